"""Simulated samples are exact: a strapdown integration of them gives the truth back."""

from functools import cache

import numpy as np
import pytest

from inertial import rotation
from inertial.earth import EARTH_RATE, STANDARD_GRAVITY, normal_gravity
from inertial.imu_errors import PROFILES, AltimeterErrors, ImuErrors
from inertial.recording import Recording
from inertial.scenarios import SCENARIOS
from inertial.simulator import add_errors, make_trajectory, sample_trajectory, simulate

DURATION = 60.0
# One constant rate and force per sample leaves coning and sculling errors of second order in the
# interval; with twice the rate they fall to a quarter. Sensor noise is a hundred times larger.
TILT_400_HZ_DEG = 3e-4
VELOCITY_400_HZ = 1e-3
ALTITUDE_400_HZ = 0.02
SECOND_ORDER = (3.5, 4.5)
QUADRATURE_RATE = 1e-8  # rad/s, error of a sample's mean rate: 2e-3 deg/h
QUADRATURE_FORCE = 1e-7  # m/s^2, error of a sample's mean force: 10 ng
ROUNDING = 1e-9
CLOSED = 1e-4  # m, altitude gained or lost over ten minutes of closed cycles
HIGHEST = 500.0  # m, well inside the range of a barometer

ALL = pytest.mark.parametrize("name", SCENARIOS)


@cache
def _sampled(name, imu_rate=100.0, latitude=None):
    return sample_trajectory(make_trajectory(name, duration=DURATION, latitude=latitude),
                             imu_rate=imu_rate)


def _strapdown(sampled):
    """Integrate the samples from the true start; return down_b, velocity down, position down."""
    dcm_nb = rotation.dcm_from_quaternion(sampled.truth.q_nb_wxyz[0])
    velocity_n, position_n = sampled.velocity_n[0].copy(), sampled.position_n[0].copy()
    gravity_n = np.array([0.0, 0.0, sampled.gravity])
    intervals = np.diff(sampled.imu.stamp_ns) * 1e-9
    out = [(dcm_nb[2], velocity_n[2], position_n[2])]
    for dt, gyro_b, accel_b in zip(intervals, sampled.imu.gyro_b[1:], sampled.imu.accel_b[1:],
                                   strict=True):
        R, J1, J2 = rotation.zoh_integrals(gyro_b, dt)
        position_n = position_n + velocity_n * dt + dcm_nb @ J2 @ accel_b + gravity_n * dt ** 2 / 2
        velocity_n = velocity_n + dcm_nb @ J1 @ accel_b + gravity_n * dt
        dcm_nb = dcm_nb @ R
        out.append((dcm_nb[2], velocity_n[2], position_n[2]))
    return [np.array(column) for column in zip(*out, strict=True)]


def _strapdown_errors(sampled):
    down_b, velocity, position = _strapdown(sampled)
    truth_b = rotation.down_from_quaternion(sampled.truth.q_nb_wxyz)
    tilt_deg = np.degrees(np.linalg.norm(np.cross(down_b, truth_b), axis=1).max())
    return (tilt_deg, np.abs(velocity - sampled.velocity_n[:, 2]).max(),
            np.abs(position - sampled.position_n[:, 2]).max())


@ALL
def test_integrating_the_samples_gives_attitude_velocity_and_altitude_back(name):
    tilt_deg, velocity, altitude = _strapdown_errors(_sampled(name, 400.0))
    assert tilt_deg < TILT_400_HZ_DEG
    assert velocity < VELOCITY_400_HZ
    assert altitude < ALTITUDE_400_HZ


def test_what_is_left_is_of_second_order_in_the_sample_interval():
    low, high = SECOND_ORDER
    coarse, fine = (_strapdown_errors(_sampled("quad", rate)) for rate in (200.0, 400.0))
    for larger, smaller in zip(coarse, fine, strict=True):
        assert low < larger / smaller < high


@ALL
def test_samples_are_means_over_the_interval_that_ends_at_the_stamp(name):
    sampled = _sampled(name)
    trajectory = make_trajectory(name, duration=DURATION)
    t = (sampled.imu.stamp_ns - sampled.imu.stamp_ns[0]) * 1e-9
    nodes, weights = np.polynomial.legendre.leggauss(12)
    at = t[:, None] - 0.01 * 0.5 * (1 - nodes)
    gyro_b, accel_b = (np.einsum("k,nki->ni", 0.5 * weights, values)
                       for values in trajectory.sensed(trajectory.at(at)))
    assert np.abs(sampled.imu.gyro_b - gyro_b).max() < QUADRATURE_RATE
    assert np.abs(sampled.imu.accel_b - accel_b).max() < QUADRATURE_FORCE


def test_at_rest_force_is_minus_gravity():
    recording = simulate("turn", duration=3.0, rest=3.0, profile="perfect")
    assert recording.imu.accel_b == pytest.approx(
        np.tile([0.0, 0.0, -STANDARD_GRAVITY], (600, 1)), abs=ROUNDING)
    assert recording.imu.gyro_b == pytest.approx(np.zeros((600, 3)), abs=ROUNDING)
    assert recording.truth.q_nb_wxyz == pytest.approx(np.tile([1.0, 0, 0, 0], (600, 1)))


def test_with_a_latitude_the_earth_turns_and_gravity_is_normal():
    latitude = np.radians(35.0)
    sampled = sample_trajectory(make_trajectory("hover", duration=3.0, latitude=latitude))
    assert sampled.gravity == pytest.approx(normal_gravity(latitude))
    assert sampled.imu.gyro_b[0] == pytest.approx(
        [EARTH_RATE * np.cos(latitude), 0.0, -EARTH_RATE * np.sin(latitude)])
    assert sampled.imu.accel_b[0] == pytest.approx([0.0, 0.0, -sampled.gravity])


def test_a_northbound_vehicle_is_held_against_the_coriolis_force():
    latitude = np.radians(50.0)
    trajectory = make_trajectory("straight", duration=DURATION, latitude=latitude)
    _, accel_b = trajectory.sensed(trajectory.at(50.0))
    # To stay on the meridian it is pushed west by 2 Omega sin L v; it is lighter by v^2 / R.
    assert accel_b[1] == pytest.approx(-2 * EARTH_RATE * np.sin(latitude) * 25.0, rel=1e-6)
    assert accel_b[2] + trajectory.gravity == pytest.approx(25.0 ** 2 / 6.373e6, rel=1e-2)


def test_same_seed_same_bytes_other_seed_other_noise():
    first, again, other = (simulate("car", duration=5.0, seed=seed) for seed in (7, 7, 8))
    assert isinstance(first, Recording)
    assert first.imu.gyro_b.tobytes() == again.imu.gyro_b.tobytes()
    assert first.imu.accel_b.tobytes() == again.imu.accel_b.tobytes()
    assert first.altitude.altitude.tobytes() == again.altitude.altitude.tobytes()
    assert not np.array_equal(first.imu.gyro_b, other.imu.gyro_b)
    assert first.truth.q_nb_wxyz.tobytes() == other.truth.q_nb_wxyz.tobytes()


def test_many_draws_of_one_motion_equal_simulating_anew():
    sensors = PROFILES["consumer"]
    sampled = sample_trajectory(make_trajectory("turn", duration=5.0), imu_rate=200.0)
    draw = add_errors(sampled, sensors.imu, sensors.altimeter, np.random.default_rng(4))
    whole = simulate("turn", duration=5.0, seed=4)
    assert np.array_equal(draw.imu.gyro_b, whole.imu.gyro_b)
    assert np.array_equal(draw.altitude.altitude, whole.altitude.altitude)


def test_the_true_bias_is_told():
    errors = ImuErrors(gyro_bias_std=0.01, gyro_drift_std=0.01, accel_bias_std=0.1)
    biased, plain = (simulate("hover", duration=4.0, imu_errors=e, profile="perfect")
                     for e in (errors, ImuErrors()))
    assert biased.imu.gyro_b - plain.imu.gyro_b == pytest.approx(biased.gyro_bias_b, abs=ROUNDING)
    assert biased.imu.accel_b - plain.imu.accel_b == pytest.approx(
        biased.accel_bias_b, abs=ROUNDING)
    assert biased.gyro_bias_b.any()


def test_dropouts_take_samples_and_biases_but_not_the_truth():
    errors = ImuErrors(dropout_share=0.3, jitter_std=0.001, gyro_bias_std=0.1)
    recording = simulate("hover", duration=10.0, imu_errors=errors)
    assert len(recording.truth) == 2000
    assert len(recording.imu) < 1600
    assert len(recording.gyro_bias_b) == len(recording.imu.gyro_b) == len(recording.imu)
    assert np.all(np.diff(recording.imu.stamp_ns) > 0)


def test_altitude_is_late_by_its_delay():
    errors = AltimeterErrors(delay=0.25)
    recording = simulate("hover", duration=10.0, altimeter_rate=20.0, profile="perfect",
                         altimeter_errors=errors)
    sampled_ns = recording.altitude.stamp_ns - 250_000_000
    truth = np.interp(sampled_ns - recording.truth.stamp_ns[0],
                      recording.truth.stamp_ns - recording.truth.stamp_ns[0],
                      -recording.position_n[:, 2])
    assert recording.altitude.altitude == pytest.approx(truth, abs=1e-4)
    assert recording.altitude.altitude[-1] > 1.0


def test_altitude_between_imu_stamps_is_exact():
    fine = sample_trajectory(make_trajectory("aerobatic", duration=30.0), imu_rate=500.0)
    coarse = sample_trajectory(make_trajectory("aerobatic", duration=30.0), imu_rate=50.0)
    dense, sparse = (add_errors(s, ImuErrors(), AltimeterErrors(), np.random.default_rng(0),
                                altimeter_rate=125.0).altitude for s in (fine, coarse))
    common = min(len(dense), len(sparse))
    assert dense.altitude[:common] == pytest.approx(sparse.altitude[:common], abs=1e-4)


def test_arrival_counts_the_imu_samples_before_each_altitude():
    recording = simulate("hover", duration=2.0, imu_rate=100.0, altimeter_rate=10.0)
    assert recording.altitude.arrival[:3].tolist() == [1, 11, 21]
    imu_ns, altitude_ns = recording.imu.stamp_ns, recording.altitude.stamp_ns
    assert np.all(imu_ns[recording.altitude.arrival - 1] <= altitude_ns)


def test_rates_and_count_are_what_was_asked():
    recording = simulate("straight", duration=2.0, imu_rate=333.0, altimeter_rate=7.0)
    assert len(recording.imu) == 666
    assert np.ptp(np.diff(recording.imu.stamp_ns)) <= 1
    assert recording.imu.stamp_ns.dtype == np.int64


def test_a_long_simulation_is_the_short_one_continued():
    long, short = (sample_trajectory(make_trajectory("quad", duration=d), imu_rate=100.0)
                   for d in (130.0, 20.0))
    assert len(long.imu) == 13_000
    assert np.array_equal(long.imu.gyro_b[:2000], short.imu.gyro_b)


@pytest.mark.parametrize("bad, message", [
    ({"duration": 0.0}, "duration = 0.0 s"), ({"imu_rate": -1.0}, "imu_rate = -1.0 Hz"),
    ({"altimeter_rate": np.nan}, "altimeter_rate = nan Hz"), ({"rest": -1.0}, "rest = -1.0 s"),
    ({"latitude": 45.0}, "latitude = 45.0 rad"), ({"profile": "none"}, "sensor profile 'none'")])
def test_impossible_requests_are_refused(bad, message):
    with pytest.raises(ValueError, match=message):
        simulate("hover", **bad)


@pytest.mark.parametrize("name, started", [  # s, when the first cycle of manoeuvres begins
    ("turn", 23.0), ("vertical_plane", 23.0), ("aerobatic", 23.0), ("car", 3.0), ("quad", 11.0)])
def test_cycles_of_manoeuvres_end_at_the_altitude_at_which_they_began(name, started):
    sampled = sample_trajectory(make_trajectory(name, duration=600.0), imu_rate=50.0)
    altitude = -sampled.position_n[:, 2]
    base = altitude[round(started * 50.0)]
    assert altitude[round(started * 50.0):].min() == pytest.approx(base, abs=CLOSED)
    assert np.abs(altitude[-10_000:] - base).min() < CLOSED
    assert altitude.max() < HIGHEST
