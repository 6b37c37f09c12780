"""A table that turns steadily: sums over blocks against one fit of all, methods, disturbances, delay."""

import dataclasses
import math

import numpy as np
import pytest

from alignment.azimuth import METHODS
from alignment.bounds import noise_covariance, turning_noise_density
from alignment.errors import NotEnoughDataError
from alignment.harmonic import fit_harmonic
from alignment.params import AlignmentParams
from alignment.results import Quality, wrap_angle
from alignment.rotation import SteadyRotation
from alignment.sequences import continuous_rotation
from alignment.turntable import TriadErrors, Turntable, exact_readings, simulate_readings

DEG = math.pi / 180
LATITUDE = 35 * DEG
NOISE = TriadErrors(bias=(3e-5, -2e-5, 1e-5), noise_density=0.003 * DEG / 60)
FORCE_NOISE = TriadErrors(bias=(0.01, -0.02, 0.005), noise_density=1e-4)
PARAMS = AlignmentParams(
    latitude=LATITUDE, gyro_noise_density=NOISE.noise_density, gyro_bias_instability=0.01 * DEG / 3600, scale_std=2e-5,
    skew_std=2e-5, gravity=9.80665, accel_noise_density=1e-4, accel_scale_std=1e-4)
SIGMAS = 4.5  # a good estimate is outside once in 150 000
LEAST_OF_STATED = 0.7  # of a sigma: half a turn each way, where it is the most cautious
SAME = 1e-9  # of a heading's deviation: rounding
TABLE = Turntable(20 * DEG, -15 * DEG, 140 * DEG, LATITUDE)


def _turned(both_ways=True, seconds=300.0, seed=7, table=TABLE, noise=NOISE):
    """Return time, angle, gyro_b and accel_b of a table that turns at 6 deg/s."""
    schedule = continuous_rotation(6 * DEG, seconds, 0.05, both_ways)
    readings = simulate_readings(table, schedule, noise, FORCE_NOISE, np.random.default_rng(seed))
    return schedule.end, schedule.angle, readings.gyro_b, readings.accel_b


def _rotation(samples, params=PARAMS, blocks=1):
    rotation = SteadyRotation(params)
    rotation.start(*samples)
    for block in zip(*(np.array_split(column, blocks) for column in samples), strict=True):
        rotation.add(*block)
    return rotation


def _error(result, table=TABLE):
    return abs(float(wrap_angle(result.north.heading - table.heading)))


@pytest.mark.parametrize("both_ways", [True, False])
def test_a_turning_table_is_aligned_from_its_samples(both_ways):
    result = _rotation(_turned(both_ways), blocks=20).result()
    assert result.believable
    assert _error(result) < SIGMAS * result.north.std
    assert result.north.std < 0.1 * DEG
    assert result.level.roll == pytest.approx(TABLE.roll, abs=1e-3)
    assert 0 < result.floor < result.north.std


@pytest.mark.parametrize("robust", [True, False])
def test_block_by_block_is_the_fit_of_all_samples(robust):
    samples = _turned()
    time, angle, gyro_b, accel_b = samples
    gyro_b[::20, 0] += 1e-3 * robust
    fits = _rotation(samples, dataclasses.replace(PARAMS, robust=robust), blocks=30).fits()
    rate = np.diff(angle, prepend=angle[0]) / 0.05
    columns = {"rate": rate[1:], "robust": False}
    kept = np.ones(len(time) - 1, dtype=bool)
    if robust:
        kept = ~((np.arange(1, len(time)) % 20) == 0)
    for fit, readings in zip(fits, (*gyro_b[:, :2].T, *accel_b.T), strict=True):
        columns["rate"] = rate[1:][kept]
        expected = fit_harmonic(angle[1:][kept], readings[1:][kept], 1.0, **columns)
        deviation = np.sqrt(np.diag(fit.covariance))
        # Of clean samples one in two million is left out as well.
        np.testing.assert_allclose((fit.coefficients - expected.coefficients) / deviation, 0.0, atol=1e-3 + SAME)


def test_the_stated_deviation_is_that_of_many_runs():
    normalised = []
    for seed in range(40):
        result = _rotation(_turned(seconds=120.0, seed=seed)).result()
        normalised.append(_error(result) / result.north.std)
    assert 0.5 < np.mean(np.square(normalised)) < 1.7  # chi-square of 40, 99.5 %


@pytest.mark.parametrize("both_ways", [True, False])
@pytest.mark.parametrize("turns", [1.0, 1.25, 1.5, 2.0, 3.0, 4.0, 8.0])
def test_few_turns_let_in_no_more_of_the_1_f_noise_than_is_counted(turns, both_ways):
    """The exact covariance of the fit, in its worst direction, against the density that the heading's sigma has."""
    rate, instability = 6 * DEG, 1.0 * DEG / 3600
    interval = 2 * math.pi / rate / 30
    schedule = continuous_rotation(rate, turns * 2 * math.pi / rate, interval, both_ways)
    columns = np.stack([np.ones_like(schedule.angle), np.cos(schedule.angle), np.sin(schedule.angle)]
                       + [schedule.rate] * both_ways, axis=1)
    normal = columns.T @ columns
    gain = np.linalg.solve(normal, columns.T)
    exact = (gain @ noise_covariance(schedule, 1e-9, instability) @ gain.T)[1:3, 1:3]
    stated = np.linalg.inv(normal)[1:3, 1:3] \
        * turning_noise_density(1e-9, instability, rate, turns, both_ways) ** 2 / interval
    worst = np.sqrt(np.linalg.eigvals(np.linalg.solve(stated, exact)).real.max())
    assert LEAST_OF_STATED < worst < 1.0


def test_every_closed_form_is_served_but_the_tipped_sensor():
    rotation = _rotation(_turned())
    headings, levels = rotation.compare_headings(), rotation.compare_levels()
    assert set(headings) == {"joint", *METHODS} - {"azimuth_6"}
    for name, north in headings.items():
        assert abs(wrap_angle(north.heading - TABLE.heading)) < SIGMAS * north.std, name
    assert set(levels) == {"joint", "levelling_1", "levelling_2", "levelling_3", "levelling_4"}
    for name, level in levels.items():
        assert abs(level.roll - TABLE.roll) < SIGMAS * np.sqrt(level.covariance[0, 0]), name


@pytest.mark.parametrize("both_ways, use_y, low_deg, high_deg, flags", [
    (True, False, 0.0, 0.001, Quality(0)), (False, False, 0.1, 1.0, Quality.INCONSISTENT),
    (True, True, 0.0, 0.001, Quality(0)), (False, True, 0.0, 0.001, Quality.INCONSISTENT)])
def test_wobble_cancels_by_turning_back_and_is_noticed_otherwise(both_ways, use_y, low_deg, high_deg, flags):
    table = Turntable(0.1, 0.1, 1.0, LATITUDE, wobble=DEG / 3600)
    schedule = continuous_rotation(6 * DEG, 240.0, 0.05, both_ways)
    readings = exact_readings(table, schedule.angle, schedule.rate)
    params = dataclasses.replace(PARAMS, use_y_gyro=use_y, robust=False)
    result = _rotation((schedule.end, schedule.angle, readings.gyro_b, readings.accel_b), params).result()
    assert low_deg <= np.degrees(_error(result, table)) <= high_deg
    assert result.north.flags == flags


@pytest.mark.parametrize("both_ways", [True, False])
def test_late_stamps_of_the_joint_cancel_or_are_in_the_deviation(both_ways):
    delay = 0.01
    params = dataclasses.replace(PARAMS, joint_delay_std=delay)
    time, angle, *readings = _turned(both_ways)
    result, late = (_rotation((time, np.interp(time - by, time, angle), *readings), params).result()
                    for by in (0.0, delay))
    turned = abs(float(late.north.heading - result.north.heading))
    assert turned == pytest.approx(0.0 if both_ways else 6 * DEG * delay, abs=5e-5)
    assert (result.north.std > 6 * DEG * delay) != both_ways


def test_vibration_widens_the_deviation():
    shaken = dataclasses.replace(NOISE, noise_density=2 * NOISE.noise_density)
    still, shaking = (_rotation(_turned(noise=noise)).result().north for noise in (NOISE, shaken))
    assert shaking.flags == Quality(0)
    assert shaking.std == pytest.approx(2 * still.std, rel=0.1)


def test_without_a_turn_there_is_no_result():
    with pytest.raises(NotEnoughDataError, match="does not turn"):
        SteadyRotation(PARAMS).result()
