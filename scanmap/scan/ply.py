"""PLY files of a scan: written with everything a point carries, read back into the same range image."""

from __future__ import annotations

import json
import re
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import RecordingError
from scanmap.geometry import HeadMount
from scanmap.laserline import Reason
from scanmap.scan.ply_header import PLY_TYPES, Header, parse_header
from scanmap.scan.range_image import Scan, ScanParams
from scanmap.scan.surface import normals

# One record of the vertex element, in this order; other readers find what they know by name.
VERTEX = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz", "intensity", "sigma", "range", "column")]
    + [("bearing_index", "<i4"), ("row", "<i4")]
)
_UNITS = "x y z sigma range [m], column [px], intensity [grey levels], nx ny nz unit, 0 0 0 where not known"
_FRAME = "world: origin on the rotation axis at laser height, x at bearing 0, z up"
# What the scan is made of again on reading; comments of the scan's own may not take these names.
_GEOMETRY = ("rows", "head_offset_m", "tilt_deg", "bearings_rad")
_RESERVED = {*_GEOMETRY, "units", "frame", "sweep"}
# Readers in C keep a header line in a buffer of 1024 bytes or less.
_LINE = 200
_NUMBERS_A_LINE = 8
# More than any camera and stage give; a damaged header must not take the machine's memory.
_MAX_ROWS, _MAX_CELLS = 20_000, 2**27
_BLOCKS_AHEAD = 2  # of records, made while others are written


def write_ply(scan: Scan, file: BinaryIO, params: ScanParams | None = None) -> None:
    """Write the scan's points, binary, little endian, with comments that make a `Scan` of them again."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comment_lines(scan))]
    lines.append(f"element vertex {int(scan.valid.sum())}")
    lines += [f"property {PLY_TYPES[VERTEX[name].str]} {name}" for name in VERTEX.names or ()]
    file.write("\n".join([*lines, "end_header\n"]).encode("ascii"))
    for records in vertex_blocks(scan, params):
        file.write(records.data)


def vertex_blocks(scan: Scan, params: ScanParams | None = None, columns: int = 64) -> Iterator[NDArray[Any]]:
    """The scan's points as records of `VERTEX`, bearing by bearing, row by row, some columns at a time."""
    normal = normals(scan, params)

    def records_of(block: slice) -> NDArray[Any]:
        bearing, row = np.nonzero(scan.valid[block])
        records = np.empty(len(bearing), VERTEX)
        floats = records.view(np.float32).reshape(len(bearing), VERTEX.itemsize // 4)
        floats[:, 0:3] = scan.points[block][bearing, row]
        floats[:, 3:6] = np.nan_to_num(normal[block][bearing, row])
        for k, values in enumerate((scan.intensity, scan.sigma_m, scan.range_m, scan.column_px)):
            floats[:, 6 + k] = values[block][bearing, row]
        records["bearing_index"], records["row"] = bearing + block.start, row
        return records

    # Copying whole arrays leaves the interpreter's lock.
    ahead: deque[Future[NDArray[Any]]] = deque()
    with ThreadPoolExecutor(_BLOCKS_AHEAD, thread_name_prefix="vertices") as pool:
        for start in range(0, len(scan), columns):
            ahead.append(pool.submit(records_of, slice(start, start + columns)))
            if len(ahead) > _BLOCKS_AHEAD:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()


def read_ply(path: Path | str) -> Scan:
    """The scan that `write_ply` wrote, bit for bit where it has points; cells without are `Reason.NOT_SCANNED`.

    Raises:
        RecordingError: not a PLY, damaged, or without the bearing and row that make a range image.
    """
    header, vertices = _read(Path(path))
    facts = _facts(header.comments)
    missing = [name for name in VERTEX.names or () if name not in (vertices.dtype.names or ())]
    missing += [f"the comment {name}" for name in _GEOMETRY if name not in facts]
    if missing:
        raise RecordingError(
            f"{path} is no scan by scanmap: it lacks {', '.join(missing)}; give a PLY that scanmap scan or replay wrote"
        )
    try:
        return _scan_of(vertices, facts)
    except (ValueError, IndexError) as error:
        raise RecordingError(f"{path} is damaged: {error}") from error


def read_points(path: Path | str) -> NDArray[np.float64]:
    """(N, 3) x y z of any PLY's vertices [its units].

    Raises:
        RecordingError: not a PLY, damaged, or without x y z.
    """
    _, vertices = _read(Path(path))
    names = vertices.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise RecordingError(f"{path} has no x y z; its vertices have {', '.join(names) or 'nothing'}")
    return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=-1)


def comment_lines(scan: Scan) -> list[str]:
    """What the header says beside the fields: where the scan comes from, units, mount, rows and bearings."""
    lines: list[str] = []
    for key, value in scan.comments.items():
        lines += _spread(_free_key(str(key)), _text(value))
    lines += [f"units: {_UNITS}", f"frame: {_FRAME}", f"rows: {scan.rows}"]
    lines += _numbers("head_offset_m", scan.mount.offset_m) + _numbers("tilt_deg", scan.mount.tilt_deg)
    if len(scan):
        low, high = np.degrees([scan.bearings.min(), scan.bearings.max()])
        lines.append(f"sweep: {len(scan)} bearings from {low:.3f} to {high:.3f} deg")
    # Radians to the last bit: degrees would have to be converted back, and not every bit survives that.
    return lines + (_numbers("bearings_rad", scan.bearings) or ["bearings_rad: "])


def _numbers(key: str, values: Iterable[float]) -> list[str]:
    numbers = [repr(float(value)) for value in values]
    return [f"{key}: {' '.join(numbers[k : k + _NUMBERS_A_LINE])}" for k in range(0, len(numbers), _NUMBERS_A_LINE)]


def _free_key(key: str) -> str:
    key = re.sub(r"[^A-Za-z0-9_. -]", "_", key).strip() or "_"
    return f"{key}_" if key in _RESERVED else key


def _text(value: Any) -> str:
    """A value as the header holds it: plain words as they are, everything else as JSON."""
    if isinstance(value, str) and value.isascii() and value.isprintable() and value == value.strip() and value:
        try:
            json.loads(value)
        except ValueError:
            return value
    return json.dumps(value, default=str)


def _spread(key: str, text: str) -> list[str]:
    parts = [text[k : k + _LINE] for k in range(0, len(text), _LINE)]
    return [f"{key}: {parts[0]}", *(f"{key}+: {part}" for part in parts[1:])]


def _facts(comments: list[str]) -> dict[str, str]:
    """`key: value` comments; `key+` goes on where `key` ended, a repeated key is a longer list."""
    facts: dict[str, str] = {}
    for comment in comments:
        key, colon, value = comment.partition(": ")
        if colon and key.endswith("+") and key[:-1] in facts:
            facts[key[:-1]] += value
        elif colon:
            facts[key] = f"{facts[key]} {value}" if key in facts else value
    return facts


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


def _scan_of(vertices: NDArray[Any], facts: dict[str, str]) -> Scan:
    offset, tilt, bearings = (
        [float(number) for number in facts[key].split()] for key in ("head_offset_m", "tilt_deg", "bearings_rad")
    )
    rows = int(facts["rows"])
    if len(offset) != 3 or len(tilt) != 2 or not 1 <= rows <= _MAX_ROWS or rows * len(bearings) > _MAX_CELLS:
        raise ValueError(f"its comments give {rows} rows, {len(bearings)} bearings, offset {offset}, tilt {tilt}")
    if not np.isfinite([*offset, *tilt, *bearings]).all():
        raise ValueError("a bearing, head_offset_m or tilt_deg that is not finite")
    at = vertices["bearing_index"], vertices["row"]
    if len(vertices) and min(at[0].min(), at[1].min()) < 0:
        raise ValueError("negative bearing_index or row")
    comments = {key: _value(text) for key, text in facts.items() if key not in _RESERVED}
    mount = HeadMount((offset[0], offset[1], offset[2]), (tilt[0], tilt[1]))
    scan = Scan.empty(mount, rows, np.array(bearings), comments)
    cell = at[0].astype(np.intp) * rows + at[1]
    if len(vertices) and (at[1].max() >= rows or at[0].max() >= len(bearings)):
        raise ValueError(f"bearing_index or row beyond its {len(bearings)} bearings and {rows} rows")
    points = scan.points.reshape(-1, 3)
    for k, axis in enumerate("xyz"):
        points[cell, k] = vertices[axis]
    for name, values in (
        ("intensity", scan.intensity), ("sigma", scan.sigma_m), ("range", scan.range_m), ("column", scan.column_px),
    ):  # fmt: skip
        values.reshape(-1)[cell] = vertices[name]
    scan.reason.reshape(-1)[cell] = Reason.OK
    if np.count_nonzero(scan.valid) < len(vertices):
        raise ValueError("two points in one cell of the range image")
    if not np.isfinite(points[cell]).all():
        raise ValueError("a point whose x, y or z is not finite")
    return scan


def _read(path: Path) -> tuple[Header, NDArray[Any]]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    try:
        header = parse_header(data)
        if header.form == "ascii":
            lines = data[header.size :].decode("latin-1").splitlines()[: header.vertices]
            table = np.array([line.split()[: len(header.fields)] for line in lines], np.float64)
            if table.shape != (header.vertices, len(header.fields)):
                raise ValueError(f"{len(lines)} of {header.vertices} vertices are there")
            vertices = np.empty(header.vertices, header.record)
            for k, name in enumerate(header.record.names or ()):
                vertices[name] = table[:, k]
        else:
            vertices = np.frombuffer(data, header.record, header.vertices, header.size)
    except (ValueError, OverflowError) as error:
        raise RecordingError(f"{path} cannot be read as a PLY file: {error}") from error
    return header, vertices
