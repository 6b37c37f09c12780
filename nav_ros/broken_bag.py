"""What can still be read of a bag's file that ends too early or is damaged.

A recorder that is killed leaves an MCAP file without index and footer, and with half a chunk. Records are therefore
walked from the start: whole ones are taken, and of a chunk that is cut off as much as its compressor gives back. The
rows of an sqlite3 file are taken in the order of their writing until a page is missing.

Sources: the MCAP specification, https://mcap.dev/spec (records 0x03 Schema, 0x04 Channel, 0x05 Message, 0x06 Chunk);
https://www.sqlite.org/fileformat2.html (the size in the header).
"""

import contextlib
import sqlite3
import struct
from typing import NamedTuple
from urllib.parse import quote

from lz4.frame import LZ4FrameDecompressor

try:
    from compression import zstd
except ImportError:
    from backports import zstd

MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 3, 4, 5, 6
_RECORD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")


class Salvage(NamedTuple):
    """What was found before the break.

    Attributes
    ----------
    types : dict
        Topic -> message type.
    messages : list of (topic, receive_ns, raw)
        By receive time.
    """

    types: dict
    messages: list


def read_broken_mcap(data):
    """Return everything that the bytes of an MCAP file still give, a :class:`Salvage`.

    Raises
    ------
    ValueError
        The bytes are not an MCAP file.
    """
    if data[:len(MAGIC)] != MAGIC:
        raise ValueError("not an MCAP file")
    schemas, channels, messages = {}, {}, []
    for opcode, body in _records(memoryview(data)[len(MAGIC):]):
        try:
            inner = _records(memoryview(_chunk_content(body))) if opcode == _CHUNK else [(opcode, body)]
            for kind, content in inner:
                _take(kind, content, schemas, channels, messages)
        except (struct.error, zstd.ZstdError, RuntimeError, KeyError, UnicodeDecodeError):
            break
    messages.sort(key=lambda message: message[1])
    return Salvage(dict(channels.values()), messages)


def read_broken_db3(path):
    """Return what an sqlite3 file still gives, a :class:`Salvage`.

    Raises
    ------
    ValueError
        The file has no list of topics.
    """
    messages = []
    with contextlib.closing(sqlite3.connect(f"file:{quote(str(path))}?immutable=1", uri=True)) as database:
        database.execute("PRAGMA writable_schema = ON")  # else a file with fewer pages than its header says is refused
        try:
            rows = database.execute("SELECT id, name, type FROM topics").fetchall()
        except sqlite3.Error as error:
            raise ValueError(f"no list of topics: {error}") from error
        topics = {key: topic for key, topic, _ in rows}
        with contextlib.suppress(sqlite3.Error, KeyError):
            for key, receive_ns, raw in database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id"):
                messages.append((topics[key], receive_ns, raw))
    messages.sort(key=lambda message: message[1])
    return Salvage({topic: kind for _, topic, kind in rows}, messages)


def _records(data):
    """Yield opcode and body; the last body may be shorter than it says if it is a chunk's."""
    start = 0
    while start + _RECORD.size <= len(data):
        opcode, size = _RECORD.unpack_from(data, start)
        start += _RECORD.size
        if start + size > len(data) and opcode != _CHUNK:
            return
        yield opcode, data[start:start + size]
        start += size


def _chunk_content(body):
    (name_size,) = struct.unpack_from("<I", body, 28)
    compression = bytes(body[32:32 + name_size]).decode()
    compressed = body[32 + name_size + 8:]
    if compression == "zstd":
        return zstd.ZstdDecompressor().decompress(compressed)
    if compression == "lz4":
        return LZ4FrameDecompressor().decompress(compressed)
    return compressed


def _take(kind, body, schemas, channels, messages):
    if kind == _SCHEMA:
        (key,) = struct.unpack_from("<H", body)
        schemas[key] = _text(body, 2)
    elif kind == _CHANNEL:
        key, schema = struct.unpack_from("<HH", body)
        channels[key] = _text(body, 4), schemas[schema]
    elif kind == _MESSAGE:
        key, _, receive_ns, _ = _MESSAGE_HEAD.unpack_from(body)
        messages.append((channels[key][0], receive_ns, bytes(body[_MESSAGE_HEAD.size:])))


def _text(body, start):
    (size,) = struct.unpack_from("<I", body, start)
    return bytes(body[start + 4:start + 4 + size]).decode()
