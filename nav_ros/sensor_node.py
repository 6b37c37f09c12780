"""What nodes with fast sensors have in common: parameters, guarded raw subscriptions, faults, diagnostics.

A node made of this says which messages it takes and what it publishes; nothing that comes in can end it, and
each kind of fault is counted, logged now and then, and told in the next report. A report comes once a second,
and at once when a sensor or a peer comes or goes.
"""

import math
import time
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from nav_ros.bias_file import BiasFileError, read_biases, write_biases
from nav_ros.compiling import compilations_told, start_compiler
from nav_ros.diagnostics import Level, Report, StreamMeter, diagnostic_array
from nav_ros.messages import RefusedMessageError
from nav_ros.parameters import declare_parameters
from nav_ros.sensor_loop import SensorGroup
from nav_ros.transforms import Transforms

DEPTH = 1000  # messages; half a second of a fast IMU while the machine is busy elsewhere
SENSOR_QOS = QoSProfile(depth=DEPTH, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
OUTPUT_QOS = QoSProfile(depth=DEPTH, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
SLOW_START = 5.0  # s of compilation worth telling
STORE_PERIOD = 60.0  # s between two writings of the biases
WATCH_PERIOD = 0.2  # s, how soon a silent sensor or a new peer is told
WATCHES_PER_REPORT = 5


class Sensor(NamedTuple):
    """One topic that comes in; `needed` is one without which there is nothing to publish."""

    topic: str
    subscription: Subscription
    take: Callable
    meter: StreamMeter
    needed: bool

    @property
    def publishers(self):
        """How many publishers it is matched with."""
        return self.subscription.handle.get_publisher_count()


class SensorNode(Node):
    """A node whose sensors are served by :func:`nav_ros.sensor_loop.spin_sensors`.

    A subclass adds its sensors and outputs, and at last calls :meth:`begin`. Its :meth:`make_report` says how it
    is.

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
        Of the messages of each sensor and of the faults told to :meth:`fault`.
    sensors : dict of str to Sensor
        By the first part of their topics' names. Of messages that wait together, those of the first are served
        first.
    outputs : dict of str to rclpy.publisher.Publisher
        By topic.
    wanted : set of str
        Topics of the outputs to which somebody listens, as of the last watch.
    """

    def __init__(self, name, params_class):
        super().__init__(name)
        self.params = declare_parameters(self, params_class)
        self.counts, self._last_fault = Counter(), {}
        self.sensors, self.outputs, self.wanted = {}, {}, set()
        self._keep = None
        self._listeners, self._watches, self._watched = {}, 0, None
        self._sensor_group = SensorGroup()
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def prepare(self, make):
        """Return what a function returns that has every kernel compiled, so that no message waits for a compiler."""
        began = time.monotonic()
        self.get_logger().info("preparing the kernels")
        start_compiler()
        with compilations_told(self.get_logger().info):
            made = make()
        took = time.monotonic() - began
        if took > SLOW_START:
            self.get_logger().info(f"kernels ready after {took:.1f} s")
        return made

    def begin(self):
        """Watch the sensors from now on."""
        # By a steady clock, which also goes where nobody publishes the /clock that use_sim_time asks for.
        self.create_timer(WATCH_PERIOD, self._watch, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info("ready")

    def now_ns(self):
        """Return the node's time."""
        # get_clock().now() makes an object around the same number at several times the cost.
        return self.get_clock().handle.get_now().nanoseconds

    def advertise(self, kind, topic, qos_told=True):
        """Return a publisher whose QoS can be overridden by parameters.

        Each handler that tells of QoS costs every turn of the executor.
        """
        events = PublisherEventCallbacks(use_default_callbacks=False,
                                         incompatible_qos=self._on_bad_qos(topic) if qos_told else None)
        self.outputs[topic] = self.create_publisher(
            kind, topic, OUTPUT_QOS, event_callbacks=events,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        return self.outputs[topic]

    def transforms(self):
        """Return :class:`nav_ros.transforms.Transforms`, or None, which is told, where tf2_ros is not installed."""
        try:
            return Transforms(self)
        except ImportError:
            self.get_logger().error("publish_tf is true but tf2_ros is not installed: no transform")
            return None

    def keep_biases(self, path, newest):
        """Keep biases in a file from now on, every minute and at the end.

        Parameters
        ----------
        path : str
        newest : callable
            Returns :class:`nav_ros.bias_file.StoredBiases`, or None while they are not known.

        Returns
        -------
        nav_ros.bias_file.StoredBiases or None
            Those of the last run, if there are any that can be used.
        """
        self._keep = lambda: self._write_biases(path, newest())
        self.create_timer(STORE_PERIOD, self._keep)
        try:
            stored = read_biases(path)
        except BiasFileError as error:
            self.get_logger().warning(f"{error}: starting without")
            return None
        if stored is None:
            self.get_logger().info(f"no {path} yet")
        return stored

    def _write_biases(self, path, biases):
        if biases is None:
            return
        try:
            write_biases(path, biases)
        except OSError as error:
            self.fault("bias_file", f"{path}: cannot be written: {error.strerror}", Level.WARN)

    def destroy_node(self):
        """Keep the biases and end."""
        if self._keep is not None:
            self._keep()
        super().destroy_node()

    def add_sensor(self, kind, topic, take, *, needed=False, patience):
        """Subscribe to serialized messages; whatever `take` makes of one, the next one is served.

        Parameters
        ----------
        kind : type
        topic : str
        take : callable
            ``take(raw)`` returns the stamp of a message that can be used, in ns, otherwise 0.
        needed : bool
            Whether nothing goes without it.
        patience : float
            Seconds without a message after which it has stopped, if its rate lets expect more.
        """
        key, meter = topic.partition("/")[0], StreamMeter(patience=patience)
        messages = f"{key}_messages"

        def guarded(raw):
            arrival_ns = self.now_ns()
            self.counts[messages] += 1
            try:
                stamp_ns = take(raw)
                if stamp_ns:
                    meter.add(stamp_ns, arrival_ns)
            except RefusedMessageError as error:
                self.fault(error.fault, f"{topic}: {error}", error.level)
            except Exception as error:
                self.fault("exception", f"{topic}: {type(error).__name__}: {error}", Level.ERROR)

        events = SubscriptionEventCallbacks(use_default_callbacks=False, incompatible_qos=self._on_bad_qos(topic))
        subscription = self.create_subscription(
            kind, topic, guarded, SENSOR_QOS, raw=True, event_callbacks=events, callback_group=self._sensor_group,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self.sensors[key] = Sensor(topic, subscription, guarded, meter, needed)

    def _on_bad_qos(self, topic):
        def told(info):
            policy = qos_policy_name_from_kind(info.last_policy_kind)
            self.fault("incompatible_qos", f"{topic}: a peer's {policy} does not fit; nothing gets through",
                       Level.ERROR)
        return told

    def fault(self, name, text, level, always=False):
        """Count a fault and remember it for the next report; log its 1st, 10th, 100th, ... time, or every one."""
        self.counts[name] += 1
        self._last_fault[name] = (level, text)
        count = self.counts[name]
        if always or count == 10 ** round(math.log10(count)):
            told = text if count == 1 else f"{text} ({count} times)"
            # Two calls: rclpy refuses one that logs with a severity and later with another.
            if level == Level.ERROR:
                self.get_logger().error(told)
            else:
                self.get_logger().warning(told)

    # --- reports

    def make_report(self, now_ns):
        """Return a :class:`nav_ros.diagnostics.Report` of the whole node."""
        raise NotImplementedError

    def send_report(self, now_ns):
        """Publish a report on /diagnostics and return it."""
        report = self.make_report(now_ns)
        self._diagnostics.publish(diagnostic_array(now_ns, [report]))
        self._last_fault.clear()
        return report

    def new_report(self, now_ns, what, hardware_id=""):
        """Return a report with the faults since the last one that was sent, and how the sensors are."""
        report = Report(f"{self.get_fully_qualified_name().lstrip('/')}: {what}", hardware_id)
        for level, text in self._last_fault.values():
            report.fault(level, text)
        if now_ns == 0:
            report.fault(Level.WARN, "use_sim_time is true and there is no /clock yet")
        for key, sensor in self.sensors.items():
            self._report_sensor(report, key, sensor, now_ns)
        for topic, count in self._listeners.items():
            report.value(f"{topic}_subscribers", count)
        return report

    def _report_sensor(self, report, key, sensor, now_ns):
        publishers = sensor.publishers
        report.value(f"{key}_rate_hz", sensor.meter.stamp_rate)
        report.value(f"{key}_publishers", publishers)
        nobody = "" if publishers else ": nobody publishes it"
        if sensor.needed and math.isnan(sensor.meter.age(now_ns)):
            report.fault(Level.STALE, f"no usable {sensor.topic} yet{nobody}")
        elif silence := sensor.meter.silence(now_ns):
            report.fault(Level.ERROR if sensor.needed else Level.WARN,
                         f"{sensor.topic} stopped {silence:.1f} s ago{nobody}")
        if key == "imu" and publishers > 1:
            report.fault(Level.WARN, f"{sensor.topic} has {publishers} publishers")

    def report_imu(self, report, gate, check, now_ns):
        """Add what the arrival, the stamps and the size of an IMU's messages say of it."""
        topic, _, _, meter, _ = self.sensors["imu"]
        report.value("imu_arrival_rate_hz", meter.arrival_rate)
        report.value("latency_p50_s", meter.latency(0.5))
        report.value("latency_p99_s", meter.latency(0.99))
        age = meter.age(now_ns)
        if math.isnan(age):
            return
        if gate.interleaved:
            report.fault(Level.ERROR, f"{topic}: stamps go back and forth: two publishers?")
        for text in check.faults.values():
            report.fault(Level.ERROR, f"{topic}: {text}")
        clock = gate.clock_fault(gate.stamp_ns + round(age * 1e9), now_ns)
        if clock:
            report.fault(Level.WARN, clock)

    def _watch(self):
        """Report once a second, and at once when a sensor or a peer comes or goes."""
        now_ns = self.now_ns()
        self._listeners = {topic: publisher.get_subscription_count() for topic, publisher in self.outputs.items()}
        self.wanted = {topic for topic, count in self._listeners.items() if count}
        watched = self._listeners, [(sensor.publishers, sensor.needed and sensor.meter.silence(now_ns) > 0.0)
                                    for sensor in self.sensors.values()]
        self._watches += 1
        if self._watches % WATCHES_PER_REPORT == 0 or watched != self._watched:
            self._watched = watched
            self.send_report(now_ns)
