"""Paper 001's two Kalman filters beside the 15-state error-state filter, with every acceptance figure.

``study_two_filters`` writes docs/results/two_filters.md and its plots; every figure in it is computed here, from fixed
seeds. "The paper" estimates a helicopter's state by a filter of attitude and gyro bias, and one of position and
velocity (in Persian); its equations as they are used stand in ``attitude_estimator/navigation/_kernels.py``.
"""

import argparse
import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit

from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.navigation import _kernels as kernels
from attitude_estimator.navigation.estimator import NavigationEstimator
from attitude_estimator.navigation.params import STEADY_GAIN_LIMIT, NavigationParams
from inertial.earth import STANDARD_GRAVITY
from inertial.imu_errors import PROFILES
from inertial.rotation import (
    dcm_from_quaternion,
    down_from_quaternion,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
    skew,
)
from inertial.scoring import score_attitude
from inertial.simulator import simulate
from nav_ros.bags import read_recording
from studies import head_commit
from studies.north_finding import table
from studies.recordings import family_of, recordings_folder
from studies.timing import times_in_turn

DEG = np.pi / 180
SEED = 1001
RATES = (0.0, 1e-6, 0.01, 0.3, 1.0, 2.9, 3.1, 10.0, 30.0)  # rad/s
CLOSED_FORM_LIMIT = 1e-12
ANEES_LIMITS = (5.2, 6.9)

INTERVAL = 0.02  # s, of the gyro
AIDING_EVERY = 5  # steps: 10 Hz
DURATION = 120.0  # s
INCLINOMETER_STD = 1.0 * DEG
GYRO_DENSITY, WALK_DENSITY = 0.005 * DEG, 0.0001 * DEG  # rad/s/sqrt(Hz), rad/s/sqrt(s)
START_STD, BIAS_START_STD = 20.0 * DEG, 1.0 * DEG  # rad, rad/s, each axis
TILT_LIMIT, BIAS_LIMIT, EARLY_BIAS_LIMIT = 0.12, 0.02, 0.1  # deg, deg/s, deg/s after 10 s

CASCADE_LIMITS = {"tilt, deg": 0.5, "position, m": 0.45, "velocity, m/s": 0.15}
ESKF_TILT_LIMIT = 0.1  # deg
FLIGHT = "quad"
SENSORS = PROFILES["mti300"].imu
ALIGNED = dataclasses.replace(SENSORS, gyro_misalignment_std=0.0)
POSITION_STD, VELOCITY_STD = 1.0, 0.1  # m, m/s
SETTLED = 40.0  # s
SLOW_TIME = 60.0  # s, of a fix's slow error
RECORDING_RATIO_LIMIT = 1.1
STEP_LIMIT = 2.0  # us
LONGEST = 20_000  # samples of each recording


def verdict(good):
    """Return in a word whether a limit is kept."""
    return "held" if good else "**not held**"


# --- closed forms -------------------------------------------------------------------------------------


def closed_form_error(rate, dt):
    """Return the largest relative difference of Theta, Psi, Q11, Q12 from Gauss-Legendre quadrature."""
    w = rate * np.array([0.48, -0.6, 0.64])
    nodes, weights = np.polynomial.legendre.leggauss(24)
    share, weights = 0.5 * (1 + nodes), 0.5 * weights

    def theta(t):
        return dcm_from_quaternion(quaternion_exp(-w * np.asarray(t)[..., None]))

    def psi(t):
        return t * np.einsum("k,kij->ij", weights, theta(t * share))

    psis = np.array([psi(dt * part) for part in share])
    exact = (theta(dt), psi(dt),
             GYRO_DENSITY**2 * dt * np.eye(3) + WALK_DENSITY**2 * dt * np.einsum("k,kij,klj->il", weights, psis, psis),
             -WALK_DENSITY**2 * dt * np.einsum("k,kij->ij", weights, psis))
    closed = [np.empty((3, 3)) for _ in exact]
    kernels.attitude_model(w, dt, GYRO_DENSITY, WALK_DENSITY, *closed)
    return max(np.abs(ours - value).max() / np.abs(value).max() for ours, value in zip(closed, exact, strict=True))


def closed_form_section():
    """Return how near Phi and Qd are to their integrals."""
    rows = [(f"{rate:g}", *(f"{closed_form_error(rate, dt):.1e}" for dt in (0.001, 0.01, 0.1))) for rate in RATES]
    worst = max(closed_form_error(rate, dt) for rate in RATES for dt in (0.001, 0.01, 0.1))
    return ["## Transition and noise in closed form", "",
            "Theta, Psi, Q11 and Q12 (equations 19 to 22, put right) against quadrature: largest difference relative "
            f"to the matrix's largest element. Worst {worst:.1e}, limit {CLOSED_FORM_LIMIT:g}: "
            f"{verdict(worst <= CLOSED_FORM_LIMIT)}.",
            *table(("rate, rad/s", "dt 1 ms", "dt 10 ms", "dt 100 ms"), rows)]


# --- attitude and gyro bias ---------------------------------------------------------------------------


@dataclass(frozen=True)
class MekfRuns:
    """Errors (runs, times, 6) of attitude (navigation axes, rad) and bias (rad/s), their NEES, times s."""

    time: np.ndarray
    error: np.ndarray
    nees: np.ndarray

    def late(self):
        """Return which times are of the second half."""
        return self.time > 0.5 * self.time[-1]

    def anees(self):
        """Return the mean NEES of the second half; ideally 6."""
        return float(self.nees[:, self.late()].mean())


def mekf_runs(runs, heading, frame="navigation", seed=SEED, duration=DURATION):
    """Run the filter of attitude and gyro bias from a wrong start.

    Parameters
    ----------
    runs : int
    heading : bool
        Whether a heading of 1 deg aids it at 10 Hz, beside the inclinometer.
    frame : str
        "navigation" or "body": axes of the attitude error.
    """
    world = _simulate(runs, round(duration / INTERVAL), np.random.default_rng(seed))
    run_filter = _body_run if frame == "body" else _navigation_run
    found = [run_filter(World(*(part[run] for part in world)), heading) for run in range(runs)]
    q_hat, bias_hat, P = (np.array(part) for part in zip(*found, strict=True))
    q, bias = world.q[:, AIDING_EVERY - 1::AIDING_EVERY], world.bias[:, AIDING_EVERY - 1::AIDING_EVERY]
    turned = quaternion_log(quaternion_multiply(q, quaternion_conjugate(q_hat)))
    error = np.concatenate([turned, bias - bias_hat], axis=-1)
    seen = error.copy()
    if frame == "body":
        seen[..., :3] = np.einsum("...ji,...j->...i", dcm_from_quaternion(q_hat), turned)
    nees = np.sum(seen * np.linalg.solve(P, seen[..., None])[..., 0], axis=-1)
    return MekfRuns(INTERVAL * AIDING_EVERY * np.arange(1, q.shape[1] + 1), error, nees)


class World(NamedTuple):
    """Truth and readings of the runs, and the wrong start of each."""

    q: np.ndarray
    bias: np.ndarray
    gyro_b: np.ndarray
    down_b: np.ndarray
    heading: np.ndarray
    q_start: np.ndarray


def _simulate(runs, steps, rng):
    phase = 2 * np.pi * rng.random((runs, 1, 3))
    time = INTERVAL * np.arange(steps)[:, None]
    rate_b = np.array([0.9, 0.7, 0.5]) * np.sin(time * [0.9, 0.7, 0.5] + phase)
    turn = quaternion_exp(rate_b * INTERVAL)
    q_now = quaternion_exp(np.array([0.2, -0.1, 1.0]) * rng.standard_normal((runs, 3)))
    q_start = quaternion_multiply(quaternion_exp(START_STD * rng.standard_normal((runs, 3))), q_now)
    q = np.empty((runs, steps, 4))
    for k in range(steps):
        q[:, k] = q_now = quaternion_multiply(q_now, turn[:, k])
    walk = WALK_DENSITY * INTERVAL**0.5 * rng.standard_normal((runs, steps, 3))
    bias = BIAS_START_STD * rng.standard_normal((runs, 1, 3)) + np.cumsum(walk, axis=1)
    gyro_b = rate_b + bias + GYRO_DENSITY / INTERVAL**0.5 * rng.standard_normal((runs, steps, 3))
    dcm_nb = dcm_from_quaternion(q)
    down_b = dcm_nb[..., 2, :] + INCLINOMETER_STD * rng.standard_normal((runs, steps, 3))
    heading = np.arctan2(dcm_nb[..., 1, 0], dcm_nb[..., 0, 0]) + INCLINOMETER_STD * rng.standard_normal((runs, steps))
    return World(q, bias, gyro_b, down_b, heading, q_start)


def _start():
    return np.zeros(3), np.diag(np.repeat([START_STD**2, BIAS_START_STD**2], 3))


def _navigation_run(world, heading):
    """Return attitude, bias and covariance of the product's filter after each aiding."""
    q = world.q_start.copy()
    (bias, P), found = _start(), []
    down_n, R = np.array([0.0, 0.0, 1.0]), INCLINOMETER_STD**2 * np.eye(3)
    for k, gyro_b in enumerate(world.gyro_b):
        kernels.mekf_predict(q, P, gyro_b - bias, INTERVAL, GYRO_DENSITY, WALK_DENSITY)
        if (k + 1) % AIDING_EVERY == 0:
            kernels.mekf_vector_update(q, bias, P, world.down_b[k], down_n, R, np.inf)
            if heading:
                kernels.mekf_heading_update(q, bias, P, world.heading[k], INCLINOMETER_STD**2, np.inf)
            found.append((q.copy(), bias.copy(), P.copy()))
    return tuple(zip(*found, strict=True))


def _body_run(world, _):
    """Return the same of the filter as the paper prints it, without a heading."""
    q, (bias, P), found = world.q_start, _start(), []
    for k, gyro_b in enumerate(world.gyro_b):
        q, P = _body_predict(q, P, gyro_b - bias)
        if (k + 1) % AIDING_EVERY == 0:
            q, bias, P = _body_update(q, bias, P, world.down_b[k], INCLINOMETER_STD**2 * np.eye(3))
            found.append((q, bias, P))
    return tuple(zip(*found, strict=True))


def _body_predict(q, P, w):
    """Carry the filter as the paper prints it: attitude error in body axes."""
    theta, psi, q11, q12 = (np.empty((3, 3)) for _ in range(4))
    kernels.attitude_model(w, INTERVAL, GYRO_DENSITY, WALK_DENSITY, theta, psi, q11, q12)
    Phi = np.block([[theta, -psi], [np.zeros((3, 3)), np.eye(3)]])
    Qd = np.block([[q11, q12], [q12.T, WALK_DENSITY**2 * INTERVAL * np.eye(3)]])
    return quaternion_multiply(q, quaternion_exp(w * INTERVAL)), Phi @ P @ Phi.T + Qd


def _body_update(q, bias, P, measured_b, R):
    down_b = down_from_quaternion(q)
    H = np.hstack([skew(down_b), np.zeros((3, 3))])
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    dx, A = K @ (measured_b - down_b), np.eye(6) - K @ H
    return quaternion_multiply(q, quaternion_exp(dx[:3])), bias + dx[3:], A @ P @ A.T + K @ R @ K.T


def consistency_section(runs, plots):
    """Return ANEES with and without heading, in navigation and body axes, and the errors of the tilt-only case."""
    cases = {"inclinometer and heading": mekf_runs(runs, True), "inclinometer only": mekf_runs(runs, False),
             "inclinometer only, error in body axes": mekf_runs(max(runs // 4, 1), False, "body")}
    draw_nees(plots / "nees.png", cases)
    low, high = ANEES_LIMITS
    rows = []
    for name, case in cases.items():
        inside = low <= case.anees() <= high
        rows.append((name, f"{case.anees():.2f}", "" if "body" in name else f"{low} to {high}",
                     "overconfident" if "body" in name and case.anees() > high else verdict(inside)))
    return ["## Consistency of the attitude and bias filter", "",
            f"{runs} runs (in body axes a quarter of them) of {DURATION:g} s, gyro {1 / INTERVAL:g} Hz with "
            f"{GYRO_DENSITY / DEG:g} deg/s/sqrt(Hz), inclinometer of {INCLINOMETER_STD / DEG:g} deg at 10 Hz, start "
            f"{START_STD / DEG:g} deg and {BIAS_START_STD / DEG:g} deg/s wrong on every axis (1 sigma), turning by up "
            "to 0.9 rad/s. Of 60 runs one set of random numbers and another differ by 0.5, hence more of them. "
            "Mean normalised squared error of the second half; 6 states, so ideally 6. "
            "In body axes, as printed, the linearised update learns of the heading what an inclinometer cannot know.",
            *table(("aided by", "ANEES", "limits", "verdict"), rows), "", f"![NEES]({plots.name}/nees.png)", "",
            *inclinometer_lines(cases["inclinometer only"])]


def inclinometer_lines(case):
    """Return tilt and bias errors of the inclinometer-only runs beside their limits."""
    late, ten = case.late(), np.searchsorted(case.time, 10.0)
    rows = []
    tilt = np.degrees(np.sqrt(np.mean(np.sum(case.error[:, late, :2] ** 2, axis=-1))))
    bias = np.degrees(np.sqrt(np.mean(case.error[:, late, 3:] ** 2)))
    early = np.degrees(np.sqrt(np.mean(case.error[:, ten, 3:] ** 2, axis=0)).max())
    for name, value, limit in (("tilt, second half, deg", tilt, TILT_LIMIT),
                               ("bias, second half, each axis, deg/s", bias, BIAS_LIMIT),
                               ("bias after 10 s, worst axis, deg/s", early, EARLY_BIAS_LIMIT)):
        rows.append((name, f"{value:.3f}", limit, verdict(value <= limit)))
    return ["Errors of the filter with the inclinometer only (RMS over the runs):",
            *table(("", "error", "limit", "verdict"), rows)]


def draw_nees(path, cases):
    """Draw the mean NEES of the runs against time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3.5), layout="constrained")
    axes = figure.subplots()
    for name, case in cases.items():
        axes.semilogy(case.time, case.nees.mean(axis=0), label=name)
    axes.axhspan(*ANEES_LIMITS, color="0.85", label="limits")
    axes.set_xlabel("time, s")
    axes.set_ylabel("mean NEES")
    axes.grid(True, alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=100, metadata={"Software": None})


# --- position and velocity ----------------------------------------------------------------------------


def spectral_radius(product):
    """Return that of a fix interval's step with the paper's gain times the interval; wn T given."""
    gain = np.array([[np.sqrt(2) * product], [product**2]])
    return float(np.abs(np.linalg.eigvals((np.eye(2) - gain @ [[1.0, 0.0]]) @ [[1.0, 1.0], [0.0, 1.0]])).max())


def riccati_radius(product):
    """Return the same with the gain of the discrete Riccati equation, in units of the interval."""
    F, H, R = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]]), 1.0
    Qd = product**4 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    P = np.eye(2)
    for _ in range(2000):
        P = F @ P @ F.T + Qd
        K = P @ H.T / (H @ P @ H.T + R)
        P = (np.eye(2) - K @ H) @ P
    return float(np.abs(np.linalg.eigvals((np.eye(2) - K @ H) @ F)).max())


def bias_left(bias, wn, dt=1e-3, duration=60.0):
    """Return position and velocity errors that a constant acceleration error leaves, simulated."""
    r = u = 0.0
    for _ in range(round(duration / dt)):
        r, u = r + dt * (u - np.sqrt(2) * wn * r), u + dt * (bias - wn**2 * r)
    return r, u


def gain_section():
    """Return where the paper's gain is unstable, and what a bias leaves without its state."""
    rows = [(f"{product:g}", f"{spectral_radius(product):.3f}",
             "unstable, refused" if product > STEADY_GAIN_LIMIT else "stable", f"{riccati_radius(product):.3f}")
            for product in (0.1, 0.5, 0.9, 1.03, 1.04, 1.2, 2.0)]
    lines = ["## The paper's gain of position and velocity", "",
             "K = [sqrt2 wn, wn^2] (equation 9), applied as K T once a fix: largest eigenvalue of the error's step, "
             f"beside that of the Riccati gain. It is unstable beyond wn T = sqrt6 - sqrt2 = {STEADY_GAIN_LIMIT:.4f}; "
             "`gain: steady` is refused there: " + refusal(),
             *table(("wn T", "the paper's gain", "", "Riccati gain"), rows), "",
             "Without a bias state an acceleration error b leaves b/wn^2 and sqrt2 b/wn, for good (b = 0.1 m/s^2):"]
    rows = []
    for wn in (0.3, 0.5, 1.0):
        r, u = bias_left(0.1, wn)
        rows.append((wn, f"{r:.3f}", f"{0.1 / wn**2:.3f}", f"{u:.3f}", f"{np.sqrt(2) * 0.1 / wn:.3f}"))
    return [*lines, *table(("wn, rad/s", "position, m", "b/wn^2, m", "velocity, m/s", "sqrt2 b/wn, m/s"), rows), "",
            "Hence `cascade` has the third state by default (`gain: riccati`)."]


def refusal():
    """Return what the parameters say of an unstable gain."""
    try:
        NavigationParams(estimator="cascade", gain="steady", fix_interval=10.0, accel_noise_density=1.0, fix_std=0.1)
    except ValueError as refused:
        return f"\"{refused}\"."
    return "**not refused**."


# --- flights ------------------------------------------------------------------------------------------


def flight(seed, duration, imu_errors=SENSORS):
    """Return a recording and its aids: (sample, position, velocity) at 1 Hz."""
    recording = simulate(FLIGHT, duration=duration, imu_rate=100.0, imu_errors=imu_errors, seed=seed)
    rng = np.random.default_rng([SEED, seed])
    return recording, {k: (recording.position_n[k] + POSITION_STD * rng.standard_normal(3),
                           recording.velocity_n[k] + VELOCITY_STD * rng.standard_normal(3))
                       for k in range(50, len(recording.imu), 100)}


def sensor_params(**changes):
    """Return NavigationParams that know the sensors of :func:`flight`, whose positions have white noise."""
    imu = SENSORS
    known = {"gyro_noise_density": imu.gyro_noise_density, "gyro_bias_std": imu.gyro_bias_std,
             "gyro_rate_error": 5e-4, "gyro_bias_walk": 1e-5, "accel_noise_density": imu.accel_noise_density,
             "accel_force_error": 5e-4, "accel_bias_std": imu.accel_bias_std, "accel_bias_time": 1000.0,
             "fix_std": POSITION_STD, "velocity_std": VELOCITY_STD, "fix_slow_share": 0.0}
    return NavigationParams(**(known | changes))


def navigate(recording, aids, params, late=0):
    """Return the Navigation of a flight whose aids arrive `late` samples after they were valid."""
    estimator, imu = NavigationEstimator(params), recording.imu
    estimator.hold()
    for k in range(len(imu)):
        estimator.add_imu(int(imu.stamp_ns[k]), imu.gyro_b[k], imu.accel_b[k])
        if k - late in aids:
            stamp_ns = int(imu.stamp_ns[k - late])
            estimator.add_position(stamp_ns, aids[k - late][0])
            estimator.add_velocity(stamp_ns, aids[k - late][1])
    navigation, _ = estimator.release()
    return navigation


def inclinometer_by_force(recording, gate=np.inf):
    """Return attitudes (N, 4) of the attitude filter that takes the accelerometer for an inclinometer at 10 Hz."""
    imu, errors = recording.imu, SENSORS
    q, bias = recording.truth.q_nb_wxyz[0].copy(), np.zeros(3)
    P = np.diag(np.repeat([(1.0 * DEG) ** 2, errors.gyro_bias_std**2], 3))
    down_n, R, found = np.array([0.0, 0.0, 1.0]), INCLINOMETER_STD**2 * np.eye(3), np.empty((len(imu), 4))
    for k in range(len(imu)):
        kernels.mekf_predict(q, P, imu.gyro_b[k] - bias, 0.01, errors.gyro_noise_density, 2e-5)
        size = np.linalg.norm(imu.accel_b[k])
        if k % 10 == 0 and abs(size - STANDARD_GRAVITY) < gate:
            kernels.mekf_vector_update(q, bias, P, -imu.accel_b[k] / size, down_n, R, np.inf)
        found[k] = q
    return found


def tilt_error(recording, q_nb_wxyz):
    """Return the angle between true and estimated down, (N,), deg."""
    cross = np.cross(down_from_quaternion(q_nb_wxyz), down_from_quaternion(recording.truth.q_nb_wxyz))
    return np.degrees(np.arcsin(np.clip(np.linalg.norm(cross, axis=-1), 0, 1)))


def rms(values):
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def flight_section(seeds, plots, duration=120.0):
    """Return the filters' errors in manoeuvring flight beside their limits, and what an accelerometer is worth."""
    late = 0.01 * np.arange(round(100 * duration)) > SETTLED
    tilt, others, aligned = {}, {"position, m": [], "velocity, m/s": []}, []
    for seed in range(seeds):
        recording, aids = flight(seed, duration)
        cascade = navigate(recording, aids, sensor_params(estimator="cascade"))
        found = {"accelerometer as inclinometer": inclinometer_by_force(recording),
                 "the same, only where the force is within 0.5 m/s^2 of gravity": inclinometer_by_force(recording, 0.5),
                 "cascade: the aiding velocity's derivative taken off": cascade.q_nb_wxyz,
                 "eskf15": navigate(recording, aids, sensor_params()).q_nb_wxyz}
        for name, q in found.items():
            tilt.setdefault(name, []).append(tilt_error(recording, q))
        straight, aids = flight(seed, duration, ALIGNED)
        aligned.append(tilt_error(straight, navigate(straight, aids, sensor_params()).q_nb_wxyz))
        others["position, m"].append((recording.position_n - cascade.position_n)[late])
        others["velocity, m/s"].append((recording.velocity_n - cascade.velocity_n)[late])
    draw_tilt(plots / "tilt.png", {name: values[0] for name, values in tilt.items()})
    tilt["eskf15, were the gyros' axes not misaligned"] = aligned
    page = (3.0, 4.7, 0.33, 0.06, "")
    limits = (None, None, CASCADE_LIMITS["tilt, deg"], ESKF_TILT_LIMIT, ESKF_TILT_LIMIT)
    figures = {name: rms(np.array(values)[:, late]) for name, values in tilt.items()}
    rows = [(name, f"{value:.3f} +- {standard_error(np.array(tilt[name])[:, late]):.3f}", there, limit or "",
             verdict(value <= limit) if limit else "")
            for (name, value), there, limit in zip(figures.items(), page, limits, strict=True)]
    along = {name: rms(values) for name, values in others.items()}
    along_rows = [(name, f"{value:.3f}", CASCADE_LIMITS[name], verdict(value <= CASCADE_LIMITS[name]))
                  for name, value in along.items()]
    return ["## In manoeuvring flight", "",
            f"Scenario `{FLIGHT}`, {seeds} flights of {duration:g} s, sensors of profile mti300, position "
            f"({POSITION_STD:g} m) and velocity ({VELOCITY_STD:g} m/s) at 1 Hz, heading unknown at the start; after "
            f"{SETTLED:g} s. An accelerometer is no inclinometer when the vehicle accelerates, and choosing the "
            "moments when its size is gravity's does not make it one. (The design page's figures are of another "
            "flight.) The spread is that of the mean over the flights. The axes of this sensor's gyros are "
            f"{np.degrees(SENSORS.gyro_misalignment_std):g} deg off, as its data sheet says; neither filter has states "
            "for that, and the last row is the same without it.",
            *table(("tilt, RMS", "deg", "on the design page, deg", "limit, deg", "verdict"), rows), "",
            "Position and velocity of the cascade, RMS of each axis:",
            *table(("", "error", "limit", "verdict"), along_rows), "", f"![tilt]({plots.name}/tilt.png)"], figures


def standard_error(errors):
    """Return that of the RMS of errors (flights, N), from the flights' differences."""
    squares = np.mean(np.square(errors), axis=1)
    return float(np.std(squares) / np.sqrt(max(len(squares) - 1, 1)) / (2.0 * np.sqrt(np.mean(squares))))


def draw_tilt(path, tilt):
    """Draw the tilt errors of one flight."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3.5), layout="constrained")
    axes = figure.subplots()
    for name, error in tilt.items():
        axes.semilogy(0.01 * np.arange(len(error))[::20], error[::20], linewidth=1, label=name)
    axes.set_xlabel("time, s")
    axes.set_ylabel("tilt error, deg")
    axes.set_ylim(1e-3, 30)
    axes.grid(True, alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=100, metadata={"Software": None})


# --- honesty ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Receiver:
    """A satellite receiver: rate Hz, delay s, share of the position's variance that is slow, and what goes wrong."""

    rate: float
    delay: float = 0.0
    slow_share: float = 0.0
    faulty: bool = False


RECEIVERS = {
    "1 Hz, white": Receiver(1.0),
    "10 Hz, 0.2 s late, white": Receiver(10.0, 0.2),
    "5 Hz, 0.3 s late, half of the variance slow": Receiver(5.0, 0.3, 0.5),
    "the same, 2 % of the fixes 50 m off, 20 m off for 1.5 s": Receiver(5.0, 0.3, 0.5, faulty=True)}


def receive(recording, receiver, rng):
    """Return sample -> position and velocity of a receiver."""
    at = np.arange(50, len(recording.imu), round(100 / receiver.rate))
    decay = np.exp(-1.0 / receiver.rate / SLOW_TIME)
    slow = np.empty((len(at), 3))
    slow[0] = rng.standard_normal(3)
    for k in range(1, len(at)):
        slow[k] = decay * slow[k - 1] + np.sqrt(1 - decay**2) * rng.standard_normal(3)
    white = rng.standard_normal((len(at), 3))
    error = POSITION_STD * (np.sqrt(1 - receiver.slow_share) * white + np.sqrt(receiver.slow_share) * slow)
    if receiver.faulty:
        error[rng.random(len(at)) < 0.02] += 50.0
        error[(at > 6000) & (at <= 6150)] += 20.0
    velocity_n = recording.velocity_n[at] + VELOCITY_STD * rng.standard_normal((len(at), 3))
    return {int(k): values for k, *values in zip(at, recording.position_n[at] + error, velocity_n, strict=True)}


def honesty_section(seeds):
    """Return errors and their size in predicted standard deviations, of the default filter."""
    rows = []
    for label, scenario, imu_errors, changes in (
            ("turn", "turn", SENSORS, {}), ("turn, gyros aligned", "turn", ALIGNED, {}),
            ("turn, `gyro_rate_error` 2e-3", "turn", SENSORS, {"gyro_rate_error": 2e-3}),
            ("quad", "quad", SENSORS, {}), ("car", "car", SENSORS, {})):
        recordings = [simulate(scenario, duration=120.0, imu_rate=100.0, imu_errors=imu_errors, seed=seed)
                      for seed in range(seeds)]
        for name, receiver in RECEIVERS.items():
            params = sensor_params(fix_slow_share=receiver.slow_share, fix_slow_time=SLOW_TIME, **changes)
            found = []
            for seed, recording in enumerate(recordings):
                aids = receive(recording, receiver, np.random.default_rng([SEED, seed]))
                found.append(errors_and_nees(recording, navigate(recording, aids, params, round(100 * receiver.delay))))
            tilt, position, *nees = np.mean(found, axis=0)
            rows.append((label, name, f"{np.degrees(tilt):.2f}", f"{position:.2f}", *(f"{n:.2f}" for n in nees)))
    return ["## Does the covariance tell the truth?", "",
            f"`eskf15`, the sensors as above, {seeds} flights of 120 s each, after {SETTLED:g} s; positions of "
            f"{POSITION_STD:g} m and velocities of {VELOCITY_STD:g} m/s with their covariances. A slow error lasts "
            f"{SLOW_TIME:g} s; `fix_slow_share` is the receiver's. NEES for each state: mean squared error in "
            "predicted variances, 1 where both agree, below where the filter is careful. A position's variance has in "
            "it the slow error that all fixes share, of which averaging does not rid it. The tilt errs by more than it "
            "is told to, most in long turns: the gyros' misalignment times the turn's rate stands still, while the "
            "filter takes it for white noise in proportion to the rate (`gyro_rate_error`, here 5e-4). With aligned "
            "gyros, or with a larger `gyro_rate_error`, the covariance of `turn` tells the truth.",
            *table(("flight", "receiver", "tilt, deg", "position, m", "NEES tilt", "NEES heading", "NEES velocity",
                    "NEES position"), rows)]


def errors_and_nees(recording, navigation):
    """Return the RMS of tilt (rad) and position (m), then NEES for each state: tilt, heading, velocity, position."""
    late = (navigation.stamp_ns - navigation.stamp_ns[0]) * 1e-9 > SETTLED
    turned = quaternion_multiply(recording.truth.q_nb_wxyz, quaternion_conjugate(navigation.q_nb_wxyz))
    error = np.hstack([quaternion_log(turned), recording.velocity_n - navigation.velocity_n,
                       recording.position_n - navigation.position_n])[late]
    P = navigation.covariance[late]
    nees = []
    for part in (slice(0, 2), slice(2, 3), slice(3, 6), slice(6, 9)):
        e = error[:, part, None]
        nees.append(float(np.mean(np.swapaxes(e, 1, 2) @ np.linalg.solve(P[:, part, part], e))) / e.shape[1])
    return rms(np.linalg.norm(error[:, :2], axis=1)), rms(np.linalg.norm(error[:, 6:], axis=1)), *nees


# --- real recordings, without GNSS --------------------------------------------------------------------


def recordings_section():
    """Return the tilt of both estimators on recordings with IMU and altitude, by family."""
    folder = recordings_folder()
    if folder is None:
        return ["## Real recordings without GNSS", "", "No recordings found; `REAL_BAGS` names their folder."]
    families = {}
    for path in sorted(folder.iterdir()):
        if (path / "metadata.yaml").is_file():
            recording = read_recording(path)
            if recording.altitude is not None:
                families.setdefault(family_of(path.name), []).append(tilt_without_gnss(recording))
    rows, worst = [], 0.0
    for family, values in families.items():
        ours, level = np.median(values, axis=0)
        worst = max(worst, ours / level)
        rows.append((family, len(values), f"{ours:.3f}", f"{level:.3f}", f"{ours / level:.3f}"))
    return ["## Real recordings without GNSS", "",
            "IMU and altitude only, at most the first "
            f"{LONGEST} samples: tilt RMS, deg, medians of each family. Without position and velocity the navigator "
            f"gives the attitude estimator's tilt. Worst ratio {worst:.3f}, limit {RECORDING_RATIO_LIMIT}: "
            f"{verdict(worst <= RECORDING_RATIO_LIMIT)}.",
            *table(("family", "recordings", "navigator", "attitude_node's estimator", "ratio"), rows)]


def tilt_without_gnss(recording):
    """Return the tilt RMS (deg) of the navigator and of the attitude estimator."""
    imu, altitude = recording.imu, recording.altitude
    imu = type(imu)(imu.stamp_ns[:LONGEST], imu.gyro_b[:LONGEST], imu.accel_b[:LONGEST])
    heard = altitude.arrival < len(imu)
    altitude = type(altitude)(altitude.stamp_ns[heard], altitude.altitude[heard], altitude.arrival[heard])
    found, _ = NavigationEstimator().run(dataclasses.replace(recording, imu=imu, altitude=altitude))
    level, _ = AttitudeEstimator().run(imu, altitude)
    return [score_attitude(e.stamp_ns, e.q_nb_wxyz, covariance, e.valid, recording.truth).tilt_rms_deg
            for e, covariance in ((found, found.covariance[:, :2, :2]), (level, level.tilt_covariance_n))]


# --- claims and cost ----------------------------------------------------------------------------------


def claims_section(figures):
    """Return a verdict on each thing that the paper says of its filters."""
    force, gated, cascade, eskf, _ = figures.values()
    rows = [
        ("two filters in a row give nine states (abstract; what its equations estimate is told in "
         "[helicopter.md](helicopter.md))", "attitude, velocity and position: confirmed, once the attitude is aided by "
         "more than the force and the second filter has a state for the acceleration's error (tables above); one "
         f"filter of 15 states is better in tilt ({eskf:.3f} against {cascade:.3f} deg)"),
        ("an inclinometer corrects the gyros",
         f"only a true one: the accelerometer in its place leaves {force:.1f} deg in flight, chosen by its size "
         f"{gated:.1f} deg"),
        ("the steady gain K = [sqrt2 wn, wn^2] serves (equation 9)",
         f"between fixes of wn T below {STEADY_GAIN_LIMIT:.4f} only, and never with a bias"),
        ("q = {exp(w_avg dt/2) + commutator dt^2/48} q (equation 12)",
         "(!) the exponent wants Omega(w_avg), and the sum is not normalised: put right here; order 4 for a rate "
         "linear in time, 2 for any"),
        ("the skew matrix of equation 20, Q's lower left block of equation 21",
         "(!) minus the usual one; the block wants the transpose"),
        ("the error state is added to the estimate (equation 18)", "(!) the attitude's part multiplies"),
        ("the error of the attitude in body axes", "overconfident with an inclinometer alone (ANEES above)"),
        ("a filter of sensors needs no model of the helicopter, one of the model does",
         "confirmed: see [helicopter.md](helicopter.md)")]
    return ["## The paper's claims", *table(("what the paper says", "verdict"), rows)]


@njit  # not cached: a cache does not see a change in the kernels' own file
def _mekf_steps(q, bias, P, gyro_b, down_n, R, steps):
    measured_b = np.empty(3)
    for _ in range(steps):
        kernels.mekf_predict(q, P, gyro_b, 0.01, 1e-3, 1e-5)
        x, y, z, w = q[1], q[2], q[3], q[0]
        measured_b[0], measured_b[1], measured_b[2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        kernels.mekf_vector_update(q, bias, P, measured_b, down_n, R, np.inf)


def step_cost(steps=500, rounds=100):
    """Return what predict and update of the attitude filter take in a compiled loop, us: the least of the rounds."""
    q, bias, P = np.array([1.0, 0, 0, 0]), np.zeros(3), 1e-3 * np.eye(6)
    gyro_b, down_n, R = np.array([0.1, -0.2, 0.3]), np.array([0.0, 0.0, 1.0]), 1e-4 * np.eye(3)
    taken = []
    for _ in range(rounds + 1):  # the first compiles
        began = time.perf_counter()
        _mekf_steps(q, bias, P, gyro_b, down_n, R, steps)
        taken.append(time.perf_counter() - began)
    return min(taken[1:]) * 1e6 / steps


def sample_costs(duration=20.0, rounds=10):
    """Return us of each sample of a flight with aids, a recording at once and one by one: the least of the rounds."""
    recording, aids = flight(0, duration)
    imu = recording.imu

    def one_by_one():
        estimator = NavigationEstimator(sensor_params())
        for k in range(len(imu)):
            estimator.add_imu(int(imu.stamp_ns[k]), imu.gyro_b[k], imu.accel_b[k])

    costs = times_in_turn({"at once": lambda: navigate(recording, aids, sensor_params()), "one by one": one_by_one},
                          len(imu), time.process_time, rounds)
    return tuple(costs.values())


def cost_section():
    """Return the cost of the attitude filter beside its limit, and of a sample."""
    cost, (at_once, one_by_one) = step_cost(), sample_costs()
    return ["## Cost", "", f"Predict and update of the attitude and bias filter, compiled: {cost:.2f} us, limit "
            f"{STEP_LIMIT:g} us: {verdict(cost <= STEP_LIMIT)} (the least of a hundred rounds on the machine that made "
            f"this page). A sample through the whole navigator, levelling included: {at_once:.0f} us when a recording "
            f"is taken at once, {one_by_one:.0f} us one by one from Python."]


def main(argv=None):
    """Write the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/results"), help="folder of the results")
    parser.add_argument("--runs", type=int, default=180, help="runs of the consistency test")
    arguments = parser.parse_args(argv)
    plots = arguments.out / "two_filters"
    plots.mkdir(parents=True, exist_ok=True)
    flights, figures = flight_section(max(arguments.runs // 9, 1), plots)
    sections = [
        ["# Two Kalman filters", "",
         f"Made by `study_two_filters` from commit {head_commit()}, seed {SEED}. The filters are "
         "told in `attitude_estimator/navigation/`."],
        closed_form_section(), consistency_section(arguments.runs, plots), gain_section(), flights,
        honesty_section(max(arguments.runs // 22, 1)), recordings_section(), claims_section(figures), cost_section()]
    text = "\n\n".join("\n".join(section) for section in sections) + "\n"
    (arguments.out / "two_filters.md").write_text(text, encoding="utf-8")
    print(arguments.out / "two_filters.md")


if __name__ == "__main__":
    main()
