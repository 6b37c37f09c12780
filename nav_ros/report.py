"""A run against the truth, for people: a table of figures, a picture, one HTML file that holds both."""

import base64
import html
from dataclasses import dataclass
from pathlib import Path
from string import Template

import numpy as np

from inertial.recording import AttitudeSeries
from inertial.rotation import dcm_from_quaternion, euler_from_dcm, roll_pitch_from_down
from inertial.scoring import interpolate_down

TRUTH_COLOUR, ESTIMATE_COLOUR, BAND_COLOUR = "#1b1b1b", "#d1495b", "#9cc5e8"


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


@dataclass(frozen=True)
class AttitudeRun:
    """Estimated attitudes beside the truth; arrays as :func:`inertial.scoring.score_attitude` takes them."""

    stamp_ns: np.ndarray
    q_nb_wxyz: np.ndarray
    tilt_covariance_n: np.ndarray
    valid: np.ndarray
    truth: AttitudeSeries


def text_table(figures):
    """Return the figures as lines of aligned columns."""
    rows = [(figure.name, figure.value, figure.expected, figure.verdict) for figure in figures]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
                     for row in rows)


def roll_pitch_std(q_nb_wxyz, tilt_covariance_n):
    """Return the standard deviations of roll and pitch, (N, 2), rad.

    A small rotation ``e`` about north and east turns the angles by ``roll = (cos h e_n + sin h e_e) / cos p``
    and ``pitch = cos h e_e - sin h e_n``, with h the heading and p the pitch.

    Parameters
    ----------
    q_nb_wxyz : (N, 4)
    tilt_covariance_n : (N, 2, 2), rad^2
    """
    _, pitch, heading = euler_from_dcm(dcm_from_quaternion(q_nb_wxyz))
    ch, sh, cp = np.cos(heading), np.sin(heading), np.cos(pitch)
    jacobian = np.moveaxis(np.array([[ch / cp, sh / cp], [-sh, ch]]), -1, 0)
    return np.sqrt(np.einsum("nij,njk,nik->ni", jacobian, tilt_covariance_n, jacobian))


def draw_attitude(run, path):
    """Draw roll and pitch, estimated and true, with the error in its 3-sigma band below, as a PNG.

    Parameters
    ----------
    run : AttitudeRun
    path : path-like
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    time = (run.stamp_ns - run.truth.stamp_ns[0]) * 1e-9
    down_b, spanned = interpolate_down(run.truth, run.stamp_ns)
    known = run.valid & spanned
    estimated = np.degrees(np.stack(euler_from_dcm(dcm_from_quaternion(run.q_nb_wxyz))[:2], axis=-1))
    true = np.degrees(np.stack(roll_pitch_from_down(down_b), axis=-1))
    band = np.full_like(true, np.nan)
    band[known] = 3.0 * np.degrees(roll_pitch_std(run.q_nb_wxyz[known], run.tilt_covariance_n[known]))
    error = np.where(known[:, None], (estimated - true + 180.0) % 360.0 - 180.0, np.nan)
    estimated = np.where(known[:, None], _unwrapped(estimated), np.nan)

    canvas = Canvas(figsize=(11, 5.6), layout="constrained")
    FigureCanvasAgg(canvas)
    axes = canvas.subplots(2, 2, sharex=True, height_ratios=(3, 2))
    for k, name in enumerate(("roll, right wing down", "pitch, nose up")):
        _draw_angle(axes[0, k], name, time, _unwrapped(true)[:, k], estimated[:, k])
        _draw_error(axes[1, k], time, error[:, k], band[:, k])
    lines = [axis.get_legend_handles_labels() for axis in axes[:, 0]]
    canvas.legend(*(sum(parts, []) for parts in zip(*lines, strict=True)), loc="outside lower center",
                  frameon=False, ncols=4)
    canvas.savefig(path, dpi=120)


def _draw_angle(axis, name, time, true, estimated):
    axis.plot(time, true, color=TRUTH_COLOUR, linewidth=2.2, label="truth")
    axis.plot(time, estimated, color=ESTIMATE_COLOUR, linewidth=1.0, label="estimate")
    axis.set_title(name, loc="left")
    _tidy(axis, "deg")


def _draw_error(axis, time, error, band):
    axis.fill_between(time, -band, band, color=BAND_COLOUR, linewidth=0, label="3 sigma, the filter's own")
    axis.plot(time, error, color=ESTIMATE_COLOUR, linewidth=0.8, label="its error")
    settled = band[time >= 5.0]
    limit = 2.0 * np.nanmedian(settled) if np.isfinite(settled).any() else 10.0
    axis.set_ylim(-limit, limit)
    axis.set_xlabel("time, s")
    _tidy(axis, "error, deg")


def _tidy(axis, label):
    axis.set_ylabel(label)
    axis.grid(color="#e4e4e4", linewidth=0.6)
    axis.spines[["top", "right"]].set_visible(False)
    axis.margins(x=0.0)


def _unwrapped(angles_deg):
    """Break the line where an angle passes +-180 deg, so that no stroke crosses the picture."""
    jump = np.abs(np.diff(angles_deg, axis=0, prepend=angles_deg[:1])) > 180.0
    return np.where(jump, np.nan, angles_deg)


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
<h1>Roll, pitch and heading against the truth</h1>
<p class="what">$title</p>
<p>$summary</p>
<img alt="Roll and pitch, estimated and true, with the error and its 3-sigma band"
     src="data:image/png;base64,$picture">
<table>
<tr><th>figure</th><th>measured</th><th>bound or remark</th><th></th></tr>
$rows
</table>
<p class="remark">Angles are of the body (x forward, y right, z down) against north-east-down: right wing
down and nose up are positive. RMS values leave out the first 5 s. The band is the filter's own opinion of its
error; an honest filter's error is inside of it nearly always and fills about a third of it. The heading is
that of a turntable at rest, found in two and a half minutes from the Earth's rotation alone; it is simulated
with navigation-grade sensors.</p>
</body>
</html>
""")


def write_report(folder, title, run, score, figures):
    """Write ``attitude.png`` and ``report.html``, which holds the picture too; return the latter's path.

    Parameters
    ----------
    folder : path-like
    title : str
    run : AttitudeRun
    score : inertial.scoring.AttitudeScore
    figures : list of Figure
    """
    picture = Path(folder) / "attitude.png"
    draw_attitude(run, picture)
    report = Path(folder) / "report.html"
    report.write_text(_PAGE.substitute(
        title=html.escape(title), summary=html.escape(_summary(run, score)),
        picture=base64.b64encode(picture.read_bytes()).decode(),
        rows="\n".join(map(_html_row, figures))), encoding="utf-8")
    return report


def _summary(run, score):
    down_b, spanned = interpolate_down(run.truth, run.stamp_ns)
    roll, pitch = np.degrees(roll_pitch_from_down(down_b[spanned]))
    start = (run.stamp_ns[np.argmax(run.valid)] - run.stamp_ns[0]) * 1e-9
    return (
        f"The vehicle rolls from {roll.min():.0f} to {roll.max():.0f} deg and pitches from "
        f"{pitch.min():.0f} to {pitch.max():.0f} deg. The filter starts knowing nothing, has an attitude "
        f"after {start:.1f} s and then stays within {score.tilt_rms_deg:.2f} deg RMS of the true vertical; "
        "its own sigma is "
        f"{score.median_sigma_deg:.2f} deg in the median. The error was inside of three times that sigma "
        f"{score.coverage_3sigma:.1%} of the time.")


def _html_row(figure):
    kind = "bad" if figure.within is False else "ok"
    cells = [figure.name, figure.value, figure.expected]
    return ("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
            + f'<td class="{kind}">{figure.verdict}</td></tr>')
