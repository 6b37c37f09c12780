"""Real recordings: the tilt error of the default estimator beside that of its peers.

The peers' figures are those of the recordings' INDEX.csv, at their defaults from a cold start; ours are
made here, at the defaults too, by the code that ``estimate_bag`` and ``attitude_node`` run. ``REAL_BAGS`` names the
folder of the recordings. Writes docs/results/recordings.md.
"""

import csv
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.params import AttitudeParams
from attitude_estimator.smoother import smooth
from inertial.scoring import AttitudeScore, score_attitude
from nav_ros.bags import read_recording

PEERS = ("vqf", "imufusion", "madgwick", "mahony")
OUT = Path("docs/results/recordings.md")

ABLATIONS = {
    "as shipped": {},
    "no altimeter": None,
    "gravity always trusted alike": {"gravity_residual_share": 0.0, "gravity_floor_std": 0.5},
    "residual not remembered": {"gravity_decay_time": 0.05},
    "gravity updates taken as independent": {"gravity_correlation": 0.0},
    "what lasts in the residual not measured": {"gravity_lasting_share": 0.0, "gravity_lasting_share_alone": 0.0},
    "vibration not taken for noise": {"accel_vibration_share": 0.0},
    "no distrust at the start": {"gravity_start_std": 0.0},
    "no accelerometer bias": {"accel_bias_std": 1e-6},
    "accelerometer bias takes its full gain": {"gravity_bias_share": 1.0},
    "gyro noise does not grow with the rate": {"gyro_rate_error": 0.0},
    "gyro bias prior of 0.3 deg/s": {"gyro_bias_std": 0.005},
    "no altimeter drift": {"altitude_drift_density": 0.0},
    "no altimeter jump tests": {"altitude_gate": 100.0, "altitude_step_gate": 100.0},
    "gravity low-pass twice as slow": {"gravity_time": 3.3},
}
"""What is left out, parameter by parameter."""


@dataclass(frozen=True)
class RecordingResult:
    """One recording: our scores with and without its altimeter, smoothed, and the peers' tilt RMS in deg."""

    name: str
    family: str
    score: AttitudeScore
    score_imu_only: AttitudeScore
    score_smoothed: AttitudeScore
    peers: dict


def recordings_folder():
    """Return the folder of the recordings, or None where there is none."""
    folder = Path(os.environ.get("REAL_BAGS", "../shared/bags"))
    return folder if (folder / "INDEX.csv").is_file() else None


def family_of(name):
    """Return the kind of recording: the part of its name that does not number it."""
    parts = name.split("_")
    return "_".join(parts[:2]) if parts[0] in ("ansfl", "inav") else parts[0]


def estimate(recording, params, use_altitude=True):
    """Return the score of an estimator on a recording."""
    estimates, _ = AttitudeEstimator(params).run(recording.imu, recording.altitude if use_altitude else None)
    return _score(estimates, recording)


def _score(estimates, recording):
    return score_attitude(estimates.stamp_ns, estimates.q_nb_wxyz, estimates.tilt_covariance_n,
                          estimates.valid, recording.truth)


def score_recordings(folder, params):
    """Return a :class:`RecordingResult` for each recording of the folder's INDEX.csv."""
    results = []
    with open(folder / "INDEX.csv", newline="") as file:
        for row in csv.DictReader(file):
            recording = read_recording(folder / row["name"])
            results.append(RecordingResult(
                row["name"], family_of(row["name"]), estimate(recording, params),
                estimate(recording, params, use_altitude=False),
                _score(smooth(recording.imu, recording.altitude, params=params)[0], recording),
                {peer: float(row[f"{peer}_tilt"]) for peer in PEERS}))
            print(".", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return results


def family_medians(results, value):
    """Return family -> median of a value of its recordings."""
    families = {}
    for result in results:
        families.setdefault(result.family, []).append(value(result))
    return {family: float(np.median(values)) for family, values in families.items()}


def geometric_ratio(results, value):
    """Return the geometric mean over families of a value's median beside VQF's."""
    ours = family_medians(results, value)
    vqf = family_medians(results, lambda result: result.peers["vqf"])
    return float(np.exp(np.mean([np.log(ours[family] / vqf[family]) for family in ours])))


def ablation_table(folder):
    """Return the lines that say what each part brings."""
    recordings = [read_recording(path) for path in sorted(folder.iterdir()) if (path / "metadata.yaml").is_file()]
    ratios = {}
    for name, changes in ABLATIONS.items():
        params = AttitudeParams(**(changes or {}))
        tilt, covered = {}, []
        for recording in recordings:
            score = estimate(recording, params, use_altitude=changes is not None)
            tilt.setdefault(family_of(recording.name), []).append(score.tilt_rms_deg)
            covered.append(score.coverage_3sigma)
        ratios[name] = {family: np.median(values) for family, values in tilt.items()}, np.mean(covered)
        print(".", end="", file=sys.stderr, flush=True)
    shipped = ratios["as shipped"][0]
    lines = ["## What each part brings", "",
             "Tilt RMS against that of the shipped estimator, geometric mean over the families and the worst family; "
             "inside 3 sigma over all recordings. A part that made nothing worse when it was left out is gone already: "
             "the excess of the force's norm (1.00). What lasts in the residual, and vibration, are for motion that "
             "these recordings do not have: `test/attitude_estimator/test_motions.py`.", "",
             "| left out or changed | ratio | worst family | inside 3 sigma |", "|---|---|---|---|"]
    for name, (tilt, covered) in ratios.items():
        parts = {family: tilt[family] / shipped[family] for family in tilt}
        worst = max(parts, key=parts.get)
        mean = np.exp(np.mean(np.log(list(parts.values()))))
        lines.append(f"| {name} | {mean:.2f} | {parts[worst]:.2f} ({worst}) | {covered:.1%} |")
    return [*lines, ""]


def report(results):
    """Return the page."""
    lines = [
        "# Real recordings", "",
        "Made by `make study`. Tilt RMS in degrees after the first 5 s, default parameters everywhere, cold "
        "start; sigma is the median of what the filter predicts, inside 3 sigma counts the time without an "
        "attitude as outside. Without altitude: the same estimator, IMU alone. Smoothed: `estimate_bag --smooth`, "
        "which knows what comes after. It is as good as the model: a constant error that the model takes for noise "
        "stays, and in recordings that hardly move the smoother may be the worse.", "",
        "| recording | ours | sigma | inside 3 sigma | without altitude | smoothed | VQF | Fusion | Madgwick | "
        "Mahony |",
        "|---|---|---|---|---|---|---|---|---|---|"]
    for result in results:
        cells = [f"{result.score.tilt_rms_deg:.2f}", f"{result.score.median_sigma_deg:.2f}",
                 f"{result.score.coverage_3sigma:.1%}", f"{result.score_imu_only.tilt_rms_deg:.2f}",
                 f"{result.score_smoothed.tilt_rms_deg:.2f}",
                 *(f"{result.peers[peer]:.2f}" for peer in PEERS)]
        lines.append(f"| {result.name} | {' | '.join(cells)} |")
    lines += ["", "Medians of each family:", "",
              "| family | ours | without altitude | VQF | ratio to VQF | smoothed | smoothed to forward |",
              "|---|---|---|---|---|---|---|"]
    ours = family_medians(results, lambda result: result.score.tilt_rms_deg)
    alone = family_medians(results, lambda result: result.score_imu_only.tilt_rms_deg)
    vqf = family_medians(results, lambda result: result.peers["vqf"])
    smoothed = family_medians(results, lambda result: result.score_smoothed.tilt_rms_deg)
    lines += [f"| {family} | {ours[family]:.2f} | {alone[family]:.2f} | {vqf[family]:.2f} | "
              f"{ours[family] / vqf[family]:.2f} | {smoothed[family]:.2f} | {smoothed[family] / ours[family]:.2f} |"
              for family in ours]
    with_altitude = geometric_ratio(results, lambda result: result.score.tilt_rms_deg)
    without = geometric_ratio(results, lambda result: result.score_imu_only.tilt_rms_deg)
    lines += ["", f"Geometric mean of the families' ratios to VQF: {with_altitude:.2f} with altitude, "
              f"{without:.2f} without.", "",
              "The truth of the inav recordings is the onboard filter of the same IMU (differences below "
              "2 deg mean nothing there), that of vn100 comes from the same sensor, px4 stands still. The "
              "index's figures of the broad recordings are over other samples than ours: compare those in "
              "[accuracy.md](accuracy.md), where the peers are run on the same ones.", ""]
    return "\n".join(lines)


def main():
    """Run ``study_recordings``."""
    folder = recordings_folder()
    if folder is None:
        print("study_recordings: no recordings found; REAL_BAGS names their folder", file=sys.stderr)
        return 0
    OUT.parent.mkdir(parents=True, exist_ok=True)
    page = report(score_recordings(folder, AttitudeParams()))
    OUT.write_text("\n".join([page, *ablation_table(folder)]))
    print(OUT)
    return 0


if __name__ == "__main__":
    sys.exit(main())
