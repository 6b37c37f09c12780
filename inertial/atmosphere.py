"""Pressure altitude: the hypsometric equation of the international standard atmosphere.

The troposphere's equation (ISO 2533:1975, constant lapse rate), which holds to 11 km; altitude is
geopotential metres above the level where the pressure is ``reference``. Everything is vectorised.
"""

import numpy as np

SEA_LEVEL_PRESSURE = 101325.0

_SEA_LEVEL_TEMPERATURE = 288.15
_LAPSE_RATE = 0.0065
_GAS_CONSTANT = 287.05287
_EXPONENT = _GAS_CONSTANT * _LAPSE_RATE / 9.80665
_SCALE = _SEA_LEVEL_TEMPERATURE / _LAPSE_RATE


def altitude_from_pressure(pressure_pa, reference=SEA_LEVEL_PRESSURE):
    """Return the altitude above the level of ``reference``, m, up.

    Parameters
    ----------
    pressure_pa, reference : float or array, Pa

    Raises
    ------
    ValueError
        A pressure is not positive and finite.
    """
    pressure_pa, reference = _checked("pressure_pa", pressure_pa), _checked("reference", reference)
    return _SCALE * (1.0 - (pressure_pa / reference) ** _EXPONENT)


def pressure_from_altitude(altitude, reference=SEA_LEVEL_PRESSURE):
    """Return the pressure, Pa, at ``altitude`` m above the level of ``reference`` Pa.

    Raises
    ------
    ValueError
        ``reference`` is not positive and finite.
    """
    ratio = 1.0 - np.asarray(altitude) / _SCALE
    return _checked("reference", reference) * ratio ** (1.0 / _EXPONENT)


def _checked(name, pressure):
    pressure = np.asarray(pressure, dtype=float)[()]
    if not np.all((pressure > 0) & np.isfinite(pressure)):
        raise ValueError(f"{name} = {pressure} Pa: must be positive and finite")
    return pressure
