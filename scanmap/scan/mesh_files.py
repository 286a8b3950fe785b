"""Mesh files of a scan: binary STL and PLY, and GLB and OBJ by trimesh. Metres, z up (GLB: y up, as glTF wants it)."""

from __future__ import annotations

from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from scanmap.scan.mesh import Mesh, mesh
from scanmap.scan.ply import comment_lines
from scanmap.scan.range_image import Scan, ScanParams
from scanmap.scan.surface import normals

_STL_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_PLY_VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
_PLY_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
_PLY_VERTEX_LINES = [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")] + [
    f"property uchar {name}" for name in ("red", "green", "blue")
]
# glTF's x y z from x forward, y left, z up: a viewer turns it back by the same rule.
_Y_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def write_stl(scan: Scan, file: BinaryIO, params: ScanParams | None = None) -> None:
    """Binary STL; its 80 free bytes say where the scan comes from."""
    surface = mesh(scan, params)
    facets = np.zeros(len(surface.triangles), _STL_FACET)
    facets["corners"] = surface.vertices[surface.triangles]
    a, b, c = (facets["corners"][:, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    facets["normal"] = normal / np.where(length > 0, length, 1.0)
    about = f"scanmap mesh, metres; source: {scan.comments.get('source', 'scan')}"
    file.write(about.encode("ascii", "replace")[:80].ljust(80))
    file.write(np.uint32(len(facets)).tobytes())
    file.write(facets.data)


def write_mesh_ply(scan: Scan, file: BinaryIO, params: ScanParams | None = None) -> None:
    """Binary PLY mesh with normals and grey vertices, and the comments of the cloud."""
    surface, used = _compact(scan, params)
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comment_lines(scan))]
    lines += [f"element vertex {len(surface.vertices)}", *_PLY_VERTEX_LINES]
    lines += [f"element face {len(surface.triangles)}", "property list uchar int vertex_indices", "end_header\n"]
    file.write("\n".join(lines).encode("ascii"))
    vertices = np.empty(len(used), _PLY_VERTEX)
    vertices["position"] = surface.vertices
    vertices["normal"] = _normals(scan, params)[used]
    vertices["colour"] = _greys(scan)[used, None]
    faces = np.empty(len(surface.triangles), _PLY_FACE)
    faces["count"], faces["corners"] = 3, surface.triangles
    file.write(vertices.data)
    file.write(faces.data)


def write_glb(scan: Scan, file: BinaryIO, params: ScanParams | None = None) -> None:
    """Binary glTF: y up, normals, grey vertices; the scan's comments are the mesh's `extras`."""
    built = _trimesh(scan, params)
    built.apply_transform(_Y_UP)
    file.write(built.export(file_type="glb", include_normals=True))


def write_obj(scan: Scan, file: BinaryIO, params: ScanParams | None = None) -> None:
    """Wavefront OBJ, z up, with normals; text, so large and slow."""
    file.write(_trimesh(scan, params).export(file_type="obj", include_color=False).encode())


def _trimesh(scan: Scan, params: ScanParams | None) -> Any:
    import trimesh

    surface, used = _compact(scan, params)
    grey = _greys(scan)[used]
    return trimesh.Trimesh(
        vertices=surface.vertices,
        faces=surface.triangles,
        vertex_normals=_normals(scan, params)[used],
        vertex_colors=np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=-1),
        process=False,
        metadata={str(key): str(value) for key, value in scan.comments.items()},
    )


def _compact(scan: Scan, params: ScanParams | None) -> tuple[Mesh, NDArray[np.intp]]:
    """The mesh without points that no triangle uses, and which of the scan's points are left."""
    surface = mesh(scan, params)
    touched = np.zeros(len(surface.vertices), bool)
    touched[surface.triangles.ravel()] = True
    number = np.cumsum(touched, dtype=np.int32) - 1
    return Mesh(surface.vertices[touched], number[surface.triangles]), np.flatnonzero(touched)


def _normals(scan: Scan, params: ScanParams | None) -> NDArray[np.float32]:
    return np.nan_to_num(normals(scan, params)[scan.valid])


def _greys(scan: Scan) -> NDArray[np.uint8]:
    """How bright each point is drawn, (N,): the root of the line's height, which varies by powers of ten."""
    height = np.clip(np.nan_to_num(scan.intensity[scan.valid]) / 255.0, 0.05, 1.0)
    return np.asarray(255.0 * np.sqrt(height), np.uint8)
