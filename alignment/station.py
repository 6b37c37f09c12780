"""A turntable alignment as it happens: dwells come in one by one, the result may be asked for at any time.

This is what a node and a command line call. It holds the dwells, says which angle is wanted next, and gives
level from the first dwell on and heading as soon as three angles have been seen.
"""

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np

from alignment import bounds, sequences
from alignment.azimuth import METHODS
from alignment.comparison import compare_headings, compare_levels, dwell_readings
from alignment.errors import NotEnoughDataError
from alignment.harmonic import OUTLIER_THRESHOLD, deletion_residuals, fit_harmonic
from alignment.levelling import level_jointly
from alignment.north import find_north
from alignment.params import NorthPriors
from alignment.results import LARGEST_SCALE_ERROR, UNBELIEVABLE, HeadingResult, LevelResult, Quality
from alignment.turntable import earth_direction_t
from inertial.earth import EARTH_RATE
from inertial.rotation import roll_pitch_from_down

_SMALLEST_COS_PITCH = 1e-3  # keeps the roll's variance finite when the table stands on end
_LONGEST_FORECAST = 24 * 3600.0
_NO_PRIORS = NorthPriors(0.0, 0.0, 0.0, 0.0)
_HALF_TURN = (0.0, math.pi)
_FEWEST_TO_JUDGE = 6  # dwells that agree, from which one that does not is rejected
_MOVED = 3  # dwells one after another that disagree with all before
_LARGEST_OUTLYING = 0.2  # share of the dwells that may disagree; where more do it is not they that are wrong


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
    gyro_bias : (3,) float64, rad/s
        Of x and y, as the turn tells them; of z what its mean reading leaves beside the Earth's rate. NaN where
        not known.
    """

    level: LevelResult
    north: HeadingResult | None
    floor: float
    time_left: float
    reason: str = ""
    gyro_bias: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))

    @property
    def believable(self):
        """Whether the heading may be published."""
        return self.north is not None and not self.north.flags & UNBELIEVABLE


def solve_table(gyro_x, gyro_y, accel_x, accel_y, accel_z, params):
    """Return level and heading, the latter None without a level or a latitude.

    Parameters
    ----------
    gyro_x, gyro_y, accel_x, accel_y : alignment.harmonic.HarmonicFit
        rad/s and m/s^2.
    accel_z : float, m/s^2
        Mean reading along the table's axis.
    params : alignment.params.AlignmentParams

    Returns
    -------
    level : alignment.results.LevelResult
    north : alignment.results.HeadingResult or None
    """
    level = level_jointly(accel_x, accel_y, accel_z, params)
    if math.isnan(params.latitude) or np.isnan(level.roll):
        return level, None
    return level, find_north(gyro_x, gyro_y if params.use_y_gyro else None, [level.roll, level.pitch],
                             level.covariance, params.latitude, params)


def noise_std(fits, level, params):
    """Return the part of the heading's deviation that is the gyros' noise, rad: what falls with time."""
    gyro_x, gyro_y = fits[:2]
    north = find_north(gyro_x, gyro_y if params.use_y_gyro else None, [level.roll, level.pitch], np.zeros((2, 2)),
                       params.latitude, _NO_PRIORS)
    return float(north.std)


def time_left(std, noise, used_time, target):
    """Return how long until the asked accuracy if the sequence goes on, s; infinite where it cannot be.

    White noise and, with returns to each angle, 1/f noise fall with the root of the time; the priors stay.

    Parameters
    ----------
    std, noise : float, rad
        Deviation of the heading and the part of it that is noise.
    used_time : float, s
    target : float, rad
    """
    if std <= target:
        return 0.0
    fixed = max(std ** 2 - noise ** 2, 0.0)
    if fixed >= target ** 2:
        return math.inf
    left = used_time * (noise ** 2 / (target ** 2 - fixed) - 1)
    return left if left < _LONGEST_FORECAST else math.inf


class TableAlignment:
    """Level and heading of a turntable from dwells.

    Parameters
    ----------
    params : alignment.params.AlignmentParams
    """

    def __init__(self, params):
        self.params = params
        self.reset()

    @property
    def dwells(self):
        """The accepted dwells, in order."""
        return tuple(self._dwells)

    def add(self, dwell):
        """Take in a dwell; return the reason when it is rejected, otherwise an empty string."""
        reason = dwell.rejection
        if not reason and self._dwells and dwell.start < self._dwells[-1].end - 1e-9:
            reason = "it overlaps the dwell before"
        if reason:
            self.rejected.append(dataclasses.replace(dwell, rejection=reason))
            return reason
        self._dwells.append(dwell)
        self._reject_outlying()
        if self._dwells[-1] is dwell:
            self._disagreeing = 0
            return ""
        self._disagreeing += 1
        return next(bad.rejection for bad in self.rejected if bad.start == dwell.start)

    @property
    def noise_ratio(self):
        """White noise that the gyros' samples show over what was stated; NaN before the first dwell."""
        shown = [dwell.gyro_noise_density for dwell in self._dwells]
        return float(np.median(shown)) / self.params.gyro_noise_density if shown else math.nan

    @property
    def moved(self):
        """What tells that the table has moved, or an empty string."""
        if self._disagreeing < _MOVED:
            return ""
        return (f"the last {self._disagreeing} dwells disagree with all before: the table or the IMU on it has moved; "
                "begin anew (~/reset)")

    def _reject_outlying(self):
        """Reject dwells that disagree with all the others, if few do."""
        kept, out = list(self._dwells), []
        while len(kept) >= _FEWEST_TO_JUDGE:
            try:
                worst, reason = self._outlier(kept)
            except NotEnoughDataError:
                return
            if not reason:
                break
            out.append(dataclasses.replace(kept[worst], rejection=reason))
            del kept[worst]
        if out and not (len(kept) >= _FEWEST_TO_JUDGE and len(out) <= _LARGEST_OUTLYING * len(self._dwells)):
            return
        self._dwells = kept
        self.rejected += out

    def _outlier(self, dwells):
        """Return the dwell that is farthest from all the others, and how far if that is too far."""
        schedule = _schedule_of(dwells)
        time = schedule.middle if self.params.estimate_drift else None
        gyro_b, accel_b = (np.array([getattr(dwell, triad)[:2] for dwell in dwells])
                           for triad in ("gyro_b", "accel_b"))
        force_covariance = np.diag(self.params.accel_noise_density ** 2 / schedule.duration)
        apart = np.abs(np.concatenate([
            deletion_residuals(schedule.angle, gyro_b, self._rate_covariance(schedule), time),
            deletion_residuals(schedule.angle, accel_b, force_covariance)], axis=1))
        worst, channel = np.unravel_index(np.argmax(apart), apart.shape)
        if apart[worst, channel] <= OUTLIER_THRESHOLD:
            return worst, ""
        name = ("x gyro", "y gyro", "x accelerometer", "y accelerometer")[channel]
        return worst, f"its {name} is {apart[worst, channel]:.3g} deviations off the other dwells"

    def reset(self):
        """Forget every dwell."""
        self._dwells, self.rejected, self._disagreeing = [], [], 0

    def next_angle(self):
        """Return the table angle wanted next, rad, following the sequence of the parameters."""
        count = len(self._dwells)
        if self.params.sequence != "refined" or self._used_time() < self.params.coarse_time:
            once = self.params.sequence == "single_pass"
            order = sequences.FOUR_POSITIONS if once else sequences.PALINDROME
            return order[count % len(order)]
        result = self.result()
        north = result.north
        ambiguous = north is not None and north.flags & UNBELIEVABLE == Quality.AMBIGUOUS \
            and np.isfinite(north.branches).all()
        if not (result.believable or ambiguous):
            return sequences.PALINDROME[count % len(sequences.PALINDROME)]
        attitude = float(result.level.roll), float(result.level.pitch)
        if ambiguous:
            best = bounds.telling_angle(*attitude, *map(float, north.branches))
        else:
            best = bounds.best_angle(*attitude, float(north.heading), self.params.latitude)
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
        accel_z = np.average(self._column("accel_b", 2), weights=schedule.duration)
        try:
            fits = self._fits(schedule)
        except NotEnoughDataError as error:
            return AlignmentResult(self._level_of_few(), None, math.nan, math.inf, str(error))
        level, north = solve_table(*fits, accel_z, self.params)
        if north is None or np.isnan(north.heading):
            return AlignmentResult(level, north, math.nan, math.inf)
        attitude = float(level.roll), float(level.pitch), float(north.heading), self.params.latitude
        white, total = (
            bounds.predicted_heading_std(schedule, self.params.gyro_noise_density, instability, *attitude)
            for instability in (0.0, self.params.gyro_bias_instability))
        noise = noise_std(fits, level, self.params)
        floor = noise * math.sqrt(max(1.0 - (white / total) ** 2, 0.0))
        left = time_left(float(north.std), noise, self._used_time(), self.params.target_std)
        down = EARTH_RATE * earth_direction_t(*attitude)[2]
        bias_z = np.average(self._column("gyro_b", 2), weights=schedule.duration) - down
        return AlignmentResult(level, north, floor, left, gyro_bias=np.array([fits[0].bias, fits[1].bias, bias_z]))

    def compare_headings(self, level=None, names=tuple(METHODS), hint=None):
        """Return the heading by the joint estimator and by every closed form that the dwells serve: name to result.

        Parameters
        ----------
        level : alignment.results.LevelResult, optional
            The joint one when absent.
        names : iterable of str
            Closed forms wanted.
        hint : float, optional
            Heading by a compass, rad, to choose among branches; the joint estimator's when absent.
        """
        found = self.result()
        if found.north is None:
            return {}
        level = found.level if level is None else level
        schedule = self._schedule()
        covariance = self._rate_covariance(schedule)
        rate = self._column("gyro_b", 0)
        best = bounds.best_angle(float(level.roll), float(level.pitch), float(found.north.heading),
                                 self.params.latitude)
        readings = dwell_readings(schedule, rate, covariance, fit_harmonic(schedule.angle, rate, covariance),
                                  self.params.position_tolerance, best, tipped=self._column("gyro_b", 2))
        hint = float(found.north.heading) if hint is None else hint
        return {"joint": found.north} | compare_headings(readings, level, self.params, names, hint)

    def compare_levels(self):
        """Return the level by every levelling method that the dwells serve: name to result."""
        results, schedule = {"joint": self.result().level}, self._schedule()
        covariance = np.diag(self.params.accel_noise_density ** 2 / schedule.duration)
        forces = [self._column("accel_b", axis) for axis in range(3)]
        try:
            accel_x, accel_y = (dwell_readings(
                schedule, force, covariance, fit_harmonic(schedule.angle, force, covariance),
                self.params.position_tolerance, tipped=forces[2]) for force in forces[:2])
        except NotEnoughDataError:  # fewer than three angles
            return results
        return results | compare_levels(accel_x, accel_y, self.params)

    def _schedule(self):
        return _schedule_of(self._dwells)

    def _used_time(self):
        return sum(dwell.duration for dwell in self._dwells)

    def _fits(self, schedule):
        """Return the harmonic fits of the x and y gyros and of the x and y accelerometers."""
        params = self.params
        rate_variance = self._rate_covariance(schedule)
        force_variance = params.accel_noise_density ** 2 / schedule.duration
        time = schedule.middle if params.estimate_drift else None
        rates = [fit_harmonic(schedule.angle, self._column("gyro_b", axis), rate_variance, time=time)
                 for axis in (0, 1)]
        forces = [fit_harmonic(schedule.angle, self._column("accel_b", axis), force_variance) for axis in (0, 1)]
        return [fit.widened() for fit in rates + forces]

    def _rate_covariance(self, schedule):
        return bounds.noise_covariance(
            schedule, self.params.gyro_noise_density, self.params.gyro_bias_instability)

    def _column(self, triad, axis):
        return np.array([getattr(dwell, triad)[axis] for dwell in self._dwells])

    def _level_of_few(self):
        """Return the level before the table has turned: the accelerometers as they are, bias and all."""
        tau = self._dwells[-1].angle
        x, y, z = self._dwells[-1].accel_b
        force_t = np.array([math.cos(tau) * x - math.sin(tau) * y, math.sin(tau) * x + math.cos(tau) * y, z])
        roll, pitch = roll_pitch_from_down(-force_t)
        variance = (self.params.accel_bias_std / self.params.local_gravity) ** 2
        covariance = variance * np.diag([1 / max(np.cos(pitch), _SMALLEST_COS_PITCH) ** 2, 1.0])
        scale = np.linalg.norm(force_t) / self.params.local_gravity
        quality = np.asarray(Quality.SCALE.value if abs(scale - 1) > LARGEST_SCALE_ERROR else 0)
        return LevelResult(roll, pitch, covariance, np.asarray(np.nan), np.asarray(scale), quality)


def _schedule_of(dwells):
    angle, start, end = (np.array([getattr(dwell, name) for dwell in dwells]) for name in ("angle", "start", "end"))
    return sequences.Schedule(angle, start - start[0], end - start[0], np.zeros(len(dwells)))
