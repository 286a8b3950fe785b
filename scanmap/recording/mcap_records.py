"""The records of an MCAP file, walked so that no cut and no damage stops the reading of what is whole.

A file is a chain of records, each an opcode, a length and a body; messages mostly come in chunks that carry a
CRC. Format: https://mcap.dev/spec
"""

from __future__ import annotations

import os
import struct
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar

from scanmap.errors import RecordingError

try:
    from isal.isal_zlib import crc32  # a tenth of the time
except ImportError:  # no wheel for this machine
    from zlib import crc32

MAGIC = b"\x89MCAP0\r\n"
HEADER_BYTES = 9  # opcode, length
FOOTER_BYTES = 20
LARGEST_RECORD = 1 << 30  # a record that says it is longer is damaged, or nothing we can hold in memory

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, _ATTACHMENT_INDEX, _STATISTICS, METADATA, _METADATA_INDEX, _SUMMARY_OFFSET, DATA_END = range(9, 16)
DATA = (CHUNK, MESSAGE, SCHEMA, CHANNEL)  # what messages are made of
PRIVATE = 0x80  # opcodes from here on are other people's own

T = TypeVar("T")


class DamagedError(Exception):
    """A record's body is not what it should be; the message says why."""


class Record(NamedTuple):
    """One record; the body is read on demand."""

    opcode: int
    offset: int  # of the body
    length: int  # of the body


class Break(NamedTuple):
    """The chain of records is broken here."""

    offset: int
    cut: bool  # the file simply ends
    resumed_at: int | None  # where whole records begin again


class Message(NamedTuple):
    """One message, not parsed."""

    channel_id: int
    sequence: int
    log_time: int  # [ns]
    publish_time: int  # [ns]
    data: memoryview


class Channel(NamedTuple):
    """A topic's channel."""

    topic: str
    message_type: str
    encoding: str


@dataclass
class Directory:
    """Channels seen so far; ids mean nothing across files."""

    schemas: dict[int, str] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)

    def add(self, opcode: int, body: bytes | memoryview) -> None:
        """Take in a Schema or Channel record. Raises DamagedError."""
        from mcap import records

        if opcode == SCHEMA:
            schema = parse(records.Schema.read, body)
            self.schemas[schema.id] = schema.name
        else:
            channel = parse(records.Channel.read, body)
            message_type = self.schemas.get(channel.schema_id, "")
            self.channels[channel.id] = Channel(channel.topic, message_type, channel.message_encoding)


def open_mcap(path: Path) -> BinaryIO:
    """Open an MCAP file, after its magic.

    Raises:
        RecordingError: it cannot be read or is no MCAP file.
    """
    try:
        file = path.open("rb")
        magic = file.read(len(MAGIC))
    except OSError as error:
        raise RecordingError(f"recording {path} cannot be read: {error.strerror}") from error
    if magic != MAGIC:
        file.close()
        what = "is empty" if not magic else f"is no MCAP file: it begins with {magic!r}"
        raise RecordingError(f"{path} {what}; scanmap replays .mcap files, folders with scan.csv, and videos")
    return file


def walk(file: BinaryIO, size: int | None = None) -> Iterator[Record | Break]:
    """Every record from the first to the footer, by seeking from one to the next.

    Args:
        size: [bytes] of the file as it was first seen, which may have grown since; as it is now if left out.

    `body` may be called between two steps. Where the chain is broken, the index at the end of the file, if
    there is one, tells where the next chunk begins.
    """
    now = os.fstat(file.fileno()).st_size
    size = now if size is None else min(size, now)
    whole = _ends_with_magic(file, size)
    summary = _summary(file, size) if whole else None
    marks = _chunk_starts(summary, size)
    offset = len(MAGIC)
    while True:
        file.seek(offset)
        head = file.read(HEADER_BYTES)
        opcode, length = struct.unpack("<BQ", head) if len(head) == HEADER_BYTES else (0, LARGEST_RECORD)
        end = offset + HEADER_BYTES + length
        at = bisect_right(marks, offset)
        mark = marks[at] if at < len(marks) else size
        if end > mark or length > LARGEST_RECORD or not (HEADER <= opcode <= DATA_END or opcode >= PRIVATE):
            yield Break(offset, cut=not whole, resumed_at=mark if mark < size else None)
            if mark == size:
                return
            offset = mark
            continue
        yield Record(opcode, offset + HEADER_BYTES, length)
        if opcode == FOOTER:
            return
        offset = end
        if opcode == DATA_END and summary is None:
            yield Break(offset, cut=not whole, resumed_at=None)
            return


def body(file: BinaryIO, record: Record) -> bytes:
    """The body of a record."""
    file.seek(record.offset)
    return file.read(record.length)


def parse(read: Callable[[Any], T], data: bytes | memoryview) -> T:
    """Parse a small record with one of the readers of `mcap.records`. Raises DamagedError."""
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError

    try:
        return read(ReadDataStream(BytesIO(data)))
    except (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError, MemoryError) as error:
        raise DamagedError(str(error)) from error


def attachment(data: bytes) -> tuple[str, bytes]:
    """Name and content of an Attachment record, its CRC checked. Raises DamagedError."""
    from mcap import records

    (crc,) = struct.unpack("<I", data[-4:]) if len(data) > 4 else (0,)
    if crc not in (0, crc32(data[:-4])):
        raise DamagedError("its CRC does not match")
    parsed = parse(records.Attachment.read, data)
    return parsed.name, parsed.data


def chunk_records(data: bytes) -> Iterator[tuple[int, memoryview]]:
    """Opcode and body of every record in a Chunk record, its CRC checked before the first.

    Raises:
        DamagedError: CRC or structure is wrong, or the compression unknown.
    """
    view = memoryview(_chunk_content(data))
    offset = 0
    while offset < len(view):
        if offset + HEADER_BYTES > len(view):
            raise DamagedError("it ends within a record")
        opcode, length = struct.unpack_from("<BQ", view, offset)
        offset += HEADER_BYTES
        if offset + length > len(view):
            raise DamagedError("a record in it is longer than the chunk")
        yield opcode, view[offset : offset + length]
        offset += length


def message(view: memoryview) -> Message:
    """Parse a Message record. Raises DamagedError."""
    if len(view) < 22:
        raise DamagedError("a message in it is too short")
    channel_id, sequence, log_time, publish_time = struct.unpack_from("<HIQQ", view)
    return Message(channel_id, sequence, log_time, publish_time, view[22:])


def content_offset(file: BinaryIO, chunk: Record) -> int | None:
    """Where in the file the records of an uncompressed Chunk record begin; None for a compressed or damaged one."""
    file.seek(chunk.offset + 28)
    plain = file.read(4) == bytes(4)
    return chunk.offset + 40 if plain and chunk.length >= 40 else None


def message_head(file: BinaryIO, offset: int, chunk: Record) -> tuple[int, int] | None:
    """Channel and log time of the Message record that stands at `offset` in a chunk; None if none does."""
    if not chunk.offset <= offset <= chunk.offset + chunk.length - HEADER_BYTES - 22:
        return None
    file.seek(offset)
    opcode, _, channel_id, _, log_time = struct.unpack("<BQHIQ", file.read(HEADER_BYTES + 14))
    return (channel_id, log_time) if opcode == MESSAGE else None


def _chunk_content(data: bytes) -> bytes | memoryview:
    try:
        _, _, size, crc, name_length = struct.unpack_from("<QQQII", data)
        compression = data[32 : 32 + name_length].decode("ascii")
        (stored,) = struct.unpack_from("<Q", data, 32 + name_length)
    except (struct.error, UnicodeDecodeError) as error:
        raise DamagedError("its head is damaged") from error
    content = memoryview(data)[40 + name_length :]
    if stored != len(content) or size > LARGEST_RECORD:
        raise DamagedError("its length is wrong")
    unpacked = _decompress(compression, content, size)
    if len(unpacked) != size:
        raise DamagedError("its length is wrong")
    if crc not in (0, crc32(unpacked)):
        raise DamagedError("its CRC does not match")
    return unpacked


def _decompress(compression: str, content: memoryview, size: int) -> bytes | memoryview:
    if compression == "":
        return content
    try:
        if compression == "zstd":
            import zstandard

            return zstandard.ZstdDecompressor().decompress(content, max_output_size=size)
        if compression == "lz4":
            import lz4.frame

            return bytes(lz4.frame.decompress(content))
    except Exception as error:  # each codec has its own errors for bytes that are not its own
        raise DamagedError(f"it cannot be decompressed: {error}") from error
    raise DamagedError(f"its compression is {compression!r}; known: none, zstd, lz4")


def _ends_with_magic(file: BinaryIO, size: int) -> bool:
    if size < 2 * len(MAGIC) + FOOTER_BYTES:
        return False
    file.seek(size - len(MAGIC))
    return file.read(len(MAGIC)) == MAGIC


def _summary(file: BinaryIO, size: int) -> bytes | None:
    """The records between data and footer: schemas, channels, indexes; empty if there are none, None if damaged."""
    footer = size - len(MAGIC) - FOOTER_BYTES
    file.seek(footer)
    fields = file.read(FOOTER_BYTES)
    position, _, crc = struct.unpack("<QQI", fields)
    if position == 0:
        return b""
    if not len(MAGIC) < position < footer or footer - position > LARGEST_RECORD:
        return None
    file.seek(position)
    summary = file.read(footer - position)  # with the footer's own opcode and length, as the CRC has it
    if crc not in (0, crc32(fields[:-4], crc32(summary))):
        return None
    return summary[:-HEADER_BYTES]


def _chunk_starts(summary: bytes | None, size: int) -> list[int]:
    """Where the chunks begin, and last the summary itself; ascending, empty if unknown."""
    if not summary:
        return []
    position = size - len(MAGIC) - FOOTER_BYTES - HEADER_BYTES - len(summary)
    at, starts = 0, [position]
    while at + HEADER_BYTES <= len(summary):
        opcode, length = struct.unpack_from("<BQ", summary, at)
        if opcode == CHUNK_INDEX and length >= 24 and at + HEADER_BYTES + 24 <= len(summary):
            starts.append(struct.unpack_from("<Q", summary, at + HEADER_BYTES + 16)[0])
        at += HEADER_BYTES + length
    return sorted(start for start in starts if start <= position)
