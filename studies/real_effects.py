"""What real altimeters, IMUs and mountings do to the attitude: one effect at a time, on simulated motion.

Each effect is added to consumer sensors in motions of four kinds; the tilt error is told beside that of the same
noise without the effect, and beside the size that the filter itself predicts. Writes docs/results/real_effects.md.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.params import AttitudeParams
from inertial.imu_errors import find_profile
from inertial.recording import AltitudeSeries
from inertial.scoring import score_attitude
from inertial.simulator import add_errors, make_trajectory, sample_trajectory

OUT = Path("docs/results/real_effects.md")
SCENARIOS = ("turn", "aerobatic", "car", "quad")
SECONDS, RATE, ALTIMETER_RATE, SEEDS = 120.0, 100.0, 20.0, (1, 2, 3)


@dataclass(frozen=True)
class Effect:
    """One effect: other sensor errors, rates, parameters, or altitudes that are changed afterwards.

    Attributes
    ----------
    change : callable or None
        Times (M,) in s and altitudes (M,) in m to altitudes; None: no altimeter at all.
    """

    name: str
    imu: dict = field(default_factory=dict)
    altimeter: dict = field(default_factory=dict)
    rate: float = RATE
    latitude: float | None = None
    params: dict = field(default_factory=dict)
    change: Callable | None = lambda t, z: z


def _step(size):
    return lambda t, z: z + size * (t > 60.0)


def _pulses(t, z):
    """A door or a gust: 2 m for a third of a second, every 10 s."""
    return z + 2.0 * (t % 10.0 < 0.3)


LATITUDE = np.radians(52.0)
EFFECTS = (
    Effect("no altimeter", change=None),
    Effect("altitude late by 0.15 s, not told", altimeter={"delay": 0.15}),
    Effect("altitude late by 0.15 s, `altitude_delay` set", altimeter={"delay": 0.15}, params={"altitude_delay": 0.15}),
    Effect("altitude scale 5 % off", altimeter={"scale": 0.05}),
    Effect("altitude scale 10 % off", altimeter={"scale": 0.10}),
    Effect("altitude in steps of 0.5 m", altimeter={"resolution": 0.5}),
    Effect("altitude in steps of 1 m", altimeter={"resolution": 1.0}),
    Effect("altitude noise 1 m", altimeter={"noise_std": 1.0}),
    Effect("altitude drifts 3 m within a minute", altimeter={"drift_std": 3.0, "drift_time": 60.0}),
    Effect("altitude steps by 1 m", change=_step(1.0)),
    Effect("altitude steps by 5 m", change=_step(5.0)),
    Effect("pressure pulses of 2 m", change=_pulses),
    Effect("vibration at 30 Hz, 5 m/s^2 and 0.02 rad/s",
           imu={"accel_vibration_std": 5.0, "gyro_vibration_std": 0.02, "vibration_frequency": 30.0}),
    Effect("accelerometer clipped at 1.5 g", imu={"accel_range": 14.7}, params={"accel_range": 14.7}),
    Effect("accelerometer clipped at 1.5 g, not told", imu={"accel_range": 14.7}),
    Effect("gyro clipped at 40 deg/s", imu={"gyro_range": 0.7}, params={"gyro_range": 0.7}),
    Effect("gyro bias 3 deg/s, prior left alone", imu={"gyro_bias_std": np.radians(3.0)}),
    Effect("10 % of the samples lost", imu={"dropout_share": 0.1}),
    Effect("stamps jitter by 2 ms", imu={"jitter_std": 0.002}),
    Effect("10 Hz", rate=10.0),
    Effect("25 Hz", rate=25.0),
    Effect("400 Hz", rate=400.0),
    Effect("1 kHz", rate=1000.0),
    Effect("the Earth turns, latitude 52 deg, not told", latitude=LATITUDE, params={"gravity": 9.8125}),
    Effect("the Earth turns, `latitude` set", latitude=LATITUDE, params={"latitude": LATITUDE}),
)


@dataclass(frozen=True)
class Outcome:
    """Over all seeds of a motion: tilt RMS in deg, NEES over 2, share beyond 3 sigma or without attitude."""

    rms_deg: float
    half_nees: float
    beyond: float


def run(effect, scenario, seeds=SEEDS, seconds=SECONDS):
    """Return the :class:`Outcome` of an effect in a motion."""
    profile = find_profile("consumer")
    imu_errors, altimeter_errors = replace(profile.imu, **effect.imu), replace(profile.altimeter, **effect.altimeter)
    trajectory = make_trajectory(scenario, duration=seconds, latitude=effect.latitude)
    sampled = sample_trajectory(trajectory, imu_rate=effect.rate)
    scores = []
    for seed in seeds:
        recording = add_errors(sampled, imu_errors, altimeter_errors, np.random.default_rng(seed),
                               altimeter_rate=min(ALTIMETER_RATE, effect.rate))
        estimates, _ = AttitudeEstimator(AttitudeParams(**effect.params)).run(
            recording.imu, _altitude(effect, recording))
        scores.append(score_attitude(estimates.stamp_ns, estimates.q_nb_wxyz, estimates.tilt_covariance_n,
                                     estimates.valid, recording.truth))
    return Outcome(float(np.sqrt(np.mean([score.tilt_rms_deg**2 for score in scores]))),
                   float(np.mean([score.nees for score in scores])) / 2,
                   1.0 - float(np.mean([score.coverage_3sigma for score in scores])))


def _altitude(effect, recording):
    if effect.change is None:
        return None
    altitude = recording.altitude
    t = (altitude.stamp_ns - altitude.stamp_ns[0]) * 1e-9
    return AltitudeSeries(altitude.stamp_ns, effect.change(t, altitude.altitude), altitude.arrival)


def report(clean, outcomes):
    """Return the page, from the outcomes without any effect and with each."""
    lines = ["# Real effects, one at a time", "",
             f"Made by `make study`: consumer sensors, {SECONDS:g} s at {RATE:g} Hz with {ALTIMETER_RATE:g} Hz of "
             f"altitude, seeds {', '.join(map(str, SEEDS))}, scored as every recording. For each motion the tilt "
             "RMS in degrees, in brackets against that without the effect. NEES/2 and the share beyond 3 sigma are the "
             "worst of the motions.", "",
             f"| effect | {' | '.join(SCENARIOS)} | NEES/2 | beyond 3 sigma |",
             f"|---|{'---|' * (len(SCENARIOS) + 2)}"]
    for name, row in [("none", clean), *outcomes.items()]:
        cells = [f"{row[s].rms_deg:.2f} ({row[s].rms_deg / clean[s].rms_deg:.2f})" for s in SCENARIOS]
        lines.append(f"| {name} | {' | '.join(cells)} | {max(o.half_nees for o in row.values()):.2f} | "
                     f"{max(o.beyond for o in row.values()):.1%} |")
    return "\n".join([*lines, ""])


def main():
    """Run ``study_real_effects``."""
    clean = {scenario: run(Effect("none"), scenario) for scenario in SCENARIOS}
    outcomes = {}
    for effect in EFFECTS:
        outcomes[effect.name] = {scenario: run(effect, scenario) for scenario in SCENARIOS}
        print(".", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(report(clean, outcomes))
    print(OUT)
    return 0


if __name__ == "__main__":
    sys.exit(main())
