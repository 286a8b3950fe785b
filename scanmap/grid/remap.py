"""Polar evidence to the cells of a Cartesian grid, once: how many bearings hit a cell, how many pass it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.grid.evidence import BINS_PER_CELL, GridParams, PolarEvidence

Array = NDArray[np.float64]

# Walls seen at a flatter angle than this are not drawn along their direction.
_MIN_COS_INCIDENCE = np.cos(np.radians(85.0))
# Neighbours this far apart in heading tell a wall's direction from the noise of its points [rad].
_LINE_STEP = np.radians(1.0)
# Bearings closer than this are the same one, repeated [rad].
_SAME_HEADING = np.radians(0.02)
# A cell's centre is nearer to a wall in the cell than this, in cells.
_HALF_DIAGONAL = 0.71


class Counts(NamedTuple):
    """Bearings per cell. Row 0 is the lowest y, column 0 the lowest x."""

    hits: NDArray[np.int32]  # (rows, cols)
    passes: NDArray[np.int32]  # (rows, cols)
    origin: tuple[float, float]  # lower-left corner of cell (0, 0) [m]


class Beams(NamedTuple):
    """The bearings as sectors, and the straight wall each of them hit, where its neighbours confirm one."""

    direction: Array  # (B, 2) unit
    left: Array  # (B,) [rad] how far the beam reaches counter-clockwise: half way to the neighbour
    right: Array  # (B,)
    next_left: NDArray[np.intp]  # (B,) the bearing next to it counter-clockwise
    next_right: NDArray[np.intp]  # (B,)
    point: Array  # (B, 2) on the surface that most rows hit; NaN without
    tangent: Array  # (B, 2) along the wall; NaN where it is not straight
    blocks: NDArray[np.bool_]  # (B,) the free space ends at that surface, not for want of returns


def remap(evidence: PolarEvidence, params: GridParams) -> Counts:
    """Count for every cell the bearings that hit it and those that pass it.

    A bearing stands for half the step to both sides, at most max_beam_deg / 2. It hits along the direction
    of its wall where that is straight, so that walls stay in place and closed between coarse bearings.
    """
    if not len(evidence.heading):
        nothing = np.zeros((1, 1), np.int32)
        return Counts(nothing, nothing, (0.0, 0.0))
    beams = _beams(evidence, params)
    hit_bearing, hit_at, in_front = _draw_hits(evidence, beams, params)
    origin, shape = _extent(hit_at, evidence, params.resolution_m)
    cell = _cell_of(hit_at, origin, shape, params.resolution_m)
    size = shape[0] * shape[1]
    pairs, first = np.unique(hit_bearing * size + cell, return_index=True)
    hits = np.bincount(pairs % size, minlength=size)
    passes = _passes(evidence, beams, origin, shape, params)
    # A bearing that hit a cell on its way, a table below other rows, does not pass it.
    passes -= np.bincount(cell[first][in_front[first]], minlength=size)
    return Counts(hits.reshape(shape).astype(np.int32), np.maximum(passes, 0).reshape(shape).astype(np.int32), origin)


def _beams(evidence: PolarEvidence, params: GridParams) -> Beams:
    direction = np.column_stack([np.cos(evidence.heading), np.sin(evidence.heading)])
    point = evidence.origin + _place(evidence.surface, evidence.surface_side, direction)
    # Repeated bearings look the same way and share their neighbours.
    group = np.cumsum(np.diff(evidence.heading, prepend=-np.inf) > _SAME_HEADING) - 1
    first = np.flatnonzero(np.diff(group, prepend=-1))
    heading = evidence.heading[first]
    gap = np.mod(np.roll(heading, -1) - heading, 2.0 * np.pi) if len(heading) > 1 else np.full(1, 2.0 * np.pi)
    limit = np.radians(params.max_beam_deg)
    usual = float(np.median(gap[gap <= limit])) if (gap <= limit).any() else limit
    half = 0.5 * np.where(gap <= limit, gap, usual)
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(point[:, 0])
        many = np.bincount(group[seen], minlength=len(heading))
        mean = [np.bincount(group[seen], weights=point[seen, i], minlength=len(heading)) / many for i in (0, 1)]
    tangent = _tangents(np.column_stack(mean), gap, params.resolution_m)[group]
    tangent[np.abs(_cross(tangent, direction)) < _MIN_COS_INCIDENCE] = np.nan
    blocks = np.abs(evidence.free_to - evidence.surface) <= 2.0 * params.resolution_m
    neighbours = np.roll(first, -1)[group], np.roll(first, 1)[group]
    return Beams(direction, half[group], np.roll(half, 1)[group], *neighbours, point, tangent, blocks)


def _tangents(point: Array, gap: Array, resolution: float) -> Array:
    """Direction (B, 2) of the wall at each point, where three points near it lie on a line; NaN elsewhere."""
    B = len(point)
    tangent = np.full((B, 2), np.nan)
    if B < 3:
        return tangent
    stride = max(1, round(_LINE_STEP / float(np.median(gap))))
    index = np.arange(B)
    turn = np.concatenate([[0.0], np.cumsum(gap)])
    least = np.full(B, 0.25 * resolution)
    for shift in (-2, 0, -1):
        a, b, c = (np.mod(index + (shift + s) * stride, B) for s in range(3))
        chord = point[c] - point[a]
        with np.errstate(divide="ignore", invalid="ignore"):
            unit = chord / np.linalg.norm(chord, axis=1)[:, None]
            bend = np.abs(_cross(unit, point[b] - point[a]))
        # Near a corner more than one triple is almost straight; the straightest is the wall.
        better = (bend <= least) & (np.mod(turn[c] - turn[a], turn[-1]) < 0.5 * np.pi)
        tangent[better], least[better] = unit[better], bend[better]
    return tangent


def _draw_hits(
    evidence: PolarEvidence, beams: Beams, params: GridParams
) -> tuple[NDArray[np.intp], Array, NDArray[np.bool_]]:
    """Bearing (M,), place (M, 2) [m] of hits drawn across their beams; whether free space goes on behind (M,)."""
    k, r = evidence.hit_bearing, evidence.hit_range
    start = evidence.origin[k] + _place(r, evidence.hit_side, beams.direction[k])
    width = params.resolution_m / BINS_PER_CELL
    on_wall = (np.abs(r - evidence.surface[k]) <= 3.0 * width) & np.isfinite(beams.tangent[k, 0])
    ends = [_wall_end(evidence, beams, side) for side in (1, -1)]
    reach = np.where(on_wall, np.abs(ends[0][k]) + np.abs(ends[1][k]), r * (beams.left + beams.right)[k])
    n = np.ceil(reach / width).astype(np.intp) + 1
    each = np.repeat(np.arange(len(k)), n)
    step = np.arange(len(each)) - np.repeat(np.cumsum(n) - n, n)
    part = np.where(n[each] > 1, step / np.maximum(n[each] - 1, 1), 0.5)
    b = k[each]
    along = ends[1][b] + part * (ends[0] - ends[1])[b]
    wall = start[each] + along[:, None] * beams.tangent[b]
    angle = evidence.heading[b] - beams.right[b] + part * (beams.left + beams.right)[b]
    arc = evidence.origin[b] + _place(r[each], evidence.hit_side[each], np.column_stack([np.cos(angle), np.sin(angle)]))
    in_front = r < evidence.free_to[k] - _HALF_DIAGONAL * params.resolution_m
    return b, np.where(on_wall[each, None], wall, arc), in_front[each]


def _wall_end(evidence: PolarEvidence, beams: Beams, side: int) -> Array:
    """How far (B,) [m] along its tangent a bearing's wall is drawn to one side, +1 = counter-clockwise.

    To the beam's edge, or to the corner with the neighbour's wall.
    """
    half, k = (beams.left, beams.next_left) if side > 0 else (beams.right, beams.next_right)
    angle = evidence.heading + side * half
    edge = np.column_stack([np.cos(angle), np.sin(angle)])
    # The laser moves on as the head turns.
    ahead, aside = (evidence.origin * beams.direction).sum(axis=1), _cross(beams.direction, evidence.origin)
    laser = _place(ahead, aside, edge)
    with np.errstate(divide="ignore", invalid="ignore"):
        end = -_cross(beams.point - laser, edge) / _cross(beams.tangent, edge)
        other_point, other = beams.point[k], beams.tangent[k]
        det = _cross(beams.tangent, other)
        corner = _cross(other_point - beams.point, other) / np.where(np.abs(det) > 0.1, det, np.nan)
        arc = evidence.surface * half / np.abs(_cross(beams.tangent, beams.direction))
    end = np.clip(end, -2.0 * arc, 2.0 * arc)
    # A corner counts where it lies within the gap between the two bearings: elsewhere it is where a wall
    # would meet the one far behind it.
    at = beams.point + corner[:, None] * beams.tangent
    after = side * _cross(beams.direction, at - evidence.origin) > 0
    before = side * _cross(at - evidence.origin[k], beams.direction[k]) > 0
    between = after & before
    drawn: Array = np.where(between, corner, end)
    return drawn


def _extent(hit_at: Array, evidence: PolarEvidence, resolution: float) -> tuple[tuple[float, float], tuple[int, int]]:
    """Lower-left corner [m] and shape of the grid: every hit and all free space, two cells of margin.

    Corners lie on multiples of the resolution, so that grids of several scans share their cells.
    """
    direction = np.column_stack([np.cos(evidence.heading), np.sin(evidence.heading)])
    reached = evidence.origin + evidence.free_to[:, None] * direction
    seen = np.concatenate([hit_at, reached, evidence.origin, np.zeros((1, 2))])
    low = np.floor(seen.min(axis=0) / resolution).astype(int) - 2
    high = np.floor(seen.max(axis=0) / resolution).astype(int) + 3
    cols, rows = (high - low).tolist()
    return (float(low[0] * resolution), float(low[1] * resolution)), (rows, cols)


def _cell_of(at: Array, origin: tuple[float, float], shape: tuple[int, int], resolution: float) -> NDArray[np.intp]:
    col, row = np.floor((at - origin) / resolution).astype(np.intp).T
    cell: NDArray[np.intp] = np.clip(row, 0, shape[0] - 1) * shape[1] + np.clip(col, 0, shape[1] - 1)
    return cell


def _passes(
    evidence: PolarEvidence, beams: Beams, origin: tuple[float, float], shape: tuple[int, int], params: GridParams
) -> NDArray[np.intp]:
    """Bearings (rows * cols,) that pass each cell.

    A cell sees the laser at a heading and distance that follow in closed form from the laser's circle about
    the axis; a laser behind the axis can look at a cell from two headings.
    """
    passes = np.zeros(shape[0] * shape[1], dtype=np.intp)
    rows, cols = np.divmod(np.arange(passes.size), shape[1])
    cell = np.column_stack([cols, rows])
    centre = np.asarray(origin) + (cell + 0.5) * params.resolution_m
    ahead = float(np.median((evidence.origin * beams.direction).sum(axis=1)))
    aside = float(np.median(_cross(beams.direction, evidence.origin)))
    square = (centre**2).sum(axis=1) - aside**2
    root = np.sqrt(np.maximum(square, 0.0))
    for sign in (1.0, -1.0):
        distance = sign * root - ahead
        look = np.flatnonzero((square >= 0.0) & (distance > 0.0))
        r = distance[look]
        heading = np.arctan2(centre[look, 1], centre[look, 0]) - np.arctan2(aside, sign * root[look])
        passes[look] += _bearings_passing(
            evidence, beams, centre[look], heading=heading, r=r, lever=r + ahead, params=params
        )
    return passes


def _bearings_passing(
    evidence: PolarEvidence,
    beams: Beams,
    centre: Array,
    *,
    heading: Array,
    r: Array,
    lever: Array,
    params: GridParams,
) -> NDArray[np.intp]:
    """How many bearings pass cells (N,) seen under `heading` [rad] at distance `r` [m] from the laser.

    Where several bearings fall into a cell they are counted; elsewhere the cell belongs to the beam it lies
    in, and between two bearings neither's wall may stand before it.
    """
    B, resolution = len(evidence.heading), params.resolution_m
    around = np.concatenate([evidence.heading - 2.0 * np.pi, evidence.heading, evidence.heading + 2.0 * np.pi])
    heading = np.mod(heading, 2.0 * np.pi)
    wide = np.minimum(0.5 * resolution / np.maximum(np.abs(lever), 1e-9), np.pi / 2.0)
    first, last = np.searchsorted(around, heading - wide), np.searchsorted(around, heading + wide)
    # The beam a cell lies in, and the neighbour on its other side.
    after = np.searchsorted(around, heading)
    before = after - 1
    d_after, d_before = around[after % (3 * B)] - heading, heading - around[before]
    mine_is_after = d_after < d_before
    mine, other = np.where(mine_is_after, after, before) % B, np.where(mine_is_after, before, after) % B
    off = np.minimum(d_after, d_before)
    inside = off <= np.where(mine_is_after, beams.right[mine], beams.left[mine]) + 1e-9
    proven = (
        inside & _in_front(evidence, beams, mine, centre, r=r, resolution=resolution) & (r >= evidence.free_from[mine])
    )
    between = (last == first) & (d_after + d_before <= np.radians(params.max_beam_deg))
    has_wall = beams.blocks[other]
    blocked = between & has_wall & ~_in_front(evidence, beams, other, centre, r=r, resolution=resolution)
    counted = _count_in_window(evidence, beams, (first, last), r, resolution)
    return np.where(last - first > 1, counted, proven & ~blocked).astype(np.intp)


def _in_front(
    evidence: PolarEvidence, beams: Beams, k: NDArray[np.intp], centre: Array, *, r: Array, resolution: float
) -> NDArray[np.bool_]:
    """Whether cells (N,) lie before the end of the free space of bearing `k` (N,), along its wall if it has one."""
    margin = _HALF_DIAGONAL * resolution
    tangent = beams.tangent[k]
    # Side of the wall's line, positive towards the laser.
    side = _cross(tangent, centre - beams.point[k]) * np.sign(_cross(tangent, -beams.direction[k]))
    slack = (evidence.surface - evidence.free_to)[k] * np.abs(_cross(tangent, beams.direction[k]))
    along_wall = beams.blocks[k] & np.isfinite(tangent[:, 0])
    free_to = evidence.free_to[k]
    front: NDArray[np.bool_] = np.where(along_wall, side >= margin + np.maximum(slack, 0.0), r <= free_to - margin)
    return front & (free_to > 0.0)


def _count_in_window(
    evidence: PolarEvidence,
    beams: Beams,
    window: tuple[NDArray[np.intp], NDArray[np.intp]],
    r: Array,
    resolution: float,
) -> NDArray[np.intp]:
    """Bearings of the `window`, first and last of the thrice repeated circle, whose free space holds r (N,)."""
    B = len(evidence.heading)
    width = resolution / BINS_PER_CELL
    cosine = np.abs(_cross(beams.tangent, beams.direction))
    cosine = np.where(beams.blocks & np.isfinite(cosine), np.maximum(cosine, 0.2), 1.0)
    end = evidence.free_to - _HALF_DIAGONAL * resolution / cosine
    bins = int(r.max(initial=0.0) / width) + 2
    at = (np.arange(bins) + 0.5) * width
    free = (at >= evidence.free_from[:, None]) & (at <= end[:, None])
    total = np.zeros((3 * B + 1, bins), dtype=np.int32)
    np.cumsum(np.concatenate([free, free, free]), axis=0, out=total[1:])
    k = (r / width).astype(np.intp)
    counted: NDArray[np.intp] = total[window[1], k] - total[window[0], k]
    return counted


def _place(along: Array, left: Array, direction: Array) -> Array:
    """(N, 2) [m] `along` a direction and to the `left` of it."""
    across = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
    return along[:, None] * direction + left[:, None] * across


def _cross(a: Array, b: Array) -> Array:
    """z of the cross product of (..., 2) vectors."""
    z: Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return z
