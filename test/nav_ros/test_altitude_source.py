"""Altitude from points and pressures, and the samples that are refused."""

import math

import numpy as np
import pytest

from inertial.atmosphere import pressure_from_altitude
from nav_ros.altitude_source import AltitudeRefusedError, AltitudeSource
from nav_ros.messages import POINT, PRESSURE

ROUNDING = 1e-6
"""Metres: a pressure in double precision resolves far less."""


def test_a_point_gives_its_z():
    altitude, variance = AltitudeSource(POINT).convert((1.0, 2.0, -3.5))
    assert altitude == -3.5 and math.isnan(variance)


def test_pressure_altitude_counts_from_the_first_sample():
    source = AltitudeSource(PRESSURE)
    heights = np.array([500.0, 500.0, 520.0, 1500.0])
    altitudes = [source.convert((float(p), 0.0)).altitude for p in pressure_from_altitude(heights)]
    np.testing.assert_allclose(altitudes, heights - 500.0, atol=ROUNDING)
    source.reset()
    assert source.convert((95000.0, 0.0)).altitude == 0.0


def test_variance_of_pressure_becomes_one_of_altitude():
    metres_per_pascal = 287.05287 * 288.15 / (9.80665 * 101325.0)
    variance = AltitudeSource(PRESSURE).convert((101325.0, 9.0)).variance
    assert math.sqrt(variance) == pytest.approx(3.0 * metres_per_pascal, rel=1e-6)


@pytest.mark.parametrize("variance", [0.0, -1.0, math.nan, math.inf])
def test_an_unknown_variance_is_not_a_number(variance):
    assert math.isnan(AltitudeSource(PRESSURE).convert((101325.0, variance)).variance)


@pytest.mark.parametrize("pressure, unit", [(1013.25, "hPa"), (550.0, "hPa"), (101.3, "kPa"), (14.7, "psi"),
                                            (1.013, "bar")])
def test_a_wrong_unit_is_named(pressure, unit):
    with pytest.raises(AltitudeRefusedError, match=f"looks like {unit}") as refused:
        AltitudeSource(PRESSURE).convert((pressure, 0.0))
    assert refused.value.fault == "pressure_unit"


@pytest.mark.parametrize("message_type, values, fault", [
    (POINT, (0.0, 0.0, math.nan), "altitude_not_finite"),
    (POINT, (0.0, 0.0, -math.inf), "altitude_not_finite"),
    (PRESSURE, (math.nan, 0.0), "pressure_not_finite"),
    (PRESSURE, (0.0, 0.0), "pressure_not_positive"),
    (PRESSURE, (-5.0, 0.0), "pressure_not_positive"),
    (PRESSURE, (1e6, 0.0), "pressure_unit"),
    (PRESSURE, (5.0, 0.0), "pressure_unit")])
def test_a_refusal_names_its_fault(message_type, values, fault):
    with pytest.raises(AltitudeRefusedError) as refused:
        AltitudeSource(message_type).convert(values)
    assert refused.value.fault == fault


def test_a_refused_first_sample_does_not_become_the_reference():
    source = AltitudeSource(PRESSURE)
    with pytest.raises(AltitudeRefusedError):
        source.convert((1013.25, 0.0))
    assert source.convert((101325.0, 0.0)).altitude == 0.0
