"""attitude_node: IMU and altimeter in, attitude with its covariance out.

Topics, services and parameters: README. Every IMU message is answered at once with the estimate at its
stamp; an altitude counts at its own stamp, also when it comes late. Subscriptions and publications are of
serialized messages, because making message objects costs more than the estimate.
"""

import math
import sys

import numpy as np
from geometry_msgs.msg import PointStamped, Vector3Stamped
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
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
from nav_ros.altitude_source import AltitudeSource
from nav_ros.diagnostics import Level
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
    RefusedMessageError,
    StampedEncoder,
    decode,
)
from nav_ros.parameters import on_change
from nav_ros.sensor_loop import run_sensor_node
from nav_ros.sensor_node import SensorNode
from nav_ros.time_gate import StampCode, TimeGate

MESSAGE_TYPES = {"imu/data": Imu, "imu/rpy/filtered": Vector3Stamped, "attitude/state": Odometry,
                 "imu/gyro_bias": Vector3Stamped, "imu/accel_bias": Vector3Stamped}
IMU_SILENCE, ALTITUDE_SILENCE = 0.2, 2.0  # s without a message after which each has stopped
TWO_ALTIMETERS = 5.0  # s within which both have been heard
ERROR_SHARE = 0.01  # of refused samples
STUCK_ERROR_SAMPLES = 500
FOUND_MOVING_NS = 60_000_000_000  # after which a start in motion has been corrected


class AttitudeNode(SensorNode):
    """See the module."""

    def __init__(self):
        super().__init__("attitude_node", AttitudeNodeParams)
        self._messages = OutputMessages(self.params.mounting_rpy)
        self.prepare(self._warm_up)
        self._estimator = make_estimator(self.params)
        path = self.params.bias_file
        self._stored = self.keep_biases(path, self._newest_biases) if path else None
        self._noise = MessageNoise()
        self._check = ImuCheck(self._messages.mounting.up_imu)
        self._resets, self._found = 0, None
        self._gate = TimeGate(self.params)
        self._frame, self._encoders, self._slot = None, {}, None
        self._use_altitude = True
        self._transforms = self.transforms() if self.params.publish_tf else None
        on_change(self, self.params, self._apply)
        for topic, kind in MESSAGE_TYPES.items():
            self.advertise(kind, topic, qos_told=topic == "imu/data")
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/level", self._on_level)
        self.create_service(SetBool, "~/use_altitude", self._on_use_altitude)
        for name, kind, message_type in (("altitude", PointStamped, POINT), ("pressure", FluidPressure, PRESSURE)):
            if self.params.altitude_source in ("auto", name):
                take = self._taking_altitude(name, message_type, AltitudeSource(message_type))
                self.add_sensor(kind, name, take, patience=ALTITUDE_SILENCE)
        self._altimeters = dict(self.sensors)
        self.add_sensor(Imu, "imu/data_raw", self._take_imu, needed=True, patience=IMU_SILENCE)
        self.begin()

    def _warm_up(self):
        make_estimator(self.params).warm_up()
        TimeGate(self.params).check(1)

    def _newest_biases(self):
        estimate = self._estimator.estimate
        return biases_to_store(estimate) if estimate.valid else None

    # --- input

    def _take_imu(self, raw):
        stamp_ns, frame_id, values = decode(IMU, raw)
        code = self._gate.check(stamp_ns)
        if code == StampCode.JUMP_BACK:
            self.get_logger().warning("stamps went back (a bag's loop, a clock set?): the filter starts anew")
            self._reset()
        elif code == StampCode.NO_STAMP:
            raise RefusedMessageError("no_stamp", "no valid stamp, and no fixed_dt to stand in")
        if code >= StampCode.DUPLICATE:
            return 0
        self._step(self._gate.stamp_ns, frame_id, values)
        return self._gate.stamp_ns

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
            self._estimator.params = self._noise.applied(self.params, period_ns * 1e-9)
        if self._noise.invalid:
            self.fault("covariance_invalid", "imu/data_raw: a covariance is -1, negative or asymmetric and does not "
                       "count", Level.WARN)

    def _taking_altitude(self, name, message_type, source):
        """Return what takes a serialized message of an altimeter."""
        def take(raw):
            stamp_ns, _, values = decode(message_type, raw)
            if stamp_ns <= 0:
                raise RefusedMessageError("altitude_no_stamp", "no valid stamp")
            altitude, variance = source.convert(values)
            if self._use_altitude and not self._two_altimeters(name):
                self._estimator.add_altitude(stamp_ns, altitude, variance)
            return stamp_ns
        return take

    def _two_altimeters(self, name):
        now_ns = self.now_ns()
        both = any(other != name and sensor.meter.age(now_ns) < TWO_ALTIMETERS
                   for other, sensor in self._altimeters.items())
        if both:
            self.fault("two_altimeters", "altitude and pressure are both published: choose one by altitude_source; "
                       "neither is used", Level.ERROR)
        return both

    # --- output

    def _publish(self, stamp_ns, frame_id):
        estimate = self._estimator.estimate
        if frame_id != self._frame:
            self._set_frame(frame_id)
        slot = self.params.auxiliary_slot(stamp_ns)
        auxiliary, self._slot = slot != self._slot, slot
        for topic, publisher in self.outputs.items():
            if topic != "imu/data" and not (auxiliary and topic in self.wanted):
                continue
            if topic == "imu/rpy/filtered" and not estimate.valid:
                continue
            values = self._messages.values(topic, estimate)
            publisher.publish(self._encoders[topic].encode(stamp_ns, values))
        if self._transforms is not None and estimate.valid:
            self._transforms.send(stamp_ns, self.params.world_frame, self.params.base_frame or frame_id,
                                  self._messages.values("imu/data", estimate)[ORIENTATION])

    def _set_frame(self, frame_id):
        if not frame_id:
            self.fault("frame_id_empty", "imu/data_raw: frame_id is empty, so nobody knows whose axes these are",
                        Level.ERROR)
        if self._frame is not None:
            self.fault("frame_id_changed", f"imu/data_raw: frame_id was {self._frame!r} and is {frame_id!r}: two IMUs "
                        "on one topic?", Level.ERROR)
        self._frame = frame_id
        self._encoders = {topic: StampedEncoder(message_type, *self.params.frames(topic, frame_id))
                          for topic, message_type in OUTPUT_TYPES.items()}

    # --- services and parameters

    def _apply(self, params):
        self.params = params
        self._estimator.params = self._noise.applied(params, self._gate.period_ns * 1e-9)
        self._gate.set_params(params)
        self._messages = OutputMessages(params.mounting_rpy)
        self._check.up_imu = self._messages.mounting.up_imu

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

    def make_report(self, now_ns):
        """Return the report: state, sensors, everything refused."""
        report = self.new_report(now_ns, "attitude", self._frame or "")
        self.report_imu(report, self._gate, self._check, now_ns)
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

    def _report_altimeter(self, report, now_ns):
        report.value("use_altitude", self._use_altitude)
        ages = [sensor.meter.age(now_ns) for sensor in self._altimeters.values()]
        if ages and self._use_altitude and not any(age <= ALTITUDE_SILENCE for age in ages):
            report.fault(Level.WARN, "no altitude: the IMU alone, with a larger covariance")

    def _report_faults(self, report):
        """Counters of everything refused; what is new since the last report is a fault of this one."""
        gate = {name: self._gate.counts[code] for name, code in (
            ("duplicate_stamp", StampCode.DUPLICATE), ("backward_stamp", StampCode.BACKWARD),
            ("no_stamp", StampCode.NO_STAMP), ("gap", StampCode.GAP), ("long_gap", StampCode.LONG_GAP),
            ("stamp_jump_back", StampCode.JUMP_BACK))}
        faults = vars(self._estimator.faults)
        # What is refused here never reaches the estimator, whose counter of that name stays zero.
        report.counters(faults | self.counts | gate)
        samples = max(self.counts["imu_messages"], 1)
        refused = sum(faults[name] for name in ("gyro_not_finite", "gyro_out_of_range", "accel_not_finite",
                                                "accel_out_of_range", "accel_zero"))
        if refused:
            level = Level.ERROR if refused > ERROR_SHARE * samples else Level.WARN
            report.fault(level, f"{refused} of {samples} IMU samples not finite, out of range or all zero")
        if faults["stuck"]:
            level = Level.ERROR if faults["stuck"] > STUCK_ERROR_SAMPLES else Level.WARN
            report.fault(level, "the IMU repeats one sample: stuck?")
        if self._estimator.free_fall:
            report.fault(Level.WARN, "the force is too small to show gravity")


def main():
    """Run the node until it is interrupted or shut down; return its exit status."""
    return run_sensor_node("attitude_node", AttitudeNode, AttitudeNodeParams, __doc__)


if __name__ == "__main__":
    sys.exit(main())
