"""The attitude of a whole recording, each sample from all of it: a Rauch-Tung-Striebel smoother.

The default filter runs forward by its own kernels. Then the recording is gone through backward, in parts that
the filter steps over once more, because the covariances of a long recording do not fit in memory.
Equations: ``docs/attitude.md``. Frames and units: :mod:`inertial`.
"""

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from attitude_estimator import _kernels as kernels
from attitude_estimator._smoother_kernels import carry_heading, smooth_back
from attitude_estimator.estimator import ACTION_RESET, ACTION_SKIP, AttitudeEstimator, Estimates
from attitude_estimator.params import AttitudeParams
from inertial.recording import AltitudeSeries, ImuSeries
from inertial.rotation import quaternion_from_dcm

N, VD, ALT = kernels.N, kernels.VD, kernels.ALT
BG, BA = slice(kernels.BG, kernels.BA), slice(kernels.BA, N)
X, P = slice(kernels.X, kernels.X + N), slice(kernels.P, kernels.P + N * N)  # in the filter's memory
PART = 2048  # samples whose covariances are held at once, 3 kB each


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
    check_smoothable(params)
    actions = np.zeros(len(imu), np.int64) if actions is None else np.asarray(actions)
    altitude, variance = _in_time_order(imu, actions, altitude, altitude_variance)
    parts = [_cut(imu, actions, altitude, variance, first) for first in range(0, len(imu), PART)]
    estimator = AttitudeEstimator(params)
    rows = np.empty((len(imu), Estimates.ROW_SIZE))
    fresh = np.zeros(len(imu), bool)
    memories, ends = [], [0]
    for k, part in enumerate(parts):
        memories.append(estimator._memory.copy())
        estimates, used = estimator.run(part.imu, part.altitude, part.variance, actions=part.actions)
        fresh[k * PART:k * PART + len(used)] = used
        ends.append(ends[-1] + len(estimates))
        rows[ends[-2]:ends[-1]] = estimates.rows
    estimates = Estimates(imu.stamp_ns[fresh], rows[:ends[-1]])
    covariance, starts = np.empty((len(estimates), 3, 3)), np.empty(len(estimates), bool)
    after, steps = _Smoothed(estimator._memory), _Steps()
    for part, memory, first, last in reversed(list(zip(parts, memories, ends[:-1], ends[1:], strict=True))):
        steps.replay(memory, part)
        here = slice(first, last)
        covariance[here], starts[here] = after.go_back(steps, params, rows[here])
    _write_attitude(estimates, covariance, starts, params)
    return estimates, fresh, estimator.faults


def check_smoothable(params):
    """Raise ValueError unless it is the default filter that is asked for."""
    if params.estimator != "dcm_row":
        raise ValueError(f"estimator = {params.estimator}: only dcm_row can be smoothed")


@dataclass(frozen=True)
class _Part:
    """Samples and the altitudes to take before each, by :attr:`AltitudeSeries.arrival`."""

    imu: ImuSeries
    actions: np.ndarray
    altitude: AltitudeSeries
    variance: np.ndarray


def _in_time_order(imu, actions, altitude, variance):
    """Let each altitude arrive just before the first used sample that is not earlier.

    An altitude for which there is none arrives after the last sample, which is never.
    """
    if altitude is None:
        none = np.zeros(0, np.int64)
        return AltitudeSeries(none, np.zeros(0), none), np.zeros(0)
    variance = np.zeros(len(altitude)) if variance is None else np.asarray(variance)
    arrival = altitude.arrival.copy()
    resets = np.flatnonzero(actions == ACTION_RESET)
    pieces = np.searchsorted(resets, altitude.arrival)
    for piece, (first, last) in enumerate(zip([0, *resets], [*resets, len(imu)], strict=True)):
        used = first + np.flatnonzero(actions[first:last] != ACTION_SKIP)
        inside = pieces == piece
        places = np.searchsorted(imu.stamp_ns[used], altitude.stamp_ns[inside])
        arrival[inside] = np.append(used, len(imu))[places]
        if first > 0:
            arrival[inside & (arrival == first)] = len(imu)  # the filter forgets what came before
    order = np.lexsort((altitude.stamp_ns, arrival))
    return (AltitudeSeries(altitude.stamp_ns[order], altitude.altitude[order], arrival[order]),
            variance[order])


def _cut(imu, actions, altitude, variance, first):
    part = slice(first, first + PART)
    here = (altitude.arrival >= first) & (altitude.arrival < first + PART)
    return _Part(ImuSeries(imu.stamp_ns[part], imu.gyro_b[part], imu.accel_b[part]), actions[part],
                 AltitudeSeries(altitude.stamp_ns[here], altitude.altitude[here],
                                altitude.arrival[here] - first), variance[here])


class _Steps:
    """How the filter came to each sample of a part; :func:`smooth_back` says what the arrays are.

    ``after_*[k]`` is the filter's state before step k, and ``after_*[k + 1]`` the one after it.
    """

    def __init__(self):
        self.after_x, self.after_P = np.empty((PART + 1, N)), np.empty((PART + 1, N, N))
        self.after_known, self.after_pulled = np.empty(PART + 1, bool), np.empty(PART + 1)
        self.predicted_x, self.predicted_P = np.empty((PART, N)), np.empty((PART, N, N))
        self.keeps = np.empty((PART, N), bool)
        self.dt, self.samples = np.empty(PART), np.empty((PART, 6))
        self.count = 0
        self._predicted = np.empty(kernels.M_OUT)

    def replay(self, memory, part):
        """Take the samples of a part once more, from the filter's memory before it."""
        self.count = waiting = 0
        self._keep_after(memory, 0)
        stamps, altitudes = part.imu.stamp_ns.tolist(), part.altitude.altitude.tolist()
        alt_stamps, arrival = part.altitude.stamp_ns.tolist(), part.altitude.arrival.tolist()
        for k, (stamp, action) in enumerate(zip(stamps, part.actions.tolist(), strict=True)):
            if action == ACTION_SKIP:
                continue
            if action == ACTION_RESET:
                kernels.reset(memory)
            self._predicted[:] = memory[:kernels.M_OUT]
            if kernels.push_imu(memory, stamp, part.imu.gyro_b[k], part.imu.accel_b[k]) != kernels.FRESH:
                continue
            self._predict(memory, forget=action == ACTION_RESET)
            if self.dt[self.count] == 0.0 and self.after_known[self.count] and action != ACTION_RESET:
                waiting = bisect_right(arrival, k, waiting)  # those within a long gap do not count
            while waiting < len(altitudes) and arrival[waiting] <= k:
                if math.isfinite(altitudes[waiting]):
                    age = (stamp - alt_stamps[waiting]) * 1e-9
                    self._take_altitude(memory, altitudes[waiting], part.variance[waiting], age)
                waiting += 1
            self.count += 1
            self._keep_after(memory, self.count)

    def _keep_after(self, memory, k):
        self.after_x[k] = memory[X]
        self.after_P[k] = memory[P].reshape(N, N)
        self.after_known[k] = memory[kernels.ATTITUDE] == 1.0
        self.after_pulled[k] = memory[kernels.PULLED]

    def _predict(self, memory, forget):
        """Keep the last sample as it was used, and what the filter predicted with it."""
        k = self.count
        head = memory[kernels.M_INTS:kernels.M_ALTITUDES].view(np.int64)[kernels.I_HEAD]
        row = kernels.M_HISTORY + head * kernels.H_SIZE
        dt, *sample, gyro_var, accel_var, force_known = memory[row:row + kernels.H_SIZE].tolist()
        self.dt[k], self.samples[k], self.keeps[k] = dt, sample, True
        predicted = memory
        if dt > 0.0:
            predicted = self._predicted
            predicted[kernels.SINCE_GRAVITY] = -np.inf  # so that nothing is updated
            kernels.imu_step(predicted, dt, *sample, gyro_var, accel_var, force_known == 1.0)
        self.predicted_x[k], self.predicted_P[k] = predicted[X], predicted[P].reshape(N, N)
        if dt == 0.0:  # the attitude started anew
            self.keeps[k] = not forget
            self.keeps[k, :kernels.BG] = False
        elif self.predicted_P[k, VD, ALT] == 0.0:  # the vertical channel did
            self.keeps[k, VD] = self.keeps[k, ALT] = False

    def _take_altitude(self, memory, z, variance, age):
        """Apply an altitude; what it moves the height reference by is process noise of the step to it."""
        k, covariance = self.count, memory[P].reshape(N, N)
        expected = covariance[ALT, ALT] + (memory[kernels.P_ALT_DELAY] + age) * covariance[ALT, VD]
        kernels.altitude_step(memory, z, variance, age)
        if memory[kernels.ALT_COUNT] == 1.0:
            self.keeps[k, ALT] = False
            self.predicted_x[k, ALT] = z
            self.predicted_P[k, ALT] = self.predicted_P[k, :, ALT] = 0.0
            self.predicted_P[k, ALT, ALT] = covariance[ALT, ALT]
        else:
            self.predicted_P[k, ALT, ALT] += max(memory[kernels.PH + ALT] - expected, 0.0)


class _Smoothed:
    """Smoothed state, which goes back part by part; at first the filter's last one."""

    def __init__(self, memory):
        self._x, self._P = memory[X].copy(), memory[P].reshape(N, N).copy()
        self._known = memory[kernels.ATTITUDE] == 1.0
        self._out_x, self._out_P = np.empty((PART, N)), np.empty((PART, N, N))
        self._out_known = np.empty(PART, bool)

    def go_back(self, steps, params, rows):
        """Go back over a part and write what the rows have besides the attitude.

        Returns
        -------
        covariance : (n, 3, 3)
            Of the down direction, with what a lasting acceleration may have pulled it along in the filter.
        starts : (n,) bool
            Where the attitude does not follow from the sample before.
        """
        n = steps.count
        x, covariance, known = self._out_x[:n], self._out_P[:n], self._out_known[:n]
        self._known = smooth_back(
            steps.after_x[:n], steps.after_P[:n], steps.after_known[:n], steps.predicted_x[:n],
            steps.predicted_P[:n], steps.keeps[:n], steps.dt[:n], steps.samples[:n], params.local_gravity(),
            params.earth_rate_down(), params.accel_bias_time, kernels.LOST_TRACE, self._x, self._P,
            self._known, x, covariance, known)
        _write_state(rows, x, np.diagonal(covariance, axis1=1, axis2=2), known)
        return covariance[:, :3, :3] + steps.after_pulled[1:n + 1, None, None] * np.eye(3), ~steps.keeps[:n, 0]


def _write_state(rows, x, variances, known):
    """Replace the filter's rows by the smoothed states, but for the attitude's quaternion and covariance."""
    for sample, bias, variance, states in ((kernels.OUT_GYRO, kernels.OUT_BG, kernels.OUT_BG_VAR, BG),
                                           (kernels.OUT_ACCEL, kernels.OUT_BA, kernels.OUT_BA_VAR, BA)):
        rows[:, sample:sample + 3] += rows[:, bias:bias + 3] - x[:, states]
        rows[:, bias:bias + 3] = x[:, states]
        rows[:, variance:variance + 3] = variances[:, states]
    rows[:, kernels.OUT_VD], rows[:, kernels.OUT_ALT] = x[:, VD], x[:, ALT]
    rows[:, kernels.OUT_VD_VAR], rows[:, kernels.OUT_ALT_VAR] = variances[:, VD], variances[:, ALT]
    rows[:, kernels.OUT_VALID] = known
    norm = np.linalg.norm(x[:, :3], axis=1)
    rows[:, kernels.OUT_NORM] = norm
    rows[known, kernels.OUT_DOWN:kernels.OUT_DOWN + 3] = x[known, :3] / norm[known, None]


def _write_attitude(estimates, covariance, starts, params):
    """Write quaternion, tilt covariance and yaw variance where there is an attitude."""
    known, down = estimates.valid, estimates.down_b
    north, yaw_variance = np.zeros_like(down), np.zeros(len(down))
    dt = np.diff(estimates.stamp_ns, prepend=estimates.stamp_ns[:1]) * 1e-9
    gyro_b = estimates.gyro_b - params.earth_rate_down() * down
    carry_heading(down, gyro_b, estimates.gyro_bias_variance, known, starts, dt, params.gyro_noise_density,
                  north, yaw_variance)
    rows, down, north = estimates.rows, down[known], north[known]
    east = np.cross(down, north)
    rows[known, kernels.OUT_Q:kernels.OUT_Q + 4] = quaternion_from_dcm(np.stack([north, east, down], axis=1))
    axes = np.stack([east, -north], axis=1)  # a turn about north moves down along -east
    tilt = axes @ covariance[known] @ np.swapaxes(axes, 1, 2)
    rows[known, kernels.OUT_TILT_COV:kernels.OUT_TILT_COV + 3] = tilt[:, [0, 0, 1], [0, 1, 1]]
    rows[known, kernels.OUT_YAW_VAR] = yaw_variance[known]
