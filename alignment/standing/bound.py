"""How well the heading of a standing vehicle can be known: the floor in closed form, the Cramer-Rao bound.

A gyro sees ``dcm_nb^T w + b + noise``. Towards heading, rate changes by ``Omega cos L`` times the east axis in the
body ``e_b(t)``; with bias prior b and angle random walk A, and the bias eliminated,

``1 / variance = (Omega cos L)^2 / A^2 (T - |int e_b dt|^2 / (T + A^2 / b^2))``.

Standing still ``e_b`` is constant and the floor is ``sqrt(b^2 + A^2 / T) / (Omega cos L)``; a half turn half-way, or
steady rotation, makes the integral vanish and the bias with it.
"""

import math

import numpy as np

from alignment.standing._kernels import FLICKER
from alignment.standing.coarse import UNKNOWN_HEADING_STD
from alignment.standing.filters import VELOCITY_STD, bias_priors, sample_intervals
from inertial.earth import earth_rate_n
from inertial.rotation import dcm_from_quaternion, skew

_TILT_STD = 0.1  # rad, of a tilt of which nothing is known


def heading_floor(east_integral_b, time, params):
    """Return the heading's smallest possible standard deviation by the gyros' noise and biases, rad.

    Parameters
    ----------
    east_integral_b : (3,), s
        Integral of the east axis in body axes.
    time : float, s
    params : StandingParams
    """
    bias_var, noise_var = params.gyro_bias_spread ** 2, params.gyro_noise_density ** 2
    if time <= 0:
        return UNKNOWN_HEADING_STD
    if bias_var == 0:
        lost = 0.0
    else:
        lost = float(np.sum(np.square(east_integral_b))) / (time + noise_var / bias_var)
    return min(math.sqrt(noise_var / max(time - lost, 1e-300)) / params.north_rate, UNKNOWN_HEADING_STD)


def time_to_target(floor, time, params):
    """Return how much longer it takes until the floor is at the target, if all goes on alike, s; inf for never."""
    wanted = (params.target_std * params.north_rate) ** 2
    noise_var = params.gyro_noise_density ** 2
    bias_var = max((floor * params.north_rate) ** 2 - noise_var / time, 0.0)
    return max(noise_var / (wanted - bias_var) - time, 0.0) if wanted > bias_var else math.inf


def heading_bound(stamp_ns, q_nb_wxyz, params):
    """Return the Cramer-Rao bound of the heading's standard deviation along a known attitude, (K,), rad.

    The covariance of attitude, velocity and biases is carried along the truth from nothing but the priors of the
    biases, with a zero velocity at every ``zero_velocity_period``.

    Parameters
    ----------
    stamp_ns : (K,) int64
        A second apart or less.
    q_nb_wxyz : (K, 4)
        True attitude.
    params : StandingParams
    """
    dcm_nb = dcm_from_quaternion(q_nb_wxyz)
    dt = sample_intervals(np.asarray(stamp_ns))
    earth = earth_rate_n(params.latitude)
    constants_gravity = np.array([0.0, 0.0, params.local_gravity])
    P = np.zeros((12, 12))
    P[:3, :3] = np.diag([_TILT_STD, _TILT_STD, UNKNOWN_HEADING_STD]) ** 2
    P[3:6, 3:6] = VELOCITY_STD ** 2 * np.eye(3)
    P[6:, 6:] = bias_priors(params, dcm_nb[0])
    white = np.repeat([params.gyro_noise_density ** 2, params.accel_noise_density ** 2, 0.0, 0.0], 3)
    flicker = FLICKER * np.repeat([0.0, 0.0, params.gyro_bias_instability ** 2, params.accel_bias_instability ** 2], 3)
    H = np.zeros((3, 12))
    H[:, 3:6] = np.eye(3)
    std, elapsed = np.empty(len(dt)), np.clip(np.cumsum(dt), 1.0, params.bias_time)
    for k, (t, dcm) in enumerate(zip(dt, dcm_nb, strict=True)):
        A = np.zeros((12, 12))
        A[:3, :3], A[:3, 6:9] = -skew(earth), -dcm
        A[3:6, :3], A[3:6, 3:6], A[3:6, 9:] = skew(constants_gravity), -2 * skew(earth), -dcm
        F = np.eye(12) + t * A + 0.5 * t * t * A @ A
        P = F @ P @ F.T + t * np.diag(white + flicker / elapsed[k])
        R = params.zero_velocity_std ** 2 * min((params.zero_velocity_period or t) / t, 1.0)
        gain = np.linalg.solve(H @ P @ H.T + R * np.eye(3), H @ P)
        P = P - gain.T @ (H @ P)
        P = 0.5 * (P + P.T)
        std[k] = math.sqrt(P[2, 2])
    return std
