"""Pictures of the command lines; matplotlib is imported where it draws."""

import numpy as np

_COLOURS = ("#d1495b", "#2e7d5b", "#2d6a9f")


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
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise ValueError(f"{path}: drawing needs matplotlib (pip install matplotlib)") from None
    figure = Figure(figsize=(11, 5), layout="constrained")
    FigureCanvasAgg(figure)
    panels = zip(figure.subplots(1, 2), (noise.gyro, noise.accel),
                 (("gyro", "deg/h", np.degrees(3600.0)), ("accelerometer", "m/s²", 1.0)), strict=True)
    for axes, triad, (name, unit, scale) in panels:
        _draw_triad(axes, triad, scale)
        axes.set(xscale="log", yscale="log", title=name, xlabel="averaging time, s",
                 ylabel=f"Allan deviation, {unit}")
        axes.grid(True, which="both", alpha=0.25)
        axes.legend(frameon=False)
    figure.savefig(path, dpi=120)


def _draw_triad(axes, triad, scale):
    time = triad.curve.time
    for k, (name, colour, fit) in enumerate(zip("xyz", _COLOURS, triad.fits, strict=True)):
        axes.errorbar(time, scale * triad.curve.deviation[:, k], scale * triad.curve.deviation_std[:, k], fmt="o",
                      color=colour, markersize=4, elinewidth=1, label=name)
        fitted = time[time >= fit.shortest_time]
        axes.plot(fitted, scale * np.sqrt(fit.variance(fitted)), color=colour,
                  label="fit" if k == 2 else None)
