"""A loop that serves fast sensors at little cost.

One turn of rclpy's executor goes through everything that a node has: services, timers, events. At the rate
of an IMU that costs several times the estimate. Here the sensors' subscriptions alone are waited for, and the
executor gets a turn every :data:`HOUSEKEEPING` seconds for the rest.
"""

import time

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation

HOUSEKEEPING = 0.05  # s from one turn of the executor to the next
BACKLOG = 1000  # messages of one subscription served in a row


def spin_sensors(node, sensors):
    """Serve a node until its context is shut down.

    Parameters
    ----------
    node : rclpy.node.Node
    sensors : list of (rclpy.subscription.Subscription, callable)
        Raw subscriptions with what takes their bytes; of messages that wait together, those of the first
        subscription are served first.

    Raises
    ------
    KeyboardInterrupt, rclpy.executors.ExternalShutdownException
        As from ``rclpy.spin``.
    """
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    wait_set = rclpy_implementation.WaitSet(len(sensors), 0, 0, 0, 0, 0, node.context.handle)
    while rclpy.ok():
        executor.spin_once(timeout_sec=0.0)
        housekeeping = time.monotonic() + HOUSEKEEPING
        while (left := housekeeping - time.monotonic()) > 0.0:
            wait_set.clear_entities()
            for subscription, _ in sensors:
                wait_set.add_subscription(subscription.handle)
            wait_set.wait(round(left * 1e9))
            for subscription, take in sensors:
                _serve_waiting(subscription, take)


def _serve_waiting(subscription, take):
    for _ in range(BACKLOG):
        waiting = subscription.handle.take_message(subscription.msg_type, True)
        if waiting is None:
            return
        take(waiting[0])
