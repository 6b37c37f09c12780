"""Kinds of motion that pass for something else: a slow hand or a boat for rest, a long acceleration for gravity.

Of each the user's view: how large the tilt error is, and whether the covariance knows it.
"""

from dataclasses import replace

import numpy as np
import pytest

from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.smoother import smooth
from inertial.earth import STANDARD_GRAVITY
from inertial.imu_errors import PROFILES
from inertial.recording import AltitudeSeries, ImuSeries
from inertial.rotation import down_from_quaternion
from inertial.scoring import tilt_error_n
from inertial.simulator import Trajectory, add_errors, make_trajectory, sample_trajectory
from inertial.trajectory import Motion, Profile, car, flight

CONSUMER = PROFILES["consumer"]
RATE = 100.0  # Hz
SECONDS = 100.0
SEEDS = (1, 2, 3)
SETTLE = 5.0  # s
HONEST = 1.3  # NEES/2: 1 is exact
TRAIN_ALONE = 20.0  # the same without an altimeter: its gyro bias is pulled along, too, and it passes for rest
SMOOTHED_ALONE = 3.5  # the same smoothed: the way back believes the pulled attitude more; 40 were the pull not told
CLOSED = 0.5  # of sigma without the altimeter, half a minute after its return
BEYOND_3_SIGMA = 0.08
BIAS_SIGMAS = 4.0  # that a bias may be off by after the first seconds
START_RMS_DEG = 12.0  # over half a minute, from a start at 30 to 42 deg of bank
START_HONEST = 30.0  # NEES/2: the turn looks like a gyro bias; taken for rest it is some hundreds
START_BEYOND = 0.4  # beyond 3 sigma: it cannot know at once that it is turning


def _swaying(roll, pitch, sideways):
    """Return the motion of a body that rolls and pitches; each argument gives value, 1st and 2nd derivative."""
    def motion(t):
        zero = np.zeros_like(t)
        (a, a_rate, _), (b, b_rate, _), (_, speed, acceleration) = roll(t), pitch(t), sideways(t)
        return Motion(a, b, zero, a_rate, b_rate, zero, np.stack([zero, speed, zero], -1),
                      np.stack([zero, acceleration, zero], -1))
    return motion


def _wave(size, period, phase=0.0):
    """Return a sine, as the three derivatives that ``_swaying`` takes."""
    w = 2.0 * np.pi / period

    def value(t):
        return (size * np.sin(w * t + phase), size * w * np.cos(w * t + phase), -size * w**2 * np.sin(w * t + phase))
    return value


def _swell(size, period):
    """Return a wave that grows from nothing within some 10 s."""
    def value(t):
        grown, growth = np.tanh(t / 10.0) ** 2, 2.0 * np.tanh(t / 10.0) / np.cosh(t / 10.0) ** 2 / 10.0
        bent = (2.0 / np.cosh(t / 10.0) ** 4 - 4.0 * np.tanh(t / 10.0) ** 2 / np.cosh(t / 10.0) ** 2) / 100.0
        wave, rate, acceleration = _wave(size, period)(t)
        return grown * wave, grown * rate + growth * wave, grown * acceleration + 2.0 * growth * rate + bent * wave
    return value


def _train():
    """A minute to 50 m/s, long bends, braking for half a minute."""
    speed = Profile([5.0, 50.0, 65.0, 95.0], [0.0, 50.0, 50.0, 15.0])
    curvature = Profile([500.0, 900.0, 1500.0, 1900.0, 2400.0], [0.0, 1e-3, 1e-3, -1e-3, -1e-3])
    return car(speed, curvature, Profile([0.0, 1000.0, 2000.0, 3000.0], [0.0, 0.02, -0.02, 0.0]))


def _loiter():
    """A fixed wing in one turn of 15 deg of bank for more than a minute."""
    turn = Profile([8.0, 14.0], [0.0, STANDARD_GRAVITY * np.tan(np.radians(15.0)) / 30.0])
    climb = Profile([3.0, 20.0, 40.0, 60.0, 80.0], [0.0, 0.04, -0.03, 0.04, 0.0])
    return flight(Profile([3.0, 13.0], [0.0, 30.0]), climb, turn, Profile([0.0, 1.0], [0.0, 0.0]), STANDARD_GRAVITY)


# Motion, tilt RMS in deg that it may cost, NEES/2 (1 is exact). A hand at 3 deg/s and a boat's first swell are quiet
# enough for rest; a train's minute of acceleration looks like a gyro bias.
MOTIONS = {
    "hand": (_swaying(_wave(0.25, 30.0), _wave(0.15, 40.0, 1.0), _wave(0.0, 1.0)), 2.5, 1.3),
    "boat": (_swaying(_swell(0.2, 8.0), _swell(0.06, 6.0), _swell(1.2, 8.0)), 1.0, 1.3),
    "train": (_train(), 2.5, 3.5),
    "loiter": (_loiter(), 1.5, 1.3),
}


def _runs(trajectory, imu_errors=CONSUMER.imu):
    """Yield estimates, true gyro bias and true down direction of each seed."""
    sampled = sample_trajectory(trajectory, imu_rate=RATE)
    down_b = down_from_quaternion(sampled.truth.q_nb_wxyz)
    for seed in SEEDS:
        recording = add_errors(sampled, imu_errors, CONSUMER.altimeter, np.random.default_rng(seed))
        yield recording, down_b


def _from(recording, first):
    """Return IMU and altitude of a recording that begins with the sample ``first``."""
    imu, altitude = recording.imu, recording.altitude
    imu = ImuSeries(imu.stamp_ns[first:], imu.gyro_b[first:], imu.accel_b[first:])
    late = altitude.stamp_ns > imu.stamp_ns[0]
    return imu, AltitudeSeries(altitude.stamp_ns[late], altitude.altitude[late],
                               np.maximum(altitude.arrival[late] - first, 0))


def _judge(estimates, down_b, settle):
    """Return squared tilt errors (rad^2), NEES/2 and whether beyond 3 sigma, of each settled sample."""
    used = (estimates.stamp_ns - estimates.stamp_ns[0] > settle * 1e9) & estimates.valid
    error, covariance = tilt_error_n(estimates.q_nb_wxyz, down_b)[used], estimates.tilt_covariance_n[used]
    squares = np.sum(error**2, axis=1)
    nees = np.sum(error * np.linalg.solve(covariance, error[..., None])[..., 0], axis=1)
    return squares, nees / 2, squares > 9 * np.trace(covariance, axis1=1, axis2=2)


@pytest.mark.parametrize("name", MOTIONS)
def test_what_passes_for_rest_or_gravity_costs_little_and_the_covariance_knows(name):
    motion, limit_deg, honest = MOTIONS[name]
    squares, nees, beyond = [], [], []
    for recording, down_b in _runs(Trajectory(name, SECONDS, motion, STANDARD_GRAVITY)):
        estimates, _ = AttitudeEstimator().run(recording.imu, recording.altitude)
        assert np.mean(estimates.valid) > 0.9
        for values, value in zip((squares, nees, beyond), _judge(estimates, down_b, SETTLE), strict=True):
            values.append(np.mean(value))
    assert np.degrees(np.sqrt(np.mean(squares))) < limit_deg
    assert np.mean(nees) < honest
    assert np.mean(beyond) < BEYOND_3_SIGMA


@pytest.mark.parametrize(("name", "honest", "beyond_3_sigma"), [
    ("train", TRAIN_ALONE, 0.7), ("loiter", HONEST, BEYOND_3_SIGMA)])
def test_without_an_altimeter_long_accelerations_pull_the_attitude_along_and_the_covariance_knows(
        name, honest, beyond_3_sigma):
    nees, beyond = [], []
    for recording, down_b in _runs(Trajectory(name, SECONDS, MOTIONS[name][0], STANDARD_GRAVITY)):
        estimates, _ = AttitudeEstimator().run(recording.imu)
        _, one_nees, one_beyond = _judge(estimates, down_b, SETTLE)
        nees.append(np.mean(one_nees))
        beyond.append(np.mean(one_beyond))
    assert np.mean(nees) < honest
    assert np.mean(beyond) < beyond_3_sigma


def test_a_smoothed_attitude_without_an_altimeter_is_pulled_along_too_and_its_covariance_knows():
    nees = []
    for recording, down_b in _runs(Trajectory("loiter", SECONDS, MOTIONS["loiter"][0], STANDARD_GRAVITY)):
        estimates, *_ = smooth(recording.imu)
        nees.append(np.mean(_judge(estimates, down_b, SETTLE)[1]))
    assert np.mean(nees) < SMOOTHED_ALONE


def test_once_there_is_an_altimeter_again_the_covariance_closes():
    recording, _ = next(_runs(Trajectory("loiter", SECONDS, MOTIONS["loiter"][0], STANDARD_GRAVITY)))
    altitude = recording.altitude
    seconds = (altitude.stamp_ns - altitude.stamp_ns[0]) * 1e-9
    back = (seconds < 5.0) | (seconds > 60.0)
    altitude = AltitudeSeries(altitude.stamp_ns[back], altitude.altitude[back], altitude.arrival[back])
    estimates, _ = AttitudeEstimator().run(recording.imu, altitude)
    sigma = np.sqrt(np.trace(estimates.tilt_covariance_n, axis1=1, axis2=2))
    assert sigma[round(95 * RATE)] < CLOSED * sigma[round(60 * RATE)]


@pytest.mark.parametrize("name", ["hand", "boat"])
def test_a_slow_motion_is_not_taken_for_the_gyro_bias(name):
    for recording, _ in _runs(Trajectory(name, 20.0, MOTIONS[name][0], STANDARD_GRAVITY)):
        estimates, _ = AttitudeEstimator().run(recording.imu)
        off = (estimates.gyro_bias_b - recording.gyro_bias_b)[:, :2]
        sigma = np.sqrt(estimates.gyro_bias_variance[:, :2])
        assert np.all(np.abs(off[estimates.valid]) < BIAS_SIGMAS * sigma[estimates.valid])


@pytest.mark.parametrize("start", [30.0, 47.0, 61.0])
def test_a_start_in_a_coordinated_turn_is_found_out(start):
    first = round(start * RATE)
    squares, beyond = [], []
    for recording, down_b in _runs(make_trajectory("turn", duration=start + 30.0)):
        imu, altitude = _from(recording, first)
        estimates, fresh = AttitudeEstimator().run(imu, altitude)
        one_squares, _, one_beyond = _judge(estimates, down_b[first:][fresh], 0.0)
        squares.append(np.mean(one_squares))
        beyond.append(np.mean(one_beyond))
    assert np.degrees(np.sqrt(np.mean(squares))) < START_RMS_DEG
    assert np.mean(beyond) < START_BEYOND


def test_a_start_in_a_slow_steady_turn_is_not_taken_for_rest():
    first = round(30.0 * RATE)
    for recording, down_b in _runs(Trajectory("loiter", 70.0, MOTIONS["loiter"][0], STANDARD_GRAVITY)):
        imu, altitude = _from(recording, first)
        estimates, fresh = AttitudeEstimator().run(imu, altitude)
        assert np.mean(_judge(estimates, down_b[first:][fresh], SETTLE)[1]) < START_HONEST


@pytest.mark.parametrize("scenario", ["turn", "quad"])
def test_vibration_that_aliases_is_in_the_covariance(scenario):
    shaken = replace(CONSUMER.imu, accel_vibration_std=5.0, gyro_vibration_std=0.02, vibration_frequency=30.0)
    nees = []
    for recording, down_b in _runs(make_trajectory(scenario, duration=SECONDS), shaken):
        estimates, _ = AttitudeEstimator().run(recording.imu, recording.altitude)
        nees.append(np.mean(_judge(estimates, down_b, SETTLE)[1]))
    assert np.mean(nees) < HONEST
