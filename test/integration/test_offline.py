"""simulate_bag, estimate_bag and score_bag as they are installed, one after the other; options and bad input."""

import json
import os
import subprocess

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed")

from attitude_estimator.cli import main as estimate_bag_main  # noqa: E402
from attitude_estimator.edge import OUTPUT_TYPES  # noqa: E402
from nav_ros.bags import BagReader, BagWriter, read_messages  # noqa: E402
from nav_ros.messages import DOUBLES, IMU, ORIENTATION_COVARIANCE, QUATERNION, decode  # noqa: E402
from nav_ros.resources import executable  # noqa: E402

LIMIT = 400.0
"""Seconds, which also lets a first run compile."""
TILT_RMS_DEG = 2.0
OUTPUT = ["/imu/data", "/imu/rpy/filtered", "/attitude/state", "/imu/gyro_bias", "/imu/accel_bias"]
TRUTH = "/ground_truth/attitude"
TYPES = {f"/{topic}": message_type for topic, message_type in OUTPUT_TYPES.items()} | {TRUTH: QUATERNION}
ROUNDING = 1e-12
"""Relative and absolute: a kernel just compiled and the same one from the cache need not round alike."""


def run(name, *arguments):
    """Return (exit status, standard output, standard error) of an installed program."""
    done = subprocess.run([executable(name), *map(str, arguments)], capture_output=True, text=True,
                          timeout=LIMIT, stdin=subprocess.DEVNULL)
    return done.returncode, done.stdout, done.stderr


@pytest.fixture
def estimate(capsys):
    """Return a function that gives the same of estimate_bag in this process, without the seconds of a start."""
    def estimate(*arguments):
        try:
            status = estimate_bag_main([str(argument) for argument in arguments])
        except SystemExit as end:
            status = end.code
        return status, *capsys.readouterr()
    return estimate


def written(bag):
    """Return topic -> list of serialized messages."""
    messages = {}
    for topic, _, raw in read_messages(bag):
        messages.setdefault(topic, []).append(raw)
    return messages


def assert_same(messages, expected):
    """Insist on the same messages on the same topics, but for rounding; of both as `written` returns it."""
    assert messages.keys() == expected.keys()
    for topic, raws in expected.items():
        size = 8 * DOUBLES[TYPES[topic]]
        assert [raw[:-size] for raw in messages[topic]] == [raw[:-size] for raw in raws], topic
        values = [np.frombuffer(b"".join(raw[-size:] for raw in some)) for some in (messages[topic], raws)]
        np.testing.assert_allclose(*values, rtol=ROUNDING, atol=ROUNDING, err_msg=topic)


def copy(source, target, rename=None, leave_out=()):
    """Write a bag again with other topics."""
    rename = rename or {}
    with BagReader(source) as reader:
        types = {topic: kind for topic, kind in reader.types.items() if topic not in leave_out}
        with BagWriter(target, {rename.get(topic, topic): kind for topic, kind in types.items()}) as writer:
            for topic, receive_ns, raw in reader.messages(types):
                writer.write(rename.get(topic, topic), receive_ns, raw)
    return target


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("simulated") / "flight"
    status, _, errors = run("simulate_bag", "turn", path, "--duration", 12, "--imu-rate", 50, "--pressure")
    assert (status, errors) == (0, "")
    return path


@pytest.fixture(scope="module")
def estimated(bag):
    """Return the messages of the estimates."""
    path = bag.parent / "estimated"
    status, output, errors = run("estimate_bag", bag, path)
    assert (status, errors) == (0, "")
    assert "600 estimates" in output and "nothing refused" in output
    return written(path)


def test_simulated_estimated_scored(bag, estimated):
    status, output, errors = run("score_bag", bag.parent / "estimated", "--json")
    assert (status, errors) == (0, "")
    assert json.loads(output)["tilt_rms_deg"] < TILT_RMS_DEG
    assert sorted(estimated) == sorted([*OUTPUT, TRUTH])
    source = written(bag)
    assert estimated[TRUTH] == source[TRUTH]
    assert [raw[4:12] for raw in estimated["/imu/data"]] == [raw[4:12] for raw in source["/imu/data_raw"]]


def test_several_bags_other_topics_and_storage_give_the_same(estimate, bag, estimated, tmp_path):
    (tmp_path / "b").mkdir()
    renamed = copy(bag, tmp_path / "renamed", {"/imu/data_raw": "/my/imu", "/pressure": "/my/baro"})
    again = copy(renamed, tmp_path / "b" / "again")
    status, output, errors = estimate(renamed, again, tmp_path / "out", "--storage", "sqlite3",
                                      "--topic", "imu:=/my/imu", "--topic", "pressure:=/my/baro")
    assert (status, errors) == (0, "")
    assert len(output.splitlines()) == 2
    for name in ("renamed", "again"):
        assert list((tmp_path / "out" / name).glob("*.db3"))
        assert_same(written(tmp_path / "out" / name), estimated)


def test_parameters_from_a_file_and_the_command_line(estimate, bag, estimated, tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("attitude_node:\n  ros__parameters:\n    world_frame: map\n    auxiliary_rate: 0.0\n")
    status, _, errors = estimate(bag, tmp_path / "out", "--params", file, "-p", "base_frame:=hull",
                                 "-p", "gravity:=9.81")
    assert (status, errors) == (0, "")
    out = written(tmp_path / "out")
    assert len(out["/attitude/state"]) == len(out["/imu/data"]) == len(estimated["/imu/data"])
    assert b"map\0" in out["/attitude/state"][0] and b"hull_stabilized\0" in out["/attitude/state"][0]
    assert out["/imu/data"][-1][-37 * 8:] != estimated["/imu/data"][-1][-37 * 8:]


def test_a_smoothed_bag_has_the_same_messages_and_an_attitude_from_the_start(estimate, bag, estimated, tmp_path):
    status, _, errors = estimate(bag, tmp_path / "smoothed", "--smooth")
    assert (status, errors) == (0, "")
    smoothed = written(tmp_path / "smoothed")
    assert set(smoothed) == set(estimated) and len(smoothed["/imu/data"]) == len(estimated["/imu/data"])
    known = {which: np.array([decode(IMU, raw)[2][ORIENTATION_COVARIANCE.start] >= 0.0 for raw in raws])
             for which, raws in (("smoothed", smoothed["/imu/data"]), ("filtered", estimated["/imu/data"]))}
    assert known["smoothed"].all() and not known["filtered"].all()
    status, _, errors = estimate(bag, tmp_path / "no", "--smooth", "-p", "estimator:=dcm_row5")
    assert status == 2 and len(errors.splitlines()) == 1 and not (tmp_path / "no").exists()


def test_an_interrupted_recording_is_estimated_up_to_the_break(estimate, bag, estimated, tmp_path):
    (file,) = bag.glob("*.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[:-500])
    status, _, errors = estimate(cut, tmp_path / "out")
    assert status == 0
    (warning,) = errors.splitlines()
    assert warning.startswith("estimate_bag: warning: ") and "up to the break" in warning
    out = written(tmp_path / "out")["/imu/data"]
    assert out
    assert_same({"/imu/data": out}, {"/imu/data": estimated["/imu/data"][:len(out)]})


def test_what_cannot_be_estimated_is_one_line_and_nothing_written(estimate, bag, tmp_path):
    no_imu = copy(bag, tmp_path / "no_imu", leave_out=["/imu/data_raw"])
    both = copy(bag, tmp_path / "both", {TRUTH: "/altitude"})
    out, there = tmp_path / "out", tmp_path / "there"
    there.mkdir()
    bad_file = tmp_path / "bad.yaml"
    bad_file.write_text("/**:\n  ros__parameters:\n    gyro_nose_density: 1.0\n")
    expected = [
        ([no_imu, out], "no topic /imu/data_raw; topics there: /ground_truth/attitude, /pressure"),
        ([tmp_path / "none", out], "there is no such file or folder"),
        ([both, out], "choose one by altitude_source"),
        ([bag, there], "exists already"),
        ([bag, out, "-p", "gravity:=7"], "gravity = 7.0 m/s^2: must be from 9.7 to 9.9"),
        ([bag, out, "-p", "gravty:=9.8"], "there is no parameter gravty; did you mean gravity?"),
        ([bag, out, "-p", "gravity=9.8"], "expected NAME:=VALUE"),
        ([bag, out, "-p", "gravity:=[1"], "'[1' is not a parameter value"),
        ([bag, out, "--params", bad_file], "did you mean gyro_noise_density?"),
        ([bag, out, "--topic", "imu:=/pressure"], "expected sensor_msgs/msg/Imu"),
        ([bag, out, "-p", "altitude_source:=altitude"], "there is no topic /altitude"),
        ([bag], "needs at least one bag and the folder to write"),
    ]
    for arguments, reason in expected:
        status, output, errors = estimate(*arguments)
        assert (status, output) == (2, ""), (arguments, errors)
        assert reason in errors and errors.startswith("estimate_bag: ") and errors.count("\n") == 1, errors
        assert not out.exists()
    assert os.listdir(there) == []


def test_a_recording_with_faults_names_them(estimate, bag, tmp_path):
    faulty = tmp_path / "faulty"
    with BagReader(bag) as reader, BagWriter(faulty, reader.types) as writer:
        for k, (topic, receive_ns, raw) in enumerate(reader.messages()):
            writer.write(topic, receive_ns, raw)
            if topic == "/imu/data_raw" and k < 100:
                writer.write(topic, receive_ns, raw)
                writer.write(topic, receive_ns, raw[:-1])
    status, output, errors = estimate(faulty, tmp_path / "out")
    repeated = sum(message.topic == "/imu/data_raw" for message in list(read_messages(bag))[:100])
    assert (status, errors) == (0, "")
    assert f"duplicate {repeated}" in output and f"malformed {repeated}" in output


def test_a_real_recording(estimate, real_bag, tmp_path):
    status, output, errors = estimate(real_bag, tmp_path / "out")
    assert (status, errors) == (0, "") and "nothing refused" in output
    status, output, errors = run("score_bag", tmp_path / "out", "--json")
    assert (status, errors) == (0, "")
    assert json.loads(output)["tilt_rms_deg"] < TILT_RMS_DEG
