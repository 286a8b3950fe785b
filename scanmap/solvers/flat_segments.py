"""Flat pieces of a scan, grown in the range image, as far as a plane holds in units of image columns.

A residual is how many columns the line lies beside where the plane would put it: there noise is the same at every
range, and a calibration that is a little wrong bends a wall by a column or so where a corner kinks it by tens.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.solvers.sight import Patches

Array = NDArray[np.float64]
Labels = NDArray[np.intp]
Mask = NDArray[np.bool_]

# Of how far a column moves a point, at least this share counts as along the normal: under 3 deg from ray to surface,
# roughness tells more than the column. A least length would reward a head that shrinks what lies below it altogether.
GRAZING = 0.05
TILE_ROWS = 5
TILE_TURN = np.radians(4.0)
# The smallest flat piece: patches, bearings, rows of patches.
SMALLEST = (30, 3, 6)
# Pieces that turn against each other by more than this meet in a corner, and are not parts of one wall.
CORNER = np.radians(15.0)


class Segments(NamedTuple):
    """Flat pieces of a scan."""

    label: Labels  # (B, R) of each patch, -1 where it belongs to none
    planes: Array  # (K, 4) n.x + d = 0 in the world frame, |n| = 1
    noise_px: float  # what the flattest quarter of all small tiles is flat to

    def __len__(self) -> int:
        """Number of pieces K."""
        return len(self.planes)


def grow(points: Array, per_column: Array, patches: Patches, tolerance_px: float) -> Segments:
    """Flat pieces: small tiles, the flattest first, each grown over connected patches that its plane holds for.

    Args:
        points, per_column: (B, R, 3) as `located` gives them.
        patches: which patches neighbour across the closing of a full turn.
        tolerance_px: how far off its plane a patch may be [px].
    """
    label = np.full(points.shape[:2], -1, np.intp)
    tried = np.zeros(points.shape[:2], bool)
    known = np.isfinite(points[..., 0])
    tiles = _tiles(points, per_column, known, patches.step)
    planes: list[Array] = []
    noise = float(np.quantile([tile.rms_px for tile in tiles], 0.25)) if tiles else np.inf
    for tile in sorted(tiles, key=lambda t: t.rms_px):
        if tile.rms_px > tolerance_px:
            break
        if tried[tile.where].mean() > 0.3:
            continue
        grown = _grown(points, per_column, known & (label < 0), tile, tolerance_px, patches.closed)
        tried[tile.where] = True
        if grown is None:
            continue
        member, plane = grown
        tried |= member
        size = (np.count_nonzero(member), np.count_nonzero(member.any(axis=1)), np.count_nonzero(member.any(axis=0)))
        if all(have >= want for have, want in zip(size, SMALLEST, strict=True)):
            label[member] = len(planes)
            planes.append(plane)
    return Segments(label, np.array(planes).reshape(-1, 4), noise)


def beside(points: Array, per_column: Array, plane: Array) -> Array:
    """Columns (...,) that points (..., 3) lie beside their plane (4,) or (..., 4), signed along the image."""
    height = np.einsum("...i,...i->...", points, plane[..., :3])
    columns: Array = (height + plane[..., 3]) / steepness(per_column, plane[..., :3])
    return columns


def steepness(per_column: Array, normal: Array) -> Array:
    """How far (...,) a column moves points along the normal of their plane (..., 3) [m/px], signed, never nothing."""
    along = np.einsum("...i,...i->...", per_column, normal)
    least = GRAZING * np.sqrt(np.einsum("...i,...i->...", per_column, per_column))
    steep: Array = np.copysign(np.maximum(np.abs(along), least), along)
    return steep


def near_another(points: Array, per_column: Array, segments: Segments, reach_px: float) -> Mask:
    """Patches (B, R) of a piece that another piece's plane, at an angle to their own, holds for too: along the corners.

    They may lie on either surface, and taken for the wrong one they bend it.
    """
    shot, row = np.nonzero(segments.label >= 0)
    own = segments.planes[segments.label[shot, row], :3]
    p, slope = points[shot, row], per_column[shot, row]
    close = np.zeros(len(shot), bool)
    for plane in segments.planes:
        close |= (np.abs(own @ plane[:3]) < np.cos(CORNER)) & (np.abs(beside(p, slope, plane)) < reach_px)
    near = np.zeros(segments.label.shape, bool)
    near[shot, row] = close
    return near


def fitted_plane(points: Array, per_column: Array, normal: Array | None = None, rounds: int = 1) -> Array:
    """Plane (4,) through points (N, 3), weighted by what a column means along the normal."""
    weight = np.ones(len(points))
    for _ in range(rounds + 1):
        if normal is not None:
            weight = steepness(per_column, normal) ** -2
        centre = weight @ points / weight.sum()
        q = points - centre
        normal = np.linalg.eigh((q * weight[:, None]).T @ q)[1][:, 0]
    assert normal is not None
    return np.append(normal, -normal @ centre)


class _Tile(NamedTuple):
    """A few neighbouring patches, the seed of a piece."""

    where: tuple[slice, slice]
    plane: Array  # (4,)
    rms_px: float


def _tiles(points: Array, per_column: Array, known: Mask, step: float) -> list[_Tile]:
    """All tiles that are at least 70 % full, half overlapping, with the plane through each."""
    shots, rows = known.shape
    wide = int(np.clip(round(TILE_TURN / max(step, 1e-6)), 3, 8))
    if shots < wide or rows < TILE_ROWS:
        return []
    i = np.arange(0, shots - wide + 1, max(1, wide // 2))
    j = np.arange(0, rows - TILE_ROWS + 1, max(1, TILE_ROWS // 2))
    at = (i[:, None, None, None] + np.arange(wide)[:, None], j[None, :, None, None] + np.arange(TILE_ROWS))
    some = np.argwhere(known[at].mean(axis=(2, 3)) >= 0.7)
    if not len(some):
        return []
    tile_shot = i[some[:, 0], None, None] + np.arange(wide)[:, None]
    tile_row = j[some[:, 1], None, None] + np.arange(TILE_ROWS)
    shot, row = (axis.reshape(len(some), -1) for axis in np.broadcast_arrays(tile_shot, tile_row))
    here = known[shot, row]
    p, slope = np.where(here[..., None], points[shot, row], 0.0), np.where(here[..., None], per_column[shot, row], 1.0)
    plane = _batch_planes(p, here.astype(float))
    weight = here / steepness(slope, plane[:, None, :3]) ** 2
    plane = _batch_planes(p, weight)
    off = np.where(here, beside(p, slope, plane[:, None, :]), 0.0)
    rms = np.sqrt((off**2).sum(axis=1) / here.sum(axis=1))
    return [
        _Tile((slice(i[a], i[a] + wide), slice(j[b], j[b] + TILE_ROWS)), plane[k], float(rms[k]))
        for k, (a, b) in enumerate(some)
    ]


def _batch_planes(points: Array, weight: Array) -> Array:
    """Planes (T, 4) through T sets of points (T, N, 3) with weights (T, N)."""
    centre = np.einsum("tn,tni->ti", weight, points) / weight.sum(axis=1)[:, None]
    q = points - centre[:, None]
    normal = np.linalg.eigh(np.einsum("tn,tni,tnj->tij", weight, q, q))[1][:, :, 0]
    return np.concatenate([normal, -(normal * centre).sum(axis=1)[:, None]], axis=1)


def _grown(
    points: Array, per_column: Array, free: Mask, tile: _Tile, tolerance_px: float, closed: bool
) -> tuple[Mask, Array] | None:
    """The connected patches of `free` that one plane holds for, from a tile on; and that plane."""
    plane, member = tile.plane, np.zeros_like(free)
    for _ in range(6):
        with np.errstate(invalid="ignore"):
            holds = free & (np.abs(beside(points, per_column, plane)) < tolerance_px)
        pieces = _connected(holds, closed)
        inside = pieces[tile.where][pieces[tile.where] > 0]
        if inside.size < TILE_ROWS:
            return None
        before, member = member, pieces == np.bincount(inside).argmax()
        if np.count_nonzero(before ^ member) < 0.01 * np.count_nonzero(member):
            break
        plane = fitted_plane(points[member], per_column[member], plane[:3])
    return member, plane


def _connected(mask: Mask, closed: bool) -> NDArray[np.int32]:
    """Numbers of the connected parts of a mask (B, R), 0 outside; over the closing of a full turn too."""
    from scipy import ndimage

    part: NDArray[np.int32] = ndimage.label(mask)[0]
    if closed:
        same = np.arange(part.max() + 1, dtype=part.dtype)
        for a, b in {(int(x), int(y)) for x, y in zip(part[0], part[-1], strict=True) if x and y}:
            same[same == max(same[a], same[b])] = min(same[a], same[b])
        part = same[part]
    return part
