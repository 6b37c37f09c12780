"""What nodes with fast sensors have in common: parameters, guarded raw subscriptions, faults, diagnostics.

A node made of this says which messages it takes and what it publishes; nothing that comes in can end it, and
each kind of fault is counted, logged now and then, and told in the next report.
"""

import difflib
import math
import time
from collections import Counter

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions

from nav_ros.diagnostics import Level, Report, diagnostic_array
from nav_ros.parameters import declare_parameters, parameter_names
from nav_ros.sensor_loop import SensorGroup

DEPTH = 1000  # messages; half a second of a fast IMU while the machine is busy elsewhere
SENSOR_QOS = QoSProfile(depth=DEPTH, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
OUTPUT_QOS = QoSProfile(depth=DEPTH, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
SLOW_START = 1.0  # s of compilation worth telling


class SensorNode(Node):
    """A node whose sensors are served by :func:`nav_ros.sensor_loop.spin_sensors`.

    Parameters
    ----------
    name : str
    params_class : type
        Its parameters, see :func:`nav_ros.parameters.declare_parameters`.

    Attributes
    ----------
    params : instance of `params_class`
        As at the start.
    counts : Counter
        Of the faults told to :meth:`fault`.
    sensors : list of (rclpy.subscription.Subscription, callable)
        Of messages that wait together, those of the first are served first.
    """

    def __init__(self, name, params_class):
        super().__init__(name)
        self.params = declare_parameters(self, params_class)
        self.counts, self._last_fault = Counter(), {}
        self.sensors = []
        self._sensor_group = SensorGroup()
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        for given in self._parameter_overrides:
            if not self.has_parameter(given):  # rclpy drops it without a word
                (near,) = difflib.get_close_matches(given, parameter_names(params_class), 1, 0.0)
                self.get_logger().warning(f"there is no parameter {given}; did you mean {near}?")

    def prepare(self, warm_up):
        """Have every kernel compiled, so that no message waits for a compiler."""
        began = time.monotonic()
        self.get_logger().info("preparing the kernels (the first start compiles them, about a minute)")
        warm_up()
        took = time.monotonic() - began
        if took > SLOW_START:
            self.get_logger().info(f"kernels ready after {took:.1f} s; later starts reuse them")

    def now_ns(self):
        """Return the node's time."""
        # get_clock().now() makes an object around the same number at several times the cost.
        return self.get_clock().handle.get_now().nanoseconds

    def advertise(self, kind, topic):
        """Return a publisher whose QoS can be overridden by parameters."""
        events = PublisherEventCallbacks(use_default_callbacks=False, incompatible_qos=self._on_bad_qos(topic))
        return self.create_publisher(kind, topic, OUTPUT_QOS, event_callbacks=events,
                                     qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def add_sensor(self, kind, topic, take):
        """Subscribe to serialized messages; whatever `take` makes of one, the next one is served."""
        def guarded(raw):
            try:
                take(raw)
            except Exception as error:
                if rclpy.ok():  # otherwise a signal has shut down under this message
                    self.fault("exception", f"{topic}: {type(error).__name__}: {error}", Level.ERROR)

        events = SubscriptionEventCallbacks(use_default_callbacks=False, incompatible_qos=self._on_bad_qos(topic))
        subscription = self.create_subscription(
            kind, topic, guarded, SENSOR_QOS, raw=True, event_callbacks=events, callback_group=self._sensor_group,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self.sensors.append((subscription, guarded))

    def _on_bad_qos(self, topic):
        def told(info):
            policy = qos_policy_name_from_kind(info.last_policy_kind)
            self.fault("incompatible_qos", f"{topic}: a peer's {policy} does not fit; nothing gets through",
                       Level.ERROR)
        return told

    def fault(self, name, text, level):
        """Count a fault and remember it for the next report; log its 1st, 10th, 100th, ... time."""
        self.counts[name] += 1
        self._last_fault[name] = (level, text)
        count = self.counts[name]
        if count == 10 ** round(math.log10(count)):
            told = text if count == 1 else f"{text} ({count} times)"
            # Two calls: rclpy refuses one that logs with a severity and later with another.
            if level == Level.ERROR:
                self.get_logger().error(told)
            else:
                self.get_logger().warning(told)

    def new_report(self, what, hardware_id=""):
        """Return a :class:`nav_ros.diagnostics.Report` with the faults since the one before."""
        report = Report(f"{self.get_fully_qualified_name().lstrip('/')}: {what}", hardware_id)
        for level, text in self._last_fault.values():
            report.fault(level, text)
        self._last_fault.clear()
        return report

    def publish_report(self, report, now_ns):
        """Publish a report on /diagnostics."""
        self._diagnostics.publish(diagnostic_array(now_ns, [report]))
