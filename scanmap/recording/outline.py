"""What an MCAP file holds, found without reading its images."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from scanmap.recording import layout, mcap_records
from scanmap.recording.mcap_records import Break, DamagedError, Directory, Record

ATTACHMENT_LIMIT_BYTES = 1 << 24

Entries = NDArray[np.uint64]  # (N, 2) of a message index: time [ns] and place in the chunk


@dataclass
class Outline:
    """Topics, counts, attachments and metadata of one file; true for cut and damaged files as well."""

    path: Path
    size: int = 0  # [bytes]
    directory: Directory = field(default_factory=Directory)
    attachments: dict[str, str] = field(default_factory=dict)  # rig.toml and calibration.toml
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)  # messages by channel
    first_ns: int | None = None
    last_ns: int | None = None
    cut_at: int | None = None  # byte at which the file ends without an end
    damaged: bool = False
    faults: list[str] = field(default_factory=list)
    diagnostics: list[Record] = field(default_factory=list)  # chunks with messages on a diagnostics topic

    @property
    def cut(self) -> bool:
        """Whether the file ends without an end."""
        return self.cut_at is not None

    def count(self, topic: str) -> int:
        """Messages on a topic."""
        return sum(n for channel, n in self.counts.items() if self.directory.channels[channel].topic == topic)

    def add(self, channel_id: int, times_ns: np.ndarray) -> None:
        """Count messages of a channel."""
        if channel_id not in self.directory.channels or not len(times_ns):
            return
        self.counts[channel_id] = self.counts.get(channel_id, 0) + len(times_ns)
        times = times_ns.tolist()  # one or two of them, mostly
        first, last = min(times), max(times)
        self.first_ns = first if self.first_ns is None else min(first, self.first_ns)
        self.last_ns = last if self.last_ns is None else max(last, self.last_ns)


def outline(path: Path) -> Outline:
    """Walk a file from record to record.

    Raises:
        RecordingError: it cannot be read or is no MCAP file.
    """
    found = Outline(path)
    with mcap_records.open_mcap(path) as file:
        found.size = path.stat().st_size
        chunk: Record | None = None  # one whose messages have not been counted yet
        indexes: list[bytes] = []
        for record in mcap_records.walk(file, found.size):
            if isinstance(record, Record) and record.opcode == mcap_records.MESSAGE_INDEX:
                indexes.append(mcap_records.body(file, record))
                continue
            _count(found, file, chunk, indexes)
            chunk, indexes = None, []
            if isinstance(record, Break):
                found.damaged = True
                found.cut_at = record.offset if record.cut else None
            elif record.opcode == mcap_records.CHUNK:
                chunk = record
            else:
                _note(found, file, record)
        _count(found, file, chunk, indexes)
    return found


def _count(found: Outline, file: BinaryIO, chunk: Record | None, indexes: list[bytes]) -> None:
    """Count a chunk's messages by its index; one without a true one, or with channels not known yet, is opened."""
    if chunk is None:
        return
    entries = {struct.unpack_from("<H", index)[0]: _entries(index) for index in indexes if len(index) >= 6}
    if not _agrees(file, chunk, entries):
        entries = {}
    if not entries or not entries.keys() <= found.directory.channels.keys():
        try:
            opened = _open(found, mcap_records.body(file, chunk))
        except DamagedError:
            return  # reported by the reading of the shots
        entries = entries or opened
    for channel_id, times_and_offsets in entries.items():
        found.add(channel_id, times_and_offsets[:, 0])
        channel = found.directory.channels.get(channel_id)
        if channel is not None and channel.message_type == layout.DIAGNOSTIC_ARRAY:
            found.diagnostics.append(chunk)


def _entries(index: bytes) -> Entries:
    whole = (len(index) - 6) // 16 * 16
    return np.frombuffer(index[6 : 6 + whole], "<u8").reshape(-1, 2)


def _agrees(file: BinaryIO, chunk: Record, entries: dict[int, Entries]) -> bool:
    """Whether an index says what stands in its chunk: the format guards the one by a CRC, but not the other."""
    content = mcap_records.content_offset(file, chunk)
    if content is None:  # compressed: what others recorded is taken at its word
        return True
    for channel_id, times_and_offsets in entries.items():
        for time, offset in times_and_offsets.tolist():
            if mcap_records.message_head(file, content + offset, chunk) != (channel_id, time):
                return False
    return True


def _open(found: Outline, data: bytes) -> dict[int, Entries]:
    """Take in a chunk's topics; times of its messages by channel."""
    times: dict[int, list[int]] = {}
    for opcode, view in mcap_records.chunk_records(data):
        if opcode in (mcap_records.SCHEMA, mcap_records.CHANNEL):
            found.directory.add(opcode, view)
        elif opcode == mcap_records.MESSAGE:
            message = mcap_records.message(view)
            times.setdefault(message.channel_id, []).append(message.log_time)
    return {channel: np.array([[time, 0] for time in of_it], np.uint64) for channel, of_it in times.items()}


def _note(found: Outline, file: BinaryIO, record: Record) -> None:
    """Take in what stands outside the chunks."""
    from mcap import records

    try:
        if record.opcode in (mcap_records.SCHEMA, mcap_records.CHANNEL):
            found.directory.add(record.opcode, mcap_records.body(file, record))
        elif record.opcode == mcap_records.MESSAGE:
            head = mcap_records.body(file, record._replace(length=min(record.length, 22)))
            message = mcap_records.message(memoryview(head))
            found.add(message.channel_id, np.array([message.log_time], np.uint64))
        elif record.opcode == mcap_records.METADATA:
            metadata = mcap_records.parse(records.Metadata.read, mcap_records.body(file, record))
            content = dict(metadata.metadata)
            crc = content.pop(layout.METADATA_CRC, "")
            if crc and crc != layout.metadata_crc(content):
                raise DamagedError(f"metadata {metadata.name!r}: its CRC does not match")
            found.metadata[metadata.name] = content
        elif record.opcode == mcap_records.ATTACHMENT and record.length < ATTACHMENT_LIMIT_BYTES:
            name, text = mcap_records.attachment(mcap_records.body(file, record))
            if name in (layout.CALIBRATION_ATTACHMENT, layout.RIG_ATTACHMENT):
                found.attachments[name] = text.decode("utf-8")
    except (DamagedError, UnicodeDecodeError) as error:
        found.faults.append(f"{found.path}: the record at byte {record.offset} is damaged and left out: {error}")
