"""An Imu's doubles, filled from estimates: once for the nodes and the offline tools that publish one."""

import numpy as np

from nav_ros.frames import orientation_from_q_nb, swap_enu_ned_covariance
from nav_ros.messages import (
    ACCEL,
    ACCEL_COVARIANCE,
    DOUBLES,
    GYRO,
    GYRO_COVARIANCE,
    IMU,
    ORIENTATION,
    ORIENTATION_COVARIANCE,
)


def imu_values(mounting, estimates, covariance_n):
    """Return the doubles of the Imu messages of N estimates, linear in them, (N, 37).

    Parameters
    ----------
    mounting : nav_ros.frames.Mounting
    estimates : object
        ``q_nb_wxyz`` (N, 4); ``gyro_b``, ``accel_b`` and the variances of their biases, (N, 3), in the IMU's axes, FRD.
    covariance_n : (N, 3, 3), rad^2
        Of the small rotation about north, east and down.
    """
    values = np.zeros((len(covariance_n), DOUBLES[IMU]))
    values[:, ORIENTATION] = orientation_from_q_nb(mounting.attitude(estimates.q_nb_wxyz))
    values[:, ORIENTATION_COVARIANCE] = swap_enu_ned_covariance(covariance_n).reshape(-1, 9)
    values[:, GYRO] = mounting.vector(estimates.gyro_b)
    values[:, GYRO_COVARIANCE] = mounting.covariance(estimates.gyro_bias_variance).reshape(-1, 9)
    values[:, ACCEL] = mounting.vector(estimates.accel_b)
    values[:, ACCEL_COVARIANCE] = mounting.covariance(estimates.accel_bias_variance).reshape(-1, 9)
    return values


def hide_orientation(values, valid):
    """Say in the doubles (..., 37) of Imu messages, in place, that there is no orientation where not `valid` (...)."""
    if not valid.all():
        table, unknown = values.reshape(-1, DOUBLES[IMU]), ~np.atleast_1d(valid)
        table[unknown, ORIENTATION] = [0.0, 0.0, 0.0, 1.0]
        table[unknown, ORIENTATION_COVARIANCE] = [-1.0] + [0.0] * 8
