"""alignment_node: an IMU at rest in, level and true heading out; on a turntable or in a standing vehicle.

Topics, services and parameters: README; what it does: docs/alignment.md. The node drives nothing. Of a table it
says which angle it wants, in the status, on ``table/command`` and by ``~/next_position``, and takes every dwell
by the joint's own stamps.
"""

import difflib
import math
import sys
from collections import Counter
from dataclasses import replace

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, Vector3Stamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Imu, JointState, NavSatFix, NavSatStatus
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from alignment.edge import (
    UNKNOWN_VARIANCE,
    AlignmentNodeParams,
    JointError,
    attitude_values,
    imu_sample,
    joint_sample,
    level_values,
    yaw_of,
)
from alignment.views import open_view
from nav_ros.diagnostics import Level, Report, StreamMeter, diagnostic_array
from nav_ros.messages import IMU, VECTOR, MalformedMessageError, StampedEncoder
from nav_ros.parameters import declare_parameters, on_change, parameter_names
from nav_ros.sensor_loop import SensorGroup, run_sensor_node

SENSOR_QOS = QoSProfile(depth=1000, history=HistoryPolicy.KEEP_LAST,
                        reliability=ReliabilityPolicy.BEST_EFFORT)
OUTPUT_QOS = QoSProfile(depth=100, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
REPORT_PERIOD = 1.0  # s
SILENCE = 1.0  # s without a message after which a sensor has stopped
JUMP_BACK_NS = 500_000_000  # stamps that go back further begin a new alignment


class AlignmentNode(Node):
    """See the module."""

    def __init__(self):
        super().__init__("alignment_node")
        self._params = declare_parameters(self, AlignmentNodeParams)
        self._view = open_view(self._params)
        self._session = self._view.session
        self._fixed_latitude = not math.isnan(self._params.latitude)
        self._counts, self._last_fault = Counter(), {}
        takes = {"imu": (Imu, "imu/data_raw", self._take_imu),
                 "joints": (JointState, "joint_states", self._take_joint)}
        sensors = [takes[key] for key in self._view.inputs]
        self._meters = {topic: StreamMeter() for _, topic, _ in sensors}
        self._stamp_ns = dict.fromkeys(self._meters, 0)
        self._slot = None
        self._encoders = {"alignment/level": StampedEncoder(VECTOR, self._params.base_frame),
                          "alignment/attitude": StampedEncoder(IMU, self._params.base_frame)}
        on_change(self, self._params, self._apply, check=self._view.check)
        self._level, self._attitude, self._heading, self._status, self._command = (
            self.create_publisher(kind, topic, OUTPUT_QOS) for kind, topic in (
                (Vector3Stamped, "alignment/level"), (Imu, "alignment/attitude"),
                (PoseWithCovarianceStamped, "alignment/heading"), (DiagnosticStatus, "alignment/status"),
                (Float64, "table/command")))
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        for name in ("start", "stop", "reset", "next_position"):
            self.create_service(Trigger, f"~/{name}", getattr(self, f"_on_{name}"))
        self.create_timer(REPORT_PERIOD, self._report)
        self._sensor_group = SensorGroup()
        self.sensors = [self._subscribe(*sensor) for sensor in sensors]
        self.create_subscription(NavSatFix, "fix", self._on_fix, SENSOR_QOS)
        self._tell_unknown_parameters()
        self.get_logger().info("ready")

    def _tell_unknown_parameters(self):
        """Warn of parameters that were given but are nobody's; rclpy drops them without a word."""
        for name in self._parameter_overrides:
            if not self.has_parameter(name):
                (near,) = difflib.get_close_matches(name, parameter_names(AlignmentNodeParams), 1, 0.0)
                self.get_logger().warning(f"there is no parameter {name}; did you mean {near}?")

    def _subscribe(self, kind, topic, take):
        """Return a subscription of serialized messages and what serves one of them."""
        def guarded(raw):
            """Outermost guard: whatever is wrong with one message, the next one is served."""
            try:
                take(raw)
            except MalformedMessageError as error:
                self._fault("malformed", f"{topic}: {error}", Level.WARN)
            except JointError as error:
                self._fault("joint_missing", f"{topic}: {error}", Level.ERROR)
            except Exception as error:
                self._fault("exception", f"{topic}: {type(error).__name__}: {error}", Level.ERROR)

        def incompatible(info):
            policy = qos_policy_name_from_kind(info.last_policy_kind)
            self._fault("incompatible_qos", f"{topic}: a peer's {policy} does not fit; nothing gets through",
                        Level.ERROR)

        events = SubscriptionEventCallbacks(use_default_callbacks=False, incompatible_qos=incompatible)
        subscription = self.create_subscription(
            kind, topic, guarded, SENSOR_QOS, raw=True, event_callbacks=events,
            callback_group=self._sensor_group,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        return subscription, guarded

    def _now_ns(self):
        return self.get_clock().now().nanoseconds

    # --- input

    def _take_imu(self, raw):
        stamp_ns, gyro_b, accel_b = imu_sample(raw)
        if self._accept("imu/data_raw", stamp_ns):
            self._tell(self._session.add_imu(stamp_ns, gyro_b, accel_b), stamp_ns)

    def _take_joint(self, raw):
        stamp_ns, angle = joint_sample(raw, self._params.joint_name)
        if self._accept("joint_states", stamp_ns):
            self._tell(self._session.add_joint(stamp_ns, angle), self._stamp_ns["imu/data_raw"])

    def _accept(self, topic, stamp_ns):
        """Count a message and return whether its stamp is one that follows the last."""
        last_ns = self._stamp_ns[topic]
        if stamp_ns <= 0:
            self._fault("no_stamp", f"{topic}: no valid stamp", Level.ERROR)
            return False
        if last_ns - JUMP_BACK_NS < stamp_ns <= last_ns:
            self._fault("stamp_not_later", f"{topic}: a stamp is not later than the one before", Level.WARN)
            return False
        if stamp_ns < last_ns:
            self.get_logger().warning(
                "stamps went back (a bag's loop, a clock set?): the alignment starts anew")
            self._counts["stamp_jump_back"] += 1
            self._session.reset()
            self._stamp_ns = dict.fromkeys(self._stamp_ns, 0)
        self._stamp_ns[topic] = stamp_ns
        self._meters[topic].add(stamp_ns, self._now_ns())
        return True

    def _on_fix(self, fix):
        if self._fixed_latitude:
            return
        latitude = math.radians(fix.latitude)
        if fix.status.status == NavSatStatus.STATUS_NO_FIX or not abs(latitude) <= 0.5 * math.pi:
            self._fault("no_fix", "fix: no position in it", Level.WARN)
        elif not abs(latitude - self._session.params.latitude) <= self._params.latitude_std:
            self.get_logger().info(f"latitude {fix.latitude:.5f} deg from fix")
            self._session.params = replace(self._params, latitude=latitude)

    # --- output

    def _tell(self, changed, stamp_ns):
        """Publish what is known at the output's rate, and at once when it has changed."""
        for good, text in self._session.take_remarks():
            if good:
                self.get_logger().info(text)
            else:
                self._fault(self._view.setback, text, Level.WARN)
        slot = stamp_ns // round(1e9 / self._params.output_rate)
        if stamp_ns and (changed or slot != self._slot):
            self._slot = slot
            self._publish(stamp_ns)
        if changed:
            self._publish_command()
            self._status.publish(self._status_message())

    def _publish(self, stamp_ns):
        solution = self._view.solution
        if solution is not None and solution.stamp_ns is not None:
            stamp_ns = solution.stamp_ns
        encoder = self._encoders["alignment/attitude"]
        self._attitude.publish(encoder.encode(stamp_ns, attitude_values(solution)))
        if solution is None:
            return
        self._level.publish(self._encoders["alignment/level"].encode(stamp_ns, level_values(solution)))
        if solution.believable:
            self._heading.publish(self._heading_message(stamp_ns, solution))

    def _heading_message(self, stamp_ns, solution):
        message = PoseWithCovarianceStamped()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        message.header.frame_id = self._params.world_frame
        yaw = yaw_of(solution)
        orientation = message.pose.pose.orientation
        orientation.z, orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        variances = [UNKNOWN_VARIANCE] * 5 + [solution.heading_var]
        message.pose.covariance = np.diag(variances).ravel()
        return message

    def _publish_command(self):
        joint = self._view.wanted_joint
        if joint is not None:
            self._command.publish(Float64(data=joint))

    # --- services and parameters

    def _apply(self, params):
        latitude = self._session.params.latitude if math.isnan(params.latitude) else params.latitude
        self._params = params
        self._fixed_latitude = not math.isnan(params.latitude)
        self._session.params = replace(params, latitude=latitude)

    def _on_start(self, _request, response):
        self._session.start()
        return self._answer(response, f"aligns; {self._view.next_step}")

    def _on_stop(self, _request, response):
        changed = self._session.stop()
        self._tell(changed, self._stamp_ns["imu/data_raw"])
        return self._answer(response, f"stopped after {self._view.gathered}")

    def _on_reset(self, _request, response):
        self._session.reset()
        return self._answer(response, f"starts anew; {self._view.next_step}")

    def _on_next_position(self, _request, response):
        return self._answer(response, self._view.next_step, self._session.running)

    def _answer(self, response, text, success=True):
        self._publish_command()
        response.success, response.message = success, text
        return response

    # --- diagnostics

    def _fault(self, name, text, level):
        """Count a fault and remember it for the next report; log its 1st, 10th, 100th, ... time."""
        self._counts[name] += 1
        self._last_fault[name] = (level, text)
        count = self._counts[name]
        if count == 10 ** round(math.log10(count)) or name == self._view.setback:
            told = text if count == 1 else f"{text} ({count} times)"
            # Two calls: rclpy refuses one that logs with a severity and later with another.
            if level == Level.ERROR:
                self.get_logger().error(told)
            else:
                self.get_logger().warning(told)

    def _report(self):
        report = self._make_report()
        now_ns = self._now_ns()
        self._status.publish(diagnostic_array(now_ns, [report]).status[0])
        self._diagnostics.publish(diagnostic_array(now_ns, [report]))
        self._last_fault.clear()
        self._publish_command()

    def _status_message(self):
        return diagnostic_array(0, [self._make_report()]).status[0]

    def _make_report(self):
        report = Report(f"{self.get_fully_qualified_name().lstrip('/')}: alignment", self._params.base_frame)
        for key, value in (self._view.status() | self._view.activity()).items():
            report.value(key, value)
        report.value("latitude_deg", math.degrees(self._session.params.latitude))
        report.counters(self._counts)
        self._report_streams(report, self._now_ns())
        if self._session.refusal:
            report.fault(Level.ERROR if self._view.bad_input else Level.WARN,
                         f"no heading: {self._session.refusal}")
        for level, text in self._last_fault.values():
            report.fault(level, text)
        return report

    def _report_streams(self, report, now_ns):
        for topic, meter in self._meters.items():
            report.value(f"{topic.partition('/')[0].partition('_')[0]}_rate_hz", meter.stamp_rate)
            age = meter.age(now_ns)
            if math.isnan(age):
                report.fault(Level.STALE, f"no usable {topic} yet")
            elif age > SILENCE:
                report.fault(Level.ERROR, f"{topic} stopped {age:.1f} s ago")


def main():
    """Run the node until it is interrupted or shut down; return its exit status."""
    return run_sensor_node("alignment_node", AlignmentNode)


if __name__ == "__main__":
    sys.exit(main())
