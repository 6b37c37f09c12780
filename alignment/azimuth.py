"""North from one gyro on a levelled turntable: the paper's seven closed forms, each with all its branches.

The x gyro reads ``bias + S W (X cos tau + Y sin tau)`` with the Earth rate ``W [X, Y, Z]`` in table axes
(:func:`alignment.turntable.earth_direction_t`); roll, pitch and latitude are known. Each method in
:data:`METHODS` says at which angles it wants its readings. Equation numbers are the paper's; 40 (second
case), 46 to 49, 57 to 59, 64 and 67 to 69 are corrected. No method is best everywhere: :mod:`alignment.north`
uses all the readings instead.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from alignment.results import (
    LARGEST_SCALE_ERROR,
    LARGEST_STD,
    SINGULAR_SENSITIVITY,
    WEAK_SENSITIVITY,
    HeadingResult,
    Quality,
    central_jacobian,
    wrap_angle,
)
from alignment.turntable import earth_direction_t
from inertial.earth import EARTH_RATE

_DIFFERENCE_STEP = 1e-7  # of the Earth rate, or rad: central differences good to about nine digits
_FEW = (1.0, 2.0, 4.0)  # deviations within which a solution may have been missed
_NO_SOLUTION_STD = np.pi  # rad, of a heading that has none one deviation of the readings off
_SAME_BRANCH = 1e-9  # rad; two solutions closer than this are one


@dataclass(frozen=True)
class AzimuthMethod:
    """One closed form.

    Attributes
    ----------
    name : str
    positions : tuple of str
        Readings it takes, in order: table angles in deg, ``"any"`` angle, ``"maximum"`` over a turn, or
        ``"tipped"``, the sensor along body z.
    solve : callable
        (rates / Earth rate, roll, pitch, latitude, angle) to (branches, bias, scale, latitude).
    """

    name: str
    positions: tuple
    solve: Callable


def find_azimuth(method, rate, roll, pitch, latitude, *, angle=0.0, rate_covariance=None,
                 level_covariance=None, latitude_std=0.0, hint=None, shared_channel=False):
    """Return the heading by one of the closed forms.

    Parameters
    ----------
    method : str
        Name in :data:`METHODS`.
    rate : (..., n) float64, rad/s
        Readings of the gyro at the method's positions.
    roll, pitch, latitude : (...) float64, rad
    angle : float, rad
        Table angle of the reading that ``azimuth_2`` takes.
    rate_covariance : (n, n) float64, optional
    level_covariance : (2, 2) float64, optional
        Of roll and pitch.
    latitude_std : float, rad
    hint : (...) float64, optional
        Heading by a compass, rad: the branch nearest to it is chosen. Without it the first is, and AMBIGUOUS
        is set where there are several.
    shared_channel : bool
        Whether the tipped reading comes from a z gyro and not from the x one, tipped.

    Returns
    -------
    HeadingResult

    Raises
    ------
    ValueError
        There is no such method, or the number of readings is not the method's.
    """
    method = find_method(method)
    rate = np.asarray(rate, dtype=float)
    count = len(method.positions)
    if rate.shape[-1:] != (count,):
        raise ValueError(f"{method.name} takes {count} readings, rate has shape {rate.shape}")
    shape = np.broadcast_shapes(rate.shape[:-1], np.shape(roll), np.shape(pitch), np.shape(latitude))
    known = [np.broadcast_to(value, shape)[..., None] for value in (roll, pitch, latitude)]
    inputs = np.concatenate([np.broadcast_to(rate / EARTH_RATE, (*shape, count)), *known], axis=-1)

    with np.errstate(invalid="ignore", divide="ignore"):
        branches, bias, scale, found_latitude = _solve(method, inputs, angle)
        covariance = _input_covariance(count, rate_covariance, level_covariance, latitude_std)
        missed = _just_missed(method, inputs, angle, branches, covariance, hint)
        order = _branch_order(branches, hint)
        branches = np.take_along_axis(branches, order, axis=-1)
        slope = _heading_slope(method, inputs, angle, branches[..., 0])
        variance = np.maximum(np.einsum("...i,ij,...j->...", slope, covariance, slope),
                              _far_variance(method, inputs, angle, branches[..., 0], covariance))
        quality = _quality(method, inputs, slope, branches, scale, hint)
        quality |= Quality.SHARED_CHANNEL.value if shared_channel else 0
        quality |= np.where(missed | (variance > LARGEST_STD ** 2), Quality.AMBIGUOUS.value, 0)
        blind = quality & Quality.SINGULAR.value != 0
    return HeadingResult(np.where(blind, np.nan, branches[..., 0]), np.where(blind, np.nan, variance),
                         branches, bias * EARTH_RATE, scale, quality, latitude=found_latitude)


def find_method(name):
    """Return the method of that name.

    Raises
    ------
    ValueError
        There is none; the message lists the names.
    """
    if name not in METHODS:
        raise ValueError(f"unknown azimuth method {name!r}: choose from {', '.join(METHODS)}")
    return METHODS[name]


def solve_kernel(a, b, c):
    """Return both solutions of ``a sin(psi) + b cos(psi) = c``, (..., 2), NaN where there are none.

    ``atan2(a, b) +- acos(c / hypot(a, b))``: the paper's half-angle form 41 without its pole at b + c = 0.
    """
    middle, half = np.arctan2(a, b), np.arccos(c / np.hypot(a, b))
    return wrap_angle(np.stack([middle + half, middle - half], axis=-1))


def quadratic_coefficients(rate_0, rate_90, roll, pitch, latitude):
    """Return A, B, C of method 5's ``B x^2 + C x - A = 0``, x = 1 / (S cos(latitude)) (equation 64).

    ``rate_0`` and ``rate_90`` are without bias and in Earth rates.
    """
    slope, tan_pitch, tan_latitude = np.tan(roll), np.tan(pitch), np.tan(latitude)
    cos_pitch = np.cos(pitch)
    p = rate_0 * tan_pitch * slope - rate_90 / np.cos(roll)
    a = 1 - tan_latitude ** 2 * (tan_pitch ** 2 + slope ** 2 / cos_pitch ** 2)
    b = p ** 2 + rate_0 ** 2 / cos_pitch ** 2
    c = -2 * tan_latitude / cos_pitch * (p * slope + rate_0 * tan_pitch)
    return a, b, c


def approximate_scale_5(rate_0, rate_90, roll, pitch, latitude):
    """Return method 5's scale factor to first order in its error (equation 66)."""
    a, b, c = quadratic_coefficients(rate_0, rate_90, roll, pitch, latitude)
    a, c = a * np.cos(latitude) ** 2, c * np.cos(latitude)
    return 1 + (-a + b + c) / (2 * a - c)


def angle_of_maximum(roll, pitch, heading, latitude):
    """Return the table angle at which the x gyro reads most, rad (equation 52, all four quadrants)."""
    x, y, _ = np.moveaxis(earth_direction_t(roll, pitch, heading, latitude), -1, 0)
    return np.arctan2(y, x)


def _azimuth_1a(w, roll, pitch, latitude, angle):
    cosine = ((w[..., 0] - w[..., 1]) / 2 - np.sin(pitch) * np.sin(latitude)) \
        / (np.cos(pitch) * np.cos(latitude))
    half = np.arccos(cosine)
    return _only_branches(np.stack([half, -half], axis=-1))


def _azimuth_1b(w, roll, pitch, latitude, angle):
    side = ((w[..., 0] - w[..., 1]) / 2 + np.cos(pitch) * np.sin(roll) * np.sin(latitude)) / np.cos(latitude)
    return _only_branches(solve_kernel(-np.cos(roll), np.sin(pitch) * np.sin(roll), side))


def _azimuth_2(w, roll, pitch, latitude, angle):
    cos_tau, sin_tau = np.cos(angle), np.sin(angle)
    cos_latitude, sin_latitude = np.cos(latitude), np.sin(latitude)
    a = -np.cos(roll) * cos_latitude * sin_tau
    b = (np.sin(pitch) * np.sin(roll) * sin_tau + np.cos(pitch) * cos_tau) * cos_latitude
    c = w[..., 0] - np.sin(pitch) * sin_latitude * cos_tau \
        + np.cos(pitch) * np.sin(roll) * sin_latitude * sin_tau
    return _only_branches(solve_kernel(a, b, c))


def _azimuth_3(w, roll, pitch, latitude, angle):
    along_axis = np.sqrt(1 - w[..., 0] ** 2)
    a, b = np.sin(roll) * np.cos(latitude), np.sin(pitch) * np.cos(roll) * np.cos(latitude)
    level = np.cos(pitch) * np.cos(roll) * np.sin(latitude)
    return _only_branches(np.concatenate(
        [solve_kernel(a, b, sign * along_axis + level) for sign in (1, -1)], axis=-1))


def _azimuth_4(w, roll, pitch, latitude, angle):
    bias, w1, w2 = _without_bias(w)
    branches = solve_kernel(
        -w1 * np.cos(roll), w1 * np.sin(pitch) * np.sin(roll) - w2 * np.cos(pitch),
        (w2 * np.sin(pitch) + w1 * np.cos(pitch) * np.sin(roll)) * np.tan(latitude))
    earth = earth_direction_t(roll[..., None], pitch[..., None], branches, latitude[..., None])
    x, y = earth[..., 0], earth[..., 1]
    scale = (w1[..., None] * x + w2[..., None] * y) / (x ** 2 + y ** 2)
    return _nearest_scale_first(branches, bias, scale)


def _azimuth_5(w, roll, pitch, latitude, angle):
    bias, w1, w2 = _without_bias(w)
    a, b, c = quadratic_coefficients(w1, w2, roll, pitch, latitude)
    # Both roots without the loss of digits of the textbook form.
    root = -0.5 * (c + np.copysign(np.sqrt(c ** 2 + 4 * a * b), c))
    x = np.stack([root / b, -a / root], axis=-1)
    pitch, roll, tan_latitude = pitch[..., None], roll[..., None], np.tan(latitude)[..., None]
    w3 = x * w1[..., None] - np.sin(pitch) * tan_latitude
    w4 = x * w2[..., None] + np.cos(pitch) * np.sin(roll) * tan_latitude
    branches = np.arctan2(w3 * np.tan(pitch) * np.tan(roll) - w4 / np.cos(roll), w3 / np.cos(pitch))
    return _nearest_scale_first(branches, bias, 1 / (x * np.cos(latitude)[..., None]))


def _azimuth_6(w, roll, pitch, latitude, angle):
    bias, w1, w2 = _without_bias(w)
    w3 = w[..., 3] - bias
    # Rx(roll), then Ry(pitch): table axes to level ones.
    right = np.cos(roll) * w2 - np.sin(roll) * w3
    down = np.sin(roll) * w2 + np.cos(roll) * w3
    forward = np.cos(pitch) * w1 + np.sin(pitch) * down
    down = np.cos(pitch) * down - np.sin(pitch) * w1
    scale = np.sqrt(w1 ** 2 + w2 ** 2 + w3 ** 2)
    branches = np.arctan2(-right, forward)[..., None]
    return branches, bias, scale, np.arctan2(-down, np.hypot(forward, right))


def _without_bias(w):
    bias = 0.5 * (w[..., 0] + w[..., 2])
    return bias, w[..., 0] - bias, w[..., 1] - bias


def _only_branches(branches):
    unknown = np.full(branches.shape[:-1], np.nan)
    return branches, unknown, unknown, unknown


def _nearest_scale_first(branches, bias, scale):
    """Order the branches by their scale factor's distance from 1; those beyond the limit are none."""
    error = np.abs(scale - 1)
    error = np.where(np.isnan(error), np.inf, error)
    order = np.argsort(error, axis=-1)
    scale, branches, error = (np.take_along_axis(array, order, axis=-1) for array in (scale, branches, error))
    branches[..., 1] = np.where(error[..., 1] > LARGEST_SCALE_ERROR, np.nan, branches[..., 1])
    return branches, bias, scale[..., 0], np.full(bias.shape, np.nan)


METHODS = {method.name: method for method in (
    AzimuthMethod("azimuth_1a", ("0", "180"), _azimuth_1a),
    AzimuthMethod("azimuth_1b", ("90", "270"), _azimuth_1b),
    AzimuthMethod("azimuth_2", ("any",), _azimuth_2),
    AzimuthMethod("azimuth_3", ("maximum",), _azimuth_3),
    AzimuthMethod("azimuth_4", ("0", "90", "180"), _azimuth_4),
    AzimuthMethod("azimuth_5", ("0", "90", "180"), _azimuth_5),
    AzimuthMethod("azimuth_6", ("0", "90", "180", "tipped"), _azimuth_6),
)}


def _solve(method, inputs, angle):
    count = len(method.positions)
    return method.solve(inputs[..., :count], *np.moveaxis(inputs[..., count:], -1, 0), angle)


def _branch_order(branches, hint):
    """Return the order of the branches: nearest to the hint first, or as they are; NaN last."""
    if hint is None:
        return np.argsort(np.isnan(branches), axis=-1, kind="stable")
    distance = np.abs(wrap_angle(branches - np.asarray(hint)[..., None]))
    return np.argsort(np.where(np.isnan(distance), np.inf, distance), axis=-1, kind="stable")


def _input_covariance(count, rate_covariance, level_covariance, latitude_std):
    covariance = np.zeros((count + 3, count + 3))
    if rate_covariance is not None:
        covariance[:count, :count] = np.asarray(rate_covariance) / EARTH_RATE ** 2
    if level_covariance is not None:
        covariance[count:-1, count:-1] = level_covariance
    covariance[-1, -1] = latitude_std ** 2
    return covariance


def _changes(method, inputs, angle, heading):
    """Return how far the branch nearest to ``heading`` is from it, rad; NaN where there is none."""
    branches = _solve(method, inputs, angle)[0]
    distance = wrap_angle(branches - heading[..., None])
    nearest = np.argmin(np.where(np.isnan(distance), np.inf, np.abs(distance)), axis=-1)
    return np.take_along_axis(distance, nearest[..., None], axis=-1)


def _heading_slope(method, inputs, angle, heading):
    """Return the derivatives of the branch at ``heading`` by the inputs, (..., n)."""
    steps = np.full(inputs.shape[-1], _DIFFERENCE_STEP)
    return central_jacobian(lambda shifted: _changes(method, shifted, angle, heading), inputs, steps)[..., 0, :]


def _far_variance(method, inputs, angle, heading, covariance):
    """Return the variance by what inputs one deviation off, each way, make of the heading.

    Where the equations bend within the inputs' deviations, their first order says too little.
    """
    shifts = _deviations(covariance, inputs.ndim)
    change = _changes(method, inputs + shifts, angle, heading)[..., 0]
    return 0.5 * np.sum(np.where(np.isnan(change), _NO_SOLUTION_STD, change) ** 2, axis=0)


def _just_missed(method, inputs, angle, branches, covariance, hint):
    """Whether readings a few deviations off would have a solution nearer to the hint, which these have not."""
    if hint is None:
        return np.zeros(branches.shape[:-1], dtype=bool)
    shifts = np.concatenate([few * _deviations(covariance, inputs.ndim) for few in _FEW])
    near = _solve(method, inputs + shifts, angle)[0]
    hint = np.asarray(hint)[..., None]
    best = np.nanmin(np.abs(wrap_angle(branches - hint)), axis=-1, keepdims=True, initial=np.inf)
    return np.any(np.isnan(branches) & (np.abs(wrap_angle(near - hint)) < best), axis=(0, -1))


def _deviations(covariance, ndim):
    """Return one deviation of the inputs along each axis of their covariance, each way, (2 n, ..., n)."""
    variances, axes = np.linalg.eigh(covariance)
    shifts = (axes * np.sqrt(variances.clip(0.0))).T
    return np.concatenate([shifts, -shifts]).reshape(-1, *(1,) * (ndim - 1), len(covariance))


def _quality(method, inputs, slope, branches, scale, hint):
    """Return the flags, from the gain of the method: heading error per error of its worst reading."""
    gain = np.linalg.norm(slope[..., :len(method.positions)], axis=-1)
    cos_latitude = np.cos(inputs[..., -1])
    reach = np.minimum(1 / gain, cos_latitude)
    blind = ~(reach > SINGULAR_SENSITIVITY) | np.isnan(branches[..., 0])
    quality = np.where(blind, Quality.SINGULAR.value, np.where(reach < WEAK_SENSITIVITY,
                                                              Quality.WEAK.value, 0))
    quality |= np.where(np.abs(scale - 1) > LARGEST_SCALE_ERROR, Quality.SCALE.value, 0)
    if hint is None:
        apart = np.abs(wrap_angle(branches - branches[..., :1])) > _SAME_BRANCH
        quality |= np.where(np.any(apart, axis=-1), Quality.AMBIGUOUS.value, 0)
    return quality


