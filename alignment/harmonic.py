"""What a sensor on a turntable reads, as bias, cosine and sine of the table angle: the fit under everything.

``reading = bias + cosine cos(tau) + sine sin(tau) [+ drift time] [+ spin rate]``. The bias is always
fitted, so that no constant error of a sensor reaches the attitude. Weighted, and robust when asked: Huber's
weights until they settle, then readings beyond five deviations are left out and the rest count in full, which
keeps the efficiency of clean data (P. Huber, Robust Statistics, 1981, 7.8).
"""

from dataclasses import dataclass, replace

import numpy as np

from alignment.errors import NotEnoughDataError

HUBER_THRESHOLD = 1.345  # 95 % efficient for normal noise
OUTLIER_THRESHOLD = 5.0  # one clean reading in two million lies beyond
LARGEST_CONDITION = 1e4  # two angles a minute of arc apart already exceed it
Y_TO_PLANE = np.array([[0.0, -1.0], [1.0, 0.0]])
"""From cosine and sine of a y axis, which reads Y cos(tau) - X sin(tau), to the (X, Y) of the table."""
_HUBER_STEPS = 30
_SETTLED = 1e-3  # of the coefficients' deviation
# Huber's weights need no more readings than these to tell outliers from the rest.
_ENOUGH_TO_START = 20_000
_NORMAL_MAD = 1.482602218505602  # standard deviation per median absolute deviation
_UNCHECKED = 1e-6  # of a reading's weight: rounding
_UNLIKELY = 3.0  # deviations of chi2 from which it is the stated noise that is too small


@dataclass(frozen=True)
class HarmonicFit:
    """Coefficients of the table angle in one channel's readings.

    Attributes
    ----------
    coefficients : (..., M) float64
        Bias, cosine, sine, then drift per second and response to the table's rate where fitted.
    covariance : (M, M) float64
    chi2 : (...) float64
        Sum of the squared normalised residuals.
    freedom : int
        Readings kept less coefficients.
    condition : float
        Condition number of the columns.
    kept : (..., K) bool or None
        Which readings count; all of them unless the fit is robust. None where only their sums are known.
    """

    coefficients: np.ndarray
    covariance: np.ndarray
    chi2: np.ndarray
    freedom: int
    condition: float
    kept: np.ndarray | None = None

    @property
    def bias(self):
        """Constant part."""
        return self.coefficients[..., 0]

    @property
    def scatter(self):
        """How many times the stated noise the readings scatter, 0 where that cannot be told."""
        return np.sqrt(self.chi2 / self.freedom) if self.freedom else np.zeros_like(self.chi2)

    @property
    def excess(self):
        """By how many deviations chi2 is larger than its freedom explains (Wilson and Hilferty, 1931)."""
        if self.freedom < 1:
            return np.zeros_like(self.chi2)
        spread = 2 / (9 * self.freedom)
        return (np.cbrt(self.chi2 / self.freedom) - (1 - spread)) / np.sqrt(spread)

    def widened(self):
        """Return the fit of one channel with the covariance that its scatter shows where that is the larger."""
        if not self.excess > _UNLIKELY:
            return self
        return replace(self, covariance=self.covariance * self.scatter ** 2)

    @property
    def in_plane(self):
        """Cosine and sine coefficients, (..., 2)."""
        return self.coefficients[..., 1:3]

    @property
    def in_plane_covariance(self):
        """Covariance of the cosine and sine coefficients, (2, 2)."""
        return self.covariance[1:3, 1:3]


def harmonic_design(angle, time=None, rate=None):
    """Return the columns 1, cos, sin [, time] [, rate] of the fit, (K, M).

    Raises
    ------
    NotEnoughDataError
        The columns do not tell the coefficients apart; the message names rank and condition number.
    """
    angle = np.asarray(angle, dtype=float)
    more = [column for column in (time, rate) if column is not None]
    columns = np.empty((3 + len(more), len(angle)))
    columns[0] = 1.0
    np.cos(angle, out=columns[1])
    np.sin(angle, out=columns[2])
    for row, column in zip(columns[3:], more, strict=True):
        row[:] = column
    _condition(columns @ columns.T, len(angle))
    return columns.T


def fit_harmonic(angle, value, variance=None, *, time=None, rate=None, robust=False):
    """Fit bias, cosine and sine to readings at table angles.

    Parameters
    ----------
    angle : (K,) float64, rad
    value : (..., K) float64
        Readings; leading dimensions are independent trials. A robust fit takes one.
    variance : float, (K,) or (K, K) float64, optional
        Of the readings. Without it all count alike and their scatter sets the covariance.
    time : (K,) float64, s, optional
        Fits a drift too.
    rate : (K,) float64, rad/s, optional
        Fits the response to the table's own rate too: misalignment with its axis.
    robust : bool
        Whether outliers are found and left out.

    Returns
    -------
    HarmonicFit

    Raises
    ------
    ValueError
        An array's shape is wrong, or a variance is not positive.
    NotEnoughDataError
        Too few angles, or too much alike.
    """
    design = harmonic_design(angle, time, rate)
    value = np.asarray(value, dtype=float)
    if value.shape[-1:] != design.shape[:1]:
        raise ValueError(f"value has shape {value.shape}, the angles are {len(design)}")
    if robust:
        return _fit_robust(design, value, variance)
    return _fit_weighted(design, value, variance)


def deletion_residuals(angle, values, covariance, time=None):
    """Return how far each reading is from the fit of all the others, in deviations of the difference.

    Where the others scatter more than stated, in theirs (the externally studentised residual).

    Parameters
    ----------
    angle : (K,) float64, rad
    values : (K, C) float64
        Readings of C channels.
    covariance : (K, K) float64
        Of each channel's.
    time : (K,) float64, s, optional
        As in :func:`fit_harmonic`.

    Returns
    -------
    (K, C) float64
        Zero for a reading that no other one checks.

    Raises
    ------
    NotEnoughDataError
        Too few angles, or too much alike.
    """
    design = harmonic_design(angle, time)
    weight = np.linalg.inv(covariance)
    weighted = weight @ design
    projection = weight - weighted @ np.linalg.solve(design.T @ weighted, weighted.T)
    unchecked = np.diag(projection) < _UNCHECKED * np.diag(weight)
    deviation = np.sqrt(np.where(unchecked, np.inf, np.diag(projection)))
    residual = projection @ values / deviation[:, None]
    chi2 = np.einsum("kc,kl,lc->c", values, projection, values)
    freedom = len(angle) - design.shape[1] - 1
    if freedom < 1:
        return residual
    return residual / np.sqrt(np.maximum((chi2 - residual ** 2) / freedom, 1.0))


def _condition(normal, count):
    """Return the condition number of columns, each scaled to unit length, from their products."""
    length = np.sqrt(np.diag(normal).clip(np.finfo(float).tiny))
    singular = np.sqrt(np.linalg.eigvalsh(normal / np.outer(length, length)).clip(0.0))
    condition = singular[-1] / max(singular[0], np.finfo(float).eps)  # rounding tells no more
    if count < len(normal) or condition > LARGEST_CONDITION:
        rank = min(count, int(np.sum(singular * LARGEST_CONDITION > singular[-1])))
        raise NotEnoughDataError(
            f"{count} readings tell {rank} of {len(normal)} coefficients apart (condition number "
            f"{condition:.3g}, at most {LARGEST_CONDITION:.0e}): use at least three well separated angles")
    return condition


def _whitening(variance, count):
    """Return what makes readings of this variance unit ones: (K,) weights or a (K, K) matrix."""
    variance = np.asarray(variance, dtype=float)
    if variance.ndim == 2:
        return np.linalg.solve(np.linalg.cholesky(variance), np.eye(count))
    if not np.all(variance > 0):
        raise ValueError(f"variance = {variance.min()}: must be positive")
    return np.broadcast_to(1 / np.sqrt(variance), (count,))


def _fit_weighted(design, value, variance):
    whitening = _whitening(1.0 if variance is None else variance, len(design))
    if whitening.ndim == 2:
        columns, readings = whitening @ design, value @ whitening.T
    else:
        columns, readings = whitening[:, None] * design, value * whitening
    covariance = np.linalg.inv(columns.T @ columns)
    coefficients = readings @ columns @ covariance
    chi2 = np.sum((readings - coefficients @ columns.T) ** 2, axis=-1)
    freedom = len(design) - design.shape[1]
    if variance is None:
        covariance = covariance * (np.mean(chi2) / freedom if freedom else np.nan)
    return HarmonicFit(coefficients, covariance, chi2, freedom, _condition(design.T @ design, len(design)),
                       np.ones(value.shape, dtype=bool))


def _fit_robust(design, value, variance):
    if value.ndim != 1 or np.ndim(variance) == 2:
        raise ValueError("a robust fit takes one row of readings and no correlations between them")
    columns, readings = design, value
    if variance is not None:
        whitening = _whitening(variance, len(design))
        columns, readings = whitening[:, None] * design, whitening * value
    some = slice(None)
    if len(value) > _ENOUGH_TO_START:
        # At random, since every n-th reading may meet the same angles again and again.
        some = np.random.default_rng(0).choice(len(value), _ENOUGH_TO_START, replace=False)
    coefficients, spread = huber_fit(columns[some], readings[some], None if variance is None else 1.0)
    residual = readings - columns @ coefficients
    kept = np.abs(residual) <= OUTLIER_THRESHOLD * spread
    out, wrong = columns[~kept], residual[~kept]
    return fit_from_sums(columns.T @ columns - out.T @ out, columns.T @ residual - out.T @ wrong,
                         residual @ residual - wrong @ wrong, int(kept.sum()), coefficients,
                         None if variance is None else 1.0, kept)


def fit_from_sums(normal, moment, squares, count, start, variance=None, kept=None):
    """Return the fit of readings of which only sums are known.

    Parameters
    ----------
    normal : (M, M) float64
        Columns times columns, summed.
    moment : (M,) float64
        Columns times residuals from ``start``; near the fit, so that no digits are lost.
    squares : float
        Squared residuals, summed.
    count : int
        Number of readings.
    start : (M,) float64
        Coefficients.
    variance : float, optional
        Of a reading; without it the scatter sets the covariance.
    kept : (K,) bool, optional

    Raises
    ------
    NotEnoughDataError
        The columns do not tell the coefficients apart.
    """
    condition = _condition(normal, count)
    step = np.linalg.solve(normal, moment)
    squares = squares - step @ moment
    freedom = count - len(normal)
    unit = variance
    unit = variance if variance is not None else squares / freedom if freedom else np.nan
    return HarmonicFit(start + step, np.linalg.inv(normal) * unit, squares / (variance or 1.0), freedom,
                       condition, kept)


def huber_fit(columns, readings, spread=None):
    """Fit coefficients with Huber's weights.

    Parameters
    ----------
    columns : (K, M) float64
    readings : (K,) float64
    spread : float, optional
        Standard deviation of the readings; without it, robustly from the residuals.

    Returns
    -------
    coefficients : (M,) float64
    spread : float
    """
    coefficients = np.linalg.solve(columns.T @ columns, columns.T @ readings)
    for _ in range(_HUBER_STEPS):
        residual = readings - columns @ coefficients
        deviation = robust_spread(residual) if spread is None else spread
        size = np.abs(residual)
        weight = np.minimum(1.0, HUBER_THRESHOLD * deviation / np.maximum(size, np.finfo(float).tiny))
        weighted = columns * weight[:, None]
        normal = weighted.T @ columns
        step = np.linalg.solve(normal, weighted.T @ residual)
        coefficients = coefficients + step
        if step @ normal @ step < (_SETTLED * deviation) ** 2:
            break
    return coefficients, deviation


def robust_spread(residual):
    """Return the standard deviation of residuals along their first axis, by the median of their sizes."""
    return np.maximum(_NORMAL_MAD * np.median(np.abs(residual), axis=0), np.finfo(float).tiny)
