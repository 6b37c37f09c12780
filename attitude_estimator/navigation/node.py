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

from attitude_estimator.navigation.edge import (
    COASTING_AFTER,
    INPUTS,
    NavigationNodeParams,
    NavigationOutput,
    NavigationSession,
)
from attitude_estimator.navigation.estimator import NavigationEstimator
from nav_ros.diagnostics import Level, StreamMeter
from nav_ros.parameters import on_change
from nav_ros.sensor_loop import run_sensor_node
from nav_ros.sensor_node import SensorNode
from nav_ros.time_gate import TimeGate

INPUT_TYPES = {"altitude": PointStamped, "pressure": FluidPressure, "fix": NavSatFix,
               "velocity": TwistWithCovarianceStamped, "inclinometer": QuaternionStamped,
               "heading": PoseWithCovarianceStamped, "imu": Imu}
OUTPUT_TYPES = {"imu/data": Imu, "odometry": Odometry, "imu/gyro_bias": Vector3Stamped,
                "imu/accel_bias": Vector3Stamped}
WATCH_PERIOD = 0.2  # s, how soon a silent IMU is told
WATCHES_PER_REPORT = 5
SILENCE, SILENT_PERIODS = 0.2, 5  # s, or periods of the IMU, after which it has stopped
AID_SILENCE = 2.0  # s, or periods of the aid, after which one that was there has stopped
IMU_FAULTS = ("gyro_not_finite", "accel_not_finite", "gyro_out_of_range", "accel_out_of_range", "accel_zero")
ERROR_SHARE = 0.01  # of IMU samples with such a fault


class NavigationNode(SensorNode):
    """See the module."""

    def __init__(self):
        super().__init__("navigation_node", NavigationNodeParams)
        self.prepare(self._warm_up)
        self._session = NavigationSession(self.params, self.fault)
        self._answers = NavigationOutput(self._session)
        self._meters = {name: StreamMeter() for name in INPUTS}
        self._subscribers, self._watches, self._silent, self._origin = (), 0, False, None
        self._told = {}
        on_change(self, self.params, self._apply)
        self._outputs = {topic: self.advertise(kind, topic) for topic, kind in OUTPUT_TYPES.items()}
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_timer(WATCH_PERIOD, self._watch)
        for name in INPUTS:
            if name not in ("altitude", "pressure") or self.params.altitude_source in ("auto", name):
                topic = "imu/data_raw" if name == "imu" else name
                self.add_sensor(INPUT_TYPES[name], topic, self._taking(name))
        self.get_logger().info("ready")

    def _warm_up(self):
        NavigationEstimator(self.params).warm_up()
        TimeGate(self.params).check(1)

    def _taking(self, name):
        """Return what takes a serialized message of an input."""
        def take(raw):
            arrival_ns = self.now_ns()
            fresh = self._session.take(name, raw)
            if self._session.stamp_ns:
                self._meters[name].add(self._session.stamp_ns, arrival_ns)
            if fresh:
                for topic, serialized in self._answers.messages(self._subscribers):
                    self._outputs[topic].publish(serialized)
        return take

    def _apply(self, params):
        self.params = self._session.params = params

    def _on_reset(self, _request, response):
        self._session.reset()
        response.success, response.message = True, "starts anew; the next fix is the origin"
        return response

    # --- diagnostics

    def _watch(self):
        """Report once a second, and at once when the IMU falls silent or comes back."""
        now_ns = self.now_ns()
        self._subscribers = {topic for topic, publisher in self._outputs.items()
                             if publisher.get_subscription_count()}
        self._tell_origin()
        silent = self._silence("imu", now_ns, SILENCE) > 0.0
        self._watches += 1
        if self._watches % WATCHES_PER_REPORT == 0 or silent != self._silent:
            self._silent = silent
            self.publish_report(self._report(now_ns), now_ns)

    def _tell_origin(self):
        origin = self._session.estimator.origin
        if origin != self._origin and origin is not None:
            latitude, longitude, height = origin
            self.get_logger().info(f"origin at {math.degrees(latitude):.7f} deg north, "
                                   f"{math.degrees(longitude):.7f} deg east, {height:.2f} m")
        self._origin = origin

    def _silence(self, name, now_ns, least):
        """Seconds since the last message of an input if they are too many, otherwise 0."""
        age, rate = self._meters[name].age(now_ns), self._meters[name].stamp_rate
        limit = least if math.isnan(rate) else max(least, SILENT_PERIODS / rate)
        return age if age > limit else 0.0

    def _report(self, now_ns):
        session = self._session
        report = self.new_report("navigation", session.frame or "")
        self._report_state(report)
        self._report_imu(report, now_ns)
        self._report_aids(report, now_ns)
        self._report_faults(report)
        return report

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

    def _report_imu(self, report, now_ns):
        meter, session = self._meters["imu"], self._session
        report.value("imu_rate_hz", meter.stamp_rate)
        report.value("latency_p50_s", meter.latency(0.5))
        report.value("latency_p99_s", meter.latency(0.99))
        age = meter.age(now_ns)
        if math.isnan(age):
            report.fault(Level.STALE, "no usable imu/data_raw yet")
            return
        silence = self._silence("imu", now_ns, SILENCE)
        if silence:
            report.fault(Level.ERROR, f"imu/data_raw stopped {silence:.1f} s ago")
        publishers = self.sensors[-1][0].handle.get_publisher_count()
        if publishers > 1:
            report.fault(Level.WARN, f"imu/data_raw has {publishers} publishers")
        if session.gate.interleaved:
            report.fault(Level.ERROR, "imu/data_raw: stamps go back and forth: two publishers?")
        for text in session.check.faults.values():
            report.fault(Level.ERROR, f"imu/data_raw: {text}")
        clock = session.gate.clock_fault(session.gate.stamp_ns + round(age * 1e9), now_ns)
        if clock:
            report.fault(Level.WARN, clock)

    def _report_aids(self, report, now_ns):
        """NIS and age of each aid that there has been, its rate; a topic that has stopped is a warning."""
        for name, health in self._session.estimator.health.items():
            if health.used + health.refused:
                report.value(f"{name}_nis", health.nis)
                report.value(f"{name}_used", health.used)
                report.value(f"{name}_age_s", health.age if math.isfinite(health.age) else math.nan)
        for name in INPUTS[:-1]:
            if self._session.counts[f"{name}_messages"]:
                report.value(f"{name}_rate_hz", self._meters[name].stamp_rate)
                silence = self._silence(name, now_ns, AID_SILENCE)
                if silence:
                    report.fault(Level.WARN, f"{name} stopped {silence:.1f} s ago")

    def _report_faults(self, report):
        """Counters of everything refused; what is new since the last report is a fault of this one."""
        faults, samples = self._session.faults, max(self._session.counts["imu_messages"], 1)
        often = sum(faults[name] for name in IMU_FAULTS) > ERROR_SHARE * samples
        for name, count in faults.items():
            new = count - self._told.get(name, 0)
            if new > 0:
                report.fault(Level.ERROR if often and name in IMU_FAULTS else Level.WARN, f"{name}: {new} more")
        self._told = faults
        report.counters(faults | dict(self._session.counts) | dict(self.counts))


def main():
    """Run the node until it is interrupted or shut down; return its exit status."""
    return run_sensor_node("navigation_node", NavigationNode)


if __name__ == "__main__":
    sys.exit(main())
