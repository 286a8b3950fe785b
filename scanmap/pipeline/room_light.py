"""The room's light under the line as other bearings show it: laser-off frames where none were taken.

When the head has turned on, the line lies elsewhere in the picture, and what it covered is seen without it. Where in
that picture follows from the points that the sweep has measured, and from how the surface lies between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.laserline import slide_between
from scanmap.scan import Scan

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_HALF = 44  # [px] on either side of the line that are made
# The same, and rows apart, where it is told how far beside its place a picture lies; and how far that is at most.
_HALF_WIDE, _ROWS_APART, _BESIDE_PX = 160, 6, 7
_LINE_PX, _NEEDED_PX = 14, 22  # of them: on which its own light may lie; within which all must be known
_ROWS = 25  # along the line over which what is left beside it is averaged
_NONE, _SATURATED = 255, 250  # what is not known, as a saturated laser-off frame tells nothing
# What is left beside the line in such means, of its height and in their own noise, up to which the light is the room's.
_LEFT, _LEFT_NOISE = 0.03, 2.0
_SAME_SURFACE = 3.0  # times as far as a point of a surface seen straight would lie, the next bearing's one may lie


class Unlit(NamedTuple):
    """A picture (H, W[, 3]) as it would be without the laser, near its line."""

    picture: U8  # 255 where it is not known
    told: Mask  # (H,) rows in which it is, and agrees with what is seen beside the line
    sigma_px: F64  # (H,) how well its place is known; infinite where nothing tells it
    slid_px: list[float]  # how far the others' pictures lay beside their places, of those that tell it


def unlit(
    scan: Scan, calibration: Calibration, k: int, picture: U8, others: Sequence[tuple[int, U8]], channel: int
) -> Unlit:
    """The picture of the k-th bearing without the laser.

    Args:
        picture: (H, W) or (H, W, 3) of the k-th bearing.
        others: bearings, by their index, and their pictures.
        channel: of the pictures that is compared.
    """
    dark = Unlit(np.full_like(picture, _NONE), np.zeros(scan.rows, bool), np.full(scan.rows, np.inf), [])
    rows = np.flatnonzero(scan.valid[k])
    if len(rows) < _ROWS:
        return dark
    strips, wide = (
        _Strips.of(scan, calibration, k, some, picture.shape[1], half)
        for some, half in ((rows, _HALF), (rows[::_ROWS_APART], _HALF_WIDE))
    )
    lit, wide_lit = strips.cut(picture), _plane(wide.cut(picture), channel)
    own = _plane(lit, channel)
    rises = np.maximum(own[:, _HALF - 1 : _HALF + 2].max(axis=1) - np.median(own, axis=1), np.float32(0.0))
    near, best = slice(_HALF - _NEEDED_PX, _HALF + _NEEDED_PX + 1), np.full(len(rows), np.inf)
    for j, other in others:
        seen, known = wide.seen_from(scan, calibration, j)
        off = _beside(_plane(_sampled(other, seen), channel), known)
        # What lies between both lines is best known; beyond them the surface may end.
        between = np.where(wide.towards(scan, calibration, j), wide_lit, np.float32(np.nan))
        right, sigma = slide_between(between, off, _BESIDE_PX)
        if not np.isfinite(sigma):
            right, sigma = slide_between(wide_lit, off, _BESIDE_PX)
        if np.isfinite(sigma):
            dark.slid_px.append(right)
        seen, known = strips.seen_from(scan, calibration, j)
        strip = _sampled(other, _moved(seen, right))
        gain, left, noise = _left_over(*(_beside(plane, known) for plane in (own, _plane(strip, channel))))
        whole = (known | ~strips.inside)[:, near].all(axis=1)
        better = whole & (left < np.hypot(_LEFT * rises, _LEFT_NOISE * noise)) & (left < best)
        best[better] = left[better]
        at, x = np.nonzero(better[:, None] & known)
        dark.picture[rows[better]] = _NONE
        dark.picture[rows[at], strips.x[at, x]] = np.minimum(gain * strip[at, x], _NONE - 1)
        dark.told[rows[better]], dark.sigma_px[rows[better]] = True, sigma
    return dark


class _Strips(NamedTuple):
    """Parts of a picture beside its line, in N rows and n columns."""

    row: Index  # (N,)
    x: Index  # (N, n) columns
    inside: Mask  # (N, n) of the picture
    k: int
    points: F64  # (N, 3) of the line [m], world frame
    along: F64  # (N, 3) to the next of them
    origin: F64  # (3,) of the rays
    rays: F64  # (N, n, 3) of the samples, world frame

    @classmethod
    def of(cls, scan: Scan, calibration: Calibration, k: int, rows: Index, width: int, half: int) -> _Strips:
        """Of the k-th bearing's picture, `half` columns on either side of its line in some rows."""
        T = scan.mount.T_world_head(float(scan.bearings[k])) @ calibration.T_head_camera
        points = scan.points[k, rows].astype(np.float64)
        along = np.gradient(cv2.blur(points, (1, min(_ROWS, len(rows)))), axis=0)
        x = np.rint(scan.column_px[k, rows]).astype(np.intp)[:, None] + np.arange(-half, half + 1)
        row = np.broadcast_to(rows[:, None].astype(np.float64), x.shape)
        rays = calibration.intrinsics.rays(x.astype(np.float64), row) @ T[:3, :3].T
        return cls(rows, x, (x >= 0) & (x < width), k, points, along, T[:3, 3], rays)

    def cut(self, picture: U8) -> F32:
        """The strips of the picture itself."""
        x = np.clip(self.x, 0, picture.shape[1] - 1)
        return picture[self.row[:, None], x].astype(np.float32)

    def towards(self, scan: Scan, calibration: Calibration, j: int) -> Mask:
        """What of them (N, n) lies between their line and another bearing's, on one surface as far as can be told."""
        T = scan.mount.T_world_head(float(scan.bearings[self.k])) @ calibration.T_head_camera
        there = calibration.intrinsics.project(_in_camera(T, scan.points[j, self.row].astype(np.float64)))
        middle = self.x[:, self.x.shape[1] // 2, None]
        beside, away = self.x - middle, there[:, :1] - middle
        with np.errstate(invalid="ignore"):
            return np.asarray(~self.other(scan, j)[:, None] & (beside * away > 0) & (np.abs(beside) < np.abs(away)))

    def other(self, scan: Scan, j: int) -> Mask:
        """Rows (N,) in which another bearing's line lies on another surface, or is not known."""
        turned = abs(float(scan.bearings[j] - scan.bearings[self.k]))
        beside, ray = scan.points[j, self.row] - self.points, self.points - self.origin
        size, range_m = (np.sqrt(np.square(vector).sum(axis=1)) for vector in (beside, ray))
        with np.errstate(invalid="ignore"):
            return np.asarray(~(size < _SAME_SURFACE * turned * range_m))

    def seen_from(self, scan: Scan, calibration: Calibration, j: int) -> tuple[F32, Mask]:
        """Where another bearing's picture shows them, (N, n, 2) columns and rows; and where it shows no line there."""
        own = calibration.intrinsics
        T = scan.mount.T_world_head(float(scan.bearings[j])) @ calibration.T_head_camera
        beside = scan.points[j, self.row].astype(np.float64) - self.points
        ray = self.points - self.origin
        other = self.other(scan, j)
        # Of a surface that ends before, nothing is known but its line; it is taken to face the camera.
        beside[other] = np.cross(self.along[other], ray[other])
        normal = np.cross(self.along, beside)
        with np.errstate(invalid="ignore", divide="ignore"):
            far = (ray * normal).sum(axis=1)[:, None] / (self.rays * normal[:, None]).sum(axis=2)
        places = self.origin + far[..., None] * self.rays
        seen = np.nan_to_num(own.project(_in_camera(T, places.reshape(-1, 3))), nan=-9.0)
        seen = seen.reshape(*self.x.shape, 2)
        column, row = seen[..., 0], seen[..., 1]
        known = self.inside & (far > 0) & (column >= 1) & (column < own.width - 2) & (row >= 1) & (row < own.height - 2)
        line = scan.column_px[j][np.clip(np.rint(row), 0, own.height - 1).astype(np.intp)]
        with np.errstate(invalid="ignore"):
            known &= ~(np.abs(column - line) < _NEEDED_PX)
        return seen.astype(np.float32), known


def _in_camera(T: F64, points: F64) -> F64:
    """Points (N, 3) of the world in the frame of a camera that stands there at `T`."""
    return np.asarray((points - T[:3, 3]) @ T[:3, :3])


def _sampled(picture: U8, seen: F32) -> F32:
    values = cv2.remap(picture, seen[..., 0], seen[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, np.float32)


def _moved(seen: F32, right: float) -> F32:
    """Places (N, n, 2) so that what is seen there moves right [px]."""
    return np.asarray(seen - np.float32(right) * np.gradient(seen, axis=1), np.float32)


def _plane(strip: F32, channel: int) -> F32:
    return strip if strip.ndim == 2 else strip[..., channel]


def _beside(strip: F32, known: Mask) -> F32:
    """Strips (N, n), NaN on the line and where nothing is known."""
    half = strip.shape[1] // 2
    away = np.abs(np.arange(-half, half + 1)) > _LINE_PX
    return np.where(known & away, strip, np.float32(np.nan))


def _left_over(on: F32, off: F32) -> tuple[float, F64, float]:
    """Gain from `off` to `on`; what is left (N,) of strips, in means along the line, and what noise leaves there."""
    usable = (on < _SATURATED) & (off < _SATURATED)
    if not usable.any():
        return 1.0, np.full(len(on), np.inf), 0.0
    gain = float(on[usable].sum() / max(float(off[usable].sum()), 1.0))
    apart = np.where(usable, on - gain * off, np.float32(0.0))
    count = cv2.blur(usable.astype(np.float32), (1, _ROWS))
    mean = cv2.blur(apart, (1, _ROWS)) / np.maximum(count, np.float32(0.5 / _ROWS))
    many = usable.sum(axis=1)
    left = np.sqrt((np.square(mean) * usable).sum(axis=1) / np.maximum(many, 1))
    noise = 1.48 * float(np.median(np.abs((apart - mean)[usable]))) / np.sqrt(_ROWS)
    return gain, np.where(many > _HALF // 2, left, np.inf), noise
