"""align_bag: level and true heading from a recorded bag of a turntable, by the same core as the node."""

import argparse
import dataclasses
import json
import math

import numpy as np

from alignment.edge import AlignmentNodeParams, JointError, status_values, table_angle
from alignment.errors import AlignmentError
from alignment.params import METHODS
from alignment.session import TableSession
from nav_ros.bags import TYPES, BagError, BagReader
from nav_ros.cli import (
    add_parameter_options,
    add_topic_option,
    json_number,
    one_line_errors,
    parameters_of,
    progress,
    topics_of,
)
from nav_ros.frames import swap_flu_frd
from nav_ros.messages import ACCEL, GYRO, IMU, MalformedMessageError, decode, decode_joints


def align_bag(path, params, topics):
    """Return the finished session of a bag's messages.

    Parameters
    ----------
    path : path-like
    params : alignment.edge.AlignmentNodeParams
    topics : dict
        Key -> topic, see :data:`nav_ros.bags.TOPICS`.

    Returns
    -------
    alignment.session.TableSession

    Raises
    ------
    nav_ros.bags.BagError
        There is no such bag, a topic is missing, or nothing in it can be used.
    """
    session = TableSession(params, follow=False)
    malformed = 0
    with BagReader(path) as bag:
        for key in ("imu", "joints"):
            bag.require(topics[key], TYPES[key])
        wanted = [topics["imu"], topics["joints"]]
        for topic, _, raw in progress(bag.messages(wanted), bag.name):
            try:
                if topic == topics["imu"]:
                    stamp_ns, _, values = decode(IMU, raw)
                    session.add_imu(stamp_ns, swap_flu_frd(values[GYRO]), swap_flu_frd(values[ACCEL]))
                else:
                    stamp_ns, positions = decode_joints(raw)
                    session.add_joint(stamp_ns, table_angle(positions, params.joint_name))
            except MalformedMessageError:
                malformed += 1
            except JointError as error:
                raise BagError(f"{path}: {topic}: {error}") from None
    session.finish()
    if session.result is None:
        reason = session.rejected[0].rejection if session.rejected else "the table never stood long enough"
        raise BagError(f"{path}: no usable dwell: {reason}" + (f"; {malformed} malformed" * bool(malformed)))
    return session


def main(arguments=None):
    """Run ``align_bag``; exit status 0 with a heading that may be believed, 1 without, 2 for bad input."""
    options = _parser().parse_args(arguments)
    with one_line_errors("align_bag"):
        params = _params(options)
        session = align_bag(options.bag, params, topics_of(options))
        report = _report(session)
        if options.json:
            print(json.dumps(report))
        else:
            print(_text(report))
    return 1 if session.refusal else 0


def _params(options):
    params = parameters_of(options, "alignment_node", AlignmentNodeParams)
    changes = {} if options.method is None else {"method": options.method}
    if options.latitude is not None:
        if not abs(options.latitude) <= 90.0:
            raise ValueError(f"--latitude {options.latitude:g}: must be from -90 to 90 deg")
        changes["latitude"] = math.radians(options.latitude)
    return dataclasses.replace(params, **changes)


def _report(session):
    """Return everything that is printed, ready for JSON."""
    report = {key: json_number(value) for key, value in status_values(session).items()}
    report["refusal"] = session.refusal
    report["turning"] = session.turning
    report["rejections"] = [dwell.rejection for dwell in session.rejected]
    report["levelling_methods"], report["heading_methods"] = {}, {}
    if session.dwells:
        try:
            levels, headings = session.compare()
        except AlignmentError:
            return report
        report["levelling_methods"] = {name: _level_row(level) for name, level in levels.items()}
        report["heading_methods"] = {name: _heading_row(north) for name, north in headings.items()}
    return report


def _level_row(level):
    stds = np.sqrt(np.diag(level.covariance))
    row = {"roll_deg": math.degrees(level.roll), "roll_sigma_deg": math.degrees(stds[0]),
           "pitch_deg": math.degrees(level.pitch), "pitch_sigma_deg": math.degrees(stds[1])}
    return {key: json_number(value) for key, value in row.items()} | {"flags": _flags(level)}


def _heading_row(north):
    row = {"heading_deg": math.degrees(north.heading) % 360.0, "sigma_deg": math.degrees(north.std),
           "gyro_bias_deg_h": math.degrees(north.bias) * 3600.0, "gyro_scale": float(north.scale)}
    return {key: json_number(value) for key, value in row.items()} | {"flags": _flags(north)}


def _flags(result):
    return ", ".join(flag.name for flag in type(result.flags) if flag in result.flags) or "none"


def _text(report):
    """Return the report as a person reads it."""
    lines = [f"roll      {_with_sigma(report, 'roll_deg', 'roll_sigma_deg')}    right side down is positive",
             f"pitch     {_with_sigma(report, 'pitch_deg', 'pitch_sigma_deg')}    nose up is positive"]
    if "heading_deg" in report and not report["refusal"]:
        lines.append(f"heading   {_with_sigma(report, 'heading_deg', 'heading_sigma_deg')}    "
                     f"clockwise from true north; floor {_number(report['heading_floor_deg'])} deg")
    else:
        lines.append(f"heading   none: {report['refusal']}")
    lines.append(f"dwells    {report['dwells']} used, {report['dwells_rejected']} rejected"
                 + ("; the table turns steadily" if report["turning"] else ""))
    lines += [f"rejected  {reason}" for reason in report["rejections"]]
    lines.append(f"flags     {report.get('flags', 'none')}")
    for title, rows in (("levelling", report["levelling_methods"]), ("heading", report["heading_methods"])):
        if rows:
            lines += ["", *_table(title, rows)]
    return "\n".join(lines)


def _table(title, rows):
    names = list(next(iter(rows.values())))
    lines = [[title, *names]] + [[name, *(_number(row[key]) for key in names)] for name, row in rows.items()]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
            for line in lines]


def _with_sigma(report, value, sigma):
    return f"{_number(report[value]):>9} +- {_number(report[sigma])} deg"


def _number(value):
    if isinstance(value, str):
        return value
    return "unknown" if value is None else f"{value:.4f}"


def _parser():
    parser = argparse.ArgumentParser(
        prog="align_bag",
        description="Find level and true north in a recording of an IMU on a turntable, with its joint's "
        "angle: the result, its sigma, and every method beside it. Exit status 1 when no heading may be "
        "believed, 2 for input that cannot be used.")
    parser.add_argument("bag", metavar="BAG", help="rosbag2 folder, .mcap or .db3 file")
    parser.add_argument("--latitude", type=float, metavar="DEG",
                        help="geodetic latitude, north positive; without it the level only")
    parser.add_argument("--method", choices=METHODS, help="how the heading is found (default joint)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    add_parameter_options(parser, "alignment_node")
    add_topic_option(parser, ("imu", "joints"))
    return parser
