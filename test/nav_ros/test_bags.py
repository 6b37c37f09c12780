"""Bags: round trips, the same bytes twice, damaged recordings, real recordings."""

import os
import resource
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from inertial.atmosphere import pressure_from_altitude
from nav_ros import bags
from nav_ros.bags import BagError, BagReader, BagWarning, BagWriter, read_messages, read_recording
from nav_ros.frames import orientation_from_q_nb, swap_flu_frd
from nav_ros.messages import IMU, POINT, PRESSURE, QUATERNION, StampedEncoder

REAL_BAGS = Path(os.environ.get("REAL_BAGS", Path(__file__).parents[3] / "shared" / "bags"))
T0 = 1_700_000_000_000_000_000
TOPICS = {"/imu/data_raw": IMU, "/altitude": POINT, "/ground_truth/attitude": QUATERNION}
PRESSURE_ROUNDING = 1e-6
"""Metres."""


def samples(n=200):
    rng = np.random.default_rng(0)
    q = rng.normal(size=(n, 4))
    return {"gyro_b": rng.normal(size=(n, 3)), "accel_b": rng.normal(size=(n, 3)),
            "altitude": rng.normal(size=n), "q_nb_wxyz": q / np.linalg.norm(q, axis=1, keepdims=True)}


def write_bag(path, n=200, storage="mcap", altimeter="altitude", imu_topic="/imu/data_raw"):
    """Write n IMU samples at 100 Hz, an altitude before every tenth, truth after every fifth."""
    data = samples(n)
    imu, point = StampedEncoder(IMU, "imu"), StampedEncoder(POINT, "odom")
    pressure, truth = StampedEncoder(PRESSURE, "imu"), StampedEncoder(QUATERNION, "odom")
    altimeter_type = POINT if altimeter == "altitude" else PRESSURE
    topics = {imu_topic: IMU, f"/{altimeter}": altimeter_type, "/ground_truth/attitude": QUATERNION}
    with BagWriter(path, topics, storage) as writer:
        for k in range(n):
            stamp = T0 + 10_000_000 * k
            values = np.zeros(37)
            values[13:16] = swap_flu_frd(data["gyro_b"][k])
            values[25:28] = swap_flu_frd(data["accel_b"][k])
            if k % 10 == 0:
                height = data["altitude"][k]
                raw = point.encode(stamp, [0, 0, height]) if altimeter == "altitude" \
                    else pressure.encode(stamp, [pressure_from_altitude(height), 0])
                writer.write(f"/{altimeter}", stamp, raw)
            writer.write(imu_topic, stamp, imu.encode(stamp, values))
            if k % 5 == 0:
                writer.write("/ground_truth/attitude", stamp,
                             truth.encode(stamp, orientation_from_q_nb(data["q_nb_wxyz"][k])))
    return data


def truncate(path, fraction):
    """Cut the storage file of a bag short, as an interrupted recording is."""
    (file,) = [file for file in path.iterdir() if file.suffix != ".yaml"]
    file.write_bytes(file.read_bytes()[:int(file.stat().st_size * fraction)])


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_what_is_written_is_read_in_recorded_order(tmp_path, storage):
    data = write_bag(tmp_path / "run", storage=storage)
    recording = read_recording(tmp_path / "run")
    assert recording.name == "run"
    np.testing.assert_array_equal(recording.imu.stamp_ns, T0 + 10_000_000 * np.arange(200))
    np.testing.assert_array_equal(recording.imu.gyro_b, data["gyro_b"])
    np.testing.assert_array_equal(recording.imu.accel_b, data["accel_b"])
    np.testing.assert_array_equal(recording.altitude.altitude, data["altitude"][::10])
    np.testing.assert_array_equal(recording.altitude.arrival, np.arange(0, 200, 10))
    np.testing.assert_allclose(recording.truth.q_nb_wxyz, data["q_nb_wxyz"][::5], atol=1e-15)
    messages = list(read_messages(tmp_path / "run"))
    assert [message.topic for message in messages[:3]] == ["/altitude", "/imu/data_raw",
                                                           "/ground_truth/attitude"]
    assert len(messages) == 200 + 20 + 40
    assert all(a.receive_ns <= b.receive_ns for a, b in zip(messages, messages[1:], strict=False))


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_the_same_input_gives_the_same_bytes(tmp_path, storage):
    for folder in ("a", "b"):
        write_bag(tmp_path / folder / "run", storage=storage)
    for file in (tmp_path / "a" / "run").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / "run" / file.name).read_bytes()


def test_the_bag_offers_complete_qos_and_is_compressed(tmp_path):
    write_bag(tmp_path / "run", n=1000)
    with Reader(tmp_path / "run") as reader:
        for connection in reader.connections:
            (qos,) = connection.ext.offered_qos_profiles
            assert len(qos) == 9 and qos.depth == 100
    assert (tmp_path / "run" / "run.mcap").stat().st_size < 1000 * 324 / 2


def test_pressure_counts_from_the_first_sample(tmp_path):
    data = write_bag(tmp_path / "run", altimeter="pressure")
    altitude = read_recording(tmp_path / "run").altitude
    expected = data["altitude"][::10] - data["altitude"][0]
    np.testing.assert_allclose(altitude.altitude, expected, atol=PRESSURE_ROUNDING)


def test_topics_may_have_other_names(tmp_path):
    write_bag(tmp_path / "run", imu_topic="/my/imu")
    assert len(read_recording(tmp_path / "run", {"imu": "/my/imu"}).imu) == 200
    with pytest.raises(BagError, match=r"no topic /imu/data_raw \(.* is on /my/imu\); topics there: /altitude"):
        read_recording(tmp_path / "run")


def test_a_topic_of_another_type_is_told(tmp_path):
    write_bag(tmp_path / "run")
    with pytest.raises(BagError, match="/altitude is geometry_msgs/msg/PointStamped, expected sensor_msgs"):
        read_recording(tmp_path / "run", {"imu": "/altitude"})
    with pytest.raises(BagError, match="expected sensor_msgs/msg/FluidPressure"):
        list(read_messages(tmp_path / "run", {"/altitude": PRESSURE}))


@pytest.mark.parametrize("types, source, expected", [
    (["/altitude"], "auto", "altitude"), (["/pressure"], "auto", "pressure"), ([], "auto", None),
    (["/altitude", "/pressure"], "pressure", "pressure"), (["/altitude"], "none", None)])
def test_choice_of_the_altimeter(types, source, expected):
    assert bags.choose_altitude(types, bags.TOPICS, source) == expected


@pytest.mark.parametrize("types, source, reason", [
    (["/altitude", "/pressure"], "auto", "both /altitude and /pressure"),
    (["/altitude"], "pressure", "no topic /pressure")])
def test_an_impossible_choice_of_the_altimeter(types, source, reason):
    with pytest.raises(BagError, match=reason):
        bags.choose_altitude(types, bags.TOPICS, source)


@pytest.mark.parametrize("storage, metadata, fraction", [
    ("mcap", True, 0.3), ("mcap", True, 0.9999), ("mcap", False, 0.6), ("mcap", False, 0.95),
    ("sqlite3", True, 0.3), ("sqlite3", True, 0.95), ("sqlite3", False, 0.6)])
def test_an_interrupted_recording_is_read_up_to_the_break(tmp_path, storage, metadata, fraction):
    write_bag(tmp_path / "run", 5000, storage)
    whole = list(read_messages(tmp_path / "run"))
    truncate(tmp_path / "run", fraction)
    if not metadata:
        (tmp_path / "run" / "metadata.yaml").unlink()
    with pytest.warns(BagWarning, match=r"cut off or damaged .* read \d+ messages over"):
        part = list(read_messages(tmp_path / "run"))
    assert part == whole[:len(part)]
    assert len(part) > 0.8 * fraction * len(whole)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_without_metadata_or_a_lone_file_will_do(tmp_path, storage):
    write_bag(tmp_path / "run", storage=storage)
    whole = list(read_messages(tmp_path / "run"))
    (tmp_path / "run" / "metadata.yaml").unlink()
    (file,) = (tmp_path / "run").iterdir()
    assert list(read_messages(tmp_path / "run")) == whole
    assert list(read_messages(file)) == whole


@pytest.mark.parametrize("metadata", [True, False])
def test_an_empty_file_beside_good_ones_is_told(tmp_path, metadata):
    write_bag(tmp_path / "run")
    whole = list(read_messages(tmp_path / "run"))
    (tmp_path / "run" / "run_1.mcap").write_bytes(b"")
    if not metadata:
        (tmp_path / "run" / "metadata.yaml").unlink()
        with pytest.warns(BagWarning, match=r"seems to be empty.* read the other files"):
            assert list(read_messages(tmp_path / "run")) == whole
    else:
        assert list(read_messages(tmp_path / "run")) == whole


def test_broken_metadata_does_not_matter(tmp_path):
    write_bag(tmp_path / "run")
    whole = list(read_messages(tmp_path / "run"))
    (tmp_path / "run" / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: [")
    assert list(read_messages(tmp_path / "run")) == whole


def test_damage_in_the_middle_ends_the_reading_and_is_told(tmp_path):
    write_bag(tmp_path / "run", n=9000)
    whole = list(read_messages(tmp_path / "run"))
    file = tmp_path / "run" / "run.mcap"
    data = bytearray(file.read_bytes())
    data[len(data) // 2:len(data) // 2 + 1000] = bytes(1000)
    file.write_bytes(data)
    with pytest.warns(BagWarning, match="cut off or damaged"):
        part = list(read_messages(tmp_path / "run"))
    assert 0 < len(part) < len(whole) and part == whole[:len(part)]


def test_a_database_with_a_page_overwritten_is_read_up_to_it(tmp_path):
    write_bag(tmp_path / "run", 3000, "sqlite3")
    whole = list(read_messages(tmp_path / "run"))
    file = tmp_path / "run" / "run.db3"
    data = bytearray(file.read_bytes())
    data[len(data) // 2:len(data) // 2 + 40_000] = bytes(40_000)
    file.write_bytes(data)
    with pytest.warns(BagWarning, match="cut off or damaged"):
        part = list(read_messages(file))
    assert 0 < len(part) < len(whole) and part == whole[:len(part)]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_random_damage_never_gives_any_other_error(tmp_path, storage):
    write_bag(tmp_path / "run", 300, storage)
    (file,) = [file for file in (tmp_path / "run").iterdir() if file.suffix != ".yaml"]
    whole, rng = file.read_bytes(), np.random.default_rng(2)
    outcomes = set()
    for _ in range(50):
        data = bytearray(whole)
        for _ in range(rng.integers(1, 20)):
            data[rng.integers(len(data))] = rng.integers(256)
        file.write_bytes(data[:rng.integers(len(data))] if rng.random() < 0.3 else data)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", BagWarning)
            try:
                outcomes.add(bool(list(read_messages(tmp_path / "run"))))
            except BagError as error:
                assert "\n" not in str(error)
                outcomes.add("refused")
    assert outcomes >= {True, "refused"}


def test_what_is_no_bag_is_told_in_one_line(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.txt").write_text("hello")
    (tmp_path / "text.mcap").write_text("hello")
    (tmp_path / "void.db3").write_text("")
    for name, reason in {"none": "no such file", "empty": "no metadata.yaml", "text.txt": "expected a",
                         "text.mcap": "not a bag that can be read", "void.db3": "not a bag that can"}.items():
        with pytest.raises(BagError, match=reason) as error:
            BagReader(tmp_path / name)
        assert "\n" not in str(error.value)


def test_a_bag_is_not_overwritten(tmp_path):
    with pytest.raises(BagError, match="exists already"):
        BagWriter(tmp_path, TOPICS)
    with pytest.raises(BagError, match="must be one of mcap, sqlite3"):
        BagWriter(tmp_path / "run", TOPICS, storage="bag")


def test_malformed_and_refused_messages_are_counted(tmp_path):
    with BagWriter(tmp_path / "run", {"/imu/data_raw": IMU, "/pressure": PRESSURE}) as writer:
        imu, pressure = StampedEncoder(IMU, "imu"), StampedEncoder(PRESSURE, "imu")
        for k in range(1, 5):
            raw = imu.encode(k, np.zeros(37))
            writer.write("/imu/data_raw", k, raw[:-1] if k == 2 else raw)
            writer.write("/pressure", k, pressure.encode(k, [1013.25 if k == 3 else 101325.0, 0]))
    with pytest.warns(BagWarning) as told:
        recording = read_recording(tmp_path / "run")
    assert any("/imu/data_raw: 1 of 4 messages are malformed, the first is number 1" in str(w.message)
               for w in told)
    assert any("1 of 4 samples of /pressure refused: pressure 1013.25 Pa" in str(w.message) for w in told)
    assert list(recording.imu.stamp_ns) == [1, 3, 4]
    assert list(recording.altitude.stamp_ns) == [1, 2, 4]
    assert list(recording.altitude.arrival) == [1, 2, 4]
    assert recording.truth is None


def test_what_was_written_before_an_exception_can_be_read(tmp_path):
    with pytest.raises(KeyboardInterrupt), BagWriter(tmp_path / "run", {"/imu/data_raw": IMU}) as writer:
        writer.write("/imu/data_raw", 5, StampedEncoder(IMU, "imu").encode(5, np.zeros(37)))
        raise KeyboardInterrupt
    assert len(list(read_messages(tmp_path / "run"))) == 1


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_full_disk_is_told_in_one_line(tmp_path, storage):
    raws = StampedEncoder(IMU, "imu").encode_batch(np.arange(4000), np.random.default_rng(0).normal(size=(4000, 37)))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))
    try:
        with (pytest.raises(BagError, match="run: cannot be written any further"),
              BagWriter(tmp_path / "run", {"/imu/data_raw": IMU}, storage) as writer):
            for stamp_ns, raw in enumerate(raws):
                writer.write("/imu/data_raw", stamp_ns, raw)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_real_recordings_can_be_read(tmp_path):
    paths = [path.parent for path in sorted(REAL_BAGS.glob("*/metadata.yaml"))[::8]]
    if not paths:
        pytest.skip("the folder of real recordings is absent (REAL_BAGS)")
    for path in paths:
        recording = read_recording(path)
        with Reader(path) as reader:
            counts = {topic: info.msgcount for topic, info in reader.topics.items()}
        assert len(recording.imu) == counts["/imu/data_raw"]
        assert len(recording.truth) == counts["/ground_truth/attitude"]
        assert np.isfinite(recording.imu.accel_b).all()
        copy = tmp_path / path.name
        shutil.copytree(path, copy)
        (file,) = copy.glob("*.mcap")
        file.chmod(0o644)
        file.write_bytes(file.read_bytes()[:-200])
        with pytest.warns(BagWarning, match="read"):
            assert len(read_recording(copy).imu) > 0
