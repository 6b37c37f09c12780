"""alignment_node and align_bag as they are installed: heading, status, services, bad input, the end."""

import json
import math
import signal
import subprocess

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from geometry_msgs.msg import PoseWithCovarianceStamped, Vector3Stamped  # noqa: E402
from rclpy.qos import ReliabilityPolicy  # noqa: E402
from sensor_msgs.msg import Imu, JointState, NavSatFix  # noqa: E402
from std_msgs.msg import Float64  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from inertial.rotation import dcm_from_quaternion, euler_from_dcm  # noqa: E402
from inertial.table_scenarios import HEADING, LATITUDE, PITCH, ROLL  # noqa: E402
from nav_ros.bags import read_recording  # noqa: E402
from nav_ros.cli import simulate_bag_main  # noqa: E402
from nav_ros.frames import q_nb_from_orientation  # noqa: E402
from nav_ros.messages import IMU, StampedEncoder, encode_joints  # noqa: E402
from nav_ros.resources import bundled_config, executable  # noqa: E402

CONFIG = bundled_config("alignment_navigation.yaml")
SIGMAS = 3.0
"""Of the heading, for one fixed seed."""
LEVEL_SIGMA = 1e-4  # rad, generous: a tenth of it is expected
SAME_ANGLE = 1e-9  # rad
BURST, ANSWER_PERIOD_NS = 50, 100_000_000
"""Samples between two waits for an answer, and how far apart the answers are."""
RUN = ["--params-file", CONFIG, "-p", f"latitude:={LATITUDE}"]
LIMIT = 400.0
"""Seconds, which also lets a first run compile."""


@pytest.fixture(scope="module")
def table_bag(tmp_path_factory):
    """Return a bag of a turntable with navigation-grade sensors at 50 Hz."""
    bag = tmp_path_factory.mktemp("bags") / "table"
    simulate_bag_main(["turntable_navigation", str(bag), "--duration", "148", "--imu-rate", "50",
                       "--seed", "6"])
    return bag


def stamp_of(raw):
    return int.from_bytes(raw[4:8], "little") * 10**9 + int.from_bytes(raw[8:12], "little")


def time_of(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def values_of(status):
    return {entry.key: entry.value for entry in status.values}


def test_a_replayed_table_is_aligned(bench, table_bag):
    node = bench.start_ready(*RUN, name="alignment_node")
    peer = bench.peer()
    heard = {topic: peer.hear(kind, topic, raw=False) for topic, kind in (
        ("alignment/level", Vector3Stamped), ("alignment/attitude", Imu),
        ("alignment/heading", PoseWithCovarianceStamped), ("alignment/status", DiagnosticStatus),
        ("table/command", Float64))}
    bench.play(peer, table_bag, "in_flight:=100", answers="alignment/attitude")
    end_ns = read_recording(table_bag).imu.stamp_ns[-1] - ANSWER_PERIOD_NS
    for topic in ("alignment/attitude", "alignment/level", "alignment/heading"):
        bench.wait_until(lambda topic=topic: heard[topic] and time_of(heard[topic][-1]) > end_ns, f"the last {topic}")
    bench.diagnostics(peer, "alignment_node", "alignment").next()
    bench.wait_until(lambda: values_of(heard["alignment/status"][-1])["dwells"] == "8", "eight dwells")

    message = heard["alignment/heading"][-1]
    assert message.header.frame_id == "map"
    orientation, sigma = message.pose.pose.orientation, math.sqrt(message.pose.covariance[35])
    yaw = 2.0 * math.atan2(orientation.z, orientation.w)
    assert abs(math.remainder(yaw - (0.5 * math.pi - HEADING), 2 * math.pi)) < SIGMAS * sigma
    assert 0.0 < math.degrees(sigma) < 0.15

    attitude = heard["alignment/attitude"]
    known = [message.orientation_covariance[0] >= 0.0 for message in attitude]
    assert not known[0] and known[-1] and all(known[known.index(True):])
    last = attitude[-1]
    assert last.header.frame_id == "base_link"
    assert np.linalg.eigvalsh(last.orientation_covariance.reshape(3, 3)).min() > 0.0
    q = last.orientation
    roll, pitch, heading = euler_from_dcm(dcm_from_quaternion(q_nb_from_orientation([q.x, q.y, q.z, q.w])))
    assert (roll, pitch) == pytest.approx((ROLL, PITCH), abs=LEVEL_SIGMA)
    assert math.remainder(float(heading) - (0.5 * math.pi - yaw), 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
    level = heard["alignment/level"][-1].vector
    assert (level.x, level.y, level.z) == pytest.approx((ROLL, -PITCH, 0.0), abs=LEVEL_SIGMA)
    first, first_known = heard["alignment/level"][0].header.stamp, attitude[known.index(True)].header.stamp
    assert first.sec < first_known.sec, "the level is there long before the heading"

    statuses = heard["alignment/status"]
    phases = list(dict.fromkeys(values_of(status)["phase"] for status in statuses))
    assert phases[-3:] == ["coarse", "positions", "aligned"]
    values = values_of(statuses[-1])
    assert math.radians(float(values["heading_deg"])) == pytest.approx(0.5 * math.pi - yaw, abs=1e-4)
    assert {"method", "heading_sigma_deg", "heading_floor_deg", "gyro_bias_deg_h", "gyro_scale", "chi2",
            "flags", "time_to_target_s", "next_joint_rad"} <= set(values)
    wanted = list(dict.fromkeys(round(message.data, 6) for message in heard["table/command"]))
    quarter = round(0.5 * math.pi, 6)
    assert wanted[:2] == [0.0, -quarter], "a joint turns the other way round than a table angle"
    assert node.finish(signal.SIGINT) == 0 and "rror" not in node.said


def test_services_latitude_by_fix_and_sigterm(bench):
    node = bench.start_ready("--params-file", CONFIG, name="alignment_node")
    peer = bench.peer()
    statuses = peer.hear(DiagnosticStatus, "alignment/status", raw=False)
    answer = peer.call(Trigger, "/alignment_node/next_position")
    assert answer.success and "turn the joint to 0.000000 rad" in answer.message
    assert "stopped after 0 dwells" in peer.call(Trigger, "/alignment_node/stop").message
    assert not peer.call(Trigger, "/alignment_node/next_position").success
    bench.wait_until(lambda: statuses and values_of(statuses[-1])["phase"] == "stopped", "phase stopped")
    for service in ("start", "reset"):
        assert peer.call(Trigger, f"/alignment_node/{service}").success
    bench.wait_until(lambda: values_of(statuses[-1])["phase"] == "waiting", "phase waiting")
    assert values_of(statuses[-1])["latitude_deg"] == "unknown"
    assert "no usable imu/data_raw yet" in statuses[-1].message
    fix = peer.publisher(NavSatFix, "fix", ReliabilityPolicy.RELIABLE)
    fix.publish(NavSatFix(latitude=35.0))
    bench.wait_until(lambda: values_of(statuses[-1])["latitude_deg"] == "35", "the latitude of fix")
    assert node.finish(signal.SIGTERM) == 0


def test_bad_input_is_told_and_survived(bench):
    bench.start_ready(*RUN, "-p", "dwell_time:=2.0", "-p", "joint_name:=table", name="alignment_node")
    peer = bench.peer()
    diagnostics, answers = bench.diagnostics(peer, "alignment_node", "alignment"), peer.hear(Imu, "alignment/attitude")
    imu, joints = peer.publisher(Imu, "imu/data_raw"), peer.publisher(JointState, "joint_states")

    def wait_for_answer(stamp_ns):
        bench.wait_until(lambda: answers and stamp_of(answers[-1]) > stamp_ns - ANSWER_PERIOD_NS, "an answer")

    joints.publish(encode_joints(10**18, "", {"wheel": 0.0, "arm": 0.0}))
    diagnostics.told("no joint table; joints there: wheel, arm")
    joints.publish(encode_joints(0, "", {"table": 0.0}))
    diagnostics.told("joint_states: no valid stamp")
    joints.publish(encode_joints(10**18, "", {"table": math.nan}))
    diagnostics.told("position of the joint is nan")
    # The joint stands, the sensors say that the table rocks.
    encoder, rng = StampedEncoder(IMU, "imu"), np.random.default_rng(0)
    for k in range(400):
        values = np.zeros(37)
        values[13:16] = 1e-6 * rng.standard_normal(3)
        values[25:28] = [0.1 * math.sin(0.01 * k), 0.0, 9.8]
        stamp_ns = 10**18 + 10_000_000 * k
        joints.publish(encode_joints(stamp_ns, "", {"table": 0.0}))
        imu.publish(encoder.encode(stamp_ns, values))
        if k % BURST == BURST - 1:
            wait_for_answer(stamp_ns)
    report = diagnostics.told("rejected: not still: the x accelerometer changed")
    assert values_of(report)["dwells"] == "0"
    imu.publish(encoder.encode(10**15, values))
    diagnostics.wait_for(lambda status: values_of(status).get("stamp_jump_back") == "1", "stamps that went back")


@pytest.mark.parametrize("given, reason", [
    ("method:=ekf11", "must be one of"),
    ("latitude:=35.0", "latitude = 35.0 rad"), ("sequence:=random", "sequence")])
def test_parameters_that_cannot_be_end_the_start_in_one_line(bench, given, reason):
    node = bench.start("alignment_node", "-p", given)
    assert node.finish() == 2
    assert reason in node.said and len(node.said.strip().splitlines()) == 1


def align_bag(*arguments):
    done = subprocess.run([executable("align_bag"), *map(str, arguments)], capture_output=True, text=True,
                          timeout=LIMIT, stdin=subprocess.DEVNULL)
    return done.returncode, done.stdout, done.stderr


def test_align_bag_finds_the_heading_and_compares_the_methods(table_bag):
    assert read_recording(table_bag).truth is not None
    status, out, _ = align_bag(table_bag, "--latitude", math.degrees(LATITUDE), "--params", CONFIG, "--json")
    report = json.loads(out)
    assert status == 0 and report["believable"] and report["refusal"] == "" and report["dwells"] == 8
    error_deg = math.remainder(report["heading_deg"] - math.degrees(HEADING), 360.0)
    assert abs(error_deg) < SIGMAS * report["heading_sigma_deg"]
    assert {"phase", "method", "roll_deg", "pitch_deg", "heading_floor_deg", "chi2", "flags",
            "time_to_target_s", "gyro_bias_deg_h", "gyro_scale", "rejections", "turning"} <= set(report)
    assert {"joint", "azimuth_1a", "azimuth_4"} <= set(report["heading_methods"])
    assert {"joint", "levelling_1"} <= set(report["levelling_methods"])
    status, out, _ = align_bag(table_bag, "--latitude", 35, "--params", CONFIG, "--method", "azimuth_4")
    assert status == 0 and "clockwise from true north" in out and "azimuth_1b" in out


def test_align_bag_without_a_latitude_gives_the_level_and_status_1(table_bag):
    status, out, _ = align_bag(table_bag, "--params", CONFIG)
    assert status == 1 and "roll " in out and "heading   none: the latitude is not known" in out


@pytest.mark.parametrize("arguments, reason", [
    (("--latitude", 91), "must be from -90 to 90 deg"),
    (("-p", "dwel_time:=1.0"), "did you mean dwell_time?"),
    (("--topic", "joints:=/other"), "no topic /other"),
    (("-p", "joint_name:=arm"), "no joint arm; joints there: table_joint")])
def test_align_bag_tells_bad_input_in_one_line(table_bag, arguments, reason):
    status, out, said = align_bag(table_bag, *arguments)
    assert status == 2 and out == "" and reason in said and len(said.strip().splitlines()) == 1
