"""navigation_node: an IMU and what aids it in, position, velocity and attitude out.

Topics, services and parameters: README; what it does: docs/navigation.md. Every IMU message is answered at once
with the estimate at its stamp; each aid counts at its own stamp, also when it comes late.
"""

import math
import sys

from geometry_msgs.msg import (
    PointStamped,
    PoseWithCovarianceStamped,
    QuaternionStamped,
    TwistWithCovarianceStamped,
    Vector3Stamped,
)
from nav_msgs.msg import Odometry
from sensor_msgs.msg import FluidPressure, Imu, NavSatFix
from std_srvs.srv import Trigger

from attitude_estimator.edge import biases_to_store
from attitude_estimator.navigation.edge import (
    COASTING_AFTER,
    INPUTS,
    NavigationNodeParams,
    NavigationOutput,
    NavigationSession,
)
from attitude_estimator.navigation.estimator import NavigationEstimator
from nav_ros.diagnostics import Level
from nav_ros.messages import POSE_ORIENTATION, POSE_POSITION
from nav_ros.parameters import on_change
from nav_ros.sensor_loop import run_sensor_node
from nav_ros.sensor_node import SensorNode
from nav_ros.time_gate import TimeGate

INPUT_TYPES = {"altitude": PointStamped, "pressure": FluidPressure, "fix": NavSatFix,
               "velocity": TwistWithCovarianceStamped, "inclinometer": QuaternionStamped,
               "heading": PoseWithCovarianceStamped}
OUTPUT_TYPES = {"imu/data": Imu, "odometry": Odometry, "imu/gyro_bias": Vector3Stamped,
                "imu/accel_bias": Vector3Stamped}
IMU_SILENCE, AID_SILENCE = 0.2, 2.0  # s without a message after which each has stopped
IMU_FAULTS = ("gyro_not_finite", "accel_not_finite", "gyro_out_of_range", "accel_out_of_range", "accel_zero")
ERROR_SHARE = 0.01  # of IMU samples with such a fault


class NavigationNode(SensorNode):
    """See the module."""

    def __init__(self):
        super().__init__("navigation_node", NavigationNodeParams)
        self.prepare(self._warm_up)
        self._session = NavigationSession(self.params, self.fault)
        path = self.params.bias_file
        self._session.stored = self.keep_biases(path, self._newest_biases) if path else None
        self._answers = NavigationOutput(self._session)
        self._transforms = self.transforms() if self.params.publish_tf else None
        self._origin, self._told = None, {}
        on_change(self, self.params, self._apply)
        for topic, kind in OUTPUT_TYPES.items():
            self.advertise(kind, topic)
        self.create_service(Trigger, "~/reset", self._on_reset)
        for name in INPUTS[:-1]:
            if name not in ("altitude", "pressure") or self.params.altitude_source in ("auto", name):
                self.add_sensor(INPUT_TYPES[name], name, self._taking(name), patience=AID_SILENCE)
        self.add_sensor(Imu, "imu/data_raw", self._take_imu, needed=True, patience=IMU_SILENCE)
        self.begin()

    def _warm_up(self):
        NavigationEstimator(self.params).warm_up()
        TimeGate(self.params).check(1)

    def _newest_biases(self):
        estimate = self._session.estimator.estimate
        return biases_to_store(estimate) if estimate.valid else None

    def _taking(self, name):
        """Return what takes a serialized message of an input."""
        def take(raw):
            self._session.take(name, raw)
            return self._session.stamp_ns
        return take

    def _take_imu(self, raw):
        if self._session.take("imu", raw):
            for topic, serialized in self._answers.messages(self.wanted):
                self.outputs[topic].publish(serialized)
            if self._transforms is not None and self._session.estimator.estimate.navigating:
                self._send_transform()
        return self._session.stamp_ns

    def _send_transform(self):
        estimate = self._session.estimator.estimate
        pose = self._session.messages.values("odometry", estimate)
        self._transforms.send(int(estimate.stamp_ns), self.params.world_frame,
                              self.params.base_frame or self._session.frame, pose[POSE_ORIENTATION],
                              pose[POSE_POSITION])

    def _apply(self, params):
        self.params = self._session.params = params

    def _on_reset(self, _request, response):
        self._session.reset()
        response.success, response.message = True, "starts anew; the origin is the first fix that the next one confirms"
        return response

    # --- diagnostics

    def make_report(self, now_ns):
        """Return the report: state, IMU, aids, everything refused."""
        self._tell_origin()
        report = self.new_report(now_ns, "navigation", self._session.frame or "")
        self._report_state(report)
        self.report_imu(report, self._session.gate, self._session.check, now_ns)
        self._report_aids(report)
        self._report_faults(report)
        return report

    def _tell_origin(self):
        origin = self._session.estimator.origin
        if origin != self._origin and origin is not None:
            latitude, longitude, height = origin
            self.get_logger().info(f"origin at {math.degrees(latitude):.7f} deg north, "
                                   f"{math.degrees(longitude):.7f} deg east, {height:.2f} m")
        self._origin = origin

    def _report_state(self, report):
        session, estimate = self._session, self._session.estimator.estimate
        report.value("phase", session.phase)
        if not estimate.valid or not estimate.navigating:
            report.fault(Level.WARN, f"waiting for {session.estimator.waiting_for}")
        elif session.since_aided > COASTING_AFTER:
            report.fault(Level.WARN, f"coasting: no fix and no velocity used for {session.since_aided:.1f} s")
        if session.estimator.free_fall:
            report.fault(Level.WARN, "the force is too small to show gravity")
        for name, value in session.spread().items():
            report.value(name, value)
        if session.estimator.origin is not None:
            latitude, longitude, height = session.estimator.origin
            report.value("origin_latitude_deg", f"{math.degrees(latitude):.9f}")
            report.value("origin_longitude_deg", f"{math.degrees(longitude):.9f}")
            report.value("origin_height_m", f"{height:.3f}")

    def _report_aids(self, report):
        """NIS and age of each aid that there has been."""
        for name, health in self._session.estimator.health.items():
            if health.used + health.refused:
                report.value(f"{name}_nis", health.nis)
                report.value(f"{name}_used", health.used)
                report.value(f"{name}_age_s", health.age if math.isfinite(health.age) else math.nan)

    def _report_faults(self, report):
        """Counters of everything refused; what is new since the last report is a fault of this one."""
        faults, samples = self._session.faults, max(self._session.counts["imu_messages"], 1)
        often = sum(faults[name] for name in IMU_FAULTS) > ERROR_SHARE * samples
        for name, count in faults.items():
            new = count - self._told.get(name, 0)
            if new > 0:
                report.fault(Level.ERROR if often and name in IMU_FAULTS else Level.WARN, f"{name}: {new} more")
        self._told = faults
        report.counters(faults | self.counts)


def main():
    """Run the node until it is interrupted or shut down; return its exit status."""
    return run_sensor_node("navigation_node", NavigationNode, NavigationNodeParams, __doc__)


if __name__ == "__main__":
    sys.exit(main())
