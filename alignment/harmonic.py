"""What a sensor on a turntable reads, as bias, cosine and sine of the table angle: the fit under everything.

``reading = bias + cosine cos(tau) + sine sin(tau) [+ drift time] [+ spin rate]``. The bias is always
fitted, so that no constant error of a sensor reaches the attitude. Weighted, and robust when asked: Huber's
weights until they settle, then readings beyond five deviations are left out and the rest count in full, which
keeps the efficiency of clean data (P. Huber, Robust Statistics, 1981, 7.8).
"""

from dataclasses import dataclass

import numpy as np

from alignment._kernels import accumulate_huber, accumulate_kept
from alignment.errors import NotEnoughDataError

HUBER_THRESHOLD = 1.345  # 95 % efficient for normal noise
OUTLIER_THRESHOLD = 5.0  # one clean reading in two million lies beyond
LARGEST_CONDITION = 1e4  # two angles a minute of arc apart already exceed it
_HUBER_STEPS = 30
_SETTLED = 1e-3  # of a coefficient's deviation
_NORMAL_MAD = 1.482602218505602  # standard deviation per median absolute deviation


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
    kept : (..., K) bool
        Which readings count; all of them unless the fit is robust.
    """

    coefficients: np.ndarray
    covariance: np.ndarray
    chi2: np.ndarray
    freedom: int
    condition: float
    kept: np.ndarray

    @property
    def bias(self):
        """Constant part."""
        return self.coefficients[..., 0]

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
    columns = [np.ones_like(angle), np.cos(angle), np.sin(angle)]
    columns += [np.asarray(column, dtype=float) for column in (time, rate) if column is not None]
    design = np.stack(columns, axis=1)
    _condition(design)
    return design


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


def _condition(design):
    scaled = design / np.linalg.norm(design, axis=0).clip(np.finfo(float).tiny)
    singular = np.sqrt(np.linalg.eigvalsh(scaled.T @ scaled).clip(0.0))
    condition = singular[-1] / max(singular[0], np.finfo(float).tiny)
    if len(design) < design.shape[1] or condition > LARGEST_CONDITION:
        rank = min(len(design), int(np.sum(singular * LARGEST_CONDITION > singular[-1])))
        raise NotEnoughDataError(
            f"{len(design)} readings tell {rank} of {design.shape[1]} coefficients apart (condition number "
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
    return HarmonicFit(coefficients, covariance, chi2, freedom, _condition(design),
                       np.ones(value.shape, dtype=bool))


def _fit_robust(design, value, variance):
    if value.ndim != 1 or np.ndim(variance) == 2:
        raise ValueError("a robust fit takes one row of readings and no correlations between them")
    weight_root = _whitening(1.0 if variance is None else variance, len(design))
    columns, readings = weight_root[:, None] * design, weight_root * value
    coefficients = np.linalg.solve(columns.T @ columns, columns.T @ readings)
    spread = _spread(readings - columns @ coefficients, variance)
    for _ in range(_HUBER_STEPS):
        normal, right = accumulate_huber(columns, readings, coefficients, HUBER_THRESHOLD * spread)
        step = np.linalg.solve(normal, right) - coefficients
        coefficients = coefficients + step
        spread = _spread(readings - columns @ coefficients, variance)
        if step @ normal @ step < (_SETTLED * spread) ** 2:
            break
    kept = np.abs(readings - columns @ coefficients) <= OUTLIER_THRESHOLD * spread
    condition = _condition(design[kept])
    normal, right = accumulate_kept(columns, readings, kept)
    coefficients = np.linalg.solve(normal, right)
    chi2 = np.sum((readings - columns @ coefficients)[kept] ** 2)
    freedom = int(kept.sum()) - design.shape[1]
    unit = 1.0 if variance is not None else chi2 / freedom if freedom else np.nan
    return HarmonicFit(coefficients, np.linalg.inv(normal) * unit, chi2, freedom, condition, kept)


def _spread(residual, variance):
    """Return the residuals' standard deviation: stated, or robustly from themselves."""
    if variance is not None:
        return 1.0
    return max(_NORMAL_MAD * np.median(np.abs(residual)), np.finfo(float).tiny)
