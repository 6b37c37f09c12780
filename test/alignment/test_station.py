"""Raw samples to dwells, and dwells one by one to level and heading."""

import dataclasses
import math
import re

import numpy as np
import pytest

from alignment.azimuth import METHODS
from alignment.dwells import Dwell, reduce_dwell
from alignment.errors import NotEnoughDataError
from alignment.params import AlignmentParams
from alignment.results import Quality, wrap_angle
from alignment.sequences import FOUR_POSITIONS, indexed_schedule
from alignment.station import TableAlignment
from alignment.turntable import TriadErrors, Turntable, earth_direction_t, exact_readings, simulate_readings

DEG = np.pi / 180
LATITUDE = 35 * DEG
NOISE = TriadErrors(bias=(3e-5, -2e-5, 1e-5), noise_density=0.003 * DEG / 60,
                    bias_instability=0.01 * DEG / 3600)
FORCE_NOISE = TriadErrors(bias=(0.01, -0.02, 0.005), noise_density=1e-4)
PARAMS = AlignmentParams(latitude=LATITUDE, gyro_noise_density=NOISE.noise_density, scale_std=2e-5,
                         skew_std=2e-5, gyro_bias_instability=NOISE.bias_instability, gravity=9.80665,
                         accel_noise_density=1e-4, accel_scale_std=1e-4, target_std=0.05 * DEG)
SIGMAS = 4.5  # a good estimate is outside once in 150 000
SAMPLE_RATE = 100.0


def _table(roll=5.0, pitch=-3.0, heading=140.0):
    return Turntable(roll * DEG, pitch * DEG, heading * DEG, LATITUDE)


def _add(station, table, angle, rng, duration=15.0):
    start = station.dwells[-1].end + 1.0 if station.dwells else 0.0
    schedule = indexed_schedule([angle], duration, start=start)
    readings = simulate_readings(table, schedule, NOISE, FORCE_NOISE, rng)
    return station.add(Dwell(angle, start, start + duration, readings.gyro_b[0], readings.accel_b[0]))


def _samples(angle=0.3, seconds=10.0, **noise):
    rng = np.random.default_rng(1)
    exact = exact_readings(_table(), angle)
    count = int(seconds * SAMPLE_RATE)
    time = 100.0 + np.arange(1, count + 1) / SAMPLE_RATE
    root = math.sqrt(SAMPLE_RATE)
    gyro_b = exact.gyro_b + noise.get("gyro", NOISE.noise_density) * root * rng.standard_normal((count, 3))
    accel_b = exact.accel_b + noise.get("accel", 1e-4) * root * rng.standard_normal((count, 3))
    return time, np.full(count, angle), gyro_b, accel_b


def test_a_still_dwell_is_its_mean():
    time, angle, gyro_b, accel_b = _samples()
    dwell = reduce_dwell(time, angle, gyro_b, accel_b, PARAMS)
    assert dwell.rejection == ""
    assert (dwell.angle, dwell.start, dwell.end) == pytest.approx((0.3, 100.0, 110.0))
    assert dwell.gyro_b == pytest.approx(gyro_b.mean(axis=0), abs=NOISE.noise_density / 10)


def test_samples_of_somebody_walking_past_are_left_out():
    time, angle, gyro_b, accel_b = _samples()
    clean = reduce_dwell(time, angle, gyro_b, accel_b, PARAMS)
    gyro_b[::20] += 1e-3
    dwell = reduce_dwell(time, angle, gyro_b, accel_b, PARAMS)
    assert dwell.rejection == ""
    assert dwell.kept == pytest.approx(0.95, abs=0.001)
    assert dwell.gyro_b == pytest.approx(clean.gyro_b, abs=NOISE.noise_density / 5)


def _turning(time, angle, gyro_b, accel_b):
    return time, angle + 0.01 * (time - time[0]), gyro_b, accel_b


def _rocking(time, angle, gyro_b, accel_b):
    return time, angle, gyro_b, accel_b + 0.02 * np.sin(0.5 * time)[:, None]


def _spinning(time, angle, gyro_b, accel_b):
    return time, angle, gyro_b + [0, 0, 0.1], accel_b


def _broken(time, angle, gyro_b, accel_b):
    gyro_b[3, 1] = np.nan
    return time, angle, gyro_b, accel_b


def _short(*columns):
    return tuple(column[:5] for column in columns)


@pytest.mark.parametrize("spoil, reason", [
    (_turning, "the table turned by"), (_rocking, "not still: the . accelerometer"),
    (_spinning, "not still: turning at 5.73 deg/s"), (_broken, "1 samples are not numbers"),
    (_short, "only 5 samples")])
def test_bad_dwells_are_rejected_with_the_reason(spoil, reason):
    station = TableAlignment(PARAMS)
    dwell = reduce_dwell(*spoil(*_samples()), PARAMS)
    assert re.match(reason, station.add(dwell))
    assert not station.dwells
    (rejected,) = station.rejected
    assert repr(rejected) == repr(dwell)  # NaN is not NaN


def test_level_is_known_at_once_and_better_when_the_table_has_turned():
    rng, table, station = np.random.default_rng(2), _table(), TableAlignment(PARAMS)
    with pytest.raises(NotEnoughDataError, match="no dwell"):
        station.result()
    _add(station, table, 0.0, rng)
    first = station.result()
    assert first.north is None
    bias = FORCE_NOISE.bias[0] / 9.8
    assert first.level.roll == pytest.approx(table.roll, abs=3 * PARAMS.accel_bias_std / 9.8)
    assert abs(first.level.pitch - table.pitch) > 0.5 * bias
    for angle in FOUR_POSITIONS[1:]:
        _add(station, table, angle, rng)
    level = station.result().level
    for found, truth, variance in zip((level.roll, level.pitch), (table.roll, table.pitch),
                                      np.diag(level.covariance), strict=True):
        assert abs(found - truth) < SIGMAS * np.sqrt(variance)
        assert np.sqrt(variance) < 0.1 * PARAMS.accel_bias_std / 9.8


@pytest.mark.parametrize("attitude", [(5, -3, 140), (50, 30, 88), (-120, 40, -60)])
def test_a_followed_sequence_reaches_the_target_with_honest_sigma(attitude):
    rng, table, station = np.random.default_rng(3), _table(*attitude), TableAlignment(PARAMS)
    for _ in range(60):
        assert _add(station, table, station.next_angle(), rng) == ""
        result = station.result()
        if result.time_left == 0:
            break
    assert result.believable
    assert result.north.std <= PARAMS.target_std
    assert abs(wrap_angle(result.north.heading - table.heading)) < SIGMAS * result.north.std
    assert 0 < result.floor < result.north.std


def test_after_the_coarse_part_the_table_looks_east_and_west():
    rng, table = np.random.default_rng(4), _table(0.0, 0.0, 140.0)
    station = TableAlignment(PARAMS)
    wanted = []
    for _ in range(12):
        wanted.append(station.next_angle())
        _add(station, table, wanted[-1], rng)
    assert wanted[:8] == list(FOUR_POSITIONS + FOUR_POSITIONS[::-1])
    for angle in wanted[8:]:
        assert abs(math.cos(angle + table.heading)) < 0.01
    assert len({round(math.sin(angle + table.heading)) for angle in wanted[8:]}) == 2


def test_two_angles_or_no_latitude_give_no_heading():
    rng, table = np.random.default_rng(5), _table()
    two, blind = TableAlignment(PARAMS), TableAlignment(AlignmentParams())
    for angle in (0.0, np.pi, 0.0):
        _add(two, table, angle, rng)
    assert two.result().north is None
    for angle in FOUR_POSITIONS:
        _add(blind, table, angle, rng)
    result = blind.result()
    assert result.north is None
    assert not result.believable
    assert result.level.flags == Quality(0)


def _disturbed(table, start, change_b):
    reading = exact_readings(table, 1.0)
    return Dwell(1.0, start, start + 15.0, reading.gyro_b + NOISE.bias + change_b, reading.accel_b + FORCE_NOISE.bias)


def test_a_dwell_that_disagrees_with_all_the_others_is_rejected():
    rng, table, station = np.random.default_rng(9), _table(), TableAlignment(PARAMS)
    for angle in FOUR_POSITIONS * 2:
        _add(station, table, angle, rng)
    before = station.result().north
    disturbed = _disturbed(table, station.dwells[-1].end, [0.0, 1e-5, 0.0])
    assert re.match("its y gyro is 36.5 deviations off the other dwells", station.add(disturbed))
    assert len(station.dwells) == 8 and station.rejected[0].angle == disturbed.angle
    assert station.result().north.heading == before.heading


def test_a_disturbed_dwell_among_the_first_is_found_when_there_are_others():
    rng, table, station = np.random.default_rng(10), _table(), TableAlignment(PARAMS)
    assert station.add(_disturbed(table, 0.0, [3e-5, 0.0, 0.0])) == ""
    for angle in FOUR_POSITIONS * 2:
        assert _add(station, table, angle, rng) == ""
    assert [dwell.start for dwell in station.rejected] == [0.0]
    result = station.result()
    assert result.believable and abs(wrap_angle(result.north.heading - table.heading)) < SIGMAS * result.north.std


def test_dwells_that_disagree_among_themselves_are_inconsistent():
    rng, table, station = np.random.default_rng(9), _table(), TableAlignment(PARAMS)
    for k, angle in enumerate(FOUR_POSITIONS * 2):
        _add(station, table, angle, rng)
        start = station.dwells[-1].end
        station.add(_disturbed(table, start, (-1) ** k * np.array([1e-5, 2e-5, 0.0])))
    assert not station.rejected
    assert Quality.INCONSISTENT in station.result().north.flags and not station.result().believable


def test_readings_that_scatter_a_little_more_than_stated_widen_the_deviation():
    rng, table = np.random.default_rng(12), _table()
    honest, hopeful = TableAlignment(PARAMS), TableAlignment(
        dataclasses.replace(PARAMS, gyro_noise_density=PARAMS.gyro_noise_density / 2,
                            gyro_bias_instability=PARAMS.gyro_bias_instability / 2))
    for angle in FOUR_POSITIONS * 10:
        _add(honest, table, angle, rng)
        hopeful.add(honest.dwells[-1])
    assert hopeful.result().believable
    assert hopeful.result().north.std == pytest.approx(honest.result().north.std, rel=0.25)


def test_methods_are_compared_with_the_joint_one():
    rng, table, station = np.random.default_rng(6), _table(), TableAlignment(PARAMS)
    for angle in FOUR_POSITIONS:
        _add(station, table, angle, rng, 150.0)
    results = station.compare_headings()
    assert set(results) == {"joint", *METHODS}
    for name in ("joint", "azimuth_1a", "azimuth_1b", "azimuth_2", "azimuth_3", "azimuth_4", "azimuth_5"):
        error = abs(wrap_angle(results[name].heading - table.heading))
        assert error < SIGMAS * results[name].std, name
    assert Quality.SHARED_CHANNEL in results["azimuth_6"].flags


def test_overlapping_dwells_are_refused():
    station = TableAlignment(PARAMS)
    reading = exact_readings(_table(), 0.0)
    assert station.add(Dwell(0.0, 0.0, 10.0, reading.gyro_b, reading.accel_b)) == ""
    overlapping = Dwell(1.0, 5.0, 15.0, reading.gyro_b, reading.accel_b)
    assert station.add(overlapping) == "it overlaps the dwell before"
    station.reset()
    assert (station.dwells, station.rejected) == ((), [])


def test_while_two_headings_fit_the_table_looks_where_they_differ_most():
    rng, table = np.random.default_rng(14), _table(80.0, 10.0, 40.0)
    station = TableAlignment(dataclasses.replace(PARAMS, coarse_time=50.0, gyro_noise_density=3e-5))
    for angle in FOUR_POSITIONS:
        _add(station, table, angle, rng)
    north = station.result().north
    assert north.flags == Quality.AMBIGUOUS
    here, there = (earth_direction_t(table.roll, table.pitch, heading, LATITUDE)[:2] for heading in north.branches)
    wanted = station.next_angle()
    difference = np.array([math.cos(wanted), math.sin(wanted)]) @ (here - there)
    assert abs(difference) == pytest.approx(np.linalg.norm(here - there), rel=1e-3)
