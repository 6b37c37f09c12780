"""replay_node as a real process on a real DDS domain, heard by a node in this one."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

import rclpy  # noqa: E402
from geometry_msgs.msg import PointStamped, QuaternionStamped  # noqa: E402
from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import Imu  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from nav_ros.bags import read_messages  # noqa: E402
from nav_ros.cli import simulate_bag_main  # noqa: E402
from nav_ros.sensor_loop import served  # noqa: E402

LIMIT = 60.0
"""Seconds after which something has gone wrong, on however busy a machine."""
SECONDS = 2.0
"""Length of the bag: 400 IMU samples at 200 Hz."""
EARLY = 0.02
"""Seconds by which the measured length may be short: the first message is sent after the clock is read."""
LOCKSTEP = ("rate:=0.0", "lockstep_topic:=imu/data", f"lockstep_timeout:={LIMIT}")
SENSOR_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
TOPICS = {"imu/data_raw": Imu, "altitude": PointStamped, "ground_truth/attitude": QuaternionStamped}


class Listener:
    """A node that keeps the raw messages of some topics and may answer the IMU's."""

    def __init__(self, answer_of, domain, types, namespace="", answers=False):
        self.answer_of = answer_of
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("listener", context=self.context, namespace=namespace)
        self.heard = {topic: [] for topic in types}
        self.imu = next(topic for topic, kind in types.items() if kind is Imu)
        self.answers = self.node.create_publisher(Imu, "imu/data", 200) if answers else None
        self.subscriptions = [
            self.node.create_subscription(kind, topic, lambda raw, t=topic: self._hear(t, raw), SENSOR_QOS, raw=True)
            for topic, kind in types.items()]
        self.cleanup = contextlib.ExitStack()
        self.cleanup.callback(rclpy.try_shutdown, context=self.context)
        self.cleanup.callback(self.node.destroy_node)
        self.cleanup.enter_context(served(self.node))

    def _hear(self, topic, raw):
        self.heard[topic].append(raw)
        if self.answers and topic == self.imu:
            self.answers.publish(raw)

    def start(self):
        """Start a paused replay once every one of its messages will be heard."""
        wait_until(lambda: all(each.handle.get_publisher_count() for each in self.subscriptions))
        wait_until(lambda: self.answers is None or self.answers.get_subscription_count())
        return self.call("replay_node/start")

    def call(self, service):
        return self.answer_of(self.node, Trigger, service)

    def close(self):
        self.cleanup.close()


def wait_until(condition):
    end = time.monotonic() + LIMIT
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("bags") / "run"
    simulate_bag_main(["hover", str(path), "--duration", str(SECONDS), "--rest", "1"])
    return path


@pytest.fixture
def listen(answer_of, domain):
    listeners = []

    def make(*arguments, **named):
        listeners.append(Listener(answer_of, domain, *arguments, **named))
        return listeners[-1]

    yield make
    for listener in listeners:
        listener.close()


@pytest.fixture
def replay(domain):
    children = []

    def start(*parameters, arguments=()):
        environment = {name: value for name, value in os.environ.items() if name != "RMW_IMPLEMENTATION"}
        environment["ROS_DOMAIN_ID"] = str(domain)
        given = [item for parameter in parameters for item in ("-p", parameter)]
        children.append(subprocess.Popen(
            [sys.executable, "-m", "nav_ros.replay_node", "--ros-args", *given, *arguments], env=environment,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True))
        return children[-1]

    yield start
    for child in children:
        if child.poll() is None:
            child.kill()
        child.communicate()


def play(replay, listener, *parameters, arguments=()):
    """Return exit status and output of a replay of which nothing is missed."""
    child = replay(*parameters, "start_paused:=true", arguments=arguments)
    listener.start()
    return finish(child)


def finish(child):
    """Return exit status and output."""
    output, _ = child.communicate(timeout=LIMIT)
    return child.returncode, output


def recorded(bag, topic):
    return [message.raw for message in read_messages(bag, [topic])]


def test_every_message_arrives_as_recorded_and_on_time(bag, listen, replay):
    listener = listen(TOPICS)
    status, output = play(replay, listener, f"bag:={bag}")
    assert status == 0, output
    for topic, heard in listener.heard.items():
        assert heard == recorded(bag, f"/{topic}")
    seconds = float(re.search(r"in ([\d.]+) s: ", output)[1])
    # How late it is at the end is the machine's affair.
    assert seconds > SECONDS - EARLY


def test_in_lock_step_nothing_is_lost_however_fast(bag, listen, replay):
    listener = listen(TOPICS, answers=True)
    status, output = play(replay, listener, f"bag:={bag}", *LOCKSTEP, "in_flight:=3")
    assert status == 0 and "not answered" not in output, output
    for topic, heard in listener.heard.items():
        assert heard == recorded(bag, f"/{topic}")


def test_without_an_answer_lock_step_goes_on_and_tells(bag, listen, replay):
    listener = listen(TOPICS)
    status, output = play(replay, listener, f"bag:={bag}", "rate:=0.0", "lockstep_topic:=imu/data", "in_flight:=150",
                          "lockstep_timeout:=0.2")
    assert status == 0 and "nobody publishes /imu/data" in output, output
    assert "400 IMU messages were not answered on imu/data" in output
    assert len(listener.heard["imu/data_raw"]) == 400


def test_names_can_be_put_in_a_namespace_and_remapped(bag, listen, replay):
    listener = listen({"/plane/my_imu": Imu, "/plane/altitude": PointStamped}, namespace="/plane", answers=True)
    status, output = play(replay, listener, f"bag:={bag}", *LOCKSTEP, arguments=[
        "-r", "__ns:=/plane", "-r", "imu/data_raw:=my_imu"])
    assert status == 0, output
    assert listener.heard["/plane/my_imu"] == recorded(bag, "/imu/data_raw")
    assert listener.heard["/plane/altitude"] == recorded(bag, "/altitude")


def test_it_stays_paused_until_it_is_started_and_can_be_stopped(bag, listen, replay):
    listener = listen(TOPICS)
    child = replay(f"bag:={bag}", "start_paused:=true")
    heard = listener.heard["imu/data_raw"]
    assert listener.call("/replay_node/stop").success
    assert not heard
    assert listener.start().message == "replaying"
    wait_until(lambda: len(heard) > 20)
    assert listener.call("/replay_node/stop").message == "paused"
    wait_until(lambda: len(heard) == _after_a_while(heard))
    assert len(heard) < 400
    listener.call("/replay_node/start")
    assert finish(child)[0] == 0
    assert heard == recorded(bag, "/imu/data_raw")


def _after_a_while(heard):
    time.sleep(0.1)
    return len(heard)


def test_a_scenario_is_simulated_with_clock_and_pressure(listen, replay):
    from sensor_msgs.msg import FluidPressure
    listener = listen({"imu/data_raw": Imu, "pressure": FluidPressure, "/clock": Clock}, answers=True)
    status, output = play(replay, listener, *LOCKSTEP, "scenario:=turn", "duration:=2.0", "imu_rate:=100.0",
                          "pressure:=true", "publish_clock:=true")
    assert status == 0, output
    assert len(listener.heard["imu/data_raw"]) == 200
    assert len(listener.heard["pressure"]) == pytest.approx(40, abs=1)
    clocks = [int.from_bytes(raw[4:8], "little") * 10**9 + int.from_bytes(raw[8:12], "little")
              for raw in listener.heard["/clock"]]
    assert clocks == sorted(set(clocks))
    assert len(clocks) == pytest.approx(200, abs=2)


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_with_status_0(bag, listen, replay, signal_number):
    listener = listen({"imu/data_raw": Imu})
    child = replay(f"bag:={bag}", "rate:=0.0", "loop:=true")
    wait_until(lambda: len(listener.heard["imu/data_raw"]) > 400)
    child.send_signal(signal_number)
    status, output = finish(child)
    assert status == 0 and "Traceback" not in output, output


def test_signals_end_it_while_it_waits_or_is_paused(bag, listen, replay):
    listener = listen({"heard/imu/data_raw": Imu})
    waiting = replay(f"bag:={bag}", arguments=["-r", "__node:=waiting"])
    paused = replay(f"bag:={bag}", "start_paused:=true",
                    arguments=["-r", "__node:=paused", "-r", "__ns:=/heard"])
    assert listener.call("/waiting/stop").success and listener.call("/heard/paused/stop").success
    waiting.send_signal(signal.SIGTERM)
    paused.send_signal(signal.SIGINT)
    assert finish(waiting)[0] == 0 and finish(paused)[0] == 0


def test_what_cannot_be_replayed_is_told_in_one_line(replay):
    expected = [
        ([], 2, "give either bag:=FOLDER or scenario:=NAME"),
        (["bga:=/none"], 2, "there is no parameter bga; did you mean bag?"),
        (["bag:=/none"], 2, "/none: there is no such file or folder"),
        (["scenario:=turn", "rate:=-1.0"], 2, "rate = -1.0: must be from 0.0 to 1000.0"),
        (["scenario:=dive"], 2, "unknown scenario 'dive'"),
        (["scenario:=turn", "duration:=2.0", "wait_timeout:=0.2"], 1, "0 of 1 subscribers on /imu/data_raw")]
    for parameters, status, reason in expected:
        got, output = finish(replay(*parameters))
        assert got == status and reason in output
        assert len(output.strip().splitlines()) == 1 + ("bga" in output)


def test_an_interrupted_recording_is_replayed_up_to_the_break(bag, tmp_path, listen, replay):
    (file,) = bag.glob("*.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[:-500])
    listener = listen(TOPICS, answers=True)
    status, output = play(replay, listener, f"bag:={cut}", *LOCKSTEP)
    assert status == 0 and "up to the break" in output, output
    heard = listener.heard["imu/data_raw"]
    assert len(heard) > 300 and heard == recorded(bag, "/imu/data_raw")[:len(heard)]
