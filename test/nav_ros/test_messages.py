"""CDR codecs: against rosbags and rclpy, on malformed bytes, one by one against many at once."""

import importlib

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from nav_ros import messages
from nav_ros.messages import (
    DOUBLES,
    FIX,
    IMU,
    INVALID_STAMP,
    NO_FIX,
    ODOMETRY,
    POSE,
    TWIST,
    Fix,
    MalformedMessageError,
    StampedEncoder,
)

FRAMES = ["", "a", "imu", "imu_", "base_link", "imué", "机体", "x" * 63]
STAMP_NS = 1_700_000_000_123_456_789
STAMPED = list(DOUBLES)
STORE = get_typestore(Stores.ROS2_JAZZY)


def encoder(name, frame):
    return StampedEncoder(name, frame, "child" if name == ODOMETRY else "")


def doubles(name, seed=0):
    return np.random.default_rng(seed).normal(size=DOUBLES[name])


def flat(message):
    """Return every double of a deserialized message, in the order of its definition."""
    if isinstance(message, float):
        return [message]
    if isinstance(message, (np.ndarray, list)):
        return list(message)
    if isinstance(message, (int, str)):
        return []
    return [value for name in message.__dataclass_fields__ if name != "header"
            for value in flat(getattr(message, name))]


@pytest.mark.parametrize("name", DOUBLES)
@pytest.mark.parametrize("frame", FRAMES)
def test_encoding_is_that_of_rosbags(name, frame):
    values = doubles(name)
    raw = encoder(name, frame).encode(STAMP_NS, values)
    message = STORE.deserialize_cdr(raw, name)
    assert bytes(STORE.serialize_cdr(message, name)) == raw
    assert message.header.frame_id == frame
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == STAMP_NS
    assert flat(message) == list(values)


@pytest.mark.parametrize("name", DOUBLES)
@pytest.mark.parametrize("frame", FRAMES)
def test_rclpy_reads_what_we_write_and_we_read_what_it_writes(name, frame):
    serialization = pytest.importorskip("rclpy.serialization", reason="rclpy is not installed")
    package, _, kind = name.split("/")
    message_class = getattr(importlib.import_module(f"{package}.msg"), kind)
    raw = encoder(name, frame).encode(STAMP_NS, doubles(name))
    message = serialization.deserialize_message(raw, message_class)
    assert message.header.frame_id == frame
    ours = STORE.deserialize_cdr(raw, name)
    theirs = serialization.serialize_message(message)
    # Fast-CDR leaves whatever was in memory in its padding, so the values are compared, not those bytes.
    assert len(theirs) == len(raw)
    assert flat(STORE.deserialize_cdr(theirs, name)) == flat(ours)
    if name != ODOMETRY:
        assert messages.decode(name, theirs) == messages.decode(name, raw)


def test_clock_is_that_of_rosbags():
    message = STORE.deserialize_cdr(messages.encode_clock(STAMP_NS), "rosgraph_msgs/msg/Clock")
    assert message.clock.sec * 10**9 + message.clock.nanosec == STAMP_NS
    assert bytes(STORE.serialize_cdr(message, "rosgraph_msgs/msg/Clock")) == messages.encode_clock(STAMP_NS)


@pytest.mark.parametrize("name", STAMPED)
@pytest.mark.parametrize("frame", FRAMES)
def test_decode_returns_what_was_encoded(name, frame):
    values = doubles(name)
    raw = StampedEncoder(name, frame).encode(STAMP_NS, values)
    assert messages.decode(name, raw) == (STAMP_NS, frame, tuple(values))
    assert messages.decode(name, memoryview(raw)) == (STAMP_NS, frame, tuple(values))


def test_imu_fields_stand_where_the_definition_says():
    message = STORE.deserialize_cdr(StampedEncoder(IMU, "imu").encode(0, np.arange(37.0)), IMU)
    values = np.arange(37.0)
    assert list(values[messages.ORIENTATION]) == flat(message.orientation)
    assert list(values[messages.ORIENTATION_COVARIANCE]) == list(message.orientation_covariance)
    assert list(values[messages.GYRO]) == flat(message.angular_velocity)
    assert list(values[messages.GYRO_COVARIANCE]) == list(message.angular_velocity_covariance)
    assert list(values[messages.ACCEL]) == flat(message.linear_acceleration)
    assert list(values[messages.ACCEL_COVARIANCE]) == list(message.linear_acceleration_covariance)


def test_odometry_fields_stand_where_the_definition_says():
    values = np.arange(85.0)
    message = STORE.deserialize_cdr(StampedEncoder(ODOMETRY, "odom", "base").encode(0, values), ODOMETRY)
    assert message.child_frame_id == "base"
    assert list(values[messages.POSE_POSITION]) == flat(message.pose.pose.position)
    assert list(values[messages.POSE_ORIENTATION]) == flat(message.pose.pose.orientation)
    assert list(values[messages.POSE_COVARIANCE]) == list(message.pose.covariance)
    assert list(values[messages.TWIST_LINEAR]) == flat(message.twist.twist.linear)
    assert list(values[messages.TWIST_ANGULAR]) == flat(message.twist.twist.angular)
    assert list(values[messages.TWIST_COVARIANCE]) == list(message.twist.covariance)


def test_twist_and_pose_fields_stand_where_the_definition_says():
    values = np.arange(43.0)
    twist = STORE.deserialize_cdr(StampedEncoder(TWIST, "map").encode(0, values[:42]), TWIST).twist
    assert list(values[messages.VELOCITY]) == flat(twist.twist.linear)
    assert list(values[messages.VELOCITY_COVARIANCE]) == list(twist.covariance)
    pose = STORE.deserialize_cdr(StampedEncoder(POSE, "map").encode(0, values), POSE).pose
    assert list(values[messages.POSE_ORIENTATION]) == flat(pose.pose.orientation)
    assert list(values[messages.POSE_COVARIANCE]) == list(pose.covariance)


A_FIX = Fix(NO_FIX, 35.0, 139.5, -12.25, tuple(np.arange(9.0)), 2)


@pytest.mark.parametrize("frame", FRAMES)
def test_a_fix_is_that_of_rosbags_and_of_rclpy(frame):
    raw = messages.encode_fix(STAMP_NS, frame, A_FIX)
    message = STORE.deserialize_cdr(raw, FIX)
    assert bytes(STORE.serialize_cdr(message, FIX)) == raw
    assert (message.header.frame_id, message.status.status, message.status.service) == (frame, NO_FIX, 1)
    assert (message.latitude, message.longitude, message.altitude) == A_FIX[1:4]
    assert (tuple(message.position_covariance), message.position_covariance_type) == A_FIX[4:]
    serialization = pytest.importorskip("rclpy.serialization", reason="rclpy is not installed")
    message_class = importlib.import_module("sensor_msgs.msg").NavSatFix
    theirs = serialization.serialize_message(serialization.deserialize_message(raw, message_class))
    for each in (raw, theirs, raw + bytes(-len(raw) % 4)):
        assert messages.decode_fix(each) == (STAMP_NS, A_FIX)


def test_a_fix_cut_off_or_with_other_bytes_is_malformed_and_nothing_else():
    raw = messages.encode_fix(STAMP_NS, "gps", A_FIX)
    for length in range(len(raw)):
        with pytest.raises(MalformedMessageError):
            messages.decode_fix(raw[:length])
    rng = np.random.default_rng(0)
    for _ in range(300):
        damaged = bytearray(raw)
        damaged[rng.integers(len(raw))] = rng.integers(256)
        try:
            messages.decode_fix(bytes(damaged))
        except MalformedMessageError as error:
            assert str(error)


@pytest.mark.parametrize("sec, nanosec", [(-1, 0), (-2**31, 5), (0, 10**9), (7, 2**32 - 1)])
def test_impossible_stamps_are_told_as_invalid(sec, nanosec):
    raw = bytearray(StampedEncoder(IMU, "imu").encode(0, np.zeros(37)))
    raw[4:12] = sec.to_bytes(4, "little", signed=True) + nanosec.to_bytes(4, "little")
    assert messages.decode(IMU, bytes(raw))[0] == INVALID_STAMP
    assert list(messages.decode_batch(IMU, [bytes(raw)] * 2).stamp_ns) == [INVALID_STAMP] * 2


def test_each_fault_is_named():
    raw = StampedEncoder(IMU, "imu").encode(0, np.zeros(37))
    faults = {"too few": raw[:15], "big-endian": b"\x00\x00" + raw[2:], "0x0007": b"\x00\x07" + raw[2:],
              "do not fit": raw[:-1], "not terminated": raw[:19] + b"u" + raw[20:],
              "not UTF-8": raw[:16] + b"\xff" + raw[17:]}
    for reason, broken in faults.items():
        with pytest.raises(MalformedMessageError, match=reason):
            messages.decode(IMU, broken)


@pytest.mark.parametrize("name", STAMPED)
def test_random_bytes_and_truncations_never_raise_anything_else(name):
    rng = np.random.default_rng(7)
    raw = StampedEncoder(name, "imu_link").encode(STAMP_NS, doubles(name))
    broken = [raw[:end] for end in range(len(raw))] + [rng.bytes(rng.integers(0, 400)) for _ in range(300)]
    for _ in range(300):
        damaged = bytearray(raw)
        damaged[rng.integers(0, 28)] = rng.integers(0, 256)
        broken.append(bytes(damaged))
    refused = 0
    for data in broken:
        try:
            messages.decode(name, data)
        except MalformedMessageError:
            refused += 1
    batch = messages.decode_batch(name, broken)
    assert refused == len(batch.malformed) >= len(raw)
    assert sorted([*batch.malformed, *batch.index]) == list(range(len(broken)))


@pytest.mark.parametrize("frames", [["imu"] * 50, ["ima", "imb"] * 25, ["a", "longer"] * 25])
@pytest.mark.parametrize("name", STAMPED)
def test_many_at_once_equals_one_by_one(name, frames):
    rng = np.random.default_rng(3)
    raws = [StampedEncoder(name, frame).encode(STAMP_NS + k, rng.normal(size=DOUBLES[name]))
            for k, frame in enumerate(frames)]
    raws[4] = StampedEncoder(name, frames[4]).encode(5, np.full(DOUBLES[name], np.nan))
    batch = messages.decode_batch(name, raws)
    assert batch.malformed == {} and batch.frame_id == frames and len(batch) == len(raws)
    for k, raw in enumerate(raws):
        stamp_ns, _, values = messages.decode(name, raw)
        assert batch.stamp_ns[k] == stamp_ns
        assert batch.values[k].tobytes() == np.array(values).tobytes()


def test_a_malformed_message_among_many_is_told_and_nothing_else_is_lost():
    raws = [StampedEncoder(IMU, "imu").encode(k, np.full(37, k)) for k in range(6)]
    raws[2] = raws[2][:-1]
    raws[5] = b"\x00\x00" + raws[5][2:]
    batch = messages.decode_batch(IMU, raws)
    assert list(batch.malformed) == [2, 5] and list(batch.index) == [0, 1, 3, 4]
    assert list(batch.stamp_ns) == [0, 1, 3, 4] and "big-endian" in batch.malformed[5]


def test_an_empty_list_decodes_to_an_empty_batch():
    batch = messages.decode_batch(IMU, [])
    assert len(batch) == 0 and batch.values.shape == (0, 37)


@pytest.mark.parametrize("name", DOUBLES)
def test_encoding_many_equals_one_by_one(name):
    stamps = STAMP_NS + np.arange(20) * 300_000_000
    values = np.random.default_rng(1).normal(size=(20, DOUBLES[name]))
    one = encoder(name, "imué")
    raws = one.encode_batch(stamps, values)
    assert raws == [one.encode(int(stamp), row) for stamp, row in zip(stamps, values, strict=True)]
    assert one.encode_batch(stamps[:0], values[:0]) == []


def test_encoders_refuse_what_a_message_cannot_hold():
    one = StampedEncoder(IMU, "imu")
    with pytest.raises(ValueError, match=r"shape \(36,\)"):
        one.encode(0, np.zeros(36))
    with pytest.raises(ValueError, match="-1 ns does not fit"):
        one.encode(-1, np.zeros(37))
    with pytest.raises(ValueError, match="does not fit"):
        one.encode_batch([0, 2**31 * 10**9], np.zeros((2, 37)))
    with pytest.raises(ValueError, match="NUL"):
        StampedEncoder(IMU, "a\0b")
    with pytest.raises(ValueError, match="child_frame_id"):
        StampedEncoder(IMU, "imu", "child")


JOINT_SETS = [[], ["x"], ["table_joint"], ["ab", "table_joint", "机"]]


def rosbags_joints(frame, names, velocities=()):
    kinds = STORE.types
    stamp = kinds["builtin_interfaces/msg/Time"](*divmod(STAMP_NS, 10**9))
    header = kinds["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)
    message = kinds[messages.JOINTS](header=header, name=names, position=0.5 + np.arange(len(names)),
                                     velocity=np.array(velocities, float), effort=np.zeros(0))
    return bytes(STORE.serialize_cdr(message, messages.JOINTS))


@pytest.mark.parametrize("names", JOINT_SETS)
@pytest.mark.parametrize("frame", FRAMES)
def test_joints_are_encoded_and_decoded_as_by_rosbags(frame, names):
    positions = {name: 0.5 + k for k, name in enumerate(names)}
    raw = messages.encode_joints(STAMP_NS, frame, positions)
    assert raw == rosbags_joints(frame, names)
    assert messages.decode_joints(raw) == (STAMP_NS, positions)
    assert messages.decode_joints(rosbags_joints(frame, names, [0.1] * len(names))) == (STAMP_NS, positions)


def test_joints_of_any_bytes_are_decoded_or_refused():
    raw = rosbags_joints("frame", ["ab", "table_joint"])
    rng = np.random.default_rng(0)
    for size in range(len(raw) - 8 - 16):
        with pytest.raises(MalformedMessageError):
            messages.decode_joints(raw[:size])
    for _ in range(2000):
        spoilt = bytearray(raw)
        spoilt[rng.integers(len(raw))] = rng.integers(256)
        try:
            messages.decode_joints(bytes(spoilt))
        except MalformedMessageError:
            continue


def test_joints_without_positions_have_none():
    kinds = STORE.types
    header = kinds["std_msgs/msg/Header"](stamp=kinds["builtin_interfaces/msg/Time"](1, 0), frame_id="")
    empty = np.zeros(0)
    message = kinds[messages.JOINTS](header=header, name=["a"], position=empty, velocity=empty, effort=empty)
    assert messages.decode_joints(bytes(STORE.serialize_cdr(message, messages.JOINTS))) == (10**9, {})
