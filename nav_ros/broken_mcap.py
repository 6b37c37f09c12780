"""What can still be read of an MCAP file that ends too early or is damaged.

A recorder that is killed leaves no index, no footer and half a chunk. Records are therefore walked from the
start: whole ones are taken, and of a chunk that is cut off as much as its compressor gives back.

Source: the MCAP specification, https://mcap.dev/spec (records 0x03 Schema, 0x04 Channel, 0x05 Message,
0x06 Chunk).
"""

import struct
from typing import NamedTuple

from lz4.frame import LZ4FrameDecompressor

try:
    from compression import zstd
except ImportError:
    from backports import zstd

MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 3, 4, 5, 6
_RECORD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")


class BrokenMcap(NamedTuple):
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
    """Return everything that the bytes of an MCAP file still give, a :class:`BrokenMcap`.

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
    return BrokenMcap(dict(channels.values()), messages)


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
