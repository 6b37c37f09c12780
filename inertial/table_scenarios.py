"""Scenarios of an IMU on a turntable that stands on the turning Earth, for three grades of sensors.

The table visits 0-90-180-270-270-180-90-0 deg over and over, which cancels a steady drift, and stands at each
for :data:`STAND` seconds, enough for a dwell of 15 s. The IMU turns with the table; the truth is the attitude
of the table at table angle zero, which does not change. A table angle is positive clockwise seen from above
(about z, down).

Gyros have white noise, 1/f noise ("bias instability"), a bias, scale factor errors and misalignment.
"""

import math
from dataclasses import dataclass

import numpy as np

from inertial.earth import normal_gravity
from inertial.imu_errors import ImuErrors, apply_imu_errors, flicker_noise
from inertial.recording import AttitudeSeries, ImuSeries, JointSeries, Recording
from inertial.rotation import dcm_nb_from_euler, quaternion_from_dcm
from inertial.simulator import Trajectory, sample_trajectory
from inertial.trajectory import Profile

STAND, MOVE = 16.5, 2.0
"""Seconds at each angle, and between two."""
LATITUDE = math.radians(35.0)
ROLL, PITCH, HEADING = (math.radians(angle) for angle in (2.0, -1.5, 130.0))
"""Where the table stands, and how."""

_ANGLES = np.radians([0.0, 90.0, 180.0, 270.0, 270.0, 180.0, 90.0, 0.0])
_JOINT_RATE = 20.0  # Hz
_TRUTH_PERIOD_NS = 100_000_000
_DEG = math.pi / 180
_DEG_PER_HOUR = _DEG / 3600
_DEG_PER_ROOT_HOUR = _DEG / 60


@dataclass(frozen=True)
class TableMotion:
    """What :class:`inertial.trajectory.Motion` says, of a body on a turntable."""

    dcm_nb: np.ndarray
    rate_b: np.ndarray
    velocity_n: np.ndarray
    acceleration_n: np.ndarray


@dataclass(frozen=True)
class TableScenario:
    """A grade of sensors on the table.

    Attributes
    ----------
    description : str
    errors : inertial.imu_errors.ImuErrors
    gyro_bias_instability : float, rad/s
        Floor of the gyros' Allan deviation.
    """

    description: str
    errors: ImuErrors
    gyro_bias_instability: float


TABLE_SCENARIOS = {
    "turntable_navigation": TableScenario(
        "navigation-grade gyros (0.01 deg/h, 0.003 deg/rt-h) on a turntable at latitude 35 deg",
        ImuErrors(gyro_noise_density=0.003 * _DEG_PER_ROOT_HOUR, gyro_bias_std=0.01 * _DEG_PER_HOUR,
                  gyro_scale_std=1e-5, gyro_misalignment_std=2e-5, accel_noise_density=1e-4,
                  accel_bias_std=5e-4, accel_scale_std=5e-5, accel_misalignment_std=2e-5),
        0.01 * _DEG_PER_HOUR),
    "turntable_tactical": TableScenario(
        "tactical-grade gyros (1 deg/h, 0.1 deg/rt-h), likewise",
        ImuErrors(gyro_noise_density=0.1 * _DEG_PER_ROOT_HOUR, gyro_bias_std=1.0 * _DEG_PER_HOUR,
                  gyro_scale_std=3e-4, gyro_misalignment_std=3e-4, accel_noise_density=5e-4,
                  accel_bias_std=0.01, accel_scale_std=3e-4, accel_misalignment_std=3e-4),
        1.0 * _DEG_PER_HOUR),
    "turntable_mems": TableScenario(
        "good MEMS gyros (5.1 deg/h, 0.26 deg/rt-h), likewise",
        ImuErrors(gyro_noise_density=0.26 * _DEG_PER_ROOT_HOUR, gyro_bias_std=100.0 * _DEG_PER_HOUR,
                  gyro_scale_std=1e-3, gyro_misalignment_std=1e-3, accel_noise_density=1e-3,
                  accel_bias_std=0.03, accel_scale_std=1e-3, accel_misalignment_std=1e-3),
        5.1 * _DEG_PER_HOUR),
}


def simulate_table(scenario, *, duration=148.0, imu_rate=100.0, seed=0):
    """Return a simulated recording of an IMU on a turntable; the same arguments give the same bytes.

    Parameters
    ----------
    scenario : str
        A name in :data:`TABLE_SCENARIOS`.
    duration : float, s
        One round takes eight times STAND + MOVE.
    imu_rate : float, Hz
    seed : int

    Returns
    -------
    inertial.recording.Recording
        With the table's angle at 20 Hz, and the attitude of the table at angle zero as the truth.

    Raises
    ------
    ValueError
        Unknown name, or figures out of range.
    """
    if scenario not in TABLE_SCENARIOS:
        raise ValueError(f"unknown scenario {scenario!r}: choose from {', '.join(TABLE_SCENARIOS)}")
    grade = TABLE_SCENARIOS[scenario]
    angle = table_angle(duration)
    dcm_nt = dcm_nb_from_euler(ROLL, PITCH, HEADING)
    trajectory = Trajectory(scenario, duration, lambda t: _motion(t, angle, dcm_nt),
                            float(normal_gravity(LATITUDE)), LATITUDE)
    perfect = sample_trajectory(trajectory, imu_rate=imu_rate).imu
    rng = np.random.default_rng(seed)
    measured = apply_imu_errors(perfect, grade.errors, rng).imu
    flicker = flicker_noise(grade.gyro_bias_instability, 1.0 / imu_rate, len(perfect), rng)
    imu = ImuSeries(measured.stamp_ns, measured.gyro_b + flicker, measured.accel_b)
    truth_ns = np.arange(imu.stamp_ns[0], imu.stamp_ns[-1] + 1, _TRUTH_PERIOD_NS)
    truth = AttitudeSeries(truth_ns, np.tile(quaternion_from_dcm(dcm_nt), (len(truth_ns), 1)))
    joint_ns = imu.stamp_ns[::max(1, round(imu_rate / _JOINT_RATE))]
    # The first sample ends at time zero.
    time = (joint_ns - imu.stamp_ns[0]) * 1e-9
    return Recording(scenario, imu, truth=truth, joint=JointSeries(joint_ns, angle(time)))


def table_angle(duration):
    """Return the table angle, rad, as an :class:`inertial.trajectory.Profile` of time."""
    stops = max(2, math.ceil(duration / (STAND + MOVE)))
    angles = np.resize(_ANGLES, stops)
    arrivals = (STAND + MOVE) * np.arange(stops)
    knots = np.stack([arrivals, arrivals + STAND], axis=-1).ravel()
    return Profile(knots, np.repeat(angles, 2))


def _motion(time, angle, dcm_nt):
    tau = angle(time)
    zero = np.zeros((*np.shape(time), 3))
    rate_b = zero.copy()
    rate_b[..., 2] = angle(time, 1)
    return TableMotion(dcm_nt @ dcm_nb_from_euler(0.0, 0.0, tau), rate_b, zero, zero)
