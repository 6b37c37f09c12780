"""Compiled backward pass of the smoother, over the steps of the forward filter as plain arrays.

The state is ``[c vd h bg ba]`` of ``docs/attitude.md``: down direction, velocity down, altitude, biases of
gyro and accelerometer. How the filter keeps its own state is not known here.
"""

import math

import numpy as np

from inertial._kernels import compiled
from inertial.rotation import fill_zoh_integrals

N = 11
VD, ALT, BG, BA = 3, 4, 5, 8


@compiled
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
    R, jv, jh = np.empty((3, 3)), np.empty(3), np.empty(3)
    F, cross, noise = np.empty((N, N)), np.empty((N, N)), np.empty((N, N))
    for k in range(len(dt) - 1, -1, -1):
        for i in range(N):
            out_x[k, i] = x[i]
        _copy(P, out_P[k])
        out_known[k] = known
        _motion(before_x[k], samples[k], dt[k], earth_rate_down, R, jv, jh)
        _transition(before_x[k], R, jv, jh, dt[k], accel_bias_time, F)
        _times_transposed(before_P[k], F, cross)
        if known and not before_known[k] and keeps[k, 0]:
            _times(F, cross, noise)
            for i in range(N):
                for j in range(N):
                    noise[i, j] = predicted_P[k, i, j] - noise[i, j] if keeps[k, i] and keeps[k, j] else 0.0
            _motion(x, samples[k], dt[k], earth_rate_down, R, jv, jh)
            _carry_back(noise, R, jv, jh, dt[k], gravity, F, cross, x, P)
            known = P[0, 0] + P[1, 1] + P[2, 2] < lost_trace
        else:
            _smooth(before_x[k], before_P[k], before_known[k], predicted_x[k], predicted_P[k], cross,
                    keeps[k], F, x, P)
            known = before_known[k]
        for i in range(N):
            for j in range(i):
                P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])
    return known


@compiled
def _motion(x, sample, dt, earth_rate_down, R, jv, jh):
    """Write R, J1 f and J2 f of a sample without the state's biases."""
    rate, J1, J2 = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        rate[i] = sample[i] - x[BG + i] - earth_rate_down * x[i]
    fill_zoh_integrals(rate, dt, R, J1, J2)
    for i in range(3):
        jv[i] = jh[i] = 0.0
        for j in range(3):
            force = sample[3 + j] - x[BA + j]
            jv[i] += J1[i, j] * force
            jh[i] += J2[i, j] * force


@compiled
def _transition(x, R, jv, jh, dt, accel_bias_time, F):
    """Write the filter's F."""
    for i in range(N):
        for j in range(N):
            F[i, j] = 1.0 if i == j else 0.0
    for i in range(3):
        down = R[0, i] * x[0] + R[1, i] * x[1] + R[2, i] * x[2]
        for j in range(3):
            F[i, j] = R[j, i]
        before, after = (i + 1) % 3, (i + 2) % 3
        F[before, BG + after] = dt * down  # -dt [down x]
        F[after, BG + before] = -dt * down
        F[VD, i] = jv[i]
        F[VD, BA + i] = -dt * down
        F[ALT, i] = -jh[i]
        F[BA + i, BA + i] = max(1.0 - dt / accel_bias_time, 0.0)
    F[ALT, VD] = -dt


@compiled
def _smooth(before_x, before_P, before_known, predicted_x, predicted_P, cross, keeps, work, x, P):
    """Rauch, Tung and Striebel's step; `cross` is the covariance of the states before and predicted."""
    _copy(predicted_P, work)
    if before_known and keeps[0]:
        # Unit length leaves no covariance along the down direction; whatever stands there has no effect.
        norm2 = predicted_x[0] ** 2 + predicted_x[1] ** 2 + predicted_x[2] ** 2
        for i in range(3):
            for j in range(3):
                work[i, j] += predicted_x[i] * predicted_x[j] / norm2
    for i in range(N):
        for j in range(N):
            if not keeps[j]:
                cross[i, j] = 0.0
            P[i, j] -= predicted_P[i, j]
        x[i] -= predicted_x[i]
    _divide(cross, work)
    gain = cross
    _times_transposed(P, gain, work)
    _times(gain, work, P)
    for i in range(N):
        work[0, i] = before_x[i]
        for j in range(N):
            P[i, j] += before_P[i, j]
            work[0, i] += gain[i, j] * x[j]
    norm = math.sqrt(work[0, 0] ** 2 + work[0, 1] ** 2 + work[0, 2] ** 2) if before_known else 1.0
    for i in range(N):
        x[i] = work[0, i] / norm if i < VD else work[0, i]


@compiled
def _carry_back(noise, R, jv, jh, dt, gravity, inverse, work, x, P):
    """Carry the state back by the model alone, where the filter had no attitude to linearise about."""
    for i in range(N):
        for j in range(N):
            inverse[i, j] = 1.0 if i == j else 0.0
            P[i, j] += noise[i, j]
    for i in range(3):
        for j in range(3):
            before, after = (j + 1) % 3, (j + 2) % 3
            inverse[i, j] = R[i, j]
            inverse[i, BG + j] = dt * (R[i, before] * x[after] - R[i, after] * x[before])
        inverse[VD, BA + i] = dt * x[i]
    for j in range(N):
        for i in range(3):
            inverse[VD, j] -= jv[i] * inverse[i, j]
            inverse[ALT, j] += jh[i] * inverse[i, j]
        inverse[ALT, j] += dt * inverse[VD, j]
    _times_transposed(P, inverse, work)
    _times(inverse, work, P)
    d0, d1, d2 = x[0], x[1], x[2]
    for i in range(3):
        x[i] = R[i, 0] * d0 + R[i, 1] * d1 + R[i, 2] * d2
    x[VD] -= jv[0] * x[0] + jv[1] * x[1] + jv[2] * x[2] + dt * gravity
    x[ALT] += dt * x[VD] + jh[0] * x[0] + jh[1] * x[1] + jh[2] * x[2] + 0.5 * dt * dt * gravity


@compiled
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
    R, J1, J2 = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for k in range(len(dt)):
        if not known[k]:
            continue
        d = (down[k, 0], down[k, 1], down[k, 2])
        if k == 0 or starts[k] or not known[k - 1]:
            bias_std = noise_var = 0.0
            n = (-d[1], d[0], 0.0) if abs(d[0]) > 0.99 else (0.0, -d[2], d[1])
        else:
            fill_zoh_integrals(gyro_b[k], dt[k], R, J1, J2)
            a = (north[k - 1, 0], north[k - 1, 1], north[k - 1, 2])
            n = (R[0, 0] * a[0] + R[1, 0] * a[1] + R[2, 0] * a[2],
                 R[0, 1] * a[0] + R[1, 1] * a[1] + R[2, 1] * a[2],
                 R[0, 2] * a[0] + R[1, 2] * a[1] + R[2, 2] * a[2])
            bias_std += dt[k] * math.sqrt(d[0] ** 2 * bias_variance[k, 0] + d[1] ** 2 * bias_variance[k, 1]
                                          + d[2] ** 2 * bias_variance[k, 2])
            noise_var += dt[k] * noise_density**2
        along = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
        norm = math.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2 - along**2)
        for i in range(3):
            north[k, i] = (n[i] - along * d[i]) / norm
        yaw_variance[k] = bias_std**2 + noise_var


@compiled
def _copy(A, out):
    for i in range(N):
        for j in range(N):
            out[i, j] = A[i, j]


@compiled
def _times(A, B, out):
    """Write ``A B``."""
    for i in range(N):
        for j in range(N):
            out[i, j] = 0.0
        for k in range(N):
            for j in range(N):
                out[i, j] += A[i, k] * B[k, j]


@compiled
def _times_transposed(A, B, out):
    """Write ``A B^T``."""
    for i in range(N):
        for j in range(N):
            total = 0.0
            for k in range(N):
                total += A[i, k] * B[j, k]
            out[i, j] = total


@compiled
def _divide(B, S):
    """Replace B by ``B S^-1`` for a symmetric positive definite S, and S by its Cholesky factor."""
    for i in range(N):
        for j in range(i + 1):
            rest = S[i, j]
            for k in range(j):
                rest -= S[i, k] * S[j, k]
            S[i, j] = math.sqrt(rest) if i == j else rest / S[j, j]
    for row in range(N):
        for j in range(N):
            for k in range(j):
                B[row, j] -= S[j, k] * B[row, k]
            B[row, j] /= S[j, j]
        for j in range(N - 1, -1, -1):
            for k in range(j + 1, N):
                B[row, j] -= S[k, j] * B[row, k]
            B[row, j] /= S[j, j]
