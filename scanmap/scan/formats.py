"""Files of a scan by their ending: clouds and meshes, written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scanmap.errors import ConfigError
from scanmap.scan.mesh import mesh
from scanmap.scan.ply import ply_bytes, read_ply, read_points, vertices_of
from scanmap.scan.range_image import Scan
from scanmap.scan.surface import normals

__all__ = ["CLOUDS", "MESHES", "check_writable", "read_ply", "read_points", "write"]

CLOUDS = (".ply", ".pcd", ".xyz")
MESHES = (".glb", ".stl", ".obj")


def check_writable(path: Path, suffixes: tuple[str, ...] = (*CLOUDS, *MESHES)) -> None:
    """Find out before a scan, not after it, whether `path` can be written.

    Raises:
        ConfigError: unknown ending, no such folder, or no right to write there.
    """
    if path.suffix.lower() not in suffixes:
        ending = path.suffix or "no ending"
        raise ConfigError(f"{path}: {ending} is not a kind scanmap writes here; valid: {', '.join(suffixes)}")
    folder = path.parent
    if not folder.is_dir():
        raise ConfigError(f"{path} cannot be written: there is no folder {folder}; create it with mkdir -p {folder}")
    if path.is_dir():
        raise ConfigError(f"{path} cannot be written: it is a folder; give a file name")
    if not os.access(path if path.exists() else folder, os.W_OK):
        raise ConfigError(f"{path} cannot be written: no permission; choose another folder")


def write(scan: Scan, path: Path) -> None:
    """Write the scan in the form its ending asks for; a file that exists is replaced when the new one is whole.

    `.ply .pcd .xyz` are clouds with every attribute; `.glb .stl .obj` and names that end in `mesh.ply` are meshes.

    Raises:
        ConfigError: as `check_writable`.
        OSError: disk full.
    """
    check_writable(path)
    is_mesh = path.name.lower().endswith("mesh.ply")
    data = mesh_bytes(scan, "ply") if is_mesh else _WRITERS[path.suffix.lower()](scan)
    partial = path.with_name(f".{path.name}.part")
    try:
        partial.write_bytes(data)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def pcd_bytes(scan: Scan) -> bytes:
    """The cloud as a binary PCD 0.7, fields as in the PLY; the normals by PCL's names."""
    records = vertices_of(scan)
    pcl = {"nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}
    names = [pcl.get(name, name) for name in records.dtype.names or ()]
    kinds = ["F" if records.dtype[k].kind == "f" else "I" for k in range(len(names))]
    about = "".join(f"# {key}: {value}\n" for key, value in scan.comments.items())
    header = (
        f"# .PCD v0.7 - Point Cloud Data file format\n{about}VERSION 0.7\nFIELDS {' '.join(names)}\n"
        f"SIZE {' '.join('4' for _ in names)}\nTYPE {' '.join(kinds)}\nCOUNT {' '.join('1' for _ in names)}\n"
        f"WIDTH {len(records)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(records)}\nDATA binary\n"
    )
    return header.encode() + records.tobytes()


def xyz_bytes(scan: Scan) -> bytes:
    """The points as text, `x y z` [m] a line, nothing else: what every program reads."""
    points = scan.points[scan.valid].astype(np.float64)
    return "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in points.tolist()).encode()


def mesh_bytes(scan: Scan, kind: str) -> bytes:
    """The mesh as `glb`, `stl`, `obj` or `ply`; grey by the line's intensity where the form has colours."""
    import trimesh

    surface = mesh(scan)
    normal = normals(scan)[scan.valid]
    built = trimesh.Trimesh(
        vertices=surface.vertices,
        faces=surface.triangles,
        vertex_normals=np.nan_to_num(normal) if kind != "stl" else None,
        vertex_colors=_greys(scan),
        process=False,
        metadata={key: str(value) for key, value in scan.comments.items()},
    )
    data: Any = built.export(file_type=kind)
    return data.encode() if isinstance(data, str) else bytes(data)


def _greys(scan: Scan) -> np.ndarray[Any, np.dtype[np.uint8]]:
    brightness = np.sqrt(np.clip(scan.intensity[scan.valid] / 255.0, 0.05, 1.0))
    grey = (255.0 * brightness).astype(np.uint8)
    return np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=-1)


_WRITERS: dict[str, Callable[[Scan], bytes]] = {
    ".ply": ply_bytes,
    ".pcd": pcd_bytes,
    ".xyz": xyz_bytes,
    ".glb": lambda scan: mesh_bytes(scan, "glb"),
    ".stl": lambda scan: mesh_bytes(scan, "stl"),
    ".obj": lambda scan: mesh_bytes(scan, "obj"),
}
