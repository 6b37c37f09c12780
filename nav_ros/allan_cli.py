"""allan: the noises of an IMU from a bag in which it stands still, as parameters of the nodes.

Axes are those of the messages (FLU). A figure comes with its 95 % limits; "<" stands before the upper limit of
what the record is too short, or the sensor too good, to show.
"""

import argparse
import json
import math
from pathlib import Path

import numpy as np

from inertial.allan import NOISES, measure_noise
from inertial.recording import ImuSeries
from nav_ros.bags import TYPES, BagError, BagReader
from nav_ros.cli import add_topic_option, one_line_errors, progress, topics_of
from nav_ros.messages import ACCEL, GYRO, IMU, decode_batch
from nav_ros.plots import draw_allan

_PART = 50_000  # messages decoded at once
_DEG_PER_HOUR = math.pi / 180 / 3600
_MICRO_G = 9.80665e-6
# Figure -> (title, unit, its size in SI) as data sheets give it.
_GYRO_UNITS = {
    "noise_density": ("white noise N", "deg/sqrt(h)", 60 * _DEG_PER_HOUR),
    "bias_instability": ("bias instability (0.664 B)", "deg/h", _DEG_PER_HOUR),
    "walk_density": ("rate random walk K", "deg/h/sqrt(h)", _DEG_PER_HOUR / 60),
    "quantisation": ("quantisation Q", "arcsec", _DEG_PER_HOUR)}
_ACCEL_UNITS = {
    "noise_density": ("white noise N", "ug/sqrt(Hz)", _MICRO_G),
    "bias_instability": ("bias instability (0.664 B)", "ug", _MICRO_G),
    "walk_density": ("random walk K", "ug/sqrt(h)", _MICRO_G / 60),
    "quantisation": ("quantisation Q", "mm/s", 1e-3)}
# What attitude_node's defaults allow for in motion: vibration, scale factors, temperature. The noise at rest is added.
_MOTION = {"gyro_noise_density": 0.0022, "gyro_bias_walk": 5e-5, "accel_noise_density": 0.01}
_PARAMETERS = """\
# Noise of an IMU at rest, found by allan in {source}: {duration:.0f} s at {rate:.4g} Hz.
#   attitude_node --ros-args --params-file THIS
#   estimate_bag IN OUT --params THIS            (navigate_bag likewise)
#   align_bag BAG --latitude DEG --params THIS
# Root mean squares of the axes that these noises explain; of white noise and bias instability the upper 95 % limit
# where the record does not show them.
attitude_node:
  ros__parameters:
    gyro_bias_std: {gyro_bias_std:.4g}    # rad/s, twice the largest axis of this switch-on
    # The default, which stands for vibration and temperature, with the noise at rest added.
    gyro_noise_density: {motion[gyro_noise_density]:.4g}    # rad/s/sqrt(Hz)
    gyro_bias_walk: {motion[gyro_bias_walk]:.4g}    # rad/s/sqrt(s)
    accel_noise_density: {motion[accel_noise_density]:.4g}    # m/s^2/sqrt(Hz)
navigation_node:
  ros__parameters:
    gyro_bias_std: {gyro_bias_std:.4g}    # rad/s
    gyro_noise_density: {motion[gyro_noise_density]:.4g}    # rad/s/sqrt(Hz)
    gyro_bias_walk: {motion[gyro_bias_walk]:.4g}    # rad/s/sqrt(s)
    accel_noise_density: {motion[accel_noise_density]:.4g}    # m/s^2/sqrt(Hz)
alignment_node:
  ros__parameters:
    gyro_noise_density: {rest[gyro_noise_density]:.4g}    # rad/s/sqrt(Hz)
    gyro_bias_instability: {rest[gyro_bias_instability]:.4g}    # rad/s, floor of the Allan deviation
    accel_noise_density: {rest[accel_noise_density]:.4g}    # m/s^2/sqrt(Hz)
"""


def main(arguments=None):
    """Run ``allan``."""
    options = _parser().parse_args(arguments)
    with one_line_errors("allan"):
        noise = measure_noise(read_rest(options.bag, topics_of(options)["imu"], options.start, options.end))
        print(json.dumps(report(noise)) if options.json else table(noise))
        if options.plot:
            draw_allan(noise, options.plot)
        if options.out:
            Path(options.out).write_text(parameter_file(noise, Path(options.bag).name), encoding="utf-8")


def read_rest(path, topic, start=0.0, end=math.inf):
    """Return the IMU samples of a bag between two times after its first one.

    Parameters
    ----------
    path : path-like
    topic : str
    start, end : float, s

    Returns
    -------
    inertial.recording.ImuSeries
        In the axes of the messages.

    Raises
    ------
    nav_ros.bags.BagError
        The bag or the topic is not there, or messages cannot be decoded.
    """
    parts, raws = [], []
    with BagReader(path) as bag:
        bag.require(topic, TYPES["imu"])
        for message in progress(bag.messages([topic]), bag.name):
            raws.append(message.raw)
            if len(raws) == _PART:
                parts.append(_decoded(raws, topic))
                raws = []
    parts.append(_decoded(raws, topic))
    stamp_ns, gyro, accel = (np.concatenate([part[k] for part in parts]) for k in range(3))
    if not len(stamp_ns):
        raise BagError(f"{path}: no messages on {topic}")
    time = (stamp_ns - stamp_ns[0]) * 1e-9
    wanted = (time >= start) & (time <= end)
    return ImuSeries(stamp_ns[wanted], gyro[wanted], accel[wanted])


def _decoded(raws, topic):
    batch = decode_batch(IMU, raws)
    if batch.malformed:
        raise BagError(f"{len(batch.malformed)} malformed messages on {topic}")
    return batch.stamp_ns, batch.values[:, GYRO], batch.values[:, ACCEL]


def parameter_file(noise, source):
    """Return the text of a parameter file for ``attitude_node``, ``navigation_node`` and ``alignment_node``."""
    rest = {"gyro_noise_density": noise.gyro.combined("noise_density"),
            "gyro_bias_instability": noise.gyro.combined("bias_instability"),
            "gyro_bias_walk": _walk(noise.gyro), "accel_noise_density": noise.accel.combined("noise_density")}
    return _PARAMETERS.format(
        source=source, duration=noise.duration, rate=1.0 / noise.gyro.curve.interval, rest=rest,
        gyro_bias_std=2.0 * np.abs(noise.gyro.mean).max(),
        motion={name: math.hypot(default, rest[name]) for name, default in _MOTION.items()})


def _walk(triad):
    """Return the random walk whose Allan deviation meets the floor where white noise does, or K if that is more.

    Only what the record shows counts: the upper limit of a walk in a few minutes is no walk that a filter could use.
    """
    return max(math.sqrt(3.0) * triad.shown("bias_instability") ** 2 / triad.combined("noise_density"),
               triad.shown("walk_density"))


def report(noise):
    """Return everything that was found, in SI, ready for JSON."""
    def axis(triad, k):
        fit = triad.fits[k]
        figures = {name: vars(getattr(fit, name)) for name in NOISES}
        return {"mean": triad.mean[k]} | figures | {"shortest_time_s": fit.shortest_time,
                                                    "misfit": fit.misfit, "consistent": fit.consistent}

    return {"duration_s": noise.duration, "rate_hz": 1.0 / noise.gyro.curve.interval, "missing": noise.missing} | {
        sensor: {name: axis(triad, k) for k, name in enumerate("xyz")}
        for sensor, triad in (("gyro", noise.gyro), ("accel", noise.accel))}


def table(noise):
    """Return what was found as a person reads it, in the units of data sheets."""
    lost = f", {100 * noise.missing:.2g} % of the samples missing" if noise.missing else ""
    lines = [f"{noise.duration:.0f} s at {1.0 / noise.gyro.curve.interval:.4g} Hz{lost}; in brackets the 95 % limits"]
    for title, triad, units, mean_unit, mean_scale in (
            ("gyro", noise.gyro, _GYRO_UNITS, "deg/s", math.radians(1.0)),
            ("accelerometer", noise.accel, _ACCEL_UNITS, "m/s^2", 1.0)):
        lines += ["", _row(title, "", ["x", "y", "z"])]
        lines.append(_row("mean reading", mean_unit, [f"{mean / mean_scale:.5g}" for mean in triad.mean]))
        lines += [_row(name, unit, [_figure(getattr(fit, key), scale) for fit in triad.fits])
                  for key, (name, unit, scale) in units.items()]
        lines += [remark for k, fit in enumerate(triad.fits) if (remark := _remark("xyz"[k], fit, triad.curve))]
    return "\n".join(lines)


def _row(name, unit, cells):
    return f"{name:27}{unit:15}" + "".join(f"{cell:>30}" for cell in cells).rstrip()


def _figure(estimate, scale):
    if not estimate.found:
        return f"< {estimate.high / scale:.3g}"
    value, low, high = (getattr(estimate, name) / scale for name in ("value", "low", "high"))
    return f"{value:.3g} [{low:.3g}, {high:.3g}]"


def _remark(axis, fit, curve):
    if not fit.consistent:
        return f"  {axis}: no sum of these noises explains the curve (temperature, vibration, people?)"
    if fit.shortest_time > curve.time[0]:
        return f"  {axis}: explained from {fit.shortest_time:.3g} s; shorter times show a filter, or vibration"
    return ""


def _parser():
    parser = argparse.ArgumentParser(
        prog="allan",
        description="Find the noises of an IMU by the Allan deviation of a bag in which it stands still, and write "
        "them as parameters of the nodes. An hour shows the bias instability; a few minutes the white noise.")
    parser.add_argument("bag", metavar="BAG", help="rosbag2 folder, .mcap or .db3 file")
    parser.add_argument("--out", metavar="FILE", help="write a ROS 2 parameter file")
    parser.add_argument("--plot", metavar="FILE", help="draw the Allan deviation as a PNG")
    parser.add_argument("--json", action="store_true", help="print one JSON object, in SI")
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="leave out what comes before")
    parser.add_argument("--end", type=float, default=math.inf, metavar="S", help="leave out what comes after")
    add_topic_option(parser, ("imu",))
    return parser
