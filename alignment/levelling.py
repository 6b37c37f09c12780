"""Levelling on a turntable: the paper's five methods, and the one that uses what there is.

Readings are specific forces, m/s^2, at table angles 0, 90, 180 and 270 deg (see :mod:`alignment.turntable`).
Methods 1 to 4 find roll within +-90 deg only: the paper's arcsines. Equation numbers are the paper's; 21 and
22 are corrected (g on one side, a lever arm missing). Everything is vectorised over leading dimensions.
"""

import math
from dataclasses import replace

import numpy as np

from alignment.harmonic import Y_TO_PLANE, fit_harmonic
from alignment.results import LARGEST_SCALE_ERROR, LevelResult, Quality, propagate_covariance
from inertial.earth import STANDARD_GRAVITY
from inertial.rotation import down_from_roll_pitch, roll_pitch_from_down

# Where cos(pitch) is smaller, methods 1 to 4 no longer see the roll.
_SMALLEST_COS_PITCH = 1e-3
# By as much, rad and deviations, may two accelerometers tell different tilts.
_LARGEST_DIFFERENCE, _MISFIT_LIMIT = math.radians(0.1), 5.0
_GAUSS_NEWTON_STEPS = 6  # quadratic from a start within a hundredth of a radian
_DIFFERENCE_STEP = 1e-6  # of gravity: central differences are then good to about ten digits


def levelling_1(accel_x, gravity=STANDARD_GRAVITY, covariance=None):
    """Level with the x accelerometer at four positions (equation 19).

    Parameters
    ----------
    accel_x : (..., 4) float64, m/s^2
        Readings at 0, 90, 180, 270 deg.
    gravity : float, m/s^2
    covariance : (4, 4) float64, optional
        Of the readings.

    Returns
    -------
    LevelResult
    """
    return _level(lambda a: _from_in_plane((a[..., 0] - a[..., 2]) / (2 * gravity),
                                           (a[..., 3] - a[..., 1]) / (2 * gravity)),
                  accel_x, gravity, covariance)


def levelling_2(angle, accel_x, gravity=STANDARD_GRAVITY, covariance=None):
    """Level with the x accelerometer at any three or more angles, by least squares (equations 20, 21).

    Parameters
    ----------
    angle : (K,) float64, rad
    accel_x : (..., K) float64, m/s^2
    gravity : float, m/s^2
    covariance : (K, K) float64, optional
        Of the readings.

    Raises
    ------
    NotEnoughDataError
        Too few angles, or too much alike.
    """
    def solve(readings):
        in_plane = fit_harmonic(angle, readings).in_plane / gravity
        return _from_in_plane(in_plane[..., 0], -in_plane[..., 1])
    return _level(solve, accel_x, gravity, covariance)


def levelling_3(accel_y, gravity=STANDARD_GRAVITY, covariance=None):
    """Level with the y accelerometer at four positions (equation 24); parameters as :func:`levelling_1`."""
    return _level(lambda a: _from_in_plane((a[..., 3] - a[..., 1]) / (2 * gravity),
                                           (a[..., 2] - a[..., 0]) / (2 * gravity)),
                  accel_y, gravity, covariance)


def levelling_4(angle, accel_y, gravity=STANDARD_GRAVITY, covariance=None, lever_acceleration=0.0):
    """Level with the y accelerometer at any angles, by least squares (equations 25, 26).

    Parameters as :func:`levelling_2`; ``lever_acceleration``, (K,) m/s^2, is lever arm times the table's
    angular acceleration. Unlike the paper's, the fit has a constant, so that the bias does no harm.
    """
    def solve(readings):
        in_plane = fit_harmonic(angle, lever_acceleration - readings).in_plane / gravity
        return _from_in_plane(in_plane[..., 1], in_plane[..., 0])
    return _level(solve, accel_y, gravity, covariance)


def levelling_5(accel_x, accel_tipped, gravity=STANDARD_GRAVITY, covariance=None, shared_channel=False):
    """Level with bias and scale factor (equations 27 to 33): a fifth position tips the sensor to body z.

    Roll over the whole circle, and neither gravity nor the scale factor matters to the angles.

    Parameters
    ----------
    accel_x : (..., 3) or (..., 4) float64, m/s^2
        Readings at 0, 90, 180 deg (a fourth is not used).
    accel_tipped : (...) float64, m/s^2
        Reading along body z.
    gravity : float, m/s^2
    covariance : (4, 4) float64, optional
        Of the readings at 0, 90, 180 deg and tipped.
    shared_channel : bool
        Whether ``accel_tipped`` comes from a z accelerometer and not from the x one, tipped.
    """
    in_plane = np.asarray(accel_x, dtype=float)[..., :3]
    readings = np.concatenate([in_plane, np.asarray(accel_tipped, dtype=float)[..., None]], axis=-1)
    result = _level(lambda a: _from_three_axes(a, gravity), readings, gravity, covariance)
    return replace(result, quality=result.quality | Quality.SHARED_CHANNEL.value * shared_channel)


def approximate_scale(scale):
    """Return the scale factor by the paper's approximation ``1 + (S^2 - 1)/2`` (equations 34 and 71)."""
    return 1 + 0.5 * (np.asarray(scale) ** 2 - 1)


def _from_in_plane(sin_pitch, cos_pitch_sin_roll):
    """Return roll, pitch, bias, scale, (..., 4); NaN where the arcsines are not defined."""
    cos_pitch = np.sqrt(np.maximum(1 - sin_pitch ** 2, 0.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        pitch = np.arcsin(sin_pitch)
        roll = np.arcsin(cos_pitch_sin_roll / cos_pitch)
    unknown = np.full_like(pitch, np.nan)
    return np.stack([roll, pitch, unknown, unknown], axis=-1)


def _from_three_axes(readings, gravity):
    bias = 0.5 * (readings[..., 0] + readings[..., 2])
    x, minus_y, z = readings[..., 0] - bias, readings[..., 1] - bias, readings[..., 3] - bias
    scale = np.sqrt(x ** 2 + minus_y ** 2 + z ** 2) / gravity
    return np.stack([np.arctan2(-minus_y, -z), np.arctan2(x, np.hypot(minus_y, z)), bias, scale], axis=-1)


def _level(solve, readings, gravity, covariance):
    readings = np.asarray(readings, dtype=float)
    solution = solve(readings)
    roll, pitch, bias, scale = np.moveaxis(solution, -1, 0)
    spread = np.zeros((*roll.shape, 2, 2))
    if covariance is not None:
        steps = np.full(readings.shape[-1], _DIFFERENCE_STEP * gravity)
        spread = propagate_covariance(lambda a: solve(a)[..., :2], readings, steps, covariance)
    blind = np.isnan(roll) | np.isnan(pitch) | (np.abs(np.cos(pitch)) < _SMALLEST_COS_PITCH)
    quality = np.where(blind, Quality.SINGULAR.value, 0)
    with np.errstate(invalid="ignore"):
        quality |= np.where(np.abs(scale - 1) > LARGEST_SCALE_ERROR, Quality.SCALE.value, 0)
    return LevelResult(np.where(blind, np.nan, roll), np.where(np.isnan(pitch), np.nan, pitch),
                       spread, bias, scale, quality)


def level_jointly(accel_x, accel_y, accel_z, params):
    """Level with every accelerometer there is: harmonic fits of x and y, and the z readings.

    The down direction seen by the table is fitted to the in-plane force and the force along the axis, each
    with its own uncertainty: scale factors for all, the bias for z, whose readings do not turn. Any attitude.

    Parameters
    ----------
    accel_x, accel_y : alignment.harmonic.HarmonicFit
        Of the accelerometers that see the table turn, m/s^2.
    accel_z : float, m/s^2
        Mean reading along the table's axis.
    params : alignment.params.AlignmentParams

    Returns
    -------
    LevelResult
        INCONSISTENT where x and y tell different tilts: they do not turn as the angles say.
    """
    gravity = params.local_gravity
    weight, weighted, found = np.zeros((3, 3)), np.zeros(3), []
    for fit, turn in ((accel_x, np.eye(2)), (accel_y, Y_TO_PLANE)):
        # At rest an accelerometer reads minus gravity.
        turn = -turn / gravity
        down = turn @ fit.in_plane
        covariance = turn @ fit.in_plane_covariance @ turn.T + params.accel_scale_std ** 2 * np.outer(down, down)
        information = np.linalg.inv(covariance)
        weight[:2, :2] += information
        weighted[:2] += information @ down
        found.append((down, covariance))
    down_z = -accel_z / gravity
    weight[2, 2] = 1 / ((params.accel_bias_std / gravity) ** 2 + (params.accel_scale_std * down_z) ** 2
                        + _DIFFERENCE_STEP ** 2)
    weighted[2] = weight[2, 2] * down_z
    level = _level_from_down(np.linalg.solve(weight, weighted), weight)
    (x_down, x_covariance), (y_down, y_covariance) = found
    apart = x_down - y_down
    deviations = math.sqrt(apart @ np.linalg.solve(x_covariance + y_covariance, apart))
    differ = deviations > _MISFIT_LIMIT and np.linalg.norm(apart) > _LARGEST_DIFFERENCE
    return replace(level, quality=level.quality | Quality.INCONSISTENT.value * differ)


def _level_from_down(down, weight):
    """Return the unit down direction nearest to the estimate in its own metric, as roll and pitch."""
    roll, pitch = roll_pitch_from_down(down)
    for _ in range(_GAUSS_NEWTON_STEPS):
        slope = _down_slope(roll, pitch)
        information = slope.T @ weight @ slope
        if np.linalg.cond(information) > 1 / np.finfo(float).eps:
            break
        step = np.linalg.solve(information, slope.T @ weight @ (down - down_from_roll_pitch(roll, pitch)))
        roll, pitch = roll + step[0], pitch + step[1]
    slope = _down_slope(roll, pitch)
    blind = abs(np.cos(pitch)) < _SMALLEST_COS_PITCH
    covariance = np.full((2, 2), np.nan) if blind else np.linalg.inv(slope.T @ weight @ slope)
    unknown = np.asarray(np.nan)
    quality = np.asarray(Quality.SINGULAR.value if blind else 0)
    length = np.linalg.norm(down)
    if abs(length - 1) > LARGEST_SCALE_ERROR:
        quality = quality | Quality.SCALE.value
    roll, pitch = roll_pitch_from_down(down_from_roll_pitch(roll, pitch))
    return LevelResult(np.asarray(np.nan if blind else roll), np.asarray(pitch), covariance, unknown,
                       np.asarray(length), quality)


def _down_slope(roll, pitch):
    """Return the derivatives of the down direction by roll and pitch, (3, 2)."""
    sr, cr, sp, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
    return np.array([[0.0, -cp], [cr * cp, -sr * sp], [-sr * cp, -cr * sp]])
