"""report_bag as a user calls it, and what it reads back."""

import re

import numpy as np
import pytest

from inertial.rotation import down_from_quaternion
from nav_ros import cli, report_cli
from nav_ros.bags import TOPICS, BagWriter
from nav_ros.estimated import read_run
from nav_ros.frames import orientation_from_q_nb
from nav_ros.messages import (
    DOUBLES,
    GYRO_COVARIANCE,
    IMU,
    ODOMETRY,
    ORIENTATION,
    ORIENTATION_COVARIANCE,
    POSE_COVARIANCE,
    POSE_POSITION,
    TWIST_COVARIANCE,
    VECTOR,
    StampedEncoder,
)
from nav_ros.recorded import recorded_messages
from nav_ros.simulated import simulate_scenario

UNKNOWN = 1e6
SIGMA = 0.01  # rad, of north and of east
BIAS_SIGMA = 0.002  # rad/s
SPEED_ERROR = 0.02  # m/s, of differences over a sample in which the speed changes by less
LATE = 50  # samples without an attitude


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Return the recording of a flight and its bag: sensors, the truth, and the truth as an estimate."""
    recording = simulate_scenario("flight_with_gps", duration=12.0, rest=1.0, imu_rate=100.0, altimeter_rate=20.0)
    types, messages = recorded_messages(recording)
    stamps = recording.truth.stamp_ns
    values = np.zeros((len(stamps), DOUBLES[IMU]))
    values[:, ORIENTATION] = orientation_from_q_nb(recording.truth.q_nb_wxyz)
    values[:, ORIENTATION_COVARIANCE] = np.diag([SIGMA**2, SIGMA**2, UNKNOWN]).ravel()
    values[:LATE, ORIENTATION_COVARIANCE.start] = -1.0
    values[:, GYRO_COVARIANCE] = (BIAS_SIGMA**2 * np.eye(3)).ravel()
    state = np.zeros((len(stamps), DOUBLES[ODOMETRY]))
    state[:, POSE_POSITION] = (7.0, 7.0, 30.0)
    state[:, POSE_COVARIANCE] = np.diag([UNKNOWN, UNKNOWN, 0.25, UNKNOWN, UNKNOWN, UNKNOWN]).ravel()
    state[:, TWIST_COVARIANCE] = np.diag([UNKNOWN] * 6).ravel()
    estimates = {"/imu/data": (IMU, values), "/attitude/state": (ODOMETRY, state),
                 "/imu/gyro_bias": (VECTOR, np.full((len(stamps), 3), 0.01)),
                 "/imu/accel_bias": (VECTOR, np.full((len(stamps), 3), 0.02))}
    folder = tmp_path_factory.mktemp("bags") / "a flight & more"
    with BagWriter(folder, types | {topic: kind for topic, (kind, _) in estimates.items()}) as bag:
        for message in messages:
            bag.write(*message)
        for topic, (kind, rows) in estimates.items():
            raws = StampedEncoder(kind, "imu").encode_batch(stamps, rows)
            for stamp_ns, raw in zip(stamps.tolist(), raws, strict=True):
                bag.write(topic, stamp_ns, raw)
    return folder, recording


def test_a_page_shows_what_was_estimated(flight, tmp_path, capsys):
    report_cli.main([str(flight[0]), "--out", str(tmp_path / "page.html")])
    said, page = capsys.readouterr().out, (tmp_path / "page.html").read_text()
    assert str(tmp_path / "page.html") in said and "a flight & more: 12 s" in said
    assert re.search(r"tilt RMS +0\.00 deg", said) and re.search(r"within 3 sigma +100\.0%", said)
    assert re.search(r"rate +100\.0 Hz", said)
    assert re.search(rf"sigma of the tilt +{np.degrees(SIGMA * 2**0.5):.2f} deg", said)
    assert re.search(r"gyro bias at the end +\+0\.573 -0\.573 -0\.573 deg/s +sigma 0\.115 0\.115 0\.115", said)
    assert page.count('src="data:image/png;base64,iVBORw0KGgo') == 4 and "a flight &amp; more" in page
    assert "http" not in page and "0.5 s" in page


def test_what_navigation_publishes_gets_a_track_and_a_bag_without_truth_a_page_too(flight, tmp_path, capsys):
    report_cli.main([str(flight[0]), "--out", str(tmp_path / "page.html"), "--topic", "truth:=/none",
                     "--topic", "odometry:=/ground_truth/odometry"])
    page = (tmp_path / "page.html").read_text()
    assert "RMS" not in capsys.readouterr().out
    assert page.count("<img") == 5 and "Way over ground" in page and "against the truth" not in page


def test_what_is_read_back_is_what_was_true(flight):
    folder, recording = flight
    run = read_run(folder, TOPICS | {"odometry": "/ground_truth/odometry"})
    np.testing.assert_allclose(down_from_quaternion(run.attitude.q_nb_wxyz),
                               down_from_quaternion(recording.truth.q_nb_wxyz), atol=1e-12)
    assert run.attitude.valid.tolist() == [False] * LATE + [True] * (len(run.attitude) - LATE)
    step = np.diff(run.odometry.stamp_ns)[:, None] * 1e-9
    between = 0.5 * (run.odometry.velocity_n[1:] + run.odometry.velocity_n[:-1])
    np.testing.assert_allclose(np.diff(run.odometry.position_n, axis=0) / step, between, atol=SPEED_ERROR)
    assert np.abs(between).max() > 10.0
    assert np.isnan(run.state.position_n[:, :2]).all() and np.isnan(run.state.velocity_n).all()
    assert (run.state.position_n[:, 2] == -30.0).all() and (run.state.position_std[:, 2] == 0.5).all()


def test_a_bag_of_raw_sensors_is_told_what_it_lacks(tmp_path, capsys):
    cli.simulate_bag_main(["turn", str(tmp_path / "raw"), "--duration", "2"])
    with pytest.raises(SystemExit) as end:
        report_cli.main([str(tmp_path / "raw"), "--out", str(tmp_path / "page.html")])
    assert end.value.code == cli.USAGE_ERROR
    assert "no topic /imu/data, which estimate_bag and the nodes make" in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()
