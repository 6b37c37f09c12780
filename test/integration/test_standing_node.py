"""alignment_node and align_bag with a standing vehicle: phases, a move, latitude, bad input, the same offline."""

import contextlib
import io
import json
import math
import signal

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from geometry_msgs.msg import PoseWithCovarianceStamped, Vector3Stamped  # noqa: E402
from rclpy.qos import ReliabilityPolicy  # noqa: E402
from sensor_msgs.msg import Imu, NavSatFix  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from alignment.cli import main as align_bag_main  # noqa: E402
from alignment.standing.params import STANDING_METHODS  # noqa: E402
from inertial.parked_scenarios import MOVE  # noqa: E402
from inertial.rotation import (  # noqa: E402
    quaternion_conjugate,
    quaternion_log,
    quaternion_multiply,
    quaternion_slerp,
)
from inertial.table_scenarios import LATITUDE  # noqa: E402
from nav_ros.bags import read_recording  # noqa: E402
from nav_ros.cli import simulate_bag_main  # noqa: E402
from nav_ros.frames import q_nb_from_orientation  # noqa: E402
from nav_ros.messages import IMU, StampedEncoder  # noqa: E402
from nav_ros.resources import bundled_config  # noqa: E402

CONFIG = bundled_config("alignment_standing.yaml")
GIVEN = {"coarse_window": 15.0, "target_std": 0.025}
DURATION, IMU_RATE = 100.0, 50.0  # s, Hz
SIGMAS = 4.0
"""Of the heading, for one fixed seed."""
TILT_TOLERANCE = 5e-4  # rad, half of what people lean the vehicle: the sensors allow a tenth
MOVE_NS = round(1e9 * MOVE)
FIVE_SECONDS_NS = 5_000_000_000
ANSWER_PERIOD_NS = 200_000_000
"""Twice that of the output: a solution is as old as the last block of samples that went into it."""


@pytest.fixture(scope="module")
def moved_bag(tmp_path_factory):
    """Return a bag of a parked vehicle that drives to another place in the middle."""
    bag = tmp_path_factory.mktemp("bags") / "moved"
    simulate_bag_main(["parked_navigation_moved", str(bag), "--duration", str(DURATION), "--imu-rate",
                       str(IMU_RATE), "--seed", "3"])
    return bag


def values_of(status):
    return {entry.key: entry.value for entry in status.values}


def stamp_of(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def align_bag(*arguments):
    """Return exit status, output and error output of align_bag in this process."""
    out, said = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
        try:
            status = align_bag_main([str(argument) for argument in arguments])
        except SystemExit as end:
            status = end.code
    return status, out.getvalue(), said.getvalue()


def errors_of(messages, recording):
    """Return the small rotations about north, east, down by which attitudes are off the truth, (N, 3)."""
    q_nb = q_nb_from_orientation([[message.orientation.x, message.orientation.y, message.orientation.z,
                                   message.orientation.w] for message in messages])
    truth, stamp_ns = recording.truth, np.array([stamp_of(message) for message in messages])
    k = np.clip(np.searchsorted(truth.stamp_ns, stamp_ns), 1, len(truth) - 1)
    share = (stamp_ns - truth.stamp_ns[k - 1]) / (truth.stamp_ns[k] - truth.stamp_ns[k - 1])
    truth_q_nb = quaternion_slerp(truth.q_nb_wxyz[k - 1], truth.q_nb_wxyz[k], share)
    return quaternion_log(quaternion_multiply(q_nb, quaternion_conjugate(truth_q_nb)))


def test_a_vehicle_is_aligned_again_after_a_move_and_offline_as_online(bench, moved_bag):
    given = [word for name, value in (GIVEN | {"latitude": LATITUDE}).items() for word in ("-p", f"{name}:={value}")]
    node = bench.start_ready("--params-file", CONFIG, *given, name="alignment_node")
    peer = bench.peer()
    heard = {topic: peer.hear(kind, topic, raw=False) for topic, kind in (
        ("alignment/level", Vector3Stamped), ("alignment/attitude", Imu),
        ("alignment/heading", PoseWithCovarianceStamped), ("alignment/status", DiagnosticStatus))}
    bench.play(peer, moved_bag, "in_flight:=50", answers="alignment/attitude")
    recording = read_recording(moved_bag)
    end_ns = recording.imu.stamp_ns[-1] - ANSWER_PERIOD_NS
    bench.wait_until(lambda: stamp_of(heard["alignment/attitude"][-1]) > end_ns, "the last answer")
    assert "stopped after" in peer.call(Trigger, "/alignment_node/stop").message
    statuses = heard["alignment/status"]
    bench.wait_until(lambda: values_of(statuses[-1])["phase"] == "stopped", "phase stopped")

    middle_ns = recording.truth.stamp_ns[0] + round(0.5e9 * DURATION)
    attitude = heard["alignment/attitude"]
    stamps = np.array([stamp_of(message) for message in attitude])
    known = np.array([message.orientation_covariance[0] >= 0.0 for message in attitude])
    assert not known[abs(stamps - middle_ns) < FIVE_SECONDS_NS].any(), "while it drives there is no attitude"
    assert known[stamps < middle_ns - MOVE_NS // 2].any() and known[-1]
    believed = [message for message, there in zip(attitude, known, strict=True) if there]
    turns_n = errors_of(believed, recording)
    heading_std = np.sqrt([message.orientation_covariance[8] for message in believed])
    assert np.max(np.abs(turns_n[:, 2]) / heading_std) < SIGMAS and heading_std[-1] < GIVEN["target_std"]
    assert np.abs(turns_n[:, :2]).max() < TILT_TOLERANCE
    assert heard["alignment/heading"][-1].pose.covariance[35] == pytest.approx(heading_std[-1] ** 2)
    assert stamp_of(heard["alignment/level"][0]) < stamps[known][0], "the level is there before the heading"

    phases = [values_of(status)["phase"] for status in statuses]
    changes = [phase for phase, last in zip(phases, ["", *phases], strict=False) if phase != last]
    assert changes[:5] == ["waiting", "coarse", "fine", "aligned", "waiting"]
    assert changes[-2:] == ["aligned", "stopped"]
    assert any("the vehicle moves" in status.message for status in statuses)

    values = values_of(statuses[-1])
    options = [word for name, value in GIVEN.items() for word in ("-p", f"{name}:={value}")]
    status, out, _ = align_bag(moved_bag, "--latitude", math.degrees(LATITUDE), "--params", CONFIG, "--json",
                               *options)
    report = json.loads(out)
    assert status == 0 and report["phase"] == "aligned" and report["believable"]
    for key in ("method", "heading_deg", "heading_sigma_deg", "heading_floor_deg", "roll_deg", "nis",
                "gyro_bias_x_deg_h", "accel_bias_sigma_z_mg", "target_sigma_deg", "time_to_target_s"):
        text = report[key] if isinstance(report[key], str) else f"{report[key]:.6g}"
        assert text == values[key], key
    assert set(report["heading_methods"]) == set(STANDING_METHODS)
    assert node.finish(signal.SIGINT) == 0 and "rror" not in node.said


def test_latitude_by_fix_services_and_wrong_units(bench):
    node = bench.start_ready("--params-file", CONFIG, name="alignment_node")
    peer = bench.peer()
    statuses = peer.hear(DiagnosticStatus, "alignment/status", raw=False)
    imu = peer.publisher(Imu, "imu/data_raw")
    encoder, rng = StampedEncoder(IMU, "imu"), np.random.default_rng(0)
    stamp_ns = 10**18

    def feed(seconds, gravity):
        nonlocal stamp_ns
        for _ in range(round(20 * seconds)):
            stamp_ns += 50_000_000
            values = np.zeros(37)
            values[13:16] = 6e-5 + 1e-6 * rng.standard_normal(3)
            values[25:28] = [0.0, 0.0, gravity] + 1e-4 * rng.standard_normal(3)
            imu.publish(encoder.encode(stamp_ns, values))

    def told(text):
        bench.wait_until(lambda: any(text in status.message for status in statuses[-5:]), repr(text))

    feed(5.0, 9.8)
    told("latitude is not known")
    fix = peer.publisher(NavSatFix, "fix", ReliabilityPolicy.RELIABLE)
    fix.publish(NavSatFix(latitude=35.0))
    bench.wait_until(lambda: values_of(statuses[-1])["latitude_deg"] == "35", "the latitude of fix")
    feed(5.0, 9.8)
    bench.wait_until(lambda: values_of(statuses[-1])["phase"] == "coarse", "phase coarse")
    assert peer.call(Trigger, "/alignment_node/reset").success
    feed(5.0, 1.0)
    told("in g")
    assert statuses[-1].level == DiagnosticStatus.ERROR
    assert "stopped after" in peer.call(Trigger, "/alignment_node/stop").message
    bench.wait_until(lambda: values_of(statuses[-1])["phase"] == "stopped", "phase stopped")
    assert "keep the vehicle still" in peer.call(Trigger, "/alignment_node/start").message
    assert node.finish(signal.SIGTERM) == 0


def test_align_bag_reads_for_a_person_and_tells_bad_input_in_one_line(tmp_path):
    short, turning = tmp_path / "short", tmp_path / "turning"
    for scenario, bag in (("parked_navigation", short), ("parked_navigation_two_position", turning)):
        simulate_bag_main([scenario, str(bag), "--duration", "12", "--imu-rate", "20"])
    status, out, _ = align_bag(turning, "--latitude", 35)
    assert status == 2 and out == ""
    status, out, _ = align_bag(short, "--latitude", 35)
    assert status == 1 and "heading   none: the coarse alignment is under way" in out
    assert "roll " in out and "riekf6" in out
    status, out, _ = align_bag(short)
    assert status == 1 and "none: the latitude is not known" in out
    for arguments, reason in (
            (("--method", "joint"), "no topic /joint_states; topics there: /ground_truth/attitude"),
            (("--method", "ekf10", "--topic", "imu:=/other"), "no topic /other"),
            (("-p", "coarse_windw:=1.0"), "did you mean coarse_window?"),
            (("--latitude", 91), "must be from -90 to 90 deg")):
        status, out, said = align_bag(short, *arguments)
        assert status == 2 and out == "" and reason in said and len(said.strip().splitlines()) == 1
