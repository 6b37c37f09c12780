"""The helicopter: published eigenvalues, closed forms of loop and filter, and a flight that obeys its equations."""

import warnings

import numpy as np
import pytest

from inertial.earth import STANDARD_GRAVITY
from inertial.helicopter import (
    LINEAR_RANGE,
    OUTPUTS,
    STATES,
    LinearRangeWarning,
    UndetectableError,
    decoupling,
    fly,
    kalman_bucy,
    linearising_controller,
    nonlinear_rate,
    r50_hover,
    relative_degrees,
    zero_dynamics,
)
from inertial.rotation import dcm_nb_from_euler
from inertial.simulator import make_trajectory

ROUNDING = 1e-9
# Listed to 0.001 or 0.01 1/s: a unit of the last digit.
EIGENVALUES = {0.306 + 0.094j: 1e-3, -0.401 + 0.086j: 1e-3, -0.608: 1e-3, -1.70 + 8.19j: 0.01,
               -2.66 + 11.58j: 0.01, -6.20 + 8.20j: 0.01, -20.17 + 4.70j: 0.01}
POLE_ERROR = 1e-3  # 1/s: the rounding of a triple eigenvalue
HOLD_ERROR = 0.003  # of a step: sticks that are held for 1 ms against a closed form in continuous time
SAMPLING = 0.25  # of a standard deviation from 95 s of errors that last a second or two
LINEAR_ERROR = 1e-5  # of the rates, at a thousandth of the states
SMALL = 1e-3
DRIFT_ERROR = 1e-8  # m/s^2: the flight's velocities against the model's equations
INTERVAL = 0.01  # s
NOISE_STD = np.radians([1.0, 1.0, 1.0, 1.0])  # rad, and m for the height
GUSTS = np.diag([0.1 if name in ("u", "v", "w", "p", "q", "r") else 0.0 for name in STATES]) ** 2
TURN = np.array([-30.0, 20.0, 0.0, 0.0]) * np.pi / 180


@pytest.fixture(scope="module")
def model():
    return r50_hover()


@pytest.fixture(scope="module")
def kalman(model):
    return kalman_bucy(model, OUTPUTS, GUSTS, np.diag(NOISE_STD**2) * INTERVAL)


def flight(model, command=TURN, **settings):
    return fly(model, linearising_controller(model), command, rng=np.random.default_rng(0),
               **{"duration": 5.0, "interval": INTERVAL, **settings})


# --- model ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("listed", EIGENVALUES)
def test_the_hover_eigenvalues_are_the_published_ones(listed):
    found = np.linalg.eigvals(r50_hover(heading_and_height=False).A)
    miss = found[np.argmin(np.abs(found - listed))] - listed
    assert max(abs(miss.real), abs(miss.imag)) < EIGENVALUES[listed]


def test_the_units_are_si(model):
    small = r50_hover(heading_and_height=False)
    np.testing.assert_array_equal(small.A, model.A[:13, :13])
    at = {name: i for i, name in enumerate(STATES)}
    assert -model.A[at["u"], at["theta"]] == pytest.approx(STANDARD_GRAVITY, rel=2e-3)  # 32.2 ft/s^2
    assert model.A[at["h"], at["w"]] == -1.0
    assert model.A[at["p"], at["v"]] == pytest.approx(0.1432 / 0.3048)


def test_small_motion_of_the_nonlinear_plant_is_the_linear_one(model):
    rng = np.random.default_rng(1)
    x, control = SMALL * rng.standard_normal(15), SMALL * rng.standard_normal(4)
    np.testing.assert_allclose(nonlinear_rate(model, x, control), model.A @ x + model.B @ control, atol=LINEAR_ERROR)


def test_the_nonlinear_kinematics_are_those_of_a_turning_body(model):
    rng = np.random.default_rng(2)
    x, step = rng.uniform(-0.5, 0.5, 15), 1e-6
    rate = nonlinear_rate(model, x, np.zeros(4))
    index = [STATES.index(name) for name in ("phi", "theta", "psi")]
    before, after = (dcm_nb_from_euler(*(x + sign * step * rate)[index]) for sign in (-1, 1))
    W = dcm_nb_from_euler(*x[index]).T @ (after - before) / (2 * step)
    turned_b = x[[STATES.index(name) for name in ("p", "q", "r")]]
    np.testing.assert_allclose([W[2, 1], W[0, 2], W[1, 0]], turned_b, atol=ROUNDING)
    velocity_b = x[[STATES.index(name) for name in ("u", "v", "w")]]
    down = (dcm_nb_from_euler(*x[index]) @ velocity_b)[2]
    assert rate[STATES.index("h")] == pytest.approx(-down, abs=ROUNDING)


# --- controller -------------------------------------------------------------------------------------------


def test_relative_degrees_and_stable_zero_dynamics(model):
    assert relative_degrees(model) == (3, 3, 2, 2)
    inside = zero_dynamics(model)
    assert len(inside) == len(STATES) - 10
    assert inside.real.max() < 0
    assert np.linalg.matrix_rank(decoupling(model)[0]) == 4


def test_an_output_that_no_input_reaches_is_named(model):
    still = type(model)(model.A, 0 * model.B, model.states)
    with pytest.raises(ValueError, match="no input reaches phi"):
        relative_degrees(still)


def test_the_loop_has_the_chosen_poles_and_the_zero_dynamics(model):
    rates = (4.0, 3.0, 2.0, 1.5)
    controller = linearising_controller(model, rates)
    found = np.sort_complex(np.linalg.eigvals(model.A - model.B @ controller.feedback))
    chosen = np.repeat(rates, relative_degrees(model))
    expected = np.sort_complex(np.concatenate([chosen, -zero_dynamics(model)])) * -1
    np.testing.assert_allclose(np.sort(found.real), np.sort(expected.real), atol=POLE_ERROR)


def test_the_outputs_follow_chains_of_equal_lags_and_leave_each_other_alone(model):
    run = flight(model, interval=1e-3, duration=2.0)
    s = 4.0 * run.time
    step = 1 - np.exp(-s) * (1 + s + s**2 / 2)
    np.testing.assert_allclose(run.output[:, :2] / TURN[:2], np.stack([step, step], axis=1), atol=HOLD_ERROR)
    assert np.abs(run.output[:, 2:]).max() < HOLD_ERROR * TURN[1]


# --- filter ---------------------------------------------------------------------------------------------


def test_the_gain_solves_the_riccati_equation_and_the_filter_forgets(model, kalman):
    C, V, P = model.select(OUTPUTS), np.diag(NOISE_STD**2) * INTERVAL, kalman.covariance
    residual = model.A @ P + P @ model.A.T - P @ C.T @ np.linalg.solve(V, C @ P) + GUSTS
    np.testing.assert_allclose(residual, 0.0, atol=ROUNDING)
    np.testing.assert_allclose(kalman.gain @ V, P @ C.T, atol=ROUNDING)
    assert np.linalg.eigvals(model.A - kalman.gain @ C).real.max() < 0


def test_roll_and_pitch_alone_do_not_show_heading_and_height(model):
    two, V = ("phi", "theta"), np.diag(NOISE_STD[:2] ** 2) * INTERVAL
    with pytest.raises(UndetectableError, match="phi, theta do not show 2 of the 15 modes, whose eigenvalues 0, 0"):
        kalman_bucy(model, two, GUSTS, V)
    kalman_bucy(r50_hover(heading_and_height=False), two, GUSTS[:13, :13], V)


def test_the_errors_are_what_the_filter_says(model, kalman):
    run = flight(model, np.zeros(4), duration=100.0, kalman=kalman, measurement_std=NOISE_STD, process_density=GUSTS)
    late = run.time > 5.0
    index = [STATES.index(name) for name in OUTPUTS]
    expected = np.sqrt(np.diag(kalman.covariance)[index])
    np.testing.assert_allclose((run.filtered - run.output)[late].std(axis=0), expected, rtol=SAMPLING)
    np.testing.assert_allclose((run.measured - run.output)[late].std(axis=0), NOISE_STD, rtol=SAMPLING)


def test_without_noise_the_filter_is_the_plant(model, kalman):
    with pytest.warns(LinearRangeWarning):
        run = flight(model, kalman=kalman)
    np.testing.assert_allclose(run.filtered, run.output, atol=ROUNDING)
    np.testing.assert_array_equal(run.measured, run.output)


def test_a_reference_may_change_on_the_way(model):
    whole, part = flight(model), flight(model, duration=2.0)
    path = np.where(np.arange(500)[:, None] < 200, TURN, 0.0)
    run = flight(model, path)
    np.testing.assert_array_equal(run.state[:200], part.state)
    assert abs(run.output[-1, 0]) < 0.01 * abs(whole.output[-1, 0])


def test_leaving_the_linear_range_is_told_and_staying_is_not(model, kalman):
    with pytest.warns(LinearRangeWarning, match="reached 3[0-9] deg: beyond 10 deg"):
        flight(model, kalman=kalman, nonlinear=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        flight(model, 0.5 * LINEAR_RANGE * np.array([1, 1, 0, 0]), kalman=kalman, nonlinear=True)
        flight(model)


# --- the scenario -----------------------------------------------------------------------------------------


def test_the_scenario_obeys_the_models_equations(model):
    """Roll and pitch given, the moments give the flapping, and the flapping's force the accelerations."""
    t, step = np.linspace(8.0, 60.0, 2000), 1e-4
    trajectory = make_trajectory("helicopter", duration=70.0, rest=5.0)
    before, now, after = (trajectory.at(t + shift) for shift in (-step, 0.0, step))
    c, s = np.cos(now.heading), np.sin(now.heading)

    def ahead_and_right(vector_n):
        return np.stack([c * vector_n[:, 0] + s * vector_n[:, 1], -s * vector_n[:, 0] + c * vector_n[:, 1]])
    velocity = ahead_and_right(now.velocity_n)
    turn = now.heading_rate * np.stack([velocity[1], -velocity[0]])
    found = ahead_and_right(now.acceleration_n) + turn
    angle, rates = np.stack([now.pitch, now.roll]), [np.stack([m.pitch_rate, m.roll_rate]) for m in (before, after)]
    at = STATES.index
    A, (u, v, q, p) = model.A, (at("u"), at("v"), at("q"), at("p"))
    moments = (rates[1] - rates[0]) / (2 * step) - A[[q, p]][:, [u, v]] @ velocity
    flap = moments / A[[q, p], [at("a"), at("b")]][:, None]
    expected = (np.array([A[u, u], A[v, v]])[:, None] * velocity
                + np.array([A[u, at("theta")], A[v, at("phi")]])[:, None] * angle
                + np.array([A[u, at("a")], A[v, at("b")]])[:, None] * flap)
    assert np.abs(velocity).max() > 3.0
    np.testing.assert_allclose(found, expected, atol=DRIFT_ERROR)
