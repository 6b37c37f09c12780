"""Compiled kernels of the navigation filters: closed forms, both filters, the start, the time buffer, a recording.

One flat float64 array holds state, parameters and history, as in :mod:`attitude_estimator._kernels`, so that a
snapshot is one copy; this file is the only place that knows positions in it. One entry, :func:`run`, takes
samples and measurements one by one and by the million. Attitude errors are small rotations
about the navigation axes, ``C_true = (I + [theta x]) C``; every error is true less estimated.
Equations: ``docs/navigation.md``. Frames and units: :mod:`inertial`.
"""

import math

import numpy as np
from numba import njit

from inertial._kernels import compiled, zoh_coefficients


def _offsets(*sizes):
    """Return the offset of each field and the total size."""
    ends = [0]
    for size in sizes:
        ends.append(ends[-1] + size)
    return ends


# Error states: attitude, gyro bias; velocity, position, accelerometer bias; the altimeter's zero. The cascade has the
# same with nothing between the first six and the others, and there BA is the acceleration's error in NED.
N = 16
TH, BG, V, POS, BA, REF = 0, 3, 6, 9, 12, 15
N_BLIND = 6  # north, east; their velocities; cosine and sine of the heading of the level frame
BV, BC = 2, 4
KINDS = ("fix", "velocity", "altitude", "inclinometer", "heading", "level")
N_KINDS = len(KINDS)
(K_FIX, K_VELOCITY, K_ALTITUDE, K_INCLINOMETER, K_HEADING, K_LEVEL, K_ORIGIN, K_RESET) = range(N_KINDS + 2)

(X_PHASE, X_Q, X_V, X_P, X_BG, X_BA, X_REF, X_COV, X_RATE, X_ACC,
 X_BLIND, X_BLIND_COV, X_BLIND_ON, X_DOWN_FIX, X_DOWN_VEL,
 X_INTERVAL, X_GYRO_LP, X_ACCEL_LP, X_GYRO_SPREAD, X_ACCEL_SPREAD,
 X_SINCE, X_NIS, X_USED, X_REFUSED, X_REFUSING,
 X_DRIFT, X_DVEL, X_DVEL_TIME, X_LAST_VELOCITY, X_LOST, X_SLOW,
 STATE_SIZE) = _offsets(
    1,  # PHASE: 0 levelling or looking for the heading, 1 navigating
    4, 3, 3, 3, 3, 1, N * N,  # q_nb_wxyz, velocity, position, biases, altimeter's zero, covariance
    3, 3,  # RATE of the body rad/s and ACC of the IMU m/s^2 NED, both of the last step
    N_BLIND, N_BLIND**2, 1,  # the heading's blind start; 1 once it has been aided
    3, 3,  # last down position and down velocity of the aids: value, variance, age s
    1, 3, 3, 1, 1,  # mean interval; low-passed sample; its squared distance from it
    6, 6, 6, 6, 6,  # of each kind: s since used, NIS over its mean, used, refused, s of refusing
    3, 3, 1, 4,  # cascade: acceleration error NED; velocity gained by force and in what time; last velocity, known
    1, 3)  # how often the heading was lost; variance of the fixes' slow error, which the position shares
PARAMETER_NAMES = (
    "cascade", "steady", "local_gravity", "gyro_noise_density", "gyro_rate_error", "accel_noise_density",
    "accel_force_error", "gyro_bias_walk", "accel_bias_std", "accel_bias_time", "altitude_drift_density",
    "altitude_scale_error", "innovation_gate", "recovery_time", "heading_start_std", "cascade_bias_std",
    "cascade_bias_time", "axis_frequency", "fix_interval", "antenna_x", "antenna_y", "antenna_z",
    "measurement_buffer", "gap_limit",
    "fix_slow_share", "fix_slow_time")

# One row of output.
(OUT_VALID, OUT_HEADING, OUT_NAVIGATING, OUT_Q, OUT_V, OUT_P, OUT_BG, OUT_BA, OUT_GYRO, OUT_ACCEL, OUT_COV,
 OUT_BG_VAR, OUT_BA_VAR, OUT_REF, OUT_SIZE) = _offsets(
    1, 1, 1, 4, 3, 3, 3, 3, 3, 3,
    81,  # covariance of attitude, velocity, position
    3, 3, 1)

# One sample as it is remembered: its interval, what the level estimator says with it, whether its force is known.
(L_DT, L_VALID, L_Q, L_TILT, L_VD, L_ALTITUDE, L_VD_VAR, L_ALTITUDE_VAR, L_BG, L_BA, L_BG_VAR, L_BA_VAR, L_GYRO,
 L_ACCEL, L_KNOWN, L_SIZE) = _offsets(1, 1, 4, 3, 1, 1, 1, 1, 3, 3, 3, 3, 3, 3, 1)
# One measurement: its kind, value and covariance. Of a reset and an origin the value is latitude, height, gravity.
(A_KIND, A_VALUE, A_COV, A_SIZE) = _offsets(1, 3, 9)

HISTORY = 1024  # samples that can be taken back
SNAPSHOTS = 16  # the state after every so many samples is kept
QUEUE = 1024  # measurements remembered, at least half of them
AHEAD_LIMIT = 1_000_000_000  # ns that a measurement may be ahead of the samples
(I_COUNT, I_AT, I_LAST_STAMP, I_QUEUED, I_NEXT, I_FORGOTTEN, I_FAULTS) = range(7)
FAULTS = ("measurement_late", "measurement_ahead", "measurement_duplicate", "restarted", "heading_lost")
(F_LATE, F_AHEAD, F_DUPLICATE, F_RESTARTED, F_LOST) = range(len(FAULTS))
COUNTS, EARLY = -1, -2  # what else becomes of a measurement: it counts; there was no sample yet
I_STAMPS = I_FAULTS + len(FAULTS)
I_QUEUE_STAMPS = I_STAMPS + HISTORY
I_SIZE = I_QUEUE_STAMPS + QUEUE

(M_STATE, M_PARAMETERS, M_EARTH, M_INTS, M_HISTORY, M_SNAPSHOTS, M_QUEUE, MEMORY_SIZE) = _offsets(
    STATE_SIZE, len(PARAMETER_NAMES), 5, I_SIZE, HISTORY * L_SIZE, HISTORY // SNAPSHOTS * STATE_SIZE, QUEUE * A_SIZE)
(P_CASCADE, P_STEADY, P_GRAVITY, P_GYRO_NOISE, P_RATE_ERROR, P_ACCEL_NOISE, P_FORCE_ERROR, P_GYRO_WALK,
 P_ACCEL_BIAS_STD, P_ACCEL_BIAS_TIME, P_ALT_DRIFT, P_ALT_SCALE, P_GATE, P_RECOVERY, P_HEADING_STD,
 P_AXIS_BIAS_STD, P_AXIS_BIAS_TIME, P_AXIS_FREQUENCY, P_FIX_INTERVAL, P_ANTENNA) = range(
     M_PARAMETERS, M_PARAMETERS + 20)
P_BUFFER, P_GAP_LIMIT, P_SLOW_SHARE, P_SLOW_TIME = range(P_ANTENNA + 3, P_ANTENNA + 7)

# M_EARTH: 1 once there is a place; latitude, radii of curvature at its height, and height (m) of the origin.
EARTH_RATE = 7.292115e-5
SEMI_MAJOR = 6378137.0
ECCENTRICITY2 = 6.69437999014e-3
BLIND_VELOCITY_STD = 100.0  # m/s
BLIND_POSITION_STD = 1e4  # m
VELOCITY_KNOWN_STD = 10.0  # m/s, below which the start may hand over
HEADING_LOST_STD = 0.6  # rad
YAW_BIAS_TIME = 5.0  # s over which the gyro bias turns the level frame before it counts as noise
TILT_TIME = 2.0  # s, correlation of the level frame's tilt error
FRESH = 1.5  # s within which a measurement still says what is now
UNKNOWN_ACCEL_STD = 2.0  # m/s^2, spread of the acceleration while the force is unknown
LOWPASS_TIME = 0.5  # s
NIS_SHARE = 0.05  # of a new value in the mean NIS
AIDING_TIMEOUT = 3.0  # s without position and velocity before the level estimator's tilt is taken
TILT_PERIOD = 1.0  # s between its tilts
UNKNOWN_VARIANCE = 1e6
NEVER = 1e9  # s since a measurement that has not come
TILT_CORRELATION = 20.0  # s that an error of the level estimator's tilt lasts

# As `compiled`, of what only other kernels call: no entry from Python, which takes half as long to compile.
_inlined = njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"},
                no_cpython_wrapper=True, no_cfunc_wrapper=True)


# --- closed forms of paper 001 ----------------------------------------------------------------------


@_inlined
def _fifth_coefficient(angle, third):
    """Return 2 (x^3/6 - x + sin x)/x^5, from the series below 0.3 rad."""
    x2 = angle * angle
    if angle < 0.3:
        return (1.0 - x2 / 42.0 * (1.0 - x2 / 72.0 * (1.0 - x2 / 110.0 * (1.0 - x2 / 156.0)))) / 60.0
    return 2.0 * (1.0 / 6.0 - third) / x2


@_inlined
def _fill(out, w, constant, linear, quadratic):
    """Fill out = constant I + linear [w x] + quadratic [w x]^2."""
    x, y, z = w[0], w[1], w[2]
    out[0, 0] = constant - quadratic * (y * y + z * z)
    out[1, 1] = constant - quadratic * (x * x + z * z)
    out[2, 2] = constant - quadratic * (x * x + y * y)
    out[0, 1] = quadratic * x * y - linear * z
    out[1, 0] = quadratic * x * y + linear * z
    out[0, 2] = quadratic * x * z + linear * y
    out[2, 0] = quadratic * x * z - linear * y
    out[1, 2] = quadratic * y * z - linear * x
    out[2, 1] = quadratic * y * z + linear * x


@compiled
def attitude_model(w, dt, gyro_density, walk_density, theta, psi, q11, q12):
    """Fill Theta, Psi, Q11 and Q12 of paper 001 (eq 19 to 22) for a rate w held over dt."""
    angle = math.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2) * dt
    k0, k1, k2, k3 = zoh_coefficients(angle)
    k4 = _fifth_coefficient(angle, k2)
    dt2 = dt * dt
    _fill(theta, w, 1.0, -k0 * dt, k1 * dt2)
    _fill(psi, w, dt, -k1 * dt2, k2 * dt2 * dt)
    walk = walk_density * walk_density
    _fill(q11, w, gyro_density * gyro_density * dt + walk * dt2 * dt / 3.0, 0.0, walk * k4 * dt2 * dt2 * dt)
    _fill(q12, w, -walk * dt2 / 2.0, walk * k2 * dt2 * dt, -walk * k3 * dt2 * dt2)


@_inlined
def _dcm(q, c):
    """Fill the matrix of a unit quaternion, scalar first."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    c[0, 0] = w * w + x * x - y * y - z * z
    c[0, 1] = 2.0 * (x * y - w * z)
    c[0, 2] = 2.0 * (x * z + w * y)
    c[1, 0] = 2.0 * (x * y + w * z)
    c[1, 1] = w * w - x * x + y * y - z * z
    c[1, 2] = 2.0 * (y * z - w * x)
    c[2, 0] = 2.0 * (x * z - w * y)
    c[2, 1] = 2.0 * (y * z + w * x)
    c[2, 2] = w * w - x * x - y * y + z * z


@_inlined
def _multiply(p, q0, q1, q2, q3):
    """Replace the quaternion p by p q."""
    w, x, y, z = p[0], p[1], p[2], p[3]
    p[0] = w * q0 - x * q1 - y * q2 - z * q3
    p[1] = w * q1 + x * q0 + y * q3 - z * q2
    p[2] = w * q2 - x * q3 + y * q0 + z * q1
    p[3] = w * q3 + x * q2 - y * q1 + z * q0


@_inlined
def _exp_parts(x, y, z):
    """Return the quaternion of a rotation vector."""
    half = 0.5 * math.sqrt(x * x + y * y + z * z)
    k = 0.5 * (1.0 - half * half / 6.0) if half < 1e-4 else 0.5 * math.sin(half) / half
    return math.cos(half), k * x, k * y, k * z


@_inlined
def _normalise(q):
    k = 1.0 / math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for i in range(4):
        q[i] *= k


@_inlined
def _turn_body(q, x, y, z):
    """Turn an attitude by a rotation vector in body axes."""
    w, a, b, c = _exp_parts(x, y, z)
    _multiply(q, w, a, b, c)
    _normalise(q)


@_inlined
def _turn_navigation(q, x, y, z):
    """Turn an attitude by a rotation vector in navigation axes: exp([v x]) C."""
    w, a, b, c = _exp_parts(x, y, z)
    q0, q1, q2, q3 = q[0], q[1], q[2], q[3]
    q[0], q[1], q[2], q[3] = w, a, b, c
    _multiply(q, q0, q1, q2, q3)
    _normalise(q)


@compiled
def integrate_rates(q, before, now, dt):
    """Turn an attitude by point-sampled rates at both ends of dt (paper 001 eq 12, put right).

    The commutator of the two Omega matrices, times dt^2/48, is half the quaternion of
    ``before x now dt^2 / 12``; added outside the exponential as in the paper, then normalised.
    """
    w, a, b, c = _exp_parts(0.5 * dt * (before[0] + now[0]), 0.5 * dt * (before[1] + now[1]),
                            0.5 * dt * (before[2] + now[2]))
    k = dt * dt / 24.0
    a += k * (before[1] * now[2] - before[2] * now[1])
    b += k * (before[2] * now[0] - before[0] * now[2])
    c += k * (before[0] * now[1] - before[1] * now[0])
    _multiply(q, w, a, b, c)
    _normalise(q)


# --- the Kalman update ------------------------------------------------------------------------------


@compiled
def kalman_update(P, H, R, y, d, dx, gate):
    """Update P in Joseph form and fill dx, unless the innovation fails the gate.

    Parameters
    ----------
    P : (n, n), H : (3, n), R : (3, 3), y : (3,), dx : (n,)
    d : int
        Components of the measurement, at most three. Never a literal: each would be compiled for itself.
    gate : float
        Largest normalised squared innovation.

    Returns
    -------
    float
        The normalised squared innovation (NIS); above `gate` nothing was changed.
    """
    n = len(dx)
    # W = H P and K are held as rows of n, so that the inner loops run along memory.
    rows, small = np.zeros((6, n)), np.empty((7, 3))
    W, K, S, L, u = rows[:3], rows[3:], small[:3], small[3:6], small[6]
    for a in range(d):
        for j in range(n):
            h = H[a, j]
            if h != 0.0:
                for i in range(n):
                    W[a, i] += h * P[j, i]
    nis = 0.0
    for a in range(d):
        # S = H P H^T + R, its Cholesky factor with an inverted diagonal, and the whitened innovation.
        for b in range(a + 1):
            s = R[a, b]
            for j in range(n):
                s += H[a, j] * W[b, j]
            S[a, b] = S[b, a] = s
            for k in range(b):
                s -= L[a, k] * L[b, k]
            if b < a:
                L[a, b] = s * L[b, b]
            elif s > 0.0:
                L[a, a] = 1.0 / math.sqrt(s)
            else:
                return math.inf
        s = y[a]
        for k in range(a):
            s -= L[a, k] * u[k]
        u[a] = s * L[a, a]
        nis += u[a] * u[a]
    if not nis <= gate:
        return nis
    for i in range(n):
        for a in range(d):
            s = W[a, i]
            for k in range(a):
                s -= L[a, k] * K[k, i]
            K[a, i] = s * L[a, a]
        s = 0.0
        for a in range(d - 1, -1, -1):
            g = K[a, i]
            for k in range(a + 1, d):
                g -= L[k, a] * K[k, i]
            K[a, i] = g * L[a, a]
            s += K[a, i] * y[a]
        dx[i] = s
    # Joseph's form multiplied out, K as rows: P - K^T X - X^T K with X = W - S K / 2.
    for a in range(d):
        for i in range(n):
            s = 0.0
            for b in range(d):
                s += S[a, b] * K[b, i]
            W[a, i] -= 0.5 * s
    for i in range(n):
        for j in range(i + 1):
            s = P[i, j]
            for a in range(d):
                s -= K[a, i] * W[a, j] + W[a, i] * K[a, j]
            P[i, j] = P[j, i] = s
    return nis


_update_inlined = njit(inline="always")(kalman_update.py_func)  # where the sizes are constants: a third faster


# --- attitude and gyro bias, paper 001 --------------------------------------------------------------


@compiled
def mekf_predict(q, P, w, dt, gyro_density, walk_density):
    """Carry attitude and covariance (6, 6) over dt; w is the rate less the bias."""
    _turn_body(q, w[0] * dt, w[1] * dt, w[2] * dt)
    mekf_covariance(q, P, w, dt, gyro_density, walk_density, 0.0)


@_inlined
def mekf_covariance(q, P, w, dt, gyro_density, walk_density, angle_var):
    """Carry the first six rows and columns of P to the attitude q at the end of the interval.

    Phi = [I, -C^T Psi; 0, I] and Q turned alike, with C navigation to body; `angle_var` (rad^2) is noise on top.
    The closed forms are polynomials of [w x], so that C^T f(w) = f(C^T w) C^T.
    """
    work = np.empty((7, 3, 3))
    c, theta, psi, q11, q12, a, w_n = work[0], work[1], work[2], work[3], work[4], work[5], work[6, 0]
    _dcm(q, c)
    for i in range(3):
        w_n[i] = c[i, 0] * w[0] + c[i, 1] * w[1] + c[i, 2] * w[2]
    attitude_model(w_n, dt, gyro_density, walk_density, theta, psi, q11, q12)
    for i in range(3):
        q11[i, i] += angle_var
        for j in range(3):
            a[i, j] = psi[i, 0] * c[0, j] + psi[i, 1] * c[1, j] + psi[i, 2] * c[2, j]
    # The block right above is carried first; the one left below still has its old values.
    for i in range(3):
        for j in range(3):
            P[i, 3 + j] -= a[i, 0] * P[3, 3 + j] + a[i, 1] * P[4, 3 + j] + a[i, 2] * P[5, 3 + j]
    for i in range(3):
        for j in range(i, 3):
            P[i, j] += q11[i, j] - (
                a[i, 0] * P[3, j] + a[i, 1] * P[4, j] + a[i, 2] * P[5, j]
                + a[j, 0] * P[i, 3] + a[j, 1] * P[i, 4] + a[j, 2] * P[i, 5])
            P[j, i] = P[i, j]
    for i in range(3):
        P[3 + i, 3 + i] += walk_density * walk_density * dt
        for j in range(3):
            P[i, 3 + j] += q12[i, 0] * c[0, j] + q12[i, 1] * c[1, j] + q12[i, 2] * c[2, j]
            P[3 + j, i] = P[i, 3 + j]


@compiled
def mekf_vector_update(q, bias, P, measured_b, reference_n, R, gate):
    """Update by a direction or vector known in the navigation frame; return the NIS.

    ``C z = (I - [theta x]) v_n`` of the true C less its error, so turned to navigation axes ``H = [[v_n x], 0]``.
    """
    work, rows = np.empty((10, 3)), np.zeros((4, 6))
    c, t, R_n, y, H, dx = work[:3], work[3:6], work[6:9], work[9], rows[:3], rows[3]
    _dcm(q, c)
    for i in range(3):
        for j in range(3):
            t[i, j] = c[i, 0] * R[0, j] + c[i, 1] * R[1, j] + c[i, 2] * R[2, j]
    for i in range(3):
        y[i] = c[i, 0] * measured_b[0] + c[i, 1] * measured_b[1] + c[i, 2] * measured_b[2] - reference_n[i]
        for j in range(3):
            R_n[i, j] = t[i, 0] * c[j, 0] + t[i, 1] * c[j, 1] + t[i, 2] * c[j, 2]
    H[0, 1], H[0, 2] = -reference_n[2], reference_n[1]
    H[1, 0], H[1, 2] = reference_n[2], -reference_n[0]
    H[2, 0], H[2, 1] = -reference_n[1], reference_n[0]
    nis = _update_inlined(P, H, R_n, y, 3, dx, gate)
    if nis <= gate:
        _turn_navigation(q, dx[0], dx[1], dx[2])
        for i in range(3):
            bias[i] += dx[3 + i]
    return nis


@_inlined
def _wrap(angle):
    """Return the angle within half a turn of zero."""
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@_inlined
def _heading_row(c, H):
    """Fill the derivative of the heading by the attitude error; return its estimate, NaN near the vertical."""
    level2 = c[0, 0] ** 2 + c[1, 0] ** 2
    if level2 < 0.03:
        return math.nan
    H[0, 0] = -c[2, 0] * c[0, 0] / level2
    H[0, 1] = -c[2, 0] * c[1, 0] / level2
    H[0, 2] = 1.0
    return math.atan2(c[1, 0], c[0, 0])


@compiled
def mekf_heading_update(q, bias, P, heading, variance, gate):
    """Update by a heading, rad clockwise from north; return the NIS, NaN when the nose is near the vertical."""
    c, H, R, y, dx = np.empty((3, 3)), np.zeros((1, 6)), np.empty((1, 1)), np.empty(1), np.zeros(6)
    _dcm(q, c)
    estimate = _heading_row(c, H)
    y[0] = _wrap(heading - estimate) if estimate == estimate else math.nan
    R[0, 0] = variance
    nis = kalman_update(P, H, R, y, len(y), dx, gate)
    if nis <= gate:
        _turn_navigation(q, dx[0], dx[1], dx[2])
        for i in range(3):
            bias[i] += dx[3 + i]
    return nis


# --- the place on the Earth -------------------------------------------------------------------------


@_inlined
def _place(m, earth):
    """Fill gravity, the Earth's and the frame's rate (north, east, down each) and the metric of the position.

    Without a place the Earth is flat and does not turn. North and east count along the parallel and meridian of
    the origin, so metres of position and metres travelled differ by the ratios of the radii.
    """
    for i in range(9):
        earth[i] = 0.0
    earth[0] = m[P_GRAVITY]
    earth[7], earth[8] = 1.0, 1.0
    if m[M_EARTH] == 0.0:
        return
    meridian0, transverse0 = m[M_EARTH + 2], m[M_EARTH + 3]
    latitude = m[M_EARTH + 1] + m[X_P] / meridian0
    s, c = math.sin(latitude), math.cos(latitude)
    w2 = 1.0 - ECCENTRICITY2 * s * s
    transverse = SEMI_MAJOR / math.sqrt(w2)
    height = m[M_EARTH + 4] - m[X_P + 2]
    meridian = transverse * (1.0 - ECCENTRICITY2) / w2 + height
    transverse += height
    north, east = m[X_V] / meridian, m[X_V + 1] / transverse
    earth[1], earth[3] = EARTH_RATE * c, -EARTH_RATE * s
    earth[4], earth[5], earth[6] = east, -north, -east * s / c
    earth[7] = meridian0 / meridian
    earth[8] = transverse0 * math.cos(m[M_EARTH + 1]) / (transverse * c)


# --- the 15-state error-state filter ----------------------------------------------------------------


@_inlined
def _carry_mean(m, w, f, dt, dcm, gained):
    """Carry attitude, velocity and position; fill the mean matrix D of dt and the force's velocity gain D f."""
    q = m[X_Q:X_V]
    earth = np.empty(9)
    _place(m, earth)
    c, j1 = np.empty((3, 3)), np.empty((3, 3))
    _dcm(q, c)
    angle = math.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2) * dt
    k0, k1, k2, k3 = zoh_coefficients(angle)
    _fill(j1, w, dt, k1 * dt * dt, k2 * dt * dt * dt)
    for i in range(3):
        gained[i] = 0.0
        for j in range(3):
            dcm[i, j] = c[i, 0] * j1[0, j] + c[i, 1] * j1[1, j] + c[i, 2] * j1[2, j]
            gained[i] += dcm[i, j] * f[j]
    v0, v1, v2 = m[X_V], m[X_V + 1], m[X_V + 2]
    r0, r1, r2 = 2.0 * earth[1] + earth[4], earth[5], 2.0 * earth[3] + earth[6]
    a0 = gained[0] / dt - (r1 * v2 - r2 * v1)
    a1 = gained[1] / dt - (r2 * v0 - r0 * v2)
    a2 = gained[2] / dt - (r0 * v1 - r1 * v0) + earth[0]
    m[X_P] += earth[7] * dt * (v0 + 0.5 * dt * a0)
    m[X_P + 1] += earth[8] * dt * (v1 + 0.5 * dt * a1)
    m[X_P + 2] += dt * (v2 + 0.5 * dt * a2)
    m[X_V], m[X_V + 1], m[X_V + 2] = v0 + dt * a0, v1 + dt * a1, v2 + dt * a2
    m[X_ACC], m[X_ACC + 1], m[X_ACC + 2] = a0, a1, a2
    _turn_body(q, w[0] * dt, w[1] * dt, w[2] * dt)
    _turn_navigation(q, -dt * (earth[1] + earth[4]), -dt * earth[5], -dt * (earth[3] + earth[6]))


@_inlined
def _carry_covariance(P, D, u, dt, decay):
    """Replace P, flat and symmetric, by F P F^T: F P, turned over, is P F^T, so the same step comes twice."""
    h = 0.5 * dt
    d00, d01, d02, d10, d11, d12, d20, d21, d22 = (
        D[0, 0], D[0, 1], D[0, 2], D[1, 0], D[1, 1], D[1, 2], D[2, 0], D[2, 1], D[2, 2])
    u0, u1, u2 = u[0], u[1], u[2]
    for _ in range(2):
        # All columns at once: rows lie along memory.
        for k in range(N):
            t0, t1, t2 = P[k], P[N + k], P[2 * N + k]
            b0, b1, b2 = P[BG * N + k], P[(BG + 1) * N + k], P[(BG + 2) * N + k]
            a0, a1, a2 = P[BA * N + k], P[(BA + 1) * N + k], P[(BA + 2) * N + k]
            v0, v1, v2 = P[V * N + k], P[(V + 1) * N + k], P[(V + 2) * N + k]
            g0 = d00 * b0 + d01 * b1 + d02 * b2
            g1 = d10 * b0 + d11 * b1 + d12 * b2
            g2 = d20 * b0 + d21 * b1 + d22 * b2
            # theta acts through u = D f: -u x theta, and the gyro bias through theta's mean over dt.
            m0, m1, m2 = t0 - 0.5 * g0, t1 - 0.5 * g1, t2 - 0.5 * g2
            e0 = u2 * m1 - u1 * m2 - (d00 * a0 + d01 * a1 + d02 * a2)
            e1 = u0 * m2 - u2 * m0 - (d10 * a0 + d11 * a1 + d12 * a2)
            e2 = u1 * m0 - u0 * m1 - (d20 * a0 + d21 * a1 + d22 * a2)
            P[POS * N + k] += dt * v0 + h * e0
            P[(POS + 1) * N + k] += dt * v1 + h * e1
            P[(POS + 2) * N + k] += dt * v2 + h * e2
            P[V * N + k], P[(V + 1) * N + k], P[(V + 2) * N + k] = v0 + e0, v1 + e1, v2 + e2
            P[k], P[N + k], P[2 * N + k] = t0 - g0, t1 - g1, t2 - g2
            P[BA * N + k], P[(BA + 1) * N + k], P[(BA + 2) * N + k] = decay * a0, decay * a1, decay * a2
        for i in range(N):
            for j in range(i):
                P[N * i + j], P[N * j + i] = P[N * j + i], P[N * i + j]


@_inlined
def _eskf_predict(m, P, dt, w, f, gyro_var, accel_var):
    """Carry the filter over dt (s); w and f less their biases, variances (rad^2, m^2/s^2) on top of the noise.

    The position is that of the fixes, slow error included, so that it drifts as that error does.
    """
    D, u = np.empty((3, 3)), np.empty(3)
    _carry_mean(m, w, f, dt, D, u)
    decay = max(1.0 - dt / m[P_ACCEL_BIAS_TIME], 0.0)
    _carry_covariance(m[X_COV:X_RATE], D, u, dt, decay)
    rate2 = w[0] ** 2 + w[1] ** 2 + w[2] ** 2
    acc2 = m[X_ACC] ** 2 + m[X_ACC + 1] ** 2 + m[X_ACC + 2] ** 2
    q_angle = dt * (m[P_GYRO_NOISE] ** 2 + m[P_RATE_ERROR] ** 2 * rate2) + gyro_var
    q_velocity = dt * (m[P_ACCEL_NOISE] ** 2 + m[P_FORCE_ERROR] ** 2 * acc2) + accel_var
    for i in range(3):
        m[X_BA + i] *= decay
        P[TH + i, TH + i] += q_angle
        P[V + i, V + i] += q_velocity
        P[POS + i, V + i] += 0.5 * dt * q_velocity
        P[V + i, POS + i] += 0.5 * dt * q_velocity
        P[POS + i, POS + i] += dt * dt * q_velocity / 3.0 + 2.0 * dt * m[X_SLOW + i] / m[P_SLOW_TIME]
        P[BG + i, BG + i] += dt * m[P_GYRO_WALK] ** 2
        P[BA + i, BA + i] += 2.0 * dt / m[P_ACCEL_BIAS_TIME] * m[P_ACCEL_BIAS_STD] ** 2
    P[REF, REF] += dt * (m[P_ALT_DRIFT] ** 2 + (m[P_ALT_SCALE] * m[X_V + 2]) ** 2)
    for i in range(N):
        for j in range(i):
            P[i, j] = 0.5 * (P[i, j] + P[j, i])
            P[j, i] = P[i, j]


@_inlined
def _lever(m, c, arm, swing):
    """Fill the antenna's place C l and its velocity C (w x l) relative to the IMU, NED."""
    w0, w1, w2 = m[X_RATE], m[X_RATE + 1], m[X_RATE + 2]
    l0, l1, l2 = m[P_ANTENNA], m[P_ANTENNA + 1], m[P_ANTENNA + 2]
    s0, s1, s2 = w1 * l2 - w2 * l1, w2 * l0 - w0 * l2, w0 * l1 - w1 * l0
    for i in range(3):
        arm[i] = c[i, 0] * l0 + c[i, 1] * l1 + c[i, 2] * l2
        swing[i] = c[i, 0] * s0 + c[i, 1] * s1 + c[i, 2] * s2


@_inlined
def _fill_minus_cross(H, column, v):
    """Fill -[v x] into three columns of H."""
    H[0, column + 1], H[0, column + 2] = v[2], -v[1]
    H[1, column], H[1, column + 2] = -v[2], v[0]
    H[2, column], H[2, column + 1] = v[1], -v[0]


@compiled
def measurement_model(m, kind, z, age, H, y):
    """Fill rows and innovation of a measurement valid `age` s before the state; return how many rows count.

    fix: NED position of the antenna, m; velocity: of the antenna, NED, m/s; altitude: m, up, of the IMU above
    the altimeter's zero; inclinometer: the down direction in body axes; heading: rad clockwise from north.
    """
    for i in range(3):
        for j in range(N):
            H[i, j] = 0.0
    c, arm, swing = np.empty((3, 3)), np.empty(3), np.empty(3)
    _dcm(m[X_Q:X_V], c)
    if kind in (K_FIX, K_VELOCITY):
        _lever(m, c, arm, swing)
        for i in range(3):
            if kind == K_FIX:
                velocity = m[X_V + i] + swing[i]
                y[i] = z[i] - (m[X_P + i] + arm[i] - age * (velocity - 0.5 * age * m[X_ACC + i]))
                H[i, POS + i], H[i, V + i] = 1.0, -age
            else:
                y[i] = z[i] - (m[X_V + i] + swing[i] - age * m[X_ACC + i])
                H[i, V + i] = 1.0
        if kind == K_FIX:
            _fill_minus_cross(H, TH, arm)
        else:
            _fill_minus_cross(H, TH, swing)
            l0, l1, l2 = m[P_ANTENNA], m[P_ANTENNA + 1], m[P_ANTENNA + 2]
            for i in range(3):
                H[i, BG] = c[i, 1] * l2 - c[i, 2] * l1
                H[i, BG + 1] = c[i, 2] * l0 - c[i, 0] * l2
                H[i, BG + 2] = c[i, 0] * l1 - c[i, 1] * l0
        return 3
    if kind == K_ALTITUDE:
        y[0] = z[0] - (m[X_REF] - (m[X_P + 2] - age * m[X_V + 2]))
        H[0, POS + 2], H[0, V + 2], H[0, REF] = -1.0, age, 1.0
        return 1
    if kind in (K_INCLINOMETER, K_LEVEL):
        w0, w1, w2 = age * m[X_RATE], age * m[X_RATE + 1], age * m[X_RATE + 2]
        d0, d1, d2 = z[0] - w1 * z[2] + w2 * z[1], z[1] - w2 * z[0] + w0 * z[2], z[2] - w0 * z[1] + w1 * z[0]
        # C z = e_down - theta x e_down, whose part along down says nothing.
        for i in range(2):
            y[i] = c[i, 0] * d0 + c[i, 1] * d1 + c[i, 2] * d2
        H[0, TH + 1], H[1, TH] = -1.0, 1.0
        return 2
    estimate = _heading_row(c, H)
    if estimate != estimate:
        return 0
    turned = age * (m[X_RATE + 1] * c[2, 1] + m[X_RATE + 2] * c[2, 2]) / (1.0 - c[2, 0] ** 2)
    y[0] = _wrap(z[0] + turned - estimate)
    return 1


@_inlined
def _judge(m, kind, nis, d, gate):
    """Count a measurement as used or refused."""
    if nis <= gate:
        m[X_USED + kind] += 1.0
        m[X_SINCE + kind] = 0.0
        m[X_REFUSING + kind] = 0.0
    else:
        m[X_REFUSED + kind] += 1.0
        m[X_REFUSING + kind] = max(m[X_REFUSING + kind], 1e-9)
    share = max(NIS_SHARE, 1.0 / (m[X_USED + kind] + m[X_REFUSED + kind]))
    m[X_NIS + kind] += share * (min(nis / d, 1e3) - m[X_NIS + kind])


@_inlined
def _gate(m, kind, d):
    """Gate of `d` components, infinite once measurements have been refused for the recovery time."""
    return math.inf if m[X_REFUSING + kind] > m[P_RECOVERY] else m[P_GATE] + 3.0 * (d - 1)


@_inlined
def _open(m, P, kind, y, d):
    """What has been refused for so long is true: the state that it shows is taken for lost."""
    for a in range(d):
        if kind in (K_INCLINOMETER, K_LEVEL):
            i = TH + 1 - a
        elif kind == K_HEADING:
            i = TH + 2
        elif kind == K_ALTITUDE:
            i = REF
        else:
            i = (POS if kind == K_FIX else V) + a
        P[i, i] += y[a] ** 2


@_inlined
def _correct(m, dx):
    """Add an error to what is estimated."""
    _turn_navigation(m[X_Q:X_V], dx[TH], dx[TH + 1], dx[TH + 2])
    at = X_DRIFT if m[P_CASCADE] == 1.0 else X_BA
    for i in range(3):
        m[X_V + i] += dx[V + i]
        m[X_P + i] += dx[POS + i]
        m[X_BG + i] += dx[BG + i]
        m[at + i] += dx[BA + i]
    m[X_REF] += dx[REF]


# --- the cascade of paper 001 -----------------------------------------------------------------------


@_inlined
def _carry_axes(P, dt, density, bias_std, bias_time):
    """Carry the covariance of velocity, position and acceleration error over dt."""
    h = 0.5 * dt * dt
    decay = math.exp(-dt / bias_time)
    for by_column in range(2):
        for k in range(V, N):
            A = P[k] if by_column else P[:, k]
            for i in range(3):
                A[POS + i] += dt * A[V + i] + h * A[BA + i]
                A[V + i] += dt * A[BA + i]
                A[BA + i] *= decay
    q = density * density
    for i in range(3):
        P[V + i, V + i] += q * dt
        P[V + i, POS + i] += q * h
        P[POS + i, V + i] += q * h
        P[POS + i, POS + i] += q * dt * dt * dt / 3.0
        P[BA + i, BA + i] += bias_std * bias_std * (1.0 - decay * decay)


@_inlined
def _cascade_predict(m, P, dt, w, f, gyro_var, accel_var):
    """Carry both filters of the cascade over dt (s)."""
    D, u = np.empty((3, 3)), np.empty(3)
    _carry_mean(m, w, f, dt, D, u)
    rate2 = w[0] ** 2 + w[1] ** 2 + w[2] ** 2
    mekf_covariance(m[X_Q:X_V], P, w, dt, m[P_GYRO_NOISE], m[P_GYRO_WALK],
                    gyro_var + dt * m[P_RATE_ERROR] ** 2 * rate2)
    bias_std = 0.0 if m[P_STEADY] == 1.0 else m[P_AXIS_BIAS_STD]
    _carry_axes(P, dt, math.sqrt(m[P_ACCEL_NOISE] ** 2 + accel_var / dt), bias_std, m[P_AXIS_BIAS_TIME])
    decay = math.exp(-dt / m[P_AXIS_BIAS_TIME])
    for i in range(3):
        m[X_P + i] += 0.5 * dt * dt * m[X_DRIFT + i]
        m[X_V + i] += dt * m[X_DRIFT + i]
        m[X_DRIFT + i] *= decay
        m[X_DVEL + i] += u[i]
        P[POS + i, POS + i] += 2.0 * dt * m[X_SLOW + i] / m[P_SLOW_TIME]
    m[X_DVEL_TIME] += dt


@_inlined
def _steady_update(m, P, y, R, gate):
    """Paper 001 eq 8 and 9: position and velocity by the steady gain times the interval; return the NIS."""
    wn, dt = m[P_AXIS_FREQUENCY], m[P_FIX_INTERVAL]
    nis = 0.0
    for i in range(3):
        density = R[i, i] * dt
        P[POS + i, POS + i], P[V + i, V + i] = math.sqrt(2.0) * wn * density, math.sqrt(2.0) * wn**3 * density
        P[POS + i, V + i] = P[V + i, POS + i] = wn * wn * density
        nis += y[i] * y[i] / (P[POS + i, POS + i] + R[i, i])
    if nis <= gate:
        for i in range(3):
            m[X_P + i] += math.sqrt(2.0) * wn * dt * y[i]
            m[X_V + i] += wn * wn * dt * y[i]
    return nis


@_inlined
def _level_by_velocity(m, z, cov, age, H, R, y):
    """The force's mean less the aiding velocity's derivative is gravity: fill rows that say so.

    ``f_true = (I + [theta x]) f``, so ``dv/dt - g - f = -[f x] theta``. Returns whether they count.
    """
    c, arm, swing, f = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    _dcm(m[X_Q:X_V], c)
    _lever(m, c, arm, swing)
    span = max(m[X_DVEL_TIME], 1e-3)
    for i in range(3):
        for j in range(N):
            H[i, j] = 0.0
        for j in range(3):
            R[i, j] = 0.0
        velocity = z[i] - swing[i] + age * m[X_ACC + i]
        f[i] = m[X_DVEL + i] / span
        y[i] = (velocity - m[X_LAST_VELOCITY + i]) / span - f[i]
        R[i, i] = 2.0 * cov[i, i] / span**2 + m[P_ACCEL_BIAS_STD] ** 2
        m[X_LAST_VELOCITY + i] = velocity
        m[X_DVEL + i] = 0.0
    y[2] -= m[P_GRAVITY]
    _fill_minus_cross(H, TH, f)
    known = m[X_LAST_VELOCITY + 3] == 1.0
    m[X_DVEL_TIME], m[X_LAST_VELOCITY + 3] = 0.0, 1.0
    return known and 0.02 < span < FRESH


# --- the start: level, heading unknown --------------------------------------------------------------


@_inlined
def _start_blind(m):
    """Know nothing of the heading: cosine and sine zero, their covariance that of every direction."""
    for i in range(X_BLIND, X_INTERVAL):
        m[i] = 0.0
    P = m[X_BLIND_COV:X_BLIND_ON].reshape((N_BLIND, N_BLIND))
    for i in range(2):
        P[i, i] = BLIND_POSITION_STD**2
        P[BV + i, BV + i] = BLIND_VELOCITY_STD**2
        P[BC + i, BC + i] = 0.5


@_inlined
def blind_predict(x, P, dt, north, east, force_density2, yaw_density2):
    """Carry the blind start over dt: horizontal force (m/s^2) in the level frame whose heading is sought.

    Velocity north changes by (cos n - sin e) dt, east by (sin n + cos e) dt: linear in what is sought.
    Densities squared: of the force's error, (m/s^2)^2 s, and of the level frame's yaw, rad^2/s.
    """
    h = 0.5 * dt
    for k in range(N_BLIND + 1):
        A = x if k == N_BLIND else P[:, k]
        d0 = dt * (north * A[BC] - east * A[BC + 1])
        d1 = dt * (east * A[BC] + north * A[BC + 1])
        A[0] += dt * A[BV] + h * d0
        A[1] += dt * A[BV + 1] + h * d1
        A[BV] += d0
        A[BV + 1] += d1
    for k in range(N_BLIND):
        A = P[k, :]
        d0 = dt * (north * A[BC] - east * A[BC + 1])
        d1 = dt * (east * A[BC] + north * A[BC + 1])
        A[0] += dt * A[BV] + h * d0
        A[1] += dt * A[BV + 1] + h * d1
        A[BV] += d0
        A[BV + 1] += d1
    c, s = x[BC], x[BC + 1]
    q = dt * yaw_density2
    ss, cs, cc = s * s + P[BC + 1, BC + 1], -s * c - P[BC, BC + 1], c * c + P[BC, BC]
    P[BC, BC] += q * ss
    P[BC, BC + 1] += q * cs
    P[BC + 1, BC] += q * cs
    P[BC + 1, BC + 1] += q * cc
    for i in range(2):
        P[BV + i, BV + i] += dt * force_density2


@_inlined
def _blind_model(m, kind, z, cov, age, level_yaw, H, R, y):
    """Fill rows, covariance and innovation of a fix, a velocity or a heading for the blind start."""
    for i in range(2):
        for j in range(2):
            R[i, j] = cov[i, j]
        if kind == K_HEADING:
            angle = z[0] - level_yaw
            y[i] = (math.sin(angle) if i else math.cos(angle)) - m[X_BLIND + BC + i]
            H[i, BC + i] = 1.0
        elif kind == K_FIX:
            y[i] = z[i] - m[X_BLIND + i] + age * m[X_BLIND + BV + i]
            H[i, i], H[i, BV + i] = 1.0, -age
            R[i, i] += _arm2(m)
        else:
            y[i] = z[i] - m[X_BLIND + BV + i]
            H[i, BV + i] = 1.0


@_inlined
def _blind_correct(m, kind, z, cov, age, dx):
    """Add an error to the blind start, and remember what the aid says of the vertical."""
    for i in range(N_BLIND):
        m[X_BLIND + i] += dx[i]
    if kind != K_HEADING:
        m[X_BLIND_ON] = 1.0
        at = X_DOWN_FIX if kind == K_FIX else X_DOWN_VEL
        m[at], m[at + 1], m[at + 2] = z[2], cov[2, 2], age


@_inlined
def _arm2(m):
    return m[P_ANTENNA] ** 2 + m[P_ANTENNA + 1] ** 2 + m[P_ANTENNA + 2] ** 2


@_inlined
def blind_heading_variance(m):
    """Variance of the blind start's heading, rad^2; UNKNOWN_VARIANCE until there is a direction."""
    c, s = m[X_BLIND + BC], m[X_BLIND + BC + 1]
    r2 = c * c + s * s
    P = m[X_BLIND_COV:X_BLIND_ON].reshape((N_BLIND, N_BLIND))
    if r2 < 0.5 or r2 > 1.6 or P[BC, BC] + P[BC + 1, BC + 1] > 0.25:
        return UNKNOWN_VARIANCE
    return (s * s * P[BC, BC] - 2.0 * s * c * P[BC, BC + 1] + c * c * P[BC + 1, BC + 1]) / (r2 * r2)


@_inlined
def _may_navigate(m):
    """Whether heading and velocity are known well enough for a filter of small errors."""
    P = m[X_BLIND_COV:X_BLIND_ON].reshape((N_BLIND, N_BLIND))
    return (m[X_BLIND_ON] == 1.0 and P[BV, BV] + P[BV + 1, BV + 1] < VELOCITY_KNOWN_STD**2
            and blind_heading_variance(m) < m[P_HEADING_STD] ** 2
            and P[BC, BC] + P[BC + 1, BC + 1] < 4.0 * m[P_HEADING_STD] ** 2)


@_inlined
def _start_navigating(m, L):
    """Put the filter of small errors where the level estimator and the blind start have come to."""
    heading = math.atan2(m[X_BLIND + BC + 1], m[X_BLIND + BC])
    for i in range(4):
        m[X_Q + i] = L[L_Q + i]
    _turn_navigation(m[X_Q:X_V], 0.0, 0.0, heading)
    for i in range(X_COV, X_RATE):
        m[i] = 0.0
    P = m[X_COV:X_RATE].reshape((N, N))
    B = m[X_BLIND_COV:X_BLIND_ON].reshape((N_BLIND, N_BLIND))
    c, s = math.cos(heading), math.sin(heading)
    nn, ne, ee = L[L_TILT], L[L_TILT + 1], L[L_TILT + 2]
    P[0, 0] = c * c * nn - 2.0 * c * s * ne + s * s * ee
    P[1, 1] = s * s * nn + 2.0 * c * s * ne + c * c * ee
    P[0, 1] = P[1, 0] = c * s * (nn - ee) + (c * c - s * s) * ne
    P[2, 2] = blind_heading_variance(m)
    r = math.sqrt(m[X_BLIND + BC] ** 2 + m[X_BLIND + BC + 1] ** 2)
    for i in range(2):
        m[X_P + i], m[X_V + i] = m[X_BLIND + i], m[X_BLIND + BV + i]
        for j in range(2):
            P[POS + i, POS + j], P[V + i, V + j] = B[i, j], B[BV + i, BV + j]
            P[POS + i, V + j] = P[V + j, POS + i] = B[i, BV + j]
        P[2, V + i] = P[V + i, 2] = (c * B[BC + 1, BV + i] - s * B[BC, BV + i]) / r
        P[2, POS + i] = P[POS + i, 2] = (c * B[BC + 1, i] - s * B[BC, i]) / r
    for i in range(3):
        m[X_BG + i], m[X_BA + i] = L[L_BG + i], L[L_BA + i]
        P[BG + i, BG + i], P[BA + i, BA + i] = L[L_BG_VAR + i], L[L_BA_VAR + i]
    _start_vertical(m, P, L)
    if m[P_CASCADE] == 1.0:
        _start_cascade(m, P)
    m[X_PHASE] = 1.0


@_inlined
def _start_vertical(m, P, L):
    """Height and its rate from the aids where they are fresh, otherwise from the level estimator."""
    v, variance, age = m[X_DOWN_VEL], m[X_DOWN_VEL + 1], m[X_DOWN_VEL + 2]
    fresh = variance > 0.0 and age < FRESH
    m[X_V + 2] = v if fresh else L[L_VD]
    P[V + 2, V + 2] = variance + age * age if fresh else L[L_VD_VAR]
    z, variance, age = m[X_DOWN_FIX], m[X_DOWN_FIX + 1], m[X_DOWN_FIX + 2]
    if variance > 0.0 and age < FRESH:
        m[X_P + 2] = z + age * m[X_V + 2]
        P[POS + 2, POS + 2] = variance + age * age * (1.0 + P[V + 2, V + 2])
        m[X_REF] = L[L_ALTITUDE] + m[X_P + 2]
        P[REF, REF] = L[L_ALTITUDE_VAR] + P[POS + 2, POS + 2]
        P[POS + 2, REF] = P[REF, POS + 2] = P[POS + 2, POS + 2]
    else:
        m[X_P + 2], P[POS + 2, POS + 2] = -L[L_ALTITUDE], L[L_ALTITUDE_VAR]
        m[X_REF], P[REF, REF] = 0.0, 1e-6


@_inlined
def _start_cascade(m, P):
    """Cut what the cascade does not know of: its attitude from the rest, its acceleration error from all."""
    for i in range(N):
        for j in range(N):
            if (i < V) != (j < V) or (BA <= i < REF) or (BA <= j < REF):
                P[i, j] = 0.0
    for i in range(3):
        P[BA + i, BA + i] = 0.0 if m[P_STEADY] == 1.0 else m[P_AXIS_BIAS_STD] ** 2
        m[X_DRIFT + i] = 0.0
        m[X_DVEL + i] = 0.0
    m[X_DVEL_TIME] = 0.0
    m[X_LAST_VELOCITY + 3] = 0.0


# --- one step --------------------------------------------------------------------------------------


@_inlined
def _track(m, L):
    """Follow the mean interval and how much the samples vary; return what a lost part of dt may have held."""
    dt = L[L_DT]
    usual = m[X_INTERVAL] if m[X_INTERVAL] > 0.0 else dt
    lost = max(dt - 1.5 * usual, 0.0) * (dt - usual)
    m[X_INTERVAL] = usual + 0.02 * (min(dt, 2.0 * usual) - usual)
    gain = dt / (LOWPASS_TIME + dt)
    dw2 = df2 = 0.0
    for i in range(3):
        dw = L[L_GYRO + i] + L[L_BG + i] - m[X_GYRO_LP + i]
        df = L[L_ACCEL + i] + L[L_BA + i] - m[X_ACCEL_LP + i]
        m[X_GYRO_LP + i] += gain * dw
        m[X_ACCEL_LP + i] += gain * df
        dw2 += dw * dw
        df2 += df * df
    m[X_GYRO_SPREAD] += gain * (dw2 - m[X_GYRO_SPREAD])
    m[X_ACCEL_SPREAD] += gain * (df2 - m[X_ACCEL_SPREAD])
    return lost * m[X_GYRO_SPREAD] / 3.0, lost * m[X_ACCEL_SPREAD]


@_inlined
def _level_frame(m, L):
    """Return of the level frame: north and east force, then the densities squared of its error and of the yaw's."""
    if L[L_VALID] == 0.0:
        return 0.0, 0.0, UNKNOWN_ACCEL_STD**2, 0.1
    c = np.empty((3, 3))
    _dcm(L[L_Q:L_TILT], c)
    north = east = bias_var = 0.0
    for i in range(3):
        north += c[0, i] * L[L_ACCEL + i]
        east += c[1, i] * L[L_ACCEL + i]
        bias_var += c[2, i] ** 2 * L[L_BG_VAR + i]
    tilt = L[L_TILT] + L[L_TILT + 2]
    return (north, east, m[P_ACCEL_NOISE] ** 2 + m[P_GRAVITY] ** 2 * tilt * TILT_TIME,
            m[P_GYRO_NOISE] ** 2 + 2.0 * YAW_BIAS_TIME * bias_var)


@_inlined
def _level_yaw(L):
    q0, q1, q2, q3 = L[L_Q], L[L_Q + 1], L[L_Q + 2], L[L_Q + 3]
    return math.atan2(2.0 * (q1 * q2 + q0 * q3), q0 * q0 + q1 * q1 - q2 * q2 - q3 * q3)


@_inlined
def _carry(m, L):
    """Carry whatever runs over one remembered sample."""
    dt = L[L_DT]
    for k in range(N_KINDS):
        m[X_SINCE + k] += dt
        if m[X_REFUSING + k] > 0.0:
            m[X_REFUSING + k] += dt
    gyro_var, accel_var = _track(m, L)
    if L[L_KNOWN] == 0.0:
        accel_var += (dt * UNKNOWN_ACCEL_STD) ** 2
    if m[X_PHASE] == 0.0:
        m[X_DOWN_FIX + 2] += dt
        m[X_DOWN_VEL + 2] += dt
        north, east, force_density2, yaw_density2 = _level_frame(m, L)
        blind_predict(m[X_BLIND:X_BLIND_COV], m[X_BLIND_COV:X_BLIND_ON].reshape((N_BLIND, N_BLIND)), dt,
                      north, east, force_density2 + accel_var / dt, yaw_density2 + gyro_var / dt)
        return
    sample = np.empty((2, 3))
    w, f = sample[0], sample[1]
    for i in range(3):
        w[i] = L[L_GYRO + i] + L[L_BG + i] - m[X_BG + i]
        f[i] = L[L_ACCEL + i] + L[L_BA + i] - m[X_BA + i]
        m[X_RATE + i] = w[i]
    P = m[X_COV:X_RATE].reshape((N, N))
    if m[P_CASCADE] == 1.0:
        _cascade_predict(m, P, dt, w, f, gyro_var, accel_var)
    else:
        _eskf_predict(m, P, dt, w, f, gyro_var, accel_var)


@_inlined
def _follow_slow_error(m, cov):
    for i in range(3):
        m[X_SLOW + i] = m[P_SLOW_SHARE] * cov[i, i]


@_inlined
def _take_starting(m, kind, z, cov, age, L):
    """Take a measurement, valid `age` s before the sample L, into the start."""
    if kind == K_ALTITUDE:
        m[X_SINCE + kind] = 0.0  # the level estimator has it
    if kind not in (K_FIX, K_VELOCITY, K_HEADING):
        return
    rows, R, y = np.zeros((3, N_BLIND)), np.empty((2, 2)), np.empty(2)
    H, dx = rows[:2], rows[2]
    P = m[X_BLIND_COV:X_BLIND_ON].reshape((N_BLIND, N_BLIND))
    gate = _gate(m, kind, len(y))
    if gate == math.inf:
        _start_blind(m)  # what contradicts the aids for so long was wrong from its first fix
    _blind_model(m, kind, z, cov, age, _level_yaw(L), H, R, y)
    nis = kalman_update(P, H, R, y, len(y), dx, gate)
    _judge(m, kind, nis, len(y), gate)
    if nis <= gate:
        if kind == K_FIX:
            _follow_slow_error(m, cov)
        _blind_correct(m, kind, z, cov, age, dx)


@_inlined
def _take(m, aid, age, L):
    """Take a measurement, valid `age` s before the sample L, into whatever runs.

    The cascade's filters are blocks of one covariance, so that one update serves all.
    """
    kind, z, cov = int(aid[A_KIND]), aid[A_VALUE:A_COV], aid[A_COV:].reshape((3, 3))
    if m[X_PHASE] == 0.0:
        _take_starting(m, kind, z, cov, age, L)
        return
    cascade, steady = m[P_CASCADE] == 1.0, m[P_CASCADE] == 1.0 and m[P_STEADY] == 1.0
    if steady and kind == K_ALTITUDE:
        return
    rows, small = np.empty((4, N)), np.zeros((4, 3))
    H, dx, R, y = rows[:3], rows[3], small[:3], small[3]
    P = m[X_COV:X_RATE].reshape((N, N))
    d = measurement_model(m, kind, z, age, H, y)
    if d == 0:
        return
    for i in range(N):
        dx[i] = 0.0
    for i in range(3):
        for j in range(3):
            R[i, j] = cov[i, j]
    gate = _gate(m, kind, d)
    if gate == math.inf:
        _open(m, P, kind, y, d)
    if steady and kind == K_FIX:
        nis = _steady_update(m, P, y, R, gate)
    elif steady and kind == K_VELOCITY:
        nis = 0.0
    else:
        nis = kalman_update(P, H, R, y, d, dx, gate)
    _judge(m, kind, nis, d, gate)
    if not nis <= gate:
        return
    if kind == K_FIX:
        _follow_slow_error(m, cov)
    _correct(m, dx)
    if cascade and kind == K_VELOCITY and _level_by_velocity(m, z, cov, age, H, R, y):
        level_gate = m[P_GATE] + 6.0
        if kalman_update(P, H, R, y, len(y), dx, level_gate) <= level_gate:
            _correct(m, dx)


@_inlined
def _change_phase(m, L, tilt):
    """Begin to navigate, or go back to the start, where it is time.

    Returns whether the level estimator's tilt is to be taken, which is then filled in: now and then, where nothing
    else shows it.
    """
    if m[X_PHASE] == 0.0:
        if L[L_VALID] == 1.0 and _may_navigate(m):
            _start_navigating(m, L)
        return False
    if m[X_COV + (N + 1) * (TH + 2)] > HEADING_LOST_STD**2:
        m[X_PHASE] = 0.0
        m[X_LOST] += 1.0
        _start_blind(m)
        return False
    aided = min(m[X_SINCE + K_FIX], m[X_SINCE + K_VELOCITY], m[X_SINCE + K_INCLINOMETER])
    if L[L_VALID] == 0.0 or aided <= AIDING_TIMEOUT or m[X_SINCE + K_LEVEL] <= TILT_PERIOD:
        return False
    m[X_SINCE + K_LEVEL] = 0.0
    c = np.empty((3, 3))
    _dcm(L[L_Q:L_TILT], c)
    tilt[A_KIND] = K_LEVEL
    variance = 0.5 * (L[L_TILT] + L[L_TILT + 2]) * TILT_CORRELATION / TILT_PERIOD
    for i in range(3):
        tilt[A_VALUE + i] = c[2, i]
        for j in range(3):
            tilt[A_COV + 3 * i + j] = variance if i == j else 0.0
    return True


@_inlined
def _write_output(m, L, out):
    """Fill one row of output from the state and the last sample."""
    for i in range(OUT_SIZE):
        out[i] = 0.0
    C = out[OUT_COV:OUT_BG_VAR].reshape((9, 9))
    if m[X_PHASE] == 0.0:
        _write_start(m, L, out, C)
        return
    out[OUT_VALID] = out[OUT_HEADING] = out[OUT_NAVIGATING] = 1.0
    for i in range(OUT_GYRO - OUT_Q):
        out[OUT_Q + i] = m[X_Q + i]
    out[OUT_REF] = m[X_REF]
    for i in range(3):
        out[OUT_GYRO + i] = L[L_GYRO + i] + L[L_BG + i] - m[X_BG + i]
        out[OUT_ACCEL + i] = L[L_ACCEL + i] + L[L_BA + i] - m[X_BA + i]
    P = m[X_COV:X_RATE].reshape((N, N))
    for i in range(9):
        for j in range(9):
            C[i, j] = P[i if i < 3 else V + i - 3, j if j < 3 else V + j - 3]
    cascade = m[P_CASCADE] == 1.0
    for i in range(3):
        C[6 + i, 6 + i] += m[X_SLOW + i]
        out[OUT_BG_VAR + i] = P[BG + i, BG + i]
        out[OUT_BA_VAR + i] = m[P_ACCEL_BIAS_STD] ** 2 if cascade else P[BA + i, BA + i]


@_inlined
def _write_start(m, L, out, C):
    """Before it navigates: the level estimator's tilt, the blind start's heading, position and velocity."""
    q = out[OUT_Q:OUT_V]
    out[OUT_VALID] = L[L_VALID]
    variance = blind_heading_variance(m)
    known = variance < UNKNOWN_VARIANCE
    heading = math.atan2(m[X_BLIND + BC + 1], m[X_BLIND + BC]) if known else 0.0
    q[0] = 1.0
    if L[L_VALID] == 1.0:
        for i in range(4):
            q[i] = L[L_Q + i]
        _turn_navigation(q, 0.0, 0.0, heading)
    out[OUT_HEADING] = 1.0 if known else 0.0
    c, s = math.cos(heading), math.sin(heading)
    nn, ne, ee = L[L_TILT], L[L_TILT + 1], L[L_TILT + 2]
    C[0, 0] = c * c * nn - 2.0 * c * s * ne + s * s * ee
    C[1, 1] = s * s * nn + 2.0 * c * s * ne + c * c * ee
    C[0, 1] = C[1, 0] = c * s * (nn - ee) + (c * c - s * s) * ne
    C[2, 2] = variance
    B = m[X_BLIND_COV:X_BLIND_ON].reshape((N_BLIND, N_BLIND))
    for i in range(2):
        C[3 + i, 3 + i] = C[6 + i, 6 + i] = UNKNOWN_VARIANCE
        if m[X_BLIND_ON] == 1.0:
            out[OUT_V + i], C[3 + i, 3 + i] = m[X_BLIND + BV + i], min(B[BV + i, BV + i], UNKNOWN_VARIANCE)
            out[OUT_P + i], C[6 + i, 6 + i] = m[X_BLIND + i], min(B[i, i] + m[X_SLOW + i], UNKNOWN_VARIANCE)
    out[OUT_V + 2], C[5, 5] = L[L_VD], L[L_VD_VAR]
    out[OUT_P + 2], C[8, 8] = -L[L_ALTITUDE], L[L_ALTITUDE_VAR]
    if m[X_DOWN_FIX + 1] > 0.0:
        # Height in the frame of the fixes.
        out[OUT_P + 2] = m[X_DOWN_FIX] + m[X_DOWN_FIX + 2] * L[L_VD]
        C[8, 8] = m[X_DOWN_FIX + 1] + m[X_SLOW + 2] + m[X_DOWN_FIX + 2] ** 2 * L[L_VD_VAR]
    for i in range(3):
        out[OUT_BG + i], out[OUT_BA + i] = L[L_BG + i], L[L_BA + i]
        out[OUT_BG_VAR + i], out[OUT_BA_VAR + i] = L[L_BG_VAR + i], L[L_BA_VAR + i]
        out[OUT_GYRO + i], out[OUT_ACCEL + i] = L[L_GYRO + i], L[L_ACCEL + i]


# --- the time buffer --------------------------------------------------------------------------------


@_inlined
def _integers(m):
    return m[M_INTS:M_HISTORY].view(np.int64)


@_inlined
def _remembered(m, at):
    """Return what is remembered of the sample with this number."""
    row = M_HISTORY + at % HISTORY * L_SIZE
    return m[row:row + L_SIZE]


@_inlined
def _keep(m, ints):
    """Keep the state now and then."""
    at = ints[I_AT]
    if at % SNAPSHOTS == 0:
        kept = M_SNAPSHOTS + at % HISTORY // SNAPSHOTS * STATE_SIZE
        for k in range(STATE_SIZE):
            m[kept + k] = m[k]


@njit(inline="always")
def _settle(m, ints):
    """Step over what is remembered and not in the state yet: at each sample the measurements up to its stamp.

    The phase changes with the sample after, when all that was valid before has come.
    """
    tilt = np.empty(A_SIZE)
    while True:
        at = ints[I_AT]
        stamp, L = ints[I_STAMPS + at % HISTORY], _remembered(m, at)
        if ints[I_NEXT] < ints[I_QUEUED] and ints[I_QUEUE_STAMPS + ints[I_NEXT]] <= stamp:
            age = (stamp - ints[I_QUEUE_STAMPS + ints[I_NEXT]]) * 1e-9
            aid = m[M_QUEUE + ints[I_NEXT] * A_SIZE:M_QUEUE + (ints[I_NEXT] + 1) * A_SIZE]
            ints[I_NEXT] += 1
        else:
            _keep(m, ints)
            if at == ints[I_COUNT] - 1:
                break
            if not _change_phase(m, L, tilt):
                ints[I_AT] = at + 1
                _carry(m, _remembered(m, at + 1))
                continue
            age, aid = 0.0, tilt
        _take(m, aid, age, L)


@_inlined
def _remember(m, ints, stamp, sample):
    """Remember a sample whose stamp is later than the last one; a long gap before it makes it the first."""
    at = ints[I_COUNT]
    dt = (stamp - ints[I_LAST_STAMP]) * 1e-9
    if at > 0 and dt > m[P_GAP_LIMIT]:
        ints[I_FAULTS + F_RESTARTED] += 1
        _restart(m, ints)
        at = 0
    L = _remembered(m, at)
    for k in range(L_SIZE):
        L[k] = sample[k]
    L[L_DT] = dt
    ints[I_COUNT] = at + 1
    ints[I_STAMPS + at % HISTORY] = ints[I_LAST_STAMP] = stamp
    if at == 0:
        for i in range(3):
            m[X_GYRO_LP + i], m[X_ACCEL_LP + i] = L[L_GYRO + i] + L[L_BG + i], L[L_ACCEL + i] + L[L_BA + i]


@_inlined
def _place_of(m, ints, stamp, kind):
    """Return where a measurement belongs in the queue, or -1 where one of its kind and stamp is there.

    Those of one stamp are ordered by their kinds, so that it does not matter which came first.
    """
    place = ints[I_QUEUED]
    while place > 0:
        before, other = ints[I_QUEUE_STAMPS + place - 1], m[M_QUEUE + (place - 1) * A_SIZE]
        if before == stamp and other == kind:
            return -1
        if before < stamp or (before == stamp and other < kind):
            break
        place -= 1
    return place


@_inlined
def _insert(m, ints, stamp, aid):
    """Take a measurement where it belongs in time; return COUNTS, EARLY or the fault.

    One that is ahead of the samples waits for them; a late one takes the filter back to before its stamp.
    """
    if ints[I_COUNT] == 0:
        return EARLY
    if stamp > ints[I_LAST_STAMP] + AHEAD_LIMIT:
        return F_AHEAD
    place = _place_of(m, ints, stamp, aid[A_KIND])
    if place < 0:
        return F_DUPLICATE
    last, oldest = ints[I_COUNT] - 1, max(ints[I_COUNT] - HISTORY, 0)
    before = last  # the sample before the measurement
    while before >= oldest and ints[I_STAMPS + before % HISTORY] >= stamp:
        before -= 1
    # Between the last two samples, and the last of all: taken as it comes, as going back would come to.
    late = before < last and not (before == last - 1 and place == ints[I_NEXT] and place == ints[I_QUEUED])
    origin = before - before % SNAPSHOTS
    if late and (before < oldest or origin < oldest or ints[I_STAMPS + origin % HISTORY] < ints[I_FORGOTTEN]
                 or ints[I_LAST_STAMP] - stamp > np.int64(m[P_BUFFER] * 1e9)):
        return F_LATE
    _queue(m, ints, place, stamp, aid)
    if late:
        _go_back(m, ints, origin)
    return COUNTS


@_inlined
def _queue(m, ints, place, stamp, aid):
    """Put a measurement into the queue; a full one loses its older half."""
    if ints[I_QUEUED] == QUEUE:
        half = QUEUE // 2
        ints[I_FORGOTTEN] = ints[I_QUEUE_STAMPS + half - 1]
        for k in range(half, QUEUE):
            _move(m, ints, k, k - half)
        ints[I_QUEUED] -= half
        ints[I_NEXT] = max(ints[I_NEXT] - half, 0)
        place = max(place - half, 0)
    for k in range(ints[I_QUEUED], place, -1):
        _move(m, ints, k - 1, k)
    ints[I_QUEUE_STAMPS + place] = stamp
    for k in range(A_SIZE):
        m[M_QUEUE + place * A_SIZE + k] = aid[k]
    ints[I_QUEUED] += 1


@_inlined
def _move(m, ints, source, target):
    ints[I_QUEUE_STAMPS + target] = ints[I_QUEUE_STAMPS + source]
    for k in range(A_SIZE):
        m[M_QUEUE + target * A_SIZE + k] = m[M_QUEUE + source * A_SIZE + k]


@_inlined
def _go_back(m, ints, origin):
    """Go back to the sample `origin`, after which the state was kept."""
    kept = M_SNAPSHOTS + origin % HISTORY // SNAPSHOTS * STATE_SIZE
    for k in range(STATE_SIZE):
        m[k] = m[kept + k]
    stamp = ints[I_STAMPS + origin % HISTORY]
    ints[I_NEXT] = ints[I_QUEUED]
    while ints[I_NEXT] > 0 and ints[I_QUEUE_STAMPS + ints[I_NEXT] - 1] > stamp:
        ints[I_NEXT] -= 1
    ints[I_AT] = origin


@_inlined
def _restart(m, ints):
    """Forget state and history; faults and the origin stay."""
    ints[I_FAULTS + F_LOST] += int(m[X_LOST])
    for k in range(STATE_SIZE):
        m[k] = 0.0
    m[X_Q] = 1.0
    for k in range(N_KINDS):
        m[X_SINCE + k] = NEVER
    _start_blind(m)
    for k in range(I_FAULTS):
        ints[k] = 0


@_inlined
def _set_origin(m, latitude, height, gravity):
    """Let the Earth turn beneath from now on."""
    w2 = 1.0 - ECCENTRICITY2 * math.sin(latitude) ** 2
    transverse = SEMI_MAJOR / math.sqrt(w2)
    m[M_EARTH], m[M_EARTH + 1], m[M_EARTH + 4] = 1.0, latitude, height
    m[M_EARTH + 2], m[M_EARTH + 3] = transverse * (1.0 - ECCENTRICITY2) / w2 + height, transverse + height
    m[P_GRAVITY] = gravity


@_inlined
def _give(m, ints, stamp, aid):
    """Put a measurement where it belongs, or do what its kind says; return what became of it."""
    if aid[A_KIND] == K_RESET:
        _restart(m, ints)
        m[M_EARTH], m[P_GRAVITY] = 0.0, aid[A_VALUE + 2]
        return COUNTS
    if aid[A_KIND] == K_ORIGIN:
        _set_origin(m, aid[A_VALUE], aid[A_VALUE + 1], aid[A_VALUE + 2])
        return COUNTS
    done = _insert(m, ints, stamp, aid)
    if done >= 0 and aid[A_KIND] != K_ALTITUDE:  # the level estimator counts those
        ints[I_FAULTS + done] += 1
    return done


# --- from Python ------------------------------------------------------------------------------------


@compiled
def run(m, stamps, samples, aid_stamps, aids, arrival, out, done):
    """Feed samples and measurements in recorded order.

    Parameters
    ----------
    m : (MEMORY_SIZE,)
    stamps : (N,) int64
        Each later than the one before, ns.
    samples : (N, L_SIZE)
    aid_stamps : (M,) int64, aids : (M, A_SIZE)
    arrival : (M,) int64
        How many of the samples had come before each.
    out : (N, OUT_SIZE)
        Filled: the estimate after each sample.
    done : (M,) int64
        Filled: what became of each measurement, COUNTS, EARLY or the fault.
    """
    ints, j, k = _integers(m), 0, 0
    while j < len(arrival) or k < len(stamps):
        is_sample = j == len(arrival) or (k < len(stamps) and arrival[j] > k)
        if is_sample:
            _remember(m, ints, stamps[k], samples[k])
        else:
            done[j] = _give(m, ints, aid_stamps[j], aids[j])
            j += 1
        if ints[I_COUNT] > 0:
            _settle(m, ints)
        if is_sample:
            _write_output(m, _remembered(m, ints[I_AT]), out[k])
            k += 1
