"""A small helicopter: model, controller, Kalman-Bucy filter, figures 2 and 3, and where they end.

``study_helicopter`` writes docs/results/helicopter.md and its plots; every figure in it is computed here, from fixed
seeds. "The paper" is that of :mod:`inertial.helicopter`.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np

from attitude_estimator.navigation import _kernels as kernels
from inertial.helicopter import (
    LINEAR_RANGE,
    OUTPUTS,
    LinearModel,
    LinearRangeWarning,
    UndetectableError,
    fly,
    kalman_bucy,
    linearising_controller,
    r50_hover,
    relative_degrees,
    zero_dynamics,
)
from inertial.imu_errors import PROFILES, apply_imu_errors
from inertial.recording import ImuSeries
from inertial.rotation import (
    dcm_nb_from_euler,
    down_from_quaternion,
    down_from_roll_pitch,
    quaternion_conjugate,
    quaternion_from_dcm,
    quaternion_log,
    quaternion_multiply,
    roll_pitch_from_down,
)
from studies import head_commit
from studies.north_finding import rms, table

SEED = 20240601
DEG = np.pi / 180
INTERVAL = 0.01  # s
DURATION = 20.0  # s
SETTLED = 2.0  # s after which errors count
COMMAND = np.array([-30 * DEG, 20 * DEG, 0.0, 0.0])
GENTLE = np.array([5 * DEG, 5 * DEG, 0.0, 0.0])
NOISE_STD = np.array([1 * DEG, 1 * DEG, 1 * DEG, 0.3])  # the page's 1 deg; 0.3 m of an altimeter
# Gusts, in units per root second: the filter knows them, the plant feels them.
GUSTS = {"u": 0.15, "v": 0.15, "w": 0.15, "p": 0.025, "q": 0.025, "r": 0.025}
FILTERED_LIMIT_DEG = 0.15
RAW_DEG = 0.99
SHARES = (0.1, 0.25, 0.5, 0.75, 1.0)
SCALES = {"roll, deg": (-35, 5), "pitch, deg": (-5, 25), "heading, deg": (-5, 5), "height, m": (-1, 1)}
MODEL_ERRORS = (0.0, 0.1, 0.2, 0.3)
# Of the 13 states in hover, of each pair one; the tolerance is a unit of the last digit that is listed.
LISTED = ("0.306+0.094j", "-0.401+0.086j", "-0.608", "-1.70+8.19j", "-2.66+11.58j", "-6.20+8.20j", "-20.17+4.70j")
GYROS = PROFILES["consumer"].imu
GYRO_BIAS_STD = 1 * DEG  # rad/s, of which the gyros' filter starts


def main(argv=None):
    """Write the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/results"), help="folder of the results")
    parser.add_argument("--runs", type=int, default=20, help="flights for each figure that varies with the noise")
    arguments = parser.parse_args(argv)
    (arguments.out / "helicopter").mkdir(parents=True, exist_ok=True)
    lines = ["# The helicopter", "",
             f"Made by `study_helicopter` from commit {head_commit()}, seed {SEED}.", "",
             *helicopter_report(arguments.out / "helicopter", arguments.runs)]
    (arguments.out / "helicopter.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(arguments.out / "helicopter.md")


def helicopter_report(plots, runs=20):
    """Return the study's lines of Markdown, and write its plots.

    Parameters
    ----------
    plots : Path
        Folder of the plots, shown as ``<its name>/figure_2.png``.
    runs : int
        Flights for each figure that varies with the noise.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LinearRangeWarning)  # range_section tells which flights are warned of
        sections = [model_section(), figures_section(plots, runs), detectability_section(), range_section(plots),
                    model_or_sensor_section(runs)]
    return "\n\n".join("\n".join(section) for section in sections).split("\n")


# --- model and controller -----------------------------------------------------------------------------


def eigenvalue_misses():
    """Return the listed eigenvalues and what they are off in the worse part, in units of their last digit."""
    found = np.linalg.eigvals(r50_hover(heading_and_height=False).A)
    misses = {}
    for listed in LISTED:
        value = complex(listed)
        miss = found[np.argmin(np.abs(found - value))] - value
        unit = 10.0 ** -len(listed.split(".")[-1].rstrip("j"))
        misses[listed] = max(abs(miss.real), abs(miss.imag)) / unit
    return misses


def model_section():
    """Return eigenvalues, relative degrees and zero dynamics."""
    rows = [(listed.replace("+", " +- ").replace("j", "i"), f"{miss:.2f}", "reproduced" if miss < 1 else "**not**")
            for listed, miss in eigenvalue_misses().items()]
    model = r50_hover()
    inside = zero_dynamics(model)
    loop = np.linalg.eigvals(model.A - model.B @ linearising_controller(model).feedback)
    return ["## Model and controller", "",
            "The Yamaha R-50 in hover (CMU-RI-TR-00-03), 13 states. Two of its derivatives, Nv and Nw, are "
            "second-hand: from a reprint of the report's table.",
            *table(("eigenvalue listed, 1/s", "miss, units of the last digit", "verdict"), rows), "",
            "Heading and height are integrated on top. Input-output linearisation: relative degrees of roll, pitch, "
            f"heading and height {', '.join(map(str, relative_degrees(model)))}, ten of 15 states. The other five, the "
            f"zero dynamics, have {', '.join(map(_complex, inside))} 1/s: "
            f"{'stable' if inside.real.max() < 0 else '**unstable**'}. The slowest closed-loop eigenvalue is "
            f"{loop.real.max():.3f} 1/s: the velocities, which only drag holds."]


def _complex(value):
    return f"{value.real:.2f}" + (f"{value.imag:+.2f}i" if value.imag else "")


def gusts(model):
    """Return the spectral density of the gusts, (n, n)."""
    return np.diag([GUSTS.get(name, 0.0) ** 2 for name in model.states])


def filter_of(model, outputs=OUTPUTS):
    """Return the Kalman-Bucy filter that measures these of the outputs 100 times a second."""
    noise_std = NOISE_STD[[OUTPUTS.index(name) for name in outputs]]
    return kalman_bucy(model, outputs, gusts(model), np.diag(noise_std**2) * INTERVAL)


def flight(command=COMMAND, *, believed=None, filtered=True, seed=0, duration=DURATION, **settings):
    """Return a run of the true helicopter; controller and filter are built from the believed model."""
    true = r50_hover()
    believed = true if believed is None else believed
    noise = {"kalman": filter_of(believed), "measurement_std": NOISE_STD, "process_density": gusts(true)}
    return fly(true, linearising_controller(believed), command, duration=duration, interval=INTERVAL,
               rng=np.random.default_rng([SEED, seed]), **(noise if filtered else {}), **settings)


def errors_deg(run, roll_pitch):
    """Return the RMS errors (2,) of roll and pitch (N, 2), deg."""
    late = run.time >= SETTLED
    return np.degrees([rms(error) for error in (roll_pitch - run.output[:, :2])[late].T])


# --- figures 2 and 3 ----------------------------------------------------------------------------------


def figures_section(plots, runs):
    """Return what figures 2 and 3 show, and draw them."""
    quiet, flights = flight(filtered=False, duration=10.0), [flight(seed=seed) for seed in range(runs)]
    draw_outputs(plots / "figure_2.png", quiet, "no noise, no filter")
    draw_outputs(plots / "figure_3.png", flights[0], "noise, and the filter in the loop")
    hover = flight(np.zeros(4))
    raw, filtered = (np.array([errors_deg(run, series(run)[:, :2]) for run in flights])
                     for series in (lambda run: run.measured, lambda run: run.filtered))
    reached = [f"{value:.2f}" for value in np.degrees(quiet.output[-1, :3])]
    expected = expected_deg(filter_of(r50_hover()))
    rows = [(name, f"{rms(raw[:, axis]):.3f}", f"{RAW_DEG}", f"{rms(filtered[:, axis]):.3f}", f"{FILTERED_LIMIT_DEG}",
             f"{expected[axis]:.3f}", "held" if rms(filtered[:, axis]) <= FILTERED_LIMIT_DEG else "**missed**")
            for axis, name in enumerate(("roll", "pitch"))]
    return ["## Figures 2 and 3", "",
            "Wanted: roll -30, pitch 20, heading 0 deg, height 0, from trim; linear plant. Without noise it is at "
            f"{', '.join(reached)} deg and {round(quiet.output[-1, 3], 2) + 0.0:.2f} m after 10 s (figure 2; the "
            "sticks are held for 10 ms, which leaves the last digit). With 1 deg of noise at 100 Hz, gusts, and the "
            f"filter feeding the controller (figure 3), RMS from {SETTLED:g} s on, {runs} flights:",
            *table(("", "raw, deg", "expected", "filtered, deg", "limit", "the filter says", "verdict"), rows), "",
            f"The error lasts a second or so, hence one flight of {DURATION:g} s has between {filtered.min():.2f} and "
            f"{filtered.max():.2f} deg. The paper gives no gusts; those here, {GUSTS['u']} m/s^2 and {GUSTS['p']} "
            f"rad/s^2 per root hertz, move a hovering helicopter by {rms(hover.state[:, 0]):.1f} m/s ahead and "
            f"{rms(hover.output[:, 1]) / DEG:.1f} deg of pitch (RMS), and the filter knows them.", "",
            f"![figure 2]({plots.name}/figure_2.png)", f"![figure 3]({plots.name}/figure_3.png)"]


def expected_deg(kalman):
    """Return what the filter says its errors of roll and pitch are, (2,), deg."""
    at = [kalman.model.states.index(name) for name in ("phi", "theta")]
    return np.degrees(np.sqrt(np.diag(kalman.covariance)[at]))


def draw_outputs(path, run, title):
    """Draw the outputs: true, and where there is a filter measured and filtered."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    figure.suptitle(title)
    for axis, (axes, name) in enumerate(zip(figure.subplots(2, 2, sharex=True).flat, (
            "roll, deg", "pitch, deg", "heading, deg", "height, m"), strict=True)):
        factor = 1.0 if name == "height, m" else 1 / DEG
        noisy = np.any(run.measured != run.output)
        if noisy:
            axes.plot(run.time, factor * run.measured[:, axis], color="0.8", label="measured")
        axes.plot(run.time, factor * run.output[:, axis], color="C1", label="true")
        if noisy:
            axes.plot(run.time, factor * run.filtered[:, axis], color="C0", linewidth=1, label="filtered")
        else:
            axes.set_ylim(*SCALES[name])
        axes.set_ylabel(name)
        axes.grid(True, alpha=0.3)
    for axes in figure.axes[2:]:
        axes.set_xlabel("time, s")
    figure.axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=100, metadata={"Software": None})


# --- where the filter ends ----------------------------------------------------------------------------


def detectability_section():
    """Return what can be estimated from roll and pitch alone."""
    two = ("phi", "theta")
    try:
        filter_of(r50_hover(), two)
        words = "**not refused**"
    except UndetectableError as refused:
        words = f'refused: "{refused}"'
    small = filter_of(r50_hover(heading_and_height=False), two)
    roll, pitch = expected_deg(small)
    ahead, right = np.sqrt(np.diag(small.covariance)[:2])
    return ["## Roll and pitch as the only measurements", "",
            f"The paper measures roll and pitch. With heading and height among the states that is {words}. Without "
            f"them, 13 states, it can be done: the filter says {roll:.3f} deg of roll, {pitch:.3f} deg of pitch, and "
            f"through the rotor's moments {ahead:.2f} and {right:.2f} m/s of the velocities ahead and to the right."]


def range_section(plots):
    """Return the errors against the size of the command on nonlinear kinematics, beside gyros and no model."""
    rows, errors = [], []
    for share in SHARES:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", LinearRangeWarning)
            run = flight(share * COMMAND, nonlinear=True)
        series = (run.measured[:, :2], run.filtered[:, :2], gyro_filter(run))
        errors.append([errors_deg(run, roll_pitch) for roll_pitch in series])
        raw, model, _ = errors[-1]
        largest = np.degrees(np.abs(run.output[:, :2]).max())
        rows.append((f"{-30 * share:.1f}, {20 * share:.1f}", f"{largest:.0f}",
                     *(f"{roll:.2f}, {pitch:.2f}" for roll, pitch in errors[-1]),
                     "**yes**" if model[1] > raw[1] else "no", "yes" if told else "no"))
    draw_range(plots / "range.png", np.array(errors))
    return ["## Where the linear filter ends", "",
            "Figure 3 again, on nonlinear kinematics and gravity (forces as identified), and smaller commands. Beside "
            "it the paper's other filter (equations 10 to 22): gyros of a consumer IMU, the same noisy roll and pitch, "
            "no helicopter. The model's filter still believes that pitch changes by q and that gravity pulls "
            f"by g theta; it pays in pitch first. `fly` warns beyond {LINEAR_RANGE / DEG:.0f} deg.",
            *table(("wanted roll, pitch, deg", "largest, deg", "raw, deg", "model's filter, deg", "gyros' filter, deg",
                    "model worse than raw in pitch", "warned"), rows), "", f"![range]({plots.name}/range.png)"]


def draw_range(path, errors):
    """Draw the errors (shares, 3 kinds, 2 axes), deg, against the wanted roll."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    wanted = -np.degrees(COMMAND[0]) * np.array(SHARES)
    for kind, (label, color) in enumerate((("the sensor alone", "0.6"), ("model's filter", "C0"),
                                           ("gyros' filter", "C2"))):
        for axis, (name, line) in enumerate((("roll", "o--"), ("pitch", "o-"))):
            axes.semilogy(wanted, errors[:, kind, axis], line, color=color, markersize=4, label=f"{label}, {name}")
    axes.axvline(LINEAR_RANGE / DEG, color="0.3", linestyle=":", label="warned beyond")
    axes.set_xlabel("wanted roll, deg (pitch two thirds of it)")
    axes.set_ylabel("RMS error, deg")
    axes.grid(True, which="both", alpha=0.3)
    axes.set_yticks([0.1, 0.2, 0.5, 1, 2, 5], ["0.1", "0.2", "0.5", "1", "2", "5"])
    figure.legend(loc="outside right center", fontsize=8)
    figure.savefig(path, dpi=100, metadata={"Software": None})


def gyro_filter(run):
    """Return roll and pitch (N, 2) of gyros and the run's noisy angles by the paper's filter of attitude and bias."""
    gyro_b = read_gyros(run)
    down_b = down_from_roll_pitch(*run.measured[:, :2].T)
    q, bias = quaternion_from_dcm(dcm_nb_from_euler(*run.measured[0, :3])), np.zeros(3)
    P = np.diag(np.repeat([NOISE_STD[0] ** 2, GYRO_BIAS_STD**2], 3))
    R, down_n, found = NOISE_STD[0] ** 2 * np.eye(3), np.array([0.0, 0.0, 1.0]), [q.copy()]
    for rate_b, measured_b in zip(gyro_b, down_b[1:], strict=True):
        kernels.mekf_predict(q, P, rate_b - bias, INTERVAL, GYROS.gyro_noise_density, GYROS.gyro_walk_density)
        kernels.mekf_vector_update(q, bias, P, measured_b, down_n, R, np.inf)
        found.append(q.copy())
    return np.stack(roll_pitch_from_down(down_from_quaternion(np.array(found))), axis=-1)


def read_gyros(run):
    """Return what the gyros read over each interval of a run, (N - 1, 3), rad/s."""
    q = quaternion_from_dcm(dcm_nb_from_euler(*run.output[:, :3].T))
    turned_b = quaternion_log(quaternion_multiply(quaternion_conjugate(q[:-1]), q[1:]))
    stamp_ns = np.rint(run.time[1:] * 1e9).astype(np.int64)
    still = np.zeros_like(turned_b)
    return apply_imu_errors(ImuSeries(stamp_ns, turned_b / INTERVAL, still), GYROS,
                            np.random.default_rng([SEED, 2])).imu.gyro_b


# --- model-based or sensor-based ----------------------------------------------------------------------


def model_or_sensor_section(runs):
    """Return what a wrong model costs, and verdicts on the paper's argument and its count of states."""
    wrong = {error: wrong_model_errors(error, runs) for error in MODEL_ERRORS}
    rows = [(f"{100 * error:.0f} %", *_spread(errors)) for error, errors in wrong.items()]
    return ["## Model-based or sensor-based", "",
            "Each derivative of the model that controller and filter believe off by a random share (standard "
            f"deviation); roll 5 and pitch 5 deg wanted, linear plant, {runs} draws. RMS error of roll and pitch of a "
            "flight, deg; the sensor alone has 1:",
            *table(("model wrong by", "median", "worst", "loops lost"), rows), "",
            *table(("the paper says", "verdict"), claims())]


def claims():
    """Return what the paper says of its filters, each with a verdict."""
    on_linear, run = flight(), flight(nonlinear=True)
    linear = errors_deg(on_linear, on_linear.filtered[:, :2]).max()
    model, gyros = (errors_deg(run, roll_pitch).max() for roll_pitch in (run.filtered[:, :2], gyro_filter(run)))
    better = "confirmed" if gyros < model else "**not confirmed**"
    return [
        ("a good model of a helicopter is hard to have, and its filter hard to build since it is nonlinear; a model of "
         "the sensors needs no helicopter and stays the same for another one (section 1)",
         f"{better}: at 30 deg of roll the model's filter is off by {model:.1f} deg, the gyros' filter by {gyros:.2f}, "
         "from the same roll and pitch. Near hover the model's is as good as it says while the model is right, and "
         "gives velocities without another sensor"),
        ("the results are those of an estimator \"without the model of the helicopter\" (section 4)",
         "no: figure 3 is equations 23 to 31, whose A and B are the helicopter's; the sensors' filters, 3 to 22, are "
         "not in any figure"),
        ("nine states are estimated: three attitudes from gyros, three accelerations and three positions from "
         "accelerometers (abstract)",
         "not by its equations: 3 to 9 estimate position and velocity, six; 10 to 22 attitude and gyro bias, six; "
         "twelve. The acceleration is an input. Attitude, velocity and position make nine; with gyro and "
         "accelerometer biases, without which a bias stays in the result, 15, as in `navigation_node`"),
        ("feeding the controller with the filter shows that it is right (section 4)",
         f"in the linear range only: {linear:.2f} deg on the linear plant, {model:.1f} deg on nonlinear kinematics at "
         "the same command")]


def _spread(errors):
    kept = errors[np.isfinite(errors)]
    return f"{np.median(errors):.2f}", f"{kept.max():.2f}", f"{len(errors) - len(kept)}"


def wrong_model_errors(error, runs):
    """Return the RMS roll and pitch error of each draw of a wrong model, deg; infinite where the loop is lost."""
    rng, model, results = np.random.default_rng([SEED, 1]), r50_hover(), []
    exact = np.isin(model.states, OUTPUTS)[:, None]
    for draw in range(runs):
        A, B = (matrix * np.where(exact, 1.0, 1 + error * rng.standard_normal(matrix.shape))
                for matrix in (model.A, model.B))
        run = flight(GENTLE, believed=LinearModel(A, B, model.states), seed=draw)
        lost = not np.abs(run.output[:, :2]).max() < np.pi / 2
        results.append(np.inf if lost else rms(errors_deg(run, run.filtered[:, :2])))
    return np.array(results)


if __name__ == "__main__":
    main()
