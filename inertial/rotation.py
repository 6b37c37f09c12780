"""Rotations: direction cosine matrices, Euler angles, quaternions and the down direction.

Everything is vectorised over leading dimensions. ``dcm_nb`` and ``q_nb_wxyz`` take body (FRD) to
navigation (NED); Euler angles are heading about down, then pitch, then roll. The constant-rate
integrals :func:`zoh_integrals` are compiled and may be called from compiled code.
"""

import numpy as np

from inertial._kernels import fill_zoh_integrals, zoh_coefficients, zoh_integrals

__all__ = [
    "dcm_from_quaternion", "dcm_nb_from_euler", "down_from_quaternion", "down_from_roll_pitch",
    "euler_from_dcm", "fill_zoh_integrals", "quaternion_conjugate", "quaternion_exp", "quaternion_from_dcm",
    "quaternion_log", "quaternion_multiply", "quaternion_slerp", "roll_pitch_from_down", "skew",
    "zoh_coefficients", "zoh_integrals"]


def skew(vector):
    """Return the matrices ``[v x]``, (..., 3, 3), of vectors (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(vector, dtype=float), -1, 0)
    zero = np.zeros_like(x)
    return _matrix([[zero, -z, y], [z, zero, -x], [-y, x, zero]])


def dcm_nb_from_euler(roll, pitch, heading):
    """Return ``dcm_nb = Rz(heading) Ry(pitch) Rx(roll)``, (..., 3, 3); angles in rad."""
    roll, pitch, heading = np.broadcast_arrays(roll, pitch, heading)
    sr, cr = np.sin(roll), np.cos(roll)
    sp, cp = np.sin(pitch), np.cos(pitch)
    sh, ch = np.sin(heading), np.cos(heading)
    return _matrix([[cp * ch, sr * sp * ch - cr * sh, cr * sp * ch + sr * sh],
                    [cp * sh, sr * sp * sh + cr * ch, cr * sp * sh - sr * ch],
                    [-sp, sr * cp, cr * cp]])


def euler_from_dcm(dcm_nb):
    """Return ``(roll, pitch, heading)`` in rad of matrices (..., 3, 3).

    Roll and heading are in [-pi, pi], pitch in [-pi/2, pi/2]. At pitch +-90 deg, where only a
    combination of roll and heading is defined, the three angles still rebuild the matrix.
    """
    dcm_nb = np.asarray(dcm_nb, dtype=float)
    roll, pitch = roll_pitch_from_down(dcm_nb[..., 2, :])
    sr, cr = np.sin(roll), np.cos(roll)
    heading = np.arctan2(sr * dcm_nb[..., 0, 2] - cr * dcm_nb[..., 0, 1],
                         cr * dcm_nb[..., 1, 1] - sr * dcm_nb[..., 1, 2])
    return roll, pitch, heading


def roll_pitch_from_down(down_b):
    """Return ``(roll, pitch)`` in rad of down directions (..., 3); their length does not matter."""
    x, y, z = np.moveaxis(np.asarray(down_b, dtype=float), -1, 0)
    return np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z))


def down_from_roll_pitch(roll, pitch):
    """Return the down direction in body axes, (..., 3), third row of ``dcm_nb``; angles in rad."""
    roll, pitch = np.broadcast_arrays(roll, pitch)
    return np.stack([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)],
                    axis=-1)


def down_from_quaternion(q_nb_wxyz):
    """Return the down direction in body axes, (..., 3), of unit quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(q_nb_wxyz, dtype=float), -1, 0)
    return np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
                    axis=-1)


def dcm_from_quaternion(q_wxyz):
    """Return the matrices (..., 3, 3) of unit quaternions (..., 4), same sense of rotation."""
    w, x, y, z = np.moveaxis(np.asarray(q_wxyz, dtype=float), -1, 0)
    return _matrix([
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z]])


def quaternion_from_dcm(dcm):
    """Return the unit quaternions (..., 4), scalar first and >= 0, of matrices (..., 3, 3).

    ``4 q q^T`` is linear in the matrix; its row with the largest diagonal element, normalised, is
    the quaternion (Shepperd, J. Guidance and Control 1(3), 1978).
    """
    m = np.moveaxis(np.asarray(dcm, dtype=float), (-2, -1), (0, 1))
    xx, yy, zz = m[0, 0], m[1, 1], m[2, 2]
    wx, wy, wz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    outer = _matrix([[1 + xx + yy + zz, wx, wy, wz],
                     [wx, 1 + xx - yy - zz, xy, xz],
                     [wy, xy, 1 - xx + yy - zz, yz],
                     [wz, xz, yz, 1 - xx - yy + zz]])
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def quaternion_multiply(left, right):
    """Return the Hamilton products (..., 4), scalar first: ``q_ab`` times ``q_bc`` is ``q_ac``."""
    left, right = np.asarray(left, dtype=float), np.asarray(right, dtype=float)
    w, v = left[..., :1], left[..., 1:]
    s, u = right[..., :1], right[..., 1:]
    return np.concatenate([w * s - np.sum(v * u, axis=-1, keepdims=True),
                           w * u + s * v + np.cross(v, u)], axis=-1)


def quaternion_conjugate(q_wxyz):
    """Return the opposite rotations (..., 4) of unit quaternions."""
    return np.asarray(q_wxyz, dtype=float) * [1.0, -1.0, -1.0, -1.0]


def quaternion_exp(rotation_vector):
    """Return the unit quaternions (..., 4), scalar first, of rotation vectors (..., 3), rad."""
    rotation_vector = np.asarray(rotation_vector, dtype=float)
    half = 0.5 * np.linalg.norm(rotation_vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * rotation_vector], axis=-1)


def quaternion_log(q_wxyz):
    """Return the shortest rotation vectors (..., 3), rad, of unit quaternions (..., 4)."""
    q = np.asarray(q_wxyz, dtype=float)
    q = np.where(q[..., :1] < 0, -q, q)
    half_sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(half_sine, q[..., :1])
    ratio = np.divide(angle, half_sine, out=np.full_like(angle, 2.0), where=half_sine > 0)
    return ratio * q[..., 1:]


def quaternion_slerp(start, end, fraction):
    """Interpolate at constant rate along the shortest way between unit quaternions.

    Parameters
    ----------
    start, end : (..., 4)
    fraction : (...)
        0 gives ``start``, 1 gives ``end`` (up to sign).
    """
    step = quaternion_log(quaternion_multiply(quaternion_conjugate(start), end))
    return quaternion_multiply(start, quaternion_exp(np.asarray(fraction)[..., None] * step))


def _matrix(rows):
    """Stack a nested list of equally shaped arrays into (..., rows, columns)."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
