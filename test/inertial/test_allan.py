"""Allan deviation against published figures; noises put in come back, with limits that hold."""

from dataclasses import replace

import numpy as np
import pytest

from inertial.allan import NOISES, TriadNoise, allan_curve, fit_noise, measure_noise
from inertial.imu_errors import PROFILES, ImuErrors, apply_imu_errors
from inertial.recording import ImuSeries

# NIST SP 1065 (2008), table 31: overlapping Allan deviation of the 1000-point test suite.
NIST = {1: 2.922319e-01, 10: 9.159953e-02, 100: 3.241343e-02}
NIST_DIGITS = 1e-6

INTERVAL = 0.1
COUNT = 2 ** 14
STAMPS = 1_700_000_000_000_000_000 + 100_000_000 * np.arange(COUNT)
SLOPE, LEVEL = 0.03, 0.05
WALK_LEVEL_IN_A_MIX = 0.3
FITS = 24
COVERED = 20  # of 24: 95 % limits cover fewer once in 150 times; 300 fits gave 94 to 98 %


def readings(count=COUNT, seed=1, **errors):
    """Return the gyro of a simulated IMU at rest, (N, 3), and its interval."""
    imu = ImuSeries(STAMPS[:count], np.zeros((count, 3)), np.zeros((count, 3)))
    named = ImuErrors(**{f"gyro_{name}": value for name, value in errors.items()})
    return apply_imu_errors(imu, named, np.random.default_rng(seed)).imu.gyro_b


def at_rest(errors, seconds, rate=100.0, seed=1):
    count = round(seconds * rate)
    stamps = STAMPS[0] + np.rint(1e9 / rate * np.arange(count)).astype(np.int64)
    imu = ImuSeries(stamps, np.zeros((count, 3)), np.tile([0.0, 0.0, -9.8], (count, 1)))
    return apply_imu_errors(imu, errors, np.random.default_rng(seed)).imu


def test_the_test_suite_of_nist():
    numbers = [1234567890]
    while len(numbers) < 1000:
        numbers.append(16807 * numbers[-1] % (2 ** 31 - 1))
    curve = allan_curve(np.array(numbers) / (2 ** 31 - 1), 1.0, list(NIST))
    np.testing.assert_allclose(curve.deviation[:, 0], list(NIST.values()), rtol=NIST_DIGITS)
    assert curve.time.tolist() == list(NIST)


@pytest.mark.parametrize("errors, slope, expected, times", [
    # Counts of the angle, with noise enough to spread each reading over some of them.
    ({"angle_resolution": 1e-3, "noise_density": 1.3e-3}, -1.0,
     lambda t: np.sqrt(1e-6 / 4 / t ** 2 + 1.69e-6 / t), (0.1, 0.1)),
    ({"noise_density": 0.02}, -0.5, lambda t: 0.02 / np.sqrt(t), (0.1, 26.0)),
    ({"bias_instability": 0.03}, 0.0, lambda t: 0.03 + 0.0 * t, (1.6, 26.0)),
    ({"walk_density": 0.01}, 0.5, lambda t: 0.01 * np.sqrt(t / 3), (0.8, 13.0))])
def test_each_noise_has_its_slope_and_level(errors, slope, expected, times):
    curve = allan_curve(np.concatenate([readings(seed=seed, **errors) for seed in range(6)], axis=1), INTERVAL)
    wanted = (curve.time > 0.99 * times[0]) & (curve.time < 1.01 * times[1])
    deviation = np.sqrt(curve.variance.mean(axis=1))
    level = deviation[wanted] / expected(curve.time[wanted])
    assert np.exp(np.mean(np.log(level))) == pytest.approx(1.0, abs=LEVEL)
    if wanted.sum() > 1:
        fitted, _ = np.polyfit(np.log(curve.time[wanted]), np.log(deviation[wanted]), 1)
        assert fitted == pytest.approx(slope, abs=SLOPE)


def test_the_limits_of_a_fit_cover_the_truth():
    truth = {"noise_density": 1.0, "bias_instability": 0.3, "walk_density": 0.05}
    covered = dict.fromkeys(NOISES, 0)
    values = {name: [] for name in NOISES}
    for seed in range(FITS // 3):
        curve = allan_curve(readings(seed=seed, **truth), INTERVAL)
        for axis in range(3):
            fit = fit_noise(curve, axis)
            assert fit.consistent
            for name in NOISES:
                estimate = getattr(fit, name)
                covered[name] += estimate.low <= truth.get(name, 0.0) <= estimate.high
                values[name].append(estimate.value)
    assert min(covered.values()) >= COVERED, covered
    assert np.mean(values["noise_density"]) == pytest.approx(1.0, rel=LEVEL)
    assert np.mean(values["bias_instability"]) == pytest.approx(0.3, rel=LEVEL)
    assert np.mean(values["walk_density"]) == pytest.approx(0.05, rel=WALK_LEVEL_IN_A_MIX)


def test_noises_that_are_not_there_are_not_found():
    fit = fit_noise(allan_curve(readings(noise_density=1.0), INTERVAL))
    assert fit.noise_density.found and fit.noise_density.low < 1.0 < fit.noise_density.high
    for name in ("quantisation", "bias_instability", "walk_density"):
        estimate = getattr(fit, name)
        assert not estimate.found and 0.0 <= estimate.value < estimate.high
    np.testing.assert_allclose(np.sqrt(fit.variance([0.1, 1.0])), [10 ** 0.5, 1.0], rtol=LEVEL)


def test_the_limits_narrow_with_the_root_of_the_record():
    def width(count):
        estimate = fit_noise(allan_curve(readings(count, noise_density=1.0), INTERVAL)).noise_density
        return np.log(estimate.high / estimate.low)

    assert width(COUNT // 4) / width(COUNT) == pytest.approx(2.0, rel=0.3)


def test_a_filtered_sensor_is_explained_from_longer_times():
    white = readings(noise_density=1.0)
    smoothed = np.apply_along_axis(np.convolve, 0, white, np.ones(4) / 4, mode="valid")
    fit = fit_noise(allan_curve(smoothed, INTERVAL))
    assert fit.consistent and fit.shortest_time > 4 * INTERVAL
    assert fit.noise_density.low < 1.0 < fit.noise_density.high


def test_what_no_noise_explains_is_told():
    tone = np.sin(2 * np.pi * 0.01 * INTERVAL * np.arange(COUNT))
    fit = fit_noise(allan_curve(readings(noise_density=0.01)[:, 0] + tone, INTERVAL))
    assert not fit.consistent and fit.misfit > 10.0


@pytest.mark.parametrize("profile", ["bmi160", "adis16488a"])
def test_a_real_sensors_data_sheet_comes_back(profile):
    errors = PROFILES[profile].imu
    noise = measure_noise(at_rest(errors, 300.0))
    assert noise.gyro.combined("noise_density") == pytest.approx(errors.gyro_noise_density, rel=LEVEL)
    assert noise.accel.combined("noise_density") == pytest.approx(errors.accel_noise_density, rel=LEVEL)
    for triad, floor in ((noise.gyro, errors.gyro_bias_instability), (noise.accel, errors.accel_bias_instability)):
        assert np.median([fit.bias_instability.low for fit in triad.fits]) < floor
        assert np.median([fit.bias_instability.high for fit in triad.fits]) > floor


def test_lost_and_late_samples_cost_little():
    errors = ImuErrors(gyro_noise_density=1e-3, accel_noise_density=1e-2)
    disturbed = replace(errors, dropout_share=0.02, jitter_std=1e-3)
    clean, lost = (measure_noise(at_rest(each, 120.0)) for each in (errors, disturbed))
    assert clean.missing == 0.0 and lost.missing == pytest.approx(0.02, abs=0.005)
    assert lost.gyro.curve.interval == pytest.approx(0.01, rel=1e-4)
    assert lost.gyro.combined("noise_density") == pytest.approx(1e-3, rel=LEVEL)


def test_readings_without_a_number_count_as_lost():
    imu = at_rest(ImuErrors(gyro_noise_density=1e-3, accel_noise_density=1e-2), 70.0)
    imu.gyro_b[100:110] = np.nan
    assert measure_noise(imu).missing == pytest.approx(10 / len(imu))


def _moved(imu):
    imu.gyro_b[3000:4000] += 0.1
    return imu


@pytest.mark.parametrize("change, reason", [
    (lambda imu: ImuSeries(imu.stamp_ns[:500], imu.gyro_b[:500], imu.accel_b[:500]), "5.0 s .* too short"),
    (lambda imu: ImuSeries(imu.stamp_ns[:0], imu.gyro_b[:0], imu.accel_b[:0]), "too short"),
    (_moved, "moving in 10 of 70 s, between 30 and 40 s"),
    (lambda imu: replace(imu, stamp_ns=np.roll(imu.stamp_ns, -1) + np.where(np.arange(7000) == 6999, 10 ** 12, 0)
                         - np.where(np.arange(7000) == 20, 10 ** 9, 0)), "stamps do not increase, first 0.2 s"),
    (lambda imu: ImuSeries(*(np.delete(each, np.s_[100:1000], axis=0)
                             for each in (imu.stamp_ns, imu.gyro_b, imu.accel_b))), "12.9 % of the samples"),
    (lambda imu: replace(imu, gyro_b=np.zeros((7000, 3))), "do not change")])
def test_a_record_that_cannot_be_used_says_why(change, reason):
    imu = at_rest(ImuErrors(gyro_noise_density=1e-3, accel_noise_density=1e-2), 70.0)
    with pytest.raises(ValueError, match=reason):
        measure_noise(change(imu))


def test_too_few_samples_or_too_long_a_time_are_refused():
    with pytest.raises(ValueError, match="100 samples"):
        allan_curve(np.zeros(100), 1.0)
    with pytest.raises(ValueError, match="factors from 1 to 600: must be from 1 to 500"):
        allan_curve(np.zeros(1000), 1.0, [1, 600])
    with pytest.raises(ValueError, match="3 averaging times"):
        fit_noise(allan_curve(np.arange(1000.0) % 7, 1.0, [1, 2, 4]))


def test_an_axis_that_no_noise_explains_does_not_count():
    curve = allan_curve(readings(noise_density=1e-3), INTERVAL)
    good, shaken = fit_noise(curve), replace(fit_noise(curve), consistent=False, misfit=100.0)
    worse = replace(shaken, noise_density=replace(good.noise_density, value=1.0, low=0.5, high=2.0))
    alone = TriadNoise(np.zeros(3), curve, (good, good, worse))
    assert alone.combined("noise_density") == pytest.approx(good.noise_density.value)
    assert alone.shown("walk_density") == 0.0 < alone.combined("walk_density")
    with pytest.raises(ValueError, match="moved, shaken"):
        TriadNoise(np.zeros(3), curve, (shaken, shaken, worse)).combined("noise_density")
