"""How well roll and pitch can be known at all from an IMU and an altimeter: the Cramer-Rao bound.

Along a known trajectory the errors of down direction, vertical velocity, altitude and sensor biases
are linear in the sensors' noise, and the covariance that the Riccati recursion gives *at the truth*
is the posterior Cramer-Rao bound (Tichavsky, Muravchik, Nehorai, IEEE Trans. Signal Processing
46(5), 1998): no unbiased estimator that has only these measurements does better. An estimator may
get below it by what it assumes beyond them, for instance that a body does not accelerate for long;
where the force is vertical the altimeter shows nothing of the tilt and the bound only grows.
Equations: ``docs/attitude.md``. Frames and units: :mod:`inertial`.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from inertial.parameters import check_parameters, parameter
from inertial.rotation import zoh_integrals

# Errors: down_b (3, in its tangent plane), velocity down, altitude, gyro bias (3), accelerometer bias (3).
_N = 11
_VD, _ALT, _BG, _BA = 3, 4, 5, 8
# Of no consequence after the first manoeuvre: what is known of the vertical channel at the start.
_START_VD_STD = 2.0
_START_ALTITUDE_STD = 5.0


@dataclass(frozen=True)
class SensorNoise:
    """What the bound knows of the sensors; the defaults are the paper's, without biases."""

    gyro_noise_density: float = parameter(
        math.radians(0.05), "rad/s/sqrt(Hz)", "white noise of each gyro axis", 0.0)
    accel_noise_density: float = parameter(
        0.01, "m/s^2/sqrt(Hz)", "white noise of each accelerometer axis", 0.0)
    altitude_std: float = parameter(2.0, "m", "white noise of each altitude", 1e-6)
    gyro_bias_std: float = parameter(0.0, "rad/s", "spread of the gyro bias", 0.0)
    gyro_bias_walk: float = parameter(0.0, "rad/s/sqrt(s)", "random walk of the gyro bias", 0.0)
    accel_bias_std: float = parameter(0.0, "m/s^2", "spread of the accelerometer bias", 0.0)
    accel_bias_walk: float = parameter(
        0.0, "m/s^2/sqrt(s)", "random walk of the accelerometer bias", 0.0)

    def __post_init__(self):
        check_parameters(self)

    @classmethod
    def of(cls, profile):
        """Return the noise and biases of an :class:`inertial.imu_errors.SensorProfile`.

        Scale, misalignment, resolution, delay and the altimeter's drift are left out: with them the
        true bound is higher. A Gauss-Markov bias counts as a constant that walks.
        """
        imu = profile.imu
        return cls(
            imu.gyro_noise_density, imu.accel_noise_density, profile.altimeter.noise_std,
            math.hypot(imu.gyro_bias_std, imu.gyro_drift_std),
            math.hypot(imu.gyro_walk_density, imu.gyro_drift_std * math.sqrt(2 / imu.gyro_drift_time)),
            math.hypot(imu.accel_bias_std, imu.accel_drift_std),
            math.hypot(imu.accel_walk_density, imu.accel_drift_std * math.sqrt(2 / imu.accel_drift_time)))


@dataclass(frozen=True)
class TiltBound:
    """Smallest possible standard deviations after each of N IMU samples.

    Attributes
    ----------
    stamp_ns : (N,) int64
    tilt_std : (N,), rad
        Of the angle between estimated and true down direction: the root of the variances' sum over
        the two tilt axes.
    vd_std, altitude_std : (N,), m/s and m
    gyro_bias_std, accel_bias_std : (N, 3), rad/s and m/s^2
    """

    stamp_ns: np.ndarray
    tilt_std: np.ndarray
    vd_std: np.ndarray
    altitude_std: np.ndarray
    gyro_bias_std: np.ndarray
    accel_bias_std: np.ndarray

    def tilt_rms(self, used):
        """Return the RMS of ``tilt_std`` over the samples ``used`` ((N,) bool or slice), rad."""
        return float(np.sqrt(np.mean(self.tilt_std[used] ** 2)))


def tilt_bound(imu, down_b, altitude_ns, noise, *, tilt_std=1.0):
    """Return the Cramer-Rao bound of tilt along a known trajectory.

    ``P <- F P F^T + Q`` from sample to sample, with F at the true rate and force and
    ``Q_c = sg^2 dt (I - c c^T)``, ``Q_vd = sa^2 dt``; at each altitude
    ``P <- P - P H^T H P / (H P H^T + r^2)``.

    Parameters
    ----------
    imu : ImuSeries
        What perfect sensors measure: N means over the intervals that end at the stamps.
    down_b : (N, 3)
        True down direction at the stamps.
    altitude_ns : (M,) int64, not decreasing
        When there is an altitude; those beyond the last IMU stamp do not count.
    noise : SensorNoise
    tilt_std : float, rad
        What is known of the tilt at the first sample, both axes together.

    Returns
    -------
    TiltBound

    Raises
    ------
    ValueError
        Lengths differ, or altitude stamps decrease.
    """
    down_b, altitude_ns = np.asarray(down_b, dtype=float), np.asarray(altitude_ns, dtype=np.int64)
    if down_b.shape != (len(imu), 3):
        raise ValueError(f"down_b has shape {down_b.shape}: must be ({len(imu)}, 3)")
    if np.any(np.diff(altitude_ns) < 0):
        raise ValueError("altitude_ns decreases: altitudes must be in time order")
    biases = np.repeat([noise.gyro_bias_std**2, noise.accel_bias_std**2], 3)
    P = np.diag([0.0, 0.0, 0.0, _START_VD_STD**2, _START_ALTITUDE_STD**2, *biases])
    P[:3, :3] = 0.5 * tilt_std**2 * (np.eye(3) - np.outer(down_b[0], down_b[0]))
    densities = np.array([noise.gyro_noise_density, noise.accel_noise_density,
                          noise.gyro_bias_walk, noise.accel_bias_walk])
    variances = _riccati(P, imu.stamp_ns, imu.gyro_b, imu.accel_b, down_b, altitude_ns,
                         densities**2, noise.altitude_std**2)
    std = np.sqrt(np.maximum(variances, 0.0))
    return TiltBound(imu.stamp_ns, np.sqrt(variances[:, :3].sum(axis=1)), std[:, _VD], std[:, _ALT],
                     std[:, _BG:_BA], std[:, _BA:])


@njit(cache=True)
def _riccati(P, stamp_ns, gyro_b, accel_b, down_b, altitude_ns, densities2, altitude_var):
    """Run the recursion in P and return its diagonal after each sample, (N, 11)."""
    variances = np.empty((len(stamp_ns), _N))
    F = np.eye(_N)
    scratch = np.empty((_N, _N))
    j = 0
    for k in range(len(stamp_ns)):
        if k > 0:
            dt = (stamp_ns[k] - stamp_ns[k - 1]) * 1e-9
            _fill_transition(F, gyro_b[k], accel_b[k], down_b[k], dt)
            _multiply_transposed(F, P, scratch)
            _multiply_transposed(F, scratch, P)
            _add_noise(P, down_b[k], dt, densities2)
        while j < len(altitude_ns) and altitude_ns[j] <= stamp_ns[k]:
            _update(P, (stamp_ns[k] - altitude_ns[j]) * 1e-9, altitude_var)
            j += 1
        for i in range(_N):
            variances[k, i] = P[i, i]
    return variances


@njit(cache=True)
def _fill_transition(F, gyro_b, accel_b, down_b, dt):
    """Fill the transition of the errors over dt; down_b is that at its end."""
    R, J1, J2 = zoh_integrals(gyro_b, dt)
    for i in range(3):
        F[_VD, i] = J1[i, 0] * accel_b[0] + J1[i, 1] * accel_b[1] + J1[i, 2] * accel_b[2]
        F[_ALT, i] = -(J2[i, 0] * accel_b[0] + J2[i, 1] * accel_b[1] + J2[i, 2] * accel_b[2])
        F[_VD, _BA + i] = -dt * down_b[i]
        for j in range(3):
            F[i, j] = R[j, i]
    F[_ALT, _VD] = -dt
    F[0, _BG + 1], F[0, _BG + 2] = dt * down_b[2], -dt * down_b[1]
    F[1, _BG], F[1, _BG + 2] = -dt * down_b[2], dt * down_b[0]
    F[2, _BG], F[2, _BG + 1] = dt * down_b[1], -dt * down_b[0]


@njit(cache=True)
def _multiply_transposed(F, m, out):
    """Write ``(F m)^T`` into ``out``; twice, with symmetric m, it is ``F m F^T``."""
    for i in range(_N):
        for j in range(_N):
            out[j, i] = 0.0
        for k in range(_N):
            if F[i, k] != 0.0:
                for j in range(_N):
                    out[j, i] += F[i, k] * m[k, j]


@njit(cache=True)
def _add_noise(P, down_b, dt, densities2):
    """Add what the sensors' noise brings over dt: a turn of the down direction, a vertical velocity."""
    for i in range(3):
        for j in range(3):
            P[i, j] -= dt * densities2[0] * down_b[i] * down_b[j]
        P[i, i] += dt * densities2[0]
        P[_BG + i, _BG + i] += dt * densities2[2]
        P[_BA + i, _BA + i] += dt * densities2[3]
    P[_VD, _VD] += dt * densities2[1]


@njit(cache=True)
def _update(P, age, altitude_var):
    """Take in an altitude that was valid ``age`` s ago, ``altitude + age vd``."""
    PH = P[:, _ALT] + age * P[:, _VD]
    variance = PH[_ALT] + age * PH[_VD] + altitude_var
    for i in range(_N):
        for j in range(_N):
            P[i, j] -= PH[i] * PH[j] / variance
