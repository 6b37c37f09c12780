"""navigation_node as a real process, and navigate_bag: a flight with a receiver that loses the sky, bad input."""

import json
import math
import signal

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from geometry_msgs.msg import Vector3Stamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterValue  # noqa: E402
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.serialization import deserialize_message  # noqa: E402
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from attitude_estimator.navigation.cli import main as navigate_bag_main  # noqa: E402
from attitude_estimator.navigation.edge import OUTPUT_TYPES  # noqa: E402
from attitude_estimator.navigation.params import NavigationParams  # noqa: E402
from inertial.flight_scenarios import Receiver  # noqa: E402
from nav_ros.bags import BagReader, BagWriter, read_messages  # noqa: E402
from nav_ros.bias_file import read_biases  # noqa: E402
from nav_ros.cli import score_bag_main, simulate_bag_main  # noqa: E402
from nav_ros.messages import DOUBLES, IMU, POSE_COVARIANCE, POSE_POSITION, StampedEncoder  # noqa: E402

TYPES = {"imu/data": Imu, "odometry": Odometry, "imu/gyro_bias": Vector3Stamped, "imu/accel_bias": Vector3Stamped}
SAME = 1e-9
"""The same session on the same bytes."""
DURATION, IMU_RATE = 33.0, 50.0  # s, Hz: ends in the first dropout
LOST = DURATION - Receiver.dropout_start
AIDED_ERROR = 1.0  # m, with fixes of 1 m of noise five times a second
SIGMAS = 4.0
"""Of each component of the position, for one fixed seed."""
TILT_RMS_DEG = 1.0
UNKNOWN = 1e6
TRUTHS = ["/ground_truth/attitude", "/ground_truth/odometry"]


@pytest.fixture(scope="module")
def flight_bag(tmp_path_factory):
    """Return a bag of a flight that ends while the sky is lost."""
    bag = tmp_path_factory.mktemp("bags") / "flight"
    simulate_bag_main(["flight_with_gps", str(bag), "--duration", str(DURATION), "--imu-rate", str(IMU_RATE)])
    return bag


@pytest.fixture(scope="module")
def navigated(flight_bag, tmp_path_factory):
    """Return the bag that navigate_bag makes of it, each message written."""
    out = tmp_path_factory.mktemp("navigated") / "out"
    navigate_bag_main([str(flight_bag), str(out), "-p", "auxiliary_rate:=0.0"])
    return out


@pytest.fixture(scope="module")
def bias_file(tmp_path_factory):
    """Return the path of a file that is not there yet."""
    return tmp_path_factory.mktemp("biases") / "biases.yaml"


@pytest.fixture(scope="module")
def open_node(open_bench, bias_file):
    """Return a bench and a navigation_node for all tests of this file."""
    with open_bench() as bench:
        yield bench, bench.start_ready("-p", "auxiliary_rate:=0.0", "-p", "fix_stdd:=2.0",
                                       "-p", f"bias_file:={bias_file}", name="navigation_node")


def stamps_of(raws):
    return np.array([int.from_bytes(raw[4:8], "little") * 10**9 + int.from_bytes(raw[8:12], "little")
                     for raw in raws])


def doubles_of(raws, topic):
    size = 8 * DOUBLES[OUTPUT_TYPES[topic]]
    return np.frombuffer(b"".join(raw[-size:] for raw in raws)).reshape(len(raws), -1)


def values_of(status):
    return {entry.key: entry.value for entry in status.values}


def raws_on(bag, topic):
    return [message.raw for message in read_messages(bag, [topic])]


def test_the_node_and_navigate_bag_publish_the_same(open_node, flight_bag, navigated):
    bench, node = open_node
    assert "there is no parameter fix_stdd; did you mean fix_std?" in node.said
    peer = bench.peer()
    diagnostics = bench.diagnostics(peer, "navigation_node", "navigation")
    heard = {topic: peer.hear(kind, topic) for topic, kind in TYPES.items()}
    bench.replay(peer, flight_bag, "in_flight:=1")
    for topic, raws in heard.items():
        offline = raws_on(navigated, f"/{topic}")
        bench.wait_until(lambda raws=raws, offline=offline: len(raws) >= len(offline), f"all of {topic}")
        size = 8 * DOUBLES[OUTPUT_TYPES[topic]]
        assert len(offline) > 0.9 * DURATION * IMU_RATE
        assert [raw[:-size] for raw in raws] == [raw[:-size] for raw in offline]
        np.testing.assert_allclose(doubles_of(raws, topic), doubles_of(offline, topic), rtol=SAME, atol=SAME)

    report = diagnostics.next()
    values = values_of(report)
    assert values["phase"].startswith("coasting for ") and "coasting: no fix and no velocity" in report.message
    assert float(values["phase"].split()[2]) == pytest.approx(LOST, abs=0.5)
    assert int(values["no_fix"]) == round(LOST * Receiver.rate)
    assert float(values["origin_latitude_deg"]) == pytest.approx(35.0, abs=1e-4)
    for name in ("fix", "velocity", "altitude"):
        assert int(values[f"{name}_used"]) > 100 and 0.5 < float(values[f"{name}_nis"]) < 2.0
    assert "origin at " in node.said


def test_bad_messages_and_a_reset_do_not_end_the_node(open_node, bias_file):
    bench, node = open_node
    peer = bench.peer()
    diagnostics = bench.diagnostics(peer, "navigation_node", "navigation")
    before = values_of(diagnostics.next())
    fix = peer.publisher(NavSatFix, "fix")
    message = NavSatFix(latitude=math.nan)
    message.status.status = NavSatStatus.STATUS_FIX
    message.header.stamp.sec = 1_700_000_100
    fix.publish(message)
    message.latitude, message.header.stamp.sec = 35.0, 0
    fix.publish(message)
    fix.publish(b"\x00\x01\x00\x00short")
    report = diagnostics.wait_for(
        lambda status: int(values_of(status)["fix_messages"]) == int(before["fix_messages"]) + 3, "three fixes")
    for name in ("fix_invalid", "fix_no_stamp", "malformed"):
        assert values_of(report)[name] == "1", name
    parameter = Parameter(name="fix_std", value=ParameterValue(type=3, double_value=-1.0))
    (result,) = peer.call(SetParameters, "/navigation_node/set_parameters", parameters=[parameter]).results
    assert not result.successful and "fix_std" in result.reason

    assert peer.call(Trigger, "/navigation_node/reset").success
    feed, odometry = bench.feed(peer), peer.hear(Odometry, "odometry")
    feed.start(2.0)
    bench.wait_until(lambda: odometry, "odometry of the level phase")
    first = deserialize_message(odometry[0], Odometry)
    variances = first.pose.covariance.reshape(6, 6).diagonal()
    assert variances[[0, 1, 5]].tolist() == [UNKNOWN] * 3 and 0.0 < variances[3] < 1.0
    assert (first.header.frame_id, first.child_frame_id) == ("map", "imu_link")
    status = diagnostics.told("waiting for a heading")
    assert values_of(status)["phase"] == "start"
    assert node.finish(signal.SIGINT) == 0 and "Traceback" not in node.said
    assert max(read_biases(bias_file).gyro_bias_std) < NavigationParams().gyro_bias_std, "kept for the next run"


@pytest.mark.parametrize(("argument", "reason"), [
    ("estimator:=magic", "estimator = 'magic': must be one of eskf15, cascade"),
    ("antenna_position:=[1.0]", "antenna_position needs 3 values, got 1")])
def test_a_wrong_parameter_is_told_in_one_line(bench, argument, reason):
    node = bench.start("navigation_node", "-p", argument)
    assert node.finish() == 2
    (line,) = node.said.splitlines()
    assert line.startswith("navigation_node: ") and reason in line


def test_the_position_is_true_within_its_covariance_also_while_it_coasts(navigated):
    raws, truth = raws_on(navigated, "/odometry"), raws_on(navigated, "/ground_truth/odometry")
    stamps, true_stamps = stamps_of(raws), stamps_of(truth)
    place = np.searchsorted(true_stamps, stamps)
    assert (true_stamps[place] == stamps).all()
    values = doubles_of(raws, "odometry")
    errors = values[:, POSE_POSITION] - doubles_of(truth, "odometry")[place, POSE_POSITION]
    variances = values[:, POSE_COVARIANCE].reshape(-1, 6, 6).diagonal(axis1=1, axis2=2)[:, :3]
    seconds = (stamps - true_stamps[0]) * 1e-9
    known = seconds > 10.0
    assert (np.abs(errors[known]) < SIGMAS * np.sqrt(variances[known])).all()
    aided = known & (seconds < Receiver.dropout_start)
    assert np.sqrt(np.mean(np.sum(errors[aided] ** 2, axis=1))) < AIDED_ERROR
    assert np.sqrt(variances[-1, :2]).min() > 2.0 * np.sqrt(variances[aided, :2]).max(), "it knows that it coasts"


def test_score_bag_takes_it_and_the_truth_is_copied(flight_bag, navigated, capsys):
    score_bag_main([str(navigated), "--json"])
    score = json.loads(capsys.readouterr().out)
    assert score["tilt_rms_deg"] < TILT_RMS_DEG and score["coverage_3sigma"] > 0.95
    for topic in TRUTHS:
        assert raws_on(navigated, topic) == raws_on(flight_bag, topic)
    with BagReader(navigated) as bag:
        assert set(bag.types) == {*TRUTHS, *(f"/{topic}" for topic in TYPES)}


def test_other_topics_without_a_fix_and_what_cannot_be_read(flight_bag, tmp_path, capsys):
    with BagReader(flight_bag) as reader:
        names = {"/imu/data_raw": "/my/imu", "/velocity": "/my/velocity"}
        with BagWriter(tmp_path / "other", {name: reader.types[old] for old, name in names.items()}) as writer:
            for topic, receive_ns, raw in reader.messages(names):
                writer.write(names[topic], receive_ns, raw)
    remaps = ["--topic", "imu:=/my/imu", "--topic", "velocity:=/my/velocity"]
    navigate_bag_main([str(tmp_path / "other"), str(tmp_path / "out"), *remaps])
    said = capsys.readouterr().out
    assert f"{round(DURATION * IMU_RATE)} estimates" in said and "velocity" in said and "  fix" not in said

    with BagWriter(tmp_path / "unusable", {"/imu/data_raw": IMU}) as writer:
        for stamp_ns in range(5):
            writer.write("/imu/data_raw", stamp_ns, StampedEncoder(IMU, "imu").encode(0, np.zeros(DOUBLES[IMU])))
    out = tmp_path / "none"
    for arguments, reason in (
            ([tmp_path / "unusable", out], "no usable IMU sample on /imu/data_raw: imu_no_stamp 5; fixed_dt is"),
            ([flight_bag, out, "--topic", "fix:=/my/fix"], "no topic /my/fix (sensor_msgs/msg/NavSatFix is on /fix)"),
            ([tmp_path / "other", out], "no topic /imu/data_raw (sensor_msgs/msg/Imu is on /my/imu); topics there"),
            ([flight_bag, out, "--topic", "fix:=/velocity"], "expected sensor_msgs/msg/NavSatFix"),
            ([flight_bag, out, "-p", "fix_stdd:=1.0"], "did you mean fix_std?"),
            ([flight_bag, out, "-p", "fix_std:=-1.0"], "fix_std = -1.0 m: must be from"),
            ([flight_bag, tmp_path / "out"], "exists already")):
        with pytest.raises(SystemExit) as end:
            navigate_bag_main([str(argument) for argument in arguments])
        errors = capsys.readouterr().err
        assert end.value.code == 2 and errors.count("\n") == 1 and reason in errors, errors
        assert not out.exists()
