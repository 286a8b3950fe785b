"""Laser lines of a whole scan, reduced to patches, and where they lie in the world under a calibration."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration, Intrinsics
from scanmap.laserline import LaserLine
from scanmap.scan.range_image import bearing_columns

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# An image has about so many patches one above the other.
PATCHES = 300
# A patch must be straight to this, or it lies on an edge [px].
STRAIGHT_PX = 1.0
# Rows along which the line runs off faster than this belong to a ledge [px a row].
STEEPEST = 3.0
# A line that stands this close says the same again [px].
SAME_COLUMN_PX = 1.0
# Bearings closer than this were meant to be the same [rad].
SAME_BEARING = float(np.radians(0.02))


class Lines(NamedTuple):
    """Laser lines of B shots in the order they were taken."""

    column_px: Array  # (B, H)
    sigma_px: Array  # (B, H)
    bearings: Array  # (B,) [rad]


class Patches(NamedTuple):
    """A few rows of one bearing each: B bearings ascending within one turn, R patches from top to bottom."""

    column_px: Array  # (B, R) mean over the patch; NaN where it has too few rows or lies on an edge
    row_px: Array  # (B, R) its mean row
    sigma_px: Array  # (B, R) mean sigma of its rows
    bearings: Array  # (B,) [rad]

    @property
    def step(self) -> float:
        """Median angle between bearings [rad]."""
        return float(np.median(np.diff(self.bearings))) if len(self.bearings) > 1 else 0.0

    @property
    def closed(self) -> bool:
        """Whether the last bearing neighbours the first."""
        gap = 2.0 * np.pi - float(np.ptp(self.bearings))
        return 0.0 < gap <= 1.5 * self.step


class Sight(NamedTuple):
    """N patches as the camera sees them; the last axis of the arrays is x, y, z in the camera's frame."""

    bearing: Array  # (N,) [rad]
    ray: Array  # (N, 3) z = 1
    ray_per_column: Array  # (N, 3) derivative by the column

    def taken(self, which: Mask | NDArray[np.intp]) -> Sight:
        """Only the patches of a mask or index."""
        return Sight(self.bearing[which], self.ray[which], self.ray_per_column[which])


class LineStore:
    """Keeps the line of every shot that passes; the sink of a replay."""

    def __init__(self) -> None:
        self._columns: list[NDArray[np.float32]] = []
        self._sigmas: list[NDArray[np.float32]] = []
        self._bearings: list[float] = []

    def add(self, line: LaserLine, bearing: float) -> None:
        """Keep one line seen at `bearing` [rad]."""
        self._columns.append(line.column_px.astype(np.float32))
        self._sigmas.append(line.sigma_px.astype(np.float32))
        self._bearings.append(bearing)

    def lines(self) -> Lines:
        """All of them."""
        return Lines(np.array(self._columns, float), np.array(self._sigmas, float), np.array(self._bearings))


def patches_of(lines: Lines) -> Patches:
    """Straight pieces of the lines, a few rows each; bearings that were seen again are one.

    A mean over rows leaves what neighbouring rows share: that they were pooled, and JPEG's blocks.
    """
    lines = _merged(lines)
    shots, height = lines.column_px.shape
    rows = max(3, round(height / PATCHES))
    count = height // rows
    column, sigma = (part[:, : count * rows].reshape(shots, count, rows) for part in lines[:2])
    row = np.arange(count * rows, dtype=np.float64).reshape(count, rows)
    known = np.isfinite(column)
    number = known.sum(axis=2)
    share = np.maximum(number, 1)
    mean_row = np.where(known, row, 0.0).sum(axis=2) / share
    mean_column = np.where(known, column, 0.0).sum(axis=2) / share
    along = np.where(known, row - mean_row[..., None], 0.0)
    across = np.where(known, column - mean_column[..., None], 0.0)
    slope = (along * across).sum(axis=2) / np.maximum((along**2).sum(axis=2), 1e-9)
    bend = np.abs(across - slope[..., None] * along).max(axis=2)
    good = (number > rows / 2) & (number >= 2) & (bend < STRAIGHT_PX) & (np.abs(slope) < STEEPEST)
    return Patches(
        np.where(good, mean_column, np.nan), np.where(good, mean_row, np.nan),
        np.where(known, sigma, 0.0).sum(axis=2) / share, lines.bearings,
    )  # fmt: skip


def places_of(patches: Patches) -> NDArray[np.intp]:
    """Number (B, R) of the place in the picture where each patch stands; -1 where there is none."""
    column = np.round(np.nan_to_num(patches.column_px, nan=-1.0) / SAME_COLUMN_PX).astype(np.intp)
    rows = column.shape[1]
    return np.where(np.isfinite(patches.column_px), column * rows + np.arange(rows), -1)


def _merged(lines: Lines) -> Lines:
    """Lines by ascending bearing within one turn; of repeated ones the mean, where they agree."""
    bearings, groups = bearing_columns(lines.bearings, SAME_BEARING)
    first = [group[0] for group in groups]
    column, sigma = lines.column_px[first], lines.sigma_px[first]
    for k, group in enumerate(groups):
        if len(group) > 1:
            known = np.isfinite(lines.column_px[group])
            own = np.where(known, lines.column_px[group], 0.0)
            share = np.maximum(known.sum(axis=0), 1)
            mean = own.sum(axis=0) / share
            agree = known.any(axis=0) & (np.where(known, np.abs(own - mean), 0.0).max(axis=0) < 0.5 * STRAIGHT_PX)
            column[k] = np.where(agree, mean, np.nan)
            sigma[k] = np.sqrt((np.where(known, lines.sigma_px[group], 0.0) ** 2).sum(axis=0)) / share
    return Lines(column, sigma, np.array([bearings[group].mean() for group in groups]))


def sight_of(patches: Patches, intrinsics: Intrinsics) -> Sight:
    """Rays (B, R, 3) of patches; they depend on the intrinsics alone."""
    half = 0.5
    column, row = patches.column_px, patches.row_px
    ray = intrinsics.rays(column, row)
    slope = (intrinsics.rays(column + half, row) - intrinsics.rays(column - half, row)) / (2.0 * half)
    bearing = np.broadcast_to(patches.bearings[:, None], column.shape)
    return Sight(np.ascontiguousarray(bearing), ray, slope)


def located(sight: Sight, calibration: Calibration) -> tuple[Array, Array]:
    """World points (..., 3) [m] of what is seen, and their derivative by the column (..., 3) [m/px].

    NaN where the ray does not meet the laser plane in front of the camera.
    """
    R, centre = calibration.T_head_camera[:3, :3], calibration.T_head_camera[:3, 3]
    normal = calibration.laser_plane[:3]
    away = float(normal @ centre + calibration.laser_plane[3])
    ray, slope = sight.ray @ R.T, sight.ray_per_column @ R.T
    with np.errstate(divide="ignore", invalid="ignore"):
        toward = ray @ normal
        t = -away / toward
        t = np.where(t > 0, t, np.nan)[..., None]
        point = centre + t * ray
        per_column = t * (slope - ((slope @ normal) / toward)[..., None] * ray)
    T = calibration.mount.T_axis_head()
    point, per_column = point @ T[:3, :3].T + T[:3, 3], per_column @ T[:3, :3].T
    return _turned(point, sight.bearing), _turned(per_column, sight.bearing)


def _turned(vectors: Array, bearing: Array) -> Array:
    """Vectors (..., 3) turned about z by bearings (...) [rad]."""
    c, s = np.cos(bearing), np.sin(bearing)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([c * x - s * y, s * x + c * y, vectors[..., 2]], axis=-1)
