"""What attitude_node says and does when its input is wrong: the rows of bad input, on a real process."""

import math
import signal
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from geometry_msgs.msg import PointStamped  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from rclpy.serialization import deserialize_message  # noqa: E402
from sensor_msgs.msg import FluidPressure, Imu  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from nav_ros.bias_file import StoredBiases, read_biases, write_biases  # noqa: E402
from nav_ros.messages import GYRO_COVARIANCE, IMU, POINT, PRESSURE, StampedEncoder  # noqa: E402

RATE = 200
RATE_SHARE = 1e-3
BURST = 50
"""Samples between two waits for an answer."""
QUEUE = 1000
"""Messages that the node keeps while it is busy."""
BIAS_STD = 2e-3
"""rad/s, what some seconds at rest leave open of a gyro bias."""
GRAVITY = 9.80665
WARN, ERROR, STALE = b"\x01", b"\x02", b"\x03"
NOT_FAULTS = ("_hz", "_s", "_publishers", "_subscribers", "_messages", "use_altitude", "state", "tilt_sigma_deg")
"""How the keys of other values end."""


def values(report):
    return {entry.key: entry.value for entry in report.values}


def faults(report):
    """Return the counters that are not zero."""
    return {key: int(value) for key, value in values(report).items()
            if not key.endswith(NOT_FAULTS) and value != "0"}


def settled(diagnostics, feed):
    """Return the first report that knows of the last sample."""
    feed.go_on(0.05)
    return diagnostics.next()


def test_every_fault_of_the_imu_is_counted_and_survived(bench):
    node = bench.start_ready()
    peer = bench.peer()
    diagnostics = bench.diagnostics(peer)
    report = diagnostics.next()
    assert report.level == STALE and "no usable imu/data_raw yet: nobody publishes it" in report.message

    feed = bench.feed(peer, rate=RATE, reliability=ReliabilityPolicy.BEST_EFFORT)
    feed.start(4.0)
    report = settled(diagnostics, feed)
    assert faults(report) == {}
    assert float(values(report)["imu_rate_hz"]) == pytest.approx(RATE, rel=RATE_SHARE)
    assert values(report)["state"] == "attitude known"
    assert "no altitude: the IMU alone" in report.message

    answers, good = len(feed.answers), 0
    for stamp_offset_ns, count in ((0, 3), (-10_000_000, 4)):
        for _ in range(count):
            feed.publisher.publish(feed.message(feed.stamp_ns + stamp_offset_ns))
            feed.next()
            good += 1
    for bad, count in (({"gyro": [math.nan, 0.0, 0.0]}, 2), ({"accel": [0.0, math.inf, 0.0]}, 5),
                       ({"gyro": [0.0, 1e6, 0.0]}, 1), ({"accel": [0.0, 0.0, -1e9]}, 2)):
        for _ in range(count):
            feed.next(**bad)
            feed.next()
            good += 2
    usual = feed.message(feed.stamp_ns)
    for malformed in (usual[:-8], usual[:20], usual + b"\x00" * 8, b"\x00\x00" + usual[2:],
                      usual[:12] + b"\xff\xff\xff\x7f" + usual[16:]):
        feed.publisher.publish(malformed)
        feed.next()
        good += 1
    negative, overflow = (-5).to_bytes(4, "little", signed=True), (10**9).to_bytes(4, "little")
    for untimed in (usual[:4] + negative + usual[8:], usual[:8] + overflow + usual[12:],
                    usual[:4] + bytes(8) + usual[12:]):
        feed.publisher.publish(untimed)
        feed.next()
        good += 1
    report = settled(diagnostics, feed)
    good += RATE // 20
    expected = {"duplicate_stamp": 3, "backward_stamp": 4, "gyro_not_finite": 2, "accel_not_finite": 5,
                "gyro_out_of_range": 1, "accel_out_of_range": 2, "malformed": 5, "no_stamp": 3}
    assert faults(report) == expected
    assert int(values(report)["imu_messages"]) == 4 * RATE + RATE // 20 + good + 15
    assert [raw[4:12] for raw in feed.answers[answers:]] == \
        [feed.message(feed.stamp_ns - k * feed.period_ns)[4:12] for k in reversed(range(good))]
    for raw in feed.answers:
        assert np.isfinite(np.frombuffer(raw[-37 * 8:])).all()
    assert "10 of" in report.message and "not finite" in report.message
    assert report.level == ERROR

    stamp_ns = feed.stamp_ns
    feed.start(2.0, end_ns=stamp_ns - 100 * 10**9)
    assert node.said.count("stamps went back") == 1
    first, last = (deserialize_message(raw, Imu).orientation_covariance[0]
                   for raw in (feed.answers[-2 * RATE], feed.answers[-1]))
    assert first == -1.0 and last > 0.0
    assert faults(settled(diagnostics, feed)) == expected | {"stamp_jump_back": 1}


def test_an_imu_that_stops_and_returns(bench):
    bench.start_ready()
    peer = bench.peer()
    diagnostics = bench.diagnostics(peer)
    feed = bench.feed(peer)
    feed.start(3.0)
    seen = len(feed.answers)
    report = diagnostics.told("imu/data_raw stopped")
    assert report.level == ERROR and "nobody publishes it" not in report.message
    assert len(feed.answers) == seen
    feed.start(3.0, end_ns=feed.stamp_ns + 5 * 10**9)  # beyond gap_limit, however long the report took
    report = diagnostics.wait_for(lambda status: "stopped" not in status.message, "a recovery", since=time.time(),
                                  meanwhile=lambda: feed.go_on(0.02))
    assert report.level in (b"\x00", WARN)
    assert feed.answers[-1][4:12] == feed.message(feed.stamp_ns)[4:12]
    feed.start(1.0, end_ns=feed.stamp_ns + 60 * 10**9)
    assert "ahead of the node's clock" in settled(diagnostics, feed).message


def test_an_altitude_that_is_missing_wrong_or_stops(bench):
    bench.start_ready()
    peer = bench.peer()
    diagnostics = bench.diagnostics(peer)
    feed, altitude = bench.feed(peer), peer.publisher(PointStamped, "altitude")
    point = StampedEncoder(POINT, "odom")

    def climb(seconds, height=10.0):
        for _ in range(round(20 * seconds)):
            altitude.publish(point.encode(feed.stamp_ns, np.array([0.0, 0.0, height])))
            feed.go_on(0.05)

    def told_of(text, there, since):
        """Return the next report, made while it climbs, that has some text or has it not."""
        return diagnostics.wait_for(lambda status: (text in status.message) == there, f"{text}: {there}",
                                    since=since, meanwhile=lambda: climb(0.05))

    feed.start(0.5)
    assert "no altitude: the IMU alone" in settled(diagnostics, feed).message
    feed.start(0.05)
    climb(2.0)
    report = told_of("altitude", False, time.time())
    assert float(values(report)["altitude_rate_hz"]) == pytest.approx(20.0, rel=RATE_SHARE)
    before = faults(report)

    climb(0.1, math.nan)
    altitude.publish(point.encode(feed.stamp_ns, np.zeros(3))[:-8])
    altitude.publish(point.encode(0, np.zeros(3)))
    report = diagnostics.wait_for(lambda status: values(status).get("altitude_no_stamp") == "1", "what is wrong")
    assert faults(report) == before | {"altitude_not_finite": 2, "malformed": 1, "altitude_no_stamp": 1}
    assert "the IMU alone" in diagnostics.told("altitude stopped").message
    told_of("altitude", False, time.time())


def test_pressure_its_unit_and_two_altimeters(bench):
    auto = bench.start_ready()
    chosen = bench.start_ready("-r", "__node:=chosen", "-p", "altitude_source:=pressure")
    peer = bench.peer()
    of_auto, of_chosen = bench.diagnostics(peer), bench.diagnostics(peer, "chosen")
    feed, barometer = bench.feed(peer, nodes=2), peer.publisher(FluidPressure, "pressure", nodes=2)
    pressure, point = StampedEncoder(PRESSURE, "baro"), StampedEncoder(POINT, "odom")
    feed.start(0.1)

    def in_hectopascal():
        barometer.publish(pressure.encode(feed.stamp_ns, np.array([1013.25, 0.0])))

    for node, diagnostics in ((auto, of_auto), (chosen, of_chosen)):
        report = diagnostics.told("looks like hPa (mbar)", meanwhile=in_hectopascal)
        assert report.level == ERROR and set(faults(report)) == {"pressure_unit"}
        assert "multiply by 100" in node.said

    altitude = peer.publisher(PointStamped, "altitude")
    assert altitude.get_subscription_count() == 1, "only one of the nodes takes any altimeter"

    def of_both_kinds():
        barometer.publish(pressure.encode(feed.stamp_ns, np.array([101325.0, 4.0])))
        altitude.publish(point.encode(feed.stamp_ns, np.zeros(3)))
        feed.next()

    both = of_auto.told("choose one by altitude_source", meanwhile=of_both_kinds)
    assert both.level == ERROR and faults(both)["two_altimeters"] >= 1
    report = of_chosen.next()
    assert set(faults(report)) <= {"pressure_unit", "altitude_duplicate"}
    assert int(values(report)["pressure_messages"]) > 1 and "altitude_messages" not in values(report)


def test_a_peer_whose_qos_does_not_fit_is_told(bench):
    node = bench.start_ready()
    peer = bench.peer()
    diagnostics = bench.diagnostics(peer)
    lasting = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    peer.node.create_subscription(Imu, "imu/data", lambda _: None, lasting)
    report = diagnostics.told("DURABILITY")
    assert report.level in (ERROR, STALE) and "imu/data: " in report.message
    assert faults(report) == {"incompatible_qos": 1}
    assert "DURABILITY" in node.said


def test_a_second_start_compiles_nothing(bench, monkeypatch):
    bench.start_ready()
    monkeypatch.setenv("NUMBA_DEBUG_CACHE", "1")
    said = bench.start_ready().said
    assert "data loaded from" in said and "data saved to" not in said


def begin(feed, seconds, **fields):
    """Publish samples up to now."""
    feed.stamp_ns = time.time_ns() - round(seconds * 1e9)
    stream(feed, seconds, **fields)


def publish(feed, fields):
    feed.next(**{name: value() for name, value in fields.items()})


def stream(feed, seconds, **fields):
    """Publish the samples that follow, made by one function a field, and wait for their answers."""
    for k in range(round(seconds * 1e9) // feed.period_ns):
        publish(feed, fields)
        if k % BURST == 0:
            feed.wait()
    feed.wait()


def stamp_of(raw):
    return int.from_bytes(raw[4:8], "little") * 10**9 + int.from_bytes(raw[8:12], "little")


def noisy(vector, std):
    rng = np.random.default_rng(1)
    return lambda: np.asarray(vector) + std * rng.standard_normal(3)


def test_what_a_message_says_besides_its_sample_is_judged(bench, tmp_path):
    (tmp_path / "biases.yaml").write_text("stamp_ns: 1\ngyro_bias: [1, 2]\n")
    node = bench.start_ready("-p", f"bias_file:={tmp_path / 'biases.yaml'}")
    assert node.said.count("gyro_bias = [1, 2]: must be three numbers: starting without") == 1
    peer = bench.peer()
    diagnostics, feed = bench.diagnostics(peer), bench.feed(peer)
    begin(feed, 3.0)
    report = settled(diagnostics, feed)
    assert faults(report) == {} and "found in motion" not in report.message

    sample = np.frombuffer(feed.message(feed.stamp_ns)[-37 * 8:])
    uncovered = sample.copy()
    uncovered[GYRO_COVARIANCE.start] = -1.0
    for frame, doubles in (("other", sample), ("", sample), *[("imu_link", uncovered)] * 3):
        feed.stamp_ns += feed.period_ns
        feed.publisher.publish(StampedEncoder(IMU, frame).encode(feed.stamp_ns, doubles))
    report = diagnostics.told("two IMUs on one topic")
    assert report.level == ERROR and "publishers" not in report.message
    report = settled(diagnostics, feed)
    assert faults(report) == {"frame_id_changed": 3, "frame_id_empty": 1, "covariance_invalid": 3}

    stream(feed, 6.0, accel=noisy([0.0, 0.0, 1.0], 2e-3))
    report = diagnostics.told("it looks like g")
    assert report.level == ERROR and "multiply by 9.80665" in report.message
    stream(feed, 6.0, accel=noisy([0.0, 0.0, -GRAVITY], 0.02))
    assert "upside down (set mounting_rpy)" in diagnostics.told("upside down").message

    peer.publisher(Imu, "imu/data_raw")
    assert "imu/data_raw has 2 publishers" in diagnostics.told("publishers").message
    for _ in range(20):  # what two publishers look like, one of them always a little behind
        feed.publisher.publish(feed.message(feed.stamp_ns - 10**8))
        feed.next()
    assert "stamps go back and forth: two publishers?" in diagnostics.told("back and forth").message

    assert peer.call(Trigger, "/attitude_node/reset").success
    stream(feed, 10.0, gyro=noisy([0.0, 0.0, 0.3], 1e-3))
    assert diagnostics.told("the attitude was found in motion").level >= WARN


def test_a_reset_and_a_burst_in_the_stream(bench, tmp_path):
    path, bias = tmp_path / "biases.yaml", np.array([0.02, -0.01, 0.015])
    write_biases(path, StoredBiases(time.time_ns(), tuple(bias), (BIAS_STD,) * 3, (0.0,) * 3, (0.02,) * 3))
    node = bench.start_ready("-p", f"bias_file:={path}")
    peer = bench.peer()
    diagnostics, feed = bench.diagnostics(peer), bench.feed(peer)
    begin(feed, 3.0, gyro=noisy(bias, 1e-3))
    rate = deserialize_message(feed.answers[0], Imu).angular_velocity
    assert np.linalg.norm([rate.x, rate.y, rate.z]) < BIAS_STD + 6e-3, "the stored bias counts from the first sample"

    client = peer.node.create_client(Trigger, "/attitude_node/reset")
    bench.wait_until(client.service_is_ready, "the service")
    answers, sent, future = len(feed.answers), 0, client.call_async(Trigger.Request())
    while not future.done():
        stream(feed, 0.05, gyro=noisy(bias, 1e-3))
        sent += RATE // 20
    stream(feed, 2.5, gyro=noisy(bias, 1e-3))
    assert future.result().success and len(feed.answers) - answers == sent + round(2.5 * RATE)
    known = [deserialize_message(raw, Imu).orientation_covariance[0] >= 0.0 for raw in feed.answers[answers:]]
    lost, found = known.index(False), known.index(True, known.index(False))
    assert all(known[:lost]) and not any(known[lost:found]) and all(known[found:])

    answers = len(feed.answers)
    for _ in range(4 * QUEUE):
        feed.next(gyro=bias)
    burst_end_ns = feed.stamp_ns
    # The last of the burst may be among those that nobody has room for.
    bench.wait_until(lambda: stamp_of(feed.answers[-1]) > burst_end_ns, "an answer after the burst",
                     meanwhile=lambda: feed.next(gyro=bias))
    order = [stamp_of(raw) for raw in feed.answers[answers:]]
    assert order == sorted(order) and sum(stamp <= burst_end_ns for stamp in order) <= 4 * QUEUE
    assert float(values(diagnostics.next())["latency_p99_s"]) > -4 * QUEUE / RATE
    stream(feed, 2.0, gyro=noisy(bias, 1e-3))

    assert node.finish(signal.SIGINT) == 0
    np.testing.assert_allclose(read_biases(path).gyro_bias, bias, atol=BIAS_STD)
