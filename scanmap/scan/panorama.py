"""A scan asked by direction: what stands there, and whether it looked through a given place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanmap.scan.links import MAX_STEP
from scanmap.scan.range_image import Scan, ScanParams
from scanmap.scan.surface import normals

F64 = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_FINEST = 1e-4  # smallest step of elevation [rad]
_TOLERANCE = (0.015, 0.005)  # of a place against a surface, beside its noise: constant [m], and share of the range
_MOST_M = 0.15  # however noisy
_PATCH_M = 0.15  # what lies in one cube of this size counts once
_ABOUT_M = 0.4  # how far along a surface, beyond its own cell, it is still taken for the nearest
_CLEARLY_M = 0.1  # so far beyond a place, beside the tolerance, and the scan looked through it


class Panorama:
    """A scan, B bearings ascending x H rows, as seen from the middle of its origins.

    Columns of a sweep may be degrees apart: each point stands for a piece of plane that reaches to the next column.
    """

    points: F64  # (B, H, 3) world frame [m]
    normals: F64  # (B, H, 3), NaN where unknown
    sigma: F64  # (B, H) [m], 0 where there is no point
    distance: F64  # (B, H) from the middle of the origins [m]
    valid: Mask  # (B, H); who has explained a point may take it out
    bearings: F64  # (B,) [rad]
    eye: F64  # (3,) the middle of the origins [m]

    def __init__(self, scan: Scan, params: ScanParams) -> None:
        """Make ready a scan that has points."""
        self.points = scan.points.astype(np.float64)
        self.normals = normals(scan, params).astype(np.float64)
        self.sigma = np.nan_to_num(scan.sigma_m.astype(np.float64))
        self.valid = scan.valid
        self.bearings = scan.bearings
        self.eye = scan.origins.mean(axis=0)
        way = self.points - self.eye
        self.distance = np.linalg.norm(way, axis=-1)
        elevation = np.arctan2(way[..., 2], np.hypot(way[..., 0], way[..., 1]))
        steps = np.abs(np.diff(elevation, axis=1))
        known = np.isfinite(steps)
        self._step = max(1.5 * float(np.median(steps[known])) if known.any() else 0.0, _FINEST)
        self._lowest = float(elevation[self.valid].min())
        column, row = np.nonzero(self.valid)
        height = ((elevation[column, row] - self._lowest) / self._step).astype(np.intp)
        self._row = np.full((len(scan), int(height.max()) + 1), -1)
        self._row[column, height] = row

    def tolerance(self, cells: Mask) -> F64:
        """How far (N,) an image of the cells may be beside the room [m]."""
        own: F64 = 3.0 * self.sigma[cells] + _TOLERANCE[0] + _TOLERANCE[1] * self.distance[cells]
        return np.minimum(own, _MOST_M)

    def images(self, points: F64, tolerance: F64, among: Mask) -> tuple[Mask, Mask, Mask]:
        """Whether `points` (N, 3) lie on a surface, and an upright one; and whether the scan looked through them.

        Args:
            tolerance: (N,) of their own [m].
            among: cells (B, H) that are asked.
        """
        way = points - self.eye
        distance = np.linalg.norm(way, axis=1)
        on, upright = np.zeros((2, len(points)), bool)
        through = np.ones(len(points), bool)
        for k, at, reach in self._around(way, among):
            known = np.zeros(len(points), bool)
            known[k] = True
            through &= known
            normal, apart = self.normals[at], points[k] - self.points[at]
            beside = np.linalg.norm(apart, axis=1) < reach * distance[k] + _CLEARLY_M
            off = np.abs(np.einsum("ij,ij->i", apart, normal))
            allowed = np.hypot(tolerance[k], 3.0 * self.sigma[at])
            met = beside & (off < allowed)
            on[k] |= met
            upright[k] |= met & (np.abs(normal[:, 2]) < 0.5)
            cosine = np.abs(np.einsum("ij,ij->i", way[k], normal)) / distance[k]
            through[k] &= self.distance[at] - distance[k] > _CLEARLY_M + allowed / np.clip(
                np.nan_to_num(cosine), 0.2, 1.0
            )
        return on, upright, through & ~on

    def nearest(self, points: F64, among: Mask) -> tuple[F64, F64]:
        """How far (N,) points (N, 3) are before the surface in that direction [m], NaN where none is; its normal."""
        best, facing = np.full(len(points), np.nan), np.zeros_like(points)
        for k, at, reach in self._around(points - self.eye, among):
            apart = points[k] - self.points[at]
            off = np.einsum("ij,ij->i", apart, self.normals[at])
            with np.errstate(invalid="ignore"):
                near = np.linalg.norm(apart, axis=1) < reach * self.distance[at] + _ABOUT_M
                near &= np.isfinite(off) & ~(np.abs(off) >= np.abs(best[k]))
            best[k[near]], facing[k[near]] = off[near], self.normals[at][near]
        return best, facing

    def _around(self, way: F64, among: Mask) -> list[tuple[Index, tuple[Index, Index], F64]]:
        """What was measured in directions (N, 3), at the bearings before and after: of which, and in which cells.

        The third is how far around a place one of the cells stands for its surface, as a share of the range.
        """
        azimuth = self.bearings[0] + (np.arctan2(way[:, 1], way[:, 0]) - self.bearings[0]) % (2.0 * np.pi)
        height = np.floor((np.arctan2(way[:, 2], np.hypot(way[:, 0], way[:, 1])) - self._lowest) / self._step)
        after = np.searchsorted(self.bearings, azimuth)
        inside = (after > 0) & (height >= 0) & (height < self._row.shape[1])
        ahead = np.append(self.bearings, self.bearings[0] + 2.0 * np.pi)
        span = ahead[after] - ahead[after - 1]
        inside &= span < MAX_STEP
        found = list[tuple[Index, tuple[Index, Index], F64]]()
        for column in (after - 1, after % len(self.bearings)):
            row = np.where(inside, self._row[column, np.where(inside, height, 0).astype(np.intp)], -1)
            row[~among[column, row]] = -1
            k = np.flatnonzero(row >= 0)
            found.append((k, (column[k], row[k]), 1.2 * span[k]))
        return found


def patches(points: F64) -> NDArray[np.int64]:
    """Number (N,) of the cube of space that each point (N, 3) lies in."""
    number: NDArray[np.int64] = np.floor(points / _PATCH_M).astype(np.int64) @ np.array([1, 4096, 4096**2])
    return number
