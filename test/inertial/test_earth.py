"""Gravity, Earth rate and radii against published values; pressure altitude against ISA tables."""

import numpy as np
import pytest

from inertial import atmosphere, earth

TR8350_GRAVITY = 1e-9  # m/s^2, digits of TR8350.2's table
RADIUS = 1e-3  # m, digits of the published radii
ISA_PRESSURE = 0.5  # Pa, digits of the ISO 2533 table
ROUND_TRIP = 1e-8  # m


def test_normal_gravity_at_equator_and_pole():
    assert earth.normal_gravity(0.0) == pytest.approx(9.7803253359, abs=TR8350_GRAVITY)
    assert earth.normal_gravity(np.pi / 2) == pytest.approx(9.8321849378, abs=TR8350_GRAVITY)


def test_gravity_falls_with_height_as_the_free_air_gradient():
    drop = earth.normal_gravity(np.pi / 4) - earth.normal_gravity(np.pi / 4, 1000.0)
    assert drop == pytest.approx(3.086e-3, rel=1e-3)


def test_earth_rate_points_north_at_the_equator_and_up_at_the_pole():
    rate_n = earth.earth_rate_n([0.0, np.pi / 2])
    expected = earth.EARTH_RATE * np.array([[1.0, 0, 0], [0, 0, -1.0]])
    assert rate_n == pytest.approx(expected, abs=1e-20)


def test_radii_of_curvature_at_equator_and_pole():
    meridian, transverse = earth.radii_of_curvature(np.array([0.0, np.pi / 2]))
    assert meridian == pytest.approx([6335439.327, 6399593.626], abs=RADIUS)
    assert transverse == pytest.approx([6378137.0, 6399593.626], abs=RADIUS)


def test_transport_rate_going_north_pitches_down_and_going_east_rolls():
    north = earth.transport_rate_n(0.0, 0.0, [100.0, 0.0, 0.0])
    east = earth.transport_rate_n(np.pi / 4, 0.0, [0.0, 100.0, 0.0])
    assert north == pytest.approx([0.0, -100.0 / 6335439.327, 0.0], rel=1e-9)
    assert east[0] == pytest.approx(-east[2])
    assert east[0] > 0


@pytest.mark.parametrize("altitude, pressure_pa", [
    (-500.0, 107478.0), (0.0, 101325.0), (1000.0, 89874.6), (5000.0, 54019.9), (11000.0, 22632.0)])
def test_standard_atmosphere(altitude, pressure_pa):
    assert atmosphere.pressure_from_altitude(altitude) == pytest.approx(pressure_pa, abs=ISA_PRESSURE)
    exact = atmosphere.pressure_from_altitude(altitude)
    assert atmosphere.altitude_from_pressure(exact) == pytest.approx(altitude, abs=ROUND_TRIP)


def test_altitude_is_zero_at_the_reference():
    assert atmosphere.altitude_from_pressure(np.array([95000.0]), 95000.0) == pytest.approx([0.0])


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_impossible_pressure_is_refused_by_name(bad):
    with pytest.raises(ValueError, match=r"pressure_pa = .* Pa"):
        atmosphere.altitude_from_pressure(bad)
    with pytest.raises(ValueError, match=r"reference = .* Pa"):
        atmosphere.altitude_from_pressure(101325.0, bad)
