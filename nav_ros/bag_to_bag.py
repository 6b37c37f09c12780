"""What the tools that make a bag of estimates from a bag of samples have in common.

Messages are taken in recorded order, some thousands at once. What cannot be used leaves no bag behind.
"""

import argparse
import contextlib
import gc
import shutil
import sys
import time
import warnings
from collections import Counter
from operator import itemgetter
from pathlib import Path

from nav_ros.bags import BagError, BagReader, BagWarning, BagWriter, bag_name
from nav_ros.bias_file import read_biases
from nav_ros.cli import (
    USAGE_ERROR,
    add_parameter_options,
    add_topic_option,
    one_line_errors,
    parameters_of,
    progress,
)
from nav_ros.compiling import start_compiler


class BagEstimator:
    """Turns messages of a bag into those that a node publishes.

    What is derived from it has ``estimate(messages)``, which returns a (topic, receive_ns, raw) of each message that
    follows, ``faults``, and ``summary()``, which yields what came out and more lines about it.

    Parameters
    ----------
    params : parameters with an ``altitude_source`` and a ``bias_file``
    bag : nav_ros.bags.BagReader
    topics : dict
        Key -> topic, see :data:`nav_ros.bags.TOPICS`.

    Attributes
    ----------
    keys, copies : tuple of str
        Keys of :data:`nav_ros.bags.TOPICS`: what is read where it is there, and what is written again as it is.
    output_types : dict
        Topic without its slash -> message type, ``imu/data`` first.
    part : float
        Messages that are estimated at once; more only takes memory.
    inputs : dict
        Topic -> key of what is read.
    counts : Counter
        ``samples``, and others.
    suspicions : iterable of str
        What the values show of a wrong unit or a wrong side up.
    """

    part = 20_000
    suspicions = ()

    def __init__(self, params, bag, topics):
        self.params = params
        self.inputs = bag.inputs(self.keys, topics, params.altitude_source)
        self.counts = Counter()

    def stored_biases(self):
        """Return what the file of biases holds: None where none is named or, which is told, there is no such file."""
        path = self.params.bias_file
        stored = read_biases(path) if path else None
        if path and stored is None:
            warnings.warn(f"bias_file = {path!r}: there is no such file", BagWarning, stacklevel=2)
        return stored

    @property
    def told_faults(self):
        """Everything that was refused or bridged as one text."""
        return ", ".join(f"{name} {count}" for name, count in self.faults.items() if count)


def estimate_bag_to_bag(kind, path, out, params, topics, storage="mcap", **more):
    """Write what is estimated from one bag into another, with a copy of the truth.

    Parameters
    ----------
    kind : type
        A :class:`BagEstimator`.
    path, out : path-like
    params, topics
        Of the estimator.
    storage : {"mcap", "sqlite3"}
    more
        Handed to the estimator too.

    Returns
    -------
    instance of `kind`

    Raises
    ------
    nav_ros.bags.BagError
        There is no such bag, no IMU in it, a topic of another type, or nothing that can be used.
    """
    with BagReader(path) as bag:
        estimator = kind(params, bag, topics, **more)
        copied = {topics[key]: bag.types[topics[key]] for key in kind.copies if topics[key] in bag.types}
        types = {f"/{topic}": message_type for topic, message_type in kind.output_types.items()} | copied
        with BagWriter(out, types, storage) as writer, _without_garbage_collection():
            part = []
            for message in progress(bag.messages([*estimator.inputs, *copied]), bag.name):
                part.append(message)
                if len(part) >= estimator.part:
                    _write(writer, estimator, part, copied)
                    part = []
            _write(writer, estimator, part, copied)
    if not estimator.counts["samples"]:
        shutil.rmtree(out)
        why = estimator.told_faults or "no message"
        hint = "; fixed_dt is the interval of samples without a stamp" if "no_stamp" in why else ""
        raise BagError(f"{path}: no usable IMU sample on {topics['imu']}: {why}{hint}")
    return estimator


@contextlib.contextmanager
def _without_garbage_collection():
    """Messages are in no cycles, and the search for cycles among so many would take a fifth of the time."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _write(writer, estimator, part, copied):
    out = estimator.estimate([message for message in part if message.topic not in copied])
    out += [message for message in part if message.topic in copied]
    writer.write_all(sorted(out, key=itemgetter(1)))


def bags_parser(program, description, node_name, kind):
    """Return the parser of a tool that makes bags by a :class:`BagEstimator` with the parameters of a node."""
    parser = argparse.ArgumentParser(prog=program, description=description)
    parser.add_argument("bags", nargs="+", metavar="IN... OUT",
                        help="bags to read (rosbag2 folders, .mcap or .db3 files), and the folder to make; of several "
                        "bags it holds one bag each")
    add_parameter_options(parser, node_name)
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="default %(default)s")
    add_topic_option(parser, (*kind.keys, *kind.copies))
    parser.set_defaults(node_name=node_name)
    return parser


def estimate_bags(parser, params_class, estimate, arguments=None):
    """Run such a tool; return its exit status.

    Parameters
    ----------
    parser : argparse.ArgumentParser
        Of :func:`bags_parser`.
    params_class : type
    estimate : callable
        ``estimate(bag, out, params, options)`` writes one bag and returns its :class:`BagEstimator`.
    arguments : list of str, optional
    """
    options = parser.parse_args(arguments)
    status = 0
    with one_line_errors(parser.prog):
        *bags, out = options.bags
        if not bags:
            raise ValueError("needs at least one bag and the folder to write")
        params = parameters_of(options, options.node_name, params_class)
        start_compiler()
        for bag, target in _targets(bags, out):
            began = time.perf_counter()
            try:
                estimator = estimate(bag, target, params, options)
            except BagError as error:
                if len(bags) == 1:
                    raise
                print(f"{parser.prog}: {error}", file=sys.stderr)
                status = USAGE_ERROR
                continue
            for suspicion in estimator.suspicions:
                warnings.warn(f"{bag}: {suspicion}", BagWarning, stacklevel=1)
            result, *more = estimator.summary()
            print(f"{target}: {result}, in {time.perf_counter() - began:.1f} s; "
                  f"{estimator.told_faults or 'nothing refused'}", *more, sep="\n")
    return status


def _targets(bags, out):
    """Return (bag, folder to make) pairs."""
    if len(bags) == 1:
        return [(bags[0], Path(out))]
    (name, count), = Counter(map(bag_name, bags)).most_common(1)
    if count > 1:
        raise ValueError(f"{count} bags are named {name}: their estimates would have one folder")
    return [(bag, Path(out) / bag_name(bag)) for bag in bags]
