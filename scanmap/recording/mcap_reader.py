"""Recordings back into shots: ours, cut or damaged ones, and bags that other robots recorded."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from scanmap.errors import RecordingError
from scanmap.recording import layout, mcap_records, messages
from scanmap.recording.assembly import Assembler
from scanmap.recording.layout import RecordingParams
from scanmap.recording.mcap_records import Break, Channel, DamagedError, Directory, Message, Record
from scanmap.recording.messages import MalformedMessageError
from scanmap.recording.outline import Outline, outline
from scanmap.recording.parts import part_outlines, start_of
from scanmap.recording.source import Report, Source
from scanmap.recording.withdrawals import Withdrawals, left_out, withdrawals
from scanmap.shot import Shot


def mcap_source(path: Path, params: RecordingParams) -> Source:
    """Open a recording with the parts that continue it, or a bag folder.

    Raises:
        RecordingError: not an MCAP file, unreadable, or without the topics that make shots.
    """
    outlines = _of_folder(path) if path.is_dir() else part_outlines(path)
    for found in outlines:
        _require_topics(found, params)
    first, last = outlines[0], outlines[-1]
    cut = any(found.cut for found in outlines) if path.is_dir() else last.cut
    end = last.metadata.get(layout.END_METADATA, {})
    counts = [found.count(params.image_topic) for found in outlines]
    own = first.metadata.get(layout.START_METADATA, {}).get("start_ns", "").isdecimal()
    notes = withdrawals(outlines) if own else []
    return Source(
        path=path,
        kind="recording",
        read=lambda report: _read(outlines, params, Withdrawals(notes, params), report),
        calibration_toml=first.attachments.get(layout.CALIBRATION_ATTACHMENT, ""),
        rig_toml=first.attachments.get(layout.RIG_ATTACHMENT, ""),
        metadata=dict(first.metadata.get(layout.START_METADATA, {})),
        count=sum(counts) - left_out(notes, params),
        parts=tuple(found.path for found in outlines),
        end_reason="cut" if cut else end.get("reason", ""),
        faults=[fault for found in outlines for fault in found.faults],
    )


def _of_folder(folder: Path) -> list[Outline]:
    """The files of a bag or of one scan; RecordingError where scans of different starts lie side by side."""
    found = [outline(part) for part in _bag_parts(folder)]
    starts: dict[str, Path] = {}
    for each in found:
        starts.setdefault(start_of(each), each.path)
    starts.pop("", None)
    if len(starts) > 1:
        names = ", ".join(str(path) for path in list(starts.values())[:4])
        raise RecordingError(f"folder {folder} holds {len(starts)} scans: {names}; name one of these instead")
    return found


def _bag_parts(folder: Path) -> list[Path]:
    """The .mcap files of a ROS 2 bag folder, in order.

    Raises:
        RecordingError: there are none.
    """
    parts = sorted(folder.glob("*.mcap"), key=lambda part: [int(n) for n in re.findall(r"\d+", part.stem)])
    if not parts:
        others = sorted(entry.name for entry in folder.iterdir())
        raise RecordingError(
            f"bag {folder} has no .mcap file, only {', '.join(others[:5])}; scanmap reads MCAP bags: "
            "convert it with `ros2 bag convert` (storage_id: mcap)"
        )
    return parts


def _require_topics(found: Outline, params: RecordingParams) -> None:
    if found.cut and not found.directory.channels:
        raise RecordingError(f"recording {found.path} is cut at byte {found.size}, before its first shot")
    wanted = ((params.image_topic, layout.COMPRESSED_IMAGE), (params.joint_topic, layout.JOINT_STATE))
    for topic, message_type in wanted:
        if not any(_carries(channel, topic, message_type) for channel in found.directory.channels.values()):
            raise RecordingError(_no_topic(found.path, found.directory, topic, message_type))


def _carries(channel: Channel, topic: str, message_type: str) -> bool:
    named = channel.message_type.replace("/msg/", "/") == message_type.replace("/msg/", "/")
    return channel.topic == topic and named and channel.encoding == "cdr"


def _no_topic(path: Path, directory: Directory, topic: str, message_type: str) -> str:
    there = sorted(f"{c.topic} ({c.message_type or c.encoding})" for c in directory.channels.values())
    there = [name if name.isprintable() else repr(name) for name in there]
    key = "image_topic" if message_type == layout.COMPRESSED_IMAGE else "joint_topic"
    return (
        f"{path} has no {message_type} on {topic}; it has {', '.join(there) or 'no topics'}; "
        f"name the right one with --set recording.{key}=/topic"
    )


def _read(outlines: list[Outline], params: RecordingParams, withdrawn: Withdrawals, report: Report) -> Iterator[Shot]:
    start = outlines[0].metadata.get(layout.START_METADATA, {}).get("start_ns", "")
    own = start.isdecimal()
    off = any(found.count(params.off_topic) for found in outlines)
    assembler = Assembler(params, report, int(start) if own else 0, own, off)
    for part, found in enumerate(outlines):
        for fault in found.faults:
            report(fault)
        for channel, message, offset in _data(found, assembler, report):
            try:
                _take(channel, message, params, assembler)
            except MalformedMessageError as error:
                report(f"{found.path}: message on {channel.topic} left out: {error}")
            yield from (shot for shot in assembler.ready() if withdrawn.keeps(shot, part, offset))
    yield from (shot for shot in assembler.finish() if withdrawn.keeps(shot, len(outlines), 0))
    _account(outlines, params, assembler, report)
    withdrawn.account(outlines[0].path, report)


def _data(found: Outline, assembler: Assembler, report: Report) -> Iterator[tuple[Channel, Message, int]]:
    """Every message of a file in its order, with its channel and the byte of its record; what is broken is reported."""
    path, directory, nameless = found.path, found.directory, 0
    with mcap_records.open_mcap(path) as file:
        # A recording that still grows is read as far every time: what is looked at again is what was seen.
        for record in mcap_records.walk(file, found.size):
            if isinstance(record, Break):
                report(_broken(path, record, assembler.done))
            elif record.opcode in mcap_records.DATA:
                try:
                    for message in _messages(record, mcap_records.body(file, record), directory):
                        if message.channel_id in directory.channels:
                            yield directory.channels[message.channel_id], message, record.offset
                        else:
                            nameless += 1
                except DamagedError as error:
                    report(f"{path}: the record at byte {record.offset} is damaged and left out: {error}")
    if nameless:
        report(f"{path}: {nameless} messages left out: the record that names their topic is damaged")


def _messages(record: Record, data: bytes, directory: Directory) -> Iterator[Message]:
    chunk = record.opcode == mcap_records.CHUNK
    for opcode, view in mcap_records.chunk_records(data) if chunk else [(record.opcode, memoryview(data))]:
        if opcode == mcap_records.MESSAGE:
            yield mcap_records.message(view)
        elif opcode in (mcap_records.SCHEMA, mcap_records.CHANNEL):
            directory.add(opcode, view)


def _take(channel: Channel, message: Message, params: RecordingParams, assembler: Assembler) -> None:
    if _carries(channel, params.image_topic, layout.COMPRESSED_IMAGE):
        assembler.add_image(messages.read_image(message.data), message.sequence)
    elif _carries(channel, params.off_topic, layout.COMPRESSED_IMAGE):
        assembler.add_off(messages.read_image(message.data))
    elif _carries(channel, params.joint_topic, layout.JOINT_STATE):
        assembler.add_joints(messages.read_joints(message.data))


def _broken(path: Path, broken: Break, done: int) -> str:
    if broken.cut:
        return f"recording {path} is cut at byte {broken.offset}: {done} shots before the cut were read"
    where = f"recording {path} is damaged at byte {broken.offset}, after {done} shots"
    return f"{where}; reading goes on at byte {broken.resumed_at}" if broken.resumed_at else where


def _account(outlines: list[Outline], params: RecordingParams, assembler: Assembler, report: Report) -> None:
    """Say what is missing of what was recorded, and why when nothing came."""
    path = outlines[0].path
    if assembler.without_bearing and params.joint not in assembler.joints_seen:
        joints = ", ".join(sorted(assembler.joints_seen)) or "none"
        raise RecordingError(
            f"{path} has no joint {params.joint!r} on {params.joint_topic}; it has {joints}; "
            "name the right one with --set recording.joint=NAME"
        )
    if not assembler.done:
        raise RecordingError(f"recording {path} holds no shot that can be read")
    noted = [found.metadata.get(layout.END_METADATA, {}).get("shots", "") for found in outlines]
    expected = sum(int(shots) for shots in noted if shots.isdecimal())
    if assembler.done < expected:
        report(f"{assembler.done} of {expected} recorded shots could be read")
