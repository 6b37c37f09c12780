"""simulate_bag and score_bag as a user calls them."""

import csv
import json

import numpy as np
import pytest

from inertial.rotation import down_from_quaternion
from nav_ros import cli
from nav_ros.bags import BagWriter, read_messages, read_recording
from nav_ros.frames import orientation_from_q_nb
from nav_ros.messages import IMU, ORIENTATION, ORIENTATION_COVARIANCE, QUATERNION, StampedEncoder

KEYS = ["tilt_rms_deg", "roll_rms_deg", "pitch_rms_deg", "coverage_3sigma", "nees", "samples", "skipped_s"]
TILT_DEG = 1.0
ROUNDING_DEG = 1e-6


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
    assert "no topic /imu/data; topics there: /altitude, /ground_truth/attitude, /imu/data_raw" in line


def test_a_warning_takes_one_line(tmp_path, capsys):
    scored_bag(tmp_path / "run")
    file = tmp_path / "run" / "run.mcap"
    file.write_bytes(file.read_bytes()[:-100])
    run(cli.score_bag_main, tmp_path / "run", "--json")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("score_bag: warning: ") and "up to the break" in line
