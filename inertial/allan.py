"""Allan deviation of a sensor at rest, and the noise densities that explain it.

The curve is fitted by the sum of four noises (IEEE Std 952-1997, annex C; here c = B^2 2 ln 2 / pi, the
floor's square)::

    variance(tau) = 3 Q^2/tau^2 + N^2/tau + c + K^2 tau/3

which is linear in the squares. Estimates at different times are of the same data and so correlated, and each
has the fewer independent terms the longer its time is. The fit weighs them with the covariance that the
fitted noises themselves would give: with the spectrum ``S`` of the noise and ``H_i`` of the Allan filter,
``cov_ij = 2 / n integral |H_i|^2 |H_j|^2 S^2 df`` for Gaussian noise, so the fit is repeated until it agrees
with its weights. Its own covariance then gives the confidence limits.

Units: samples in u (rad/s or m/s^2), times in s.
"""

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np

# Enough independent differences at the longest time: nine lie end to end in the record.
_LONGEST_SHARE = 10
_FEWEST_SAMPLES = 200
_ROUNDS = 8
_POINTS_PER_OCTAVE = 48  # of the covariance's integral, which needs to be good to some per cent
_TWO_SIDED, _ONE_SIDED = 1.960, 1.645  # sigmas of 95 %
_LIMIT_ROUNDS = 4
_RIDGE = 1e-6
_FIT_SIGMAS = 3.090  # one-sided, one in a thousand: a fit that chance explains more rarely does not hold

# A rest for less than this shows the white noise and hardly more.
_SHORTEST_REST = 60.0  # s
_LARGEST_LOSS = 0.05  # of the samples, which are then interpolated: that takes half of it off the noise
_STAMPS_COMPARED = 10_000
# What the mean of a second may differ by from that of all: beyond it the IMU has been moved.
_STILL_RATE, _STILL_FORCE = 0.02, 0.2  # rad/s, m/s^2
_MOVED_SECONDS = 3  # fewer are knocks, which the fit survives
NOISES = ("quantisation", "noise_density", "bias_instability", "walk_density")
"""The noises fitted, and their names: Q in u s, N in u/sqrt(Hz), the floor in u, K in u/sqrt(s)."""


@dataclass(frozen=True)
class AllanCurve:
    """Allan variance of one or more channels.

    Attributes
    ----------
    interval : float, s
        Between samples.
    count : int
        Samples.
    factor : (J,) int
        Samples averaged.
    variance : (J, A), u^2
    """

    interval: float
    count: int
    factor: np.ndarray
    variance: np.ndarray

    @property
    def time(self):
        """Averaging times, (J,), s."""
        return self.factor * self.interval

    @property
    def deviation(self):
        """Allan deviation, (J, A), u."""
        return np.sqrt(self.variance)

    @property
    def deviation_std(self):
        """What the deviation is uncertain by, (J, A), u (IEEE Std 952-1997, C.1)."""
        return self.deviation / np.sqrt(2.0 * (self.count / self.factor - 1.0))[:, None]


@dataclass(frozen=True)
class Estimate:
    """A figure with its 95 % limits; a lower limit of 0 says that it was not found."""

    value: float
    low: float
    high: float

    @property
    def found(self):
        """Whether the data show that there is such a noise."""
        return self.low > 0.0


@dataclass(frozen=True)
class NoiseFit:
    """The noises that explain an Allan curve.

    Attributes
    ----------
    quantisation : Estimate, u s
        Q of IEEE Std 952: a count of the integral over sqrt 12.
    noise_density : Estimate, u/sqrt(Hz)
        N: white noise, angle or velocity random walk.
    bias_instability : Estimate, u
        Floor of the Allan deviation that 1/f noise gives, 0.664 B.
    walk_density : Estimate, u/sqrt(s)
        K: rate random walk.
    shortest_time : float, s
        The curve is explained from here; below it filters of the sensor or vibration shape it.
    misfit : float
        Chi-square per degree of freedom of what the fit leaves.
    consistent : bool
        Whether chance explains the misfit.
    """

    quantisation: Estimate
    noise_density: Estimate
    bias_instability: Estimate
    walk_density: Estimate
    shortest_time: float
    misfit: float
    consistent: bool

    def variance(self, time):
        """Return the Allan variance of the fitted noises at times (...), u^2."""
        squares = [getattr(self, name).value ** 2 for name in NOISES]
        return np.moveaxis(_terms(np.asarray(time, float)), 0, -1) @ squares


@dataclass(frozen=True)
class TriadNoise:
    """What a rest shows of three gyros or three accelerometers.

    Attributes
    ----------
    mean : (3,), u
        Of the readings.
    curve : AllanCurve
    fits : tuple of NoiseFit
        One an axis.
    """

    mean: np.ndarray
    curve: AllanCurve
    fits: tuple

    def combined(self, name):
        """Return one figure of NOISES for the axes: root mean square, of the upper limit where none is found.

        Raises
        ------
        ValueError
            No axis' curve is explained, so no figure means anything.
        """
        return _root_mean_square([figure.value if figure.found else figure.high for figure in self._figures(name)])

    def shown(self, name):
        """Return the same with 0 where none is found."""
        return _root_mean_square([figure.value if figure.found else 0.0 for figure in self._figures(name)])

    def _figures(self, name):
        figures = [getattr(fit, name) for fit in self.fits if fit.consistent]
        if not figures:
            raise ValueError("no axis' Allan curve is explained by the noises of a sensor at rest: it was moved, "
                             "shaken or warmed, and there are no parameters to write")
        return figures


def _root_mean_square(values):
    return math.sqrt(np.mean(np.square(values)))


@dataclass(frozen=True)
class ImuNoise:
    """What a rest shows of an IMU; ``missing`` is the share of samples that were filled in."""

    gyro: TriadNoise
    accel: TriadNoise
    duration: float
    missing: float


def measure_noise(imu):
    """Return the noises of an IMU that has been at rest.

    Parameters
    ----------
    imu : inertial.recording.ImuSeries

    Returns
    -------
    ImuNoise

    Raises
    ------
    ValueError
        The record is short, has gaps or stamps out of order, or the IMU was moved.
    """
    usable = np.isfinite(imu.gyro_b).all(axis=1) & np.isfinite(imu.accel_b).all(axis=1)
    stamp_ns = imu.stamp_ns[usable]
    duration = (stamp_ns[-1] - stamp_ns[0]) * 1e-9 if len(stamp_ns) else 0.0
    if duration < _SHORTEST_REST:
        raise ValueError(f"{duration:.1f} s of IMU samples are too short: {_SHORTEST_REST:g} s show the white "
                         "noise, an hour the bias instability")
    interval, place = _places(stamp_ns)
    grid = np.arange(place[-1] + 1)
    missing = 1.0 - len(np.unique(place)) / len(grid)
    if missing > _LARGEST_LOSS:
        raise ValueError(f"{100 * missing:.1f} % of the samples are missing: at most {100 * _LARGEST_LOSS:g} % may")
    triads = [np.stack([np.interp(grid, place, axis) for axis in readings[usable].T], axis=-1)
              for readings in (imu.gyro_b, imu.accel_b)]
    _check_still(interval, *triads)
    return ImuNoise(*(_triad_noise(readings, interval) for readings in triads), duration, missing)


def _places(stamp_ns):
    """Return the sampling interval, and where on its grid each sample belongs."""
    step_ns = np.diff(stamp_ns)
    if step_ns.min() <= 0:
        back = int(np.argmax(step_ns <= 0))
        raise ValueError(f"stamps do not increase, first {(stamp_ns[back] - stamp_ns[0]) * 1e-9:.1f} s after the "
                         "start")
    # Steps count the samples but for some that late stamps make round the wrong way: among the counts near it,
    # the one on whose grid the stamps agree best.
    steps = np.rint(step_ns / np.median(step_ns))
    reach = 10.0 + 4.0 * math.sqrt(np.sum(steps != 1.0))
    counts = steps.sum() + np.arange(-reach, reach, 0.25)
    elapsed = (stamp_ns - stamp_ns[0]) / (stamp_ns[-1] - stamp_ns[0])
    some = elapsed[::max(1, len(elapsed) // _STAMPS_COMPARED)]
    agreement = [abs(np.exp(2j * math.pi * count * some).sum()) for count in counts]
    phase = counts[np.argmax(agreement)] * elapsed
    place = np.rint(phase - np.median(phase - np.rint(phase))).astype(np.int64)
    interval = (stamp_ns[-1] - stamp_ns[0]) * 1e-9 / counts[np.argmax(agreement)]
    return interval, place - place[0]


def _check_still(interval, gyro_b, accel_b):
    second = max(1, round(1.0 / interval))
    means = [readings[:len(readings) // second * second].reshape(-1, second, 3).mean(axis=1)
             for readings in (gyro_b, accel_b)]
    moved = [np.abs(mean - np.median(mean, axis=0)).max(axis=1) > limit
             for mean, limit in zip(means, (_STILL_RATE, _STILL_FORCE), strict=True)]
    seconds = np.flatnonzero(moved[0] | moved[1])
    if len(seconds) > _MOVED_SECONDS:
        raise ValueError(f"the IMU is moving in {len(seconds)} of {len(moved[0])} s, between {seconds[0]} and "
                         f"{seconds[-1] + 1} s after the start: it must stand still")


def _triad_noise(readings, interval):
    curve = allan_curve(readings, interval)
    return TriadNoise(readings.mean(axis=0), curve, tuple(fit_noise(curve, axis) for axis in range(3)))


def allan_curve(samples, interval, factors=None):
    """Return the overlapping Allan variance (NIST SP 1065, eq. 11).

    Parameters
    ----------
    samples : (N,) or (N, A) float64, u
        Means over intervals that follow each other without a gap.
    interval : float, s
    factors : (J,) int, optional
        Samples averaged; by default powers of two up to a tenth of the record.

    Returns
    -------
    AllanCurve

    Raises
    ------
    ValueError
        Too few samples, or a factor for which they do not suffice.
    """
    samples = np.asarray(samples, float).reshape(len(samples), -1)
    count = len(samples)
    if factors is None:
        if count < _FEWEST_SAMPLES:
            raise ValueError(f"{count} samples: an Allan curve needs {_FEWEST_SAMPLES} or more")
        factors = 2 ** np.arange(int(math.log2(count / _LONGEST_SHARE)) + 1)
    factors = np.asarray(factors, np.int64)
    if factors.min() < 1 or 2 * factors.max() > count:
        raise ValueError(f"factors from {factors.min()} to {factors.max()}: must be from 1 to {count // 2}")
    variance = np.empty((len(factors), samples.shape[1]))
    for channel in range(samples.shape[1]):
        # Without the mean the sums keep their digits over a day.
        centred = samples[:, channel] - samples[:, channel].mean()
        phase = np.concatenate([[0.0], np.cumsum(centred)])
        for row, m in enumerate(factors.tolist()):
            sums = phase[m:] - phase[:-m]
            change = sums[m:] - sums[:-m]
            variance[row, channel] = 0.5 * np.mean(change ** 2) / m ** 2
    return AllanCurve(interval, count, factors, variance)


def fit_noise(curve, channel=0):
    """Return the noises that explain one channel of an Allan curve.

    Parameters
    ----------
    curve : AllanCurve
    channel : int

    Returns
    -------
    NoiseFit
        From the shortest time on from which the four noises explain the curve. Where they explain it from
        none, the best fit, with its limits widened by the root of its misfit.

    Raises
    ------
    ValueError
        The channel never changes, or the curve is too short to fit.
    """
    variance = curve.variance[:, channel]
    if not np.all(variance > 0.0):
        raise ValueError("the samples do not change: there is no noise to measure")
    if len(variance) <= len(NOISES):
        raise ValueError(f"{len(variance)} averaging times: a fit needs {len(NOISES) + 1} or more")
    fits = []
    for start in range(len(variance) - len(NOISES)):
        fits.append(_fit_from(curve, variance, start))
        if fits[-1].consistent:
            return fits[-1]
    return min(fits, key=lambda fit: fit.misfit)


def _fit_from(curve, variance, start):
    """Return the fit to all but the first `start` points."""
    factor, time, variance = curve.factor[start:], curve.time[start:], variance[start:]
    design = _terms(time).T
    scale = variance.max() / design.max(axis=0)  # squares of very different sizes become alike
    design = design * scale
    # To begin with: independent estimates with as many terms as lie end to end.
    covariance = np.diag(variance ** 2 * factor / curve.count)
    for _ in range(_ROUNDS):
        whitener = np.linalg.inv(np.linalg.cholesky(covariance))
        squares = _least_squares(whitener @ design, whitener @ variance)
        covariance = _covariance(curve, factor, squares * scale)
    freedom = len(variance) - len(NOISES)
    misfit = np.sum((whitener @ (variance - design @ squares)) ** 2) / freedom
    consistent = bool(misfit < _largest_misfit(freedom))
    widening = 1.0 if consistent else math.sqrt(misfit)
    gain = np.linalg.pinv(whitener @ design) @ whitener
    free = gain @ variance  # without regard to the signs

    def spread(k, square):
        """Standard deviation of the free square k, were this the true one."""
        truth = np.where(np.arange(len(NOISES)) == k, square, squares)
        return widening * math.sqrt(gain[k] @ _covariance(curve, factor, truth * scale) @ gain[k])

    estimates = []
    for k, square in enumerate(squares):
        low, high = _limits(free[k], lambda value, k=k: spread(k, value))
        # The free squares are a little off those without a negative one among them.
        limits = [square, min(low, square), max(high, square)]
        estimates.append(Estimate(*np.sqrt(scale[k] * np.array(limits)).tolist()))
    return NoiseFit(*estimates, float(time[0]), float(misfit), consistent)


def _limits(free, spread):
    """Return the true squares between which 95 % lie: found from them, `free` is just as far off as that.

    The spread grows with the true square, so the limits are not equally far. The upper one is looked for in a few
    rounds only: where the spread is as large as the square itself, there is none.
    """
    found = free > _TWO_SIDED * spread(0.0)
    sigmas = _TWO_SIDED if found else _ONE_SIDED
    high = max(free, 0.0)
    low, above = (max(free - sigmas * spread(free), 0.0), free) if found else (0.0, 0.0)
    for _ in range(_LIMIT_ROUNDS):
        high = max(free, 0.0) + sigmas * spread(high)
        middle = 0.5 * (low + above)
        if middle + sigmas * spread(middle) < free:
            low = middle
        else:
            above = middle
    return low, high


def _terms(time):
    """Return the Allan variances of unit noises, (4, ...), in the order of NOISES."""
    return np.stack([3.0 / time ** 2, 1.0 / time, np.ones_like(time), time / 3.0])


def _least_squares(design, target):
    """Return the least-squares solution without negative elements, by trying which are zero."""
    best, solution = math.inf, None
    for size in range(design.shape[1] + 1):
        for columns in combinations(range(design.shape[1]), size):
            trial = np.zeros(design.shape[1])
            trial[list(columns)] = np.linalg.lstsq(design[:, columns], target, rcond=None)[0]
            misfit = np.sum((target - design @ trial) ** 2)
            if misfit < best and np.all(trial >= 0.0):
                best, solution = misfit, trial
    return solution


def _covariance(curve, factor, squares):
    """Return the covariance of overlapping Allan variances of noise with the four squares."""
    nyquist = 0.5 / curve.interval
    octaves = math.ceil(math.log2(curve.count))
    frequency = nyquist * 2.0 ** (-(np.arange(octaves * _POINTS_PER_OCTAVE) + 0.5) / _POINTS_PER_OCTAVE)
    width = frequency * math.log(2.0) / _POINTS_PER_OCTAVE
    half = np.sin(math.pi * frequency * curve.interval)
    filters = 2.0 * np.sin(math.pi * np.outer(factor, frequency) * curve.interval) ** 4 \
        / (factor[:, None] * half) ** 2
    difference = 2.0 * half / curve.interval  # discrete 2 pi f
    spectrum = squares @ np.stack([curve.interval * difference ** 2, np.ones_like(half),
                                   0.25 / (math.log(2.0) * frequency), 1.0 / difference ** 2])
    shaped = filters * spectrum
    terms = curve.count - 2 * factor + 1
    # Both sides of the spectrum, and the sum over all lags by Parseval's theorem.
    covariance = 4.0 / curve.interval * (shaped * width) @ shaped.T / np.maximum.outer(terms, terms)
    # Where one noise rules at several times their estimates are nearly the same: keep it invertible.
    return covariance + np.diag(_RIDGE * np.diag(covariance))


def _largest_misfit(freedom):
    """Return the chi-square per degree of freedom that chance exceeds once in a thousand (Wilson and Hilferty)."""
    share = 2.0 / (9.0 * freedom)
    return (1.0 - share + _FIT_SIGMAS * math.sqrt(share)) ** 3
