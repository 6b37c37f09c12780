"""The smoother: equal to a joint estimate of all states, better than the filter and honest about it."""

from functools import cache

import numpy as np
import pytest

from attitude_estimator import _smoother_kernels, smoother
from attitude_estimator.estimator import ACTION_RESET, ACTION_SKIP, ACTION_USE, AttitudeEstimator
from attitude_estimator.params import AttitudeParams
from attitude_estimator.smoother import smooth
from inertial.imu_errors import PROFILES
from inertial.recording import AltitudeSeries, ImuSeries
from inertial.rotation import down_from_quaternion
from inertial.scoring import tilt_error_n
from inertial.simulator import add_errors, make_trajectory, sample_trajectory

CONSUMER = PROFILES["consumer"]
RATE = 50.0  # Hz
DURATION = 60.0  # s
SEEDS = 3
RATIO = {"turn": 0.8, "hover": 1.0, "car": 0.6}  # smoothed RMS by the filter's; measured 0.60, 0.86, 0.44
NEES_LOW, NEES_HIGH = 0.15, 1.6  # NEES/2 of three draws of the biases; 0.3 to 1.2 over eight of 120 s
SIGMA_MARGIN = 1.0001  # normalising and the partial update are not exactly linear
EXACT = 1e-9  # rounding of a few thousand steps
STEP = 5.0  # m, of the altimeter's zero
STEP_TILT = np.radians(0.3)  # what such a step may do to the tilt
GAP = 3.0  # s without samples
CONVERGED = np.radians(5.0)  # error of an attitude that was found again, or carried back to the start
N = _smoother_kernels.N


@cache
def _simulated(scenario, seed):
    sampled = sample_trajectory(make_trajectory(scenario, duration=DURATION), imu_rate=RATE)
    recording = add_errors(sampled, CONSUMER.imu, CONSUMER.altimeter, np.random.default_rng(seed))
    return recording.imu, recording.altitude, down_from_quaternion(sampled.truth.q_nb_wxyz)


def _part(imu, keep):
    return ImuSeries(imu.stamp_ns[keep], imu.gyro_b[keep], imu.accel_b[keep])


def _tilt_error(estimates, down_b):
    return np.linalg.norm(tilt_error_n(estimates.q_nb_wxyz, down_b), axis=1)


def _tilt_between(left, right):
    cross = np.linalg.norm(np.cross(left.down_b, right.down_b), axis=1)
    return np.arctan2(cross, np.sum(left.down_b * right.down_b, axis=1))


@pytest.mark.parametrize("scenario", RATIO)
def test_it_is_better_than_the_filter_and_its_covariance_says_so(scenario):
    squares, nees = [], []
    for seed in range(SEEDS):
        imu, altitude, down_b = _simulated(scenario, seed)
        forward, _ = AttitudeEstimator().run(imu, altitude)
        smoothed, _, _ = smooth(imu, altitude)
        assert smoothed.valid.all()
        used = forward.valid & (imu.stamp_ns - imu.stamp_ns[0] > 5e9)
        squares.append([np.mean(_tilt_error(each, down_b)[used] ** 2) for each in (forward, smoothed)])
        error, covariance = tilt_error_n(smoothed.q_nb_wxyz, down_b), smoothed.tilt_covariance_n
        weighted = np.linalg.solve(covariance, error[..., None])[..., 0]
        nees.append(np.mean(np.sum(error * weighted, axis=1)) / 2)
        sigma2 = [np.trace(each.tilt_covariance_n, axis1=1, axis2=2)[used] for each in (forward, smoothed)]
        assert np.all(sigma2[1] <= sigma2[0] * SIGMA_MARGIN)
    forward, smoothed = np.sqrt(np.mean(squares, axis=0))
    assert smoothed < RATIO[scenario] * forward
    assert NEES_LOW < np.mean(nees) < NEES_HIGH


def test_the_backward_pass_is_the_joint_estimate_of_all_states():
    steps, rng = 5, np.random.default_rng(7)
    dt, samples = np.full(steps, 0.1), rng.standard_normal((steps, 6)) * np.repeat([0.5, 5.0], 3)
    x, P = np.r_[0.1, -0.2, 0.3, np.zeros(8)], np.diag(rng.uniform(0.5, 2.0, N))
    before_x, before_P = np.empty((steps, N)), np.empty((steps, N, N))
    predicted_x, predicted_P = np.empty((steps, N)), np.empty((steps, N, N))
    joint_x, joint_P = x, P  # of all states so far
    for k in range(steps):
        before_x[k], before_P[k] = x, P
        F, R, jv, jh = np.empty((N, N)), np.empty((3, 3)), np.empty(3), np.empty(3)
        _smoother_kernels._motion(x, samples[k], dt[k], 0.0, R, jv, jh)
        _smoother_kernels._transition(x, R, jv, jh, dt[k], 200.0, F)
        Q, noise = np.diag(rng.uniform(0.1, 0.5, N)), np.eye(2)
        H, innovation = rng.standard_normal((2, N)), rng.standard_normal(2)
        x, P = F @ x, F @ P @ F.T + Q
        predicted_x[k], predicted_P[k] = x, P
        last = joint_P[-N:]
        joint_x = np.r_[joint_x, x]
        joint_P = np.block([[joint_P, last.T @ F.T], [F @ last, P]])
        gain = joint_P[:, -N:] @ H.T @ np.linalg.inv(H @ P @ H.T + noise)
        joint_x = joint_x + gain @ innovation
        joint_P = joint_P - gain @ H @ joint_P[-N:]
        x, P = joint_x[-N:], joint_P[-N:, -N:]
    out_x, out_P, out_known = np.empty((steps, N)), np.empty((steps, N, N)), np.empty(steps, bool)
    first_x, first_P = x.copy(), P.copy()
    _smoother_kernels.smooth_back(
        before_x, before_P, np.zeros(steps, bool), predicted_x, predicted_P, np.ones((steps, N), bool), dt,
        samples, 9.8, 0.0, 200.0, 0.1, first_x, first_P, False, out_x, out_P, out_known)
    np.testing.assert_allclose(np.r_[first_x, out_x.ravel()], joint_x, atol=EXACT)
    np.testing.assert_allclose(first_P, joint_P[:N, :N], atol=EXACT)
    for k in range(steps):
        here = slice((k + 1) * N, (k + 2) * N)
        np.testing.assert_allclose(out_P[k], joint_P[here, here], atol=EXACT)


def test_it_ends_where_the_filter_ends():
    imu, altitude, _ = _simulated("car", 0)
    forward, _ = AttitudeEstimator().run(imu, altitude)
    smoothed, _, _ = smooth(imu, altitude)
    np.testing.assert_allclose(smoothed.down_b[-1], forward.down_b[-1], atol=EXACT)
    np.testing.assert_allclose(smoothed.gyro_bias_b[-1], forward.gyro_bias_b[-1], atol=EXACT)


def test_where_a_long_recording_is_cut_does_not_show(monkeypatch):
    imu, altitude, _ = _simulated("car", 0)
    whole, _, _ = smooth(imu, altitude)
    monkeypatch.setattr(smoother, "PART", 97)
    in_parts, _, _ = smooth(imu, altitude)
    np.testing.assert_allclose(in_parts.rows, whole.rows, atol=EXACT)


def test_an_altitude_counts_at_its_stamp_however_late_it_arrives():
    imu, altitude, _ = _simulated("car", 0)
    late = AltitudeSeries(altitude.stamp_ns, altitude.altitude,
                          np.minimum(altitude.arrival + round(2 * RATE), len(imu)))
    np.testing.assert_array_equal(smooth(imu, late)[0].rows, smooth(imu, altitude)[0].rows)


def test_a_step_of_the_altimeters_zero_hardly_moves_the_tilt():
    imu, altitude, _ = _simulated("hover", 0)
    late = np.arange(len(altitude)) > len(altitude) // 2
    stepped = AltitudeSeries(altitude.stamp_ns, altitude.altitude + STEP * late, altitude.arrival)
    moved = _tilt_between(smooth(imu, altitude)[0], smooth(imu, stepped)[0])
    assert moved.max() < STEP_TILT


def test_across_a_long_gap_only_the_biases_are_shared():
    imu, altitude, down_b = _simulated("car", 0)
    t = (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9
    keep = (t < DURATION / 2) | (t > DURATION / 2 + GAP)
    estimates, fresh, faults = smooth(_part(imu, keep), altitude)
    assert faults.restarted == 1
    assert fresh.all() and estimates.valid.all()
    assert _tilt_error(estimates, down_b[keep]).max() < CONVERGED
    split = np.searchsorted(t[keep], DURATION / 2)
    alone, _, _ = smooth(_part(imu, t < DURATION / 2), altitude)
    assert np.all(estimates.gyro_bias_variance[split - 1] < alone.gyro_bias_variance[-1])


def test_a_recording_that_starts_over_is_smoothed_piece_by_piece():
    imu, altitude, _ = _simulated("car", 0)
    altitude = AltitudeSeries(altitude.stamp_ns[5:], altitude.altitude[5:], altitude.arrival[5:])
    twice = ImuSeries(*(np.concatenate([a, a]) for a in (imu.stamp_ns, imu.gyro_b, imu.accel_b)))
    altitudes = AltitudeSeries(np.tile(altitude.stamp_ns, 2), np.tile(altitude.altitude, 2),
                               np.concatenate([altitude.arrival, len(imu) + altitude.arrival]))
    actions = np.full(len(twice), ACTION_USE)
    actions[len(imu)] = ACTION_RESET
    estimates, _, _ = smooth(twice, altitudes, actions=actions)
    alone, _, _ = smooth(imu, altitude)
    np.testing.assert_allclose(estimates.rows[:len(imu)], alone.rows, atol=EXACT)
    np.testing.assert_allclose(estimates.rows[len(imu):], alone.rows, atol=EXACT)


def test_refused_samples_have_no_estimate_and_do_no_harm():
    imu, altitude, down_b = _simulated("car", 0)
    gyro_b, actions = imu.gyro_b.copy(), np.full(len(imu), ACTION_USE)
    gyro_b[1000:1010] = np.nan
    actions[500:505] = ACTION_SKIP
    damaged = ImuSeries(imu.stamp_ns, gyro_b, imu.accel_b)
    estimates, fresh, faults = smooth(damaged, altitude, actions=actions)
    assert faults.gyro_not_finite == 10
    assert not fresh[500:505].any() and not fresh[1005:1010].any()
    assert len(estimates) == fresh.sum() and estimates.valid.all()
    assert np.isfinite(estimates.rows).all()
    assert _tilt_error(estimates, down_b[fresh]).max() < CONVERGED


def test_too_short_a_recording_has_no_attitude():
    imu, _, _ = _simulated("car", 0)
    estimates, _, _ = smooth(_part(imu, slice(0, 5)))
    assert len(estimates) == 5 and not estimates.valid.any()


def test_without_samples_there_is_nothing():
    imu, _, _ = _simulated("car", 0)
    estimates, fresh, _ = smooth(_part(imu, slice(0, 0)))
    assert len(estimates) == len(fresh) == 0


def test_only_the_default_filter_is_smoothed():
    imu, altitude, _ = _simulated("car", 0)
    with pytest.raises(ValueError, match="dcm_row5"):
        smooth(imu, altitude, params=AttitudeParams(estimator="dcm_row5"))
