"""Altitude from whichever altimeter there is: a PointStamped's z, or air pressure.

Pressure becomes altitude through the standard atmosphere, counted from the first sample, because the
weather shifts pressure altitude by hundreds of metres and only its changes are of use here. A value that
cannot be a pressure in pascal is refused with the unit that it looks like; feet for metres cannot be told.
"""

import math
from typing import NamedTuple

from inertial.atmosphere import altitude_from_pressure
from nav_ros.messages import POINT, PRESSURE, RefusedMessageError

PRESSURE_RANGE = (2_000.0, 120_000.0)
"""Pa; what an air vehicle can meet, from 26 km to some 1400 m below the sea."""

_UNITS = ((200.0, 1_200.0, "hPa (mbar)", 100.0), (20.0, 120.0, "kPa", 1_000.0),
          (12.0, 16.0, "psi", 6_894.757), (0.2, 1.2, "bar", 100_000.0))


class AltitudeRefusedError(RefusedMessageError):
    """Raised for a sample that says nothing about the altitude."""


class Altitude(NamedTuple):
    """Metres up, and the variance in m^2 that the message gives, NaN where it gives none."""

    altitude: float
    variance: float


class AltitudeSource:
    """Turns the values of one altimeter topic into altitudes.

    Parameters
    ----------
    message_type : str
        :data:`~nav_ros.messages.POINT` or :data:`~nav_ros.messages.PRESSURE`.
    """

    def __init__(self, message_type):
        self._convert = {POINT: _altitude_of_point, PRESSURE: self._altitude_of_pressure}[message_type]
        self._first = None

    def convert(self, values):
        """Return the :class:`Altitude` of one message.

        Parameters
        ----------
        values : sequence of float
            The doubles of the message: x, y, z (m) or pressure (Pa) and its variance (Pa^2).

        Raises
        ------
        AltitudeRefusedError
            The value is not finite, not positive or in another unit.
        """
        return self._convert(values)

    def reset(self):
        """Count pressure altitude from the next sample."""
        self._first = None

    def _altitude_of_pressure(self, values):
        pressure, variance = values
        _check_pressure(pressure)
        altitude = float(altitude_from_pressure(pressure))
        if self._first is None:
            self._first = altitude
        if not 0.0 < variance < math.inf:
            return Altitude(altitude - self._first, math.nan)
        slope = float(altitude_from_pressure(pressure - 0.5) - altitude_from_pressure(pressure + 0.5))
        return Altitude(altitude - self._first, slope * slope * variance)


def _altitude_of_point(values):
    if not math.isfinite(values[2]):
        raise AltitudeRefusedError("altitude_not_finite", f"altitude {values[2]} m is not finite")
    return Altitude(values[2], math.nan)


def _check_pressure(pressure):
    if not math.isfinite(pressure):
        raise AltitudeRefusedError("pressure_not_finite", f"pressure {pressure} Pa is not finite")
    if pressure <= 0.0:
        raise AltitudeRefusedError("pressure_not_positive", f"pressure {pressure:g} Pa is not positive")
    low, high = PRESSURE_RANGE
    if low <= pressure <= high:
        return
    reason = f"pressure {pressure:g} Pa is outside {low:g} to {high:g} Pa"
    for least, most, unit, factor in _UNITS:
        if least <= pressure <= most:
            reason += f"; it looks like {unit}, and FluidPressure is in Pa: multiply by {factor:g}"
            break
    raise AltitudeRefusedError("pressure_unit", reason)
