"""A recording serialized, written to a bag and read again."""

import numpy as np
import pytest

from inertial.recording import AltitudeSeries, AttitudeSeries, ImuSeries, JointSeries, Recording
from nav_ros.bags import BagWriter, read_recording
from nav_ros.messages import JOINTS, decode_joints
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
