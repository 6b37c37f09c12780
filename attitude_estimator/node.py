"""attitude_node: IMU and altimeter in, attitude with its covariance out.

Topics, services and parameters: README. Every IMU message is answered at once with the estimate at its
stamp; an altitude counts at its own stamp, also when it comes late. Subscriptions and publications are of
serialized messages, because making message objects costs more than the estimate.
"""

import difflib
import math
import sys
import time
from collections import Counter

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, TransformStamped, Vector3Stamped
from nav_msgs.msg import Odometry
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import FluidPressure, Imu
from std_srvs.srv import SetBool, Trigger

from attitude_estimator.edge import (
    OUTPUT_TYPES,
    AttitudeNodeParams,
    MessageNoise,
    OutputMessages,
    biases_to_store,
    start_with_stored,
)
from attitude_estimator.rivals import make_estimator
from nav_ros.altitude_source import AltitudeRefusedError, AltitudeSource
from nav_ros.bias_file import BiasFileError, read_biases, write_biases
from nav_ros.diagnostics import Level, Report, StreamMeter, diagnostic_array
from nav_ros.frames import swap_flu_frd
from nav_ros.imu_check import ImuCheck
from nav_ros.messages import (
    ACCEL,
    ACCEL_COVARIANCE,
    GYRO,
    GYRO_COVARIANCE,
    IMU,
    ORIENTATION,
    POINT,
    PRESSURE,
    MalformedMessageError,
    StampedEncoder,
    decode,
)
from nav_ros.parameters import declare_parameters, on_change, parameter_names
from nav_ros.sensor_loop import SensorGroup, run_sensor_node
from nav_ros.time_gate import StampCode, TimeGate

DEPTH = 1000  # messages; half a second of a fast IMU while the machine is busy elsewhere
SENSOR_QOS = QoSProfile(depth=DEPTH, history=HistoryPolicy.KEEP_LAST,
                        reliability=ReliabilityPolicy.BEST_EFFORT)
OUTPUT_QOS = QoSProfile(depth=DEPTH, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
MESSAGE_TYPES = {"imu/data": Imu, "imu/rpy/filtered": Vector3Stamped, "attitude/state": Odometry,
                 "imu/gyro_bias": Vector3Stamped, "imu/accel_bias": Vector3Stamped}
WATCH_PERIOD = 0.2  # s, how soon a silent IMU is told
WATCHES_PER_REPORT = 5
SILENCE = 0.2  # s, or SILENT_PERIODS of the IMU, after which it has stopped
SILENT_PERIODS = 5
ALTITUDE_SILENCE = 2.0  # s without a usable altitude before a warning
ERROR_SHARE = 0.01  # of refused samples
STUCK_ERROR_SAMPLES = 500
TWO_ALTIMETERS_NS = 5_000_000_000  # within which both have been heard
SLOW_START = 1.0  # s of compilation worth telling
FOUND_MOVING_NS = 60_000_000_000  # after which a start in motion has been corrected
WATCHES_PER_STORE = 300  # a minute between two writings of bias_file


class AttitudeNode(Node):
    """See the module."""

    def __init__(self):
        super().__init__("attitude_node")
        self._params = declare_parameters(self, AttitudeNodeParams)
        self._messages = OutputMessages(self._params.mounting_rpy)
        self._estimator = self._compiled_estimator()
        self._stored = self._stored_biases()
        self._noise = MessageNoise()
        self._check = ImuCheck(self._messages.up_imu)
        self._resets, self._found = 0, None
        self._gate = TimeGate(self._params)
        self._counts = Counter()
        self._last_fault = {}
        self._meter = StreamMeter()
        self._altitude_meter = StreamMeter()
        self._frame = None
        self._encoders = {}
        self._slot = None
        self._use_altitude = True
        self._altimeter_heard = {}
        self._watches = 0
        self._silent = False
        self._tf = self._transform_broadcaster() if self._params.publish_tf else None
        on_change(self, self._params, self._apply)
        self._subscribers = {}
        self._outputs = {topic: self._advertise(topic) for topic in OUTPUT_TYPES}
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/level", self._on_level)
        self.create_service(SetBool, "~/use_altitude", self._on_use_altitude)
        self.create_timer(WATCH_PERIOD, self._watch)
        # The altimeter first: of two messages that wait together, it is taken before the IMU's.
        self._sensor_group = SensorGroup()
        self.sensors = [*self._subscribe_altimeters(),
                        (self._subscribe(Imu, "imu/data_raw", self._take_imu), self._take_imu)]
        self._tell_unknown_parameters()
        self.get_logger().info("ready")

    def _compiled_estimator(self):
        """Make the estimator and run every kernel once, so that no message waits for a compiler."""
        began = time.monotonic()
        self.get_logger().info("preparing the kernels (the first start compiles them, about a minute)")
        make_estimator(self._params).warm_up()
        TimeGate(self._params).check(1)
        took = time.monotonic() - began
        if took > SLOW_START:
            self.get_logger().info(f"kernels ready after {took:.1f} s; later starts reuse them")
        return make_estimator(self._params)

    def _stored_biases(self):
        """Return the biases of the last run, None where there are none that can be used."""
        if not self._params.bias_file:
            return None
        try:
            stored = read_biases(self._params.bias_file)
        except BiasFileError as error:
            self.get_logger().warning(f"{error}: starting without")
            return None
        if stored is None:
            self.get_logger().info(f"no {self._params.bias_file} yet")
        return stored

    def _store_biases(self):
        estimate = self._estimator.estimate
        if not (self._params.bias_file and estimate.valid):
            return
        try:
            write_biases(self._params.bias_file, biases_to_store(estimate))
        except OSError as error:
            self._fault("bias_file", f"{self._params.bias_file}: cannot be written: {error.strerror}", Level.WARN)

    def destroy_node(self):
        """Keep the biases and end."""
        self._store_biases()
        super().destroy_node()

    def _tell_unknown_parameters(self):
        """Warn of parameters that were given but are nobody's; rclpy drops them without a word."""
        for name in self._parameter_overrides:
            if not self.has_parameter(name):
                (near,) = difflib.get_close_matches(name, parameter_names(AttitudeNodeParams), 1, 0.0)
                self.get_logger().warning(f"there is no parameter {name}; did you mean {near}?")

    def _transform_broadcaster(self):
        try:
            from tf2_ros import TransformBroadcaster
        except ImportError:
            self.get_logger().error("publish_tf is true but tf2_ros is not installed: no transform")
            return None
        return TransformBroadcaster(self)

    def _advertise(self, topic):
        # Each event handler costs every turn of the executor, so only the main topics have one.
        events = PublisherEventCallbacks(
            use_default_callbacks=False,
            incompatible_qos=self._on_bad_qos(topic) if topic == "imu/data" else None)
        return self.create_publisher(MESSAGE_TYPES[topic], topic, OUTPUT_QOS, event_callbacks=events,
                                     qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def _subscribe(self, message_type, topic, callback):
        events = SubscriptionEventCallbacks(use_default_callbacks=False,
                                            incompatible_qos=self._on_bad_qos(topic))
        return self.create_subscription(message_type, topic, callback, SENSOR_QOS, raw=True,
                                        event_callbacks=events, callback_group=self._sensor_group,
                                        qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def _subscribe_altimeters(self):
        """Return (subscription, callback) of each altimeter that may be used."""
        subscriptions = []
        chosen = self._params.altitude_source
        for name, ros_type, message_type in (("altitude", PointStamped, POINT),
                                             ("pressure", FluidPressure, PRESSURE)):
            if chosen in ("auto", name):
                take = self._altitude_callback(name, message_type, AltitudeSource(message_type))
                subscriptions.append((self._subscribe(ros_type, name, take), take))
        return subscriptions

    def _on_bad_qos(self, topic):
        def told(info):
            policy = qos_policy_name_from_kind(info.last_policy_kind)
            self._fault("incompatible_qos", f"{topic}: a peer's {policy} does not fit; nothing gets through",
                        Level.ERROR)
        return told

    def _now_ns(self):
        # get_clock().now() makes an object around the same number at several times the cost.
        return self.get_clock().handle.get_now().nanoseconds

    # --- input

    def _take_imu(self, raw):
        """Outermost guard of the IMU: whatever is wrong with one message, the next one is served."""
        arrival_ns = self._now_ns()
        self._counts["imu_messages"] += 1
        try:
            stamp_ns, frame_id, values = decode(IMU, raw)
            if self._accept_stamp(stamp_ns):
                stamp_ns = self._gate.stamp_ns
                self._meter.add(stamp_ns, arrival_ns)
                self._step(stamp_ns, frame_id, values)
        except MalformedMessageError as error:
            self._fault("malformed", f"imu/data_raw: {error}", Level.WARN)
        except Exception as error:
            self._fault("exception", f"imu/data_raw: {type(error).__name__}: {error}", Level.ERROR)

    def _accept_stamp(self, stamp_ns):
        code = self._gate.check(stamp_ns)
        if code == StampCode.JUMP_BACK:
            self.get_logger().warning("stamps went back (a bag's loop, a clock set?): the filter starts anew")
            self._reset()
        elif code == StampCode.NO_STAMP:
            self._fault("no_stamp", "imu/data_raw: no valid stamp, and no fixed_dt to stand in", Level.ERROR)
        return code < StampCode.DUPLICATE

    def _step(self, stamp_ns, frame_id, values):
        self._look_at(stamp_ns, values)
        gyro_b = swap_flu_frd(values[GYRO])
        accel_b = swap_flu_frd(values[ACCEL])
        if self._stored is not None:
            start_with_stored(self._estimator, self._stored, stamp_ns)
            self._stored = None
        if self._estimator.add_imu(stamp_ns, gyro_b, accel_b):
            self._publish(stamp_ns, frame_id)

    def _look_at(self, stamp_ns, values):
        """Judge what is in a message besides the sample, and whether the sample is in the right unit."""
        self._check.add(stamp_ns, values[GYRO], values[ACCEL])
        period_ns = self._gate.period_ns
        if period_ns and self._noise.take(values[GYRO_COVARIANCE], values[ACCEL_COVARIANCE]):
            self._estimator.params = self._noise.applied(self._params, period_ns * 1e-9)
        if self._noise.invalid:
            self._fault("covariance_invalid", "imu/data_raw: a covariance is -1, negative or asymmetric and does not "
                        "count", Level.WARN)

    def _altitude_callback(self, name, message_type, source):
        def take(raw):
            arrival_ns = self._now_ns()
            self._counts[f"{name}_messages"] += 1
            self._altimeter_heard[name] = arrival_ns
            try:
                stamp_ns, _, values = decode(message_type, raw)
                if stamp_ns <= 0:
                    self._fault("altitude_no_stamp", f"{name}: no valid stamp", Level.ERROR)
                    return
                altitude, variance = source.convert(values)
                self._altitude_meter.add(stamp_ns, arrival_ns)
                if self._use_altitude and not self._two_altimeters(arrival_ns):
                    self._estimator.add_altitude(stamp_ns, altitude, variance)
            except AltitudeRefusedError as error:
                self._fault(error.fault, f"{name}: {error}", Level.ERROR)
            except MalformedMessageError as error:
                self._fault("malformed", f"{name}: {error}", Level.WARN)
            except Exception as error:
                self._fault("exception", f"{name}: {type(error).__name__}: {error}", Level.ERROR)
        return take

    def _two_altimeters(self, now_ns):
        heard = self._altimeter_heard.values()
        both = len(heard) == 2 and now_ns - min(heard) < TWO_ALTIMETERS_NS
        if both:
            self._fault("two_altimeters", "altitude and pressure are both published: choose one by "
                        "altitude_source; neither is used", Level.ERROR)
        return both

    # --- output

    def _publish(self, stamp_ns, frame_id):
        estimate = self._estimator.estimate
        if frame_id != self._frame:
            self._set_frame(frame_id)
        slot = self._params.auxiliary_slot(stamp_ns)
        auxiliary, self._slot = slot != self._slot, slot
        for topic, publisher in self._outputs.items():
            if topic != "imu/data" and not (auxiliary and self._subscribers.get(topic)):
                continue
            if topic == "imu/rpy/filtered" and not estimate.valid:
                continue
            values = self._messages.values(topic, estimate)
            publisher.publish(self._encoders[topic].encode(stamp_ns, values))
        if self._tf is not None and estimate.valid:
            self._send_transform(stamp_ns, estimate)

    def _set_frame(self, frame_id):
        if not frame_id:
            self._fault("frame_id_empty", "imu/data_raw: frame_id is empty, so nobody knows whose axes these are",
                        Level.ERROR)
        if self._frame is not None:
            self._fault("frame_id_changed", f"imu/data_raw: frame_id was {self._frame!r} and is {frame_id!r}: two IMUs "
                        "on one topic?", Level.ERROR)
        self._frame = frame_id
        self._encoders = {topic: StampedEncoder(message_type, *self._params.frames(topic, frame_id))
                          for topic, message_type in OUTPUT_TYPES.items()}

    def _send_transform(self, stamp_ns, estimate):
        transform = TransformStamped()
        transform.header.stamp.sec, transform.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        transform.header.frame_id = self._params.world_frame
        transform.child_frame_id = self._params.base_frame or self._frame
        x, y, z, w = self._messages.values("imu/data", estimate)[ORIENTATION].tolist()
        rotation = transform.transform.rotation
        rotation.x, rotation.y, rotation.z, rotation.w = x, y, z, w
        self._tf.sendTransform(transform)

    # --- services and parameters

    def _apply(self, params):
        self._params = params
        self._estimator.params = self._noise.applied(params, self._gate.period_ns * 1e-9)
        self._gate.set_params(params)
        self._messages = OutputMessages(params.mounting_rpy)
        self._check.up_imu = self._messages.up_imu

    def _reset(self):
        self._estimator.reset()
        self._resets += 1

    def _on_reset(self, _request, response):
        self._reset()
        response.success, response.message = True, "starts anew"
        return response

    def _on_level(self, _request, response):
        estimate = self._estimator.estimate
        if not estimate.valid:
            response.success, response.message = False, "there is no attitude yet"
            return response
        rpy = self._messages.level(estimate)
        (result,) = self.set_parameters([Parameter("mounting_rpy", value=list(rpy))])
        response.success = result.successful
        response.message = result.reason or f"mounting_rpy: [{rpy[0]:.6f}, {rpy[1]:.6f}, {rpy[2]:.6f}]"
        return response

    def _on_use_altitude(self, request, response):
        self._use_altitude = request.data
        response.success, response.message = True, "altitude " + ("used" if request.data else "not used")
        return response

    # --- diagnostics

    def _fault(self, name, text, level):
        """Count a fault and remember it for the next report; log its 1st, 10th, 100th, ... time."""
        self._counts[name] += 1
        self._last_fault[name] = (level, text)
        count = self._counts[name]
        if count == 10 ** round(math.log10(count)):
            told = text if count == 1 else f"{text} ({count} times)"
            # Two calls: rclpy refuses one that logs with a severity and later with another.
            if level == Level.ERROR:
                self.get_logger().error(told)
            else:
                self.get_logger().warning(told)

    def _watch(self):
        """Report once a second, and at once when the IMU falls silent or comes back."""
        now_ns = self._now_ns()
        self._subscribers = {topic: publisher.get_subscription_count()
                             for topic, publisher in self._outputs.items()}
        silent = self._silence(now_ns) > 0.0
        self._watches += 1
        if self._watches % WATCHES_PER_STORE == 0:
            self._store_biases()
        if self._watches % WATCHES_PER_REPORT == 0 or silent != self._silent:
            self._silent = silent
            self._diagnostics.publish(diagnostic_array(now_ns, [self._report(now_ns)]))

    def _silence(self, now_ns):
        """Seconds since the last IMU message if they are too many, otherwise 0."""
        age, rate = self._meter.age(now_ns), self._meter.stamp_rate
        limit = SILENCE if math.isnan(rate) else max(SILENCE, SILENT_PERIODS / rate)
        return age if age > limit else 0.0

    def _report(self, now_ns):
        report = Report(f"{self.get_fully_qualified_name().lstrip('/')}: attitude", self._frame or "")
        self._report_imu(report, now_ns)
        self._report_altimeter(report, now_ns)
        self._report_faults(report)
        self._report_state(report)
        return report

    def _report_state(self, report):
        estimate = self._estimator.estimate
        if not estimate.valid:
            self._found = None
            report.value("state", "INITIALISING")
            report.fault(Level.WARN, f"INITIALISING: {self._estimator.waiting_for}")
            return
        report.value("state", "attitude known")
        report.value("tilt_sigma_deg", math.degrees(math.sqrt(np.trace(estimate.tilt_covariance_n))))
        starts = self._resets, self._estimator.faults.restarted
        if self._found is None or self._found[0] != starts:
            self._found = starts, int(estimate.stamp_ns), self._check.standing
        _, found_ns, standing = self._found
        if not standing and estimate.stamp_ns - found_ns < FOUND_MOVING_NS:
            report.fault(Level.WARN, "the attitude was found in motion: it may be far off for a minute")

    def _report_imu(self, report, now_ns):
        report.value("imu_rate_hz", self._meter.stamp_rate)
        report.value("imu_arrival_rate_hz", self._meter.arrival_rate)
        report.value("latency_p50_s", self._meter.latency(0.5))
        report.value("latency_p99_s", self._meter.latency(0.99))
        age = self._meter.age(now_ns)
        if math.isnan(age):
            report.fault(Level.STALE, "no usable imu/data_raw yet")
            return
        silence = self._silence(now_ns)
        if silence:
            report.fault(Level.ERROR, f"imu/data_raw stopped {silence:.1f} s ago")
        publishers = self.sensors[-1][0].handle.get_publisher_count()
        if publishers > 1:
            report.fault(Level.WARN, f"imu/data_raw has {publishers} publishers")
        for text in self._check.faults.values():
            report.fault(Level.ERROR, f"imu/data_raw: {text}")
        clock = self._gate.clock_fault(self._gate.stamp_ns + round(age * 1e9), now_ns)
        if clock:
            report.fault(Level.WARN, clock)

    def _report_altimeter(self, report, now_ns):
        report.value("altitude_rate_hz", self._altitude_meter.stamp_rate)
        report.value("use_altitude", self._use_altitude)
        if self._params.altitude_source == "none" or not self._use_altitude:
            return
        age = self._altitude_meter.age(now_ns)
        if math.isnan(age):
            report.fault(Level.WARN, "no altitude yet: the IMU alone, with a larger covariance")
        elif age > ALTITUDE_SILENCE:
            report.fault(Level.WARN, f"altitude stopped {age:.1f} s ago: the IMU alone")

    def _report_faults(self, report):
        """Counters of everything refused; what is new since the last report is a fault of this one."""
        gate = {name: self._gate.counts[code] for name, code in (
            ("duplicate_stamp", StampCode.DUPLICATE), ("backward_stamp", StampCode.BACKWARD),
            ("no_stamp", StampCode.NO_STAMP), ("gap", StampCode.GAP), ("long_gap", StampCode.LONG_GAP),
            ("stamp_jump_back", StampCode.JUMP_BACK))}
        faults = vars(self._estimator.faults)
        # What is refused here never reaches the estimator, whose counter of that name stays zero.
        report.counters(faults | dict(self._counts) | gate)
        for level, text in self._last_fault.values():
            report.fault(level, text)
        self._last_fault.clear()
        samples = max(self._counts["imu_messages"], 1)
        refused = sum(faults[name] for name in ("gyro_not_finite", "gyro_out_of_range", "accel_not_finite",
                                                "accel_out_of_range", "accel_zero"))
        if refused:
            level = Level.ERROR if refused > ERROR_SHARE * samples else Level.WARN
            report.fault(level, f"{refused} of {samples} IMU samples not finite, out of range or all zero")
        if faults["stuck"]:
            level = Level.ERROR if faults["stuck"] > STUCK_ERROR_SAMPLES else Level.WARN
            report.fault(level, "the IMU repeats one sample: stuck?")
        if self._gate.interleaved:
            report.fault(Level.ERROR, "imu/data_raw: stamps go back and forth: two publishers?")
        if self._estimator.free_fall:
            report.fault(Level.WARN, "the force is too small to show gravity")


def main():
    """Run the node until it is interrupted or shut down; return its exit status."""
    return run_sensor_node("attitude_node", AttitudeNode)


if __name__ == "__main__":
    sys.exit(main())
