"""report_bag: what a node or a tool has estimated, as one HTML page with pictures."""

import argparse
from functools import partial
from pathlib import Path

import numpy as np

from nav_ros.cli import add_topic_option, one_line_errors, progress, topics_of
from nav_ros.estimated import ALSO, read_run
from nav_ros.plots import attitude_picture, bias_picture, motion_picture, track_picture, vertical_picture
from nav_ros.report import Figure, score_figures, summary_of, text_table, write_report


def main(arguments=None):
    """Run ``report_bag``."""
    options = _parser().parse_args(arguments)
    with one_line_errors("report_bag"):
        run = read_run(options.bag, topics_of(options), progress=partial(progress, what="reading"))
        out = Path(options.out or f"{run.name}.html")
        print(f"{report_bag(run, out)}\n\nreport: {out}")


def report_bag(run, path):
    """Write the page of a run and return its table as text.

    Parameters
    ----------
    run : nav_ros.estimated.EstimatedRun
    path : path-like

    Raises
    ------
    ValueError
        There is nothing to draw, or matplotlib is not installed.
    """
    attitude = run.attitude
    if len(attitude) < 2:
        raise ValueError(f"{run.name}: {len(attitude)} estimates are too few for a report")
    score = None if attitude.truth is None else attitude.score()
    figures = [*([] if score is None else score_figures(score)), *_run_figures(run)]
    seconds = (attitude.stamp_ns[-1] - attitude.stamp_ns[0]) * 1e-9
    title = f"{run.name}: {seconds:.0f} s, {len(attitude)} estimates"
    write_report(path, "Roll and pitch against the truth" if score else "Roll and pitch", title,
                 summary_of(attitude, score), _pictures(run), figures)
    return f"{title}\n\n{text_table(figures)}"


def _pictures(run):
    pictures = {"Roll and pitch with the 3-sigma band": attitude_picture(run.attitude)}
    if run.odometry is not None:
        pictures["Way over ground"] = track_picture(run, run.odometry)
    places = run.odometry or run.state
    if places is not None:
        pictures["Height and climb rate with their 3-sigma bands"] = vertical_picture(run, places)
    if run.gyro_bias is not None and run.accel_bias is not None:
        pictures["Biases of the gyro and the accelerometer with one sigma"] = bias_picture(run)
    pictures["Rate and specific force without their biases"] = motion_picture(run.attitude)
    return pictures


def _run_figures(run):
    """Rows that need no truth."""
    attitude = run.attitude
    step = np.diff(attitude.stamp_ns) * 1e-9
    rows = [Figure("rate", f"{1.0 / np.median(step):.1f} Hz", f"longest interval {step.max():.3f} s"),
            Figure("without an attitude", f"{np.mean(~attitude.valid):.1%}", "of the estimates")]
    if attitude.valid.any():
        median, most = np.degrees(np.nanpercentile(attitude.tilt_std, [50, 95]))
        rows.append(Figure("sigma of the tilt", f"{median:.2f} deg", f"median; 95 % of it below {most:.2f} deg"))
    for name, unit, scale, biases, std in (
            ("gyro bias at the end", "deg/s", np.degrees(1.0), run.gyro_bias, attitude.gyro_bias_std),
            ("accelerometer bias at the end", "m/s²", 1.0, run.accel_bias, attitude.accel_bias_std)):
        if biases is not None and len(biases[0]):
            rows.append(Figure(name, " ".join(f"{scale * value:+.3f}" for value in biases[1][-1]) + f" {unit}",
                               "sigma " + " ".join(f"{scale * value:.3f}" for value in std[-1])))
    return rows


def _parser():
    parser = argparse.ArgumentParser(
        prog="report_bag",
        description="Write one self-contained HTML page of what was estimated in a bag: attitude, height, biases, and "
        "the error where the bag holds the truth. A bag of raw sensors goes through estimate_bag or navigate_bag "
        "first.")
    parser.add_argument("bag", metavar="BAG", help="rosbag2 folder, .mcap or .db3 file")
    parser.add_argument("--out", metavar="FILE", help="default: NAME.html in this folder")
    add_topic_option(parser, ("output", *ALSO))
    return parser
