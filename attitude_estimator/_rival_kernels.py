"""Compiled kernels of the other ways to find roll and pitch: one sample, one altitude, a recording.

One estimator is a flat float64 array and a few integers. The layouts below are of this file only, because
compiled code is cached per file. A Kalman filter has its attitude in the first states and velocity down and
altitude in the last two; the others have no states. Whatever the method, Q is an attitude that the gyro
carries and whose down axis is then turned the shortest way to the method's own, so its heading is the
integrated gyro. Equations: ``docs/attitude.md``. Frames and units: :mod:`inertial`.
"""

import math

import numpy as np

from inertial._kernels import compiled, zoh_coefficients
from inertial.rotation import zoh_integrals

MODELS = ("dcm_row5_gamma", "euler_ukf", "euler_ukf_first_order", "euler_ekf", "euler_ekf_first_order",
          "quaternion_ekf", "complementary", "complementary_literal", "accelerometer", "gyro", "gyro_euler")
(GAMMA, EULER_UKF, EULER_UKF_FIRST_ORDER, EULER_EKF, EULER_EKF_FIRST_ORDER, QUATERNION_EKF,
 COMPLEMENTARY, COMPLEMENTARY_LITERAL, ACCELEROMETER, GYRO, GYRO_EULER) = range(len(MODELS))

PARAMETER_NAMES = (
    "local_gravity", "earth_rate_down", "gyro_noise_density", "accel_noise_density", "altitude_std",
    "altitude_delay", "complementary_frequency", "levelling_gate", "norm_gain",
    "gyro_range", "accel_range", "altitude_buffer", "gap_limit")


def _offsets(*sizes):
    ends = [0]
    for size in sizes:
        ends.append(ends[-1] + size)
    return ends


N_MAX = 6
(X, P, Q, DOWN, DOWN_COV, YAW_VAR, AUXILIARY, RATE, FORCE, LAST_ALTITUDE, LAST_ALTITUDE_VAR,
 PARAMETERS) = _offsets(
    N_MAX, N_MAX * N_MAX,
    4, 3, 9, 1,  # q_nb_wxyz; down_b and its covariance, row by row; variance of the yaw
    6,  # what the complementary schemes and the Euler kinematics remember
    3, 3, 1, 1)  # the last good sample; the last altitude and its variance
MEMORY_SIZE = PARAMETERS + len(PARAMETER_NAMES)
(P_GRAVITY, P_EARTH_RATE_DOWN, P_GYRO_NOISE, P_ACCEL_NOISE, P_ALT_STD, P_ALT_DELAY, P_FREQUENCY, P_GATE,
 P_NORM_GAIN, P_GYRO_RANGE, P_ACCEL_RANGE, P_ALT_BUFFER, P_GAP_LIMIT) = range(PARAMETERS, MEMORY_SIZE)

FAULTS = ("gyro_not_finite", "accel_not_finite", "gyro_out_of_range", "accel_out_of_range", "accel_zero",
          "restarted", "altitude_not_finite", "altitude_late", "altitude_ahead")
(F_GYRO_NOT_FINITE, F_ACCEL_NOT_FINITE, F_GYRO_OUT_OF_RANGE, F_ACCEL_OUT_OF_RANGE, F_ACCEL_ZERO,
 F_RESTARTED, F_ALT_NOT_FINITE, F_ALT_LATE, F_ALT_AHEAD) = range(len(FAULTS))
(I_MODEL, I_LAST_STAMP, I_CLOCK, I_ATTITUDE, I_ALTITUDES, I_COUNTS) = range(6)
I_SIZE = I_COUNTS + len(FAULTS)

# One row of output, in the order in which attitude_estimator.rivals places it.
(R_Q, R_TILT_COV, R_YAW_VAR, R_DOWN, R_NORM, R_VD, R_ALT, R_VD_VAR, R_ALT_VAR, R_GYRO, R_ACCEL,
 ROW_SIZE) = _offsets(4, 3, 1, 3, 1, 1, 1, 1, 1, 3, 3)

ACTION_USE, ACTION_SKIP, ACTION_RESET = range(3)
MISSHAPEN, OLD, STALE, FRESH = range(4)

START_TILT_STD = 0.2  # rad, of an attitude taken from one force
VD_STD, ALT_STD = 2.0, 5.0  # m/s and m, at the start
FIXED_TILT_STD = math.radians(5.0)  # what is told of a method that has no covariance
UNKNOWN_VD_STD, UNKNOWN_ALT_STD = 100.0, 1e4
SMALLEST_COSINE = 1e-3  # of the pitch, where Euler angles are singular
LARGEST_VARIANCE = 1e12  # rad^2: beyond it a filter has lost itself
FREE_FALL_SHARE = 0.5  # of gravity, below which a force shows no direction
AHEAD_LIMIT = 1_000_000_000  # ns


@compiled
def size_of(model):
    """Number of states of the model; 0 for those without a covariance."""
    if model == GAMMA:
        return 5
    if model in (EULER_UKF, EULER_UKF_FIRST_ORDER, EULER_EKF, EULER_EKF_FIRST_ORDER):
        return 4
    return 6 if model == QUATERNION_EKF else 0


@compiled
def _state(m, n):
    return m[X:X + n], m[P:P + n * n].reshape(n, n)


@compiled
def _vector(m, at):
    return m[at], m[at + 1], m[at + 2]


@compiled
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@compiled
def _unit(v):
    inv = 1.0 / math.sqrt(_dot(v, v))
    return inv * v[0], inv * v[1], inv * v[2]


@compiled
def carry_direction(c, w, dt):
    """Carry a direction that is fixed in space, seen in body axes, over dt of constant rate w."""
    first, second, _, _ = zoh_coefficients(math.sqrt(_dot(w, w)) * dt)
    turned = _cross(c, w)
    twice = _cross(turned, w)
    a, b = first * dt, second * dt * dt
    return (c[0] + a * turned[0] + b * twice[0], c[1] + a * turned[1] + b * twice[1],
            c[2] + a * turned[2] + b * twice[2])


@compiled
def _carry(F, p):
    """Replace the covariance by F P F^T."""
    n = len(F)
    half = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            if F[i, k] != 0.0:
                for j in range(n):
                    half[i, j] += F[i, k] * p[k, j]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += half[i, k] * F[j, k]
            p[i, j] = total
            p[j, i] = total


# --- Euler angles: equations 4, 24, 25 --------------------------------------------------------------


@compiled
def _tangent(sine, cosine):
    """Tangent of the pitch, kept finite at +-90 deg."""
    if abs(cosine) < SMALLEST_COSINE:
        cosine = SMALLEST_COSINE if cosine >= 0.0 else -SMALLEST_COSINE
    return sine / cosine


@compiled
def euler_rates(x, w, f, g):
    """Time derivatives of roll, pitch, velocity down and altitude."""
    sr, cr, sp, cp = math.sin(x[0]), math.cos(x[0]), math.sin(x[1]), math.cos(x[1])
    return (w[0] + _tangent(sp, cp) * (sr * w[1] + cr * w[2]), cr * w[1] - sr * w[2],
            -sp * f[0] + cp * (sr * f[1] + cr * f[2]) + g, -x[2])


@compiled
def euler_jacobian(x, w, f):
    """Derivative of :func:`euler_rates` with respect to the state, (4, 4)."""
    sr, cr, sp, cp = math.sin(x[0]), math.cos(x[0]), math.sin(x[1]), math.cos(x[1])
    tangent = _tangent(sp, cp)
    A = np.zeros((4, 4))
    A[0, 0] = tangent * (cr * w[1] - sr * w[2])
    A[0, 1] = (1.0 + tangent * tangent) * (sr * w[1] + cr * w[2])
    A[1, 0] = -sr * w[1] - cr * w[2]
    A[2, 0] = cp * (cr * f[1] - sr * f[2])
    A[2, 1] = -cp * f[0] - sp * (sr * f[1] + cr * f[2])
    A[3, 2] = -1.0
    return A


@compiled
def _moved(x, dt, rates):
    return (x[0] + dt * rates[0], x[1] + dt * rates[1], x[2] + dt * rates[2], x[3] + dt * rates[3])


@compiled
def euler_step(x, w, f, g, dt, first_order):
    """Return the state after dt (s) of constant rate and force: one Euler or one Runge-Kutta step."""
    k1 = euler_rates(x, w, f, g)
    if first_order:
        return _moved(x, dt, k1)
    k2 = euler_rates(_moved(x, 0.5 * dt, k1), w, f, g)
    k3 = euler_rates(_moved(x, 0.5 * dt, k2), w, f, g)
    k4 = euler_rates(_moved(x, dt, k3), w, f, g)
    middle = (k2[0] + k3[0], k2[1] + k3[1], k2[2] + k3[2], k2[3] + k3[3])
    mean = _moved(_moved(k1, 2.0, middle), 1.0, k4)
    return _moved(x, dt / 6.0, mean)


@compiled
def _add_euler_noise(p, pitch, q_angle, q_vd):
    p[0, 0] += q_angle * (1.0 + _tangent(math.sin(pitch), math.cos(pitch)) ** 2)
    p[1, 1] += q_angle
    p[2, 2] += q_vd


@compiled
def euler_ekf_predict(x, p, w, f, g, dt, q_angle, q_vd, first_order):
    """Carry the extended Kalman filter over dt."""
    F = euler_jacobian((x[0], x[1], x[2], x[3]), w, f)
    for i in range(4):
        for j in range(4):
            F[i, j] *= dt
        F[i, i] += 1.0
    _carry(F, p)
    x[0], x[1], x[2], x[3] = euler_step((x[0], x[1], x[2], x[3]), w, f, g, dt, first_order)
    _add_euler_noise(p, x[1], q_angle, q_vd)


@compiled
def _fill_cholesky(p, L):
    """Fill the lower factor of p; False where p has a negative eigenvalue."""
    n = len(p)
    for j in range(n):
        for i in range(j, n):
            total = p[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = total / L[j, j] if L[j, j] > 0.0 else 0.0
            elif total >= -1e-9 * p[j, j]:
                L[j, j] = math.sqrt(max(total, 0.0))
            else:
                return False
    return True


@compiled
def euler_ukf_predict(x, p, w, f, g, dt, q_angle, q_vd, first_order):
    """Carry the unscented filter over dt: eight points at mean +- sqrt(4) columns of the factor.

    That is kappa = 0: second order, no negative weight. False where P has a negative eigenvalue.
    """
    L = np.zeros((4, 4))
    if not _fill_cholesky(p, L):
        return False
    points = np.empty((8, 4))
    for k in range(8):
        s = 2.0 if k < 4 else -2.0
        j = k % 4
        point = (x[0] + s * L[0, j], x[1] + s * L[1, j], x[2] + s * L[2, j], x[3] + s * L[3, j])
        points[k, 0], points[k, 1], points[k, 2], points[k, 3] = euler_step(point, w, f, g, dt, first_order)
    for i in range(4):
        total = 0.0
        for k in range(8):
            total += points[k, i]
        x[i] = total / 8.0
        for k in range(8):
            points[k, i] -= x[i]
        for j in range(i + 1):
            total = 0.0
            for k in range(8):
                total += points[k, i] * points[k, j]
            p[i, j] = total / 8.0
            p[j, i] = total / 8.0
    _add_euler_noise(p, x[1], q_angle, q_vd)
    return True


# --- quaternion: equations 5, 6, 24, 25 -------------------------------------------------------------


@compiled
def quaternion_down(q):
    """Down direction in body axes of a quaternion; as long as the quaternion's squared norm."""
    return (2.0 * (q[1] * q[3] - q[0] * q[2]), 2.0 * (q[2] * q[3] + q[0] * q[1]),
            q[0] * q[0] - q[1] * q[1] - q[2] * q[2] + q[3] * q[3])


@compiled
def _down_jacobian(q):
    """Derivative of :func:`quaternion_down`, (3, 4)."""
    J = np.empty((3, 4))
    J[0, 0], J[0, 1], J[0, 2], J[0, 3] = -2.0 * q[2], 2.0 * q[3], -2.0 * q[0], 2.0 * q[1]
    J[1, 0], J[1, 1], J[1, 2], J[1, 3] = 2.0 * q[1], 2.0 * q[0], 2.0 * q[3], 2.0 * q[2]
    J[2, 0], J[2, 1], J[2, 2], J[2, 3] = 2.0 * q[0], -2.0 * q[1], -2.0 * q[2], 2.0 * q[3]
    return J


@compiled
def _multiply(a, b):
    """Hamilton product."""
    return (a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0])


@compiled
def _turn(w, dt):
    """Quaternion of the rotation by w dt."""
    half = 0.5 * dt * math.sqrt(_dot(w, w))
    s = 0.5 * dt * zoh_coefficients(half)[0]
    return math.cos(half), s * w[0], s * w[1], s * w[2]


@compiled
def quaternion_step(x, w, f, g, dt):
    """Return quaternion, velocity and altitude after dt of constant rate and force, and the Jacobian."""
    q = (x[0], x[1], x[2], x[3])
    R, J1, J2 = zoh_integrals(np.array(w), dt)
    c, C = quaternion_down(q), _down_jacobian(q)
    t = _turn(w, dt)
    after, F = np.empty(6), np.eye(6)
    after[0], after[1], after[2], after[3] = _multiply(q, t)
    after[4], after[5] = x[4] + g * dt, x[5] - dt * x[4] - 0.5 * g * dt * dt
    F[5, 4] = -dt
    for i in range(3):
        jv = J1[i, 0] * f[0] + J1[i, 1] * f[1] + J1[i, 2] * f[2]
        jh = J2[i, 0] * f[0] + J2[i, 1] * f[1] + J2[i, 2] * f[2]
        after[4] += jv * c[i]
        after[5] -= jh * c[i]
        for j in range(4):
            F[4, j] += jv * C[i, j]
            F[5, j] -= jh * C[i, j]
    for i in range(4):
        F[i, i] = t[0]
    F[0, 1], F[0, 2], F[0, 3] = -t[1], -t[2], -t[3]
    F[1, 0], F[1, 2], F[1, 3] = t[1], t[3], -t[2]
    F[2, 0], F[2, 1], F[2, 3] = t[2], -t[3], t[1]
    F[3, 0], F[3, 1], F[3, 2] = t[3], t[2], -t[1]
    return after, F


@compiled
def quaternion_ekf_predict(x, p, w, f, g, dt, q_angle, q_vd):
    """Carry the quaternion filter over dt."""
    after, F = quaternion_step(x, w, f, g, dt)
    _carry(F, p)
    norm2 = 0.0
    for i in range(6):
        x[i] = after[i]
        norm2 += x[i] * x[i] if i < 4 else 0.0
    for i in range(4):
        p[i, i] += 0.25 * q_angle * norm2
        for j in range(4):
            p[i, j] -= 0.25 * q_angle * x[i] * x[j]
    p[4, 4] += q_vd


@compiled
def _normalise_quaternion(x, p):
    """Bring the quaternion to unit length and the covariance to its tangent space."""
    norm = math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + x[3] * x[3])
    N = np.eye(6)
    for i in range(4):
        x[i] /= norm
    for i in range(4):
        for j in range(4):
            N[i, j] = ((1.0 if i == j else 0.0) - x[i] * x[j]) / norm
    _carry(N, p)


# --- the linear filter with the paper's k gamma: equations 14, 15, 26 to 31 --------------------------


@compiled
def gamma_predict(x, p, w, f, g, dt, q_angle, q_vd, norm_gain):
    """Carry the linear filter over dt; the norm is held by ``k gamma`` alone."""
    grown = 1.0 + norm_gain * dt * (1.0 - x[0] * x[0] - x[1] * x[1] - x[2] * x[2])
    R, J1, J2 = zoh_integrals(np.array(w), dt)
    F = np.eye(5)
    F[4, 3] = -dt
    for i in range(3):
        F[3, i] = J1[i, 0] * f[0] + J1[i, 1] * f[1] + J1[i, 2] * f[2]
        F[4, i] = -(J2[i, 0] * f[0] + J2[i, 1] * f[1] + J2[i, 2] * f[2])
        for j in range(3):
            F[i, j] = grown * R[j, i]
    after = np.zeros(5)
    for i in range(5):
        for j in range(5):
            after[i] += F[i, j] * x[j]
    after[3] += g * dt
    after[4] -= 0.5 * g * dt * dt
    for i in range(5):
        x[i] = after[i]
    _carry(F, p)
    trace = p[0, 0] + p[1, 1] + p[2, 2] + x[0] * x[0] + x[1] * x[1] + x[2] * x[2]
    for i in range(3):
        for j in range(3):
            p[i, j] -= q_angle * (x[i] * x[j] + p[i, j])
        p[i, i] += q_angle * trace
    p[3, 3] += q_vd * trace


# --- schemes without a covariance -------------------------------------------------------------------


@compiled
def complementary_step(m, w, f, dt):
    """Figure 1 on the sphere: proportional and integral turn towards the accelerometer's down direction."""
    k_i = m[P_FREQUENCY] ** 2
    k_p = math.sqrt(2.0) * m[P_FREQUENCY]
    c = _vector(m, DOWN)
    norm = math.sqrt(_dot(f, f))
    if norm > 0.0:
        off = _cross((-f[0] / norm, -f[1] / norm, -f[2] / norm), c)
        for i in range(3):
            m[AUXILIARY + i] += k_i * dt * off[i]
        w = (w[0] + k_p * off[0] + m[AUXILIARY], w[1] + k_p * off[1] + m[AUXILIARY + 1],
             w[2] + k_p * off[2] + m[AUXILIARY + 2])
    return carry_direction(c, w, dt)


@compiled
def complementary_literal_step(m, w, f, dt):
    """Equation 18 as printed: ``c_m - c_g`` is a low-pass of ``c_a - c_g``, component by component.

    AUXILIARY holds the gyro's own direction and ``k_i`` times the integral of what is left.
    """
    k_i = m[P_FREQUENCY] ** 2
    k_p = math.sqrt(2.0) * m[P_FREQUENCY]
    before = _vector(m, AUXILIARY)
    carried = carry_direction(before, w, dt)
    norm = math.sqrt(_dot(f, f))
    c = [0.0, 0.0, 0.0]
    for i in range(3):
        m[AUXILIARY + i] = carried[i]
        shift = m[X + i]
        left = -f[i] / norm - carried[i] - shift if norm > 0.0 else 0.0
        m[X + i] = shift + dt * (k_p * left + m[AUXILIARY + 3 + i])
        m[AUXILIARY + 3 + i] += dt * k_i * left
        c[i] = carried[i] + m[X + i]
    if _dot(c, c) < 1e-6:
        return carried
    return _unit(c)


@compiled
def levelling_step(m, f):
    """Equations 10 and 11: the force shows down where its size is that of gravity; otherwise hold."""
    norm = math.sqrt(_dot(f, f))
    if norm == 0.0 or abs(norm - m[P_GRAVITY]) > m[P_GATE]:
        return _vector(m, DOWN)
    return -f[0] / norm, -f[1] / norm, -f[2] / norm


# --- a sample, whatever the model -------------------------------------------------------------------


@compiled
def start(m, ints, down, tilt_var):
    """Begin at a down direction (unit) with this variance of its angle; the nose points east."""
    model = ints[I_MODEL]
    n = size_of(model)
    roll, pitch = math.atan2(down[1], down[2]), math.atan2(-down[0], math.hypot(down[1], down[2]))
    east = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
    level = _multiply(east, (math.cos(0.5 * pitch), 0.0, math.sin(0.5 * pitch), 0.0))
    q = _multiply(level, (math.cos(0.5 * roll), math.sin(0.5 * roll), 0.0, 0.0))
    m[:Q] = 0.0
    m[Q], m[Q + 1], m[Q + 2], m[Q + 3] = q
    m[DOWN], m[DOWN + 1], m[DOWN + 2] = down
    m[YAW_VAR] = 0.0
    m[AUXILIARY:RATE] = 0.0
    if model == COMPLEMENTARY_LITERAL:
        m[AUXILIARY], m[AUXILIARY + 1], m[AUXILIARY + 2] = down
    if model == GYRO_EULER:
        m[AUXILIARY], m[AUXILIARY + 1] = roll, pitch
    if n > 0:
        x, p = _state(m, n)
        _start_attitude(x, p, model, q, down, 0.5 * tilt_var)
        x[n - 1] = m[LAST_ALTITUDE]
        p[n - 2, n - 2] = VD_STD**2
        p[n - 1, n - 1] = ALT_STD**2
    ints[I_ATTITUDE] = 1
    _show(m, model, n)


@compiled
def _start_attitude(x, p, model, q, down, axis_var):
    if model == GAMMA:
        for i in range(3):
            x[i] = down[i]
            p[i, i] = axis_var
            for j in range(3):
                p[i, j] -= axis_var * down[i] * down[j]
    elif model == QUATERNION_EKF:
        for i in range(4):
            x[i] = q[i]
        # A small turn t of the body moves q by q (0, t) / 2; turns about down stay out.
        for axis in range(3):
            t = [0.0, 0.0, 0.0]
            for i in range(3):
                t[i] = (1.0 if i == axis else 0.0) - down[axis] * down[i]
            moved = _multiply(q, (0.0, t[0], t[1], t[2]))
            for i in range(4):
                for j in range(4):
                    p[i, j] += 0.25 * axis_var * moved[i] * moved[j]
    else:
        x[0], x[1] = math.atan2(down[1], down[2]), math.atan2(-down[0], math.hypot(down[1], down[2]))
        _add_euler_noise(p, x[1], axis_var, 0.0)


@compiled
def predict(m, ints, w, f, dt):
    """Carry the model over dt; False where its covariance is none any more."""
    model = ints[I_MODEL]
    n = size_of(model)
    c = _vector(m, DOWN)
    spin = m[P_EARTH_RATE_DOWN]
    w = (w[0] - spin * c[0], w[1] - spin * c[1], w[2] - spin * c[2])
    q_angle, q_vd = dt * m[P_GYRO_NOISE] ** 2, dt * m[P_ACCEL_NOISE] ** 2
    g = m[P_GRAVITY]
    x, p = _state(m, n)
    m[Q], m[Q + 1], m[Q + 2], m[Q + 3] = _multiply((m[Q], m[Q + 1], m[Q + 2], m[Q + 3]), _turn(w, dt))
    m[YAW_VAR] += q_angle
    sound = True
    if model == GAMMA:
        gamma_predict(x, p, w, f, g, dt, q_angle, q_vd, m[P_NORM_GAIN])
    elif model in (EULER_UKF, EULER_UKF_FIRST_ORDER):
        sound = euler_ukf_predict(x, p, w, f, g, dt, q_angle, q_vd, model == EULER_UKF_FIRST_ORDER)
    elif model in (EULER_EKF, EULER_EKF_FIRST_ORDER):
        euler_ekf_predict(x, p, w, f, g, dt, q_angle, q_vd, model == EULER_EKF_FIRST_ORDER)
    elif model == QUATERNION_EKF:
        quaternion_ekf_predict(x, p, w, f, g, dt, q_angle, q_vd)
    else:
        m[DOWN], m[DOWN + 1], m[DOWN + 2] = _carried_down(m, model, w, f, dt)
    return sound


@compiled
def _carried_down(m, model, w, f, dt):
    """Down direction of a method without a covariance."""
    if model == COMPLEMENTARY:
        return complementary_step(m, w, f, dt)
    if model == COMPLEMENTARY_LITERAL:
        return complementary_literal_step(m, w, f, dt)
    if model == ACCELEROMETER:
        return levelling_step(m, f)
    if model == GYRO:
        return quaternion_down((m[Q], m[Q + 1], m[Q + 2], m[Q + 3]))
    angles = euler_step((m[AUXILIARY], m[AUXILIARY + 1], 0.0, 0.0), w, f, 0.0, dt, False)
    m[AUXILIARY], m[AUXILIARY + 1] = _wrapped(angles[0]), _wrapped(angles[1])
    return _euler_down(m[AUXILIARY], m[AUXILIARY + 1])


@compiled
def _wrapped(angle):
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@compiled
def _euler_down(roll, pitch):
    return -math.sin(pitch), math.sin(roll) * math.cos(pitch), math.cos(roll) * math.cos(pitch)


@compiled
def update(m, ints, z, variance, age):
    """One altitude z (m, up) that was valid `age` s before the state: z = h + age vd."""
    model = ints[I_MODEL]
    n = size_of(model)
    x, p = _state(m, n)
    vd, alt = n - 2, n - 1
    ph = np.empty(n)
    for i in range(n):
        ph[i] = p[i, alt] + age * p[i, vd]
    inv = 1.0 / (ph[alt] + age * ph[vd] + variance)
    y = z - x[alt] - age * x[vd]
    for i in range(n):
        k = inv * ph[i]
        x[i] += k * y
        for j in range(n):
            p[i, j] -= k * ph[j]
    if model == QUATERNION_EKF:
        _normalise_quaternion(x, p)


@compiled
def _sound(x, p):
    """Whether mean and variances are finite and not negative."""
    sound = True
    for i in range(len(x)):
        sound &= abs(x[i]) < math.inf and 0.0 <= p[i, i] < LARGEST_VARIANCE
    return sound


@compiled
def _show(m, model, n):
    """Bring the down direction, its covariance and the quaternion in line with the states."""
    if n > 0:
        x, p = _state(m, n)
        if model == GAMMA:
            m[DOWN], m[DOWN + 1], m[DOWN + 2] = _unit((x[0], x[1], x[2]))
            J = np.eye(3)
        elif model == QUATERNION_EKF:
            q = (x[0], x[1], x[2], x[3])
            m[DOWN], m[DOWN + 1], m[DOWN + 2] = _unit(quaternion_down(q))
            J = _down_jacobian(q)
        else:
            x[0], x[1] = _wrapped(x[0]), _wrapped(x[1])
            m[DOWN], m[DOWN + 1], m[DOWN + 2] = _euler_down(x[0], x[1])
            J = _euler_down_jacobian(x[0], x[1])
        _fill_down_covariance(m, J, p)
    _align(m)


@compiled
def _euler_down_jacobian(roll, pitch):
    sr, cr, sp, cp = math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch)
    J = np.zeros((3, 2))
    J[1, 0], J[2, 0] = cr * cp, -sr * cp
    J[0, 1], J[1, 1], J[2, 1] = -cp, -sr * sp, -cr * sp
    return J


@compiled
def _fill_down_covariance(m, J, p):
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(J.shape[1]):
                for r in range(J.shape[1]):
                    total += J[i, k] * p[k, r] * J[j, r]
            m[DOWN_COV + 3 * i + j] = total


@compiled
def _align(m):
    """Turn Q the shortest way so that its down axis is DOWN."""
    q = (m[Q], m[Q + 1], m[Q + 2], m[Q + 3])
    c, d = _vector(m, DOWN), _unit(quaternion_down(q))
    axis = _cross(c, d)
    r = (1.0 + _dot(c, d), axis[0], axis[1], axis[2])
    if r[0] < 1e-9:  # opposite: about any axis across
        axis = _unit(_cross(c, (1.0, 0.0, 0.0) if abs(c[0]) < 0.7 else (0.0, 1.0, 0.0)))
        r = (0.0, axis[0], axis[1], axis[2])
    q = _multiply(q, r)
    inv = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for i in range(4):
        m[Q + i] = inv * q[i]


@compiled
def write_row(m, ints, row):
    """Fill one row of output."""
    model = ints[I_MODEL]
    n = size_of(model)
    for i in range(4):
        row[R_Q + i] = m[Q + i]
    for i in range(3):
        row[R_DOWN + i] = m[DOWN + i]
        row[R_GYRO + i] = m[RATE + i]
        row[R_ACCEL + i] = m[FORCE + i]
    row[R_YAW_VAR] = m[YAW_VAR]
    row[R_NORM] = 1.0
    if model == GAMMA:
        row[R_NORM] = math.sqrt(m[X] ** 2 + m[X + 1] ** 2 + m[X + 2] ** 2)
    if n > 0:
        x, p = _state(m, n)
        row[R_VD], row[R_ALT] = x[n - 2], x[n - 1]
        row[R_VD_VAR], row[R_ALT_VAR] = p[n - 2, n - 2], p[n - 1, n - 1]
        _write_tilt_covariance(m, row)
    else:
        row[R_VD], row[R_VD_VAR] = 0.0, UNKNOWN_VD_STD**2
        row[R_ALT] = m[LAST_ALTITUDE]
        row[R_ALT_VAR] = m[LAST_ALTITUDE_VAR] if ints[I_ALTITUDES] > 0 else UNKNOWN_ALT_STD**2
        row[R_TILT_COV] = row[R_TILT_COV + 2] = 0.5 * FIXED_TILT_STD**2
        row[R_TILT_COV + 1] = 0.0


@compiled
def _write_tilt_covariance(m, row):
    """Covariance of the turns about the estimate's own north and east axes."""
    w, x, y, z = m[Q], m[Q + 1], m[Q + 2], m[Q + 3]
    north = (w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y))
    east = (2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x))
    nn = ne = ee = 0.0
    for i in range(3):
        for j in range(3):
            cov = m[DOWN_COV + 3 * i + j]
            nn += east[i] * cov * east[j]
            ne -= north[i] * cov * east[j]
            ee += north[i] * cov * north[j]
    row[R_TILT_COV], row[R_TILT_COV + 1], row[R_TILT_COV + 2] = nn, ne, ee


# --- checks, from Python ----------------------------------------------------------------------------


@compiled
def reset(m, ints):
    """Forget everything but parameters and counters."""
    m[:PARAMETERS] = 0.0
    ints[I_LAST_STAMP:I_COUNTS] = 0


@compiled
def _vector_ok(ints, not_finite, out_of_range, limit, v):
    if not abs(v[0] + v[1] + v[2]) < math.inf:
        ints[I_COUNTS + not_finite] += 1
        return False
    if max(abs(v[0]), abs(v[1]), abs(v[2])) > 1.002 * limit:
        ints[I_COUNTS + out_of_range] += 1
        return False
    return True


@compiled
def push_imu(m, ints, stamp, gyro_b, accel_b):
    """Take one sample; FRESH where there is a new estimate."""
    if len(gyro_b) != 3 or len(accel_b) != 3:
        return MISSHAPEN
    if ints[I_CLOCK] == 1 and stamp <= ints[I_LAST_STAMP]:
        return OLD
    w = (gyro_b[0], gyro_b[1], gyro_b[2])
    f = (accel_b[0], accel_b[1], accel_b[2])
    ok = _vector_ok(ints, F_GYRO_NOT_FINITE, F_GYRO_OUT_OF_RANGE, m[P_GYRO_RANGE], w)
    ok &= _vector_ok(ints, F_ACCEL_NOT_FINITE, F_ACCEL_OUT_OF_RANGE, m[P_ACCEL_RANGE], f)
    if f[0] == 0.0 and f[1] == 0.0 and f[2] == 0.0:
        ints[I_COUNTS + F_ACCEL_ZERO] += 1  # no sensor in free fall reads three zeros
        ok = False
    if not ok:
        return STALE
    dt = (stamp - ints[I_LAST_STAMP]) * 1e-9 if ints[I_CLOCK] == 1 else 0.0
    m[RATE], m[RATE + 1], m[RATE + 2] = w
    m[FORCE], m[FORCE + 1], m[FORCE + 2] = f
    ints[I_CLOCK] = 1
    ints[I_LAST_STAMP] = stamp
    if ints[I_ATTITUDE] == 1 and dt > m[P_GAP_LIMIT]:
        _give_up(ints)
    if ints[I_ATTITUDE] == 0:
        return _level(m, ints)
    if dt > 0.0 and not (predict(m, ints, w, f, dt) and _settled(m, ints)):
        _give_up(ints)
        return _level(m, ints)
    return FRESH


@compiled
def _settled(m, ints):
    """Bring the output in line with the states, if they are sound."""
    model = ints[I_MODEL]
    n = size_of(model)
    if n > 0:
        x, p = _state(m, n)
        if not _sound(x, p):
            return False
    _show(m, model, n)
    return True


@compiled
def _give_up(ints):
    ints[I_COUNTS + F_RESTARTED] += 1
    ints[I_ATTITUDE] = 0


@compiled
def _level(m, ints):
    """Start at the attitude that the last force shows, if it is large enough to be gravity's."""
    f = _vector(m, FORCE)
    if math.sqrt(_dot(f, f)) < FREE_FALL_SHARE * m[P_GRAVITY]:
        return STALE
    start(m, ints, _unit((-f[0], -f[1], -f[2])), START_TILT_STD**2)
    return FRESH


@compiled
def push_altitude(m, ints, stamp, z, message_var):
    """Take one altitude (m, up) in order of arrival, with its age; return whether it counts."""
    if not abs(z) < math.inf:
        ints[I_COUNTS + F_ALT_NOT_FINITE] += 1
        return False
    age = (ints[I_LAST_STAMP] - stamp) * 1e-9 if ints[I_CLOCK] == 1 else 0.0
    if age > m[P_ALT_BUFFER]:
        ints[I_COUNTS + F_ALT_LATE] += 1
        return False
    if age * 1e9 < -AHEAD_LIMIT:
        ints[I_COUNTS + F_ALT_AHEAD] += 1
        return False
    variance = message_var if message_var > 0.0 else m[P_ALT_STD] ** 2
    m[LAST_ALTITUDE], m[LAST_ALTITUDE_VAR] = z, variance
    ints[I_ALTITUDES] += 1
    n = size_of(ints[I_MODEL])
    if n == 0 or ints[I_ATTITUDE] == 0:
        return True
    if ints[I_ALTITUDES] == 1:
        m[X + n - 1] = z
        return True
    update(m, ints, z, variance, age + m[P_ALT_DELAY])
    if not _settled(m, ints):
        _give_up(ints)
        _level(m, ints)
    return True


@compiled
def run(m, ints, stamps, gyro_b, accel_b, actions, alt_stamps, alt_values, alt_vars, arrival, rows, fresh):
    """Feed a recording in recorded order; rows are filled where `fresh` becomes True.

    Returns how many samples were taken before one whose stamp is not later than the last.
    """
    j = 0
    for k in range(len(stamps)):
        while j < len(arrival) and arrival[j] <= k:
            push_altitude(m, ints, alt_stamps[j], alt_values[j], alt_vars[j])
            j += 1
        fresh[k] = False
        if actions[k] == ACTION_SKIP:
            continue
        if actions[k] == ACTION_RESET:
            reset(m, ints)
        done = push_imu(m, ints, stamps[k], gyro_b[k], accel_b[k])
        if done == OLD:
            return k
        fresh[k] = done == FRESH
        if fresh[k]:
            write_row(m, ints, rows[k])
    while j < len(arrival):
        push_altitude(m, ints, alt_stamps[j], alt_values[j], alt_vars[j])
        j += 1
    return len(stamps)
