"""A recording serialized, written to a bag and read again."""

import numpy as np
import pytest

from inertial.flight_scenarios import simulate_flight
from inertial.recording import AltitudeSeries, AttitudeSeries, ImuSeries, JointSeries, Recording
from nav_ros.bags import BagWriter, read_recording
from nav_ros.messages import (
    JOINTS,
    NO_FIX,
    POSE_POSITION,
    TWIST,
    TWIST_LINEAR,
    VELOCITY,
    VELOCITY_COVARIANCE,
    decode,
    decode_fix,
    decode_joints,
)
from nav_ros.recorded import recorded_messages

T0 = 1_700_000_000_000_000_000
ROUNDING = 1e-15
PRESSURE_ROUNDING = 1e-6
"""Metres."""


def recording(n=100):
    rng = np.random.default_rng(1)
    stamps = T0 + 5_000_000 * np.arange(n)
    q = rng.normal(size=(n, 4))
    # Altitudes 30 ms late: they are stamped earlier than the IMU samples they arrive after.
    late = np.arange(10, n, 10)
    return Recording("run", ImuSeries(stamps, rng.normal(size=(n, 3)), rng.normal(size=(n, 3))),
                     AltitudeSeries(stamps[late] - 30_000_000, rng.normal(size=len(late)), late),
                     AttitudeSeries(stamps, q / np.linalg.norm(q, axis=1, keepdims=True)))


@pytest.mark.parametrize("pressure", [False, True])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_recording_survives_the_bag(tmp_path, storage, pressure):
    original = recording()
    types, messages = recorded_messages(original, pressure)
    assert next(iter(types)) == "/imu/data_raw"
    with BagWriter(tmp_path / "run", types, storage) as writer:
        for message in messages:
            writer.write(*message)
    copy = read_recording(tmp_path / "run")
    np.testing.assert_array_equal(copy.imu.stamp_ns, original.imu.stamp_ns)
    np.testing.assert_array_equal(copy.imu.gyro_b, original.imu.gyro_b)
    np.testing.assert_array_equal(copy.imu.accel_b, original.imu.accel_b)
    np.testing.assert_array_equal(copy.altitude.stamp_ns, original.altitude.stamp_ns)
    np.testing.assert_array_equal(copy.altitude.arrival, original.altitude.arrival)
    shift = original.altitude.altitude[0] if pressure else 0.0
    tolerance = PRESSURE_ROUNDING if pressure else 0.0
    np.testing.assert_allclose(copy.altitude.altitude, original.altitude.altitude - shift, rtol=0,
                               atol=tolerance)
    np.testing.assert_allclose(copy.truth.q_nb_wxyz, original.truth.q_nb_wxyz, atol=ROUNDING)


def test_receive_times_never_decrease():
    _, messages = recorded_messages(recording())
    receive = [message.receive_ns for message in messages]
    assert receive == sorted(receive)


def test_a_recording_of_the_imu_alone_has_one_topic():
    types, messages = recorded_messages(Recording("run", recording().imu))
    assert list(types) == ["/imu/data_raw"] and len(messages) == 100


def test_a_table_angle_is_written_as_a_joint_that_turns_the_other_way():
    stamps = T0 + 50_000_000 * np.arange(3)
    table = Recording("run", recording().imu, joint=JointSeries(stamps, np.array([0.0, 0.5, 1.0])))
    types, messages = recorded_messages(table)
    assert types["/joint_states"] == JOINTS
    found = [decode_joints(message.raw) for message in messages if message.topic == "/joint_states"]
    assert found == [(stamp, {"table_joint": -angle})
                     for stamp, angle in zip(stamps.tolist(), (0.0, 0.5, 1.0), strict=True)]


def test_fixes_velocities_and_the_true_odometry_are_written_in_enu_and_in_the_order_of_arrival():
    flight = simulate_flight("flight_with_gps", duration=40.0, imu_rate=20.0)
    types, messages = recorded_messages(flight)
    raws = {topic: [message.raw for message in messages if message.topic == topic] for topic in types}
    fixes = [decode_fix(raw) for raw in raws["/fix"]]
    assert [stamp_ns for stamp_ns, _ in fixes] == flight.fix.stamp_ns.tolist()
    for k, (_, fix) in enumerate(fixes):
        assert (fix.status == NO_FIX) == np.isnan(flight.fix.latitude[k])
        assert fix.covariance[::4] == tuple(np.diagonal(flight.fix.covariance_n)[[1, 0, 2]])
        np.testing.assert_allclose(np.radians([fix.latitude_deg, fix.longitude_deg]),
                                   [flight.fix.latitude[k], flight.fix.longitude[k]], rtol=ROUNDING)
    _, _, values = decode(TWIST, raws["/velocity"][20])
    north, east, down = flight.velocity.velocity_n[20]
    assert values[VELOCITY] == (east, north, -down)
    variances = np.reshape(values[VELOCITY_COVARIANCE], (6, 6)).diagonal()
    assert variances[:3].tolist() == np.diagonal(flight.velocity.covariance_n)[[1, 0, 2]].tolist()
    values = np.frombuffer(raws["/ground_truth/odometry"][-1][-85 * 8:])
    np.testing.assert_array_equal(values[POSE_POSITION], flight.position_n[-1, [1, 0, 2]] * [1, 1, -1])
    assert np.hypot(*values[TWIST_LINEAR][1:]) < 0.05 * values[TWIST_LINEAR][0], "an aircraft flies ahead"

    imu = 0
    for message in messages:
        imu += message.topic == "/imu/data_raw"
        if message.topic == "/fix":
            stamp_ns, _ = decode_fix(message.raw)
            assert imu == flight.fix.arrival[flight.fix.stamp_ns.tolist().index(stamp_ns)]
