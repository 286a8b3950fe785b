"""Pairs of a column and a measured distance, as people write them down: the csv behind `calibrate table`."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import CalibrationError, ConfigError

Array = NDArray[np.float64]

# Names a column of the csv may have; case, blanks and a unit in brackets do not matter.
COLUMN_NAMES = ("ppx", "column", "col", "pixel", "px", "u", "row", "v")
DISTANCE_NAMES = ("actual", "distance", "d", "depth", "measured", "range")
FIRST_NAMES = ("published_alg1", "alg1", "algorithm_1", "algorithm1")
SECOND_NAMES = ("published_alg2", "alg2", "algorithm_2", "algorithm2")
UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}


class NotedHead(NamedTuple):
    """What a file of pairs says of the head."""

    width: int  # [px] of the image along the axis the line moves on
    height: int  # [px] across it
    baseline_m: float


@dataclass(frozen=True)
class Pairs:
    """N measurements; NaN where a cell of the csv is empty."""

    column: Array  # (N,) [px]; all NaN in a table that only compares distances
    distance_m: Array  # (N,) measured with a ruler
    published_ratio_m: Array  # (N,) what was published for Algorithm 1
    published_angle_m: Array  # (N,) and for Algorithm 2
    head: NotedHead | None = None  # where the file says what it was measured with

    @property
    def has_columns(self) -> bool:
        """Whether a model can be fitted."""
        return bool(np.isfinite(self.column).all())

    @property
    def published(self) -> bool:
        """Whether the table holds somebody's results to compare with."""
        return bool(np.isfinite(self.published_ratio_m).any() or np.isfinite(self.published_angle_m).any())


def read_pairs(path: Path) -> Pairs:
    """Read measurements: a csv, or the calibrate.yml of laser-range-finder (`scanmap.solvers.range_finder`).

    A csv has a header, then a line each; `,`, `;` or tab between, `#` begins a comment. Needs a distance (`actual_m`,
    `distance_mm`, ...) and, for a fit, a column (`ppx`, `column`, `row`, ...).

    Raises:
        ConfigError: no such file, no header, a column is missing, or a cell is no number; with its line.
    """
    if path.suffix.lower() in (".yml", ".yaml"):
        from scanmap.solvers.range_finder import read_range_finder

        return read_range_finder(path)
    lines = _lines(path)
    if not lines:
        raise ConfigError(f"{path} is empty; it needs a header such as ppx,actual_m and a line for every measurement")
    separator = max(",;\t", key=lines[0][1].count)
    header = [_plain(cell) for cell in next(csv.reader([lines[0][1]], delimiter=separator))]
    distance = _find(header, DISTANCE_NAMES, units=True)
    if distance is None:
        raise ConfigError(
            f"{path}, line {lines[0][0]}: no column of distances in the header {shorten(', '.join(header), 120)}; "
            f"valid: {', '.join(DISTANCE_NAMES)}, with _m, _cm or _mm behind"
        )
    places = (
        _find(header, COLUMN_NAMES), distance,
        _find(header, FIRST_NAMES, units=True), _find(header, SECOND_NAMES, units=True),
    )  # fmt: skip
    rows = [_numbers(path, number, text, separator, len(header)) for number, text in lines[1:]]
    if not rows:
        raise ConfigError(f"{path} has a header and no measurement under it")
    cells = np.array(rows)
    empty = np.full(len(rows), np.nan)
    column, actual, first, second = (empty if at is None else cells[:, at[0]] * at[1] for at in places)
    pairs = Pairs(column, actual, first, second)
    wrong = ~(pairs.distance_m > 0)
    if wrong.any():
        number = lines[1 + int(wrong.argmax())][0]
        raise ConfigError(f"{path}, line {number}: distance {pairs.distance_m[wrong][0]:g}; it must be above 0")
    return pairs


def once_each(column: Array, distance: Array) -> tuple[Array, Array]:
    """The pairs (M,), (M,) without those that were noted twice.

    The same column at the same distance again is no second measurement: it is rounded to the same pixel.
    """
    both = np.stack([column, distance], axis=1)
    first = np.sort(np.unique(both, axis=0, return_index=True)[1])
    return column[first], distance[first]


def check_fit(pairs: Pairs, path: Path, width: int, chosen: NDArray[np.intp]) -> None:
    """Raise unless a model can be fitted to the `chosen` rows of a table.

    Raises:
        ConfigError: no columns, or outside of the image.
        CalibrationError: too few pairs, or all at one place.
    """
    known = np.isfinite(pairs.column)
    if known.any() and not known.all():
        raise ConfigError(
            f"{path}: row {int(known.argmin()) + 1} has no column of the image; fill it in, or take the row out"
        )
    if not pairs.has_columns:
        raise ConfigError(
            f"{path}: to fit a model every row needs a column of the image; valid headers: {', '.join(COLUMN_NAMES)}"
        )
    outside = (pairs.column < -0.5) | (pairs.column > width - 0.5)
    if outside.any():
        raise ConfigError(
            f"{path}: column {pairs.column[outside][0]:g} is outside an image {width} px wide; give --width, "
            "the pixels along the axis the line moves on"
        )
    column, distance = pairs.column[chosen], pairs.distance_m[chosen]
    if len(np.unique(column)) < 3 or len(np.unique(distance)) < 3:
        raise CalibrationError(
            f"{path}: {len(np.unique(column))} different columns at {len(np.unique(distance))} distances are too few; "
            "measure at 3 distances at least, better 7, from the nearest to the farthest that you will scan"
        )


def _lines(path: Path) -> list[tuple[int, str]]:
    """Number and text of every line that says something."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not text"
        raise ConfigError(f"table {path} cannot be read: {why}; it must be a csv such as ppx,actual_m") from error
    numbered = ((k, line.split("#")[0].strip()) for k, line in enumerate(text.splitlines(), 1))
    return [(k, line) for k, line in numbered if line.strip(",;\t ")]


def _plain(name: str) -> str:
    """A header as it is compared: `Distance [mm]` is distance_mm."""
    kept = "".join(c if c.isalnum() else " " for c in name.strip().strip('"').lower())
    return "_".join(kept.split())


def _find(header: list[str], names: tuple[str, ...], *, units: bool = False) -> tuple[int, float] | None:
    """Place of the first header among `names`, and what its unit is in metres; pixels have the unit `px` or none."""
    suffixes = {f"_{unit}": factor for unit, factor in UNITS_M.items()} if units else {"_px": 1.0}
    for name in names:
        for suffix, factor in {"": 1.0, **suffixes}.items():
            if name + suffix in header:
                return header.index(name + suffix), factor
    return None


def _numbers(path: Path, number: int, text: str, separator: str, width: int) -> list[float]:
    """The cells of one line, NaN where empty."""
    cells = [cell.strip() for cell in text.split(separator)]
    if len(cells) > width:
        raise ConfigError(f"{path}, line {number}: {len(cells)} cells under {width} headers: {text}")
    values = []
    for cell in cells + [""] * (width - len(cells)):
        try:
            value = float((cell.replace(",", ".") if separator != "," else cell).strip('"') or "nan")
        except ValueError as error:
            raise ConfigError(f"{path}, line {number}: {cell!r} is no number") from error
        if math.isinf(value):
            raise ConfigError(f"{path}, line {number}: {cell!r} is no distance or column")
        values.append(value)
    return values
