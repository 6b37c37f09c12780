"""estimate_bag on recordings that are not as they should be: what is refused, what is told, what is written."""

import numpy as np
import pytest

from attitude_estimator import cli
from inertial.rotation import down_from_quaternion
from nav_ros.bags import BagWriter, read_messages
from nav_ros.messages import ACCEL, GYRO, IMU, POINT, PRESSURE, QUATERNION, StampedEncoder

SECONDS, RATE = 4.0, 50
LEVEL = 1e-3
"""Largest component of the down direction across the body, for a sensor that reads exactly +g on z."""


def bag(path, altimeter=POINT, value=0.0, gyro=0.0, gravity=9.80665, imu_topic="/imu/data_raw", stamped=True):
    """Write a recording of an IMU at rest (`gyro` is every third rate) and of an altimeter that does not change."""
    stamps = 10**18 + np.arange(0, SECONDS, 1.0 / RATE) * 1e9
    values = np.zeros((len(stamps), 37))
    values[::3, GYRO.start], values[:, ACCEL.stop - 1] = gyro, gravity
    types = {imu_topic: IMU}
    if altimeter:
        altitude_topic = "/pressure" if altimeter == PRESSURE else "/altitude"
        types[altitude_topic] = altimeter
        fields = {POINT: (0.0, 0.0, value), PRESSURE: (value, 0.0), QUATERNION: (0.0, 0.0, 0.0, 1.0)}[altimeter]
        encoder = StampedEncoder(altimeter, "odom")
    imu = StampedEncoder(IMU, "imu")
    with BagWriter(path, types) as writer:
        for stamp, row in zip(stamps.astype(int).tolist(), values, strict=True):
            writer.write(imu_topic, stamp, imu.encode(stamp if stamped else 0, row))
            if altimeter:
                writer.write(altitude_topic, stamp, encoder.encode(stamp, np.array(fields)))
    return path


def estimate(*arguments):
    """Return the exit status."""
    try:
        return cli.main([str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code


def test_a_recording_at_rest_is_level_and_its_share_of_attitudes_told(tmp_path, capsys):
    assert estimate(bag(tmp_path / "rest"), tmp_path / "out") == 0
    told = capsys.readouterr()
    assert "200 estimates" in told.out and "% with an attitude" in told.out and told.err == ""
    last = [raw for topic, _, raw in read_messages(tmp_path / "out") if topic == "/imu/data"][-1]
    x, y, z, w = np.frombuffer(last[-296:-264])
    assert np.abs(down_from_quaternion(np.array([w, x, -y, -z]))[:2]).max() < LEVEL


@pytest.mark.parametrize("recording, arguments, reason", [
    ({"altimeter": QUATERNION}, [], "/altitude is geometry_msgs/msg/QuaternionStamped, expected geometry"),
    ({}, ["--topic", "altitude:=/baro"], "no topic /baro (geometry_msgs/msg/PointStamped is on /altitude)"),
    ({}, ["--topic", "truth:=/mocap"], "no topic /mocap"),
    ({"imu_topic": "/my/imu"}, [], "no topic /imu/data_raw (sensor_msgs/msg/Imu is on /my/imu)"),
    ({"stamped": False}, [], "no_stamp 200; fixed_dt is the interval")])
def test_what_cannot_be_used_ends_in_one_line_and_leaves_no_bag(tmp_path, capsys, recording, arguments, reason):
    assert estimate(bag(tmp_path / "in", **recording), tmp_path / "out", *arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("estimate_bag: ") and reason in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("recording, reasons", [
    ({"altimeter": None}, ["neither /altitude nor /pressure is there: the IMU alone is used"]),
    ({"altimeter": PRESSURE, "value": 1013.25}, ["200 samples of /pressure refused", "looks like hPa"]),
    ({"gyro": 150.0}, ["rates are beyond gyro_range = 100 rad/s: are they in deg/s?"]),
    ({"gravity": 1.0}, ["no sample has an attitude"])])
def test_what_makes_the_estimate_worse_is_told(tmp_path, capsys, recording, reasons):
    assert estimate(bag(tmp_path / "in", **recording), tmp_path / "out") == 0
    told = capsys.readouterr().err
    assert all(reason in told for reason in reasons), told
    assert all(line.startswith("estimate_bag: warning: ") for line in told.splitlines())


def test_samples_without_a_stamp_take_fixed_dt(tmp_path, capsys):
    assert estimate(bag(tmp_path / "in", stamped=False), tmp_path / "out", "-p", f"fixed_dt:={1 / RATE}") == 0
    assert "200 estimates" in capsys.readouterr().out


def test_a_bias_file_that_is_not_there_is_told(tmp_path, capsys):
    assert estimate(bag(tmp_path / "in"), tmp_path / "out", "-p", f"bias_file:={tmp_path / 'none.yaml'}") == 0
    assert "there is no such file" in capsys.readouterr().err


def test_of_several_bags_a_bad_one_does_not_stop_the_others(tmp_path, capsys):
    bags = [bag(tmp_path / name, imu_topic=topic)
            for name, topic in (("run.1", "/imu/data_raw"), ("run.2", "/imu"), ("run.3", "/imu/data_raw"))]
    assert estimate(*bags, tmp_path / "out") == 2
    assert "run.2: no topic /imu/data_raw" in capsys.readouterr().err
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["run.1", "run.3"]


def test_bags_of_one_name_are_refused_before_anything_is_written(tmp_path, capsys):
    bags = [bag(tmp_path / folder / "run") for folder in "ab"]
    assert estimate(*bags, tmp_path / "out") == 2
    assert "2 bags are named run" in capsys.readouterr().err and not (tmp_path / "out").exists()
