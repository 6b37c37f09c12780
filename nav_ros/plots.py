"""Pictures of the command lines and of reports; matplotlib is imported where it draws."""

import io

import numpy as np

from inertial.rotation import roll_pitch_from_down
from inertial.scoring import interpolate_down

_COLOURS = ("#d1495b", "#2e7d5b", "#2d6a9f")
_TRUTH_COLOUR, _ESTIMATE_COLOUR, _BAND_COLOUR = "#1b1b1b", "#d1495b", "#9cc5e8"
_DPI = 120
_POINTS = 20_000  # of a line; more cannot be told apart
_SETTLED = 5.0  # s; what comes before does not set the scale


def draw_allan(noise, path):
    """Draw the Allan deviation of each axis, one sigma about it, and what was fitted, as a PNG.

    Parameters
    ----------
    noise : inertial.allan.ImuNoise
    path : path-like

    Raises
    ------
    ValueError
        matplotlib is not installed.
    """
    figure = _canvas(5.0)
    panels = zip(figure.subplots(1, 2), (noise.gyro, noise.accel),
                 (("gyro", "deg/h", np.degrees(3600.0)), ("accelerometer", "m/s²", 1.0)), strict=True)
    for axes, triad, (name, unit, scale) in panels:
        _draw_triad(axes, triad, scale)
        axes.set(xscale="log", yscale="log", title=name, xlabel="averaging time, s",
                 ylabel=f"Allan deviation, {unit}")
        axes.grid(True, which="both", alpha=0.25)
        axes.legend(frameon=False)
    figure.savefig(path, dpi=_DPI)


def _draw_triad(axes, triad, scale):
    time = triad.curve.time
    for k, (name, colour, fit) in enumerate(zip("xyz", _COLOURS, triad.fits, strict=True)):
        axes.errorbar(time, scale * triad.curve.deviation[:, k], scale * triad.curve.deviation_std[:, k], fmt="o",
                      color=colour, markersize=4, elinewidth=1, label=name)
        fitted = time[time >= fit.shortest_time]
        axes.plot(fitted, scale * np.sqrt(fit.variance(fitted)), color=colour,
                  label="fit" if k == 2 else None)


def attitude_picture(run):
    """Draw roll and pitch and below them the 3-sigma band, with the error in it where the truth is known.

    Parameters
    ----------
    run : nav_ros.estimated.AttitudeRun

    Returns
    -------
    bytes
        Of a PNG.

    Raises
    ------
    ValueError
        matplotlib is not installed.
    """
    shown = _shown(len(run))
    time = _seconds(run.stamp_ns, run.stamp_ns)[shown]
    angles = np.where(run.valid[:, None], np.degrees(run.roll_pitch), np.nan)[shown]
    band = 3.0 * np.degrees(run.roll_pitch_std)[shown]
    true = error = np.full((len(time), 2), np.nan)
    if run.truth is not None:
        down_b, spanned = interpolate_down(run.truth, run.stamp_ns[shown])
        true = np.where(spanned[:, None], np.degrees(np.stack(roll_pitch_from_down(down_b), axis=-1)), np.nan)
        error = (angles - true + 180.0) % 360.0 - 180.0
    figure = _canvas(5.6)
    axes = figure.subplots(2, 2, sharex=True, height_ratios=(3, 2))
    for k, name in enumerate(("roll, right wing down", "pitch, nose up")):
        if run.truth is not None:
            axes[0, k].plot(time, _unwrapped(true[:, k]), color=_TRUTH_COLOUR, linewidth=2.2, label="truth")
        axes[0, k].plot(time, _unwrapped(angles[:, k]), color=_ESTIMATE_COLOUR, linewidth=1.0, label="estimate")
        axes[0, k].set_title(name, loc="left")
        _tidy(axes[0, k], "deg")
        _draw_error(axes[1, k], time, error[:, k], band[:, k])
    return _finished(figure, axes[:, 0])


def _draw_error(axis, time, error, band):
    axis.fill_between(time, -band, band, color=_BAND_COLOUR, linewidth=0, label="3 sigma, the filter's own")
    if np.isfinite(error).any():
        axis.plot(time, error, color=_ESTIMATE_COLOUR, linewidth=0.8, label="its error")
    settled = band[time >= _SETTLED]
    limit = 2.0 * np.nanmedian(settled) if np.isfinite(settled).any() else 10.0
    axis.set_ylim(-limit, limit)
    axis.set_xlabel("time, s")
    _tidy(axis, "error, deg")


def motion_picture(run):
    """Draw rate and force without their biases, body axes; arguments as :func:`attitude_picture`."""
    shown = _shown(len(run))
    time = _seconds(run.stamp_ns, run.stamp_ns)[shown]
    figure = _canvas(3.4)
    axes = figure.subplots(1, 2)
    _draw_axes(axes[0], "rate", "deg/s", time, np.degrees(run.gyro_b[shown]))
    _draw_axes(axes[1], "specific force", "m/s²", time, run.accel_b[shown])
    return _finished(figure, axes[:1])


def bias_picture(run):
    """Draw the biases with one sigma of each; `run` is a :class:`nav_ros.estimated.EstimatedRun` that has them."""
    figure = _canvas(3.4)
    axes = figure.subplots(1, 2)
    attitude = run.attitude
    for axis, name, unit, scale, (stamp_ns, bias), std in (
            (axes[0], "gyro bias", "deg/s", np.degrees(1.0), run.gyro_bias, attitude.gyro_bias_std),
            (axes[1], "accelerometer bias", "m/s²", 1.0, run.accel_bias, attitude.accel_bias_std)):
        shown = _shown(len(stamp_ns))
        time = _seconds(stamp_ns[shown], attitude.stamp_ns)
        sample = np.clip(np.searchsorted(attitude.stamp_ns, stamp_ns[shown]), 0, len(attitude) - 1)
        _draw_axes(axis, name, unit, time, scale * bias[shown], scale * std[sample])
    return _finished(figure, axes[:1])


def vertical_picture(run, places):
    """Draw height and climb rate with 3 sigma of each; `places` is a :class:`nav_ros.estimated.PlaceRun`."""
    figure = _canvas(3.4)
    axes = figure.subplots(1, 2)
    shown = _shown(len(places.stamp_ns))
    time = _seconds(places.stamp_ns[shown], run.attitude.stamp_ns)
    for axis, name, unit, down, std in (
            (axes[0], "height", "m", places.position_n[shown, 2], places.position_std[shown, 2]),
            (axes[1], "climb rate", "m/s", places.velocity_n[shown, 2], places.velocity_std[shown, 2])):
        axis.fill_between(time, -down - 3.0 * std, -down + 3.0 * std, color=_BAND_COLOUR, linewidth=0, label="3 sigma")
        axis.plot(time, -down, color=_ESTIMATE_COLOUR, linewidth=1.0, label="estimate")
        axis.set_title(name, loc="left")
        axis.set_xlabel("time, s")
        _tidy(axis, unit)
    return _finished(figure, axes[:1])


def track_picture(run, places):
    """Draw the way over ground and the sigma of the position; arguments as :func:`vertical_picture`."""
    figure = _canvas(4.2)
    axes = figure.subplots(1, 2)
    shown = _shown(len(places.stamp_ns))
    north, east, _ = places.position_n[shown].T
    axes[0].plot(east, north, color=_ESTIMATE_COLOUR, linewidth=1.0)
    axes[0].set_title("way over ground", loc="left")
    axes[0].set(xlabel="east, m", aspect="equal", adjustable="datalim")
    _tidy(axes[0], "north, m")
    time = _seconds(places.stamp_ns[shown], run.attitude.stamp_ns)
    for k, name in enumerate(("north", "east", "down")):
        axes[1].plot(time, places.position_std[shown, k], color=_COLOURS[k], linewidth=1.0, label=name)
    axes[1].set_title("sigma of the position", loc="left")
    axes[1].set_xlabel("time, s")
    axes[1].set_ylim(bottom=0.0)
    _tidy(axes[1], "m")
    return _finished(figure, axes[1:])


def _draw_axes(axis, name, unit, time, values, std=None):
    for k, letter in enumerate("xyz"):
        if std is not None:
            axis.fill_between(time, values[:, k] - std[:, k], values[:, k] + std[:, k], color=_COLOURS[k], alpha=0.15,
                              linewidth=0)
        axis.plot(time, values[:, k], color=_COLOURS[k], linewidth=0.8, label=letter)
    axis.set_title(name, loc="left")
    axis.set_xlabel("time, s")
    _tidy(axis, unit)


def _canvas(height):
    """Return an empty figure of the usual width."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise ValueError("drawing needs matplotlib (pip install matplotlib)") from None
    figure = Figure(figsize=(11, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _finished(figure, axes):
    """Return the PNG of a figure, with one legend for the lines of some axes."""
    lines = [axis.get_legend_handles_labels() for axis in axes]
    figure.legend(*(sum(parts, []) for parts in zip(*lines, strict=True)), loc="outside lower center", frameon=False,
                  ncols=4)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=_DPI)
    return file.getvalue()


def _tidy(axis, label):
    axis.set_ylabel(label)
    axis.grid(color="#e4e4e4", linewidth=0.6)
    axis.spines[["top", "right"]].set_visible(False)
    axis.margins(x=0.0)


def _seconds(stamp_ns, origin_ns):
    return (stamp_ns - origin_ns[0]) * 1e-9


def _shown(count):
    """Return the samples of a line that are drawn."""
    return slice(None, None, max(count // _POINTS, 1))


def _unwrapped(angles_deg):
    """Break the line where an angle passes +-180 deg, so that no stroke crosses the picture."""
    jump = np.abs(np.diff(angles_deg, prepend=angles_deg[:1])) > 180.0
    return np.where(jump, np.nan, angles_deg)
