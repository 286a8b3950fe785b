"""`describe`: what a recording holds, without replaying it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from scanmap.recording import layout
from scanmap.recording.layout import RecordingParams
from scanmap.recording.messages import SECOND_NS, Fault
from scanmap.recording.opening import open_source
from scanmap.recording.outline import Outline, outline
from scanmap.recording.parts import part_outlines
from scanmap.recording.withdrawals import noted_faults, ranges, withdrawn_indices


class TopicInfo(NamedTuple):
    """A topic of a recording."""

    message_type: str
    messages: int


@dataclass(frozen=True)
class RecordingInfo:
    """What `scanmap info` says about a recording, a folder of frames, or a video."""

    path: Path
    kind: str  # `recording`, `frames` or `video`
    source: str = ""  # the rig's name or `digital twin`; empty where nobody noted it
    shots: int = 0  # counted, images not opened: a damaged one counts
    duration_s: float = 0.0
    size_bytes: int = 0
    end_reason: str = ""  # `finished`, `interrupted`, `error: ...`; empty where nobody noted it
    cut_at: int | None = None  # byte at which the file ends without an end; None for a whole file
    plan: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)  # and whatever else was noted at the start
    topics: dict[str, TopicInfo] = field(default_factory=dict)
    parts: tuple[tuple[Path, int], ...] = ()  # files it consists of, and the shots in each
    has_calibration: bool = False
    has_rig: bool = False
    faults: tuple[Fault, ...] = ()  # noted while scanning

    @property
    def is_twin(self) -> bool:
        """Whether the digital twin made it."""
        return self.source == layout.DIGITAL_TWIN

    @property
    def lines(self) -> list[str]:
        """All of it in words, a line each."""
        size = f", {self.duration_s:.1f} s, {self.size_bytes / 1e6:.1f} MB" if self.size_bytes else ""
        carried = [name for name, there in (("calibration", self.has_calibration), ("rig", self.has_rig)) if there]
        made_up = "; its room is made up" if self.is_twin else ""
        lines = [
            f"{self.kind} {self.path}: {self.shots} shots{size}",
            f"source: {self.source or 'not noted'}{made_up}",
            f"ended: {self._ended}",
            f"carries: {', '.join(carried) or 'neither calibration nor rig; replay it with --calibration F'}",
        ]
        if len(self.parts) > 1:
            lines.append("parts: " + ", ".join(f"{part.name} ({shots} shots)" for part, shots in self.parts))
        lines += [f"plan {key}: {value}" for key, value in self.plan.items()]
        lines += [f"{key}: {value}" for key, value in self.versions.items()]
        lines += [f"topic {name}: {topic.messages} {topic.message_type}" for name, topic in self.topics.items()]
        for fault in self.faults:
            which = f": {ranges(shots)}" if (shots := withdrawn_indices(fault)) else ""
            lines.append(f"fault noted by the {fault.part}: {fault.message}{which}")
        return lines

    @property
    def _ended(self) -> str:
        if self.cut_at is not None:
            return f"cut at byte {self.cut_at}; what stands before can be replayed"
        return self.end_reason or "not noted"


def describe(path: Path | str, params: RecordingParams | None = None) -> RecordingInfo:
    """Look into a recording, whole or cut; images are not read.

    Raises:
        RecordingError, ConfigError: as `open_source`, except that a bag without our topics is described as well.
    """
    path, params = Path(path), params or RecordingParams()
    if path.suffix == ".mcap" and path.is_file():
        return _describe_parts(path, part_outlines(path), params)
    source = open_source(path, params)
    if source.kind == "recording":
        return _describe_parts(path, [outline(part) for part in source.parts], params)
    return RecordingInfo(
        path,
        source.kind,
        shots=source.count or 0,
        has_calibration=source.has_calibration,
        has_rig=bool(source.rig_toml),
    )


def _describe_parts(path: Path, parts: list[Outline], params: RecordingParams) -> RecordingInfo:
    first, last = parts[0], parts[-1]
    about = dict(first.metadata.get(layout.START_METADATA, {}))
    topics: dict[str, TopicInfo] = {}
    for part in parts:
        for channel in part.directory.channels.values():
            before = topics.get(channel.topic, TopicInfo("", 0)).messages
            topics[channel.topic] = TopicInfo(channel.message_type, before + part.count(channel.topic))
    source, plan = about.pop("source", ""), about.pop("plan", "")
    about.pop("start_ns", None)
    return RecordingInfo(
        path,
        "recording",
        source=source,
        shots=sum(part.count(params.image_topic) for part in parts),
        duration_s=_duration_s(parts, len(parts) > 1 and not path.is_dir()),
        size_bytes=sum(part.size for part in parts),
        end_reason=last.metadata.get(layout.END_METADATA, {}).get("reason", ""),
        cut_at=last.cut_at if path.is_file() else next((part.cut_at for part in parts if part.cut), None),
        parts=tuple((part.path, part.count(params.image_topic)) for part in parts),
        plan=_plan(plan),
        versions=about,
        topics=dict(sorted(topics.items())),
        has_calibration=layout.CALIBRATION_ATTACHMENT in first.attachments,
        has_rig=layout.RIG_ATTACHMENT in first.attachments,
        faults=tuple(fault for part in parts for _, fault in noted_faults(part)),
    )


def _duration_s(parts: list[Outline], resumed: bool) -> float:
    """From the first message to the last; of a resumed scan without the time between its parts."""
    spans = [(part.first_ns, part.last_ns) for part in parts]
    known = [(first, last) for first, last in spans if first is not None and last is not None]
    if not known:
        return 0.0
    if resumed:
        return sum(last - first for first, last in known) / SECOND_NS
    return (max(last for _, last in known) - min(first for first, _ in known)) / SECOND_NS


def _plan(text: str) -> dict[str, Any]:
    try:
        plan = json.loads(text or "{}")
    except ValueError:
        return {"plan": text}
    return plan if isinstance(plan, dict) else {"plan": plan}
