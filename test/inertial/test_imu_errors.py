"""The errors put in come back as statistics; one error changes one thing."""

from dataclasses import replace

import numpy as np
import pytest

from inertial.imu_errors import (
    PROFILES,
    AltimeterErrors,
    ImuErrors,
    apply_altimeter_errors,
    apply_imu_errors,
    find_profile,
)
from inertial.recording import ImuSeries

RATE = 100.0
COUNT = 40_000
STATISTICS = 0.03  # four sigma of a standard deviation from 3 x 40000 samples is 0.8 %
ENSEMBLE = 0.15  # four sigma of a standard deviation from 3 x 200 draws is 11 %
STAMPS = 1_700_000_000_000_000_000 + 10_000_000 * np.arange(COUNT)


def _imu(count=COUNT, rate_b=(0.0, 0.0, 0.0), force_b=(0.0, 0.0, -9.8)):
    return ImuSeries(STAMPS[:count], np.tile(np.array(rate_b), (count, 1)),
                     np.tile(np.array(force_b), (count, 1)))


def _error(errors, seed=1, **kwargs):
    imu = _imu(**kwargs)
    measured = apply_imu_errors(imu, errors, np.random.default_rng(seed))
    return (measured.imu.gyro_b - imu.gyro_b, measured.imu.accel_b - imu.accel_b, measured)


def test_a_perfect_sensor_changes_nothing():
    gyro, accel, measured = _error(ImuErrors())
    assert not gyro.any() and not accel.any()
    assert not measured.gyro_bias_b.any() and not measured.accel_bias_b.any()
    assert np.array_equal(measured.imu.stamp_ns, STAMPS)


def test_noise_density_is_per_root_hertz():
    gyro, accel, _ = _error(ImuErrors(gyro_noise_density=0.01, accel_noise_density=0.2))
    assert gyro.std() == pytest.approx(0.01 * np.sqrt(RATE), rel=STATISTICS)
    assert accel.std() == pytest.approx(0.2 * np.sqrt(RATE), rel=STATISTICS)


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_turn_on_bias_is_constant_in_a_run_and_has_its_spread_over_runs(sensor):
    errors = ImuErrors(**{f"{sensor}_bias_std": 0.1})
    runs = [_error(errors, seed, count=5)[2] for seed in range(200)]
    bias_b = np.array([getattr(run, f"{sensor}_bias_b") for run in runs])
    assert np.all(bias_b == bias_b[:, :1])
    assert bias_b[:, 0].std() == pytest.approx(0.1, rel=ENSEMBLE)


def test_drift_has_its_spread_and_correlation_time():
    gyro, accel, measured = _error(ImuErrors(gyro_drift_std=0.3, gyro_drift_time=0.5))
    assert np.array_equal(gyro, measured.gyro_bias_b)
    assert not accel.any()
    assert gyro.std() == pytest.approx(0.3, rel=0.1)
    lag = int(0.5 * RATE)
    correlation = np.mean(gyro[lag:] * gyro[:-lag]) / gyro.var()
    assert correlation == pytest.approx(np.exp(-1), abs=0.1)


def test_random_walk_grows_with_the_root_of_time():
    errors = ImuErrors(accel_walk_density=0.1)
    last = np.array([_error(errors, seed, count=400)[1][-1] for seed in range(200)])
    assert last.std() == pytest.approx(0.1 * np.sqrt(4.0), rel=ENSEMBLE)


def test_scale_and_misalignment_are_diagonal_and_off_diagonal():
    axes = {"count": 2, "rate_b": (1.0, 0.0, 0.0)}
    scale = np.array([_error(ImuErrors(gyro_scale_std=0.01), s, **axes)[0][0] for s in range(200)])
    assert scale[:, 0].std() == pytest.approx(0.01, rel=0.2)
    assert not scale[:, 1:].any()
    turned = np.array([_error(ImuErrors(gyro_misalignment_std=0.01), s, **axes)[0][0]
                       for s in range(200)])
    assert turned[:, 1:].std() == pytest.approx(0.01, rel=0.15)
    assert not turned[:, 0].any()


def test_readings_are_clipped_and_quantised():
    errors = ImuErrors(accel_noise_density=1.0, accel_resolution=0.25, accel_range=12.0)
    accel = _error(errors)[2].imu.accel_b
    assert np.abs(accel).max() == 12.0
    assert np.array_equal(accel, np.round(accel * 4) / 4)


def test_switching_one_error_on_leaves_the_noise_as_it_was():
    noise = ImuErrors(gyro_noise_density=0.01, accel_noise_density=0.1)
    plain = _error(noise)
    biased = _error(replace(noise, gyro_bias_std=0.1))
    assert np.array_equal(plain[1], biased[1])
    assert biased[0] - biased[2].gyro_bias_b == pytest.approx(plain[0], abs=1e-15)


def test_jitter_and_dropouts_keep_stamps_in_order():
    errors = ImuErrors(jitter_std=0.005, dropout_share=0.2)
    stamp_ns = apply_imu_errors(_imu(5000), errors, np.random.default_rng(1)).imu.stamp_ns
    assert stamp_ns.dtype == np.int64
    assert np.all(np.diff(stamp_ns) > 0)
    assert len(stamp_ns) == pytest.approx(4000, abs=4 * np.sqrt(5000 * 0.2 * 0.8))
    off_grid = (stamp_ns - STAMPS[0] + 5_000_000) % 10_000_000 - 5_000_000
    assert 0.002e9 < off_grid.std() < 0.005e9


def test_altimeter_noise_drift_scale_and_resolution():
    altitude = np.full(COUNT, 100.0)

    def reading(**errors):
        return apply_altimeter_errors(STAMPS, altitude, AltimeterErrors(**errors),
                                      np.random.default_rng(5))[1]

    assert np.array_equal(reading(), altitude)
    assert reading(noise_std=2.0).std() == pytest.approx(2.0, rel=STATISTICS)
    assert reading(drift_std=0.5, drift_time=1.0).std() == pytest.approx(0.5, rel=0.2)
    assert reading(scale=0.02) == pytest.approx(102.0)
    coarse = reading(noise_std=1.0, resolution=0.5)
    assert np.array_equal(coarse, np.round(coarse * 2) / 2)


def test_errors_out_of_range_are_refused():
    with pytest.raises(ValueError, match="gyro_noise_density = -1.0 rad/s"):
        ImuErrors(gyro_noise_density=-1.0)
    with pytest.raises(ValueError, match="dropout_share = 1.5"):
        AltimeterErrors(dropout_share=1.5)
    with pytest.raises(ValueError, match="choose from perfect, consumer, paper"):
        find_profile("military")


def test_the_papers_sensors_have_the_papers_noise_at_100_hz():
    gyro, accel, _ = _error(PROFILES["paper"].imu)
    assert np.degrees(gyro.std()) == pytest.approx(0.5, rel=STATISTICS)
    assert accel.std() == pytest.approx(0.1, rel=STATISTICS)
    assert PROFILES["paper"].altimeter.noise_std == 2.0


COLOURED = {"gyro_bias_instability": 0.02, "accel_vibration_std": 0.5, "vibration_frequency": 20.0}


def test_coloured_noise_leaves_all_other_noise_as_it_was():
    noise = ImuErrors(gyro_noise_density=0.01, accel_noise_density=0.1, jitter_std=0.001)
    plain, coloured = _error(noise)[2], _error(replace(noise, **COLOURED))[2]
    assert np.array_equal(plain.imu.stamp_ns, coloured.imu.stamp_ns)
    flicker = coloured.gyro_bias_b - plain.gyro_bias_b
    assert flicker.std() > 0.02
    assert coloured.imu.gyro_b - plain.imu.gyro_b == pytest.approx(flicker, abs=1e-15)
    assert np.array_equal(plain.accel_bias_b, coloured.accel_bias_b)


def test_vibration_is_a_band_about_its_frequency():
    _, accel, _ = _error(ImuErrors(**COLOURED, vibration_time=1.0))
    assert accel.std() == pytest.approx(0.5, rel=STATISTICS)
    power = np.sum(np.abs(np.fft.rfft(accel, axis=0)) ** 2, axis=1)
    near = np.abs(np.fft.rfftfreq(COUNT, 1.0 / RATE) - 20.0) < 2.0
    assert power[near].sum() > 0.9 * power.sum()


def test_counting_the_angle_loses_none_of_it():
    errors = ImuErrors(gyro_angle_resolution=1e-3, gyro_noise_density=0.01)
    counted, _, _ = _error(errors, rate_b=(0.1, 0.0, 0.0))
    smooth, _, _ = _error(replace(errors, gyro_angle_resolution=0.0), rate_b=(0.1, 0.0, 0.0))
    assert np.abs(np.cumsum(counted - smooth, axis=0) / RATE).max() == pytest.approx(0.5e-3, rel=0.01)
    counts = (counted + [0.1, 0.0, 0.0]) / RATE / 1e-3
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_compensation_takes_the_constant_errors_out(sensor):
    errors = ImuErrors(**{f"{sensor}_bias_std": 0.5, f"{sensor}_scale_std": 0.02,
                          f"{sensor}_misalignment_std": 0.02})
    truth = {"rate_b": (0.3, -0.2, 0.1), "force_b": (1.0, 2.0, -9.0)}
    imu, (_, _, measured) = _imu(10, **truth), _error(errors, count=10, **truth)
    reading = getattr(measured.imu, f"{sensor}_b")
    assert np.abs(reading - getattr(imu, f"{sensor}_b")).max() > 0.1
    calibration = getattr(measured, f"{sensor}_calibration")
    np.testing.assert_allclose(calibration.compensate(reading), getattr(imu, f"{sensor}_b"), atol=1e-14)


def test_real_sensors_are_ordered_by_their_grade():
    grades = [PROFILES[name].imu for name in ("icm20948", "adis16448", "adis16488a", "kvh1750", "hg9900")]
    for figure in ("gyro_noise_density", "gyro_bias_std", "accel_bias_std"):
        values = [getattr(errors, figure) for errors in grades]
        assert values == sorted(values, reverse=True), figure
