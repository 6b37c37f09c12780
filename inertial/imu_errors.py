"""What real sensors add to the truth: noise, biases, scale, quantisation, late and lost samples.

Every random figure is drawn from the generator passed in, in a fixed order and whether or not it is
used, so that one seed gives the same noise whichever errors are switched on. :data:`PROFILES` holds
named sensors. Frames and units: :mod:`inertial`.
"""

import math
from dataclasses import dataclass

import numpy as np

from inertial._kernels import first_order_recursion
from inertial.parameters import check_parameters, parameter
from inertial.recording import ImuSeries

# Stamp jitter is cut off here, in sample intervals, so that stamps stay in order.
_LARGEST_JITTER = 0.45


@dataclass(frozen=True)
class ImuErrors:
    """Errors of a gyro and accelerometer triad; the defaults are a perfect sensor."""

    gyro_noise_density: float = parameter(
        0.0, "rad/s/sqrt(Hz)", "White noise (angle random walk).", 0.0)
    gyro_bias_std: float = parameter(0.0, "rad/s", "Spread of the bias drawn at turn-on.", 0.0)
    gyro_drift_std: float = parameter(0.0, "rad/s", "Spread of the in-run Gauss-Markov bias.", 0.0)
    gyro_drift_time: float = parameter(300.0, "s", "Correlation time of the in-run bias.", 1e-3)
    gyro_walk_density: float = parameter(
        0.0, "rad/s/sqrt(s)", "Rate random walk of the bias.", 0.0)
    gyro_scale_std: float = parameter(0.0, "", "Spread of each axis' scale factor error.", 0.0)
    gyro_misalignment_std: float = parameter(
        0.0, "rad", "Spread of each axis' direction error towards each other axis.", 0.0)
    gyro_resolution: float = parameter(0.0, "rad/s", "Quantisation step; 0 for none.", 0.0)
    gyro_range: float = parameter(
        float("nan"), "rad/s", "Readings are clipped beyond it.", 0.0, nan_means="unlimited")
    accel_noise_density: float = parameter(
        0.0, "m/s^2/sqrt(Hz)", "White noise (velocity random walk).", 0.0)
    accel_bias_std: float = parameter(0.0, "m/s^2", "Spread of the bias drawn at turn-on.", 0.0)
    accel_drift_std: float = parameter(0.0, "m/s^2", "Spread of the in-run Gauss-Markov bias.", 0.0)
    accel_drift_time: float = parameter(300.0, "s", "Correlation time of the in-run bias.", 1e-3)
    accel_walk_density: float = parameter(
        0.0, "m/s^2/sqrt(s)", "Random walk of the bias.", 0.0)
    accel_scale_std: float = parameter(0.0, "", "Spread of each axis' scale factor error.", 0.0)
    accel_misalignment_std: float = parameter(
        0.0, "rad", "Spread of each axis' direction error towards each other axis.", 0.0)
    accel_resolution: float = parameter(0.0, "m/s^2", "Quantisation step; 0 for none.", 0.0)
    accel_range: float = parameter(
        float("nan"), "m/s^2", "Readings are clipped beyond it.", 0.0, nan_means="unlimited")
    jitter_std: float = parameter(0.0, "s", "Spread of the stamps about the sampling times.", 0.0)
    dropout_share: float = parameter(0.0, "", "Share of the samples lost at random.", 0.0, 1.0)

    def __post_init__(self):
        check_parameters(self)


@dataclass(frozen=True)
class AltimeterErrors:
    """Errors of a barometric altimeter; the defaults are a perfect sensor."""

    noise_std: float = parameter(0.0, "m", "White noise of each sample.", 0.0)
    drift_std: float = parameter(0.0, "m", "Spread of the Gauss-Markov drift (weather).", 0.0)
    drift_time: float = parameter(300.0, "s", "Correlation time of the drift.", 1e-3)
    scale: float = parameter(0.0, "", "Scale factor error of the altitude above the start.")
    delay: float = parameter(0.0, "s", "How much older than its stamp each value is.", 0.0)
    resolution: float = parameter(0.0, "m", "Quantisation step; 0 for none.", 0.0)
    jitter_std: float = parameter(0.0, "s", "Spread of the stamps about the sampling times.", 0.0)
    dropout_share: float = parameter(0.0, "", "Share of the samples lost at random.", 0.0, 1.0)

    def __post_init__(self):
        check_parameters(self)


@dataclass(frozen=True)
class SensorProfile:
    """A named set of sensors."""

    description: str
    imu: ImuErrors
    altimeter: AltimeterErrors


@dataclass(frozen=True)
class MeasuredImu:
    """IMU samples with errors, and the true bias within each.

    Attributes
    ----------
    imu : ImuSeries
    gyro_bias_b, accel_bias_b : (N, 3), rad/s and m/s^2
        Turn-on bias, Gauss-Markov part and walk together.
    """

    imu: ImuSeries
    gyro_bias_b: np.ndarray
    accel_bias_b: np.ndarray


def apply_imu_errors(imu, errors, rng):
    """Return the samples as a sensor with errors would deliver them.

    ``reading = quantise(clip((I + M) truth + bias + noise))``.

    Parameters
    ----------
    imu : ImuSeries
        True means over the sample intervals.
    errors : ImuErrors
    rng : numpy.random.Generator

    Returns
    -------
    MeasuredImu
    """
    dt = _sample_intervals(imu.stamp_ns)
    gyro_b, gyro_bias_b = _measure_triad("gyro", imu.gyro_b, dt, errors, rng)
    accel_b, accel_bias_b = _measure_triad("accel", imu.accel_b, dt, errors, rng)
    stamp_ns, kept = _disturb_sampling(imu.stamp_ns, errors, rng)
    return MeasuredImu(ImuSeries(stamp_ns[kept], gyro_b[kept], accel_b[kept]),
                       gyro_bias_b[kept], accel_bias_b[kept])


def apply_altimeter_errors(stamp_ns, altitude, errors, rng):
    """Return the stamps and readings of an altimeter with errors.

    Parameters
    ----------
    stamp_ns : (M,) int64
    altitude : (M,) float64, m
        True altitude above the start at ``stamp_ns`` less the delay.
    errors : AltimeterErrors
    rng : numpy.random.Generator

    Returns
    -------
    stamp_ns : (M',) int64
    altitude : (M',) float64, m
    """
    dt = _sample_intervals(stamp_ns)
    drift = _gauss_markov(errors.drift_std, errors.drift_time, dt, 1, rng)[:, 0]
    noise = errors.noise_std * rng.standard_normal(len(dt))
    reading = _quantise((1 + errors.scale) * altitude + drift + noise, errors.resolution)
    stamp_ns, kept = _disturb_sampling(stamp_ns, errors, rng)
    return stamp_ns[kept], reading[kept]


def _measure_triad(sensor, truth_b, dt, errors, rng):
    def error(name):
        return getattr(errors, f"{sensor}_{name}")

    matrix = error("misalignment_std") * rng.standard_normal((3, 3))
    np.fill_diagonal(matrix, error("scale_std") * rng.standard_normal(3))
    bias_b = error("bias_std") * rng.standard_normal(3) + _gauss_markov(
        error("drift_std"), error("drift_time"), dt, 3, rng)
    walk = rng.standard_normal((len(dt), 3)) * np.sqrt(dt)[:, None]
    bias_b += error("walk_density") * np.cumsum(walk, axis=0)
    noise = rng.standard_normal((len(dt), 3)) / np.sqrt(dt)[:, None]
    reading = truth_b + truth_b @ matrix.T + bias_b + error("noise_density") * noise
    if np.isfinite(error("range")):
        reading = np.clip(reading, -error("range"), error("range"))
    return _quantise(reading, error("resolution")), bias_b


def _gauss_markov(std, time, dt, columns, rng):
    """Return a stationary first-order Gauss-Markov process, (N, columns)."""
    decay = np.exp(-dt / time)
    decay[0] = 0.0
    drive = rng.standard_normal((len(dt), columns)) * np.sqrt(1 - decay ** 2)[:, None]
    return std * first_order_recursion(decay, drive)


def _quantise(reading, resolution):
    return np.round(reading / resolution) * resolution if resolution > 0 else reading


def _sample_intervals(stamp_ns):
    dt = np.diff(stamp_ns) * 1e-9
    return np.concatenate([dt[:1], dt])


def _disturb_sampling(stamp_ns, errors, rng):
    """Return jittered stamps and which samples are kept."""
    interval = np.diff(stamp_ns).min() * 1e-9
    jitter = errors.jitter_std * rng.standard_normal(len(stamp_ns))
    limit = _LARGEST_JITTER * interval
    jitter_ns = np.rint(np.clip(jitter, -limit, limit) * 1e9).astype(np.int64)
    return stamp_ns + jitter_ns, rng.random(len(stamp_ns)) >= errors.dropout_share


_PAPER_INTERVAL = 0.01

PROFILES = {
    "perfect": SensorProfile("sensors without errors", ImuErrors(), AltimeterErrors()),
    "consumer": SensorProfile(
        "consumer MEMS after a factory calibration: between the data sheets of Bosch BMI160 and "
        "TDK ICM-20948, and a barometer such as Bosch BMP388",
        ImuErrors(
            gyro_noise_density=2e-4, gyro_bias_std=math.radians(0.5),
            gyro_drift_std=math.radians(0.02), gyro_walk_density=1e-6,
            gyro_scale_std=3e-3, gyro_misalignment_std=2e-3, gyro_resolution=1.065e-3,
            gyro_range=34.9, accel_noise_density=2e-3, accel_bias_std=0.05,
            accel_drift_std=0.01, accel_walk_density=1e-5, accel_scale_std=2e-3,
            accel_misalignment_std=2e-3, accel_resolution=4.79e-3, accel_range=156.9),
        AltimeterErrors(noise_std=0.2, drift_std=0.4, drift_time=120.0, scale=0.01, delay=0.03,
                        resolution=0.02)),
    "paper": SensorProfile(
        "the paper's sensors: white noise of 0.5 deg/s, 0.1 m/s^2 and 2 m per sample at 100 Hz",
        ImuErrors(gyro_noise_density=math.radians(0.5) * _PAPER_INTERVAL ** 0.5,
                  accel_noise_density=0.1 * _PAPER_INTERVAL ** 0.5),
        AltimeterErrors(noise_std=2.0)),
}


def find_profile(name):
    """Return the sensor profile of that name.

    Raises
    ------
    ValueError
        There is none; the message lists the names.
    """
    if name not in PROFILES:
        raise ValueError(f"unknown sensor profile {name!r}: choose from {', '.join(PROFILES)}")
    return PROFILES[name]
