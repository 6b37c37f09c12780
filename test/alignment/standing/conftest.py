"""A standing IMU with constant biases and white noise, made in one line of numpy; grades of the design page."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from alignment.standing.params import StandingParams
from inertial.earth import STANDARD_GRAVITY, earth_rate_n, normal_gravity
from inertial.recording import ImuSeries
from inertial.rotation import dcm_nb_from_euler

LATITUDE = np.radians(35.0)
_DEG_PER_HOUR = np.radians(1 / 3600)


@dataclass(frozen=True)
class Grade:
    """Spread of the gyro bias, rad/s, angle random walk, accelerometer bias, m/s^2, velocity random walk."""

    gyro_bias: float
    gyro_noise: float
    accel_bias: float
    accel_noise: float


PERFECT = Grade(0.0, 1e-12, 0.0, 1e-12)
NAVIGATION = Grade(0.01 * _DEG_PER_HOUR, np.radians(0.002) / 60, 0.05e-3 * STANDARD_GRAVITY, 0.003 / 60)
TACTICAL = Grade(1.0 * _DEG_PER_HOUR, np.radians(0.1) / 60, 1e-3 * STANDARD_GRAVITY, 0.03 / 60)


@pytest.fixture(scope="session")
def made_up():
    """Return what this file makes, by name: tests do not import each other."""
    return SimpleNamespace(imu=made_up_imu, params=made_up_params, error=heading_error, perfect=PERFECT,
                           navigation=NAVIGATION, tactical=TACTICAL)


def made_up_imu(grade, duration, seed=0, heading=0.7, roll=0.02, pitch=-0.03, rate=100.0, turns=()):
    """Return an ImuSeries and the attitude (3, 3) at its end; turns are (start s, length s, angle rad)."""
    rng = np.random.default_rng(seed)
    count = round(duration * rate)
    time = (np.arange(count) + 0.5) / rate
    angle, speed = np.zeros(count), np.zeros(count)
    for start, length, by in turns:
        share = np.clip((time - start) / length, 0.0, 1.0)
        angle += by * share
        speed += np.where((share > 0) & (share < 1), by / length, 0.0)
    dcm_nb = dcm_nb_from_euler(roll, pitch, heading) @ dcm_nb_from_euler(0.0, 0.0, angle)
    gyro_b = np.einsum("kji,j->ki", dcm_nb, earth_rate_n(LATITUDE))
    gyro_b[:, 2] += speed
    accel_b = np.einsum("kji,j->ki", dcm_nb, [0.0, 0.0, -normal_gravity(LATITUDE)])
    white = np.sqrt(rate) * rng.standard_normal((2, count, 3))
    gyro_b += grade.gyro_bias * rng.standard_normal(3) + grade.gyro_noise * white[0]
    accel_b += grade.accel_bias * rng.standard_normal(3) + grade.accel_noise * white[1]
    stamp_ns = np.rint(np.arange(1, count + 1) * 1e9 / rate).astype(np.int64)
    return ImuSeries(stamp_ns, gyro_b, accel_b), dcm_nb[-1]


def made_up_params(grade, **changes):
    """Return the StandingParams of a grade."""
    return StandingParams(**{
        "latitude": LATITUDE, "gyro_noise_density": grade.gyro_noise, "gyro_bias_std": grade.gyro_bias,
        "gyro_bias_instability": 0.0, "accel_noise_density": grade.accel_noise, "accel_bias_std": grade.accel_bias,
        "accel_bias_instability": 0.0, "scale_std": 0.0, "zero_velocity_std": 1e-3, **changes})


def heading_error(heading, dcm_nb):
    """Return how far a heading is off, rad, in [-pi, pi)."""
    return (heading - np.arctan2(dcm_nb[1, 0], dcm_nb[0, 0]) + np.pi) % (2 * np.pi) - np.pi
