"""navigate_bag: position, velocity and attitude of a recorded bag, by the same session as the node, without DDS.

Messages are taken in recorded order, each aid at its stamp, so the output bag has what ``navigation_node`` would
have published; thousands of samples go through the kernels at once.
"""

from functools import partial

import numpy as np

from attitude_estimator.navigation.edge import (
    INPUTS,
    OUTPUT_TYPES,
    NavigationNodeParams,
    NavigationOutput,
    NavigationSession,
)
from nav_ros.bag_to_bag import BagEstimator, bags_parser, estimate_bag_to_bag, estimate_bags
from nav_ros.cli import topics_of


class NavigationBagEstimator(BagEstimator):
    """Turns the messages of one bag into those that ``navigation_node`` publishes.

    Parameters
    ----------
    params : NavigationNodeParams
    bag, topics
        As of a :class:`~nav_ros.bag_to_bag.BagEstimator`.
    """

    keys, copies, output_types = INPUTS, ("truth", "true_odometry"), OUTPUT_TYPES

    def __init__(self, params, bag, topics):
        super().__init__(params, bag, topics)
        self._session = NavigationSession(params, lambda name, _text, _level: self.counts.update([name]))
        self._output = NavigationOutput(self._session)
        self._session.stored = self.stored_biases()

    def estimate(self, part):
        """Return what follows from a list of messages: (topic, receive_ns, raw) of each."""
        out = []
        self._hold()
        for topic, receive_ns, raw in part:
            if self.inputs[topic] == "heading":
                out += self._release()  # the vehicle's heading is made the IMU's by the present estimate
                self._hold()
            if self._session.take(self.inputs[topic], raw):
                self._receive_ns.append(receive_ns)
                self._frames.append(self._session.frame)
        return out + self._release()

    def _hold(self):
        self._receive_ns, self._frames = [], []
        self._session.estimator.hold()

    def _release(self):
        """Return the messages of what has been held."""
        navigation, fresh = self._session.estimator.release()
        receive_ns, frames = np.array(self._receive_ns, np.int64)[fresh], np.array(self._frames, str)[fresh]
        self.counts["samples"] += len(navigation)
        return [message for topic, rows, raws in self._output.batch(navigation, frames)
                for message in zip([f"/{topic}"] * len(rows), receive_ns[rows].tolist(), raws, strict=True)]

    @property
    def faults(self):
        """Name -> count of everything that was refused or bridged."""
        return self._session.faults | {name: count for name, count in self.counts.items() if name != "samples"}

    @property
    def suspicions(self):
        """What the values show of a wrong unit or a wrong side up."""
        return self._session.check.faults.values()

    def summary(self):
        """Return what came out, each aid, and the end."""
        estimator = self._session.estimator
        yield f"{self.counts['samples']} estimates"
        for name, health in estimator.health.items():
            if health.used or health.refused:
                yield f"  {name:12} {health.used} used, {health.refused} refused, NIS {health.nis:.2f}"
        spread = ", ".join(f"{name} {value:.3g}" for name, value in self._session.spread().items())
        yield f"  at the end   {self._session.phase}; {spread}"
        if not estimator.estimate.navigating:
            yield f"  waiting for  {estimator.waiting_for}"


navigate_bag = partial(estimate_bag_to_bag, NavigationBagEstimator)
"""Write the navigation of one bag into another."""


def main(arguments=None):
    """Run ``navigate_bag``; return its exit status."""
    parser = bags_parser(
        "navigate_bag", "Write the bag that navigation_node would make of a recording: /odometry, /imu/data, the "
        "biases, and a copy of the truth.", "navigation_node", NavigationBagEstimator)
    return estimate_bags(parser, NavigationNodeParams, _navigate_one, arguments)


def _navigate_one(bag, out, params, options):
    return navigate_bag(bag, out, params, topics_of(options), options.storage)
