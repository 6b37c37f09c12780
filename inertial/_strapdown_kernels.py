"""Compiled strapdown navigation: one major step, and a whole run of them.

What they compute is told in :mod:`inertial.strapdown`. Vectors are tuples of floats, which cost nothing;
arrays hold what lasts from step to step:

``core`` (18,)
    quaternion body to navigation (4), velocity (3), b_ij by rows (9), height, correction of the vertical
    acceleration.
``window`` (K, 6)
    Increments of angle and velocity, oldest first: the previous ones that the scheme uses, then the new.
``history`` (3, 6)
    Whether there is one (first element), and the two samples before the present one.
"""

import math

import numpy as np
from numba import njit

from inertial._kernels import zoh_coefficients
from inertial.earth import (
    _ECCENTRICITY2,
    _EQUATOR_GRAVITY,
    _RATE_RATIO,
    _SOMIGLIANA,
    EARTH_RATE,
    FLATTENING,
    SEMI_MAJOR_AXIS,
)

Q, V, B, HEIGHT, CORRECTION = 0, 4, 7, 16, 17
CORE_SIZE = 18


@njit(cache=True)
def _sum(a, b, factor):
    """Return a + factor b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@njit(cache=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def _norm(a):
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@njit(cache=True)
def _load(array, start):
    return array[start], array[start + 1], array[start + 2]


@njit(cache=True)
def _store(array, start, a):
    array[start], array[start + 1], array[start + 2] = a


@njit(cache=True)
def _copy(source, target):
    # A loop: numba takes seconds to compile an assignment of slices.
    for i in range(len(source)):
        target[i] = source[i]


@njit(cache=True)
def _multiply(p, q):
    """Return the Hamilton product of quaternions, scalar first."""
    return (p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
            p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
            p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
            p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0])


@njit(cache=True)
def _exp(a, sign):
    """Return the quaternion of the rotation vector ``sign * a``."""
    half = 0.5 * _norm(a)
    s = 0.5 * sign * zoh_coefficients(half)[0]
    return math.cos(half), s * a[0], s * a[1], s * a[2]


@njit(cache=True)
def _rotate(q, a):
    """Return the vector ``a`` turned by the quaternion."""
    v = (q[1], q[2], q[3])
    twice = _cross(v, a)
    return _sum(_sum(a, twice, 2.0 * q[0]), _cross(v, twice), 2.0)


@njit(cache=True)
def combine(window, k, new):
    """Return the rotation vector and the velocity vector of a major interval.

    ``phi = sum alpha_i + (sum k_i alpha_i) x alpha_last``, and the same with one alpha of each product in turn
    replaced by the velocity increment: coning and sculling are one correction.

    Parameters
    ----------
    window : (K, 6) float64
    k : (K - 1,) float64
    new : int
        How many increments, the last ones, make the interval.

    Returns
    -------
    phi, eta : tuple of 3 float; rad, m/s
    """
    last = len(k)
    alpha = nu = k_alpha = k_nu = (0.0, 0.0, 0.0)
    for i in range(last):
        alpha_i, nu_i = _load(window[i], 0), _load(window[i], 3)
        k_alpha, k_nu = _sum(k_alpha, alpha_i, k[i]), _sum(k_nu, nu_i, k[i])
        if i > last - new:
            alpha, nu = _sum(alpha, alpha_i, 1.0), _sum(nu, nu_i, 1.0)
    alpha_last, nu_last = _load(window[last], 0), _load(window[last], 3)
    alpha, nu = _sum(alpha, alpha_last, 1.0), _sum(nu, nu_last, 1.0)
    phi = _sum(alpha, _cross(k_alpha, alpha_last), 1.0)
    eta = _sum(_sum(nu, _cross(k_alpha, nu_last), 1.0), _cross(k_nu, alpha_last), 1.0)
    return phi, eta


@njit(cache=True)
def velocity_increment(phi, eta):
    """Return the integral of the specific force in the axes at the start of the interval, m/s."""
    _, second, third, _ = zoh_coefficients(_norm(phi))
    once = _cross(phi, eta)
    return _sum(_sum(eta, once, second), _cross(phi, once), third)


@njit(cache=True)
def gravity(sine, height):
    """Return normal gravity, m/s^2, as :func:`inertial.earth.normal_gravity`; ``sine`` of the latitude."""
    sin2 = sine * sine
    surface = _EQUATOR_GRAVITY * (1 + _SOMIGLIANA * sin2) / math.sqrt(1 - _ECCENTRICITY2 * sin2)
    ratio = height / SEMI_MAJOR_AXIS
    return surface * (1 - 2 * (1 + FLATTENING + _RATE_RATIO - 2 * FLATTENING * sin2) * ratio + 3 * ratio * ratio)


@njit(cache=True)
def transport_rate(axis, height, velocity):
    """Return the rate of the navigation frame against the Earth; zero about the vertical (wander azimuth).

    ``axis`` is the Earth's axis in navigation axes, whose horizontal part is cos(latitude) long and points
    north; with it the ellipsoid's curvature needs no heading and is regular at the poles.
    """
    root2 = 1 - _ECCENTRICITY2 * axis[2] * axis[2]
    transverse = SEMI_MAJOR_AXIS / math.sqrt(root2)
    meridian = transverse * (1 - _ECCENTRICITY2) / root2
    along_parallel = 1 / (transverse + height)
    northward = axis[0] * velocity[0] + axis[1] * velocity[1]
    more = northward * transverse * _ECCENTRICITY2 / root2 * along_parallel / (meridian + height)
    return (along_parallel * velocity[1] + more * axis[1], -along_parallel * velocity[0] - more * axis[0], 0.0)


@njit(cache=True)
def _acceleration(axis, height, velocity):
    """Return gravity and the Coriolis term, and the transport rate."""
    rate = transport_rate(axis, height, velocity)
    coriolis = _cross(_sum(rate, axis, 2 * EARTH_RATE), velocity)
    return (-coriolis[0], -coriolis[1], gravity(axis[2], height) - coriolis[2]), rate


@njit(cache=True)
def major_step(core, phi, eta, dt, altitude, gains):
    """Advance by one major interval.

    Parameters
    ----------
    core : (18,) float64
        Changed in place.
    phi, eta : tuple of 3 float
        From :func:`combine`.
    dt : float, s
    altitude : float, m
        At the end of the interval; NaN: the vertical channel is left to itself.
    gains : (3,) float64
        Of height, vertical velocity and its correction; 1/s, 1/s^2, 1/s^3.
    """
    q = (core[Q], core[Q + 1], core[Q + 2], core[Q + 3])
    velocity, axis, height = _load(core, V), _load(core, B + 6), core[HEIGHT]
    thrust = _rotate(q, velocity_increment(phi, eta))

    # Gravity, Coriolis and transport rate in the middle of the interval.
    start, rate = _acceleration(axis, height, velocity)
    middle_velocity = _sum(_sum(velocity, thrust, 0.5), start, 0.5 * dt)
    axis = _sum(axis, _cross(rate, axis), -0.5 * dt)
    height -= 0.25 * dt * (velocity[2] + middle_velocity[2])
    middle, rate = _acceleration(axis, height, middle_velocity)
    turn = _sum(rate, axis, EARTH_RATE)
    thrust = _sum(thrust, _cross(turn, thrust), -0.5 * dt)
    new_velocity = _sum(_sum(velocity, thrust, 1.0), middle, dt)

    mean_velocity = _sum(_sum((0.0, 0.0, 0.0), velocity, 0.5), new_velocity, 0.5)
    rate = transport_rate(axis, height, mean_velocity)
    turn = _sum(rate, axis, EARTH_RATE)
    _turn_position(core, _sum((0.0, 0.0, 0.0), rate, dt))
    core[HEIGHT] -= dt * mean_velocity[2]
    _store(core, V, new_velocity)
    _store_unit(core, _multiply(_exp(_sum((0.0, 0.0, 0.0), turn, dt), -1.0), _multiply(q, _exp(phi, 1.0))))
    if not math.isnan(altitude):
        _aid_vertical(core, altitude, dt, gains)


@njit(cache=True)
def _turn_position(core, theta):
    """Turn b_ij by ``theta``, at most 1e-5 rad, of which third powers vanish."""
    for row in range(B, B + 9, 3):
        b = _load(core, row)
        once = _cross(b, theta)
        _store(core, row, _sum(_sum(b, once, 1.0), _cross(once, theta), 0.5))


@njit(cache=True)
def _store_unit(core, q):
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for i in range(4):
        core[Q + i] = q[i] / norm


@njit(cache=True)
def _aid_vertical(core, altitude, dt, gains):
    error = core[HEIGHT] - altitude
    core[HEIGHT] -= gains[0] * error * dt
    core[V + 2] += (gains[1] * error + core[CORRECTION]) * dt
    core[CORRECTION] += gains[2] * error * dt


@njit(cache=True)
def take_sample(window, row, history, gyro_b, accel_b, affine, interval, point):
    """Write a sample's increments, free of the sensors' errors, into a row of the window.

    A point sample ends its interval; the parabola through it and the two before is integrated.
    """
    for i in range(6):
        reading = gyro_b if i < 3 else accel_b
        sensor, axis = i // 3, i % 3
        value = affine[sensor, axis, 3]
        for j in range(3):
            value += affine[sensor, axis, j] * reading[j]
        if not point:
            window[row, i] = interval * value
            continue
        if history[0, 0] == 0.0:
            history[1, i] = history[2, i] = value
        window[row, i] = interval / 12 * (5 * value + 8 * history[1, i] - history[2, i])
        history[2, i], history[1, i] = history[1, i], value


@njit(cache=True)
def run(core, window, history, gyro_b, accel_b, altitude, affine, interval, point, k, new, gains, every):
    """Run over as many major intervals as there are altitudes, and return every ``every``-th ``core``.

    Parameters
    ----------
    core, window, history : float64 arrays
        Changed in place.
    gyro_b, accel_b : (N * new, 3) float64, rad/s and m/s^2
    altitude : (N,) float64, m
    affine : (2, 3, 4) float64
        Matrix and offset that take the errors out of gyro and accelerometer readings.
    interval : float, s
        Between samples.
    point : bool
        Whether samples are instantaneous values.
    k, new : (K - 1,) float64, int
        The scheme.
    gains : (3,) float64
    every : int

    Returns
    -------
    (N // every, 18) float64
    """
    out = np.empty((len(altitude) // every, CORE_SIZE))
    first = len(k) + 1 - new
    for step in range(len(altitude)):
        for i in range(first):
            _copy(window[new + i], window[i])
        for i in range(new):
            sample = step * new + i
            take_sample(window, first + i, history, gyro_b[sample], accel_b[sample], affine, interval, point)
            if history[0, 0] == 0.0:
                history[0, 0] = 1.0
                for j in range(first):
                    _copy(window[first], window[j])
        phi, eta = combine(window, k, new)
        major_step(core, phi, eta, new * interval, altitude[step], gains)
        if (step + 1) % every == 0:
            _copy(core, out[(step + 1) // every - 1])
    return out
