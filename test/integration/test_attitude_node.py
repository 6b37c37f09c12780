"""attitude_node as a real process: what it publishes, its parameters, services, names, time and end."""

import importlib
import math
import re
import signal

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from geometry_msgs.msg import PointStamped, Vector3Stamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterValue  # noqa: E402
from rcl_interfaces.srv import GetParameters, SetParameters  # noqa: E402
from rclpy.parameter import parameter_value_to_python  # noqa: E402
from rclpy.serialization import deserialize_message  # noqa: E402
from sensor_msgs.msg import Imu  # noqa: E402
from std_srvs.srv import SetBool, Trigger  # noqa: E402

from attitude_estimator.cli import main as estimate_bag_main  # noqa: E402
from attitude_estimator.edge import OUTPUT_TYPES  # noqa: E402
from nav_ros.bags import read_messages, read_recording  # noqa: E402
from nav_ros.estimated import attitude_run  # noqa: E402
from nav_ros.messages import DOUBLES, POINT, StampedEncoder  # noqa: E402

TYPES = {"imu/data": Imu, "imu/rpy/filtered": Vector3Stamped, "attitude/state": Odometry,
         "imu/gyro_bias": Vector3Stamped, "imu/accel_bias": Vector3Stamped}
SAME = 1e-9
"""The same kernels on the same samples: what is left is the last bits of a matrix product."""
TILT_RMS_DEG = 2.0
"""A coarse limit, of simulated turns with a consumer's IMU and of a hand-held recording's first seconds."""
NEES = 4.0
"""Twice the ideal: the covariance does not promise much more than is true."""
UNKNOWN = 1e6
RATE_SHARE = 1e-3
TILT_STD = 0.006
"""rad; of the attitude at rest, after seconds of averaging ACCEL_STD / g per sample."""
ROLL, PITCH = 0.1, -0.05
AUXILIARY_PERIOD_NS = 50_000_000


class Run:
    """Everything that the node published for a bag, and the bag that the offline tool made of it."""

    def __init__(self, bag, folder, bench, *parameters):
        self.bag = bag
        self.sent = [message.raw for message in read_messages(bag, ["/imu/data_raw"])]
        given = [item for text in ("auxiliary_rate:=0.0", *parameters) for item in ("-p", text)]
        bench.start_ready(*given)
        peer = bench.peer()
        diagnostics = bench.diagnostics(peer)
        self.heard = {topic: peer.hear(kind, topic) for topic, kind in TYPES.items()}
        bench.replay(peer, bag, "in_flight:=1")
        self.report = diagnostics.next()
        estimate_bag_main([str(bag), str(folder / "estimated"), *given])
        self.offline = {topic: [message.raw for message in read_messages(folder / "estimated", [f"/{topic}"])]
                        for topic in TYPES}

    def messages(self, topic):
        return [deserialize_message(raw, TYPES[topic]) for raw in self.heard[topic]]


@pytest.fixture(scope="module", params=["turn_bag", "real_bag"])
def run(request, tmp_path_factory, open_bench):
    bag = request.getfixturevalue(request.param)
    with open_bench() as bench:
        yield Run(bag, tmp_path_factory.mktemp("offline"), bench)


def test_each_sample_has_one_answer_at_its_stamp(run):
    assert [raw[4:12] for raw in run.heard["imu/data"]] == [raw[4:12] for raw in run.sent]


def test_the_attitude_is_true_within_its_covariance(run):
    score = attitude_run(run.heard["imu/data"], read_recording(run.bag).truth).score()
    assert score.tilt_rms_deg < TILT_RMS_DEG
    assert score.nees < NEES
    assert score.skipped_s < 1.0


def same(run, topic):
    """Return for each message on a topic whether the node and the offline tool made the same, (N,) bool."""
    heard, offline = run.heard[topic], run.offline[topic]
    doubles = 8 * DOUBLES[OUTPUT_TYPES[topic]]
    assert [raw[:-doubles] for raw in heard] == [raw[:-doubles] for raw in offline]
    values, expected = (np.frombuffer(b"".join(raw[-doubles:] for raw in raws)).reshape(len(raws), -1)
                        for raws in (heard, offline))
    return np.isclose(values, expected, rtol=SAME, atol=SAME).all(axis=1)


@pytest.mark.parametrize("topic", TYPES)
def test_estimate_bag_writes_what_the_node_publishes(run, topic):
    assert len(run.heard[topic]) > 100 and same(run, topic).all()


def test_a_clean_run_counts_no_fault(run):
    assert counters(run.report) == {}
    values = {entry.key: entry.value for entry in run.report.values}
    assert int(values["imu_messages"]) == len(run.sent)
    stamps = read_recording(run.bag).imu.stamp_ns
    last = stamps[-1000:]
    rate = (len(last) - 1) * 1e9 / (last[-1] - last[0])
    assert float(values["imu_rate_hz"]) == pytest.approx(rate, rel=RATE_SHARE)


def counters(report):
    """Return the counters of faults that are not zero."""
    others = ("_messages", "_hz", "_publishers", "_subscribers")
    return {entry.key: int(entry.value) for entry in report.values
            if entry.value.isdigit() and entry.value != "0" and not entry.key.endswith(others)}


def test_unknown_at_first_then_known_with_a_covariance(run):
    messages = run.messages("imu/data")
    known = [message.orientation_covariance[0] >= 0.0 for message in messages]
    first = known.index(True)
    assert all(known[first:])
    for message in messages[:first]:
        assert message.orientation_covariance.tolist() == [-1.0] + [0.0] * 8
        assert (message.orientation.w, message.orientation.x) == (1.0, 0.0)
    for message in messages[first:]:
        assert np.linalg.eigvalsh(message.orientation_covariance.reshape(3, 3)).min() > 0.0
    stamps = [raw[4:12] for raw in run.heard["imu/data"]]
    assert all(stamps.index(raw[4:12]) >= first for raw in run.heard["imu/rpy/filtered"])


def test_frames_and_what_is_unknown_says_so(run):
    frame = deserialize_message(run.sent[0], Imu).header.frame_id
    frames = {topic: {message.header.frame_id for message in run.messages(topic)} for topic in TYPES}
    assert frames == {topic: {"odom" if topic == "attitude/state" else frame} for topic in TYPES}
    for message in run.messages("attitude/state"):
        assert message.child_frame_id == f"{frame}_stabilized"
        for covariance in (message.pose.covariance, message.twist.covariance):
            variances = covariance.reshape(6, 6).diagonal()
            assert variances[[0, 1, 3, 4, 5]].tolist() == [UNKNOWN] * 5
            assert 0.0 < variances[2] < UNKNOWN


def test_roll_pitch_yaw_are_those_of_the_orientation(run):
    orientations = {(imu.header.stamp.sec, imu.header.stamp.nanosec): imu.orientation
                    for imu in run.messages("imu/data")}
    for message in run.messages("imu/rpy/filtered"):
        q = orientations[message.header.stamp.sec, message.header.stamp.nanosec]
        roll = math.atan2(2 * (q.w * q.x + q.y * q.z), 1 - 2 * (q.x**2 + q.y**2))
        pitch = math.asin(2 * (q.w * q.y - q.z * q.x))
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
        vector = message.vector
        assert (vector.x, vector.y, vector.z) == pytest.approx((roll, pitch, yaw), abs=SAME)


def set_parameter(peer, name, value, node="attitude_node"):
    parameter = Parameter(name=name, value=value)
    (result,) = peer.call(SetParameters, f"/{node}/set_parameters", parameters=[parameter]).results
    return result


def get_parameter(peer, name, node="attitude_node"):
    (value,) = peer.call(GetParameters, f"/{node}/get_parameters", names=[name]).values
    return parameter_value_to_python(value)


def double(value):
    return ParameterValue(type=3, double_value=value)


def text(value):
    return ParameterValue(type=4, string_value=value)


def test_parameters_and_services_of_a_running_node(bench):
    node = bench.start_ready("-p", "gyro_nose_density:=0.1")
    assert node.said.count("there is no parameter gyro_nose_density; did you mean gyro_noise_density?") == 1
    peer = bench.peer()
    assert peer.call(Trigger, "/attitude_node/level").success is False

    refused = {
        ("gyro_noise_density", math.nan): "gyro_noise_density",
        ("gyro_noise_density", -1.0): "gyro_noise_density",
        ("gyro_noise_density", "fast"): "must be a number",
        ("world_frame", "map"): "read-only", ("altitude_std", math.inf): "altitude_std"}
    for (name, value), reason in refused.items():
        before = get_parameter(peer, name)
        result = set_parameter(peer, name, text(value) if isinstance(value, str) else double(value))
        assert not result.successful and reason in result.reason, (name, value, result.reason)
        assert get_parameter(peer, name) == before
    assert "undeclared" in set_parameter(peer, "gyro_nose_density", double(1.0)).reason

    feed = bench.feed(peer, ROLL, PITCH)
    rpy, state = peer.hear(Vector3Stamped, "imu/rpy/filtered"), peer.hear(Odometry, "attitude/state")
    feed.start(2.0)
    expected = len({stamp_of(raw) // AUXILIARY_PERIOD_NS for raw in feed.answers})
    assert 40 <= expected <= 41, "2 s at 20 Hz"
    bench.wait_until(lambda: len(state) >= expected, "every state")
    assert len(state) == expected
    assert set_parameter(peer, "auxiliary_rate", double(0.0)).successful
    state.clear()
    feed.go_on(4.0)
    bench.wait_until(lambda: len(state) >= 800, "every state, as auxiliary_rate says now")
    assert len(state) == 800
    assert last_vector(rpy) == pytest.approx((ROLL, PITCH, 0.0), abs=3 * TILT_STD)

    levelled = peer.call(Trigger, "/attitude_node/level")
    assert levelled.success
    mounting = [float(number) for number in re.findall(r"-?[\d.]+\d", levelled.message)]
    assert list(get_parameter(peer, "mounting_rpy")) == pytest.approx(mounting, abs=1e-6)
    assert mounting == pytest.approx((ROLL, PITCH, 0.0), abs=3 * TILT_STD)
    feed.go_on(0.5)
    assert last_vector(rpy)[:2] == pytest.approx((0.0, 0.0), abs=TILT_STD)

    answers = len(feed.answers)
    assert peer.call(Trigger, "/attitude_node/reset").success
    feed.go_on(4.0)
    after = [deserialize_message(raw, Imu).orientation_covariance[0] for raw in feed.answers[answers:]]
    assert after[0] == -1.0 and after[-1] > 0.0
    assert last_vector(rpy)[:2] == pytest.approx((0.0, 0.0), abs=3 * TILT_STD)


def stamp_of(raw):
    return int.from_bytes(raw[4:8], "little") * 10**9 + int.from_bytes(raw[8:12], "little")


def last_vector(raws):
    vector = deserialize_message(raws[-1], Vector3Stamped).vector
    return vector.x, vector.y, vector.z


def test_altitude_can_be_switched_off_and_on(bench):
    bench.start_ready("-p", "auxiliary_rate:=0.0")
    peer = bench.peer()
    feed, altitude = bench.feed(peer), peer.publisher(PointStamped, "altitude")
    state = peer.hear(Odometry, "attitude/state")
    encoder = StampedEncoder(POINT, "odom")

    def fly(height, seconds):
        for _ in range(round(20 * seconds)):
            altitude.publish(encoder.encode(feed.stamp_ns, np.array([0.0, 0.0, height])))
            feed.go_on(0.05)
        return deserialize_message(state[-1], Odometry).pose.pose.position.z

    feed.start(0.1)
    assert fly(100.0, 3.0) == pytest.approx(100.0, abs=0.5)
    assert peer.call(SetBool, "/attitude_node/use_altitude", data=False).success
    assert fly(200.0, 3.0) == pytest.approx(100.0, abs=5.0)
    assert peer.call(SetBool, "/attitude_node/use_altitude", data=True).success
    assert fly(100.0, 1.0) == pytest.approx(100.0, abs=1.0)


@pytest.mark.parametrize(("arguments", "reason"), [
    (["-p", "gyro_noise_density:=-1.0"], "gyro_noise_density = -1.0 rad/s/sqrt(Hz): must be from 0.0 to 1.0"),
    (["-p", "gyro_noise_density:=.nan"], "gyro_noise_density = nan"),
    (["-p", "gyro_noise_density:=fast"], "gyro_noise_density = 'fast': must be a number"),
    (["-p", "mounting_rpy:=[0.0, 1.0]"], "mounting_rpy needs 3 values, got 2"),
    (["-p", "estimator:=magic"], "estimator = 'magic': must be one of"),
    (["-p", "use_sim_time:=maybe"], "'use_sim_time' to 'maybe'"),
    (["-p", "gyro_noise_density"], "-p gyro_noise_density"),
    (["--params-file", "none.yaml"], "--params-file none.yaml"),
    (["--", "-p", "gyro_noise_density:=0.1"], "unknown argument -p"),
])
def test_a_wrong_start_is_told_in_one_line(bench, arguments, reason):
    node = bench.start("attitude_node", *arguments)
    assert node.finish() == 2, node.said
    *others, last = node.said.splitlines()
    assert last.startswith("attitude_node: ") and reason in last, node.said
    # rcl logs a line of its own about arguments that it cannot parse.
    assert all("[rcl]" in line for line in others), node.said


@pytest.mark.parametrize(("module", "told"), [
    ("attitude_estimator.node", "gyro_noise_density (default 0.0022 rad/s/sqrt(Hz); 0 to 1)"),
    ("attitude_estimator.navigation.node", "antenna_position (default [0, 0, 0] m; -1000 to 1000)"),
    ("alignment.node", "latitude (default .nan rad;"),
    ("nav_ros.replay_node", "lockstep_topic (default \"\")")])
def test_help_tells_what_it_does_and_its_parameters(module, told, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["node", "--help"])
    assert importlib.import_module(module).main() == 0
    said = capsys.readouterr().out
    assert said.startswith("usage: ") and told in said and said.count("_node: ") == 1


def test_signals_end_it_while_data_flow_and_before(bench, turn_bag):
    nodes = {number: bench.start_ready("-r", f"__node:=node_{number}")
             for number in (signal.SIGINT, signal.SIGTERM)}
    replay = bench.start("replay_node", "-p", f"bag:={turn_bag}", "-p", "rate:=5.0", "-p", "loop:=true",
                         "-p", "wait_for_subscribers:=2")
    heard = bench.peer().hear(Imu, "imu/data", nodes=2)
    bench.wait_until(lambda: len(heard) > 200, "data to flow")
    for number, node in nodes.items():
        assert node.finish(number) == 0, node.said
        assert "Traceback" not in node.said
    assert replay.finish(signal.SIGINT) == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_while_it_prepares(bench, number):
    node = bench.start("attitude_node")
    node.wait_for("preparing")
    assert node.finish(number) == 0, node.said
    assert "Traceback" not in node.said


def test_namespace_remaps_and_time_of_the_replay(bench, turn_bag):
    bench.start_ready("-r", "__ns:=/vehicle", "-r", "imu/data_raw:=/sensors/imu", "-p", "use_sim_time:=true")
    peer = bench.peer("/vehicle")
    diagnostics = bench.diagnostics(peer, "vehicle/attitude_node")
    heard = {topic: peer.hear(kind, topic) for topic, kind in TYPES.items()}
    bench.replay(peer, turn_bag, "publish_clock:=true", "in_flight:=20", "rate:=4.0",
                 remaps=["-r", "__ns:=/vehicle", "-r", "imu/data_raw:=/sensors/imu"])
    stamps = read_recording(turn_bag).imu.stamp_ns
    assert len(heard["imu/data"]) == len(stamps)
    bench.wait_until(lambda: all(heard.values()), "every topic")
    first, *_ = reports = diagnostics.reports
    assert first[0] == 0.0 and "use_sim_time is true and there is no /clock yet" in first[1].message
    timed = [(stamp, status) for stamp, status in reports if stamp > 0.0]
    assert timed and all(stamps[0] * 1e-9 <= stamp <= stamps[-1] * 1e-9 for stamp, _ in timed)
    # A busy machine may be late with a /clock; without the bag's time every report would tell of years.
    assert any("clock" not in status.message for _, status in timed)
