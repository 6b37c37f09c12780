"""How much older an altitude is than its stamp, found from a recording.

The filter runs with each of some delays. What it expects of the next altitude is then off by the altimeter's noise
and, where the delay is wrong, by the climb in between: the delay under which the innovations are most likely is
the altimeter's. A parabola through the log likelihood about its top gives it, and its curvature the spread.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from attitude_estimator.estimator import AttitudeEstimator

_COARSE = np.arange(-0.2, 1.01, 0.1)
_FINE = 0.02 * np.arange(-5, 6)  # s about the best of the coarse ones
_SETTLED_NS = 10_000_000_000  # before it the filter finds its height
_FEWEST = 100  # innovations
_OUTLIER = 5.0  # spreads
# What the model leaves out makes innovations alike for a while: each counts for so many less.
_CORRELATION = 6.0
# The filter looks back by the velocity alone: with the acceleration left out, a longer delay is found less well.
_MODEL_SHARE = 0.1
_LARGEST_STD = 0.05  # s without that share, beyond which the recording does not show it


@dataclass(frozen=True)
class DelayFit:
    """Delay of an altimeter and its standard deviation, s."""

    delay: float
    std: float


def fit_delay(imu, altitude, params, actions=None):
    """Return the delay of the altimeter in a recording.

    Parameters
    ----------
    imu : inertial.recording.ImuSeries
    altitude : inertial.recording.AltitudeSeries
    params : AttitudeParams
        ``altitude_delay`` is what is looked for.
    actions : (N,) int, optional
        As of :meth:`AttitudeEstimator.run`.

    Returns
    -------
    DelayFit

    Raises
    ------
    ValueError
        The recording does not show it: too few altitudes, or too little climbing and sinking.
    """
    def likelihood(delay):
        told = dataclasses.replace(params, altitude_delay=float(delay), altitude_delay_std=0.0)
        return _log_likelihood(imu, altitude, told, actions)

    coarse = [likelihood(delay) for delay in _COARSE]
    delays = _COARSE[int(np.argmax(coarse))] + _FINE
    delays = delays[(delays >= -1.0) & (delays <= 2.0)]
    curve = np.array([likelihood(delay) for delay in delays])
    middle = delays[int(np.argmax(curve))]
    bend, slope, _ = np.polyfit(delays - middle, curve, 2)
    if not bend < 0.0 or (std := math.sqrt(-0.5 * _CORRELATION / bend)) > _LARGEST_STD:
        raise ValueError("the recording does not show the altimeter's delay: too little climbing and sinking")
    delay = float(middle - 0.5 * slope / bend)
    return DelayFit(delay, math.hypot(std, _MODEL_SHARE * delay))


def _log_likelihood(imu, altitude, params, actions):
    """Return the log likelihood of the innovations of altitudes, their variance being what they show."""
    estimates, _ = AttitudeEstimator(params).run(imu, altitude, actions=actions)
    before = np.searchsorted(estimates.stamp_ns, altitude.stamp_ns) - 1
    known = (before >= 0) & np.isfinite(altitude.altitude)
    known &= altitude.stamp_ns - estimates.stamp_ns[0] > _SETTLED_NS
    known[known] &= estimates.valid[before[known]]
    before, stamp_ns, measured = before[known], altitude.stamp_ns[known], altitude.altitude[known]
    if len(before) < _FEWEST:
        raise ValueError(f"{len(before)} altitudes with a known attitude: the delay needs {_FEWEST} or more")
    ahead = (stamp_ns - estimates.stamp_ns[before]) * 1e-9 - params.altitude_delay
    innovation = measured - (estimates.altitude[before] - ahead * estimates.vd[before])
    limit = _OUTLIER * 1.483 * np.median(np.abs(innovation))
    return -0.5 * len(innovation) * math.log(np.mean(np.minimum(innovation ** 2, limit ** 2)))
