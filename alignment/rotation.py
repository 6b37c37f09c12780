"""A table that turns steadily: sums over its samples, solved as often as one likes.

The harmonic fit needs nothing of a sample but its part in a few sums, so that a new result costs the same after
an hour as after a turn, and no sample is kept. Readings that outlie those about them are left out as they come.

Turning both ways cancels what follows the table's own rate: wobble, misalignment with its axis, and a delay
between the stamps of joint and IMU.
"""

import dataclasses
import math

import numpy as np

from alignment.azimuth import METHODS
from alignment.bounds import best_angle, turning_noise_density
from alignment.comparison import compare_headings, compare_levels, turning_readings
from alignment.errors import NotEnoughDataError
from alignment.harmonic import OUTLIER_THRESHOLD, fit_from_sums, huber_fit, robust_spread
from alignment.results import wrap_angle
from alignment.station import AlignmentResult, noise_std, solve_table, time_left

_LONGEST_GAP = 0.5  # s between samples over which the table's rate is not known
_TURNED_BACK = 0.1  # share of the way from which a table counts as turning both ways
_ENOUGH_TO_START = 5000  # readings about which the sums are taken
_LARGEST_ZERO_STD = 0.2  # rad; beyond, the first order of the prior is none


class SteadyRotation:
    """Level and heading from samples of a turning table.

    Parameters
    ----------
    params : alignment.params.AlignmentParams
        May be replaced at any time.

    Attributes
    ----------
    delay_seen : float, s
        Size of a delay between the stamps of joint and IMU that has been seen; it counts like ``joint_delay_std``.
    """

    def __init__(self, params):
        self.params = params
        self.delay_seen = 0.0
        self.reset()

    def reset(self):
        """Forget every sample."""
        # Columns 1, cos, sin, rate, time; channels x and y gyro, x, y and z accelerometer.
        self._normal, self._moment, self._squares = np.zeros((5, 5)), np.zeros((5, 5)), np.zeros(5)
        self._start = None
        self._last = None
        self._origin = self._duration = self._travel = self._turned = 0.0
        self._count = self._kept = 0

    @property
    def started(self):
        """Whether :meth:`start` has been called."""
        return self._start is not None

    def start(self, time, angle, gyro_b, accel_b):
        """Find coefficients near the fit, about which the sums are taken, from the samples of a turn.

        Parameters as of :meth:`add`, which wants these samples still.
        """
        some = slice(None, None, len(time) // _ENOUGH_TO_START + 1)
        columns = np.stack([np.ones_like(angle[some]), np.cos(angle[some]), np.sin(angle[some])], axis=-1)
        readings = np.concatenate([gyro_b[some, :2], accel_b[some]], axis=-1)
        self._start = np.zeros((5, 5))
        self._start[:3] = np.stack([huber_fit(columns, reading)[0] for reading in readings.T], axis=-1)
        self._origin = time[0]

    def add(self, time, angle, gyro_b, accel_b):
        """Take in samples that follow those before.

        Parameters
        ----------
        time : (N,) float64, s
            Times of the samples, each the mean of the interval before it, increasing.
        angle : (N,) float64, rad
            Table angle in the middle of each interval.
        gyro_b : (N, 3) float64, rad/s
        accel_b : (N, 3) float64, m/s^2
        """
        if self._last is None:
            self._last = time[0], angle[0]
        interval = np.diff(time, prepend=self._last[0])
        step = wrap_angle(np.diff(angle, prepend=self._last[1]))
        self._last = time[-1], angle[-1]
        follows = (interval > 0) & (interval < _LONGEST_GAP)
        time, angle, interval, step = time[follows], angle[follows], interval[follows], step[follows]
        if not len(time):
            return
        columns = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle), step / interval,
                            time - self._origin], axis=-1)
        readings = np.concatenate([gyro_b[follows, :2], accel_b[follows]], axis=-1)
        residual = readings - columns @ self._start
        for ahead in (step > 0, step <= 0):
            self._sum(columns[ahead], residual[ahead], interval[ahead])
        self._count += len(columns)
        self._duration += float(interval.sum())
        self._travel += float(np.abs(step).sum())
        self._turned += float(step.sum())

    def _sum(self, columns, residual, interval):
        if not len(columns):
            return
        if self.params.robust:
            # What follows the table's rate is no outlier, so that each way has its own centre.
            distance = np.abs(residual - np.median(residual, axis=0))
            stated = np.array([self.params.gyro_noise_density] * 2 + [self.params.accel_noise_density] * 3) \
                / math.sqrt(interval.mean())
            kept = np.all(distance <= OUTLIER_THRESHOLD * np.maximum(robust_spread(distance), stated), axis=1)
            columns, residual = columns[kept], residual[kept]
        self._normal += columns.T @ columns
        self._moment += columns.T @ residual
        self._squares += np.sum(residual ** 2, axis=0)
        self._kept += len(columns)

    @property
    def both_ways(self):
        """Whether the table has turned both ways."""
        return abs(self._turned) < (1 - 2 * _TURNED_BACK) * self._travel

    @property
    def _rate(self):
        """Mean size of the table's rate, rad/s."""
        return self._travel / self._duration if self._duration > 0 else 0.0

    @property
    def _rate_density(self):
        params = self.params
        return turning_noise_density(params.gyro_noise_density, params.gyro_bias_instability, self._rate,
                                     self._travel / (2 * math.pi), self.both_ways)

    def fits(self):
        """Return the harmonic fits of the x and y gyros and of the x, y and z accelerometers.

        Raises
        ------
        NotEnoughDataError
            The table did not turn far enough.
        """
        if not self._rate > 0:
            raise NotEnoughDataError("the table does not turn steadily")
        chosen = [0, 1, 2] + [3] * self.both_ways + [4] * self.params.estimate_drift
        normal = self._normal[np.ix_(chosen, chosen)]
        density = np.array([self._rate_density] * 2 + [self.params.accel_noise_density] * 3)
        variance = density ** 2 * self._count / self._duration
        return [fit_from_sums(normal, self._moment[chosen, k], self._squares[k], self._kept,
                              self._start[chosen, k], variance[k]).widened() for k in range(5)]

    def result(self):
        """Return what is known so far.

        Returns
        -------
        alignment.station.AlignmentResult

        Raises
        ------
        NotEnoughDataError
            The table did not turn far enough.
        UnobservableError
            The latitude is a pole's.
        """
        params = self.params
        fits = self.fits()
        # A delay turns the table's zero by as much as the table turns, one way less the other.
        turned = self._turned / self._duration * max(params.joint_delay_std, self.delay_seen)
        zero_std = min(math.hypot(params.table_zero_std, turned), _LARGEST_ZERO_STD)
        level, north = solve_table(*fits[:4], float(fits[4].bias),
                                   dataclasses.replace(params, table_zero_std=zero_std))
        if north is None or math.isnan(north.heading):
            return AlignmentResult(level, north, math.nan, math.inf)
        noise = noise_std(fits, level, params)
        white = params.gyro_noise_density / self._rate_density
        return AlignmentResult(level, north, noise * math.sqrt(1 - white ** 2),
                               time_left(float(north.std), noise, self._duration, params.target_std))

    def compare_levels(self):
        """Return the level by every levelling method that a rotation serves: name to result."""
        fits = self.fits()
        return {"joint": self.result().level} | compare_levels(
            turning_readings(fits[2]), turning_readings(fits[3]), self.params)

    def compare_headings(self, level=None, names=tuple(METHODS)):
        """Return the heading by the joint estimator and by every closed form that a rotation serves: name to result.

        Parameters
        ----------
        level : alignment.results.LevelResult, optional
            The joint one when absent.
        names : iterable of str
            Closed forms wanted.
        """
        found = self.result()
        if found.north is None:
            return {}
        level = found.level if level is None else level
        best = best_angle(float(level.roll), float(level.pitch), float(found.north.heading), self.params.latitude)
        return {"joint": found.north} | compare_headings(
            turning_readings(self.fits()[0], best), level, self.params, names, float(found.north.heading))
