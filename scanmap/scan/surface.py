"""The surface of a range image: outliers removed, and normals, by image operations.

The functions want a scan whose bearings ascend (`Scan.merged`); a scan of a full turn closes on itself.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import Reason
from scanmap.scan.links import MAX_GAP, Disparity, bearing_links, blocks, depth_edge_slope, disparity, row_links
from scanmap.scan.range_image import Scan, ScanParams

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


def remove_outliers(scan: Scan, params: ScanParams | None = None) -> Scan:
    """A copy without the points that no neighbour supports (`Reason.OUTLIER`).

    And without those that say next to nothing of where the surface is, `max_sigma_share` (`Reason.WEAK`); what lies so
    far off may be anything's neighbour.

    A point stays if the row above or below lies on the same surface. If both rows are there and neither does, the
    bearings decide: a wire along them stays, a speck does not, nor a flying pixel that hangs between two surfaces.
    """
    params = params or ScanParams()
    with np.errstate(invalid="ignore"):
        known = scan.without(scan.sigma_m > params.max_sigma_share * scan.range_m, Reason.WEAK)
    known.give_up(unsupported(known, params), Reason.OUTLIER)
    return known


def unsupported(scan: Scan, params: ScanParams) -> Mask:
    """(B, H) cells with a point that no neighbour supports."""
    halo, reach = 2, depth_edge_slope(params)
    d = disparity(scan, params, halo)
    lonely = np.zeros((len(scan), scan.rows), bool)
    for block in blocks(len(scan), scan.rows):
        core = slice(block.start + halo, block.stop + halo)
        rows = row_links(d, core, reach)
        alone = np.isfinite(d.q[core])
        lost = ~alone[:, 1:-1]
        # What a gap carries on is linked to where it comes from; a neighbour is only the point at its end.
        rows &= alone[:, 1:]
        alone[:, 1:] &= ~rows
        for _ in range(MAX_GAP):
            rows[:, :-1] |= lost & rows[:, 1:]
        alone[:, :-1] &= ~rows
        lonely[block] = alone
    column, row = np.nonzero(lonely)
    lonely[column, row] = ~_held_by_bearings(d, column + halo, row)
    return lonely


def _held_by_bearings(d: Disparity, column: NDArray[np.intp], row: NDArray[np.intp]) -> Mask:
    """Whether points that no row supports are supported by the bearings beside them; (N,) padded column and row."""
    offsets = range(-2, 3)
    q = {k: d.q[column + k, row] for k in offsets}
    noise = {k: d.noise[column + k, row] for k in offsets}
    step = {k: np.where(d.step[column + k] > 0, d.step[column + k], np.nan) for k in range(-2, 2)}
    place = {-2: -step[-1] - step[-2], -1: -step[-1], 0: 0.0 * step[0], 1: step[0], 2: step[0] + step[1]}
    if d.q.shape[1] < 2:
        above = below = np.full(len(row), np.nan)
    else:
        above = np.where(row > 0, d.q[column, row - 1], np.nan)
        below = np.where(row < d.q.shape[1] - 1, d.q[column, np.minimum(row + 1, d.q.shape[1] - 1)], np.nan)
    with np.errstate(invalid="ignore"):
        beside, straight = np.zeros(len(row), bool), np.zeros(len(row), bool)
        for k in (-1, 1):
            slack = noise[0] + noise[k] + d.turn[column, row] * np.abs(place[k])
            beside |= np.abs(q[k] - q[0]) <= slack
        for k in (-1, 0, 1):  # a wire: three neighbours in a line, not too steep, this point one of them
            before, after = place[k] - place[k - 1], place[k + 1] - place[k]
            middle = (q[k - 1] * after + q[k + 1] * before) / (before + after)
            bend = np.abs(q[0]) * before * after  # an even line in space is no straight line of disparities
            slack = noise[k - 1] + noise[k] + noise[k + 1]
            gentle = np.abs(q[k + 1] - q[k - 1]) <= slack + 2.0 * d.turn[column, row] * (before + after)
            straight |= gentle & (np.abs(q[k] - middle) <= slack + bend)
        between = (q[0] - above) * (below - q[0]) > 0
    contradicted = np.isfinite(above) & np.isfinite(below)
    return np.where(contradicted, straight & ~between, beside)


def normals(scan: Scan, params: ScanParams | None = None) -> F32:
    """Unit normals (B, H, 3) in the world frame, toward the head; NaN where there is no surface to fit.

    Cross product of two chords through each point, one along the rows and one along the bearings, between means over
    a patch of `normal_window_deg` that ends at depth edges. On a plane any chord lies in it, so steps need not be
    equal and the head need not stand on the axis.
    """
    params = params or ScanParams()
    result = np.full((len(scan), scan.rows, 3), np.nan, np.float32)
    if len(scan) < 2 or scan.rows < 3:
        return result
    third = np.radians(params.normal_window_deg) / 3.0
    steps = np.diff(scan.bearings)
    along = int(np.clip(round(third / max(float(np.median(steps)), 1e-6)), 1, 16))
    halo = along + 2
    d = disparity(scan, params, halo)
    down = int(np.clip(round(third / max(d.row_step, 1e-6)), 1, max(1, scan.rows // 3)))
    # Columns of the halo of a scan that is no full turn are the wrong ones; no link leads there.
    order = np.arange(-halo, len(scan) + halo) % len(scan)
    origins = scan.origins.astype(np.float32)
    for block in blocks(len(scan), scan.rows):
        wide = slice(block.start, block.stop + 2 * halo)
        points = np.ascontiguousarray(np.moveaxis(scan.points[order[wide]], -1, 0))
        patch = _patch_normals(points, d, wide, depth_edge_slope(params), along, down)[:, halo:-halo]
        view = origins[block].T[:, :, None] - points[:, halo:-halo]
        patch *= np.copysign(np.float32(1.0), (patch * view).sum(axis=0))
        result[block] = np.moveaxis(patch, 0, -1)
    return result


def _patch_normals(points: F32, d: Disparity, wide: slice, reach: float, along: int, down: int) -> F32:
    """Unit normals (3, n, H) of one block of padded columns, either sign."""
    rows = np.zeros(points.shape[1:], np.uint8)
    rows[:, :-1] = row_links(d, wide, reach)
    bearings = np.zeros(points.shape[1:], np.uint8)
    bearings[:-1] = bearing_links(d, wide, reach)
    smooth = _row_means(points, rows, down)
    a, b = _chord(smooth, rows, down, axis=1), _chord(smooth, bearings, along, axis=0)
    normal = np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
    length = np.sqrt((normal * normal).sum(axis=0))
    with np.errstate(divide="ignore", invalid="ignore"):
        normal /= np.where(length > 0, length, np.nan)
    normal[:, np.isnan(points[0])] = np.nan
    return normal


def _row_means(points: F32, links: NDArray[np.uint8], window: int) -> F32:
    """Points (3, n, H) averaged over up to `window` rows of the same surface; as they are beside a depth edge."""
    window |= 1
    if window < 3:
        return points
    half, known = window // 2, np.isfinite(points[0])
    sums = _row_sums(np.where(known, points, np.float32(0.0)).reshape(-1, points.shape[2]), window)
    count = _row_sums(known.astype(np.float32), window)
    whole = np.zeros_like(known)
    whole[:, half:] = _all_linked(links, window - 1, axis=1)[:, :-half]
    whole &= count > 0
    means = sums.reshape(points.shape)
    np.divide(means, count, out=means, where=whole)
    np.copyto(means, points, where=~whole)
    return means


def _row_sums(values: F32, window: int) -> F32:
    sums = cv2.boxFilter(values, -1, (window, 1), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(sums, np.float32)


def _chord(points: F32, links: NDArray[np.uint8], span: int, axis: int) -> F32:
    """Vectors (3, n, H) from the surface before each cell to the surface after it, along `axis`.

    Each end is `span` cells away where the surface reaches that far, else the next cell, else the cell itself.
    """
    after, before = points.copy(), points.copy()
    known = np.isfinite(points[0])
    for reach in sorted({1, span}):
        if reach >= known.shape[axis]:
            break
        low, high = _part(axis, None, -reach), _part(axis, reach, None)
        onward = _all_linked(links, reach, axis)[low]
        np.copyto(after[:, *low], points[:, *high], where=onward & known[high])
        np.copyto(before[:, *high], points[:, *low], where=onward & known[low])
    after -= before
    return after


def _part(axis: int, start: int | None, stop: int | None) -> tuple[slice, slice]:
    """The slice from start to stop along `axis` of a two-dimensional array."""
    return (slice(start, stop), slice(None)) if axis == 0 else (slice(None), slice(start, stop))


def _all_linked(links: NDArray[np.uint8], count: int, axis: int) -> Mask:
    """Whether the `count` links from each cell on are all there, (n, H); False beyond the border."""
    kernel = np.ones((1, count) if axis == 1 else (count, 1), np.uint8)
    eroded = cv2.erode(links, kernel, anchor=(0, 0), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return eroded.astype(bool)
