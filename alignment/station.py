"""A turntable alignment as it happens: dwells come in one by one, the result may be asked for at any time.

This is what a node and a command line call. It holds the dwells, says which angle is wanted next, and gives
level from the first dwell on and heading as soon as three angles have been seen.
"""

import math
from dataclasses import dataclass

import numpy as np

from alignment import azimuth, bounds, levelling, sequences
from alignment.errors import NotEnoughDataError
from alignment.harmonic import fit_harmonic
from alignment.levelling import level_jointly
from alignment.north import find_north
from alignment.results import LARGEST_SCALE_ERROR, UNBELIEVABLE, HeadingResult, LevelResult, Quality
from inertial.earth import STANDARD_GRAVITY, normal_gravity
from inertial.rotation import roll_pitch_from_down

_SMALLEST_COS_PITCH = 1e-3  # keeps the roll's variance finite when the table stands on end
_LONGEST_FORECAST = 24 * 3600.0
_HALF_TURN = (0.0, math.pi)
_TURNED_BACK = 0.1  # share of the time from which a table counts as turning both ways


@dataclass(frozen=True)
class AlignmentResult:
    """What is known so far.

    Attributes
    ----------
    level : alignment.results.LevelResult
    north : alignment.results.HeadingResult or None
        None until three angles have been seen, or without a latitude.
    floor : float, rad
        Part of the heading's deviation that is 1/f noise: what waiting no longer removes quickly.
    time_left : float, s
        Until the asked accuracy; 0 when reached, infinite when it cannot be.
    reason : str
        Why ``north`` is None, where the readings are not enough for it.
    """

    level: LevelResult
    north: HeadingResult | None
    floor: float
    time_left: float
    reason: str = ""

    @property
    def believable(self):
        """Whether the heading may be published."""
        return self.north is not None and not self.north.flags & UNBELIEVABLE


class TableAlignment:
    """Level and heading of a turntable from dwells.

    Parameters
    ----------
    params : alignment.params.AlignmentParams
    """

    def __init__(self, params):
        self.params = params
        self._dwells = []
        self.rejected = []

    @property
    def dwells(self):
        """The accepted dwells, in order."""
        return tuple(self._dwells)

    @property
    def gravity(self):
        """Magnitude of gravity used, m/s^2."""
        if not math.isnan(self.params.gravity):
            return self.params.gravity
        latitude = self.params.latitude
        return STANDARD_GRAVITY if math.isnan(latitude) else float(normal_gravity(latitude))

    def add(self, dwell):
        """Take in a dwell; return the reason when it is rejected, otherwise an empty string."""
        reason = dwell.rejection
        if not reason and self._dwells and dwell.start < self._dwells[-1].end - 1e-9:
            reason = "it overlaps the dwell before"
        (self.rejected if reason else self._dwells).append(dwell)
        return reason

    def reset(self):
        """Forget every dwell."""
        self._dwells, self.rejected = [], []

    def next_angle(self):
        """Return the table angle wanted next, rad, following the sequence of the parameters."""
        count = len(self._dwells)
        if self.params.sequence != "refined" or self._used_time() < self.params.coarse_time:
            once = self.params.sequence == "single_pass"
            order = sequences.FOUR_POSITIONS if once else sequences.PALINDROME
            return order[count % len(order)]
        result = self.result()
        if not result.believable:
            return sequences.PALINDROME[count % len(sequences.PALINDROME)]
        best = bounds.best_angle(float(result.level.roll), float(result.level.pitch),
                                 float(result.north.heading), self.params.latitude)
        # The order +--+ cancels a drift.
        return (best + _HALF_TURN[(count + 1) // 2 % 2]) % (2 * math.pi)

    def result(self):
        """Return what is known so far.

        Raises
        ------
        NotEnoughDataError
            No dwell yet.
        UnobservableError
            The latitude is a pole's.
        """
        if not self._dwells:
            raise NotEnoughDataError("no dwell has been accepted yet")
        schedule = self._schedule()
        try:
            level, north = self._solve(schedule)
        except NotEnoughDataError as error:
            return AlignmentResult(self._level_of_few(), None, math.nan, math.inf, str(error))
        if north is None or np.isnan(north.heading):
            return AlignmentResult(level, north, math.nan, math.inf)
        attitude = float(level.roll), float(level.pitch), float(north.heading), self.params.latitude
        white, total = (
            bounds.predicted_heading_std(schedule, self.params.gyro_noise_density, instability, *attitude)
            for instability in (0.0, self.params.gyro_bias_instability))
        # The prediction is of one gyro; two do better.
        floor = math.sqrt(max(total ** 2 - white ** 2, 0.0)) * min(1.0, float(north.std) / total)
        return AlignmentResult(level, north, floor, self._time_left(float(north.std), white, total))

    def compare_methods(self, hint=None, level=None):
        """Return the heading by every closed form whose positions have been visited: name to result.

        Parameters
        ----------
        hint : float, optional
            Heading by a compass, rad, to choose among branches; the joint estimator's when absent.
        level : alignment.results.LevelResult, optional
            The joint one when absent.
        """
        found = self.result()
        level = found.level if level is None else level
        if hint is None and found.north is not None:
            hint = found.north.heading
        results = {"joint": found.north} if found.north is not None else {}
        for name, method in azimuth.METHODS.items():
            readings = [self._reading_at(position) for position in method.positions]
            if None not in readings:
                results[name] = azimuth.find_azimuth(
                    name, [rate for rate, _ in readings], level.roll, level.pitch,
                    self.params.latitude, rate_covariance=np.diag([var for _, var in readings]),
                    level_covariance=level.covariance, latitude_std=self.params.latitude_std, hint=hint,
                    shared_channel="tipped" in method.positions)
        return results

    def compare_levelling(self):
        """Return the level by every levelling method whose positions have been visited: name to result."""
        results = {"joint": self.result().level}
        angle, gravity = np.array([dwell.angle for dwell in self._dwells]), self.gravity
        accel_b = np.array([dwell.accel_b for dwell in self._dwells])
        variance = self.params.accel_noise_density ** 2 / np.array([dwell.duration for dwell in self._dwells])
        four_x, four_y = (self._mean_forces(("0", "90", "180", "270"), axis) for axis in (0, 1))
        tipped = self._mean_forces(("0", "90", "180", "tipped"), 0)
        if four_x:
            results["levelling_1"] = levelling.levelling_1(four_x[0], gravity, four_x[1])
            results["levelling_3"] = levelling.levelling_3(four_y[0], gravity, four_y[1])
        try:
            for name, method, axis in (("levelling_2", levelling.levelling_2, 0),
                                       ("levelling_4", levelling.levelling_4, 1)):
                results[name] = method(angle, accel_b[:, axis], gravity, np.diag(variance))
        except NotEnoughDataError:  # fewer than three angles
            pass
        if tipped:
            results["levelling_5"] = levelling.levelling_5(
                tipped[0][:3], tipped[0][3], gravity, tipped[1], shared_channel=True)
        return dict(sorted(results.items()))

    def _mean_forces(self, positions, axis):
        """Return mean accelerometer readings at positions and their covariance; None if one is missing."""
        means = [self._mean_at(position, "accel_b", axis) for position in positions]
        if None in means:
            return None
        density = self.params.accel_noise_density
        return (np.array([mean for mean, _ in means]),
                np.diag([density ** 2 / duration for _, duration in means]))

    def _schedule(self):
        column = {name: np.array([getattr(dwell, name) for dwell in self._dwells])
                  for name in ("angle", "start", "end")}
        start = self._dwells[0].start
        return sequences.Schedule(column["angle"], column["start"] - start, column["end"] - start,
                                  np.zeros(len(self._dwells)))

    def _used_time(self):
        return sum(dwell.duration for dwell in self._dwells)

    def _solve(self, schedule):
        params = self.params
        gyro_b = np.array([dwell.gyro_b for dwell in self._dwells])
        accel_b = np.array([dwell.accel_b for dwell in self._dwells])
        accel_variance = params.accel_noise_density ** 2 / schedule.duration
        # The y axis is a quarter turn ahead of x.
        fits = [(fit_harmonic(schedule.angle, accel_b[:, axis], accel_variance), 0.5 * math.pi * axis)
                for axis in (0, 1)]
        accel_z = np.average(accel_b[:, 2], weights=schedule.duration)
        level = level_jointly(fits, accel_z, params, self.gravity)
        if math.isnan(params.latitude) or np.isnan(level.roll):
            return level, None
        covariance = bounds.noise_covariance(
            schedule, params.gyro_noise_density, params.gyro_bias_instability)
        time = schedule.middle if params.estimate_drift else None
        fit_x, fit_y = (fit_harmonic(schedule.angle, gyro_b[:, axis], covariance, time=time)
                        for axis in (0, 1))
        north = find_north(fit_x, fit_y if params.use_y_gyro else None, [level.roll, level.pitch],
                           level.covariance, params.latitude, params)
        return level, north

    def _level_of_few(self):
        """Return the level before the table has turned: the accelerometers as they are, bias and all."""
        tau = self._dwells[-1].angle
        x, y, z = self._dwells[-1].accel_b
        force_t = np.array([math.cos(tau) * x - math.sin(tau) * y, math.sin(tau) * x + math.cos(tau) * y, z])
        roll, pitch = roll_pitch_from_down(-force_t)
        variance = (self.params.accel_bias_std / self.gravity) ** 2
        covariance = variance * np.diag([1 / max(np.cos(pitch), _SMALLEST_COS_PITCH) ** 2, 1.0])
        scale = np.linalg.norm(force_t) / self.gravity
        quality = np.asarray(Quality.SCALE.value if abs(scale - 1) > LARGEST_SCALE_ERROR else 0)
        return LevelResult(roll, pitch, covariance, np.asarray(np.nan), np.asarray(scale), quality)

    def _time_left(self, std, white, total):
        """Return how long until the asked accuracy if the sequence goes on, s.

        White noise and, with returns to each angle, 1/f noise fall with the root of the time; the priors
        stay.
        """
        target = self.params.target_std
        fixed = max(std ** 2 - total ** 2, 0.0)
        if std <= target:
            return 0.0
        if fixed >= target ** 2:
            return math.inf
        factor = total ** 2 / (target ** 2 - fixed)
        left = self._used_time() * (factor - 1)
        return left if left < _LONGEST_FORECAST else math.inf

    def _reading_at(self, position):
        """Return mean x rate at a table angle in deg (or of z for the tipped sensor) and its variance."""
        mean = self._mean_at(position, "gyro_b", 0)
        return mean and (mean[0], self.params.gyro_noise_density ** 2 / mean[1])

    def _mean_at(self, position, triad, axis):
        """Return the mean reading of an axis at a position and its duration, or None.

        The position is a table angle in deg, or ``"tipped"``: the z axis at any angle.
        """
        if position in ("any", "maximum"):
            return None
        tipped = position == "tipped"
        chosen = [dwell for dwell in self._dwells if tipped or abs(math.remainder(
            dwell.angle - math.radians(float(position)), 2 * math.pi)) <= self.params.position_tolerance]
        if not chosen:
            return None
        duration = [dwell.duration for dwell in chosen]
        readings = [getattr(dwell, triad)[2 if tipped else axis] for dwell in chosen]
        return np.average(readings, weights=duration), sum(duration)


def align_turning(time, angle, gyro_b, accel_b, params):
    """Return level and heading from raw samples of a table that turns steadily, one way or both.

    Turning both ways cancels what follows the table's own rate: wobble, and misalignment with its axis.

    Parameters
    ----------
    time : (N,) float64, s
        Times of the samples, each the mean of the interval before it, increasing.
    angle : (N,) float64, rad
        Table angle in the middle of each interval.
    gyro_b : (N, 3) float64, rad/s
    accel_b : (N, 3) float64, m/s^2
    params : alignment.params.AlignmentParams

    Returns
    -------
    AlignmentResult

    Raises
    ------
    NotEnoughDataError
        The table did not turn far enough.
    UnobservableError
        The latitude is a pole's.
    """
    interval = float(np.median(np.diff(time)))
    rate = np.gradient(np.unwrap(angle), time)
    typical = float(np.median(np.abs(rate)))
    if not typical > 0:
        raise NotEnoughDataError("the table does not turn: give its dwells to TableAlignment")
    both_ways = min(np.mean(rate > 0), np.mean(rate < 0)) > _TURNED_BACK
    density = bounds.turning_noise_density(params.gyro_noise_density, params.gyro_bias_instability, typical)
    options = {"rate": rate if both_ways else None, "robust": params.robust,
               "time": time - time[0] if params.estimate_drift else None}
    force_variance, rate_variance = params.accel_noise_density ** 2 / interval, density ** 2 / interval
    forces = [(fit_harmonic(angle, accel_b[:, axis], force_variance, **options), 0.5 * math.pi * axis)
              for axis in (0, 1)]
    station = TableAlignment(params)
    level = level_jointly(forces, float(np.mean(accel_b[:, 2])), params, station.gravity)
    if math.isnan(params.latitude) or np.isnan(level.roll):
        return AlignmentResult(level, None, math.nan, math.inf)
    fit_x, fit_y = (fit_harmonic(angle, gyro_b[:, axis], rate_variance, **options) for axis in (0, 1))
    north = find_north(fit_x, fit_y if params.use_y_gyro else None, [level.roll, level.pitch],
                       level.covariance, params.latitude, params)
    flicker_share = 1 - (params.gyro_noise_density / density) ** 2
    floor = float(north.std) * math.sqrt(flicker_share)
    missing = max((float(north.std) / params.target_std) ** 2 - 1, 0.0)
    return AlignmentResult(level, north, floor, missing * float(time[-1] - time[0]))
