"""The joint estimator of north: every reading of one or two gyros, and one search for the heading.

The harmonic fits of the gyros hold all they tell about the heading: the in-plane Earth rate (X, Y). A search
over the heading alone finds where the Earth rate of that heading explains them best; scale factors, table
zero, roll, pitch and latitude are integrated out under their priors to first order. The likelihood over the
circle also shows whether a second, distant heading would do: no compass is needed to choose among branches.
"""

import numpy as np

from alignment._kernels import MODE_GAP, search_heading
from alignment.bounds import sensitivity
from alignment.errors import UnobservableError
from alignment.harmonic import Y_TO_PLANE
from alignment.results import (
    LARGEST_SCALE_ERROR,
    LARGEST_STD,
    SINGULAR_SENSITIVITY,
    WEAK_SENSITIVITY,
    HeadingResult,
    Quality,
)
from inertial.earth import EARTH_RATE

# Deviations of a misfit or of a scale factor that noise does not explain.
_MISFIT_LIMIT = 5.0
# Readings that scatter more than this many times their stated noise are not those of a table at rest. Less widens
# the deviation of the result (HarmonicFit.widened): nobody knows his noise that well.
LARGEST_SCATTER = 3.0


def find_north(fit_x, fit_y, level, level_covariance, latitude, priors):
    """Return the heading that explains the gyros' harmonic fits best.

    Parameters
    ----------
    fit_x, fit_y : alignment.harmonic.HarmonicFit or None
        Of the x and y gyros, rad/s; either may be missing.
    level : (..., 2) float64, rad
        Roll and pitch of the table.
    level_covariance : (2, 2) float64, rad^2
    latitude : float, rad
    priors : alignment.params.NorthPriors

    Returns
    -------
    HeadingResult
        Branches are the best heading and, where AMBIGUOUS, the second.

    Raises
    ------
    ValueError
        No gyro, or a latitude that is none.
    UnobservableError
        At a pole there is no north.
    """
    if not abs(latitude) <= 0.5 * np.pi:
        raise ValueError(f"latitude = {latitude} rad: must be within +-pi/2")
    if np.cos(latitude) < SINGULAR_SENSITIVITY:
        raise UnobservableError(f"latitude = {np.degrees(latitude):.3f} deg: too near a pole for a heading")
    channels = [(fit, rotation) for fit, rotation in ((fit_x, np.eye(2)), (fit_y, Y_TO_PLANE))
                if fit is not None]
    if not channels:
        raise ValueError("neither fit_x nor fit_y is given")
    in_plane = np.stack([fit.in_plane @ turn.T for fit, turn in channels], axis=-2) / EARTH_RATE
    covariance = np.stack([turn @ fit.in_plane_covariance @ turn.T for fit, turn in channels])
    covariance /= EARTH_RATE ** 2
    shape = in_plane.shape[:-2]
    level = np.ascontiguousarray(np.broadcast_to(level, (*shape, 2)), dtype=float)
    out = np.empty((int(np.prod(shape)), 6))
    count = len(channels)
    search_heading(
        np.ascontiguousarray(in_plane).reshape(-1, count, 2), covariance,
        np.full(count, priors.scale_std ** 2), np.full(count, priors.skew_std ** 2), level.reshape(-1, 2),
        np.asarray(level_covariance, dtype=float), float(latitude), priors.latitude_std ** 2,
        priors.table_zero_std ** 2, out)
    scatter = np.max([np.where(fit.excess > _MISFIT_LIMIT, fit.scatter, 1.0) for fit, _ in channels], axis=0)
    return _result(out.reshape(*shape, 6), channels[0][0].bias, scatter, covariance, level, latitude, priors)


def explain_scale(ratio):
    """Return in words why a sensor may read this many times the Earth's rate or gravity.

    >>> explain_scale(57.3)
    'about 57.3 times the expected: in deg/s, not rad/s?'
    """
    likely = ((57.29578, "in deg/s, not rad/s?"), (206264.8, "in arcsec/s, not rad/s?"),
              (1 / 9.80665, "in g, not m/s^2?"), (1e-3 * 9.80665, "in milli-g, not m/s^2?"),
              (1 / 57.29578, "converted to rad twice?"))
    for factor, reason in likely:
        if abs(ratio / factor - 1) < 4 * LARGEST_SCALE_ERROR:
            return f"about {ratio:.3g} times the expected: {reason}"
    return f"{ratio:.3g} times the expected: the base turns, or the latitude or the level is wrong"


def _result(out, bias, scatter, covariance, level, latitude, priors):
    heading, variance, misfit, second, gap, scale = np.moveaxis(out, -1, 0)
    reach = sensitivity(level[..., 0], level[..., 1], heading, latitude)
    blind = ~(reach >= SINGULAR_SENSITIVITY)
    quality = np.where(reach < WEAK_SENSITIVITY, Quality.WEAK.value, 0)
    quality = np.where(blind, Quality.SINGULAR.value, quality)
    ambiguous = (gap < MODE_GAP) | (variance > LARGEST_STD ** 2)
    quality |= np.where(ambiguous, Quality.AMBIGUOUS.value, 0)
    scale_std = np.sqrt(np.trace(covariance[0]) + priors.scale_std ** 2)
    wrong_scale = np.abs(scale - 1) > LARGEST_SCALE_ERROR + _MISFIT_LIMIT * scale_std
    quality |= np.where(wrong_scale, Quality.SCALE.value, 0)
    inconsistent = (scatter > LARGEST_SCATTER) | (misfit > _MISFIT_LIMIT ** 2)
    quality |= np.where(inconsistent, Quality.INCONSISTENT.value, 0)
    second = np.where(ambiguous, second, np.nan)
    return HeadingResult(np.where(blind, np.nan, heading), np.where(blind, np.nan, variance),
                         np.stack([heading, second], axis=-1), bias, scale, quality, chi2=misfit, scatter=scatter)
