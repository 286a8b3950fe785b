"""Which neighbours in the range image lie on one surface: the question behind filter, normals and mesh.

Ranges are compared as disparities q = c / range with c such that one unit is about one image column: there noise is
nearly the same at every range, a plane is a straight line along the rows, and a floor seen at a grazing angle, whose
ranges differ by decimetres from row to row, is as smooth as a wall.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.scan.range_image import Scan, ScanParams

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Bearings farther apart than this are not neighbours, whatever lies between them.
MAX_STEP = np.radians(15.0)
# Rows (and bearings) without a point that a surface may bridge.
MAX_GAP = 2
# Columns of the range image worked on at a time, so that the intermediate arrays stay in the processor's cache.
BLOCK_CELLS = 60_000


class Disparity(NamedTuple):
    """The range image as disparities, with `halo` columns more on either side: wrapped round, or NaN."""

    q: F32  # (B + 2 halo, H) [about image columns]
    noise: F32  # (B + 2 halo, H) half the tolerance of a pair: sigma and floor, in the same unit
    turn: F32  # (B + 2 halo, H) q * distance from the axis / range: what one radian of bearing means sideways
    step: F32  # (B + 2 halo,) bearing to the next column [rad]; 0 where the next column is no neighbour
    row_step: float  # angle from row to row [rad]
    halo: int


def depth_edge_slope(params: ScanParams) -> float:
    """Tangent of the steepest incidence a surface is seen at; what rises more steeply is a depth edge."""
    return float(np.tan(np.radians(params.max_incidence_deg)))


def is_full_turn(bearings: NDArray[np.float64]) -> bool:
    """Whether the last of the ascending bearings [rad] neighbours the first."""
    if len(bearings) < 3:
        return False
    gap = 2.0 * np.pi - (bearings[-1] - bearings[0])
    return bool(0.0 < gap <= 1.5 * np.median(np.diff(bearings)))


def disparity(scan: Scan, params: ScanParams, halo: int) -> Disparity:
    """Disparities of a scan whose bearings ascend, ready for `links`."""
    scale = columns_per_inverse_range(scan)
    count = len(scan)
    shape = (count + 2 * halo, scan.rows)
    q, noise, turn = (np.full(shape, np.nan, np.float32) for _ in range(3))
    step = np.zeros(shape[0], np.float32)
    points, range_m = scan.points, scan.range_m
    inner = slice(halo, halo + count)
    np.divide(np.float32(scale), range_m, out=q[inner])
    np.multiply(scan.sigma_m, q[inner], out=noise[inner])
    noise[inner] *= q[inner]
    noise[inner] *= np.float32(params.support_sigma / np.sqrt(2.0) / scale)
    noise[inner] += np.float32(0.5 * params.support_px)
    np.hypot(points[..., 0], points[..., 1], out=turn[inner])
    turn[inner] *= q[inner]
    turn[inner] /= range_m
    gaps = np.diff(scan.bearings, append=scan.bearings[:1] + 2.0 * np.pi)
    full = is_full_turn(scan.bearings)
    if not full:
        gaps[-1:] = 0.0
    step[inner] = np.where(gaps <= MAX_STEP, gaps, 0.0)
    if full:
        for values in (q, noise, turn, step):
            values[:halo], values[halo + count :] = values[count : count + halo], values[halo : 2 * halo]
    return Disparity(q, noise, turn, step, row_angle(scan), halo)


def columns_per_inverse_range(scan: Scan) -> float:
    """How many image columns the laser line moves per 1/m of inverse range, learned from the scan itself."""
    some = (slice(None, None, max(1, len(scan) // 64)), slice(None, None, max(1, scan.rows // 64)))
    known = scan.valid[some] & np.isfinite(scan.column_px[some])
    column = scan.column_px[some][known].astype(np.float64)
    inverse = 1.0 / scan.range_m[some][known].astype(np.float64)
    spread = inverse - inverse.mean() if len(inverse) else inverse
    if np.abs(spread).sum() > 1e-2 * np.abs(inverse).sum():
        slope = abs(float(spread @ column / (spread @ spread)))
        if slope > 0.0:
            return slope
    # All at one range: take the median sigma for 0.05 px instead.
    per_px = (scan.sigma_m[some] / scan.range_m[some] ** 2)[scan.valid[some]]
    typical = float(np.median(per_px)) if per_px.size else 0.0
    return 0.05 / typical if typical > 0.0 else 100.0


def row_angle(scan: Scan) -> float:
    """Median angle between neighbouring rows as seen from the head [rad]."""
    some = slice(None, None, max(1, len(scan) // 32))
    rays = scan.points[some].astype(np.float64) - scan.origins[some][:, None]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    angle = np.linalg.norm(np.diff(rays, axis=1), axis=-1)
    angle = angle[np.isfinite(angle)]
    return float(np.median(angle)) if angle.size else 0.0


def blocks(count: int, rows: int) -> Iterator[slice]:
    """Slices over `count` columns, each small enough for the cache."""
    size = max(8, BLOCK_CELLS // max(1, rows))
    for start in range(0, count, size):
        yield slice(start, min(count, start + size))


def row_links(d: Disparity, columns: slice, reach: float) -> Mask:
    """Whether each cell and the one below lie on one surface, (n, H - 1), for padded columns `columns`.

    A gap of up to two lost rows is carried across by the last row before it.
    """
    q = _filled(d.q[columns], axis=1)
    sideways = np.nan_to_num(q[:, :-1]) * np.float32(d.row_step)
    noise = _filled(d.noise[columns], axis=1)
    return _linked(np.diff(q, axis=1), noise[:, :-1] + noise[:, 1:], sideways, reach, axis=1)


def bearing_links(d: Disparity, columns: slice, reach: float) -> Mask:
    """Whether each cell and the one at the next bearing lie on one surface, (n - 1, H); gaps as in `row_links`."""
    q = _filled(d.q[columns], axis=0)
    noise = _filled(d.noise[columns], axis=0)
    step = d.step[columns][:-1, None]
    sideways = np.nan_to_num(_filled(d.turn[columns], axis=0)[:-1]) * step
    return _linked(np.diff(q, axis=0), noise[:-1] + noise[1:], sideways, reach, axis=0) & (step > 0)


def _linked(jump: F32, tolerance: F32, sideways: F32, reach: float, axis: int) -> Mask:
    """Whether jumps in disparity are those of one surface.

    Args:
        jump: (n, m) difference between neighbours along `axis`, NaN where one has no point.
        tolerance: (n, m) noise of the pair.
        sideways: (n, m) how far apart the two lie across the view, in the same unit.
        reach: tangent of the steepest incidence a surface is seen at.

    A jump belongs to the surface if it is no larger than the points are apart, or lies between the jumps before and
    after it (a slope that goes on, an edge between two walls); never if the surface would be seen too steeply.
    """
    tolerance = tolerance + sideways
    size = np.abs(jump)
    linked: Mask = size <= tolerance
    # The few others may continue a slope: their neighbours decide.
    doubtful = np.flatnonzero(~linked & (size <= tolerance + sideways * np.float32(reach)))
    if doubtful.size:
        low = high = np.zeros(doubtful.size, np.float32)
        place = np.array(np.unravel_index(doubtful, jump.shape))
        for offset in (-1, 1):
            beside = place.copy()
            beside[axis] += offset
            inside = (beside[axis] >= 0) & (beside[axis] < jump.shape[axis])
            beside[axis] = np.clip(beside[axis], 0, jump.shape[axis] - 1)
            other = np.where(inside, np.nan_to_num(jump[beside[0], beside[1]]), 0.0)
            low, high = np.minimum(low, other), np.maximum(high, other)
        own, slack = jump.ravel()[doubtful], tolerance.ravel()[doubtful]
        linked.ravel()[doubtful] = (own >= low - slack) & (own <= high + slack)
    return linked


def _filled(values: F32, axis: int) -> F32:
    """A copy in which up to MAX_GAP missing cells carry the value before them along `axis`."""
    filled = values.copy()
    after = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
    before = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
    for _ in range(MAX_GAP):
        np.copyto(filled[after], filled[before].copy(), where=np.isnan(filled[after]))
    return filled
