"""PLY files of a scan: written with everything a point carries, read back into the same range image."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import RecordingError
from scanmap.geometry import HeadMount
from scanmap.laserline import Reason
from scanmap.scan.range_image import Scan
from scanmap.scan.surface import normals

# One record of the vertex element, in this order; other readers find what they know by name.
VERTEX = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz", "intensity", "sigma", "range", "column")]
    + [("bearing_index", "<i4"), ("row", "<i4")]
)
_PLY_TYPE = {"<f4": "float", "<i4": "int", "<u1": "uchar"}
_NUMPY_TYPE = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_PER_LINE = 8
_UNITS = "x y z sigma range [m], column [px], intensity [grey levels]; world frame: z up, origin on the rotation axis"


class PlyFile(NamedTuple):
    """What a PLY's header says, and its vertices."""

    comments: list[str]
    vertices: NDArray[Any]  # (N,) structured


def vertices_of(scan: Scan) -> NDArray[Any]:
    """The scan's points as records of `VERTEX`, bearing by bearing, row by row."""
    bearing, row = np.nonzero(scan.valid)
    records = np.empty(len(bearing), VERTEX)
    normal = normals(scan)
    for k, axis in enumerate("xyz"):
        records[axis] = scan.points[bearing, row, k]
        records[f"n{axis}"] = normal[bearing, row, k]
    records["intensity"], records["sigma"] = scan.intensity[bearing, row], scan.sigma_m[bearing, row]
    records["range"], records["column"] = scan.range_m[bearing, row], scan.column_px[bearing, row]
    records["bearing_index"], records["row"] = bearing, row
    return records


def ply_bytes(scan: Scan) -> bytes:
    """The whole file: binary, little endian, float32."""
    records = vertices_of(scan)
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment {line}" for line in _comments(scan)]
    header.append(f"element vertex {len(records)}")
    header += [f"property {_PLY_TYPE[VERTEX[name].str]} {name}" for name in VERTEX.names or ()]
    header.append("end_header\n")
    return "\n".join(header).encode() + records.tobytes()


def read_ply(path: Path | str) -> Scan:
    """The scan that `ply_bytes` wrote, bit for bit where it has points; cells without are `Reason.NOT_SCANNED`.

    Raises:
        RecordingError: not a PLY, damaged, or without the bearing and row that make a range image.
    """
    file = _read(Path(path))
    missing = [name for name in VERTEX.names or () if name not in (file.vertices.dtype.names or ())]
    facts = _facts(file.comments)
    if missing or "rows" not in facts or "bearings_rad" not in facts:
        lacking = ", ".join(missing) or "its comments rows and bearings_rad"
        raise RecordingError(
            f"{path} was not written by scanmap: it lacks {lacking}; a map or scan needs scanmap's PLY"
        )
    try:
        return _scan_of(file.vertices, facts)
    except (ValueError, IndexError) as error:
        raise RecordingError(f"{path} is damaged: {error}") from error


def read_points(path: Path | str) -> NDArray[np.float64]:
    """(N, 3) x y z of any PLY's vertices [its units].

    Raises:
        RecordingError: not a PLY, damaged, or without x y z.
    """
    vertices = _read(Path(path)).vertices
    if not {"x", "y", "z"} <= set(vertices.dtype.names or ()):
        raise RecordingError(f"{path} has no x y z; its vertices have {', '.join(vertices.dtype.names or ())}")
    return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=-1)


def _comments(scan: Scan) -> list[str]:
    lines = [f"{key}: {value}" for key, value in scan.comments.items()]
    lines += [f"units: {_UNITS}", f"rows: {scan.rows}"]
    lines += [f"head_offset_m: {' '.join(repr(float(v)) for v in scan.mount.offset_m)}"]
    lines += [f"tilt_deg: {' '.join(repr(float(v)) for v in scan.mount.tilt_deg)}"]
    # Radians to the last bit: degrees would have to be converted back.
    numbers = [repr(float(b)) for b in scan.bearings]
    lines += [f"bearings_rad: {' '.join(numbers[k : k + _PER_LINE])}" for k in range(0, len(numbers), _PER_LINE)]
    return lines


def _facts(comments: list[str]) -> dict[str, str]:
    """`key: value` comments; those that come in several lines joined."""
    facts: dict[str, str] = {}
    for comment in comments:
        key, colon, value = comment.partition(": ")
        if colon:
            facts[key] = f"{facts[key]} {value}" if key in facts else value
    return facts


def _scan_of(vertices: NDArray[Any], facts: dict[str, str]) -> Scan:
    offset = [float(v) for v in facts["head_offset_m"].split()]
    tilt = [float(v) for v in facts["tilt_deg"].split()]
    bearings = np.array([float(v) for v in facts["bearings_rad"].split()])
    own = {"units", "rows", "head_offset_m", "tilt_deg", "bearings_rad"}
    mount = HeadMount((offset[0], offset[1], offset[2]), (tilt[0], tilt[1]))
    scan = Scan.empty(mount, int(facts["rows"]), bearings, {k: v for k, v in facts.items() if k not in own})
    at = vertices["bearing_index"], vertices["row"]
    if len(vertices) and (min(at[0].min(), at[1].min()) < 0):
        raise ValueError("negative bearing index or row")
    for k, axis in enumerate("xyz"):
        scan.points[*at, k] = vertices[axis]
    scan.intensity[at], scan.sigma_m[at] = vertices["intensity"], vertices["sigma"]
    scan.range_m[at], scan.column_px[at] = vertices["range"], vertices["column"]
    scan.reason[at] = Reason.OK
    return scan


def _read(path: Path) -> PlyFile:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise RecordingError(f"{path} is not a PLY file: it does not begin with ply and a header")
    body = data.find(b"\n", end) + 1
    lines = data[:end].decode("latin-1").splitlines()
    try:
        form, count, fields = _vertex_layout(lines)
        comments = [line.partition(" ")[2] for line in lines if line.startswith("comment ")]
        if form == "ascii":
            table = np.loadtxt(data[body:].decode("latin-1").splitlines()[:count], ndmin=2)
            vertices = np.empty(len(table), np.dtype(fields))
            for k, (name, _) in enumerate(fields):
                vertices[name] = table[:, k]
        else:
            order = ">" if form == "binary_big_endian" else "<"
            kind = np.dtype([(name, order + type_) for name, type_ in fields])
            vertices = np.frombuffer(data, kind, count, body)
    except (ValueError, KeyError, IndexError) as error:
        raise RecordingError(f"{path} is damaged or of a kind scanmap does not read: {error}") from error
    return PlyFile(comments, vertices)


def _vertex_layout(lines: list[str]) -> tuple[str, int, list[tuple[str, str]]]:
    """Format, number of vertices and their fields; the vertex element must come first, as it always does."""
    form, count, fields, element = "", 0, [], ""
    for line in lines:
        words = line.split()
        if words[:1] == ["format"]:
            form = words[1]
        elif words[:1] == ["element"]:
            if not element and words[1] != "vertex":
                raise ValueError(f"its first element is {words[1]}, not vertex")
            element = words[1]
            count = int(words[2]) if element == "vertex" else count
        elif words[:1] == ["property"] and element == "vertex":
            fields.append((words[-1], _NUMPY_TYPE[words[1]]))
    return form, count, fields
