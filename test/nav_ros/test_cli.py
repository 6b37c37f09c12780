"""simulate_bag, score_bag and allan as a user calls them."""

import csv
import json

import numpy as np
import pytest

from alignment.edge import AlignmentNodeParams
from attitude_estimator.edge import AttitudeNodeParams
from attitude_estimator.navigation.edge import NavigationNodeParams
from inertial.imu_errors import PROFILES, apply_imu_errors
from inertial.recording import ImuSeries, Recording
from inertial.rotation import down_from_quaternion
from nav_ros import allan_cli, cli
from nav_ros.bags import BagWriter, read_messages, read_recording
from nav_ros.frames import orientation_from_q_nb
from nav_ros.messages import IMU, ORIENTATION, ORIENTATION_COVARIANCE, QUATERNION, StampedEncoder
from nav_ros.parameters import load_parameter_file, parameter_names, params_from_values
from nav_ros.recorded import recorded_messages

KEYS = ["tilt_rms_deg", "roll_rms_deg", "pitch_rms_deg", "coverage_3sigma", "nees", "samples", "skipped_s"]
TILT_DEG = 1.0
ROUNDING_DEG = 1e-6
NOISE = 0.05  # share by which the noise of 7000 samples may be off


def run(main, *arguments):
    return main([str(argument) for argument in arguments])


def scored_bag(path, covariance=(0.02**2, 0.01**2), output="/imu/data"):
    """Write 20 s of level truth and of an estimate with its nose TILT_DEG up, facing north."""
    stamps = 10**18 + 10_000_000 * np.arange(2000)
    half = np.radians(TILT_DEG) / 2
    values = np.zeros((len(stamps), 37))
    values[:, ORIENTATION] = orientation_from_q_nb([np.cos(half), 0, np.sin(half), 0])
    values[:, ORIENTATION_COVARIANCE] = np.diag([*covariance, 1e6]).ravel()
    values[:700, ORIENTATION_COVARIANCE.start] = -1.0
    truth = np.broadcast_to(orientation_from_q_nb([1.0, 0, 0, 0]), (len(stamps), 4))
    imus = StampedEncoder(IMU, "imu").encode_batch(stamps, values)
    truths = StampedEncoder(QUATERNION, "odom").encode_batch(stamps, truth)
    with BagWriter(path, {output: IMU, "/ground_truth/attitude": QUATERNION}) as writer:
        for stamp, imu, attitude in zip(stamps.tolist(), imus, truths, strict=True):
            writer.write(output, stamp, imu)
            writer.write("/ground_truth/attitude", stamp, attitude)


def test_a_simulated_bag_holds_what_was_asked_for(tmp_path, capsys):
    run(cli.simulate_bag_main, "turn", tmp_path / "run", "--duration", 5, "--imu-rate", 100,
        "--altimeter-rate", 10)
    assert "turn, 5 s" in capsys.readouterr().out
    recording = read_recording(tmp_path / "run")
    assert len(recording.imu) == 500
    assert len(recording.altitude) == pytest.approx(50, abs=1)
    assert len(recording.truth) >= 500
    at_rest = down_from_quaternion(recording.truth.q_nb_wxyz[0])
    np.testing.assert_allclose(at_rest, [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_the_same_seed_gives_the_same_bytes(tmp_path, storage):
    for folder, seed in (("a", 1), ("b", 1), ("c", 2)):
        run(cli.simulate_bag_main, "hover", tmp_path / folder / "run", "--duration", 4, "--seed", seed,
            "--storage", storage)
    bytes_of = {folder: [file.read_bytes() for file in sorted((tmp_path / folder / "run").iterdir())]
                for folder in "abc"}
    assert bytes_of["a"] == bytes_of["b"] != bytes_of["c"]


def test_pressure_in_place_of_altitude(tmp_path):
    run(cli.simulate_bag_main, "hover", tmp_path / "run", "--duration", 4, "--pressure")
    topics = {message.topic for message in read_messages(tmp_path / "run")}
    assert topics == {"/imu/data_raw", "/pressure", "/ground_truth/attitude"}


def test_the_score_is_the_tilt_that_was_put_in(tmp_path, capsys):
    scored_bag(tmp_path / "run")
    run(cli.score_bag_main, tmp_path / "run", "--json", "--csv", tmp_path / "score.csv")
    score = json.loads(capsys.readouterr().out)
    assert list(score)[:len(KEYS)] == KEYS
    assert score["tilt_rms_deg"] == pytest.approx(TILT_DEG, abs=ROUNDING_DEG)
    assert score["pitch_rms_deg"] == pytest.approx(TILT_DEG, abs=ROUNDING_DEG)
    assert score["roll_rms_deg"] == pytest.approx(0.0, abs=ROUNDING_DEG)
    # Facing north, a pitch error turns about east: the first of the ENU axes, of std 0.02 rad.
    assert score["nees"] == pytest.approx((np.radians(TILT_DEG) / 0.02)**2, rel=1e-3)
    assert score["samples"] == 1300
    with open(tmp_path / "score.csv", newline="") as file:
        (row,) = csv.DictReader(file)
    assert float(row["tilt_rms_deg"]) == score["tilt_rms_deg"]


def test_scoring_takes_other_topics(tmp_path, capsys):
    scored_bag(tmp_path / "run", output="/other")
    run(cli.score_bag_main, tmp_path / "run", "--topic", "output:=/other")
    assert "tilt_rms_deg         1.0000" in capsys.readouterr().out


def test_spans_without_attitude_count_as_not_covered(tmp_path):
    scored_bag(tmp_path / "run")
    score = cli.score_bag(tmp_path / "run")
    assert score.coverage_3sigma == pytest.approx(1300 / 1500, abs=1e-3)


@pytest.mark.parametrize("main, arguments, reason", [
    (cli.score_bag_main, ["none"], "no such file or folder"),
    (cli.simulate_bag_main, ["hover", "."], "exists already"),
    (cli.simulate_bag_main, ["hover", "out", "--duration", "-1"], "duration"),
    (cli.simulate_bag_main, ["hovering", "out"], "invalid choice: 'hovering'"),
    (cli.score_bag_main, ["none", "--topic", "imu=/a"], "expected NAME:=/TOPIC")])
def test_errors_are_told_with_exit_status_2(tmp_path, monkeypatch, capsys, main, arguments, reason):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(arguments)
    told = capsys.readouterr()
    assert end.value.code == 2 and reason in told.err.splitlines()[-1] and told.out == ""


def test_a_bag_without_estimates_names_the_topics(tmp_path, capsys):
    run(cli.simulate_bag_main, "hover", tmp_path / "run", "--duration", 4)
    capsys.readouterr()
    with pytest.raises(SystemExit):
        run(cli.score_bag_main, tmp_path / "run")
    (line,) = capsys.readouterr().err.splitlines()
    assert "no topic /imu/data, which estimate_bag" in line
    assert line.endswith("topics there: /altitude, /ground_truth/attitude, /imu/data_raw")


def test_a_warning_takes_one_line(tmp_path, capsys):
    scored_bag(tmp_path / "run")
    file = tmp_path / "run" / "run.mcap"
    file.write_bytes(file.read_bytes()[:-100])
    run(cli.score_bag_main, tmp_path / "run", "--json")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("score_bag: warning: ") and "up to the break" in line


def bag_at_rest(path, seconds=70.0, rate=100.0, profile="adis16488a"):
    count = round(seconds * rate)
    stamps = 10**18 + np.rint(1e9 / rate * np.arange(count)).astype(np.int64)
    truth = ImuSeries(stamps, np.zeros((count, 3)), np.tile([0.0, 0.0, -9.8], (count, 1)))
    imu = apply_imu_errors(truth, PROFILES[profile].imu, np.random.default_rng(1)).imu
    types, messages = recorded_messages(Recording("rest", imu))
    with BagWriter(path, types) as writer:
        for message in messages:
            writer.write(*message)


@pytest.fixture(scope="module")
def rest(tmp_path_factory):
    path = tmp_path_factory.mktemp("allan") / "rest"
    bag_at_rest(path)
    return path


def test_allan_writes_a_parameter_file_that_the_nodes_read(rest, tmp_path, capsys):
    run(allan_cli.main, rest, "--out", tmp_path / "params.yaml", "--plot", tmp_path / "plot.png")
    told = capsys.readouterr().out
    assert "70 s at 100 Hz" in told and "white noise N              deg/sqrt(h)" in told
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
    errors = PROFILES["adis16488a"].imu
    params = {kind: params_from_values(kind, load_parameter_file(tmp_path / "params.yaml", node,
                                                                 parameter_names(kind)))
              for kind, node in ((AttitudeNodeParams, "attitude_node"), (AlignmentNodeParams, "alignment_node"),
                                 (NavigationNodeParams, "navigation_node"))}
    standing = params[AlignmentNodeParams]
    assert standing.gyro_noise_density == pytest.approx(errors.gyro_noise_density, rel=NOISE)
    assert standing.accel_noise_density == pytest.approx(errors.accel_noise_density, rel=NOISE)
    assert standing.gyro_bias_instability > 0.8 * errors.gyro_bias_instability
    moving, default = params[AttitudeNodeParams], AttitudeNodeParams()
    assert vars(moving).items() & vars(params[NavigationNodeParams]).items() >= {
        (name, getattr(moving, name)) for name in (*allan_cli._MOTION, "gyro_bias_std")}
    assert moving.gyro_noise_density == pytest.approx(
        np.hypot(default.gyro_noise_density, errors.gyro_noise_density), rel=NOISE)
    assert {name: getattr(default, name) for name in allan_cli._MOTION} == allan_cli._MOTION
    assert 0.2 < moving.gyro_bias_std / errors.gyro_bias_std < 6.0


def test_allan_speaks_json(rest, capsys):
    run(allan_cli.main, rest, "--json", "--start", 2)
    found = json.loads(capsys.readouterr().out)
    assert found["duration_s"] == pytest.approx(68.0, abs=0.1) and found["rate_hz"] == pytest.approx(100.0)
    density = found["gyro"]["x"]["noise_density"]
    assert density["low"] < density["value"] < density["high"]
    assert found["accel"]["z"]["mean"] == pytest.approx(9.8, abs=0.3)


@pytest.mark.parametrize("arguments, reason", [
    (["--end", "20"], "20.0 s of IMU samples are too short"),
    (["--start", "100"], "too short"),
    (["--topic", "imu:=/other"], "no topic /other (sensor_msgs/msg/Imu is on /imu/data_raw); topics there"),
    (["--out", "none/params.yaml"], "No such file or directory")])
def test_allan_says_in_one_line_what_is_wrong(rest, capsys, arguments, reason):
    with pytest.raises(SystemExit) as end:
        run(allan_cli.main, rest, *arguments)
    (line,) = capsys.readouterr().err.splitlines()
    assert end.value.code == 2 and line.startswith("allan: ") and reason in line


def test_allan_refuses_a_flight(tmp_path, capsys):
    run(cli.simulate_bag_main, "hover", tmp_path / "run", "--duration", 70, "--imu-rate", 50)
    with pytest.raises(SystemExit):
        run(allan_cli.main, tmp_path / "run")
    assert "the IMU is moving in" in capsys.readouterr().err
