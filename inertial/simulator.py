"""Simulated recordings: exact truth from a named motion, sensors with chosen errors.

:func:`simulate` does it in one call. For many noise draws of one motion, :func:`sample_trajectory`
is called once and :func:`add_errors` as often as wanted.

Without a latitude the Earth is flat and does not rotate. With one, gravity is WGS84 normal gravity
there, the gyro also sees Earth and transport rate, and the accelerometer the Coriolis term.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from inertial.earth import STANDARD_GRAVITY, earth_rate_n, normal_gravity, transport_rate_n
from inertial.imu_errors import apply_altimeter_errors, apply_imu_errors, find_profile
from inertial.recording import AltitudeSeries, AttitudeSeries, ImuSeries, Recording
from inertial.rotation import quaternion_from_dcm
from inertial.scenarios import find_scenario

# 2023-11-14: an epoch of today's size, so that nanoseconds lost to floats show.
_START_NS = 1_700_000_000_000_000_000
# Three Gauss-Legendre nodes in panels of at most 10 ms: tested to be far below any sensor's noise.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)
_PANEL = 0.01
# IMU intervals integrated at a time, which bounds the memory of long simulations.
_BLOCK = 10_000


@dataclass(frozen=True)
class Trajectory:
    """A motion over the Earth.

    Attributes
    ----------
    name : str
    duration : float, s
    motion : callable
        Times (...) in s to :class:`inertial.trajectory.Motion`.
    gravity : float, m/s^2
    latitude : float or None, rad
        None: flat Earth without rotation.
    """

    name: str
    duration: float
    motion: Callable
    gravity: float
    latitude: float | None = None

    def at(self, t):
        """Return the :class:`inertial.trajectory.Motion` at times (...)."""
        return self.motion(np.asarray(t, dtype=float))

    def sensed(self, motion):
        """Return the ``(gyro_b, accel_b)`` of perfect sensors in a state of motion, (..., 3)."""
        dcm_bn = np.swapaxes(motion.dcm_nb, -1, -2)
        force_n = motion.acceleration_n - [0.0, 0.0, self.gravity]
        if self.latitude is None:
            return motion.rate_b, _rotate(dcm_bn, force_n)
        earth_n = earth_rate_n(self.latitude)
        frame_rate_n = earth_n + transport_rate_n(self.latitude, 0.0, motion.velocity_n)
        coriolis_n = np.cross(earth_n + frame_rate_n, motion.velocity_n)
        return (motion.rate_b + _rotate(dcm_bn, frame_rate_n),
                _rotate(dcm_bn, force_n + coriolis_n))


@dataclass(frozen=True)
class SampledTrajectory:
    """What perfect sensors and a perfect observer record of a trajectory.

    Attributes
    ----------
    name : str
    imu : ImuSeries
        N samples, each the mean over the interval that ends at its stamp.
    truth : AttitudeSeries
        At the same stamps.
    velocity_n, position_n : (N, 3), m/s and m
        At the same stamps; the position begins at zero.
    gravity : float, m/s^2
    """

    name: str
    imu: ImuSeries
    truth: AttitudeSeries
    velocity_n: np.ndarray
    position_n: np.ndarray
    gravity: float


@dataclass(frozen=True, kw_only=True)
class SimulatedRecording(Recording):
    """A recording with everything that is known about it.

    Attributes
    ----------
    gyro_bias_b, accel_bias_b : (N, 3), rad/s and m/s^2
        The true bias in each IMU sample.
    velocity_n, position_n : (K, 3), m/s and m
        At the stamps of ``truth``, which also has the samples that the IMU lost.
    gravity : float, m/s^2
    """

    gyro_bias_b: np.ndarray
    accel_bias_b: np.ndarray
    velocity_n: np.ndarray
    position_n: np.ndarray
    gravity: float


def simulate(scenario, *, duration=120.0, imu_rate=200.0, altimeter_rate=20.0, profile="consumer",
             imu_errors=None, altimeter_errors=None, seed=0, rest=3.0, latitude=None):
    """Return a simulated recording; the same arguments give the same bytes.

    Parameters
    ----------
    scenario : str
        A name in :data:`inertial.scenarios.SCENARIOS`.
    duration : float, s
    imu_rate, altimeter_rate : float, Hz
    profile : str
        A name in :data:`inertial.imu_errors.PROFILES`.
    imu_errors : ImuErrors, optional
    altimeter_errors : AltimeterErrors, optional
        In place of the profile's.
    seed : int
    rest : float, s
        Standing still before the motion starts.
    latitude : float or None, rad
        None: flat Earth without rotation, gravity 9.80665 m/s^2.

    Returns
    -------
    SimulatedRecording

    Raises
    ------
    ValueError
        Unknown names, or figures out of range.
    """
    sensors = find_profile(profile)
    trajectory = make_trajectory(scenario, duration=duration, rest=rest, latitude=latitude)
    return add_errors(sample_trajectory(trajectory, imu_rate=imu_rate),
                      sensors.imu if imu_errors is None else imu_errors,
                      sensors.altimeter if altimeter_errors is None else altimeter_errors,
                      np.random.default_rng(seed), altimeter_rate=altimeter_rate)


def make_trajectory(scenario, *, duration=120.0, rest=3.0, latitude=None):
    """Return the :class:`Trajectory` of a named scenario; parameters as in :func:`simulate`."""
    motion = find_scenario(scenario).motion
    _check_positive("duration", duration, "s")
    if not 0 <= rest < np.inf:
        raise ValueError(f"rest = {rest} s: must not be negative")
    if latitude is not None and not abs(latitude) <= np.pi / 2:
        raise ValueError(f"latitude = {latitude} rad: must be from -pi/2 to pi/2")
    gravity = STANDARD_GRAVITY if latitude is None else float(normal_gravity(latitude))
    return Trajectory(scenario, duration, motion(duration, rest, gravity), gravity, latitude)


def sample_trajectory(trajectory, *, imu_rate=200.0):
    """Return perfect samples of a trajectory.

    Parameters
    ----------
    trajectory : Trajectory
    imu_rate : float, Hz

    Returns
    -------
    SampledTrajectory
        ``duration * imu_rate`` samples, at least two.
    """
    stamp_ns = _regular_stamps(trajectory.duration, imu_rate, "imu_rate")
    t = (stamp_ns - _START_NS) * 1e-9
    starts = np.concatenate([[-1.0 / imu_rate], t[:-1]])
    blocks = [_sample_block(trajectory, starts[k:k + _BLOCK], t[k:k + _BLOCK])
              for k in range(0, len(t), _BLOCK)]
    gyro_b, accel_b, q_nb_wxyz, velocity_n, step_n = map(np.concatenate, zip(*blocks, strict=True))
    return SampledTrajectory(trajectory.name, ImuSeries(stamp_ns, gyro_b, accel_b),
                             AttitudeSeries(stamp_ns, q_nb_wxyz), velocity_n,
                             np.cumsum(step_n, axis=0), trajectory.gravity)


def add_errors(sampled, imu_errors, altimeter_errors, rng, *, altimeter_rate=20.0):
    """Return a sampled trajectory as sensors with errors would record it.

    Parameters
    ----------
    sampled : SampledTrajectory
    imu_errors : ImuErrors
    altimeter_errors : AltimeterErrors
    rng : numpy.random.Generator
    altimeter_rate : float, Hz

    Returns
    -------
    SimulatedRecording
    """
    measured = apply_imu_errors(sampled.imu, imu_errors, rng)
    truth_ns = sampled.truth.stamp_ns
    duration = (truth_ns[-1] - truth_ns[0]) * 1e-9
    altimeter_ns = _regular_stamps(duration, altimeter_rate, "altimeter_rate")
    t = (altimeter_ns - truth_ns[0]) * 1e-9 - altimeter_errors.delay
    altitude = _interpolate_cubic(t, (truth_ns - truth_ns[0]) * 1e-9, -sampled.position_n[:, 2],
                                  -sampled.velocity_n[:, 2])
    altimeter_ns, altitude = apply_altimeter_errors(altimeter_ns, altitude, altimeter_errors, rng)
    arrival = np.searchsorted(measured.imu.stamp_ns, altimeter_ns, side="right")
    return SimulatedRecording(
        sampled.name, measured.imu, AltitudeSeries(altimeter_ns, altitude, arrival), sampled.truth,
        gyro_bias_b=measured.gyro_bias_b, accel_bias_b=measured.accel_bias_b,
        velocity_n=sampled.velocity_n, position_n=sampled.position_n, gravity=sampled.gravity)


def _sample_block(trajectory, starts, ends):
    """Return mean gyro_b and accel_b, then at the ends q_nb_wxyz, velocity_n, the step of position."""
    length = ends - starts
    panels = int(np.ceil(length.max() / _PANEL))
    shares = ((np.arange(panels)[:, None] + 0.5 * (1 + _NODES)) / panels).ravel()
    weights = np.tile(0.5 * _WEIGHTS / panels, panels)
    motion = trajectory.at(starts[:, None] + length[:, None] * shares)
    gyro_b, accel_b, mean_velocity_n = (
        np.einsum("k,nki->ni", weights, values)
        for values in (*trajectory.sensed(motion), motion.velocity_n))
    at_end = trajectory.at(ends)
    return (gyro_b, accel_b, quaternion_from_dcm(at_end.dcm_nb), at_end.velocity_n,
            mean_velocity_n * length[:, None])


def _regular_stamps(duration, rate, name):
    _check_positive(name, rate, "Hz")
    count = max(2, round(duration * rate))
    return _START_NS + np.rint(np.arange(count) * (1e9 / rate)).astype(np.int64)


def _interpolate_cubic(t, knots, values, slopes):
    """Return the cubic Hermite interpolation; constant outside the knots."""
    t = np.clip(t, knots[0], knots[-1])
    k = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
    length = knots[k + 1] - knots[k]
    u = (t - knots[k]) / length
    return (values[k] * (1 + 2 * u) * (1 - u) ** 2 + values[k + 1] * u ** 2 * (3 - 2 * u)
            + length * (slopes[k] * u * (1 - u) ** 2 - slopes[k + 1] * u ** 2 * (1 - u)))


def _check_positive(name, value, unit):
    if not 0 < value < np.inf:
        raise ValueError(f"{name} = {value} {unit}: must be positive")


def _rotate(dcm, vector):
    return np.einsum("...ij,...j->...i", dcm, vector)
