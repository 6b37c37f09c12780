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
# A square known no better than this is told as an upper limit.
_LARGEST_SHARE = 1 / _TWO_SIDED
# Fits that chance explains more rarely than this do not hold.
_FIT_PROBABILITY = 1e-3
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
    consistent : bool
        Whether chance explains what the fit leaves.
    """

    quantisation: Estimate
    noise_density: Estimate
    bias_instability: Estimate
    walk_density: Estimate
    shortest_time: float
    consistent: bool

    def variance(self, time):
        """Return the Allan variance of the fitted noises at times (...), u^2."""
        squares = [getattr(self, name).value ** 2 for name in NOISES]
        return np.moveaxis(_terms(np.asarray(time, float)), 0, -1) @ squares


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
            variance[row, channel] = np.dot(change, change) / (2.0 * m * m * len(change))
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
        Starting at the shortest time from which on the four noises explain the curve.

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
    fits = (_fit_from(curve, variance, start) for start in range(len(variance) - len(NOISES)))
    first = next(fits)
    return first if first.consistent else next((fit for fit in fits if fit.consistent), first)


def _fit_from(curve, variance, start):
    """Return the fit to all but the first `start` points."""
    factor, time, variance = curve.factor[start:], curve.time[start:], variance[start:]
    design = _terms(time).T
    scale = design.max(axis=0) / variance.max()  # squares of very different sizes become alike
    design = design / scale
    # To begin with: independent estimates with as many terms as lie end to end.
    covariance = np.diag(variance ** 2 * factor / curve.count)
    for _ in range(_ROUNDS):
        whitener = np.linalg.inv(np.linalg.cholesky(covariance))
        squares = _least_squares(whitener @ design, whitener @ variance)
        covariance = _covariance(curve, factor, squares / scale)
    whitener = np.linalg.inv(np.linalg.cholesky(covariance))
    free, *_ = np.linalg.lstsq(whitener @ design, whitener @ variance, rcond=None)
    squares = _least_squares(whitener @ design, whitener @ variance)
    spread = np.sqrt(np.diag(np.linalg.inv(design.T @ whitener.T @ whitener @ design)))
    misfit = np.sum((whitener @ (variance - design @ squares)) ** 2)
    estimates = [_estimate(*row) for row in zip(squares / scale, free / scale, spread / scale, strict=True)]
    return NoiseFit(*estimates, float(time[0]), misfit < _largest_misfit(len(variance) - len(NOISES)))


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
    return 4.0 / curve.interval * (shaped * width) @ shaped.T / np.maximum.outer(terms, terms)


def _estimate(square, free, spread):
    """Return the root of a square with its limits.

    A square is a sum of squares: its logarithm is nearer to a normal distribution than itself.
    """
    if free <= 0.0 or spread > _LARGEST_SHARE * square:
        return Estimate(math.sqrt(square), 0.0, math.sqrt(max(free, 0.0) + _ONE_SIDED * spread))
    factor = math.exp(0.5 * _TWO_SIDED * spread / square)
    return Estimate(math.sqrt(square), math.sqrt(square) / factor, math.sqrt(square) * factor)


def _largest_misfit(freedom):
    """Return the chi-square that chance exceeds with _FIT_PROBABILITY (Wilson and Hilferty)."""
    sigmas = 3.090  # of the normal distribution
    share = 2.0 / (9.0 * freedom)
    return freedom * (1.0 - share + sigmas * math.sqrt(share)) ** 3
