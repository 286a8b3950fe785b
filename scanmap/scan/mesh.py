"""The organised triangle mesh of a range image: neighbours joined where they lie on one surface."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.scan.links import bearing_links, disparity, row_links
from scanmap.scan.range_image import Scan, ScanParams


class Mesh(NamedTuple):
    """Triangles over the points of a scan, in the order of `Scan.points[Scan.valid]`."""

    vertices: NDArray[np.float32]  # (N, 3) world [m]
    triangles: NDArray[np.int32]  # (M, 3) counter-clockwise seen from the scanner


def mesh(scan: Scan, params: ScanParams | None = None) -> Mesh:
    """Two triangles for every four neighbours that lie on one surface, one where a corner is missing.

    Cut at depth jumps: every side of a triangle along the rows or the bearings must be a link of `scan.links`. A
    full turn closes on itself. Wants ascending bearings (`Scan.merged`).
    """
    params = params or ScanParams()
    valid = scan.valid
    vertices = scan.points[valid]
    if len(scan) < 2 or scan.rows < 2:
        return Mesh(vertices, np.empty((0, 3), np.int32))
    reach = float(np.tan(np.radians(params.max_incidence_deg)))
    d = disparity(scan, params, 1)
    everything = slice(0, len(scan) + 2)
    down = row_links(d, everything, reach)  # (B + 2, H - 1)
    along = bearing_links(d, everything, reach)  # (B + 1, H)
    # Padded column k + 1 is column k; the last may be followed by the first.
    order = np.append(np.arange(len(scan)), 0)
    here, there = slice(1, len(scan) + 1), slice(2, len(scan) + 2)
    number = np.full(valid.shape, -1, np.int64)
    number[valid] = np.arange(len(vertices))
    number = number[order]
    a, b = number[:-1, :-1], number[1:, :-1]  # this row: this bearing, the next
    c, e = number[:-1, 1:], number[1:, 1:]  # the row below
    left, right = down[here], down[there]
    top, bottom = along[1:, :-1], along[1:, 1:]
    ok_a, ok_b, ok_c, ok_e = a >= 0, b >= 0, c >= 0, e >= 0
    whole = ok_a & ok_b & ok_c & ok_e
    # Bearings grow to the left as the scanner looks, rows downward.
    parts = [
        _triangles(ok_a & ok_b & ok_c & left & top, a, b, c),
        _triangles(whole & right & bottom, b, e, c),
        _triangles(~ok_a & ok_b & ok_c & ok_e & right & bottom, b, e, c),
        _triangles(~ok_c & ok_a & ok_b & ok_e & top & right, a, b, e),
        _triangles(~ok_b & ok_a & ok_c & ok_e & left & bottom, a, e, c),
    ]
    return Mesh(vertices, np.concatenate(parts).astype(np.int32))


def _triangles(mask: NDArray[np.bool_], *corners: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.stack([corner[mask] for corner in corners], axis=-1)
