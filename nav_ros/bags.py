"""Rosbag2 folders and files, read and written without a ROS installation (through rosbags).

Reading goes in recorded order, by receive time. Whatever is wrong with a bag is one :class:`BagError` with
one line; a recording that was cut off is read up to the break, and a :class:`BagWarning` says so.
"""

import contextlib
import sqlite3
import struct
import warnings
from collections import Counter
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import apsw
import numpy as np
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, ReaderError, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer
from rosbags.typesys import Stores, get_typestore

from inertial.recording import AltitudeSeries, AttitudeSeries, ImuSeries, Recording
from nav_ros.altitude_source import AltitudeRefusedError, AltitudeSource
from nav_ros.broken_bag import read_broken_db3, read_broken_mcap, zstd
from nav_ros.frames import q_nb_from_orientation, swap_flu_frd
from nav_ros.messages import (
    ACCEL,
    FIX,
    GYRO,
    IMU,
    JOINTS,
    ODOMETRY,
    POINT,
    POSE,
    PRESSURE,
    QUATERNION,
    TWIST,
    VECTOR,
    decode_batch,
)

TOPICS = {"imu": "/imu/data_raw", "altitude": "/altitude", "pressure": "/pressure",
          "truth": "/ground_truth/attitude", "true_odometry": "/ground_truth/odometry",
          "joints": "/joint_states", "fix": "/fix", "velocity": "/velocity", "inclinometer": "/inclinometer",
          "heading": "/heading", "output": "/imu/data", "state": "/attitude/state", "odometry": "/odometry",
          "gyro_bias": "/imu/gyro_bias", "accel_bias": "/imu/accel_bias"}
"""What is on which topic unless told otherwise."""

TYPES = {"imu": IMU, "altitude": POINT, "pressure": PRESSURE, "truth": QUATERNION, "true_odometry": ODOMETRY,
         "joints": JOINTS, "fix": FIX, "velocity": TWIST, "inclinometer": QUATERNION, "heading": POSE,
         "output": IMU, "state": ODOMETRY, "odometry": ODOMETRY, "gyro_bias": VECTOR, "accel_bias": VECTOR}
"""The message type of each of :data:`TOPICS`."""

_SUFFIXES = (".mcap", ".db3")
# What rosbags lets out of damaged files besides its own error.
_DAMAGE = (ReaderError, ValueError, TypeError, LookupError, ArithmeticError, AssertionError, EOFError,
           RuntimeError, MemoryError, struct.error, zstd.ZstdError, apsw.Error)


class BagError(Exception):
    """Raised for anything wrong with a bag, with one line for its user."""


class BagWarning(UserWarning):
    """Something about a bag that its user should know, though it could be read."""


class BagMessage(NamedTuple):
    """One recorded message."""

    topic: str
    receive_ns: int
    raw: bytes


class BagReader:
    """An open bag: a rosbag2 folder, or a lone .mcap or .db3 file.

    Parameters
    ----------
    path : path-like

    Attributes
    ----------
    path : pathlib.Path
    name : str
        Of the folder or file.
    types : dict
        Topic -> message type.
    broken : str or None
        Why the bag ends early, once that is known; a :class:`BagWarning` has been given.

    Raises
    ------
    BagError
        There is no bag that can be read.
    """

    def __init__(self, path):
        self.path = Path(path)
        self.name = bag_name(path)
        self.broken = None
        self._salvaged = []
        self._readers = []
        self.types = {}
        unreadable = [reason for part in _parts(self.path) for reason in self._open(part)]
        if unreadable and not self._readers and not self._salvaged:
            raise BagError(f"{self.path}: not a bag that can be read ({unreadable[0]})")
        for reason in unreadable:
            self._tell_break(reason, "the other files")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """Close the files."""
        for reader in self._readers:
            reader.close()
        self._readers.clear()

    def require(self, topic, message_type=None):
        """Check that the bag has a topic, of a given type.

        Raises
        ------
        BagError
            Naming the topic and those which are there.
        """
        if topic not in self.types:
            there = ", ".join(sorted(self.types)) or "none"
            fitting = ", ".join(sorted(name for name, kind in self.types.items() if kind == message_type))
            hint = f" ({message_type} is on {fitting})" if fitting else ""
            raise BagError(f"{self.path}: no topic {topic}{hint}; topics there: {there}")
        if message_type is not None and self.types[topic] != message_type:
            raise BagError(f"{self.path}: topic {topic} is {self.types[topic]}, expected {message_type}")

    def inputs(self, keys, topics, altitude_source="auto"):
        """Return which topics to read: topic -> key.

        Parameters
        ----------
        keys : iterable of str
            Of :data:`TOPICS`: the IMU, which must be there, and what is used where it is; of the altimeters one.
        topics : dict
            Key -> topic, as :data:`TOPICS`; one that differs must be there, whether it is read or not.
        altitude_source : {"auto", "altitude", "pressure", "none"}

        Raises
        ------
        BagError
            A topic is not there or of another type, or there are two altimeters to choose from.
        """
        for key, topic in topics.items():
            if key == "imu" or topic != TOPICS[key]:
                self.require(topic, TYPES[key])
        unused = {"altitude", "pressure"} - {choose_altitude(self.types, topics, altitude_source)}
        there = {topics[key]: key for key in keys if key not in unused and topics[key] in self.types}
        for topic, key in there.items():
            self.require(topic, TYPES[key])
        return there

    def messages(self, topics=None):
        """Yield a (topic, receive_ns, raw) :class:`BagMessage` each, in recorded order.

        Parameters
        ----------
        topics : iterable of str, optional
            All by default.

        Raises
        ------
        BagError
            A topic is not there.
        """
        topics = set(self.types if topics is None else topics)
        for topic in sorted(topics):
            self.require(topic)
        for reader in self._readers:
            yield from self._read(reader, topics)
        for message in self._salvaged:
            if message.topic in topics:
                yield message

    def _open(self, part):
        """Open a folder or file; return a reason for each file that gives nothing at all."""
        try:
            reader = Reader(part)
            reader.open()
        except (OSError, *_DAMAGE) as error:
            if part.is_dir():
                # Metadata that cannot be used; the files speak for themselves.
                files = _storage_files(part)
                reasons = [reason for file in files for reason in self._open(file)]
                return reasons if files else [_one_line(error)]
            return self._salvage(part, _one_line(error))
        self._readers.append(reader)
        self.types.update({connection.topic: connection.msgtype for connection in reader.connections})
        return []

    def _salvage(self, file, reason):
        try:
            found = read_broken_db3(file) if file.suffix == ".db3" else read_broken_mcap(file.read_bytes())
        except (OSError, ValueError):
            return [reason]
        if not found.messages:
            return [reason]
        self.types.update(found.types)
        self._salvaged += [BagMessage(*message) for message in found.messages]
        span = (found.messages[-1][1] - found.messages[0][1]) * 1e-9
        self._tell_break(reason, f"{len(found.messages)} messages over {span:.1f} s up to the break")
        return []

    def _read(self, reader, topics):
        connections = [connection for connection in reader.connections if connection.topic in topics]
        if not connections:
            return
        count = 0
        try:
            for connection, receive_ns, raw in reader.messages(connections):
                yield BagMessage(connection.topic, receive_ns, raw)
                count += 1
        except _DAMAGE as error:
            self._tell_break(_one_line(error), f"{count} messages up to the break")

    def _tell_break(self, reason, what):
        self.broken = reason
        warnings.warn(f"{self.path}: the recording is cut off or damaged ({reason}); read {what}",
                      BagWarning, stacklevel=4)


def read_messages(path, topics=None):
    """Yield the (topic, receive_ns, raw) of a bag's messages in recorded order.

    Parameters
    ----------
    path : path-like
    topics : dict or iterable of str, optional
        Topics, or topic -> message type to insist on. All by default.

    Raises
    ------
    BagError
    """
    with BagReader(path) as bag:
        for topic in topics or ():
            bag.require(topic, topics[topic] if isinstance(topics, dict) else None)
        yield from bag.messages(topics)


class _McapWriter(McapWriter):
    """rosbags' writer for many messages at once: a fifth of the time, the same bytes."""

    _message = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time

    def write_all(self, messages, channels):
        """Append a list of (topic, receive_ns, raw); `channels` has each topic's number."""
        pack, head = self._message.pack, self._message.size
        end = self.chunk.bio.tell()
        for topic, receive_ns, raw in messages:
            channel, size = channels[topic], len(raw)
            self.chunk.msgs[channel].append((receive_ns, end))
            self.chunk.bio.write(pack(5, head - 9 + size, channel, 0, receive_ns, receive_ns) + raw)
            end += head + size
            if end > 2**20:
                self.close_chunk()
                end = 0

    def close_chunk(self):
        """End the chunk, whose times and counts are those of its messages."""
        chunk = self.chunk
        for channel, messages in chunk.msgs.items():
            self.channel_stats[channel] += len(messages)
            chunk.message_start_time = min(chunk.message_start_time, min(messages)[0])
            chunk.message_end_time = max(chunk.message_end_time, max(messages)[0])
        self.message_start_time = min(self.message_start_time, chunk.message_start_time)
        self.message_end_time = max(self.message_end_time, chunk.message_end_time)
        super().close_chunk()


class _Sqlite3Writer(Sqlite3Writer):
    """rosbags' writer for many messages at once."""

    def write_all(self, messages, topics):
        """Append a list of (topic, receive_ns, raw); `topics` has each topic's number."""
        self.cursor.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES(?, ?, ?)",
                                [(topics[topic], receive_ns, raw) for topic, receive_ns, raw in messages])


_UNWRITABLE = (OSError, sqlite3.Error)  # a full disk, for example


class _Writer(Writer):
    STORAGE_PLUGINS = {StoragePlugin.MCAP: _McapWriter, StoragePlugin.SQLITE3: _Sqlite3Writer}


class BagWriter:
    """Writes a bag; the same input gives the same bytes.

    Parameters
    ----------
    path : path-like
        The folder to make; its name becomes that of the file in it.
    topics : dict
        Topic -> message type.
    storage : {"mcap", "sqlite3"}
        MCAP is compressed by zstd in chunks.

    Raises
    ------
    BagError
        The folder exists or cannot be made.
    """

    def __init__(self, path, topics, storage="mcap"):
        plugins = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
        if storage not in plugins:
            raise BagError(f"storage {storage!r}: must be one of {', '.join(plugins)}")
        if Path(path).exists():
            raise BagError(f"{path} exists already and is not overwritten")
        self._path = path
        self._writer = _Writer(path, version=9, storage_plugin=plugins[storage])
        if storage == "mcap":
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        try:
            self._writer.open()
        except OSError as error:
            raise BagError(f"{path}: cannot be written ({error.strerror})") from error
        store = get_typestore(Stores.ROS2_JAZZY)
        self._numbers = {
            topic: self._writer.add_connection(topic, message_type, typestore=store,
                                               offered_qos_profiles=[_SENSOR_QOS]).id
            for topic, message_type in topics.items()}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """Finish the bag; what was written before an exception is kept readable."""
        try:
            self._writer.close()
        except _UNWRITABLE as error:
            with contextlib.suppress(*_UNWRITABLE):
                self._writer.storage.abort()
            raise self._cut_off(error) from error

    def write(self, topic, receive_ns, raw):
        """Append one serialized message; as :meth:`write_all`."""
        self.write_all([(topic, receive_ns, raw)])

    def write_all(self, messages):
        """Append serialized messages.

        Parameters
        ----------
        messages : list of (topic, receive_ns, raw)
            Of the topics given at the start.

        Raises
        ------
        BagError
            The disk is full, for example; what was written before stays.
        """
        if not messages:
            return
        writer = self._writer
        try:
            writer.storage.write_all(messages, self._numbers)
        except _UNWRITABLE as error:
            raise self._cut_off(error) from error
        for topic, count in Counter(map(itemgetter(0), messages)).items():
            writer.counts[self._numbers[topic]] += count
        writer.min_timestamp = min(writer.min_timestamp, min(map(itemgetter(1), messages)))
        writer.max_timestamp = max(writer.max_timestamp, max(map(itemgetter(1), messages)))

    def _cut_off(self, error):
        reason = getattr(error, "strerror", None) or error
        return BagError(f"{self._path}: cannot be written any further ({reason}); the bag there is cut off")


_ANY_TIME = QosTime(0, 0)
_SENSOR_QOS = Qos(QosHistory.KEEP_LAST, 100, QosReliability.BEST_EFFORT, QosDurability.VOLATILE, _ANY_TIME,
                  _ANY_TIME, QosLiveliness.AUTOMATIC, _ANY_TIME, False)


def choose_altitude(types, topics, altitude_source="auto"):
    """Return the key ("altitude", "pressure" or None) of the altimeter topic to use.

    Parameters
    ----------
    types : dict
        Topic -> message type, what is there.
    topics : dict
        Key -> topic, see :data:`TOPICS`.
    altitude_source : {"auto", "altitude", "pressure", "none"}

    Raises
    ------
    BagError
        Both are there and none was chosen, or the chosen one is not there.
    """
    there = [key for key in ("altitude", "pressure") if topics[key] in types]
    if altitude_source == "none" or (altitude_source == "auto" and not there):
        return None
    if altitude_source == "auto" and len(there) == 2:
        raise BagError(f"both {topics['altitude']} and {topics['pressure']} are there: choose one by "
                       "altitude_source:=altitude or altitude_source:=pressure")
    if altitude_source != "auto" and altitude_source not in there:
        raise BagError(f"altitude_source is {altitude_source}, but there is no topic "
                       f"{topics[altitude_source]}")
    return there[0] if altitude_source == "auto" else altitude_source


def read_recording(path, topics=None, altitude_source="auto"):
    """Read IMU, altimeter and truth of a bag, in FRD and NED.

    Parameters
    ----------
    path : path-like
    topics : dict, optional
        Key -> topic, where it is not as in :data:`TOPICS`.
    altitude_source : {"auto", "altitude", "pressure", "none"}

    Returns
    -------
    inertial.recording.Recording
        Stamps that are not times are -1; malformed messages and refused altitudes are left out with a
        :class:`BagWarning`.

    Raises
    ------
    BagError
        There is no such bag, no IMU in it, or a topic of another type.
    """
    topics = TOPICS | (topics or {})
    with BagReader(path) as bag:
        inputs = bag.inputs(("imu", "altitude", "pressure", "truth"), topics, altitude_source)
        raws, arrival = _collect(bag, inputs)
        name = bag.name
    batches = {key: decoded(key, raws[key], f"{path}: {topic}") for topic, key in inputs.items()}
    imu = batches["imu"]
    series = ImuSeries(imu.stamp_ns, swap_flu_frd(imu.values[:, GYRO]), swap_flu_frd(imu.values[:, ACCEL]))
    altitude = truth = None
    for altimeter in batches.keys() & {"altitude", "pressure"}:
        altitude = _altitudes(path, topics[altimeter], TYPES[altimeter], batches[altimeter], arrival)
    if "truth" in batches and len(batches["truth"]):
        truth = AttitudeSeries(batches["truth"].stamp_ns, q_nb_from_orientation(batches["truth"].values))
    return Recording(name, series, altitude, truth)


def _collect(bag, keys):
    """Return the raw messages by key, and how many of the IMU's came before each of the altimeter's."""
    raws, arrival = {key: [] for key in keys.values()}, []
    for topic, _, raw in bag.messages(keys):
        key = keys[topic]
        if key in ("altitude", "pressure"):
            arrival.append(len(raws["imu"]))
        raws[key].append(raw)
    return raws, np.array(arrival, np.int64)


def decoded(key, raws, told_of=None):
    """Return the :class:`~nav_ros.messages.MessageBatch` of serialized messages.

    Parameters
    ----------
    key : str
        Of :data:`TYPES`.
    raws : list of bytes
    told_of : str, optional
        Malformed messages are left out with a :class:`BagWarning` that begins so; without it they are refused.

    Raises
    ------
    ValueError
    """
    batch = decode_batch(TYPES[key], raws)
    if batch.malformed:
        index, reason = next(iter(batch.malformed.items()))
        text = f"{len(batch.malformed)} of {len(raws)} messages are malformed, the first is number {index}: {reason}"
        if told_of is None:
            raise ValueError(text)
        warnings.warn(f"{told_of}: {text}", BagWarning, stacklevel=3)
    return batch


def _altitudes(path, topic, message_type, batch, arrival):
    source, kept, altitude, refused = AltitudeSource(message_type), [], [], []
    for k, values in enumerate(batch.values.tolist()):
        try:
            altitude.append(source.convert(values).altitude)
            kept.append(k)
        except AltitudeRefusedError as error:
            refused.append(str(error))
    if refused:
        warnings.warn(f"{path}: {len(refused)} of {len(batch)} samples of {topic} refused: {refused[0]}",
                      BagWarning, stacklevel=3)
    if not kept:
        return None
    return AltitudeSeries(batch.stamp_ns[kept], np.array(altitude), arrival[batch.index[kept]])


def bag_name(path):
    """Return the name of a bag: of its folder, or of its file without the suffix."""
    path = Path(path)
    return path.stem if path.suffix in _SUFFIXES else path.resolve().name


def _parts(path):
    """Return what rosbags should open: the folder, or the files of a folder without metadata."""
    if not path.exists():
        raise BagError(f"{path}: there is no such file or folder")
    if path.name == "metadata.yaml":
        path = path.parent
    if path.is_dir() and not (path / "metadata.yaml").exists():
        files = _storage_files(path)
        if not files:
            raise BagError(f"{path}: not a bag, the folder has no metadata.yaml, .mcap or .db3 file")
        return files
    if path.is_file() and path.suffix not in _SUFFIXES:
        raise BagError(f"{path}: not a bag, expected a rosbag2 folder or a .mcap or .db3 file")
    return [path]


def _storage_files(folder):
    return sorted(file for file in folder.iterdir() if file.suffix in _SUFFIXES)


def _one_line(text):
    return " ".join(str(text).split())
