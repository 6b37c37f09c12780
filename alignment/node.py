"""alignment_node: an IMU at rest in, level and true heading out; on a turntable or in a standing vehicle.

Topics, services and parameters: README; what it does: docs/alignment.md. The node drives nothing. Of a table it
says which angle it wants, in the status, on ``table/command`` and by ``~/next_position``, and takes every dwell
by the joint's own stamps.
"""

import math
import sys
from dataclasses import replace

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, Vector3Stamped
from sensor_msgs.msg import Imu, JointState, NavSatFix
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from alignment.edge import (
    AlignmentNodeParams,
    attitude_values,
    imu_sample,
    joint_sample,
    level_values,
    yaw_of,
)
from alignment.views import open_view
from nav_ros.diagnostics import Level, diagnostic_array
from nav_ros.messages import (
    IMU,
    NO_FIX,
    UNKNOWN_VARIANCE,
    VECTOR,
    RefusedMessageError,
    StampedEncoder,
    decode_fix,
)
from nav_ros.parameters import on_change
from nav_ros.sensor_loop import run_sensor_node
from nav_ros.sensor_node import SensorNode

OUTPUT_TYPES = {"alignment/level": Vector3Stamped, "alignment/attitude": Imu,
                "alignment/heading": PoseWithCovarianceStamped, "alignment/status": DiagnosticStatus,
                "table/command": Float64}
SILENCE = 1.0  # s without a message after which a sensor has stopped
JUMP_BACK_NS = 500_000_000  # stamps that go back further begin a new alignment


class AlignmentNode(SensorNode):
    """See the module."""

    def __init__(self):
        super().__init__("alignment_node", AlignmentNodeParams)
        self._view = self.prepare(lambda: open_view(self.params))
        self._session = self._view.session
        self._fixed_latitude = not math.isnan(self.params.latitude)
        self._slot, self._stamp_ns = None, {"imu/data_raw": 0, "joint_states": 0}
        self._encoders = {"alignment/level": StampedEncoder(VECTOR, self.params.base_frame),
                          "alignment/attitude": StampedEncoder(IMU, self.params.base_frame)}
        on_change(self, self.params, self._apply, check=self._view.check)
        for topic, kind in OUTPUT_TYPES.items():
            self.advertise(kind, topic, qos_told=False)
        for name in ("start", "stop", "reset", "next_position"):
            self.create_service(Trigger, f"~/{name}", getattr(self, f"_on_{name}"))
        takes = {"imu": (Imu, "imu/data_raw", self._take_imu),
                 "joints": (JointState, "joint_states", self._take_joint)}
        self.add_sensor(NavSatFix, "fix", self._take_fix, patience=math.inf)
        for key in self._view.inputs:
            self.add_sensor(*takes[key], needed=True, patience=SILENCE)
        self.begin()

    # --- input

    def _take_imu(self, raw):
        stamp_ns, gyro_b, accel_b = imu_sample(raw)
        self._follow("imu/data_raw", stamp_ns)
        self._tell(self._session.add_imu(stamp_ns, gyro_b, accel_b), stamp_ns)
        return stamp_ns

    def _take_joint(self, raw):
        stamp_ns, angle = joint_sample(raw, self.params.joint_name)
        self._follow("joint_states", stamp_ns)
        self._tell(self._session.add_joint(stamp_ns, angle), self._stamp_ns["imu/data_raw"])
        return stamp_ns

    def _follow(self, topic, stamp_ns):
        """Insist on a stamp that follows the last; one far back begins a new alignment."""
        last_ns = self._stamp_ns[topic]
        if stamp_ns <= 0:
            raise RefusedMessageError("no_stamp", "no valid stamp")
        if last_ns - JUMP_BACK_NS < stamp_ns <= last_ns:
            raise RefusedMessageError("stamp_not_later", "a stamp is not later than the one before", Level.WARN)
        if stamp_ns < last_ns:
            self.get_logger().warning("stamps went back (a bag's loop, a clock set?): the alignment starts anew")
            self.counts["stamp_jump_back"] += 1
            self._session.reset()
            self._stamp_ns = dict.fromkeys(self._stamp_ns, 0)
        self._stamp_ns[topic] = stamp_ns

    def _take_fix(self, raw):
        stamp_ns, fix = decode_fix(raw)
        latitude = math.radians(fix.latitude_deg)
        if fix.status == NO_FIX or not abs(latitude) <= 0.5 * math.pi:
            raise RefusedMessageError("no_fix", "no position in it", Level.WARN)
        if not (self._fixed_latitude or abs(latitude - self._session.params.latitude) <= self.params.latitude_std):
            self.get_logger().info(f"latitude {fix.latitude_deg:.5f} deg from fix")
            self._session.params = replace(self.params, latitude=latitude)
        return stamp_ns

    # --- output

    def _tell(self, changed, stamp_ns):
        """Publish what is known at the output's rate, and at once when it has changed."""
        for good, text in self._session.take_remarks():
            if good:
                self.get_logger().info(text)
            else:
                self.fault(self._view.setback, text, Level.WARN, always=True)
        slot = stamp_ns // round(1e9 / self.params.output_rate)
        if stamp_ns and (changed or slot != self._slot):
            self._slot = slot
            self._publish(stamp_ns)
        if changed:
            self._publish_command()
            now_ns = self.now_ns()
            self._publish_status(self.make_report(now_ns), now_ns)

    def _publish(self, stamp_ns):
        solution = self._view.solution
        if solution is not None and solution.stamp_ns is not None:
            stamp_ns = solution.stamp_ns
        self._publish_encoded("alignment/attitude", stamp_ns, attitude_values(solution))
        if solution is None:
            return
        self._publish_encoded("alignment/level", stamp_ns, level_values(solution))
        if solution.believable:
            self.outputs["alignment/heading"].publish(self._heading_message(stamp_ns, solution))

    def _publish_encoded(self, topic, stamp_ns, values):
        self.outputs[topic].publish(self._encoders[topic].encode(stamp_ns, values))

    def _heading_message(self, stamp_ns, solution):
        message = PoseWithCovarianceStamped()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        message.header.frame_id = self.params.world_frame
        yaw = yaw_of(solution)
        orientation = message.pose.pose.orientation
        orientation.z, orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        variances = [UNKNOWN_VARIANCE] * 5 + [solution.heading_var]
        message.pose.covariance = np.diag(variances).ravel()
        return message

    def _publish_command(self):
        joint = self._view.wanted_joint
        if joint is not None:
            self.outputs["table/command"].publish(Float64(data=joint))

    # --- services and parameters

    def _apply(self, params):
        latitude = self._session.params.latitude if math.isnan(params.latitude) else params.latitude
        self.params = params
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

    def send_report(self, now_ns):
        """Publish a report, also as the status, and the joint's position that is wanted."""
        report = super().send_report(now_ns)
        self._publish_status(report, now_ns)
        self._publish_command()
        return report

    def _publish_status(self, report, now_ns):
        self.outputs["alignment/status"].publish(diagnostic_array(now_ns, [report]).status[0])

    def make_report(self, now_ns):
        """Return the report: what is known, what is going on, why there is no heading, everything refused."""
        report = self.new_report(now_ns, "alignment", self.params.base_frame)
        for key, value in (self._view.status() | self._view.activity()).items():
            report.value(key, value)
        report.value("latitude_deg", math.degrees(self._session.params.latitude))
        report.counters(self.counts)
        if self._session.refusal:
            report.fault(Level.ERROR if self._view.bad_input else Level.WARN,
                         f"no heading: {self._session.refusal}")
        return report


def main():
    """Run the node until it is interrupted or shut down; return its exit status."""
    return run_sensor_node("alignment_node", AlignmentNode, AlignmentNodeParams, __doc__)


if __name__ == "__main__":
    sys.exit(main())
