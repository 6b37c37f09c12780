"""Compiled kernels of the navigation filters: closed forms, both filters, the start, the time buffer.

One flat float64 array holds state, parameters and history, as in :mod:`attitude_estimator._kernels`, so that a
snapshot is one copy; this file is the only place that knows positions in it. Attitude errors are small rotations
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
(K_FIX, K_VELOCITY, K_ALTITUDE, K_INCLINOMETER, K_HEADING, K_LEVEL) = range(len(KINDS))

(X_PHASE, X_Q, X_V, X_P, X_BG, X_BA, X_REF, X_COV, X_RATE, X_ACC,
 X_BLIND, X_BLIND_COV, X_BLIND_ON, X_DOWN_FIX, X_DOWN_VEL,
 X_INTERVAL, X_GYRO_LP, X_ACCEL_LP, X_GYRO_SPREAD, X_ACCEL_SPREAD,
 X_SINCE, X_NIS, X_USED, X_REFUSED, X_REFUSING,
 X_DRIFT, X_DVEL, X_DVEL_TIME, X_LAST_VELOCITY,
 STATE_SIZE) = _offsets(
    1,  # PHASE: 0 levelling or looking for the heading, 1 navigating
    4, 3, 3, 3, 3, 1, N * N,  # q_nb_wxyz, velocity, position, biases, altimeter's zero, covariance
    3, 3,  # RATE of the body rad/s and ACC of the IMU m/s^2 NED, both of the last step
    N_BLIND, N_BLIND**2, 1,  # the heading's blind start; 1 once it has been aided
    3, 3,  # last down position and down velocity of the aids: value, variance, age s
    1, 3, 3, 1, 1,  # mean interval; low-passed sample; its squared distance from it
    6, 6, 6, 6, 6,  # of each kind: s since used, NIS over its mean, used, refused, s of refusing
    3, 3, 1, 4)  # cascade: acceleration error NED; velocity gained by force and in what time; last velocity, known
PARAMETER_NAMES = (
    "cascade", "steady", "local_gravity", "gyro_noise_density", "gyro_rate_error", "accel_noise_density",
    "accel_force_error", "gyro_bias_walk", "accel_bias_std", "accel_bias_time", "altitude_drift_density",
    "altitude_scale_error", "innovation_gate", "recovery_time", "heading_start_std", "cascade_bias_std",
    "cascade_bias_time", "axis_frequency", "fix_interval", "antenna_x", "antenna_y", "antenna_z")

# One row of output.
(OUT_VALID, OUT_HEADING, OUT_NAVIGATING, OUT_Q, OUT_V, OUT_P, OUT_BG, OUT_BA, OUT_GYRO, OUT_ACCEL, OUT_COV,
 OUT_BG_VAR, OUT_BA_VAR, OUT_REF, OUT_SIZE) = _offsets(
    1, 1, 1, 4, 3, 3, 3, 3, 3, 3,
    81,  # covariance of attitude, velocity, position
    3, 3, 1)

# One row of history: a sample, then what the level estimator makes of it: north and east force, yaw, densities
# squared of the force's and the yaw's error.
(H_DT, H_GYRO, H_ACCEL, H_ACCEL_VAR, H_NORTH, H_EAST, H_YAW, H_FORCE_DENSITY2, H_YAW_DENSITY2,
 H_SIZE) = _offsets(1, 3, 3, 1, 1, 1, 1, 1, 1)
# What the level estimator says with each sample.
(L_VALID, L_Q, L_TILT, L_VD, L_ALTITUDE, L_VD_VAR, L_ALTITUDE_VAR, L_BG, L_BA, L_BG_VAR, L_BA_VAR, L_GYRO,
 L_ACCEL, L_SIZE) = _offsets(1, 4, 3, 1, 1, 1, 1, 3, 3, 3, 3, 3, 3)
(M_STATE, M_PARAMETERS, M_EARTH, MEMORY_SIZE) = _offsets(STATE_SIZE, len(PARAMETER_NAMES), 4)
(P_CASCADE, P_STEADY, P_GRAVITY, P_GYRO_NOISE, P_RATE_ERROR, P_ACCEL_NOISE, P_FORCE_ERROR, P_GYRO_WALK,
 P_ACCEL_BIAS_STD, P_ACCEL_BIAS_TIME, P_ALT_DRIFT, P_ALT_SCALE, P_GATE, P_RECOVERY, P_HEADING_STD,
 P_AXIS_BIAS_STD, P_AXIS_BIAS_TIME, P_AXIS_FREQUENCY, P_FIX_INTERVAL, P_ANTENNA) = range(
     M_PARAMETERS, M_PARAMETERS + 20)

# M_EARTH: 1 once there is a place; latitude and the radii (m) of the origin.
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
NOTHING, STARTED, LOST, TILT = range(4)  # what change_phase did or asks for

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


@_inlined
def kalman_update(P, H, R, y, dx, gate):
    """Update P in Joseph form and fill dx, unless the innovation fails the gate.

    Parameters
    ----------
    P : (n, n), H : (d or more, n), R : (d or more, d or more), y : (d,), dx : (n,)
    gate : float
        Largest normalised squared innovation.

    Returns
    -------
    float
        The normalised squared innovation (NIS); above `gate` nothing was changed.
    """
    n, d = len(P), len(y)
    # W = H P and K are held as rows of n, so that the inner loops run along memory.
    W, K, L = np.zeros((d, n)), np.empty((d, n)), np.empty((d + 1, d))
    u = L[d]
    for a in range(d):
        for j in range(n):
            h = H[a, j]
            if h != 0.0:
                for i in range(n):
                    W[a, i] += h * P[j, i]
    nis = 0.0
    for a in range(d):
        # Cholesky factor of S = H P H^T + R, its diagonal inverted, and the whitened innovation.
        for b in range(a + 1):
            s = R[a, b]
            for j in range(n):
                s += H[a, j] * W[b, j]
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
        dx[i] = 0.0
        for a in range(d - 1, -1, -1):
            s = K[a, i]
            for k in range(a + 1, d):
                s -= L[k, a] * K[k, i]
            K[a, i] = s * L[a, a]
            dx[i] += K[a, i] * y[a]
    for i in range(n):
        for a in range(d):
            gain = K[a, i]
            for j in range(n):
                P[i, j] -= gain * W[a, j]
    # That was (I - K H) P; now times (I - K H)^T, plus K R K^T.
    for a in range(d):
        for i in range(n):
            s = 0.0
            for j in range(n):
                s += P[i, j] * H[a, j]
            for b in range(d):
                s -= K[b, i] * R[b, a]
            W[a, i] = s
    for i in range(n):
        for j in range(i + 1):
            s = P[i, j] + P[j, i]
            for a in range(d):
                s -= W[a, i] * K[a, j] + W[a, j] * K[a, i]
            P[i, j] = P[j, i] = 0.5 * s
    return nis


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
    """
    work = np.empty((7, 3, 3))
    theta, psi, q11, q12, c, a, t = work[0], work[1], work[2], work[3], work[4], work[5], work[6]
    attitude_model(w, dt, gyro_density, walk_density, theta, psi, q11, q12)
    _dcm(q, c)
    for i in range(3):
        q11[i, i] += angle_var
    for i in range(3):
        for j in range(3):
            a[i, j] = -(c[i, 0] * psi[0, j] + c[i, 1] * psi[1, j] + c[i, 2] * psi[2, j])
            t[i, j] = c[i, 0] * q11[0, j] + c[i, 1] * q11[1, j] + c[i, 2] * q11[2, j]
    for j in range(6):
        for i in range(3):
            P[i, j] += a[i, 0] * P[3, j] + a[i, 1] * P[4, j] + a[i, 2] * P[5, j]
    for i in range(6):
        for j in range(3):
            P[i, j] += a[j, 0] * P[i, 3] + a[j, 1] * P[i, 4] + a[j, 2] * P[i, 5]
    for i in range(3):
        P[3 + i, 3 + i] += walk_density * walk_density * dt
        for j in range(3):
            x = c[i, 0] * q12[0, j] + c[i, 1] * q12[1, j] + c[i, 2] * q12[2, j]
            P[i, 3 + j] += x
            P[3 + j, i] += x
            P[i, j] += t[i, 0] * c[j, 0] + t[i, 1] * c[j, 1] + t[i, 2] * c[j, 2]


@compiled
def mekf_vector_update(q, bias, P, measured_b, reference_n, R, gate):
    """Update by a direction or vector known in the navigation frame; return the NIS.

    ``z = C_true v_n = v_b + [v_b x] C theta``, so ``H = [[v_b x] C, 0]``.
    """
    work, H, dx = np.empty((5, 3)), np.zeros((3, 6)), np.empty(6)
    c, b, y = work[:3], work[3], work[4]
    _dcm(q, c)
    for i in range(3):
        b[i] = c[0, i] * reference_n[0] + c[1, i] * reference_n[1] + c[2, i] * reference_n[2]
        y[i] = measured_b[i] - b[i]
    for j in range(3):
        H[0, j] = b[1] * c[j, 2] - b[2] * c[j, 1]
        H[1, j] = b[2] * c[j, 0] - b[0] * c[j, 2]
        H[2, j] = b[0] * c[j, 1] - b[1] * c[j, 0]
    nis = kalman_update(P, H, R, y, dx, gate)
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
    nis = kalman_update(P, H, R, y, dx, gate)
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
    meridian = transverse * (1.0 - ECCENTRICITY2) / w2
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
    """Replace P by F P F^T: F times each column, then each row times F^T."""
    h = 0.5 * dt
    for by_column in range(2):
        for k in range(N):
            A = P[k] if by_column else P[:, k]
            t0, t1, t2 = A[0], A[1], A[2]
            g0 = D[0, 0] * A[BG] + D[0, 1] * A[BG + 1] + D[0, 2] * A[BG + 2]
            g1 = D[1, 0] * A[BG] + D[1, 1] * A[BG + 1] + D[1, 2] * A[BG + 2]
            g2 = D[2, 0] * A[BG] + D[2, 1] * A[BG + 1] + D[2, 2] * A[BG + 2]
            # theta acts through u = D f: -u x theta, and the gyro bias through theta's mean over dt.
            m0, m1, m2 = t0 - 0.5 * g0, t1 - 0.5 * g1, t2 - 0.5 * g2
            d0 = -(u[1] * m2 - u[2] * m1) - (
                D[0, 0] * A[BA] + D[0, 1] * A[BA + 1] + D[0, 2] * A[BA + 2])
            d1 = -(u[2] * m0 - u[0] * m2) - (
                D[1, 0] * A[BA] + D[1, 1] * A[BA + 1] + D[1, 2] * A[BA + 2])
            d2 = -(u[0] * m1 - u[1] * m0) - (
                D[2, 0] * A[BA] + D[2, 1] * A[BA + 1] + D[2, 2] * A[BA + 2])
            A[POS] += dt * A[V] + h * d0
            A[POS + 1] += dt * A[V + 1] + h * d1
            A[POS + 2] += dt * A[V + 2] + h * d2
            A[V] += d0
            A[V + 1] += d1
            A[V + 2] += d2
            A[0], A[1], A[2] = t0 - g0, t1 - g1, t2 - g2
            A[BA] *= decay
            A[BA + 1] *= decay
            A[BA + 2] *= decay


@_inlined
def _eskf_predict(m, P, dt, w, f, gyro_var, accel_var):
    """Carry the filter over dt (s); w and f less their biases, variances (rad^2, m^2/s^2) on top of the noise."""
    D, u = np.empty((3, 3)), np.empty(3)
    _carry_mean(m, w, f, dt, D, u)
    decay = max(1.0 - dt / m[P_ACCEL_BIAS_TIME], 0.0)
    _carry_covariance(P, D, u, dt, decay)
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
        P[POS + i, POS + i] += dt * dt * q_velocity / 3.0
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


@compiled
def start_blind(m):
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
    """Fill rows, covariance and innovation of what the blind start takes; return how many rows count."""
    if kind not in (K_FIX, K_VELOCITY, K_HEADING):
        return 0
    for i in range(2):
        for j in range(2):
            R[i, j] = cov[i, j]
        if kind == K_HEADING:
            angle = z[0] - level_yaw
            y[i] = (math.sin(angle) if i else math.cos(angle)) - m[X_BLIND + BC + i]
            H[i, BC + i], R[i, i] = 1.0, cov[0, 0]
        elif kind == K_FIX:
            y[i] = z[i] - m[X_BLIND + i] + age * m[X_BLIND + BV + i]
            H[i, i], H[i, BV + i] = 1.0, -age
            R[i, i] += _arm2(m)
        else:
            y[i] = z[i] - m[X_BLIND + BV + i]
            H[i, BV + i] = 1.0
    return 2


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


# --- from Python ------------------------------------------------------------------------------------


@_inlined
def _track(m, dt, row):
    """Follow the mean interval and how much the samples vary; return what a lost part of dt may have held."""
    usual = m[X_INTERVAL] if m[X_INTERVAL] > 0.0 else dt
    lost = max(dt - 1.5 * usual, 0.0) * (dt - usual)
    m[X_INTERVAL] = usual + 0.02 * (min(dt, 2.0 * usual) - usual)
    gain = dt / (LOWPASS_TIME + dt)
    dw2 = df2 = 0.0
    for i in range(3):
        dw, df = row[H_GYRO + i] - m[X_GYRO_LP + i], row[H_ACCEL + i] - m[X_ACCEL_LP + i]
        m[X_GYRO_LP + i] += gain * dw
        m[X_ACCEL_LP + i] += gain * df
        dw2 += dw * dw
        df2 += df * df
    m[X_GYRO_SPREAD] += gain * (dw2 - m[X_GYRO_SPREAD])
    m[X_ACCEL_SPREAD] += gain * (df2 - m[X_ACCEL_SPREAD])
    return lost * m[X_GYRO_SPREAD] / 3.0, lost * m[X_ACCEL_SPREAD]


@compiled
def fill_row(m, L, dt, force_known, row):
    """Fill one row of history: the sample of the dt (s) before it and what the level estimator makes of it."""
    for i in range(H_SIZE):
        row[i] = 0.0
    row[H_DT] = dt
    for i in range(3):
        row[H_GYRO + i] = L[L_GYRO + i] + L[L_BG + i]
        row[H_ACCEL + i] = L[L_ACCEL + i] + L[L_BA + i]
    row[H_ACCEL_VAR] = 0.0 if force_known else (dt * UNKNOWN_ACCEL_STD) ** 2
    row[H_FORCE_DENSITY2], row[H_YAW_DENSITY2] = UNKNOWN_ACCEL_STD**2, 0.1
    if L[L_VALID] == 1.0:
        c = np.empty((3, 3))
        _dcm(L[L_Q:L_TILT], c)
        bias_var = 0.0
        for i in range(3):
            row[H_NORTH] += c[0, i] * L[L_ACCEL + i]
            row[H_EAST] += c[1, i] * L[L_ACCEL + i]
            bias_var += c[2, i] ** 2 * L[L_BG_VAR + i]
        row[H_YAW] = math.atan2(c[1, 0], c[0, 0])
        tilt = L[L_TILT] + L[L_TILT + 2]
        row[H_FORCE_DENSITY2] = m[P_ACCEL_NOISE] ** 2 + m[P_GRAVITY] ** 2 * tilt * TILT_TIME
        row[H_YAW_DENSITY2] = m[P_GYRO_NOISE] ** 2 + 2.0 * YAW_BIAS_TIME * bias_var


@compiled
def carry(m, row):
    """Carry whatever runs over one row of history."""
    dt = row[H_DT]
    for k in range(N_KINDS):
        m[X_SINCE + k] += dt
        if m[X_REFUSING + k] > 0.0:
            m[X_REFUSING + k] += dt
    gyro_var, accel_var = _track(m, dt, row)
    accel_var += row[H_ACCEL_VAR]
    if m[X_PHASE] == 0.0:
        m[X_DOWN_FIX + 2] += dt
        m[X_DOWN_VEL + 2] += dt
        blind_predict(m[X_BLIND:X_BLIND_COV], m[X_BLIND_COV:X_BLIND_ON].reshape((N_BLIND, N_BLIND)), dt,
                      row[H_NORTH], row[H_EAST], row[H_FORCE_DENSITY2] + accel_var / dt,
                      row[H_YAW_DENSITY2] + gyro_var / dt)
        return
    w, f = np.empty(3), np.empty(3)
    for i in range(3):
        w[i] = row[H_GYRO + i] - m[X_BG + i]
        f[i] = row[H_ACCEL + i] - m[X_BA + i]
        m[X_RATE + i] = w[i]
    P = m[X_COV:X_RATE].reshape((N, N))
    if m[P_CASCADE] == 1.0:
        _cascade_predict(m, P, dt, w, f, gyro_var, accel_var)
    else:
        _eskf_predict(m, P, dt, w, f, gyro_var, accel_var)


@compiled
def take(m, kind, z, cov, age, level_yaw):
    """Take a measurement, valid `age` s ago, into whatever runs; the yaw is that of the level frame now.

    The cascade's filters are blocks of one covariance, so that one update serves all.
    """
    H, R, y, dx = np.zeros((3, N)), np.empty((3, 3)), np.zeros(3), np.zeros(N)
    starting, cascade, steady = m[X_PHASE] == 0.0, m[P_CASCADE] == 1.0, m[P_STEADY] == 1.0
    if starting:
        P = m[X_BLIND_COV:X_BLIND_ON].reshape((N_BLIND, N_BLIND))
        d = _blind_model(m, kind, z, cov, age, level_yaw, H, R, y)
        if kind == K_ALTITUDE:
            m[X_SINCE + kind] = 0.0  # the level estimator has it
    else:
        P = m[X_COV:X_RATE].reshape((N, N))
        d = measurement_model(m, kind, z, age, H, y)
        for i in range(3):
            for j in range(3):
                R[i, j] = cov[i, j]
    steady = cascade and steady and not starting
    if d == 0 or (steady and kind == K_ALTITUDE):
        return
    gate = _gate(m, kind, d)
    if gate == math.inf and not starting:
        _open(m, P, kind, y, d)
    if steady and kind == K_FIX:
        nis = _steady_update(m, P, y, R, gate)
    elif steady and kind == K_VELOCITY:
        nis = 0.0
    else:
        nis = kalman_update(P, H, R, y[:d], dx, gate)
    _judge(m, kind, nis, d, gate)
    if not nis <= gate:
        return
    if starting:
        _blind_correct(m, kind, z, cov, age, dx)
        return
    _correct(m, dx)
    if cascade and kind == K_VELOCITY and _level_by_velocity(m, z, cov, age, H, R, y):
        level_gate = m[P_GATE] + 6.0
        if kalman_update(P, H, R, y, dx, level_gate) <= level_gate:
            _correct(m, dx)


@compiled
def change_phase(m, L):
    """Begin to navigate or go back to the start where it is time; return what was done, of NOTHING to TILT."""
    if m[X_PHASE] == 0.0:
        if L[L_VALID] == 1.0 and _may_navigate(m):
            _start_navigating(m, L)
            return STARTED
        return NOTHING
    if m[X_COV + (N + 1) * (TH + 2)] > HEADING_LOST_STD**2:
        m[X_PHASE] = 0.0
        start_blind(m)
        return LOST
    aided = min(m[X_SINCE + K_FIX], m[X_SINCE + K_VELOCITY], m[X_SINCE + K_INCLINOMETER])
    if L[L_VALID] == 1.0 and aided > AIDING_TIMEOUT and m[X_SINCE + K_LEVEL] > TILT_PERIOD:
        return TILT
    return NOTHING


@compiled
def write_output(m, L, row, out):
    """Fill one row of output from the state, the level estimator and the last row of history."""
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
        out[OUT_GYRO + i] = row[H_GYRO + i] - m[X_BG + i]
        out[OUT_ACCEL + i] = row[H_ACCEL + i] - m[X_BA + i]
    P = m[X_COV:X_RATE].reshape((N, N))
    for i in range(9):
        for j in range(9):
            C[i, j] = P[i if i < 3 else V + i - 3, j if j < 3 else V + j - 3]
    cascade = m[P_CASCADE] == 1.0
    for i in range(3):
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
            out[OUT_P + i], C[6 + i, 6 + i] = m[X_BLIND + i], min(B[i, i], UNKNOWN_VARIANCE)
    out[OUT_V + 2], C[5, 5] = L[L_VD], L[L_VD_VAR]
    out[OUT_P + 2], C[8, 8] = -L[L_ALTITUDE], L[L_ALTITUDE_VAR]
    if m[X_DOWN_FIX + 1] > 0.0:
        # Height in the frame of the fixes.
        out[OUT_P + 2] = m[X_DOWN_FIX] + m[X_DOWN_FIX + 2] * L[L_VD]
        C[8, 8] = m[X_DOWN_FIX + 1] + m[X_DOWN_FIX + 2] ** 2 * L[L_VD_VAR]
    for i in range(3):
        out[OUT_BG + i], out[OUT_BA + i] = L[L_BG + i], L[L_BA + i]
        out[OUT_BG_VAR + i], out[OUT_BA_VAR + i] = L[L_BG_VAR + i], L[L_BA_VAR + i]
        out[OUT_GYRO + i], out[OUT_ACCEL + i] = L[L_GYRO + i], L[L_ACCEL + i]
