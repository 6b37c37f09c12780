"""A parked vehicle: its readings integrate to its truth, it sways as it says, its sensors have their grade."""

import math

import numpy as np
import pytest

from inertial.earth import earth_rate_n, normal_gravity, transport_rate_n
from inertial.parked_scenarios import GRADES, PARKED_SCENARIOS, simulate_parked
from inertial.rotation import (
    dcm_from_quaternion,
    dcm_nb_from_euler,
    euler_from_dcm,
    quaternion_exp,
    skew,
)
from inertial.table_scenarios import HEADING, LATITUDE, PITCH, ROLL

ATTITUDE_TOLERANCE = 2e-6  # rad, what mean rates of 5 ms lose of rocking and turning
VELOCITY_TOLERANCE = 2e-3  # m/s, likewise
SWAY = 6e-3  # rad, more than wind and people tilt the body
PER_TRUTH = 20  # samples at 200 Hz for each true attitude
SHARE = 0.1  # by which a spread of thousands of samples may differ


def strapdown(recording):
    """Return attitude and velocity at every stamp, integrated from the true first ones."""
    gravity_n, earth_n = np.array([0.0, 0.0, recording.gravity]), earth_rate_n(LATITUDE)
    skew_earth = skew(earth_n)
    dt = np.diff(recording.imu.stamp_ns) * 1e-9
    turns = dcm_from_quaternion(quaternion_exp(dt[:, None] * recording.imu.gyro_b[1:]))
    halves = dcm_from_quaternion(quaternion_exp(0.5 * dt[:, None] * recording.imu.gyro_b[1:]))
    forces = np.einsum("nij,nj->ni", halves, recording.imu.accel_b[1:])
    # Transport rate and Coriolis of the true velocity are near enough.
    frames = skew(earth_n + transport_rate_n(LATITUDE, 0.0, recording.velocity_n))
    attitudes = [dcm_from_quaternion(recording.truth.q_nb_wxyz[0])]
    velocities = [recording.velocity_n[0]]
    for k, (step, turn, force_b) in enumerate(zip(dt, turns, forces, strict=True)):
        dcm_nb, velocity_n, frame = attitudes[-1], velocities[-1], frames[k // PER_TRUTH]
        coriolis_n = (skew_earth + frame) @ velocity_n
        velocities.append(velocity_n + step * (dcm_nb @ force_b + gravity_n - coriolis_n))
        attitudes.append(dcm_nb @ turn - step * frame @ dcm_nb)
    return np.array(attitudes), np.array(velocities)


@pytest.mark.parametrize("name", ["parked_perfect_moved", "parked_perfect_rotating"])
def test_perfect_readings_integrate_to_the_truth(name):
    recording = simulate_parked(name, duration=36.0, imu_rate=200.0, seed=1)
    attitudes, velocities = strapdown(recording)
    np.testing.assert_allclose(attitudes[::PER_TRUTH], dcm_from_quaternion(recording.truth.q_nb_wxyz),
                               atol=ATTITUDE_TOLERANCE)
    np.testing.assert_allclose(velocities[::PER_TRUTH], recording.velocity_n, atol=VELOCITY_TOLERANCE)
    steps = np.diff(recording.position_n, axis=0)
    middles = 0.5 * (recording.velocity_n[1:] + recording.velocity_n[:-1])
    np.testing.assert_allclose(steps, 0.1 * middles, atol=VELOCITY_TOLERANCE)


def test_a_parked_body_sways_about_its_place_and_wind_and_people_can_be_switched_off():
    swaying = simulate_parked("parked_perfect", duration=120.0, imu_rate=50.0, seed=2)
    angles = np.stack(euler_from_dcm(dcm_from_quaternion(swaying.truth.q_nb_wxyz)), axis=-1)
    off = angles - [ROLL, PITCH, HEADING]
    assert np.abs(off).max() < SWAY and off.std(axis=0).min() > 0.0
    assert np.abs(np.diff(off[:, 0])).max() > 1e-5, "it rocks at every moment"
    calm = simulate_parked("parked_perfect", duration=2.0, imu_rate=50.0, disturbance=0.0)
    dcm_nb = dcm_nb_from_euler(ROLL, PITCH, HEADING)
    np.testing.assert_allclose(calm.imu.gyro_b, np.tile(earth_rate_n(LATITUDE) @ dcm_nb, (100, 1)), atol=1e-12)
    np.testing.assert_allclose(calm.imu.accel_b, np.tile(-normal_gravity(LATITUDE) * dcm_nb[2], (100, 1)),
                               atol=1e-12)


def test_each_scheme_turns_or_moves_as_it_says():
    def heading_deg(name, **where):
        recording = simulate_parked(name, duration=92.0, imu_rate=20.0, disturbance=0.0, **where)
        heading = euler_from_dcm(dcm_from_quaternion(recording.truth.q_nb_wxyz))[2]
        return np.degrees(np.unwrap(heading)), recording

    still, _ = heading_deg("parked_perfect", heading=-1.0, latitude=0.3)
    assert np.ptp(still) < 1e-9 and still[0] == pytest.approx(np.degrees(-1.0))
    turned, _ = heading_deg("parked_perfect_two_position")
    # Half a turn about the z axis of a tilted IMU.
    half = dcm_nb_from_euler(ROLL, PITCH, HEADING) @ np.diag([-1.0, -1.0, 1.0])
    assert math.cos(math.radians(turned[-1]) - euler_from_dcm(half)[2]) == pytest.approx(1.0, abs=1e-12)
    assert turned[400] == turned[0]
    rotating, _ = heading_deg("parked_perfect_rotating")
    assert rotating[295] == pytest.approx(rotating[0])
    assert rotating[910] == pytest.approx(rotating[0] + 360.0, abs=0.5)
    moved, recording = heading_deg("parked_perfect_moved")
    assert moved[-1] - moved[0] == pytest.approx(70.0)
    assert np.linalg.norm(recording.position_n[-1]) > 50.0
    np.testing.assert_allclose(recording.velocity_n[[0, -1]], 0.0, atol=1e-12)


def test_the_sensors_have_the_biases_and_the_noise_of_their_grade():
    errors = GRADES["tactical"].errors
    recordings = [simulate_parked("parked_tactical", duration=100.0, imu_rate=20.0, seed=seed, disturbance=0.0)
                  for seed in range(8)]
    for name, bias_std, density, wobble in (
            ("gyro_b", errors.gyro_bias_std, errors.gyro_noise_density, errors.gyro_bias_instability),
            ("accel_b", errors.accel_bias_std, errors.accel_noise_density, errors.accel_bias_instability)):
        samples = np.array([getattr(recording.imu, name) for recording in recordings])
        biases = np.array([getattr(recording, name.replace("_b", "_bias_b")) for recording in recordings])
        noise = np.diff(samples - biases, axis=1).std() / np.sqrt(2.0)
        assert noise == pytest.approx(density * np.sqrt(20.0), rel=SHARE)
        assert 0.5 < biases.std() / bias_std < 1.5
        assert 0.5 < np.diff(biases, axis=1).std() / wobble < 2.0, "1/f noise has a step of about its floor"


def test_the_adis_is_nonlinear_by_its_data_sheet_at_full_scale():
    grade = GRADES["adis"]
    assert grade.gyro_curvature * grade.errors.gyro_range == pytest.approx(1e-4)
    assert grade.accel_curvature * grade.errors.accel_range == pytest.approx(1e-3)


def test_the_same_arguments_give_the_same_bytes():
    one, other, third = (simulate_parked("parked_adis", duration=3.0, seed=seed) for seed in (5, 5, 6))
    assert one.imu.gyro_b.tobytes() == other.imu.gyro_b.tobytes() != third.imu.gyro_b.tobytes()
    assert one.truth.q_nb_wxyz.tobytes() == other.truth.q_nb_wxyz.tobytes() != third.truth.q_nb_wxyz.tobytes()


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="parked_navigation"):
        simulate_parked("parked")
    with pytest.raises(ValueError, match="latitude = 35"):
        simulate_parked("parked_perfect", latitude=35)
    assert len(PARKED_SCENARIOS) == 16
