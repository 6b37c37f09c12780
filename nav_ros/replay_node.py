"""replay_node: publishes a recorded bag or a simulated scenario as live sensors would.

Recorded bytes go out as they are, on relative topic names, so namespaces and remaps work. The pace is an
absolute schedule, which does not drift. In lock-step (``lockstep_topic``) no more than ``in_flight`` IMU
messages are ever unanswered, so whatever the speed of the listener nothing is lost. Exit status: 0 at the end
of the bag and on SIGINT or SIGTERM, 1 if nobody listened within ``wait_timeout``, 2 for bad input.
"""

import dataclasses
import importlib
import struct
import sys
import threading
import time
import warnings
from collections import Counter, deque
from dataclasses import dataclass

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from inertial.parameters import check_parameters, parameter
from inertial.recording import Recording
from nav_ros.bags import TOPICS, BagError, BagReader
from nav_ros.messages import IMU, encode_clock
from nav_ros.parameters import declare_parameters
from nav_ros.recorded import recorded_messages
from nav_ros.sensor_loop import run_node, served

CLOCK_PERIOD_NS = 10_000_000
NAP_NS = 100_000_000  # longest sleep, so that a pause or the end is noticed
WAIT_TOLD = 5.0  # s between lines while waiting for subscribers
SETTLED = 0.2  # s without another subscriber: discovery is over
FAREWELL = 0.2  # s for the middleware to deliver the last messages
SLOW_SHARE = 0.95  # of the rate asked for; below it the rate was too high

_STAMP = struct.Struct("<iI")


@dataclass(frozen=True)
class ReplayParams:
    """What to replay, and how."""

    bag: str = parameter("", "", "Rosbag2 folder, .mcap or .db3 file to replay", runtime=False)
    scenario: str = parameter("", "", "Scenario to simulate in place of a bag", runtime=False)
    duration: float = parameter(60.0, "s", "Length of the simulated scenario", 1.0, 86400.0, runtime=False)
    seed: int = parameter(0, "", "Of the simulated noise", 0, 2**31 - 1, runtime=False)
    imu_rate: float = parameter(200.0, "Hz", "Of the simulated IMU", 1.0, 2000.0, runtime=False)
    altimeter_rate: float = parameter(20.0, "Hz", "Of the simulated altimeter", 0.1, 1000.0, runtime=False)
    errors: str = parameter("", "", "Name of the simulated sensors' errors; empty: consumer, or "
                            "a turntable's grade", runtime=False)
    pressure: bool = parameter(False, "", "Simulate a barometer on pressure in place of altitude",
                               runtime=False)
    rate: float = parameter(1.0, "", "Speed against real time; 0 is as fast as possible", 0.0, 1000.0,
                            runtime=False)
    loop: bool = parameter(False, "", "Start again at the end", runtime=False)
    start_paused: bool = parameter(False, "", "Wait for a call of ~/start", runtime=False)
    publish_clock: bool = parameter(False, "", "Publish /clock at 100 Hz of replayed time", runtime=False)
    wait_for_subscribers: int = parameter(1, "", "Start once the IMU topic has so many; 0 does not wait",
                                          0, 100, runtime=False)
    wait_timeout: float = parameter(0.0, "s", "Give up waiting, exit status 1; 0 waits for ever", 0.0,
                                    86400.0, runtime=False)
    lockstep_topic: str = parameter("", "", "Imu output to keep in step with, for example imu/data; empty: "
                                    "no lock-step", runtime=False)
    in_flight: int = parameter(20, "", "Most IMU messages without an answer, in lock-step", 1, 1000,
                               runtime=False)
    lockstep_timeout: float = parameter(5.0, "s", "Go on without an answer after this, in lock-step", 0.1,
                                        3600.0, runtime=False)
    exit_at_end: bool = parameter(True, "", "End with status 0 after the last message", runtime=False)
    depth: int = parameter(200, "", "Queue depth of each topic", 1, 100000, runtime=False)

    def __post_init__(self):
        check_parameters(self)
        if bool(self.bag) == bool(self.scenario):
            raise ValueError("give either bag:=FOLDER or scenario:=NAME")


class Schedule:
    """When each message is due: an absolute schedule, which a pause shifts.

    Parameters
    ----------
    rate : float
        Speed against real time; 0: everything is due at once.
    """

    def __init__(self, rate):
        self._rate = rate
        self._origin = None

    def due_ns(self, receive_ns, now_ns):
        """Return the time, on the clock of `now_ns`, when a message recorded at `receive_ns` is due."""
        if self._origin is None:
            self._origin = receive_ns, now_ns
        if self._rate == 0.0:
            return now_ns
        receive_start, start = self._origin
        return start + round((receive_ns - receive_start) / self._rate)

    def shift(self, pause_ns):
        """Move everything that is still to come by a pause."""
        if self._origin is not None:
            self._origin = self._origin[0], self._origin[1] + pause_ns

    def restart(self):
        """Count from the next message, as at the beginning."""
        self._origin = None


class Window:
    """The messages in flight: published, not yet answered. One thread publishes, another answers.

    Parameters
    ----------
    size : int
        Most messages in flight.
    """

    def __init__(self, size):
        self._size = size
        self._stamps = deque()
        self._answered = threading.Condition()
        self.unanswered = 0

    def sent(self, stamp):
        """Count a message as in flight."""
        with self._answered:
            self._stamps.append(stamp)

    def answer(self, stamp):
        """Take the message with that stamp and all before it out of flight, if it is there."""
        with self._answered:
            if stamp in self._stamps:
                while self._stamps.popleft() != stamp:
                    pass
                self._answered.notify()

    def wait_for_room(self, timeout, size=None):
        """Return whether fewer than `size` messages are in flight within `timeout` s."""
        size = self._size if size is None else size
        with self._answered:
            return self._answered.wait_for(lambda: len(self._stamps) < size, timeout)

    def give_up(self):
        """Take all out of flight and count them as unanswered."""
        with self._answered:
            self.unanswered += len(self._stamps)
            self._stamps.clear()


class ReplayNode(Node):
    """See the module."""

    def __init__(self):
        super().__init__("replay_node")
        self.params = declare_parameters(self, ReplayParams)
        self._types, self._messages = self._open()
        self._qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST, depth=self.params.depth,
            reliability=ReliabilityPolicy.RELIABLE if self.params.lockstep_topic
            else ReliabilityPolicy.BEST_EFFORT)
        self._senders = {topic: self._publisher(topic) for topic in self._types if self._known(topic)}
        self._imu_topic = self._find_imu()
        self._clock = self.create_publisher(Clock, "/clock", 10) if self.params.publish_clock else None
        self._schedule = Schedule(self.params.rate)
        self._running = threading.Event()
        if not self.params.start_paused:
            self._running.set()
        self.create_service(Trigger, "~/start", self._start)
        self.create_service(Trigger, "~/stop", self._stop)
        self._window = None
        if self.params.lockstep_topic:
            self._window = Window(self.params.in_flight)
            watch = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=2 * self.params.in_flight + 100,
                               reliability=ReliabilityPolicy.BEST_EFFORT)
            self._answers = self.create_subscription(Imu, self.params.lockstep_topic, self._answer, watch, raw=True)
        self._published = Counter()

    def replay(self):
        """Publish everything; return the exit status."""
        if not self._wait_for_subscribers():
            return 1
        if self._window:
            self._wait_for_who_answers()
        if self.params.start_paused:
            self.get_logger().info("paused; call ~/start")
        start = None
        first = last = 0
        while True:
            clock_ns = 0
            self._schedule.restart()
            for topic, receive_ns, raw in self._messages():
                self._wait_until_due(receive_ns)
                if start is None:
                    start, first = time.monotonic_ns(), receive_ns
                if self._clock and receive_ns - clock_ns >= CLOCK_PERIOD_NS:
                    self._clock.publish(encode_clock(receive_ns))
                    clock_ns = receive_ns
                last = receive_ns
                self._send(topic, raw)
            if start is None:
                self.get_logger().error("there is nothing to replay")
                return 2
            if not self.params.loop:
                break
        self._finish(start, last - first)
        return 0

    def _open(self):
        """Return the topics with their types, and a function that returns all messages in order."""
        params = self.params
        warnings.showwarning = lambda message, *_args, **_kwargs: self.get_logger().warning(str(message))
        if params.bag:
            with BagReader(params.bag) as bag:
                return dict(bag.types), self._read_bag
        # Compiled code, which a bag's replay should not wait for.
        from nav_ros.simulated import simulate_scenario
        recording = simulate_scenario(
            params.scenario, duration=params.duration, imu_rate=params.imu_rate,
            altimeter_rate=params.altimeter_rate, errors=params.errors, seed=params.seed)
        if not params.publish_clock:
            now_ns = self.get_clock().now().nanoseconds
            recording = _shifted(recording, now_ns - int(recording.imu.stamp_ns[0]))
        types, messages = recorded_messages(recording, params.pressure)
        return types, lambda: messages

    def _read_bag(self):
        with BagReader(self.params.bag) as bag:
            yield from bag.messages(self._senders)

    def _known(self, topic):
        package, _, kind = self._types[topic].split("/")
        try:
            getattr(importlib.import_module(f"{package}.msg"), kind)
        except (ImportError, AttributeError):
            self.get_logger().warning(f"{topic} is left out: {self._types[topic]} is not installed here")
            return False
        return True

    def _publisher(self, topic):
        package, _, kind = self._types[topic].split("/")
        message_class = getattr(importlib.import_module(f"{package}.msg"), kind)
        return self.create_publisher(
            message_class, topic.lstrip("/"), self._qos,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def _find_imu(self):
        imus = [topic for topic in self._senders if self._types[topic] == IMU]
        if not imus:
            raise BagError(f"{self.params.bag}: no topic of type {IMU}; topics there: "
                           f"{', '.join(sorted(self._types)) or 'none'}")
        return TOPICS["imu"] if TOPICS["imu"] in imus else imus[0]

    def _wait_for_subscribers(self):
        """Return whether the IMU topic has its subscribers and discovery has settled."""
        wanted, publisher = self.params.wait_for_subscribers, self._senders[self._imu_topic]
        if wanted == 0:
            return True
        began = told = settled = time.monotonic()
        counts = None
        while True:
            now = time.monotonic()
            previous, counts = counts, [each.get_subscription_count() for each in self._senders.values()]
            if counts != previous or publisher.get_subscription_count() < wanted:
                settled = now
            if now - settled >= SETTLED:
                return True
            if 0.0 < self.params.wait_timeout <= now - began:
                self.get_logger().error(f"{publisher.get_subscription_count()} of {wanted} subscribers on "
                                        f"{publisher.topic_name} after {self.params.wait_timeout:g} s")
                return False
            if now - told >= WAIT_TOLD:
                self.get_logger().info(f"waiting for {wanted} subscriber(s) on {publisher.topic_name}")
                told = now
            time.sleep(0.01)

    def _wait_for_who_answers(self):
        end = time.monotonic() + self.params.lockstep_timeout
        while not self._answers.handle.get_publisher_count():
            if time.monotonic() > end:
                self.get_logger().warning(f"nobody publishes {self._answers.topic_name}")
                return
            time.sleep(0.01)

    def _wait_until_due(self, receive_ns):
        """Sleep until a message is due."""
        while True:
            now_ns = time.monotonic_ns()
            if not self._running.is_set():
                self._running.wait(NAP_NS * 1e-9)
                self._schedule.shift(time.monotonic_ns() - now_ns)
                continue
            left_ns = self._schedule.due_ns(receive_ns, now_ns) - now_ns
            if left_ns <= 0:
                return
            time.sleep(min(left_ns, NAP_NS) * 1e-9)

    def _send(self, topic, raw):
        if self._window is not None:
            # Every topic waits, not only the IMU's: the listener then gets all in recorded order.
            if not self._window.wait_for_room(self.params.lockstep_timeout):
                self._window.give_up()
                self.get_logger().warning(f"no answer on {self.params.lockstep_topic} within "
                                          f"{self.params.lockstep_timeout:g} s: going on without")
            if topic == self._imu_topic:
                self._window.sent(_stamp(raw))
        self._senders[topic].publish(raw)
        self._published[topic] += 1

    def _answer(self, raw):
        if len(raw) >= 12:
            self._window.answer(_stamp(raw))

    def _finish(self, start, replayed_ns):
        """Wait for the last answers and tell what was done."""
        if self._window and not self._window.wait_for_room(self.params.lockstep_timeout, 1):
            self._window.give_up()
        seconds = max((time.monotonic_ns() - start) * 1e-9, 1e-9)
        time.sleep(FAREWELL)
        total = sum(self._published.values())
        counts = ", ".join(f"{count} {self._senders[topic].topic_name}"
                           for topic, count in self._published.items())
        speed = replayed_ns * 1e-9 / seconds
        self.get_logger().info(f"published {total} messages ({counts}) in {seconds:.2f} s: "
                               f"{self._published[self._imu_topic] / seconds:.1f} Hz IMU, "
                               f"{speed:.2f} times real time")
        if not self.params.loop and not self._window and 0.0 < speed < SLOW_SHARE * self.params.rate:
            self.get_logger().warning(f"rate {self.params.rate:g} is more than this machine can do")
        if self._window and self._window.unanswered:
            self.get_logger().warning(f"{self._window.unanswered} IMU messages were not answered on "
                                      f"{self.params.lockstep_topic}")

    def _start(self, _request, response):
        self._running.set()
        response.success, response.message = True, "replaying"
        return response

    def _stop(self, _request, response):
        self._running.clear()
        response.success, response.message = True, "paused"
        return response


def main():
    """Run the node; return its exit status."""
    return run_node("replay_node", ReplayNode, ReplayParams, __doc__, _run, (BagError, ValueError, OSError))


def _run(node):
    """Replay in this thread while another one serves calls and answers."""
    with served(node):
        status = node.replay()
        while not node.params.exit_at_end:
            time.sleep(NAP_NS * 1e-9)
    return status


def _stamp(raw):
    return _STAMP.unpack_from(raw, 4)


def _shifted(recording, offset_ns):
    """Return a recording with all stamps moved."""
    series = {field.name: getattr(recording, field.name) for field in dataclasses.fields(Recording)[1:]}
    return dataclasses.replace(recording, **{
        name: dataclasses.replace(each, stamp_ns=each.stamp_ns + offset_ns)
        for name, each in series.items() if each is not None})


if __name__ == "__main__":
    sys.exit(main())
