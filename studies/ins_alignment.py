"""INS alignment at rest: the IPEKF's paper beside its rivals, the Cramer-Rao bound, and what the product does.

``study_ins_alignment`` writes docs/results/ins_alignment.md and its plots; every figure in it is computed here or
in :mod:`studies.standing_runs`, from fixed seeds. "The paper" is N. Ghahramani and H. Majed Alhassan, "Design of a
new algorithm to improve the convergence of extended Kalman filter based on incremental predictive model for
inertial navigation system alignment and its stability analysis".
"""

import argparse
import math
import os
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np

from alignment.standing import _kernels as kernels
from alignment.standing.bound import heading_bound
from alignment.standing.filters import Filter, heading_covariance, reduce, sample_intervals
from inertial._kernels import first_order_recursion
from inertial.earth import EARTH_RATE
from inertial.parked_scenarios import GRADES as PARKED_GRADES
from inertial.rotation import dcm_from_quaternion
from inertial.table_scenarios import LATITUDE
from studies import head_commit
from studies.standing_runs import (
    ACCURACY,
    ARCMINUTE,
    DEG,
    GRADES,
    RATE,
    add_biases_and_noise,
    as_the_paper,
    chain_job,
    each,
    interval,
    parked_job,
    root_mean,
    run,
    stand,
    stand_still,
    told,
    wrong_start,
)
from studies.timing import times_in_turn

OUT = Path("docs/results")
SEEDS = 20
WORKERS = 2
STEP_ROUNDS = 30
DURATION = 1200.0  # s, the paper's
SHORT = 300.0  # s, in which the product should be done
HEADING_ERROR = 30 * DEG
NOISE_STDS = (1e-3, 1e-2, 1e-1)  # m/s, the paper's sigma_R
ERROR_MODELS = ("ipekf", "ekf5", "ekf10", "ukf10")
TABLE_GRADES = ("perfect", "navigation", "tactical", "ADIS in-run")
LARGE_ERRORS_DEG = (5, 10, 30, 60, 90, 120, 150, 170)
HORIZONS = (2, 10, 20, 50)
ENLARGED = (1, 10, 100)
RATIOS = (1e-4, 1e-3, 1e-2, 2e-2, 5e-2, 1e-1)
MODELLED = (("paper_literal", 1e-4), ("closed_loop", 1e-4), ("closed_loop", 1e-2), ("residual", 1e-7),
            ("residual", 1e-6))  # variants of the IPEKF and their Ry / Qm
COLOUR_TIME = 1.0  # s
STRENGTHS = (0.0, 1.0, 3.0)
RUNS_A_SEED = 10  # of the runs from any heading
MOTIONS = 20  # of swaying vehicles, each with a heading of its own
FRESH_MOTION, FRESH_SEED = 7000, 500  # the first of these vehicles and of their sensors: no constant was tuned on them
SCHEMES = ("static", "two_position", "rotating")
CHAIN_GRADES = ("navigation", "tactical", "ADIS in-run", "ADIS turn-on")
PRECISE = (("navigation", "static"), ("navigation", "two_position"))
MORE_SEEDS = 3  # times as many for these

# Convergence time s, RMSE and standard deviation arcmin (table 2).
PAPER = {"ipekf": ((8, 0.39, 0.14), (20, 2.67, 0.03), (52, 4.087, 0.19)),
         "EKF": ((150, 1.12, 0.91), (400, 11.38, 10.42), (524, 58.009, 48)),
         "UKF": ((50, 0.82, 0.8), (300, 50.7, 15.1), (math.inf, 1071, 162))}
PAPER_LOADS = {"EKF": 7378, "UKF": 7851, "IPEKF, p = 10": 6560, "IPEKF, p = 2": 1373}
# What was asked for: time s and RMSE arcmin by grade and sigma_R, and RMS arcmin of the default chain.
ASKED = {("perfect", 1e-3): (8, 0.02), ("perfect", 1e-2): (21, 0.04), ("perfect", 1e-1): (52, 0.13),
         ("navigation", 1e-3): (8, 1.64), ("ADIS noise only", 1e-3): (math.inf, 139)}
ASKED_PART = 0.2
PROTOTYPE = {("navigation", "static"): 2.5, ("navigation", "two_position"): 0.82, ("navigation", "rotating"): 1.08,
             ("tactical", "static"): 244, ("tactical", "two_position"): 36, ("tactical", "rotating"): 48,
             ("ADIS in-run", "static"): 1276, ("ADIS in-run", "two_position"): 83, ("ADIS in-run", "rotating"): 125}
_BESIDE = 1.75  # inches of a legend beside the axes
# Of two filters that do the same the one is drawn wide, the other thin upon it.
_LINES = {"ipekf": {"color": "C0", "linewidth": 2.4}, "ekf5": {"color": "black", "linewidth": 0.8, "linestyle": "--"},
          "ekf10": {"color": "C1", "linewidth": 1.0}, "ukf10": {"color": "C2", "linewidth": 1.0}}
LARGEST_RATIO, SQUARES = 1.1, (0.8, 1.25)
STEP_LIMITS = {"ekf5": 1.5, "ipekf, p = 10, gain at 1 Hz": 2.0, "riekf12, 10 Hz": 5.0}


def main(argv=None):
    """Write the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=OUT, help="folder of the results")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="of every Monte-Carlo figure")
    parser.add_argument("--workers", type=int, default=min(WORKERS, os.cpu_count() or 1), help="processes")
    arguments = parser.parse_args(argv)
    plots = arguments.out / "ins_alignment"
    plots.mkdir(parents=True, exist_ok=True)
    seeds, workers = arguments.seeds, arguments.workers

    table_2 = run_table_2(seeds, workers)
    chains = run_chains(seeds, workers)
    parked = run_parked(seeds, workers)
    predictive = run_predictive(max(seeds // 5, 2), workers)
    costs = step_costs()
    asked = [*asked_of_table_2(table_2), *asked_of_chains(chains), *asked_of_parked(parked), *asked_of_costs(costs)]
    sections = [
        heading_lines(seeds), asked_section(asked, table_2), table_2_section(table_2), figures_section(plots, workers),
        claims_section(table_2, predictive, costs, workers), predictive_section(predictive),
        large_error_section(max(seeds // 10, 1), workers), any_heading_section(parked), chain_section(chains, plots),
        aligned_section(parked), disturbance_section(max(seeds // 2, 1), workers), load_section(costs)]
    text = "\n\n".join("\n".join(section) for section in sections) + "\n"
    (arguments.out / "ins_alignment.md").write_text(text, encoding="utf-8")
    print(arguments.out / "ins_alignment.md")


def heading_lines(seeds):
    """Return what the reader needs to know first."""
    return [
        "# INS alignment at rest", "",
        f"Made by `study_ins_alignment` from commit {head_commit()}; {seeds} seeds (0, 1, 2 ...) "
        f"a figure unless told otherwise, 100 Hz, latitude {LATITUDE / DEG:.0f} deg. Headings in arcminutes, times "
        "in seconds. Sensors have a constant bias and white noise where the Cramer-Rao bound is to be met; all "
        "errors of their grade, in a swaying vehicle with people in it, where the product is on trial. Intervals "
        "are of 95 %."]


def table(header, rows):
    """Return the lines of a Markdown table."""
    return ["", "| " + " | ".join(header) + " |", "|" + "---|" * len(header),
            *("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows)]


def number(value):
    """Return a figure with three digits, or 'never'."""
    if math.isinf(value):
        return "never"
    return f"{value:.0f}" if value >= 99.95 else f"{value:.3g}"


def seconds(value):
    """Return a time, or 'never'."""
    return number(value) + " s" * math.isfinite(value)


def with_interval(mean_square, count, unit=ARCMINUTE):
    """Return a root mean square of so many independent values with its interval."""
    low, high = (math.sqrt(value) / unit for value in interval(mean_square, count))
    return f"{number(math.sqrt(mean_square) / unit)} ({number(low)} to {number(high)})"


# --- table 2 ------------------------------------------------------------------------------------------


def table_2_job(grade, noise_std, seed, names):
    """Return name -> (settled, trusted, mean square, mean z^2) of the filters over one recording."""
    rng = np.random.default_rng(seed)
    still = stand_still(DURATION)
    imu = add_biases_and_noise(still.imu, GRADES[grade], rng)
    start = wrong_start(still.truth.q_nb_wxyz[0], HEADING_ERROR, rng)
    noise = noise_std * rng.standard_normal((len(imu), 2))
    params = as_the_paper(GRADES[grade], noise_std)
    found = {}
    for name in names:
        one = run(name, still, imu, params, start, HEADING_ERROR, noise)
        found[name] = np.array([one.settled, one.trusted, *one.late()])
    return found


def run_table_2(seeds, workers):
    """Return (grade, sigma_R) -> name -> (runs, 4), and -> "bound" -> (time, mean square).

    IPEKF and EKF5 have all seeds where a figure was asked for; all else one in five.
    """
    cases = [(grade, noise_std) for grade in TABLE_GRADES for noise_std in NOISE_STDS]
    cases += [case for case in ASKED if case not in cases]
    few = max(seeds // 5, 1)
    jobs = [(*case, seed, ERROR_MODELS[:4 if seed < few and case[0] in TABLE_GRADES else 2])
            for case in cases for seed in range(seeds if case in ASKED else few)]
    found = each(table_2_job, jobs, workers)
    bounds = each(still_bound, cases, workers)
    result = {case: {"bound": bound} for case, bound in zip(cases, bounds, strict=True)}
    for (grade, noise_std, _, names), rows in zip(jobs, found, strict=True):
        for name in names:
            result[grade, noise_std].setdefault(name, []).append(rows[name])
    return {case: {name: np.array(rows) for name, rows in row.items()} for case, row in result.items()}


def bound_curve(grade, noise_std):
    """Return times and the Cramer-Rao bound of the heading's standard deviation at them."""
    t = np.concatenate([np.arange(0.25, 12.0, 0.25), np.arange(12.0, 60.0, 0.5), np.arange(60.0, DURATION + 1)])
    q_nb = np.tile(stand_still(1.0).truth.q_nb_wxyz[0], (len(t), 1))
    return t, heading_bound(np.round(1e9 * t).astype(np.int64), q_nb, as_the_paper(GRADES[grade], noise_std))


def still_bound(grade, noise_std):
    """Return the seconds after which the Cramer-Rao bound is within ACCURACY, and its mean square of late."""
    t, std = bound_curve(grade, noise_std)
    within = np.flatnonzero(std <= ACCURACY)
    return np.array([t[within[0]] if len(within) else math.inf, np.mean(std[t > 0.5 * DURATION] ** 2)])


def time_and_error(rows):
    """Return a cell: the median time, and the RMSE over runs and the second half of the time."""
    return f"{number(np.median(rows[:, 0]))} / {number(math.sqrt(np.mean(rows[:, 2])) / ARCMINUTE)}"


def table_2_section(table_2):
    """Return the paper's table 2 side by side."""
    rows = []
    for k, noise_std in enumerate(NOISE_STDS):
        ipekf, ekf, ukf = (f"{number(PAPER[name][k][0])} / {PAPER[name][k][1]:g} +- {PAPER[name][k][2]:g}"
                           for name in PAPER)
        rows.append(("the paper, ADIS16488A", f"{noise_std:g}", "", ipekf, "", ekf, ukf))
    for grade in TABLE_GRADES:
        for noise_std in NOISE_STDS:
            row = table_2[grade, noise_std]
            time, mean_square = row["bound"]
            rows.append((grade, f"{noise_std:g}", f"{number(time)} / {number(math.sqrt(mean_square) / ARCMINUTE)}",
                         *(time_and_error(row[name]) for name in ERROR_MODELS)))
    return ["## Table 2 side by side", "",
            f"Seconds until the heading stays within {ACCURACY / ARCMINUTE:.0f}' / RMSE in arcminutes over the last "
            f"{DURATION / 2:.0f} of {DURATION:.0f} s (the paper's: +- its standard deviation). The first heading is "
            f"{HEADING_ERROR / DEG:.0f} deg wrong, the tilt by 1 deg; the velocity is measured at 100 Hz with white "
            "noise of sigma_R, m/s. Times are medians. IPEKF and EKF5 have all seeds where a figure was asked for; all "
            "else one in five. IPEKF: closed loop, p = 10, Ry/Qm = 1e-4. *Bound*: Cramer-Rao, biases by their priors.",
            *table(("sensors", "sigma_R", "bound", "IPEKF", "EKF5", "EKF10", "UKF10"), rows)]


# --- asked and got ------------------------------------------------------------------------------------


def asked_of_table_2(table_2):
    """Return rows (what, asked, got, met) of the table that must come out."""
    rows = []
    for (grade, noise_std), (time, error) in ASKED.items():
        for name in ("ipekf", "ekf5"):
            found = table_2[grade, noise_std][name]
            settled, trusted, mean_square = np.median(found[:, 0]), np.median(found[:, 1]), np.mean(found[:, 2])
            low, high = (math.sqrt(value) / ARCMINUTE for value in interval(mean_square, len(found)))
            near = low <= error * (1 + ASKED_PART) and (high >= error * (1 - ASKED_PART))
            in_time = (math.isinf(settled) and math.isinf(time)) or abs(settled - time) <= ASKED_PART * time
            text = (f"{seconds(settled)} (by its own sigma {seconds(trusted)}) / "
                    f"{with_interval(mean_square, len(found))}")
            word = "yes" if near and in_time else "time: " + ("yes" if in_time else "no") + ", error: " + (
                "yes" if near else "better" if high < error else "no")
            rows.append((f"{name}, {grade}, sigma_R {noise_std:g}", f"{seconds(time)} / {error:g}', within 20 %", text,
                         word))
    return rows


def asked_section(rows, table_2):
    """Return what was asked for and what came out."""
    case = ("navigation", NOISE_STDS[0])
    bound = number(math.sqrt(table_2[case]["bound"][1]) / ARCMINUTE)
    return ["## Asked and got", "", *table(("what", "asked", "got", "met"), rows)[1:], "",
            f"The {ASKED[case][1]}' asked for with navigation-grade sensors is below their Cramer-Rao bound of {bound}'"
            ": it came of few seeds, whose gyro biases were small. A time ends with the last error above "
            f"{ACCURACY / ARCMINUTE:.0f}'; where the bound stays beyond that, it ends late and by chance, and the "
            "filter's own sigma never says so."]


def yes(met):
    """Return the word for a condition."""
    return "yes" if met else "no"


# --- the paper's figures ------------------------------------------------------------------------------


def one_run(name, grade, noise_std, seed=0, duration=None, r_factor=1, q_factor=1, period=1.0, **settings):
    """Return one filter over one recording, told standard deviations of R and Q that are so many times the truth."""
    rng = np.random.default_rng(seed)
    still = stand_still(duration or DURATION)
    errors = GRADES[grade]
    imu = add_biases_and_noise(still.imu, errors, rng)
    start = wrong_start(still.truth.q_nb_wxyz[0], HEADING_ERROR, rng)
    noise = noise_std * rng.standard_normal((len(imu), 2))
    params = as_the_paper(errors, r_factor * noise_std, **settings)
    params = replace(params, gyro_noise_density=q_factor * params.gyro_noise_density,
                     accel_noise_density=q_factor * params.accel_noise_density)
    return run(name, still, imu, params, start, HEADING_ERROR, noise, period)


def draw(function, plots):
    """Call a function that draws."""
    return function(plots)


def figures_section(plots, workers):
    """Draw figures 3 to 9, and that of the IPA acting, and return what they show."""
    functions = (draw_figure_3, draw_figures_4_and_5, draw_figure_6, draw_acting, draw_figures_7_to_9)
    *_, shares = each(draw, [(function, plots) for function in functions], workers)
    falls = ", ".join(f"p = {p}: {100 * closed:.0f} % ({100 * literal:.0f} %)"
                      for p, (closed, literal) in shares.items())
    return ["## Figures 3 to 9", "",
            "Navigation-grade sensors unless told otherwise, sigma_R 0.1 m/s, one seed.", "",
            "![figure 3](ins_alignment/figure_3.png)", "",
            "Figure 3. On the paper's own sensor no filter gets the accuracy it prints, and with sensors that allow "
            "it the IPEKF is no faster than the others.", "",
            "![figures 4 and 5](ins_alignment/figures_4_5.png)", "",
            "Figures 4 and 5. R and Q enlarged together, as factors on the standard deviations: IPEKF and EKF5 are "
            "delayed alike, and their covariance, which the IPA does not enter, is the same.", "",
            "![figure 6](ins_alignment/figure_6.png)", "",
            "Figure 6. Up to p = 20 the horizon makes next to no difference; a longer one weighs more in the sum "
            "of equation 2, and at p = 50 the IPA acts visibly: for the worse.", "",
            "![figures 7 to 9](ins_alignment/figures_7_9.png)", "",
            "Figures 7 to 9. Over minutes the cost J* falls in the closed loop, as the paper draws it, and rises in "
            "the literal form. From sample to sample it falls on this share of them, closed loop (literal): "
            f"{falls}; a Lyapunov function would on all."]


def _axes(rows, columns, share_y=False, margin=0.15):
    """Return a figure and its axes, to be saved by :func:`_save`, with so many inches beside them."""
    from matplotlib.figure import Figure

    width, height = 4.05 * columns + margin, 3.0 * rows
    figure = Figure(figsize=(width, height))
    figure.subplots_adjust(left=0.85 / width, right=1 - margin / width, bottom=0.5 / height, top=1 - 0.3 / height,
                           wspace=0.05 if share_y else 0.32, hspace=0.4)
    return figure, figure.subplots(rows, columns, sharey=share_y, squeeze=False)


def _save(figure, path):
    figure.savefig(path, dpi=90, metadata={"Software": None})


def _legend_beside(figure):
    """Tell once, beside the axes, what each line is: over them a legend would hide lines."""
    handles = {}
    for axes in figure.axes:
        handles |= dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    figure.legend(handles.values(), handles.keys(), fontsize="small", loc="center right")


def _label(axes, title, x="s", y="arcmin", legend="best"):
    axes.set_title(title, fontsize="medium")
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.3)
    if legend:
        axes.legend(fontsize="small", loc=legend)
    if axes.get_yscale() != "linear":
        # Not as powers of ten: mathematical type takes longer to set than all the rest to draw.
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("")


def draw_figure_3(plots):
    """Draw the heading error against time: IPEKF beside EKF and UKF, the bound, and what the paper prints."""
    noise_std, (_, printed, _) = NOISE_STDS[-1], PAPER["ipekf"][-1]
    figure, panels = _axes(2, 2, margin=_BESIDE)
    for row, grade in zip(panels, ("ADIS in-run", "navigation"), strict=True):
        curves = {name: one_run(name, grade, noise_std) for name in ERROR_MODELS}
        t, std = bound_curve(grade, noise_std)
        for axes, rivals in zip(row, (("ekf10", "ekf5"), ("ukf10",)), strict=True):
            for name in ("ipekf", *rivals):
                axes.semilogy(curves[name].t, np.abs(curves[name].error) / ARCMINUTE, label=name, **_LINES[name])
            axes.semilogy(t, std / ARCMINUTE, "k:", label="bound, one sigma")
            axes.axhline(printed, color="0.6", label="printed for the IPEKF")
            axes.set_ylim(bottom=0.1)
            _label(axes, f"3: {grade}, |error|", legend="")
    _legend_beside(figure)
    _save(figure, plots / "figure_3.png")


def draw_figures_4_and_5(plots):
    """Draw heading error and spread with R and Q enlarged together."""
    figure, (row,) = _axes(1, 2, margin=_BESIDE)
    for enlarge, colour in zip(ENLARGED, ("C0", "C1", "C2"), strict=True):
        for name in ("ipekf", "ekf5"):
            one = one_run(name, "navigation", 0.1, r_factor=enlarge, q_factor=enlarge)
            style = _LINES[name] | ({"color": colour} if name == "ipekf" else {})
            for axes, values in zip(row, (np.abs(one.error), one.std), strict=True):
                label = f"ipekf, x {enlarge}" if name == "ipekf" else "ekf5, likewise"
                axes.semilogy(one.t, values / ARCMINUTE, label=label, **style)
    row[0].set_ylim(bottom=0.1)
    _label(row[0], "4: heading, |error|", legend="")
    _label(row[1], "5: heading, standard deviation of the filter", legend="")
    _legend_beside(figure)
    _save(figure, plots / "figures_4_5.png")


def draw_figure_6(plots):
    """Draw the heading error for several horizons."""
    figure, (row,) = _axes(1, 2, margin=_BESIDE)
    plain = one_run("ekf5", "navigation", 0.1)
    # The longest first: the others lie upon each other.
    for k, horizon in reversed(list(enumerate(HORIZONS))):
        one = one_run("ipekf", "navigation", 0.1, horizon=horizon)
        style = {"label": f"p = {horizon}", "color": f"C{k}", "linewidth": 1.0 + 0.6 * k}
        row[0].semilogy(one.t, np.abs(one.error) / ARCMINUTE, **style)
        row[1].semilogy(one.t, np.abs(one.error - plain.error) / ARCMINUTE, **style)
    row[0].set_ylim(bottom=0.1)
    row[1].set_ylim(bottom=1e-5)
    _label(row[0], "6: heading, |error|", legend="")
    _label(row[1], "|IPEKF - EKF5|", legend="")
    _legend_beside(figure)
    _save(figure, plots / "figure_6.png")


def draw_figures_7_to_9(plots):
    """Draw the cost for three horizons; return horizon -> share of samples on which it falls, both variants."""
    figure, (row,) = _axes(1, 3)
    shares = {}
    for axes, (digit, horizon) in zip(row, ((7, 2), (8, 10), (9, 50)), strict=True):
        shares[horizon] = []
        for variant in ("closed_loop", "paper_literal"):
            one = one_run("ipekf", "navigation", 0.1, duration=min(DURATION, SHORT), period=1 / RATE,
                          horizon=horizon, variant=variant)
            axes.semilogy(one.t[1::10], one.cost[1::10], linewidth=0.7, label=variant)
            shares[horizon].append(np.mean(np.diff(one.cost[2:]) < 0))
        _label(axes, f"{digit}: J*, p = {horizon}", y="J* / Qm")
    _save(figure, plots / "figures_7_9.png")
    return shares


# --- the predictive algorithm -------------------------------------------------------------------------


def predictive_job(seed):
    """Return what the IPA does on one recording of tactical- and one of navigation-grade sensors.

    Returns
    -------
    ratios : (len(RATIOS), 2)
        Heading RMSE and mean error of late by Ry / Qm, navigation grade, less EKF5's.
    modelled : (len(MODELLED), 2, 5)
        What the IPA takes for the errors of the model's rates, and what they are; tactical grade.
    small : (3,)
        At the default weights: RMS of Dm* on the heading's rate and of the IPEKF's heading less EKF5's, rad, and
        the heading's spread.
    coloured : (2, 2)
        Heading RMSE of late with white and with coloured noise of the velocity, IPEKF and EKF5.
    tuned : (3, 2)
        The same with R a hundred times too small, right, too large.
    jacobian : (2, 2)
        The same with the paper's and the mended Jacobian, EKF5 and EKF10, tactical grade, small R.
    """
    grade, noise_std = "navigation", 1e-2
    plain = one_run("ekf5", grade, noise_std, seed)
    late = plain.t > 0.5 * DURATION
    ratios = []
    for ratio in RATIOS:
        one = one_run("ipekf", grade, noise_std, seed, weight_ratio=ratio)
        ratios.append([np.mean(one.error[late] ** 2), np.mean((one.error - plain.error)[late])])
    usual = one_run("ipekf", grade, noise_std, seed)
    increment = np.diff(usual.model_error[late], axis=0) / RATE  # of a second of increments, mean rate times 1 s
    small = [root_mean(increment[:, 4]), root_mean((usual.error - plain.error)[late]), np.mean(plain.std[late])]
    return (np.array(ratios), modelled_errors(seed), np.array(small), coloured_errors(seed),
            np.array([[np.mean(tuned_run(name, seed, factor).error[late] ** 2) for name in ("ipekf", "ekf5")]
                      for factor in (0.01, 1.0, 100.0)]),
            np.array([[one_run(name, "tactical", 1e-3, seed, jacobian=jacobian).late()[0]
                       for name in ("ekf5", "ekf10")] for jacobian in ("paper", "mended")]))


def tuned_run(name, seed, factor):
    """Return a navigation-grade run with R so many times its right value."""
    return one_run(name, "navigation", 1e-2, seed, r_factor=math.sqrt(factor))


def coloured_errors(seed):
    """Return late mean squares of the heading, white and coloured noise of the velocity by IPEKF and EKF5."""
    rng = np.random.default_rng(seed)
    still = stand_still(DURATION)
    errors, noise_std = GRADES["navigation"], 1e-2
    imu = add_biases_and_noise(still.imu, errors, rng)
    start = wrong_start(still.truth.q_nb_wxyz[0], HEADING_ERROR, rng)
    white = noise_std * rng.standard_normal((len(imu), 2))
    keep = math.exp(-1 / (RATE * COLOUR_TIME))
    coloured = first_order_recursion(np.full(len(white), keep), math.sqrt(1 - keep ** 2) * white)
    return np.array([[run(name, still, imu, as_the_paper(errors, noise_std), start, HEADING_ERROR,
                          noise, 1.0).late()[0] for name in ("ipekf", "ekf5")]
                     for noise in (white, coloured)])


def modelled_errors(seed):
    """Return, of MODELLED, what the IPA takes for the errors of the model's rates, and what they are, (5, 2, 5)."""
    rng = np.random.default_rng(seed)
    still = stand_still(DURATION)
    imu = add_biases_and_noise(still.imu, GRADES["tactical"], rng)
    dcm_nb = dcm_from_quaternion(still.truth.q_nb_wxyz[0])
    rate_n, force_n = (dcm_nb @ np.mean(read - exact, axis=0) for read, exact in (
        (imu.gyro_b, still.imu.gyro_b), (imu.accel_b, still.imu.accel_b)))
    truth = np.array([force_n[0], force_n[1], *-rate_n])
    start = wrong_start(still.truth.q_nb_wxyz[0], HEADING_ERROR, rng)
    noise = 1e-2 * rng.standard_normal((len(imu), 2))
    found = []
    for variant, ratio in MODELLED:
        params = as_the_paper(GRADES["tactical"], 1e-2, variant=variant, weight_ratio=ratio)
        one = run("ipekf", still, imu, params, start, HEADING_ERROR, noise, 1.0)
        found.append([np.mean(one.model_error[len(one.t) // 2:], axis=0), truth])
    return np.array(found)


def run_predictive(seeds, workers):
    """Return what :func:`predictive_job` does of every seed, stacked, as a list."""
    found = each(predictive_job, [(seed,) for seed in range(seeds)], workers)
    return [np.array(part) for part in zip(*found, strict=True)]


def slopes(modelled):
    """Return by variant and axis the slope of the modelled error on the true one, and their correlation."""
    ours, truth = modelled[:, :, 0], modelled[:, :, 1]
    product = np.sum(ours * truth, axis=0)
    return (product / np.sum(truth ** 2, axis=0),
            product / np.sqrt(np.sum(ours ** 2, axis=0) * np.sum(truth ** 2, axis=0)))


def predictive_section(predictive):
    """Return how large Dm is, what the IPA takes for the model's error, and where it acts."""
    ratios, modelled, small, *_ = predictive
    plain = math.sqrt(np.mean(predictive[4][:, 1, 1])) / ARCMINUTE
    rows = [(f"{ratio:.0e}", number(math.sqrt(np.mean(ratios[:, k, 0])) / ARCMINUTE),
             number(root_mean(ratios[:, k, 1]) / ARCMINUTE))
            for k, ratio in enumerate(RATIOS)]
    slope, correlation = slopes(modelled)
    model_rows = [(f"{variant}, {ratio:.0e}", *(f"{slope[v, k]:.2g} ({correlation[v, k]:.2f})" for k in range(5)))
                  for v, (variant, ratio) in enumerate(MODELLED)]
    increment, apart, std = np.sqrt(np.mean(small ** 2, axis=0)) / ARCMINUTE
    return ["## The predictive algorithm (IPA)", "",
            f"Navigation-grade sensors, sigma_R 0.01 m/s, {len(small)} seeds. With the default weights (Ry/Qm = 1e-4) "
            f"the IPA moves the heading by {increment:.1e}' a second; the IPEKF's heading is {apart:.1e}' from "
            f"EKF5's (RMS), whose own spread is {std:.2g}'. In the limit of no weight both are the same filter. The "
            "free response is that of the estimated state alone: no measurement enters it, so it cannot learn what "
            "the model lacks; what it does is to pull the estimated velocity error towards zero.", "",
            f"Where it acts: EKF5 has {plain:.2g}'.",
            *table(("Ry/Qm", "IPEKF, RMSE, arcmin", "of it mean difference from EKF5, arcmin (RMS over seeds)"), rows),
            "", "![the IPA acting](ins_alignment/ipa.png)", "",
            "What it holds for the error of the model's rates (m), tactical grade: slope on the true error and "
            "correlation over seeds; slope and correlation of 1 would be an estimate.",
            *table(("variant, Ry/Qm", "force N", "force E", "rate N", "rate E", "rate D"), model_rows)]


def draw_acting(plots):
    """Draw the heading with the IPA acting."""
    figure, (row,) = _axes(1, 2, margin=_BESIDE)
    plain = one_run("ekf5", "navigation", 1e-2)
    for k, ratio in reversed(list(enumerate(RATIOS))):
        one = one_run("ipekf", "navigation", 1e-2, weight_ratio=ratio)
        style = {"label": f"Ry/Qm = {ratio:g}", "color": f"C{k}", "linewidth": 1.0 + 0.4 * k}
        row[0].semilogy(one.t, np.abs(one.error) / ARCMINUTE, **style)
        row[1].semilogy(one.t, np.abs(one.error - plain.error) / ARCMINUTE, **style)
    row[0].semilogy(plain.t, np.abs(plain.error) / ARCMINUTE, label="EKF5", **_LINES["ekf5"])
    row[0].set_ylim(bottom=0.1)
    row[1].set_ylim(bottom=1e-4)
    _label(row[0], "heading, |error|", legend="")
    _label(row[1], "|IPEKF - EKF5|", legend="")
    _legend_beside(figure)
    _save(figure, plots / "ipa.png")


# --- the paper's claims -------------------------------------------------------------------------------


def claims_section(table_2, predictive, costs, workers):
    """Return a verdict on each claim of the paper, with the figure that decides."""
    ratios, modelled, small, coloured, tuned, jacobian = predictive
    slope, correlation = slopes(modelled)
    white, colour = np.sqrt(np.mean(coloured, axis=0)) / ARCMINUTE
    by_r = np.sqrt(np.mean(tuned, axis=0)) / ARCMINUTE
    paper, mended = np.sqrt(np.mean(jacobian, axis=0)) / ARCMINUTE
    five, ten = (observable_states(n) for n in (5, 10))
    times = {name: [number(np.median(table_2["navigation", s][name][:, 0])) for s in NOISE_STDS]
             for name in ERROR_MODELS}
    adis = table_2["ADIS in-run", NOISE_STDS[0]]
    noise_only = math.sqrt(table_2["ADIS noise only", NOISE_STDS[0]]["bound"][1]) / ARCMINUTE
    reach = number(math.sqrt(adis["bound"][1]) / ARCMINUTE)
    literal, open_loop, *by_horizon = each(rms_of_two, [
        ("ipekf", 1e-2, {"variant": "paper_literal"}), ("ekf5", 1e-2, {"feedback_period": 0.0}),
        *(("ipekf", NOISE_STDS[-1], {"horizon": p}) for p in HORIZONS)], workers)
    rows = [
        ("The IPEKF converges in 8, 20, 52 s for sigma_R 1e-3, 1e-2, 1e-1",
         f"with navigation-grade sensors, yes ({', '.join(times['ipekf'])} s), and EKF5 alike "
         f"({', '.join(times['ekf5'])} s): it is the bound's time, not the IPA's merit; with the paper's sensor never"),
        ("0.39', 2.67', 4.09' with an ADIS16488A",
         f"impossible at rest: its noise alone bounds the heading to {number(noise_only)}' RMS over the last 600 s, "
         f"with the in-run bias to {reach}'"),
        ("More accurate and faster than EKF and UKF",
         f"no: navigation grade, EKF10 {', '.join(times['ekf10'])} s, UKF10 {', '.join(times['ukf10'])} s; the RMSE "
         "is that of the bound for all (table 2)"),
        ("The IPA estimates the model error",
         f"no: its slope on the true north rate error is {slope[1, 2]:.1g} in the closed loop; driven by the residual "
         f"it follows that one in part (slope {slope[-1, 2]:.2f}, correlation {correlation[-1, 2]:.2f}) and no other "
         "(table below)"),
        ("A longer horizon is more accurate", "no: RMSE " + ", ".join(
            f"{error:.4g}' (p = {p})" for p, error in zip(HORIZONS, by_horizon, strict=True)) + " at sigma_R 0.1"),
        ("Less load than EKF and UKF",
         f"only with a gain that is kept for a second: {costs['ipekf, p = 10, gain at 1 Hz'] / costs['ekf10']:.2f} "
         f"of EKF10's time, {costs['ipekf, p = 10, gain every sample'] / costs['ekf10']:.1f} times with the paper's "
         "gain at every sample; EKF5 is the same filter for less (table 3)"),
        ("The noise may be coloured",
         f"no more than for EKF5: RMSE {white[0]:.2g}' and {white[1]:.2g}' (IPEKF, EKF5) with white noise, "
         f"{colour[0]:.2g}' and {colour[1]:.2g}' with noise of {COLOUR_TIME:g} s correlation time"),
        ("Less sensitive to R and Q than the EKF",
         f"no: with R a hundred times too small, right, too large {slash(by_r[:, 0])}' and EKF5 {slash(by_r[:, 1])}'; "
         "figures 4 and 5"),
        ("Five states instead of ten raise observability",
         f"in name: {five} of 5 states are observable, {ten} of 10; the biases that are left out are still there and "
         "the filter's sigma no longer knows of them: mean z^2 with the ADIS in-run "
         f"{np.mean(adis['ipekf'][:, 3]):.0f} (IPEKF), {np.mean(adis['ekf10'][:, 3]):.2f} (EKF10)"),
        ("Asymptotically stable, with J* as Lyapunov function",
         "not shown: the proof assumes x_{k+p} = 0, which equations 10 to 12 do not impose; J* rises on about half of "
         "the samples (figures 7 to 9). With the default weights the filter is as stable as EKF5, of which it is a "
         f"copy; at Ry/Qm = {RATIOS[-1]:g} it is {number(math.sqrt(np.mean(ratios[:, -1, 0])) / ARCMINUTE)}' off"),
        ("The Jacobian of appendix A",
         "believes in a heading that cannot be seen: tactical grade, sigma_R 0.001, with it "
         f"{number(paper[0])}' (EKF5) and {number(paper[1])}' (EKF10), mended {number(mended[0])}' and "
         f"{number(mended[1])}'"),
        ("The equations as printed (open loop, m unused)",
         f"lost: {number(literal)}' of late with navigation-grade sensors; EKF5 in open loop has {number(open_loop)}', "
         f"the closed loop {by_r[1, 0]:.2g}'. The IPA pulls the velocity to zero, which in open loop is not its error"),
    ]
    return ["## The paper's claims", *table(("claim", "verdict"), rows)]


def slash(values):
    """Return figures with slashes between them."""
    return " / ".join(number(value) for value in values)


def rms_of_two(name, noise_std, settings):
    """Return a filter's late RMSE of the heading over two navigation-grade recordings, arcmin."""
    return math.sqrt(np.mean([one_run(name, "navigation", noise_std, seed, **settings).late()[0]
                              for seed in range(2)])) / ARCMINUTE


def observable_states(count):
    """Return the rank of the observability matrix at rest, in units of the Earth rate and gravity."""
    params = told(GRADES["navigation"])
    gravity = params.local_gravity
    A = np.zeros((count, count))
    x = np.zeros(count)
    dcm_nb = dcm_from_quaternion(stand_still(1.0).truth.q_nb_wxyz[0])
    kernels.model_jacobian(params.constants(), count, x, np.array([0.0, 0.0, -gravity]), dcm_nb, A)
    unit = np.array([gravity / EARTH_RATE] * 2 + [1.0] * 3 + [EARTH_RATE] * 3 + [gravity] * 2)[:count]
    A = A * unit / unit[:, None] / EARTH_RATE
    rows = [np.eye(2, count)]
    for _ in range(count - 1):
        rows.append(rows[-1] @ A)
    rows = [block / np.linalg.norm(block) for block in rows]
    return int(np.linalg.matrix_rank(np.concatenate(rows), tol=1e-9))


# --- large heading errors -----------------------------------------------------------------------------


def large_error_job(degrees, seed):
    """Return filter -> late mean square of the heading, started so many degrees off; navigation grade."""
    rng = np.random.default_rng(seed)
    still = stand_still(DURATION)
    imu = add_biases_and_noise(still.imu, GRADES["navigation"], rng)
    start = wrong_start(still.truth.q_nb_wxyz[0], degrees * DEG, rng)
    return {name: run(name, still, imu, as_the_paper(GRADES["navigation"], 1e-3) if name in ERROR_MODELS else
                      told(GRADES["navigation"], robust=False, adaptive=False), start, degrees * DEG, period=1.0
                      ).late()[0] for name in (*ERROR_MODELS, "mekf", "riekf6", "riekf12")}


def large_error_section(seeds, workers):
    """Return the table of heading errors that the filters start with."""
    jobs = [(degrees, seed) for degrees in LARGE_ERRORS_DEG for seed in range(seeds)]
    found = dict(zip(jobs, each(large_error_job, jobs, workers), strict=True))
    names = list(found[jobs[0]])
    rows = [(degrees, *(number(math.sqrt(np.mean([found[degrees, seed][name] for seed in range(seeds)])) / ARCMINUTE)
                        for name in names)) for degrees in LARGE_ERRORS_DEG]
    return ["## Large heading errors", "",
            f"RMSE over the last {DURATION / 2:.0f} s, arcmin, started so many degrees off and told so; navigation "
            f"grade, {seeds} seeds; error models at 100 Hz with sigma_R 0.001 m/s, the others at 10 Hz with 0.005 m/s.",
            *table(("deg", *names), rows), "",
            "The product never starts a filter from a guess: a coarse alignment comes first, and the filter sees its "
            "window again."]


# --- the default chain --------------------------------------------------------------------------------


def chain_params(grade, scheme):
    """Return the product's parameters for a grade and a scheme."""
    return told(GRADES[grade], zero_velocity_while_turning=scheme != "static")


def run_chains(seeds, workers):
    """Return (grade, scheme) -> (bound's standard deviation, errors and spreads (runs, 2), rad)."""
    stands = dict(zip(SCHEMES[1:], each(stand_at_rest, [(scheme,) for scheme in SCHEMES[1:]], workers), strict=True))
    stands["static"] = stand_still(DURATION)
    cases = [(grade, scheme) for grade in CHAIN_GRADES for scheme in SCHEMES]
    many = {case: seeds * MORE_SEEDS if case in PRECISE else seeds for case in cases}
    jobs = [(stands[scheme], GRADES[grade], chain_params(grade, scheme), seed, DURATION / 4)
            for grade, scheme in cases for seed in range(many[grade, scheme])]
    runs = iter(each(chain_job, jobs, workers))
    bounds = each(chain_bound, [(stands[scheme], chain_params(grade, scheme)) for grade, scheme in cases], workers)
    return {case: (bound, np.array([next(runs).final for _ in range(many[case])]))
            for case, bound in zip(cases, bounds, strict=True)}


def stand_at_rest(scheme):
    """Return the recording of a vehicle that does not sway."""
    return stand(scheme, DURATION, disturbance=0.0)


def chain_bound(stand, params):
    """Return the Cramer-Rao bound at the end, rad."""
    stamp_ns = stand.imu.stamp_ns[0] + np.arange(round(DURATION)) * 1_000_000_000
    at = np.minimum(np.searchsorted(stand.truth.stamp_ns, stamp_ns), len(stand.truth.stamp_ns) - 1)
    return heading_bound(stamp_ns, stand.truth.q_nb_wxyz[at], params)[-1]


def chain_figures(bound, finals):
    """Return the mean square over the bound's, and the mean z^2."""
    return np.mean(finals[:, 0] ** 2) / bound ** 2, np.mean((finals[:, 0] / finals[:, 1]) ** 2)


def believed(finals):
    """Return the errors and spreads of the runs that gave a heading."""
    return finals[np.isfinite(finals[:, 0])]


def chain_section(chains, plots):
    """Return the default chain against the bound."""
    rows = []
    for (grade, scheme), (bound, finals) in chains.items():
        good = believed(finals)
        first = (grade, scheme.replace("_", "-"), f"{len(good)} of {len(finals)}", number(bound / ARCMINUTE))
        printed = PROTOTYPE.get((grade, scheme))
        if not len(good):
            rows.append((*first, "refused", "-", "-", "-"))
            continue
        ratio, square = chain_figures(bound, good)
        low, high = (math.sqrt(value) for value in interval(ratio, len(good)))
        z_low, z_high = interval(square, len(good))
        rows.append((*first, number(root_mean(good[:, 0]) / ARCMINUTE),
                     f"{math.sqrt(ratio):.2f} ({low:.2f} to {high:.2f})", f"{square:.2f} ({z_low:.2f} to {z_high:.2f})",
                     number(printed) if printed else "-"))
    draw_chains(plots, chains)
    return ["## The default chain against the Cramer-Rao bound", "",
            f"Coarse alignment, then riekf12 (`oba_riekf`), {DURATION:.0f} s; two-position: turned by half a turn in "
            "the middle; rotating: 6 deg/s, a turn one way, a turn the other. RMS and bound in arcmin at the end, of "
            "the runs that gave a heading to be believed.",
            *table(("sensors", "scheme", "runs with a heading", "bound", "RMS", "RMS / bound", "mean z^2",
                    "prototype's RMS"), rows),
            "", "![errors over their spread](ins_alignment/chain.png)"]


def draw_chains(plots, chains):
    """Draw every run's error over the bound."""
    figure, (row,) = _axes(1, len(SCHEMES), share_y=True)
    for axes, scheme in zip(row, SCHEMES, strict=True):
        for place, grade in enumerate(CHAIN_GRADES):
            bound, finals = chains[grade, scheme]
            axes.plot(np.full(len(finals), place), finals[:, 0] / bound, "_", markersize=12, alpha=0.6)
        axes.axhspan(-1, 1, color="0.85", zorder=0, label="bound, one sigma")
        axes.set_xticks(range(len(CHAIN_GRADES)), [grade.replace(" ", "\n") for grade in CHAIN_GRADES],
                        fontsize="small")
        axes.set_xlim(-0.5, len(CHAIN_GRADES) - 0.5)
        _label(axes, scheme.replace("_", "-"), x="", y="error / bound" if scheme == SCHEMES[0] else "")
    _save(figure, plots / "chain.png")


def asked_of_chains(chains):
    """Return rows (what, asked, got, met)."""
    rows = []
    for case in PRECISE:
        bound, finals = chains[case]
        finals = believed(finals)
        ratio, square = chain_figures(bound, finals)
        low, high = (math.sqrt(value) for value in interval(ratio, len(finals)))
        z_low, z_high = interval(square, len(finals))
        name = f"default chain, {case[0]}, {case[1].replace('_', '-')}, {len(finals)} seeds"
        rows += [(f"{name}: RMS / bound", f"<= {LARGEST_RATIO}", f"{math.sqrt(ratio):.2f} ({low:.2f} to {high:.2f})",
                  yes(math.sqrt(ratio) <= LARGEST_RATIO)),
                 (f"{name}: mean z^2", f"{SQUARES[0]} to {SQUARES[1]}",
                  f"{square:.2f} ({z_low:.2f} to {z_high:.2f})", yes(SQUARES[0] <= square <= SQUARES[1]))]
    return rows


# --- any heading, and ALIGNED -------------------------------------------------------------------------


def run_parked(seeds, workers):
    """Return grade -> list of (ChainRun, riekf6's error and spread), RUNS_A_SEED runs a seed."""
    count = RUNS_A_SEED * seeds
    motions = min(MOTIONS, count)
    each_has = range(FRESH_SEED, FRESH_SEED + count // motions)
    grades = ("navigation", "tactical")
    jobs = [(grades, FRESH_MOTION + motion, each_has, SHORT, -math.pi + 2 * math.pi * (motion + 0.5) / motions)
            for motion in range(motions)]
    found = each(parked_job, jobs, workers)
    return {grade: [one for part in found for one in part[grade]] for grade in grades}


def any_heading_section(parked):
    """Return how the alignment fares from any heading."""
    rows = []
    for grade, runs in parked.items():
        for name, pairs in (("default chain", np.array([chain.final for chain, _ in runs])),
                            ("riekf6, first heading anywhere", np.array([blind for _, blind in runs]))):
            lost = diverged(pairs, grade)
            pairs = believed(pairs)
            z = np.abs(pairs[:, 0] / pairs[:, 1])
            rows.append((grade, name, len(pairs), with_interval(np.mean(pairs[:, 0] ** 2), len(pairs)),
                         number(np.max(np.abs(pairs[:, 0])) / ARCMINUTE), number(np.median(pairs[:, 1]) / ARCMINUTE),
                         f"{np.mean(z ** 2):.2f}", f"{np.max(z):.1f}", lost))
    return ["## Any initial heading", "",
            f"{SHORT:.0f} s in a swaying vehicle with people in it and all sensor errors, at headings all round the "
            f"circle; vehicles and sensors that no constant was tuned on (from {FRESH_MOTION} and {FRESH_SEED} on, the "
            "other tables' are 0, 1, 2 ...). riekf6, which has no biases, starts with a heading drawn from the whole "
            "circle, and its sigma does not know of biases. Diverged: more than six times the heading's floor away at "
            "the end.",
            *table(("sensors", "method", "runs", "RMS", "largest error", "median sigma", "mean z^2", "largest z",
                    "diverged"), rows)]


def floor(grade):
    """Return the heading's floor of a grade after SHORT seconds, rad."""
    params = told(PARKED_GRADES[grade].errors)
    return math.hypot(params.gyro_bias_spread, params.gyro_noise_density / math.sqrt(SHORT)) / params.north_rate


def diverged(pairs, grade):
    """Return how many errors are not those of a heading found; none given counts too."""
    return int(np.sum(~(np.abs(pairs[:, 0]) <= 6 * floor(grade))))


def aligned_figures(runs):
    """Return what ALIGNED is worth.

    Returns
    -------
    dict
        runs that reached it, that said so while more than 4 sigma off, spread over RMS at the end.
    """
    reached = np.array([chain.aligned.any() for chain, _ in runs])
    false = np.array([(chain.aligned & (np.abs(chain.error) > 4 * chain.std)).any() for chain, _ in runs])
    finals = believed(np.array([chain.final for chain, _ in runs]))
    first = [chain.t[np.argmax(chain.aligned)] for chain, _ in runs if chain.aligned.any()]
    return {"reached": np.mean(reached), "false": int(np.sum(false)),
            "spread": math.sqrt(np.mean(finals[:, 1] ** 2)) / root_mean(finals[:, 0]),
            "time": float(np.median(first)) if first else math.inf}


def aligned_section(parked):
    """Return what ALIGNED is worth."""
    rows = []
    for grade, runs in parked.items():
        found = aligned_figures(runs)
        rows.append((grade, len(runs), f"{100 * found['reached']:.1f} %", number(found["time"]), found["false"],
                     f"{found['spread']:.2f}"))
    target = told(GRADES["navigation"]).target_std
    return ["## ALIGNED", "",
            f"The same runs; target {target / DEG:g} deg. A tactical grade at rest has a floor of "
            f"{floor('tactical') / DEG:.1f} deg and must never say so.",
            *table(("sensors", "runs", f"ALIGNED within {SHORT:.0f} s", "median time, s", "said while 4 sigma off",
                    "sigma / RMS"), rows)]


def asked_of_parked(parked):
    """Return rows (what, asked, got, met)."""
    rows = []
    for grade, runs in parked.items():
        lost = diverged(np.array([chain.final for chain, _ in runs]), grade)
        rows.append((f"any heading, {grade}, {len(runs)} seeds: diverged", "0", lost, yes(lost == 0)))
    false = sum(aligned_figures(runs)["false"] for runs in parked.values())
    count = sum(len(runs) for runs in parked.values())
    found = aligned_figures(parked["navigation"])
    return [*rows, (f"ALIGNED while 4 sigma off, {count} runs", "0", false, yes(false == 0)),
            (f"ALIGNED within {SHORT:.0f} s, navigation", ">= 95 %", f"{100 * found['reached']:.1f} %",
             yes(found["reached"] >= 0.95)),
            ("sigma / RMS then", "<= 2", f"{found['spread']:.2f}", yes(found["spread"] <= 2))]


# --- disturbances -------------------------------------------------------------------------------------


def disturbance_section(seeds, workers):
    """Return what wind and people do."""
    jobs = [(("navigation",), 1000 + motion, range(1), SHORT, 0.3 * motion, strength)
            for strength in STRENGTHS for motion in range(seeds)]
    found = dict(zip(jobs, each(parked_job, jobs, workers), strict=True))
    rows = []
    for strength in STRENGTHS:
        runs = [pair for job, pairs in found.items() if job[-1] == strength for pair in pairs["navigation"]]
        finals = believed(np.array([chain.final for chain, _ in runs]))
        rows.append((f"{strength:g}", len(finals), with_interval(np.mean(finals[:, 0] ** 2), len(finals)),
                     number(np.median(finals[:, 1]) / ARCMINUTE),
                     f"{np.mean((finals[:, 0] / finals[:, 1]) ** 2):.2f}",
                     f"{100 * aligned_figures(runs)['reached']:.0f} %"))
    return ["## Disturbances", "",
            f"Navigation grade, {SHORT:.0f} s, {seeds} vehicles each: wind and walking people of so many times their "
            "usual strength (sway of 0.3 mrad, leaning of 0.8 mrad).",
            *table(("strength", "runs with a heading", "RMS, arcmin", "median sigma", "mean z^2", "ALIGNED"), rows)]


# --- load ---------------------------------------------------------------------------------------------


def step_costs(count=3000):
    """Return name -> microseconds per sample at 100 Hz, or per step at 10 Hz, on this machine."""
    imu = stand_still(count / RATE).imu
    dt = sample_intervals(imu.stamp_ns)
    start = stand_still(1.0).truth.q_nb_wxyz[0]
    none = np.empty((0, kernels.OUT_SIZE))
    functions = {}
    for name, settings in (("ekf5", {}), ("ekf10", {}), ("ukf10", {}),
                           ("ipekf, p = 10, gain at 1 Hz", {}), ("ipekf, p = 2, gain at 1 Hz", {"horizon": 2}),
                           ("ipekf, p = 10, gain every sample", {"gain_period": 0.0}),
                           ("ipekf, p = 2, gain every sample", {"horizon": 2, "gain_period": 0.0})):
        params = as_the_paper(GRADES["navigation"], 1e-2, **settings)
        state = Filter(name.split(",")[0], params, start, heading_covariance(HEADING_ERROR))
        functions[name] = lambda state=state: state.run_samples(dt, imu.gyro_b, imu.accel_b, True, 1, none)
    params = told(GRADES["navigation"])
    steps, _ = reduce(imu, dt, params.zero_velocity_period)
    for name in ("riekf12", "riekf6"):
        state = Filter(name, params, start, heading_covariance(HEADING_ERROR))

        def steps_of(state=state):
            state.run_steps(steps, none)
        steps_of.samples = len(steps)
        functions[f"{name}, 10 Hz"] = steps_of
    return times_in_turn(functions, count, process_time, STEP_ROUNDS)


def formula_counts():
    """Return the paper's operation counts by its own formulas (table 3)."""
    def ekf(n, m):
        return 6 * n ** 3 + 6 * n * n * m + 4 * n * m * m + m ** 3 + n * m - n

    return {"EKF": ekf(10, 2), "UKF": round(16 / 3 * 1000 + 1200 + 160 + 1100 + 8 + 20 + 30),
            **{f"IPEKF, p = {p}": ekf(5, 2) + 25 * p * p * 2 + 25 * p * 2 for p in (10, 2)}}


def true_counts():
    """Return multiplications and additions of dense arithmetic, (at every sample, at every new gain)."""
    def ekf(n, m):
        covariance = 2 * n * n * (2 * n - 1) + n * n
        gain = n * m * (2 * n - 1) + m * m * (2 * n - 1) + m * m + 2 * m ** 3 + n * m * (2 * m - 1)
        return covariance + gain + 2 * n * m + 2 * m + n + 2 * n * n * m

    def ipa(n, m, p):
        each_sample = 2 * m * n * p + 2 * n * m * p + (2 * m * p + 1) * m * p
        new_gain = 2 * m * n * n * p + m * m * n * p * (p + 1) + 2 * (m * p) ** 3 + 2 * n * (m * p) ** 2
        return each_sample, new_gain

    def ukf(n):
        return n ** 3 // 3 + (2 * n + 1) * (60 + 4 * n) + (2 * n + 1) * n * (n + 1) * 3 // 2 + 6 * n * n

    ten = ipa(5, 2, 10)
    two = ipa(5, 2, 2)
    return {"EKF": (ekf(10, 2), 0), "UKF": (ukf(10), 0), "IPEKF, p = 10": (ekf(5, 2) + ten[0], ten[1]),
            "IPEKF, p = 2": (ekf(5, 2) + two[0], two[1])}


def load_section(costs):
    """Return table 3: formulas, true counts, and times."""
    formula, true = formula_counts(), true_counts()
    timed = {"EKF": ("ekf10", "ekf10"), "UKF": ("ukf10", "ukf10"),
             "IPEKF, p = 10": ("ipekf, p = 10, gain at 1 Hz", "ipekf, p = 10, gain every sample"),
             "IPEKF, p = 2": ("ipekf, p = 2, gain at 1 Hz", "ipekf, p = 2, gain every sample")}
    rows = [(name, PAPER_LOADS[name], formula[name], f"{true[name][0]} + {true[name][1]}" if true[name][1] else
             true[name][0], f"{costs[kept] / costs['ekf10']:.2f}", f"{costs[anew] / costs['ekf10']:.2f}")
            for name, (kept, anew) in timed.items()]
    measured = [(name, f"{cost:.2f}", f"{cost / costs['ekf5']:.2f}") for name, cost in costs.items()]
    return ["## Table 3: load", "",
            "Operations of a sample: as the paper prints them, as its formulas give them, and counted (dense "
            "arithmetic; of the IPEKF each sample + each new gain, whose 2 p x 2 p system the formula leaves out). "
            "Times over EKF10's, with the gain computed once a second and at every sample.",
            *table(("filter", "printed", "formula", "counted", "time, gain at 1 Hz", "time, gain every sample"), rows),
            "", "Compiled steps on the machine that made this page (medians in turn): a sample at 100 Hz, a step at "
            "10 Hz for the riekf.", *table(("filter", "us", "over ekf5"), measured)]


def asked_of_costs(costs):
    """Return rows (what, asked, got, met)."""
    return [(f"step of {name}", f"<= {limit:g} us", f"{costs[name]:.2f} us", yes(costs[name] <= limit))
            for name, limit in STEP_LIMITS.items()]


if __name__ == "__main__":
    main()
