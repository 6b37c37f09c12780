"""The filters against numpy twins, against the physics, and from far off; coarse alignment and bounds."""

import math

import numpy as np
import pytest

from alignment.standing import _kernels as kernels
from alignment.standing.bound import heading_bound, heading_floor
from alignment.standing.coarse import align_by_gravity, align_two_vectors
from alignment.standing.filters import Filter, heading_covariance, reduce, run_filter, sample_intervals
from alignment.standing.params import MODELS
from alignment.standing.predictive import error_jacobian, error_rate
from inertial.earth import earth_rate_n
from inertial.recording import ImuSeries
from inertial.rotation import (
    dcm_from_quaternion,
    quaternion_exp,
    quaternion_from_dcm,
    quaternion_log,
    quaternion_multiply,
    skew,
)

ARCMIN = math.radians(1 / 60)
FAR = math.radians(30.0)
ROUNDING = 1e-12  # rad, m/s
EXACT = 1e-6  # rad, of a coarse alignment of perfect sensors
STEP_TOLERANCE = 5e-3  # per unit error: terms beyond the first order in a step that turns by 0.01 rad
TWIN = 1e-9  # relative: the same arithmetic in another order
PAGE = 0.05  # relative, of the page's rounded bounds
PLAIN = {"robust": False, "adaptive": False, "zero_velocity_period": 0.0}


def dcm_exp(vector):
    return dcm_from_quaternion(quaternion_exp(vector))


@pytest.mark.parametrize("turns", [(), ((5.0, 20.0, 3.0),)], ids=["still", "turning"])
def test_gravity_in_inertial_axes_gives_the_attitude(made_up, turns):
    imu, dcm_nb = made_up.imu(made_up.perfect, 40.0, turns=turns, heading=-2.0)
    params = made_up.params(made_up.perfect)
    steps, _ = reduce(imu, sample_intervals(imu.stamp_ns), 0.1)
    sums = np.zeros(kernels.O_SIZE)
    kernels.run_coarse(params.constants(), sums, np.zeros(6), steps)
    found = align_by_gravity(sums, params)
    assert np.linalg.norm(quaternion_log(quaternion_from_dcm(
        dcm_from_quaternion(found.q_nb_wxyz) @ dcm_nb.T))) < 100 * EXACT


def test_two_vectors_give_the_attitude_and_the_biases_show_as_predicted(made_up):
    params = made_up.params(made_up.navigation)
    imu, dcm_nb = made_up.imu(made_up.perfect, 1.0, heading=1.0)
    gyro_b, accel_b = imu.gyro_b.mean(axis=0), imu.accel_b.mean(axis=0)
    found = align_two_vectors(gyro_b, accel_b, 1200.0, params)
    np.testing.assert_allclose(dcm_from_quaternion(found.q_nb_wxyz), dcm_nb, atol=EXACT)
    east = dcm_nb.T @ [0.0, 1e-8, 0.0]
    wrong = align_two_vectors(gyro_b + east, accel_b, 1200.0, params)
    turned = quaternion_log(quaternion_from_dcm(dcm_from_quaternion(wrong.q_nb_wxyz) @ dcm_nb.T))
    assert turned[2] == pytest.approx(-1e-8 / params.north_rate, rel=1e-3)


@pytest.mark.parametrize("bend", [0.0, 0.02], ids=["straight", "bent"])
def test_missing_samples_are_bridged_and_counted_in_the_variance(bend):
    """Of readings on a straight line nothing is lost, of a parabola as much as the step says."""
    count, dt = 60, 0.01
    time = (np.arange(count) + 0.5) * dt
    rate = 0.01 + 0.05 * time + bend * ((time - 0.3) ** 2 + dt ** 2 / 12)  # means over the intervals
    gyro_b, accel_b = np.outer(rate, [1.0, 0.0, 0.0]), np.outer(10 * rate, [1.0, 0.0, 0.0])
    kept = np.ones(count, dtype=bool)
    kept[[25, 26]] = False
    stamp_ns = np.arange(1, count + 1) * 10_000_000
    angle, speed, variances = {}, {}, None
    for name, part in (("all", np.ones(count, dtype=bool)), ("some", kept)):
        imu = ImuSeries(stamp_ns[part], gyro_b[part], accel_b[part])
        steps, _ = reduce(imu, sample_intervals(imu.stamp_ns), 0.1)
        angle[name] = steps[:, kernels.STEP_DTHETA].sum()
        speed[name] = steps[:, kernels.STEP_DVEL].sum()
        variances = steps[:, kernels.STEP_LOST:].sum(axis=0)
    lost = np.sqrt(variances)
    assert abs(angle["some"] - angle["all"]) == pytest.approx(lost[0], rel=1e-3, abs=ROUNDING)
    assert abs(speed["some"] - speed["all"]) == pytest.approx(lost[1], rel=1e-3, abs=ROUNDING)
    assert (lost > 1e3 * ROUNDING).all() == (bend > 0)


@pytest.mark.parametrize("name", ["riekf12", "mekf"])
def test_transition_is_the_derivative_of_the_step(made_up, name):
    """An error injected before a step comes out of it as F says, by the filter's own definition of error."""
    params = made_up.params(made_up.navigation)
    imu, dcm_nb = made_up.imu(made_up.navigation, 1.0, turns=((0.0, 10.0, 1.0),))
    step = reduce(imu, sample_intervals(imu.stamp_ns), 0.1)[0][3]
    sizes = np.repeat([1e-4, 1e-3, 1e-6, 1e-3], 3)

    def carried(delta):
        R = dcm_exp(delta[:3]) @ dcm_nb
        m = np.zeros(kernels.M_SIZE)
        m[:9] = delta[3:] @ np.kron(np.eye(3), R)
        m[:3] = delta[3:6]
        F, H, after = np.empty((12, 12)), np.empty((3, 12)), np.empty((7, 3))
        kernels.group_step(MODELS[name], params.constants(), R, m, step, np.empty((3, 3)),
                           np.empty((3, 3)), after, F, H)
        return R, m, F, H, after[0]

    R, m, F, H, mean = carried(np.zeros(12))
    for j in range(12):
        found = []
        for sign in (1, -1):
            R1, m1, _, _, mean1 = carried(sign * sizes[j] * np.eye(12)[j])
            phi = quaternion_log(quaternion_from_dcm(R1 @ R.T))
            rho = m1[:3] - (dcm_exp(phi) @ m[:3] if name == "riekf12" else m[:3])
            found.append(np.concatenate([phi, rho, R @ (m1[3:6] - m[3:6]), R @ (m1[6:9] - m[6:9]), mean1 - mean]))
        numeric = (found[0] - found[1]) / (2 * sizes[j])
        np.testing.assert_allclose(numeric[:12], F[:, j], atol=STEP_TOLERANCE, err_msg=f"column {j}")
        if j not in (6, 7, 8):  # the rates' part in the mean velocity, g t^2 / 6, is left out
            np.testing.assert_allclose(numeric[12:], (H @ F)[:, j], atol=STEP_TOLERANCE, err_msg=f"mean, column {j}")


def test_invariant_filter_against_its_numpy_twin(made_up):
    imu, dcm_nb = made_up.imu(made_up.navigation, 3.0, seed=4)
    params = made_up.params(made_up.navigation, **{**PLAIN, "zero_velocity_period": 0.1})
    steps, _ = reduce(imu, sample_intervals(imu.stamp_ns), 0.1)
    start = quaternion_multiply(quaternion_exp([0.01, -0.02, 0.5]), quaternion_from_dcm(dcm_nb))
    state = Filter("riekf12", params, start, heading_covariance(FAR))
    R, P, v, b = state.R.copy(), state.P.copy(), np.zeros(3), np.zeros(6)
    state.run_steps(steps, np.empty((0, kernels.OUT_SIZE)))
    g, noise = np.array([0.0, 0.0, params.local_gravity]), np.repeat(
        [params.gyro_noise_density, params.accel_noise_density, 0.0, 0.0], 3) ** 2
    for step in steps:
        t = step[0]
        transport = np.array([v[1], -v[0], -v[1] * np.tan(params.latitude)]) / params.constants()[
            kernels.C_RADIUS]
        w = earth_rate_n(params.latitude) + transport
        coriolis = w + earth_rate_n(params.latitude)
        turn = dcm_exp(0.5 * (step[1:4] - b[:3] * t))
        half = R @ turn
        gain = R @ (step[4:7] - 0.5 * t * np.cross(b[:3], step[4:7])) - t * half @ b[3:]
        mean = v + R @ (step[7:10] - t / 3 * np.cross(b[:3], step[7:10])) \
            + 0.5 * t * (g - np.cross(coriolis, v) - half @ b[3:])
        v = v + gain - 0.5 * t * np.cross(w, gain) + t * (g - np.cross(coriolis, v))
        F = np.eye(12)
        F[:3, :3] -= t * skew(w)
        radius = params.constants()[kernels.C_RADIUS]
        F[0, 4], F[1, 3], F[2, 4] = -t / radius, t / radius, t * np.tan(params.latitude) / radius
        F[3:6, :3] = t * skew(g)
        F[3:6, 3:6] -= t * skew(coriolis)
        F[:3, 6:9] = F[3:6, 9:] = -t * half @ R.T
        F[3:6, 6:9] = -0.5 * t * t * skew(g) @ half @ R.T
        H = np.concatenate([-0.5 * F[3:6, :3], np.eye(3), np.zeros((3, 3)), 0.5 * t * np.eye(3)], axis=1)
        after = dcm_exp(-t * w) @ half @ turn
        F[6:, 6:] = np.kron(np.eye(2), after @ R.T)
        R = after
        P = F @ P @ F.T + t * np.diag(noise)
        K = np.linalg.solve(H @ P @ H.T + params.zero_velocity_std ** 2 * np.eye(3), H @ P).T
        delta, P = K @ mean, P - K @ H @ P
        phi = -delta[:3]
        angle = np.linalg.norm(phi)
        J = np.eye(3) + (1 - np.cos(angle)) / angle ** 2 * skew(phi) \
            + (angle - np.sin(angle)) / angle ** 3 * skew(phi) @ skew(phi)
        R, v = dcm_exp(phi) @ R, dcm_exp(phi) @ v - J @ delta[3:6]
        b = b - np.kron(np.eye(2), R.T) @ delta[6:]
    np.testing.assert_allclose(state.R, R, atol=TWIN)
    np.testing.assert_allclose(state.m[3:9], b, atol=1e-6 * np.abs(b).max())
    np.testing.assert_allclose(state.P, P, atol=1e-7 * np.abs(P).max())


def test_error_model_filter_against_its_numpy_twin(made_up):
    """ekf5 open loop, the attitude being the computed one with the error taken off."""
    imu, dcm_nb = made_up.imu(made_up.navigation, 2.0, seed=4)
    params = made_up.params(made_up.navigation, feedback_period=0.0, **PLAIN)
    start = quaternion_multiply(quaternion_exp([0.0, 0.0, 0.5]), quaternion_from_dcm(dcm_nb))
    history = run_filter("ekf5", imu, start, heading_covariance(FAR), params, period=2.0)
    c = params.constants()
    R, m, x = dcm_from_quaternion(start), np.zeros(kernels.M_SIZE), np.zeros(5)
    P = np.zeros((5, 5))
    P[:2, :2], P[2:, 2:] = 0.01 * np.eye(2), heading_covariance(FAR)
    Q = np.diag(np.repeat([params.accel_noise_density, params.gyro_noise_density], [2, 3]) ** 2)
    for t, gyro_b, accel_b in zip(sample_intervals(imu.stamp_ns), imu.gyro_b, imu.accel_b, strict=True):
        kernels.strapdown_step(c, R, m, t, gyro_b, accel_b, np.zeros(6), np.empty((3, 3)), np.empty((3, 3)))
        force = m[kernels.M_FORCE:kernels.M_FORCE + 3]
        F = np.eye(5) + t * error_jacobian(x, force, R, params)
        x = x + t * error_rate(x, force, R, params)
        P = F @ P @ F.T + t * Q
        K = np.linalg.solve(P[:2, :2] + params.zero_velocity_std ** 2 * np.eye(2), P[:2]).T
        x, P = x + K @ (m[:2] - x[:2]), P - K @ P[:2]
    np.testing.assert_allclose(history.velocity_n[-1, :2], m[:2] - x[:2], atol=TWIN)
    np.testing.assert_allclose(history.covariance[-1], P[2:, 2:], atol=1e-7 * P[4, 4])


@pytest.mark.parametrize(("name", "changes", "limit"), [
    ("ekf5", {}, 0.1), ("ekf10", {}, 0.1), ("ukf10", {}, 1.0), ("mekf", {}, 0.1), ("riekf6", {}, 0.1),
    ("riekf12", {}, 0.1), ("ipekf", {}, 0.1), ("ipekf", {"variant": "residual"}, 85.0)])
def test_every_filter_finds_north_from_30_deg_off_with_perfect_sensors(made_up, name, changes, limit):
    imu, dcm_nb = made_up.imu(made_up.perfect, 60.0)
    start = quaternion_multiply(quaternion_exp([0.0, 0.0, FAR]), quaternion_from_dcm(dcm_nb))
    params = made_up.params(made_up.perfect, **{**PLAIN, "zero_velocity_period": 0.02, **changes})
    history = run_filter(name, imu, start, heading_covariance(FAR), params, period=10.0)
    assert abs(made_up.error(history.heading[-1], dcm_nb)) < limit * ARCMIN


def test_paper_literal_runs_away_from_its_own_linearisation(made_up):
    """Open loop, the strapdown's velocity grows without end: half of g w t^2 and more in 60 s."""
    imu, dcm_nb = made_up.imu(made_up.perfect, 60.0)
    start = quaternion_multiply(quaternion_exp([0.0, 0.0, FAR]), quaternion_from_dcm(dcm_nb))
    params = made_up.params(made_up.perfect, variant="paper_literal", jacobian="paper", **PLAIN)
    state = Filter("ipekf", params, start, heading_covariance(FAR))
    state.run_samples(sample_intervals(imu.stamp_ns), imu.gyro_b, imu.accel_b, True, 1,
                      np.empty((0, kernels.OUT_SIZE)))
    expected = 0.5 * params.local_gravity * 2 * math.sin(FAR / 2) * params.north_rate * 60.0 ** 2
    assert np.hypot(*state.m[:2]) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("off_deg", [5.0, 90.0, 170.0])
def test_invariant_filter_does_not_mind_how_far_off_it_starts(made_up, off_deg):
    imu, dcm_nb = made_up.imu(made_up.navigation, 300.0, seed=2)
    off = math.radians(off_deg)
    start = quaternion_multiply(quaternion_exp([0.0, 0.0, off]), quaternion_from_dcm(dcm_nb))
    params = made_up.params(made_up.navigation, robust=False, adaptive=False)
    history = run_filter("riekf6", imu, start, heading_covariance(off), params, period=300.0)
    floor = heading_floor(300.0 * dcm_nb[1], 300.0, params)
    assert abs(made_up.error(history.heading[-1], dcm_nb)) < 3.5 * floor


@pytest.mark.parametrize(("grade", "turns", "bound_arcmin"), [
    ("navigation", (), 3.0), ("tactical", (), 283.0), ("navigation", ((595.0, 10.0, math.pi),), 0.99),
    ("tactical", ((595.0, 10.0, math.pi),), 50.0)])
def test_bounds_are_those_of_the_page(made_up, grade, turns, bound_arcmin):
    params = made_up.params(getattr(made_up, grade))
    time = np.arange(1, 1201)
    share = np.zeros(1200) if not turns else np.clip((time - turns[0][0]) / turns[0][1], 0.0, 1.0)
    q_nb = quaternion_exp(np.stack([0 * share, 0 * share, math.pi * share], axis=1))
    bound = heading_bound(time * 10 ** 9, q_nb, params)[-1]
    east_b = dcm_from_quaternion(q_nb)[:, 1].sum(axis=0)
    assert bound == pytest.approx(bound_arcmin * ARCMIN, rel=PAGE)
    assert heading_floor(east_b, 1200.0, params) == pytest.approx(bound, rel=PAGE)
