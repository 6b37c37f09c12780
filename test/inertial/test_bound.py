"""The Cramer-Rao bound against least squares, against closed forms, and as a bound."""

import math
from dataclasses import astuple

import numpy as np
import pytest

from inertial.bound import SensorNoise, tilt_bound
from inertial.imu_errors import PROFILES
from inertial.recording import ImuSeries
from inertial.rotation import down_from_quaternion, down_from_roll_pitch, zoh_integrals
from inertial.simulator import make_trajectory, sample_trajectory

ROUNDING = 1e-6  # relative, of information summed over a thousand samples
GRAVITY = 9.80665
RATE = 50
QUIET = {"gyro_noise_density": 0.0, "accel_noise_density": 0.0}


def _manoeuvre(duration=20.0):
    sampled = sample_trajectory(make_trajectory("quad", duration=duration, rest=1.0), imu_rate=RATE)
    return sampled.imu, down_from_quaternion(sampled.truth.q_nb_wxyz)


def _standing(duration, down_b):
    n = int(duration * RATE)
    stamp_ns = 1_000_000_000 + np.arange(n) * round(1e9 / RATE)
    return ImuSeries(stamp_ns, np.zeros((n, 3)), np.tile(-GRAVITY * down_b, (n, 1))), np.tile(down_b, (n, 1))


def test_without_sensor_noise_it_is_the_inverse_of_the_information_of_all_altitudes():
    imu, down_b = _manoeuvre()
    noise = SensorNoise(**QUIET, altitude_std=0.5)
    tilt_std = 0.1
    bound = tilt_bound(imu, down_b, imu.stamp_ns, noise, tilt_std=tilt_std)
    projector = np.eye(3) - np.outer(down_b[0], down_b[0])
    basis = np.linalg.svd(projector)[0][:, :2]
    # Columns: what the two tilt axes, the velocity and the altitude at the start do to each state.
    effect = np.zeros((5, 4))
    effect[:3, :2], effect[3, 2], effect[4, 3] = basis, 1.0, 1.0
    information = np.diag([2 / tilt_std**2, 2 / tilt_std**2, 1 / 2.0**2, 1 / 5.0**2])
    for k in range(len(imu)):
        if k > 0:
            R, J1, J2 = zoh_integrals(imu.gyro_b[k], 1 / RATE)
            F = np.eye(5)
            F[:3, :3], F[3, :3] = R.T, J1 @ imu.accel_b[k]
            F[4, :3], F[4, 3] = -J2 @ imu.accel_b[k], -1 / RATE
            effect = F @ effect
        information += np.outer(effect[4], effect[4]) / 0.5**2
    covariance = effect @ np.linalg.solve(information, effect.T)
    assert bound.tilt_std[-1] == pytest.approx(math.sqrt(np.trace(covariance[:3, :3])), rel=ROUNDING)
    assert bound.vd_std[-1] == pytest.approx(math.sqrt(covariance[3, 3]), rel=ROUNDING)
    assert bound.altitude_std[-1] == pytest.approx(math.sqrt(covariance[4, 4]), rel=ROUNDING)
    assert bound.tilt_std[-1] < 0.2 * tilt_std


def test_at_rest_nothing_shows_the_tilt_and_it_walks_with_the_gyro():
    down_b = down_from_roll_pitch(0.3, -0.2)
    imu, truth = _standing(40.0, down_b)
    noise = SensorNoise(gyro_noise_density=1e-3)
    bound = tilt_bound(imu, truth, imu.stamp_ns, noise, tilt_std=0.02)
    t = (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9
    np.testing.assert_allclose(bound.tilt_std, np.sqrt(0.02**2 + 2 * 1e-6 * t), rtol=ROUNDING)


def test_at_rest_a_gyro_bias_brings_its_horizontal_part_times_the_time():
    imu, truth = _standing(40.0, np.array([0.0, 0.0, 1.0]))
    noise = SensorNoise(gyro_noise_density=0.0, gyro_bias_std=1e-3)
    bound = tilt_bound(imu, truth, imu.stamp_ns, noise, tilt_std=0.02)
    t = (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9
    np.testing.assert_allclose(bound.tilt_std, np.sqrt(0.02**2 + 2 * (1e-3 * t) ** 2), rtol=ROUNDING)
    np.testing.assert_allclose(bound.gyro_bias_std, 1e-3, rtol=ROUNDING)


def test_altitudes_between_samples_count_at_their_own_stamps():
    imu, down_b = _manoeuvre()
    on = tilt_bound(imu, down_b, imu.stamp_ns[1::2], SensorNoise(altitude_std=0.5))
    between = tilt_bound(imu, down_b, imu.stamp_ns[1::2] - 10_000_000, SensorNoise(altitude_std=0.5))
    assert on.tilt_std[-1] != between.tilt_std[-1]
    assert between.tilt_std[-1] == pytest.approx(on.tilt_std[-1], rel=0.02)  # half a sample of manoeuvre


@pytest.mark.parametrize("worse", [
    {"gyro_noise_density": 2e-3}, {"accel_noise_density": 0.1}, {"altitude_std": 4.0},
    {"gyro_bias_std": 0.01}, {"gyro_bias_walk": 1e-3}, {"accel_bias_std": 0.1}, {"accel_bias_walk": 0.05}])
def test_every_error_of_the_sensors_raises_it(worse):
    imu, down_b = _manoeuvre()
    best = tilt_bound(imu, down_b, imu.stamp_ns, SensorNoise())
    other = tilt_bound(imu, down_b, imu.stamp_ns, SensorNoise(**worse))
    assert np.all(other.tilt_std >= best.tilt_std * (1 - ROUNDING))
    assert other.tilt_std[-1] > 1.01 * best.tilt_std[-1]


def test_a_profile_gives_its_noise_and_biases():
    assert astuple(SensorNoise.of(PROFILES["paper"])) == pytest.approx(astuple(SensorNoise()))
    consumer, noise = PROFILES["consumer"], SensorNoise.of(PROFILES["consumer"])
    assert noise.gyro_noise_density == consumer.imu.gyro_noise_density
    assert noise.altitude_std == consumer.altimeter.noise_std
    assert noise.gyro_bias_std > consumer.imu.gyro_bias_std
    assert noise.accel_bias_walk > consumer.imu.accel_walk_density


def test_bad_arguments_are_named():
    imu, down_b = _manoeuvre(2.0)
    with pytest.raises(ValueError, match="down_b"):
        tilt_bound(imu, down_b[1:], imu.stamp_ns, SensorNoise())
    with pytest.raises(ValueError, match="altitude_ns"):
        tilt_bound(imu, down_b, imu.stamp_ns[::-1], SensorNoise())
    with pytest.raises(ValueError, match="altitude_std"):
        SensorNoise(altitude_std=0.0)
