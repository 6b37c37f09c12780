"""Levelling 1 to 5 and azimuth 1a to 6: exact, with the paper's errors, degenerate, and their covariance."""

import numpy as np
import pytest

from alignment import azimuth, levelling
from alignment.errors import NotEnoughDataError
from alignment.results import UNBELIEVABLE, Quality, wrap_angle
from alignment.sequences import FOUR_POSITIONS, single_pass
from alignment.turntable import (
    TriadErrors,
    Turntable,
    earth_direction_t,
    exact_readings,
    simulate_readings,
)
from inertial.earth import EARTH_RATE, STANDARD_GRAVITY

EXACT = 1e-12  # rad, ideal sensors away from flagged geometry
EXACT_5 = 1e-11  # rad; azimuth 5 goes through a quadratic
PRINTED_DEG = 6e-5  # half the last digit of the figures, deg
DEG = np.pi / 180
ARCSECOND = DEG / 3600
PAPER = Turntable(roll=50 * DEG, pitch=30 * DEG, heading=88 * DEG, latitude=35 * DEG)
ANGLE_2 = 40 * DEG


def _attitudes(count=1000):
    """Return random attitudes within 60 deg of level and latitudes to 60 deg."""
    rng = np.random.default_rng(3)
    roll, pitch, latitude = rng.uniform(-60, 60, (3, count)) * DEG
    return roll, pitch, rng.uniform(-np.pi, np.pi, count), latitude


def _in_plane_rates(roll, pitch, heading, latitude):
    """Return the exact rates at 0, 90, 180, 270 deg, along z, at ANGLE_2 and the largest, (..., 7)."""
    x, y, z = np.moveaxis(earth_direction_t(roll, pitch, heading, latitude), -1, 0)
    return EARTH_RATE * np.stack(
        [x, y, -x, -y, z, x * np.cos(ANGLE_2) + y * np.sin(ANGLE_2), np.hypot(x, y)], axis=-1)


COLUMNS = {"0": 0, "90": 1, "180": 2, "270": 3, "tipped": 4, "any": 5, "maximum": 6}


def _readings_of(method, rates):
    return rates[..., [COLUMNS[position] for position in azimuth.METHODS[method].positions]]


@pytest.mark.parametrize("method", azimuth.METHODS)
def test_azimuth_is_exact_with_ideal_sensors(method):
    roll, pitch, heading, latitude = _attitudes()
    rate = _readings_of(method, _in_plane_rates(roll, pitch, heading, latitude))
    result = azimuth.find_azimuth(method, rate, roll, pitch, latitude, angle=ANGLE_2, hint=heading)
    good = result.quality == 0
    assert good.mean() > 0.4  # azimuth 3 is weak in half of them
    limit = EXACT_5 if method == "azimuth_5" else EXACT
    assert np.abs(wrap_angle(result.heading - heading))[good].max() < limit


@pytest.mark.parametrize("method", ["azimuth_4", "azimuth_5", "azimuth_6"])
def test_bias_and_scale_are_found_and_do_not_move_the_heading(method):
    rates = _in_plane_rates(PAPER.roll, PAPER.pitch, PAPER.heading, PAPER.latitude)
    rate = _readings_of(method, 1.00002 * rates + 4.848e-8)
    result = azimuth.find_azimuth(method, rate, PAPER.roll, PAPER.pitch, PAPER.latitude)
    assert result.flags == Quality(0)
    assert result.heading == pytest.approx(PAPER.heading, abs=EXACT_5)
    assert result.bias == pytest.approx(4.848e-8, abs=1e-18)
    assert result.scale == pytest.approx(1.00002, abs=1e-11)


def test_approximate_scale_factors_are_right_to_first_order():
    x, y = _in_plane_rates(PAPER.roll, PAPER.pitch, PAPER.heading, PAPER.latitude)[:2] / EARTH_RATE
    for error in (20e-6, 1e-3):
        scale = 1 + error
        five = azimuth.approximate_scale_5(scale * x, scale * y, PAPER.roll, PAPER.pitch, PAPER.latitude)
        for found in (five, levelling.approximate_scale(scale)):
            assert 0 < abs(found - scale) < error ** 2


def test_azimuth_6_finds_the_latitude_too():
    rates = _in_plane_rates(PAPER.roll, PAPER.pitch, PAPER.heading, PAPER.latitude)
    result = azimuth.find_azimuth("azimuth_6", rates[:5][[0, 1, 2, 4]], PAPER.roll, PAPER.pitch, 0.1,
                                  shared_channel=True)
    assert result.latitude == pytest.approx(PAPER.latitude, abs=EXACT)
    assert result.flags == Quality.SHARED_CHANNEL


@pytest.fixture(scope="module")
def paper_readings():
    """Readings with the paper's bias, scale factor and misalignment, and no noise."""
    g = STANDARD_GRAVITY
    gyro = TriadErrors(bias=(0.01 * ARCSECOND,) * 3, scale=(20e-6,) * 3, misalignment=5 * ARCSECOND)
    accel = TriadErrors(bias=(1e-4 * g,) * 3, scale=(50e-6,) * 3, misalignment=10 * ARCSECOND)
    return simulate_readings(PAPER, single_pass(4.0), gyro, accel, np.random.default_rng(0)), gyro


def test_levelling_with_the_papers_errors(paper_readings):
    accel_b = paper_readings[0].accel_b
    x, y = accel_b[:, 0], accel_b[:, 1]
    for result in (levelling.levelling_1(x), levelling.levelling_2(FOUR_POSITIONS, x)):
        assert np.degrees([result.roll, result.pitch]) == pytest.approx([50.0056, 29.9995], abs=PRINTED_DEG)
    for result in (levelling.levelling_3(y), levelling.levelling_4(FOUR_POSITIONS, y)):
        assert np.degrees([result.roll, result.pitch]) == pytest.approx([50.0035, 30.0038], abs=PRINTED_DEG)
    fifth = levelling.levelling_5(x, accel_b[0, 2], shared_channel=True)
    assert fifth.bias / STANDARD_GRAVITY == pytest.approx(73.0e-6, abs=0.05e-6)
    assert fifth.scale == pytest.approx(1.0000394, abs=5e-8)
    assert fifth.flags == Quality.SHARED_CHANNEL


@pytest.mark.parametrize("method, expected_deg", [
    ("azimuth_1a", 88.0013), ("azimuth_1b", 88.0044), ("azimuth_3", 88.4877), ("azimuth_4", 88.0017),
    ("azimuth_5", 88.0017)])
def test_azimuth_with_the_papers_errors(paper_readings, method, expected_deg):
    readings, gyro = paper_readings
    largest = azimuth.angle_of_maximum(PAPER.roll, PAPER.pitch, PAPER.heading, PAPER.latitude)
    at_largest = exact_readings(PAPER, largest).gyro_b @ gyro.matrix.T + gyro.bias
    rates = np.concatenate([readings.gyro_b[:, 0], readings.gyro_b[:1, 2], [0.0, at_largest[0]]])
    result = azimuth.find_azimuth(method, _readings_of(method, rates), PAPER.roll, PAPER.pitch,
                                  PAPER.latitude, hint=PAPER.heading)
    assert np.degrees(result.heading) == pytest.approx(expected_deg, abs=PRINTED_DEG)


def test_gyro_errors_found_with_the_papers_errors(paper_readings):
    rates = np.concatenate([paper_readings[0].gyro_b[:, 0], paper_readings[0].gyro_b[:1, 2]])
    for method, scale in (("azimuth_4", 1.0000175), ("azimuth_5", 1.0000175), ("azimuth_6", 1.0000131)):
        result = azimuth.find_azimuth(method, _readings_of(method, rates), PAPER.roll, PAPER.pitch,
                                      PAPER.latitude)
        assert result.bias == pytest.approx(4.904e-8, abs=5e-12)
        assert result.scale == pytest.approx(scale, abs=5e-8)


def test_levelling_is_exact_with_ideal_sensors_lever_arm_and_turning():
    table = Turntable(roll=0.7, pitch=-0.4, heading=1.0, latitude=0.6)
    accel_b = exact_readings(table, FOUR_POSITIONS).accel_b
    x, y, z = accel_b.T
    for result in (levelling.levelling_1(x), levelling.levelling_2(FOUR_POSITIONS, x),
                   levelling.levelling_3(y), levelling.levelling_4(FOUR_POSITIONS, y),
                   levelling.levelling_5(x, z[0])):
        assert [result.roll, result.pitch] == pytest.approx([0.7, -0.4], abs=EXACT)
        assert result.flags == Quality(0)
    arm = Turntable(roll=0.7, pitch=-0.4, lever_arm=0.3)
    speeding_up = np.array([0.1, 0.4, 0.2, 0.0])
    y = exact_readings(arm, FOUR_POSITIONS, acceleration=speeding_up).accel_b[:, 1]
    result = levelling.levelling_4(FOUR_POSITIONS, y, lever_acceleration=0.3 * speeding_up)
    assert [result.roll, result.pitch] == pytest.approx([0.7, -0.4], abs=EXACT)


def test_levelling_5_finds_roll_over_the_whole_circle_whatever_gravity():
    for roll in (-3.0, -1.6, 0.1, 2.5):
        x, _, z = exact_readings(Turntable(roll=roll, pitch=0.5, gravity=9.7), FOUR_POSITIONS).accel_b.T
        result = levelling.levelling_5(1.001 * x + 0.02, 1.001 * z[0] + 0.02)
        assert [result.roll, result.pitch] == pytest.approx([roll, 0.5], abs=EXACT)


@pytest.mark.parametrize("method, roll, pitch, heading, latitude, flag", [
    ("azimuth_1a", 0, 0, 0, 35, Quality.SINGULAR), ("azimuth_1a", 0, 0, 180, 35, Quality.SINGULAR),
    ("azimuth_1a", 0, 90, 40, 35, Quality.SINGULAR), ("azimuth_1a", 0, 0, 5, 35, Quality.WEAK),
    ("azimuth_1b", 0, 0, 90, 35, Quality.SINGULAR), ("azimuth_1b", 0, 0, -90, 35, Quality.SINGULAR),
    ("azimuth_3", 0, 0, 40, 35, Quality.SINGULAR), ("azimuth_5", 0, 90, 40, 35, Quality.SINGULAR),
    ("azimuth_4", 90, 0, 0, 0, Quality.SINGULAR), ("azimuth_4", 0, 0, 40, 89.99, Quality.SINGULAR),
    ("azimuth_6", 0, 0, 40, 82, Quality.WEAK)])
def test_degenerate_geometry_is_flagged(method, roll, pitch, heading, latitude, flag):
    roll, pitch, heading, latitude = np.radians([roll, pitch, heading, latitude])
    rate = _readings_of(method, _in_plane_rates(roll, pitch, heading, latitude))
    result = azimuth.find_azimuth(method, rate, roll, pitch, latitude, hint=heading)
    assert flag in result.flags
    assert np.isnan(result.heading) == (flag is Quality.SINGULAR)


def test_two_branches_without_a_compass_are_ambiguous():
    rate = _readings_of("azimuth_1a", _in_plane_rates(0.0, 0.0, 1.0, 0.6))
    assert Quality.AMBIGUOUS in azimuth.find_azimuth("azimuth_1a", rate, 0.0, 0.0, 0.6).flags
    with_compass = azimuth.find_azimuth("azimuth_1a", rate, 0.0, 0.0, 0.6, hint=-0.8)
    assert with_compass.flags == Quality(0)
    assert with_compass.heading == pytest.approx(-1.0, abs=EXACT)


def test_levelling_at_the_pole_of_pitch_is_refused():
    x = exact_readings(Turntable(roll=0.3, pitch=np.pi / 2), FOUR_POSITIONS).accel_b[:, 0]
    result = levelling.levelling_1(x)
    assert Quality.SINGULAR in result.flags
    assert np.isnan(result.roll)


def test_the_kernel_has_no_pole():
    for psi in (-3.0, 0.1, np.pi, 2.0):
        a, b = 1.0, -np.cos(psi)
        solutions = azimuth.solve_kernel(a, b, a * np.sin(psi) + b * np.cos(psi))
        assert np.abs(wrap_angle(solutions - psi)).min() < EXACT * 1e4  # at a double root half the digits


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="unknown azimuth method 'azimuth_7'.*azimuth_1a"):
        azimuth.find_azimuth("azimuth_7", [0.0], 0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match=r"azimuth_4 takes 3 readings, rate has shape \(2,\)"):
        azimuth.find_azimuth("azimuth_4", [0.0, 0.0], 0.0, 0.0, 0.0)
    with pytest.raises(NotEnoughDataError, match="tell 2 of 3 coefficients"):
        levelling.levelling_2([0.0, np.pi, 0.0], [1.0, 2.0, 1.0])


FEWEST_GIVEN = 0.4  # share of headings round the circle that a form must still give
FORMS_SQUARE = (0.5, 1.4)  # of z: a second-order variance is cautious, a bent equation not normal
FORMS_BEYOND = 0.01  # share beyond 4 sigma
COVARIANCE_TRIALS = 4000
COVARIANCE_RATIO = 0.08  # 3.5 deviations of a sample variance from 4000 trials


@pytest.mark.parametrize("method", azimuth.METHODS)
def test_azimuth_covariance_is_that_of_a_monte_carlo(method):
    rng = np.random.default_rng(4)
    rate = _readings_of(method, _in_plane_rates(PAPER.roll, PAPER.pitch, PAPER.heading, PAPER.latitude))
    rate_covariance = np.diag(np.full(len(rate), (2e-4 * EARTH_RATE) ** 2))
    level_covariance = np.array([[4e-8, 1e-8], [1e-8, 2e-8]])
    noise = rng.multivariate_normal(np.zeros(len(rate)), rate_covariance, COVARIANCE_TRIALS)
    tilt = rng.multivariate_normal([0, 0], level_covariance, COVARIANCE_TRIALS)
    latitude = PAPER.latitude + 1e-4 * rng.standard_normal(COVARIANCE_TRIALS)
    stated = azimuth.find_azimuth(method, rate, PAPER.roll, PAPER.pitch, PAPER.latitude, angle=ANGLE_2,
                                  rate_covariance=rate_covariance, level_covariance=level_covariance,
                                  latitude_std=1e-4, hint=PAPER.heading).variance
    trials = azimuth.find_azimuth(method, rate + noise, PAPER.roll + tilt[:, 0], PAPER.pitch + tilt[:, 1],
                                  latitude, angle=ANGLE_2, hint=np.full(COVARIANCE_TRIALS, PAPER.heading))
    assert np.mean((trials.heading - PAPER.heading) ** 2) / stated == pytest.approx(1.0, abs=COVARIANCE_RATIO)


@pytest.mark.parametrize("number", [1, 2, 3, 4, 5])
def test_levelling_covariance_is_that_of_a_monte_carlo(number):
    rng = np.random.default_rng(5)
    x, y, z = exact_readings(PAPER, FOUR_POSITIONS).accel_b.T
    covariance = np.diag([1.0, 2.0, 3.0, 4.0]) * 1e-6

    def level(noise):
        if number == 5:
            return levelling.levelling_5(x[:3] + noise[..., :3], z[0] + noise[..., 3], covariance=covariance)
        readings = (x if number < 3 else y) + noise
        method = getattr(levelling, f"levelling_{number}")
        arguments = (readings,) if number in (1, 3) else (FOUR_POSITIONS, readings)
        return method(*arguments, covariance=covariance)
    stated = level(np.zeros(4)).covariance
    trials = level(rng.multivariate_normal(np.zeros(4), covariance, COVARIANCE_TRIALS))
    found = np.cov(trials.roll, trials.pitch)
    assert np.diag(found) / np.diag(stated) == pytest.approx(1.0, abs=COVARIANCE_RATIO)
    limit = COVARIANCE_RATIO * np.sqrt(stated[0, 0] * stated[1, 1])
    assert found[0, 1] == pytest.approx(stated[0, 1], abs=limit)


@pytest.mark.parametrize("method", azimuth.METHODS)
@pytest.mark.parametrize("noise", [0.003, 0.03])
def test_what_noise_leaves_of_a_closed_form_is_as_good_as_it_says_or_is_flagged(method, noise):
    """Where equations bend or lose their solution within the noise, first order alone is far too sure."""
    rng = np.random.default_rng(1)
    heading = rng.uniform(-np.pi, np.pi, 2000)
    roll, pitch, latitude = 50 * DEG, 30 * DEG, 35 * DEG
    columns = [COLUMNS[place] for place in azimuth.find_method(method).positions]
    rate = _in_plane_rates(roll, pitch, heading, latitude)[..., columns]
    rate = rate + noise * EARTH_RATE * rng.standard_normal(rate.shape)
    result = azimuth.find_azimuth(method, rate, roll, pitch, latitude, angle=ANGLE_2, hint=heading,
                                  rate_covariance=(noise * EARTH_RATE) ** 2 * np.eye(len(columns)))
    good = result.quality & UNBELIEVABLE.value == 0
    z = wrap_angle(result.heading - heading)[good] / result.std[good]
    assert good.mean() > FEWEST_GIVEN
    assert FORMS_SQUARE[0] < np.mean(z ** 2) < FORMS_SQUARE[1] and np.mean(np.abs(z) > 4.0) < FORMS_BEYOND
