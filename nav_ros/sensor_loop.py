"""A loop that serves fast sensors at little cost.

One turn of rclpy's executor goes through everything that a node has: services, timers, events. At the rate
of an IMU that costs several times the estimate. Here the sensors' subscriptions alone are waited for, and the
executor gets a turn every :data:`HOUSEKEEPING` seconds for the rest.
"""

import contextlib
import signal
import sys
import threading
import time

import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.utilities import remove_ros_args

from nav_ros.parameters import node_help

HOUSEKEEPING = 0.05  # s from one turn of the executor to the next
BACKLOG = 1000  # messages served in a row


class SensorGroup(MutuallyExclusiveCallbackGroup):
    """Callback group of the sensors: the executor has their events, but leaves their messages to the loop."""

    def can_execute(self, entity):
        """Whether the executor may serve an entity."""
        return not isinstance(entity, Subscription) and super().can_execute(entity)


def init_interruptible():
    """Initialise ROS so that SIGINT and SIGTERM raise KeyboardInterrupt in the main thread.

    rclpy's own handlers shut the context down from a thread of theirs, under whatever is being published or
    waited for: now and then that ends in an RCLError or a segmentation fault.
    """
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)


def made(node_class):
    """Return a node of a class that takes no arguments.

    One whose making fails is destroyed: rclpy may hang at the program's end over entities that are left behind.
    """
    node = node_class.__new__(node_class)
    with contextlib.ExitStack() as cleanup:
        cleanup.callback(_destroy, node)
        node.__init__()
        cleanup.pop_all()
    return node


def _destroy(node):
    if hasattr(node, "_type_description_service"):  # the last thing that rclpy's own part makes
        Node.destroy_node(node)


def run_node(name, node_class, params_class, text, work, errors=()):
    """Make a node and let it work until it is done, interrupted or shut down; ``--help`` tells what it does.

    Parameters
    ----------
    name : str
        Of the program, for what it prints.
    node_class : type
        Made without arguments; a ValueError or a parameter of the wrong type ends the start.
    params_class : type
    text : str
        What the node does.
    work : callable
        ``work(node)`` returns the exit status.
    errors : tuple of exception types
        What else is wrong with the input, also while it works.

    Returns
    -------
    int
        Exit status: that of the work, 0 when interrupted, or 2 after one line about what is wrong.
    """
    if not {"-h", "--help"}.isdisjoint(sys.argv[1:]):
        print(node_help(name, text, params_class))
        return 0
    node = None
    told = (ValueError, ParameterException, rclpy_implementation.RCLError,
            rclpy_implementation.UnknownROSArgsError, *errors)
    try:
        init_interruptible()
        others = remove_ros_args(sys.argv)[1:]
        if others:
            raise ValueError(f"unknown argument {others[0]}: parameters and remaps come after --ros-args")
        node = made(node_class)
        told = errors
        return work(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except told as error:
        # What follows is the place in the source of ROS.
        print(f"{name}: {' '.join(str(error).partition(', at /')[0].split())}", file=sys.stderr)
        return 2
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def run_sensor_node(name, node_class, params_class, text):
    """Run a :class:`nav_ros.sensor_node.SensorNode`; parameters and result as of :func:`run_node`."""
    return run_node(name, node_class, params_class, text, spin_sensors)


@contextlib.contextmanager
def served(node):
    """Serve a node's callbacks in a thread of its own while the block runs.

    ``executor.spin`` in a thread would have to be ended from another one, under what it waits for.

    Parameters
    ----------
    node : rclpy.node.Node
    """
    ended = threading.Event()

    def serve():
        executor = SingleThreadedExecutor(context=node.context)
        executor.add_node(node)
        while not ended.is_set():
            executor.spin_once(timeout_sec=HOUSEKEEPING)
        executor.shutdown()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def spin_sensors(node):
    """Serve a node until its context is shut down; return the exit status 0.

    Of messages that wait together, those of the first sensor are served first. A message of the last one is served
    after all that came before it.

    Parameters
    ----------
    node : nav_ros.sensor_node.SensorNode

    Raises
    ------
    KeyboardInterrupt, rclpy.executors.ExternalShutdownException
        As from ``rclpy.spin``.
    """
    sensors = [(sensor.subscription, sensor.take) for sensor in node.sensors.values()]
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
            _serve_waiting(sensors)
    return 0


def _serve_waiting(sensors):
    *others, (last, take_last) = sensors
    left = BACKLOG
    while left > 0:
        # Fetched first and served last: by then all that came before it has been served.
        waiting = last.handle.take_message(last.msg_type, True)
        served = sum(_serve(*sensor, left) for sensor in others)
        if waiting is not None:
            take_last(waiting[0])
        elif not served:
            return
        left -= served + 1


def _serve(subscription, take, most):
    """Serve what waits on a subscription; return how many messages that were."""
    for count in range(most):
        waiting = subscription.handle.take_message(subscription.msg_type, True)
        if waiting is None:
            return count
        take(waiting[0])
    return most
