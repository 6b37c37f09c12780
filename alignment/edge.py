"""What ``alignment_node`` and ``align_bag`` share at the ROS edge: parameters and message contents.

On a table attitude and heading are those of the table at joint zero; of a standing vehicle those of the IMU.
"""

import math
from dataclasses import dataclass

import numpy as np

from alignment.params import METHODS, AlignmentParams
from alignment.standing.params import STANDING_METHODS, StandingParams
from inertial.parameters import parameter
from inertial.rotation import dcm_nb_from_euler, quaternion_from_dcm
from nav_ros.frames import orientation_from_q_nb, rpy_from_euler, swap_enu_ned_covariance, swap_flu_frd
from nav_ros.messages import (
    ACCEL,
    ACCEL_COVARIANCE,
    DOUBLES,
    GYRO,
    GYRO_COVARIANCE,
    IMU,
    ORIENTATION,
    ORIENTATION_COVARIANCE,
    RefusedMessageError,
    decode,
    decode_joints,
)


@dataclass(frozen=True)
class AlignmentNodeParams(StandingParams, AlignmentParams):
    """Parameters of ``alignment_node`` and ``align_bag``: of both kinds of alignment and of the edge."""

    method: str = parameter(
        "joint", "", "How the heading is found; from oba_riekf on in a standing vehicle.",
        choices=METHODS + STANDING_METHODS)
    joint_name: str = parameter("", "", "Joint of the table in joint_states; empty: the only one there",
                                runtime=False)
    base_frame: str = parameter("base_link", "", "Frame of the table at joint zero, or of the IMU",
                                runtime=False)
    world_frame: str = parameter("map", "", "frame_id of alignment/heading: east, north, up", runtime=False)
    output_rate: float = parameter(10.0, "Hz", "Rate of the output, by the stamps of the IMU", 0.1, 1000.0,
                                   runtime=False)


class JointError(RefusedMessageError):
    """Raised when a message does not have the table's joint, with what to do."""

    def __init__(self, reason):
        super().__init__("joint_missing", reason)


def imu_sample(raw):
    """Return stamp_ns, gyro_b (3,) rad/s and accel_b (3,) m/s^2 of a serialized sensor_msgs/Imu.

    Raises
    ------
    nav_ros.messages.MalformedMessageError
    """
    stamp_ns, _, values = decode(IMU, raw)
    return stamp_ns, swap_flu_frd(values[GYRO]), swap_flu_frd(values[ACCEL])


def joint_sample(raw, joint_name):
    """Return stamp_ns and the table angle, rad, of a serialized sensor_msgs/JointState.

    Parameters
    ----------
    raw : bytes
    joint_name : str
        Empty: the only joint there.

    Raises
    ------
    nav_ros.messages.MalformedMessageError
    JointError
    """
    stamp_ns, positions = decode_joints(raw)
    if not joint_name and len(positions) == 1:
        (position,) = positions.values()
    elif joint_name in positions:
        position = positions[joint_name]
    else:
        there = ", ".join(positions) or "none with a position"
        what = f"no joint {joint_name}" if joint_name else "not just one joint: set joint_name"
        raise JointError(f"{what}; joints there: {there}")
    if not math.isfinite(position):
        raise JointError(f"position of the joint is {position}")
    return stamp_ns, -position


def level_values(solution):
    """Return roll, pitch (REP-103: nose down is positive) and 0: the doubles of a Vector3Stamped."""
    roll, pitch, _ = rpy_from_euler(solution.roll, solution.pitch, 0.0)
    return np.array([roll, pitch, 0.0])


def attitude_values(solution):
    """Return the doubles of a sensor_msgs/Imu with the orientation and its covariance.

    The covariance is that of a small rotation about east, north and up. Where no heading may be believed
    there is no orientation: the first covariance is -1.

    Parameters
    ----------
    solution : alignment.views.Solution or None
    """
    values = np.zeros(DOUBLES[IMU])
    values[[GYRO_COVARIANCE.start, ACCEL_COVARIANCE.start]] = -1.0
    values[ORIENTATION] = [0.0, 0.0, 0.0, 1.0]
    values[ORIENTATION_COVARIANCE.start] = -1.0
    if solution is not None and solution.believable:
        dcm_nb = dcm_nb_from_euler(solution.roll, solution.pitch, solution.heading)
        values[ORIENTATION] = orientation_from_q_nb(quaternion_from_dcm(dcm_nb))
        values[ORIENTATION_COVARIANCE] = swap_enu_ned_covariance(solution.covariance_n).ravel()
    return values


def yaw_of(solution):
    """Return the yaw in ENU, rad, counter-clockwise from east."""
    return float(rpy_from_euler(0.0, 0.0, solution.heading)[2])
