"""Installed programs as processes on a ROS domain of their own, and a node in this one that hears them."""

import contextlib
import os
import subprocess
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

import rclpy  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402
from sensor_msgs.msg import Imu  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from nav_ros.bags import BagReader, BagWriter  # noqa: E402
from nav_ros.demo import free_domain  # noqa: E402
from nav_ros.messages import ACCEL, GYRO, IMU, StampedEncoder  # noqa: E402
from nav_ros.resources import executable  # noqa: E402
from nav_ros.sensor_loop import served  # noqa: E402

LIMIT = 60.0
"""Seconds after which something has gone wrong, on however busy a machine."""
PATIENCE = 5.0
"""Seconds after which an answer is asked for again."""
COMPILE_LIMIT = 900.0
"""Seconds that a start may take which has every kernel to compile, on however busy a machine."""
DEPTH = 5000
"""Queue depth that holds more messages than any test publishes."""
GRAVITY = 9.80665
GYRO_STD, ACCEL_STD = 1e-3, 0.02
"""Noise of the fed samples, rad/s and m/s^2: a sensor that repeats itself counts as stuck."""
REAL_RECORDING, REAL_SECONDS = "tumvi_room4", 7.0
BURST = 50
"""Samples fed before the last one's answer is awaited, far fewer than the node's queue holds."""


def wait_until(condition, what="a condition", limit=LIMIT, meanwhile=lambda: None):
    """Return the first true value of a function, which is called until then; fail when it does not come."""
    end = time.monotonic() + limit
    while not (value := condition()):
        assert time.monotonic() < end, f"waited in vain for {what}"
        meanwhile()
        time.sleep(0.005)
    return value


def answer_of(node, kind, name, **fields):
    """Return the response of a service to a node that is served elsewhere.

    A server may know of a request before it knows of who is to have the answer, which is then lost: another request
    follows.
    """
    client = node.create_client(kind, name)
    assert client.wait_for_service(LIMIT), name
    futures = []

    def answered():
        if time.monotonic() >= began + PATIENCE * len(futures):
            futures.append(client.call_async(kind.Request(**fields)))
        return next((future for future in futures if future.done()), None)

    began = time.monotonic()
    return wait_until(answered, f"an answer of {name}").result()


def own_domain():
    """Return a free ROS domain of this test process' share, so that two never choose the same."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    return free_domain(range(1 + worker, 101, workers))


def values_of(status):
    """Return the values of a DiagnosticStatus, key -> text."""
    return {entry.key: entry.value for entry in status.values}


def publishers_key(topic):
    """Return the key under which a node tells how many publishers a sensor's topic has."""
    return f"{topic.partition('/')[0]}_publishers"


class Program:
    """One of the package's programs as it is installed, running."""

    def __init__(self, name, arguments, folder, domain):
        self._log = folder / f"{name}.log"
        # One mark stands for both: the wheels of ROS set the library path and then start Python again.
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(folder),
                                    "PYTHONUNBUFFERED": "1"}
        environment.pop("RMW_IMPLEMENTATION", None)
        with self._log.open("w") as log:
            self.process = subprocess.Popen([executable(name), *map(str, arguments)], env=environment,
                                            stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT)

    @property
    def said(self):
        return self._log.read_text()

    def wait_for(self, text, limit=LIMIT):
        """Wait until the program has said something."""
        wait_until(lambda: text in self.said or self.process.poll() is not None, repr(text), limit)
        assert text in self.said, f"ended with status {self.process.returncode}: {self.said}"

    def finish(self, signal_number=None):
        """Return the exit status, after a signal if one is given."""
        if signal_number is not None:
            self.process.send_signal(signal_number)
        return self.process.wait(LIMIT)


class Peer:
    """A node in this process, with a thread of its own that serves it.

    Of two that are matched one knows it before the other does, and what is sent in between is lost. So here all wait
    until a node, too, has told in its diagnostics how many it is matched with.
    """

    def __init__(self, domain, matches, namespace=""):
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node("peer", context=self._context, namespace=namespace)
        self._matches = matches
        self._cleanup = contextlib.ExitStack()
        self._cleanup.callback(rclpy.try_shutdown, context=self._context)
        self._cleanup.callback(self.node.destroy_node)
        self.arrays = []
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.arrays.append, DEPTH)
        self._cleanup.enter_context(served(self.node))

    def hear(self, kind, topic, *, raw=True, nodes=1):
        """Return a list that fills with the messages of a topic of so many nodes."""
        heard = []
        with self._matched(f"{topic}_subscribers", nodes):
            self.node.create_subscription(kind, topic, heard.append, DEPTH, raw=raw)
        return heard

    def publisher(self, kind, topic, reliability=ReliabilityPolicy.RELIABLE, nodes=1):
        """Return a publisher of a sensor's messages that reach so many nodes."""
        with self._matched(publishers_key(topic), nodes):
            return self.node.create_publisher(kind, topic, QoSProfile(depth=DEPTH, reliability=reliability))

    @contextlib.contextmanager
    def _matched(self, key, nodes):
        """Wait until one more peer has been matched, that of the block."""
        self.wait_matched({key: self._matches[key]}, nodes)  # those of programs that have ended are forgotten
        yield
        self._matches[key] += 1
        self.wait_matched({key: self._matches[key]}, nodes)

    def wait_matched(self, counts, nodes):
        """Wait until so many nodes, and no others otherwise, tell these numbers of peers."""
        def told():
            last = {array.status[0].name: values_of(array.status[0]) for array in list(self.arrays)}
            for key, count in counts.items():
                values = [report[key] for report in last.values() if key in report]
                if len(values) < nodes or set(values) - {str(count)}:
                    return False
            return True
        wait_until(told, f"peers: {counts}")

    def call(self, kind, name, **fields):
        """Return the response of a service."""
        return answer_of(self.node, kind, name, **fields)

    def close(self):
        self._cleanup.close()


class Feed:
    """IMU samples at rest, from this process, stamped at an even rate up to now."""

    def __init__(self, peer, roll=0.0, pitch=0.0, rate=200, reliability=ReliabilityPolicy.RELIABLE, nodes=1):
        self.publisher = peer.publisher(Imu, "imu/data_raw", reliability, nodes)
        self.answers = peer.hear(Imu, "imu/data", nodes=nodes)
        self.period_ns = 10**9 // rate
        self.stamp_ns = 0
        self._encoder = StampedEncoder(IMU, "imu_link")
        self._rng = np.random.default_rng(0)
        # The direction up in the axes of a body of that roll and pitch (FLU, REP-103).
        self._up = np.array([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])

    def message(self, stamp_ns, gyro=None, accel=None):
        """Return a serialized sample."""
        values = np.zeros(37)
        values[GYRO] = GYRO_STD * self._rng.standard_normal(3) if gyro is None else gyro
        values[ACCEL] = (GRAVITY * self._up + ACCEL_STD * self._rng.standard_normal(3)
                         if accel is None else accel)
        return self._encoder.encode(stamp_ns, values)

    def next(self, **fields):
        """Publish the next sample."""
        self.stamp_ns += self.period_ns
        self.publisher.publish(self.message(self.stamp_ns, **fields))

    def start(self, seconds, end_ns=None):
        """Publish samples whose stamps end now, or at a given stamp."""
        self.stamp_ns = (time.time_ns() if end_ns is None else end_ns) - round(seconds * 1e9)
        self.go_on(seconds)

    def go_on(self, seconds):
        """Publish the samples that follow and wait for their answers."""
        for k in range(round(seconds * 1e9) // self.period_ns):
            self.next()
            if k % BURST == BURST - 1:
                self.wait()
        self.wait()

    def wait(self):
        """Wait for the answer to the last sample."""
        stamp = self.message(self.stamp_ns)[4:12]
        wait_until(lambda: self.answers and self.answers[-1][4:12] == stamp, "the answer to a sample")


class Diagnostics:
    """What a node has reported on /diagnostics, each report looked at once."""

    def __init__(self, peer, name="attitude_node", what="attitude"):
        self._name = f"{name}: {what}"
        self._arrays = peer.arrays
        self._looked_at = 0

    @property
    def reports(self):
        """(stamp in s, DiagnosticStatus) of each report so far."""
        return [(array.header.stamp.sec + array.header.stamp.nanosec * 1e-9, array.status[0])
                for array in list(self._arrays) if array.status[0].name == self._name]

    def wait_for(self, condition, what, since=0.0, **options):
        """Return the next report that fulfils a condition."""
        def found():
            for stamp, status in self.reports[self._looked_at:]:
                self._looked_at += 1
                if stamp >= since and condition(status):
                    return status
            return None
        return wait_until(found, what, **options)

    def told(self, text, **options):
        """Return the next report with some text in its message."""
        return self.wait_for(lambda status: text in status.message, repr(text), **options)

    def next(self):
        """Return the first report that is made from now on."""
        return self.wait_for(lambda _: True, "a report", since=time.time())


class Bench:
    """What a test starts, and ends with it."""

    wait_until, values_of = staticmethod(wait_until), staticmethod(values_of)
    feed, diagnostics = Feed, Diagnostics

    def __init__(self, folder):
        self.domain = own_domain()
        self._folder = folder
        self._cleanup = contextlib.ExitStack()
        self._starts, self._matches = Counter(), Counter()

    def start(self, name, *arguments):
        """Start an installed program with ROS arguments."""
        self._starts[name] += 1
        folder = self._folder / f"{name}_{self._starts[name]}"
        folder.mkdir()
        program = Program(name, ["--ros-args", *arguments] if arguments else [], folder, self.domain)
        self._cleanup.callback(_kill, program.process)
        return program

    def start_ready(self, *arguments, name="attitude_node"):
        """Start a node and wait until it listens."""
        node = self.start(name, *arguments)
        node.wait_for("]: ready", COMPILE_LIMIT)
        return node

    def play(self, peer, bag, *parameters, remaps=(), answers="imu/data"):
        """Begin to play a bag in lock-step, once it is matched with what it is for."""
        given = [f"bag:={bag}", "rate:=0.0", f"lockstep_topic:={answers}", f"lockstep_timeout:={LIMIT}",
                 "start_paused:=true", *parameters]
        replay = self.start("replay_node", *(item for text in given for item in ("-p", text)), *remaps)
        replay.wait_for("paused")
        with BagReader(bag) as reader:
            keys = {f"{answers}_subscribers", *(publishers_key(topic.lstrip("/")) for topic in reader.types)}
        peer.wait_matched({key: self._matches[key] + 1 for key in keys}, 0)
        peer.call(Trigger, "replay_node/start")
        return replay

    def replay(self, peer, bag, *parameters, **options):
        """Play a bag in lock-step with imu/data to its end."""
        replay = self.play(peer, bag, *parameters, **options)
        assert replay.finish() == 0 and "not answered" not in replay.said, replay.said

    def peer(self, namespace=""):
        peer = Peer(self.domain, self._matches, namespace)
        self._cleanup.callback(peer.close)
        return peer

    def close(self):
        self._cleanup.close()


def _kill(process):
    if process.poll() is None:
        process.kill()
        process.wait()


@pytest.fixture(scope="session", name="answer_of")
def answer_of_fixture():
    """Return the function of that name."""
    return answer_of


@pytest.fixture(scope="session")
def domain():
    """Return a ROS domain for all tests of a file."""
    return own_domain()


@pytest.fixture(scope="session")
def open_bench(tmp_path_factory):
    """Return a context manager that makes a :class:`Bench`."""
    return lambda: contextlib.closing(Bench(tmp_path_factory.mktemp("bench")))


@pytest.fixture
def bench(open_bench):
    """Return a :class:`Bench` for one test."""
    with open_bench() as bench:
        yield bench


@pytest.fixture(scope="session")
def turn_bag(tmp_path_factory):
    """Return a bag of 12 s with turns, 100 Hz, its truth and 20 Hz of altitude."""
    from nav_ros.cli import simulate_bag_main
    bag = tmp_path_factory.mktemp("bags") / "turn"
    simulate_bag_main(["turn", str(bag), "--duration", "12", "--imu-rate", "100"])
    return bag


@pytest.fixture(scope="session")
def real_bag(repository, tmp_path_factory):
    """Return a bag of the first seconds of a real recording; skip where there is none."""
    source = Path(os.environ.get("REAL_BAGS", repository.parent / "shared" / "bags")) / REAL_RECORDING
    if not source.is_dir():
        pytest.skip(f"no recording {REAL_RECORDING} in ../shared/bags or REAL_BAGS")
    bag = tmp_path_factory.mktemp("bags") / REAL_RECORDING
    with BagReader(source) as reader, BagWriter(bag, reader.types) as writer:
        start_ns = next(reader.messages()).receive_ns
        for message in reader.messages():
            if message.receive_ns - start_ns > REAL_SECONDS * 1e9:
                break
            writer.write(*message)
    return bag
