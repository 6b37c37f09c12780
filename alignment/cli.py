"""align_bag: level and true heading from a recorded bag of a turntable or of a standing vehicle.

By the same core as the node.
"""

import argparse
import dataclasses
import json
import math

from alignment.edge import AlignmentNodeParams, JointError, imu_sample, joint_sample
from alignment.params import METHODS, AlignmentParams
from alignment.standing.params import STANDING_METHODS, StandingParams
from alignment.views import open_view
from nav_ros.bags import TOPICS, TYPES, BagError, BagReader
from nav_ros.cli import (
    add_parameter_options,
    add_topic_option,
    json_number,
    one_line_errors,
    parameters_of,
    progress,
    topics_of,
)
from nav_ros.messages import MalformedMessageError


def align_bag(path, params, topics, fit=False):
    """Return the finished alignment of a bag's messages.

    Parameters
    ----------
    path : path-like
    params : alignment.edge.AlignmentNodeParams
    topics : dict
        Key -> topic, see :data:`nav_ros.bags.TOPICS`.
    fit : bool
        Whether a standing vehicle's method stands in for ``joint`` where the bag has no joint.

    Returns
    -------
    alignment.views.TableView or alignment.views.StandingView

    Raises
    ------
    nav_ros.bags.BagError
        There is no such bag, a topic is missing, or nothing in it can be used.
    """
    malformed = 0
    with BagReader(path) as bag:
        without_joint = topics["joints"] == TOPICS["joints"] not in bag.types
        if fit and without_joint and params.method == AlignmentParams.method:
            params = dataclasses.replace(params, method=StandingParams.method)
        view = open_view(params, live=False)
        for key in view.inputs:
            bag.require(topics[key], TYPES[key])
        for topic, _, raw in progress(bag.messages(topics[key] for key in view.inputs), bag.name):
            try:
                if topic == topics["imu"]:
                    view.session.add_imu(*imu_sample(raw))
                else:
                    view.session.add_joint(*joint_sample(raw, params.joint_name))
            except MalformedMessageError:
                malformed += 1
            except JointError as error:
                raise BagError(f"{path}: {topic}: {error}") from None
    view.session.finish()
    if view.session.result is None:
        raise BagError(f"{path}: {view.lack}" + (f"; {malformed} malformed" * bool(malformed)))
    return view


def main(arguments=None):
    """Run ``align_bag``; exit status 0 with a heading that may be believed, 1 without, 2 for bad input."""
    options = _parser().parse_args(arguments)
    with one_line_errors("align_bag"):
        params = _params(options)
        view = align_bag(options.bag, params, topics_of(options), fit=options.method is None)
        report = _report(view)
        if options.json:
            print(json.dumps(report))
        else:
            print(_text(report, view))
    return 1 if view.session.refusal else 0


def _params(options):
    params = parameters_of(options, "alignment_node", AlignmentNodeParams)
    changes = {} if options.method is None else {"method": options.method}
    if options.latitude is not None:
        if not abs(options.latitude) <= 90.0:
            raise ValueError(f"--latitude {options.latitude:g}: must be from -90 to 90 deg")
        changes["latitude"] = math.radians(options.latitude)
    return dataclasses.replace(params, **changes)


def _report(view):
    """Return everything that is printed, ready for JSON."""
    return {key: _json(value) for key, value in (view.status() | view.findings()).items()}


def _json(value):
    if isinstance(value, dict):
        return {key: _json(inner) for key, inner in value.items()}
    return json_number(value)


def _text(report, view):
    """Return the report as a person reads it."""
    lines = [f"roll      {_with_sigma(report, 'roll_deg', 'roll_sigma_deg')}    right side down is positive",
             f"pitch     {_with_sigma(report, 'pitch_deg', 'pitch_sigma_deg')}    nose up is positive"]
    if "heading_deg" in report and not report["refusal"]:
        lines.append(f"heading   {_with_sigma(report, 'heading_deg', 'heading_sigma_deg')}    "
                     f"clockwise from true north; floor {_number(report['heading_floor_deg'])} deg")
    else:
        lines.append(f"heading   none: {report['refusal']}")
    lines += [f"{title:9} {text}" for title, text in view.remarks()]
    for title, key in (("levelling", "levelling_methods"), ("heading", "heading_methods")):
        if report.get(key):
            lines += ["", *_table(title, report[key])]
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
        description="Find level and true north in a recording of an IMU, on a turntable with its joint's angle "
        "or in a standing vehicle: the result, its sigma, and every method beside it. Exit status 1 when no "
        "heading may be believed, 2 for input that cannot be used.")
    parser.add_argument("bag", metavar="BAG", help="rosbag2 folder, .mcap or .db3 file")
    parser.add_argument("--latitude", type=float, metavar="DEG",
                        help="geodetic latitude, north positive; without it the level only")
    parser.add_argument("--method", choices=METHODS + STANDING_METHODS,
                        help="how the heading is found (default joint, oba_riekf where there is no joint)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    add_parameter_options(parser, "alignment_node")
    add_topic_option(parser, ("imu", "joints"))
    return parser
