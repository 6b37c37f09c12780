"""A recording as the serialized messages that sensors and a reference would have published."""

import numpy as np

from inertial.atmosphere import pressure_from_altitude
from nav_ros.bags import TOPICS, BagMessage
from nav_ros.frames import orientation_from_q_nb, swap_flu_frd
from nav_ros.messages import (
    ACCEL,
    GYRO,
    IMU,
    JOINTS,
    ORIENTATION,
    ORIENTATION_COVARIANCE,
    POINT,
    PRESSURE,
    QUATERNION,
    StampedEncoder,
    encode_joints,
)

IMU_FRAME, WORLD_FRAME, TABLE_JOINT = "imu_link", "odom", "table_joint"


def recorded_messages(recording, pressure=False):
    """Serialize a recording.

    Parameters
    ----------
    recording : inertial.recording.Recording
    pressure : bool
        Give the altimeter's samples as air pressure (standard atmosphere, 0 m is at 1013.25 hPa).

    Returns
    -------
    types : dict
        Topic -> message type, the most written first.
    messages : list of nav_ros.bags.BagMessage
        In the order of arrival; receive times never decrease.
    """
    imu = recording.imu
    parts = [(TOPICS["imu"], IMU, imu.stamp_ns, np.arange(len(imu)), _imu_messages(imu))]
    if recording.truth is not None:
        truth = recording.truth
        raws = StampedEncoder(QUATERNION, WORLD_FRAME).encode_batch(
            truth.stamp_ns, orientation_from_q_nb(truth.q_nb_wxyz))
        # After the IMU sample of the same stamp and the altitudes that came before the next one.
        place = np.searchsorted(imu.stamp_ns, truth.stamp_ns, side="right") - 0.25
        parts.append((TOPICS["truth"], QUATERNION, truth.stamp_ns, place, raws))
    if recording.altitude is not None:
        series = recording.altitude
        topic, message_type, raws = _altitude_messages(series, pressure)
        parts.append((topic, message_type, series.stamp_ns, series.arrival - 0.5, raws))
    if recording.joint is not None:
        joint = recording.joint
        place = np.searchsorted(imu.stamp_ns, joint.stamp_ns, side="right") - 0.75
        parts.append((TOPICS["joints"], JOINTS, joint.stamp_ns, place, _joint_messages(joint)))
    topics = np.repeat(np.arange(len(parts)), [len(part[4]) for part in parts])
    order = np.argsort(np.concatenate([part[3] for part in parts]), kind="stable")
    receive_ns = np.maximum.accumulate(np.concatenate([part[2] for part in parts])[order]).tolist()
    raws = [raw for part in parts for raw in part[4]]
    messages = [BagMessage(parts[topics[k]][0], receive, raws[k])
                for k, receive in zip(order.tolist(), receive_ns, strict=True)]
    return {part[0]: part[1] for part in parts}, messages


def _imu_messages(imu):
    values = np.zeros((len(imu), 37))
    values[:, ORIENTATION] = (0.0, 0.0, 0.0, 1.0)
    values[:, ORIENTATION_COVARIANCE.start] = -1.0
    values[:, GYRO] = swap_flu_frd(imu.gyro_b)
    values[:, ACCEL] = swap_flu_frd(imu.accel_b)
    return StampedEncoder(IMU, IMU_FRAME).encode_batch(imu.stamp_ns, values)


def _joint_messages(joint):
    # A ROS joint about z up turns the other way.
    return [encode_joints(stamp_ns, "", {TABLE_JOINT: -angle})
            for stamp_ns, angle in zip(joint.stamp_ns.tolist(), joint.angle.tolist(), strict=True)]


def _altitude_messages(series, pressure):
    values = np.zeros((len(series), 2 if pressure else 3))
    if pressure:
        values[:, 0] = pressure_from_altitude(series.altitude)
        return TOPICS["pressure"], PRESSURE, StampedEncoder(PRESSURE, IMU_FRAME).encode_batch(
            series.stamp_ns, values)
    values[:, 2] = series.altitude
    return TOPICS["altitude"], POINT, StampedEncoder(POINT, WORLD_FRAME).encode_batch(series.stamp_ns, values)
