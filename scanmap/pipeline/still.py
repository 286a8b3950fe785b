"""What stands still while the head turns is no laser line: tubes of light, stripes, spines of books, print.

One picture cannot always tell a tube of light from the line. A sweep can. What belongs to the room is one point of the
world, and every bearing sees it in that place; the line lies in that direction in one bearing only, the one in which
the laser meets the thing itself. A surface that kept the line on one ray of the camera while the head turns would be
seen edge on, and return nothing.

A ray that passes the axis at a distance p (counter-clockwise) in the direction a is, at the distance 1/w from the
axis, at the azimuth a - asin(p w). So every line-like place of every picture votes, for a row of distances, for one
azimuth and one elevation; where enough bearings meet, something stands (Hough 1962). A second count, in which every
place votes only where it found most agreement, takes away what other rays happen to cross (Gerig 1987).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

ROWS, FIRST = 8, 1  # image rows to a row of places, and which of them was looked at; see `laserline.Look`
_NEAREST_M, _DISTANCES = 0.5, 20  # things are looked for from here to infinity, at so many distances
_CELL_PX = 3.0  # columns to a cell of azimuth; neighbours count as one place
_APART = float(np.radians(2.0))  # bearings nearer to each other see the same and vote once
_VOTES, _SHARE = 3, 0.4  # bearings that see a thing: at least so many, and this share of all that could
_COUNTS = 2
_AGREED = 0.75  # share of the most votes, at a distance that the thing may have
_OWN = 0.6  # part of those distances, around their middle, at which the laser may have met the thing itself
_BITS = 32
_AROUND_PX = 7  # columns on either side of a thing, and
_AROUND_BLOCKS = 2  # blocks of rows above and below, in which the line is not looked for


class _Rays(NamedTuple):
    """Camera rays of N pixels in the axis's frame, arrays (N,)."""

    azimuth: F32  # [rad]
    rise: F32  # tangent of the elevation
    passing: F32  # distance at which the ray passes the axis, counter-clockwise [m]
    before: F32  # how far the camera stands beyond that point, along the ray [m]


class _Votes(NamedTuple):
    """Every line-like place of every voting picture, arrays (N,)."""

    rays: _Rays  # at their bearings
    owner: Index  # which picture, rising


class StillThings:
    """Collects the line-like places of a sweep and says which of them stand still."""

    def __init__(self, calibration: Calibration, window: F64) -> None:
        """Make ready for the pictures of a head whose line lies within `window` (H, 2) [px]."""
        own = calibration.intrinsics
        self._calibration = calibration
        self._T_axis_camera = calibration.mount.T_axis_head() @ calibration.T_head_camera
        self._inverse = np.linspace(0.0, 1.0 / _NEAREST_M, _DISTANCES, dtype=np.float32)
        self._cell, self._rise_cell = _CELL_PX / own.fx, ROWS / own.fy
        self._rises = int(np.ceil(1.5 * max(own.cy, own.height - own.cy) / ROWS))
        self._azimuths = int(np.ceil(2.0 * np.pi / self._cell))
        middle = own.height // 2
        some = np.flatnonzero(np.isfinite(window[:, 0]))
        at = some[np.abs(some - middle).argmin()] if some.size else middle
        ends = np.nan_to_num(np.clip(window[at], 0.0, own.width - 1.0))
        self._ends = self._rays(ends, np.full(2, float(at)), 0.0)
        self._seen: dict[float, list[F32]] = {}  # by bearing
        self._bearings: list[float] = []  # those that vote
        self._counts = np.zeros((_DISTANCES, 0), np.uint8)
        self._votes: _Votes | None = None

    def add(self, bearing: float, places: F32) -> None:
        """Note the line-like places (ceil(H / ROWS), n) [px] of the picture taken at `bearing` [rad]."""
        self._seen.setdefault(bearing, []).append(places)

    def count(self) -> bool:
        """Count the votes of all that was added, in whatever order; whether anything stands still."""
        self._bearings = _apart(self._seen)
        self._votes = votes = self._all_votes()
        bit = np.left_shift(np.uint32(1), votes.owner.astype(np.uint32) % np.uint32(_BITS))
        cells = [self._cells(votes.rays, w) for w in self._inverse]
        voting = [good for _, good in cells]
        least = np.maximum(_VOTES, _SHARE * self._seen_by())
        self._counts = np.zeros((_DISTANCES, self._azimuths * 2 * self._rises), np.uint8)
        for _ in range(_COUNTS):
            self._counts[:] = 0
            for counts, (cell, _), good, limit in zip(self._counts, cells, voting, least, strict=True):
                self._count_one(counts, cell[good], bit[good], limit)
            agreed = np.array([np.where(ok, c[cell], 0) for c, (cell, ok) in zip(self._counts, cells, strict=True)])
            most = agreed.max(axis=0)
            voting = list((agreed == most) & (most > 0))
        return bool(self._counts.any())

    def stands(self, bearing: F64, row: Index, column: F64, distance: F64) -> Mask:
        """Whether pixels (N,) seen at `bearing` (N,) [rad] show what stands still, and not the laser on it.

        Args:
            row, column: (N,) [px].
            distance: (N,) from the axis [m], of the point that each would be as the laser line.
        """
        rays = self._rays(column, row.astype(np.float64), bearing)
        found = np.zeros((_DISTANCES, len(row)), np.uint8)
        for k, (counts, w) in enumerate(zip(self._counts, self._inverse, strict=True)):
            if counts.any():
                cell, good = self._cells(rays, w)
                found[k] = np.where(good, counts[cell], np.uint8(0))
        most = found.max(axis=0)
        # What agrees over a row of distances is most likely in their middle.
        agreed = found >= np.maximum(_AGREED * most, 1)
        low = self._inverse[agreed.argmax(axis=0)]
        high = self._inverse[_DISTANCES - 1 - agreed[::-1].argmax(axis=0)]
        own = 1.0 / np.maximum(distance, 1e-3)
        itself = np.abs(own - 0.5 * (low + high)) < _OWN * 0.5 * (high - low) + 1.5 * self._inverse[1]
        stands: Mask = (most > 0) & ~itself
        return stands

    def mask(self, bearing: float, block: int) -> Mask:
        """(ceil(H / block), W) where a picture taken at `bearing` [rad] shows what stands still."""
        own, T = self._calibration.intrinsics, self._T_axis_camera
        azimuth, rise, w = self._things()
        azimuth = azimuth - bearing
        direction = np.stack([np.cos(azimuth), np.sin(azimuth), rise], axis=-1) - w[:, None] * T[:3, 3]
        pixel = own.project(direction @ T[:3, :3])
        with np.errstate(invalid="ignore"):
            pixel = pixel[((pixel >= 0.0) & (pixel <= [own.width - 1.0, own.height - 1.0])).all(axis=1)]
        mask = np.zeros((-(-own.height // block), own.width), np.uint8)
        column, row = np.rint(pixel).astype(np.intp).T
        mask[row // block, column] = 1
        around = np.ones((2 * _AROUND_BLOCKS + 1, 2 * _AROUND_PX + 1), np.uint8)
        return np.asarray(cv2.dilate(mask, around), np.uint8).astype(bool)

    def _things(self) -> tuple[F64, F64, F64]:
        """Azimuth [rad], tangent of the elevation and inverse distance [1/m] of all that stands still, (M,)."""
        votes = self._votes or self._all_votes()
        most, at = np.zeros(len(votes.owner), np.uint8), np.zeros(len(votes.owner), np.intp)
        for k, (counts, w) in enumerate(zip(self._counts, self._inverse, strict=True)):
            cell, good = self._cells(votes.rays, w)
            count = np.where(good, counts[cell], np.uint8(0))
            better = count > most
            most[better], at[better] = count[better], k
        still = np.flatnonzero(most > 0)
        azimuth, rise, w = (np.empty(len(still)) for _ in range(3))
        for k in np.unique(at[still]):
            some = np.flatnonzero(at[still] == k)
            rays = _Rays(*(values[still[some]] for values in votes.rays))
            azimuth[some], rise[some], _ = self._seen_from_axis(rays, self._inverse[k])
            w[some] = self._inverse[k]
        # One of each place is enough.
        key = np.stack([np.rint(azimuth / self._cell), np.rint(rise / self._rise_cell), w])
        _, first = np.unique(key, axis=1, return_index=True)
        return azimuth[first], rise[first], w[first]

    def _all_votes(self) -> _Votes:
        owner, column, row = [], [], []
        for k, bearing in enumerate(self._bearings):
            places = np.concatenate(self._seen[bearing], axis=1)
            i, j = np.nonzero(np.isfinite(places))
            owner.append(np.full(len(i), k, np.intp))
            column.append(places[i, j].astype(np.float64))
            row.append(i * float(ROWS) + FIRST)
        if not owner:
            return _Votes(self._rays(np.empty(0), np.empty(0), 0.0), np.empty(0, np.intp))
        of = np.concatenate(owner)
        bearings = np.array(self._bearings)[of]
        return _Votes(self._rays(np.concatenate(column), np.concatenate(row), bearings), of)

    def _rays(self, column: F64, row: F64, bearing: F64 | float) -> _Rays:
        """The rays of pixels (N,) at `bearing` [rad]."""
        T = self._T_axis_camera
        x, y, z = np.moveaxis(self._calibration.intrinsics.rays(column, row) @ T[:3, :3].T, -1, 0)
        flat = np.hypot(x, y)
        (cx, cy), azimuth = T[:2, 3], np.arctan2(y, x) + bearing
        values = azimuth, z / flat, (cx * y - cy * x) / flat, (cx * x + cy * y) / flat
        return _Rays(*(v.astype(np.float32) for v in values))

    def _seen_from_axis(self, rays: _Rays, w: np.float32) -> tuple[F32, F32, Mask]:
        """Azimuth and tangent of the elevation (N,) of the rays' points at the distance 1/w; whether there is one."""
        sine = rays.passing * w
        with np.errstate(invalid="ignore"):
            along = np.sqrt(np.float32(1.0) - sine * sine) - rays.before * w
            azimuth = rays.azimuth - np.arcsin(sine)
        return azimuth, np.float32(self._T_axis_camera[2, 3]) * w + rays.rise * along, along > 0

    def _cells(self, rays: _Rays, w: np.float32) -> tuple[Index, Mask]:
        """Cell (N,) of azimuth and elevation of the rays' points at the distance 1/w, and whether there is one."""
        azimuth, rise, good = self._seen_from_axis(rays, w)
        with np.errstate(invalid="ignore"):
            row = np.floor(rise / np.float32(self._rise_cell)) + self._rises
            good &= (row >= 0) & (row < 2 * self._rises)
        column = np.floor(np.where(good, azimuth, 0.0) / self._cell).astype(np.intp) % self._azimuths
        return column * (2 * self._rises) + np.where(good, row, 0).astype(np.intp), good

    def _count_one(self, counts: U8, cell: Index, bit: NDArray[np.uint32], least: F64) -> None:
        """Write down how many bearings vote for each cell of one distance, where they are enough.

        Args:
            counts: of all cells, 0 so far.
            cell, bit: (N,) the votes, and the bit of the bearing each comes from.
            least: (azimuths,) votes that are enough.
        """
        votes = np.zeros(len(counts), np.uint32)
        np.bitwise_or.at(votes, cell, bit)
        beside = 2 * self._rises
        for at in (cell, (cell + beside) % len(votes), cell - beside):
            count = np.bitwise_count(votes[at] | votes[(at + beside) % len(votes)] | votes[at - beside])
            counts[at] = np.where(count >= least[at // beside], count, np.uint8(0))

    def _seen_by(self) -> F64:
        """How many bearings could see something (distances, azimuths)."""
        bearings, seen = np.array(self._bearings), np.empty((len(self._inverse), self._azimuths))
        for k, w in enumerate(self._inverse):
            low, high = np.sort(self._seen_from_axis(self._ends, w)[0])
            first, last = (np.floor((bearings + end) / self._cell).astype(np.intp) for end in (low, high))
            # Those who begin to see at each azimuth, less those who cease, from two turns made one.
            begin, cease = (first % self._azimuths, first % self._azimuths + last - first + 1)
            change = np.bincount(begin, minlength=2 * self._azimuths + 1) - np.bincount(
                cease, minlength=2 * self._azimuths + 1
            )
            seen[k] = change.cumsum()[: 2 * self._azimuths].reshape(2, -1).sum(axis=0)
        return seen


def _apart(bearings: Iterable[float]) -> list[float]:
    """Those of the bearings [rad] that see something new: not a second turn, nor what lies closely beside another."""
    turn = 2.0 * np.pi
    chosen: list[float] = []
    for bearing in sorted(bearings, key=lambda b: (b % turn, b)):
        if not chosen or bearing % turn - chosen[-1] % turn >= _APART:
            chosen.append(bearing)
    return chosen
