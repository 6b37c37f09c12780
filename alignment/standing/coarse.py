"""Coarse alignment: the first attitude of a standing vehicle, and how far it may be off.

Two vectors, gravity and the Earth rate, fix an attitude (TRIAD). On a vehicle that sways the gyros see much more
sway than Earth rate; seen from inertial axes, though, gravity goes round with the Earth whatever the vehicle does,
and the rotation that carries the one cone to the other is the attitude sought (optimisation-based alignment).
Both carry the sensors' errors to first order in the same way: with errors df and dw of force and rate in
navigation axes,

``phi = (-dfE / g, dfN / g, tan L dfE / g - dwE / (Omega cos L))``,   ``dcm^ = exp(phi x) dcm``.

Sources: P. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd edition, 5.6;
M. Wu, Y. Wu, X. Hu, D. Hu, Optimization-based alignment for inertial navigation systems, Aerospace Science and
Technology 15, 2011.
"""

import math
from dataclasses import dataclass

import numpy as np

from alignment.standing import _kernels as kernels
from inertial.earth import earth_rate_n
from inertial.rotation import (
    dcm_nb_from_euler,
    quaternion_exp,
    quaternion_from_dcm,
    quaternion_multiply,
    roll_pitch_from_down,
)

# Spread of a heading of which nothing is known, uniform over the circle, rad.
UNKNOWN_HEADING_STD = math.pi / math.sqrt(3)
# The optimisation weighs the seconds otherwise than noise asks for: heading variance over the best possible one,
# for gyro white noise, by a linear calculation and by simulation (test_coarse).
NOISE_FACTOR = 1.3


@dataclass(frozen=True)
class CoarseResult:
    """A first attitude.

    Attributes
    ----------
    q_nb_wxyz : (4,)
        At the end of the window.
    start_q_nb_wxyz : (4,)
        At its start.
    covariance : (3, 3), rad^2
        Of the small rotation in navigation axes; a heading of which nothing is known has pi^2 / 3.
    time : float, s
        Length of the window.
    """

    q_nb_wxyz: np.ndarray
    start_q_nb_wxyz: np.ndarray
    covariance: np.ndarray
    time: float

    @property
    def heading_std(self):
        """Spread of the heading, rad."""
        return math.sqrt(self.covariance[2, 2])


def align_two_vectors(gyro_b, accel_b, time, params):
    """Return the attitude by gravity and the Earth rate (TRIAD).

    Parameters
    ----------
    gyro_b, accel_b : (3,)
        Mean rate and specific force, rad/s and m/s^2.
    time : float, s
        Over which they are means.
    params : StandingParams

    Returns
    -------
    CoarseResult
        For a vehicle that does not move at all: sway comes on top.
    """
    down, earth = -np.asarray(accel_b, dtype=float), np.asarray(gyro_b, dtype=float)
    seen = _triad(down, earth)
    known = _triad(np.array([0.0, 0.0, 1.0]), earth_rate_n(params.latitude))
    q_nb = quaternion_from_dcm(known @ seen.T)
    return CoarseResult(q_nb, q_nb, coarse_covariance(time, params, noise_factor=1.0), time)


def align_by_gravity(sums, params, sway_std=0.0):
    """Return the attitude of the sums of :func:`alignment.standing._kernels.run_coarse` (Davenport's q-method).

    ``sway_std`` is the spread of the vehicle's velocity, m/s, if more than the parameters say is seen.
    """
    time = float(sums[kernels.O_TIME])
    profile = sums[kernels.O_PROFILE:kernels.O_SIZE].reshape(3, 3)
    axis = np.array([profile[2, 1] - profile[1, 2], profile[0, 2] - profile[2, 0], profile[1, 0] - profile[0, 1]])
    matrix = np.empty((4, 4))
    matrix[0, 0] = np.trace(profile)
    matrix[0, 1:] = matrix[1:, 0] = axis
    matrix[1:, 1:] = profile + profile.T - np.trace(profile) * np.eye(3)
    start = np.linalg.eigh(matrix)[1][:, -1]
    body = quaternion_from_dcm(sums[kernels.O_BODY:kernels.O_TIME].reshape(3, 3))
    turned = quaternion_multiply(quaternion_exp(-time * earth_rate_n(params.latitude)), start)
    return CoarseResult(quaternion_multiply(turned, body), start, coarse_covariance(time, params, sway_std), time)


def start_attitude(sums, dcm_nb, params):
    """Return the attitude (4,) at the beginning of the sums from ``dcm_nb`` (3, 3) at their end."""
    body = sums[kernels.O_BODY:kernels.O_TIME].reshape(3, 3)
    turned = quaternion_exp(sums[kernels.O_TIME] * earth_rate_n(params.latitude))
    return quaternion_multiply(turned, quaternion_from_dcm(dcm_nb @ body.T))


def level_by_force(sums, params):
    """Return the level alone, by the mean force, where the latitude is of no use; the heading is zero."""
    time = float(sums[kernels.O_TIME])
    down_b = -sums[kernels.O_BODY:kernels.O_TIME].reshape(3, 3).T @ sums[kernels.O_ALPHA:kernels.O_BETA]
    roll, pitch = roll_pitch_from_down(down_b)
    q_nb = quaternion_from_dcm(dcm_nb_from_euler(roll, pitch, 0.0))
    tilt_var = (params.accel_bias_spread / params.local_gravity) ** 2 + params.gyro_noise_density ** 2 * time
    return CoarseResult(q_nb, q_nb, np.diag([tilt_var, tilt_var, UNKNOWN_HEADING_STD ** 2]), time)


def bias_sensitivity(params):
    """Return how a first attitude is wrong by errors of force and of rate in navigation axes: two (3, 3)."""
    tan_latitude = math.tan(params.latitude)
    force = np.array([[0, -1, 0], [1, 0, 0], [0, tan_latitude, 0]]) / params.local_gravity
    rate = np.zeros((3, 3))
    rate[2, 1] = -1 / params.north_rate
    return force, rate


def coarse_covariance(time, params, sway_std=0.0, noise_factor=NOISE_FACTOR):
    """Return the covariance (3, 3) of the small rotation in navigation axes after a coarse alignment, rad^2.

    Biases by their priors, noise over the time, sway of the vehicle by the zero-velocity noise.
    """
    force, rate = bias_sensitivity(params)
    velocity_std = max(params.zero_velocity_std, sway_std)
    force_var = params.accel_bias_spread ** 2 + params.accel_noise_density ** 2 / time \
        + (velocity_std / time) ** 2
    east_rate_var = params.gyro_bias_spread ** 2 + noise_factor * params.gyro_noise_density ** 2 / time \
        + (12 * velocity_std / (params.local_gravity * time ** 2)) ** 2
    covariance = force_var * force @ force.T + east_rate_var * rate @ rate.T \
        + params.gyro_noise_density ** 2 * time * np.eye(3)
    return limit_heading(covariance)


def limit_heading(covariance):
    """Return a covariance of a small rotation with a heading no worse than unknown."""
    excess = covariance[2, 2] / UNKNOWN_HEADING_STD ** 2
    if excess <= 1:
        return covariance
    scale = np.array([1, 1, 1 / math.sqrt(excess)])
    return covariance * np.outer(scale, scale)


def _triad(first, second):
    first = first / np.linalg.norm(first)
    across = np.cross(first, second)
    across /= np.linalg.norm(across)
    return np.stack([first, across, np.cross(first, across)], axis=1)
