"""Reports, rates and latencies."""

import math

import pytest

from nav_ros.diagnostics import Level, Report, StreamMeter, diagnostic_array

MS = 1_000_000


def test_without_faults_a_report_is_ok():
    report = Report("imu")
    report.value("rate", 200.0)
    assert (report.level, report.message) == (Level.OK, "OK")


def test_the_worst_level_wins_and_comes_first():
    report = Report("imu")
    report.fault(Level.WARN, "late")
    report.fault(Level.ERROR, "gyro dead")
    report.fault(Level.WARN, "odd rate")
    assert (report.level, report.message) == (Level.ERROR, "gyro dead; late; odd rate")
    report.fault(Level.STALE, "no data")
    assert report.level == Level.STALE


def test_values_are_text():
    report = Report("imu")
    report.value("rate", 1 / 3)
    report.value("sigma", math.nan)
    report.value("aligned", True)
    report.counters({"duplicate": 0, "backward": 12})
    assert report.values == {"rate": "0.333333", "sigma": "unknown", "aligned": "true", "duplicate": "0",
                             "backward": "12"}


def test_the_message_holds_it_all():
    pytest.importorskip("diagnostic_msgs", reason="ROS is not installed")
    report = Report("imu", "adis")
    report.fault(Level.ERROR, "gyro dead")
    report.value("rate", 200.0)
    array = diagnostic_array(1_700_000_000_000_000_005, [report, Report("altitude")])
    assert (array.header.stamp.sec, array.header.stamp.nanosec) == (1_700_000_000, 5)
    first, second = array.status
    assert (first.level, first.name, first.hardware_id) == (b"\x02", "imu", "adis")
    assert first.message == "gyro dead"
    assert (first.values[0].key, first.values[0].value) == ("rate", "200")
    assert second.level == b"\x00"


def test_rates_by_stamp_and_by_arrival_differ():
    meter = StreamMeter()
    for k in range(11):
        meter.add(5 * MS * k, 10 * MS * k)
    assert meter.stamp_rate == 200.0 and meter.arrival_rate == 100.0
    assert meter.age(150 * MS) == pytest.approx(0.05)


def test_latencies_are_those_of_the_last_messages():
    meter = StreamMeter(window=100)
    for latency in [500] * 50 + list(range(100)):
        meter.add(0, latency * MS)
    assert meter.latency(0.5) == pytest.approx(0.050)
    assert meter.latency(0.99) == pytest.approx(0.099)
    assert meter.latency(1.0) == pytest.approx(0.099)


def test_before_any_message_all_is_unknown():
    meter = StreamMeter()
    unknown = (meter.stamp_rate, meter.arrival_rate, meter.latency(0.5), meter.age(0))
    assert all(map(math.isnan, unknown))
    meter.add(0, 0)
    meter.add(0, 0)
    assert math.isnan(meter.stamp_rate)
