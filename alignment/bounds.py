"""How well a heading can be known: Cramer-Rao bounds, and the error expected of a schedule.

White noise alone sets the bounds; 1/f noise ("bias instability") adds a floor that depends on the order in
which the angles are visited. Both follow from the covariance of the mean readings of the intervals.

Sources: IEEE Std 952-1997, annex C (1/f noise); the generalised covariance of 1/f noise is the Fourier
transform of 1/abs(f), ``-2 ln abs(t)``, up to a constant that no fit with a bias can see.
"""

import math

import numpy as np

from inertial.earth import EARTH_RATE

# Allan deviation of noise with two-sided spectral density B^2 / (2 pi f) is flat at this many B.
_ALLAN_FLOOR = math.sqrt(2 * math.log(2) / math.pi)
# Share of the 1/f noise that a fit of one turn lets in from beside the frequency of the turn.
_LEAK_ONE_WAY, _LEAK_BOTH_WAYS = 0.4, 0.8


def heading_slope_t(roll, pitch, heading, latitude):
    """Return how the Earth rate in table axes changes with heading, (..., 3), Earth rates per rad.

    Its x and y parts are the paper's X and Y differentiated by psi; their length, cos(latitude) on a level
    table, is the sensitivity of an in-plane gyro.
    """
    sr, cr = np.sin(roll), np.cos(roll)
    sp, cp = np.sin(pitch), np.cos(pitch)
    sh, ch = np.sin(heading), np.cos(heading)
    return np.stack(np.broadcast_arrays(
        -cp * sh * np.cos(latitude), -(sh * sp * sr + ch * cr) * np.cos(latitude),
        (ch * sr - sh * sp * cr) * np.cos(latitude)), axis=-1)


def sensitivity(roll, pitch, heading, latitude):
    """Return the length of the in-plane part of :func:`heading_slope_t`, Earth rates per rad."""
    slope = heading_slope_t(roll, pitch, heading, latitude)
    return np.hypot(slope[..., 0], slope[..., 1])


def best_angle(roll, pitch, heading, latitude, channel="x"):
    """Return the table angle at which a gyro's reading changes most with heading, rad.

    The other best angle is half a turn further; on a level table they look east and west.
    """
    slope = heading_slope_t(roll, pitch, heading, latitude)
    angle = np.arctan2(slope[..., 1], slope[..., 0])
    return angle if channel == "x" else angle - 0.5 * np.pi


def telling_angle(roll, pitch, heading, other):
    """Return the table angle at which an x gyro tells two headings apart best, rad."""
    # (X, Y) as in heading_slope_t; what does not depend on the heading drops out, and so does cos(latitude).
    change_cos, change_sin = np.cos(heading) - np.cos(other), np.sin(heading) - np.sin(other)
    return np.arctan2(change_cos * np.sin(pitch) * np.sin(roll) - change_sin * np.cos(roll),
                      change_cos * np.cos(pitch))


def heading_bound(noise_density, total_time, table_sensitivity, uniform=False, gyros=1):
    """Return the Cramer-Rao bound of the heading's standard deviation for white noise and unknown bias, rad.

    Parameters
    ----------
    noise_density : float, rad/s/sqrt(Hz)
    total_time : float, s
    table_sensitivity : float or array
        From :func:`sensitivity`.
    uniform : bool
        Whether the angles are spread evenly; otherwise the best two share the time.
    gyros : int
        In-plane gyros used; two at right angles reach the best bound at any opposite angles.
    """
    best = noise_density / np.sqrt(total_time) / (EARTH_RATE * np.asarray(table_sensitivity))
    return best * math.sqrt(2) if uniform and gyros == 1 else best


def flicker_covariance(schedule, bias_instability):
    """Return the covariance of the means of 1/f noise over a schedule's intervals, up to a constant.

    ``-B^2/pi`` times the mean of ``ln abs(t - s)`` over each pair of intervals. Only weights that add up to
    nothing have a variance under it; the constant is such that the matrix is positive definite.

    Parameters
    ----------
    schedule : alignment.sequences.Schedule
    bias_instability : float
        Floor of the Allan deviation.

    Returns
    -------
    (K, K) float64
    """
    # In units of the whole time, in which the logarithm's kernel is positive definite.
    span = schedule.end[-1] - schedule.start[0]
    start, end = schedule.start / span, schedule.end / span
    total = (_log_integral(end[:, None] - start) + _log_integral(start[:, None] - end)
             - _log_integral(end[:, None] - end) - _log_integral(start[:, None] - start))
    strength = bias_instability / _ALLAN_FLOOR
    return -strength ** 2 / math.pi * total / np.outer(end - start, end - start)


def noise_covariance(schedule, noise_density, bias_instability=0.0):
    """Return the covariance of a channel's mean readings, white and 1/f noise together, (K, K)."""
    covariance = np.diag(noise_density ** 2 / schedule.duration)
    if bias_instability > 0:
        covariance += flicker_covariance(schedule, bias_instability)
    return covariance


def turning_noise_density(noise_density, bias_instability, rate, turns=math.inf, both_ways=False):
    """Return the density of the noise that a steadily turning table lets into the heading.

    Turning moves the Earth rate to the frequency of the turn, where 1/f noise has this much left. A fit of few turns
    lets other frequencies in, too: at most as much as allowed for here (exact covariances of fits of one turn to
    eight, in test_rotation).

    Parameters
    ----------
    noise_density : float, rad/s/sqrt(Hz)
    bias_instability : float, rad/s
    rate : float, rad/s
        Of the table, not zero.
    turns : float
        That have been made.
    both_ways : bool
        Whether the response to the rate is fitted, too.
    """
    # Density B^2 / (2 pi f) at f = rate / (2 pi).
    leak = 1.0 + (_LEAK_BOTH_WAYS if both_ways else _LEAK_ONE_WAY) / math.sqrt(turns)
    return math.sqrt(noise_density ** 2 + leak * (bias_instability / _ALLAN_FLOOR) ** 2 / abs(rate))


def predicted_heading_std(schedule, noise_density, bias_instability, roll, pitch, heading, latitude):
    """Return the heading's standard deviation expected of one x gyro on a schedule, rad.

    The readings are fitted with weights by their white noise, as :mod:`alignment.harmonic` does, and the
    heading is read off the in-plane Earth rate, all priors exact.
    """
    cosine, sine = np.cos(schedule.angle), np.sin(schedule.angle)
    design = np.stack([np.ones_like(cosine), cosine, sine], axis=1)
    weighted = design * schedule.duration[:, None]
    gain = np.linalg.solve(design.T @ weighted, weighted.T)
    slope = heading_slope_t(roll, pitch, heading, latitude)[:2] * EARTH_RATE
    white = np.linalg.inv(design.T @ weighted)[1:, 1:]
    towards_heading = np.linalg.solve(white, slope)
    weights = towards_heading @ gain[1:] / (towards_heading @ slope)
    return math.sqrt(weights @ noise_covariance(schedule, noise_density, bias_instability) @ weights)


def _log_integral(t):
    """Return the second integral of ln abs(t): t^2/2 ln abs(t) - 3/4 t^2."""
    size = np.abs(t)
    safe = np.where(size > 0, size, 1.0)
    return size ** 2 * (0.5 * np.log(safe) - 0.75)
