"""Command lines for bags: make a simulated one, score the attitude in one.

What the tools share is here too: remapping of topics, one-line errors with exit status 2, a progress bar
that shows on a terminal only.
"""

import argparse
import contextlib
import csv
import dataclasses
import json
import sys
import warnings
from functools import partial

import numpy as np
from tqdm import tqdm

from inertial.imu_errors import PROFILES
from nav_ros.bags import TOPICS, BagError, BagWarning, BagWriter
from nav_ros.compiling import compilations_told
from nav_ros.estimated import read_run
from nav_ros.parameters import load_parameter_file, parameter_names, params_from_values, unknown_parameters
from nav_ros.recorded import recorded_messages
from nav_ros.simulated import DESCRIPTIONS, simulate_scenario

USAGE_ERROR = 2
"""Exit status for a wrong command line or input that cannot be used."""


def add_topic_option(parser, keys):
    """Give a parser the option ``--topic NAME:=/TOPIC`` for some keys of :data:`nav_ros.bags.TOPICS`."""
    defaults = ", ".join(f"{key} ({TOPICS[key]})" for key in keys)
    parser.add_argument("--topic", action="append", default=[], metavar="NAME:=/TOPIC", dest="topics",
                        type=lambda text: _remap(text, keys),
                        help=f"read NAME from another topic; names: {defaults}")


def topics_of(arguments):
    """Return key -> topic with the remaps that :func:`add_topic_option` has collected."""
    return TOPICS | dict(arguments.topics)


def add_parameter_options(parser, node_name):
    """Give a parser the options ``--params FILE`` and ``-p NAME:=VALUE`` for the parameters of a node."""
    parser.add_argument("--params", metavar="FILE", help=f"ROS 2 parameter file of {node_name}")
    parser.add_argument("-p", "--param", action="append", default=[], metavar="NAME:=VALUE", dest="set",
                        help="one parameter, as after --ros-args")


def parameters_of(arguments, node_name, params_class):
    """Return the parameters that :func:`add_parameter_options` has collected.

    Raises
    ------
    ValueError
        Names that do not exist (the nearest ones are told), or values that are refused.
    """
    names = parameter_names(params_class)
    values = load_parameter_file(arguments.params, node_name, names) if arguments.params else {}
    given = [text.partition(":=") for text in arguments.set]
    for text, (_, separator, _) in zip(arguments.set, given, strict=True):
        if not separator:
            raise ValueError(f"-p {text}: expected NAME:=VALUE")
    if faults := unknown_parameters([name for name, _, _ in given], names):
        raise ValueError(" ".join(faults))
    values |= {name: parse_value(value) for name, _, value in given}
    return params_from_values(params_class, values)


def parse_value(text):
    """Return a parameter value as ROS reads it from a command line.

    Raises
    ------
    ValueError
        It is not YAML.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError
    try:
        return YAML(typ="safe").load(text)
    except YAMLError as error:
        raise ValueError(f"{text!r} is not a parameter value: {error.problem}") from error


@contextlib.contextmanager
def one_line_errors(program):
    """End the program with one line and exit status 2 on bad input; warnings and compilations take one line each."""
    def show(message, category, *_args, **_kwargs):
        print(f"{program}: warning: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", BagWarning)
        warnings.showwarning = show
        try:
            with _told_on_a_terminal(program):
                yield
        except (BagError, ValueError, OSError) as error:
            print(f"{program}: {' '.join(str(error).split())}", file=sys.stderr)
            raise SystemExit(USAGE_ERROR) from None
        except KeyboardInterrupt:
            print(f"{program}: interrupted", file=sys.stderr)
            raise SystemExit(130) from None


def _told_on_a_terminal(program):
    if not sys.stderr.isatty():
        return contextlib.nullcontext()
    return compilations_told(lambda text: tqdm.write(f"{program}: {text}", file=sys.stderr))


def progress(iterable, what, total=None):
    """Iterate with a progress bar on standard error, if that is a terminal."""
    return tqdm(iterable, desc=what, total=total, unit="msg", unit_scale=True, leave=False, disable=None)


def simulate_bag_main(arguments=None):
    """Run ``simulate_bag``."""
    options = _simulate_parser().parse_args(arguments)
    with one_line_errors("simulate_bag"):
        recording = simulate_scenario(
            options.scenario, duration=options.duration, imu_rate=options.imu_rate,
            altimeter_rate=options.altimeter_rate, errors=options.errors, seed=options.seed,
            rest=options.rest)
        types, messages = recorded_messages(recording, options.pressure)
        with BagWriter(options.out, types, options.storage) as writer:
            writer.write_all(messages)
        print(f"{options.out}: {options.scenario}, {options.duration:g} s, {len(messages)} messages on "
              f"{', '.join(types)}")


def score_bag_main(arguments=None):
    """Run ``score_bag``."""
    options = _score_parser().parse_args(arguments)
    with one_line_errors("score_bag"):
        score = dataclasses.asdict(score_bag(options.bag, topics_of(options)))
        if options.csv:
            with open(options.csv, "w", newline="") as file:
                rows = csv.writer(file)
                rows.writerows([["bag", *score], [options.bag, *score.values()]])
        if options.json:
            print(json.dumps({key: json_number(value) for key, value in score.items()}))
        else:
            for key, value in score.items():
                print(f"{key:20} {value:.4f}" if isinstance(value, float) else f"{key:20} {value}")


def score_bag(path, topics=TOPICS):
    """Score the attitudes on the output topic of a bag against its truth.

    Parameters
    ----------
    path : path-like
    topics : dict
        ``output`` is a sensor_msgs/Imu whose orientation_covariance[0] is -1 where there is no attitude;
        ``truth`` is a geometry_msgs/QuaternionStamped.

    Returns
    -------
    inertial.scoring.AttitudeScore

    Raises
    ------
    nav_ros.bags.BagError
        The bag or one of the topics is not there.
    ValueError
        There is nothing to score.
    """
    run = read_run(path, topics, need=("truth",), also=(), progress=partial(progress, what="reading"))
    return run.attitude.score()


def _simulate_parser():
    parser = argparse.ArgumentParser(
        prog="simulate_bag", formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Write a bag of a simulated IMU with the true attitude, and of an altimeter or, for a "
        "turntable, of its joint.",
        epilog="scenarios:\n" + "\n".join(f"  {name:21} {text}" for name, text in DESCRIPTIONS.items()))
    parser.add_argument("scenario", metavar="SCENARIO", choices=DESCRIPTIONS, help="see below")
    parser.add_argument("out", metavar="OUT", help="folder to make")
    parser.add_argument("--duration", type=float, default=120.0, metavar="S",
                        help="seconds (default %(default)g)")
    parser.add_argument("--rest", type=float, default=3.0, metavar="S",
                        help="seconds of standing still at the start (default %(default)g)")
    parser.add_argument("--seed", type=int, default=0,
                        help="of the noise; the same seed gives the same bytes (default 0)")
    parser.add_argument("--imu-rate", type=float, default=200.0, metavar="HZ", help="default %(default)g")
    parser.add_argument("--altimeter-rate", type=float, default=20.0, metavar="HZ",
                        help="default %(default)g")
    parser.add_argument("--errors", choices=PROFILES, default="",
                        help="quality of a motion's sensors (default consumer); a turntable's is in its name")
    parser.add_argument("--pressure", action="store_true", help="write /pressure in place of /altitude")
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="default %(default)s")
    return parser


def _score_parser():
    parser = argparse.ArgumentParser(
        prog="score_bag",
        description="Compare the attitude in a bag with the truth in it: tilt error after the first 5 s, "
        "where the truth has no gap. An orientation_covariance that starts with -1 means no attitude.")
    parser.add_argument("bag", metavar="BAG", help="rosbag2 folder, .mcap or .db3 file")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--csv", metavar="FILE", help="also write a header and one row to FILE")
    add_topic_option(parser, ("output", "truth"))
    return parser


def _remap(text, keys):
    key, separator, topic = text.partition(":=")
    if not separator or key not in keys or not topic.startswith("/"):
        raise argparse.ArgumentTypeError(
            f"{text!r}: expected NAME:=/TOPIC with NAME one of {', '.join(keys)}")
    return key, topic


def json_number(value):
    """Return a value as JSON has it: None for what is not a finite number."""
    return None if isinstance(value, float) and not np.isfinite(value) else value
