"""The alignment of a standing vehicle, sample by sample: what ``alignment_node`` and ``align_bag`` run.

Waiting until the vehicle stands (:mod:`alignment.standing.stillness`); a coarse alignment over ``coarse_window``
(:mod:`alignment.standing.coarse`); then a filter (:mod:`alignment.standing.fine`). Motion suspends zero velocities;
after it the filter goes on with what it still knows, or, when its velocity no longer agrees with standing, everything
but the biases starts anew. Here are the phases, and what is told of them.
"""

import math
from dataclasses import replace

import numpy as np

from alignment.north import explain_scale
from alignment.standing import _kernels as kernels
from alignment.standing.coarse import align_by_gravity
from alignment.standing.filters import GROUP_FILTERS
from alignment.standing.fine import UNKNOWN, Followed, Remembered
from alignment.standing.params import SMALLEST_COS_LATITUDE
from alignment.standing.results import coarse_result, fine_result
from alignment.standing.samples import StepMaker
from alignment.standing.stillness import LEVEL_TIME, STILL_TIME, Stillness, explain_noise
from inertial.earth import EARTH_RATE
from inertial.recording import ImuSeries

_PREVIEW = 2.0  # s of the coarse alignment from which there is a result
_STANDING_AGAIN = 10.0  # s that sensors must look still, while the filter's velocity says otherwise
# Zero velocities of sensors as they were told scatter little more than stated, also where people walk and an engine
# runs; where gyros are noisier than told the attitude wanders, and they scatter more within seconds.
_DOUBTFUL_SCALE = 4.0  # of their variance
_TRUSTED_AGAIN = 120.0  # s after an alarm that noise may explain


class StandingAligner:
    """Attitude and heading of a standing vehicle from its IMU.

    Parameters
    ----------
    params : alignment.standing.params.StandingParams
    """

    def __init__(self, params):
        self._maker = StepMaker()
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
        self._maker.period = params.zero_velocity_period
        self._maker.with_spans = not self._by_steps
        self.reset()

    def reset(self):
        """Forget everything that was measured."""
        self._maker.reset()
        self._stillness = Stillness(self.params)
        self._alarmed = False
        self._begin_anew(None, None)

    @property
    def refused(self):
        """Samples that were not numbers or not later than the one before."""
        return self._maker.refused

    @property
    def gaps(self):
        """Gaps after which it started anew."""
        return self._maker.gaps

    def add_imu(self, stamp_ns, gyro_b, accel_b):
        """Take in a sample, rad/s and m/s^2; return whether the result has changed."""
        return self._use_all(self._maker.add_one(stamp_ns, gyro_b, accel_b))

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
            self._use_all(self._maker.add(ImuSeries(imu.stamp_ns[part], imu.gyro_b[part], imu.accel_b[part])))
            found.append((self.phase, self.result))
        return found

    # --- what is told -----------------------------------------------------------------------------

    def take_remarks(self):
        """Return what has happened since the last call, each as (good, text)."""
        remarks, self._remarks = self._remarks, []
        return remarks

    @property
    def moving(self):
        """Whether the vehicle moves."""
        return self._moved if self._fine is None else self._fine.filter.moving

    @property
    def phase(self):
        """One of waiting, coarse, fine, aligned."""
        if self.moving or (self._fine is None and self._sums[kernels.O_TIME] == 0.0):
            return "waiting"
        if self._fine is None:
            return "coarse"
        found, target = self.result, self.params.target_std
        aligned = not self.refusal and found.heading_std <= target and found.floor <= target
        return "aligned" if aligned else "fine"

    @property
    def activity(self):
        """What the vehicle and the alignment are doing, in words."""
        if self.moving:
            return "motion seen: waits until the vehicle stands"
        if self._fine is not None:
            return f"{self._name}, {self._fine.filter.time:.0f} s"
        return f"coarse alignment, {self._sums[kernels.O_TIME]:.0f} of {self.params.coarse_window:g} s"

    @property
    def refusal(self):
        """Why no heading may be believed; empty when it may."""
        told = self.input_error or self._no_latitude
        if told:
            return told
        if self._fine is None or self.moving:
            return self._why_not_yet
        if self.result.heading_std > UNKNOWN:
            how = ", with zero_velocity_while_turning" if self.params.drowned else ""
            return f"the gyros' biases hide the Earth rate: turn the vehicle or the IMU{how}"
        return self._doubt

    @property
    def input_error(self):
        """What is wrong with the samples, as a unit or a scale; empty when they may be of a vehicle on the Earth."""
        wrong = self._stillness.scale_is_wrong(standing=self._fine is not None)
        return f"the accelerometers read {explain_scale(self._stillness.scale)}" if wrong else ""

    @property
    def result(self):
        """The present :class:`alignment.standing.results.StandingResult`, or None."""
        if self._result is None and self._result_stamp is not None:
            if self._fine is not None:
                self._result = fine_result(self._result_stamp, self._fine, self.params)
            elif self._sums[kernels.O_TIME] > 0.0:
                self._result = coarse_result(self._result_stamp, self._sums, self._sway_std, self.params)
        return self._result

    @property
    def _no_latitude(self):
        if not self.params.no_latitude:
            return ""
        if math.isnan(self.params.latitude):
            return "the latitude is not known: level only"
        return f"latitude {math.degrees(self.params.latitude):.3f} deg is too near a pole for a heading: level only"

    @property
    def _why_not_yet(self):
        """Why there is no filter, or why it waits."""
        told = self._stillness.explain_rate() or (self._alarmed and self._poorer_sensors)
        if told:
            return told
        if self.moving:
            return "the vehicle moves"
        return "the coarse alignment is under way" if self._sums[kernels.O_TIME] else "no second at rest yet"

    @property
    def _doubt(self):
        """What speaks against sensors as good as the parameters say; empty where the residuals are those of such."""
        state = self._fine.filter
        doubtful = state.q[kernels.Q_SCALE] > _DOUBTFUL_SCALE or (self._alarmed and state.time < _TRUSTED_AGAIN)
        return self._poorer_sensors if doubtful else ""

    @property
    def _poorer_sensors(self):
        told = explain_noise(self._maker.noise_density, self.params)
        return told and (f"{told}, and the attitude wanders more than it should: poorer sensors than the parameters, "
                         "or a vehicle that shakes")

    @property
    def _sway_std(self):
        return math.sqrt(self._stillness.sway_var)

    @property
    def _by_steps(self):
        """Whether the filter needs no samples, only what they sum up to."""
        return self._name in GROUP_FILTERS

    # --- phases -----------------------------------------------------------------------------------

    def _use_all(self, parts):
        changed = False
        for part in parts:
            if part.gap:
                self._remark(False, f"gap of {part.gap:.1f} s: the alignment starts anew")
                self._begin_anew(*self._known_biases())
                changed = True
            changed |= self._use(part)
        return changed

    def _use(self, steps):
        """Use steps; return whether the result has changed."""
        k, changed = 0, False
        while k < len(steps.values):
            used, new = (1, self._approach(steps.values[k])) if self._fine is None else (
                self._refine(steps.values[k:], steps.spans[k:]), True)
            k += used
            if new:
                self._result, changed = None, True
                self._result_stamp = int(steps.stamp_ns[k - 1])
        return changed

    def _begin_anew(self, biases, bias_covariance):
        self._fine = self._result = self._result_stamp = None
        self._biases, self._bias_covariance = biases, bias_covariance
        self._moved, self._still_time = False, 0.0
        self._sums, self._turn = np.zeros(kernels.O_SIZE), np.zeros(3)
        self._stillness.begin_anew()
        self._steps = []

    def _known_biases(self):
        return (self._biases, self._bias_covariance) if self._fine is None else self._fine.known_biases()

    def _approach(self, step):
        """Wait for a vehicle at rest, then sum up the coarse alignment; return whether there is a result."""
        started = self._sums[kernels.O_TIME] > 0.0
        if not self._looks_still(step) or (started and self._stillness.accelerates(
                step, self._sums, self._biases is not None)):
            return self._wait()
        self._still_time += step[kernels.STEP_DT]
        if self._still_time < STILL_TIME:
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
        if not self.params.no_latitude:
            self._steps.append(step.copy())
            if time >= self.params.coarse_window:
                self._start_filter()
        elif time > LEVEL_TIME:
            self._sums[kernels.O_ALPHA:kernels.O_BETA] *= max(1 - step[kernels.STEP_DT] / LEVEL_TIME, 0.0)
        return time >= _PREVIEW

    def _wait(self):
        """Forget what was measured of a vehicle that moves; return whether there was a result."""
        if not self._moved:
            self._remark(False, "motion seen: waits until the vehicle stands")
        had, scale = self._result is not None, self._stillness.scale
        self._begin_anew(self._biases, self._bias_covariance)
        self._moved, self._stillness.scale = True, scale
        return had

    def _looks_still(self, step):
        biases = self._biases if self._fine is None else self._fine.biases
        return self._stillness.looks_still(step, 0.0 if biases is None else biases[:3])

    def _start_filter(self):
        coarse = align_by_gravity(self._sums, self.params, self._sway_std)
        self._remark(True, f"coarse alignment: heading within {math.degrees(coarse.heading_std):.2f} deg")
        known = self._biases, self._bias_covariance
        self._fine = Remembered(self._name, self.params, coarse, self._steps, *known) if self._by_steps \
            else Followed(self._name, self.params, coarse, *known)
        self._still_time = 0.0

    def _refine(self, steps, spans):
        """Run the filter over steps until something happens; return how many were used."""
        fine = self._fine
        standing = self._by_steps or self._looks_still(steps[0])
        used, event = fine.use(steps, spans, standing)
        self._heed(event, steps[used - 1])
        if self._fine is fine:
            fine.settle(steps)
        return used

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
            self._alarmed = True
            return
        if self._fine.filter.moving:
            still = self._looks_still(step) and self._keeps_velocity(step)
            self._still_time = self._still_time + step[kernels.STEP_DT] if still else 0.0
            if self._still_time >= _STANDING_AGAIN:
                self._remark(False, "stands again, but the velocity is lost: the alignment starts anew")
                self._begin_anew(*self._known_biases())

    def _keeps_velocity(self, step):
        """Whether the filter's velocity has stayed the same since the vehicle looks still."""
        velocity = self._fine.filter.m[kernels.M_V:kernels.M_V + 3]
        if self._still_time == 0.0:
            self._velocity = velocity.copy()
        return np.linalg.norm(velocity - self._velocity) < self.params.largest_velocity * (1 + self._still_time)

    def _remark(self, good, text):
        self._remarks.append((good, text))


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
