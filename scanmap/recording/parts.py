"""The files of one scan: `room.mcap`, and `room.part2.mcap` and so on where it was resumed."""

from __future__ import annotations

import re
from itertools import count
from pathlib import Path

from scanmap.errors import RecordingError
from scanmap.recording import layout
from scanmap.recording.outline import Outline, outline

_PART = re.compile(r"\.part\d+$")


def part_path(path: Path, number: int) -> Path:
    """Where the `number`-th part of the scan that begins in `path` stands; the first is `path` itself."""
    return path if number == 1 else path.with_name(f"{path.stem}.part{number}.mcap")


def is_later_part(path: Path) -> bool:
    """Whether this is the name of a part that continues another file."""
    return path.suffix == ".mcap" and _PART.search(path.stem) is not None


def first_part(path: Path) -> Path:
    """The file in which the scan begins that `path` is a part of: the one that stands for all of it."""
    return path.with_name(f"{_PART.sub('', path.stem)}.mcap") if is_later_part(path) else path


def next_part(path: Path) -> Path:
    """A new file for the next part of the scan that begins in `path`."""
    return next(part for part in (part_path(path, number) for number in count(2)) if not part.exists())


def part_outlines(path: Path) -> list[Outline]:
    """The file at `path` and the parts that continue it, in order.

    A part that holds nothing, or belongs to another scan of that name, is left out; the first says so in `faults`.

    Raises:
        RecordingError: `path` itself cannot be read.
    """
    first = outline(path)
    found = [first]
    if is_later_part(path):
        return found
    for number in count(2):
        part = part_path(path, number)
        if not part.exists():
            return found
        try:
            other = outline(part)
        except RecordingError as error:
            first.faults.append(f"{error}; it is left out")
            continue
        begun, theirs = start_of(first), start_of(other)
        if begun and theirs and begun != theirs:
            first.faults.append(f"{part} continues another scan than {path} and is left out")
        elif other.directory.channels:
            found.append(other)
        else:
            first.faults.append(f"{part} is cut before its first shot and left out")
    raise AssertionError("unreachable")


def start_of(found: Outline) -> str:
    """What names a scan: the nanosecond it began in; empty where that is not known."""
    return found.metadata.get(layout.START_METADATA, {}).get("start_ns", "")
