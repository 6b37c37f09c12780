"""What real sensors add to the truth: noise, biases, scale, quantisation, late and lost samples.

Every random figure is drawn from the generator passed in, in a fixed order and whether or not it is
used, so that one seed gives the same noise whichever errors are switched on; only 1/f noise and vibration,
which take many draws, are drawn last and where they are asked for. :data:`PROFILES` holds named sensors.
Frames and units: :mod:`inertial`.

1/f noise is a sum of first-order Gauss-Markov processes, one an octave, each of variance b^2 / 2: its two-sided
spectral density is b^2 / (4 ln 2 f) and its Allan deviation flat at b (IEEE Std 952-1997, annex C, where b is
0.664 B). One such process alone is not flat anywhere.
"""

import math
from dataclasses import dataclass

import numpy as np

from inertial._kernels import first_order_recursion
from inertial.earth import STANDARD_GRAVITY
from inertial.parameters import check_parameters, parameter
from inertial.recording import ImuSeries

# Stamp jitter is cut off here, in sample intervals, so that stamps stay in order.
_LARGEST_JITTER = 0.45
# Durations: what is slower still is part of the bias.
_SLOWEST_FLICKER = 8.0


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
    gyro_bias_instability: float = parameter(
        0.0, "rad/s", "1/f noise: the floor of its Allan deviation.", 0.0)
    gyro_scale_std: float = parameter(0.0, "", "Spread of each axis' scale factor error.", 0.0)
    gyro_misalignment_std: float = parameter(
        0.0, "rad", "Spread of each axis' direction error towards each other axis.", 0.0)
    gyro_resolution: float = parameter(0.0, "rad/s", "Quantisation step; 0 for none.", 0.0)
    gyro_angle_resolution: float = parameter(
        0.0, "rad", "Quantisation step of the integral, where pulses are counted; 0 for none.", 0.0)
    gyro_vibration_std: float = parameter(0.0, "rad/s", "Vibration of the mounting.", 0.0)
    gyro_range: float = parameter(
        float("nan"), "rad/s", "Readings are clipped beyond it.", 0.0, nan_means="unlimited")
    accel_noise_density: float = parameter(
        0.0, "m/s^2/sqrt(Hz)", "White noise (velocity random walk).", 0.0)
    accel_bias_std: float = parameter(0.0, "m/s^2", "Spread of the bias drawn at turn-on.", 0.0)
    accel_drift_std: float = parameter(0.0, "m/s^2", "Spread of the in-run Gauss-Markov bias.", 0.0)
    accel_drift_time: float = parameter(300.0, "s", "Correlation time of the in-run bias.", 1e-3)
    accel_walk_density: float = parameter(
        0.0, "m/s^2/sqrt(s)", "Random walk of the bias.", 0.0)
    accel_bias_instability: float = parameter(
        0.0, "m/s^2", "1/f noise: the floor of its Allan deviation.", 0.0)
    accel_scale_std: float = parameter(0.0, "", "Spread of each axis' scale factor error.", 0.0)
    accel_misalignment_std: float = parameter(
        0.0, "rad", "Spread of each axis' direction error towards each other axis.", 0.0)
    accel_resolution: float = parameter(0.0, "m/s^2", "Quantisation step; 0 for none.", 0.0)
    accel_velocity_resolution: float = parameter(
        0.0, "m/s", "Quantisation step of the integral, where pulses are counted; 0 for none.", 0.0)
    accel_vibration_std: float = parameter(0.0, "m/s^2", "Vibration of the mounting.", 0.0)
    accel_range: float = parameter(
        float("nan"), "m/s^2", "Readings are clipped beyond it.", 0.0, nan_means="unlimited")
    vibration_frequency: float = parameter(100.0, "Hz", "Centre of the vibration's band.", 0.0)
    vibration_time: float = parameter(
        0.1, "s", "Correlation time of the vibration; longer is a purer tone.", 1e-3)
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
class Calibration:
    """What is constant in the errors of a triad: ``reading = (I + matrix) truth + bias_b``.

    Attributes
    ----------
    matrix : (3, 3)
        Scale factor errors on the diagonal, misalignment beside it.
    bias_b : (3,), the unit of the readings
    """

    matrix: np.ndarray
    bias_b: np.ndarray

    def compensate(self, reading_b):
        """Return readings (..., 3) without these errors."""
        return (reading_b - self.bias_b) @ np.linalg.inv(np.eye(3) + self.matrix).T


@dataclass(frozen=True)
class MeasuredImu:
    """IMU samples with errors, and what is true of the errors.

    Attributes
    ----------
    imu : ImuSeries
    gyro_bias_b, accel_bias_b : (N, 3), rad/s and m/s^2
        The bias in each sample: turn-on bias, Gauss-Markov part, walk and 1/f noise together.
    gyro_calibration, accel_calibration : Calibration
        That would take the constant errors out.
    """

    imu: ImuSeries
    gyro_bias_b: np.ndarray
    accel_bias_b: np.ndarray
    gyro_calibration: Calibration
    accel_calibration: Calibration


@dataclass
class _Triad:
    """A triad while its errors are put together; 1/f noise is added to both arrays."""

    sensor: str
    reading: np.ndarray
    bias_b: np.ndarray
    calibration: Calibration


def apply_imu_errors(imu, errors, rng):
    """Return the samples as a sensor with errors would deliver them.

    ``reading = quantise(clip((I + M) truth + bias + noise + vibration))``.

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
    triads = [_measure_triad("gyro", imu.gyro_b, dt, errors, rng),
              _measure_triad("accel", imu.accel_b, dt, errors, rng)]
    stamp_ns, kept = _disturb_sampling(imu.stamp_ns, errors, rng)
    for triad in triads:
        _add_flicker(triad, errors, rng)
    for triad in triads:
        _add_vibration(triad, dt, errors, rng)
    gyro_b, accel_b = (_digitise(triad, dt, errors) for triad in triads)
    gyro, accel = triads
    return MeasuredImu(ImuSeries(stamp_ns[kept], gyro_b[kept], accel_b[kept]), gyro.bias_b[kept],
                       accel.bias_b[kept], gyro.calibration, accel.calibration)


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


def flicker_noise(bias_instability, interval, count, rng, columns=3):
    """Return 1/f noise, its Allan deviation flat to some per cent from eight intervals on.

    Parameters
    ----------
    bias_instability : float
        Floor of the Allan deviation.
    interval : float, s
    count, columns : int
    rng : numpy.random.Generator

    Returns
    -------
    (count, columns) float64
    """
    octaves = math.ceil(math.log2(_SLOWEST_FLICKER * count)) + 1
    total = np.zeros((count, columns))
    for time in interval * 2.0 ** np.arange(octaves):
        decay = np.full(count, math.exp(-interval / time))
        decay[0] = 0.0
        drive = rng.standard_normal((count, columns)) * np.sqrt(1 - decay ** 2)[:, None]
        total += first_order_recursion(decay, drive)
    return bias_instability * math.sqrt(0.5) * total


def _measure_triad(sensor, truth_b, dt, errors, rng):
    def error(name):
        return getattr(errors, f"{sensor}_{name}")

    matrix = error("misalignment_std") * rng.standard_normal((3, 3))
    np.fill_diagonal(matrix, error("scale_std") * rng.standard_normal(3))
    turn_on_b = error("bias_std") * rng.standard_normal(3)
    bias_b = turn_on_b + _gauss_markov(error("drift_std"), error("drift_time"), dt, 3, rng)
    walk = rng.standard_normal((len(dt), 3)) * np.sqrt(dt)[:, None]
    bias_b += error("walk_density") * np.cumsum(walk, axis=0)
    noise = rng.standard_normal((len(dt), 3)) / np.sqrt(dt)[:, None]
    reading = truth_b + truth_b @ matrix.T + bias_b + error("noise_density") * noise
    return _Triad(sensor, reading, bias_b, Calibration(matrix, turn_on_b))


def _add_flicker(triad, errors, rng):
    level = getattr(errors, f"{triad.sensor}_bias_instability")
    if level > 0.0:
        flicker = flicker_noise(level, 1.0, len(triad.reading), rng)
        triad.reading += flicker
        triad.bias_b += flicker


def _add_vibration(triad, dt, errors, rng):
    """Add a tone whose two quadratures are Gauss-Markov processes: a band about its frequency."""
    std = getattr(errors, f"{triad.sensor}_vibration_std")
    if std > 0.0:
        quadratures = _gauss_markov(std, errors.vibration_time, dt, 6, rng)
        phase = 2 * np.pi * errors.vibration_frequency * np.cumsum(dt)[:, None]
        triad.reading += quadratures[:, :3] * np.cos(phase) + quadratures[:, 3:] * np.sin(phase)


def _digitise(triad, dt, errors):
    """Return the readings clipped at the range, then in steps of the resolution or of the counted integral."""
    def error(name):
        return getattr(errors, f"{triad.sensor}_{name}")

    reading = triad.reading
    if np.isfinite(error("range")):
        reading = np.clip(reading, -error("range"), error("range"))
    count = error("angle_resolution" if triad.sensor == "gyro" else "velocity_resolution")
    if count > 0.0:
        integral = _quantise(np.cumsum(reading * dt[:, None], axis=0), count)
        reading = np.diff(integral, axis=0, prepend=0.0) / dt[:, None]
    return _quantise(reading, error("resolution"))


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
_DEG = math.pi / 180
_DEG_PER_HOUR = _DEG / 3600
_DEG_PER_ROOT_HOUR = _DEG / 60
_PER_ROOT_HOUR = 1 / 60
_G = STANDARD_GRAVITY
_BAROMETER = AltimeterErrors(noise_std=0.2, drift_std=0.4, drift_time=120.0, scale=0.01, delay=0.03,
                             resolution=0.02)

# A data sheet's typical value counts as one sigma, which is how Bosch and Analog Devices define theirs. Where it
# gives nothing, the figure is left at zero, or is marked "class": usual for such sensors. The lines of the BMI160, of
# the ICM-20948's gyro and of the KVH 1750 are quoted second-hand.
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
        _BAROMETER),
    "paper": SensorProfile(
        "the paper's sensors: white noise of 0.5 deg/s, 0.1 m/s^2 and 2 m per sample at 100 Hz",
        ImuErrors(gyro_noise_density=math.radians(0.5) * _PAPER_INTERVAL ** 0.5,
                  accel_noise_density=0.1 * _PAPER_INTERVAL ** 0.5),
        AltimeterErrors(noise_std=2.0)),
    "bmi160": SensorProfile(
        "Bosch BMI160, uncalibrated, at +-2000 deg/s and +-16 g (BST-BMI160-DS000, electrical characteristics)",
        ImuErrors(
            gyro_noise_density=0.007 * _DEG,  # output noise density 0.007 deg/s/sqrt(Hz)
            gyro_bias_std=3.0 * _DEG,  # zero-rate offset +-3 deg/s
            gyro_bias_instability=10.0 * _DEG_PER_HOUR,  # class
            gyro_scale_std=0.01,  # class
            gyro_misalignment_std=0.02,  # cross axis sensitivity 2 %
            gyro_resolution=_DEG / 16.4,  # 16.4 LSB/deg/s
            gyro_range=2000.0 * _DEG,
            accel_noise_density=180e-6 * _G,  # output noise density 180 ug/sqrt(Hz)
            accel_bias_std=40e-3 * _G,  # zero-g offset +-40 mg over lifetime
            accel_bias_instability=40e-6 * _G,  # class
            accel_scale_std=0.01,  # class
            accel_misalignment_std=0.01,  # cross axis sensitivity 1 %
            accel_resolution=_G / 2048,  # 2048 LSB/g
            accel_range=16.0 * _G),
        _BAROMETER),
    "icm20948": SensorProfile(
        "TDK ICM-20948, uncalibrated, at +-2000 deg/s and +-16 g (DS-000189 rev. 1.3, tables 1 and 2)",
        ImuErrors(
            gyro_noise_density=0.015 * _DEG,  # rate noise spectral density 0.015 deg/s/sqrt(Hz)
            gyro_bias_std=5.0 * _DEG,  # initial ZRO tolerance +-5 deg/s
            gyro_bias_instability=10.0 * _DEG_PER_HOUR,  # class
            gyro_scale_std=0.015,  # sensitivity scale factor tolerance +-1.5 %
            gyro_misalignment_std=0.02,  # cross-axis sensitivity +-2 %
            gyro_resolution=_DEG / 16.4,  # 16.4 LSB/deg/s
            gyro_range=2000.0 * _DEG,
            accel_noise_density=230e-6 * _G,  # noise spectral density 230 ug/sqrt(Hz)
            accel_bias_std=50e-3 * _G,  # zero-g initial tolerance, board level, +-50 mg
            accel_bias_instability=40e-6 * _G,  # class
            accel_scale_std=0.005,  # sensitivity initial tolerance +-0.5 %
            accel_misalignment_std=0.02,  # cross-axis sensitivity +-2 %
            accel_resolution=_G / 2048,  # 2048 LSB/g
            accel_range=16.0 * _G),
        _BAROMETER),
    "mti300": SensorProfile(
        "Xsens MTi-300 (MTi user manual MT0605P, sensor specifications of the 100-series)",
        ImuErrors(
            gyro_noise_density=0.01 * _DEG,  # noise density 0.01 deg/s/sqrt(Hz)
            gyro_bias_std=0.2 * _DEG,  # bias repeatability 0.2 deg/s
            gyro_bias_instability=10.0 * _DEG_PER_HOUR,  # in-run bias stability 10 deg/h
            gyro_misalignment_std=0.05 * _DEG,  # non-orthogonality 0.05 deg
            gyro_range=450.0 * _DEG,  # full range 450 deg/s
            accel_noise_density=60e-6 * _G,  # noise density 60 ug/sqrt(Hz)
            accel_bias_std=0.03,  # bias repeatability 0.03 m/s^2
            accel_bias_instability=15e-6 * _G,  # in-run bias stability 15 ug
            accel_misalignment_std=0.05 * _DEG,  # non-orthogonality 0.05 deg
            accel_range=50.0),  # full range 50 m/s^2
        _BAROMETER),
    "adis16405": SensorProfile(
        "Analog Devices ADIS16405 (data sheet ADIS16400/ADIS16405, table 1)",
        ImuErrors(
            gyro_noise_density=2.0 * _DEG_PER_ROOT_HOUR,  # angular random walk 2.0 deg/sqrt(h)
            gyro_bias_std=3.0 * _DEG,  # initial bias error +-3 deg/s
            gyro_bias_instability=0.007 * _DEG,  # in-run bias stability 0.007 deg/s
            gyro_scale_std=0.01,  # sensitivity 0.0495 to 0.0505 deg/s/LSB
            gyro_misalignment_std=0.05 * _DEG,  # misalignment, axis to axis, 0.05 deg
            gyro_resolution=0.05 * _DEG,  # 0.05 deg/s/LSB
            gyro_range=300.0 * _DEG,  # dynamic range +-300 deg/s
            accel_noise_density=0.2 * _PER_ROOT_HOUR,  # velocity random walk 0.2 m/s/sqrt(h)
            accel_bias_std=50e-3 * _G,  # initial bias error +-50 mg
            accel_bias_instability=0.2e-3 * _G,  # in-run bias stability 0.2 mg
            accel_scale_std=0.014,  # sensitivity 3.285 to 3.38 mg/LSB
            accel_misalignment_std=0.2 * _DEG,  # misalignment, axis to axis, 0.2 deg
            accel_resolution=3.33e-3 * _G,  # 3.33 mg/LSB
            accel_range=18.0 * _G),  # dynamic range +-18 g
        _BAROMETER),
    "adis16448": SensorProfile(
        "Analog Devices ADIS16448 (data sheet, table 1)",
        ImuErrors(
            gyro_noise_density=0.66 * _DEG_PER_ROOT_HOUR,  # angular random walk 0.66 deg/sqrt(h)
            gyro_bias_std=0.5 * _DEG,  # initial bias error +-0.5 deg/s
            gyro_bias_instability=14.5 * _DEG_PER_HOUR,  # in-run bias stability 14.5 deg/h
            gyro_scale_std=0.01,  # sensitivity tolerance +-1 %
            gyro_misalignment_std=0.05 * _DEG,  # misalignment, axis to axis, 0.05 deg
            gyro_resolution=0.04 * _DEG,  # 0.04 deg/s/LSB
            gyro_range=1000.0 * _DEG,  # dynamic range +-1000 deg/s
            accel_noise_density=0.11 * _PER_ROOT_HOUR,  # velocity random walk 0.11 m/s/sqrt(h)
            accel_bias_std=20e-3 * _G,  # initial bias error +-20 mg
            accel_bias_instability=0.25e-3 * _G,  # in-run bias stability 0.25 mg
            accel_misalignment_std=0.2 * _DEG,  # misalignment, axis to axis, 0.2 deg
            accel_resolution=0.833e-3 * _G,  # 0.833 mg/LSB
            accel_range=18.0 * _G),  # dynamic range +-18 g
        _BAROMETER),
    "adis16488a": SensorProfile(
        "Analog Devices ADIS16488A in 32 bits (data sheet, table 1; paper 002, table 1)",
        ImuErrors(
            gyro_noise_density=0.26 * _DEG_PER_ROOT_HOUR,  # angular random walk 0.26 deg/sqrt(h)
            gyro_bias_std=0.2 * _DEG,  # bias repeatability +-0.2 deg/s
            gyro_bias_instability=5.1 * _DEG_PER_HOUR,  # in-run bias stability 5.1 deg/h
            gyro_scale_std=0.01,  # sensitivity repeatability +-1 %
            gyro_misalignment_std=0.05 * _DEG,  # misalignment, axis to axis, +-0.05 deg
            gyro_range=450.0 * _DEG,  # dynamic range +-450 deg/s
            accel_noise_density=0.029 * _PER_ROOT_HOUR,  # velocity random walk 0.029 m/s/sqrt(h)
            accel_bias_std=16e-3 * _G,  # bias repeatability +-16 mg
            accel_bias_instability=0.07e-3 * _G,  # in-run bias stability 0.07 mg
            accel_scale_std=0.005,  # sensitivity repeatability +-0.5 %
            accel_misalignment_std=0.035 * _DEG,  # misalignment, axis to axis, +-0.035 deg
            accel_range=18.0 * _G),  # dynamic range +-18 g
        _BAROMETER),
    "kvh1750": SensorProfile(
        "KVH 1750 IMU, a tactical fibre-optic gyro with MEMS accelerometers of 10 g (KVH data sheet)",
        ImuErrors(
            gyro_noise_density=0.012 * _DEG_PER_ROOT_HOUR,  # angle random walk 0.012 deg/sqrt(h)
            gyro_bias_std=2.0 * _DEG_PER_HOUR,  # bias offset +-2 deg/h
            gyro_bias_instability=0.05 * _DEG_PER_HOUR,  # bias instability 0.05 deg/h
            gyro_scale_std=200e-6,  # scale factor over temperature 200 ppm
            gyro_misalignment_std=0.4e-3,  # class
            gyro_range=490.0 * _DEG,  # input rate +-490 deg/s
            accel_noise_density=0.12e-3 * _G,  # velocity random walk 0.12 mg/sqrt(Hz)
            accel_bias_std=2e-3 * _G,  # class
            accel_bias_instability=0.05e-3 * _G,  # bias instability 0.05 mg
            accel_scale_std=1e-3,  # class
            accel_misalignment_std=1e-3,  # class
            accel_range=10.0 * _G),  # input limit +-10 g
        _BAROMETER),
    "hg9900": SensorProfile(
        "Honeywell HG9900, a navigation-grade ring-laser unit (brochure N61-1638-000-000, key characteristics)",
        ImuErrors(
            gyro_noise_density=0.002 * _DEG_PER_ROOT_HOUR,  # angular random walk 0.002 deg/sqrt(h)
            gyro_bias_std=0.0035 * _DEG_PER_HOUR,  # bias repeatability 0.0035 deg/h
            gyro_scale_std=5e-6,  # scale factor 5 ppm
            gyro_misalignment_std=1e-5,  # class
            accel_noise_density=10e-6 * _G,  # class
            accel_bias_std=25e-6 * _G,  # bias repeatability 25 ug
            accel_scale_std=100e-6,  # scale factor 100 ppm
            accel_misalignment_std=1e-5),  # class
        _BAROMETER),
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
