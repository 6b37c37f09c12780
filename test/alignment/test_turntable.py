"""The turntable's kinematics against first principles, and its errors one by one."""

import numpy as np
import pytest

from alignment.sequences import PALINDROME, continuous_rotation, indexed_schedule, palindrome, refinement
from alignment.turntable import (
    TriadErrors,
    Turntable,
    earth_direction_t,
    exact_readings,
    simulate_readings,
)
from inertial.earth import EARTH_RATE, STANDARD_GRAVITY, earth_rate_n
from inertial.rotation import dcm_nb_from_euler, skew

ROUNDING = 1e-14  # of unit vectors
RATE = 1e-12  # rad/s; the wobble rates here are 1e-6
RATE_BY_DIFFERENCE = 2e-7  # rad/s; attitude differenced over 2 ms, third order
FORCE_BY_DIFFERENCE = 2e-6  # m/s^2; positions differenced twice over 1 ms
DEG = np.pi / 180
TABLE = Turntable(roll=50 * DEG, pitch=30 * DEG, heading=88 * DEG, latitude=35 * DEG)


def test_level_table_facing_north_sees_the_horizontal_earth_rate_ahead():
    x, y, z = earth_direction_t(0.0, 0.0, 0.0, 0.6)
    assert [x, y, z] == pytest.approx([np.cos(0.6), 0.0, -np.sin(0.6)], abs=ROUNDING)
    # Facing east, north is to the left.
    assert earth_direction_t(0.0, 0.0, np.pi / 2, 0.6)[1] == pytest.approx(-np.cos(0.6), abs=ROUNDING)


def test_level_at_rest_reads_minus_gravity_down_at_every_angle():
    accel_b = exact_readings(Turntable(latitude=0.6), np.linspace(0, 6, 7)).accel_b
    assert accel_b == pytest.approx(np.tile([0, 0, -STANDARD_GRAVITY], (7, 1)), abs=ROUNDING)


def test_positive_table_angle_turns_clockwise_seen_from_above():
    # North ahead at zero is to the left after a quarter turn clockwise.
    gyro_b = exact_readings(Turntable(), np.pi / 2).gyro_b
    assert gyro_b == pytest.approx([0.0, -EARTH_RATE, 0.0], abs=ROUNDING * EARTH_RATE)


def test_the_papers_expanded_equations():
    tau, rate, acceleration, arm = 0.7, 0.3, 0.05, 0.2
    table = Turntable(TABLE.roll, TABLE.pitch, TABLE.heading, TABLE.latitude, lever_arm=arm)
    readings = exact_readings(table, tau, rate, acceleration)
    x, y, z = earth_direction_t(table.roll, table.pitch, table.heading, table.latitude)
    st, ct = np.sin(table.pitch), np.cos(table.pitch)
    sf, cf, s, c, g = np.sin(table.roll), np.cos(table.roll), np.sin(tau), np.cos(tau), table.gravity
    coriolis = 2 * EARTH_RATE * arm * rate
    assert readings.accel_b == pytest.approx(
        [g * (c * st - s * ct * sf) - arm * rate ** 2 - coriolis * z,
         -g * (s * st + c * ct * sf) + arm * acceleration,
         -g * ct * cf + coriolis * (c * x + s * y)], abs=1e-14 * g)
    assert readings.gyro_b == pytest.approx(
        [EARTH_RATE * (x * c + y * s), EARTH_RATE * (y * c - x * s), EARTH_RATE * z + rate],
        abs=ROUNDING * rate)


def _inertial_attitude(table, time, rate, acceleration):
    """Return body to inertial axes (NED at time zero), by turning the Earth and the table."""
    axis = earth_rate_n(table.latitude)
    turn = np.linalg.norm(axis) * time
    unit = axis / np.linalg.norm(axis)
    cross = skew(unit)
    earth = np.eye(3) + np.sin(turn) * cross + (1 - np.cos(turn)) * cross @ cross
    tau = 0.4 + rate * time + 0.5 * acceleration * time ** 2
    return earth @ dcm_nb_from_euler(table.roll, table.pitch, table.heading) @ dcm_nb_from_euler(0, 0, tau)


def test_rates_and_forces_follow_from_motion_in_inertial_space():
    rate, acceleration, arm, step = 0.8, 0.3, 0.5, 1e-3
    table = Turntable(TABLE.roll, TABLE.pitch, TABLE.heading, TABLE.latitude, lever_arm=arm)
    readings = exact_readings(table, 0.4, rate, acceleration)
    before, now, after = (_inertial_attitude(table, t, rate, acceleration) for t in (-step, 0.0, step))
    spin = now.T @ (after - before) / (2 * step)
    assert [spin[2, 1], spin[0, 2], spin[1, 0]] == pytest.approx(readings.gyro_b, abs=RATE_BY_DIFFERENCE)
    # The arm's own motion; the platform's circle about the Earth's axis is part of gravity.
    ends = [attitude[:, 0] * arm for attitude in (before, now, after)]
    earth_b = now.T @ earth_rate_n(table.latitude)
    centrifugal_b = np.cross(earth_b, np.cross(earth_b, [arm, 0, 0]))
    motion_b = now.T @ (ends[0] - 2 * ends[1] + ends[2]) / step ** 2 - centrifugal_b
    gravity_b = now.T @ [0, 0, table.gravity]
    assert readings.accel_b == pytest.approx(motion_b - gravity_b, abs=FORCE_BY_DIFFERENCE)


def test_each_error_changes_what_it_should():
    schedule = indexed_schedule([0.0], 10.0)
    rng = np.random.default_rng(1)
    truth = exact_readings(TABLE, [0.0]).gyro_b

    def error_of(**errors):
        readings = simulate_readings(TABLE, schedule, TriadErrors(**errors), TriadErrors(), rng)
        return (readings.gyro_b - truth)[0]
    assert error_of() == pytest.approx([0, 0, 0], abs=1e-30)
    assert error_of(bias=(1e-6, 2e-6, 3e-6)) == pytest.approx([1e-6, 2e-6, 3e-6], rel=1e-9)
    assert error_of(drift=(1e-8, 0.0, 0.0)) == pytest.approx([5e-8, 0, 0], abs=1e-18)
    assert error_of(scale=(1e-3, 0.0, 0.0)) == pytest.approx([1e-3 * truth[0, 0], 0, 0], abs=1e-18)
    assert error_of(misalignment=1e-3)[0] == pytest.approx(1e-3 * (truth[0, 1] + truth[0, 2]), rel=1e-9)


def test_white_noise_falls_with_the_root_of_the_dwell():
    rng = np.random.default_rng(2)
    readings = simulate_readings(TABLE, indexed_schedule([0.0, 0.0], [4.0, 100.0]),
                                 TriadErrors(noise_density=1e-4), TriadErrors(), rng, trials=20000)
    assert readings.gyro_b.std(axis=0)[:, 0] == pytest.approx([5e-5, 1e-5], rel=0.02)


def test_encoder_zero_is_a_turn_of_the_heading():
    turned = exact_readings(Turntable(heading=0.5, latitude=0.6, encoder_zero=0.1), [0.3, 2.0])
    heading = exact_readings(Turntable(heading=0.6, latitude=0.6), [0.3, 2.0])
    assert turned.gyro_b == pytest.approx(heading.gyro_b, abs=ROUNDING * EARTH_RATE)


def test_wobble_rate_is_the_change_of_the_tilted_attitude():
    arcsecond, rate, step = DEG / 3600, 6 * DEG, 1e-3
    table = Turntable(wobble=arcsecond)

    def tilt_t(angle):
        return arcsecond * np.array([np.cos(2 * angle), np.sin(2 * angle), 0.0])
    expected_t = (tilt_t(0.9 + rate * step) - tilt_t(0.9 - rate * step)) / (2 * step)
    still, turning = exact_readings(table, 0.9), exact_readings(table, 0.9, rate)
    added_b = turning.gyro_b - still.gyro_b - [0, 0, rate]
    assert added_b == pytest.approx(dcm_nb_from_euler(0, 0, 0.9).T @ expected_t, abs=RATE)


def test_schedules_cover_the_time_they_are_given():
    for schedule in (palindrome(600.0), palindrome(20.0), refinement(0.3, 450.0, start=100.0),
                     continuous_rotation(0.1, 100.0, 0.01)):
        assert np.all(schedule.duration > 0)
        assert np.all(schedule.start[1:] >= schedule.end[:-1] - 1e-9)
    for total in (20.0, 170.0, 600.0):
        assert palindrome(total).duration.sum() == pytest.approx(total)
        assert palindrome(total).duration.max() <= 15.0 + 1e-9
    assert len(palindrome(20.0).angle) == len(PALINDROME)
    both_ways = continuous_rotation(0.1, 100.0, 0.01)
    assert both_ways.rate.sum() == pytest.approx(0.0, abs=1e-9)
    assert np.abs(np.diff(both_ways.angle)).max() == pytest.approx(1e-3, rel=1e-6)
