"""Files of a scan by their ending: clouds and meshes, written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from scanmap.errors import ConfigError
from scanmap.scan.mesh_files import write_glb, write_mesh_ply, write_obj, write_stl
from scanmap.scan.ply import VERTEX, comment_lines, read_ply, read_points, vertex_blocks, write_ply
from scanmap.scan.range_image import Scan, ScanParams

__all__ = ["CLOUDS", "MESHES", "check_writable", "read_ply", "read_points", "write"]

CLOUDS = (".ply", ".pcd", ".xyz")
MESHES = (".glb", ".stl", ".obj")


def check_writable(path: Path | str, suffixes: tuple[str, ...] = (*CLOUDS, *MESHES)) -> None:
    """Find out before a scan, not after it, whether `path` can be written.

    Raises:
        ConfigError: unknown ending, a name that is no text, no such folder, or no right to write there.
    """
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        ending = path.suffix or "no ending"
        raise ConfigError(f"{path}: {ending} is not a kind scanmap writes here; valid: {', '.join(suffixes)}")
    try:
        path.name.encode()
    except UnicodeEncodeError as error:
        raise ConfigError(f"{path}: maps and recordings name files in UTF-8, this is not: choose another") from error
    folder = path.parent
    if not folder.is_dir():
        raise ConfigError(f"{path} cannot be written: there is no folder {folder}; create it with mkdir -p {folder}")
    if path.is_dir():
        raise ConfigError(f"{path} cannot be written: it is a folder; give a file name")
    if path.exists() and not os.access(path, os.W_OK):
        raise ConfigError(f"{path} cannot be written: it is write-protected; choose another name")
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {folder}: {error.strerror}; choose another folder") from error


def write(scan: Scan, path: Path | str, params: ScanParams | None = None) -> None:
    """Write the scan in the form its ending asks for; a file that exists is replaced when the new one is whole.

    `.ply .pcd .xyz` are clouds (`.xyz` positions only); `.glb .stl .obj` and names that end in `mesh.ply` are meshes.

    Args:
        scan: with ascending bearings (`Scan.merged`).
        path: where to.
        params: for normals and the cut at depth edges.

    Raises:
        ConfigError: as `check_writable`.
        OSError: disk full; nothing is left behind, an older file stays.
    """
    path = Path(path)
    check_writable(path)
    writer = write_mesh_ply if path.name.lower().endswith("mesh.ply") else _WRITERS[path.suffix.lower()]
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with partial.open("wb") as file:
            writer(scan, file, params)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_pcd(scan: Scan, file: BinaryIO, params: ScanParams | None = None) -> None:
    """The cloud as a binary PCD 0.7, fields as in the PLY; the normals by PCL's names."""
    pcl = {"nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}
    names = [pcl.get(name, name) for name in VERTEX.names or ()]
    kinds = ["F" if VERTEX[k].kind == "f" else "I" for k in range(len(names))]
    about = "".join(f"# {line}\n" for line in comment_lines(scan))
    count = int(scan.valid.sum())
    file.write(
        (
            f"# .PCD v0.7 - Point Cloud Data file format\n{about}VERSION 0.7\nFIELDS {' '.join(names)}\n"
            f"SIZE {' '.join('4' for _ in names)}\nTYPE {' '.join(kinds)}\nCOUNT {' '.join('1' for _ in names)}\n"
            f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
        ).encode("ascii")
    )
    for records in vertex_blocks(scan, params):
        file.write(records.data)


def write_xyz(scan: Scan, file: BinaryIO, params: ScanParams | None = None) -> None:
    """The points as text, `x y z` [m] a line to the micrometre, nothing else: what every program reads."""
    for points, valid in zip(scan.points, scan.valid, strict=True):
        numbers = points[valid].astype(float).ravel().tolist()
        file.write(("%.6f %.6f %.6f\n" * (len(numbers) // 3) % tuple(numbers)).encode("ascii"))


_WRITERS: dict[str, Callable[[Scan, BinaryIO, ScanParams | None], None]] = {
    ".ply": write_ply,
    ".pcd": write_pcd,
    ".xyz": write_xyz,
    ".glb": write_glb,
    ".stl": write_stl,
    ".obj": write_obj,
}
