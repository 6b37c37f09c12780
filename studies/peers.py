"""The peers, run at their defaults: attitude filters for an IMU alone, by their authors' own packages.

Each takes FLU rates (rad/s) and forces (m/s^2) at a steady rate and gives the down direction in FRD body axes
after each sample. A peer whose package is not installed is left out.
"""

import importlib.util

import numpy as np

from inertial.earth import STANDARD_GRAVITY
from inertial.rotation import down_from_quaternion

FLIP = np.array([1.0, -1.0, -1.0])


def down_of_world_up(q_wxyz):
    """Down direction in FRD of quaternions that take body FLU to a world with z up."""
    return -down_from_quaternion(q_wxyz) * FLIP


def vqf(gyro, accel, dt):
    """VQF (D. Laidig, T. Seel), 6D quaternion."""
    from vqf import VQF
    return down_of_world_up(VQF(dt).updateBatch(gyro, accel)["quat6D"])


def imufusion(gyro, accel, dt):
    """Fusion (S. Madgwick), without magnetometer."""
    from imufusion import Ahrs
    ahrs = Ahrs()
    ahrs.set_sample_period(dt)
    quaternions = np.empty((len(gyro), 4))
    for k, (rate, force) in enumerate(zip(np.degrees(gyro), accel / STANDARD_GRAVITY, strict=True)):
        ahrs.update_no_magnetometer(rate, force)
        quaternions[k] = ahrs.get_quaternion()
    return down_of_world_up(quaternions)


def madgwick(gyro, accel, dt):
    """Madgwick's gradient filter, of the ahrs package."""
    from ahrs.filters import Madgwick
    return down_of_world_up(Madgwick(gyr=gyro, acc=accel, frequency=1.0 / dt).Q)


def mahony(gyro, accel, dt):
    """Mahony's complementary filter, of the ahrs package."""
    from ahrs.filters import Mahony
    return down_of_world_up(Mahony(gyr=gyro, acc=accel, frequency=1.0 / dt).Q)


def ahrs_ekf(gyro, accel, dt):
    """The extended Kalman filter of the ahrs package."""
    from ahrs.filters import EKF
    return down_of_world_up(EKF(gyr=gyro, acc=accel, frequency=1.0 / dt).Q)


_MODULE = {vqf: "vqf", imufusion: "imufusion", madgwick: "ahrs", mahony: "ahrs", ahrs_ekf: "ahrs"}


def installed_peers():
    """Return name -> function of the peers whose packages are there."""
    return {peer.__name__: peer for peer, module in _MODULE.items() if importlib.util.find_spec(module)}


def run_peer(peer, imu):
    """Return the down directions (N, 3), FRD, that a peer gives for an ImuSeries."""
    dt = float(np.median(np.diff(imu.stamp_ns))) * 1e-9
    return peer(np.ascontiguousarray(imu.gyro_b * FLIP), np.ascontiguousarray(imu.accel_b * FLIP), dt)
