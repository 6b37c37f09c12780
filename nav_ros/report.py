"""A run for people: a table of figures and pictures in one HTML file that needs nothing else."""

import base64
import html
import math
from dataclasses import dataclass
from pathlib import Path
from string import Template

import numpy as np


@dataclass(frozen=True)
class Figure:
    """One row of the table.

    Attributes
    ----------
    name, value : str
    expected : str
        Bound, or a remark where there is none.
    within : bool or None
        Whether the value keeps its bound; None: there is none.
    """

    name: str
    value: str
    expected: str = ""
    within: bool | None = None

    @property
    def verdict(self):
        """What to call that."""
        return {True: "ok", False: "OUT OF BOUNDS", None: ""}[self.within]


def text_table(figures):
    """Return the figures as lines of aligned columns."""
    rows = [(figure.name, figure.value, figure.expected, figure.verdict) for figure in figures]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
                     for row in rows)


def score_figures(score, sigma_ratio=None, coverage=None):
    """Return the rows of an :class:`inertial.scoring.AttitudeScore`, judged where there are bounds.

    Parameters
    ----------
    score : inertial.scoring.AttitudeScore
    sigma_ratio : pair of float, optional
        What the error may be of what the filter predicts.
    coverage : float, optional
        Share of the time that the error must be within three sigma.
    """
    # Sample by sample, so that a few samples with a large sigma do not outweigh the others.
    ratio = math.sqrt(score.nees / 2.0)
    bounds = {} if sigma_ratio is None else {
        "expected": "{:g} to {:g}".format(*sigma_ratio), "within": sigma_ratio[0] <= ratio <= sigma_ratio[1]}
    share = {} if coverage is None else {
        "expected": f"at least {coverage:.0%}", "within": score.coverage_3sigma >= coverage}
    return [
        Figure("roll RMS", f"{score.roll_rms_deg:.2f} deg"),
        Figure("pitch RMS", f"{score.pitch_rms_deg:.2f} deg"),
        Figure("tilt RMS", f"{score.tilt_rms_deg:.2f} deg",
               f"sigma by the filter: median {score.median_sigma_deg:.2f} deg"),
        Figure("error / predicted sigma", f"{ratio:.2f} RMS", **bounds),
        Figure("within 3 sigma", f"{score.coverage_3sigma:.1%}", **share),
    ]


_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #1b1b1b; background: #fff; max-width: 62rem;
       margin: 2.5rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.5rem; font-weight: 600; margin-bottom: 0; }
.what { color: #666; margin-top: .2rem; }
img { width: 100%; height: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
td, th { text-align: left; padding: .3rem 1.6rem .3rem 0; border-bottom: 1px solid #e4e4e4; }
.ok { color: #19703a; }
.bad { color: #b3261e; font-weight: 600; }
.remark { color: #666; }
</style>
</head>
<body>
<h1>$heading</h1>
<p class="what">$title</p>
<p>$summary</p>
$pictures
<table>
<tr><th>figure</th><th>measured</th><th>bound or remark</th><th></th></tr>
$rows
</table>
<p class="remark">Angles are of the body (x forward, y right, z down) against north-east-down: right wing
down and nose up are positive. RMS values leave out the first 5 s. The band is the filter's own opinion of its
error; an honest filter's error is inside of it nearly always and fills about a third of it. $remark</p>
</body>
</html>
""")


def write_report(path, heading, title, summary, pictures, figures, remark=""):
    """Write the HTML file.

    Parameters
    ----------
    path : path-like
    heading, title, summary, remark : str
    pictures : dict
        What is to be seen -> PNG, bytes.
    figures : list of Figure
    """
    shown = "\n".join(f'<img alt="{html.escape(what)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'
                      for what, png in pictures.items())
    Path(path).write_text(_PAGE.substitute(
        heading=html.escape(heading), title=html.escape(title), summary=html.escape(summary), pictures=shown,
        remark=html.escape(remark), rows="\n".join(map(_html_row, figures))), encoding="utf-8")


def summary_of(attitude, score=None):
    """Return in words how a vehicle moved and how well its attitude was known.

    Parameters
    ----------
    attitude : nav_ros.estimated.AttitudeRun
    score : inertial.scoring.AttitudeScore, optional
    """
    if not attitude.valid.any():
        return "There was no attitude at any time."
    roll, pitch = np.degrees(attitude.roll_pitch[attitude.valid]).T
    start = (attitude.stamp_ns[np.argmax(attitude.valid)] - attitude.stamp_ns[0]) * 1e-9
    known = (f"The vehicle rolls from {roll.min():.0f} to {roll.max():.0f} deg and pitches from {pitch.min():.0f} to "
             f"{pitch.max():.0f} deg. The filter starts knowing nothing and has an attitude after {start:.1f} s")
    if score is None:
        sigma = math.degrees(np.nanmedian(attitude.tilt_std))
        return f"{known}; the sigma of its tilt is {sigma:.2f} deg in the median."
    return (f"{known}; it then stays within {score.tilt_rms_deg:.2f} deg RMS of the true vertical. Its own sigma is "
            f"{score.median_sigma_deg:.2f} deg in the median; the error was inside of three times that sigma "
            f"{score.coverage_3sigma:.1%} of the time.")


def _html_row(figure):
    kind = "bad" if figure.within is False else "ok"
    cells = [figure.name, figure.value, figure.expected]
    return ("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
            + f'<td class="{kind}">{figure.verdict}</td></tr>')
