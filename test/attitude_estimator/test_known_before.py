"""What is known before a run: stored biases, the noise that messages tell, the altimeter's delay."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from attitude_estimator import cli
from attitude_estimator.biases import aged_accel_bias, aged_gyro_bias, start_with_biases
from attitude_estimator.delay import fit_delay
from attitude_estimator.edge import AttitudeNodeParams, MessageNoise, biases_to_store, start_with_stored
from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.params import AttitudeParams
from attitude_estimator.rivals import make_estimator
from inertial.imu_errors import PROFILES
from inertial.simulator import simulate
from nav_ros.bags import BagWriter, read_messages
from nav_ros.bias_file import StoredBiases, write_biases
from nav_ros.frames import swap_flu_frd
from nav_ros.messages import GYRO, IMU, decode_batch
from nav_ros.recorded import recorded_messages

BIAS, STD = np.array([0.02, -0.01, 0.005]), np.full(3, 1e-3)
DAY = 86400.0
SIGMAS = 3.0
ZERO = (0.0,) * 9


def diagonal(*variances):
    return tuple(np.diag(variances).ravel().tolist())


@cache
def recording(scenario="vertical_plane", delay=0.03):
    altimeter = replace(PROFILES["consumer"].altimeter, delay=delay)
    return simulate(scenario, duration=60.0, imu_rate=100.0, seed=5, altimeter_errors=altimeter)


def test_a_gyro_bias_ages_from_what_was_known_to_the_prior():
    params = AttitudeParams()
    bias, std = aged_gyro_bias(BIAS, STD, 0.0, params)
    np.testing.assert_allclose(bias, BIAS, rtol=2e-3)
    np.testing.assert_allclose(std, STD, rtol=2e-3)
    spreads = [aged_gyro_bias(BIAS, STD, age, params)[1][0] for age in (0.0, 60.0, 3600.0, DAY, 1e4 * DAY)]
    assert spreads == sorted(spreads) and spreads[-1] == pytest.approx(params.gyro_bias_std, rel=1e-3)
    assert spreads[2] == pytest.approx(np.hypot(1e-3, params.gyro_bias_walk * 60.0), rel=0.02)
    np.testing.assert_allclose(aged_gyro_bias(BIAS, STD, 1e4 * DAY, params)[0], 0.0, atol=1e-3 * BIAS.max())


def test_an_accelerometer_bias_is_forgotten_in_its_correlation_time():
    params = AttitudeParams()
    bias, std = aged_accel_bias(BIAS, STD, params.accel_bias_time, params)
    np.testing.assert_allclose(bias, BIAS * np.exp(-1.0))
    assert STD[0] < std[0] < params.accel_bias_std
    assert aged_accel_bias(BIAS, STD, DAY, params)[1] == pytest.approx([params.accel_bias_std] * 3)


def test_a_start_with_the_biases_of_the_run_before_knows_them_at_once():
    run = recording()
    estimator = AttitudeEstimator()
    estimates, _ = estimator.run(run.imu, run.altitude)
    stored = biases_to_store(estimator.estimate)
    again = AttitudeEstimator()
    start_with_stored(again, stored, int(run.imu.stamp_ns[-1]) + 60 * 10**9)
    again.add_imu(int(run.imu.stamp_ns[0]), run.imu.gyro_b[0], run.imu.accel_b[0])
    start = again.estimate
    spread = np.sqrt(start.gyro_bias_variance)
    prior, last = AttitudeParams().gyro_bias_std**2, estimates.gyro_bias_variance[-1]
    assert np.all(spread**2 > prior * last / (prior + last))  # older than the last estimate, but the prior counts, too
    assert np.all(spread < 0.5 * AttitudeParams().gyro_bias_std)
    assert np.all(np.abs(start.gyro_bias_b - estimates.gyro_bias_b[-1]) < 0.1 * spread)
    assert np.all(np.abs(start.gyro_bias_b - run.gyro_bias_b[0]) < SIGMAS * spread)


def test_other_estimators_have_no_biases_to_start_with():
    with pytest.raises(ValueError, match="only dcm_row has biases"):
        start_with_biases(make_estimator(AttitudeParams(estimator="gyro")), BIAS, STD, BIAS, STD)
    with pytest.raises(ValueError, match="bias_file = 'b.yaml': complementary estimates no biases"):
        AttitudeNodeParams(estimator="complementary", bias_file="b.yaml")


def test_message_covariances_become_densities():
    noise, params = MessageNoise(), AttitudeNodeParams(use_message_covariance=True)
    assert noise.take(diagonal(4e-4, 4e-4, 4e-4), diagonal(0.01, 0.04, 0.01))
    used = noise.applied(params, 0.005)
    assert used.gyro_noise_density == pytest.approx(0.02 * 0.005 ** 0.5)
    assert used.accel_noise_density == pytest.approx((0.02 * 0.005) ** 0.5)
    assert not noise.take(diagonal(4e-4, 4e-4, 4e-4), diagonal(0.01, 0.04, 0.01)) and not noise.invalid
    assert repr(noise.applied(AttitudeNodeParams(), 0.005)) == repr(AttitudeNodeParams())  # NaN is not NaN


@pytest.mark.parametrize("covariance, invalid", [
    (ZERO, False), ((-1.0, *ZERO[1:]), True), (diagonal(1e-4, -1e-4, 1e-4), True), (diagonal(1e12, 1e12, 1e12), True),
    ((1e-4, 1e-5, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 1e-4), True), (diagonal(np.nan, 1.0, 1.0), True),
    ((0.0, 1e-4, *ZERO[2:]), True)])
def test_a_covariance_that_is_unknown_or_none_leaves_the_parameter(covariance, invalid):
    noise, params = MessageNoise(), AttitudeNodeParams(use_message_covariance=True)
    noise.take(covariance, diagonal(0.01, 0.01, 0.01))
    used = noise.applied(params, 0.01)
    assert used.gyro_noise_density == params.gyro_noise_density
    assert used.accel_noise_density == pytest.approx(0.01)
    assert noise.invalid == invalid


@pytest.mark.parametrize("delay", [0.03, 0.25])
def test_the_delay_of_the_altimeter_is_found(delay):
    run = recording(delay=delay)
    fit = fit_delay(run.imu, run.altitude, AttitudeParams())
    assert abs(fit.delay - delay) < SIGMAS * fit.std and fit.std < 0.04


def test_a_recording_that_does_not_show_the_delay_says_so():
    run = recording("hover")
    with pytest.raises(ValueError, match="too little climbing"):
        fit_delay(run.imu, run.altitude, AttitudeParams())
    few = replace(run.altitude, stamp_ns=run.altitude.stamp_ns[:250], altitude=run.altitude.altitude[:250],
                  arrival=run.altitude.arrival[:250])
    with pytest.raises(ValueError, match="the delay needs 100 or more"):
        fit_delay(run.imu, few, AttitudeParams())


def written(path, run):
    types, messages = recorded_messages(run)
    with BagWriter(path, types) as writer:
        for message in messages:
            writer.write(*message)
    return str(path)


def test_estimate_bag_finds_the_delay_and_starts_with_stored_biases(tmp_path, capsys):
    run = recording(delay=0.25)
    bag = written(tmp_path / "run", run)
    last = int(run.imu.stamp_ns[0]) - 10 * 10**9
    write_biases(tmp_path / "biases.yaml", StoredBiases(
        last, tuple(swap_flu_frd(run.gyro_bias_b[0])), (1e-4,) * 3, (0.0,) * 3, (0.05,) * 3))
    cli.main([bag, str(tmp_path / "out"), "--fit-delay", "-p", f"bias_file:={tmp_path / 'biases.yaml'}"])
    told = capsys.readouterr()
    assert float(told.out.split("altitude_delay ")[1].split(" s")[0]) == pytest.approx(0.25, abs=0.05)
    assert told.err == ""
    first = decode_batch(IMU, [next(read_messages(tmp_path / "out", ["/imu/data"])).raw]).values[0]
    truth = run.imu.gyro_b[0] - run.gyro_bias_b[0]
    np.testing.assert_allclose(swap_flu_frd(first[GYRO]), truth, atol=2e-3)
    assert "stamp_ns: " + str(last) in (tmp_path / "biases.yaml").read_text()


def test_estimate_bag_names_the_unit_and_the_delay_that_is_not_to_be_found(tmp_path, capsys):
    run = recording("hover")
    run = replace(run, imu=replace(run.imu, accel_b=run.imu.accel_b / 9.80665))
    cli.main([written(tmp_path / "run", run), str(tmp_path / "out"), "--fit-delay"])
    delay, unit, attitude = capsys.readouterr().err.splitlines()
    assert "altitude_delay stays 0 s" in delay and "it looks like g" in unit
    assert "no sample has an attitude" in attitude
