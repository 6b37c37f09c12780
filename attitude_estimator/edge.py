"""What the node and the offline tool share at the ROS edge: parameters, stamps, message contents.

The values of every message are linear in one row of estimates, except the roll, pitch and yaw. They are
written once, for many rows, and become a matrix that serves one row or many.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from attitude_estimator.biases import aged_accel_bias, aged_gyro_bias, start_with_biases
from attitude_estimator.estimator import ACTION_RESET, ACTION_SKIP, ACTION_USE, Estimates
from attitude_estimator.params import AttitudeParams
from inertial.parameters import parameter
from inertial.rotation import (
    dcm_from_quaternion,
    dcm_nb_from_euler,
    euler_from_dcm,
)
from nav_ros.bias_file import StoredBiases
from nav_ros.frames import Mounting, rpy_from_euler, swap_flu_frd
from nav_ros.imu_message import hide_orientation, imu_values
from nav_ros.messages import (
    DOUBLES,
    IMU,
    ODOMETRY,
    POSE_COVARIANCE,
    POSE_ORIENTATION,
    POSE_POSITION,
    TWIST_COVARIANCE,
    TWIST_LINEAR,
    UNKNOWN_VARIANCE,
    VECTOR,
)
from nav_ros.time_gate import StampCode, TimeGateParams

OUTPUT_TYPES = {"imu/data": IMU, "imu/rpy/filtered": VECTOR, "attitude/state": ODOMETRY,
                "imu/gyro_bias": VECTOR, "imu/accel_bias": VECTOR}
"""What the node publishes, and the offline tool writes, for every sample."""


@dataclass(frozen=True)
class AttitudeNodeParams(AttitudeParams, TimeGateParams):
    """Parameters of ``attitude_node`` and ``estimate_bag``: of the estimator, the time gate and the edge."""

    altitude_source: str = parameter(
        "auto", "", "which altimeter to use; auto takes the one that is there",
        choices=("auto", "altitude", "pressure", "none"), runtime=False)
    world_frame: str = parameter("odom", "", "frame_id of attitude/state and parent of the transform",
                                 runtime=False)
    base_frame: str = parameter(
        "", "", "frame of the vehicle, where mounting_rpy turns the IMU's axes; empty: the IMU's frame_id",
        runtime=False)
    mounting_rpy: tuple = parameter(
        (0.0, 0.0, 0.0), "rad", "roll, pitch, yaw (REP-103) of the IMU in the vehicle; ~/level sets it",
        -2 * np.pi, 2 * np.pi)
    auxiliary_rate: float = parameter(
        20.0, "Hz", "highest rate of all output but imu/data; 0: with every sample", 0.0, 1e4)
    publish_tf: bool = parameter(
        False, "", "broadcast world_frame to base_frame; needs tf2_ros", runtime=False)
    use_message_covariance: bool = parameter(
        False, "", "take the noise densities from the messages' covariances, as variance times interval",
        runtime=False)
    bias_file: str = parameter(
        "", "", "file that keeps the biases from one run to the next; empty: none", runtime=False)

    def __post_init__(self):
        super().__post_init__()
        if self.bias_file and self.estimator != "dcm_row":
            raise ValueError(f"bias_file = {self.bias_file!r}: {self.estimator} estimates no biases")

    def auxiliary_slot(self, stamp_ns):
        """Return a number (or one for each stamp) whose every change lets auxiliary output through."""
        return stamp_ns if self.auxiliary_rate == 0.0 else stamp_ns // round(1e9 / self.auxiliary_rate)

    def frames(self, topic, imu_frame):
        """Return the frame_id, and for an Odometry the child_frame_id, of a topic of OUTPUT_TYPES."""
        base = self.base_frame or imu_frame
        if topic == "attitude/state":
            return self.world_frame, f"{base}_stabilized"
        return (base if topic in ("imu/data", "imu/rpy/filtered") else imu_frame,)


def stamp_actions(codes):
    """Return the estimator's action for each :class:`~nav_ros.time_gate.StampCode`."""
    return np.select([codes >= StampCode.DUPLICATE, codes == StampCode.JUMP_BACK],
                     [ACTION_SKIP, ACTION_RESET], ACTION_USE)


class MessageNoise:
    """Noise that the covariances of an IMU's messages give.

    All zero means unknown, as in the definition of the message; -1, a negative or an asymmetric one is no
    covariance.

    Attributes
    ----------
    invalid : bool
        Whether one of the last message's is none.
    """

    def __init__(self):
        self._last = None
        self._variances = (math.nan, math.nan)
        self.invalid = False

    def take(self, gyro_covariance, accel_covariance):
        """Look at the covariances of a message, nine values each; return whether they have changed."""
        covariances = (*gyro_covariance, *accel_covariance)
        if covariances == self._last:
            return False
        self._last = covariances
        self._variances = _variance(covariances[:9]), _variance(covariances[9:])
        self.invalid = None in self._variances
        return True

    def applied(self, params, period):
        """Return the parameters with the densities that these variances mean at an interval of `period` s.

        What is unknown, or would be out of range, keeps its parameter.
        """
        names = "gyro_noise_density", "accel_noise_density"
        for name, variance in zip(names, self._variances, strict=True):
            if params.use_message_covariance and variance and variance > 0.0 and period > 0.0:
                try:
                    params = dataclasses.replace(params, **{name: math.sqrt(variance * period)})
                except ValueError:
                    self.invalid = True
        return params


def _variance(covariance):
    """Return the mean variance of a covariance of nine values, 0 where it is unknown, None where it is none."""
    matrix = np.reshape(covariance, (3, 3))
    if not matrix.any():
        return 0.0
    variances = np.diag(matrix)
    if not (np.isfinite(matrix).all() and (variances >= 0.0).all() and variances.any()):
        return None
    return float(variances.mean()) if np.abs(matrix - matrix.T).max() <= 1e-6 * variances.max() else None


def biases_to_store(estimate):
    """Return the :class:`~nav_ros.bias_file.StoredBiases` of an estimate."""
    vectors = (swap_flu_frd(estimate.gyro_bias_b), np.sqrt(estimate.gyro_bias_variance),
               swap_flu_frd(estimate.accel_bias_b), np.sqrt(estimate.accel_bias_variance))
    return StoredBiases(int(estimate.stamp_ns), *(tuple(vector.tolist()) for vector in vectors))


def start_with_stored(estimator, stored, stamp_ns):
    """Start an estimator anew with biases stored some time before (a bag's replay: or after) a stamp, in ns."""
    age, params = abs(stamp_ns - stored.stamp_ns) * 1e-9, estimator.params
    start_with_biases(
        estimator,
        *aged_gyro_bias(swap_flu_frd(stored.gyro_bias), stored.gyro_bias_std, age, params),
        *aged_accel_bias(swap_flu_frd(stored.accel_bias), stored.accel_bias_std, age, params))


class OutputMessages:
    """Contents of the messages that are made of an estimate.

    Parameters
    ----------
    mounting_rpy : (3,), rad
        Of the IMU in the vehicle, FLU.
    """

    def __init__(self, mounting_rpy):
        self.mounting = Mounting(mounting_rpy)
        basis = Estimates(None, np.eye(Estimates.ROW_SIZE))
        self._matrix = {"imu/data": self._imu(basis), "attitude/state": self._state(basis),
                        "imu/gyro_bias": swap_flu_frd(basis.gyro_bias_b),
                        "imu/accel_bias": swap_flu_frd(basis.accel_bias_b)}
        self._state_offset = self._unknown()

    def values(self, topic, estimates):
        """Return the doubles of the message on a topic of :data:`OUTPUT_TYPES`, (..., D)."""
        if topic == "imu/rpy/filtered":
            return self.rpy(estimates)
        values = estimates.rows @ self._matrix[topic]
        if topic == "attitude/state":
            values += self._state_offset
        elif topic == "imu/data":
            hide_orientation(values, estimates.valid)
        return values

    def rpy(self, estimates):
        """Return roll, pitch, yaw of the vehicle, FLU in ENU, (..., 3), rad."""
        q_nb = self.mounting.attitude(estimates.q_nb_wxyz)
        return rpy_from_euler(*euler_from_dcm(dcm_from_quaternion(q_nb)))

    def level(self, estimate):
        """Return the mounting_rpy that makes the vehicle level now and keeps its yaw."""
        q_nb = self.mounting.attitude(estimate.q_nb_wxyz)
        _, _, heading = euler_from_dcm(dcm_from_quaternion(q_nb))
        level_nb = dcm_nb_from_euler(0.0, 0.0, heading)
        roll, pitch, yaw = euler_from_dcm(level_nb.T @ dcm_from_quaternion(estimate.q_nb_wxyz))
        return float(roll), float(-pitch), float(-yaw)

    def _imu(self, estimates):
        covariance = np.zeros((len(estimates), 3, 3))
        covariance[:, :2, :2] = estimates.tilt_covariance_n
        covariance[:, 2, 2] = estimates.yaw_variance
        return imu_values(self.mounting, estimates, covariance)

    def _state(self, estimates):
        """Altitude and vertical velocity, linear in the row; what is constant is in `_unknown`."""
        values = np.zeros((len(estimates), DOUBLES[ODOMETRY]))
        values[:, POSE_POSITION.start + 2] = estimates.altitude
        values[:, POSE_COVARIANCE.start + 14] = estimates.altitude_variance
        values[:, TWIST_LINEAR.start + 2] = -estimates.vd
        values[:, TWIST_COVARIANCE.start + 14] = estimates.vd_variance
        return values

    @staticmethod
    def _unknown():
        values = np.zeros(DOUBLES[ODOMETRY])
        values[POSE_ORIENTATION.start + 3] = 1.0
        for covariance in (POSE_COVARIANCE, TWIST_COVARIANCE):
            for axis in (0, 1, 3, 4, 5):
                values[covariance.start + 7 * axis] = UNKNOWN_VARIANCE
        return values
