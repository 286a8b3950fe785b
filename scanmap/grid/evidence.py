"""Polar evidence of a scan: per bearing, what its rows hit in the height band and how far they prove it free."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, model_validator

from scanmap.geometry import transform
from scanmap.grid.floor import Floor
from scanmap.scan import Scan

Array = NDArray[np.float64]
F32 = NDArray[np.float32]

# Range bins per grid cell: a hit is placed better than the cell it falls into.
BINS_PER_CELL = 3
# Rows whose ranges scatter round one surface: a bin this much weaker than its neighbour belongs to it.
_TAIL = 0.2
# Through-gap test on about this many rows; 1200 rows are not independent.
_COVERAGE_ROWS = 240


class GridParams(BaseModel, frozen=True, extra="forbid"):
    """How a scan becomes an occupancy grid; `[grid]` in a rig's TOML."""

    resolution_m: float = Field(0.05, ge=0.005, le=1.0, description="side of a cell [m]")
    height_low_m: float = Field(0.1, description="lower edge of the height band above the floor [m]")
    height_high_m: float = Field(1.8, description="upper edge of the height band above the floor [m]")
    evidence: Literal["octomap", "cartographer"] = Field(
        "octomap", description="octomap: hit +0.85, miss -0.4, clamp -2 .. 3.5; cartographer: 0.55, 0.49, 0.1 .. 0.9"
    )
    min_coverage: float = Field(
        0.6, gt=0, le=1, description="share of the band's elevations that must be seen through before a cell is free"
    )
    min_hit_rows: int = Field(2, ge=1, description="rows that must agree on a hit")
    max_beam_deg: float = Field(8.0, gt=0, le=45, description="bearings farther apart leave unknown between them [deg]")
    laser_height_m: float | None = Field(
        None,
        gt=0,
        description="laser above the floor where too little of that is in view; else the lowest points [m]",
    )
    max_tilt_deg: float = Field(8.0, gt=0, le=30, description="largest tilt of the axis against the floor [deg]")

    @model_validator(mode="after")
    def _ordered(self) -> GridParams:
        if self.height_low_m >= self.height_high_m:
            raise ValueError(f"height_low_m {self.height_low_m} must be below height_high_m {self.height_high_m}")
        return self


class PolarEvidence(NamedTuple):
    """Evidence per bearing, sorted by heading, in the level frame of the floor. N hits, B bearings."""

    heading: Array  # (B,) [rad] direction of the laser fan
    origin: Array  # (B, 2) the laser [m]
    free_from: Array  # (B,) [m] horizontal distance from which the band is proven free ...
    free_to: Array  # (B,) ... and to which; 0 where nothing is
    surface: Array  # (B,) [m] distance along the heading where most rows hit; NaN where no row did
    surface_side: Array  # (B,) [m] and to the left of it
    hit_bearing: NDArray[np.intp]  # (N,) index into the above
    hit_range: Array  # (N,) [m] horizontal distance from the laser, along the heading ...
    hit_side: Array  # (N,) [m] ... and to the left of it: a leaning fan sweeps a little sideways


def polar_evidence(scan: Scan, floor: Floor, params: GridParams) -> PolarEvidence:
    """What each bearing says about the height band above the floor.

    A row that returns from within the band is a hit there. Every returning row, floor and ceiling rows too,
    has passed the band up to where it hit or left it. A row without a return says nothing.
    """
    if not scan.valid.any():
        none = np.zeros(0)
        return PolarEvidence(none, np.zeros((0, 2)), none, none, none, none, np.zeros(0, np.intp), none, none)
    T = floor.T_level_world
    origins = scan.origins
    laser = transform(T, origins)
    heading = _headings(scan, T, laser)
    delta = scan.points - origins[:, None].astype(np.float32)
    along, side, rise = _in_fan(delta, T, heading)
    height = rise + laser[:, 2:].astype(np.float32)
    bins = int(np.nanmax(along, initial=0.0) / _width(params)) + 2 + 2 * BINS_PER_CELL  # room for the filters
    hits = _hits(height, along, side, _spread(scan), bins, params)
    free_from, free_to = _free(rise, along, laser[:, 2], bins, params)
    order = np.argsort(heading, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return PolarEvidence(
        heading=heading[order],
        origin=laser[order, :2],
        free_from=free_from[order],
        free_to=free_to[order],
        surface=hits.surface[order],
        surface_side=hits.surface_side[order],
        hit_bearing=rank[hits.bearing],
        hit_range=hits.range_m,
        hit_side=hits.side,
    )


def _width(params: GridParams) -> float:
    """Length of a range bin [m]."""
    return params.resolution_m / BINS_PER_CELL


def _headings(scan: Scan, T: Array, laser: Array) -> Array:
    """Direction (B,) [rad] in which the laser fan of each bearing lies, in the level frame, 0 .. 2 pi.

    The mount tells where the head's x axis points; how far the laser's plane is yawed against it is the
    median over a few thousand points.
    """
    x_axis = scan.mount.T_axis_head()[:3, 0]
    cos, sin = np.cos(scan.bearings), np.sin(scan.bearings)
    turned = [cos * x_axis[0] - sin * x_axis[1], sin * x_axis[0] + cos * x_axis[1], np.full_like(cos, x_axis[2])]
    axis = np.stack(turned, axis=-1) @ T[:3, :3].T
    heading: Array = np.arctan2(axis[:, 1], axis[:, 0])
    across, down = _thin(scan)
    delta = transform(T, scan.points[across, down].astype(np.float64)) - laser[across, None]
    off = np.arctan2(delta[..., 1], delta[..., 0]) - heading[across, None]
    off = off[np.isfinite(off)]
    if len(off):
        mean = np.angle(np.exp(1j * off).mean())
        heading = heading + mean + np.median(np.angle(np.exp(1j * (off - mean))))
    return np.mod(heading, 2.0 * np.pi)


def _thin(scan: Scan) -> tuple[slice, slice]:
    """About 100 bearings and 100 rows of the scan."""
    return slice(None, None, max(1, len(scan) // 100)), slice(None, None, max(1, scan.rows // 100))


def _in_fan(delta: F32, T: Array, heading: Array) -> tuple[F32, F32, F32]:
    """World vectors (B, H, 3) in the axes of their fan, each (B, H): along the heading, to its left, up."""
    cos, sin, zero = np.cos(heading), np.sin(heading), np.zeros_like(heading)
    axes = np.stack([np.stack([cos, sin, zero], -1), np.stack([-sin, cos, zero], -1)], axis=1)
    up = np.broadcast_to([0.0, 0.0, 1.0], (len(heading), 1, 3))
    rotation = (np.concatenate([axes, up], axis=1) @ T[:3, :3]).astype(np.float32)  # (B, 3, 3)
    turned = rotation @ delta.transpose(0, 2, 1)
    return turned[:, 0], turned[:, 1], turned[:, 2]


def _spread(scan: Scan) -> float:
    """c of sigma = c range^2 [1/m], the law of triangulation, from the sigma of the points."""
    across, down = _thin(scan)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = scan.sigma_m[across, down] / scan.range_m[across, down] ** 2
    ratio = ratio[np.isfinite(ratio)]
    return float(np.median(ratio)) if len(ratio) else 0.0


class _Hits(NamedTuple):
    bearing: NDArray[np.intp]  # (N,)
    range_m: Array  # (N,)
    side: Array  # (N,)
    surface: Array  # (B,)
    surface_side: Array  # (B,)


def _hits(height: F32, along: F32, side: F32, spread: float, bins: int, params: GridParams) -> _Hits:
    """Where the rows of each bearing end within the band, and where most of them do."""
    B, H = along.shape
    inside = np.flatnonzero((height >= params.height_low_m) & (height <= params.height_high_m) & (along > 0))
    distance = along.ravel()[inside]
    key = (inside // H) * bins + (distance * np.float32(1.0 / _width(params))).astype(np.intp)
    count, metres, aside = (
        np.bincount(key, weights=w, minlength=B * bins).reshape(B, bins) for w in (None, distance, side.ravel()[inside])
    )
    rows = count.astype(np.float32)
    nearby = cv2.boxFilter(rows, -1, (2 * BINS_PER_CELL + 1, 1), normalize=False, borderType=cv2.BORDER_CONSTANT)
    hit = (count > 0) & (nearby >= params.min_hit_rows) & (rows >= _TAIL * _strongest(rows, spread, _width(params)))
    # Bins of the strongest surface, so narrow that its mean is its place.
    core = cv2.boxFilter(rows, -1, (3, 1), normalize=False, borderType=cv2.BORDER_CONSTANT)
    peak = np.where(hit, core, 0.0).argmax(axis=1)[:, None] + np.array([-1, 0, 1])
    peak, each = np.clip(peak, 0, bins - 1), np.arange(B)[:, None]
    weight = np.where(hit[each, peak], count[each, peak], 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean_range, mean_side = metres / count, aside / count
        surface, surface_side = (
            np.where(weight > 0, weight * mean[each, peak], 0.0).sum(axis=1) / weight.sum(axis=1)
            for mean in (mean_range, mean_side)
        )
    # Between two rows that graze one surface, a table top, there is no other surface and nothing free.
    closed = cv2.morphologyEx(hit.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((1, 2 * BINS_PER_CELL + 1), np.uint8))
    # Closing also fills up to the laser where the first hit is near it; before the first there is nothing to close.
    bearing, k = np.nonzero(closed & np.maximum.accumulate(hit, axis=1))
    last = np.maximum.accumulate(np.where(hit, np.arange(bins), 0), axis=1)[bearing, k]
    range_m = np.where(last == k, mean_range[bearing, k], (k + 0.5) * _width(params))
    return _Hits(bearing, range_m, mean_side[bearing, last], surface, surface_side)


def _strongest(count: F32, spread: float, width: float) -> F32:
    """Largest count within 2.5 sigma of each range bin, at least two bins."""
    r = (np.arange(count.shape[1]) + 0.5) * width
    reach = np.maximum(2.5 * spread * r * r / width, 2.0)
    reach = 2 ** np.ceil(np.log2(np.minimum(reach, 64.0)))  # few filter sizes
    strongest = np.zeros_like(count)
    for size in np.unique(reach):
        wide = cv2.dilate(count, np.ones((1, 2 * int(size) + 1), np.uint8))
        strongest[:, reach == size] = wide[:, reach == size]
    return strongest


def _free(rise: F32, along: F32, laser_height: Array, bins: int, params: GridParams) -> tuple[Array, Array]:
    """From where to where (B,) [m] each bearing proves the band free: the through-gap test.

    At distance r the band spans the elevations from atan(low / r) to atan(high / r). Rows that return from r
    or beyond have been through it at their own elevation; floor and ceiling rows only as far as they are
    inside the band. Together they must cover min_coverage of the span.
    """
    width = _width(params)
    thin = slice(None, None, max(1, along.shape[1] // _COVERAGE_ROWS))
    rise, along = rise[:, thin], along[:, thin]
    low, high = params.height_low_m - laser_height[:, None], params.height_high_m - laser_height[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = rise / along  # (B, h) tangent of each row's elevation
        t = np.where((along > 0) & np.isfinite(t), np.where(np.abs(t) < 1e-9, 1e-9, t), np.nan)
        ends = low / t, high / t
    # Elevation of a row: the step from row to row along a surface, free of the parallax at edges.
    row = np.abs(np.diff(t, axis=1))
    row = row[np.isfinite(row)]
    weight = (np.median(row) if len(row) else 0.0) / (1.0 + t * t)
    back = _bin(along, width, bins)
    enter = np.minimum(_bin(np.minimum(*ends), width, bins), back)
    leave = np.clip(_bin(np.maximum(*ends), width, bins), enter, np.maximum(back, enter))
    passed = _summed(enter, leave, np.nan_to_num(weight), bins)
    r = (np.arange(bins) + 0.5) * width
    span = np.arctan(high / r) - np.arctan(low / r)
    proven = passed >= params.min_coverage * span
    first = proven.argmax(axis=1)
    ended = ~proven & (np.arange(bins) >= first[:, None])
    last = np.where(ended.any(axis=1), ended.argmax(axis=1), bins)
    some = proven.any(axis=1)
    return np.where(some, first * width, 0.0), np.where(some, last * width, 0.0)


def _bin(distance: NDArray[np.floating[Any]], width: float, bins: int) -> NDArray[np.intp]:
    """Index of the first range bin whose centre lies at `distance` or beyond, within 0 .. bins; 0 for NaN."""
    index: NDArray[np.intp] = np.nan_to_num(np.clip(np.ceil(distance / width - 0.5), 0, bins)).astype(np.intp)
    return index


def _summed(start: NDArray[np.intp], stop: NDArray[np.intp], weight: Array, bins: int) -> Array:
    """Per bearing and range bin (B, bins) the weights of the rows whose interval [start, stop) holds the bin."""
    B = len(start)
    base, size = np.arange(B)[:, None] * (bins + 1), B * (bins + 1)
    change = np.bincount((base + start).ravel(), weights=weight.ravel(), minlength=size)
    change -= np.bincount((base + stop).ravel(), weights=weight.ravel(), minlength=size)
    summed: Array = change.reshape(B, bins + 1).cumsum(axis=1)[:, :bins]
    return summed
