"""What ``alignment_node`` and ``align_bag`` share at the ROS edge: parameters, joints, message contents.

A ROS joint about z (up) is counter-clockwise, a table angle clockwise: ``tau = -joint``. The attitude and the
heading are those of the table at joint zero.
"""

import math
from dataclasses import dataclass

import numpy as np

from alignment.azimuth import METHODS
from alignment.params import AlignmentParams
from inertial.parameters import parameter
from inertial.rotation import dcm_nb_from_euler, quaternion_from_dcm
from nav_ros.frames import orientation_from_q_nb, rpy_from_euler, swap_enu_ned_covariance
from nav_ros.messages import (
    ACCEL_COVARIANCE,
    DOUBLES,
    GYRO_COVARIANCE,
    IMU,
    ORIENTATION,
    ORIENTATION_COVARIANCE,
)

UNKNOWN_VARIANCE = 1e6
"""Variance of what is not estimated, in the unit of its entry."""


@dataclass(frozen=True)
class AlignmentNodeParams(AlignmentParams):
    """Parameters of ``alignment_node`` and ``align_bag``: of the alignment and of the edge."""

    joint_name: str = parameter("", "", "Joint of the table in joint_states; empty: the only one there",
                                runtime=False)
    base_frame: str = parameter("base_link", "", "Frame of the table at joint zero", runtime=False)
    world_frame: str = parameter("map", "", "frame_id of alignment/heading: east, north, up", runtime=False)
    output_rate: float = parameter(10.0, "Hz", "Rate of the output, by the stamps of the IMU", 0.1, 1000.0,
                                   runtime=False)

    def __post_init__(self):
        super().__post_init__()
        lacking = {"any", "maximum"} & set(METHODS[self.method].positions if self.method in METHODS else ())
        if lacking:
            what = "a gyro without bias" if "any" in lacking else "the largest rate over a turn"
            raise ValueError(f"method = {self.method!r}: needs {what}, which dwells do not give; choose "
                             "joint, azimuth_1a, azimuth_1b, azimuth_4, azimuth_5 or azimuth_6")


class JointError(ValueError):
    """Raised when a message does not have the table's joint, with what to do."""


def table_angle(positions, joint_name):
    """Return the table angle of a JointState, rad.

    Parameters
    ----------
    positions : dict
        Joint name -> position, rad.
    joint_name : str
        Empty: the only joint there.

    Raises
    ------
    JointError
    """
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
    return -position


def joint_position(angle):
    """Return the joint's position of a table angle, rad."""
    return 0.0 - angle  # no negative zero


def level_values(level):
    """Return roll, pitch (REP-103: nose down is positive) and 0: the doubles of a Vector3Stamped."""
    roll, pitch, _ = rpy_from_euler(float(level.roll), float(level.pitch), 0.0)
    return np.array([roll, pitch, 0.0])


def attitude_values(result, believable):
    """Return the doubles of a sensor_msgs/Imu with the table's orientation and its covariance.

    The covariance is that of a small rotation about east, north and up; level and heading count as
    independent.

    Parameters
    ----------
    result : alignment.station.AlignmentResult
    believable : bool
        Without it there is no orientation: the first covariance is -1.
    """
    values = np.zeros(DOUBLES[IMU])
    values[[GYRO_COVARIANCE.start, ACCEL_COVARIANCE.start]] = -1.0
    values[ORIENTATION] = [0.0, 0.0, 0.0, 1.0]
    values[ORIENTATION_COVARIANCE.start] = -1.0
    if believable:
        level, north = result.level, result.north
        roll, pitch, heading = float(level.roll), float(level.pitch), float(north.heading)
        q_nb_wxyz = quaternion_from_dcm(dcm_nb_from_euler(roll, pitch, heading))
        values[ORIENTATION] = orientation_from_q_nb(q_nb_wxyz)
        covariance = np.zeros((3, 3))
        covariance[:2, :2], covariance[2, 2] = level.covariance, north.variance
        turns_n = _rotation_of_angles(pitch, heading)
        values[ORIENTATION_COVARIANCE] = swap_enu_ned_covariance(turns_n @ covariance @ turns_n.T).ravel()
    return values


def yaw_of(result):
    """Return the yaw in ENU, rad, counter-clockwise from east, of a result's heading."""
    return float(rpy_from_euler(0.0, 0.0, float(result.north.heading))[2])


def _rotation_of_angles(pitch, heading):
    """Return the matrix that takes changes of roll, pitch and heading to a small rotation in NED."""
    sp, cp, sh, ch = math.sin(pitch), math.cos(pitch), math.sin(heading), math.cos(heading)
    return np.array([[cp * ch, -sh, 0.0], [cp * sh, ch, 0.0], [-sp, 0.0, 1.0]])


def status_values(session):
    """Return key -> value of what a session knows, as ``alignment/status`` and ``align_bag`` tell it.

    Parameters
    ----------
    session : alignment.session.TableSession
    """
    params, result = session.params, session.result
    values = {"phase": session.phase, "method": params.method, "levelling": params.levelling,
              "sequence": params.sequence, "dwells": len(session.dwells),
              "dwells_rejected": len(session.rejected)}
    if result is None:
        return values
    level, north = result.level, result.north
    roll_std, pitch_std = np.sqrt(np.diag(level.covariance))
    values |= {"roll_deg": math.degrees(level.roll), "roll_sigma_deg": math.degrees(roll_std),
               "pitch_deg": math.degrees(level.pitch), "pitch_sigma_deg": math.degrees(pitch_std),
               "accel_scale": float(level.scale), "accel_bias": float(level.bias)}
    if north is None:
        return values
    flags = north.flags | level.flags
    return values | {
        "heading_deg": math.degrees(north.heading) % 360.0, "heading_sigma_deg": math.degrees(north.std),
        "heading_floor_deg": math.degrees(result.floor), "target_sigma_deg": math.degrees(params.target_std),
        "time_to_target_s": float(result.time_left), "gyro_bias_deg_h": math.degrees(north.bias) * 3600.0,
        "gyro_scale": float(north.scale), "chi2": float(north.chi2), "believable": not session.refusal,
        "flags": ", ".join(flag.name for flag in type(flags) if flag in flags) or "none"}
