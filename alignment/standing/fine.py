"""The fine stage: a filter from the coarse attitude on.

riekf12, mekf and riekf6 run on steps, and these are remembered (:class:`Remembered`). The filter starts at the coarse
attitude of the *first* moment, told nothing of how good it is, and sees the window once more: nothing counts twice,
nothing is lost, and the coarse attitude only fixes about where the equations are made linear. As long as the
heading is poorly known, that is done again with the better attitude; where a gyro's bias may be a good part of the
Earth rate, from headings all round the circle. The filters of the error model run on samples, once
(:class:`Followed`).
"""

import math

import numpy as np

from alignment.standing import _kernels as kernels
from alignment.standing.coarse import UNKNOWN_HEADING_STD, bias_sensitivity, start_attitude
from alignment.standing.filters import WITHOUT_BIASES, Filter, bias_priors, heading_covariance
from alignment.standing.stillness import REST_BLOCK, SWAY_ANGLE
from inertial.earth import EARTH_RATE
from inertial.rotation import (
    dcm_from_quaternion,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
)

UNKNOWN = math.radians(30.0)
"""Spread of a heading that is not worth believing, rad."""
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
_NARROW = 0.1  # rad, a mixture's spread that one filter describes
_NO_ROWS = np.empty((0, kernels.OUT_SIZE))


class Remembered:
    """riekf12, mekf or riekf6 over steps that are kept, to be run again from a better first attitude.

    Parameters
    ----------
    name : str
        One of :data:`alignment.standing.filters.GROUP_FILTERS`.
    params : alignment.standing.params.StandingParams
    coarse : alignment.standing.coarse.CoarseResult
    steps : list of (STEP_SIZE,) float64
        Of the coarse alignment.
    biases : (6,) float64 or None
        That are known, of gyro and accelerometer.
    bias_covariance : (6, 6) float64 or None

    Attributes
    ----------
    filter : alignment.standing.filters.Filter
    doubt_var : float, rad^2
        Heading variance beside the filter's own: of other headings that would do.
    biases : (6,) float64 or None
        That it began with.
    """

    def __init__(self, name, params, coarse, steps, biases, bias_covariance):
        self._name, self._params, self._constants = name, params, params.constants()
        self._steps = steps
        self.biases, self._bias_covariance = biases, bias_covariance
        self._mixed = not params.drowned and params.gyro_bias_spread > _LARGE_BIAS * params.north_rate
        self.doubt_var = UNKNOWN_HEADING_STD ** 2 if self._mixed or params.drowned else 0.0
        self._find_large_bias = biases is not None and bias_covariance is None
        self._repeat_at = 2 * len(steps)
        self.filter = self._blind_filter(coarse.start_q_nb_wxyz)
        self._run_again(coarse.start_q_nb_wxyz)
        self._begin_checkpoints()

    def use(self, steps, spans, standing):
        """Run the filter over as many steps as nothing happens in; return how many, and the event."""
        found, since = self.filter, self._checkpoints[-1][1]
        room = 1 if found.moving else self._between(steps) - len(since)
        if len(self._steps) < self._repeat_at:
            room = min(room, self._repeat_at - len(self._steps))
        steps = steps[:room]
        used, event = found.run_steps(steps, _NO_ROWS)
        since.extend(steps[:used])
        if self._repeat_at:
            self._steps.extend(steps[:used])
        if event == kernels.MOVED:
            self._go_back()
        return used, event

    def settle(self, steps):
        """Make the equations linear anew where that is due, or keep a checkpoint."""
        since = self._checkpoints[-1][1]
        complete = len(since) >= self._between(steps)
        due = self._repeat_at and len(self._steps) >= self._repeat_at
        swung = self._repeat_at and complete and abs(self.filter.q[kernels.Q_SWING]) > _LARGEST_SWING
        if due or swung:
            if due:
                self._repeat_at = 2 * self._repeat_at if 2 * self._repeat_at <= _REPEAT_STEPS else 0
            self._run_again(self._first_attitude())
            self._begin_checkpoints()
        elif complete:
            self._checkpoints = [self._checkpoints[-1], (self.filter.snapshot(), [])]

    def known_biases(self):
        """Return the biases (6,) and their covariance (6, 6), as far as there are any."""
        if self._name in WITHOUT_BIASES:
            return self.biases, self._bias_covariance
        return self.filter.m[kernels.M_BG:kernels.M_X].copy(), self.filter.bias_covariance()

    # --- motion -----------------------------------------------------------------------------------

    @staticmethod
    def _between(steps):
        """Return how many steps there are between checkpoints."""
        return max(1, round(_CHECKPOINT_TIME / steps[0, kernels.STEP_DT]))

    def _begin_checkpoints(self):
        self._checkpoints = [(self.filter.snapshot(), [])] * 2

    def _go_back(self):
        """Take back the zero velocities of the seconds before motion was noticed: it may have crept before."""
        (snapshot, early), (_, late) = self._checkpoints
        steps = np.array(early if early is late else early + late)
        steps[:, kernels.STEP_MOVING] = 1.0
        self.filter.restore(snapshot)
        _run_all(self.filter, steps)
        if self._repeat_at:
            for kept in self._steps[-len(steps):]:
                kept[kernels.STEP_MOVING] = 1.0

    # --- once more --------------------------------------------------------------------------------

    def _blind_filter(self, q_nb_wxyz, heading_std=UNKNOWN_HEADING_STD):
        return Filter(self._name, self._params, q_nb_wxyz, heading_covariance(heading_std, _BLIND_TILT_STD),
                      self.biases, self._bias_covariance)

    def _run_again(self, q_start):
        """Run the filter over all remembered steps from ever better first attitudes."""
        steps = np.array(self._steps)
        for again in range(_REPEATS):
            known = again if self._mixed else self.filter.time > 0.0
            if known and self._apart(q_start) < _REPEAT_CHANGE:
                return
            self._linearised_at, off = q_start, 0.0
            if self._mixed:
                off = self._run_mixture(q_start, steps)
            else:
                self.filter = self._run_through(q_start, steps)
            if math.isnan(off):
                return
            q_start = quaternion_multiply(quaternion_exp([0.0, 0.0, off]), self._first_attitude())

    def _run_through(self, q_start, steps, heading_std=UNKNOWN_HEADING_STD):
        """Return the filter after steps from a first attitude."""
        found = self._blind_filter(q_start, heading_std)
        _run_all(found, steps)
        found.q[kernels.Q_SWING] = 0.0
        return found

    def _run_mixture(self, q_start, steps):
        """Run filters from headings all round the circle, and go on with the likeliest (Gaussian sum).

        Return how far off that one the mean of all is, rad; NaN where they are all round the circle.
        """
        if self._find_large_bias:
            self._use_rest(steps, dcm_from_quaternion(q_start))
        headings = _HEADINGS if self.doubt_var > 0.0 else _HEADINGS[:1]
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
        self.filter = found[best]
        self.doubt_var = max(total - var[best], 0.0) if total - mean ** 2 > _NARROW ** 2 else 0.0
        return mean if total - mean ** 2 < UNKNOWN ** 2 else math.nan

    def _use_rest(self, steps, dcm_nb):
        """Take the mean rate until the first turn for the gyros' bias, of which the prior knows less."""
        time = np.cumsum(steps[:, kernels.STEP_DT])
        edges = np.searchsorted(time, np.arange(0.0, max(time[-1], REST_BLOCK) - 0.5 * REST_BLOCK, REST_BLOCK))
        rates = np.add.reduceat(steps[:, kernels.STEP_DTHETA:kernels.STEP_DVEL], edges) / np.add.reduceat(
            steps[:, kernels.STEP_DT], edges)[:, None]
        turns = np.linalg.norm(rates - rates[0], axis=1) > 4 * SWAY_ANGLE / REST_BLOCK
        # A turn may have begun in the block before it shows.
        count = (int(np.argmax(turns)) if turns.any() else len(rates)) - 1
        if count < 1:
            return
        self.biases[:3] = rates[:count].mean(axis=0)
        bias_var = EARTH_RATE ** 2 + (SWAY_ANGLE / (count * REST_BLOCK)) ** 2
        self._bias_covariance = bias_priors(self._params, dcm_nb)
        self._bias_covariance[:3, :3] = min(bias_var, self._params.gyro_bias_spread ** 2) * np.eye(3)

    def _apart(self, q_start):
        return np.linalg.norm(quaternion_log(quaternion_multiply(
            q_start, quaternion_conjugate(self._linearised_at))))

    def _first_attitude(self):
        """Return the attitude at the first remembered step that follows from the present one."""
        sums = np.zeros(kernels.O_SIZE)
        kernels.run_coarse(self._constants, sums, self.filter.m[kernels.M_BG:kernels.M_X].copy(), np.array(self._steps))
        return start_attitude(sums, self.filter.R, self._params)


class Followed:
    """A filter of the error model, from the coarse attitude at the end of the window on.

    Parameters and attributes as of :class:`Remembered`.
    """

    doubt_var = 0.0

    def __init__(self, name, params, coarse, biases, bias_covariance):
        self.biases, self._bias_covariance = biases, bias_covariance
        self.filter = Filter(name, params, coarse.q_nb_wxyz, coarse.covariance,
                             None if name in WITHOUT_BIASES else biases, bias_covariance)
        self.filter.correlate_biases(bias_sensitivity(params))
        self.filter.q[kernels.Q_TIME] = coarse.time
        self.filter.q[kernels.Q_EAST:kernels.Q_COST] = coarse.time * self.filter.R[1]

    def use(self, steps, spans, standing):
        """Run the filter over the samples of the first step; return 1 for it, and what happened last."""
        samples, used, happened = spans[0], 0, kernels.NOTHING
        while used < len(samples.dt) and happened != kernels.ALARM:
            rest = samples.part(used, len(samples.dt))
            count, event = self.filter.run_samples(rest.dt, rest.gyro_b, rest.accel_b, standing, 1, _NO_ROWS)
            used += count
            happened = event if event != kernels.NOTHING else happened
        return 1, happened

    def settle(self, steps):
        """Do nothing: what has been used is not kept."""

    def known_biases(self):
        """Return the biases (6,) and their covariance (6, 6) that were known before, as far as there are any."""
        return self.biases, self._bias_covariance


def _run_all(found, steps):
    used = 0
    while used < len(steps):
        used += found.run_steps(steps[used:], _NO_ROWS)[0]
