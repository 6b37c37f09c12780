"""navigate_bag: position, velocity and attitude of a recorded bag, by the same session as the node, without DDS.

Messages are taken in recorded order, each aid at its stamp, so the output bag has what ``navigation_node`` would
have published; thousands of samples go through the kernels at once.
"""

import argparse
import time
import warnings
from collections import Counter

import numpy as np

from attitude_estimator.navigation.edge import (
    INPUTS,
    OUTPUT_TYPES,
    NavigationNodeParams,
    NavigationOutput,
    NavigationSession,
)
from nav_ros.bags import TYPES, BagError, BagReader, BagWarning, BagWriter, choose_altitude
from nav_ros.cli import (
    add_parameter_options,
    add_topic_option,
    one_line_errors,
    parameters_of,
    progress,
    topics_of,
)

TRUTHS = ("truth", "true_odometry")
"""Keys of what is copied."""
PART = 20_000  # samples that are estimated at once; more only takes memory


def navigate_bag(path, out, params, topics, storage="mcap"):
    """Write the navigation of one bag into another, with a copy of the truth.

    Parameters
    ----------
    path, out : path-like
    params : NavigationNodeParams
    topics : dict
        Key -> topic, see :data:`nav_ros.bags.TOPICS`.
    storage : {"mcap", "sqlite3"}

    Returns
    -------
    session : NavigationSession
    counts : dict
        ``estimates``, and each fault that occurred.

    Raises
    ------
    nav_ros.bags.BagError
        There is no such bag, no IMU in it, a topic of another type, or nothing that can be used.
    """
    counts = Counter(estimates=0)
    session = NavigationSession(params, lambda name, _text, _level: counts.update([name]))
    with BagReader(path) as bag:
        inputs = _inputs(bag, params, topics)
        truths = {topics[key] for key in TRUTHS if topics[key] in bag.types}
        types = {f"/{topic}": kind for topic, kind in OUTPUT_TYPES.items()}
        types |= {topic: bag.types[topic] for topic in truths}
        with BagWriter(out, types, storage) as writer:
            part = _Part(session, writer)
            for message in progress(bag.messages([*inputs, *truths]), bag.name):
                if message.topic in truths:
                    part.copy(message)
                else:
                    part.take(inputs[message.topic], message)
            part.end()
            counts["estimates"] = part.written
    if not counts["estimates"]:
        raise BagError(f"{path}: no usable IMU sample on {topics['imu']}")
    return session, {name: count for name, count in (session.faults | counts).items() if count}


class _Part:
    """Messages of a bag that are estimated at once and then written.

    Parameters
    ----------
    session : NavigationSession
    writer : nav_ros.bags.BagWriter
    """

    def __init__(self, session, writer):
        self.written = 0  # estimates so far
        self._session, self._writer = session, writer
        self._output = NavigationOutput(session)
        self._begin()

    def _begin(self):
        self._copied, self._receive_ns, self._frames = [], [], []
        self._session.estimator.hold()

    def copy(self, message):
        """Write a message as it is."""
        self._copied.append(message)

    def take(self, name, message):
        """Take a message on an input of the node."""
        if name == "heading" or len(self._frames) >= PART:
            self.end()  # the vehicle's heading is made the IMU's by the present estimate
            self._begin()
        if self._session.take(name, message.raw):
            self._receive_ns.append(message.receive_ns)
            self._frames.append(self._session.frame)

    def end(self):
        """Estimate and write what was taken."""
        navigation, fresh = self._session.estimator.release()
        receive_ns = np.array(self._receive_ns, np.int64)[fresh]
        out = list(self._copied)
        for topic, rows, raws in self._output.batch(navigation, np.array(self._frames, str)[fresh]):
            out += zip([f"/{topic}"] * len(rows), receive_ns[rows].tolist(), raws, strict=True)
        for topic, at_ns, raw in sorted(out, key=lambda message: message[1]):
            self._writer.write(topic, at_ns, raw)
        self.written += len(navigation)


def _inputs(bag, params, topics):
    """Return topic -> key of what the bag has, after a check of the types."""
    altimeter = choose_altitude(bag.types, topics, params.altitude_source)
    unused = {"altitude", "pressure"} - {altimeter}
    keys = [key for key in INPUTS if key == "imu" or (key not in unused and topics[key] in bag.types)]
    for key in keys:
        bag.require(topics[key], TYPES[key])
    return {topics[key]: key for key in keys}


def main(arguments=None):
    """Run ``navigate_bag``."""
    options = _parser().parse_args(arguments)
    with one_line_errors("navigate_bag"):
        params = parameters_of(options, "navigation_node", NavigationNodeParams)
        began = time.perf_counter()
        session, counts = navigate_bag(options.bag, options.out, params, topics_of(options), options.storage)
        for suspicion in session.check.faults.values():
            warnings.warn(f"{options.bag}: {suspicion}", BagWarning, stacklevel=1)
        print("\n".join(_summary(options.out, session, counts, time.perf_counter() - began)))


def _summary(out, session, counts, took):
    """Return what is told at the end: the estimates, each aid, the end, the faults."""
    faults = ", ".join(f"{name} {count}" for name, count in counts.items() if name != "estimates")
    yield f"{out}: {counts['estimates']} estimates in {took:.1f} s; {faults or 'nothing refused'}"
    for name, health in session.estimator.health.items():
        if health.used or health.refused:
            yield f"  {name:12} {health.used} used, {health.refused} refused, NIS {health.nis:.2f}"
    spread = ", ".join(f"{name} {value:.3g}" for name, value in session.spread().items())
    yield f"  at the end   {session.phase}; {spread}"
    if not session.estimator.estimate.navigating:
        yield f"  waiting for  {session.estimator.waiting_for}"


def _parser():
    parser = argparse.ArgumentParser(
        prog="navigate_bag",
        description="Write the bag that navigation_node would make of a recording: /odometry, /imu/data, the "
        "biases, and a copy of the truth.")
    parser.add_argument("bag", metavar="IN", help="rosbag2 folder, .mcap or .db3 file")
    parser.add_argument("out", metavar="OUT", help="folder to make")
    add_parameter_options(parser, "navigation_node")
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="default %(default)s")
    add_topic_option(parser, (*INPUTS, *TRUTHS))
    return parser
