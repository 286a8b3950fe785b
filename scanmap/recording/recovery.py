"""`recover`: a whole file made of what is whole in a cut or damaged one."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any, BinaryIO

import scanmap
from scanmap.errors import ConfigError, RecordingError
from scanmap.recording import layout, mcap_records
from scanmap.recording.info import RecordingInfo, describe
from scanmap.recording.layout import RecordingParams
from scanmap.recording.mcap_records import DamagedError, Record
from scanmap.recording.outline import Outline
from scanmap.recording.parts import part_outlines
from scanmap.recording.shot_file import ShotFile


def recover(path: Path | str, out: Path | str, params: RecordingParams | None = None) -> RecordingInfo:
    """Copy every whole message, attachment and metadata record of a recording, and of its parts, into a new file.

    The new file has an end and an index, so that readers which refuse a cut file (the rerun viewer, ROS 2)
    open it. The old one stays as it is.

    Args:
        path: a recording that is cut or damaged, or continued in parts.
        out: the new file; must not exist.

    Returns:
        What the new file holds.

    Raises:
        ConfigError: nothing is wrong with the recording.
        RecordingError: nothing can be saved, or `out` cannot be written.
    """
    path, out, params = Path(path), Path(out), params or RecordingParams()
    parts = part_outlines(path)
    last = parts[-1]
    target = ShotFile(out, overwrite=False, fsync_s=params.fsync_s)
    try:
        copy = _Copy(target, params.image_topic)
        for found in parts:
            _copy(found, copy, is_last=found is last)
        if layout.END_METADATA not in last.metadata:
            end = {"reason": "cut", "shots": str(copy.images)}
            copy.writer.add_metadata(layout.END_METADATA, end | {layout.METADATA_CRC: layout.metadata_crc(end)})
        copy.writer.finish()
        target.flush()
        target.sync()
        if not copy.messages:
            raise RecordingError(f"recording {path} holds no whole message, there is nothing to recover")
        if not copy.lost and not any(found.damaged for found in parts) and len(parts) == 1:
            raise ConfigError(
                f"recording {path} is whole, there is nothing to recover: scanmap replay {shlex.quote(str(path))}"
            )
    except BaseException as error:  # Ctrl-C too: half a file would pass for a whole one
        out.unlink()
        if isinstance(error, OSError):
            raise RecordingError(f"recording {out} cannot be written: {error.strerror or error}") from error
        raise
    finally:
        target.close()
    return describe(out, params)


def _copy(found: Outline, copy: _Copy, *, is_last: bool) -> None:
    copy.begin(is_last=is_last)
    with mcap_records.open_mcap(found.path) as file:
        # Topics are named in the first chunks and again at the end: one of the two may be damaged.
        for record in mcap_records.walk(file, found.size):
            if isinstance(record, Record) and record.opcode in (mcap_records.SCHEMA, mcap_records.CHANNEL):
                copy.take(file, record)
        for record in mcap_records.walk(file, found.size):
            if isinstance(record, Record):
                copy.take(file, record)


class _Copy:
    """Takes records over into a new file, where schemas and channels get new numbers."""

    def __init__(self, target: ShotFile, image_topic: str) -> None:
        from mcap.writer import CompressionType, Writer

        self.writer = Writer(target, chunk_size=1 << 40, compression=CompressionType.NONE)
        self.writer.start(profile="ros2", library=f"scanmap {scanmap.__version__}")
        self._image_topic = image_topic
        self._image_channels: set[int] = set()
        self._registered: dict[tuple[object, ...], int] = {}  # what a schema or channel is, and its new number
        self._named: set[str] = set()  # attachments and metadata that are there
        self.messages = self.images = 0
        self.lost = 0  # records that were damaged
        self.begin(is_last=True)

    def begin(self, *, is_last: bool) -> None:
        """Another file begins, with numbers of its own; only the last says how the scan ended."""
        self._schemas: dict[int, int] = {0: 0}  # 0 means no schema, everywhere
        self._channels: dict[int, int] = {}
        self._is_last = is_last

    def take(self, file: BinaryIO, record: Record) -> None:
        """Copy a record if it is whole."""
        from mcap import records

        try:
            if record.opcode == mcap_records.CHUNK:
                for opcode, view in mcap_records.chunk_records(mcap_records.body(file, record)):
                    self._take_data(opcode, view)
                self.writer.flush()
            elif record.opcode in mcap_records.DATA:
                self._take_data(record.opcode, memoryview(mcap_records.body(file, record)))
            elif record.opcode == mcap_records.ATTACHMENT:
                data = mcap_records.body(file, record)
                mcap_records.attachment(data)
                a = mcap_records.parse(records.Attachment.read, data)
                if self._is_new(a.name):
                    self.writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
            elif record.opcode == mcap_records.METADATA:
                metadata = mcap_records.parse(records.Metadata.read, mcap_records.body(file, record))
                if self._is_new(metadata.name):
                    self.writer.add_metadata(metadata.name, metadata.metadata)
        except DamagedError:
            self.lost += 1

    def _is_new(self, name: str) -> bool:
        """Whether an attachment or metadata record belongs into the new file; notes that it is there."""
        if name in self._named or (name == layout.END_METADATA and not self._is_last):
            return False
        self._named.add(name)
        return True

    def _take_data(self, opcode: int, view: memoryview) -> None:
        from mcap import records

        if opcode == mcap_records.SCHEMA:
            schema = mcap_records.parse(records.Schema.read, view)
            if schema.id not in self._schemas:
                what = (schema.name, schema.encoding, schema.data)
                if what not in self._registered:
                    self._registered[what] = self.writer.register_schema(*what)
                self._schemas[schema.id] = self._registered[what]
        elif opcode == mcap_records.CHANNEL:
            channel: Any = mcap_records.parse(records.Channel.read, view)
            if channel.id not in self._channels and channel.schema_id in self._schemas:
                schema_id = self._schemas[channel.schema_id]
                if channel.topic == self._image_topic:
                    self._image_channels.add(channel.id)
                named = (channel.topic, channel.message_encoding, schema_id, tuple(channel.metadata.items()))
                if named not in self._registered:
                    self._registered[named] = self.writer.register_channel(
                        channel.topic, channel.message_encoding, schema_id, channel.metadata
                    )
                self._channels[channel.id] = self._registered[named]
        elif opcode == mcap_records.MESSAGE:
            message = mcap_records.message(view)
            if message.channel_id in self._channels:
                self.messages += 1
                self.images += message.channel_id in self._image_channels
                self.writer.add_message(
                    self._channels[message.channel_id],
                    message.log_time,
                    message.data,
                    message.publish_time,
                    message.sequence,
                )
