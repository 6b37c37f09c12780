"""Recordings of a vehicle at rest and runs of the standing alignment over them, many at a time.

What :mod:`studies.ins_alignment` counts with. Sensors have a constant bias and white noise alone where the
Cramer-Rao bound is to be met, all errors of a grade where the product is on trial. The velocity of the strapdown
is measured with white noise of sigma_R, as paper 002's equation 1 has it. Angles in rad, time in s.
"""

import itertools
import math
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit

from alignment.standing import _kernels as kernels
from alignment.standing.aligner import StandingAligner
from alignment.standing.coarse import UNKNOWN_HEADING_STD
from alignment.standing.filters import (
    GROUP_FILTERS,
    Filter,
    FilterHistory,
    heading_covariance,
    run_filter,
    sample_intervals,
)
from alignment.standing.params import StandingParams
from inertial.earth import STANDARD_GRAVITY, earth_rate_n, normal_gravity
from inertial.imu_errors import ImuErrors, apply_imu_errors
from inertial.parked_scenarios import GRADES as PARKED_GRADES
from inertial.parked_scenarios import simulate_parked
from inertial.recording import AttitudeSeries, ImuSeries
from inertial.rotation import (
    dcm_from_quaternion,
    dcm_nb_from_euler,
    euler_from_dcm,
    quaternion_exp,
    quaternion_from_dcm,
    quaternion_multiply,
)
from inertial.table_scenarios import HEADING, LATITUDE, PITCH, ROLL

DEG = math.pi / 180
ARCMINUTE = DEG / 60
DEG_PER_HOUR = DEG / 3600
RATE = 100.0  # Hz, the paper's
ACCURACY = 85 * ARCMINUTE  # a heading is there when it stays within it
TILT_STD = 1.0 * DEG  # of the first attitude
LEAST = 1e-12  # of a noise density that should be zero


def plain(errors, **changes):
    """Return the constant biases and the white noise of a sensor's errors, nothing else."""
    kept = {name: getattr(errors, name) for name in ("gyro_noise_density", "gyro_bias_std", "accel_noise_density",
                                                     "accel_bias_std")}
    return ImuErrors(**{**kept, **changes})


_ADIS = PARKED_GRADES["adis"].errors
GRADES = {
    "perfect": ImuErrors(),
    "navigation": plain(PARKED_GRADES["navigation"].errors),
    "tactical": plain(PARKED_GRADES["tactical"].errors),
    "ADIS in-run": plain(_ADIS, gyro_bias_std=5.1 * DEG_PER_HOUR, accel_bias_std=0.07e-3 * STANDARD_GRAVITY),
    "ADIS noise only": plain(_ADIS, gyro_bias_std=0.0, accel_bias_std=0.0),
    "ADIS turn-on": plain(_ADIS),
}
"""Name -> sensor errors; of the ADIS16488A its in-run biases, none, or those of a turn-on."""


def told(errors, **settings):
    """Return StandingParams that know the sensors as they are."""
    known = {"gyro_noise_density": max(errors.gyro_noise_density, LEAST), "gyro_bias_std": errors.gyro_bias_std,
             "gyro_bias_instability": errors.gyro_bias_instability,
             "accel_noise_density": max(errors.accel_noise_density, LEAST), "accel_bias_std": errors.accel_bias_std,
             "accel_bias_instability": errors.accel_bias_instability, "scale_std": errors.gyro_scale_std}
    return StandingParams(latitude=LATITUDE, latitude_std=0.0, **{**known, **settings})


def as_the_paper(errors, noise_std, **settings):
    """Return StandingParams of the paper's set-up: a velocity at every sample, no robustness."""
    return told(errors, zero_velocity_std=noise_std, zero_velocity_period=1 / RATE, robust=False, adaptive=False,
                **settings)


# --- recordings ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stand:
    """What perfect sensors read, and the true attitude."""

    imu: ImuSeries
    truth: AttitudeSeries

    def heading(self, stamp_ns):
        """Return the true heading at stamps (K,)."""
        heading = np.unwrap(euler_from_dcm(dcm_from_quaternion(self.truth.q_nb_wxyz))[2])
        return np.interp(stamp_ns, self.truth.stamp_ns, heading)


def stand_still(duration):
    """Return a vehicle that does not move at all."""
    count = round(duration * RATE)
    dcm_nb = dcm_nb_from_euler(ROLL, PITCH, HEADING)
    force_n = np.array([0.0, 0.0, -normal_gravity(LATITUDE)])
    stamp_ns = np.arange(1, count + 1) * round(1e9 / RATE)
    imu = ImuSeries(stamp_ns, np.tile(dcm_nb.T @ earth_rate_n(LATITUDE), (count, 1)),
                    np.tile(dcm_nb.T @ force_n, (count, 1)))
    return Stand(imu, AttitudeSeries(stamp_ns[[0, -1]], np.tile(quaternion_from_dcm(dcm_nb), (2, 1))))


def stand(scheme, duration, **settings):
    """Return a parked vehicle of :mod:`inertial.parked_scenarios` with perfect sensors."""
    name = "parked_perfect" + (f"_{scheme}" if scheme != "static" else "")
    recording = simulate_parked(name, duration=duration, **settings)
    return Stand(recording.imu, recording.truth)


def add_biases_and_noise(imu, errors, rng):
    """Return the readings of sensors with constant biases and white noise, as ``apply_imu_errors`` but faster."""
    root_interval = math.sqrt(np.median(np.diff(imu.stamp_ns)) * 1e-9)
    readings = [reading + bias_std * rng.standard_normal(3)
                + density / root_interval * rng.standard_normal(reading.shape)
                for reading, bias_std, density in (
                    (imu.gyro_b, errors.gyro_bias_std, errors.gyro_noise_density),
                    (imu.accel_b, errors.accel_bias_std, errors.accel_noise_density))]
    return ImuSeries(imu.stamp_ns, *readings)


# --- filters ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FilterRun:
    """A filter over a recording.

    Attributes
    ----------
    t : (K,), s
    error, std : (K,), rad
        Of the heading: the error, and what the filter says of it.
    cost : (K,)
        J* of the IPEKF.
    model_error : (K, 5)
        What the IPEKF holds for the error of the model's rates.
    """

    t: np.ndarray
    error: np.ndarray
    std: np.ndarray
    cost: np.ndarray
    model_error: np.ndarray

    @property
    def settled(self):
        """Seconds from which on the heading stays within ACCURACY; inf for never."""
        return _last(np.abs(self.error) > ACCURACY, self.t)

    @property
    def trusted(self):
        """Seconds from which on the filter itself says so."""
        return _last(self.std > ACCURACY, self.t)

    def late(self):
        """Return the error's mean square over the second half, rad^2, and the mean of (error / std)^2 there."""
        half = self.t > 0.5 * self.t[-1]
        return np.array([np.mean(self.error[half] ** 2), np.mean((self.error[half] / self.std[half]) ** 2)])


def _last(outside, t):
    if not outside.any():
        return 0.0
    last = np.flatnonzero(outside)[-1]
    return float(t[last + 1]) if last + 1 < len(t) else math.inf


def wrap(angle):
    """Return angles in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def wrong_start(q_nb_wxyz, heading_error, rng=None):
    """Return an attitude that is wrong by so much in heading, and by TILT_STD in tilt if there is a generator."""
    phi = np.zeros(3) if rng is None else TILT_STD * rng.standard_normal(3)
    phi[2] = heading_error
    return quaternion_multiply(quaternion_exp(phi), q_nb_wxyz)


def run(name, stand, imu, params, start, heading_std, velocity_noise=None, period=0.1):
    """Run a filter from a wrong attitude and compare it with the truth.

    Parameters
    ----------
    name : str
    stand : Stand
    imu : ImuSeries
        Its readings.
    params : StandingParams
    start : (4,)
        First attitude.
    heading_std : float, rad
        That the filter is told of it.
    velocity_noise : (N, 2), m/s, optional
        Noise of the measured velocity; for the filters of the error model.
    period : float, s
        Between rows.
    """
    P0 = heading_covariance(heading_std, TILT_STD)
    if name in GROUP_FILTERS or velocity_noise is None:
        history = run_filter(name, imu, start, P0, params, period)
        model_error = np.full((len(history), 5), np.nan)
    else:
        history, model_error = _run_noisy(name, imu, start, P0, params, velocity_noise, period)
    error = wrap(history.heading - stand.heading(history.stamp_ns))
    t = (history.stamp_ns - imu.stamp_ns[0]) * 1e-9 + 1 / RATE
    return FilterRun(t, error, history.heading_std, history.cost, model_error)


def _run_noisy(name, imu, start, P0, params, velocity_noise, period):
    state = Filter(name, params, start, P0)
    every = round(period * RATE)
    rows = np.empty((len(imu) // every, kernels.OUT_SIZE))
    model_error = np.empty((len(rows), 5))
    _run_samples(state.model, state.constants, state.R, state.m, state.P, state.q, state.ipa,
                 sample_intervals(imu.stamp_ns), imu.gyro_b, imu.accel_b, velocity_noise, every, rows, model_error)
    return FilterHistory(imu.stamp_ns[every - 1::every][:len(rows)], rows), model_error


@njit  # not cached: a cache does not see a change in the kernels' own file
def _run_samples(model, c, R, m, P, q, ipa, dt, gyro_b, accel_b, noise, every, rows, model_error):
    """Run a filter of the error model with noise on the strapdown's velocity, just while it is measured."""
    none = np.empty((0, rows.shape[1]))
    velocity = m[kernels.M_V:kernels.M_V + 2]
    for k in range(len(dt)):
        velocity += noise[k]
        kernels.run_error_model(model, c, R, m, P, q, ipa, dt[k:k + 1], gyro_b[k:k + 1], accel_b[k:k + 1], True, 1,
                                none)
        velocity -= noise[k]
        if (k + 1) % every == 0:
            row = (k + 1) // every - 1
            kernels.error_model_row(model, R, m, P, q, rows[row])
            model_error[row] = m[kernels.M_ERROR:kernels.M_ERROR + 5]


# --- the product's own chain --------------------------------------------------------------------------


@dataclass(frozen=True)
class ChainRun:
    """The whole alignment over a recording.

    Attributes
    ----------
    t : (K,), s
    error, std : (K,), rad
        Of the heading; NaN as long as none may be believed.
    aligned : (K,) bool
        Whether it said ALIGNED.
    """

    t: np.ndarray
    error: np.ndarray
    std: np.ndarray
    aligned: np.ndarray

    @property
    def final(self):
        """The last error and spread, (2,), rad."""
        return np.array([self.error[-1], self.std[-1]])


def run_chain(stand, imu, params, period=10.0):
    """Run the alignment over readings; a row after each period."""
    aligner = StandingAligner(params)
    samples = round(period * 1e9 / np.median(np.diff(imu.stamp_ns)))
    ends = range(samples, len(imu) + 1, samples)
    rows = np.full((len(ends), 3), np.nan)
    for row, end in zip(rows, ends, strict=True):
        part = slice(end - samples, end)
        aligner.run(ImuSeries(imu.stamp_ns[part], imu.gyro_b[part], imu.accel_b[part]), period)
        if not aligner.refusal:
            result = aligner.result
            truth = stand.heading(np.array([result.stamp_ns]))[0]
            row[:] = wrap(result.heading - truth), result.heading_std, aligner.phase == "aligned"
    t = (imu.stamp_ns[samples - 1::samples] - imu.stamp_ns[0]) * 1e-9
    return ChainRun(t[:len(rows)], rows[:, 0], rows[:, 1], rows[:, 2] == 1)


def chain_job(stand, errors, params, seed, period=10.0):
    """Return the alignment of one set of biases and noise."""
    return run_chain(stand, add_biases_and_noise(stand.imu, errors, np.random.default_rng(seed)), params, period)


def parked_job(grades, motion, seeds, duration, heading, disturbance=1.0, rate=50.0):
    """Return the alignments of several sets of sensors with all errors of a grade in one swaying vehicle.

    Returns
    -------
    dict
        Grade -> list of (ChainRun, (float, float)), with the error and spread of riekf6, started with a heading
        anywhere.
    """
    swaying = stand("static", duration, seed=motion, heading=heading, disturbance=disturbance, imu_rate=rate)
    found = {grade: [] for grade in grades}
    for grade, seed in itertools.product(grades, seeds):
        rng = np.random.default_rng([seed, motion])
        params = told(PARKED_GRADES[grade].errors)
        imu = apply_imu_errors(swaying.imu, PARKED_GRADES[grade].errors, rng).imu
        start = wrong_start(swaying.truth.q_nb_wxyz[0], rng.uniform(-math.pi, math.pi), rng)
        blind = run("riekf6", swaying, imu, params, start, UNKNOWN_HEADING_STD, period=10.0)
        found[grade].append((run_chain(swaying, imu, params), (blind.error[-1], blind.std[-1])))
    return found


# --- many at a time -----------------------------------------------------------------------------------


def each(function, jobs, workers):
    """Return ``function(*job)`` of every job, in order, by so many processes."""
    if workers <= 1 or len(jobs) < 2:
        return [function(*job) for job in jobs]
    with ProcessPoolExecutor(workers) as pool:
        return list(pool.map(function, *zip(*jobs, strict=True)))


def root_mean(values):
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def interval(mean_square, count):
    """Return the 95 % interval of the mean square of so many independent normal values (Wilson and Hilferty)."""
    part = 2 / (9 * count)
    # One value alone leaves the approximation's range: 0.1 is right for it.
    return tuple(mean_square / max(1 - part + z * math.sqrt(part), 0.1) ** 3 for z in (1.96, -1.96))
