"""Installed programs as processes on a ROS domain of their own, and a node in this one that hears them."""

import contextlib
import os
import subprocess
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

import rclpy  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402
from sensor_msgs.msg import Imu  # noqa: E402

from nav_ros.demo import free_domain  # noqa: E402
from nav_ros.messages import ACCEL, GYRO, IMU, StampedEncoder  # noqa: E402
from nav_ros.resources import executable  # noqa: E402
from nav_ros.sensor_loop import served  # noqa: E402

LIMIT = 60.0
"""Seconds after which something has gone wrong, on however busy a machine."""
COMPILE_LIMIT = 400.0
"""Seconds that a start may take which has every kernel to compile."""
DEPTH = 5000
"""Queue depth that holds more messages than any test publishes."""
GRAVITY = 9.80665
GYRO_STD, ACCEL_STD = 1e-3, 0.02
"""Noise of the fed samples, rad/s and m/s^2: a sensor that repeats itself counts as stuck."""
REAL_RECORDING, REAL_SECONDS = "tumvi_room4", 7.0
BURST = 50
"""Samples fed before the last one's answer is awaited, far fewer than the node's queue holds."""


def wait_until(condition, what="a condition", limit=LIMIT, meanwhile=lambda: None):
    """Return the first true value of a function; fail when it does not come.

    What is published `meanwhile` arrives sooner or later: a publisher is told of a match before the
    subscriber is, and a best-effort subscriber misses what is sent in between.
    """
    end = time.monotonic() + limit
    while not (value := condition()):
        assert time.monotonic() < end, f"waited in vain for {what}"
        meanwhile()
        time.sleep(0.005)
    return value


def own_domain():
    """Return a free ROS domain of this test process' share, so that two never choose the same."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    return free_domain(range(1 + worker, 101, workers))


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
    """A node in this process, with a thread of its own that serves it."""

    def __init__(self, domain, namespace=""):
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node("peer", context=self._context, namespace=namespace)
        self._cleanup = contextlib.ExitStack()
        self._cleanup.callback(rclpy.try_shutdown, context=self._context)
        self._cleanup.callback(self.node.destroy_node)
        self._cleanup.enter_context(served(self.node))

    def hear(self, kind, topic, *, raw=True, reliability=ReliabilityPolicy.RELIABLE, matched=True):
        """Return a list that fills with the messages of a topic, once a publisher is there."""
        heard = []
        subscription = self.node.create_subscription(
            kind, topic, heard.append, QoSProfile(depth=DEPTH, reliability=reliability), raw=raw)
        if matched:
            wait_until(lambda: subscription.handle.get_publisher_count(), f"a publisher of {topic}")
        return heard

    def publisher(self, kind, topic, reliability=ReliabilityPolicy.RELIABLE):
        """Return a publisher, once a subscriber is there."""
        publisher = self.node.create_publisher(kind, topic, QoSProfile(depth=DEPTH, reliability=reliability))
        wait_until(publisher.get_subscription_count, f"a subscriber of {topic}")
        return publisher

    def call(self, kind, name, **fields):
        """Return the response of a service."""
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(LIMIT), name
        future = client.call_async(kind.Request(**fields))
        wait_until(future.done, f"an answer of {name}")
        return future.result()

    def close(self):
        self._cleanup.close()


class Feed:
    """IMU samples at rest, from this process, stamped at an even rate up to now."""

    def __init__(self, peer, roll=0.0, pitch=0.0, rate=200, reliability=ReliabilityPolicy.RELIABLE):
        self.publisher = peer.publisher(Imu, "imu/data_raw", reliability)
        self.answers = peer.hear(Imu, "imu/data")
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
    """What a node has reported on /diagnostics."""

    def __init__(self, peer, name="attitude_node", what="attitude"):
        self._name = f"{name}: {what}"
        self._arrays = peer.hear(DiagnosticArray, "/diagnostics", raw=False)

    @property
    def reports(self):
        """(stamp in s, DiagnosticStatus) of each report so far."""
        return [(array.header.stamp.sec + array.header.stamp.nanosec * 1e-9, array.status[0])
                for array in list(self._arrays) if array.status[0].name == self._name]

    def wait_for(self, condition, what, **options):
        """Return the first report from now on that fulfils a condition."""
        seen = len(self.reports)
        return wait_until(lambda: next((status for _, status in self.reports[seen:] if condition(status)),
                                       None), what, **options)

    def told(self, text, **options):
        """Return the first report from now on with some text in its message."""
        return self.wait_for(lambda status: text in status.message, repr(text), **options)

    def next(self):
        """Return the first report that is made wholly from now on."""
        seen = len(self.reports)
        wait_until(lambda: len(self.reports) > seen + 1, "two reports")
        return self.reports[seen + 1][1]


class Bench:
    """What a test starts, and ends with it."""

    wait_until = staticmethod(wait_until)
    feed, diagnostics = Feed, Diagnostics

    def __init__(self, folder):
        self.domain = own_domain()
        self._folder = folder
        self._cleanup = contextlib.ExitStack()
        self._starts = defaultdict(int)

    def start(self, name, *arguments):
        """Start an installed program with ROS arguments."""
        self._starts[name] += 1
        folder = self._folder / f"{name}_{self._starts[name]}"
        folder.mkdir()
        program = Program(name, ["--ros-args", *arguments] if arguments else [], folder, self.domain)
        self._cleanup.callback(_kill, program.process)
        return program

    def start_ready(self, *arguments):
        """Start attitude_node and wait until it listens."""
        node = self.start("attitude_node", *arguments)
        node.wait_for("]: ready", COMPILE_LIMIT)
        return node

    def replay(self, bag, *parameters, remaps=()):
        """Play a bag in lock-step with imu/data to its end."""
        given = [f"bag:={bag}", "rate:=0.0", "lockstep_topic:=imu/data",
                 f"lockstep_timeout:={LIMIT}", *parameters]
        replay = self.start("replay_node", *(item for text in given for item in ("-p", text)), *remaps)
        assert replay.finish() == 0 and "not answered" not in replay.said, replay.said

    def peer(self, namespace=""):
        peer = Peer(self.domain, namespace)
        self._cleanup.callback(peer.close)
        return peer

    def close(self):
        self._cleanup.close()


def _kill(process):
    if process.poll() is None:
        process.kill()
        process.wait()


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
    from nav_ros.bags import BagReader, BagWriter
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
