"""Laser lines of a whole scan, reduced to patches, and where they lie in the world under a calibration."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration, Intrinsics
from scanmap.laserline import LaserLine

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# An image has about so many patches one above the other.
PATCHES = 300
# A patch must be straight to this, or it lies on an edge [px].
STRAIGHT_PX = 1.0
# Rows along which the line runs off faster than this belong to a ledge [px a row].
STEEPEST = 3.0


class Lines(NamedTuple):
    """Laser lines of B shots in the order they were taken."""

    column_px: Array  # (B, H)
    sigma_px: Array  # (B, H)
    bearings: Array  # (B,) [rad]


class Patches(NamedTuple):
    """A few rows of one shot each: B shots by ascending bearing within one turn, R patches from top to bottom."""

    column_px: Array  # (B, R) mean over the patch; NaN where it has too few rows or lies on an edge
    row_px: Array  # (B, R) its mean row
    bearings: Array  # (B,) [rad]
    order: NDArray[np.intp]  # (B,) the shot each came from

    @property
    def step(self) -> float:
        """Median angle between bearings [rad], repeated ones left aside."""
        steps = np.diff(self.bearings)
        steps = steps[steps > np.radians(0.02)]
        return float(np.median(steps)) if steps.size else 0.0

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
    """Straight pieces of the lines, a few rows each.

    A mean over rows leaves what neighbouring rows share: that they were pooled, and JPEG's blocks.
    """
    shots, height = lines.column_px.shape
    rows = max(3, round(height / PATCHES))
    count = height // rows
    column = lines.column_px[:, : count * rows].reshape(shots, count, rows)
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
    turned = np.mod(lines.bearings - lines.bearings.min() + 1e-9, 2.0 * np.pi) + lines.bearings.min()
    order = np.argsort(turned, kind="stable")
    return Patches(
        np.where(good, mean_column, np.nan)[order], np.where(good, mean_row, np.nan)[order], turned[order], order
    )


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
