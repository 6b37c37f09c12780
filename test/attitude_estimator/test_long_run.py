"""Hours of samples, an IMU alone, any rate: flat, finite, positive, and the same attitude.

The 24 h soak of 17.28 million samples runs when the environment variable SOAK is set.
"""

import os
import pickle
from functools import cache

import numpy as np
import pytest

from attitude_estimator import _kernels as kernels
from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.params import AttitudeParams
from inertial.imu_errors import PROFILES
from inertial.recording import AltitudeSeries, ImuSeries
from inertial.rotation import down_from_quaternion
from inertial.simulator import simulate

BLOCK = 120.0  # s of flight that is flown again and again
RATE = 200
SOAK_HOURS = 24.0 if os.environ.get("SOAK") else 2.0
SYMMETRY = 1e-9  # relative to the variances
DRIFT_DEG = 1.0  # RMS of the last block against that of the second: the same flight, the same errors
RETURN_DEG = 0.3  # what the first altitudes after a long absence may move the tilt
CONSUMER = PROFILES["consumer"]


@cache
def _block(scenario="quad", imu_rate=RATE):
    return simulate(scenario, duration=BLOCK, imu_rate=imu_rate, altimeter_rate=20.0, seed=4)


def _shifted(recording, blocks, altitude=True):
    """The same recording, some blocks later."""
    shift = np.int64(blocks * BLOCK * 1e9)
    imu, z = recording.imu, recording.altitude
    return (ImuSeries(imu.stamp_ns + shift, imu.gyro_b, imu.accel_b),
            AltitudeSeries(z.stamp_ns + shift, z.altitude, z.arrival) if altitude else None)


def _error_deg(recording, estimates):
    """Tilt errors of a run of the whole recording, deg."""
    truth = down_from_quaternion(recording.truth.q_nb_wxyz)
    cross = np.linalg.norm(np.cross(estimates.down_b, truth), axis=1)
    return np.degrees(np.arctan2(cross, np.sum(estimates.down_b * truth, axis=1)))


def _rms(values):
    return float(np.sqrt(np.mean(values**2)))


def _covariance(estimator, n):
    return estimator._memory[kernels.P:kernels.P + n * n].reshape(n, n)


@pytest.mark.parametrize(("model", "n", "hours"), [("dcm_row", 11, SOAK_HOURS), ("dcm_row5", 5, 1.0)])
def test_soak(model, n, hours):
    recording = _block()
    estimator = AttitudeEstimator(AttitudeParams(estimator=model))
    blocks = round(hours * 3600 / BLOCK)
    size = len(pickle.dumps(estimator))
    errors = []
    for k in range(blocks):
        estimates, fresh = estimator.run(*_shifted(recording, k))
        assert fresh.all()
        assert np.all(np.isfinite(estimates.rows))
        P = _covariance(estimator, n)
        scale = np.sqrt(np.diag(P))
        assert np.abs((P - P.T) / np.outer(scale, scale)).max() < SYMMETRY
        assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > -SYMMETRY
        if model == "dcm_row":
            assert k == 0 or estimates.valid.all()
            errors.append(_rms(_error_deg(recording, estimates)))
    assert len(pickle.dumps(estimator)) == size
    assert not any(vars(estimator.faults).values())
    if model == "dcm_row":
        assert abs(errors[-1] - errors[1]) < DRIFT_DEG
        assert max(errors[1:]) < errors[1] + DRIFT_DEG


def test_imu_alone_for_an_hour_then_altitude_again():
    recording = _block("hover")
    estimator = AttitudeEstimator()
    estimator.run(*_shifted(recording, 0))
    for k in range(1, 31):
        estimates, _ = estimator.run(*_shifted(recording, k, altitude=False))
        assert np.all(np.isfinite(estimates.rows))
        assert estimates.valid.all()
        assert np.sqrt(estimates.vd_variance.max()) < 2 * kernels.VD_LOST_STD
        assert np.abs(estimates.vd).max() < 5 * kernels.VD_LOST_STD
    imu, altitude = _shifted(recording, 31)
    with_altitude, _ = _continued(estimator, imu, altitude)
    without, _ = _continued(estimator, imu, None)
    first = slice(0, 2 * RATE)
    apart = np.linalg.norm(np.cross(with_altitude.down_b, without.down_b), axis=1)
    assert np.degrees(apart[first].max()) < RETURN_DEG
    assert with_altitude.altitude_variance[-1] < 2.0**2
    assert with_altitude.altitude[-1] == pytest.approx(altitude.altitude[-1], abs=2.0)


def _continued(estimator, imu, altitude):
    return pickle.loads(pickle.dumps(estimator)).run(imu, altitude)


@pytest.mark.parametrize("imu_rate", [10.0, 25.0, 100.0, 400.0, 1000.0])
def test_any_sample_rate(imu_rate):
    recording = simulate("turn", duration=60.0, imu_rate=imu_rate, altimeter_rate=10.0, seed=6)
    estimates, fresh = AttitudeEstimator().run(recording.imu, recording.altitude)
    assert fresh.all()
    late = estimates.stamp_ns > estimates.stamp_ns[0] + 10_000_000_000
    error = _error_deg(recording, estimates)[late]
    sigma = np.degrees(np.sqrt(np.trace(estimates.tilt_covariance_n[late], axis1=1, axis2=2)))
    assert estimates.valid[late].all()
    assert _rms(error) < 1.5
    assert np.mean(error > 3 * sigma) < 0.02


def test_jitter_and_lost_samples():
    errors = CONSUMER.imu
    values = {name: getattr(errors, name) for name in errors.__dataclass_fields__}
    disturbed = type(errors)(**(values | {"jitter_std": 5e-4, "dropout_share": 0.1}))
    recording = simulate("turn", duration=60.0, imu_rate=RATE, imu_errors=disturbed, seed=6)
    calm = simulate("turn", duration=60.0, imu_rate=RATE, seed=6)
    estimates, _ = AttitudeEstimator().run(recording.imu, recording.altitude)
    reference, _ = AttitudeEstimator().run(calm.imu, calm.altitude)
    t = (estimates.stamp_ns - estimates.stamp_ns[0]) * 1e-9
    true_ns = recording.truth.stamp_ns
    nearest = np.clip(np.searchsorted(true_ns, estimates.stamp_ns - 2_500_000), 0, len(true_ns) - 1)
    truth = down_from_quaternion(recording.truth.q_nb_wxyz)[nearest]
    error = np.degrees(np.linalg.norm(np.cross(estimates.down_b, truth), axis=1))[t > 10]
    assert _rms(error) < _rms(_error_deg(calm, reference)[10 * RATE:]) + 0.2


@pytest.mark.parametrize("factor", [0.5, 4.0])
def test_a_bias_prior_that_is_off_still_finds_the_bias(factor):
    recording = simulate("turn", duration=90.0, imu_rate=100.0, seed=8)
    params = AttitudeParams(gyro_bias_std=factor * CONSUMER.imu.gyro_bias_std)
    estimates, _ = AttitudeEstimator(params).run(recording.imu, recording.altitude)
    late = slice(45 * 100, None)
    assert _rms(_error_deg(recording, estimates)[late]) < 1.5
    error = estimates.gyro_bias_b[-1] - recording.gyro_bias_b[-1]
    assert np.abs(error).max() < 0.5 * CONSUMER.imu.gyro_bias_std
