"""From raw samples at one table angle to a dwell: its means, or the reason why it does not count.

The sensors themselves tell whether the table stood still: the parts of a dwell must agree within what white
and 1/f noise allow. Single outlying samples, as of somebody who walks past, are left out by a robust mean.
"""

import math
from dataclasses import dataclass

import numpy as np

from alignment.harmonic import OUTLIER_THRESHOLD, huber_fit, robust_spread

_PARTS = 5
_FEWEST_SAMPLES = 20


@dataclass(frozen=True)
class Dwell:
    """Mean readings while the table stood at one angle.

    Attributes
    ----------
    angle : float, rad
        Table angle, ``tau`` of :mod:`alignment.turntable`.
    start, end : float, s
    gyro_b : (3,) float64, rad/s
    accel_b : (3,) float64, m/s^2
    kept : float
        Share of the samples that count.
    gyro_noise_density : float, rad/s/sqrt(Hz)
        White noise that the samples of the x and y gyros show.
    rejection : str
        Why the dwell may not be used; empty when it may.
    """

    angle: float
    start: float
    end: float
    gyro_b: np.ndarray
    accel_b: np.ndarray
    kept: float = 1.0
    gyro_noise_density: float = math.nan
    rejection: str = ""

    @property
    def duration(self):
        """Length of the dwell, s."""
        return self.end - self.start


def reduce_dwell(time, angle, gyro_b, accel_b, params):
    """Return the dwell of raw samples taken while the table stood.

    Parameters
    ----------
    time : (N,) float64, s
        Times of the samples, each the mean of the interval before it, increasing.
    angle : (N,) float64, rad
        Table angle at each sample.
    gyro_b : (N, 3) float64, rad/s
    accel_b : (N, 3) float64, m/s^2
    params : alignment.params.AlignmentParams

    Returns
    -------
    Dwell
        With ``rejection`` set where the samples are too few, not numbers, or not of a table at rest.
    """
    time, angle = np.asarray(time, dtype=float), np.asarray(angle, dtype=float)
    samples = np.concatenate([gyro_b, accel_b], axis=1)
    if len(time) < _FEWEST_SAMPLES:
        return rejected_dwell(time, angle, f"only {len(time)} samples, at least {_FEWEST_SAMPLES} are needed")
    if not (np.isfinite(samples).all() and np.isfinite(angle).all()):
        return rejected_dwell(time, angle, f"{np.sum(~np.isfinite(samples).all(axis=1))} samples are not numbers")
    interval = np.median(np.diff(time))
    if not interval > 0:
        return rejected_dwell(time, angle, "the stamps do not increase")
    if np.ptp(angle) > params.largest_angle_spread:
        return rejected_dwell(time, angle, f"the table turned by {np.degrees(np.ptp(angle)):.3g} deg")
    kept = np.ones(len(samples), dtype=bool)
    if params.robust:
        kept = np.all([_inliers(column) for column in samples.T], axis=0)
    means = samples[kept].mean(axis=0)
    reason = _movement(samples, kept, interval, params)
    return Dwell(float(angle.mean()), float(time[0] - interval), float(time[-1]), means[:3], means[3:],
                 float(kept.mean()), _noise_density(samples[:, :2], interval), reason)


def rejected_dwell(time, angle, reason):
    """Return a dwell of samples at times, s, and table angles, rad, that is not used for the reason."""
    unknown = np.full(3, np.nan)
    start, end = (float(time[0]), float(time[-1])) if len(time) else (np.nan, np.nan)
    return Dwell(float(angle.mean()) if len(angle) else np.nan, start, end, unknown, unknown, 0.0, rejection=reason)


def _noise_density(gyro, interval):
    """Return the density of white noise by third differences, which have 20 times its variance and no slow motion."""
    return float(robust_spread(np.diff(gyro, n=3, axis=0)).mean() * np.sqrt(interval / 20.0))


def _inliers(column):
    """Return which samples lie within the limit about Huber's mean."""
    centre, spread = huber_fit(np.ones((len(column), 1)), column)
    distance = np.abs(column - centre[0])
    # A coarsely quantised sensor at rest may show but one value, with others one step away.
    return distance <= max(OUTLIER_THRESHOLD * spread, np.quantile(distance, 0.75))


def _movement(samples, kept, interval, params):
    """Return how the sensors show that the table did not stand still, or an empty string."""
    rate = np.linalg.norm(samples[kept, :3].mean(axis=0))
    if rate > params.largest_rate:
        return f"not still: turning at {np.degrees(rate):.3g} deg/s"
    good_parts = np.array_split(kept, _PARTS)
    if not all(good.any() for good in good_parts):
        return f"not still: {_PARTS - sum(good.any() for good in good_parts)} of {_PARTS} parts are all outliers"
    parts = [part[good].mean(axis=0) for part, good in zip(
        np.array_split(samples, _PARTS), good_parts, strict=True)]
    seconds = len(samples) / _PARTS * interval
    gyro_std = np.hypot(params.gyro_noise_density / np.sqrt(seconds), params.gyro_bias_instability)
    accel_std = params.accel_noise_density / np.sqrt(seconds)
    # The scatter of the samples themselves counts where it is larger: vibration averages out.
    scatter = samples[kept].std(axis=0) / np.sqrt(seconds / interval)
    limit = params.still_threshold * np.maximum(scatter, np.repeat([gyro_std, accel_std], 3))
    spread = np.abs(parts - np.mean(parts, axis=0)).max(axis=0) / limit
    if spread.max() > 1:
        worst = int(np.argmax(spread))
        name = ("x gyro", "y gyro", "z gyro", "x accelerometer", "y accelerometer", "z accelerometer")[worst]
        return f"not still: the {name} changed by {spread[worst]:.3g} times what its noise allows"
    return ""
