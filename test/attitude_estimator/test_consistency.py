"""Monte Carlo: errors as large as the bound allows and the covariance says, in every kind of motion."""

from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from attitude_estimator import _kernels as kernels
from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.params import AttitudeParams
from inertial.bound import SensorNoise, tilt_bound
from inertial.imu_errors import PROFILES
from inertial.rotation import down_from_quaternion
from inertial.scenarios import SCENARIOS
from inertial.scoring import tilt_error_n
from inertial.simulator import add_errors, make_trajectory, sample_trajectory

PAPER, CONSUMER = PROFILES["paper"], PROFILES["consumer"]
RUNS = 20
RMS_OF_BOUND = 0.08  # 20 runs of correlated errors leave 4 %; the study has 100
CONFIDENCE = 0.95
START_STD = np.radians(1.0)  # what is known of the tilt at the start, where it is known
SETTLED = 30.0  # s
BLIND_TIME = 10.0  # s of manoeuvre that a blind start may take
BLIND_DEG = 5.0  # an attitude: nearer than that when it is first told
DIVERGED_DEG = 10.0
DEFAULT_RUNS = 10
# NEES/2 of the default filter: honest, or on the careful side with a sigma of at most 2.5 times the error.
NEES_LOW, NEES_HIGH = 0.16, 1.3
BEYOND_3_SIGMA = 0.01


@cache
def _sampled(scenario, imu_rate):
    sampled = sample_trajectory(make_trajectory(scenario), imu_rate=imu_rate)
    return sampled, down_from_quaternion(sampled.truth.q_nb_wxyz)


def _times(stamp_ns):
    return (stamp_ns - stamp_ns[0]) * 1e-9


def _paper_params():
    return AttitudeParams(estimator="dcm_row5", gyro_noise_density=PAPER.imu.gyro_noise_density,
                          accel_noise_density=PAPER.imu.accel_noise_density,
                          altitude_std=PAPER.altimeter.noise_std)


def _paper_run(scenario, seed, known_start):
    """Return the estimates of one run and the errors of the tilt, (N, 2) rad."""
    sampled, down_b = _sampled(scenario, 100.0)
    rng = np.random.default_rng(seed)
    recording = add_errors(sampled, PAPER.imu, PAPER.altimeter, rng, altimeter_rate=100.0)
    estimator = AttitudeEstimator(_paper_params())
    if known_start:
        _start_at(estimator, down_b[0] + np.cross(rng.standard_normal(3), down_b[0]) * START_STD / 2**0.5)
    estimates, _ = estimator.run(recording.imu, recording.altitude)
    return estimates, tilt_error_n(estimates.q_nb_wxyz, down_b)


def _start_at(estimator, down_b):
    """Let the paper's filter start at an attitude instead of blind."""
    down_b = down_b / np.linalg.norm(down_b)
    estimator._memory[kernels.X:kernels.X + 3] = down_b
    P = estimator._memory[kernels.P:kernels.P + kernels.N5**2].reshape(kernels.N5, kernels.N5)
    P[:3, :3] = 0.5 * START_STD**2 * (np.eye(3) - np.outer(down_b, down_b))


def _nees(error, covariance):
    return np.sum(error * np.linalg.solve(covariance, error[..., None])[..., 0], axis=-1)


@cache
def _paper_runs(scenario):
    """Return times, squared tilt errors (runs, N) and NEES (runs, N) from a known start, settled."""
    runs = [_paper_run(scenario, seed, known_start=True) for seed in range(RUNS)]
    t = _times(runs[0][0].stamp_ns)
    late = t > SETTLED
    assert all(estimates.valid[late].all() for estimates, _ in runs)
    squares = np.array([np.sum(error[late] ** 2, axis=1) for _, error in runs])
    nees = np.array([_nees(error[late], estimates.tilt_covariance_n[late]) for estimates, error in runs])
    return t[late], squares, nees


@pytest.mark.parametrize("scenario", ["turn", "aerobatic"])
def test_where_the_altimeter_shows_the_tilt_the_papers_filter_is_at_the_bound(scenario):
    sampled, down_b = _sampled(scenario, 100.0)
    bound = tilt_bound(sampled.imu, down_b, sampled.imu.stamp_ns, SensorNoise.of(PAPER), tilt_std=START_STD)
    _, squares, _ = _paper_runs(scenario)
    rms = np.sqrt(squares.mean())
    assert rms == pytest.approx(bound.tilt_rms(_times(sampled.imu.stamp_ns) > SETTLED), rel=RMS_OF_BOUND)


@pytest.mark.parametrize("scenario", ["turn", "car"])
def test_its_errors_are_as_large_as_its_covariance_says(scenario):
    t, _, nees = _paper_runs(scenario)
    instants = np.searchsorted(t, np.arange(SETTLED + 10.0, 120.0, 10.0))
    low, high = chi2.ppf([0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2], 2 * RUNS) / RUNS
    inside = (nees[:, instants].mean(axis=0) > low) & (nees[:, instants].mean(axis=0) < high)
    assert np.mean(inside) >= 0.75


@pytest.mark.parametrize("scenario", ["aerobatic", "turn", "car"])
def test_it_never_diverges_through_loops_and_rolls(scenario):
    _, squares, _ = _paper_runs(scenario)
    assert np.degrees(np.sqrt(squares.max())) < DIVERGED_DEG


# Seconds from which the motion shows roll and pitch: the first turn, the first roll.
@pytest.mark.parametrize(("scenario", "manoeuvre"), [("turn", 23.0), ("aerobatic", 38.0), ("car", 12.0)])
def test_a_blind_start_converges_in_every_run(scenario, manoeuvre):
    for seed in range(RUNS):
        estimates, error = _paper_run(scenario, seed, known_start=False)
        first = np.argmax(estimates.valid)
        assert estimates.valid[first]
        assert _times(estimates.stamp_ns)[first] < manoeuvre + BLIND_TIME
        after = _times(estimates.stamp_ns) > manoeuvre + BLIND_TIME
        assert estimates.valid[after].all()
        assert np.degrees(np.linalg.norm(error[after], axis=1)).max() < BLIND_DEG


# A steady braking, climb or turn of a body without vibration is taken for rest, with rest's covariance.
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_default_filter_is_honest_in_every_motion(scenario):
    nees, beyond = [], []
    for seed in range(DEFAULT_RUNS):
        sampled, down_b = _sampled(scenario, 200.0)
        recording = add_errors(sampled, CONSUMER.imu, CONSUMER.altimeter, np.random.default_rng(seed))
        estimates, _ = AttitudeEstimator().run(recording.imu, recording.altitude)
        used = (_times(estimates.stamp_ns) > 5.0) & estimates.valid
        assert np.mean(used) > 0.9
        error = tilt_error_n(estimates.q_nb_wxyz[used], down_b[used])
        covariance = estimates.tilt_covariance_n[used]
        nees.append(_nees(error, covariance).mean() / 2)
        beyond.append(np.mean(np.sum(error**2, axis=1) > 9 * np.trace(covariance, axis1=1, axis2=2)))
    assert NEES_LOW < np.mean(nees) < NEES_HIGH
    assert np.mean(beyond) < BEYOND_3_SIGMA
