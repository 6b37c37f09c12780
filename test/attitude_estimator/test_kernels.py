"""The compiled filters are their equations: plain numpy twins, matrix exponential, noise in closed form."""

import numpy as np
import pytest
from scipy.linalg import expm

from attitude_estimator import _kernels as kernels
from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.params import AttitudeParams
from inertial.recording import AltitudeSeries
from inertial.rotation import dcm_from_quaternion, skew, zoh_integrals
from inertial.simulator import simulate

TWIN_RELATIVE = 1e-9  # rounding of two orders of summation over a thousand samples
TWIN_COVARIANCE = 1e-8  # the same of a covariance that the altimeter has reduced a thousandfold
ROUNDING = 1e-13
COVARIANCE_MONTE_CARLO = 0.02  # of the largest element: 4 sigma of 200 000 draws, and the noise's 3rd order
SENSITIVITY = 0.01  # of the effect: half a sample interval times the rate, and what the start left
SECOND_ORDER = (3.5, 4.5)  # how much an error of order dt^2 falls when dt is halved

GRAVITY = 9.80665
GYRO = np.array([0.7, -0.4, 1.1])
ACCEL = np.array([2.0, -1.5, -11.0])
RNG_SEED = 7


# --- the twins --------------------------------------------------------------------------------------


class PaperTwin:
    """The paper's filter, dense: x = [c, vd, h], equations 26 to 31 with the design's corrections."""

    size = 5

    def __init__(self, params):
        self.p = params
        self.x = np.zeros(self.size)
        self.P = np.zeros((self.size, self.size))
        self.known = False
        self.P[:5, :5] = np.diag([1 / 3, 1 / 3, 1 / 3, 2.0**2, 5.0**2])
        self.altitudes = []
        self.pull = np.zeros((2, 2))  # covariance of pulled tilt and lasting acceleration

    def imu(self, dt, gyro, accel):
        self.propagate(dt, gyro, accel)

    def propagate(self, dt, rate, force):
        F, u = self.transition(dt, rate, force)
        self.x = F @ self.x + u
        F = self.with_biases(F, dt)
        self.P = F @ self.P @ F.T
        self.add_noise(dt, rate, force)
        return F[:3, :3]

    def transition(self, dt, rate, force):
        """Return F without the biases' columns, and the input of gravity."""
        R, J1, J2 = zoh_integrals(rate, dt)
        F = np.eye(self.size)
        F[:3, :3], F[3, :3], F[4, :3], F[4, 3] = R.T, J1 @ force, -J2 @ force, -dt
        u = np.zeros(self.size)
        u[3:5] = self.p.local_gravity() * np.array([dt, -0.5 * dt**2])
        return F, u

    def with_biases(self, F, dt):
        return F

    def add_noise(self, dt, rate, force):
        self.add_multiplicative(dt * self.p.gyro_noise_density**2, dt * self.p.accel_noise_density**2)

    def add_multiplicative(self, q_angle, q_vd):
        M = np.outer(self.x[:3], self.x[:3]) + self.P[:3, :3]
        self.P[:3, :3] += q_angle * (np.trace(M) * np.eye(3) - M)
        self.P[3, 3] += q_vd * np.trace(M)

    def altitude(self, z, age):
        if not self.altitudes:
            self.x[4] = z
        else:
            self.use_altitude(z, np.eye(self.size)[4] + age * np.eye(self.size)[3])
        self.altitudes.append(z)

    def use_altitude(self, z, H):
        self.update(z - H @ self.x, H, self.p.altitude_std**2)
        self.normalise()

    def update(self, innovation, H, R):
        K = self.P @ H / (H @ self.P @ H + R)
        self.x = self.x + K * innovation
        A = np.eye(self.size) - np.outer(K, H)
        self.P = A @ self.P @ A.T + R * np.outer(K, K)

    def normalise(self):
        norm = np.linalg.norm(self.x[:3])
        if np.trace(self.P[:3, :3]) < 0.02 and norm > 0.5:
            u = self.x[:3] / norm
            A = np.eye(self.size)
            A[:3, :3] = (np.eye(3) - np.outer(u, u)) / norm
            self.x[:3], self.P = u, A @ self.P @ A.T
            self.known = True


class DefaultTwin(PaperTwin):
    """The default filter, dense: x = [c, vd, h, gyro bias, accelerometer bias], gravity, rest."""

    size = 11

    def __init__(self, params):
        super().__init__(params)
        self.P[5:, 5:] = np.diag(np.repeat([params.gyro_bias_std**2, params.accel_bias_std**2], 3))
        self.s, self.W, self.B = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
        self.time = self.since_gravity = self.since_altitude = self.rest = 0.0
        self.residual = self.altimeter_var = self.step = self.vibration = 0.0
        self.lasting = np.zeros(3)
        self.pulling = 0.0
        self.rest_gyro, self.rest_accel = np.zeros(3), np.zeros(3)
        self.persistence = self.refused = 0.0
        self.gyro_lp = self.accel_lp = None
        self.zero_rate_updates = 0

    def imu(self, dt, gyro, accel):
        self.time += dt
        self.since_gravity += dt
        self.since_altitude += dt
        self.track(dt, gyro, accel)
        transposed = self.propagate(dt, gyro - self.x[5:8], accel - self.x[8:])
        self.carry_gravity(dt, transposed, accel)
        if self.since_gravity >= 0.05 - 0.25 * dt:
            self.use_gravity(self.since_gravity)
            self.since_gravity = 0.0

    def track(self, dt, gyro, accel):
        gain = max(dt / (0.5 + dt), min(1.0, dt / self.time))
        if self.gyro_lp is None:
            self.gyro_lp, self.accel_lp = self.first
            self.accel_before = self.first[1]
        self.gyro_lp = self.gyro_lp + gain * (gyro - self.gyro_lp)
        self.accel_lp = self.accel_lp + gain * (accel - self.accel_lp)
        self.vibration += gain * (np.sum((accel - self.accel_before) ** 2) / 6 - self.vibration)
        self.accel_before = accel
        bias_var = 6.25 * np.diag(self.P)[5:8] + 16 * self.p.rest_gyro_std**2
        still = (np.linalg.norm(gyro - self.gyro_lp) < np.radians(2.0)
                 and np.linalg.norm(accel - self.accel_lp) < 0.5
                 and abs(np.linalg.norm(accel) - GRAVITY) < 0.3 + 3 * self.p.accel_bias_std
                 and np.all((self.gyro_lp - self.x[5:8]) ** 2 <= bias_var))
        slow = dt / (min(self.rest, 3.0) + dt)
        self.rest_gyro = self.rest_gyro + slow * (self.gyro_lp - self.rest_gyro)
        self.rest_accel = self.rest_accel + slow * (self.accel_lp - self.rest_accel)
        self.rest = self.rest + dt if still else 0.0

    def with_biases(self, F, dt):
        decay = 1 - dt / self.p.accel_bias_time
        F[:3, 5:8] = -dt * skew(self.x[:3])
        F[3, 8:] = -dt * self.x[:3]
        F[8:, 8:] = decay * np.eye(3)
        self.x[8:] *= decay
        return F

    def add_noise(self, dt, rate, force):
        p, g = self.p, GRAVITY
        accel2 = np.sum((force + g * self.x[:3]) ** 2)
        self.add_multiplicative(
            dt * (p.gyro_noise_density**2 + p.gyro_rate_error**2 * (rate @ rate)),
            dt * (p.accel_noise_density**2 + p.accel_force_error**2 * accel2)
            + dt**2 * p.accel_vibration_share * self.vibration)
        self.P[4, 4] += dt * (p.altitude_drift_density**2 + (p.altitude_scale_error * self.x[3]) ** 2)
        self.P[5:8, 5:8] += dt * p.gyro_bias_walk**2 * np.eye(3)
        self.P[8:, 8:] += 2 * dt / p.accel_bias_time * p.accel_bias_std**2 * np.eye(3)

    def carry_gravity(self, dt, transposed, accel):
        alpha = max(dt / (self.p.gravity_time + dt), min(1.0, dt / self.time))
        self.s_before = transposed @ self.s
        self.lasting = transposed @ self.lasting
        self.s = (1 - alpha) * self.s_before + alpha * accel
        self.B = (1 - alpha) * transposed @ self.B + alpha * np.eye(3)
        down = self.x[:3] if self.known else -self.s_before / GRAVITY
        self.W = (1 - alpha) * (transposed @ self.W + dt * skew(down))

    def use_gravity(self, elapsed):
        R = self.gravity_variance(elapsed)
        self.consider_pull(elapsed, R)
        for i in range(3):
            H = np.zeros(11)
            H[i], H[5:8], H[8:] = -GRAVITY, -GRAVITY * self.W[i], self.B[i]
            y = self.s[i] + GRAVITY * self.x[i] - self.B[i] @ self.x[8:]
            self.partial_update(y, H, R, self.p.gravity_bias_share)
        if self.rest >= 1.5:
            self.use_zero_rate(elapsed)
        self.normalise()

    def gravity_variance(self, elapsed):
        p, t = self.p, self.time
        y = self.s + GRAVITY * self.x[:3] - self.B @ self.x[8:]
        y2 = y @ y
        slow = max(elapsed / (p.gravity_lasting_time + elapsed), min(1.0, elapsed / t))
        explained = GRAVITY**2 * np.trace(self.P[:3, :3]) + np.trace(self.P[8:, 8:])
        self.lasting = self.lasting + slow * (y - self.lasting)
        if t > 3 * p.gravity_lasting_time:
            self.pulling = max((self.lasting @ self.lasting - explained) / 2,
                               self.pulling * (1 - elapsed / p.gravity_pull_time))
        fall = max(elapsed / (p.gravity_decay_time + elapsed), min(1.0, 2 * elapsed / t))
        self.residual = max(y2, self.residual + fall * (y2 - self.residual))
        if y2 > 16 * (p.rest_accel_std**2 + explained):
            self.rest = 0.0
        if self.rest >= 1.5:
            moved = self.accel_lp - self.rest_accel
            return (p.rest_accel_std**2 + moved @ moved) * max(1.0, 1.0 / elapsed)
        variance = (p.gravity_floor_std**2 + p.gravity_residual_share**2 * self.residual
                    + p.gravity_start_std**2 / (1 + (t / 0.5) ** 2))
        share = p.gravity_lasting_share if self.aided() else p.gravity_lasting_share_alone
        return (variance * max(1.0, p.gravity_correlation * min(p.gravity_time, t) / elapsed)
                + share * max(self.lasting @ self.lasting - explained, 0.0) * min(p.gravity_lasting_time, t) / elapsed)

    def aided(self):
        return len(self.altitudes) > 1 and self.since_altitude < 10.0

    def consider_pull(self, elapsed, R):
        tilt = GRAVITY**2 * np.trace(self.P[:3, :3]) / 2
        share = tilt / (R + tilt)
        self.pull[1, 1] = 0.0 if self.aided() or self.rest >= 1.5 else self.pulling
        F = np.array([[1 - share, share / GRAVITY], [0.0, 1.0]])
        self.pull = F @ self.pull @ F.T
        self.pull[0, 1] = self.pull[1, 0] = self.pull[0, 1] * (1 - elapsed / self.p.gravity_pull_time)

    def partial_update(self, innovation, H, R, share):
        S = H @ self.P @ H + R
        K = self.P @ H / S
        kept = 1 - np.where(np.arange(11) >= 8, share, 1.0)
        correction = (1 - kept) * K * innovation
        self.x = self.x + correction
        self.P = self.P - (1 - np.outer(kept, kept)) * np.outer(K, K) * S
        self.s = self.s + GRAVITY * self.W @ correction[5:8]

    def use_zero_rate(self, elapsed):
        turned = (self.accel_lp - self.rest_accel) / (GRAVITY * min(self.rest, 3.0))
        turning = turned @ turned + np.sum((self.gyro_lp - self.rest_gyro) ** 2)
        R = (self.p.rest_gyro_std**2 + turning) * max(1.0, 1.0 / elapsed)
        for i in range(3):
            H = np.eye(11)[5 + i]
            y = self.gyro_lp[i] - self.x[5 + i]
            if y**2 < 16 * (self.P[5 + i, 5 + i] + R):
                self.zero_rate_updates += 1
                self.partial_update(y, H, R, 1.0)

    def altitude(self, z, age):
        super().altitude(z, age)
        self.since_altitude = 0.0

    def use_altitude(self, z, H):
        self.learn_altimeter(z)
        R = max(self.p.altitude_std**2, self.altimeter_var) + self.step**2 / 12
        R = R * max(1.0, 0.1 / self.since_altitude) + (self.p.altitude_delay_std * self.x[3]) ** 2
        y = z - H @ self.x
        S = H @ self.P @ H + R
        if y**2 > self.p.altitude_gate * S:
            self.refused += 1
            if self.refused < 3:
                return
            self.refused = 0
            self.P[4, 4] += y**4 / (self.p.altitude_gate * S)
        else:
            self.refused = 0
            self.persistence += 0.3 * (y / np.sqrt(S) - self.persistence)
            if self.persistence**2 > self.p.altitude_step_gate * 0.3 / 1.7:
                self.persistence = 0.0
                self.P[4, 4] += y**2
        before = np.trace(self.P[:3, :3])
        self.partial_update(y, H, R, 1.0)
        kept = np.diag([np.trace(self.P[:3, :3]) / before, 1.0])
        self.pull = kept @ self.pull @ kept
        self.normalise()

    def learn_altimeter(self, z):
        step = abs(z - self.altitudes[-1])
        if 0 < step < 2 and (self.step == 0 or step < self.step):
            self.step = step
        count = len(self.altitudes) + 1
        if count >= 3:
            d2 = z - 2 * self.altitudes[-1] + self.altitudes[-2]
            capped = min(d2**2 / 6, 9 * max(self.altimeter_var, self.p.altitude_std**2))
            self.altimeter_var += max(1 / 50, 1 / count) * (capped - self.altimeter_var)


def _run_twin(twin, recording, altitude):
    """Return [x, P, pulled tilt] of the twin after each IMU sample; an altitude comes right after its sample."""
    imu = recording.imu
    twin.first = imu.gyro_b[0], imu.accel_b[0]
    states, j = [], 0
    for k in range(len(imu)):
        if k > 0:
            twin.imu((imu.stamp_ns[k] - imu.stamp_ns[k - 1]) * 1e-9, imu.gyro_b[k], imu.accel_b[k])
        while j < len(altitude) and altitude.stamp_ns[j] <= imu.stamp_ns[k]:
            twin.altitude(altitude.altitude[j], (imu.stamp_ns[k] - altitude.stamp_ns[j]) * 1e-9)
            j += 1
        states.append((twin.x.copy(), twin.P.copy(), twin.pull[0, 0]))
    return states


def _in_time(recording, without):
    """The altitudes but for those in a span (s), each received right before the IMU sample of its stamp."""
    stamp_ns = recording.altitude.stamp_ns
    seconds = (stamp_ns - stamp_ns[0]) * 1e-9
    kept = (seconds < without[0]) | (seconds >= without[1])
    return AltitudeSeries(stamp_ns[kept], recording.altitude.altitude[kept],
                          np.searchsorted(recording.imu.stamp_ns, stamp_ns[kept]))


def _figures(estimates, k):
    """What the estimator tells after sample k."""
    return np.hstack([
        estimates.down_b[k], estimates.vd[k], estimates.altitude[k], estimates.gyro_bias_b[k],
        estimates.accel_bias_b[k], estimates.vd_variance[k], estimates.altitude_variance[k],
        estimates.gyro_bias_variance[k], estimates.accel_bias_variance[k]])


def _twin_figures(x, P):
    """The same of a twin."""
    everything, variances = np.zeros(11), np.zeros(11)
    everything[:len(x)], variances[:len(x)] = x, np.diag(P)
    return np.hstack([x[:3] / np.linalg.norm(x[:3]), everything[3:], variances[3:]])


def _twin_tilt_covariance(P, pulled, q_nb_wxyz):
    """Covariance of the small rotation about north and east: about north, down moves to the east."""
    north_b, east_b, _ = dcm_from_quaternion(q_nb_wxyz)
    turns_b = np.stack([east_b, -north_b])
    return turns_b @ P[:3, :3] @ turns_b.T + pulled * np.eye(2)


@pytest.mark.parametrize(("name", "twin", "scenario", "duration", "without"), [
    ("dcm_row", DefaultTwin, "quad", 14.0, (14.0, 14.0)), ("dcm_row", DefaultTwin, "car", 26.0, (1.0, 24.0)),
    ("dcm_row5", PaperTwin, "quad", 26.0, (26.0, 26.0))])
def test_the_compiled_filter_is_its_dense_twin(name, twin, scenario, duration, without):
    recording = simulate(scenario, duration=duration, imu_rate=50.0, altimeter_rate=12.5, rest=4.0, seed=3)
    params = AttitudeParams(estimator=name)
    altitude = _in_time(recording, without)
    estimates, fresh = AttitudeEstimator(params).run(recording.imu, altitude)
    assert fresh.all() and estimates.valid.any()
    reference = twin(params)
    states = _run_twin(reference, recording, altitude)
    assert any(pulled > 0.0 for _, _, pulled in states) == (without[0] < without[1])
    if twin is DefaultTwin:
        assert reference.zero_rate_updates > 0
    for k in range(10, len(fresh)):
        x, P, pulled = states[k]
        np.testing.assert_allclose(_figures(estimates, k), _twin_figures(x, P), TWIN_RELATIVE, TWIN_RELATIVE)
        if estimates.valid[k]:
            np.testing.assert_allclose(
                estimates.tilt_covariance_n[k], _twin_tilt_covariance(P, pulled, estimates.q_nb_wxyz[k]),
                rtol=TWIN_COVARIANCE, atol=TWIN_COVARIANCE * np.trace(P[:3, :3]))


# --- the parts --------------------------------------------------------------------------------------


def _params(name, **changes):
    quiet = {"gyro_noise_density": 0.0, "accel_noise_density": 0.0, "gyro_rate_error": 0.0,
             "accel_force_error": 0.0, "altitude_drift_density": 0.0, "altitude_scale_error": 0.0,
             "gyro_bias_walk": 0.0, "accel_bias_std": 0.0}
    return AttitudeParams(estimator=name, **(quiet | changes))


def _predict(name, x, P, dt, **changes):
    """Return x and P after one step of the compiled prediction."""
    n = len(x)
    m = AttitudeEstimator(_params(name, **changes))._memory
    m[kernels.X:kernels.X + n] = x
    m[kernels.P:kernels.P + n * n] = P.ravel()
    predict = kernels.row_predict if n == 11 else kernels.row5_predict
    predict(m, dt, *GYRO, *ACCEL, 0.0, 0.0)
    return m[kernels.X:kernels.X + n].copy(), m[kernels.P:kernels.P + n * n].reshape(n, n).copy()


def _random_state(n):
    rng = np.random.default_rng(RNG_SEED)
    x = rng.standard_normal(n)
    x[:3] /= np.linalg.norm(x[:3])
    x[5:] *= 0.01
    L = rng.standard_normal((n, n))
    return x, L @ L.T


@pytest.mark.parametrize("dt", [1e-3, 0.01, 0.1, 0.5])
def test_the_paper_filter_steps_by_the_matrix_exponential(dt):
    A = np.zeros((6, 6))  # the sixth state is the constant 1, which brings gravity in
    A[:3, :3], A[3, :3], A[3, 5], A[4, 3] = -skew(GYRO), ACCEL, GRAVITY, -1.0
    exact = expm(A * dt)
    x, P = _random_state(5)
    after, covariance = _predict("dcm_row5", x, P, dt)
    np.testing.assert_allclose(after, (exact @ [*x, 1.0])[:5], rtol=ROUNDING, atol=ROUNDING)
    F = exact[:5, :5]
    np.testing.assert_allclose(covariance, F @ P @ F.T, rtol=100 * ROUNDING, atol=100 * ROUNDING)


def _bias_jacobian_error(dt):
    """Largest difference of the covariance's F from central differences of the mean's step."""
    x, P = _random_state(11)
    step = 1e-6
    F = np.stack([(_predict("dcm_row", x + step * e, P, dt)[0] - _predict("dcm_row", x - step * e, P, dt)[0])
                  / (2 * step) for e in np.eye(11)], axis=1)
    error = 0.0
    for column in range(11):
        e = np.eye(11)[column]
        used = _predict("dcm_row", x, np.outer(e, e), dt)[1]
        error = max(error, np.abs(used - np.outer(F[:, column], F[:, column])).max() / dt)
    return error


def test_the_default_filters_jacobian_is_that_of_its_step_up_to_second_order():
    low, high = SECOND_ORDER
    coarse, fine = _bias_jacobian_error(0.02), _bias_jacobian_error(0.01)
    assert coarse < 0.02 * np.linalg.norm(ACCEL)
    assert 0.5 * low < coarse / fine < high


def test_noise_in_closed_form_is_the_kronecker_form_of_appendix_a():
    dt, gyro, accel = 0.01, 0.3, 0.7
    x, P = _random_state(5)
    after, quiet = _predict("dcm_row5", x, P, dt)
    _, noisy = _predict("dcm_row5", x, P, dt, gyro_noise_density=gyro, accel_noise_density=accel)
    G = np.zeros((6, 5, 5))  # z = sum_i w_i G_i x
    for i, e in enumerate(np.eye(3)):
        G[i, :3, :3] = dt * skew(e)
        G[3 + i, 3, :3] = dt * e
    Q = np.diag([gyro**2 / dt] * 3 + [accel**2 / dt] * 3)
    Gamma = np.hstack(G)
    at_x = np.stack([g @ after for g in G], axis=1)
    expected = at_x @ Q @ at_x.T + Gamma @ np.kron(Q, quiet) @ Gamma.T
    np.testing.assert_allclose(noisy - quiet, expected, rtol=1e-10, atol=1e-10)


def test_noise_of_an_uncertain_direction_is_that_of_random_draws():
    dt, gyro, accel, draws = 0.01, 0.1, 0.4, 200_000
    rng = np.random.default_rng(RNG_SEED)
    x, _ = _random_state(5)
    P = np.diag([0.05, 0.1, 0.2, 1e-4, 1e-6])
    _, predicted = _predict("dcm_row5", x, P, dt, gyro_noise_density=gyro, accel_noise_density=accel)
    true = x + rng.standard_normal((draws, 5)) * np.sqrt(np.diag(P))
    rates = GYRO + rng.standard_normal((draws, 3)) * gyro / np.sqrt(dt)
    forces = ACCEL + rng.standard_normal((draws, 3)) * accel / np.sqrt(dt)
    F, u = PaperTwin(_params("dcm_row5")).transition(dt, GYRO, ACCEL)
    after = true @ F.T + u
    turned = np.cross(after[:, :3], (rates - GYRO) * dt)
    after[:, 3] += np.sum((forces - ACCEL) * dt * after[:, :3], axis=1)
    after[:, :3] += turned
    drawn = np.cov(after.T)
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    assert np.abs((drawn - predicted) / scale).max() < COVARIANCE_MONTE_CARLO


def test_gravity_sensitivity_is_that_of_the_low_pass():
    """Without acceleration s = -g c - g W b, b being what the gyro reads too much."""
    dt, bias = 0.01, np.array([1e-4, -2e-4, 1.5e-4])
    params = AttitudeParams(gravity=GRAVITY, gyro_bias_std=0.0, gyro_bias_walk=0.0, accel_bias_std=0.0)
    estimators = [AttitudeEstimator(params) for _ in range(3)]
    down_b, R = np.array([0.1, -0.2, np.sqrt(0.95)]), zoh_integrals(GYRO, dt)[0]
    for k in range(1200):
        for sign, estimator in zip((-1, 0, 1), estimators, strict=True):
            estimator.add_imu(1 + 10_000_000 * k, GYRO + sign * bias, -GRAVITY * down_b)
        last, down_b = down_b, R.T @ down_b
    low, middle, high = (e._memory[kernels.GRAVITY:kernels.GRAVITY + 3] for e in estimators)
    W = estimators[1]._memory[kernels.GRAVITY_BG:kernels.GRAVITY_BG + 9].reshape(3, 3)
    np.testing.assert_allclose(middle, -GRAVITY * last, atol=1e-9)
    moved = -GRAVITY * W @ bias
    np.testing.assert_allclose((high - low) / 2, moved, atol=SENSITIVITY * np.linalg.norm(moved))
    assert np.linalg.norm(W @ bias) > dt * np.linalg.norm(bias)
