"""The attitude of a whole recording, each sample from all of it: a Rauch-Tung-Striebel smoother.

The default filter runs forward by its own kernels. Then the recording is gone through backward, in parts that
the filter steps over once more, because the covariances of a long recording do not fit in memory.
Equations: ``docs/attitude.md``. Frames and units: :mod:`inertial`.
"""

from dataclasses import dataclass

import numpy as np

from attitude_estimator import _kernels as kernels
from attitude_estimator._smoother_kernels import smooth_back
from attitude_estimator.estimator import ACTION_RESET, ACTION_SKIP, AttitudeEstimator, Estimates
from attitude_estimator.params import AttitudeParams
from inertial.recording import AltitudeSeries, ImuSeries
from inertial.rotation import (
    quaternion_from_dcm,
)

N, VD, ALT = kernels.N, kernels.VD, kernels.ALT
DOWN, BG, BA = slice(0, 3), slice(kernels.BG, kernels.BA), slice(kernels.BA, N)
PART = 4096  # samples whose covariances are held at once, 6 kB each


def smooth(imu, altitude=None, altitude_variance=None, *, params=None, actions=None):
    """Estimate a whole recording, each sample from what came before and after it.

    Parameters
    ----------
    imu : ImuSeries
    altitude : AltitudeSeries, optional
        Each counts at its stamp, however late it arrived.
    altitude_variance : (M,), m^2, optional
        Counts where > 0.
    params : AttitudeParams, optional
        Their ``estimator`` is ``dcm_row``.
    actions : (N,) int, optional
        As for :meth:`AttitudeEstimator.run`.

    Returns
    -------
    estimates : Estimates
        One for each sample that the filter used; all of them are valid from one long gap to the next if the
        filter found an attitude anywhere between.
    fresh : (N,) bool
        Which samples these are.
    faults : FaultCounts

    Raises
    ------
    ValueError
        For another estimator.
    TimeJumpError
        When a stamp that is to be used is not later than the one before.
    """
    params = AttitudeParams() if params is None else params
    if params.estimator != "dcm_row":
        raise ValueError(f"estimator = {params.estimator}: only dcm_row can be smoothed")
    actions = np.zeros(len(imu), np.int64) if actions is None else np.asarray(actions)
    altitude, variance = _in_time_order(imu, actions, altitude, altitude_variance)
    estimator = AttitudeEstimator(params)
    parts, memories = [], []
    rows, fresh = [], []
    for first in range(0, len(imu), PART):
        part = _cut(imu, actions, altitude, variance, first, first + PART)
        memories.append(estimator._memory.copy())
        estimates, used = estimator.run(part.imu, part.altitude, part.variance, actions=part.actions)
        parts.append(part)
        rows.append(estimates.rows)
        fresh.append(used)
    state = _State(estimator._memory)
    for part, memory, out in zip(reversed(parts), reversed(memories), reversed(rows), strict=True):
        _smooth_part(_replay(memory, part, len(out)), state, params, out)
    fresh = np.concatenate(fresh)
    estimates = Estimates(imu.stamp_ns[fresh], np.concatenate(rows))
    return estimates, fresh, estimator.faults


@dataclass(frozen=True)
class _Part:
    """Samples and the altitudes to take before each, by :attr:`AltitudeSeries.arrival`."""

    imu: ImuSeries
    actions: np.ndarray
    altitude: AltitudeSeries
    variance: np.ndarray


def _in_time_order(imu, actions, altitude, variance):
    """Let each altitude arrive just before the first used sample that is not earlier."""
    if altitude is None:
        none = np.zeros(0, np.int64)
        return AltitudeSeries(none, np.zeros(0), none), np.zeros(0)
    variance = np.zeros(len(altitude)) if variance is None else np.asarray(variance)
    arrival = altitude.arrival.copy()
    edges = [0, *np.flatnonzero(actions == ACTION_RESET), len(imu)]
    for first, last in zip(edges[:-1], edges[1:], strict=True):
        used = first + np.flatnonzero(actions[first:last] != ACTION_SKIP)
        inside = (altitude.arrival > first) & (altitude.arrival <= last)
        if first == 0:
            inside |= altitude.arrival == 0
        places = np.searchsorted(imu.stamp_ns[used], altitude.stamp_ns[inside])
        arrival[inside] = np.append(used, last)[places]
    order = np.lexsort((altitude.stamp_ns, arrival))
    return (AltitudeSeries(altitude.stamp_ns[order], altitude.altitude[order], arrival[order]),
            variance[order])


def _cut(imu, actions, altitude, variance, first, last):
    here = (altitude.arrival >= first) & (altitude.arrival < last)
    return _Part(ImuSeries(imu.stamp_ns[first:last], imu.gyro_b[first:last], imu.accel_b[first:last]),
                 actions[first:last],
                 AltitudeSeries(altitude.stamp_ns[here], altitude.altitude[here],
                                altitude.arrival[here] - first), variance[here])


class _State:
    """Mean and covariance of the filter's state, and whether it has an attitude, as copies."""

    def __init__(self, memory):
        self.x = memory[kernels.X:kernels.X + N].copy()
        self.P = memory[kernels.P:kernels.P + N * N].reshape(N, N).copy()
        self.known = memory[kernels.ATTITUDE] == 1.0


class _Steps:
    """How the filter came to each of n samples; :func:`smooth_back` says what the arrays are."""

    def __init__(self, n):
        self.before_x, self.before_P, self.before_known = np.empty((n, N)), np.empty((n, N, N)), np.empty(n, bool)
        self.predicted_x, self.predicted_P = np.empty((n, N)), np.empty((n, N, N))
        self.keeps = np.ones((n, N), bool)
        self.dt, self.samples = np.empty(n), np.empty((n, 6))

    def set_before(self, n, memory):
        self.before_x[n] = memory[kernels.X:kernels.X + N]
        self.before_P[n] = memory[kernels.P:kernels.P + N * N].reshape(N, N)
        self.before_known[n] = memory[kernels.ATTITUDE] == 1.0

    def set_predicted(self, n, memory):
        self.predicted_x[n] = memory[kernels.X:kernels.X + N]
        self.predicted_P[n] = memory[kernels.P:kernels.P + N * N].reshape(N, N)


def _replay(memory, part, count):
    """Step over a part again and return its steps, one for each sample that gives output."""
    ints = memory[kernels.M_INTS:kernels.M_ALTITUDES].view(np.int64)
    steps = _Steps(count)
    predicted = np.empty(kernels.M_OUT)
    before = memory[:kernels.STATE_SIZE].copy()
    waiting = n = 0
    for k, stamp in enumerate(part.imu.stamp_ns.tolist()):
        if part.actions[k] == ACTION_SKIP:
            continue
        if part.actions[k] == ACTION_RESET:
            kernels.reset(memory)
        predicted[:] = memory[:kernels.M_OUT]
        if kernels.push_imu(memory, stamp, part.imu.gyro_b[k], part.imu.accel_b[k]) != kernels.FRESH:
            continue
        steps.set_before(n, before)
        row = kernels.M_HISTORY + ints[kernels.I_HEAD] * kernels.H_SIZE
        dt, *sample, gyro_var, accel_var, force_known = memory[row:row + kernels.H_SIZE].tolist()
        steps.dt[n], steps.samples[n] = dt, sample
        if dt > 0.0:
            predicted[kernels.SINCE_GRAVITY] = -np.inf  # so that nothing is updated
            kernels.imu_step(predicted, dt, *sample, gyro_var, accel_var, force_known == 1.0)
            steps.set_predicted(n, predicted)
            forgotten = steps.predicted_P[n, VD, ALT] == 0.0
            steps.keeps[n, VD:ALT + 1] = not forgotten
        else:
            steps.set_predicted(n, memory)
            steps.keeps[n] = part.actions[k] != ACTION_RESET
            steps.keeps[n, :kernels.BG] = False
        while waiting < len(part.altitude) and part.altitude.stamp_ns[waiting] <= stamp:
            if np.isfinite(part.altitude.altitude[waiting]):
                age = (stamp - part.altitude.stamp_ns[waiting]) * 1e-9
                _take_altitude(memory, part.altitude.altitude[waiting], part.variance[waiting], age, steps, n)
            waiting += 1
        before[:] = memory[:kernels.STATE_SIZE]
        n += 1
    return steps


def _take_altitude(memory, z, variance, age, steps, n):
    """Apply an altitude; what it moves the height reference by is process noise of the step before it."""
    P = memory[kernels.P:kernels.P + N * N].reshape(N, N)
    expected = P[ALT, ALT] + (memory[kernels.P_ALT_DELAY] + age) * P[ALT, VD]
    kernels.altitude_step(memory, z, variance, age)
    if memory[kernels.ALT_COUNT] == 1.0:
        steps.keeps[n, ALT] = False
        steps.predicted_P[n, ALT, :] = steps.predicted_P[n, :, ALT] = 0.0
        steps.predicted_P[n, ALT, ALT] = P[ALT, ALT]
        steps.predicted_x[n, ALT] = z
    else:
        steps.predicted_P[n, ALT, ALT] += max(memory[kernels.PH + ALT] - expected, 0.0)


def _smooth_part(steps, state, params, rows):
    """Go back over a part from the smoothed state after it, and write the smoothed rows."""
    x, P, known = np.empty((len(rows), N)), np.empty((len(rows), N, N)), np.empty(len(rows), bool)
    state.known = smooth_back(
        steps.before_x, steps.before_P, steps.before_known, steps.predicted_x, steps.predicted_P, steps.keeps,
        steps.dt, steps.samples, params.local_gravity(), params.earth_rate_down(), params.accel_bias_time,
        state.x, state.P, state.known, x, P, known)
    _write(rows, x, P, known)


def _write(rows, x, P, known):
    """Replace the filter's rows by the smoothed states."""
    for first, bias, at in ((kernels.OUT_GYRO, kernels.OUT_BG, BG), (kernels.OUT_ACCEL, kernels.OUT_BA, BA)):
        rows[:, first:first + 3] += rows[:, bias:bias + 3] - x[:, at]
        rows[:, bias:bias + 3] = x[:, at]
    variances = np.diagonal(P, axis1=1, axis2=2)
    rows[:, kernels.OUT_BG_VAR:kernels.OUT_BG_VAR + 3] = variances[:, BG]
    rows[:, kernels.OUT_BA_VAR:kernels.OUT_BA_VAR + 3] = variances[:, BA]
    rows[:, kernels.OUT_VALID] = known
    rows[:, kernels.OUT_VD], rows[:, kernels.OUT_ALT] = x[:, VD], x[:, ALT]
    rows[:, kernels.OUT_VD_VAR], rows[:, kernels.OUT_ALT_VAR] = variances[:, VD], variances[:, ALT]
    norm = np.linalg.norm(x[:, DOWN], axis=1)
    rows[:, kernels.OUT_NORM] = norm
    down = x[:, DOWN] / np.maximum(norm, 1e-9)[:, None]
    rows[:, kernels.OUT_DOWN:kernels.OUT_DOWN + 3] = down
    north = np.where(np.abs(down[:, :1]) < .99, np.cross(down, [-1.0, 0, 0]), np.cross(down, [0, 0, 1.0]))
    north /= np.maximum(np.linalg.norm(north, axis=1), 1e-9)[:, None]
    east = np.cross(down, north)
    rows[:, kernels.OUT_Q:kernels.OUT_Q + 4] = quaternion_from_dcm(np.stack([north, east, down], 1))
    turn = np.stack([east, -north], 1)
    cov = turn @ P[:, DOWN, DOWN] @ np.swapaxes(turn, 1, 2)
    rows[:, kernels.OUT_TILT_COV:kernels.OUT_TILT_COV + 3] = cov[:, [0, 0, 1], [0, 1, 1]]
