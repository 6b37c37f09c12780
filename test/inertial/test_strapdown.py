"""The strapdown navigator: a plain numpy twin, closed forms, laws, and what it refuses."""

import numpy as np
import pytest

from inertial import _strapdown_kernels as kernels
from inertial.earth import (
    EARTH_RATE,
    STANDARD_GRAVITY,
    earth_rate_n,
    normal_gravity,
    radii_of_curvature,
    transport_rate_n,
)
from inertial.imu_errors import Calibration
from inertial.rotation import (
    dcm_from_quaternion,
    dcm_nb_from_euler,
    quaternion_exp,
    quaternion_from_dcm,
    quaternion_multiply,
    skew,
    zoh_integrals,
)
from inertial.strapdown import (
    SCHEMES,
    NavigationState,
    Strapdown,
    StrapdownParams,
    VerticalChannelError,
    combine_increments,
    dcm_en,
)

ROUNDING = 1e-12
TWIN = 1e-9  # rad, m/s, and parts of a radius: rounding of 200 steps summed in another order
SPLIT = 0.0  # a run in pieces is the same run
ALIKE = 1e-6  # m: two wander angles differ in rounding alone
COMPENSATED = 1e-6  # m after 10 s: rounding of the readings
CALIBRATED_OUT = 1.0  # m after 10 s that the same errors make if left in
REST_POSITION = 1e-3  # m
SCHULER_PART = 0.01
LOOP_LEFT = 0.01  # m: 1 % of the step that the loop has to take out
LATITUDE = np.radians(50.0)
START = NavigationState(
    LATITUDE, 0.2, 300.0, np.array([30.0, -50.0, 2.0]), quaternion_from_dcm(dcm_nb_from_euler(0.1, -0.2, 2.0)))
ALL_SCHEMES = pytest.mark.parametrize("scheme", SCHEMES)


def random_samples(count, seed=0):
    """Return smooth samples of lively motion, (count, 3) each, rad/s and m/s^2."""
    rng = np.random.default_rng(seed)
    t = 0.005 * np.arange(count)[:, None]
    gyro_b, accel_b = (rng.uniform(0.3, 1.0, 3) * np.sin(rng.uniform(1, 9, 3) * t + rng.uniform(0, 6, 3))
                       for _ in range(2))
    return gyro_b, 5 * accel_b - [0.0, 0.0, STANDARD_GRAVITY]


def navigator(start=START, **settings):
    return Strapdown(StrapdownParams(**settings), start)


def distance(a, b):
    """Return how far two states are apart on the Earth and in height, m."""
    meridian, transverse = radii_of_curvature(a.latitude)
    return np.sqrt(((a.latitude - b.latitude) * meridian) ** 2 + (a.height - b.height) ** 2
                   + ((a.longitude - b.longitude) * transverse * np.cos(a.latitude)) ** 2)


def at_rest(latitude, height, count, dcm_nb):
    """Return readings of a perfect IMU at rest."""
    return (np.tile(dcm_nb.T @ earth_rate_n(latitude), (count, 1)),
            np.tile(dcm_nb.T @ [0.0, 0.0, -normal_gravity(latitude, height)], (count, 1)))


# --- the twin ---------------------------------------------------------------------------------------


def combined(alpha, nu, k, new):
    """Coning and sculling as sums of matrices."""
    weighted_alpha, weighted_nu = np.dot(k, alpha[:-1]), np.dot(k, nu[:-1])
    return (alpha[-new:].sum(axis=0) + skew(weighted_alpha) @ alpha[-1],
            nu[-new:].sum(axis=0) + skew(weighted_alpha) @ nu[-1] + skew(weighted_nu) @ alpha[-1])


class Twin:
    """The paper's algorithm in plain matrices, in NED turned by the wander angle."""

    def __init__(self, start, dt, altitude_time):
        self.C = dcm_from_quaternion(start.q_nb_wxyz)
        self.v, self.b, self.h = start.velocity_n, dcm_en(start.latitude, start.longitude), start.height
        self.dt, self.tau, self.correction = dt, altitude_time, 0.0

    def rates(self, b, h, v):
        """Return transport rate, Earth rate and gravity through latitude and wander angle."""
        latitude, wander = np.arcsin(-b[2, 2]), np.arctan2(-b[2, 1], b[2, 0])
        turn = dcm_nb_from_euler(0.0, 0.0, wander)
        transport = turn.T @ transport_rate_n(latitude, h, turn @ v) * [1, 1, 0]
        return transport, turn.T @ earth_rate_n(latitude), np.array([0, 0, normal_gravity(latitude, h)])

    def step(self, phi, eta, altitude):
        dt = self.dt
        _, J1, _ = zoh_integrals(phi, 1.0)
        force = self.C @ J1 @ eta
        transport, earth, gravity = self.rates(self.b, self.h, self.v)
        middle_v = self.v + 0.5 * (force + dt * (gravity - np.cross(transport + 2 * earth, self.v)))
        middle_b = self.b @ zoh_integrals(transport, 0.5 * dt)[0]
        middle_h = self.h - 0.25 * dt * (self.v + middle_v)[2]
        transport, earth, gravity = self.rates(middle_b, middle_h, middle_v)
        force = force - 0.5 * dt * np.cross(transport + earth, force)
        v = self.v + force + dt * (gravity - np.cross(transport + 2 * earth, middle_v))
        transport, earth, _ = self.rates(middle_b, middle_h, 0.5 * (self.v + v))
        self.C = zoh_integrals(transport + earth, dt)[0].T @ self.C @ zoh_integrals(phi, 1.0)[0]
        self.b = self.b @ zoh_integrals(transport, dt)[0]
        self.h -= 0.5 * dt * (self.v + v)[2]
        self.v = v
        error = self.h - altitude
        self.h -= 3 / self.tau * error * dt
        self.v[2] += dt * (self.correction + error * (
            3 / self.tau**2 + 2 * STANDARD_GRAVITY / 6378137.0))
        self.correction += dt * error / self.tau**3


@ALL_SCHEMES
def test_the_compiled_run_is_its_equations(scheme):
    k, new = SCHEMES[scheme].k, SCHEMES[scheme].samples
    steps, interval = 200, 0.005
    gyro_b, accel_b = random_samples(steps * new)
    altitude = np.linspace(300.0, 310.0, steps)
    run = navigator(scheme=scheme)
    run.run(gyro_b, accel_b, altitude)
    twin = Twin(START, new * interval, run.params.altitude_time)
    before = len(k) + 1 - new
    alpha, nu = (interval * np.concatenate([values[:1].repeat(before, axis=0), values])
                 for values in (gyro_b, accel_b))
    for step in range(steps):
        rows = slice(step * new, step * new + len(k) + 1)
        twin.step(*combined(alpha[rows], nu[rows], k, new), altitude[step])
    turn = dcm_nb_from_euler(0.0, 0.0, run.state.wander)
    np.testing.assert_allclose(turn.T @ dcm_from_quaternion(run.state.q_nb_wxyz), twin.C, atol=TWIN)
    np.testing.assert_allclose(turn.T @ run.state.velocity_n, twin.v, atol=TWIN)
    np.testing.assert_allclose(dcm_en(run.state.latitude, run.state.longitude, run.state.wander), twin.b, atol=TWIN)
    assert run.state.height == pytest.approx(twin.h, abs=TWIN)


def test_gravity_and_transport_rate_are_those_of_the_earth_module():
    for latitude in (-1.2, 0.0, 0.7, 1.5):
        axis = tuple(dcm_en(latitude, 0.3)[2])
        assert kernels.gravity(axis[2], 5000.0) == pytest.approx(normal_gravity(latitude, 5000.0), rel=ROUNDING)
        expected = transport_rate_n(latitude, 5000.0, [100.0, -70.0, 3.0])
        np.testing.assert_allclose(kernels.transport_rate(axis, 5000.0, (100.0, -70.0, 3.0))[:2], expected[:2],
                                   rtol=ROUNDING)


# --- coning and sculling ------------------------------------------------------------------------------


@ALL_SCHEMES
def test_constant_rate_and_force_are_integrated_exactly(scheme):
    gyro_b, accel_b = np.array([0.7, -0.4, 1.1]), np.array([2.0, -1.5, -11.0])
    count = 3 * SCHEMES[scheme].samples
    phi, gained_b = combine_increments(np.tile(0.01 * gyro_b, (count, 1)), np.tile(0.01 * accel_b, (count, 1)), scheme)
    dt = 0.01 * SCHEMES[scheme].samples
    np.testing.assert_allclose(phi, np.tile(dt * gyro_b, (3, 1)), atol=ROUNDING)
    np.testing.assert_allclose(gained_b, np.tile(zoh_integrals(gyro_b, dt)[1] @ accel_b, (3, 1)), atol=ROUNDING)


@ALL_SCHEMES
def test_the_factors_cancel_the_leading_terms_of_coning(scheme):
    """``sum k_i sin((last - i) x) (2 sin(x/2))^2 = (n x - sin n x) / 2`` to the order of the scheme."""
    k, n = np.array(SCHEMES[scheme].k), SCHEMES[scheme].samples
    behind = np.arange(len(k), 0, -1)

    def residual(x):
        return np.sum(k * np.sin(behind * x)) * (2 * np.sin(x / 2)) ** 2 - (n * x - np.sin(n * x)) / 2
    order = np.log2(residual(0.2) / residual(0.1))
    assert order == pytest.approx(3 + 2 * len(k), abs=0.1)  # 3: nothing corrected


# --- laws -----------------------------------------------------------------------------------------------


def test_pieces_of_a_run_and_single_steps_are_the_run():
    gyro_b, accel_b = random_samples(400)
    altitude = np.full(200, 300.0)
    for semantics in ("mean", "point"):
        whole, pieces, steps = (navigator(imu_semantics=semantics) for _ in range(3))
        states = whole.run(gyro_b, accel_b, altitude, every=50)
        for part in (slice(0, 50), slice(50, 200)):
            pieces.run(gyro_b[2 * part.start:2 * part.stop], accel_b[2 * part.start:2 * part.stop], altitude[part])
        for i in range(200):
            last = steps.step(gyro_b[2 * i:2 * i + 2], accel_b[2 * i:2 * i + 2], altitude[i])
        for other in (pieces.state, last):
            assert distance(whole.state, other) <= SPLIT
            np.testing.assert_array_equal(whole.state.q_nb_wxyz, other.q_nb_wxyz)
        assert states.latitude.shape == (4,)
        assert states.latitude[-1] == whole.state.latitude


@pytest.mark.parametrize("wander", [0.5, -3.0])
def test_the_wander_angle_at_the_start_changes_nothing(wander):
    gyro_b, accel_b = random_samples(2000)
    altitude = np.full(1000, 300.0)
    plain, turned = (navigator(NavigationState(START.latitude, START.longitude, START.height, START.velocity_n,
                                               START.q_nb_wxyz, angle)) for angle in (0.0, wander))
    plain.run(gyro_b, accel_b, altitude)
    turned.run(gyro_b, accel_b, altitude)
    assert distance(plain.state, turned.state) < ALIKE
    np.testing.assert_allclose(plain.state.velocity_n, turned.state.velocity_n, atol=ALIKE)
    assert abs(np.dot(plain.state.q_nb_wxyz, turned.state.q_nb_wxyz)) == pytest.approx(1.0, abs=ROUNDING)


def test_the_start_is_told_back():
    state = navigator(NavigationState(-1.0, -3.0, 50.0, np.array([1.0, 2.0, 3.0]), START.q_nb_wxyz, 0.7)).state
    assert (state.latitude, state.longitude, state.height, state.wander) == pytest.approx((-1.0, -3.0, 50.0, 0.7))
    np.testing.assert_allclose(state.velocity_n, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(state.q_nb_wxyz, START.q_nb_wxyz)


def test_the_columns_of_b_are_north_east_and_down():
    north, east, down = dcm_en(0.3, 0.7).T
    np.testing.assert_allclose(down, -np.array([np.cos(0.3) * np.cos(0.7), np.cos(0.3) * np.sin(0.7), np.sin(0.3)]))
    np.testing.assert_allclose(east, [-np.sin(0.7), np.cos(0.7), 0.0], atol=ROUNDING)
    np.testing.assert_allclose(np.cross(east, down), north, atol=ROUNDING)


def test_constant_sensor_errors_are_taken_out_and_matter():
    rng = np.random.default_rng(3)
    gyro, accel = (Calibration(0.01 * rng.standard_normal((3, 3)), bias * rng.standard_normal(3))
                   for bias in (0.01, 0.2))
    gyro_b, accel_b = random_samples(2000)
    readings = [values @ (np.eye(3) + sensor.matrix).T + sensor.bias_b
                for values, sensor in ((gyro_b, gyro), (accel_b, accel))]
    perfect, compensated, spoiled = navigator(), Strapdown(StrapdownParams(), START, gyro, accel), navigator()
    perfect.run(gyro_b, accel_b)
    compensated.run(*readings)
    spoiled.run(*readings)
    assert distance(perfect.state, compensated.state) < COMPENSATED
    assert distance(perfect.state, spoiled.state) > CALIBRATED_OUT


def test_a_parabola_of_point_samples_is_integrated_exactly():
    t = 0.005 * np.arange(1, 5)[:, None]
    window, history = np.zeros((1, 6)), np.zeros((3, 6))
    affine = np.tile(np.eye(3, 4), (2, 1, 1))
    readings = np.array([1.0, -2.0, 3.0]) + t * [4.0, 5.0, -6.0] + t**2 * [70.0, -80.0, 90.0]
    for reading in readings:
        kernels.take_sample(window, 0, history, reading, reading, affine, 0.005, True)
        history[0, 0] = 1.0
    before, end = 0.005 * 3, 0.005 * 4
    expected = (0.005 * np.array([1.0, -2.0, 3.0]) + (end**2 - before**2) / 2 * np.array([4.0, 5.0, -6.0])
                + (end**3 - before**3) / 3 * np.array([70.0, -80.0, 90.0]))
    np.testing.assert_allclose(window[0], np.tile(expected, 2), rtol=ROUNDING)


# --- over the turning Earth -----------------------------------------------------------------------------


def test_a_perfect_imu_at_rest_stays_where_it_is():
    dcm_nb = dcm_nb_from_euler(0.1, -0.2, 2.0)
    start = NavigationState(LATITUDE, 0.2, 300.0, np.zeros(3), quaternion_from_dcm(dcm_nb))
    gyro_b, accel_b = at_rest(LATITUDE, 300.0, 2 * 180_000, dcm_nb)
    run = navigator(start)
    states = run.run(gyro_b, accel_b, np.full(180_000, 300.0), every=1000)
    assert distance(start, states).max() < REST_POSITION


def test_an_accelerometer_bias_swings_with_schuler():
    start = NavigationState(LATITUDE, 0.2, 0.0, np.zeros(3), np.array([1.0, 0, 0, 0]))
    count = 2 * 30_000
    gyro_b, accel_b = at_rest(LATITUDE, 0.0, count, np.eye(3))
    states = navigator(start, sample_interval=0.05).run(gyro_b, accel_b + [1e-3, 0, 0], np.zeros(30_000), every=10)
    radius, gravity = radii_of_curvature(LATITUDE)[0], normal_gravity(LATITUDE)
    # Half a swing: two radii times the tilt at which gravity makes up for the bias.
    assert (states.latitude - LATITUDE).max() == pytest.approx(2 * 1e-3 / gravity, rel=SCHULER_PART)
    half = np.pi * np.sqrt(radius / gravity)
    assert np.argmax(states.latitude) + 1 == pytest.approx(half, rel=SCHULER_PART)


def test_the_altitude_holds_the_vertical_channel_and_finds_the_bias():
    start = NavigationState(LATITUDE, 0.2, 1.0, np.zeros(3), np.array([1.0, 0, 0, 0]))
    gyro_b, accel_b = at_rest(LATITUDE, 0.0, 2 * 60_000, np.eye(3))
    aided, free = navigator(start), navigator(start)
    aided.run(gyro_b, accel_b + [0, 0, 0.01], np.zeros(60_000))
    assert abs(aided.state.height) < LOOP_LEFT
    assert abs(aided.state.velocity_n[2]) < LOOP_LEFT
    free.run(gyro_b, accel_b + [0, 0, 0.01])
    growth = np.sqrt(2 * STANDARD_GRAVITY / 6378137.0)
    grown = np.cosh(growth * 600.0) - 0.01 / growth**2 * (np.cosh(growth * 600.0) - 1)
    assert free.state.height == pytest.approx(grown, rel=SCHULER_PART)


# --- what is refused --------------------------------------------------------------------------------------


def test_the_vertical_channel_is_not_integrated_alone_for_long():
    gyro_b, accel_b = at_rest(LATITUDE, 0.0, 1000, np.eye(3))
    run = navigator(unaided_limit=9.0)
    run.run(gyro_b, accel_b)
    with pytest.raises(VerticalChannelError, match=r"10 s without an altitude.*unaided_limit = 9 s"):
        run.run(gyro_b, accel_b)
    run.run(gyro_b, accel_b, np.where(np.arange(500) == 250, 0.0, np.nan))
    run.run(gyro_b, accel_b)


@pytest.mark.parametrize(("arguments", "message"), [
    ((np.zeros((3, 3)), np.zeros((3, 3))), r"gyro_b has shape \(3, 3\)"),
    ((np.zeros((4, 3)), np.zeros((2, 3))), r"accel_b has shape \(2, 3\)"),
    ((np.full((2, 3), np.nan), np.zeros((2, 3))), "gyro_b is not finite"),
    ((np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(1)), r"altitude has shape \(1,\)"),
    ((np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(2), 3), "every = 3"),
])
def test_readings_that_do_not_fit_are_refused_by_name(arguments, message):
    with pytest.raises(ValueError, match=message):
        navigator().run(*arguments)


def test_a_start_that_is_not_one_finite_state_is_refused():
    with pytest.raises(ValueError, match="start"):
        navigator(NavigationState(np.nan, 0.0, 0.0, np.zeros(3), np.array([1.0, 0, 0, 0])))


def test_the_quaternion_stays_one_and_turns_with_the_earth():
    start = NavigationState(LATITUDE, 0.2, 0.0, np.zeros(3), np.array([1.0, 0, 0, 0]))
    run = navigator(start)
    gyro_b, accel_b = at_rest(LATITUDE, 0.0, 2000, np.eye(3))
    run.run(0 * gyro_b, accel_b, np.zeros(1000))
    assert np.linalg.norm(run.state.q_nb_wxyz) == pytest.approx(1.0, abs=ROUNDING)
    # A body that does not turn in space turns backwards against the Earth; tilt moves it a little.
    expected = quaternion_multiply(quaternion_exp(-10.0 * earth_rate_n(LATITUDE)), start.q_nb_wxyz)
    np.testing.assert_allclose(run.state.q_nb_wxyz, expected, atol=0.01 * 10 * EARTH_RATE)
