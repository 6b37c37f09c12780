"""A recording as the serialized messages that sensors and a reference would have published."""

import numpy as np

from inertial.atmosphere import pressure_from_altitude
from inertial.rotation import dcm_from_quaternion
from nav_ros.bags import TOPICS, BagMessage
from nav_ros.frames import orientation_from_q_nb, swap_enu_ned, swap_enu_ned_covariance, swap_flu_frd
from nav_ros.messages import (
    ACCEL,
    COVARIANCE_KNOWN,
    DOUBLES,
    FIX,
    GPS_FIX,
    GYRO,
    IMU,
    JOINTS,
    NO_FIX,
    ODOMETRY,
    ORIENTATION,
    ORIENTATION_COVARIANCE,
    POINT,
    POSE_ORIENTATION,
    POSE_POSITION,
    PRESSURE,
    QUATERNION,
    TWIST,
    TWIST_LINEAR,
    VELOCITY,
    VELOCITY_COVARIANCE,
    Fix,
    StampedEncoder,
    encode_fix,
    encode_joints,
)

IMU_FRAME, WORLD_FRAME, MAP_FRAME, RECEIVER_FRAME = "imu_link", "odom", "map", "gps"
TABLE_JOINT = "table_joint"


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
    if recording.fix is not None:
        fix, velocity = recording.fix, recording.velocity
        parts.append((TOPICS["fix"], FIX, fix.stamp_ns, fix.arrival - 0.45, _fix_messages(fix)))
        parts.append((TOPICS["velocity"], TWIST, velocity.stamp_ns, velocity.arrival - 0.4,
                      _velocity_messages(velocity)))
        place = np.searchsorted(imu.stamp_ns, recording.truth.stamp_ns, side="right") - 0.2
        parts.append((TOPICS["true_odometry"], ODOMETRY, recording.truth.stamp_ns, place,
                      _odometry_messages(recording)))
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


def _fix_messages(series):
    known = np.isfinite(series.latitude)
    covariance = tuple(swap_enu_ned_covariance(series.covariance_n).ravel().tolist())
    places = zip(np.degrees(series.latitude).tolist(), np.degrees(series.longitude).tolist(),
                 series.height.tolist(), strict=True)
    return [encode_fix(stamp_ns, RECEIVER_FRAME,
                       Fix(GPS_FIX if there else NO_FIX, *place, covariance, COVARIANCE_KNOWN))
            for stamp_ns, there, place in zip(series.stamp_ns.tolist(), known, places, strict=True)]


def _velocity_messages(series):
    values = np.zeros((len(series), DOUBLES[TWIST]))
    values[:, VELOCITY] = swap_enu_ned(series.velocity_n)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = swap_enu_ned_covariance(series.covariance_n)
    values[:, VELOCITY_COVARIANCE] = covariance.ravel()
    return StampedEncoder(TWIST, MAP_FRAME).encode_batch(series.stamp_ns, values)


def _odometry_messages(recording):
    """The true position, from the first fix, attitude and velocity; without covariances, which are exact."""
    truth = recording.truth
    values = np.zeros((len(truth), DOUBLES[ODOMETRY]))
    values[:, POSE_POSITION] = swap_enu_ned(recording.position_n)
    values[:, POSE_ORIENTATION] = orientation_from_q_nb(truth.q_nb_wxyz)
    velocity_b = np.einsum("kji,kj->ki", dcm_from_quaternion(truth.q_nb_wxyz), recording.velocity_n)
    values[:, TWIST_LINEAR] = swap_flu_frd(velocity_b)
    return StampedEncoder(ODOMETRY, MAP_FRAME, IMU_FRAME).encode_batch(truth.stamp_ns, values)


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
