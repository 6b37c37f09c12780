"""Accuracy beside the peers, all run here, on simulated motion and on the real recordings.

Writes docs/results/accuracy.md. The ahrs package takes about a millisecond a sample: allow some minutes.
"""

import sys
from pathlib import Path

import numpy as np

from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.params import AttitudeParams
from inertial.scenarios import SCENARIOS
from inertial.scoring import interpolate_down
from inertial.simulator import simulate
from nav_ros.bags import read_recording
from studies.peers import installed_peers, run_peer
from studies.recordings import family_medians, family_of, recordings_folder

OUT = Path("docs/results/accuracy.md")
SETTLE = 5.0  # s left out, as in every score
SIM_SECONDS, SIM_RATE, SIM_SEEDS = 60.0, 100.0, (1, 2, 3)


class Row:
    """Tilt RMS in deg of every estimator on one recording."""

    def __init__(self, name, recording, peers):
        self.name, self.family = name, family_of(name)
        params = AttitudeParams()
        with_altitude, _ = AttitudeEstimator(params).run(recording.imu, recording.altitude)
        alone, _ = AttitudeEstimator(params).run(recording.imu)
        self.tilt = {"with altitude": tilt_rms_deg(with_altitude.down_b, recording),
                     "IMU alone": tilt_rms_deg(alone.down_b, recording)}
        for peer_name, peer in peers.items():
            self.tilt[peer_name] = tilt_rms_deg(run_peer(peer, recording.imu), recording)


def tilt_rms_deg(down_b, recording):
    """RMS angle between a down direction and the true one, every sample after the first 5 s counted."""
    true_b, spanned = interpolate_down(recording.truth, recording.imu.stamp_ns)
    late = recording.imu.stamp_ns >= recording.imu.stamp_ns[0] + round(SETTLE * 1e9)
    used = spanned & late
    cross = np.linalg.norm(np.cross(down_b[used], true_b[used]), axis=1)
    angle = np.arctan2(cross, np.sum(down_b[used] * true_b[used], axis=1))
    return float(np.degrees(np.sqrt(np.mean(angle**2))))


def simulated_rows(peers):
    """Return a Row for each scenario and seed, consumer sensors."""
    return [_told(Row(scenario, simulate(scenario, duration=SIM_SECONDS, imu_rate=SIM_RATE, seed=seed), peers))
            for scenario in SCENARIOS for seed in SIM_SEEDS]


def recorded_rows(folder, peers):
    """Return a Row for each recording of a folder."""
    return [_told(Row(path.name, read_recording(path), peers))
            for path in sorted(folder.iterdir()) if (path / "metadata.yaml").is_file()]


def _told(row):
    print(".", end="", file=sys.stderr, flush=True)
    return row


def table(rows):
    """Return a markdown table of the families' medians."""
    names = list(rows[0].tilt)
    medians = {name: family_medians(rows, lambda row, name=name: row.tilt[name]) for name in names}
    lines = [f"| | {' | '.join(names)} |", f"|---|{'---|' * len(names)}"]
    for family in medians[names[0]]:
        best = min(medians[name][family] for name in names)
        cells = [f"**{medians[name][family]:.2f}**" if medians[name][family] == best
                 else f"{medians[name][family]:.2f}" for name in names]
        lines.append(f"| {family} | {' | '.join(cells)} |")
    if "vqf" in names:
        ratios = {name: np.exp(np.mean([np.log(medians[name][f] / medians["vqf"][f]) for f in medians[name]]))
                  for name in names}
        lines.append(f"| ratio to VQF | {' | '.join(f'{ratios[name]:.2f}' for name in names)} |")
    return lines


def bench_accuracy():
    """Run every estimator on everything and write the page; return the figures."""
    peers, folder = installed_peers(), recordings_folder()
    simulated = simulated_rows(peers)
    recorded = recorded_rows(folder, peers) if folder else []
    print(file=sys.stderr)
    lines = ["# Accuracy beside the peers", "",
             "Made by `make bench`. Tilt RMS in degrees after the first 5 s from a cold start, every sample counted, "
             "one set of defaults each; medians over seeds or recordings of a kind. The peers use the IMU alone.",
             "", f"Simulated, {SIM_SECONDS:g} s at {SIM_RATE:g} Hz, consumer sensors, {len(SIM_SEEDS)} seeds:", "",
             *table(simulated)]
    if recorded:
        lines += ["", "Real recordings:", "", *table(recorded)]
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text("\n".join([*lines, ""]))
    print("\n".join(lines))
    return {row.name: row.tilt for row in simulated + recorded}
