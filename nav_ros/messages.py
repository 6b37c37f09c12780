"""CDR codecs of the messages on the hot path, on raw bytes, without ROS.

A raw subscription and a bag give the same serialized bytes; decoding only what is needed takes about a
microsecond where rclpy's message objects take tens. Every type here is a ``std_msgs/Header`` (Odometry
adds the child's frame) followed by nothing but doubles, so one checked layout serves them all::

    00 01 00 00 | sec i32 | nanosec u32 | length u32 | frame_id + NUL | padding to 8 | doubles

A ``sensor_msgs/JointState`` has lists of names and of doubles instead, a ``sensor_msgs/NavSatFix`` small
integers between the doubles; each has its own two functions.

Offsets for the padding are counted after the four bytes of encapsulation. Values stay in the frames and
units of the message (FLU, ENU, SI); :mod:`nav_ros.frames` converts them.

Sources: OMG DDSI-RTPS 10 (encapsulation), CDR as written by Fast-CDR and rosbags.
"""

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from nav_ros.diagnostics import Level

NANOSECONDS = 1_000_000_000
INVALID_STAMP = -1
"""``stamp_ns`` of a message whose seconds are negative or whose nanoseconds reach a second."""

IMU = "sensor_msgs/msg/Imu"
POINT = "geometry_msgs/msg/PointStamped"
PRESSURE = "sensor_msgs/msg/FluidPressure"
QUATERNION = "geometry_msgs/msg/QuaternionStamped"
VECTOR = "geometry_msgs/msg/Vector3Stamped"
ODOMETRY = "nav_msgs/msg/Odometry"
JOINTS = "sensor_msgs/msg/JointState"
FIX = "sensor_msgs/msg/NavSatFix"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"

DOUBLES = {IMU: 37, POINT: 3, PRESSURE: 2, QUATERNION: 4, VECTOR: 3, ODOMETRY: 85, TWIST: 42, POSE: 43}
"""How many doubles follow the header of each message type."""

ORIENTATION = slice(0, 4)
ORIENTATION_COVARIANCE = slice(4, 13)
GYRO = slice(13, 16)
GYRO_COVARIANCE = slice(16, 25)
ACCEL = slice(25, 28)
ACCEL_COVARIANCE = slice(28, 37)
"""Where the fields of an Imu stand among its 37 doubles; the orientation is x, y, z, w."""

POSE_POSITION = slice(0, 3)
POSE_ORIENTATION = slice(3, 7)
POSE_COVARIANCE = slice(7, 43)
TWIST_LINEAR = slice(43, 46)
TWIST_ANGULAR = slice(46, 49)
TWIST_COVARIANCE = slice(49, 85)
"""Where the fields of an Odometry stand among its 85 doubles; a PoseWithCovarianceStamped has the first 43."""

VELOCITY = slice(0, 3)
VELOCITY_COVARIANCE = slice(6, 42)
"""Where linear velocity and 6 by 6 covariance stand among the 42 doubles of a TwistWithCovarianceStamped."""

NO_FIX, GPS_FIX = -1, 0
"""Status of a NavSatFix: from GPS_FIX on there is a position."""
UNKNOWN_VARIANCE = 1e6
"""Variance of what is not estimated, in the unit of its entry."""

COVARIANCE_UNKNOWN, COVARIANCE_KNOWN = 0, 3
"""Type of a NavSatFix's covariance: 0 says nothing, the others that it may be used."""

_LITTLE_ENDIAN = b"\x00\x01"
_ENCAPSULATION = b"\x00\x01\x00\x00"
_FRAME_START = 16
_UINT32 = struct.Struct("<I")
_unpack_length = _UINT32.unpack_from


class RefusedMessageError(ValueError):
    """Raised for a message that says nothing.

    Attributes
    ----------
    fault : str
        Name of its counter.
    level : nav_ros.diagnostics.Level
    """

    def __init__(self, fault, reason, level=Level.ERROR):
        super().__init__(reason)
        self.fault, self.level = fault, level


class MalformedMessageError(RefusedMessageError):
    """Raised for bytes that are not the serialized message they should be."""

    def __init__(self, reason):
        super().__init__("malformed", reason, Level.WARN)


@dataclass(frozen=True)
class MessageBatch:
    """Many decoded messages of one type.

    Attributes
    ----------
    stamp_ns : (N,) int64, :data:`INVALID_STAMP` where it is not a time
    frame_id : list of N str
    values : (N, D) float64, the doubles of each message
    index : (N,) int64, position of each message in the input
    malformed : dict
        Position in the input -> reason, of the messages that could not be decoded.
    """

    stamp_ns: np.ndarray
    frame_id: list
    values: np.ndarray
    index: np.ndarray
    malformed: dict

    def __len__(self):
        return len(self.stamp_ns)


def decode(message_type, raw):
    """Return the stamp, the frame and the doubles of one serialized message.

    Parameters
    ----------
    message_type : str
        A key of :data:`DOUBLES`.
    raw : bytes
        Little-endian CDR with its encapsulation header.

    Returns
    -------
    stamp_ns : int
        :data:`INVALID_STAMP` if the message's stamp is not a time.
    frame_id : str
    values : tuple of float
        In the order of the message's definition; for an Imu take ``values[GYRO]`` and so on.

    Raises
    ------
    MalformedMessageError
        And nothing else, whatever the bytes.
    """
    count = DOUBLES[message_type]
    size = len(raw)
    if size < _FRAME_START or raw[0:2] != _LITTLE_ENDIAN:
        raise MalformedMessageError(_encapsulation_fault(raw))
    (length,) = _unpack_length(raw, 12)
    text = length if message_type != ODOMETRY else _length_with_child(raw, length)
    if size != 4 + (12 + text + 7 & ~7) + 8 * count:
        raise MalformedMessageError(f"{size} bytes do not fit a frame_id of {length} and {count} doubles")
    fields = _layout(text, count).unpack(raw)
    sec, nanosec, frame = fields[:3]
    stamp_ns = sec * NANOSECONDS + nanosec if sec >= 0 and nanosec < NANOSECONDS else INVALID_STAMP
    return stamp_ns, _frame_text(frame[:length]), fields[3:]


def _length_with_child(raw, length):
    """Bytes from the frame_id of an Odometry to the end of its child_frame_id, which stands behind it."""
    at = length + -length % 4
    if _FRAME_START + at + 4 > len(raw):
        raise MalformedMessageError(f"{len(raw)} bytes are too few for a child_frame_id")
    return at + 4 + _unpack_length(raw, _FRAME_START + at)[0]


class Fix(NamedTuple):
    """What a NavSatFix holds: degrees, metres above the ellipsoid, nine covariances (ENU, m^2) and their type."""

    status: int
    latitude_deg: float
    longitude_deg: float
    height: float
    covariance: tuple
    covariance_type: int


def decode_fix(raw):
    """Return the stamp and the content of a serialized sensor_msgs/NavSatFix.

    Parameters
    ----------
    raw : bytes

    Returns
    -------
    stamp_ns : int
        :data:`INVALID_STAMP` if the message's stamp is not a time.
    fix : Fix

    Raises
    ------
    MalformedMessageError
        And nothing else, whatever the bytes.
    """
    size = len(raw)
    if size < _FRAME_START or raw[0:2] != _LITTLE_ENDIAN:
        raise MalformedMessageError(_encapsulation_fault(raw))
    (length,) = _unpack_length(raw, 12)
    layout = _fix_layout(length) if length < size else None
    # What comes over DDS is padded to a multiple of four bytes.
    if layout is None or not layout.size <= size < layout.size + 4:
        raise MalformedMessageError(f"{size} bytes do not fit a NavSatFix with a frame_id of {length}")
    sec, nanosec, frame, status, _, latitude, longitude, height, *covariance, kind = layout.unpack_from(raw)
    _frame_text(frame)
    stamp_ns = sec * NANOSECONDS + nanosec if sec >= 0 and nanosec < NANOSECONDS else INVALID_STAMP
    return stamp_ns, Fix(status, latitude, longitude, height, tuple(covariance), kind)


def encode_fix(stamp_ns, frame_id, fix, service=1):
    """Return a serialized sensor_msgs/NavSatFix.

    Parameters
    ----------
    stamp_ns : int
    frame_id : str
    fix : Fix
    service : int
        Bits of the satellite systems; 1 is GPS.
    """
    text = _string(frame_id)[4:]
    head = _stamp(stamp_ns) + _UINT32.pack(len(text))
    body = _fix_layout(len(text)).pack(0, 0, text, fix.status, service, fix.latitude_deg, fix.longitude_deg,
                                       fix.height, *fix.covariance, fix.covariance_type)
    return head + body[len(head):]


def decode_joints(raw):
    """Return the stamp and the positions of a serialized sensor_msgs/JointState.

    Parameters
    ----------
    raw : bytes

    Returns
    -------
    stamp_ns : int
        :data:`INVALID_STAMP` if the message's stamp is not a time.
    positions : dict
        Joint name -> position, rad; empty where the message has no positions.

    Raises
    ------
    MalformedMessageError
        And nothing else, whatever the bytes.
    """
    if len(raw) < _FRAME_START or raw[0:2] != _LITTLE_ENDIAN:
        raise MalformedMessageError(_encapsulation_fault(raw))
    try:
        sec, nanosec, length = struct.unpack_from("<iII", raw, 4)
        at, names = 16 + length, []
        (count,), at = _UINT32.unpack_from(raw, _aligned(at, 4)), _aligned(at, 4) + 4
        for _ in range(count):
            at = _aligned(at, 4)
            (length,) = _unpack_length(raw, at)
            names.append(_frame_text(bytes(raw[at + 4:at + 4 + length])))
            at += 4 + length
        (count,), at = _UINT32.unpack_from(raw, _aligned(at, 4)), _aligned(at, 4) + 4
        values = struct.unpack_from(f"<{count}d", raw, _aligned(at, 8)) if count else ()
    except (struct.error, OverflowError, MemoryError) as error:
        raise MalformedMessageError(f"{len(raw)} bytes are no JointState: {error}") from None
    if count not in (0, len(names)):
        raise MalformedMessageError(f"{len(names)} joints have {count} positions")
    stamp_ns = sec * NANOSECONDS + nanosec if sec >= 0 and nanosec < NANOSECONDS else INVALID_STAMP
    return stamp_ns, dict(zip(names, values, strict=False))


def encode_joints(stamp_ns, frame_id, positions):
    """Return a serialized sensor_msgs/JointState with positions only.

    Parameters
    ----------
    stamp_ns : int
    frame_id : str
    positions : dict
        Joint name -> position, rad.
    """
    raw = _stamp(stamp_ns) + _string(frame_id)
    raw += _padding(raw, 4) + _UINT32.pack(len(positions))
    for name in positions:
        raw += _padding(raw, 4) + _string(name)
    raw += _padding(raw, 4) + _UINT32.pack(len(positions))
    if positions:
        raw += _padding(raw, 8) + struct.pack(f"<{len(positions)}d", *positions.values())
    return raw + bytes(8)  # no velocities, no efforts


def _aligned(at, size):
    """Return the next offset that is aligned, counted after the encapsulation."""
    return at + (4 - at) % size


def _padding(raw, size):
    return bytes((4 - len(raw)) % size)


def decode_batch(message_type, raws):
    """Decode many messages of one type; the values are those of the one-by-one decoders, bit by bit.

    Parameters
    ----------
    message_type : str
        As for :func:`decode`.
    raws : list of bytes

    Returns
    -------
    MessageBatch
    """
    batch = None if message_type == ODOMETRY else _decode_uniform(raws, DOUBLES[message_type])
    return _decode_one_by_one(message_type, raws) if batch is None else batch


@lru_cache(maxsize=64)
def _layout(length, count):
    padding = -(12 + length) % 8
    return struct.Struct(f"<4xiI4x{length}s{padding}x{count}d")


@lru_cache(maxsize=64)
def _fix_layout(length):
    """Layout of a NavSatFix: status and service stand behind the frame, the service at an even offset."""
    after = -(12 + length + 1) % 2
    end = 12 + length + 1 + after + 2
    return struct.Struct(f"<4xiI4x{length}sb{after}xH{-end % 8}x12dB")


@lru_cache(maxsize=64)
def _frame_text(frame):
    if frame and frame[-1]:
        raise MalformedMessageError("frame_id is not terminated")
    try:
        return frame[:-1].decode()
    except UnicodeDecodeError as error:
        raise MalformedMessageError(f"frame_id is not UTF-8: {error}") from None


def _encapsulation_fault(raw):
    if len(raw) < _FRAME_START:
        return f"{len(raw)} bytes are too few for a header"
    if raw[0:2] == b"\x00\x00":
        return "big-endian CDR is not supported"
    return f"unknown encapsulation 0x{bytes(raw[0:2]).hex()}, expected little-endian CDR (0x0001)"


def _decode_uniform(raws, count):
    """Decode through one array if all messages have the same layout, otherwise return None."""
    if not raws or len(set(map(len, raws))) > 1 or len(raws[0]) < _FRAME_START:
        return None
    (length,) = _unpack_length(raws[0], 12)
    if len(raws[0]) != 4 + (12 + length + 7 & ~7) + 8 * count:
        return None
    rows = np.frombuffer(b"".join(raws), _row_type(length, count))
    if not ((rows["encapsulation"][:, :2] == (0, 1)).all() and (rows["length"] == length).all()):
        return None
    frames = rows["frame"]
    if (frames == frames[0]).all():
        frame_bytes = [frames[0].tobytes()]
    else:
        frame_bytes = [frame.tobytes() for frame in frames]
    try:
        frame_id = [_frame_text(frame) for frame in frame_bytes]
    except MalformedMessageError:
        return None
    if len(frame_id) == 1:
        frame_id *= len(raws)
    sec, nanosec = rows["sec"].astype(np.int64), rows["nanosec"].astype(np.int64)
    stamp_ns = np.where((sec >= 0) & (nanosec < NANOSECONDS), sec * NANOSECONDS + nanosec, INVALID_STAMP)
    return MessageBatch(stamp_ns, frame_id, np.ascontiguousarray(rows["values"], np.float64),
                        np.arange(len(raws)), {})


def _row_type(text, count):
    """Numpy type of one serialized message with `text` bytes between `length` and the doubles' padding."""
    return np.dtype([("encapsulation", "u1", 4), ("sec", "<i4"), ("nanosec", "<u4"), ("length", "<u4"),
                     ("frame", "u1", text), ("padding", "u1", -(12 + text) % 8), ("values", "<f8", count)])


def _decode_one_by_one(message_type, raws):
    good, malformed = [], {}
    for index, raw in enumerate(raws):
        try:
            good.append((index, *decode(message_type, raw)))
        except MalformedMessageError as error:
            malformed[index] = str(error)
    index, stamp_ns, frame_id, values = zip(*good, strict=True) if good else ((), (), (), ())
    return MessageBatch(np.array(stamp_ns, np.int64), list(frame_id),
                        np.array(values, np.float64).reshape(-1, DOUBLES[message_type]),
                        np.array(index, np.int64), malformed)


class StampedEncoder:
    """Serializes one message type with fixed frames; see :data:`DOUBLES` for the types.

    Parameters
    ----------
    message_type : str
    frame_id : str
    child_frame_id : str
        Only an Odometry has one.
    """

    def __init__(self, message_type, frame_id, child_frame_id=""):
        self._count = DOUBLES[message_type]
        text = _string(frame_id)[4:]
        if message_type == ODOMETRY:
            text += bytes(-len(text) % 4) + _string(child_frame_id)
        elif child_frame_id:
            raise ValueError(f"child_frame_id = {child_frame_id!r}: {message_type} has none")
        self._row = np.zeros(1, _row_type(len(text), self._count))
        self._row["encapsulation"] = list(_ENCAPSULATION)
        self._row["length"] = len(frame_id.encode()) + 1
        self._row["frame"] = list(text)
        template = self._row.tobytes()
        self._after_stamp = template[12:len(template) - 8 * self._count]

    def encode(self, stamp_ns, values):
        """Return the serialized message.

        Parameters
        ----------
        stamp_ns : int
        values : (D,) float64
            All doubles of the message in the order of its definition.

        Raises
        ------
        ValueError
            If there are not D values or the stamp does not fit the message.
        """
        values = np.ascontiguousarray(values, "<f8")
        if values.shape != (self._count,):
            raise ValueError(f"values has shape {values.shape}, expected ({self._count},)")
        return _stamp(stamp_ns) + self._after_stamp + values.tobytes()

    def encode_batch(self, stamp_ns, values):
        """Return N serialized messages, as :meth:`encode` makes them one by one.

        Parameters
        ----------
        stamp_ns : (N,) int64
        values : (N, D) float64

        Returns
        -------
        list of N bytes
        """
        stamp_ns = np.asarray(stamp_ns, np.int64)
        expected = (len(stamp_ns), self._count)
        if np.shape(values) != expected:
            raise ValueError(f"values has shape {np.shape(values)}, expected {expected}")
        rows = np.repeat(self._row, len(stamp_ns))
        if len(rows):
            _stamp(int(stamp_ns.min())), _stamp(int(stamp_ns.max()))
        rows["sec"], rows["nanosec"] = np.divmod(stamp_ns, NANOSECONDS)
        rows["values"] = values
        size, joined = rows.itemsize, rows.tobytes()
        return [joined[start:start + size] for start in range(0, len(joined), size)]


def encode_clock(stamp_ns):
    """Return a serialized rosgraph_msgs/Clock."""
    return _stamp(stamp_ns)


def _string(text):
    data = text.encode()
    if b"\x00" in data:
        raise ValueError(f"frame name {text!r} contains a NUL character")
    return _UINT32.pack(len(data) + 1) + data + b"\x00"


def _stamp(stamp_ns):
    sec, nanosec = divmod(stamp_ns, NANOSECONDS)
    if not 0 <= sec < 2**31:
        raise ValueError(f"stamp_ns = {stamp_ns} ns does not fit a ROS time")
    return struct.pack("<4siI", _ENCAPSULATION, sec, nanosec)
