"""Compiled backward pass of the smoother, over the steps of the forward filter as plain arrays.

The state is ``[c vd h bg ba]`` of ``docs/attitude.md``: down direction, velocity down, altitude, biases of
gyro and accelerometer. How the filter keeps its own state is not known here.
"""

import math

import numpy as np
from numba import njit

from inertial.rotation import zoh_integrals

N = 11
VD, ALT, BG, BA = 3, 4, 5, 8


@njit(cache=True)
def smooth_back(before_x, before_P, before_known, predicted_x, predicted_P, keeps, dt, samples,
                gravity, earth_rate_down, accel_bias_time, lost_trace, x, P, known, out_x, out_P, out_known):
    """Go back over n steps from the smoothed state after the last of them.

    Parameters
    ----------
    before_x, before_P, before_known : (n, N), (n, N, N), (n,) bool
        The filter's state after the sample before, and whether it had an attitude.
    predicted_x, predicted_P : (n, N), (n, N, N)
        The same, carried to the sample and not yet updated.
    keeps : (n, N) bool
        Which states were carried; the others started anew.
    dt, samples : (n,) s, (n, 6) rad/s and m/s^2
        What they were carried with.
    gravity, earth_rate_down, accel_bias_time : float, SI
    lost_trace : float
        Trace of the down direction's covariance above which there is no attitude.
    x, P, known : (N,), (N, N), bool
        Smoothed state after the last step; `x` and `P` are replaced by the one before the first.
    out_x, out_P, out_known : (n, N), (n, N, N), (n,) bool
        Smoothed states after each step.

    Returns
    -------
    bool
        `known` before the first step.
    """
    for k in range(len(dt) - 1, -1, -1):
        out_x[k] = x
        out_P[k] = P
        out_known[k] = known
        R, jv, jh = _motion(before_x[k], samples[k], dt[k], earth_rate_down)
        F = _transition(before_x[k], R, jv, jh, dt[k], accel_bias_time)
        if known and not before_known[k] and keeps[k, 0]:
            noise = predicted_P[k] - _times_transposed(_times(F, before_P[k]), F)
            _carry_back(noise, keeps[k], dt[k], samples[k], gravity, earth_rate_down, x, P)
            known = P[0, 0] + P[1, 1] + P[2, 2] < lost_trace
        else:
            _smooth(before_x[k], before_P[k], before_known[k], predicted_x[k], predicted_P[k],
                    _times_transposed(before_P[k], F), keeps[k], x, P)
            known = before_known[k]
        for i in range(N):
            for j in range(i):
                P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])
    return known


@njit(cache=True)
def _motion(x, sample, dt, earth_rate_down):
    """Return R, J1 f and J2 f of a sample without the state's biases."""
    R, J1, J2 = zoh_integrals(sample[:3] - x[BG:BA] - earth_rate_down * x[:3], dt)
    force = sample[3:] - x[BA:]
    return R, _times_vector(J1, force), _times_vector(J2, force)


@njit(cache=True)
def _transition(x, R, jv, jh, dt, accel_bias_time):
    """The filter's F."""
    F = np.eye(N)
    F[:3, :3] = R.T
    down = _times_vector(R.T, x[:3])
    _fill_cross(F[:3, BG:BA], down, -dt)
    F[VD, :3] = jv
    F[VD, BA:] = -dt * down
    F[ALT, :3] = -jh
    F[ALT, VD] = -dt
    for i in range(BA, N):
        F[i, i] = max(1.0 - dt / accel_bias_time, 0.0)
    return F


@njit(cache=True)
def _smooth(before_x, before_P, before_known, predicted_x, predicted_P, cross, keeps, x, P):
    """Rauch, Tung and Striebel's step; `cross` is the covariance of the states before and predicted."""
    S = predicted_P.copy()
    if before_known and keeps[0]:
        # Unit length leaves no covariance along the down direction; whatever stands there has no effect.
        norm2 = predicted_x[0] ** 2 + predicted_x[1] ** 2 + predicted_x[2] ** 2
        for i in range(3):
            for j in range(3):
                S[i, j] += predicted_x[i] * predicted_x[j] / norm2
    for j in range(N):
        if not keeps[j]:
            cross[:, j] = 0.0
    gain = _divide(cross, S)
    x[:] = before_x + _times_vector(gain, x - predicted_x)
    P[:] = before_P + _times_transposed(_times(gain, P - predicted_P), gain)
    if before_known:
        x[:3] /= math.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)


@njit(cache=True)
def _carry_back(noise, keeps, dt, sample, gravity, earth_rate_down, x, P):
    """Carry the state back by the model alone, where the filter had no attitude to linearise about."""
    R, jv, jh = _motion(x, sample, dt, earth_rate_down)
    inverse = np.eye(N)
    inverse[:3, :3] = R
    cross = np.empty((3, 3))
    _fill_cross(cross, x[:3], dt)
    inverse[:3, BG:BA] = _times(R, cross)
    inverse[VD] -= _times_vector(inverse[:3].T, jv)
    inverse[VD, BA:] += dt * x[:3]
    inverse[ALT] += dt * inverse[VD] + _times_vector(inverse[:3].T, jh)
    for j in range(N):
        if not keeps[j]:
            noise[j] = 0.0
            noise[:, j] = 0.0
    P[:] = _times_transposed(_times(inverse, P + noise), inverse)
    x[:3] = _times_vector(R, x[:3])
    x[VD] -= jv[0] * x[0] + jv[1] * x[1] + jv[2] * x[2] + dt * gravity
    x[ALT] += (dt * x[VD] + jh[0] * x[0] + jh[1] * x[1] + jh[2] * x[2] + 0.5 * dt * dt * gravity)


@njit(cache=True)
def carry_heading(down, gyro_b, bias_variance, known, starts, dt, noise_density, north, yaw_variance):
    """Integrate the gyro about the down direction, forward; the nose points east where it starts.

    Parameters
    ----------
    down, gyro_b : (n, 3), pure number and rad/s
    bias_variance : (n, 3), rad^2/s^2
    known, starts : (n,) bool
        Where there is an attitude, and where it does not follow from the sample before.
    dt : (n,), s
        To each sample from the one before.
    noise_density : float, rad/s/sqrt(Hz)
    north, yaw_variance : (n, 3), (n,) rad^2
        North in body axes and the variance of the yaw; written where `known`.
    """
    bias_std = noise_var = 0.0
    for k in range(len(dt)):
        if not known[k]:
            continue
        d = down[k]
        if k == 0 or starts[k] or not known[k - 1]:
            bias_std = noise_var = 0.0
            n = np.array([-d[1], d[0], 0.0]) if abs(d[0]) > 0.99 else np.array([0.0, -d[2], d[1]])
        else:
            R, _, _ = zoh_integrals(gyro_b[k], dt[k])
            n = _times_vector(R.T, north[k - 1])
            rate2 = 0.0
            for i in range(3):
                rate2 += d[i] ** 2 * bias_variance[k, i]
            bias_std += dt[k] * math.sqrt(rate2)
            noise_var += dt[k] * noise_density**2
        n -= (n[0] * d[0] + n[1] * d[1] + n[2] * d[2]) * d
        north[k] = n / math.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)
        yaw_variance[k] = bias_std**2 + noise_var


@njit(cache=True)
def _fill_cross(out, v, scale):
    """Write ``scale [v x]``."""
    out[0, 0] = out[1, 1] = out[2, 2] = 0.0
    out[0, 1], out[0, 2] = -scale * v[2], scale * v[1]
    out[1, 0], out[1, 2] = scale * v[2], -scale * v[0]
    out[2, 0], out[2, 1] = -scale * v[1], scale * v[0]


@njit(cache=True)
def _times_vector(A, v):
    out = np.zeros(A.shape[0])
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[i] += A[i, j] * v[j]
    return out


@njit(cache=True)
def _times(A, B):
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            for j in range(B.shape[1]):
                out[i, j] += A[i, k] * B[k, j]
    return out


@njit(cache=True)
def _times_transposed(A, B):
    """Return ``A B^T``."""
    out = np.zeros((A.shape[0], B.shape[0]))
    for i in range(A.shape[0]):
        for j in range(B.shape[0]):
            for k in range(A.shape[1]):
                out[i, j] += A[i, k] * B[j, k]
    return out


@njit(cache=True)
def _divide(B, S):
    """Return ``B S^-1`` for a symmetric positive definite S, by its Cholesky factor."""
    L = np.zeros(S.shape)
    for i in range(N):
        for j in range(i + 1):
            rest = S[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(rest) if i == j else rest / L[j, j]
    out = B.copy()
    for row in range(N):
        for j in range(N):
            for k in range(j):
                out[row, j] -= L[j, k] * out[row, k]
            out[row, j] /= L[j, j]
        for j in range(N - 1, -1, -1):
            for k in range(j + 1, N):
                out[row, j] -= L[k, j] * out[row, k]
            out[row, j] /= L[j, j]
    return out
