"""A scan as a folder of images: `frames/`, `off/` and `scan.csv`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from scanmap.errors import ConfigError, RecordingError
from scanmap.recording.bearings import HEADER, Row, frame_number, read_bearings
from scanmap.recording.source import Report, Source, text_beside
from scanmap.shot import Shot

SUFFIXES = (".jpg", ".jpeg", ".png")


def frames_source(folder: Path) -> Source:
    """Open a folder of frames.

    `scan.csv` has the header `frame,bearing_deg,time_s`; a frame is the name of a file in `frames/`, which may
    stand before it, or a number N for `frames/00000N.jpg` or `frames/N.jpg` (or .png). The file of the same name in
    `off/`, if there is one, is the picture with the laser off. `calibration.toml` and `rig.toml` in the folder
    come along.

    Raises:
        RecordingError: the folder is empty or has no scan.csv, or a file cannot be read.
        ConfigError: scan.csv is faulty.
    """
    table = folder / "scan.csv"
    if not table.exists():
        there = sorted(entry.name for entry in folder.iterdir())
        what = f"has no scan.csv, only {', '.join(there[:6])}" if there else "is empty"
        raise RecordingError(f"folder {folder} {what}; a scan needs frames/ and scan.csv with the header {HEADER}")
    rows = read_bearings(table)
    for row in rows:
        name = PurePosixPath(row.frame)
        if name.is_absolute() or ".." in name.parts or not row.frame.isprintable():
            raise ConfigError(f"{table}: line {row.line}: frame {row.frame!r} is no name of a file in the folder")
    return Source(
        path=folder,
        kind="frames",
        read=lambda report: _read(folder, rows, report),
        calibration_toml=text_beside(folder / "calibration.toml"),
        rig_toml=text_beside(folder / "rig.toml"),
        count=len(rows),
    )


def _read(folder: Path, rows: list[Row], report: Report) -> Iterator[Shot]:
    frames = folder / "frames" if (folder / "frames").is_dir() else folder
    off = folder / "off"
    with_off = off.is_dir()
    done = 0
    for index, row in enumerate(rows):
        image = _bytes(frames, row, report)
        if image is None:
            continue
        background = _bytes(off, row, report) if with_off else None
        time = float(index) if math.isnan(row.time) else row.time
        done += 1
        yield Shot(index, row.bearing, row.bearing, time, image, background)
    if not done:
        raise RecordingError(
            f"none of the {len(rows)} images that {folder / 'scan.csv'} names is in {frames}, beginning with "
            f"{rows[0].frame}; correct the names, or move the images there"
        )


def _bytes(folder: Path, row: Row, report: Report) -> bytes | None:
    """The file of a row; a missing or unreadable one is reported."""
    names = [row.frame.removeprefix("frames/")]
    if (number := frame_number(row.frame)) is not None:
        stems = dict.fromkeys((f"{number:06d}", row.frame))
        names += [stem + ending for stem in stems for suffix in SUFFIXES for ending in (suffix, suffix.upper())]
    path = next((folder / name for name in names if _is_file(folder / name)), None)
    if path is None:
        report(f"scan.csv line {row.line}: {folder / names[min(1, len(names) - 1)]} is missing and left out")
        return None
    try:
        return path.read_bytes()
    except OSError as error:
        report(f"scan.csv line {row.line}: {path} cannot be read and is left out: {error.strerror}")
        return None


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name longer than the file system takes
        return False
