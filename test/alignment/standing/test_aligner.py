"""The aligner of a standing vehicle, sample by sample."""

from dataclasses import replace

import numpy as np
import pytest

from alignment.standing.aligner import StandingAligner
from alignment.standing.params import StandingParams
from inertial.parked_scenarios import GRADES, simulate_parked
from inertial.recording import ImuSeries
from inertial.table_scenarios import LATITUDE

RATE = 50.0  # Hz


def params_of(grade, **changes):
    """Return the StandingParams that know a grade's sensors."""
    errors = GRADES[grade].errors
    known = StandingParams(
        latitude=LATITUDE, gyro_noise_density=errors.gyro_noise_density, gyro_bias_std=errors.gyro_bias_std,
        gyro_bias_instability=errors.gyro_bias_instability, accel_noise_density=errors.accel_noise_density,
        accel_bias_std=errors.accel_bias_std, accel_bias_instability=errors.accel_bias_instability,
        scale_std=errors.gyro_scale_std)
    return replace(known, **changes)


def pushed(imu, start, length, acceleration):
    """Return the readings of a vehicle that is pushed ahead besides."""
    elapsed = (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9
    accel_b = imu.accel_b.copy()
    accel_b[(elapsed >= start) & (elapsed < start + length), 0] += acceleration
    return ImuSeries(imu.stamp_ns, imu.gyro_b, accel_b)


@pytest.fixture(scope="module")
def still():
    """Return 40 s of a navigation-grade IMU in a vehicle that nothing moves."""
    return simulate_parked("parked_navigation", duration=40.0, imu_rate=RATE, disturbance=0.0).imu


@pytest.mark.parametrize("push", [(7.5, 0.5, 2.0), (5.0, 2.0, 0.12)], ids=["shove", "creep"])
def test_a_push_into_steady_motion_is_survived(still, push):
    # The shove leaves a second of which nothing is known; the creep is too gentle for the coarse alignment, and
    # the filter moves as soon as it has begun.
    aligner = StandingAligner(params_of("navigation", coarse_window=6.0))
    results = [result for _, result in aligner.run(pushed(still, *push), period=0.1)]
    assert results[-1] is not None and np.isfinite(results[-1].heading)
