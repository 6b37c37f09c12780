"""The paper's Monte Carlo: all its filters beside the Cramer-Rao bound, its figures, a verdict on each claim.

``study_attitude`` writes docs/results/attitude.md and its plots. The runs of a motion differ in noise alone:
the paper's (0.5 deg/s, 0.1 m/s^2 and 2 m per sample at 100 Hz, no biases), from seeds 0, 1, 2 ... "The
paper" is Ghanbarpour Asl and Pourtakdust, "Strapdown attitude estimation using IMU and altimeter
integration for maneuvering vehicles"; the plots bear the numbers of its figures.
"""

import argparse
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from attitude_estimator.params import AttitudeParams
from attitude_estimator.rivals import make_estimator
from inertial.bound import SensorNoise, TiltBound, tilt_bound
from inertial.earth import STANDARD_GRAVITY
from inertial.imu_errors import PROFILES
from inertial.recording import AltitudeSeries, ImuSeries
from inertial.rotation import down_from_quaternion, roll_pitch_from_down
from inertial.scoring import tilt_error_n
from inertial.simulator import SampledTrajectory, Trajectory, make_trajectory, sample_trajectory
from inertial.trajectory import Profile, flight

OUT = Path("docs/results")
RUNS = 100
RATE = 100.0  # Hz, of IMU and altimeter
DURATION = 120.0  # s
SETTLED = 30.0  # s after which errors count
EVERY = 20  # errors are looked at in every twentieth sample: they change slowly
START_STD = np.radians(1.0)  # of the tilt at the start, where it is known
SENSORS = PROFILES["paper"]
GYRO_BIAS, ACCEL_BIAS = np.radians(0.3), 0.010 * STANDARD_GRAVITY
TAKEN_OFF = 40.0  # s, when every scenario has
LOST = np.radians(10.0)  # tilt error in the last 10 s beyond which a run has lost its attitude
CONVERGED = np.radians(5.0)
START_ERRORS_DEG = (10, 30, 60, 90)
START_MOTIONS = ("manoeuvres", "quad")
NORM_GAINS = (0.0, 5.0, 50.0, 150.0)  # 1/s
RATES = (50.0, 100.0, 200.0, 400.0)  # Hz
SAME = 0.05  # part by which two RMS values may differ and still count as equal
PAPER_LINEAR, PAPER_UKF = (0.16, 0.07), (0.21, 0.10)  # deg, roll and pitch

# Rows: seconds, speed m/s, pitch step deg, turn rate deg/s. Up and down as in the paper's figures 3 and 4,
# with gentle turns, without which nothing would show the roll.
MANOEUVRES = [
    (10, 50, 0, 0), (3, 50, 25, 4), (4, 45, -25, 4), (3, 50, 40, -4), (6, 45, -80, -4), (4, 50, 40, 4),
    (3, 55, 30, 4), (3, 50, -30, 0), (4, 50, -35, -5), (3, 55, 35, -5), (3, 50, 50, 0), (6, 45, -80, 4),
    (4, 50, 30, 4)]
MOTIONS = ("manoeuvres", "turn", "vertical_plane", "aerobatic", "car", "quad", "hover", "straight")


@dataclass(frozen=True)
class Filter:
    """An estimator with what it is told beside the sensors' noise; ``blind`` starts without an attitude."""

    estimator: str
    settings: dict = field(default_factory=dict)
    blind: bool = False


LINEAR, BLIND, UKF, EKF, EKF_FIRST = "linear", "linear, blind", "UKF", "EKF", "EKF, first order"
QUATERNION = "quaternion EKF"
FILTERS = {
    LINEAR: Filter("dcm_row5"),
    BLIND: Filter("dcm_row5", blind=True),
    UKF: Filter("euler_ukf"),
    "UKF, first order": Filter("euler_ukf_first_order"),
    EKF: Filter("euler_ekf"),
    EKF_FIRST: Filter("euler_ekf_first_order"),
    QUATERNION: Filter("quaternion_ekf"),
    "PI 0.01": Filter("complementary", {"complementary_frequency": 0.01}),
    "PI 0.03": Filter("complementary", {"complementary_frequency": 0.03}),
    "PI 0.1": Filter("complementary", {"complementary_frequency": 0.1}),
    "eq. 18, 0.03": Filter("complementary_literal", {"complementary_frequency": 0.03}),
    "levelling": Filter("accelerometer"),
    "gyro": Filter("gyro"),
    "gyro, Euler": Filter("gyro_euler"),
}
KALMAN = (LINEAR, BLIND, UKF, "UKF, first order", EKF, EKF_FIRST, QUATERNION)


@dataclass(frozen=True)
class Motion:
    """A sampled motion with the truth that the study needs, and its bound; (N,) and (N, 3)."""

    sampled: SampledTrajectory
    down_b: np.ndarray
    t: np.ndarray
    bound: TiltBound

    @property
    def used(self):
        """Indices of the samples that are looked at."""
        return np.arange(0, len(self.t), EVERY)

    @property
    def late(self):
        """Of those, which count: (K,) bool."""
        return self.t[self.used] > SETTLED


@dataclass(frozen=True)
class MonteCarlo:
    """All runs of one filter in one motion at K stamps; NaN where there is no attitude.

    Attributes
    ----------
    tilt : (runs, K), rad
    down_error_b : (runs, K, 3)
    roll_pitch_error, roll_pitch_std : (runs, K, 2), rad
        The predicted ones follow from the tilt's covariance.
    tilt_std : (runs, K), rad
    nees : (runs, K)
        Normalised squared error of the tilt; ideally 2.
    norm : (runs, K)
        Length of the down direction in the filter.
    """

    tilt: np.ndarray
    down_error_b: np.ndarray
    roll_pitch_error: np.ndarray
    roll_pitch_std: np.ndarray
    tilt_std: np.ndarray
    nees: np.ndarray
    norm: np.ndarray

    def rms_deg(self, late):
        """RMS of the tilt error over the late part of all runs, deg."""
        return np.degrees(_root_mean(self.tilt[:, late]))

    def lost(self):
        """Share of the runs that end without an attitude or far off."""
        return np.mean(~(_root_mean(self.tilt[:, -int(10 * RATE) // EVERY:], axis=1) < LOST))


def main(argv=None):
    """Run ``study_attitude``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=OUT, help="folder of the results")
    parser.add_argument("--runs", type=int, default=RUNS, help="runs of each motion and filter")
    parser.add_argument("--motions", nargs="+", default=MOTIONS[1:], choices=MOTIONS[1:],
                        help=f"those beside {MOTIONS[0]}")
    arguments = parser.parse_args(argv)
    plots = arguments.out / "attitude"
    plots.mkdir(parents=True, exist_ok=True)
    runs, few = arguments.runs, max(arguments.runs // 4, 1)
    home = sample_motion(MOTIONS[0])
    home_results = run_all(home, FILTERS, runs)
    motions = {MOTIONS[0]: home} | {name: sample_motion(name) for name in arguments.motions}
    results = {name: home_results if motion is home else run_all(motion, FILTERS, few)
               for name, motion in motions.items()}
    holds = {k: Filter("dcm_row5_gamma", {"norm_gain": k}) for k in NORM_GAINS}
    norms = run_all(home, holds | {LINEAR: FILTERS[LINEAR]}, few)
    biased, starts = biased_results(motions, few), far_starts(few)
    draw(plots, home, home_results, norms)
    sections = [
        heading(runs, few), figures_section(home, home_results, norms),
        claims_section(home, home_results, motions, results, norms, biased, starts),
        rms_section(motions, results), consistency_section(motions, results), start_section(starts),
        loops_section(motions, results), bias_section(motions, biased),
        norm_section(home, norms), rate_section(few), speed_section(home, runs)]
    text = "\n\n".join("\n".join(section) for section in sections) + "\n"
    (arguments.out / "attitude.md").write_text(text, encoding="utf-8")
    print(arguments.out / "attitude.md")


# --- running ------------------------------------------------------------------------------------------


def manoeuvres():
    """Return the trajectory that stands for the paper's own."""
    rows = [*MANOEUVRES] * 3
    knots = 3.0 + np.concatenate([[0.0], np.cumsum([row[0] for row in rows])])
    speed, step, turn = np.array(rows, dtype=float).T[1:]
    profiles = (Profile(knots, np.concatenate([[0.0], column]))
                for column in (speed, np.radians(np.cumsum(step)), np.radians(turn), 0.0 * turn))
    return Trajectory(MOTIONS[0], DURATION, flight(*profiles, STANDARD_GRAVITY), STANDARD_GRAVITY)


def sample_motion(name, rate=RATE):
    """Return the :class:`Motion` of a name in ``MOTIONS``."""
    trajectory = manoeuvres() if name == MOTIONS[0] else make_trajectory(name, duration=DURATION)
    sampled = sample_trajectory(trajectory, imu_rate=rate)
    down_b = down_from_quaternion(sampled.truth.q_nb_wxyz)
    stamp_ns = sampled.imu.stamp_ns
    bound = tilt_bound(sampled.imu, down_b, stamp_ns, sensor_noise(rate), tilt_std=START_STD)
    return Motion(sampled, down_b, (stamp_ns - stamp_ns[0]) * 1e-9, bound)


def sensor_noise(rate):
    """Return the paper's noise per sample as densities at this rate."""
    noise, share = SensorNoise.of(SENSORS), np.sqrt(RATE / rate)
    return SensorNoise(noise.gyro_noise_density * share, noise.accel_noise_density * share,
                       noise.altitude_std)


def parameters(chosen, rate=RATE):
    """Return the filter's parameters: what it is told of the noise is what it is."""
    noise = sensor_noise(rate)
    return AttitudeParams(
        estimator=chosen.estimator, gyro_noise_density=noise.gyro_noise_density,
        accel_noise_density=noise.accel_noise_density, altitude_std=noise.altitude_std, **chosen.settings)


def noisy(motion, seed, rate=RATE, biases=(0.0, 0.0)):
    """Return IMU and altitudes of one run, then what its start is off, (3,)."""
    rng, paper = np.random.default_rng(seed), sensor_noise(rate)
    imu, count = motion.sampled.imu, len(motion.t)
    bias, off = rng.standard_normal((2, 3)), rng.standard_normal(3)
    gyro_b, accel_b, altitude = (rng.standard_normal(shape) for shape in ((count, 3), (count, 3), count))
    gyro_b *= paper.gyro_noise_density * np.sqrt(rate)
    gyro_b += imu.gyro_b
    gyro_b += biases[0] * bias[0]
    accel_b *= paper.accel_noise_density * np.sqrt(rate)
    accel_b += imu.accel_b
    accel_b += biases[1] * bias[1]
    altitude *= paper.altitude_std
    altitude -= motion.sampled.position_n[:, 2]
    return (ImuSeries(imu.stamp_ns, gyro_b, accel_b),
            AltitudeSeries(imu.stamp_ns, altitude, np.arange(1, count + 1)), off)


def start(estimator, chosen, down_b, off):
    """Start a filter near the truth; ``off`` is a random vector."""
    if not chosen.blind:
        estimator.start_at(down_b + np.cross(off, down_b) * START_STD / np.sqrt(2), START_STD)


def run_all(motion, filters, runs, biases=(0.0, 0.0), rate=RATE):
    """Return the :class:`MonteCarlo` of each filter; all see the same noise."""
    errors = {name: [] for name in filters}
    for seed in range(runs):
        imu, altitude, off = noisy(motion, seed, rate, biases)
        for name, chosen in filters.items():
            estimator = make_estimator(parameters(chosen, rate))
            start(estimator, chosen, motion.down_b[0], off)
            estimates, fresh = estimator.run(imu, altitude)
            assert fresh.all()
            errors[name].append(errors_of(estimates, motion))
    return {name: MonteCarlo(*map(np.array, zip(*parts, strict=True))) for name, parts in errors.items()}


def errors_of(estimates, motion):
    """Return what :class:`MonteCarlo` holds, for one run."""
    used = motion.used
    estimates = type(estimates)(estimates.stamp_ns[used], estimates.rows[used])
    true_b, hidden = motion.down_b[used], np.where(estimates.valid, 0.0, np.nan)
    tilt = tilt_error_n(estimates.q_nb_wxyz, true_b) + hidden[:, None]
    covariance = estimates.tilt_covariance_n
    determinant = covariance[:, 0, 0] * covariance[:, 1, 1] - covariance[:, 0, 1] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        nees = (covariance[:, 1, 1] * tilt[:, 0] ** 2 - 2 * covariance[:, 0, 1] * tilt[:, 0] * tilt[:, 1]
                + covariance[:, 0, 0] * tilt[:, 1] ** 2) / determinant
    estimated, true = (np.stack(roll_pitch_from_down(d), axis=-1) for d in (estimates.down_b, true_b))
    return (np.linalg.norm(tilt, axis=-1), estimates.down_b - true_b + hidden[:, None],
            np.angle(np.exp(1j * (estimated - true))) + hidden[:, None],
            predicted_roll_pitch(estimates) + hidden[:, None],
            np.sqrt(np.trace(covariance, axis1=-2, axis2=-1)) + hidden, nees, estimates.down_norm)


def predicted_roll_pitch(estimates):
    """Return the standard deviations of roll and pitch that the tilt's covariance means, (K, 2).

    With the heading psi of the estimate, a turn (n, e) about north and east changes pitch by
    ``e cos psi - n sin psi`` and roll by ``(n cos psi + e sin psi) / cos pitch``.
    """
    w, x, y, z = np.moveaxis(estimates.q_nb_wxyz, -1, 0)
    heading = np.arctan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z)
    cosine, sine = np.cos(heading), np.sin(heading)
    pitch = roll_pitch_from_down(estimates.down_b)[1]
    (nn, ne), (_, ee) = np.moveaxis(estimates.tilt_covariance_n, 0, -1)
    roll_var = cosine**2 * nn + 2 * sine * cosine * ne + sine**2 * ee
    pitch_var = sine**2 * nn - 2 * sine * cosine * ne + cosine**2 * ee
    return np.sqrt(np.maximum(np.stack([roll_var / np.cos(pitch) ** 2, pitch_var], axis=-1), 0.0))


def biased_results(motions, runs):
    """Return {motion: {filter: MonteCarlo}} with biased sensors, for filters without biases and with them."""
    default = Filter("dcm_row", {"gyro_bias_std": GYRO_BIAS, "accel_bias_std": ACCEL_BIAS}, blind=True)
    filters = {LINEAR: FILTERS[LINEAR], "default": default}
    return {name: run_all(motion, filters, runs, (GYRO_BIAS, ACCEL_BIAS))
            for name, motion in motions.items()}


def _root_mean(values, axis=None):
    """Root of the mean square; NaN counts as no attitude and makes the whole NaN."""
    return np.sqrt(np.mean(np.square(values), axis=axis))


# --- the page -----------------------------------------------------------------------------------------


def heading(runs, few):
    """Return what the reader needs to know first."""
    return [
        "# The paper's filters", "",
        f"Made by `study_attitude`: {runs} runs of {DURATION:.0f} s at {RATE:.0f} Hz in `{MOTIONS[0]}`, {few} in "
        "the other motions, seeds 0, 1, 2 ..., white noise of 0.5 deg/s, 0.1 m/s^2 and 2 m per sample, no "
        f"biases. Unless told otherwise a filter starts {np.degrees(START_STD):.0f} deg (one sigma) off and "
        f"knows it, and errors count after {SETTLED:.0f} s. The bound is the posterior Cramer-Rao bound of IMU "
        "and altimeter from the same start. *Tilt* is the angle between estimated and true down direction, in "
        "degrees, RMS over time and runs.", "",
        f"`{MOTIONS[0]}` stands for the paper's own motion, of which it gives no numbers: pull-ups and dives "
        "up to 50 deg with gentle turns. The estimators by the names that `attitude_node` and `estimate_bag` "
        "know them by:", "",
        ", ".join(f"{name}: `{chosen.estimator}`" for name, chosen in FILTERS.items())
        + ". The figures behind PI and eq. 18 are corner frequencies in rad/s."]


def table(header, rows):
    """Return the lines of a Markdown table."""
    return ["", "| " + " | ".join(header) + " |", "|" + "---|" * len(header),
            *("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows)]


def pair(values):
    """Return roll and pitch, or any two figures, as text."""
    return " / ".join(f"{value:.2f}" for value in values)


def span(values):
    """Return smallest and largest as text."""
    return f"{values.min():.3g} to {values.max():.3g}"


def roll_pitch_rms(result, late):
    """RMS of roll and pitch error, deg."""
    return np.degrees(_root_mean(result.roll_pitch_error[:, late], axis=(0, 1)))


def predicted_rms(result, late):
    """RMS of the predicted deviations of roll and pitch, deg."""
    return np.degrees(_root_mean(result.roll_pitch_std[:, late], axis=(0, 1)))


def figures_section(motion, results, norms):
    """Return the table of the paper's figures and the plots."""
    late, imu = motion.late, motion.sampled.imu
    roll, pitch = np.degrees(roll_pitch_from_down(motion.down_b))
    linear, ukf = results[LINEAR], results[UKF]
    off, on = (_root_mean(norms[k].norm[:, late] - 1.0) for k in (0.0, 50.0))
    down = _root_mean(linear.down_error_b[:, late], axis=(0, 1))
    rows = [
        (2, "elements of c", "-", ", ".join(span(c) for c in motion.down_b.T), "shown"),
        (3, "specific force", "large in the vertical plane", f"z {span(imu.accel_b[:, 2])} m/s^2",
         "of the same kind"),
        (4, "velocity down, altitude", "-", f"{span(motion.sampled.velocity_n[:, 2])} m/s, "
         f"{span(-motion.sampled.position_n[:, 2])} m", "shown"),
        (5, "angular rate", "-", f"y {span(np.degrees(imu.gyro_b[:, 1]))} deg/s", "shown"),
        (6, "roll, pitch", "-", f"{span(roll)}, {span(pitch)} deg", "shown"),
        (7, "RMS of roll / pitch error, linear, deg", f"{pair(PAPER_LINEAR)}, bounded",
         pair(roll_pitch_rms(linear, late)), bounded(linear)),
        (8, "RMS of the errors of c, linear", "bounded", ", ".join(f"{v:.4f}" for v in down),
         bounded(linear)),
        (9, "predicted deviation of roll / pitch, linear, deg", "agrees with figure 7",
         pair(predicted_rms(linear, late)), agreement(linear, late)),
        (10, "RMS of the norm's error, k gamma off / on (50 1/s)", "bounded, k gamma helps",
         f"{off:.1e} / {on:.1e}", "reproduced" if on < off else "not reproduced"),
        (11, "predicted deviation of roll / pitch, UKF, deg", "agrees with figure 12",
         pair(predicted_rms(ukf, late)), agreement(ukf, late)),
        (12, "RMS of roll / pitch error, UKF, deg", f"{pair(PAPER_UKF)}, larger than the linear filter's",
         pair(roll_pitch_rms(ukf, late)), ranking(linear, ukf, late)),
    ]
    names = ("motion", "linear", "norm", "ukf")
    return ["## Figures 2 to 12", "",
            "The paper's figures are not of this motion, and its noise density depends on a sample rate that "
            "it does not tell: compare what they say, not the digits.",
            *table(("figure", "what", "the paper", "here", "verdict"), rows), "",
            *(f"![figures, {name}](attitude/{name}.png)" for name in names)]


def bounded(result):
    """Whether the error of the last 30 s is no larger than before."""
    part = int(30 * RATE) // EVERY
    before, after = _root_mean(result.tilt[:, part:2 * part]), _root_mean(result.tilt[:, -part:])
    word = "reproduced" if after < 1.5 * before else "not reproduced"
    return (f"{word}: tilt {np.degrees(before):.2f} deg from 30 to 60 s, {np.degrees(after):.2f} deg in the "
            "last 30 s")


def agreement(result, late):
    """Whether errors are as large as predicted."""
    ratio = np.mean(result.nees[:, late]) / 2
    return f"{'reproduced' if 0.8 < ratio < 1.25 else 'not reproduced'}: NEES/2 {ratio:.2f}"


def ranking(linear, ukf, late):
    """Whether the UKF is worse than the linear filter."""
    ratio = ukf.rms_deg(late) / linear.rms_deg(late)
    word = "reproduced" if ratio > 1 + SAME else "not reproduced"
    return f"{word}: tilt {ratio:.2f} of the linear filter's"


def claims_section(home, home_results, motions, results, norms, biased, starts):
    """Return the table of the paper's claims."""
    late = home.late
    rms = {name: result.rms_deg(late) for name, result in home_results.items()}
    free, held = norms[0.0].rms_deg(late), norms[50.0].rms_deg(late)
    wild = _root_mean(norms[NORM_GAINS[-1]].norm[:, late] - 1.0)
    accelerated = ("PI 0.01", "PI 0.03", "PI 0.1", "eq. 18, 0.03", "levelling")
    straight, turning = unknown_tilt_bounds()
    rows = [
        ("the linear filter is better than the UKF (section 6)",
         f"tilt of UKF/linear: {across(motions, results, UKF)}; {rms['UKF, first order'] / rms[LINEAR]:.2f} with "
         f"first-order steps in {MOTIONS[0]} (the paper's roll and pitch: "
         f"{pair(np.divide(PAPER_UKF, PAPER_LINEAR))})", where_worse(motions, results, UKF, starts)),
        ("an EKF of Euler angles diverges (section 7)",
         f"runs lost: {lost_in(results, EKF)}; with first-order steps {lost_in(results, EKF_FIRST)}",
         where_lost(results, (EKF, EKF_FIRST))),
        ("quaternions leave the height channel nonlinear, hence large errors (section 1)",
         f"tilt of quaternion EKF/linear: {across(motions, results, QUATERNION)}",
         where_worse(motions, results, QUATERNION, starts)),
        ("the error is bounded (figures 7, 8)", *reversed(bounded(home_results[LINEAR]).split(": "))),
        ("the predicted deviation agrees (figures 7, 9)",
         *reversed(agreement(home_results[LINEAR], late).split(": "))),
        ("k gamma helps (figure 10)", f"tilt {held:.3f} deg with it, {free:.3f} deg without",
         f"it keeps the norm, the tilt is {held / free:.2f} of that without"),
        ("k is large (equation 15)",
         f"k = {NORM_GAINS[-1]:.0f} 1/s at {RATE:.0f} Hz: RMS of the norm's error {wild:.1e}",
         "wrong: k dt must stay below 1" if wild > 0.01 else "harmless here"),
        ("acceleration north or east has no effect (section 6)",
         f"bound {DURATION - TAKEN_OFF:.0f} s after an unknown tilt: straight flight {straight:.0f} deg, turns "
         f"{turning:.2f} deg",
         "wrong: it is what shows the tilt" if turning < 0.1 * straight else "reproduced"),
        ("accelerometer schemes fail when accelerated (abstract)",
         ", ".join(f"{name} {rms[name]:.1f}" for name in accelerated) + f" deg, linear {rms[LINEAR]:.2f} deg",
         "reproduced" if min(rms[name] for name in accelerated) > 2 * rms[LINEAR] else "not reproduced"),
        ("sensors without biases (section 6)", "with 0.3 deg/s and 10 mg, linear: " + ", ".join(
            f"{name} {part[LINEAR].rms_deg(motions[name].late):.1f} deg" for name, part in biased.items()),
         "needed: see the table of biases"),
    ]
    return ["## Its claims", *table(("claim", "here", "verdict"), rows)]


def ratio(motions, results, name, motion):
    """Return the RMS of a filter in a motion relative to the linear one's."""
    late = motions[motion].late
    return results[motion][name].rms_deg(late) / results[motion][LINEAR].rms_deg(late)


def across(motions, results, name):
    """Return the RMS of a filter relative to the linear one's in each motion."""
    return ", ".join(f"{motion} {ratio(motions, results, name, motion):.2f}" for motion in motions)


def where_worse(motions, results, name, starts):
    """Return in which motions, and from which starts, a filter is worse than the linear one."""
    worse = [motion for motion in motions if ratio(motions, results, name, motion) > 1 + SAME]
    far = sorted({error for (_, which, error), share in starts.items() if which == name and share < 1})
    words = [f"worse in {', '.join(worse)}"] if worse else []
    words += [f"not sure to converge from {far[0]} deg off"] if far else []
    return "; ".join(words) + "; otherwise as good or better" if words else "not reproduced: as good or better"


def lost_in(results, name):
    """Return the share of lost runs in each motion where there are any."""
    lost = [f"{part[name].lost():.0%} in {motion}" for motion, part in results.items() if part[name].lost() > 0]
    return ", ".join(lost) or "none"


def where_lost(results, names):
    """Return in which motions a filter loses runs."""
    lost = [motion for motion, part in results.items() if any(part[name].lost() > 0 for name in names)]
    return f"only in {', '.join(lost)}" if lost else "not reproduced"


def unknown_tilt_bounds():
    """Return how well, in deg, a tilt that nobody told can be known in straight flight and in turns."""
    bounds = []
    for name in ("straight", "turn"):
        sampled = sample_motion(name).sampled
        down_b = down_from_quaternion(sampled.truth.q_nb_wxyz)
        after = slice(int(TAKEN_OFF * RATE), None)
        imu = ImuSeries(*(values[after] for values in vars(sampled.imu).values()))
        bound = tilt_bound(imu, down_b[after], imu.stamp_ns, sensor_noise(RATE))
        bounds.append(np.degrees(bound.tilt_std[-1]))
    return bounds


def rms_section(motions, results):
    """Return the table of RMS."""
    rows = []
    for name, motion in motions.items():
        late = motion.late
        bound = np.degrees(motion.bound.tilt_rms(motion.used[late]))
        rows.append((name, f"{bound:.2f}", *(rms_cell(results[name][which], late) for which in FILTERS)))
    return ["## Tilt RMS beside the bound, deg", "",
            "In brackets the share of the time with an attitude, where that is not all. The blind filter has "
            "no start, so its bound is higher until the motion has shown the tilt. Where nothing accelerates "
            "horizontally (straight, hover, the roll in vertical_plane) the altimeter shows nothing and every "
            "filter only carries its start.",
            *table(("motion", "bound", *FILTERS), rows)]


def rms_cell(result, late):
    """Return the RMS, and the share of the time with an attitude where that is not all."""
    known = np.isfinite(result.tilt[:, late])
    if not known.any():
        return "-"
    rms = f"{np.degrees(_root_mean(result.tilt[:, late][known])):.2f}"
    return rms if known.all() else f"{rms} ({known.mean():.0%})"


def consistency_section(motions, results):
    """Return the table of NEES and of errors beyond three sigma."""
    rows = []
    for name, motion in motions.items():
        cells = []
        for which in KALMAN:
            result, late = results[name][which], motion.late
            nees = np.mean(result.nees[:, late]) / 2
            beyond = np.mean(result.tilt[:, late] > 3 * result.tilt_std[:, late])
            cells.append(f"{nees:.3g}, {beyond:.1%}" if np.isfinite(nees) else "-")
        rows.append((name, *cells))
    return ["## NEES/2 and share of errors beyond three sigma", "",
            "Honest is 1.00 and, for a tilt whose two axes are equally known, 0.01 %.",
            *table(("motion", *KALMAN), rows)]


def far_starts(runs):
    """Return {(motion, filter, error in deg): share of the runs that converge}."""
    shares = {}
    for name in START_MOTIONS:
        motion = sample_motion(name)
        for which in (UKF, EKF, QUATERNION):
            for error in START_ERRORS_DEG:
                shares[name, which, error] = far_start(motion, FILTERS[which], np.radians(error), runs)
        blind = run_all(motion, {BLIND: FILTERS[BLIND]}, runs)[BLIND]
        converged = np.mean(np.max(blind.tilt[:, motion.late], axis=1) < CONVERGED)
        shares.update({(name, BLIND, error): converged for error in START_ERRORS_DEG})
    return shares


def far_start(motion, chosen, error, runs):
    """Return the share of runs that converge from a start off by the error."""
    converged = 0
    for seed in range(runs):
        imu, altitude, off = noisy(motion, seed)
        down_b = motion.down_b[0]
        axis_b = np.cross(off, down_b)
        start_b = np.cos(error) * down_b + np.sin(error) * axis_b / np.linalg.norm(axis_b)
        estimator = make_estimator(parameters(chosen))
        estimator.start_at(start_b, error)
        estimates, _ = estimator.run(imu, altitude)
        converged += np.max(errors_of(estimates, motion)[0][motion.late]) < CONVERGED
    return converged / runs


def start_section(starts):
    """Return the table of far-off starts."""
    rows = [(name, which, *(f"{starts[name, which, error]:.0%}" for error in START_ERRORS_DEG))
            for name in START_MOTIONS for which in (UKF, EKF, QUATERNION, BLIND)]
    header = ("motion", "filter", *(f"{error} deg" for error in START_ERRORS_DEG))
    return ["## Far-off starts", "",
            f"Share of the runs whose tilt error stays below {np.degrees(CONVERGED):.0f} deg from "
            f"{SETTLED:.0f} s on. The filters start off by the error, about a random horizontal axis, and are "
            "told so. The blind linear filter needs no start.", *table(header, rows)]


def loops_section(motions, results):
    """Return what loops do to each filter."""
    if "aerobatic" not in motions:
        return ["## Loops through +-90 deg", "", "Not run."]
    motion, late = motions["aerobatic"], motions["aerobatic"].late
    pitch = roll_pitch_from_down(motion.down_b)[1]
    steep = np.abs(np.degrees(pitch)) > 85
    passes = np.count_nonzero(np.diff(steep.astype(int)) == 1)
    rows = [(which, rms_cell(results["aerobatic"][which], late), f"{results['aerobatic'][which].lost():.0%}")
            for which in FILTERS]
    return ["## Loops through +-90 deg", "",
            f"`aerobatic` passes {passes} times beyond 85 deg of pitch. Lost: more than "
            f"{np.degrees(LOST):.0f} deg off in the last 10 s.",
            *table(("filter", "tilt RMS, deg", "runs lost"), rows)]


def bias_section(motions, biased):
    """Return the table of biased sensors."""
    rows = [(name, *(rms_cell(result, motions[name].late) for result in part.values()))
            for name, part in biased.items()]
    header = ("motion", *next(iter(biased.values())))
    return ["## Biases of 0.3 deg/s and 10 mg (one sigma, each axis)", "",
            "Tilt RMS, deg. The default filter (`dcm_row`) starts blind, estimates both and also uses gravity.",
            *table(header, rows)]


def norm_section(motion, norms):
    """Return the table of k."""
    late = motion.late
    names = {k: f"k = {k:.0f} 1/s (k dt = {k / RATE:.2g})" for k in NORM_GAINS}
    names[LINEAR] = "projection (`dcm_row5`)"
    rows = [(names[hold], f"{_root_mean(result.norm[:, late] - 1):.1e}", f"{result.rms_deg(late):.3f}",
             f"{np.mean(result.nees[:, late]) / 2:.2f}") for hold, result in norms.items()]
    return ["## Ways to hold the norm", "",
            f"The first {len(norms[LINEAR].tilt)} runs of `{MOTIONS[0]}`. The NEES is that of the two tilt axes; "
            "the error along c is no error of attitude.",
            *table(("hold", "RMS of the norm's error", "tilt RMS, deg", "NEES/2"), rows)]


def rate_section(runs):
    """Return how bound and filter depend on the sample rate."""
    rows = []
    for rate in RATES:
        motion = sample_motion(MOTIONS[0], rate)
        result = run_all(motion, {LINEAR: FILTERS[LINEAR]}, runs, rate=rate)[LINEAR]
        late = motion.late
        rows.append((f"{rate:.0f}", f"{np.degrees(motion.bound.tilt_rms(motion.used[late])):.3f}",
                     f"{result.rms_deg(late):.3f}", pair(roll_pitch_rms(result, late))))
    return ["## Sample rate", "",
            f"The same noise per sample at other rates: the more samples, the less noise in a second. The "
            f"paper's {pair(PAPER_LINEAR)} deg is one such choice.",
            *table(("Hz", "bound, deg", "linear, tilt RMS, deg", "roll / pitch, deg"), rows)]


def speed_section(motion, runs):
    """Return how long the Monte Carlo of the paper's filter takes."""
    began = time.perf_counter()
    for seed in range(runs):
        imu, altitude, _ = noisy(motion, seed)
        make_estimator(parameters(FILTERS[LINEAR])).run(imu, altitude)
    took = time.perf_counter() - began
    return ["## Speed", "",
            f"{runs} runs of {DURATION:.0f} s at {RATE:.0f} Hz of `dcm_row5`, noise included: {took:.2f} s on one "
            f"core of the machine that made this page, {took / (runs * len(motion.t)) * 1e6:.2f} us a sample."]


# --- plots --------------------------------------------------------------------------------------------


def draw(plots, motion, results, norms):
    """Draw the paper's figures for one motion."""
    imu, t = motion.sampled.imu, motion.t[motion.used]
    vertical = np.stack([motion.sampled.velocity_n[:, 2], -motion.sampled.position_n[:, 2]], axis=-1)
    angles = np.degrees(np.stack(roll_pitch_from_down(motion.down_b), axis=-1))
    roll_pitch = ["roll", "pitch"]
    _panels(plots / "motion.png", motion.t, [
        ("2: down direction", motion.down_b, "xyz"), ("3: specific force, m/s$^2$", imu.accel_b, "xyz"),
        ("4: m/s and m", vertical, ["velocity down", "altitude"]),
        ("5: rate, deg/s", np.degrees(imu.gyro_b), "xyz"), ("6: deg", angles, roll_pitch)])
    linear, ukf = results[LINEAR], results[UKF]
    tilt = np.degrees(np.stack([_root_mean(linear.tilt, axis=0), _root_mean(linear.tilt_std, axis=0),
                                motion.bound.tilt_std[motion.used]], axis=-1))
    _panels(plots / "linear.png", t, [
        ("7: error, deg", np.degrees(_root_mean(linear.roll_pitch_error, axis=0)), roll_pitch),
        ("8: error of c", _root_mean(linear.down_error_b, axis=0), "xyz"),
        ("9: predicted, deg", np.degrees(_root_mean(linear.roll_pitch_std, axis=0)), roll_pitch),
        ("tilt, deg", tilt, ["error", "predicted", "bound"])], logarithmic=True)
    norm = np.stack([_root_mean(norms[k].norm - 1.0, axis=0) for k in NORM_GAINS], axis=-1)
    _panels(plots / "norm.png", t, [
        ("10: error of |c|", norm, [f"k = {k:.0f} 1/s" for k in NORM_GAINS])], logarithmic=True)
    _panels(plots / "ukf.png", t, [
        ("11: predicted, deg", np.degrees(_root_mean(ukf.roll_pitch_std, axis=0)), roll_pitch),
        ("12: error, deg", np.degrees(_root_mean(ukf.roll_pitch_error, axis=0)), roll_pitch)],
        logarithmic=True)


def _panels(path, t, panels, logarithmic=False):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 0.6 + 1.9 * len(panels)), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(panels), sharex=True))
    for axis, (label, values, names) in zip(axes, panels, strict=True):
        axis.plot(t, values, linewidth=0.9, label=list(names))
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
        axis.legend(loc="upper right", fontsize="small")
        if logarithmic:
            axis.set_yscale("log")
    axes[-1].set_xlabel("s")
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    main()
