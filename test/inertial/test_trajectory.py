"""Profiles and motions: derivatives are the derivatives, and motions are plausible."""

import numpy as np
import pytest

from inertial.earth import STANDARD_GRAVITY
from inertial.scenarios import SCENARIOS, find_scenario
from inertial.simulator import make_trajectory
from inertial.trajectory import Profile, flight, multirotor

DIFFERENCE = 1e-4  # s, step of central differences
PROFILE_DIFFERENCE = 1e-6  # relative to figures near one, of central differences
RATE_DIFFERENCE = 1e-6  # rad/s: 2e-4 deg/s, a hundredth of a consumer gyro's noise
ACCELERATION_DIFFERENCE = 1e-6  # m/s^2
DURATION, REST = 150.0, 3.0

ALL = pytest.mark.parametrize("name", SCENARIOS)


def _profile():
    return Profile([1.0, 2.0, 4.0, 5.0], [0.5, 2.0, 2.0, -1.0])


def test_profile_passes_its_knots_and_rests_outside():
    assert _profile()(np.array([-9.0, 1, 2, 3, 4, 5, 9])) == pytest.approx(
        [0.5, 0.5, 2, 2, 2, -1, -1])


@pytest.mark.parametrize("derivative", [0, 1, 2, 3])
def test_profile_derivatives_and_integral_belong_together(derivative):
    profile = _profile()
    t = np.linspace(0.0, 6.0, 241) + 0.003

    def lower(at):
        return profile.integral(at) if derivative == 0 else profile(at, derivative - 1)

    slope = (lower(t + DIFFERENCE) - lower(t - DIFFERENCE)) / (2 * DIFFERENCE)
    scale = max(1.0, np.abs(slope).max())
    assert profile(t, derivative) / scale == pytest.approx(slope / scale, abs=PROFILE_DIFFERENCE)


def test_a_coordinated_level_turn_has_no_side_force():
    speed, level, rate = (Profile([0.0, 1.0], [v, v]) for v in (30.0, 0.0, 0.2))
    trajectory = make_trajectory("turn")
    motion = flight(speed, level, rate, level, STANDARD_GRAVITY)(np.array([5.0]))
    _, accel_b = trajectory.sensed(motion)
    load = np.hypot(STANDARD_GRAVITY, 30.0 * 0.2)
    assert accel_b[0] == pytest.approx([0.0, 0.0, -load])
    assert motion.roll[0] == pytest.approx(np.arctan(30.0 * 0.2 / STANDARD_GRAVITY))


def test_a_multirotor_senses_force_along_its_axis_only():
    columns = [Profile([0.0, 2.0], [0.0, v]) for v in (5.0, -3.0, 1.0, 1.0)]
    trajectory = make_trajectory("quad")
    motion = multirotor(*columns, STANDARD_GRAVITY)(np.linspace(0.0, 2.0, 21))
    _, accel_b = trajectory.sensed(motion)
    assert accel_b[:, :2] == pytest.approx(0.0, abs=1e-12)
    assert np.all(accel_b[:, 2] < -STANDARD_GRAVITY / 2)
    # Speeding up to the north, heading north: nose down.
    assert motion.pitch[10] < 0


@ALL
def test_rates_are_the_derivative_of_the_attitude(name):
    trajectory = make_trajectory(name, duration=DURATION, rest=REST)
    t = np.linspace(0.0, DURATION, 10_001)
    before, at, after = (trajectory.at(t + shift) for shift in (-DIFFERENCE, 0.0, DIFFERENCE))
    slope = (after.dcm_nb - before.dcm_nb) / (2 * DIFFERENCE)
    W = np.swapaxes(at.dcm_nb, -1, -2) @ slope
    rate_b = np.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], axis=-1)
    assert np.abs(at.rate_b - rate_b).max() < RATE_DIFFERENCE
    slope = (after.velocity_n - before.velocity_n) / (2 * DIFFERENCE)
    assert np.abs(at.acceleration_n - slope).max() < ACCELERATION_DIFFERENCE


@ALL
def test_every_scenario_begins_at_rest_and_then_moves(name):
    trajectory = make_trajectory(name, duration=DURATION, rest=REST)
    gyro_b, accel_b = trajectory.sensed(trajectory.at(np.linspace(0.0, REST, 50)))
    assert not gyro_b.any()
    assert np.array_equal(accel_b, np.tile([0.0, 0.0, -STANDARD_GRAVITY], (50, 1)))
    assert np.linalg.norm(trajectory.at(REST + 5.0).velocity_n) > 0.1


LIMITS = {  # speed m/s, least and greatest load factor, rate deg/s
    "straight": (30, 0.4, 1.6, 20), "hover": (3, 0.8, 1.2, 10), "turn": (30, 0.4, 1.6, 60),
    "vertical_plane": (60, -1.2, 3.8, 60), "aerobatic": (60, -1.2, 4.5, 250),
    "car": (15, 0.85, 1.15, 30), "quad": (10, 0.7, 2.0, 150),
    "helicopter": (16, 0.8, 1.25, 40)}


@ALL
def test_scenarios_stay_within_what_the_vehicle_can_do(name):
    speed, least, greatest, rate = LIMITS[name]
    trajectory = make_trajectory(name, duration=600.0)
    motion = trajectory.at(np.linspace(0.0, 600.0, 12_001))
    gyro_b, accel_b = trajectory.sensed(motion)
    load = -accel_b[:, 2] / STANDARD_GRAVITY
    assert np.linalg.norm(motion.velocity_n, axis=1).max() < speed
    assert least < load.min() and load.max() < greatest
    assert np.degrees(np.abs(gyro_b).max()) < rate


def test_aerobatics_pass_through_the_pole_and_turn_over():
    down_b = make_trajectory("aerobatic").at(np.linspace(0.0, 120.0, 12_001)).dcm_nb[:, 2]
    assert down_b[:, 0].min() < -0.9999 and down_b[:, 0].max() > 0.9999
    assert down_b[:, 2].min() < -0.9999


def test_unknown_scenario_is_refused_with_the_names():
    with pytest.raises(ValueError, match="'submarine': choose from straight, hover, turn"):
        find_scenario("submarine")
