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
from inertial.rotation import dcm_from_quaternion, quaternion_from_dcm, quaternion_multiply

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


def align_by_gravity(sums, params):
    """Return the attitude of the sums of :func:`alignment.standing._kernels.run_coarse` (Davenport's q-method)."""
    time = float(sums[kernels.O_TIME])
    profile = sums[kernels.O_PROFILE:kernels.O_SIZE].reshape(3, 3)
    axis = np.array([profile[2, 1] - profile[1, 2], profile[0, 2] - profile[2, 0], profile[1, 0] - profile[0, 1]])
    matrix = np.empty((4, 4))
    matrix[0, 0] = np.trace(profile)
    matrix[0, 1:] = matrix[1:, 0] = axis
    matrix[1:, 1:] = profile + profile.T - np.trace(profile) * np.eye(3)
    start = np.linalg.eigh(matrix)[1][:, -1]
    earth = earth_rate_n(params.latitude) * time
    moved = dcm_from_quaternion(start) @ sums[kernels.O_BODY:kernels.O_TIME].reshape(3, 3)
    angle = np.linalg.norm(earth)
    back = np.concatenate([[math.cos(0.5 * angle)], -math.sin(0.5 * angle) * earth / angle])
    q_nb = quaternion_multiply(back, quaternion_from_dcm(moved))
    return CoarseResult(q_nb, start, coarse_covariance(time, params), time)


def coarse_covariance(time, params, noise_factor=NOISE_FACTOR):
    """Return the covariance (3, 3) of the small rotation in navigation axes after a coarse alignment, rad^2.

    Biases by their priors, noise over the time, sway of the vehicle by the zero-velocity noise.
    """
    gravity, tan_latitude = params.local_gravity, math.tan(params.latitude)
    from_force = np.array([[0, -1, 0], [1, 0, 0], [0, tan_latitude, 0]]) / gravity
    force_var = params.accel_bias_spread ** 2 + params.accel_noise_density ** 2 / time \
        + (params.zero_velocity_std / time) ** 2
    east_rate_var = params.gyro_bias_spread ** 2 + noise_factor * params.gyro_noise_density ** 2 / time \
        + (12 * params.zero_velocity_std / (gravity * time ** 2)) ** 2
    covariance = force_var * from_force @ from_force.T + params.gyro_noise_density ** 2 * time * np.eye(3)
    covariance[2, 2] += east_rate_var / params.north_rate ** 2
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
