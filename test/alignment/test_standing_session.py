"""A standing vehicle's session: a half turn is no drive; stop and start; a later latitude; every method."""

import dataclasses
import math

import numpy as np
import pytest

from alignment.standing.params import STANDING_METHODS, StandingParams
from alignment.standing_session import StandingSession
from inertial.earth import STANDARD_GRAVITY
from inertial.parked_scenarios import GRADES, simulate_parked
from inertial.recording import ImuSeries
from inertial.rotation import quaternion_conjugate, quaternion_log, quaternion_multiply
from inertial.table_scenarios import HEADING, LATITUDE

ERRORS = GRADES["navigation"].errors
PARAMS = StandingParams(
    latitude=LATITUDE, coarse_window=10.0, target_std=0.1, gyro_noise_density=ERRORS.gyro_noise_density,
    gyro_bias_std=ERRORS.gyro_bias_std, gyro_bias_instability=ERRORS.gyro_bias_instability,
    accel_noise_density=ERRORS.accel_noise_density, accel_bias_std=ERRORS.accel_bias_std,
    accel_bias_instability=ERRORS.accel_bias_instability)
SIGMAS = 4.0
"""Of a heading, for one fixed seed."""


def fed(session, recording):
    """Return the phases that a session goes through, and its remarks."""
    phases = [session.phase]
    for sample in zip(recording.imu.stamp_ns.tolist(), recording.imu.gyro_b, recording.imu.accel_b, strict=True):
        if session.add_imu(*sample):
            phases.append(session.phase)
    return phases, [text for _, text in session.take_remarks()]


@pytest.fixture(scope="module")
def turned():
    """Return a vehicle that turns by 180 deg in the middle of a minute."""
    return simulate_parked("parked_navigation_two_position", duration=60.0, imu_rate=50.0, seed=1)


def test_a_half_turn_goes_on_and_every_method_stands_beside_it(turned):
    session = StandingSession(PARAMS, keep=True)
    phases, remarks = fed(session, turned)
    assert phases[:3] == ["waiting", "coarse", "fine"] and phases[-2:] == ["waiting", "aligned"]
    assert phases.count("coarse") == 1 and not any("driven" in text for text in remarks)
    assert remarks[-1].startswith("aligned: heading 3") and remarks[-1].endswith(" deg")
    error = math.remainder(session.result.heading - HEADING - math.pi, 2 * math.pi)
    assert abs(error) < SIGMAS * session.result.heading_std
    found = session.compare()
    assert tuple(found) == STANDING_METHODS and found[PARAMS.method] is session
    assert all(other.result is not None for other in found.values())


def test_a_stopped_session_ignores_samples_and_begins_anew(turned):
    session = StandingSession(PARAMS)
    first = simulate_parked("parked_navigation", duration=15.0, imu_rate=50.0)
    fed(session, first)
    assert session.phase == "fine" and session.stop() and session.phase == "stopped"
    result = session.result
    fed(session, turned)
    assert session.result is result and not session.stop()
    assert session.activity == "stopped: call ~/start"
    session.start()
    assert session.phase == "waiting" and session.result is None


def test_a_latitude_that_comes_later_begins_the_alignment(turned):
    session = StandingSession(StandingParams())
    assert fed(session, turned)[0][:2] == ["waiting", "coarse"] and "latitude is not known" in session.refusal
    session.params = PARAMS
    assert session.phase == "waiting" and "latitude" not in session.refusal


@pytest.fixture(scope="module")
def moved():
    """Return a vehicle that drives off in the middle of two minutes; it creeps unnoticed at first."""
    return simulate_parked("parked_navigation_moved", duration=120.0, imu_rate=50.0, seed=1)


def test_a_drive_is_borne_by_a_filter_that_carries_a_velocity(moved):
    """Level and heading are those of the new place all the same."""
    session = StandingSession(PARAMS)
    phases, remarks = fed(session, moved)
    assert phases.count("coarse") == 1 and not any("driven" in text for text in remarks)
    last = np.searchsorted(moved.truth.stamp_ns, session.result.stamp_ns, side="right") - 1
    truth = moved.truth.q_nb_wxyz[last]
    error = quaternion_log(quaternion_multiply(session.result.q_nb_wxyz, quaternion_conjugate(truth)))
    assert error @ np.linalg.solve(session.result.covariance, error) < SIGMAS ** 2


def test_a_drive_begins_an_error_model_anew(moved):
    phases, remarks = fed(StandingSession(dataclasses.replace(PARAMS, method="ekf10")), moved)
    assert phases.count("coarse") == 2 and any("driven" in text for text in remarks)


def test_a_wrong_unit_is_told_apart_from_other_refusals(turned):
    session, wrong = StandingSession(PARAMS), StandingSession(PARAMS)
    fed(session, turned)
    in_g = ImuSeries(turned.imu.stamp_ns, turned.imu.gyro_b, turned.imu.accel_b / STANDARD_GRAVITY)
    fed(wrong, dataclasses.replace(turned, imu=in_g))
    assert not session.input_error
    assert wrong.input_error and wrong.refusal == wrong.input_error
