"""The aligner of a standing vehicle, sample by sample."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from alignment.standing import _kernels as kernels
from alignment.standing.aligner import StandingAligner
from alignment.standing.params import StandingParams
from inertial.parked_scenarios import GRADES, simulate_parked
from inertial.recording import ImuSeries
from inertial.rotation import dcm_nb_from_euler
from inertial.table_scenarios import HEADING, LATITUDE

RATE = 50.0  # Hz
SIGMAS = 4.0  # outside once in 16 000
SEEDS = 12
MEAN_SQUARE = (0.25, 2.4)  # of z over so many seeds: outside once in a thousand
LEVEL_LAG = 4e-4  # rad that the Earth turns by in the five seconds of a level without latitude
SAME = 1e-12  # rad: the same arithmetic in blocks of other lengths
LEAST = 0.99  # part of the floor: the first attitude, too, is known a little
COARSE = {"coarse_window": 20.0}


def params_of(grade, **changes):
    """Return the StandingParams that know a grade's sensors."""
    errors = GRADES[grade].errors
    known = StandingParams(
        latitude=LATITUDE, gyro_noise_density=errors.gyro_noise_density, gyro_bias_std=errors.gyro_bias_std,
        gyro_bias_instability=errors.gyro_bias_instability, accel_noise_density=errors.accel_noise_density,
        accel_bias_std=errors.accel_bias_std, accel_bias_instability=errors.accel_bias_instability,
        scale_std=errors.gyro_scale_std)
    return replace(known, **changes)


def pushed(imu, start, length, acceleration):
    """Return the readings of a vehicle that is pushed ahead besides."""
    elapsed = (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9
    accel_b = imu.accel_b.copy()
    accel_b[(elapsed >= start) & (elapsed < start + length), 0] += acceleration
    return ImuSeries(imu.stamp_ns, imu.gyro_b, accel_b)


@pytest.fixture(scope="module")
def still():
    """Return 40 s of a navigation-grade IMU in a vehicle that nothing moves."""
    return simulate_parked("parked_navigation", duration=40.0, imu_rate=RATE, disturbance=0.0).imu


@pytest.mark.parametrize("push", [(7.5, 0.5, 2.0), (5.0, 2.0, 0.12)], ids=["shove", "creep"])
def test_a_push_into_steady_motion_is_survived(still, push):
    # The shove leaves a second of which nothing is known; the creep is too gentle for the coarse alignment, and
    # the filter moves as soon as it has begun.
    aligner = StandingAligner(params_of("navigation", coarse_window=6.0))
    results = [result for _, result in aligner.run(pushed(still, *push), period=0.1)]
    assert results[-1] is not None and np.isfinite(results[-1].heading)


def test_default_chain_finds_north_within_its_sigma(made_up):
    """From any heading, navigation grade, in 120 s: aligned, and as far off as it says."""
    params = made_up.params(made_up.navigation)
    z = []
    for seed in range(SEEDS):
        imu, dcm_nb = made_up.imu(made_up.navigation, 120.0, seed=seed, heading=0.5 * seed, rate=RATE)
        aligner = StandingAligner(params)
        found = aligner.run(imu, period=10.0)
        assert aligner.phase == "aligned"
        for phase, result in found:
            if phase == "aligned":
                assert abs(made_up.error(result.heading, dcm_nb)) < SIGMAS * result.heading_std
        z.append(made_up.error(aligner.result.heading, dcm_nb) / aligner.result.heading_std)
    assert MEAN_SQUARE[0] < np.mean(np.square(z)) < MEAN_SQUARE[1]


def test_two_positions_find_the_gyro_bias(made_up):
    params = made_up.params(made_up.tactical)
    imu, dcm_nb = made_up.imu(made_up.tactical, 240.0, seed=3, rate=RATE, turns=((115.0, 10.0, math.pi),))
    aligner = StandingAligner(params)
    aligner.run(imu)
    result = aligner.result
    assert result.floor < 0.5 * params.gyro_bias_std / params.north_rate < 0.5 * math.pi
    assert abs(made_up.error(result.heading, dcm_nb)) < SIGMAS * result.heading_std
    assert result.heading_std < 1.6 * result.floor
    assert any("stands again" in text for good, text in aligner.take_remarks() if good)


@pytest.mark.parametrize("method", ["oba_riekf", "ekf5"])
def test_samples_one_by_one_give_what_the_recording_gives(made_up, method):
    imu, _ = made_up.imu(made_up.navigation, 40.0, rate=RATE)
    params = made_up.params(made_up.navigation, method=method, **COARSE)
    batch, stream = StandingAligner(params), StandingAligner(params)
    batch.run(imu, period=7.0)
    for sample in zip(imu.stamp_ns.tolist(), imu.gyro_b, imu.accel_b, strict=True):
        stream.add_imu(*sample)
    assert stream.result.stamp_ns == batch.result.stamp_ns
    np.testing.assert_allclose(stream.result.q_nb_wxyz, batch.result.q_nb_wxyz, atol=SAME)


@pytest.mark.parametrize("method", ["ipekf", "ekf10", "ukf10", "mekf", "riekf6"])
def test_every_method_aligns(made_up, method):
    imu, dcm_nb = made_up.imu(made_up.navigation, 60.0, rate=RATE)
    aligner = StandingAligner(made_up.params(made_up.navigation, method=method, **COARSE))
    aligner.run(imu)
    result = aligner.result
    assert abs(made_up.error(result.heading, dcm_nb)) < SIGMAS * result.heading_std
    assert result.heading_std > 0.9 * result.floor
    assert math.isnan(result.cost) == (method != "ipekf")


def test_bad_samples_are_counted_and_change_nothing(made_up):
    imu, _ = made_up.imu(made_up.navigation, 30.0, rate=RATE)
    params = made_up.params(made_up.navigation, **COARSE)
    clean, dirty = StandingAligner(params), StandingAligner(params)
    clean.run(imu)
    broken = imu.gyro_b[200].copy()
    broken[1] = math.nan
    for k, sample in enumerate(zip(imu.stamp_ns.tolist(), imu.gyro_b, imu.accel_b, strict=True)):
        if k == 200:
            dirty.add_imu(sample[0] - 1, broken, sample[2])
            dirty.add_imu(int(imu.stamp_ns[150]), *sample[1:])
        dirty.add_imu(*sample)
    assert dirty.refused == 2
    np.testing.assert_array_equal(dirty.result.q_nb_wxyz, clean.result.q_nb_wxyz)


def test_gap_starts_anew_and_says_so(made_up):
    imu, _ = made_up.imu(made_up.navigation, 30.0, rate=RATE)
    aligner = StandingAligner(made_up.params(made_up.navigation, **COARSE))
    aligner.run(imu)
    assert aligner.phase != "coarse"
    later = 32_000_000_000 - int(imu.stamp_ns[0])
    aligner.run(ImuSeries(imu.stamp_ns[:200] + later, imu.gyro_b[:200], imu.accel_b[:200]))
    assert aligner.gaps == 1 and aligner.phase == "coarse"
    assert any("gap of 2.0 s" in text for _, text in aligner.take_remarks())


@pytest.mark.parametrize(("changes", "scale", "text"), [
    ({"latitude": math.nan}, 1.0, "latitude is not known"), ({"latitude": math.radians(89.9)}, 1.0, "pole"),
    ({}, 1 / 9.80665, "g"), ({}, 1.2, "1.2")])
def test_refusals_say_why(made_up, changes, scale, text):
    imu, _ = made_up.imu(made_up.perfect, 30.0, rate=RATE)
    aligner = StandingAligner(made_up.params(made_up.navigation, **COARSE, **changes))
    aligner.run(ImuSeries(imu.stamp_ns, imu.gyro_b, scale * imu.accel_b))
    assert text in aligner.refusal
    assert aligner.phase in ("waiting", "coarse")
    if "latitude" in changes:
        assert aligner.result.roll == pytest.approx(0.02, abs=LEVEL_LAG)
        assert aligner.result.pitch == pytest.approx(-0.03, abs=LEVEL_LAG)
        assert aligner.result.heading_std == pytest.approx(math.pi / math.sqrt(3))
    else:
        assert aligner.input_error


@pytest.mark.parametrize(("sensors", "reason"), [
    ("tactical", r"gyro noise is (49|50)(\.\d)? times what gyro_noise_density says"),
    ("adis", "deg/h all the time, the Earth's rate is 15 deg/h and gyro_bias_std 0.01 deg/h")])
def test_sensors_poorer_than_told_are_refused_by_what_was_measured(sensors, reason):
    """Navigation grade is told. The one's attitude wanders, the other's turn-on bias looks like a turn."""
    imu = simulate_parked(f"parked_{sensors}", duration=100.0, imu_rate=RATE, seed=2).imu
    aligner = StandingAligner(params_of("navigation", **COARSE))
    aligner.run(imu)
    assert re.search(reason, aligner.refusal) and aligner.phase != "aligned"


def test_strong_wind_and_people_are_no_poor_sensors():
    imu = simulate_parked("parked_navigation", duration=60.0, imu_rate=RATE, seed=2, disturbance=3.0).imu
    aligner = StandingAligner(params_of("navigation", **COARSE))
    aligner.run(imu)
    assert aligner.phase == "fine" and not aligner.refusal


def test_lost_samples_of_a_vehicle_that_sways_are_in_sigma():
    """A tenth of the samples, as of a network that is too slow: heading and tilt wander more than noise explains."""
    recording = simulate_parked("parked_navigation", duration=80.0, imu_rate=RATE, seed=4, disturbance=3.0)
    kept = np.random.default_rng(4).random(len(recording.imu)) > 0.1
    aligner, whole = (StandingAligner(params_of("navigation", **COARSE)) for _ in range(2))
    imu = recording.imu
    aligner.run(ImuSeries(imu.stamp_ns[kept], imu.gyro_b[kept], imu.accel_b[kept]))
    whole.run(imu)
    error = math.remainder(aligner.result.heading - HEADING, 2 * math.pi)
    assert not aligner.refusal and abs(error) < SIGMAS * aligner.result.heading_std
    assert aligner.result.heading_std > 1.05 * whole.result.heading_std
    assert aligner._fine.filter.q[kernels.Q_SCALE] == pytest.approx(1.0)


@pytest.mark.parametrize("method", ["oba_riekf", "mekf", "riekf6", "ekf10", "ekf5"])
def test_sigma_is_never_below_what_the_biases_allow(still, method):
    """At rest a tilt stays beside an accelerometer's bias, a heading beside the east gyro's."""
    aligner = StandingAligner(params_of("navigation", method=method, **COARSE))
    params = aligner.params
    for _, result in aligner.run(still):
        if result is not None:
            tilt_var = np.diag(result.covariance)[:2].min()
            assert math.sqrt(tilt_var) > LEAST * params.accel_bias_spread / params.local_gravity
            assert result.heading_std > LEAST * result.floor > LEAST * params.gyro_bias_spread / params.north_rate


@pytest.mark.parametrize(("deg_per_hour", "cure"), [(10.0, "or the IMU"), (720.0, "with zero_velocity_while_turning")])
def test_biases_that_hide_the_earth_rate_are_never_aligned(made_up, deg_per_hour, cure):
    imu, _ = made_up.imu(made_up.tactical, 60.0, rate=RATE)
    bias_std = math.radians(deg_per_hour / 3600)
    aligner = StandingAligner(made_up.params(made_up.tactical, gyro_bias_std=bias_std, **COARSE))
    aligner.run(imu)
    assert aligner.phase == "fine" and "hide the Earth rate" in aligner.refusal and cure in aligner.refusal
    assert aligner.result.time_left == math.inf


def test_biases_near_the_earth_rate_make_no_false_sigma(made_up):
    """At 5 deg/h a bias may cancel half of the Earth's horizontal rate: then sigma is more than a linear one."""
    grade = replace(made_up.tactical, gyro_bias=math.radians(5 / 3600))
    z = []
    for seed in range(SEEDS):
        imu, dcm_nb = made_up.imu(grade, 50.0, seed=seed, heading=0.5 * seed, rate=RATE)
        aligner = StandingAligner(made_up.params(grade, **COARSE))
        aligner.run(imu)
        z.append(made_up.error(aligner.result.heading, dcm_nb) / aligner.result.heading_std)
    assert MEAN_SQUARE[0] < np.mean(np.square(z)) < MEAN_SQUARE[1] and np.abs(z).max() < SIGMAS


def test_who_steps_in_does_not_end_the_coarse_alignment(made_up):
    """The body rolls to and fro by 10 mrad, faster than a turn is allowed to be, and its top moves by as much."""
    imu, dcm_nb = made_up.imu(made_up.navigation, 40.0, rate=RATE)
    elapsed = np.maximum(imu.stamp_ns * 1e-9 - 8.0 - 0.5 / RATE, 0.0)
    roll = 0.01 * np.exp(-elapsed / 0.6) * np.sin(2 * math.pi * 1.3 * elapsed)
    rate, acceleration = np.gradient(roll, 1 / RATE), np.gradient(np.gradient(roll, 1 / RATE), 1 / RATE)
    turned = np.swapaxes(dcm_nb_from_euler(roll, 0.0, 0.0), -1, -2)
    gyro_b = np.einsum("kij,kj->ki", turned, imu.gyro_b)
    accel_b = np.einsum("kij,kj->ki", turned, imu.accel_b)
    gyro_b[:, 0] += rate
    accel_b[:, 1] += acceleration
    aligner = StandingAligner(made_up.params(made_up.navigation, zero_velocity_std=5e-3, **COARSE))
    assert np.abs(rate).max() > aligner.params.largest_rate
    phases = [phase for phase, _ in aligner.run(ImuSeries(imu.stamp_ns, gyro_b, accel_b))]
    assert phases[2:19] == 17 * ["coarse"] and set(phases[21:]) <= {"fine", "aligned"}
    assert abs(made_up.error(aligner.result.heading, dcm_nb)) < SIGMAS * aligner.result.heading_std


def test_attitude_that_contradicts_the_residuals_is_given_up(made_up):
    """Row 40 of the reliability page: a filter that is sure of a wrong attitude goes back to the coarse stage."""
    imu, dcm_nb = made_up.imu(made_up.navigation, 300.0, rate=RATE)
    aligner = StandingAligner(made_up.params(made_up.navigation, method="ekf5", zero_velocity_std=1e-4, **COARSE))
    part = slice(0, 1500)
    aligner.run(ImuSeries(imu.stamp_ns[part], imu.gyro_b[part], imu.accel_b[part]))
    state = aligner._fine.filter
    turn = math.radians(30.0)
    state.R[:] = dcm_nb_from_euler(0.0, 0.0, turn) @ state.R
    state.P[4, :] = state.P[:, 4] = 0.0
    state.P[4, 4] = 1e-10
    part = slice(1500, None)
    aligner.run(ImuSeries(imu.stamp_ns[part], imu.gyro_b[part], imu.accel_b[part]))
    assert any("back to the coarse alignment" in text for _, text in aligner.take_remarks())
    assert abs(made_up.error(aligner.result.heading, dcm_nb)) < SIGMAS * aligner.result.heading_std
