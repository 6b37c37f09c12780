"""Why a heading must not be believed, in words that say what to do."""

import math

import numpy as np

from alignment.north import LARGEST_SCATTER, explain_scale
from alignment.results import UNBELIEVABLE, Quality
from alignment.turntable import earth_direction_t
from inertial.earth import EARTH_RATE

_LEVEL_TILT = math.radians(20.0)  # within, the gyros' in-plane rate is that of the latitude
_CLEARLY = 5.0  # times the other gyros' biases, from which that of z is no bias
_NOISIER = 2.0  # times the noise that was stated, from which that explains what scatters more
_RATHER = 3.0  # times smaller with the other sign of the latitude


def explain_level(level):
    """Return what is wrong with a level, or an empty string."""
    if level.flags & Quality.SCALE:
        return f"the accelerometers read {explain_scale(float(level.scale))}"
    if level.flags & Quality.INCONSISTENT:
        return "the x and y accelerometers tell different tilts: do they turn as the joint's angle says?"
    return ""


def explain_heading(north, level, latitude, one_way=False, noise_ratio=math.nan):
    """Return why a heading must not be believed, or an empty string.

    Parameters
    ----------
    north : alignment.results.HeadingResult
    level : alignment.results.LevelResult
    latitude : float, rad
    one_way : bool
        Whether the table turned steadily one way only.
    noise_ratio : float
        White noise that the gyros' samples show over what was stated; NaN where that is not known.
    """
    flags = north.flags & UNBELIEVABLE
    reasons = []
    if flags & Quality.SINGULAR:
        reasons.append("this geometry carries no information about the heading")
    if flags & Quality.AMBIGUOUS:
        other = math.degrees(float(north.branches[1])) % 360 if len(north.branches) > 1 else math.nan
        reasons.append(f"another heading fits as well ({other:.1f} deg): go on" if math.isfinite(other) else
                       f"sigma is {math.degrees(float(north.std)):.3g} deg: go on")
    if flags & Quality.SCALE:
        reasons.append(f"the gyros read {explain_scale(float(north.scale))}")
    elif flags & Quality.INCONSISTENT:
        reasons.append(_explain_misfit(north, level, latitude, one_way, noise_ratio))
    return "; ".join(reasons)


def _explain_misfit(north, level, latitude, one_way, noise_ratio):
    if north.scatter > LARGEST_SCATTER:
        told = f"the gyros scatter {float(north.scatter):.3g} times as much as stated"
        if noise_ratio > _NOISIER:
            return f"{told}: gyro noise is {noise_ratio:.3g} times what gyro_noise_density says"
        culprits = "gyro_noise_density or gyro_bias_instability"
        if noise_ratio <= _NOISIER:
            told, culprits = f"{told}, their samples do not", "gyro_bias_instability"
        return f"{told}: the table or the IMU on it moves, or {culprits} is too small"
    scale = float(north.scale)
    told = (f"the gyros do not fit the Earth's rate (chi2 {float(north.chi2):.3g}, {scale:.4f} times its size): "
            "more noise, scale_std or skew_std than stated")
    as_at = scale * math.cos(latitude)
    if max(abs(float(level.roll)), abs(float(level.pitch))) < _LEVEL_TILT and as_at < 1.0:
        told += f", or the latitude is wrong: they read as at {math.degrees(math.acos(as_at)):.2f} deg"
    return told + "; turn the table both ways" * one_way


def sign_matters(level, heading_std, latitude):
    """Whether the sign of the latitude would turn the heading on this level by more than its deviation."""
    return 2 * math.hypot(float(level.roll), float(level.pitch)) * abs(math.tan(latitude)) > heading_std


def doubt_latitude(gyro_bias, level, heading, latitude):
    """Return a doubt about the sign of the latitude, or an empty string.

    On a level table only the z gyro, whose bias is not known, sees that sign.

    Parameters
    ----------
    gyro_bias : (3,) float64, rad/s
        That of z is what its mean reading leaves beside the Earth's rate.
    level : alignment.results.LevelResult
    heading, latitude : float, rad
    """
    here, there = (EARTH_RATE * earth_direction_t(level.roll, level.pitch, heading, sign * latitude)[2]
                   for sign in (1, -1))
    usual, left, other = np.abs(gyro_bias[:2]).max(), abs(gyro_bias[2]), abs(gyro_bias[2] + here - there)
    if left > _CLEARLY * usual and left > _RATHER * other:
        return (f"the z gyro reads the Earth's rate as at latitude {-math.degrees(latitude):.1f} deg: "
                "is the sign of the latitude right? It matters to a table that is not level")
    return ""
