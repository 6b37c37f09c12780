"""Compiled kernels: exact integrals of a rotation at constant rate, and the Gauss-Markov recursion.

Scalars and small arrays only, so that compiled filters call them at no cost.
"""

import math

import numpy as np
from numba import njit

# Below it the closed forms of the last two coefficients lose digits; eleven terms reach 1e-16 there.
_SERIES_ANGLE = 2.0
# Below it five terms do.
_SMALL_ANGLE = 0.25

compiled = njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"})
"""Decorator of an estimator's kernel: sums in any order and fused, while NaN and infinity stay what they are.

``math.isfinite`` does not work under it: compare with infinity. What simulates does not use it, so that its
bytes are the same on every processor.
"""


@njit(cache=True)
def zoh_coefficients(angle):
    """Return the four coefficients of the constant-rate integrals.

    Parameters
    ----------
    angle : float
        Rotation over the interval, rad, >= 0.

    Returns
    -------
    tuple of float
        sin a/a, (1 - cos a)/a^2, (a - sin a)/a^3, (a^2/2 + cos a - 1)/a^4, each to about 1e-15
        relative for every angle.
    """
    angle2 = angle * angle
    if angle < _SERIES_ANGLE:
        third = fourth = 0.0
        if angle >= _SMALL_ANGLE:
            for k in range(10, 4, -1):
                third = 1.0 - third * (angle2 * (1.0 / ((2 * k + 4) * (2 * k + 5))))
                fourth = 1.0 - fourth * (angle2 * (1.0 / ((2 * k + 5) * (2 * k + 6))))
        for k in range(4, -1, -1):
            third = 1.0 - third * (angle2 * (1.0 / ((2 * k + 4) * (2 * k + 5))))
            fourth = 1.0 - fourth * (angle2 * (1.0 / ((2 * k + 5) * (2 * k + 6))))
        third /= 6.0
        fourth /= 24.0
        return 1.0 - angle2 * third, 0.5 - angle2 * fourth, third, fourth
    first = math.sin(angle) / angle
    half_sinc = math.sin(0.5 * angle) / (0.5 * angle)
    second = 0.5 * half_sinc * half_sinc
    return first, second, (1.0 - first) / angle2, (0.5 - second) / angle2


@njit(cache=True)
def zoh_integrals(gyro_b, dt):
    """Return the rotation over ``dt`` at constant rate, and its first and second integrals.

    With ``W = [gyro_b x]``: ``R = exp(W dt)``, ``J1`` its integral over ``0..dt`` and ``J2`` the
    integral of ``J1``. Then ``dcm_nb @ R`` is the attitude after ``dt``, and a constant specific
    force adds ``dcm_nb @ J1 @ accel_b`` to the velocity, ``dcm_nb @ J2 @ accel_b`` to the position.

    Parameters
    ----------
    gyro_b : (3,) float64, rad/s
    dt : float, s

    Returns
    -------
    R, J1, J2 : (3, 3) float64; pure number, s, s^2
    """
    R, J1, J2 = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    fill_zoh_integrals(gyro_b, dt, R, J1, J2)
    return R, J1, J2


@njit(cache=True)
def fill_zoh_integrals(gyro_b, dt, R, J1, J2):
    """Write what :func:`zoh_integrals` returns into ``R``, ``J1``, ``J2``, for use in loops."""
    x, y, z = gyro_b[0] * dt, gyro_b[1] * dt, gyro_b[2] * dt
    first, second, third, fourth = zoh_coefficients(math.sqrt(x * x + y * y + z * z))
    _fill_polynomial(R, x, y, z, 1.0, first, second, 1.0)
    _fill_polynomial(J1, x, y, z, 1.0, second, third, dt)
    _fill_polynomial(J2, x, y, z, 0.5, third, fourth, dt * dt)


@njit(cache=True)
def _fill_polynomial(out, x, y, z, constant, linear, quadratic, factor):
    """Fill ``out = factor (constant I + linear [p x] + quadratic [p x]^2)``, p = (x, y, z)."""
    a, b, c = factor * constant, factor * linear, factor * quadratic
    out[0, 0] = a - c * (y * y + z * z)
    out[1, 1] = a - c * (x * x + z * z)
    out[2, 2] = a - c * (x * x + y * y)
    out[0, 1] = c * x * y - b * z
    out[1, 0] = c * x * y + b * z
    out[0, 2] = c * x * z + b * y
    out[2, 0] = c * x * z - b * y
    out[1, 2] = c * y * z - b * x
    out[2, 1] = c * y * z + b * x


@njit(cache=True)
def first_order_recursion(decay, drive):
    """Return ``y[k] = decay[k] y[k-1] + drive[k]``, starting from ``y[0] = drive[0]``.

    Parameters
    ----------
    decay : (N,) float64
    drive : (N, M) float64
    """
    out = np.empty_like(drive)
    # Element by element: a row assigned to a row would compile its shape's error message, ten seconds of it.
    for k in range(len(drive)):
        for i in range(drive.shape[1]):
            out[k, i] = drive[k, i] + (decay[k] * out[k - 1, i] if k > 0 else 0.0)
    return out
