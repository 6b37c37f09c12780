"""Compiled kernels of the estimators, from one sample to a whole recording.

State, parameters, history and output rows are flat float64 arrays: a sample is one call without
allocation and a snapshot is one copy. The layouts below are the only place that knows positions;
they stand in this file because compiled code is cached per file. Then, bottom up: the default
filter, the paper's filter, the checks of a sample, the time buffer, a recording.
Equations: ``docs/attitude.md``. Frames and units: :mod:`inertial`.
"""

import math

import numpy as np

from inertial._kernels import compiled, zoh_coefficients


def _offsets(*sizes):
    """Return the offset of each field and the total size."""
    ends = [0]
    for size in sizes:
        ends.append(ends[-1] + size)
    return ends


# State vector: down_b (3), velocity down, altitude, gyro bias (3), accelerometer bias (3).
# The paper's filter has the first five.
N = 11
N5 = 5
VD, ALT, BG, BA = 3, 4, 5, 8

# Filter state: first what every model has, then what only the default one has.
(X, P, ATTITUDE, ELAPSED, INTERVAL, HELD, STUCK, CLIPPED, GYRO, ACCEL, GYRO_LP, ACCEL_LP, GYRO_SPREAD,
 ACCEL_SPREAD, ACCEL_VIBRATION, REST, REST_GYRO_LP, REST_ACCEL_LP, NORTH, YAW_STD, YAW_VAR, ALT_COUNT, SINCE_ALT,
 GRAVITY, GRAVITY_BG, GRAVITY_BA, SINCE_GRAVITY, RESIDUAL, LASTING, PULLING, PULLED_COV, PULLED, FREE_FALL,
 ALT_LAST, ALT_BEFORE, ALT_SPREAD, ALT_STEP, ALT_PERSISTENCE, ALT_REFUSED,
 STATE_SIZE) = _offsets(
    N, N * N,
    1,  # ATTITUDE: 1 once there is one
    1, 1,  # ELAPSED s since the start; INTERVAL s, running mean
    1, 1, 1,  # HELD s without a good rate; STUCK s of identical samples; CLIPPED s of a rate at its limit
    3, 3,  # GYRO, ACCEL: the last good sample
    3, 3, 1, 1,  # low-passed sample, and low-passed squared distance from it
    1,  # ACCEL_VIBRATION (m/s^2)^2 of an axis, from sample to sample
    1, 3, 3,  # REST s of stillness; the low-passed sample during it, low-passed again
    3, 1, 1,  # NORTH unit vector: zero of the yaw; its spread: grows as t (rad), as sqrt t (rad^2)
    1, 1,  # ALT_COUNT; SINCE_ALT s
    3, 9, 9,  # GRAVITY low-passed force; -1/g of its sensitivity to gyro bias; to accelerometer bias
    1, 1,  # SINCE_GRAVITY s; RESIDUAL (m/s^2)^2, held maximum
    3,  # LASTING m/s^2, the residual low-passed in the frame that the gyro carries
    # A lasting acceleration that is considered, not estimated: PULLING (m/s^2)^2 of an axis, its covariance with
    # the tilt that it has pulled along (m/s^2 rad), PULLED rad^2 of that tilt.
    1, 1, 1,
    1,  # FREE_FALL: 1 while the low-passed force is too small to show gravity
    1, 1, 1, 1, 1, 1)  # last altitudes, their spread (m^2) and resolution (m), jump tests
PH = STATE_SIZE  # scratch behind the state: covariance times a measurement's row
ARRAY_SIZE = PH + N

# Parameters, by the name of the AttitudeParams field or derived value.
PARAMETER_NAMES = (
    "model", "local_gravity", "earth_rate_down",
    "gyro_noise_density", "gyro_rate_error", "accel_noise_density", "accel_force_error",
    "accel_vibration_share",
    "gyro_bias_std", "gyro_bias_walk", "accel_bias_std", "accel_bias_time",
    "gravity_time", "gravity_floor_std", "gravity_residual_share", "gravity_decay_time",
    "gravity_correlation", "gravity_lasting_time", "gravity_lasting_share", "gravity_lasting_share_alone",
    "gravity_pull_time", "gravity_start_std", "gravity_bias_share",
    "rest_gyro_std", "rest_accel_std",
    "altitude_std", "altitude_drift_density", "altitude_scale_error", "altitude_delay", "altitude_delay_std",
    "altitude_gate", "altitude_step_gate",
    "gyro_range", "accel_range", "altitude_buffer", "gap_limit")


# One row of output.
(OUT_VALID, OUT_Q, OUT_TILT_COV, OUT_YAW_VAR, OUT_DOWN, OUT_NORM, OUT_VD, OUT_ALT, OUT_VD_VAR, OUT_ALT_VAR,
 OUT_BG, OUT_BA, OUT_BG_VAR, OUT_BA_VAR, OUT_GYRO, OUT_ACCEL, OUT_SIZE) = _offsets(
    1,  # 1 while there is an attitude
    4, 3, 1,  # q_nb_wxyz; covariance NN, NE, EE of the tilt, rad^2; variance of the yaw
    3, 1, 1, 1, 1, 1,  # down_b, its length before normalising; velocity down and altitude, variances
    3, 3, 3, 3,  # biases of gyro and accelerometer, then their variances
    3, 3)  # rate and force with the bias removed

# Integers: the time buffer's bookkeeping, then one counter per fault.
HISTORY = 1024  # IMU samples that can be taken back
ALTITUDES = 256  # altitudes remembered, at least half of them
(I_HEAD, I_STORED, I_ALTITUDES, I_NEXT, I_LAST_STAMP, I_COUNTS) = range(6)
FAULTS = ("gyro_not_finite", "accel_not_finite", "gyro_out_of_range", "accel_out_of_range",
          "accel_zero", "clipped", "stuck", "restarted", "altitude_not_finite", "altitude_late",
          "altitude_ahead", "altitude_duplicate")
(F_GYRO_NOT_FINITE, F_ACCEL_NOT_FINITE, F_GYRO_OUT_OF_RANGE, F_ACCEL_OUT_OF_RANGE,
 F_ACCEL_ZERO, F_CLIPPED, F_STUCK, F_RESTARTED, F_ALT_NOT_FINITE, F_ALT_LATE,
 F_ALT_AHEAD, F_ALT_DUPLICATE) = range(len(FAULTS))
I_STAMPS = I_COUNTS + len(FAULTS)
I_ALT_STAMPS = I_STAMPS + HISTORY
I_SIZE = I_ALT_STAMPS + ALTITUDES

# One remembered sample, as it was used. The state after every SNAPSHOTS-th is kept, too.
(H_DT, H_SAMPLE, H_GYRO_VAR, H_ACCEL_VAR, H_KNOWN, H_SIZE) = _offsets(1, 6, 1, 1, 1)
SNAPSHOTS = 16

# Everything of one estimator in one array; the integers are a view of their part.
(M_STATE, M_PARAMETERS, M_OUT, M_INTS, M_ALTITUDES, M_HISTORY, M_SNAPSHOTS, MEMORY_SIZE) = _offsets(
    ARRAY_SIZE, len(PARAMETER_NAMES), OUT_SIZE, I_SIZE, 2 * ALTITUDES, HISTORY * H_SIZE,
    HISTORY // SNAPSHOTS * STATE_SIZE)
(P_MODEL, P_GRAVITY, P_EARTH_RATE_DOWN,
 P_GYRO_NOISE, P_GYRO_RATE_ERROR, P_ACCEL_NOISE, P_ACCEL_FORCE_ERROR,
 P_VIBRATION_SHARE,
 P_GYRO_BIAS_STD, P_GYRO_BIAS_WALK, P_ACCEL_BIAS_STD, P_ACCEL_BIAS_TIME,
 P_GRAVITY_TIME, P_GRAVITY_FLOOR, P_GRAVITY_SHARE, P_GRAVITY_DECAY,
 P_CORRELATION, P_LASTING_TIME, P_LASTING_SHARE, P_LASTING_ALONE,
 P_PULL_TIME, P_START_STD, P_BIAS_SHARE,
 P_REST_GYRO_STD, P_REST_ACCEL_STD,
 P_ALT_STD, P_ALT_DRIFT, P_ALT_SCALE_ERROR, P_ALT_DELAY, P_ALT_DELAY_STD,
 P_ALT_GATE, P_ALT_STEP_GATE,
 P_GYRO_RANGE, P_ACCEL_RANGE, P_ALT_BUFFER, P_GAP_LIMIT) = range(M_PARAMETERS, M_OUT)

ACTION_USE, ACTION_SKIP, ACTION_RESET = range(3)  # what to do with a sample of a recording
# What became of a sample: not of three values, not later than the last, no output, output.
MISSHAPEN, OLD, STALE, FRESH = range(4)

REST_TIME = 1.5  # s of stillness that count as rest
LOWPASS_TIME = 0.5  # s
REST_GYRO = math.radians(2.0)  # rad/s about the low-pass
REST_ACCEL = 0.5  # m/s^2 about the low-pass
REST_MEMORY = 3.0  # s over which a slow motion shows that passes for rest
REST_BIAS = 6.25  # squared sigmas of the gyro bias: a steady rate that is larger is a turn
ALTITUDE_AIDS = 10.0  # s after an altitude in which another one is still to come
GRAVITY_PERIOD = 0.05  # s between gravity updates
FREE_FALL_SHARE = 0.5  # of gravity, below which the low-passed force shows no direction
ATTITUDE_TRACE = 0.02  # trace of the down direction's covariance below which there is an attitude
LOST_TRACE = 0.1  # trace above which there is none any more
ATTITUDE_NORM = 0.5
VD_STD = 2.0  # m/s at the start
ALT_START_STD = 5.0  # m
VD_LOST_STD = 100.0  # m/s, spread beyond which the vertical channel starts anew
HOLD_TIME = 0.05  # s that a last good rate is held, or 1.5 intervals
STUCK_TIME = 1.0  # s of identical samples
STUCK_GYRO_DENSITY = 0.05  # rad/s/sqrt(Hz), added while the sensor is stuck
STUCK_ACCEL_DENSITY = 1.0  # m/s^2/sqrt(Hz)
CLIP_SHARE = 0.998  # of the range, above which a component may be clipped
CLIP_ERROR = 0.1  # of the range, spread of a clipped force
CLIP_TIME = 1.0  # s at the limit after which a rate may be twice as large
AHEAD_LIMIT = 1_000_000_000  # ns that an altitude may be ahead of the IMU
UNKNOWN_ACCEL_STD = 2.0  # m/s^2, spread of the acceleration while the force is unknown


@compiled
def initialise(m):
    """Start blind: no down direction, priors on the biases."""
    m[:ARRAY_SIZE] = 0.0
    n = N if m[P_MODEL] == 0.0 else N5
    for i in range(3):
        m[P + (n + 1) * i] = 1.0 / 3.0
    m[P + (n + 1) * VD] = VD_STD**2
    m[P + (n + 1) * ALT] = ALT_START_STD**2
    if n == N:
        for i in range(3):
            m[P + (N + 1) * (BG + i)] = m[P_GYRO_BIAS_STD] ** 2
            m[P + (N + 1) * (BA + i)] = m[P_ACCEL_BIAS_STD] ** 2


@compiled
def restart(m, gap):
    """Start blind after a gap (m), but keep what is known of the biases."""
    kept = m[X + BG:X + N].copy()
    block = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            block[i, j] = m[P + N * (BG + i) + BG + j]
    model = m[P_MODEL]
    initialise(m)
    if model == 0.0:
        for i in range(6):
            m[X + BG + i] = kept[i]
            for j in range(6):
                m[P + N * (BG + i) + BG + j] = block[i, j]
        for i in range(3):
            k = P + (N + 1) * (BG + i)
            m[k] = min(m[k] + gap * m[P_GYRO_BIAS_WALK] ** 2, max(m[k], m[P_GYRO_BIAS_STD] ** 2))


# --- the default filter -----------------------------------------------------------------------------


@compiled
def _carry_covariance(m, r, jv, jh, c, dt, decay):
    """Replace P by F P F^T; r is R^T by rows, c the propagated down direction.

    F changes the first five states only, but for the decay of the accelerometer bias: first F's rows
    times P, in place, column by column, then that times F^T, row by row, and its mirror image.
    """
    for j in range(P, P + N):
        c0, c1, c2, v = m[j], m[j + N], m[j + 2 * N], m[j + VD * N]
        b0, b1, b2 = dt * m[j + BG * N], dt * m[j + (BG + 1) * N], dt * m[j + (BG + 2) * N]
        m[j + ALT * N] -= dt * v + jh[0] * c0 + jh[1] * c1 + jh[2] * c2
        m[j + VD * N] = (v + jv[0] * c0 + jv[1] * c1 + jv[2] * c2 - dt * (
            c[0] * m[j + BA * N] + c[1] * m[j + (BA + 1) * N] + c[2] * m[j + (BA + 2) * N]))
        m[j] = r[0] * c0 + r[1] * c1 + r[2] * c2 + c[2] * b1 - c[1] * b2
        m[j + N] = r[3] * c0 + r[4] * c1 + r[5] * c2 + c[0] * b2 - c[2] * b0
        m[j + 2 * N] = r[6] * c0 + r[7] * c1 + r[8] * c2 + c[1] * b0 - c[0] * b1
    for i in range(P, P + N * BG, N):
        c0, c1, c2, v = m[i], m[i + 1], m[i + 2], m[i + VD]
        b0, b1, b2 = dt * m[i + BG], dt * m[i + BG + 1], dt * m[i + BG + 2]
        m[i + ALT] -= dt * v + jh[0] * c0 + jh[1] * c1 + jh[2] * c2
        m[i + VD] = (v + jv[0] * c0 + jv[1] * c1 + jv[2] * c2
                     - dt * (c[0] * m[i + BA] + c[1] * m[i + BA + 1] + c[2] * m[i + BA + 2]))
        m[i] = r[0] * c0 + r[1] * c1 + r[2] * c2 + c[2] * b1 - c[1] * b2
        m[i + 1] = r[3] * c0 + r[4] * c1 + r[5] * c2 + c[0] * b2 - c[2] * b0
        m[i + 2] = r[6] * c0 + r[7] * c1 + r[8] * c2 + c[1] * b0 - c[0] * b1
    for i in range(BA, N):
        for j in range(N):
            m[P + N * j + i] *= decay
        for j in range(BG, N):
            m[P + N * i + j] *= decay
    for i in range(BG):
        for j in range(i + 1, N):
            m[P + N * j + i] = m[P + N * i + j]


@compiled
def _motion(dt, wx, wy, wz, fx, fy, fz):
    """Return R^T by rows, J1 f and J2 f for constant rate and force over dt (attitude.md, 1)."""
    rate2 = wx * wx + wy * wy + wz * wz
    k0, k1, k2, k3 = zoh_coefficients(math.sqrt(rate2) * dt)
    half = 0.5 * dt * dt
    k0 *= dt
    k1 *= dt * dt
    k2 *= dt * dt * dt
    k3 *= dt * dt * dt * dt
    r = (1.0 + k1 * (wx * wx - rate2), k0 * wz + k1 * wx * wy, -k0 * wy + k1 * wx * wz,
         -k0 * wz + k1 * wx * wy, 1.0 + k1 * (wy * wy - rate2), k0 * wx + k1 * wy * wz,
         k0 * wy + k1 * wx * wz, -k0 * wx + k1 * wy * wz, 1.0 + k1 * (wz * wz - rate2))
    ux, uy, uz = wy * fz - wz * fy, wz * fx - wx * fz, wx * fy - wy * fx
    qx, qy, qz = wy * uz - wz * uy, wz * ux - wx * uz, wx * uy - wy * ux
    jv = (dt * fx + k1 * ux + k2 * qx, dt * fy + k1 * uy + k2 * qy, dt * fz + k1 * uz + k2 * qz)
    jh = (half * fx + k2 * ux + k3 * qx, half * fy + k2 * uy + k3 * qy, half * fz + k2 * uz + k3 * qz)
    return r, jv, jh


@compiled
def _carry_mean(m, dt, g, r, jv, jh):
    """Carry down direction, velocity and altitude; return the new down direction."""
    c0, c1, c2 = m[X], m[X + 1], m[X + 2]
    m[X + ALT] -= dt * m[X + VD] + jh[0] * c0 + jh[1] * c1 + jh[2] * c2 + 0.5 * dt * dt * g
    m[X + VD] += jv[0] * c0 + jv[1] * c1 + jv[2] * c2 + dt * g
    m[X] = r[0] * c0 + r[1] * c1 + r[2] * c2
    m[X + 1] = r[3] * c0 + r[4] * c1 + r[5] * c2
    m[X + 2] = r[6] * c0 + r[7] * c1 + r[8] * c2
    return m[X], m[X + 1], m[X + 2]


@compiled
def row_predict(m, dt, wx, wy, wz, fx, fy, fz, gyro_var, accel_var):
    """Carry the default filter over dt (s) of constant rate and force, biases not yet removed.

    gyro_var (rad^2) and accel_var (m^2/s^2) are variances that this interval adds to the angles and to
    the velocity because part of the sample is lost, held or clipped.
    """
    down_rate = m[P_EARTH_RATE_DOWN]
    wx -= m[X + BG] + down_rate * m[X]
    wy -= m[X + BG + 1] + down_rate * m[X + 1]
    wz -= m[X + BG + 2] + down_rate * m[X + 2]
    fx -= m[X + BA]
    fy -= m[X + BA + 1]
    fz -= m[X + BA + 2]
    g = m[P_GRAVITY]
    r, jv, jh = _motion(dt, wx, wy, wz, fx, fy, fz)
    c = _carry_mean(m, dt, g, r, jv, jh)
    decay = max(1.0 - dt / m[P_ACCEL_BIAS_TIME], 0.0)
    for i in range(3):
        m[X + BA + i] *= decay
    _carry_covariance(m, r, jv, jh, c, dt, decay)
    rate2 = wx * wx + wy * wy + wz * wz
    accel2 = (fx + g * c[0]) ** 2 + (fy + g * c[1]) ** 2 + (fz + g * c[2]) ** 2
    q_angle = dt * (m[P_GYRO_NOISE] ** 2 + m[P_GYRO_RATE_ERROR] ** 2 * rate2) + gyro_var
    q_vd = dt * (m[P_ACCEL_NOISE] ** 2 + m[P_ACCEL_FORCE_ERROR] ** 2 * accel2) + accel_var
    q_vd += dt * dt * m[P_VIBRATION_SHARE] * m[ACCEL_VIBRATION]
    _add_multiplicative_noise(m, N, c, q_angle, q_vd)
    m[P + (N + 1) * ALT] += dt * (m[P_ALT_DRIFT] ** 2 + (m[P_ALT_SCALE_ERROR] * m[X + VD]) ** 2)
    for i in range(3):
        m[P + (N + 1) * (BG + i)] += dt * m[P_GYRO_BIAS_WALK] ** 2
        m[P + (N + 1) * (BA + i)] += 2.0 * dt / m[P_ACCEL_BIAS_TIME] * m[P_ACCEL_BIAS_STD] ** 2
    return r, c


@compiled
def _add_multiplicative_noise(m, n, c, q_angle, q_vd):
    """Add the covariance of G(x) w: with M = c c^T + Pcc, q (tr M I - M) on c and q tr M on vd."""
    trace = (m[P] + m[P + n + 1] + m[P + 2 * (n + 1)] + c[0] * c[0] + c[1] * c[1] + c[2] * c[2])
    for i in range(3):
        for j in range(3):
            m[P + n * i + j] -= q_angle * (c[i] * c[j] + m[P + n * i + j])
        m[P + (n + 1) * i] += q_angle * trace
    m[P + (n + 1) * VD] += q_vd * trace


@compiled
def _rotate(m, at, stride, r, keep):
    """Replace the vector whose components lie `stride` apart by keep R^T times it."""
    v0, v1, v2 = keep * m[at], keep * m[at + stride], keep * m[at + 2 * stride]
    m[at] = r[0] * v0 + r[1] * v1 + r[2] * v2
    m[at + stride] = r[3] * v0 + r[4] * v1 + r[5] * v2
    m[at + 2 * stride] = r[6] * v0 + r[7] * v1 + r[8] * v2


@compiled
def _carry_gravity(m, dt, r, c, fx, fy, fz, force_known):
    """Low-pass the raw force in the frame that the gyro carries, with its exact sensitivities."""
    gain = max(dt / (m[P_GRAVITY_TIME] + dt), min(1.0, dt / m[ELAPSED])) if force_known else 0.0
    keep = 1.0 - gain
    _rotate(m, GRAVITY, 1, r, keep)
    _rotate(m, LASTING, 1, r, 1.0)
    for j in range(3):
        _rotate(m, GRAVITY_BG + j, 3, r, keep)
        _rotate(m, GRAVITY_BA + j, 3, r, keep)
        m[GRAVITY_BA + 4 * j] += gain
    if m[ATTITUDE] == 0.0 and keep > 0.0:
        # Before there is a down direction, gravity's low-pass stands for it.
        g = -keep * m[P_GRAVITY]
        c = (m[GRAVITY] / g, m[GRAVITY + 1] / g, m[GRAVITY + 2] / g)
    k = keep * dt
    m[GRAVITY_BG + 1] -= k * c[2]
    m[GRAVITY_BG + 2] += k * c[1]
    m[GRAVITY_BG + 3] += k * c[2]
    m[GRAVITY_BG + 5] -= k * c[0]
    m[GRAVITY_BG + 6] -= k * c[1]
    m[GRAVITY_BG + 7] += k * c[0]
    m[GRAVITY] += gain * fx
    m[GRAVITY + 1] += gain * fy
    m[GRAVITY + 2] += gain * fz


@compiled
def _row_update(m, variance, innovation, share):
    """Scalar Kalman update by the covariances in PH; the accelerometer bias takes `share` of its gain.

    (Schmidt's partial update, so the covariance stays that of the gain that is used.)
    """
    inv = 1.0 / variance
    gain = innovation * inv
    for j in range(3):
        d = m[P_GRAVITY] * gain * m[PH + BG + j]
        for i in range(3):
            m[GRAVITY + i] += m[GRAVITY_BG + 3 * i + j] * d
    for i in range(BA):
        m[X + i] += gain * m[PH + i]
        k = inv * m[PH + i]
        for j in range(N):
            m[P + N * i + j] -= k * m[PH + j]
    both = 1.0 - (1.0 - share) ** 2
    for i in range(BA, N):
        m[X + i] += share * gain * m[PH + i]
        k = inv * m[PH + i]
        for j in range(BA):
            m[P + N * i + j] -= k * m[PH + j]
        for j in range(BA, N):
            m[P + N * i + j] -= both * k * m[PH + j]


@compiled
def _project_rows(m, n, u, inv):
    """Replace the first three rows of P by (I - u u^T) inv times them."""
    for j in range(n):
        c0, c1, c2 = m[P + j], m[P + n + j], m[P + 2 * n + j]
        along = u[0] * c0 + u[1] * c1 + u[2] * c2
        m[P + j] = inv * (c0 - u[0] * along)
        m[P + n + j] = inv * (c1 - u[1] * along)
        m[P + 2 * n + j] = inv * (c2 - u[2] * along)


@compiled
def _normalise(m, n):
    """Once the direction is known, bring it to unit length and P to its tangent plane."""
    trace = m[P] + m[P + n + 1] + m[P + 2 * (n + 1)]
    norm = math.sqrt(m[X] ** 2 + m[X + 1] ** 2 + m[X + 2] ** 2)
    if trace >= ATTITUDE_TRACE or norm <= ATTITUDE_NORM:
        if trace >= LOST_TRACE:
            m[ATTITUDE] = 0.0
        return
    u = (m[X] / norm, m[X + 1] / norm, m[X + 2] / norm)
    _project_rows(m, n, u, 1.0 / norm)
    for i in range(n):
        c0, c1, c2 = m[P + n * i], m[P + n * i + 1], m[P + n * i + 2]
        along = u[0] * c0 + u[1] * c1 + u[2] * c2
        m[P + n * i] = (c0 - u[0] * along) / norm
        m[P + n * i + 1] = (c1 - u[1] * along) / norm
        m[P + n * i + 2] = (c2 - u[2] * along) / norm
    for i in range(n):
        for j in range(i):
            mean = 0.5 * (m[P + n * i + j] + m[P + n * j + i])
            m[P + n * i + j] = mean
            m[P + n * j + i] = mean
    m[X], m[X + 1], m[X + 2] = u
    _level_north(m)


@compiled
def _level_north(m):
    """Keep the yaw's zero level; where an attitude is first known the nose points east (REP-103)."""
    if m[ATTITUDE] == 0.0:
        m[ATTITUDE] = 1.0
        steep = abs(m[X]) > 0.99
        m[NORTH] = -m[X + 1] if steep else 0.0
        m[NORTH + 1] = m[X] if steep else -m[X + 2]
        m[NORTH + 2] = 0.0 if steep else m[X + 1]
    along = m[X] * m[NORTH] + m[X + 1] * m[NORTH + 1] + m[X + 2] * m[NORTH + 2]
    norm2 = 0.0
    for i in range(3):
        m[NORTH + i] -= along * m[X + i]
        norm2 += m[NORTH + i] ** 2
    for i in range(3):
        m[NORTH + i] /= math.sqrt(norm2)


@compiled
def _tilt_variance(m):
    """Squared error of the down direction, rad^2."""
    return m[P] + m[P + N + 1] + m[P + 2 * (N + 1)]


@compiled
def _expected_residual(m):
    """Squared gravity residual, (m/s^2)^2, that errors of tilt and accelerometer bias explain."""
    bias = 0.0
    for i in range(BA, N):
        bias += m[P + (N + 1) * i]
    return m[P_GRAVITY] ** 2 * _tilt_variance(m) + bias


@compiled
def _aided(m):
    """Whether there is an altimeter, so that something else than gravity shows a tilt that is off."""
    return m[ALT_COUNT] > 1.0 and m[SINCE_ALT] < ALTITUDE_AIDS


@compiled
def _gravity_variance(m, elapsed):
    """Variance of one gravity component: how much the low-passed force may be acceleration."""
    g, t = m[P_GRAVITY], m[ELAPSED]
    residual = lasting = moved = norm2 = 0.0
    gain = max(elapsed / (m[P_LASTING_TIME] + elapsed), min(1.0, elapsed / t))
    for i in range(3):
        y = m[GRAVITY + i] + g * m[X + i]
        for j in range(3):
            y -= m[GRAVITY_BA + 3 * i + j] * m[X + BA + j]
        residual += y * y
        m[LASTING + i] += gain * (y - m[LASTING + i])
        lasting += m[LASTING + i] ** 2
        moved += (m[ACCEL_LP + i] - m[REST_ACCEL_LP + i]) ** 2
        norm2 += m[GRAVITY + i] ** 2
    fall = max(elapsed / (m[P_GRAVITY_DECAY] + elapsed), min(1.0, 2.0 * elapsed / t))
    m[RESIDUAL] = max(residual, m[RESIDUAL] + fall * (residual - m[RESIDUAL]))
    m[FREE_FALL] = 1.0 if norm2 < (FREE_FALL_SHARE * g) ** 2 else 0.0
    expected = _expected_residual(m)
    if t > 3.0 * m[P_LASTING_TIME]:  # what the blind start left there is gone
        m[PULLING] = max(0.5 * (lasting - expected), m[PULLING] * (1.0 - elapsed / m[P_PULL_TIME]))
    if residual > 16.0 * (m[P_REST_ACCEL_STD] ** 2 + expected):
        m[REST] = 0.0  # a steady braking or climb is as quiet as rest
    if m[REST] >= REST_TIME:
        return (m[P_REST_ACCEL_STD] ** 2 + moved) * max(1.0, 1.0 / elapsed)
    variance = (m[P_GRAVITY_FLOOR] ** 2 + m[P_GRAVITY_SHARE] ** 2 * m[RESIDUAL]
                + m[P_START_STD] ** 2 / (1.0 + 4.0 * t * t))
    share = m[P_LASTING_SHARE] if _aided(m) else m[P_LASTING_ALONE]
    return (variance * max(1.0, m[P_CORRELATION] * min(m[P_GRAVITY_TIME], t) / elapsed)
            + share * max(lasting - expected, 0.0) * min(m[P_LASTING_TIME], t) / elapsed)


@compiled
def _consider_pull(m, elapsed, noise):
    """Carry the covariance of a lasting acceleration with the tilt that this gravity update pulls along.

    Schmidt's considered state: it takes no part in the estimate. Each update the tilt's error e takes its share
    of the acceleration's a/g: e+ = (1 - share) e + share a/g.
    """
    g = m[P_GRAVITY]
    tilt = 0.5 * g * g * _tilt_variance(m)
    share = tilt / (noise + tilt)
    keep = 1.0 - share
    pulling = 0.0 if _aided(m) or m[REST] >= REST_TIME else m[PULLING]
    m[PULLED] = keep * keep * m[PULLED] + 2.0 * keep * share * m[PULLED_COV] / g + (share / g) ** 2 * pulling
    m[PULLED_COV] = (keep * m[PULLED_COV] + share * pulling / g) * (1.0 - elapsed / m[P_PULL_TIME])


@compiled
def row_gravity_update(m, elapsed):
    """Three scalar updates with the low-passed force; `elapsed` s since the last ones."""
    g = m[P_GRAVITY]
    noise = _gravity_variance(m, elapsed)
    if m[FREE_FALL] == 1.0:
        return
    _consider_pull(m, elapsed, noise)
    for i in range(3):
        w, b = GRAVITY_BG + 3 * i, GRAVITY_BA + 3 * i
        y = m[GRAVITY + i] + g * m[X + i]
        for j in range(3):
            y -= m[b + j] * m[X + BA + j]
        for k in range(N):
            row = P + N * k
            m[PH + k] = -g * m[row + i]
            for j in range(3):
                m[PH + k] += m[b + j] * m[row + BA + j] - g * m[w + j] * m[row + BG + j]
        variance = noise - g * m[PH + i]
        for j in range(3):
            variance += m[b + j] * m[PH + BA + j] - g * m[w + j] * m[PH + BG + j]
        _row_update(m, variance, y, m[P_BIAS_SHARE])
    if m[REST] >= REST_TIME:
        _rest_update(m, elapsed)
    _normalise(m, N)


@compiled
def _rest_update(m, elapsed):
    """At rest the low-passed gyro is its bias; a component 4 sigma off is left out.

    What passes for rest may be a hand or a boat: rates that change, or a force that turns, are no bias.
    """
    time = min(m[REST], REST_MEMORY)
    turning = 0.0
    for i in range(3):
        turning += ((m[ACCEL_LP + i] - m[REST_ACCEL_LP + i]) / (m[P_GRAVITY] * time)) ** 2
        turning += (m[GYRO_LP + i] - m[REST_GYRO_LP + i]) ** 2
    noise = (m[P_REST_GYRO_STD] ** 2 + turning) * max(1.0, 1.0 / elapsed)
    for i in range(3):
        y = m[GYRO_LP + i] - m[X + BG + i] - m[P_EARTH_RATE_DOWN] * m[X + i]
        variance = m[P + (N + 1) * (BG + i)] + noise
        if y * y < 16.0 * variance:
            for k in range(N):
                m[PH + k] = m[P + N * k + BG + i]
            _row_update(m, variance, y, 1.0)


@compiled
def row_altitude_update(m, z, message_var, age):
    """One altitude z (m, up), valid `age` s before the state; message_var m^2 counts when > 0."""
    noise = message_var if message_var > 0.0 else m[P_ALT_STD] ** 2
    _learn_altimeter(m, z, noise)
    noise = max(noise, m[ALT_SPREAD]) + m[ALT_STEP] ** 2 / 12.0
    noise *= max(1.0, 0.1 / max(m[SINCE_ALT], 1e-3))
    noise += (m[P_ALT_DELAY_STD] * m[X + VD]) ** 2
    delay = m[P_ALT_DELAY] + age
    for k in range(N):
        m[PH + k] = m[P + N * k + ALT] + delay * m[P + N * k + VD]
    variance = m[PH + ALT] + delay * m[PH + VD] + noise
    y = z - m[X + ALT] - delay * m[X + VD]
    opened = _open_reference(m, y, variance)
    if opened < 0.0:
        return
    m[P + (N + 1) * ALT] += opened
    m[PH + ALT] += opened
    before = _tilt_variance(m)
    _row_update(m, variance + opened, y, 1.0)
    kept = _tilt_variance(m) / before
    m[PULLED_COV] *= kept
    m[PULLED] *= kept * kept
    _normalise(m, N)


@compiled
def _learn_altimeter(m, z, noise):
    """Learn the white noise from second differences and the resolution from the smallest step."""
    step = abs(z - m[ALT_LAST])
    if 0.0 < step < 2.0 and (m[ALT_STEP] == 0.0 or step < m[ALT_STEP]):
        m[ALT_STEP] = step
    if m[ALT_COUNT] >= 3.0:
        second = z - 2.0 * m[ALT_LAST] + m[ALT_BEFORE]
        capped = min(second * second / 6.0, 9.0 * max(m[ALT_SPREAD], noise))
        m[ALT_SPREAD] += max(0.02, 1.0 / m[ALT_COUNT]) * (capped - m[ALT_SPREAD])


@compiled
def _open_reference(m, y, variance):
    """Variance that the height reference gets for a jump, m^2; -1 when the altitude has to wait."""
    y2 = y * y
    if y2 <= m[P_ALT_GATE] * variance:
        m[ALT_REFUSED] = 0.0
        m[ALT_PERSISTENCE] += 0.3 * (y / math.sqrt(variance) - m[ALT_PERSISTENCE])
        if m[ALT_PERSISTENCE] ** 2 > m[P_ALT_STEP_GATE] * 0.3 / 1.7:
            m[ALT_PERSISTENCE] = 0.0
            return y2
        return 0.0
    m[ALT_REFUSED] += 1.0
    if m[ALT_REFUSED] < 3.0:
        return -1.0
    m[ALT_REFUSED] = 0.0
    return y2 * y2 / (m[P_ALT_GATE] * variance)


# --- the paper's filter -----------------------------------------------------------------------------


@compiled
def _transition5(m, r, jv, jh, dt):
    """Replace the covariance by F times it."""
    for j in range(P, P + N5):
        c0, c1, c2, v = m[j], m[j + N5], m[j + 2 * N5], m[j + VD * N5]
        m[j] = r[0] * c0 + r[1] * c1 + r[2] * c2
        m[j + N5] = r[3] * c0 + r[4] * c1 + r[5] * c2
        m[j + 2 * N5] = r[6] * c0 + r[7] * c1 + r[8] * c2
        m[j + VD * N5] = v + jv[0] * c0 + jv[1] * c1 + jv[2] * c2
        m[j + ALT * N5] -= dt * v + jh[0] * c0 + jh[1] * c1 + jh[2] * c2


@compiled
def row5_predict(m, dt, wx, wy, wz, fx, fy, fz, gyro_var, accel_var):
    """Carry the paper's filter over dt (s) of constant rate and force (equations 26 to 31)."""
    down_rate = m[P_EARTH_RATE_DOWN]
    wx -= down_rate * m[X]
    wy -= down_rate * m[X + 1]
    wz -= down_rate * m[X + 2]
    r, jv, jh = _motion(dt, wx, wy, wz, fx, fy, fz)
    c = _carry_mean(m, dt, m[P_GRAVITY], r, jv, jh)
    for _ in range(2):
        _transition5(m, r, jv, jh, dt)
        for i in range(N5):
            for j in range(i):
                a, b = P + N5 * i + j, P + N5 * j + i
                m[a], m[b] = m[b], m[a]
    _add_multiplicative_noise(m, N5, c, dt * m[P_GYRO_NOISE] ** 2 + gyro_var,
                              dt * m[P_ACCEL_NOISE] ** 2 + accel_var)
    return r, c


@compiled
def row5_altitude_update(m, z, message_var, age):
    """One altitude z (m, up), valid `age` s before the state; message_var m^2 counts when > 0."""
    delay = m[P_ALT_DELAY] + age
    ph = np.empty(N5)
    for k in range(N5):
        ph[k] = m[P + N5 * k + ALT] + delay * m[P + N5 * k + VD]
    noise = message_var if message_var > 0.0 else m[P_ALT_STD] ** 2
    inv = 1.0 / (ph[ALT] + delay * ph[VD] + noise)
    y = z - m[X + ALT] - delay * m[X + VD]
    for i in range(N5):
        k = inv * ph[i]
        m[X + i] += k * y
        for j in range(N5):
            m[P + N5 * i + j] -= k * ph[j]
    _normalise(m, N5)


# --- a sample, whatever the model -------------------------------------------------------------------


@compiled
def _track(m, dt, wx, wy, wz, fx, fy, fz):
    """Follow the sample's low-pass and spread, and how long the body has been at rest."""
    gain = max(dt / (LOWPASS_TIME + dt), min(1.0, dt / m[ELAPSED]))
    w = (wx, wy, wz)
    f = (fx, fy, fz)
    dw2 = df2 = step2 = 0.0
    turning = False
    for i in range(3):
        step2 += (f[i] - m[ACCEL + i]) ** 2
        m[GYRO + i] = w[i]
        m[ACCEL + i] = f[i]
        m[GYRO_LP + i] += gain * (w[i] - m[GYRO_LP + i])
        m[ACCEL_LP + i] += gain * (f[i] - m[ACCEL_LP + i])
        dw2 += (w[i] - m[GYRO_LP + i]) ** 2
        df2 += (f[i] - m[ACCEL_LP + i]) ** 2
        if m[P_MODEL] == 0.0:
            bias = m[GYRO_LP + i] - m[X + BG + i] - m[P_EARTH_RATE_DOWN] * m[X + i]
            turning |= bias * bias > REST_BIAS * m[P + (N + 1) * (BG + i)] + 16.0 * m[P_REST_GYRO_STD] ** 2
    m[GYRO_SPREAD] += gain * (dw2 - m[GYRO_SPREAD])
    m[ACCEL_SPREAD] += gain * (df2 - m[ACCEL_SPREAD])
    m[ACCEL_VIBRATION] += gain * (step2 / 6.0 - m[ACCEL_VIBRATION])
    norm = math.sqrt(fx * fx + fy * fy + fz * fz)
    still = (dw2 < REST_GYRO**2 and df2 < REST_ACCEL**2 and not turning
             and abs(norm - m[P_GRAVITY]) < 0.3 + 3.0 * m[P_ACCEL_BIAS_STD])
    gain = dt / (min(m[REST], REST_MEMORY) + dt)
    for i in range(3):
        m[REST_GYRO_LP + i] += gain * (m[GYRO_LP + i] - m[REST_GYRO_LP + i])
        m[REST_ACCEL_LP + i] += gain * (m[ACCEL_LP + i] - m[REST_ACCEL_LP + i])
    m[REST] = m[REST] + dt if still else 0.0


@compiled
def imu_step(m, dt, wx, wy, wz, fx, fy, fz, gyro_var, accel_var, force_known):
    """One checked sample: the mean over the dt (s) before its stamp; rad/s and m/s^2, FRD."""
    m[ELAPSED] += dt
    m[SINCE_ALT] += dt
    m[SINCE_GRAVITY] += dt
    usual = m[INTERVAL] if m[INTERVAL] > 0.0 else dt
    lost = max(dt - 1.5 * usual, 0.0) * (dt - usual)
    m[INTERVAL] = usual + 0.02 * (min(dt, 2.0 * usual) - usual)
    if force_known:
        _track(m, dt, wx, wy, wz, fx, fy, fz)
    gyro_var += lost * m[GYRO_SPREAD] / 3.0
    accel_var += lost * m[ACCEL_SPREAD]
    if m[P_MODEL] == 0.0:
        r, c = row_predict(m, dt, wx, wy, wz, fx, fy, fz, gyro_var, accel_var)
        _carry_gravity(m, dt, r, c, fx, fy, fz, force_known)
        if force_known and m[SINCE_GRAVITY] >= GRAVITY_PERIOD - 0.25 * dt:
            row_gravity_update(m, m[SINCE_GRAVITY])
            m[SINCE_GRAVITY] = 0.0
    else:
        r, c = row5_predict(m, dt, wx, wy, wz, fx, fy, fz, gyro_var, accel_var)
    _rotate(m, NORTH, 1, r, 1.0)
    _grow_yaw(m, dt)
    if m[P + (N + 1) * VD if m[P_MODEL] == 0.0 else P + (N5 + 1) * VD] > VD_LOST_STD**2:
        _forget_vertical(m)


@compiled
def _grow_yaw(m, dt):
    """Nothing measures the yaw: its spread grows with the bias about the vertical and the noise."""
    bias_var = 0.0
    if m[P_MODEL] == 0.0:
        for i in range(3):
            for j in range(3):
                bias_var += m[X + i] * m[X + j] * m[P + N * (BG + i) + BG + j]
    m[YAW_STD] += dt * math.sqrt(max(bias_var, 0.0))
    m[YAW_VAR] += dt * m[P_GYRO_NOISE] ** 2


@compiled
def _forget_vertical(m):
    """Without an altimeter the vertical channel drifts away: start it anew, uncorrelated."""
    n = N if m[P_MODEL] == 0.0 else N5
    for k in range(n):
        for i in range(VD, ALT + 1):
            m[P + n * k + i] = 0.0
            m[P + n * i + k] = 0.0
    m[X + VD] = 0.0
    m[P + (n + 1) * VD] = VD_STD**2
    m[P + (n + 1) * ALT] = ALT_START_STD**2
    m[ALT_COUNT] = 0.0


@compiled
def altitude_step(m, z, message_var, age):
    """One finite altitude; the first one is the height to start from."""
    n = N if m[P_MODEL] == 0.0 else N5
    m[ALT_COUNT] += 1.0
    if m[ALT_COUNT] == 1.0:
        for k in range(n):
            m[P + n * k + ALT] = 0.0
            m[P + n * ALT + k] = 0.0
        m[P + (n + 1) * ALT] = ALT_START_STD**2
        m[X + ALT] = z
    elif n == N:
        row_altitude_update(m, z, message_var, age)
    else:
        row5_altitude_update(m, z, message_var, age)
    m[ALT_BEFORE] = m[ALT_LAST]
    m[ALT_LAST] = z
    m[SINCE_ALT] = 0.0


@compiled
def write_output(m, out):
    """Fill one row of output from the state."""
    n = N if m[P_MODEL] == 0.0 else N5
    out[OUT_VALID] = m[ATTITUDE]
    d0, d1, d2 = m[X], m[X + 1], m[X + 2]
    norm = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    out[OUT_NORM] = norm
    inv = 1.0 / norm if norm > 0.0 else 0.0
    d = (d0 * inv, d1 * inv, d2 * inv)
    a = (m[NORTH], m[NORTH + 1], m[NORTH + 2])
    along = a[0] * d[0] + a[1] * d[1] + a[2] * d[2]
    a = (a[0] - along * d[0], a[1] - along * d[1], a[2] - along * d[2])
    norm = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    inv = 1.0 / norm if norm > 0.0 else 0.0
    a = (a[0] * inv, a[1] * inv, a[2] * inv)
    e = (d[1] * a[2] - d[2] * a[1], d[2] * a[0] - d[0] * a[2], d[0] * a[1] - d[1] * a[0])
    _write_quaternion(out, a, e, d)
    nn = ne = ee = 0.0
    for i in range(3):
        for j in range(3):
            cov = m[P + n * i + j]
            nn += e[i] * cov * e[j]
            ne -= a[i] * cov * e[j]
            ee += a[i] * cov * a[j]
        out[OUT_DOWN + i] = d[i]
    out[OUT_TILT_COV] = nn + m[PULLED]
    out[OUT_TILT_COV + 1] = ne
    out[OUT_TILT_COV + 2] = ee + m[PULLED]
    out[OUT_YAW_VAR] = m[YAW_STD] ** 2 + m[YAW_VAR]
    out[OUT_VD] = m[X + VD]
    out[OUT_ALT] = m[X + ALT]
    out[OUT_VD_VAR] = m[P + (n + 1) * VD]
    out[OUT_ALT_VAR] = m[P + (n + 1) * ALT]
    for i in range(3):
        bg = m[X + BG + i] if n == N else 0.0
        ba = m[X + BA + i] if n == N else 0.0
        out[OUT_BG + i] = bg
        out[OUT_BA + i] = ba
        out[OUT_BG_VAR + i] = m[P + (N + 1) * (BG + i)] if n == N else 0.0
        out[OUT_BA_VAR + i] = m[P + (N + 1) * (BA + i)] if n == N else 0.0
        out[OUT_GYRO + i] = m[GYRO + i] - bg
        out[OUT_ACCEL + i] = m[ACCEL + i] - ba


@compiled
def _write_quaternion(out, a, e, d):
    """Quaternion (w first) of the matrix with rows a, e, d, by the largest component (Shepperd)."""
    trace = a[0] + e[1] + d[2]
    if trace >= a[0] and trace >= e[1] and trace >= d[2]:
        w, x, y, z = 1.0 + trace, d[1] - e[2], a[2] - d[0], e[0] - a[1]
    elif a[0] >= e[1] and a[0] >= d[2]:
        w, x, y, z = d[1] - e[2], 1.0 + 2.0 * a[0] - trace, e[0] + a[1], a[2] + d[0]
    elif e[1] >= d[2]:
        w, x, y, z = a[2] - d[0], e[0] + a[1], 1.0 + 2.0 * e[1] - trace, d[1] + e[2]
    else:
        w, x, y, z = e[0] - a[1], a[2] + d[0], d[1] + e[2], 1.0 + 2.0 * d[2] - trace
    inv = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        inv = -inv
    out[OUT_Q] = inv * w
    out[OUT_Q + 1] = inv * x
    out[OUT_Q + 2] = inv * y
    out[OUT_Q + 3] = inv * z


# --- checks and the time buffer ---------------------------------------------------------------------


@compiled
def _integers(m):
    return m[M_INTS:M_ALTITUDES].view(np.int64)


@compiled
def reset(m):
    """Forget everything but the counters."""
    initialise(m)
    m[M_OUT:M_INTS] = 0.0
    _forget_history(_integers(m))


@compiled
def declare_attitude(m):
    """Take the down direction in the state as an attitude."""
    _level_north(m)


@compiled
def _forget_history(ints):
    ints[:I_COUNTS] = 0
    ints[I_HEAD] = -1  # so that the first sample has a snapshot


@compiled
def _largest(ints, not_finite, out_of_range, limit, x, y, z):
    """Return the largest component of one vector of a sample, or -1 and count what is wrong with it."""
    largest = max(abs(x), abs(y), abs(z))
    if not abs(x + y + z) < math.inf:
        ints[I_COUNTS + not_finite] += 1
        return -1.0
    if largest > (2.0 - CLIP_SHARE) * limit:
        ints[I_COUNTS + out_of_range] += 1
        return -1.0
    return largest


@compiled
def _angle_missed(m):
    """Spread (rad) of the angle beyond the gyro's limit: a short peak hardly passes it, a long one is unknown."""
    return m[P_GYRO_RANGE] * m[CLIPPED] ** 2 / (CLIP_TIME + m[CLIPPED])


@compiled
def _suspicion(m, ints, dt, wx, wy, wz, fx, fy, fz, largest_rate, largest_force):
    """Variances (rad^2, m^2/s^2) that a stuck or clipped sample adds."""
    same = (wx == m[GYRO] and wy == m[GYRO + 1] and wz == m[GYRO + 2]
            and fx == m[ACCEL] and fy == m[ACCEL + 1] and fz == m[ACCEL + 2])
    m[STUCK] = m[STUCK] + dt if same else 0.0
    gyro_var = accel_var = 0.0
    if m[STUCK] > STUCK_TIME:
        ints[I_COUNTS + F_STUCK] += 1
        gyro_var += dt * STUCK_GYRO_DENSITY**2
        accel_var += dt * STUCK_ACCEL_DENSITY**2
    gyro_clipped = largest_rate > CLIP_SHARE * m[P_GYRO_RANGE]
    accel_clipped = largest_force > CLIP_SHARE * m[P_ACCEL_RANGE]
    if gyro_clipped or accel_clipped:
        ints[I_COUNTS + F_CLIPPED] += 1
    if accel_clipped:
        accel_var += (dt * CLIP_ERROR * m[P_ACCEL_RANGE]) ** 2
    if gyro_clipped:
        gyro_var -= _angle_missed(m) ** 2
        m[CLIPPED] += dt
        gyro_var += _angle_missed(m) ** 2
    else:
        m[CLIPPED] = 0.0
    return gyro_var, accel_var


@compiled
def _remember(m, ints, stamp, dt, wx, wy, wz, fx, fy, fz, gyro_var, accel_var, known):
    """Write a sample into the next row of history."""
    head = (ints[I_HEAD] + 1) % HISTORY
    ints[I_HEAD] = head
    ints[I_STORED] = min(ints[I_STORED] + 1, HISTORY)
    ints[I_STAMPS + head] = stamp
    ints[I_LAST_STAMP] = stamp
    row = M_HISTORY + head * H_SIZE
    m[row + H_DT] = dt
    m[row + H_SAMPLE], m[row + H_SAMPLE + 1], m[row + H_SAMPLE + 2] = wx, wy, wz
    m[row + H_SAMPLE + 3], m[row + H_SAMPLE + 4], m[row + H_SAMPLE + 5] = fx, fy, fz
    m[row + H_GYRO_VAR] = gyro_var
    m[row + H_ACCEL_VAR] = accel_var
    m[row + H_KNOWN] = 1.0 if known else 0.0


@compiled
def _keep_state(m, head):
    """Keep the state after the remembered sample with this index, if it is one of those to keep."""
    if head % SNAPSHOTS == 0:
        snapshot = M_SNAPSHOTS + head // SNAPSHOTS * STATE_SIZE
        for k in range(STATE_SIZE):
            m[snapshot + k] = m[k]


@compiled
def _start(m, ints, stamp, wx, wy, wz, fx, fy, fz):
    """Set the clock by the first good sample; altitudes back to one buffer before it count."""
    for first in (GYRO, GYRO_LP):
        m[first], m[first + 1], m[first + 2] = wx, wy, wz
    for first in (ACCEL, ACCEL_LP):
        m[first], m[first + 1], m[first + 2] = fx, fy, fz
    before = stamp - np.int64(m[P_ALT_BUFFER] * 1e9) - 1
    _remember(m, ints, before, 0.0, wx, wy, wz, fx, fy, fz, 0.0, 0.0, True)
    _keep_state(m, ints[I_HEAD])
    ints[I_LAST_STAMP] = stamp


@compiled
def _take_imu(m, ints, stamp, wx, wy, wz, fx, fy, fz):
    """Check a sample whose stamp (ns) is later than the last one, and step over it.

    Altitudes that waited for it are applied. Returns whether there is new output.
    """
    rate = _largest(ints, F_GYRO_NOT_FINITE, F_GYRO_OUT_OF_RANGE, m[P_GYRO_RANGE], wx, wy, wz)
    force = _largest(ints, F_ACCEL_NOT_FINITE, F_ACCEL_OUT_OF_RANGE, m[P_ACCEL_RANGE], fx, fy, fz)
    if force == 0.0:
        ints[I_COUNTS + F_ACCEL_ZERO] += 1  # no sensor in free fall reads three zeros
    gyro_ok, force_ok = rate >= 0.0, force > 0.0
    dt = (stamp - ints[I_LAST_STAMP]) * 1e-9
    if ints[I_STORED] > 0 and dt > m[P_GAP_LIMIT]:
        ints[I_COUNTS + F_RESTARTED] += 1
        restart(m, dt)
        _forget_history(ints)
    if ints[I_STORED] == 0:
        if not (gyro_ok and force_ok):
            return False
        _start(m, ints, stamp, wx, wy, wz, fx, fy, fz)
        dt = 0.0
    gyro_var = accel_var = 0.0
    if gyro_ok:
        m[HELD] = 0.0
    else:
        if m[HELD] + dt > max(HOLD_TIME, 1.5 * m[INTERVAL]):
            return False
        m[HELD] += dt
        wx, wy, wz = m[GYRO], m[GYRO + 1], m[GYRO + 2]
        gyro_var = dt * dt * m[GYRO_SPREAD] / 3.0
    if not force_ok:
        g = m[P_GRAVITY]
        fx, fy, fz = -g * m[X], -g * m[X + 1], -g * m[X + 2]
        accel_var = dt * dt * (m[ACCEL_SPREAD] + UNKNOWN_ACCEL_STD**2)
    known = gyro_ok and force_ok
    if known:
        gyro_var, accel_var = _suspicion(m, ints, dt, wx, wy, wz, fx, fy, fz, rate, force)
        known = force <= CLIP_SHARE * m[P_ACCEL_RANGE]
    _remember(m, ints, stamp, dt, wx, wy, wz, fx, fy, fz, gyro_var, accel_var, known)
    _advance(m, ints, ints[I_HEAD])
    return True


@compiled
def _advance(m, ints, head):
    """Step over a remembered sample, apply the altitudes up to its stamp, keep the state."""
    row = M_HISTORY + head * H_SIZE
    if m[row + H_DT] > 0.0:
        imu_step(m, m[row + H_DT], m[row + H_SAMPLE], m[row + H_SAMPLE + 1], m[row + H_SAMPLE + 2],
                 m[row + H_SAMPLE + 3], m[row + H_SAMPLE + 4], m[row + H_SAMPLE + 5],
                 m[row + H_GYRO_VAR], m[row + H_ACCEL_VAR], m[row + H_KNOWN] == 1.0)
    _apply_altitudes(m, ints, ints[I_STAMPS + head])
    _keep_state(m, head)


@compiled
def _apply_altitudes(m, ints, stamp):
    """Apply the remembered altitudes that are due at the stamp of the state."""
    while ints[I_NEXT] < ints[I_ALTITUDES] and ints[I_ALT_STAMPS + ints[I_NEXT]] <= stamp:
        age = (stamp - ints[I_ALT_STAMPS + ints[I_NEXT]]) * 1e-9
        row = M_ALTITUDES + 2 * ints[I_NEXT]
        altitude_step(m, m[row], m[row + 1], age)
        ints[I_NEXT] += 1


@compiled
def _take_altitude(m, ints, stamp, z, message_var):
    """Put an altitude where it belongs in time; return whether it counts.

    One that is ahead of the IMU waits for it; a late one takes the filter back to its stamp and
    steps over the remembered samples again.
    """
    if not abs(z) < math.inf:
        ints[I_COUNTS + F_ALT_NOT_FINITE] += 1
        return False
    if ints[I_STORED] > 0 and stamp > ints[I_LAST_STAMP] + AHEAD_LIMIT:
        ints[I_COUNTS + F_ALT_AHEAD] += 1
        return False
    place = ints[I_ALTITUDES]
    while place > 0 and ints[I_ALT_STAMPS + place - 1] > stamp:
        place -= 1
    if place > 0 and ints[I_ALT_STAMPS + place - 1] == stamp:
        ints[I_COUNTS + F_ALT_DUPLICATE] += 1
        return False
    back = _samples_since(ints, stamp)
    newest = back == 1 and ints[I_STORED] > 1 and place == ints[I_NEXT] == ints[I_ALTITUDES]
    if back > 0 and not newest:
        back += (ints[I_HEAD] - back) % SNAPSHOTS
        if back >= ints[I_STORED] or ints[I_LAST_STAMP] - stamp > m[P_ALT_BUFFER] * 1e9:
            ints[I_COUNTS + F_ALT_LATE] += 1
            return False
    _insert_altitude(m, ints, place, stamp, z, message_var)
    if newest:
        # Since the sample before, and the last of all: what a rewind would come to.
        _apply_altitudes(m, ints, ints[I_LAST_STAMP])
        _keep_state(m, ints[I_HEAD])
    elif back > 0:
        _rewind(m, ints, back)
    return True


@compiled
def _samples_since(ints, stamp):
    """How many remembered samples are at or after the stamp."""
    back = 0
    while back < ints[I_STORED] and ints[I_STAMPS + (ints[I_HEAD] - back) % HISTORY] >= stamp:
        back += 1
    return back


@compiled
def _insert_altitude(m, ints, place, stamp, z, message_var):
    """Put an altitude among the remembered ones; a full memory loses its older half."""
    if ints[I_ALTITUDES] == ALTITUDES:
        half = ALTITUDES // 2
        for k in range(half, ALTITUDES):
            _move_altitude(m, ints, k, k - half)
        ints[I_ALTITUDES] -= half
        ints[I_NEXT] = max(ints[I_NEXT] - half, 0)
        place = max(place - half, 0)
    for k in range(ints[I_ALTITUDES], place, -1):
        _move_altitude(m, ints, k - 1, k)
    ints[I_ALT_STAMPS + place] = stamp
    m[M_ALTITUDES + 2 * place] = z
    m[M_ALTITUDES + 2 * place + 1] = message_var
    ints[I_ALTITUDES] += 1


@compiled
def _move_altitude(m, ints, source, target):
    ints[I_ALT_STAMPS + target] = ints[I_ALT_STAMPS + source]
    m[M_ALTITUDES + 2 * target] = m[M_ALTITUDES + 2 * source]
    m[M_ALTITUDES + 2 * target + 1] = m[M_ALTITUDES + 2 * source + 1]


@compiled
def _rewind(m, ints, back):
    """Go back before the last `back` samples and step over them again."""
    held, stuck, clipped = m[HELD], m[STUCK], m[CLIPPED]
    origin = (ints[I_HEAD] - back) % HISTORY
    snapshot = M_SNAPSHOTS + origin // SNAPSHOTS * STATE_SIZE
    for k in range(STATE_SIZE):
        m[k] = m[snapshot + k]
    ints[I_NEXT] = 0
    while ints[I_ALT_STAMPS + ints[I_NEXT]] <= ints[I_STAMPS + origin]:
        ints[I_NEXT] += 1
    for k in range(back - 1, -1, -1):
        _advance(m, ints, (ints[I_HEAD] - k) % HISTORY)
    m[HELD], m[STUCK], m[CLIPPED] = held, stuck, clipped


# --- from Python ------------------------------------------------------------------------------------


@compiled
def push_imu(m, stamp, gyro_b, accel_b):
    """Take one sample as it comes; the output row is in the memory where FRESH is returned."""
    ints = _integers(m)
    if len(gyro_b) != 3 or len(accel_b) != 3:
        return MISSHAPEN
    if ints[I_STORED] > 0 and stamp <= ints[I_LAST_STAMP]:
        return OLD
    if not _take_imu(m, ints, stamp, gyro_b[0], gyro_b[1], gyro_b[2], accel_b[0], accel_b[1], accel_b[2]):
        return STALE
    write_output(m, m[M_OUT:M_INTS])
    return FRESH


@compiled
def push_altitude(m, stamp, z, message_var):
    """Take one altitude (m, up) at its stamp (ns); return whether it counts."""
    return _take_altitude(m, _integers(m), stamp, z, message_var)


@compiled
def run(m, stamps, gyro_b, accel_b, actions, alt_stamps, alt_values, alt_vars, arrival, out, fresh):
    """Feed a recording in recorded order; rows of `out` are filled where `fresh` becomes True.

    Returns how many samples were taken before one whose stamp is not later than the last.
    """
    ints = _integers(m)
    j = 0
    for k in range(len(stamps)):
        while j < len(arrival) and arrival[j] <= k:
            _take_altitude(m, ints, alt_stamps[j], alt_values[j], alt_vars[j])
            j += 1
        fresh[k] = False
        if actions[k] == ACTION_SKIP:
            continue
        if actions[k] == ACTION_RESET:
            reset(m)
        if ints[I_STORED] > 0 and stamps[k] <= ints[I_LAST_STAMP]:
            return k
        fresh[k] = _take_imu(m, ints, stamps[k], gyro_b[k, 0], gyro_b[k, 1], gyro_b[k, 2],
                             accel_b[k, 0], accel_b[k, 1], accel_b[k, 2])
        if fresh[k]:
            write_output(m, out[k])
    while j < len(arrival):
        _take_altitude(m, ints, alt_stamps[j], alt_values[j], alt_vars[j])
        j += 1
    return len(stamps)
