"""The csv beside images: which frame was taken at which bearing.

Spreadsheets of half the world separate by `;` and write a decimal comma, so both are read.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from scanmap.errors import ConfigError, RecordingError

HEADER = "frame,bearing_deg,time_s"


class Row(NamedTuple):
    """One line of the csv."""

    line: int  # in the file, from 1
    frame: str  # file name or number, as written
    bearing: float  # [rad]
    time: float  # [s]; NaN where the file has no time_s


def read_bearings(path: Path, *, frame_optional: bool = False) -> list[Row]:
    """Read a csv with the header `frame,bearing_deg,time_s`; `time_s` may be left out.

    Cells stand between `,`, `;` or tabs, as the header has most of; a decimal comma is read.

    Args:
        path: the csv.
        frame_optional: without a `frame` column, lines are frames 0, 1, 2 ...; then the header may be missing
            too, if every line is one number.

    Raises:
        RecordingError: it cannot be read.
        ConfigError: a column is missing, or values are no numbers; names lines and values.
    """
    lines = _lines(path)
    if not lines:
        raise ConfigError(f"{path} is empty; it needs the header {HEADER} and a line per frame")
    if frame_optional and len(lines[0][1]) == 1 and _number(lines[0][1][0]) is not None:
        lines.insert(0, (0, ["bearing_deg"]))
    columns = [name.strip().lower() for name in lines[0][1]]
    needed = ["bearing_deg"] if frame_optional else ["frame", "bearing_deg"]
    missing = [name for name in needed if name not in columns]
    if missing:
        raise ConfigError(
            f"{path} lacks the column {' and '.join(missing)}: it has {_printed(columns)}; it needs {HEADER}"
        )
    twice = [name for name in ("frame", "bearing_deg", "time_s") if columns.count(name) > 1]
    if twice:
        raise ConfigError(f"{path} has the column {twice[0]} twice: {_printed(columns)}; leave one of them")
    faults: list[str] = []
    rows = list(_rows(lines[1:], columns, faults))
    if faults:
        more = f" and {len(faults) - 5} more" if len(faults) > 5 else ""
        raise ConfigError(f"{path}: {'; '.join(faults[:5])}{more}; correct the file, or take those lines out")
    if not rows:
        raise ConfigError(f"{path} has a header but no line with a frame")
    return rows


def frame_number(frame: str) -> int | None:
    """The number a frame is named by; None for a file name."""
    return int(frame) if frame.isdecimal() and len(frame) <= 9 else None


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            separator = max(",;\t", key=file.readline().count)
            file.seek(0)
            reader = csv.reader(file, delimiter=separator, strict=True)
            return [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is no csv: it is not text in UTF-8; save it as a csv with {HEADER}") from error
    except csv.Error as error:
        raise ConfigError(f"{path} is no csv: {error}") from error


def _rows(lines: list[tuple[int, list[str]]], columns: list[str], faults: list[str]) -> Iterator[Row]:
    for count, (line, cells) in enumerate(lines):
        row = dict(zip(columns, (cell.strip() for cell in cells), strict=False))
        numbers = {"time_s": math.nan}
        for name in ("bearing_deg", "time_s"):
            if name in columns:
                value = _number(row.get(name, ""))
                if value is None:
                    faults.append(f"line {line}: {name} is {row.get(name, '')!r}, not a finite number")
                numbers[name] = value or 0.0
        frame = row.get("frame", "") if "frame" in columns else str(count)
        if not frame:
            faults.append(f"line {line}: frame is empty")
        yield Row(line, frame, math.radians(numbers["bearing_deg"]), numbers["time_s"])


def _printed(columns: list[str]) -> str:
    return ", ".join(name if name.isprintable() else repr(name) for name in columns)


def _number(text: str) -> float | None:
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        return None
    return value if math.isfinite(value) else None
