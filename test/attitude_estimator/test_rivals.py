"""The other filters: conventions, equations, the same numbers streamed and in one go, finite whatever comes."""

import math
from functools import cache

import numpy as np
import pytest
from scipy.signal import lti, step

from attitude_estimator import _rival_kernels as kernels
from attitude_estimator.estimator import ACTION_RESET, ACTION_SKIP, AttitudeEstimator, TimeJumpError
from attitude_estimator.params import ESTIMATORS, AttitudeParams
from attitude_estimator.rivals import RIVALS, RivalEstimator, make_estimator
from inertial.imu_errors import ImuErrors
from inertial.recording import AltitudeSeries, ImuSeries
from inertial.rotation import dcm_from_quaternion, down_from_quaternion, down_from_roll_pitch, zoh_integrals
from inertial.scoring import tilt_error_n
from inertial.simulator import simulate

GRAVITY = 9.80665
RATE, STEP_NS, START_NS = 100, 10_000_000, 1_700_000_000_000_000_000
HEIGHT = 0.05  # m, standing: what the unscented filter takes the unknown tilt to shorten the force
SAME_ATTITUDE = 1e-9  # rad, between two ways to write one attitude
EXACT_DEG = 0.02  # perfect sensors from a known start: what constant rates within a sample leave
SECOND_ORDER_DEG = 0.2  # the same where the method's own truncation comes in
SAME_FILTER = 0.1  # sigma between filters that differ in second order only
SAME_SPREAD = 0.05  # of the predicted sigma, the same
LEVEL_DEG = 0.1  # still for ten time constants, after a start 5 deg off
LINEAR_RESPONSE = 2e-3  # of the step: one sample's Euler step, and the sphere's third order
ROUNDING = 1e-12
ENTRIES = 1e-9  # rounding of two entries' kernels, each compiled on its own, over a recording
TWIN_RELATIVE = 1e-9  # two orders of summation over a thousand samples
CENTRAL_DIFFERENCE = 1e-6  # of the largest element: steps of 1e-5, second order
UPDATED = ("dcm_row5_gamma", "euler_ukf", "euler_ukf_first_order", "euler_ekf",
           "euler_ekf_first_order", "quaternion_ekf")
EVERY_RIVAL = pytest.mark.parametrize("name", RIVALS)


def _estimator(name, **settings):
    return RivalEstimator(AttitudeParams(estimator=name, **settings))


def _stand(estimator, roll, pitch, seconds, first=0):
    accel_b = -GRAVITY * down_from_roll_pitch(roll, pitch)
    for k in range(first, first + int(seconds * RATE)):
        estimator.add_imu(START_NS + k * STEP_NS, np.zeros(3), accel_b)
        if k % 5 == 0:
            estimator.add_altitude(START_NS + k * STEP_NS, 12.0)
    return first + int(seconds * RATE)


def _angle(a, b):
    return math.atan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b))


@cache
def _recording(scenario, profile):
    # A little noise, or the sensor at rest would count as stuck.
    return simulate(scenario, duration=40.0, imu_rate=RATE, altimeter_rate=20.0, profile=profile, seed=3)


def _run(name, recording, **settings):
    estimator = _estimator(name, **settings)
    estimator.start_at(down_from_quaternion(recording.truth.q_nb_wxyz[0]), 0.01)
    estimates, fresh = estimator.run(recording.imu, recording.altitude)
    return estimator, estimates, fresh


# --- which there are --------------------------------------------------------------------------------


def test_every_named_estimator_is_made():
    assert set(ESTIMATORS) == {"dcm_row", "dcm_row5", *RIVALS}
    for name in ESTIMATORS:
        made = make_estimator(AttitudeParams(estimator=name))
        assert isinstance(made, RivalEstimator if name in RIVALS else AttitudeEstimator)
        assert made.params.estimator == name


def test_the_default_filter_is_not_a_rival():
    with pytest.raises(ValueError, match="dcm_row"):
        RivalEstimator(AttitudeParams())


# --- conventions ------------------------------------------------------------------------------------


@EVERY_RIVAL
@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (0.0, 0.4), (0.5, -0.3), (3.0, 0.2)])
def test_a_still_body_has_its_roll_and_pitch_and_points_east(name, roll, pitch):
    estimator = _estimator(name)
    _stand(estimator, roll, pitch, 1.0)
    estimate = estimator.estimate
    assert estimate.valid
    assert math.degrees(_angle(estimate.down_b, down_from_roll_pitch(roll, pitch))) < EXACT_DEG
    assert _angle(down_from_quaternion(estimate.q_nb_wxyz), estimate.down_b) < SAME_ATTITUDE
    nose_n = dcm_from_quaternion(estimate.q_nb_wxyz)[:, 0]
    assert math.atan2(nose_n[1], nose_n[0]) == pytest.approx(math.pi / 2, abs=1e-3)
    assert estimate.altitude == pytest.approx(12.0, abs=HEIGHT)


@EVERY_RIVAL
def test_yaw_is_the_integrated_gyro(name):
    estimator = _estimator(name)
    for k in range(101):
        estimator.add_imu(START_NS + k * STEP_NS, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -GRAVITY]))
    nose_n = dcm_from_quaternion(estimator.estimate.q_nb_wxyz)[:, 0]
    assert math.atan2(nose_n[1], nose_n[0]) == pytest.approx(math.pi / 2 + 1.0, abs=1e-3)


@EVERY_RIVAL
def test_the_attitude_is_a_rotation_with_the_estimated_down_axis(name):
    _, estimates, _ = _run(name, _recording("quad", "consumer"))
    np.testing.assert_allclose(np.linalg.norm(estimates.q_nb_wxyz, axis=1), 1.0, atol=SAME_ATTITUDE)
    np.testing.assert_allclose(down_from_quaternion(estimates.q_nb_wxyz), estimates.down_b,
                               atol=SAME_ATTITUDE)


# --- recovery ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "bound_deg"), [
    ("dcm_row5_gamma", EXACT_DEG), ("euler_ekf", EXACT_DEG), ("quaternion_ekf", EXACT_DEG),
    ("gyro", EXACT_DEG), ("gyro_euler", EXACT_DEG), ("euler_ukf", SECOND_ORDER_DEG),
    ("euler_ukf_first_order", SECOND_ORDER_DEG), ("euler_ekf_first_order", SECOND_ORDER_DEG)])
def test_perfect_sensors_give_the_true_attitude(name, bound_deg):
    recording = _recording("turn", "perfect")
    _, estimates, _ = _run(name, recording)
    error = tilt_error_n(estimates.q_nb_wxyz, down_from_quaternion(recording.truth.q_nb_wxyz))
    assert np.degrees(np.abs(error).max()) < bound_deg


@pytest.mark.parametrize("name", ["complementary", "complementary_literal"])
def test_complementary_schemes_level_while_standing(name):
    estimator = _estimator(name, complementary_frequency=0.5)
    estimator.start_at(down_from_roll_pitch(0.09, 0.0), 0.1)
    _stand(estimator, 0.0, 0.0, 20.0)
    assert math.degrees(_angle(estimator.estimate.down_b, [0.0, 0.0, 1.0])) < LEVEL_DEG


@pytest.mark.parametrize("name", ["complementary", "complementary_literal"])
def test_complementary_schemes_have_the_papers_transfer_function(name):
    """A small step of the accelerometer's direction comes through (k_p s + k_i)/(s^2 + k_p s + k_i)."""
    w, off = 0.8, 0.01
    estimator = _estimator(name, complementary_frequency=w)
    estimator.start_at([0.0, 0.0, 1.0], 0.1)
    rolls = []
    for k in range(1000):
        estimator.add_imu(START_NS + k * STEP_NS, np.zeros(3), -GRAVITY * down_from_roll_pitch(off, 0.0))
        rolls.append(estimator.estimate.down_b[1])
    t = np.arange(1000) / RATE
    _, expected = step(lti([math.sqrt(2) * w, w**2], [1.0, math.sqrt(2) * w, w**2]), T=t)
    one_step = math.sqrt(2) * w / RATE
    np.testing.assert_allclose(np.array(rolls) / off, expected, atol=one_step + LINEAR_RESPONSE)


def test_levelling_holds_while_the_force_is_not_of_gravitys_size():
    estimator = _estimator("accelerometer", levelling_gate=0.5)
    estimator.add_imu(START_NS, np.zeros(3), np.array([0.0, 0.0, -GRAVITY]))
    estimator.add_imu(START_NS + STEP_NS, np.zeros(3), np.array([5.0, 0.0, -GRAVITY]))
    assert estimator.estimate.down_b == pytest.approx([0.0, 0.0, 1.0])
    estimator.add_imu(START_NS + 2 * STEP_NS, np.zeros(3), np.array([3.0, 0.0, -math.sqrt(GRAVITY**2 - 9.0)]))
    assert estimator.estimate.down_b[0] == pytest.approx(-3.0 / GRAVITY)


@pytest.mark.parametrize(("gain", "kept"), [(0.0, False), (50.0, True)])
def test_k_gamma_brings_the_norm_back_to_one(gain, kept):
    estimator = _estimator("dcm_row5_gamma", norm_gain=gain)
    estimator.start_at([0.0, 0.0, 1.0], 0.01)
    estimator._memory[kernels.X:kernels.X + 3] *= 0.9
    _stand(estimator, 0.0, 0.0, 0.2)
    assert (abs(estimator.estimate.down_norm - 1.0) < 1e-3) == kept


# --- equations --------------------------------------------------------------------------------------

RNG = np.random.default_rng(11)
POINTS = [(RNG.uniform(-1.2, 1.2, 4), RNG.normal(size=3), RNG.normal(size=3) * 3 - [0, 0, 9.8])
          for _ in range(4)]


def _differences(function, x, size=1e-5):
    columns = [(np.array(function(x + size * e)) - np.array(function(x - size * e))) / (2 * size)
               for e in np.eye(len(x))]
    return np.array(columns).T


@pytest.mark.parametrize(("x", "w", "f"), POINTS)
def test_euler_jacobian(x, w, f):
    expected = _differences(lambda at: kernels.euler_rates(tuple(at), tuple(w), tuple(f), GRAVITY), x)
    jacobian = kernels.euler_jacobian(tuple(x), tuple(w), tuple(f))
    np.testing.assert_allclose(jacobian, expected, atol=CENTRAL_DIFFERENCE * np.abs(expected).max())


@pytest.mark.parametrize(("x", "w", "f"), POINTS)
def test_quaternion_jacobian(x, w, f):
    state = np.concatenate([x / np.linalg.norm(x), [2.0, 100.0]])
    _, jacobian = kernels.quaternion_step(state, tuple(w), tuple(f), GRAVITY, 0.3)
    expected = _differences(
        lambda at: kernels.quaternion_step(at, tuple(w), tuple(f), GRAVITY, 0.3)[0], state)
    np.testing.assert_allclose(jacobian, expected, atol=CENTRAL_DIFFERENCE * np.abs(expected).max())


@pytest.mark.parametrize(("x", "w", "f"), POINTS)
def test_quaternion_step_is_the_exact_motion(x, w, f):
    q, dt = x / np.linalg.norm(x), 0.3
    after, _ = kernels.quaternion_step(np.array([*q, 2.0, 100.0]), tuple(w), tuple(f), GRAVITY, dt)
    R, J1, J2 = zoh_integrals(w, dt)
    dcm_nb = dcm_from_quaternion(q)
    np.testing.assert_allclose(dcm_from_quaternion(after[:4]), dcm_nb @ R, atol=ROUNDING)
    assert after[4] == pytest.approx(2.0 + (dcm_nb @ J1 @ f)[2] + GRAVITY * dt)
    assert after[5] == pytest.approx(100.0 - 2.0 * dt - (dcm_nb @ J2 @ f)[2] - 0.5 * GRAVITY * dt**2)


class UkfTwin:
    """The Euler filter in plain numpy: sigma points of second order, Runge-Kutta or Euler steps."""

    def __init__(self, params, first_order):
        self.p, self.first_order = params, first_order

    def start(self, roll, pitch, altitude, axis_var):
        self.x = np.array([roll, pitch, 0.0, altitude])
        self.P = np.diag([axis_var / math.cos(pitch) ** 2, axis_var, 4.0, 25.0])

    @staticmethod
    def rates(x, w, f):
        roll, pitch = x[:2]
        kinematics = np.array([[1, math.tan(pitch) * math.sin(roll), math.tan(pitch) * math.cos(roll)],
                               [0, math.cos(roll), -math.sin(roll)]])
        return np.array([*kinematics @ w, down_from_roll_pitch(roll, pitch) @ f + GRAVITY, -x[2]])

    def step(self, x, w, f, dt):
        k1 = self.rates(x, w, f)
        if self.first_order:
            return x + dt * k1
        k2 = self.rates(x + dt / 2 * k1, w, f)
        k3 = self.rates(x + dt / 2 * k2, w, f)
        k4 = self.rates(x + dt * k3, w, f)
        return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def imu(self, dt, w, f):
        offsets = 2.0 * np.linalg.cholesky(self.P).T
        points = np.array([self.step(self.x + s * o, w, f, dt) for s in (1, -1) for o in offsets])
        self.x = points.mean(axis=0)
        self.P = (points - self.x).T @ (points - self.x) / 8
        angle_var = dt * self.p.gyro_noise_density**2
        self.P += np.diag([angle_var / math.cos(self.x[1]) ** 2, angle_var,
                           dt * self.p.accel_noise_density**2, 0.0])

    def altitude(self, z, age):
        H = np.array([0.0, 0.0, age, 1.0])
        K = self.P @ H / (H @ self.P @ H + self.p.altitude_std**2)
        self.x = self.x + K * (z - H @ self.x)
        self.P = self.P - np.outer(K, H @ self.P)


@pytest.mark.parametrize("name", ["euler_ukf", "euler_ukf_first_order"])
def test_the_unscented_filter_is_its_plain_twin(name):
    recording = _recording("turn", "consumer")
    imu, altitude = recording.imu, recording.altitude
    estimator = _estimator(name)
    down_b = down_from_roll_pitch(0.1, -0.05)
    estimator.start_at(down_b, 0.05)
    twin = UkfTwin(estimator.params, name.endswith("first_order"))
    twin.start(0.1, -0.05, 0.0, 0.5 * 0.05**2)
    j = 0
    for k in range(1000):
        while altitude.arrival[j] <= k:
            z, age = altitude.altitude[j], (imu.stamp_ns[k - 1] - altitude.stamp_ns[j]) * 1e-9
            estimator.add_altitude(int(altitude.stamp_ns[j]), float(z))
            if j == 0:
                twin.x[3] = z
            else:
                twin.altitude(z, age)
            j += 1
        estimator.add_imu(int(imu.stamp_ns[k]), imu.gyro_b[k], imu.accel_b[k])
        if k > 0:
            twin.imu((imu.stamp_ns[k] - imu.stamp_ns[k - 1]) * 1e-9, imu.gyro_b[k], imu.accel_b[k])
    estimate = estimator.estimate
    assert estimate.down_b == pytest.approx(down_from_roll_pitch(*twin.x[:2]), abs=TWIN_RELATIVE)
    assert [estimate.vd, estimate.altitude] == pytest.approx(twin.x[2:], rel=TWIN_RELATIVE)
    assert [estimate.vd_variance, estimate.altitude_variance] == pytest.approx(
        np.diag(twin.P)[2:], rel=TWIN_RELATIVE)
    pitch = twin.x[1]
    assert np.trace(estimate.tilt_covariance_n) == pytest.approx(
        twin.P[0, 0] * math.cos(pitch) ** 2 + twin.P[1, 1], rel=TWIN_RELATIVE)


@pytest.mark.parametrize("name", ["euler_ekf", "quaternion_ekf"])
def test_small_errors_are_those_of_the_linear_filter(name):
    """Where the tilt is well known all three are one filter up to second order."""
    recording = _recording("turn", "paper")
    noise = ImuErrors(gyro_noise_density=math.radians(0.05), accel_noise_density=0.01)
    settings = {"gyro_noise_density": noise.gyro_noise_density, "altitude_std": 2.0}
    _, rival, _ = _run(name, recording, **settings)
    linear = AttitudeEstimator(AttitudeParams(estimator="dcm_row5", **settings))
    linear.start_at(down_from_quaternion(recording.truth.q_nb_wxyz[0]), 0.01)
    expected, _ = linear.run(recording.imu, recording.altitude)
    apart = np.linalg.norm(rival.down_b - expected.down_b, axis=1)
    spread = np.sqrt(np.trace(expected.tilt_covariance_n, axis1=1, axis2=2))
    assert np.max(apart[200:] / spread[200:]) < SAME_FILTER
    predicted = np.sqrt(np.trace(rival.tilt_covariance_n, axis1=1, axis2=2))
    np.testing.assert_allclose(predicted[200:], spread[200:], rtol=SAME_SPREAD)


# --- streaming --------------------------------------------------------------------------------------


@EVERY_RIVAL
def test_streaming_gives_the_numbers_of_the_recording(name):
    recording = _recording("quad", "consumer")
    imu, altitude = recording.imu, recording.altitude
    batch, fresh = _estimator(name).run(imu, altitude)
    assert fresh.all()
    estimator, j = _estimator(name), 0
    for k in range(len(imu)):
        while j < len(altitude) and altitude.arrival[j] <= k:
            estimator.add_altitude(int(altitude.stamp_ns[j]), float(altitude.altitude[j]))
            j += 1
        assert estimator.add_imu(int(imu.stamp_ns[k]), imu.gyro_b[k], imu.accel_b[k])
        if k % 500 == 0 or k == len(imu) - 1:
            np.testing.assert_allclose(estimator.estimate.rows, batch.rows[k], rtol=ENTRIES, atol=ENTRIES)
            assert estimator.estimate.stamp_ns == imu.stamp_ns[k]


def test_after_a_recording_the_estimate_is_its_last_row():
    estimator, estimates, _ = _run("euler_ekf", _recording("quad", "consumer"))
    np.testing.assert_array_equal(estimator.estimate.rows, estimates.rows[-1])


# --- whatever comes ---------------------------------------------------------------------------------


@EVERY_RIVAL
def test_finite_through_loops_and_bad_samples(name):
    recording = _recording("aerobatic", "paper")
    gyro_b, accel_b = recording.imu.gyro_b.copy(), recording.imu.accel_b.copy()
    gyro_b[1500] = np.nan
    accel_b[2000:2010, 1] = np.inf
    accel_b[2500] = 0.0
    gyro_b[2600] = 1e6
    altitude = recording.altitude.altitude.copy()
    altitude[100] = np.nan
    estimator = _estimator(name)
    estimates, fresh = estimator.run(
        ImuSeries(recording.imu.stamp_ns, gyro_b, accel_b),
        AltitudeSeries(recording.altitude.stamp_ns, altitude, recording.altitude.arrival))
    assert np.all(np.isfinite(estimates.rows))
    assert np.count_nonzero(~fresh) == 13
    counts = {k: v for k, v in vars(estimator.faults).items() if v and k != "restarted"}
    assert counts == {"gyro_not_finite": 1, "accel_not_finite": 10, "accel_zero": 1, "gyro_out_of_range": 1,
                      "altitude_not_finite": 1}


@EVERY_RIVAL
@pytest.mark.parametrize("rate", [math.radians(90.0), -math.radians(33.0)])
def test_finite_exactly_through_ninety_degrees(name, rate):
    estimator = _estimator(name)
    for k in range(1500):
        pitch = rate * k / RATE
        accel_b = -GRAVITY * np.array([-math.sin(pitch), 0.0, math.cos(pitch)])
        estimator.add_imu(START_NS + k * STEP_NS, np.array([0.0, rate, 0.0]), accel_b)
        estimator.add_altitude(START_NS + k * STEP_NS, 0.0)
        assert np.all(np.isfinite(estimator.estimate.rows))


def test_a_start_waits_for_a_force_of_gravitys_size():
    estimator = _estimator("euler_ukf")
    assert "first good" in estimator.waiting_for
    assert not estimator.add_imu(START_NS, np.zeros(3), np.array([0.0, 0.0, -1.0]))
    assert estimator.free_fall and "gravity" in estimator.waiting_for
    assert not estimator.estimate.valid
    assert estimator.add_imu(START_NS + STEP_NS, np.zeros(3), np.array([0.0, 0.0, -9.0]))
    assert estimator.estimate.valid and not estimator.free_fall


def test_a_long_gap_starts_anew():
    estimator = _estimator("gyro")
    estimator.add_imu(START_NS, np.zeros(3), np.array([0.0, 0.0, -GRAVITY]))
    estimator.add_imu(START_NS + 1_100_000_000, np.ones(3), -GRAVITY * down_from_roll_pitch(0.3, 0.0))
    assert estimator.faults.restarted == 1
    assert estimator.estimate.down_b == pytest.approx(down_from_roll_pitch(0.3, 0.0))


@pytest.mark.parametrize("name", UPDATED)
def test_an_altitude_counts_with_its_age(name):
    """Falling at 10 m/s, an altitude of 0.2 s ago is 2 m above that of now."""
    estimator = _estimator(name)
    estimator.start_at([0.0, 0.0, 1.0], 0.01)
    for k in range(500):
        estimator.add_imu(START_NS + k * STEP_NS, np.zeros(3), np.array([0.0, 0.0, -GRAVITY]))
        if k >= 20:
            estimator.add_altitude(START_NS + (k - 20) * STEP_NS, 500.0 - 10.0 * (k - 20) / RATE)
    assert estimator.estimate.vd == pytest.approx(10.0, abs=0.05)
    assert estimator.estimate.altitude == pytest.approx(500.0 - 10.0 * 499 / RATE, abs=0.05)


def test_altitudes_too_old_or_ahead_are_refused_and_counted():
    estimator = _estimator("euler_ekf", altitude_buffer=0.5)
    k = _stand(estimator, 0.0, 0.0, 2.0)
    before = estimator._memory.copy()
    assert not estimator.add_altitude(START_NS + (k - 60) * STEP_NS, 20.0)
    assert not estimator.add_altitude(START_NS + (k + 200) * STEP_NS, 20.0)
    assert estimator.faults.altitude_late == estimator.faults.altitude_ahead == 1
    np.testing.assert_array_equal(estimator._memory, before)
    assert estimator.add_altitude(START_NS + (k - 40) * STEP_NS, 12.0)


def test_a_stamp_that_is_not_later_is_an_error_and_changes_nothing():
    estimator = _estimator("quaternion_ekf")
    k = _stand(estimator, 0.1, 0.0, 1.0)
    before = estimator._memory.copy()
    with pytest.raises(TimeJumpError, match="not later"):
        estimator.add_imu(START_NS + (k - 1) * STEP_NS, np.ones(3), np.ones(3))
    np.testing.assert_array_equal(estimator._memory, before)


def test_actions_skip_and_reset():
    imu = _recording("quad", "consumer").imu
    actions = np.zeros(len(imu), dtype=np.int64)
    actions[100:200] = ACTION_SKIP
    actions[300] = ACTION_RESET
    estimates, fresh = _estimator("gyro").run(imu, actions=actions)
    np.testing.assert_array_equal(fresh, actions != ACTION_SKIP)
    nose_n = dcm_from_quaternion(estimates.q_nb_wxyz[200])[:, 0]
    assert math.atan2(nose_n[1], nose_n[0]) == pytest.approx(math.pi / 2)


def test_reset_forgets_all_but_the_counters():
    estimator = _estimator("euler_ekf")
    estimator.add_altitude(START_NS, math.nan)
    _stand(estimator, 0.2, 0.1, 1.0)
    estimator.reset()
    assert not estimator.estimate.valid and estimator.faults.altitude_not_finite == 1
    assert estimator.add_imu(1, np.zeros(3), np.array([0.0, 0.0, -GRAVITY]))
    assert estimator.estimate.down_b == pytest.approx([0.0, 0.0, 1.0])


@pytest.mark.parametrize("name", UPDATED)
def test_warm_up_compiles_and_leaves_nothing(name):
    estimator = _estimator(name)
    estimator.warm_up()
    assert not estimator.estimate.valid and not any(vars(estimator.faults).values())
