"""What attitude_node says and does when its input is wrong: the rows of bad input, on a real process."""

import math
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from geometry_msgs.msg import PointStamped  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from rclpy.serialization import deserialize_message  # noqa: E402
from sensor_msgs.msg import FluidPressure, Imu  # noqa: E402

from nav_ros.messages import POINT, PRESSURE, StampedEncoder  # noqa: E402

REPORT_PERIOD = 1.0  # s
REPORT_SLACK = 0.5
"""Seconds that a busy machine may shift a report."""
SILENCE_TOLD = 2.0
"""Seconds within which a stop of the IMU is in a report: one, and one for a busy machine."""
RATE = 200
RATE_SHARE = 1e-3
WARN, ERROR, STALE = b"\x01", b"\x02", b"\x03"
NOT_FAULTS = {"imu_rate_hz", "imu_arrival_rate_hz", "latency_p50_s", "latency_p99_s", "altitude_rate_hz",
              "use_altitude", "state", "tilt_sigma_deg", "imu_messages", "altitude_messages",
              "pressure_messages"}


def values(report):
    return {entry.key: entry.value for entry in report.values}


def faults(report):
    """Return the counters that are not zero."""
    return {key: int(value) for key, value in values(report).items()
            if key not in NOT_FAULTS and value != "0"}


def settled(diagnostics, feed):
    """Return the first report that knows of the last sample."""
    feed.go_on(0.05)
    return diagnostics.next()


def test_every_fault_of_the_imu_is_counted_and_survived(bench):
    node = bench.start_ready()
    peer = bench.peer()
    diagnostics = bench.diagnostics(peer)
    bench.wait_until(lambda: len(diagnostics.reports) > 2, "three reports")
    times = [stamp for stamp, _ in diagnostics.reports]
    assert np.diff(times) == pytest.approx(REPORT_PERIOD, abs=REPORT_SLACK)
    report = diagnostics.reports[-1][1]
    assert report.level == STALE and "no usable imu/data_raw yet" in report.message

    feed = bench.feed(peer, rate=RATE, reliability=ReliabilityPolicy.BEST_EFFORT)
    feed.start(4.0)
    report = settled(diagnostics, feed)
    assert faults(report) == {}
    assert float(values(report)["imu_rate_hz"]) == pytest.approx(RATE, rel=RATE_SHARE)
    assert values(report)["state"] == "attitude known"
    assert "no altitude yet" in report.message

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
    stopped = time.time()
    seen = len(feed.answers)
    report = diagnostics.told("imu/data_raw stopped")
    assert report.level == ERROR
    told = next(stamp for stamp, status in diagnostics.reports if "imu/data_raw stopped" in status.message)
    assert told - stopped < SILENCE_TOLD
    assert len(feed.answers) == seen
    feed.start(3.0)
    seen = len(diagnostics.reports)

    def recovered():
        feed.go_on(0.02)
        return [status for _, status in diagnostics.reports[seen:] if "stopped" not in status.message]

    report = bench.wait_until(recovered, "a recovery")[0]
    assert report.level in (b"\x00", WARN)
    assert feed.answers[-1][4:12] == feed.message(feed.stamp_ns)[4:12]
    feed.start(1.0, end_ns=feed.stamp_ns + 60 * 10**9)
    assert "ahead of the node's clock" in settled(diagnostics, feed).message


def test_an_altitude_that_is_missing_wrong_or_stops(bench):
    bench.start_ready()
    peer = bench.peer()
    diagnostics = bench.diagnostics(peer)
    feed, altitude = bench.feed(peer), peer.publisher(PointStamped, "altitude")
    bench.wait_until(lambda: altitude.get_subscription_count() == 1, "the altimeter's match")
    point = StampedEncoder(POINT, "odom")

    def climb(seconds, height=10.0):
        for _ in range(round(20 * seconds)):
            altitude.publish(point.encode(feed.stamp_ns, np.array([0.0, 0.0, height])))
            feed.go_on(0.05)

    feed.start(0.5)
    assert "no altitude yet" in settled(diagnostics, feed).message
    feed.start(0.05)
    climb(2.0)
    report = settled(diagnostics, feed)
    assert "altitude" not in report.message
    assert float(values(report)["altitude_rate_hz"]) == pytest.approx(20.0, rel=RATE_SHARE)
    before = faults(report)

    climb(0.1, math.nan)
    altitude.publish(point.encode(feed.stamp_ns, np.zeros(3))[:-8])
    altitude.publish(point.encode(0, np.zeros(3)))
    report = settled(diagnostics, feed)
    assert faults(report) == before | {"altitude_not_finite": 2, "malformed": 1, "altitude_no_stamp": 1}
    seen = diagnostics.told("altitude stopped")
    assert "the IMU alone" in seen.message
    climb(0.5)
    assert "altitude stopped" not in diagnostics.next().message


def test_pressure_its_unit_and_two_altimeters(bench):
    auto = bench.start_ready()
    chosen = bench.start_ready("-r", "__node:=chosen", "-p", "altitude_source:=pressure")
    peer = bench.peer()
    of_auto, of_chosen = bench.diagnostics(peer), bench.diagnostics(peer, "chosen")
    feed, barometer = bench.feed(peer), peer.publisher(FluidPressure, "pressure")
    for publisher in (barometer, feed.publisher):
        bench.wait_until(lambda publisher=publisher: publisher.get_subscription_count() == 2, "both nodes")
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
