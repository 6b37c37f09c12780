"""North finding on a turntable: the paper's tables and figures beside ours, and what is done instead.

``python -m studies.north_finding`` writes docs/results/north_finding.md and its plots; every figure in it is
computed here, from fixed seeds. Printed values are those of Mohammadkarimi, Nourani and Alizadeh Roknabadi,
"The derivation of modern inertial navigation methods at stationary state" (2023), "the paper" below.
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alignment import azimuth, bounds, levelling, sequences
from alignment.harmonic import fit_harmonic
from alignment.north import find_north
from alignment.params import NorthPriors
from alignment.results import UNBELIEVABLE, wrap_angle
from alignment.turntable import (
    TriadErrors,
    Turntable,
    earth_direction_t,
    exact_readings,
    simulate_readings,
)
from inertial.earth import EARTH_RATE, STANDARD_GRAVITY
from studies import head_commit

SEED = 20230401
DEG = np.pi / 180
ARCSECOND = DEG / 3600
DEG_PER_HOUR = DEG / 3600
NO_TILT = np.zeros((2, 2))
PERFECT = TriadErrors()

PAPER_DEG = (50, 30, 88, 35)
PAPER_GYRO = TriadErrors(bias=(0.01 * ARCSECOND,) * 3, scale=(20e-6,) * 3, misalignment=5 * ARCSECOND)
PAPER_ACCEL = TriadErrors(bias=(1e-4 * STANDARD_GRAVITY,) * 3, scale=(50e-6,) * 3,
                          misalignment=10 * ARCSECOND)
METHOD_2_ANGLE_DEG = 90.0  # the paper does not say which

# A figure is reproduced when it is as near as the paper's own rounding and noise leave it.
LEVEL_TOLERANCE_DEG = 0.0011
HEADING_TOLERANCE_DEG = 0.0003
# Parts of the time after which the refined sequence solves again: two headings fit, or one does.
TELLING_SHARE, FINE_SHARE = 0.03, 0.25
LARGEST_RATIO = 1.10


@dataclass(frozen=True)
class Grade:
    """Noise of a gyro as data sheets give it."""

    name: str
    instability_deg_h: float
    walk_deg_root_h: float

    @property
    def noise_density(self):
        """Angle random walk, rad/s/sqrt(Hz)."""
        return self.walk_deg_root_h * DEG / 60

    @property
    def instability(self):
        """Floor of the Allan deviation, rad/s."""
        return self.instability_deg_h * DEG_PER_HOUR


GRADES = (Grade("navigation", 0.01, 0.003), Grade("tactical", 1.0, 0.1), Grade("MEMS", 5.1, 0.26))
ATTITUDES_DEG = ((0, 0, 0, 35), (0, 0, 88, 35), (0, 0, 45, 60), (20, -15, 200, -45), (50, 30, 88, 35),
                 (50, 30, 10, 35), (80, 10, 40, 35))


def main(argv=None):
    """Write the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/results"), help="folder of the results")
    parser.add_argument("--trials", type=int, default=4000, help="Monte-Carlo trials of each row")
    arguments = parser.parse_args(argv)
    plots = arguments.out / "north_finding"
    plots.mkdir(parents=True, exist_ok=True)
    sections = [
        heading_lines(arguments.trials), paper_section(plots), conclusions_section(arguments.trials),
        efficiency_section(arguments.trials, plots), branch_section(), time_section(plots), effects_section(),
        cost_section()]
    text = "\n\n".join("\n".join(section) for section in sections) + "\n"
    (arguments.out / "north_finding.md").write_text(text, encoding="utf-8")
    print(arguments.out / "north_finding.md")


def heading_lines(trials):
    """Return what the reader needs to know first."""
    return [
        "# North finding on a turntable", "",
        f"Made by `study_north_finding` from commit {head_commit()}, seed {SEED}, "
        f"{trials} trials a row.", "",
        "One gyro and one accelerometer on a turntable at rest find level and true north. First the "
        "paper's own tables and figures beside the same equations (as corrected) computed here; then what "
        "the joint estimator does, which uses every reading and needs neither a compass nor a choice "
        "among methods."]


def table(header, rows):
    """Return the lines of a Markdown table."""
    return ["", "| " + " | ".join(header) + " |", "|" + "---|" * len(header),
            *("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows)]


def verdict(ours, printed, tolerance):
    """Return in a word whether the printed value is reproduced."""
    return "reproduced" if abs(ours - printed) <= tolerance else "not reproduced"


# --- the paper's tables and figures -------------------------------------------------------------------


def paper_section(plots):
    """Return tables 1 to 12, and draw figures 1 to 5."""
    roll, pitch, heading, latitude = np.radians(PAPER_DEG)
    stand = Turntable(roll, pitch, heading, latitude)
    schedule = sequences.single_pass(4.0)
    readings = simulate_readings(stand, schedule, PAPER_GYRO, PAPER_ACCEL, np.random.default_rng(SEED))
    ideal = simulate_readings(stand, schedule, TriadErrors(bias=PAPER_GYRO.bias, scale=PAPER_GYRO.scale),
                              PERFECT, np.random.default_rng(SEED))
    lines = ["## The paper's tables", "",
             f"Roll, pitch, heading, latitude {PAPER_DEG} deg. Real sensors have the paper's bias, scale "
             "factor and misalignment and no noise: " + noise_needed()]
    levels = paper_levels(readings.accel_b)
    lines += level_tables(levels) + ideal_tables(ideal, stand)
    headings = paper_headings(readings, stand, PAPER_GYRO)
    lines += heading_tables(headings, readings, stand)
    draw_paper_figures(plots, levels, headings)
    return [*lines, "", "Figures 1 to 5, the errors of these tables in per cent as the paper draws them:", "",
            "![figures 1 to 5](north_finding/paper_figures.png)"]


def noise_needed():
    """Return how long the paper's noise would have to be averaged."""
    nominal = EARTH_RATE * np.hypot(*earth_direction_t(*np.radians(PAPER_DEG))[:2])
    slope = EARTH_RATE * bounds.sensitivity(*np.radians(PAPER_DEG))
    samples = (0.05 * nominal / slope / (0.0001 * DEG)) ** 2
    return (f"the noise it names, white and 5 % of the nominal values, would need {samples:.0e} samples at "
            "each position before the printed digits (0.0001 deg) stand still.")


def paper_levels(accel_b):
    """Return the level by each method, name to result."""
    angle = np.array(sequences.FOUR_POSITIONS)
    x, y = accel_b[:, 0], accel_b[:, 1]
    return {"1": levelling.levelling_1(x), "2": levelling.levelling_2(angle, x),
            "3": levelling.levelling_3(y), "4": levelling.levelling_4(angle, y),
            "5": levelling.levelling_5(x, accel_b[0, 2], shared_channel=True)}


PRINTED_LEVELS = {"1": (50.0050, 29.9990), "2": (50.0056, 29.9995), "3": (50.0030, 30.0040),
                  "4": (50.0720, 29.9940)}
PRINTED_HEADINGS = {"azimuth_1a": 88.0012, "azimuth_1b": 88.0043, "azimuth_2": 87.9890, "azimuth_3": 88.4420,
                    "azimuth_4": 88.0015, "azimuth_5": 88.0017}
PRINTED_SCALES = {"azimuth_4": 1.000012, "azimuth_5": 1.0000199, "azimuth_6": 1.000050}
PRINTED_APPROXIMATE = {"azimuth_5": 1.0000198, "azimuth_6": 1.0000049}
PRINTED_ACCEL_BIAS, PRINTED_ACCEL_SCALE = 77.4, 1.000068
PRINTED_GYRO_BIAS = 4.49e-8


def level_tables(levels):
    """Return tables 1 to 4."""
    lines = []
    for number, (name, axis) in enumerate((("roll", 0), ("pitch", 1)), start=1):
        rows = []
        for method, printed in PRINTED_LEVELS.items():
            ours = np.degrees(getattr(levels[method], name))
            rows.append((method, f"{printed[axis]:.4f}", f"{ours:.4f}",
                         verdict(ours, printed[axis], LEVEL_TOLERANCE_DEG)))
        lines += ["", f"Table {number}, {name}, deg."] + table(("method", "paper", "here", "verdict"), rows)
    bias, scale = levels["5"].bias / STANDARD_GRAVITY * 1e6, levels["5"].scale
    rows = [("3: bias, ug", PRINTED_ACCEL_BIAS, f"{bias:.1f}",
             "not reproduced: the true 100 plus misalignment times the force along the axis; noise moves the "
             "paper's"),
            ("4: scale factor", f"{PRINTED_ACCEL_SCALE:.7f}", f"{scale:.7f}",
             verdict(scale, PRINTED_ACCEL_SCALE, 1e-6))]
    return lines + ["", "Tables 3 and 4, the accelerometer by method 5."] + table(
        ("table", "paper", "here", "verdict"), rows)


def x_rates(readings, largest):
    """Return the x gyro's rates at every position a method may ask for."""
    rates = readings.gyro_b[:, 0]
    return {"0": rates[0], "90": rates[1], "180": rates[2], "270": rates[3], "tipped": readings.gyro_b[0, 2],
            "any": rates[1], "maximum": largest}


def paper_headings(readings, stand, errors):
    """Return the heading by each method, name to result, level and latitude being exact."""
    attitude = (stand.roll, stand.pitch, stand.heading, stand.latitude)
    at_maximum = exact_readings(stand, azimuth.angle_of_maximum(*attitude)).gyro_b
    rates = x_rates(readings, (at_maximum @ errors.matrix.T + errors.bias)[0])
    return {name: azimuth.find_azimuth(
        name, [rates[position] for position in method.positions], stand.roll, stand.pitch, stand.latitude,
        angle=METHOD_2_ANGLE_DEG * DEG, hint=stand.heading, shared_channel="tipped" in method.positions)
        for name, method in azimuth.METHODS.items()}


def ideal_tables(ideal, stand):
    """Return tables 5 to 8: exact readings for the headings, bias and scale factor alone for the rest."""
    exact = exact_readings(stand, np.array(sequences.FOUR_POSITIONS))
    headings = paper_headings(exact, stand, PERFECT)
    found = paper_headings(ideal, stand, TriadErrors())
    rows = [("5: heading, deg", name, "88", f"{np.degrees(headings[name].heading):.12f}",
             verdict(headings[name].heading, stand.heading, 1e-12)) for name in PRINTED_HEADINGS]
    rows += [("6: bias, rad/s", "azimuth_4", "4.85e-8", f"{found['azimuth_4'].bias:.4e}",
              verdict(found["azimuth_4"].bias, 4.85e-8, 5e-11))]
    rows += [("7: scale factor", name, "1.00002", f"{found[name].scale:.8f}",
              verdict(found[name].scale, 1.00002, 1e-9)) for name in ("azimuth_4", "azimuth_5", "azimuth_6")]
    approximate = approximate_scale_5(ideal, stand)
    rows += [("8: approximate scale factor", "azimuth_5", "1.0000199", f"{approximate:.8f}",
              verdict(approximate, 1.0000199, 1.1e-7))]
    return ["", "Tables 5 to 8, ideal sensors (tables 6 to 8 with bias and scale factor)."] + table(
        ("table", "method", "paper", "here", "verdict"), rows)


def approximate_scale_5(readings, stand):
    """Return equation 66's scale factor."""
    rates = readings.gyro_b[:, 0]
    bias = 0.5 * (rates[0] + rates[2])
    return azimuth.approximate_scale_5((rates[0] - bias) / EARTH_RATE, (rates[1] - bias) / EARTH_RATE,
                                       stand.roll, stand.pitch, stand.latitude)


def heading_tables(headings, readings, stand):
    """Return tables 9 to 12."""
    rows = []
    for name, printed in PRINTED_HEADINGS.items():
        ours = np.degrees(headings[name].heading)
        tolerance = 0.05 if name == "azimuth_3" else HEADING_TOLERANCE_DEG
        word = verdict(ours, printed, tolerance)
        if name == "azimuth_2":
            word += f": the paper does not name the angle; here {METHOD_2_ANGLE_DEG:.0f} deg"
        rows.append(("9: heading, deg", name, f"{printed:.4f}", f"{ours:.4f}", word))
    bias = headings["azimuth_4"].bias
    rows.append(("10: bias, rad/s", "azimuth_4", f"{PRINTED_GYRO_BIAS:.2e}", f"{bias:.3e}",
                 verdict(bias, PRINTED_GYRO_BIAS, 1e-9) + ": noise moves the paper's"))
    for name, printed in PRINTED_SCALES.items():
        scale = headings[name].scale
        rows.append(("11: scale factor", name, f"{printed:.7f}", f"{scale:.7f}",
                     verdict(scale, printed, 3e-6)))
    approximate = {"azimuth_5": approximate_scale_5(readings, stand),
                   "azimuth_6": levelling.approximate_scale(headings["azimuth_6"].scale)}
    for name, printed in PRINTED_APPROXIMATE.items():
        word = verdict(approximate[name], printed, 1e-6)
        if name == "azimuth_6":
            word += ": the paper's own table 11 has 1.000050 for it"
        rows.append(("12: approximate", name, f"{printed:.7f}", f"{approximate[name]:.7f}", word))
    return ["", "Tables 9 to 12, real sensors.",
            *table(("table", "method", "paper", "here", "verdict"), rows)]


def draw_paper_figures(plots, levels, headings):
    """Draw the five charts of the paper as panels, its values beside ours."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6), layout="constrained")
    panels = figure.subplots(2, 3).ravel()
    names = list(PRINTED_LEVELS)
    for number, (name, axis) in enumerate((("roll", 0), ("pitch", 1))):
        truth = PAPER_DEG[axis]
        draw_pairs(panels[number], f"Figure {number + 1}: {name}", [f"levelling {m}" for m in names],
                   [PRINTED_LEVELS[m][axis] / truth for m in names],
                   [np.degrees(getattr(levels[m], name)) / truth for m in names])
    names = list(PRINTED_HEADINGS)
    draw_pairs(panels[2], "Figure 3: heading", [n.replace("_", " ") for n in names],
               [PRINTED_HEADINGS[n] / PAPER_DEG[2] for n in names],
               [np.degrees(headings[n].heading) / PAPER_DEG[2] for n in names])
    true_bias = PAPER_GYRO.bias[0]
    draw_pairs(panels[3], "Figure 4: bias", ["accelerometer (5)", "gyro (4)"],
               [PRINTED_ACCEL_BIAS / 100, PRINTED_GYRO_BIAS / true_bias],
               [levels["5"].bias / STANDARD_GRAVITY * 1e4, headings["azimuth_4"].bias / true_bias])
    names = list(PRINTED_SCALES)
    draw_pairs(panels[4], "Figure 5: scale factor", ["accelerometer (5)", *(f"gyro ({n[8:]})" for n in names)],
               [PRINTED_ACCEL_SCALE / 1.00005, *(PRINTED_SCALES[n] / 1.00002 for n in names)],
               [levels["5"].scale / 1.00005, *(headings[n].scale / 1.00002 for n in names)])
    panels[5].axis("off")
    panels[5].legend(*panels[0].get_legend_handles_labels(), loc="upper left", frameon=False, fontsize=11)
    figure.savefig(plots / "paper_figures.png", dpi=110, metadata={"Software": None})


def draw_pairs(axes, title, names, printed, ours):
    """Draw the errors of the paper's values and of ours, each over the truth, in per cent."""
    place = np.arange(len(names))[::-1]
    printed, ours = (np.abs(np.asarray(values, dtype=float) - 1) * 100 for values in (printed, ours))
    axes.hlines(place, printed, ours, color="0.8", zorder=1)
    axes.plot(printed, place, "s", color="0.45", markersize=7, label="printed in the paper")
    axes.plot(ours, place, "o", color="C0", markersize=7, label="the same equations here")
    axes.set_xscale("log")
    axes.xaxis.set_minor_formatter(lambda value, position: "")
    axes.set_yticks(place, names)
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.set_title(title, loc="left", fontsize=11)
    axes.set_xlabel("error, %")
    axes.grid(True, axis="x", alpha=0.3)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


# --- the paper's conclusions --------------------------------------------------------------------------


def conclusions_section(trials):
    """Return a verdict on each of the paper's conclusions, with the figure that decides."""
    rng = np.random.default_rng(SEED + 1)
    x_rms, y_rms = levelling_over_attitudes(rng, trials)
    turning = levelling_while_turning()
    at_88, at_10 = first_order_ratio(88.0), first_order_ratio(10.0)
    scales = approximation_errors()
    angle_off = maximum_angle_error()
    rows = [
        ("The y accelerometer (levelling 3, 4) is more accurate than the x one, whose lever arm forces are "
         "left out",
         f"no: over {trials} random attitudes and misalignments {x_rms:.2f} and {y_rms:.2f} arcsec RMS; "
         f"turning at 6 deg/s on a 0.1 m arm moves levelling 1 by {turning:.1e} arcsec, since the force is "
         "the same at every angle and cancels"),
        ("Levelling 4 has most noise",
         "no: at rest x and y read with the same noise, and 4 is 3 with more angles"),
        ("Azimuth 1a is the best",
         f"at heading 88 deg only: {at_88:.2f} times the bound there, {at_10:.2f} times at 10 deg, and blind "
         "at 0"),
        ("Azimuth 3 is the most sensitive, and needs a quartic and a first guess",
         "sensitive: yes (table below); a quartic: no, the sign of Z leaves the kernel"),
        ("A compass must choose the branch",
         "no: two in-plane components leave one heading but for the geometries that are flagged (see "
         "branches)"),
        ("Azimuth 5 is preferred for the scale factor",
         "no: 4 and 5 are the same three equations, table 11's difference is noise"),
        ("Azimuth 6 is the most accurate for the bias",
         "no: the bias is half the sum of two readings in 4, 5 and 6 alike"),
        ("The accelerometer's bias has a large error (22 %)",
         "yes, and it is not chance: misalignment times the force along the axis is a constant, part of "
         "every bias; it does not reach the angles"),
        ("Approximate scale factors, equations 34 and 71",
         f"usable: {scales['71'][0]:.1e} off at 20 ppm, {scales['71'][1]:.1e} at 1 %; nothing is gained over "
         "the square root"),
        ("Approximate scale factor, equation 66",
         f"usable: {scales['66'][0]:.1e} off at 20 ppm, {scales['66'][1]:.1e} at 1 %; nothing is gained over "
         "the quadratic"),
        ("tau* by equation 52",
         f"right with atan2 ({angle_off:.1e} rad from the largest reading); the printed arctangent is half a "
         "turn off where X is negative"),
    ]
    return ["## The paper's conclusions", *table(("conclusion", "verdict"), rows)]


def levelling_over_attitudes(rng, trials):
    """Return the tilt's RMS error with the x and with the y accelerometer, arcsec, misalignments random."""
    errors = {"x": [], "y": []}
    tau = np.array(sequences.FOUR_POSITIONS)
    for _ in range(trials):
        stand = Turntable(*(rng.uniform(-60, 60, 2) * DEG))
        matrix = np.eye(3) + 10 * ARCSECOND * rng.standard_normal((3, 3))
        accel_b = exact_readings(stand, tau).accel_b @ matrix.T
        for name, level in (("x", levelling.levelling_1(accel_b[:, 0])),
                            ("y", levelling.levelling_3(accel_b[:, 1]))):
            errors[name].append([level.pitch - stand.pitch, (level.roll - stand.roll) * np.cos(stand.pitch)])
    return [float(np.sqrt(np.mean(np.square(errors[name])))) / ARCSECOND for name in ("x", "y")]


def levelling_while_turning():
    """Return what lever arm and Coriolis forces do to levelling 1 on a turning table, arcsec."""
    stand = Turntable(*np.radians(PAPER_DEG), lever_arm=0.1)
    accel_b = exact_readings(stand, np.array(sequences.FOUR_POSITIONS), rate=6 * DEG).accel_b
    level = levelling.levelling_1(accel_b[:, 0])
    return max(abs(level.roll - stand.roll), abs(level.pitch - stand.pitch)) / ARCSECOND


def first_order_ratio(heading_deg):
    """Return azimuth 1a's first-order deviation over the best-design bound at the paper's level."""
    roll, pitch, heading, latitude = np.radians((PAPER_DEG[0], PAPER_DEG[1], heading_deg, PAPER_DEG[3]))
    x = EARTH_RATE * earth_direction_t(roll, pitch, heading, latitude)[0]
    half_time = np.eye(2) * 2 * GRADES[0].noise_density ** 2 / 600.0
    result = azimuth.find_azimuth("azimuth_1a", [x, -x], roll, pitch, latitude, rate_covariance=half_time,
                                  hint=heading)
    return float(result.std) / bounds.heading_bound(
        GRADES[0].noise_density, 600.0, bounds.sensitivity(roll, pitch, heading, latitude))


def approximation_errors():
    """Return the errors of equations 71 and 66 at scale factor errors of 20 ppm and 1 %."""
    roll, pitch, heading, latitude = np.radians(PAPER_DEG)
    x, y, _ = earth_direction_t(roll, pitch, heading, latitude)
    found = {"71": [], "66": []}
    for scale in (1 + 20e-6, 1.01):
        found["71"].append(abs(float(levelling.approximate_scale(scale)) - scale))
        found["66"].append(abs(float(azimuth.approximate_scale_5(
            scale * x, scale * y, roll, pitch, latitude)) - scale))
    return found


def maximum_angle_error():
    """Return how far equation 52's angle is from the largest of finely spaced readings, rad."""
    stand = Turntable(*np.radians(PAPER_DEG))
    tau = np.linspace(-np.pi, np.pi, 20001)
    rates = exact_readings(stand, tau).gyro_b[:, 0]
    return float(abs(wrap_angle(tau[np.argmax(rates)] - azimuth.angle_of_maximum(*np.radians(PAPER_DEG)))))


# --- efficiency ---------------------------------------------------------------------------------------


def efficiency_section(trials, plots):
    """Return every method's error against the bound, and the joint estimator's."""
    total = 600.0
    header = ("grade", "roll, pitch, heading, latitude, deg", "bound, deg",
              *(name[8:] for name in azimuth.METHODS), "joint, 4 positions", "joint, refined", "limit",
              "mean z^2", "refused")
    rows, missed, ratios = [], [], []
    for grade in GRADES[:2]:
        for index, attitude in enumerate(ATTITUDES_DEG):
            rng = np.random.default_rng([SEED, 2, index])
            reach = bounds.sensitivity(*np.radians(attitude))
            bound = bounds.heading_bound(grade.noise_density, total, reach)
            methods = [ratio_of(method_errors(name, attitude, grade, total, trials, rng), bound)
                       for name in azimuth.METHODS]
            four, _ = joint_errors(attitude, grade, total, trials, rng)
            refined, normalised = refined_errors(attitude, grade, total, trials, rng)
            believed = np.isfinite(refined)
            ratio = rms(refined[believed]) / bound
            if ratio > LARGEST_RATIO:
                missed.append(f"{grade.name} at {attitude}: {ratio:.3f}")
            square = np.mean(normalised[believed] ** 2)
            rows.append((grade.name, ", ".join(map(str, attitude)), f"{np.degrees(bound):.4f}",
                         *(f"{value:.2f}" if np.isfinite(value) else "-" for value in methods),
                         f"{rms(four) / bound:.2f}", f"{ratio:.3f}", f"{LARGEST_RATIO:.2f}", f"{square:.3f}",
                         f"{100 * np.mean(~believed):.2f} %"))
            ratios.append([*methods, rms(four) / bound, ratio])
    draw_efficiency(plots / "efficiency.png", np.array(ratios))
    perturbed = [perturbed_squares(attitude, trials * 4, np.random.default_rng([SEED, 3, i]))
                 for i, attitude in enumerate(ATTITUDES_DEG)]
    return [
        "## Efficiency", "",
        f"Heading RMS over the Cramer-Rao bound of the best two angles, {total:.0f} s in all for each "
        "method, white noise, unknown bias. Azimuth 2 and 3 are told the bias; azimuth 2 measures at its "
        "best angle, azimuth 6 tips the sensor. A dash: blind, or more than one trial in a hundred "
        "without a solution. The joint estimator with four positions is held to sqrt(2) by their "
        "geometry; refined, a quarter of the time goes there and the rest to the two best angles (east "
        "and west when level), but while two headings fit to where these differ most. Refused: flagged as "
        "ambiguous, so that no heading would be published.", "",
        "![efficiency](north_finding/efficiency.png)",
        *table(header, rows), "",
        "Refined beyond the limit: " + ("; ".join(missed) or "none") + ". A ratio from as many trials scatters by "
        f"{1.1 / np.sqrt(2 * trials):.3f}. Near 80 deg of tilt two headings fit at first, and the time that decides "
        "between them is lost to the best angles: the bound knows of no second heading.", "",
        "With level, latitude, table zero, scale factor and skew all perturbed by their priors, "
        f"{trials * 4} trials at each attitude, the mean of (error / deviation)^2 is {min(perturbed):.3f} "
        f"to {max(perturbed):.3f} (limit 0.97 to 1.03)."]


def rms(values):
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def ratio_of(errors, bound):
    """Return an RMS over the bound, NaN where a method often has no solution."""
    good = np.isfinite(errors)
    return rms(errors[good]) / bound if good.mean() > 0.99 else np.nan


def draw_efficiency(path, ratios):
    """Draw every method's ratios over grades and attitudes, (rows, methods); the blind ones on top."""
    from matplotlib.figure import Figure

    names = [*(name[8:] for name in azimuth.METHODS), "joint,\n4 positions", "joint,\nrefined"]
    top = 40.0
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    for place, column in enumerate(ratios.T):
        blind = ~np.isfinite(column)
        spread = place + np.linspace(-0.25, 0.25, len(column))
        color = "C3" if place >= len(azimuth.METHODS) else "C0"
        axes.plot(spread[~blind], column[~blind], "o", color=color, markersize=5)
        axes.plot(spread[blind], np.full(blind.sum(), top), "x", color="0.4", markersize=6)
    axes.axhline(1.0, color="0.3", linewidth=1)
    axes.set_yscale("log")
    axes.set_yticks([1, 1.5, 2, 3, 5, 10, 20, top], ["1", "1.5", "2", "3", "5", "10", "20", "blind"])
    axes.minorticks_off()
    axes.set_xticks(range(len(names)), names)
    axes.set_xlabel("azimuth method")
    axes.set_ylabel("heading RMS / best bound")
    axes.set_title("A closed form is good at some attitudes, the joint estimator at all", loc="left", fontsize=11)
    axes.grid(True, axis="y", alpha=0.3)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.savefig(path, dpi=120, metadata={"Software": None})


def method_errors(name, attitude_deg, grade, total, trials, rng):
    """Return heading errors of a closed form that shares the time among its positions, (trials,)."""
    roll, pitch, heading, latitude = np.radians(attitude_deg)
    x, y, z = EARTH_RATE * earth_direction_t(roll, pitch, heading, latitude)
    angle = bounds.best_angle(roll, pitch, heading, latitude)
    at = {"0": x, "90": y, "180": -x, "270": -y, "tipped": z, "maximum": np.hypot(x, y),
          "any": x * np.cos(angle) + y * np.sin(angle)}
    positions = azimuth.METHODS[name].positions
    deviation = grade.noise_density * np.sqrt(len(positions) / total)
    rates = np.array([at[position] for position in positions])
    rates = rates + deviation * rng.standard_normal((trials, len(positions)))
    result = azimuth.find_azimuth(name, rates, roll, pitch, latitude, angle=angle,
                                  hint=np.full(trials, heading))
    return wrap_angle(result.heading - heading)


def noisy_x_rates(attitude_deg, schedule, grade, rng, trials=None):
    """Return x gyro readings of a schedule with white noise, (trials, K) or (K,)."""
    x, y, _ = EARTH_RATE * earth_direction_t(*np.radians(attitude_deg))
    shape = schedule.angle.shape if trials is None else (trials, len(schedule.angle))
    noise = grade.noise_density / np.sqrt(schedule.duration) * rng.standard_normal(shape)
    return x * np.cos(schedule.angle) + y * np.sin(schedule.angle) + noise


TIGHT = NorthPriors(scale_std=20e-6, skew_std=0.0, table_zero_std=0.0, latitude_std=0.0)


def solve_joint(attitude_deg, schedule, rates, grade, priors=TIGHT):
    """Return the joint estimator's result with exact level."""
    roll, pitch, _, latitude = np.radians(attitude_deg)
    fit = fit_harmonic(schedule.angle, rates, grade.noise_density ** 2 / schedule.duration)
    return find_north(fit, None, [roll, pitch], NO_TILT, latitude, priors)


def joint_errors(attitude_deg, grade, total, trials, rng):
    """Return errors and normalised errors of the joint estimator with four positions."""
    schedule = sequences.single_pass(total)
    rates = noisy_x_rates(attitude_deg, schedule, grade, rng, trials)
    result = solve_joint(attitude_deg, schedule, rates, grade)
    error = wrap_angle(result.heading - attitude_deg[2] * DEG)
    return error, error / result.std


def refined_errors(attitude_deg, grade, total, trials, rng):
    """Return errors and normalised errors of the refined sequence; NaN where the heading may not be believed."""
    errors, normalised = np.empty(trials), np.empty(trials)
    for trial in range(trials):
        result = refined_result(attitude_deg, grade, total, rng)
        errors[trial] = wrap_angle(result.heading - attitude_deg[2] * DEG)
        errors[trial] = np.nan if result.flags & UNBELIEVABLE else errors[trial]
        normalised[trial] = errors[trial] / result.std
    return errors, normalised


def refined_result(attitude_deg, grade, total, rng):
    """Return the joint estimator's result of one run of the refined sequence, as the node follows it.

    After the coarse part the table looks where two headings that both fit differ most, until one does, and
    otherwise at the two best angles.
    """
    roll, pitch, _, latitude = np.radians(attitude_deg)
    schedule = sequences.single_pass(sequences.COARSE_SHARE * total)
    rates = noisy_x_rates(attitude_deg, schedule, grade, rng)
    while True:
        result = solve_joint(attitude_deg, schedule, rates, grade)
        used = schedule.end[-1]
        if used > 0.999 * total:
            return result
        if result.flags & UNBELIEVABLE and np.isfinite(result.branches).all():
            angle, share = bounds.telling_angle(roll, pitch, *map(float, result.branches)), TELLING_SHARE
        else:
            angle, share = bounds.best_angle(roll, pitch, float(result.heading), latitude), FINE_SHARE
        share = min(share * total, total - used)
        more = sequences.indexed_schedule((angle, angle + np.pi), 0.5 * share, start=used)
        schedule = sequences.joined(schedule, more)
        rates = np.concatenate([rates, noisy_x_rates(attitude_deg, more, grade, rng)])


def perturbed_squares(attitude_deg, trials, rng):
    """Return the mean square of the normalised error with every prior perturbed."""
    priors, tilt_std = NorthPriors(3e-4, 3e-4, 3e-4, 3e-4), 3e-4
    roll, pitch, heading, latitude = np.radians(attitude_deg)
    schedule, grade = sequences.palindrome(600.0), GRADES[0]

    def scattered(std, *shape):
        return std * rng.standard_normal((trials, *shape))
    x, y, _ = np.moveaxis(EARTH_RATE * earth_direction_t(
        roll + scattered(tilt_std), pitch + scattered(tilt_std), heading,
        latitude + scattered(priors.latitude_std)), -1, 0)[..., None]
    tau = schedule.angle + scattered(priors.table_zero_std, 1) + scattered(priors.skew_std, 1)
    rates = (1 + scattered(priors.scale_std, 1)) * (x * np.cos(tau) + y * np.sin(tau))
    variance = grade.noise_density ** 2 / schedule.duration
    fit = fit_harmonic(schedule.angle, rates + np.sqrt(variance) * rng.standard_normal(rates.shape), variance)
    result = find_north(fit, None, [roll, pitch], tilt_std ** 2 * np.eye(2), latitude, priors)
    return float(np.mean((wrap_angle(result.heading - heading) / result.std) ** 2))


# --- branches -----------------------------------------------------------------------------------------


def branch_section():
    """Return how often a wrong branch goes unflagged."""
    rows = []
    for words, low, high, wrong_limit, flag_limit in (
            ("0 to 30 deg", 0, 30, "0", "2 %"), ("30 to 80 deg", 30, 80, "", ""),
            ("85 to 95 deg", 85, 95, "0.2 %", "")):
        wrong, flagged = branch_shares(low, high, np.random.default_rng([SEED, 4, low]))
        rows.append((words, f"{100 * wrong:.3f} %", wrong_limit, f"{100 * flagged:.2f} %", flag_limit))
    return ["## Branches", "",
            "10 000 random attitudes in each range of tilt, latitude within 60 deg, navigation grade, 600 "
            "s at four positions, no compass. Wrong: more than six stated deviations off.",
            *table(("tilt", "wrong and unflagged", "limit", "flagged", "limit"), rows)]


def branch_shares(low_deg, high_deg, rng, count=10000):
    """Return the shares of wrong unflagged and of flagged headings over random attitudes."""
    tilt = np.arccos(rng.uniform(np.cos(high_deg * DEG), np.cos(low_deg * DEG), count))
    turn, heading = rng.uniform(-np.pi, np.pi, (2, count))
    roll = np.arctan2(np.sin(tilt) * np.sin(turn), np.cos(tilt))
    pitch = -np.arcsin(np.sin(tilt) * np.cos(turn))
    schedule, grade = sequences.single_pass(600.0), GRADES[0]
    wrong, flagged = 0, 0
    for latitude, chosen in zip(np.radians(np.arange(-60, 61, 15)), np.array_split(np.arange(count), 9),
                                strict=True):
        attitude = np.degrees([roll[chosen], pitch[chosen], heading[chosen], np.full(len(chosen), latitude)])
        x, y, _ = np.moveaxis(EARTH_RATE * earth_direction_t(*np.radians(attitude)), -1, 0)[..., None]
        variance = grade.noise_density ** 2 / schedule.duration
        rates = x * np.cos(schedule.angle) + y * np.sin(schedule.angle)
        rates = rates + np.sqrt(variance) * rng.standard_normal(rates.shape)
        result = find_north(fit_harmonic(schedule.angle, rates, variance), None,
                            np.stack([roll[chosen], pitch[chosen]], -1), NO_TILT, latitude, TIGHT)
        bad = result.quality & UNBELIEVABLE.value != 0
        off = ~(np.abs(wrap_angle(result.heading - heading[chosen])) <= 6 * result.std)
        wrong += np.sum(off & ~bad)
        flagged += np.sum(bad)
    return wrong / count, flagged / count


# --- heading against time -----------------------------------------------------------------------------


def time_section(plots):
    """Return heading against time for three grades, and draw it."""
    rows = []
    for index, grade in enumerate(GRADES):
        for total in (600.0, 3600.0):
            schedule = sequences.palindrome(total)
            rng = np.random.default_rng([SEED, 5, index, int(total)])
            rows.append((grade.name, f"{total:.0f}", f"{predicted_deg(grade, schedule):.3f}",
                         f"{flicker_monte_carlo_deg(grade, schedule, rng):.3f}",
                         f"{predicted_deg(grade, sequences.single_pass(total)):.3f}",
                         f"{floor_deg(grade, schedule):.3f}"))
    slow = sequences.single_pass(3600.0)
    floors = ", ".join(f"{grade.name} {floor_deg(grade, slow):.3f}" for grade in GRADES)
    draw_time(plots / "heading_against_time.png")
    return ["## Heading against time", "",
            "Level, latitude 35 deg, white and 1/f noise, 15 s at each angle of the palindrome. Predicted "
            "from the exact covariance of the dwells; the Monte Carlo solves 1000 simulated runs.",
            *table(("grade", "time, s", "palindrome, deg", "Monte Carlo, deg", "one slow pass, deg",
                    "1/f part of the palindrome, deg"), rows), "",
            f"One slow pass through four positions never does better than its floor, whatever the time, "
            f"deg: {floors}.",
            "", "![heading against time](north_finding/heading_against_time.png)"]


def predicted_deg(grade, schedule):
    """Return the deviation predicted on a level table facing north, deg."""
    return np.degrees(bounds.predicted_heading_std(schedule, grade.noise_density, grade.instability, 0.0, 0.0,
                                                   0.0, 35 * DEG))


def floor_deg(grade, schedule):
    """Return the part of the deviation that 1/f noise makes, deg."""
    white = bounds.predicted_heading_std(schedule, grade.noise_density, 0.0, 0.0, 0.0, 0.0, 35 * DEG)
    return float(np.sqrt(predicted_deg(grade, schedule) ** 2 - np.degrees(white) ** 2))


def flicker_monte_carlo_deg(grade, schedule, rng, trials=1000):
    """Return the RMS error of the joint estimator on simulated white and 1/f noise, deg."""
    stand = Turntable(latitude=35 * DEG)
    errors = TriadErrors(noise_density=grade.noise_density, bias_instability=grade.instability)
    readings = simulate_readings(stand, schedule, errors, PERFECT, rng, trials)
    result = solve_joint((0, 0, 0, 35), schedule, readings.gyro_b[..., 0], grade)
    return np.degrees(rms(wrap_angle(result.heading)))


def draw_time(path):
    """Draw the predicted deviation against time for each grade."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    # Whole rounds of the palindrome.
    times = 120.0 * np.unique(np.geomspace(1, 60, 16).round())
    for index, grade in enumerate(GRADES):
        color = f"C{index}"
        white = bounds.heading_bound(grade.noise_density, times, np.cos(35 * DEG), uniform=True)
        turned = [predicted_deg(grade, sequences.palindrome(total)) for total in times]
        slow = [predicted_deg(grade, sequences.single_pass(total)) for total in times]
        axes.loglog(times, turned, "-", color=color, linewidth=2, label="palindrome, 15 s each" if not index else None)
        axes.loglog(times, slow, "--", color=color, label="one slow pass" if not index else None)
        axes.loglog(times, np.degrees(white), ":", color=color, label="white noise alone" if not index else None)
        axes.text(times[-1] * 1.05, slow[-1], grade.name, color=color, va="center")
    axes.set_xticks([120, 300, 600, 1800, 3600, 7200], ["2 min", "5 min", "10 min", "30 min", "1 h", "2 h"])
    axes.set_yticks([0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30], ["0.01", "0.03", "0.1", "0.3", "1", "3", "10", "30"])
    axes.minorticks_off()
    axes.set_xlim(right=times[-1] * 2)
    axes.set_ylabel("heading deviation, deg")
    axes.set_title("Coming back to each angle beats waiting at it", loc="left", fontsize=11)
    axes.grid(True, alpha=0.3)
    axes.legend(frameon=False, labelcolor="0.2")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.savefig(path, dpi=120, metadata={"Software": None})


# --- error effects ------------------------------------------------------------------------------------


def effects_section():
    """Return what each imperfection alone does to the heading."""
    drift = TriadErrors(drift=(DEG_PER_HOUR / 3600,) * 3)
    wobble = {"wobble": ARCSECOND}
    turn_one_way = sequences.continuous_rotation(6 * DEG, 600.0, 0.1, both_ways=False)
    turn_both_ways = sequences.continuous_rotation(6 * DEG, 600.0, 0.1)
    twice = sequences.indexed_schedule(sequences.FOUR_POSITIONS * 2, 75.0)
    slow, there_and_back = sequences.single_pass(600.0), sequences.palindrome(600.0)
    rows = [
        ("encoder zero 0.1 deg", effect_deg(there_and_back, encoder_zero=0.1 * DEG), ""),
        ("encoder eccentricity 0.1 deg", effect_deg(there_and_back, encoder_eccentricity=0.1 * DEG), ""),
        ("wobble 1 arcsec, turning 6 deg/s one way", effect_deg(turn_one_way, **wobble), ""),
        ("wobble 1 arcsec, CW and CCW", effect_deg(turn_both_ways, **wobble), ""),
        ("wobble 1 arcsec, indexed", effect_deg(there_and_back, **wobble), ""),
        ("drift 1 deg/h per h, 0-90-180-270 in 600 s", effect_deg(slow, drift), ""),
        ("drift 1 deg/h per h, palindrome in 600 s", effect_deg(there_and_back, drift), "0.01"),
        ("drift 1 deg/h per h, 0-90-180-270 twice, drift fitted",
         effect_deg(twice, drift, fit_drift=True), ""),
        ("bias 10 deg/h", effect_deg(slow, TriadErrors(bias=(10 * DEG_PER_HOUR,) * 3)), ""),
        ("scale factor 1 %", effect_deg(slow, TriadErrors(scale=(0.01,) * 3)), ""),
        ("misalignment 0.1 deg", effect_deg(slow, TriadErrors(misalignment=0.1 * DEG)), ""),
        ("roll of the table wrong by 0.1 deg", effect_deg(slow, roll_error=0.1 * DEG), ""),
        ("latitude wrong by 0.1 deg", effect_deg(slow, latitude_error=0.1 * DEG), ""),
    ]
    clean, mean, robust = outlier_rms_deg()
    return ["## What each imperfection does", "",
            "Heading error of the joint estimator, deg, level table at latitude 35 deg: the largest over "
            "headings 0, 15, ... 345 deg.",
            *table(("imperfection", "heading error", "limit"),
                   [(name, f"{value:.4f}", limit) for name, value, limit in rows]), "",
            "Outliers: 5 % of the samples with 50 times the noise, tactical grade, 600 s, 200 samples, "
            f"500 trials: RMS {clean:.2f} deg clean, {mean:.2f} with the mean, {robust:.2f} robust, "
            f"{100 * (robust / clean - 1):.1f} % more than clean (limit 10 %)."]


def effect_deg(schedule, errors=PERFECT, roll_error=0.0, latitude_error=0.0, fit_drift=False, **imperfection):
    """Return the largest heading error over headings, deg."""
    worst = 0.0
    for heading in np.arange(0, 360, 15) * DEG:
        stand = Turntable(heading=wrap_angle(heading), latitude=35 * DEG, **imperfection)
        readings = simulate_readings(stand, schedule, errors, PERFECT, np.random.default_rng(SEED))
        variance = GRADES[0].noise_density ** 2 / schedule.duration
        fit = fit_harmonic(schedule.angle, readings.gyro_b[:, 0], variance,
                           time=schedule.middle if fit_drift else None)
        result = find_north(fit, None, [roll_error, 0.0], NO_TILT, 35 * DEG + latitude_error,
                            NorthPriors(1e-2, 0.0, 0.0, 0.0))
        worst = max(worst, abs(float(wrap_angle(result.heading - heading))))
    return np.degrees(worst)


def outlier_rms_deg(trials=500):
    """Return heading RMS clean, with outliers by the mean, and with outliers robustly, deg."""
    rng, grade = np.random.default_rng([SEED, 6]), GRADES[1]
    schedule = sequences.indexed_schedule(np.repeat(sequences.FOUR_POSITIONS, 50), 3.0)
    clean = noisy_x_rates((0, 0, 0, 35), schedule, grade, rng, trials)
    deviation = grade.noise_density / np.sqrt(schedule.duration)
    outlier = rng.random(clean.shape) < 0.05
    spoiled = np.where(outlier, clean + 50 * deviation * rng.standard_normal(clean.shape), clean)

    def error_deg(rates, robust):
        fits = [fit_harmonic(schedule.angle, row, deviation ** 2, robust=robust) for row in rates]
        return np.degrees(rms([float(find_north(fit, None, [0.0, 0.0], NO_TILT, 35 * DEG, TIGHT).heading)
                               for fit in fits]))
    return error_deg(clean, False), error_deg(spoiled, False), error_deg(spoiled, True)


# --- cost ---------------------------------------------------------------------------------------------


def cost_section():
    """Return how long the solver takes here."""
    rng, grade = np.random.default_rng([SEED, 7]), GRADES[0]
    schedule = sequences.single_pass(600.0)
    rates = noisy_x_rates((50, 30, 88, 35), schedule, grade, rng, 10000)
    many = best_time(lambda: solve_joint((50, 30, 88, 35), schedule, rates, grade))
    long = sequences.continuous_rotation(6 * DEG, 3600.0, 0.01)
    readings = noisy_x_rates((50, 30, 88, 35), long, grade, rng)
    readings[::20] += 1e-3

    def solve_long():
        fit = fit_harmonic(long.angle, readings, robust=True)
        return find_north(fit, None, [50 * DEG, 30 * DEG], NO_TILT, 35 * DEG, TIGHT)
    single = best_time(solve_long)
    return ["## Cost", "", "Best of three on the machine that made this page, CPU time.", *table(
        ("what", "CPU s", "limit, s"),
        [("10 000 Monte-Carlo solves", f"{many:.2f}", "1"),
         ("one robust solve over 360 000 readings with 5 % outliers", f"{single:.3f}", "0.2")])]


def best_time(action):
    """Return the least CPU time of three runs, s, after one to warm up."""
    action()
    durations = []
    for _ in range(3):
        start = time.process_time()
        action()
        durations.append(time.process_time() - start)
    return min(durations)


if __name__ == "__main__":
    main()
