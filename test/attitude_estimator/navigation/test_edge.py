"""The ROS edge of navigation without ROS: what each bad message comes to, and what an Odometry holds."""

from collections import Counter

import numpy as np
import pytest

from attitude_estimator.navigation import _kernels as kernels
from attitude_estimator.navigation.edge import (
    UNKNOWN_VARIANCE,
    NavigationMessages,
    NavigationNodeParams,
    NavigationOutput,
    NavigationSession,
)
from attitude_estimator.navigation.estimator import Navigation
from inertial.rotation import (
    dcm_from_quaternion,
    dcm_nb_from_euler,
    quaternion_exp,
    quaternion_from_dcm,
    quaternion_multiply,
)
from nav_ros.bias_file import StoredBiases
from nav_ros.frames import orientation_from_q_nb, swap_enu_ned_covariance, swap_flu_frd
from nav_ros.messages import (
    ACCEL,
    COVARIANCE_KNOWN,
    COVARIANCE_UNKNOWN,
    GPS_FIX,
    IMU,
    NO_FIX,
    POINT,
    POSE,
    POSE_COVARIANCE,
    POSE_ORIENTATION,
    POSE_POSITION,
    PRESSURE,
    QUATERNION,
    TWIST,
    TWIST_COVARIANCE,
    TWIST_LINEAR,
    VELOCITY,
    VELOCITY_COVARIANCE,
    Fix,
    StampedEncoder,
    encode_fix,
)

T0 = 1_700_000_000_000_000_000
PERIOD_NS = 10_000_000
ROUNDING = 1e-12
STEP, STEP_ERROR = 1e-6, 1e-8
"""Of a central difference, rad or m/s, and what is left of it relative to the speed."""
DIAGONAL = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 4.0)


STORED = StoredBiases(T0, (0.01, -0.02, 0.03), (1e-4,) * 3, (0.02, 0.0, -0.01), (1e-3,) * 3)
KEPT = 0.01
"""Of a stored bias, that the prior of any switch-on and a first sample may take off."""


class Input:
    """A session with an IMU at rest and a count of what it tells."""

    def __init__(self, **params):
        self.told, self.texts = Counter(), []
        self.session = NavigationSession(NavigationNodeParams(**params), self._tell)
        self.stamp_ns = T0
        self._rng = np.random.default_rng(0)

    def _tell(self, name, text, _level):
        self.told[name] += 1
        self.texts.append(text)

    def imu(self, count=1, stamp_ns=None, frame="imu"):
        fresh = False
        for _ in range(count):
            self.stamp_ns = self.stamp_ns + PERIOD_NS if stamp_ns is None else stamp_ns
            values = np.zeros(37)
            values[ACCEL] = [0.0, 0.0, 9.80665] + 0.01 * self._rng.standard_normal(3)
            fresh = self.session.take("imu", StampedEncoder(IMU, frame).encode(self.stamp_ns, values))
        return fresh

    def fix(self, status=GPS_FIX, latitude=35.0, covariance=DIAGONAL, kind=COVARIANCE_KNOWN, stamp_ns=None):
        stamp_ns = self.stamp_ns if stamp_ns is None else stamp_ns
        self.session.take("fix", encode_fix(stamp_ns, "gps", Fix(status, latitude, 139.0, 40.0, covariance, kind)))

    def velocity(self, velocity=(0.0, 0.0, 0.0), covariance=None):
        values = np.zeros(42)
        values[VELOCITY] = velocity
        values[VELOCITY_COVARIANCE] = np.zeros(36) if covariance is None else covariance.ravel()
        self.session.take("velocity", StampedEncoder(TWIST, "map").encode(self.stamp_ns, values))

    def heading(self, orientation, variance=0.01):
        values = np.zeros(43)
        values[POSE_ORIENTATION], values[POSE_COVARIANCE.stop - 1] = orientation, variance
        self.session.take("heading", StampedEncoder(POSE, "map").encode(self.stamp_ns, values))

    def stamped(self, name, message_type, values, stamp_ns=None):
        stamp_ns = self.stamp_ns if stamp_ns is None else stamp_ns
        self.session.take(name, StampedEncoder(message_type, "x").encode(stamp_ns, np.array(values)))

    def used(self, name):
        return self.session.estimator.health[name].used


def bad_messages(source):
    """Yield (name of the fault, what gives it once)."""
    nan = np.nan
    asymmetric = (1.0, 0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    yield "no_fix", lambda: source.fix(status=NO_FIX)
    yield "fix_invalid", lambda: source.fix(latitude=nan)
    yield "fix_invalid", lambda: source.fix(latitude=91.0)
    yield "fix_no_stamp", lambda: source.fix(stamp_ns=0)
    yield "covariance_invalid", lambda: source.fix(covariance=asymmetric)
    yield "covariance_invalid", lambda: source.fix(covariance=(-1.0, *DIAGONAL[1:]))
    yield "covariance_invalid", lambda: source.fix(covariance=(nan,) * 9)
    yield "velocity_invalid", lambda: source.velocity((nan, 0.0, 0.0))
    yield "inclinometer_invalid", lambda: source.stamped("inclinometer", QUATERNION, [0.0, 0.0, 0.0, 0.0])
    yield "heading_invalid", lambda: source.heading([nan, 0.0, 0.0, 1.0])
    yield "covariance_invalid", lambda: source.heading([0.0, 0.0, 0.0, 1.0], variance=-1.0)
    yield "altitude_not_finite", lambda: source.stamped("altitude", POINT, [0.0, 0.0, nan])
    yield "pressure_unit", lambda: source.stamped("pressure", PRESSURE, [1013.0, 0.0])
    yield "altitude_no_stamp", lambda: source.stamped("altitude", POINT, [0.0, 0.0, 1.0], stamp_ns=0)
    yield "malformed", lambda: source.session.take("velocity", b"\x00\x01\x00\x00")
    yield "imu_no_stamp", lambda: source.imu(stamp_ns=0)
    yield "frame_id_changed", lambda: source.imu(frame="other")


@pytest.mark.parametrize("held", [False, True])
def test_it_starts_with_stored_biases(held):
    source = Input()
    source.session.stored = STORED
    if held:
        source.session.estimator.hold()
    source.imu()
    if held:
        source.session.estimator.release()
    estimate = source.session.estimator.estimate
    np.testing.assert_allclose(swap_flu_frd(estimate.gyro_bias_b), STORED.gyro_bias, rtol=KEPT)
    np.testing.assert_allclose(swap_flu_frd(estimate.accel_bias_b), STORED.accel_bias, rtol=KEPT, atol=1e-6)
    np.testing.assert_allclose(np.sqrt(estimate.gyro_bias_variance), STORED.gyro_bias_std, rtol=KEPT)
    assert source.session.stored is None and source.told == {}


def test_each_bad_message_is_told_by_its_name_and_ends_nothing():
    for k in range(len(list(bad_messages(None)))):
        source = Input()
        source.imu(3)
        name, give = list(bad_messages(source))[k]
        give()
        assert source.told == {name: 1}, name
        source.stamp_ns = T0 + 10 * PERIOD_NS
        assert source.imu(), name


def test_altitude_and_pressure_together_are_an_error():
    source = Input()
    source.imu(2)
    source.stamped("altitude", POINT, [0.0, 0.0, 1.0])
    assert not source.told
    source.stamped("pressure", PRESSURE, [101_325.0, 0.0])
    assert source.told == {"two_altimeters": 1}


def test_a_clean_run_at_rest_tells_nothing_and_counts_no_fault():
    source = Input()
    for _ in range(100):
        source.imu(5)
        source.fix()
        source.velocity()
        source.stamped("altitude", POINT, [0.0, 0.0, 3.0])
    assert not source.told
    assert not any(source.session.faults.values()), source.session.faults
    assert source.session.phase == "start" and "heading" in source.session.estimator.waiting_for


def test_with_a_heading_it_navigates_and_then_coasts():
    source = Input()
    yaw = orientation_from_q_nb(quaternion_from_dcm(dcm_nb_from_euler(0.0, 0.0, 1.0)))
    for _ in range(100):
        source.imu(10)
        source.fix()
        source.velocity(covariance=np.eye(6) * 0.01)
        source.heading(yaw)
    assert source.session.phase == "navigating"
    assert source.used("fix") and source.used("velocity") and source.used("heading")
    source.imu(300)
    assert source.session.phase == "coasting for 3.0 s"
    source.imu(stamp_ns=T0)
    assert source.told == {"started_anew": 1} and source.session.phase == "start"


@pytest.mark.parametrize(("covariance", "kind", "std"), [
    (DIAGONAL, COVARIANCE_KNOWN, 1.0), (DIAGONAL, COVARIANCE_UNKNOWN, 5.0), ((0.0,) * 9, COVARIANCE_KNOWN, 5.0)])
def test_a_fix_counts_with_its_covariance_or_the_parameter(covariance, kind, std):
    source = Input(fix_std=5.0, fix_slow_share=0.0)
    source.imu(300)
    source.velocity()
    for _ in range(2):  # the first is confirmed by the second and is the origin
        source.fix(covariance=covariance, kind=kind)
        source.imu()
    assert np.sqrt(source.session.estimator.estimate.covariance[6, 6]) == pytest.approx(std, rel=0.01)


# --- contents of the messages


def navigation(seed, heading_known=True):
    """Return a made-up estimate with a full covariance."""
    rng = np.random.default_rng(seed)
    row = np.zeros(kernels.OUT_SIZE)
    row[[kernels.OUT_VALID, kernels.OUT_HEADING, kernels.OUT_NAVIGATING]] = 1.0, heading_known, 1.0
    row[kernels.OUT_Q:kernels.OUT_V] = quaternion_exp(rng.normal(size=3))
    row[kernels.OUT_V:kernels.OUT_COV] = rng.normal(size=kernels.OUT_COV - kernels.OUT_V)
    root = rng.normal(size=(9, 9))
    covariance = root @ root.T
    if not heading_known:
        covariance[2, :] = covariance[:, 2] = 0.0
        covariance[2, 2] = UNKNOWN_VARIANCE
    row[kernels.OUT_COV:kernels.OUT_BG_VAR] = covariance.ravel()
    row[kernels.OUT_BG_VAR:] = 0.1
    return Navigation(T0, row)


def test_an_odometry_has_pose_and_twist_with_their_covariances():
    estimate = navigation(0)
    values = NavigationMessages((0.0, 0.0, 0.0)).values("odometry", estimate)
    east_north_up = estimate.position_n[[1, 0, 2]] * [1.0, 1.0, -1.0]
    np.testing.assert_allclose(values[POSE_POSITION], east_north_up, atol=ROUNDING)
    np.testing.assert_allclose(values[POSE_ORIENTATION], orientation_from_q_nb(estimate.q_nb_wxyz), atol=ROUNDING)
    pose, P = values[POSE_COVARIANCE].reshape(6, 6), estimate.covariance
    for ours, theirs in (((6, 6), (0, 0)), ((0, 0), (3, 3)), ((6, 0), (0, 3)), ((0, 6), (3, 0))):
        block = P[ours[0]:ours[0] + 3, ours[1]:ours[1] + 3]
        np.testing.assert_allclose(pose[theirs[0]:theirs[0] + 3, theirs[1]:theirs[1] + 3],
                                   swap_enu_ned_covariance(block), atol=ROUNDING)

    def velocity_flu(error):
        q = quaternion_multiply(quaternion_exp(error[:3]), estimate.q_nb_wxyz)
        return swap_flu_frd((estimate.velocity_n + error[3:]) @ dcm_from_quaternion(q))

    np.testing.assert_allclose(values[TWIST_LINEAR], velocity_flu(np.zeros(6)), atol=ROUNDING)
    J = np.stack([(velocity_flu(STEP * e) - velocity_flu(-STEP * e)) / (2 * STEP) for e in np.eye(6)], axis=1)
    np.testing.assert_allclose(values[TWIST_COVARIANCE].reshape(6, 6)[:3, :3], J @ P[:6, :6] @ J.T, rtol=STEP_ERROR)


def test_what_is_unknown_has_the_variance_that_says_so():
    values = NavigationMessages((0.0, 0.0, 0.0)).values("odometry", navigation(1, heading_known=False))
    pose, twist = (values[part].reshape(6, 6) for part in (POSE_COVARIANCE, TWIST_COVARIANCE))
    assert pose[5].tolist() == [0.0] * 5 + [UNKNOWN_VARIANCE]
    assert twist.diagonal()[:3].tolist() == [UNKNOWN_VARIANCE] * 3 and twist.diagonal()[3:].max() < 1.0


def test_a_mounting_turns_what_goes_out_and_what_comes_in():
    mounting = (3.1, 0.2, -1.0)
    roll, pitch, yaw = mounting
    dcm_base_imu = dcm_nb_from_euler(roll, -pitch, -yaw)
    estimate, messages = navigation(2), NavigationMessages(mounting)
    dcm_n_base = dcm_from_quaternion(estimate.q_nb_wxyz) @ dcm_base_imu.T
    values = messages.values("odometry", estimate)
    orientation = orientation_from_q_nb(quaternion_from_dcm(dcm_n_base))
    assert abs(values[POSE_ORIENTATION] @ orientation) == pytest.approx(1.0, abs=ROUNDING)
    np.testing.assert_allclose(values[TWIST_LINEAR], swap_flu_frd(estimate.velocity_n @ dcm_n_base), atol=ROUNDING)

    dcm_n_imu = dcm_from_quaternion(estimate.q_nb_wxyz)
    np.testing.assert_allclose(messages.down_imu(orientation), dcm_n_imu[2], atol=ROUNDING)
    heading = messages.heading_imu(orientation, estimate)
    assert np.exp(1j * heading) == pytest.approx(np.exp(1j * np.arctan2(dcm_n_imu[1, 0], dcm_n_imu[0, 0])))


def test_auxiliary_output_keeps_its_rate_and_each_sample_has_an_answer():
    source = Input(auxiliary_rate=20.0, base_frame="hull")
    output = NavigationOutput(source.session)
    topics = Counter()
    for _ in range(400):
        if source.imu():
            for topic, raw in output.messages():
                topics[topic] += 1
                assert (b"imu\0" if "bias" in topic else b"hull\0") in raw
    assert topics["imu/data"] == 400 and topics["imu/gyro_bias"] == pytest.approx(80, abs=1)
    assert 0 < topics["odometry"] <= 80
