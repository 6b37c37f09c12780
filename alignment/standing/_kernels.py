"""Compiled kernels of the standing alignment: sums over steps, coarse alignment, and every filter.

Bottom up: rotations and the covariance arithmetic that all filters share; the reduction of samples to steps; the
sums of the optimisation-based coarse alignment; the filters with an attitude and a velocity of their own (riekf6,
riekf12, mekf), which run on steps; the filters of the computed-frame error model (ekf5, ekf10, ukf10, ipekf),
which run on samples. One sample and a whole recording go through the same loops. The layouts below are the
only place that knows positions. Equations: :mod:`alignment.standing.filters`. Frames and units: :mod:`inertial`.
"""

import math

import numpy as np
from numba import njit

from inertial._kernels import zoh_coefficients

RIEKF6, RIEKF12, MEKF, EKF5, EKF10, UKF10, IPEKF = range(7)
PAPER_LITERAL, CLOSED_LOOP, RESIDUAL = range(3)

# A step: its length s, the rotation vector over it, the velocity that the specific force gives over it and the mean
# of that velocity over it, both in the body's axes at its start, 1 where no zero velocity may count, and the variances
# of angle and velocity by samples that are missing.
(STEP_DT, STEP_DTHETA, STEP_DVEL, STEP_MEAN_DVEL, STEP_MOVING, STEP_LOST, STEP_SIZE) = (0, 1, 4, 7, 10, 11, 13)

# A step under way: its rotation matrix so far, then as above; of rate and force the squared density of the noise so
# far, the last three samples of each, how many there were, and the usual interval, s.
(A_ROTATION, A_DT, A_DVEL, A_POSITION, A_LOST, A_NOISE, A_BEFORE, A_SEEN, A_USUAL, A_SIZE) = (
    0, 9, 10, 13, 16, 18, 24, 42, 43, 44)

CONSTANT_NAMES = (
    "earth_north", "earth_down", "gravity", "radius", "tan_latitude", "gyro_var", "accel_var", "gyro_flicker_var",
    "accel_flicker_var", "bias_time", "scale_var", "zero_velocity_var", "zero_velocity_period", "robust", "adaptive",
    "turning_allowed", "largest_rate", "largest_velocity", "largest_drift", "feedback_period", "mended",
    "variant", "horizon", "weight_ratio", "gain_period")
(C_EARTH_NORTH, C_EARTH_DOWN, C_GRAVITY, C_RADIUS, C_TAN_LATITUDE, C_GYRO_VAR, C_ACCEL_VAR, C_GYRO_FLICKER_VAR,
 C_ACCEL_FLICKER_VAR, C_BIAS_TIME, C_SCALE_VAR, C_ZERO_VAR, C_ZERO_PERIOD, C_ROBUST, C_ADAPTIVE,
 C_TURNING_ALLOWED, C_LARGEST_RATE, C_LARGEST_VELOCITY, C_LARGEST_DRIFT, C_FEEDBACK_PERIOD, C_MENDED,
 C_VARIANT, C_HORIZON, C_WEIGHT_RATIO, C_GAIN_PERIOD) = range(len(CONSTANT_NAMES))

# Mean of a filter: velocity, biases, then for the error model its state and the one before it, each up to ten.
(M_V, M_BG, M_BA, M_X, M_BEFORE, M_FORCE, M_RATE_BEFORE, M_ERROR, M_SIZE) = (0, 3, 6, 9, 19, 29, 32, 37, 42)

# Quality of a filter, kept beside the mean.
(Q_TIME, Q_SINCE_UPDATE, Q_SINCE_FEEDBACK, Q_SINCE_GAIN, Q_SCALE, Q_NIS, Q_BLOCK, Q_BLOCK_VAR, Q_BLOCK_COUNT,
 Q_REJECTED, Q_ACCEPTED, Q_MOVING, Q_TURN, Q_EAST, Q_COST, Q_ALARM, Q_STARTED, Q_SWING, Q_REFERENCE,
 Q_TURNED, Q_RATE, Q_MISFIT, Q_SIZE) = (
    0, 1, 2, 3, 4, 5, 6, 9, 12, 13, 14, 15, 16, 17, 20, 21, 22, 23, 24,
    27, 28, 31, 32)

# A row of output: quaternion, upper triangle of the covariance of the small rotation in navigation axes, velocity,
# biases, their variances, normalised innovation squared, IPA cost J*.
(OUT_Q, OUT_COV, OUT_V, OUT_BG, OUT_BA, OUT_BG_VAR, OUT_BA_VAR, OUT_NIS, OUT_COST, OUT_SIZE) = (
    0, 4, 10, 13, 16, 19, 22, 25, 26, 27)

# Sums of the coarse alignment.
(O_BODY, O_TIME, O_ALPHA, O_BETA, O_PROFILE, O_SIZE) = (0, 9, 10, 13, 16, 25)

NOTHING, MOVED, STANDS, ALARM = range(4)  # what a run stopped for

SMALL_SQUARE = 1e-4  # rad^2, below which three terms of sine and cosine reach 1e-15
FLICKER = 2.5  # growth of a bias variance with the logarithm of time, in squares of the Allan deviation floor
AFTER_TURN = 10.0  # s that count as passed at the end of a turn
HUBER = 2.0  # standard deviations within which a zero velocity has its full weight
GATE = 8.0  # standard deviations beyond which it is no zero velocity
BLOCK = 10  # zero velocities whose mean innovation tells what noise the slow motion of the vehicle makes
MEMORY = 20.0  # blocks over which that is remembered
LARGEST_SCALE = 400.0  # of the zero-velocity variance, beyond which the attitude itself is doubted
RATE_TIME = 1.0  # s that a rate is a mean of, before it counts as a turn: who steps in rocks a vehicle to and fro
REJECTION_TIME = 1.0  # s of rejected zero velocities that count as motion
STANDING_TIME = 2.0  # s of zero velocities that end it
NOISE_TIME = 10.0  # s over which the noise of the samples is followed
MISSING = 1.7  # usual intervals from which samples are missing
MOST_CURVED = 15.0  # missing samples over which a curve is carried on


_compiled = njit(cache=True, error_model="numpy")
# As `_compiled`, of what only other kernels call: no entry from Python, which spares compiling one.
_inlined = njit(cache=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)


# --- shared -----------------------------------------------------------------------------------------


@_inlined
def _rotation(x, y, z, out):
    """Fill out (3, 3) with exp([v x])."""
    square = x * x + y * y + z * z
    if square < SMALL_SQUARE:
        a = 1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0))
        b = 0.5 - square * (1.0 / 24.0 - square * (1.0 / 720.0))
    else:
        a, b, _, _ = zoh_coefficients(math.sqrt(square))
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    out[1, 0], out[1, 1], out[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    out[2, 0], out[2, 1], out[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)


@_inlined
def _multiply(a, b, out):
    """Fill out (3, 3) with a b."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@_inlined
def _copy(a, out):
    """Fill out (3, 3) with a. A slice would do it, but takes seven seconds to compile."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, j]


@_inlined
def _orthonormalise(r):
    """Take the rounding out of a rotation matrix, first order: R (3 I - R^T R) / 2."""
    g = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            g[i, j] = -0.5 * (r[0, i] * r[0, j] + r[1, i] * r[1, j] + r[2, i] * r[2, j])
        g[i, i] += 1.5
    out = np.empty((3, 3))
    _multiply(r, g, out)
    _copy(out, r)


@_inlined
def _carry(P, F, n, scratch):
    """Replace P by F P F^T; F may be sparse. Rows are added up, which a processor does four at a time."""
    for i in range(n):
        for j in range(n):
            scratch[i, j] = 0.0
        for k in range(n):
            f = F[i, k]
            if f != 0.0:
                for j in range(n):
                    scratch[i, j] += f * P[k, j]
    for i in range(n):
        for j in range(i):
            scratch[i, j], scratch[j, i] = scratch[j, i], scratch[i, j]
    for i in range(n):
        for j in range(n):
            P[i, j] = 0.0
        for k in range(n):
            f = F[i, k]
            if f != 0.0:
                for j in range(n):
                    P[i, j] += f * scratch[k, j]
    for i in range(n):
        for j in range(i):
            P[i, j] = P[j, i]


@_inlined
def _update(P, h, n, z, variance, gain, delta):
    """Scalar Kalman update with row h: add the correction to delta, shrink P; return -log of the likelihood.

    z is the innovation before any correction; delta already holds those of the rows before.
    """
    s = variance
    for i in range(n):
        gain[i] = 0.0
    for j in range(n):
        if h[j] != 0.0:
            for i in range(n):
                gain[i] += h[j] * P[j, i]
    for i in range(n):
        s += h[i] * gain[i]
        z -= h[i] * delta[i]
    for i in range(n):
        k = gain[i] / s
        delta[i] += k * z
        for j in range(n):
            P[i, j] -= k * gain[j]
    return 0.5 * (z * z / s + math.log(s))


@_inlined
def _update_entry(P, at, n, z, variance, gain, delta):
    """Scalar Kalman update by a measurement of one entry of the state, else as :func:`_update`."""
    for i in range(n):
        gain[i] = P[i, at]
    s = variance + gain[at]
    z -= delta[at]
    for i in range(n):
        k = gain[i] / s
        delta[i] += k * z
        for j in range(n):
            P[i, j] -= k * gain[j]


@_inlined
def _innovation_variance(P, h, n):
    total = 0.0
    for i in range(n):
        if h[i] != 0.0:
            for j in range(n):
                total += h[i] * P[i, j] * h[j]
    return total


@_inlined
def _quaternion(r, out):
    """Fill out[0:4] with the unit quaternion of a rotation matrix, scalar first and >= 0 (Shepperd, 1978)."""
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    largest = trace
    k = 3
    for i in range(3):
        if r[i, i] > largest:
            largest, k = r[i, i], i
    if k == 3:
        out[0] = 1.0 + trace
        out[1], out[2], out[3] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    else:
        i, j = (k + 1) % 3, (k + 2) % 3
        out[0] = r[j, i] - r[i, j]
        out[1 + k] = 1.0 + 2.0 * r[k, k] - trace
        out[1 + i] = r[i, k] + r[k, i]
        out[1 + j] = r[j, k] + r[k, j]
    norm = math.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2 + out[3] ** 2)
    if out[0] < 0.0:
        norm = -norm
    for i in range(4):
        out[i] /= norm


@_inlined
def _judge(nis, dt, moving, velocity, c, q):
    """Return the weight of a zero velocity, 0 for none, and an event; keep count of motion.

    What has moved stands again once its velocity has stayed within the gate, and steady, for some time: a vehicle
    that brakes passes through the gate, too.
    """
    root = math.sqrt(nis / 3.0)
    if moving or (c[C_ROBUST] != 0.0 and root > GATE):
        q[Q_REJECTED] += dt
        q[Q_ACCEPTED] = 0.0
        if q[Q_REJECTED] >= REJECTION_TIME and q[Q_MOVING] == 0.0:
            q[Q_MOVING] = 1.0
            return 0.0, MOVED
        return 0.0, NOTHING
    if q[Q_MOVING] != 0.0:
        change2 = 0.0
        for i in range(len(velocity)):
            if q[Q_ACCEPTED] == 0.0:
                q[Q_REFERENCE + i] = velocity[i]
            change2 += (velocity[i] - q[Q_REFERENCE + i]) ** 2
        if change2 > (0.5 * c[C_LARGEST_VELOCITY] + c[C_LARGEST_DRIFT] * q[Q_ACCEPTED]) ** 2:
            q[Q_ACCEPTED] = 0.0
            return 0.0, NOTHING
    q[Q_ACCEPTED] += dt
    event = NOTHING
    if q[Q_ACCEPTED] >= (REJECTION_TIME if q[Q_MOVING] == 0.0 else STANDING_TIME):
        q[Q_REJECTED] = 0.0
        if q[Q_MOVING] != 0.0:
            q[Q_MOVING] = 0.0
            event = STANDS
    if q[Q_MOVING] != 0.0:
        return 0.0, NOTHING
    return (HUBER / root if c[C_ROBUST] != 0.0 and root > HUBER else 1.0), event


@_inlined
def _adapt(z, s, c, q):
    """Learn from the mean innovation of a block how noisy the zero velocities are; return an event.

    White innovations have a block mean of variance S / BLOCK. Slow motion of the vehicle makes it larger, and
    the zero-velocity variance is scaled by as much; fast motion makes it smaller, which is not made use of.
    """
    count = len(z)
    for i in range(count):
        q[Q_BLOCK + i] += z[i]
        q[Q_BLOCK_VAR + i] += s[i]
    q[Q_BLOCK_COUNT] += 1.0
    if q[Q_BLOCK_COUNT] < BLOCK:
        return NOTHING
    nis = 0.0
    for i in range(count):
        nis += q[Q_BLOCK + i] ** 2 / q[Q_BLOCK_VAR + i] / count
        q[Q_BLOCK + i] = q[Q_BLOCK_VAR + i] = 0.0
    q[Q_BLOCK_COUNT] = 0.0
    q[Q_NIS] += (nis - q[Q_NIS]) / MEMORY
    if c[C_ADAPTIVE] != 0.0:
        # nis is of a variance that is scaled already.
        q[Q_SCALE] = max(1.0, q[Q_SCALE] * (1.0 + (min(nis, 100.0) - 1.0) / MEMORY))
        if q[Q_SCALE] > LARGEST_SCALE and q[Q_ALARM] == 0.0:
            q[Q_ALARM] = 1.0
            return ALARM
    return NOTHING


# --- samples to steps, and the coarse alignment -------------------------------------------------------


@_compiled
def reduce_samples(acc, dt, gyro_b, accel_b, period, steps, ends):
    """Sum samples up to steps of at least ``period`` s; return how many steps were completed.

    Each sample is the mean over its interval. Where samples before it are missing, the mean of the last one and of it
    stands for them, wrong by as much as a curve bent like the last three samples departs from it.

    Parameters
    ----------
    acc : (A_SIZE,) float64
        The step under way, carried from call to call.
    dt : (N,) float64, s
    gyro_b, accel_b : (N, 3) float64
    period : float, s
    steps : (N, STEP_SIZE) float64
        Filled.
    ends : (N,) int64
        Filled with the index of the sample that completed each step.
    """
    count = 0
    r, turn, both = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    turned, gained = np.empty(3), np.empty(3)
    for i in range(3):
        for j in range(3):
            r[i, j] = acc[A_ROTATION + 3 * i + j]
    for k in range(len(dt)):
        if acc[A_DT] == 0.0:
            for i in range(A_NOISE):  # all that belongs to a step
                acc[i] = 0.0
            for i in range(3):
                for j in range(3):
                    r[i, j] = 1.0 if i == j else 0.0
        missing = _missing_time(acc, dt[k])
        t = dt[k] - missing
        if missing > 0.0:
            _add_lost(acc, missing, missing / t)
        for part in range(0 if missing > 0.0 else 1, 2):
            _fill_sample(acc, gyro_b[k], accel_b[k], missing if part == 0 else t, part == 0, turned, gained)
            # Specific force in the axes half-way through the sample.
            x, y, z = turned[0], turned[1], turned[2]
            fx, fy, fz = gained[0], gained[1], gained[2]
            gx = fx + 0.5 * (y * fz - z * fy)
            gy = fy + 0.5 * (z * fx - x * fz)
            gz = fz + 0.5 * (x * fy - y * fx)
            length = missing if part == 0 else t
            for i in range(3):
                gain = r[i, 0] * gx + r[i, 1] * gy + r[i, 2] * gz
                acc[A_POSITION + i] += length * (acc[A_DVEL + i] + 0.5 * gain)
                acc[A_DVEL + i] += gain
            _rotation(x, y, z, turn)
            _multiply(r, turn, both)
            r, both = both, r
            acc[A_DT] += length
        _follow_noise(acc, t, gyro_b[k], accel_b[k])
        if acc[A_DT] >= period - 0.5 * t:
            _close_step(acc, r, steps[count])
            ends[count] = k
            count += 1
            acc[A_DT] = 0.0
    for i in range(3):
        for j in range(3):
            acc[A_ROTATION + 3 * i + j] = r[i, j]
    return count


@_inlined
def _missing_time(acc, t):
    """Return how much of an interval belongs to samples that are missing, s; follow the usual interval."""
    usual = acc[A_USUAL]
    if usual == 0.0:
        acc[A_USUAL] = t
    elif t < MISSING * usual:
        acc[A_USUAL] += 0.02 * (t - usual)
    else:
        # Slowly, since the rate may have changed for good.
        acc[A_USUAL] += 0.002 * (t - usual)
        return t - usual
    return 0.0


@_inlined
def _add_lost(acc, missing, count):
    """Add the variances of angle and velocity over so many s without so many samples."""
    count = min(count, MOST_CURVED)
    # Of a parabola the straight line between the samples beside missing ones is off by this much in the mean.
    length = missing * (count + 1.0) * (count + 2.0) / 12.0
    for i in range(6):
        at = A_BEFORE + 3 * i
        bend = length * (acc[at] - 2.0 * acc[at + 1] + acc[at + 2])
        acc[A_LOST + (0 if i < 3 else 1)] += bend * bend


@_inlined
def _fill_sample(acc, gyro_b, accel_b, t, missing, turned, gained):
    """Fill the angle and the velocity (3,) of a sample of t s, or of those missing before it."""
    for i in range(3):
        rate, force = gyro_b[i], accel_b[i]
        if missing:
            rate = 0.5 * (rate + acc[A_BEFORE + 3 * i + 2])
            force = 0.5 * (force + acc[A_BEFORE + 3 * (i + 3) + 2])
        turned[i], gained[i] = t * rate, t * force


@_inlined
def _follow_noise(acc, t, gyro_b, accel_b):
    """Follow the squared noise density of each reading by its third difference, which a vehicle's sway hardly enters.

    Of white noise a third difference has 1 + 9 + 9 + 1 times the variance.
    """
    gain = max(t / NOISE_TIME, 1.0 / max(acc[A_SEEN] - 2.0, 1.0))
    for i in range(6):
        at = A_BEFORE + 3 * i
        value = gyro_b[i] if i < 3 else accel_b[i - 3]
        if acc[A_SEEN] > 2.0:
            difference = value - acc[at] + 3.0 * (acc[at + 1] - acc[at + 2])
            acc[A_NOISE + i] += gain * (0.05 * t * difference * difference - acc[A_NOISE + i])
        acc[at], acc[at + 1], acc[at + 2] = acc[at + 1], acc[at + 2], value
    acc[A_SEEN] += 1.0


@_inlined
def _close_step(acc, r, step):
    q = np.empty(4)
    _quaternion(r, q)
    sine = math.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    ratio = 2.0 * math.atan2(sine, q[0]) / sine if sine > 1e-9 else 2.0
    step[STEP_DT] = acc[A_DT]
    step[STEP_MOVING] = 0.0
    step[STEP_LOST], step[STEP_LOST + 1] = acc[A_LOST], acc[A_LOST + 1]
    for i in range(3):
        step[STEP_DTHETA + i] = ratio * q[1 + i]
        step[STEP_DVEL + i] = acc[A_DVEL + i]
        step[STEP_MEAN_DVEL + i] = acc[A_POSITION + i] / acc[A_DT]


@_compiled
def run_coarse(c, sums, bias, steps):
    """Add steps to the sums of the optimisation-based alignment (Wu and Pan, 2013).

    In the axes of body and navigation frame at the start the velocities that the specific force gives are alpha
    and beta, ``C_b^n(0) alpha = beta``; ``B = sum beta alpha^T dt`` is Davenport's attitude profile matrix.

    Parameters
    ----------
    c : (len(CONSTANT_NAMES),) float64
    sums : (O_SIZE,) float64
        Rotation of the body since the start, time, alpha, beta, B.
    bias : (6,) float64
        Of gyro and accelerometer, taken off.
    steps : (K, STEP_SIZE) float64
    """
    r, turn, both = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    if sums[O_TIME] == 0.0:
        for i in range(O_SIZE):
            sums[i] = 0.0
        for i in range(3):
            sums[O_BODY + 4 * i] = 1.0
    for i in range(3):
        for j in range(3):
            r[i, j] = sums[O_BODY + 3 * i + j]
    for k in range(len(steps)):
        step = steps[k]
        t = step[STEP_DT]
        for i in range(3):
            sums[O_ALPHA + i] += (r[i, 0] * (step[STEP_DVEL] - bias[3] * t)
                                  + r[i, 1] * (step[STEP_DVEL + 1] - bias[4] * t)
                                  + r[i, 2] * (step[STEP_DVEL + 2] - bias[5] * t))
        _rotation(step[STEP_DTHETA] - bias[0] * t, step[STEP_DTHETA + 1] - bias[1] * t,
                  step[STEP_DTHETA + 2] - bias[2] * t, turn)
        _multiply(r, turn, both)
        r, both = both, r
        middle = sums[O_TIME] + 0.5 * t
        _rotation(c[C_EARTH_NORTH] * middle, 0.0, c[C_EARTH_DOWN] * middle, turn)
        for i in range(3):
            sums[O_BETA + i] -= turn[i, 2] * c[C_GRAVITY] * t
        sums[O_TIME] += t
        for i in range(3):
            for j in range(3):
                sums[O_PROFILE + 3 * i + j] += t * sums[O_BETA + i] * sums[O_ALPHA + j]
    for i in range(3):
        for j in range(3):
            sums[O_BODY + 3 * i + j] = r[i, j]


# --- filters with an attitude and a velocity of their own ---------------------------------------------


@_compiled
def group_step(model, c, R, m, step, turn, half, after, F, H):
    """Carry attitude and velocity over a step and fill transition F and measurement rows H.

    The error is the small rotation phi, R^ = exp(phi x) R in navigation axes, then rho (riekf: v^ = exp(phi x) v
    + rho; mekf: v^ = v + rho), then R^ (b^ - b) of gyro and accelerometer: in navigation axes, where the equations of a
    vehicle at rest do not know its heading, and tilt and biases cannot seem observable because the heading swings.
    Fills row 0 of ``after`` (7, 3) with the mean velocity over the step.
    """
    t, g = step[STEP_DT], c[C_GRAVITY]
    wx = c[C_EARTH_NORTH] + m[M_V + 1] / c[C_RADIUS]
    wy = -m[M_V] / c[C_RADIUS]
    wz = c[C_EARTH_DOWN] - m[M_V + 1] * c[C_TAN_LATITUDE] / c[C_RADIUS]
    cx, cy, cz = wx + c[C_EARTH_NORTH], wy, wz + c[C_EARTH_DOWN]
    tx = step[STEP_DTHETA] - m[M_BG] * t
    ty = step[STEP_DTHETA + 1] - m[M_BG + 1] * t
    tz = step[STEP_DTHETA + 2] - m[M_BG + 2] * t
    _rotation(0.5 * tx, 0.5 * ty, 0.5 * tz, turn)
    _multiply(R, turn, half)

    gain, bias, force = after[1], after[2], after[3]
    # The steps were summed up with the gyros' bias in: on average half of what it turns by, a third for the mean.
    for k, share in ((STEP_DVEL, t / 2), (STEP_MEAN_DVEL, t / 3)):
        bx, by, bz = share * m[M_BG], share * m[M_BG + 1], share * m[M_BG + 2]
        force[0] = step[k] - (by * step[k + 2] - bz * step[k + 1])
        force[1] = step[k + 1] - (bz * step[k] - bx * step[k + 2])
        force[2] = step[k + 2] - (bx * step[k + 1] - by * step[k])
        for i in range(3):
            after[0, i] = R[i, 0] * force[0] + R[i, 1] * force[1] + R[i, 2] * force[2]
            if k == STEP_DVEL:
                gain[i] = after[0, i]
    for i in range(3):
        bias[i] = half[i, 0] * m[M_BA] + half[i, 1] * m[M_BA + 1] + half[i, 2] * m[M_BA + 2]
        gain[i] -= t * bias[i]
    vx, vy, vz = m[M_V], m[M_V + 1], m[M_V + 2]
    ax = -(cy * vz - cz * vy)
    ay = -(cz * vx - cx * vz)
    az = -(cx * vy - cy * vx) + g
    after[0, 0] += vx + 0.5 * t * (ax - bias[0])
    after[0, 1] += vy + 0.5 * t * (ay - bias[1])
    after[0, 2] += vz + 0.5 * t * (az - bias[2])
    # The navigation frame turns on during the step: the force is resolved in its axes half-way.
    m[M_V] += gain[0] - 0.5 * t * (wy * gain[2] - wz * gain[1]) + t * ax
    m[M_V + 1] += gain[1] - 0.5 * t * (wz * gain[0] - wx * gain[2]) + t * ay
    m[M_V + 2] += gain[2] - 0.5 * t * (wx * gain[1] - wy * gain[0]) + t * az

    n = 6 if model == RIEKF6 else 12
    for i in range(n):
        for j in range(n):
            F[i, j] = 1.0 if i == j else 0.0
        H[0, i] = H[1, i] = H[2, i] = 0.0
    _add_cross(F, 0, 0, -t * wx, -t * wy, -t * wz)
    _add_cross(F, 3, 3, -t * cx, -t * cy, -t * cz)
    if model == MEKF:
        _add_cross(F, 3, 0, -gain[0], -gain[1], -gain[2])
    else:
        _add_cross(F, 3, 0, 0.0, 0.0, t * g)
    for i in range(3):
        H[i, 3 + i] = 1.0
        for j in range(3):
            H[i, j] = -0.5 * F[3 + i, j]
    # Transport rate, which a wrong velocity makes wrong.
    F[0, 4] -= t / c[C_RADIUS]
    F[1, 3] += t / c[C_RADIUS]
    F[2, 4] += t * c[C_TAN_LATITUDE] / c[C_RADIUS]
    # The biases turn with the body: by half a step on average, by a whole one at its end.
    if n == 12:
        for i in range(3):
            H[i, 9 + i] = 0.5 * t
            for j in range(3):
                total = half[i, 0] * R[j, 0] + half[i, 1] * R[j, 1] + half[i, 2] * R[j, 2]
                F[i, 6 + j] = F[3 + i, 9 + j] = -t * total
                # Half a step of the velocity error that the rate error makes meanwhile.
                if i == 0:
                    F[4, 6 + j] = -0.5 * t * t * g * total
                elif i == 1:
                    F[3, 6 + j] = 0.5 * t * t * g * total
    _multiply(half, turn, after[4:7])
    _rotation(-t * wx, -t * wy, -t * wz, turn)
    _multiply(turn, after[4:7], half)
    if n == 12:
        for i in range(3):
            for j in range(3):
                total = half[i, 0] * R[j, 0] + half[i, 1] * R[j, 1] + half[i, 2] * R[j, 2]
                F[6 + i, 6 + j] = F[9 + i, 9 + j] = total
    _copy(half, R)


@_inlined
def _add_cross(F, i, j, x, y, z):
    """Add [v x] to the block of F at (i, j)."""
    F[i, j + 1] -= z
    F[i, j + 2] += y
    F[i + 1, j] += z
    F[i + 1, j + 2] -= x
    F[i + 2, j] -= y
    F[i + 2, j + 1] += x


@_inlined
def _correct_group(model, R, m, delta, turn, scratch):
    """Take the estimated error off attitude, velocity and biases."""
    x, y, z = -delta[0], -delta[1], -delta[2]
    _rotation(x, y, z, turn)
    _multiply(turn, R, scratch)
    _copy(scratch, R)
    if model == MEKF:
        for i in range(3):
            m[M_V + i] -= delta[3 + i]
    else:
        _, a, b, _ = zoh_coefficients(math.sqrt(x * x + y * y + z * z))
        u, v, w = delta[3], delta[4], delta[5]
        px, py, pz = y * w - z * v, z * u - x * w, x * v - y * u
        qx, qy, qz = y * pz - z * py, z * px - x * pz, x * py - y * px
        vx, vy, vz = m[M_V], m[M_V + 1], m[M_V + 2]
        for i in range(3):
            m[M_V + i] = turn[i, 0] * vx + turn[i, 1] * vy + turn[i, 2] * vz
        m[M_V] -= u + a * px + b * qx
        m[M_V + 1] -= v + a * py + b * qy
        m[M_V + 2] -= w + a * pz + b * qz
    if model != RIEKF6:
        for i in range(3):
            m[M_BG + i] -= R[0, i] * delta[6] + R[1, i] * delta[7] + R[2, i] * delta[8]
            m[M_BA + i] -= R[0, i] * delta[9] + R[1, i] * delta[10] + R[2, i] * delta[11]


@_inlined
def _drift(c, q, t):
    """Return by how much the variance of a bias grows over t, in squares of its instability.

    1/f noise wanders by about the same amount in every octave of time, so the variance grows as its logarithm. What a
    turn makes visible is measured against the time since then.
    """
    return FLICKER * t / min(max(q[Q_TIME] - q[Q_TURNED], 1.0), c[C_BIAS_TIME])


@_inlined
def _group_noise(model, c, step, q, P):
    """Add the noise of a step to P; a turn adds what the gyros' scale factors and axes are off."""
    t = step[STEP_DT]
    for i in range(3):
        P[i, i] += t * c[C_GYRO_VAR] + step[STEP_LOST]
        P[3 + i, 3 + i] += t * c[C_ACCEL_VAR] + step[STEP_LOST + 1]
    if model != RIEKF6:
        drift = _drift(c, q, t)
        for i in range(3):
            P[6 + i, 6 + i] += drift * c[C_GYRO_FLICKER_VAR]
            P[9 + i, 9 + i] += drift * c[C_ACCEL_FLICKER_VAR]
    angle2 = step[STEP_DTHETA] ** 2 + step[STEP_DTHETA + 1] ** 2 + step[STEP_DTHETA + 2] ** 2
    if angle2 < (c[C_LARGEST_RATE] * t) ** 2:
        if q[Q_TURN] > 0.0:
            q[Q_TURN], q[Q_TURNED] = 0.0, max(q[Q_TIME] - AFTER_TURN, 0.0)
        return
    # Of a turn by an angle, scale * angle is the error, so its variance grows as the angle squared; misaligned axes
    # do about the same across the turn's axis.
    angle = math.sqrt(angle2)
    spread = c[C_SCALE_VAR] * (2.0 * q[Q_TURN] + angle) * angle
    q[Q_TURN] += angle
    for i in range(3):
        P[i, i] += spread


@_compiled
def run_group(model, c, R, m, P, q, steps, rows):
    """Run riekf6, riekf12 or mekf over steps; return how many were used and the event that stopped it.

    Parameters
    ----------
    model : int
    c : constants
    R : (3, 3) float64, dcm_nb
    m : (M_SIZE,) float64
    P : (12, 12) float64
    q : (Q_SIZE,) float64
    steps : (K, STEP_SIZE) float64
    rows : (K, OUT_SIZE) or (0, OUT_SIZE) float64
        Filled after every step, if there is room.
    """
    n = 6 if model == RIEKF6 else 12
    F, H, scratch = np.empty((12, 12)), np.empty((3, 12)), np.empty((12, 12))
    turn, half, after = np.empty((3, 3)), np.empty((3, 3)), np.empty((7, 3))
    delta, gain, s = np.empty(12), np.empty(12), np.empty(3)
    for k in range(len(steps)):
        step = steps[k]
        t = step[STEP_DT]
        for i in range(3):
            q[Q_EAST + i] += t * R[1, i]
        group_step(model, c, R, m, step, turn, half, after, F, H)
        _carry(P, F, n, scratch)
        _group_noise(model, c, step, q, P)
        q[Q_TIME] += t

        variance = c[C_ZERO_VAR] * q[Q_SCALE]
        nis = 0.0
        speed2 = rate2 = 0.0
        for i in range(3):
            q[Q_RATE + i] += (step[STEP_DTHETA + i] / t - m[M_BG + i] - q[Q_RATE + i]) * min(t / RATE_TIME, 1.0)
            rate2 += q[Q_RATE + i] ** 2
            s[i] = variance + _innovation_variance(P, H[i], n)
            nis += after[0, i] ** 2 / s[i]
            speed2 += after[0, i] ** 2
        turning = rate2 > c[C_LARGEST_RATE] ** 2 and c[C_TURNING_ALLOWED] == 0.0
        too_fast = speed2 > c[C_LARGEST_VELOCITY] ** 2 + 9.0 * (s[0] + s[1] + s[2])
        moving = step[STEP_MOVING] != 0.0 or (c[C_ROBUST] != 0.0 and (turning or too_fast))
        weight, event = _judge(nis, t, moving, after[0], c, q)
        if weight > 0.0:
            for i in range(n):
                delta[i] = 0.0
            for i in range(3):
                q[Q_MISFIT] += _update(P, H[i], n, after[0, i], variance / weight, gain, delta)
            alarm = _adapt(after[0], s, c, q)
            event = alarm if alarm != NOTHING else event
            _correct_group(model, R, m, delta, turn, half)
            _orthonormalise(R)
            q[Q_SWING] += delta[2]
        if len(rows) > 0:
            group_row(model, R, m, P, q, rows[k])
        if event != NOTHING:
            return k + 1, event
    return len(steps), NOTHING


@_compiled
def group_row(model, R, m, P, q, row):
    """Fill a row of output; biases and their variances in body axes."""
    _quaternion(R, row)
    at = OUT_COV
    for i in range(3):
        for j in range(i, 3):
            row[at] = P[i, j]
            at += 1
    for i in range(3):
        row[OUT_V + i], row[OUT_BG + i], row[OUT_BA + i] = m[M_V + i], m[M_BG + i], m[M_BA + i]
        gyro_var = accel_var = 0.0
        for j in range(3):
            for k in range(3):
                gyro_var += R[j, i] * P[6 + j, 6 + k] * R[k, i]
                accel_var += R[j, i] * P[9 + j, 9 + k] * R[k, i]
        row[OUT_BG_VAR + i] = gyro_var if model != RIEKF6 else np.nan
        row[OUT_BA_VAR + i] = accel_var if model != RIEKF6 else np.nan
    row[OUT_NIS], row[OUT_COST] = q[Q_NIS] * q[Q_SCALE], np.nan


# --- filters of the computed-frame error model --------------------------------------------------------


@_compiled
def model_rate(c, n, x, f, R, out):
    """Fill out with the rate f(x) of the error model, n = 5 or 10.

    Parameters
    ----------
    x : dvN, dvE, phiN, phiE, phiD, and with n = 10 gyro bias (3, body) and accelerometer bias (x and y, body)
    f : (3,) specific force in computed axes
    R : (3, 3) computed C_b^n'
    """
    cs, sn = math.cos(x[4]), math.sin(x[4])
    wn, wd, radius = c[C_EARTH_NORTH], c[C_EARTH_DOWN], c[C_RADIUS]
    out[0] = (1 - cs) * f[0] + sn * f[1] - (x[3] * cs + x[2] * sn) * f[2] + 2 * wd * x[1]
    out[1] = -sn * f[0] + (1 - cs) * f[1] + (x[2] * cs - x[3] * sn) * f[2] - 2 * wd * x[0]
    out[2] = (1 - cs) * wn + x[3] * wd + x[1] / radius
    out[3] = sn * wn - x[2] * wd - x[0] / radius
    out[4] = -(x[3] * cs + x[2] * sn) * wn - x[1] * c[C_TAN_LATITUDE] / radius
    if n == 10:
        bn = R[0, 0] * x[8] + R[0, 1] * x[9]
        be = R[1, 0] * x[8] + R[1, 1] * x[9]
        bd = R[2, 0] * x[8] + R[2, 1] * x[9]
        # C_b^n = (C_n^n')^T C_b^n' with C_n^n' = (I - phi x) Rz(phiD); phi x and b are both small.
        out[0] += cs * bn - sn * be + (cs * x[3] + sn * x[2]) * bd
        out[1] += sn * bn + cs * be + (sn * x[3] - cs * x[2]) * bd
        for i in range(3):
            out[2 + i] -= R[i, 0] * x[5] + R[i, 1] * x[6] + R[i, 2] * x[7]
        for i in range(5, 10):
            out[i] = 0.0


@_compiled
def model_jacobian(c, n, x, f, R, A):
    """Fill A (n, n) with the Jacobian of :func:`model_rate`; beside diagonal and model it must be zero already.

    Mended: taken at the force that agrees with the model, (g phiE, -g phiN, -g), which makes A15 = A25 = 0.
    """
    cs, sn = math.cos(x[4]), math.sin(x[4])
    wn, wd, radius = c[C_EARTH_NORTH], c[C_EARTH_DOWN], c[C_RADIUS]
    for i in range(n):
        A[i, i] = 0.0
    f_down = f[2]
    if c[C_MENDED] != 0.0:
        f_down = -c[C_GRAVITY]
    else:
        A[0, 4] = cs * f[1] + sn * f[0] + (x[3] * sn - x[2] * cs) * f[2]
        A[1, 4] = sn * f[1] - cs * f[0] - (x[3] * cs + x[2] * sn) * f[2]
    A[0, 1], A[0, 2], A[0, 3] = 2 * wd, -sn * f_down, -cs * f_down
    A[1, 0], A[1, 2], A[1, 3] = -2 * wd, cs * f_down, -sn * f_down
    A[2, 1], A[2, 3], A[2, 4] = 1 / radius, wd, wn * sn
    A[3, 0], A[3, 2], A[3, 4] = -1 / radius, -wd, wn * cs
    A[4, 1], A[4, 2], A[4, 3] = -c[C_TAN_LATITUDE] / radius, -wn * sn, -wn * cs
    A[4, 4] = (x[3] * sn - x[2] * cs) * wn
    if n == 10:
        bn = R[0, 0] * x[8] + R[0, 1] * x[9]
        be = R[1, 0] * x[8] + R[1, 1] * x[9]
        bd = R[2, 0] * x[8] + R[2, 1] * x[9]
        A[0, 2] += sn * bd
        A[0, 3] += cs * bd
        A[1, 2] -= cs * bd
        A[1, 3] += sn * bd
        A[0, 4] += -sn * bn - cs * be + (cs * x[2] - sn * x[3]) * bd
        A[1, 4] += cs * bn - sn * be + (cs * x[3] + sn * x[2]) * bd
        for j in range(2):
            A[0, 8 + j] = cs * R[0, j] - sn * R[1, j] + (cs * x[3] + sn * x[2]) * R[2, j]
            A[1, 8 + j] = sn * R[0, j] + cs * R[1, j] + (sn * x[3] - cs * x[2]) * R[2, j]
        for i in range(3):
            for j in range(3):
                A[2 + i, 5 + j] = -R[i, j]


@_compiled
def strapdown_step(c, R, m, dt, gyro_b, accel_b, bias, turn, scratch):
    """Carry the computed attitude R and the horizontal velocity over a sample; store the force in m.

    The velocity of a vehicle at rest is the measurement of the error model.
    """
    wx = c[C_EARTH_NORTH] + m[M_V + 1] / c[C_RADIUS]
    wy = -m[M_V] / c[C_RADIUS]
    wz = c[C_EARTH_DOWN] - m[M_V + 1] * c[C_TAN_LATITUDE] / c[C_RADIUS]
    x = 0.5 * dt * (gyro_b[0] - bias[0])
    y = 0.5 * dt * (gyro_b[1] - bias[1])
    z = 0.5 * dt * (gyro_b[2] - bias[2])
    _rotation(x, y, z, turn)
    _multiply(R, turn, scratch)
    fx, fy, fz = accel_b[0] - bias[3], accel_b[1] - bias[4], accel_b[2] - bias[5]
    for i in range(3):
        m[M_FORCE + i] = scratch[i, 0] * fx + scratch[i, 1] * fy + scratch[i, 2] * fz
    _multiply(scratch, turn, R)
    north = m[M_FORCE] + (wz + c[C_EARTH_DOWN]) * m[M_V + 1]
    east = m[M_FORCE + 1] - (wz + c[C_EARTH_DOWN]) * m[M_V]
    # Half of the frame's turn during the sample.
    h = 0.5 * dt
    m[M_V] += dt * (north - h * (wy * m[M_FORCE + 2] - wz * m[M_FORCE + 1]))
    m[M_V + 1] += dt * (east - h * (wz * m[M_FORCE] - wx * m[M_FORCE + 2]))
    _rotation(-dt * wx, -dt * wy, -dt * wz, turn)
    _multiply(turn, R, scratch)
    _copy(scratch, R)


@_inlined
def computed_frame(x, out):
    """Fill out (3, 3) with C_n^n' = (I - phi_h x) Rz(phiD)."""
    cs, sn = math.cos(x[4]), math.sin(x[4])
    pn, pe = x[2], x[3]
    out[0, 0], out[0, 1], out[0, 2] = cs, sn, -pe
    out[1, 0], out[1, 1], out[1, 2] = -sn, cs, pn
    out[2, 0], out[2, 1], out[2, 2] = pe * cs + pn * sn, pe * sn - pn * cs, 1.0


@_inlined
def _true_attitude(R, x, frame, out):
    """Fill out with C_b^n = (C_n^n')^T C_b^n'."""
    computed_frame(x, frame)
    for i in range(3):
        for j in range(3):
            out[i, j] = frame[0, i] * R[0, j] + frame[1, i] * R[1, j] + frame[2, i] * R[2, j]
    for _ in range(2):
        _orthonormalise(out)


@_compiled
def fill_gain(p, ratio, dt, F, rows, gain, weight):
    """Fill what the IPA needs until its gain is computed again, for unit Qm.

    Parameters
    ----------
    p : int
        Horizon.
    ratio : float
        Ry / Qm.
    F : (5, 5) float64
    rows : (p, 2, 5) float64
        Filled with H S_i, S_i = sum of F^j, j < i, i = 1 .. p.
    gain : (5, 2 p) float64
        Filled with the rows of K that belong to the first increment.
    weight : (2 p, 2 p) float64
        Filled with (Hy Hy^T + I / ratio)^-1.
    """
    for i in range(2):
        for j in range(5):
            rows[0, i, j] = 1.0 if i == j else 0.0
    for k in range(1, p):
        # S_{k+1} = I + S_k F.
        for i in range(2):
            for j in range(5):
                total = 1.0 if i == j else 0.0
                for q in range(5):
                    total += rows[k - 1, i, q] * F[q, j]
                rows[k, i, j] = total
    # Hy Hy^T: block (i, j) is the sum over l of (H S_{i-l} G)(H S_{j-l} G)^T, a running sum down the diagonals.
    for i in range(p):
        for j in range(i + 1):
            for a in range(2):
                for b in range(2):
                    total = 0.0
                    for q in range(5):
                        total += rows[i, a, q] * rows[j, b, q]
                    total *= dt * dt
                    if j > 0:
                        total += weight[2 * (i - 1) + a, 2 * (j - 1) + b]
                    weight[2 * i + a, 2 * j + b] = total
                    weight[2 * j + b, 2 * i + a] = total
    for i in range(2 * p):
        weight[i, i] += 1.0 / ratio
    _invert(weight, 2 * p)
    for i in range(5):
        for j in range(2 * p):
            total = 0.0
            for k in range(p):
                total += dt * (rows[k, 0, i] * weight[2 * k, j] + rows[k, 1, i] * weight[2 * k + 1, j])
            gain[i, j] = total


@_inlined
def _invert(a, n):
    """Replace a symmetric positive definite matrix by its inverse (Gauss-Jordan, no pivoting needed)."""
    for k in range(n):
        pivot = 1.0 / a[k, k]
        a[k, k] = 1.0
        for j in range(n):
            a[k, j] *= pivot
        for i in range(n):
            if i != k:
                factor = a[i, k]
                a[i, k] = 0.0
                for j in range(n):
                    a[i, j] -= factor * a[k, j]


@_inlined
def _fill_short_gain(rows, gain, short):
    """Fill short (5, 7) with the gain on what makes the free response: its constant part (2,), and e (5,)."""
    for i in range(5):
        for j in range(7):
            short[i, j] = 0.0
        for k in range(len(rows)):
            for a in range(2):
                short[i, a] += gain[i, 2 * k + a]
                for j in range(5):
                    short[i, 2 + j] += gain[i, 2 * k + a] * rows[k, a, j]


@_inlined
def _model_error(c, dt, m, y, rate, short, response, increment):
    """Fill what makes the IPA's free response (7,) and the first increment Dm*.

    The free response of equation 3 is ``free_i = H x + H S_i e``, that of the residual form ``H x - y``, e = 0.
    """
    x = m[M_X:M_X + 10]
    residual = c[C_VARIANT] == RESIDUAL
    for a in range(2):
        response[a] = x[a] - (y[a] if residual else 0.0)
    if not residual:
        for i in range(5):
            response[2 + i] = x[i] - m[M_BEFORE + i] + dt * (rate[i] - m[M_RATE_BEFORE + i])
    for i in range(5):
        total = 0.0
        for j in range(7):
            total += short[i, j] * response[j]
        increment[i] = -total


@_inlined
def _predictive_cost(ipa):
    """Return J* of the last free response."""
    rows, _, weight, _, response = ipa
    free = np.empty(2 * len(rows))
    cost = 0.0
    for i in range(len(free)):
        total = response[i % 2]
        for j in range(5):
            total += rows[i // 2, i % 2, j] * response[2 + j]
        free[i] = total
        total *= 0.5 * weight[i, i]
        for j in range(i):
            total += weight[i, j] * free[j]
        cost += 2.0 * free[i] * total
    return cost


@_inlined
def _factor(P, n, L):
    """Fill L with the lower Cholesky factor of P; a pivot that rounding made negative counts as zero."""
    for j in range(n):
        pivot = P[j, j]
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        L[j, j] = math.sqrt(max(pivot, 0.0))
        inverse = 1.0 / L[j, j] if L[j, j] > 0.0 else 0.0
        for i in range(j + 1, n):
            total = P[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total * inverse


@_inlined
def _unscented(c, dt, m, R, P, L, points, rate):
    """Carry mean and covariance through the model by sigma points (paper, B-2 to B-5), n = 10."""
    n = len(rate)
    alpha = 0.1
    lam = alpha * alpha * 3.0 - n  # kappa = 3 - n
    gamma = math.sqrt(n + lam)
    w = 0.5 / (n + lam)
    f = m[M_FORCE:M_FORCE + 3]
    _factor(P, n, L)
    for k in range(2 * n + 1):
        for i in range(n):
            points[k, i] = m[M_X + i]
            if 0 < k <= n:
                points[k, i] += gamma * L[i, k - 1]
            elif k > n:
                points[k, i] -= gamma * L[i, k - n - 1]
        model_rate(c, n, points[k], f, R, rate)
        for i in range(n):
            points[k, i] += dt * rate[i]
    # About the central point, so that the large weights of opposite sign lose no digits.
    for i in range(n):
        rate[i] = 0.0
        for k in range(1, 2 * n + 1):
            points[k, i] -= points[0, i]
            rate[i] += w * points[k, i]
        m[M_X + i] = points[0, i] + rate[i]
    # sum W (d_k - mean)(d_k - mean)^T with sum W = 1 + (1 - alpha^2 + beta), beta = 2.
    extra = 1.0 - alpha * alpha + 2.0
    for i in range(n):
        for j in range(i, n):
            total = (extra - 1.0) * rate[i] * rate[j]
            for k in range(1, 2 * n + 1):
                total += w * points[k, i] * points[k, j]
            P[i, j] = P[j, i] = total


@_inlined
def _feed_back(c, n, R, m, frame, scratch):
    """Correct the strapdown by the state and start the state anew at zero, its predecessor shifted alike."""
    _true_attitude(R, m[M_X:M_X + 10], frame, scratch)
    _copy(scratch, R)
    for i in range(2):
        m[M_V + i] -= m[M_X + i]
    if n == 10:
        for i in range(5):
            m[M_BG + i] += m[M_X + 5 + i]
    for i in range(10):
        m[M_BEFORE + i] -= m[M_X + i]
        m[M_X + i] = 0.0
    model_rate(c, min(n, 5), m[M_BEFORE:M_BEFORE + 10], m[M_FORCE:M_FORCE + 3], R, m[M_RATE_BEFORE:M_ERROR])


@_compiled
def run_error_model(model, c, R, m, P, q, ipa, dt, gyro_b, accel_b, standing, every, rows):
    """Run ekf5, ekf10, ukf10 or ipekf over samples; return how many were used and the event that stopped it.

    Parameters
    ----------
    model, c, R, m, P, q
        As of :func:`run_group`; R is the computed attitude.
    ipa : tuple of arrays
        ``rows, gain, weight`` of :func:`fill_gain`, and room for the short gain (5, 7) and what it is for (7,).
    dt : (N,) float64, s
    gyro_b, accel_b : (N, 3) float64
    standing : bool
        Whether velocities may count as zero.
    every : int
        Rows are filled after every so many samples.
    rows : (N // every, OUT_SIZE) float64
    """
    n = 5 if model in (EKF5, IPEKF) else 10
    loop = not (model == IPEKF and c[C_VARIANT] == PAPER_LITERAL) and c[C_FEEDBACK_PERIOD] > 0.0
    A, scratch, points = np.zeros((10, 10)), np.zeros((10, 10)), np.empty((21, 10))
    turn, small = np.empty((3, 3)), np.empty((3, 3))
    rate, increment = np.empty(10), np.zeros(5)
    delta, gain, bias = np.empty(10), np.empty(10), np.empty(6)
    z, s = np.empty(2), np.empty(2)
    x = m[M_X:M_X + 10]
    f = m[M_FORCE:M_FORCE + 3]
    for k in range(len(dt)):
        t = dt[k]
        for i in range(3):
            q[Q_EAST + i] += t * R[1, i]
        for i in range(6):
            bias[i] = m[M_BG + i]
        z[0], z[1] = m[M_V], m[M_V + 1]
        strapdown_step(c, R, m, t, gyro_b[k], accel_b[k], bias, turn, small)
        q[Q_TIME] += t

        if model == UKF10:
            _unscented(c, t, m, R, P, scratch, points, rate)
        else:
            model_jacobian(c, n, x, f, R, A)
            for i in range(n):
                for j in range(n):
                    A[i, j] *= t
                A[i, i] += 1.0
            model_rate(c, n, x, f, R, rate)
            if model == IPEKF:
                if q[Q_STARTED] == 0.0:
                    for i in range(5):
                        m[M_BEFORE + i], m[M_RATE_BEFORE + i] = x[i], rate[i]
                if q[Q_STARTED] == 0.0 or q[Q_SINCE_GAIN] >= c[C_GAIN_PERIOD] - 0.5 * t:
                    fill_gain(len(ipa[0]), c[C_WEIGHT_RATIO], t, A, ipa[0], ipa[1], ipa[2])
                    _fill_short_gain(ipa[0], ipa[1], ipa[3])
                    q[Q_SINCE_GAIN] = 0.0
                q[Q_SINCE_GAIN] += t
                _model_error(c, t, m, z, rate, ipa[3], ipa[4], increment)
                for i in range(5):
                    m[M_ERROR + i] += increment[i]
                    if c[C_VARIANT] == RESIDUAL:
                        increment[i] = m[M_ERROR + i]
                    m[M_BEFORE + i], m[M_RATE_BEFORE + i] = x[i], rate[i]
                q[Q_STARTED] = 1.0
            for i in range(n):
                x[i] += t * (rate[i] + (increment[i] if i < 5 else 0.0))
            _carry(P, A, n, scratch)
        P[0, 0] += t * c[C_ACCEL_VAR]
        P[1, 1] += t * c[C_ACCEL_VAR]
        for i in range(3):
            P[2 + i, 2 + i] += t * c[C_GYRO_VAR]
        if n == 10:
            drift = _drift(c, q, t)
            for i in range(5):
                P[5 + i, 5 + i] += drift * (c[C_GYRO_FLICKER_VAR] if i < 3 else c[C_ACCEL_FLICKER_VAR])

        event = NOTHING
        q[Q_SINCE_UPDATE] += t
        if q[Q_SINCE_UPDATE] >= c[C_ZERO_PERIOD] - 0.5 * t:
            variance = c[C_ZERO_VAR] * q[Q_SCALE]
            nis = 0.0
            for i in range(2):
                z[i] = m[M_V + i] - x[i]
                s[i] = P[i, i] + variance
                nis += 1.5 * z[i] ** 2 / s[i]
            weight, event = _judge(nis, q[Q_SINCE_UPDATE], not standing, z, c, q)
            if weight > 0.0:
                for i in range(n):
                    delta[i] = 0.0
                for i in range(2):
                    _update_entry(P, i, n, z[i], variance / weight, gain, delta)
                for i in range(n):
                    x[i] += delta[i]
                alarm = _adapt(z, s, c, q)
                event = alarm if alarm != NOTHING else event
            q[Q_SINCE_UPDATE] = 0.0
        q[Q_SINCE_FEEDBACK] += t
        if loop and q[Q_SINCE_FEEDBACK] >= c[C_FEEDBACK_PERIOD] - 0.5 * t:
            _feed_back(c, n, R, m, turn, small)
            q[Q_SINCE_FEEDBACK] = 0.0
        wanted = len(rows) > 0 and (k + 1) % every == 0
        if wanted or event != NOTHING or k == len(dt) - 1:
            q[Q_COST] = _predictive_cost(ipa) if model == IPEKF else np.nan
        if wanted:
            error_model_row(model, R, m, P, q, rows[(k + 1) // every - 1])
        if event != NOTHING:
            return k + 1, event
    return len(dt), NOTHING


@_compiled
def error_model_row(model, R, m, P, q, row):
    """Fill a row of output: attitude, velocity and biases with the state taken off."""
    n = 5 if model in (EKF5, IPEKF) else 10
    frame, attitude = np.empty((3, 3)), np.empty((3, 3))
    x = m[M_X:M_X + 10]
    _true_attitude(R, x, frame, attitude)
    _quaternion(attitude, row)
    k = OUT_COV
    for i in range(3):
        for j in range(i, 3):
            row[k] = P[2 + i, 2 + j]
            k += 1
    for i in range(3):
        row[OUT_V + i] = m[M_V + i] - (x[i] if i < 2 else 0.0)
        row[OUT_BG + i], row[OUT_BA + i] = m[M_BG + i], m[M_BA + i]
        row[OUT_BG_VAR + i] = row[OUT_BA_VAR + i] = np.nan
    if n == 10:
        for i in range(3):
            row[OUT_BG + i] += x[5 + i]
            row[OUT_BG_VAR + i] = P[5 + i, 5 + i]
        for i in range(2):
            row[OUT_BA + i] += x[8 + i]
            row[OUT_BA_VAR + i] = P[8 + i, 8 + i]
    row[OUT_NIS], row[OUT_COST] = q[Q_NIS] * q[Q_SCALE], q[Q_COST]
