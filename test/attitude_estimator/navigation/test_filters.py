"""The navigation filters' closed forms, Jacobians and steps against plain numpy."""

import numpy as np
import pytest
from scipy.linalg import expm

from attitude_estimator.navigation import _kernels as kernels
from attitude_estimator.navigation.params import STEADY_GAIN_LIMIT, NavigationParams, axis_frequency
from inertial.rotation import (
    dcm_from_quaternion,
    quaternion_exp,
    quaternion_from_dcm,
    quaternion_log,
    quaternion_multiply,
    skew,
)

CLOSED_FORM = 1e-12  # of the largest element: the page's limit
TWIN_RELATIVE = 1e-10  # rounding of two orders of summation over the steps
JACOBIAN = 1e-7  # of the largest element: central differences with a step of 1e-6
STEP = 1e-6
MEKF_STEPS = 40
GYRO_DENSITY, WALK_DENSITY = 2e-3, 5e-4  # rad/s/sqrt(Hz), rad/s/sqrt(s)
RATES = (0.0, 1e-7, 1e-3, 0.1, 1.0, 2.9, 3.1, 10.0, 30.0)  # rad/s; 3 rad/s is where a series ends
AXIS = np.array([0.48, -0.6, 0.64])
ORDERS = {"linear": (4, 5), "sine": (2, 2)}
ORDER_TOLERANCE = 0.25

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)


def _psi(w, t):
    """Integral of exp(-[w x] t) from 0 to t by an augmented exponential."""
    block = np.zeros((6, 6))
    block[:3, :3], block[:3, 3:] = -skew(w), np.eye(3)
    return expm(block * t)[:3, 3:]


def _attitude_model(w, dt):
    """Theta, Psi, Q11 and Q12 of paper 001 by exponential and quadrature."""
    times, weights = 0.5 * dt * (1 + _NODES), 0.5 * dt * _WEIGHTS
    psi = np.array([_psi(w, t) for t in times])
    q11 = GYRO_DENSITY**2 * dt * np.eye(3) + WALK_DENSITY**2 * np.einsum("k,kij,klj->il", weights, psi, psi)
    return expm(-skew(w) * dt), _psi(w, dt), q11, -WALK_DENSITY**2 * np.einsum("k,kij->ij", weights, psi)


@pytest.mark.parametrize("dt", [0.001, 0.01, 0.1])
@pytest.mark.parametrize("rate", RATES)
def test_transition_and_noise_are_their_integrals(rate, dt):
    filled = [np.empty((3, 3)) for _ in range(4)]
    kernels.attitude_model(rate * AXIS, dt, GYRO_DENSITY, WALK_DENSITY, *filled)
    for closed, integrated in zip(filled, _attitude_model(rate * AXIS, dt), strict=True):
        np.testing.assert_allclose(closed, integrated, rtol=0, atol=CLOSED_FORM * np.abs(integrated).max())


def _error_from(q, q_estimated):
    """Return the small rotation about the navigation axes from an estimate to the truth."""
    dcm = dcm_from_quaternion(q) @ dcm_from_quaternion(q_estimated).T
    return quaternion_log(quaternion_from_dcm(dcm))


def test_mekf_is_its_equations():
    rng = np.random.default_rng(1)
    q = quaternion_exp(np.array([0.4, -0.7, 1.9]))
    bias, P = np.array([0.01, -0.02, 0.005]), np.diag([0.02, 0.03, 0.1, 1e-4, 2e-4, 3e-4])
    twin_q, twin_bias, twin_P = q.copy(), bias.copy(), P.copy()
    down_n, R, dt = np.array([0.0, 0.0, 1.0]), np.diag([1e-3, 2e-3, 1.5e-3]), 0.05
    for k in range(MEKF_STEPS):
        gyro_b = rng.standard_normal(3)
        kernels.mekf_predict(q, P, gyro_b - bias, dt, GYRO_DENSITY, WALK_DENSITY)
        twin_q, twin_P = _twin_predict(twin_q, twin_P, gyro_b - twin_bias, dt)
        measured_b = dcm_from_quaternion(twin_q).T @ down_n + 0.03 * rng.standard_normal(3)
        kernels.mekf_vector_update(q, bias, P, measured_b, down_n, R, np.inf)
        dcm_bn = dcm_from_quaternion(twin_q).T
        H = np.hstack([skew(dcm_bn @ down_n) @ dcm_bn, np.zeros((3, 3))])
        twin_q, twin_bias, twin_P = _twin_update(twin_q, twin_bias, twin_P, H, R, measured_b - dcm_bn @ down_n)
        if k % 10 == 0:
            heading = np.arctan2(dcm_bn[0, 1], dcm_bn[0, 0]) + 0.02
            dcm_nb, before = dcm_from_quaternion(twin_q), twin_q
            H = _gradient(lambda e, q0=before: _heading(quaternion_multiply(quaternion_exp(e[:3]), q0)), 6)[None]
            kernels.mekf_heading_update(q, bias, P, heading, 1e-3, np.inf)
            y = np.array([heading - np.arctan2(dcm_nb[1, 0], dcm_nb[0, 0])])
            twin_q, twin_bias, twin_P = _twin_update(twin_q, twin_bias, twin_P, H, np.array([[1e-3]]), y)
    np.testing.assert_allclose(_error_from(q, twin_q), 0, atol=1e-8)  # the gradient's differences
    np.testing.assert_allclose(bias, twin_bias, atol=1e-8)
    np.testing.assert_allclose(P, twin_P, atol=1e-7 * np.abs(twin_P).max())


def _twin_predict(q, P, w, dt):
    _, psi, q11, q12 = _attitude_model(w, dt)
    q = quaternion_multiply(q, quaternion_exp(w * dt))
    dcm_nb = dcm_from_quaternion(q)
    Phi, Qd = np.eye(6), np.zeros((6, 6))
    Phi[:3, 3:] = -dcm_nb @ psi
    Qd[:3, :3], Qd[:3, 3:] = dcm_nb @ q11 @ dcm_nb.T, dcm_nb @ q12
    Qd[3:, :3], Qd[3:, 3:] = Qd[:3, 3:].T, WALK_DENSITY**2 * dt * np.eye(3)
    return q, Phi @ P @ Phi.T + Qd


def _twin_update(q, bias, P, H, R, y):
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    dx = K @ y
    return quaternion_multiply(quaternion_exp(dx[:3]), q), bias + dx[3:], P - K @ H @ P


def _heading(q):
    dcm_nb = dcm_from_quaternion(q)
    return np.arctan2(dcm_nb[1, 0], dcm_nb[0, 0])


def _gradient(function, size):
    return np.array([(function(e) - function(-e)) / (2 * STEP) for e in STEP * np.eye(size)])


# --- the measurements of the 15-state filter --------------------------------------------------------


def _memory(antenna=(0.0, 0.0, 0.0)):
    """Memory of a navigating filter somewhere in a turn."""
    rng = np.random.default_rng(3)
    memory = np.zeros(kernels.MEMORY_SIZE)
    memory[kernels.M_PARAMETERS:kernels.M_EARTH] = NavigationParams(antenna_position=antenna).flat(
        kernels.PARAMETER_NAMES)
    memory[kernels.X_PHASE] = 1.0
    memory[kernels.X_Q:kernels.X_V] = quaternion_exp(np.array([0.3, -0.4, 0.8]))
    memory[kernels.X_V:kernels.X_COV] = 0.1 * rng.standard_normal(kernels.X_COV - kernels.X_V)
    memory[kernels.X_RATE:kernels.X_ACC] = [0.2, -0.5, 0.9]
    memory[kernels.X_ACC:kernels.X_BLIND] = [1.0, -0.5, 0.3]
    return memory


def _moved(memory, error):
    """Return the memory with an error of the filter's states added, the last rate with its bias."""
    m = memory.copy()
    m[kernels.X_Q:kernels.X_V] = quaternion_multiply(quaternion_exp(error[:3]), m[kernels.X_Q:kernels.X_V])
    for at, state, size in ((kernels.X_BG, kernels.BG, 3), (kernels.X_V, kernels.V, 3), (kernels.X_P, kernels.POS, 3),
                            (kernels.X_BA, kernels.BA, 3), (kernels.X_REF, kernels.REF, 1)):
        m[at:at + size] += error[state:state + size]
    m[kernels.X_RATE:kernels.X_ACC] -= error[kernels.BG:kernels.BG + 3]
    return m


MEASUREMENTS = {
    "fix": (kernels.K_FIX, [1.0, 2.0, -3.0]), "velocity": (kernels.K_VELOCITY, [4.0, -5.0, 1.0]),
    "altitude": (kernels.K_ALTITUDE, [7.0, 7.0, 7.0]), "heading": (kernels.K_HEADING, [0.7, 0.7, 0.7])}


@pytest.mark.parametrize("name", MEASUREMENTS)
def test_jacobian_is_the_derivative_of_the_innovation(name):
    kind, value = MEASUREMENTS[name]
    memory, value = _memory(antenna=(1.0, -0.5, 2.0)), np.array(value)
    H, y, ignored = np.empty((3, kernels.N)), np.zeros(3), np.empty((3, kernels.N))

    def innovation(error):
        out = np.zeros(3)
        kernels.measurement_model(_moved(memory, error), kind, value, 0.0, ignored, out)
        return out

    rows = kernels.measurement_model(memory, kind, value, 0.0, H, y)
    expected = -_gradient(innovation, kernels.N).T[:rows]
    np.testing.assert_allclose(H[:rows], expected, atol=JACOBIAN * np.abs(expected).max())


def test_inclinometer_jacobian_is_the_derivative_where_the_innovation_is_zero():
    memory = _memory()
    down_b = dcm_from_quaternion(memory[kernels.X_Q:kernels.X_V])[2]
    H, y, ignored = np.empty((3, kernels.N)), np.zeros(3), np.empty((3, kernels.N))

    def innovation(error):
        out = np.zeros(3)
        kernels.measurement_model(_moved(memory, error), kernels.K_INCLINOMETER, down_b, 0.0, ignored, out)
        return out

    rows = kernels.measurement_model(memory, kernels.K_INCLINOMETER, down_b, 0.0, H, y)
    np.testing.assert_allclose(H[:rows], -_gradient(innovation, kernels.N).T[:rows], atol=JACOBIAN)


@pytest.mark.parametrize("name", ["fix", "velocity"])
def test_an_age_moves_the_measurement_along_the_motion(name):
    kind, value = MEASUREMENTS[name]
    memory, H, y, aged = _memory(), np.empty((3, kernels.N)), np.zeros(3), np.zeros(3)
    kernels.measurement_model(memory, kind, np.array(value), 0.0, H, y)
    kernels.measurement_model(memory, kind, np.array(value), 0.1, H, aged)
    velocity, acceleration = memory[kernels.X_V:kernels.X_P], memory[kernels.X_ACC:kernels.X_BLIND]
    moved = 0.1 * velocity - 0.005 * acceleration if name == "fix" else 0.1 * acceleration
    np.testing.assert_allclose(aged - y, moved, atol=1e-12)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_the_update_is_the_textbook_one(d):
    rng = np.random.default_rng(5)
    n = 8
    root, noise = rng.standard_normal((n, n)), rng.standard_normal((3, 3))
    P, R, H, y = root @ root.T, noise @ noise.T + np.eye(3), rng.standard_normal((3, n)), rng.standard_normal(3)
    H[:, ::3] = 0.0
    used, dx = P.copy(), np.empty(n)
    h, S = H[:d], H[:d] @ P @ H[:d].T + R[:d, :d]
    K = np.linalg.solve(S, h @ P).T
    expected_nis = y[:d] @ np.linalg.solve(S, y[:d])
    nis = kernels.kalman_update(used, H, R, y, d, dx, np.inf)
    A = np.eye(n) - K @ h
    np.testing.assert_allclose(used, A @ P @ A.T + K @ R[:d, :d] @ K.T, atol=TWIN_RELATIVE * np.abs(P).max())
    np.testing.assert_allclose(dx, K @ y[:d], atol=TWIN_RELATIVE)
    assert nis == pytest.approx(expected_nis) and np.array_equal(used, used.T)
    kept = P.copy()
    assert kernels.kalman_update(kept, H, R, y, d, dx, 0.9 * nis) == pytest.approx(nis)
    assert np.array_equal(kept, P)


# --- paper 001's quaternion and gain ----------------------------------------------------------------


@pytest.mark.parametrize("kind", ORDERS)
def test_sampled_rates_turn_the_attitude_with_their_order(kind):
    """Order 4 for a rate linear in time, 2 for any: halving the interval shows it."""
    errors = [_integration_error(kind, steps) for steps in (40, 80)]
    order = np.log2(errors[0] / errors[1])
    assert ORDERS[kind][0] - ORDER_TOLERANCE < order < ORDERS[kind][1] + ORDER_TOLERANCE


def _integration_error(kind, steps, duration=2.0):
    def rate(t):
        if kind == "linear":
            return np.array([1.0, -0.5, 0.3]) + t * np.array([-0.4, 0.9, 0.6])
        return np.array([np.sin(3 * t), np.cos(2 * t), 0.5 * np.sin(t)])

    def turned(count):
        q, dt = np.array([1.0, 0.0, 0.0, 0.0]), duration / count
        for k in range(count):
            kernels.integrate_rates(q, rate(k * dt), rate((k + 1) * dt), dt)
        return q

    return np.linalg.norm(_error_from(turned(16 * steps), turned(steps)))


def test_the_steady_gain_is_refused_where_it_is_unstable():
    stable, unstable = 0.999 * STEADY_GAIN_LIMIT, 1.001 * STEADY_GAIN_LIMIT
    density, std = 0.1, 1.0

    def params(product):
        # wn T = (Q / R_d)^(1/4) T^(3/4)
        interval = (product / axis_frequency(density, std, 1.0)) ** (4 / 3)
        return NavigationParams(estimator="cascade", gain="steady", accel_noise_density=density, fix_std=std,
                                fix_interval=interval)

    assert params(stable).axis_frequency() * params(stable).fix_interval == pytest.approx(stable)
    with pytest.raises(ValueError, match="unstable; use gain = riccati"):
        params(unstable)


@pytest.mark.parametrize(("product", "stable"), [(0.999 * STEADY_GAIN_LIMIT, True), (1.001 * STEADY_GAIN_LIMIT, False)])
def test_the_limit_is_that_of_the_impulse_gains_eigenvalues(product, stable):
    gain = np.array([[np.sqrt(2) * product], [product**2]])
    step = (np.eye(2) - gain @ [[1.0, 0.0]]) @ [[1.0, 1.0], [0.0, 1.0]]  # in units of the interval
    assert (np.abs(np.linalg.eigvals(step)).max() < 1.0) == stable
