"""The organised triangle mesh of a range image: neighbours joined where they lie on one surface."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.scan.links import bearing_links, blocks, depth_edge_slope, disparity, row_links
from scanmap.scan.range_image import Scan, ScanParams

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


class Mesh(NamedTuple):
    """Triangles over the points of a scan, in the order of `scan.points[scan.valid]`."""

    vertices: F32  # (N, 3) world frame [m]
    triangles: NDArray[np.int32]  # (M, 3) counter-clockwise as the head sees them


def mesh(scan: Scan, params: ScanParams | None = None) -> Mesh:
    """The points of a scan whose bearings ascend (`Scan.merged`), and triangles between those of one surface.

    A cell of four neighbours gives two triangles, split along the farther diagonal: most edges of a room are hollow,
    and a triangle across one would hang before it. Where three of them hold together it gives one, none across a
    depth edge. All are counter-clockwise as the head sees them; a scan of a full turn closes.
    """
    params = params or ScanParams()
    if len(scan) < 2 or scan.rows < 2:
        return Mesh(scan.points[scan.valid], np.empty((0, 3), np.int32))
    halo, reach = 2, depth_edge_slope(params)
    d = disparity(scan, params, halo)
    number = np.cumsum(scan.valid.ravel(), dtype=np.int32).reshape(scan.valid.shape) - 1
    number = np.concatenate([number, number[:1]])
    found = []
    for block in blocks(len(scan), scan.rows):
        core = slice(halo, halo + block.stop - block.start + 1)
        wide = slice(block.start, block.stop + 2 * halo)
        known = np.isfinite(d.q[wide][core])
        rows = row_links(d, wide, reach)[core] & known[:, 1:] & known[:, :-1]
        bearings = bearing_links(d, wide, reach)[core][:-1] & known[1:] & known[:-1]
        found.append(_cell_triangles(d.q[wide][core], rows, bearings, number[block.start : block.stop + 1]))
    vertices = scan.points[scan.valid]
    return Mesh(vertices, _facing_head(np.concatenate(found), vertices, scan))


def _cell_triangles(q: F32, rows: Mask, bearings: Mask, number: NDArray[np.int32]) -> NDArray[np.int32]:
    """Triangles of the cells between n + 1 columns.

    Args:
        q: (n + 1, H) disparities.
        rows: (n + 1, H - 1) links down.
        bearings: (n, H) links to the next column.
        number: (n + 1, H) of each point.
    """
    left, right, top, bottom = rows[1:], rows[:-1], bearings[:, :-1], bearings[:, 1:]  # as the head sees a cell
    corners = {"tr": top & right, "tl": top & left, "br": bottom & right, "bl": bottom & left}
    with np.errstate(invalid="ignore"):
        farther = q[:-1, :-1] + q[1:, 1:] <= q[1:, :-1] + q[:-1, 1:]
    falling = corners["tr"].astype(np.int8) + corners["bl"]  # triangles if split from top left to bottom right
    rising = corners["tl"].astype(np.int8) + corners["br"]
    rises = (rising > falling) | ((rising == falling) & farther)
    place = {"tr": number[:-1, :-1], "tl": number[1:, :-1], "br": number[:-1, 1:], "bl": number[1:, 1:]}
    found = []
    for corner, three, split in (
        ("tr", ("tr", "tl", "br"), ~rises), ("bl", ("bl", "br", "tl"), ~rises),
        ("tl", ("tl", "bl", "tr"), rises), ("br", ("br", "tr", "bl"), rises),
    ):  # fmt: skip
        cells = np.flatnonzero(corners[corner] & split)
        found.append(np.stack([np.take(place[name], cells) for name in three], axis=-1))
    return np.concatenate(found)


def _facing_head(found: NDArray[np.int32], vertices: F32, scan: Scan) -> NDArray[np.int32]:
    """The triangles turned so that the head sees their front.

    Rows may run up as well as down, so all may need turning; and where the head looks across its own axis, at a
    turntable, what lies before the axis moves against what lies behind it, so each is asked.
    """
    ends = np.cumsum(scan.valid.sum(axis=1))
    front = _fronts(found[:: max(1, len(found) // 4096)], vertices, ends, scan.origins)
    if not len(front) or front.mean() > 0.99:
        return found
    if front.mean() < 0.01:
        return found[:, ::-1]
    for start in range(0, len(found), 65536):
        part = found[start : start + 65536]
        back = ~_fronts(part, vertices, ends, scan.origins)
        part[back] = part[back][:, ::-1]
    return found


def _fronts(found: NDArray[np.int32], vertices: F32, ends: NDArray[np.int64], origins: NDArray[np.float64]) -> Mask:
    """Whether triangles (N, 3) are counter-clockwise from where their first corner was seen, (N,).

    Noise along the ray, which turns normals, leaves this as it is.
    """
    a, b, c = (vertices[found[:, k]].astype(np.float64) for k in range(3))
    seen_from = origins[np.searchsorted(ends, found[:, 0], side="right")]
    front: Mask = (np.cross(b - a, c - a) * (seen_from - a)).sum(axis=-1) > 0
    return front
