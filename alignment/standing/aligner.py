"""The alignment of a standing vehicle, sample by sample: what ``alignment_node`` and ``align_bag`` run.

Waiting until the vehicle stands; a coarse alignment over ``coarse_window``; then the filter. The default filter,
riekf12, starts at the coarse attitude of the window's *first* moment, told nothing of how good it is, and sees the
window once more: nothing counts twice, nothing is lost, and the coarse attitude only fixes about where the
equations are made linear. As long as the heading is poorly known, that is done again with the better attitude.
Motion suspends zero velocities; after it the filter goes on with what it still knows, or, when its velocity no
longer agrees with standing, everything but the biases starts anew.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from alignment.north import explain_scale
from alignment.standing import _kernels as kernels
from alignment.standing.bound import heading_floor, time_to_target
from alignment.standing.coarse import (
    UNKNOWN_HEADING_STD,
    align_by_gravity,
    bias_sensitivity,
    level_by_force,
    limit_heading,
    start_attitude,
)
from alignment.standing.filters import GROUP_FILTERS, Filter, bias_priors, heading_covariance
from alignment.standing.params import SMALLEST_COS_LATITUDE
from inertial.earth import EARTH_RATE
from inertial.recording import ImuSeries
from inertial.rotation import (
    dcm_from_quaternion,
    euler_from_dcm,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
)

_LONGEST_GAP = 1.0  # s without a sample, after which the alignment starts anew
_STILL_TIME = 1.0  # s that a vehicle must stand before the coarse alignment begins
_PREVIEW = 2.0  # s of the coarse alignment from which there is a result
_LEVEL_TIME = 5.0  # s that the level is a mean of where the latitude is not known: the Earth turns on meanwhile
_LARGEST_FORCE_ERROR = 0.05  # of gravity: more is motion, or wrong units
_STANDING_AGAIN = 10.0  # s that sensors must look still, while the filter's velocity says otherwise
_BLIND_TILT_STD = 0.1  # rad, more than any coarse alignment is off
_REPEAT_STEPS = 12000  # remembered steps, at most; by then the heading is what it will be
_REPEAT_CHANGE = 0.02  # rad of heading, beyond which it is worth while to make the equations linear anew
_CHECKPOINT_TIME = 5.0  # s; motion takes back the zero velocities of the last one or two
_LARGEST_SWING = 0.2  # rad that the heading has been corrected by, after which that does not wait
_REPEATS = 4  # at most, each time
# A gyro's bias that may be this share of the horizontal Earth rate, or more, wants a mixture of headings: one filter
# that knows nothing of the heading would swing, and take its swings for evidence.
_LARGE_BIAS = 0.25
_HEADINGS = np.radians([0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180])
_HEADING_STD = math.radians(15.0)  # of each: half their distance adds up to a uniform density within 3 %
_SWAY_ANGLE = 5e-3  # rad, within which a vehicle at rest keeps its attitude, whoever steps in
_REST_BLOCK = 10.0  # s, over which a mean rate tells a turn
_NARROW = 0.1  # rad, a mixture's spread that one filter describes
_UNKNOWN = math.radians(30.0)  # spread of a heading that is not worth believing
_ANOTHER_SCALE = 0.02  # of gravity, by which the mean force may differ from it
_NO_BIAS = ("riekf6", "ekf5", "ipekf")


@dataclass(frozen=True)
class StandingResult:
    """An alignment.

    Attributes
    ----------
    stamp_ns : int
    q_nb_wxyz : (4,)
    covariance : (3, 3), rad^2
        Of the small rotation in navigation axes, with what the filter does not model.
    velocity_n : (3,), m/s
        Which should be zero.
    gyro_bias_b, accel_bias_b : (3,), rad/s and m/s^2
        Zero where the filter has none.
    gyro_bias_std, accel_bias_std : (3,)
    heading, heading_std, roll, pitch : float, rad
    floor : float, rad
        Smallest heading spread that the sensors allow so far.
    nis : float
        Normalised squared innovation per component, 1 when all is as modelled.
    cost : float
        J* of the IPEKF; NaN for others.
    time : float, s
        Since the alignment began.
    time_left : float, s
        Until the target may be reached; inf for never.
    """

    stamp_ns: int
    q_nb_wxyz: np.ndarray
    covariance: np.ndarray
    velocity_n: np.ndarray
    gyro_bias_b: np.ndarray
    accel_bias_b: np.ndarray
    gyro_bias_std: np.ndarray
    accel_bias_std: np.ndarray
    heading: float
    heading_std: float
    roll: float
    pitch: float
    floor: float
    nis: float
    cost: float
    time: float
    time_left: float


class StandingAligner:
    """Attitude and heading of a standing vehicle from its IMU.

    Parameters
    ----------
    params : alignment.standing.params.StandingParams

    Attributes
    ----------
    refused, gaps : int
        Samples that were not numbers or not later than the one before; gaps after which it started anew.
    """

    def __init__(self, params):
        self.refused = self.gaps = 0
        self._remarks = []
        self.params = params

    @property
    def params(self):
        """Parameters; new ones start the alignment anew."""
        return self._params

    @params.setter
    def params(self, params):
        self._params = params
        self._constants = params.constants()
        self._name = "riekf12" if params.method == "oba_riekf" else params.method
        self.reset()

    def reset(self):
        """Forget everything that was measured."""
        self._stamp_ns = None
        self._step, self._rate = np.zeros(kernels.A_SIZE), np.zeros(3)
        self._held, self._singles = _Samples.none(), []
        self._one = _Samples(np.zeros(1, dtype=np.int64), np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3)))
        self._one_step, self._one_end = np.empty((1, kernels.STEP_SIZE)), np.empty(1, dtype=np.int64)
        self._begin_anew(None, None)

    def add_imu(self, stamp_ns, gyro_b, accel_b):
        """Take in a sample, rad/s and m/s^2; return whether the result has changed."""
        dt = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        if not (0.0 < dt <= _LONGEST_GAP and math.isfinite(sum(gyro_b) + sum(accel_b))):
            return self._add(ImuSeries(np.array([stamp_ns], dtype=np.int64), np.array([gyro_b], dtype=float),
                                       np.array([accel_b], dtype=float)))
        self._stamp_ns = stamp_ns
        one = self._one
        one.stamp_ns[0], one.dt[0], one.gyro_b[0], one.accel_b[0] = stamp_ns, dt, gyro_b, accel_b
        if self._by_steps:
            return self._take(one)
        self._singles.append((stamp_ns, dt, *gyro_b, *accel_b))
        return self._take(one, held=True)

    def run(self, imu, period=1.0):
        """Take in a recording; return the results, one after each period with its phase.

        Parameters
        ----------
        imu : inertial.recording.ImuSeries
        period : float, s

        Returns
        -------
        list of (str, StandingResult or None)
        """
        if not len(imu):
            return []
        marks = np.arange(imu.stamp_ns[0] + round(1e9 * period), imu.stamp_ns[-1], round(1e9 * period))
        edges = [0, *np.searchsorted(imu.stamp_ns, marks, side="right"), len(imu)]
        found = []
        for start, end in zip(edges[:-1], edges[1:], strict=True):
            part = slice(start, end)
            self._add(ImuSeries(imu.stamp_ns[part], imu.gyro_b[part], imu.accel_b[part]))
            found.append((self.phase, self.result))
        return found

    def take_remarks(self):
        """Return what has happened since the last call, each as (good, text)."""
        remarks, self._remarks = self._remarks, []
        return remarks

    @property
    def moving(self):
        """Whether the vehicle moves."""
        return self._moved if self._filter is None else self._filter.moving

    @property
    def phase(self):
        """One of waiting, coarse, fine, aligned."""
        if self.moving or (self._filter is None and self._sums[kernels.O_TIME] == 0.0):
            return "waiting"
        if self._filter is None:
            return "coarse"
        found, target = self.result, self.params.target_std
        aligned = not self.refusal and found.heading_std <= target and found.floor <= target
        return "aligned" if aligned else "fine"

    @property
    def activity(self):
        """What the vehicle and the alignment are doing, in words."""
        if self.moving:
            return "motion seen: waits until the vehicle stands"
        if self._filter is not None:
            return f"{self._name}, {self._filter.q[kernels.Q_TIME]:.0f} s"
        return f"coarse alignment, {self._sums[kernels.O_TIME]:.0f} of {self.params.coarse_window:g} s"

    @property
    def refusal(self):
        """Why no heading may be believed; empty when it may."""
        if self.input_error:
            return self.input_error
        if self._no_latitude:
            return self._no_latitude
        if self.moving:
            return "the vehicle moves"
        if self._filter is None:
            return "the coarse alignment is under way" if self._sums[kernels.O_TIME] else "no second at rest yet"
        if self.result.heading_std > _UNKNOWN:
            how = ", with zero_velocity_while_turning" if self._drowned else ""
            return f"the gyros' biases hide the Earth rate: turn the vehicle or the IMU{how}"
        return ""

    @property
    def input_error(self):
        """What is wrong with the samples, as a unit or a scale; empty when they may be of a vehicle on the Earth."""
        allowed = _LARGEST_FORCE_ERROR if self._filter is None else \
            _ANOTHER_SCALE + 3 * self.params.accel_bias_spread / self.params.local_gravity
        return f"the accelerometers read {explain_scale(self._scale)}" if abs(self._scale - 1) > allowed else ""

    @property
    def result(self):
        """The present StandingResult, or None."""
        if self._result is None:
            self._result = self._make_result()
        return self._result

    @property
    def _drowned(self):
        """Whether the Earth rate is less than a bias, and no turn that tells them apart keeps the velocity."""
        return self.params.gyro_bias_spread > EARTH_RATE and not self.params.zero_velocity_while_turning

    @property
    def _no_latitude(self):
        if math.isnan(self.params.latitude):
            return "the latitude is not known: level only"
        if math.cos(self.params.latitude) < SMALLEST_COS_LATITUDE:
            return (f"latitude {math.degrees(self.params.latitude):.3f} deg is too near a pole for a heading: "
                    "level only")
        return ""

    # --- samples to steps -------------------------------------------------------------------------

    def _add(self, imu):
        """Sort out what cannot be used, and take in the rest; one sample or many."""
        changed = False
        good = np.isfinite(imu.gyro_b).all(axis=1) & np.isfinite(imu.accel_b).all(axis=1)
        last = -1 << 62 if self._stamp_ns is None else self._stamp_ns
        before = np.maximum.accumulate(np.concatenate([[last], np.where(good, imu.stamp_ns, last)]))[:-1]
        good &= imu.stamp_ns > before
        self.refused += int(np.sum(~good))
        stamp_ns, gyro_b, accel_b = imu.stamp_ns[good], imu.gyro_b[good], imu.accel_b[good]
        if not len(stamp_ns):
            return False
        if self._stamp_ns is None:
            self._stamp_ns = int(stamp_ns[0])
            stamp_ns, gyro_b, accel_b = stamp_ns[1:], gyro_b[1:], accel_b[1:]
        dt = np.diff(stamp_ns, prepend=self._stamp_ns) * 1e-9
        gaps = np.flatnonzero(dt > _LONGEST_GAP)
        edges = sorted({0, *gaps.tolist(), len(dt)})
        for start, end in zip(edges[:-1], edges[1:], strict=True):
            if start in gaps:
                changed |= self._skip_gap(dt[start])
                start += 1
            changed |= self._take(_Samples(stamp_ns[start:end], dt[start:end], gyro_b[start:end],
                                           accel_b[start:end]))
        if len(stamp_ns):
            self._stamp_ns = int(stamp_ns[-1])
        return changed

    def _skip_gap(self, gap):
        self.gaps += 1
        self._remark(False, f"gap of {gap:.1f} s: the alignment starts anew")
        self._step[:] = 0.0
        self._held, self._singles = _Samples.none(), []
        self._begin_anew(*self._known_biases())
        return True

    @property
    def _by_steps(self):
        """Whether the filter needs no samples, only what they sum up to."""
        return self._name in GROUP_FILTERS

    def _take(self, samples, held=False):
        """Reduce samples to steps and use them; ``held`` ones are among the singles already."""
        size = len(samples.dt)
        steps, ends = (self._one_step, self._one_end) if size == 1 else (
            np.empty((size, kernels.STEP_SIZE)), np.empty(size, dtype=np.int64))
        count = kernels.reduce_samples(self._step, samples.dt, samples.gyro_b, samples.accel_b,
                                       self.params.zero_velocity_period, steps, ends)
        if self._by_steps:
            return bool(count) and self._use(steps[:count].copy(), samples.stamp_ns[ends[:count]])
        if held and not count:
            return False
        return self._use_samples(steps[:count].copy(), ends[:count], samples, held)

    def _use_samples(self, steps, ends, samples, held):
        """Use steps together with their samples, and hold those of the step under way."""
        if self._singles:
            self._held = self._held.joined(_Samples.of(self._singles))
            self._singles = []
        offset = len(self._held.dt) - (len(samples.dt) if held else 0)
        every = self._held if held else self._held.joined(samples)
        ends = ends + offset
        edges = [0, *(ends + 1)]
        spans = [every.part(start, end) for start, end in zip(edges[:-1], edges[1:], strict=True)]
        self._held = every.part(edges[-1], len(every.dt))
        return self._use(steps, every.stamp_ns[ends], spans)

    def _use(self, steps, stamp_ns, spans=()):
        """Use steps that end at the stamps; an error model uses the spans of samples they were made of."""
        k, changed = 0, False
        while k < len(steps):
            if self._filter is None:
                used, new = 1, self._approach(steps[k])
            elif self._by_steps:
                used, new = self._refine(steps[k:]), True
            else:
                used, new = self._follow(steps[k], spans[k]), True
            k += used
            if new:
                self._result, changed = None, True
                self._result_stamp = int(stamp_ns[k - 1])
        return changed

    # --- waiting and coarse -----------------------------------------------------------------------

    def _begin_anew(self, biases, bias_covariance):
        self._filter = self._result = self._result_stamp = None
        self._biases, self._bias_covariance = biases, bias_covariance
        self._moved, self._still_time, self._scale = False, 0.0, 1.0
        self._sums = np.zeros(kernels.O_SIZE)
        self._force, self._turn, self._sway_var = np.zeros(3), np.zeros(3), 0.0
        self._steps = []

    def _approach(self, step):
        """Wait for a vehicle at rest, then sum up the coarse alignment; return whether there is a result."""
        started = self._sums[kernels.O_TIME] > 0.0
        if not self._looks_still(step) or (started and self._accelerates(step)):
            if not self._moved:
                self._remark(False, "motion seen: waits until the vehicle stands")
            kept = self._biases, self._bias_covariance
            had, scale = self._result is not None, self._scale
            self._begin_anew(*kept)
            self._moved, self._scale = True, scale
            return had
        self._still_time += step[kernels.STEP_DT]
        if self._still_time < _STILL_TIME:
            self._turn += step[kernels.STEP_DTHETA:kernels.STEP_DVEL]
            return False
        self._moved = False
        rate = self._turn / self._still_time
        if self._biases is None and self.params.gyro_bias_spread > EARTH_RATE \
                and np.linalg.norm(rate) < self.params.largest_rate:
            # A bias that the Earth rate drowns in is known best from the first second.
            self._biases = np.concatenate([rate, np.zeros(3)])
        biases = np.zeros(6) if self._biases is None else self._biases
        kernels.run_coarse(self._constants, self._sums, biases, step[None])
        time = self._sums[kernels.O_TIME]
        if not self._no_latitude:
            self._steps.append(step.copy())
            if time >= self.params.coarse_window:
                self._start_filter()
        elif time > _LEVEL_TIME:
            self._sums[kernels.O_ALPHA:kernels.O_BETA] *= max(1 - step[kernels.STEP_DT] / _LEVEL_TIME, 0.0)
        return time >= _PREVIEW

    def _looks_still(self, step):
        dt = step[kernels.STEP_DT]
        bias = 0.0 if self._biases is None else self._biases[:3]
        rate = step[kernels.STEP_DTHETA:kernels.STEP_DVEL] / dt - bias
        force = np.linalg.norm(step[kernels.STEP_DVEL:kernels.STEP_MEAN_DVEL]) / dt
        self._scale += (force / self.params.local_gravity - self._scale) * min(dt, 1.0)
        self._rate += (rate - self._rate) * min(dt / kernels.RATE_TIME, 1.0)
        turns = np.linalg.norm(self._rate) > self.params.largest_rate and not self.params.zero_velocity_while_turning
        return not turns and abs(self._scale - 1) < _LARGEST_FORCE_ERROR

    def _accelerates(self, step):
        """Whether the force of the last second, in axes that do not turn, differs from that of all the time."""
        time, dt = self._sums[kernels.O_TIME], step[kernels.STEP_DT]
        force = self._sums[:kernels.O_TIME].reshape(3, 3) @ step[kernels.STEP_DVEL:kernels.STEP_MEAN_DVEL] / dt
        mean = self._sums[kernels.O_ALPHA:kernels.O_BETA] / (min(time, _LEVEL_TIME) if self._no_latitude else time)
        self._force += (force - self._force) * (min(dt / _STILL_TIME, 1.0) if self._force.any() else 1.0)
        # The Earth turns, and so do axes carried by gyros with biases.
        rate = EARTH_RATE + (0.0 if self._biases is not None else 3 * self.params.gyro_bias_spread) \
            + 3 * self.params.gyro_noise_density
        allowed = self.params.largest_velocity / _STILL_TIME + self.params.local_gravity * rate * time
        apart = np.linalg.norm(self._force - mean)
        # What the force of a second has made of the velocity, without the Earth's turn.
        turned = 0.5 * self.params.local_gravity * EARTH_RATE * time
        sway_var = _STILL_TIME ** 2 * max(apart ** 2 - turned ** 2, 0.0)
        self._sway_var += (sway_var - self._sway_var) * min(dt / time, 1.0)
        return apart > allowed

    def _start_filter(self):
        coarse = align_by_gravity(self._sums, self.params, math.sqrt(self._sway_var))
        self._remark(True, f"coarse alignment: heading within {math.degrees(coarse.heading_std):.2f} deg")
        self._filter = self._make_filter(coarse)
        self._mixed = self._by_steps and not self._drowned \
            and self.params.gyro_bias_spread > _LARGE_BIAS * self.params.north_rate
        self._doubt_var = UNKNOWN_HEADING_STD ** 2 if self._mixed or self._drowned else 0.0
        self._find_large_bias = self._biases is not None and self._bias_covariance is None
        if self._filter.in_steps:
            self._repeat_at = 2 * len(self._steps)
            self._run_again(coarse.start_q_nb_wxyz)
            self._checkpoints = [(self._filter.snapshot(), [])] * 2
        self._still_time = 0.0

    def _make_filter(self, coarse):
        if self._by_steps:
            return self._blind_filter(coarse.start_q_nb_wxyz)
        biases = None if self._name in _NO_BIAS else self._biases
        found = Filter(self._name, self.params, coarse.q_nb_wxyz, coarse.covariance, biases, self._bias_covariance)
        found.correlate_biases(bias_sensitivity(self.params))
        found.q[kernels.Q_TIME] = coarse.time
        found.q[kernels.Q_EAST:kernels.Q_COST] = coarse.time * found.R[1]
        return found

    def _blind_filter(self, q_nb_wxyz, heading_std=UNKNOWN_HEADING_STD):
        return Filter(self._name, self.params, q_nb_wxyz, heading_covariance(heading_std, _BLIND_TILT_STD),
                      self._biases, self._bias_covariance)

    # --- fine ---------------------------------------------------------------------------------------

    def _refine(self, steps):
        """Run the filter over as many steps as nothing happens in; return how many."""
        found, since = self._filter, self._checkpoints[-1][1]
        between = max(1, round(_CHECKPOINT_TIME / steps[0, kernels.STEP_DT]))
        room = 1 if found.moving else between - len(since)
        if len(self._steps) < self._repeat_at:
            room = min(room, self._repeat_at - len(self._steps))
        steps = steps[:room]
        used, event = found.run_steps(steps, np.empty((0, kernels.OUT_SIZE)))
        since.extend(steps[:used])
        if self._repeat_at:
            self._steps.extend(steps[:used])
        if event == kernels.MOVED:
            self._go_back()
        self._heed(event, steps[used - 1])
        if self._filter is not found:
            return used
        due = self._repeat_at and len(self._steps) >= self._repeat_at
        swung = self._repeat_at and len(since) >= between and abs(found.q[kernels.Q_SWING]) > _LARGEST_SWING
        if due or swung:
            if due:
                self._repeat_at = 2 * self._repeat_at if 2 * self._repeat_at <= _REPEAT_STEPS else 0
            self._run_again(self._first_attitude())
            self._checkpoints = [(self._filter.snapshot(), [])] * 2
        elif len(since) >= between:
            self._checkpoints = [self._checkpoints[-1], (found.snapshot(), [])]
        return used

    def _go_back(self):
        """Take back the zero velocities of the seconds before motion was noticed: it may have crept before."""
        (snapshot, early), (_, late) = self._checkpoints
        steps = np.array(early if early is late else early + late)
        steps[:, kernels.STEP_MOVING] = 1.0
        self._filter.restore(snapshot)
        used = 0
        while used < len(steps):
            used += self._filter.run_steps(steps[used:], np.empty((0, kernels.OUT_SIZE)))[0]
        if self._repeat_at:
            for kept in self._steps[-len(steps):]:
                kept[kernels.STEP_MOVING] = 1.0

    def _follow(self, step, samples):
        """Run a filter of the error model over the samples of a step."""
        found, used = self._filter, 0
        standing = self._looks_still(step)
        while used < len(samples.dt) and self._filter is found:
            rest = samples.part(used, len(samples.dt))
            count, event = found.run_samples(rest.dt, rest.gyro_b, rest.accel_b, standing, 1,
                                             np.empty((0, kernels.OUT_SIZE)))
            used += count
            self._heed(event, step)
        return 1

    def _heed(self, event, step):
        """Tell of what a filter stopped for, and start anew where it cannot go on."""
        if event == kernels.MOVED:
            self._remark(False, "motion seen: no zero velocities")
            self._still_time = 0.0
        elif event == kernels.STANDS:
            self._remark(True, "stands again: goes on with what it knew")
        elif event == kernels.ALARM:
            self._remark(False, "the residuals contradict the attitude: back to the coarse alignment")
            self._begin_anew(None, None)
            return
        if self._filter.moving:
            still = self._looks_still(step) and self._keeps_velocity(step)
            self._still_time = self._still_time + step[kernels.STEP_DT] if still else 0.0
            if self._still_time >= _STANDING_AGAIN:
                self._remark(False, "stands again, but the velocity is lost: the alignment starts anew")
                self._begin_anew(*self._known_biases())

    def _keeps_velocity(self, step):
        """Whether the filter's velocity has stayed the same since the vehicle looks still."""
        velocity = self._filter.m[kernels.M_V:kernels.M_V + 3]
        if self._still_time == 0.0:
            self._velocity = velocity.copy()
        return np.linalg.norm(velocity - self._velocity) < self.params.largest_velocity * (1 + self._still_time)

    def _known_biases(self):
        if self._filter is None or self._name in _NO_BIAS or not self._filter.in_steps:
            return self._biases, self._bias_covariance
        return self._filter.m[kernels.M_BG:kernels.M_X].copy(), self._filter.bias_covariance()

    def _run_again(self, q_start):
        """Run the filter over all remembered steps from ever better first attitudes."""
        steps = np.array(self._steps)
        for again in range(_REPEATS):
            known = again if self._mixed else self._filter.q[kernels.Q_TIME] > 0.0
            if known and self._apart(q_start) < _REPEAT_CHANGE:
                return
            self._linearised_at, off = q_start, 0.0
            if self._mixed:
                off = self._run_mixture(q_start, steps)
            else:
                self._filter = self._run_through(q_start, steps)
            if math.isnan(off):
                return
            q_start = quaternion_multiply(quaternion_exp([0.0, 0.0, off]), self._first_attitude())

    def _run_through(self, q_start, steps, heading_std=UNKNOWN_HEADING_STD):
        """Return the filter after steps from a first attitude."""
        found, used = self._blind_filter(q_start, heading_std), 0
        while used < len(steps):
            used += found.run_steps(steps[used:], np.empty((0, kernels.OUT_SIZE)))[0]
        found.q[kernels.Q_SWING] = 0.0
        return found

    def _use_rest(self, steps, dcm_nb):
        """Take the mean rate until the first turn for the gyros' bias, of which the prior knows less."""
        time = np.cumsum(steps[:, kernels.STEP_DT])
        edges = np.searchsorted(time, np.arange(0.0, max(time[-1], _REST_BLOCK) - 0.5 * _REST_BLOCK, _REST_BLOCK))
        rates = np.add.reduceat(steps[:, kernels.STEP_DTHETA:kernels.STEP_DVEL], edges) / np.add.reduceat(
            steps[:, kernels.STEP_DT], edges)[:, None]
        turns = np.linalg.norm(rates - rates[0], axis=1) > 4 * _SWAY_ANGLE / _REST_BLOCK
        # A turn may have begun in the block before it shows.
        count = (int(np.argmax(turns)) if turns.any() else len(rates)) - 1
        if count < 1:
            return
        self._biases[:3] = rates[:count].mean(axis=0)
        bias_var = EARTH_RATE ** 2 + (_SWAY_ANGLE / (count * _REST_BLOCK)) ** 2
        self._bias_covariance = bias_priors(self.params, dcm_nb)
        self._bias_covariance[:3, :3] = min(bias_var, self.params.gyro_bias_spread ** 2) * np.eye(3)

    def _run_mixture(self, q_start, steps):
        """Run filters from headings all round the circle, and go on with the likeliest (Gaussian sum).

        Return how far off that one the mean of all is, rad; NaN where they are all round the circle.
        """
        if self._find_large_bias:
            self._use_rest(steps, dcm_from_quaternion(q_start))
        headings = _HEADINGS if self._doubt_var > 0.0 else _HEADINGS[:1]
        std = _HEADING_STD if len(headings) > 1 else 2 * _HEADING_STD
        found = [self._run_through(quaternion_multiply(quaternion_exp([0.0, 0.0, turn]), q_start), steps, std)
                 for turn in headings]
        misfit = np.array([one.q[kernels.Q_MISFIT] for one in found])
        best = int(np.argmin(misfit))
        weights = np.exp(misfit[best] - misfit)
        weights /= weights.sum()
        heading = np.array([math.atan2(one.R[1, 0], one.R[0, 0]) for one in found])
        apart = (heading - heading[best] + math.pi) % (2 * math.pi) - math.pi
        var = np.array([one.attitude_covariance()[2, 2] for one in found])
        mean = float(np.angle(weights @ np.exp(1j * apart - 0.5 * var)))
        total = float(weights @ (apart ** 2 + var))
        self._filter = found[best]
        self._doubt_var = max(total - var[best], 0.0) if total - mean ** 2 > _NARROW ** 2 else 0.0
        return mean if total - mean ** 2 < _UNKNOWN ** 2 else math.nan

    def _apart(self, q_start):
        return np.linalg.norm(quaternion_log(quaternion_multiply(
            q_start, quaternion_conjugate(self._linearised_at))))

    def _first_attitude(self):
        """Return the attitude at the first remembered step that follows from the present one."""
        sums = np.zeros(kernels.O_SIZE)
        biases = self._filter.m[kernels.M_BG:kernels.M_X].copy()
        kernels.run_coarse(self._constants, sums, biases, np.array(self._steps))
        return start_attitude(sums, self._filter.R, self.params)

    # --- result -------------------------------------------------------------------------------------

    def _make_result(self):
        if self._result_stamp is None or (self._filter is None and self._sums[kernels.O_TIME] == 0.0):
            return None
        row = np.full(kernels.OUT_SIZE, np.nan)
        row[kernels.OUT_V:kernels.OUT_BG_VAR] = 0.0
        if self._filter is None:
            time = float(self._sums[kernels.O_TIME])
            found = level_by_force(self._sums, self.params) if self._no_latitude \
                else align_by_gravity(self._sums, self.params, math.sqrt(self._sway_var))
            dcm, covariance = dcm_from_quaternion(found.q_nb_wxyz), found.covariance
            q_nb, east = found.q_nb_wxyz, time * dcm[1]
        else:
            row = self._filter.row()
            time = float(self._filter.q[kernels.Q_TIME])
            q_nb, east = row[:4], self._filter.q[kernels.Q_EAST:kernels.Q_COST]
            dcm, covariance = dcm_from_quaternion(q_nb), self._filter.attitude_covariance()
            covariance[2, 2] += self._doubt_var
            if self._name in _NO_BIAS:
                force, rate = bias_sensitivity(self.params)
                covariance = covariance + self.params.accel_bias_spread ** 2 * force @ force.T \
                    + self.params.gyro_bias_spread ** 2 * rate @ rate.T
        covariance = limit_heading(covariance)
        floor = UNKNOWN_HEADING_STD if self._no_latitude else heading_floor(east, time, self.params)
        roll, pitch, heading = (float(angle) for angle in euler_from_dcm(dcm))
        bias_std = np.sqrt(row[kernels.OUT_BG_VAR:kernels.OUT_NIS])
        return StandingResult(
            self._result_stamp, q_nb, covariance, row[kernels.OUT_V:kernels.OUT_BG],
            row[kernels.OUT_BG:kernels.OUT_BA], row[kernels.OUT_BA:kernels.OUT_BG_VAR], bias_std[:3], bias_std[3:],
            heading, math.sqrt(covariance[2, 2]), roll, pitch, floor, float(row[kernels.OUT_NIS]),
            float(row[kernels.OUT_COST]), time,
            math.inf if self._no_latitude else time_to_target(floor, time, self.params))

    def _remark(self, good, text):
        self._remarks.append((good, text))


@dataclass(frozen=True)
class _Samples:
    """Samples with their intervals."""

    stamp_ns: np.ndarray
    dt: np.ndarray
    gyro_b: np.ndarray
    accel_b: np.ndarray

    @classmethod
    def none(cls):
        return cls(np.empty(0, dtype=np.int64), np.empty(0), np.empty((0, 3)), np.empty((0, 3)))

    @classmethod
    def of(cls, rows):
        """Return the samples of rows (stamp, interval, rate, force)."""
        values = np.array([row[1:] for row in rows])
        return cls(np.array([row[0] for row in rows], dtype=np.int64), values[:, 0], values[:, 1:4], values[:, 4:])

    def joined(self, later):
        if not len(self.dt):
            return later
        return _Samples(*(np.concatenate([getattr(self, name), getattr(later, name)])
                          for name in ("stamp_ns", "dt", "gyro_b", "accel_b")))

    def part(self, start, end):
        return _Samples(self.stamp_ns[start:end], self.dt[start:end], self.gyro_b[start:end], self.accel_b[start:end])


def warm_up(params):
    """Align made-up samples once, so that no later one waits for a compiler.

    Parameters
    ----------
    params : StandingParams
    """
    latitude = params.latitude if math.cos(params.latitude) > SMALLEST_COS_LATITUDE else 0.5
    aligner = StandingAligner(replace(params, latitude=latitude, coarse_window=5.0))
    count = 800
    force = np.array([0.0, 0.0, -aligner.params.local_gravity])
    imu = ImuSeries(np.arange(count) * 10_000_000, np.zeros((count, 3)), np.tile(force, (count, 1)))
    aligner.run(imu)
    aligner.add_imu(int(imu.stamp_ns[-1]) + 10_000_000, np.zeros(3), force)
