"""The paper's Monte Carlo: its linear filter against the Cramer-Rao bound, from a blind start.

A hundred runs of each motion with the paper's sensors (0.5 deg/s, 0.1 m/s^2 and 2 m per sample at 100 Hz, no
biases). The runs of a motion differ in noise alone, drawn from seeds 0, 1, 2 ... Writes
docs/results/attitude.md and its pictures; the numbers of the pictures are those of the paper's figures.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from attitude_estimator.bound import SensorNoise, TiltBound, tilt_bound
from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.params import AttitudeParams
from inertial.imu_errors import PROFILES
from inertial.rotation import down_from_quaternion, roll_pitch_from_down
from inertial.scenarios import SCENARIOS
from inertial.scoring import tilt_error_n
from inertial.simulator import SampledTrajectory, add_errors, make_trajectory, sample_trajectory

OUT = Path("docs/results/attitude.md")
PICTURES = Path("docs/results/attitude")
RUNS = 100
RATE = 100.0  # Hz, of IMU and altimeter
SETTLED = 60.0  # s after which errors count: every motion that shows the tilt has shown it by then
PICTURED = "aerobatic"
SENSORS = PROFILES["paper"]
FILTERS = {
    "dcm_row5": "the paper's linear filter",
}


@dataclass(frozen=True)
class MonteCarlo:
    """All runs of one filter in one motion, at N stamps.

    Attributes
    ----------
    tilt_error_n : (runs, N, 2), rad
    down_error_b : (runs, N, 3)
    roll_pitch_error : (runs, N, 2), rad
    tilt_std : (runs, N), rad
    nees : (runs, N)
        Normalised squared error of the tilt; ideally 2. NaN, as every error, where there is no attitude.
    """

    tilt_error_n: np.ndarray
    down_error_b: np.ndarray
    roll_pitch_error: np.ndarray
    tilt_std: np.ndarray
    nees: np.ndarray


@dataclass(frozen=True)
class Motion:
    """A sampled motion with the truth that the study needs, and its bound."""

    sampled: SampledTrajectory
    down_b: np.ndarray
    t: np.ndarray
    bound: TiltBound


def sample_motion(scenario, duration=120.0):
    """Return the :class:`Motion` of a scenario."""
    sampled = sample_trajectory(make_trajectory(scenario, duration=duration), imu_rate=RATE)
    down_b = down_from_quaternion(sampled.truth.q_nb_wxyz)
    stamp_ns = sampled.imu.stamp_ns
    bound = tilt_bound(sampled.imu, down_b, stamp_ns, SensorNoise.of(SENSORS))
    return Motion(sampled, down_b, (stamp_ns - stamp_ns[0]) * 1e-9, bound)


def parameters(name):
    """Return the filter's parameters: what it is told is what the sensors are."""
    return AttitudeParams(estimator=name, gyro_noise_density=SENSORS.imu.gyro_noise_density,
                          accel_noise_density=SENSORS.imu.accel_noise_density,
                          altitude_std=SENSORS.altimeter.noise_std)


def run_filter(motion, name, runs=RUNS):
    """Return the :class:`MonteCarlo` of a filter in a motion."""
    return MonteCarlo(*map(np.array, zip(*(_run(motion, name, seed) for seed in range(runs)), strict=True)))


def _run(motion, name, seed):
    recording = add_errors(motion.sampled, SENSORS.imu, SENSORS.altimeter, np.random.default_rng(seed),
                           altimeter_rate=RATE)
    estimates, _ = AttitudeEstimator(parameters(name)).run(recording.imu, recording.altitude)
    hidden = np.where(estimates.valid, 0.0, np.nan)
    tilt = tilt_error_n(estimates.q_nb_wxyz, motion.down_b) + hidden[:, None]
    estimated, true = (np.stack(roll_pitch_from_down(d), axis=-1) for d in (estimates.down_b, motion.down_b))
    roll_pitch = np.angle(np.exp(1j * (estimated - true))) + hidden[:, None]
    covariance = estimates.tilt_covariance_n
    nees = hidden.copy()
    known = estimates.valid
    weighted = np.linalg.solve(covariance[known], tilt[known][..., None])[..., 0]
    nees[known] = np.sum(tilt[known] * weighted, axis=-1)
    return (tilt, estimates.down_b - motion.down_b + hidden[:, None], roll_pitch,
            np.sqrt(np.trace(covariance, axis1=-2, axis2=-1)) + hidden, nees)


def table_row(scenario, name, motion, result):
    """Return the line of the table for one filter in one motion."""
    late = motion.t > SETTLED
    known = np.isfinite(result.nees[:, late])
    cells = [scenario, name, f"{np.degrees(motion.bound.tilt_rms(late)):.2f}", f"{np.mean(known):.0%}"]
    if known.mean() < 0.99:
        return f"| {' | '.join([*cells, '', '', '', ''])} |"
    square = np.sum(result.tilt_error_n[:, late] ** 2, axis=-1)
    rms = np.sqrt(np.nanmean(square))
    beyond = np.mean(square[known] > 9 * result.tilt_std[:, late][known] ** 2)
    cells += [f"{np.degrees(rms):.2f}", f"{rms / motion.bound.tilt_rms(late):.2f}",
              f"{np.nanmean(result.nees[:, late]) / 2:.2f}", f"{beyond:.1%}"]
    return f"| {' | '.join(cells)} |"


def page(rows):
    """Return the page."""
    return "\n".join([
        "# The paper's filter against the bound", "",
        f"Made by `study_attitude`: {RUNS} runs each, seeds 0 to {RUNS - 1}, 120 s, {RATE:.0f} Hz, the "
        f"paper's sensors without biases. Every run starts blind; errors count after {SETTLED:.0f} s, in "
        "degrees. The bound is the posterior Cramer-Rao bound of an estimator that has the IMU and the "
        "altimeter and nothing else. Where it is large the motion does not show roll or pitch to an "
        "altimeter (nothing accelerates horizontally, or only along one axis): an attitude that is told "
        "there is told too surely. Figures are left out unless nearly every run had an attitude all the "
        "time.", "",
        "| motion | filter | bound | with attitude | tilt RMS | RMS / bound | NEES / 2 | beyond 3 sigma |",
        "|---|---|---|---|---|---|---|---|", *rows, "",
        f"![motion](attitude/{PICTURED}_motion.png)", "",
        f"Figures 2 to 6 of the paper for `{PICTURED}`: down direction, specific force, vertical velocity "
        "and altitude, rates, roll and pitch.", "",
        f"![errors](attitude/{PICTURED}_errors.png)", "",
        "Figures 7 to 9: RMS over the runs of the roll and pitch errors, of the down direction's errors, and "
        "of the tilt error beside the predicted one and the bound.", ""])


def draw(motion, result):
    """Draw the figures of the paper for one motion."""
    from matplotlib.figure import Figure

    PICTURES.mkdir(parents=True, exist_ok=True)
    imu = motion.sampled.imu
    vertical = np.stack([motion.sampled.velocity_n[:, 2], -motion.sampled.position_n[:, 2]], axis=-1)
    angles = np.degrees(np.stack(roll_pitch_from_down(motion.down_b), axis=-1))
    _panels(Figure, PICTURES / f"{PICTURED}_motion.png", motion.t, [
        ("2: down direction", motion.down_b, "xyz"), ("3: specific force, m/s$^2$", imu.accel_b, "xyz"),
        ("4: m/s and m", vertical, ["velocity down", "altitude"]),
        ("5: rate, deg/s", np.degrees(imu.gyro_b), "xyz"), ("6: deg", angles, ["roll", "pitch"])])
    tilt = np.degrees(np.stack([_rms(np.linalg.norm(result.tilt_error_n, axis=-1)), _rms(result.tilt_std),
                                motion.bound.tilt_std], axis=-1))
    _panels(Figure, PICTURES / f"{PICTURED}_errors.png", motion.t, [
        ("7: deg", np.degrees(_rms(result.roll_pitch_error)), ["roll", "pitch"]),
        ("8: down direction", _rms(result.down_error_b), "xyz"),
        ("9: tilt, deg", tilt, ["error", "predicted", "bound"])], logarithmic=True)


def _rms(values):
    """RMS over the runs; NaN until every run has an attitude."""
    return np.sqrt(np.mean(values**2, axis=0))


def _panels(figure_type, path, t, panels, logarithmic=False):
    figure = figure_type(figsize=(8, 1.9 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), sharex=True)
    for axis, (label, values, names) in zip(axes, panels, strict=True):
        axis.plot(t, values, linewidth=0.9, label=list(names))
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
        axis.legend(loc="upper right", fontsize="small")
        if logarithmic:
            axis.set_yscale("log")
    axes[-1].set_xlabel("s")
    figure.savefig(path, dpi=90)


def main():
    """Run ``study_attitude``."""
    rows = []
    for scenario in SCENARIOS:
        motion = sample_motion(scenario)
        for name in FILTERS:
            result = run_filter(motion, name)
            rows.append(table_row(scenario, name, motion, result))
            print(rows[-1], file=sys.stderr, flush=True)
            if scenario == PICTURED and name == next(iter(FILTERS)):
                draw(motion, result)
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(page(rows), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
