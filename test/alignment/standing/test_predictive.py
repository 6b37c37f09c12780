"""The error model and the predictive algorithm: Jacobians, closed forms, dense twins."""

import numpy as np
import pytest

from alignment.standing.params import StandingParams
from alignment.standing.predictive import error_jacobian, error_rate, predictive_gain
from inertial.earth import EARTH_RATE, SEMI_MAJOR_AXIS
from inertial.rotation import dcm_nb_from_euler

LATITUDE = np.radians(35.0)
DT, HORIZON, RATIO = 0.01, 10, 3.0
STEPS = np.array([1e-3, 1e-3, 1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6, 1e-3, 1e-3])
JACOBIAN_TOLERANCE = 1e-8  # of the largest entry: central differences
PUSH_THROUGH_TOLERANCE = 1e-10  # relative: two ways to write the gain
MINIMUM_TOLERANCE = 1e-8  # relative: least squares against the closed form


@pytest.fixture
def case():
    rng = np.random.default_rng(5)
    x = rng.standard_normal(10) * [0.3, 0.3, 0.02, 0.02, 1.0, 1e-5, 1e-5, 1e-5, 0.02, 0.02]
    force = np.array([0.3, -0.2, -9.7])
    return x, force, dcm_nb_from_euler(0.05, -0.04, 2.0)


def test_rate_is_the_pages_model(case):
    x, (fn, fe, fd), dcm = case
    dvn, dve, pn, pe, pd = x[:5]
    c, s, wn, wd = np.cos(pd), np.sin(pd), EARTH_RATE * np.cos(LATITUDE), -EARTH_RATE * np.sin(LATITUDE)
    expected = [(1 - c) * fn + s * fe - (pe * c + pn * s) * fd + 2 * wd * dve,
                -s * fn + (1 - c) * fe + (pn * c - pe * s) * fd - 2 * wd * dvn,
                (1 - c) * wn + pe * wd + dve / SEMI_MAJOR_AXIS,
                s * wn - pn * wd - dvn / SEMI_MAJOR_AXIS,
                -(pe * c + pn * s) * wn - dve * np.tan(LATITUDE) / SEMI_MAJOR_AXIS]
    rate = error_rate(x[:5], case[1], dcm, StandingParams(latitude=LATITUDE))
    np.testing.assert_allclose(rate, expected, rtol=1e-12)


@pytest.mark.parametrize("states", [5, 10])
@pytest.mark.parametrize("jacobian", ["paper", "mended"])
def test_jacobian_against_central_differences(case, jacobian, states):
    x, force, dcm = case
    params = StandingParams(latitude=LATITUDE, jacobian=jacobian)
    if jacobian == "mended":
        # The force that agrees with the model, and differences with that force held fixed.
        force = params.local_gravity * np.array([0.0, 0.0, -1.0])
    x = x[:states]
    analytic = error_jacobian(x, force, dcm, params)
    numeric = np.stack([(error_rate(x + step, force, dcm, params) - error_rate(x - step, force, dcm, params))
                        / (2 * step.sum()) for step in np.diag(STEPS[:states])], axis=1)
    if jacobian == "mended":
        # Its columns of heading are taken at f = (g phiE, -g phiN, -g): the forces' part vanishes.
        consistent = params.local_gravity * np.array([x[3], -x[2], -1.0])
        numeric[:2, 4] = ((error_rate(x + 1e-4 * np.eye(states)[4], consistent, dcm, params)
                           - error_rate(x - 1e-4 * np.eye(states)[4], consistent, dcm, params)) / 2e-4)[:2]
    np.testing.assert_allclose(analytic, numeric, atol=JACOBIAN_TOLERANCE * np.abs(analytic).max())


def dense(F):
    """Hy and K as the paper writes them, (2 p, 5 p) and (5 p, 2 p), for Qm = 1."""
    sums = [np.eye(5)]
    for _ in range(HORIZON - 1):
        sums.append(np.eye(5) + sums[-1] @ F)
    Hy = np.zeros((2 * HORIZON, 5 * HORIZON))
    for i in range(HORIZON):
        for j in range(i + 1):
            Hy[2 * i:2 * i + 2, 5 * j:5 * j + 5] = DT * sums[i - j][:2]
    return Hy, np.linalg.solve(RATIO * Hy.T @ Hy + np.eye(5 * HORIZON), RATIO * Hy.T)


def test_gain_is_that_of_the_dense_form(case):
    x, force, dcm = case
    F = np.eye(5) + DT * error_jacobian(x[:5], force, dcm, StandingParams(latitude=LATITUDE))
    found = predictive_gain(F, DT, HORIZON, RATIO)
    gain = dense(F)[1][:5]
    np.testing.assert_allclose(found.gain, gain, atol=PUSH_THROUGH_TOLERANCE * np.abs(gain).max())


def test_first_increment_and_cost_are_those_of_the_minimum(case):
    x, force, dcm = case
    F = np.eye(5) + DT * error_jacobian(x[:5], force, dcm, StandingParams(latitude=LATITUDE))
    free = np.random.default_rng(6).standard_normal(2 * HORIZON)
    found = predictive_gain(F, DT, HORIZON, RATIO)
    Hy = dense(F)[0]
    stacked = np.concatenate([np.sqrt(RATIO) * Hy, np.eye(5 * HORIZON)])
    target = np.concatenate([-np.sqrt(RATIO) * free, np.zeros(5 * HORIZON)])
    best, cost = np.linalg.lstsq(stacked, target, rcond=None)[:2]
    np.testing.assert_allclose(-found.gain @ free, best[:5], atol=MINIMUM_TOLERANCE * np.abs(best).max())
    np.testing.assert_allclose(free @ found.weight @ free, cost[0], rtol=MINIMUM_TOLERANCE)
