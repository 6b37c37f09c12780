"""An IMU on a turntable: what it reads at rest, the 1/f noise, the truth."""

import numpy as np
import pytest

from inertial.earth import earth_rate_n, normal_gravity
from inertial.rotation import dcm_from_quaternion, dcm_nb_from_euler
from inertial.table_scenarios import (
    HEADING,
    LATITUDE,
    MOVE,
    PITCH,
    ROLL,
    STAND,
    TABLE_SCENARIOS,
    flicker_noise,
    simulate_table,
    table_angle,
)

ALLAN_SHARE = 0.12
"""Of the Allan deviation: six channels of 2^16 samples leave it uncertain by some per cent."""
SIGMAS = 5.0


def allan_deviation(values, block):
    means = values[:len(values) // block * block].reshape(-1, block, values.shape[1]).mean(axis=1)
    return np.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2))


@pytest.mark.parametrize("block", [8, 64, 512])
def test_the_allan_deviation_of_flicker_noise_is_flat(block):
    noise = flicker_noise(3.0, 0.01, 2 ** 16, np.random.default_rng(0), columns=6)
    assert allan_deviation(noise, block) == pytest.approx(3.0, rel=ALLAN_SHARE)


def test_the_table_stands_and_moves_as_it_says():
    angle = table_angle(148.0)
    starts = (STAND + MOVE) * np.arange(8)
    for share in (0.0, 0.5, 1.0):
        np.testing.assert_allclose(np.degrees(angle(starts + share * STAND)),
                                   [0, 90, 180, 270, 270, 180, 90, 0], atol=1e-9)


def test_readings_at_rest_are_earth_rate_and_gravity_of_the_turned_table():
    grade = TABLE_SCENARIOS["turntable_navigation"].errors
    recording = simulate_table("turntable_navigation", seed=1)
    dcm_nt = dcm_nb_from_euler(ROLL, PITCH, HEADING)
    np.testing.assert_allclose(dcm_from_quaternion(recording.truth.q_nb_wxyz[0]), dcm_nt, atol=1e-12)
    time = (recording.imu.stamp_ns - recording.imu.stamp_ns[0]) * 1e-9
    for stop, angle in ((1, 90.0), (3, 270.0)):
        start = stop * (STAND + MOVE)
        still = (time > start + 0.5) & (time < start + STAND - 0.5)
        dcm_nb = dcm_nt @ dcm_nb_from_euler(0.0, 0.0, np.radians(angle))
        gyro_std = np.hypot(grade.gyro_bias_std, grade.gyro_noise_density / np.sqrt(STAND))
        np.testing.assert_allclose(recording.imu.gyro_b[still].mean(axis=0),
                                   dcm_nb.T @ earth_rate_n(LATITUDE), atol=SIGMAS * gyro_std)
        gravity = float(normal_gravity(LATITUDE))
        accel_std = np.hypot(grade.accel_bias_std, gravity * grade.accel_scale_std)
        np.testing.assert_allclose(recording.imu.accel_b[still].mean(axis=0), -dcm_nb[2] * gravity,
                                   atol=SIGMAS * accel_std)


def test_the_joint_is_slower_than_the_imu_and_has_its_time():
    recording = simulate_table("turntable_mems", duration=30.0, imu_rate=100.0)
    assert len(recording.imu) == 3000 and len(recording.joint) == 600
    assert set(recording.joint.stamp_ns) <= set(recording.imu.stamp_ns)
    assert np.degrees(recording.joint.angle[-1]) == pytest.approx(90.0)


def test_unknown_grades_are_named():
    with pytest.raises(ValueError, match="turntable_mems"):
        simulate_table("turntable")
