"""What ``navigation_node`` and ``navigate_bag`` share at the ROS edge: parameters, input, message contents.

:class:`NavigationSession` takes serialized messages, so both do the same with them, good or bad. Fixes,
velocities and headings count with the covariance of their message; all zero, or a NavSatFix's unknown type, means
the parameter.
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from attitude_estimator.edge import start_with_stored
from attitude_estimator.navigation import _kernels as kernels
from attitude_estimator.navigation.estimator import Navigation, NavigationEstimator
from attitude_estimator.navigation.params import NavigationParams
from inertial.parameters import parameter
from inertial.rotation import (
    dcm_from_quaternion,
    euler_from_dcm,
    skew,
)
from nav_ros.altitude_source import AltitudeSource
from nav_ros.diagnostics import Level
from nav_ros.frames import (
    Mounting,
    orientation_from_q_nb,
    q_nb_from_orientation,
    swap_enu_ned,
    swap_enu_ned_covariance,
    swap_flu_frd,
    swap_flu_frd_covariance,
)
from nav_ros.imu_check import ImuCheck
from nav_ros.imu_message import hide_orientation, imu_values
from nav_ros.messages import (
    ACCEL,
    COVARIANCE_UNKNOWN,
    DOUBLES,
    GPS_FIX,
    GYRO,
    IMU,
    ODOMETRY,
    POINT,
    POSE,
    POSE_COVARIANCE,
    POSE_ORIENTATION,
    POSE_POSITION,
    PRESSURE,
    QUATERNION,
    TWIST,
    TWIST_ANGULAR,
    TWIST_COVARIANCE,
    TWIST_LINEAR,
    UNKNOWN_VARIANCE,
    VECTOR,
    VELOCITY,
    VELOCITY_COVARIANCE,
    RefusedMessageError,
    StampedEncoder,
    decode,
    decode_fix,
)
from nav_ros.time_gate import StampCode, TimeGate, TimeGateParams

OUTPUT_TYPES = {"imu/data": IMU, "odometry": ODOMETRY, "imu/gyro_bias": VECTOR, "imu/accel_bias": VECTOR}
"""What the node publishes, and the offline tool writes."""
INPUTS = ("altitude", "pressure", "fix", "velocity", "inclinometer", "heading", "imu")
"""Keys of what comes in; of messages that wait together, the node serves them in this order."""
COASTING_AFTER = 2.0
"""Seconds without a used fix or velocity after which the estimate coasts."""

_TWO_ALTIMETERS_NS = 5_000_000_000  # within which both have been heard
_QUATERNION_TOLERANCE = 0.1  # of its length, which single precision and rounding do not use up


@dataclass(frozen=True)
class NavigationNodeParams(NavigationParams, TimeGateParams):
    """Parameters of ``navigation_node`` and ``navigate_bag``: of the estimator, the time gate and the edge."""

    altitude_source: str = parameter(
        "auto", "", "which altimeter to use; auto takes the one that is there",
        choices=("auto", "altitude", "pressure", "none"), runtime=False)
    world_frame: str = parameter("map", "", "frame_id of odometry: east, north, up of the first fix", runtime=False)
    base_frame: str = parameter(
        "", "", "child_frame_id of odometry: the vehicle, where mounting_rpy turns the IMU's axes; empty: the IMU's "
        "frame_id", runtime=False)
    mounting_rpy: tuple = parameter(
        (0.0, 0.0, 0.0), "rad", "roll, pitch, yaw (REP-103) of the IMU in the vehicle", -2 * np.pi, 2 * np.pi)
    auxiliary_rate: float = parameter(
        50.0, "Hz", "highest rate of all output but imu/data; 0: with every sample", 0.0, 1e4)
    publish_tf: bool = parameter(
        False, "", "broadcast world_frame to base_frame once it navigates; needs tf2_ros", runtime=False)
    bias_file: str = parameter(
        "", "", "file that keeps the biases from one run to the next; empty: none", runtime=False)


class NavigationSession:
    """Serialized messages in, estimates out.

    Parameters
    ----------
    params : NavigationNodeParams
    tell : callable
        ``tell(fault, text, level)``, called for each message that does not count, or not wholly.

    Attributes
    ----------
    estimator : NavigationEstimator
    gate : nav_ros.time_gate.TimeGate
        Of the IMU's stamps.
    check : nav_ros.imu_check.ImuCheck
    counts : Counter
        How many messages of each input came.
    stamp_ns : int
        Of the last message, 0 where it had none.
    frame : str or None
        ``frame_id`` of the IMU.
    stored : nav_ros.bias_file.StoredBiases or None
        To start with at the next sample.
    """

    def __init__(self, params, tell):
        self._tell = tell
        self.estimator = NavigationEstimator(params)
        self.gate = TimeGate(params)
        self.check = ImuCheck()
        self.counts = Counter()
        self.stamp_ns, self.frame, self.stored = 0, None, None
        self._altimeters = {"altitude": AltitudeSource(POINT), "pressure": AltitudeSource(PRESSURE)}
        self._altimeter_ns = {}
        self._takes = {"imu": self._take_imu, "fix": self._take_fix, "velocity": self._take_velocity,
                       "inclinometer": self._take_inclinometer, "heading": self._take_heading,
                       "altitude": lambda raw: self._take_altitude("altitude", POINT, raw),
                       "pressure": lambda raw: self._take_altitude("pressure", PRESSURE, raw)}
        self.params = params

    @property
    def params(self):
        """NavigationNodeParams in use; setting them keeps the state."""
        return self._params

    @params.setter
    def params(self, params):
        self._params = params
        self.estimator.params = params
        self.gate.set_params(params)
        self.messages = NavigationMessages(params.mounting_rpy)
        self.check.up_imu = self.messages.mounting.up_imu

    def reset(self):
        """Start anew; the first fix that the next one confirms is the origin."""
        self.estimator.reset()
        self._altimeter_ns.clear()

    def take(self, name, raw):
        """Take one serialized message.

        Parameters
        ----------
        name : str
            Of :data:`INPUTS`.
        raw : bytes

        Returns
        -------
        bool
            Whether there is a new estimate.
        """
        self.counts[f"{name}_messages"] += 1
        self.stamp_ns = 0
        try:
            return bool(self._takes[name](raw))
        except RefusedMessageError as error:
            self._tell(error.fault, f"{name}: {error}", error.level)
        except ValueError as error:
            self._tell(f"{name}_invalid", f"{name}: {error}", Level.ERROR)
        return False

    # --- the IMU

    def _take_imu(self, raw):
        stamp_ns, frame, values = decode(IMU, raw)
        code = self.gate.check(stamp_ns)
        if code == StampCode.JUMP_BACK:
            self._tell("started_anew", "stamps went back (a bag's loop, a clock set?): starts anew", Level.WARN)
            self.reset()
        elif code == StampCode.NO_STAMP:
            raise RefusedMessageError("imu_no_stamp", "no valid stamp, and no fixed_dt to stand in")
        if code >= StampCode.DUPLICATE:
            return False
        self.stamp_ns = self.gate.stamp_ns
        self._look_at_frame(frame)
        self.check.add(self.stamp_ns, values[GYRO], values[ACCEL])
        if self.stored is not None:
            start_with_stored(self.estimator.level, self.stored, self.stamp_ns)
            self.stored = None
        return self.estimator.add_imu(self.stamp_ns, swap_flu_frd(values[GYRO]), swap_flu_frd(values[ACCEL]))

    def _look_at_frame(self, frame):
        if frame == self.frame:
            return
        if not frame:
            self._tell("frame_id_empty", "imu: frame_id is empty, so nobody knows whose axes these are", Level.ERROR)
        if self.frame is not None:
            self._tell("frame_id_changed", f"imu: frame_id was {self.frame!r} and is {frame!r}: two IMUs on one "
                       "topic?", Level.ERROR)
        self.frame = frame

    # --- what aids it

    def _begin(self, name, stamp_ns):
        """Insist on the stamp of an aid."""
        if stamp_ns <= 0:
            raise RefusedMessageError(f"{name}_no_stamp", "no valid stamp")
        self.stamp_ns = stamp_ns

    def _take_altitude(self, name, message_type, raw):
        stamp_ns, _, values = decode(message_type, raw)
        self._begin("altitude", stamp_ns)
        altitude, variance = self._altimeters[name].convert(values)
        self._altimeter_ns[name] = stamp_ns
        stamps = self._altimeter_ns.values()
        if len(stamps) == 2 and max(stamps) - min(stamps) < _TWO_ALTIMETERS_NS:
            raise RefusedMessageError("two_altimeters", "altitude and pressure are both there: choose one by "
                                      "altitude_source; neither is used")
        self.estimator.add_altitude(stamp_ns, altitude, variance)

    def _take_fix(self, raw):
        stamp_ns, fix = decode_fix(raw)
        self._begin("fix", stamp_ns)
        if fix.status < GPS_FIX:
            raise RefusedMessageError("no_fix", f"status {fix.status}: the receiver has no position", Level.WARN)
        covariance_n = None
        if fix.covariance_type != COVARIANCE_UNKNOWN:
            covariance_n = self._covariance_n("fix", np.reshape(fix.covariance, (3, 3)))
        self.estimator.add_fix(stamp_ns, np.radians(fix.latitude_deg), np.radians(fix.longitude_deg), fix.height,
                               covariance_n)

    def _take_velocity(self, raw):
        stamp_ns, _, values = decode(TWIST, raw)
        self._begin("velocity", stamp_ns)
        covariance = np.reshape(values[VELOCITY_COVARIANCE], (6, 6))[:3, :3]
        self.estimator.add_velocity(stamp_ns, swap_enu_ned(values[VELOCITY]),
                                    self._covariance_n("velocity", covariance))

    def _take_inclinometer(self, raw):
        stamp_ns, _, values = decode(QUATERNION, raw)
        self._begin("inclinometer", stamp_ns)
        self.estimator.add_inclinometer(stamp_ns, self.messages.down_imu(values))

    def _take_heading(self, raw):
        stamp_ns, _, values = decode(POSE, raw)
        self._begin("heading", stamp_ns)
        variance = values[POSE_COVARIANCE.stop - 1]
        if not 0.0 <= variance < np.inf:
            self._covariance_invalid("heading")
            variance = 0.0
        heading = self.messages.heading_imu(values[POSE_ORIENTATION], self.estimator.estimate)
        self.estimator.add_heading(stamp_ns, heading, variance)

    def _covariance_n(self, name, covariance):
        """Return a message's ENU covariance in NED, None where it is unknown (all zero) or none."""
        if not covariance.any():
            return None
        size = np.abs(covariance).max()
        if not (np.isfinite(size) and np.abs(covariance - covariance.T).max() <= 1e-6 * size
                and np.linalg.eigvalsh(covariance)[0] > 0.0):
            self._covariance_invalid(name)
            return None
        return swap_enu_ned_covariance(covariance)

    def _covariance_invalid(self, name):
        self._tell("covariance_invalid", f"{name}: a covariance is negative, asymmetric or not finite and does not "
                   "count", Level.WARN)

    # --- what it says of itself

    @property
    def faults(self):
        """Name -> count of what was refused or bridged further in: by the gate, the IMU's checks, the aids'."""
        gate = {code.name.lower(): self.gate.counts[code] for code in StampCode
                if code not in (StampCode.STEP, StampCode.FIRST, StampCode.NO_STAMP)}
        level = {name: count for name, count in vars(self.estimator.level_faults).items() if name not in gate}
        refused = {f"{name}_refused": health.refused for name, health in self.estimator.health.items()}
        return gate | level | self.estimator.faults | refused

    @property
    def since_aided(self):
        """Seconds since the last fix or velocity that was used, infinite before the first."""
        health = self.estimator.health
        return min(health["fix"].age, health["velocity"].age)

    def spread(self):
        """Return name -> standard deviation of what is known, degrees and m; the tilt as one number."""
        estimate = self.estimator.estimate
        variances = np.diagonal(estimate.covariance)
        spread = {"tilt_sigma_deg": np.degrees(np.sqrt(variances[:2].sum())) if estimate.valid else np.nan,
                  "heading_sigma_deg": np.degrees(np.sqrt(variances[2])) if estimate.heading_known else np.nan}
        for name, some in (("velocity_sigma_m_s", variances[3:5]), ("horizontal_sigma_m", variances[6:8]),
                           ("height_sigma_m", variances[8:])):
            spread[name] = np.sqrt(some.sum()) if some.sum() < UNKNOWN_VARIANCE else np.nan
        return {name: float(value) for name, value in spread.items()}

    @property
    def phase(self):
        """``start``, ``navigating`` or ``coasting for N s``."""
        if not self.estimator.estimate.navigating:
            return "start"
        since = self.since_aided
        return f"coasting for {since:.1f} s" if since > COASTING_AFTER else "navigating"


class NavigationMessages:
    """Contents of the messages that are made of an estimate, and the vehicle's axes for what comes in.

    Parameters
    ----------
    mounting_rpy : (3,), rad
        Of the IMU in the vehicle, FLU.
    """

    def __init__(self, mounting_rpy):
        self.mounting = Mounting(mounting_rpy)
        basis = Navigation(None, np.eye(kernels.OUT_SIZE))
        # Most values are linear in the row of an estimate.
        self._matrix = {"imu/data": imu_values(self.mounting, basis, basis.covariance[:, :3, :3]),
                        "odometry": self._pose_and_turn(basis),
                        "imu/gyro_bias": swap_flu_frd(basis.gyro_bias_b),
                        "imu/accel_bias": swap_flu_frd(basis.accel_bias_b)}

    def down_imu(self, orientation_xyzw):
        """Return down in the IMU's axes, FRD, of a vehicle with that orientation."""
        return _dcm_nb(orientation_xyzw)[2] @ self.mounting.dcm_base_imu

    def heading_imu(self, orientation_xyzw, estimate):
        """Return the heading of the IMU, rad clockwise from north, where the vehicle's is that of an orientation."""
        *_, heading = euler_from_dcm(_dcm_nb(orientation_xyzw))
        # A turn about the vertical changes both headings alike.
        *_, imu = euler_from_dcm(dcm_from_quaternion(estimate.q_nb_wxyz))
        *_, base = euler_from_dcm(dcm_from_quaternion(self.mounting.attitude(estimate.q_nb_wxyz)))
        return heading + imu - base

    def values(self, topic, estimates):
        """Return the doubles of the message on a topic of :data:`OUTPUT_TYPES`, (..., D)."""
        values = estimates.rows @ self._matrix[topic]
        table, all_rows = np.atleast_2d(values), Navigation(None, np.atleast_2d(estimates.rows))
        if topic == "imu/data":
            hide_orientation(table, all_rows.valid)
        elif topic == "odometry":
            self._add_velocity(table, all_rows)
            for part in (POSE_COVARIANCE, TWIST_COVARIANCE):
                _cap(table[:, part].reshape(-1, 6, 6))
        return values

    def _pose_and_turn(self, estimates):
        """Pose in the world's axes and rate in the vehicle's: what is linear of an Odometry."""
        values = np.zeros((len(estimates), DOUBLES[ODOMETRY]))
        values[:, POSE_POSITION] = swap_enu_ned(estimates.position_n)
        values[:, POSE_ORIENTATION] = orientation_from_q_nb(self.mounting.attitude(estimates.q_nb_wxyz))
        values[:, POSE_COVARIANCE] = _pose_covariance(estimates.covariance).reshape(-1, 36)
        values[:, TWIST_ANGULAR] = self.mounting.vector(estimates.gyro_b)
        values[:, TWIST_COVARIANCE].reshape(-1, 6, 6)[:, 3:, 3:] = self.mounting.covariance(
            estimates.gyro_bias_variance)
        return values

    def _add_velocity(self, values, estimates):
        """Add the velocity in the vehicle's axes and its covariance to the values of Odometry messages, (N, D)."""
        velocity_n, dcm_nb = estimates.velocity_n, dcm_from_quaternion(self.mounting.attitude(estimates.q_nb_wxyz))
        dcm_bn = np.swapaxes(dcm_nb, -1, -2)
        values[:, TWIST_LINEAR] = swap_flu_frd((dcm_bn @ velocity_n[..., None])[..., 0])
        # v_b = C^T v; with C = (I + [theta x]) C_estimated its error is C^T (dv + v x theta).
        J = np.concatenate([dcm_bn @ skew(velocity_n), dcm_bn], axis=-1)
        covariance = swap_flu_frd_covariance(J @ estimates.covariance[:, :6, :6] @ np.swapaxes(J, -1, -2))
        covariance[~estimates.heading_known] = np.eye(3) * UNKNOWN_VARIANCE
        values[:, TWIST_COVARIANCE].reshape(-1, 6, 6)[:, :3, :3] = covariance


def _dcm_nb(orientation_xyzw):
    length = np.linalg.norm(orientation_xyzw)
    if not abs(length - 1.0) < _QUATERNION_TOLERANCE:
        raise ValueError(f"a quaternion of length {length:g} is no orientation")
    return dcm_from_quaternion(q_nb_from_orientation(orientation_xyzw) / length)


def _pose_covariance(covariance_n):
    """Return the (..., 6, 6) of position and rotation in ENU from the (..., 9, 9) of attitude, velocity, position."""
    order = np.r_[6:9, 0:3]
    blocks = covariance_n[..., order, :][..., order].reshape(-1, 2, 3, 2, 3).swapaxes(2, 3)
    return swap_enu_ned_covariance(blocks).swapaxes(2, 3).reshape(-1, 6, 6)


def _cap(covariance):
    """Give what is as good as unknown of (N, n, n) UNKNOWN_VARIANCE and no correlation, in place."""
    k = np.arange(covariance.shape[-1])
    unknown = covariance[:, k, k] >= UNKNOWN_VARIANCE
    if unknown.any():
        covariance[unknown[:, :, None] | unknown[:, None, :]] = 0.0
        covariance[:, k, k] += np.where(unknown, UNKNOWN_VARIANCE, 0.0)


class NavigationOutput:
    """Estimates serialized, at their rates.

    Parameters
    ----------
    session : NavigationSession
    """

    def __init__(self, session):
        self._session = session
        self._frame, self._encoders, self._slot = None, {}, -1

    def messages(self, wanted=OUTPUT_TYPES):
        """Yield (topic, serialized message) of the newest estimate, of the topics that are wanted."""
        session = self._session
        estimate = session.estimator.estimate
        if session.frame != self._frame:
            self._set_frame(session.frame)
        slot = self._slots(estimate.stamp_ns)
        auxiliary, self._slot = slot != self._slot, slot
        for topic in OUTPUT_TYPES:
            if topic == "imu/data" or (auxiliary and topic in wanted and (topic != "odometry" or estimate.valid)):
                values = session.messages.values(topic, estimate)
                yield topic, self._encoders[topic].encode(estimate.stamp_ns, values)

    def batch(self, navigation, frames):
        """Yield (topic, which estimates, their serialized messages); `frames` names the IMU's of each."""
        slots = self._slots(navigation.stamp_ns)
        auxiliary = np.diff(slots, prepend=self._slot) != 0
        self._slot = slots[-1] if len(slots) else self._slot
        for frame in np.unique(frames):
            self._set_frame(str(frame))
            for topic in OUTPUT_TYPES:
                keep = np.asarray(frames) == frame
                if topic != "imu/data":
                    keep &= auxiliary
                if topic == "odometry":
                    keep &= navigation.valid
                rows = np.flatnonzero(keep)
                part = Navigation(navigation.stamp_ns[rows], navigation.rows[rows])
                values = self._session.messages.values(topic, part)
                yield topic, rows, self._encoders[topic].encode_batch(part.stamp_ns, values)

    def _slots(self, stamp_ns):
        rate = self._session.params.auxiliary_rate
        return stamp_ns if rate == 0.0 else stamp_ns // round(1e9 / rate)

    def _set_frame(self, imu_frame):
        self._frame, params = imu_frame, self._session.params
        base = params.base_frame or imu_frame
        frames = {"imu/data": (base,), "odometry": (params.world_frame, base)}
        self._encoders = {topic: StampedEncoder(message_type, *frames.get(topic, (imu_frame,)))
                          for topic, message_type in OUTPUT_TYPES.items()}
