"""Mesh files of a scan: binary STL, PLY and GLB, and OBJ by trimesh. Metres, z up (GLB: y up, as glTF wants it)."""

from __future__ import annotations

import json
import struct
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import RecordingError
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


def write_stl(scan: Scan, file: BinaryIO, params: ScanParams | None = None) -> None:
    """Binary STL; its 80 free bytes say where the scan comes from."""
    surface, _ = _compact(scan, params)
    about = f"scanmap mesh, metres; source: {scan.comments.get('source', 'scan')}"
    file.write(about.encode("ascii", "replace")[:80].ljust(80))
    file.write(struct.pack("<I", len(surface.triangles)))
    for start in range(0, len(surface.triangles), 65536):
        file.write(_facets(surface.vertices[surface.triangles[start : start + 65536]]).data)


def _facets(corners: NDArray[np.float32]) -> NDArray[Any]:
    """STL records of triangles (N, 3 corners, 3)."""
    edge = np.moveaxis(corners[:, 1:] - corners[:, :1], -1, 0)
    a, b = edge[..., 0], edge[..., 1]
    normal = np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]], axis=-1)
    length = np.sqrt((normal * normal).sum(axis=-1, keepdims=True))
    facets = np.zeros(len(corners), _STL_FACET)
    facets["normal"] = normal / np.where(length > 0, length, 1.0)
    facets["corners"] = corners
    return facets


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
    """Binary glTF 2.0: y up, normals, grey vertices; the scan's comments are the mesh's `extras`.

    Source: Khronos Group, glTF 2.0 specification, section 4 (GLB) and 3.7 (meshes).
    """
    surface, used = _compact(scan, params)
    grey = _greys(scan)[used]
    opaque = np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=-1)
    vertices, normal = _y_up(surface.vertices), _y_up(_normals(scan, params)[used])
    # Every array is a view of the one buffer, a multiple of four bytes long: no padding between them.
    arrays: list[NDArray[Any]] = [surface.triangles.astype("<u4").ravel(), vertices, normal, opaque]
    offsets = np.cumsum([0, *(array.nbytes for array in arrays)]).tolist()
    kinds = ((5125, "SCALAR", 34963), (5126, "VEC3", 34962), (5126, "VEC3", 34962), (5121, "VEC4", 34962))
    accessors: list[dict[str, Any]] = [
        {"bufferView": k, "componentType": component, "type": kind, "count": len(arrays[k])}
        for k, (component, kind, _) in enumerate(kinds)
    ]
    accessors[3]["normalized"] = True
    if len(vertices):
        accessors[1] |= {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
    attributes = {"POSITION": 1, "NORMAL": 2, "COLOR_0": 3}
    document = {
        "asset": {"version": "2.0", "generator": "scanmap"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [{"attributes": attributes, "indices": 0, "mode": 4}],
                "extras": {str(key): str(value) for key, value in scan.comments.items()},
            }
        ],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": offsets[k], "byteLength": arrays[k].nbytes, "target": target}
            for k, (_, _, target) in enumerate(kinds)
        ],
        "buffers": [{"byteLength": offsets[-1]}],
    }
    header = json.dumps(document, separators=(",", ":")).encode("ascii")
    header += b" " * (-len(header) % 4)
    file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(header) + offsets[-1]))
    file.write(struct.pack("<I4s", len(header), b"JSON") + header)
    file.write(struct.pack("<I4s", offsets[-1], b"BIN\0"))
    for array in arrays:
        file.write(array.tobytes())


def write_obj(scan: Scan, file: BinaryIO, params: ScanParams | None = None) -> None:
    """Wavefront OBJ, z up, with normals; text, so large and slow."""
    import trimesh

    surface, used = _compact(scan, params)
    built = trimesh.Trimesh(
        surface.vertices, surface.triangles, vertex_normals=_normals(scan, params)[used], process=False
    )
    comment = "; ".join(comment_lines(scan)[: len(scan.comments)])
    file.write(built.export(file_type="obj", header=f"scanmap mesh, metres; {comment}").encode())


def _y_up(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, 3) from z up to glTF's y up; importers turn it back by the same rule."""
    return np.ascontiguousarray(np.stack([vectors[:, 0], vectors[:, 2], -vectors[:, 1]], axis=-1))


def _compact(scan: Scan, params: ScanParams | None) -> tuple[Mesh, NDArray[np.intp]]:
    """The mesh without points that no triangle uses, and which of the scan's points are left."""
    surface = mesh(scan, params)
    if len(surface.triangles) == 0:
        raise RecordingError(
            f"no mesh: of {len(surface.vertices)} points no three are neighbours on one surface; write a cloud (.ply)"
        )
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
