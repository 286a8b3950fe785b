"""What stands still while the head turns is no laser line: tubes of light, blinds, stripes, spines of books, print.

One picture cannot always tell a tube of light from the line. A sweep can: its other pictures show the same places
without the laser, as a laser-off frame would, but from elsewhere. Where a place of one picture is seen in another
depends on its distance. So for a row of distances it is asked how many of the other pictures show something about as
high there. At the true distance of a tube of light nearly all do. Where the laser met a surface they show the surface
without it: the line lies in one direction in two bearings only if a surface contains the camera's ray, and such a
surface returns nothing.

A thing that the laser itself meets is higher there than elsewhere, and is the line. Where both are cut at white
nothing tells them apart, and the place is no line.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.laserline import BLOCK

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

_FIRST = 1  # of BLOCK image rows stands for all of them
_NEAREST_M = 0.5  # things are looked for from here, off the axis, to infinity
_WITHIN_PX = 2  # how exactly a place is met
_TURN = float(np.radians(30.0))  # between two pictures, over which distances are told apart so exactly
_MOST_DISTANCES = 48
_COARSE = 8  # times fewer distances, and places met so much less exactly, tell most of the line at once
_APART = float(np.radians(1.9))  # pictures nearer to each other show the line in one place, if a far one
_VIEWS, _FARTHEST = 12, float(np.radians(45.0))  # other pictures that are asked, and how far round they are
_LEAST_VIEWS = 3
_NOISE = 2.0  # [grey levels] of ridges; the dimmest line that counts has more, for it must exceed its own noise sixfold
SHARE = 0.6  # of the other pictures that must show what stands still
_ROUNDING = 1e-3  # of sums of shares
_PART = 0.5  # of its height that a thing has in every picture
_TOGETHER = 2  # rows of ridges before and after one that are asked with it
_RUN_PX = 16.0  # that a line runs from one to the next, at most
_PLACES_SHARE, _LEAST_HEIGHT, _MAXIMUM_PX = 0.5, 6, 13  # of places to be masked: see `mask`
_AT_ONCE = 1 << 16  # places in other pictures that are computed together, which fit into the processor's cache
_AROUND_PX = 7  # columns on either side of a thing in which the line is not looked for; and one row of ridges


# Rows and columns of N pixels [px], and how high something must be there in other pictures [grey levels]; arrays (N,).
_Places = tuple[Index, F64, F64]


class _View(NamedTuple):
    """Ridges of one picture, the highest within reach of each place: (ceil(H / BLOCK), W)."""

    fine: U8
    coarse: U8


class StillThings:
    """What the pictures of a sweep show beside the line, and which of it stands still."""

    def __init__(self, calibration: Calibration) -> None:
        own = self._own = calibration.intrinsics
        self._T_axis_camera = calibration.mount.T_axis_head() @ calibration.T_head_camera
        parallax = 2.0 * np.hypot(*self._T_axis_camera[:2, 3]) * np.sin(0.5 * _TURN) * own.fx / _NEAREST_M
        distances = int(np.clip(np.ceil(parallax / (2 * _WITHIN_PX)), 8, _MOST_DISTANCES))
        self._inverse = np.linspace(0.0, 1.0 / _NEAREST_M, distances + 1)
        self._few = np.linspace(0.0, 1.0 / _NEAREST_M, -(-distances // _COARSE) + 1)
        corner = np.array([0.0, own.width - 1.0]), np.array([0.0, own.height - 1.0])
        rays = own.rays(*(values.ravel() for values in np.meshgrid(*corner)))
        self._widest = 1.05 * float((np.hypot(rays[:, 0], rays[:, 1]) / rays[:, 2]).max())  # tangent; lenses fold over
        self._views: dict[float, _View] = {}  # by bearing

    def add(self, bearing: float, ridges: U8) -> None:
        """Note what the picture taken at `bearing` [rad] shows, as `laserline.ridges` has it."""
        fine, coarse = (
            np.asarray(cv2.dilate(ridges, np.ones((1, 2 * reach + 1), np.uint8)), np.uint8)
            for reach in (_WITHIN_PX, _COARSE * _WITHIN_PX + 1)
        )
        self._views[bearing] = _View(fine, coarse)

    def line(self, bearing: float, column: F32 | F64, ridge: F32 | F64, share: float | F64 = SHARE) -> Mask:
        """Which rows (H,) of the line found in a picture taken at `bearing` [rad] show what stands still.

        Args:
            column: (H,) [px] NaN where none.
            ridge: (H,) as `laserline.ridge_of` has it [grey levels].
            share: of the other pictures, which must agree; one for all rows, or (H,).
        """
        row = np.arange(_FIRST, len(column), BLOCK)
        row = row[np.isfinite(column[row])]
        still = np.zeros(len(column), bool)
        if not row.size:
            return still
        at = column[row].astype(np.float64)
        least = _PART * ridge[row].astype(np.float64)
        if (own := self._views.get(bearing)) is not None:
            least = np.minimum(least, _PART * own.fine[row // BLOCK, np.rint(at).astype(np.intp)])
        least = np.maximum(least, _NOISE)
        broken = (np.diff(row, prepend=row[0]) > 2 * BLOCK) | (np.abs(np.diff(at, prepend=at[0])) > _RUN_PX)
        run = np.cumsum(broken, dtype=np.intp)
        shares: F64 = np.broadcast_to(share, column.shape)[row]
        stands = self._standing(bearing, (row, at, least), run, shares, coarse=True)
        # What stands may, and what is asked with it.
        doubtful = np.flatnonzero(np.convolve(stands, np.ones(2 * _TOGETHER + 1))[_TOGETHER:-_TOGETHER])
        some = row[doubtful], at[doubtful], least[doubtful]
        stands[doubtful] = self._standing(bearing, some, run[doubtful], shares[doubtful], coarse=False)
        # What is true of a row is true of those around it on the same line.
        asked = np.full(-(-len(column) // BLOCK), -1)
        asked[row // BLOCK] = np.arange(len(row))
        of = asked[np.arange(len(column)) // BLOCK]
        with np.errstate(invalid="ignore"):
            near = np.abs(column - at[of]) < _RUN_PX
        still |= (of >= 0) & near & stands[of]
        return still

    def _standing(self, bearing: float, places: _Places, run: Index, share: F64, *, coarse: bool) -> Mask:
        """Which of the places (N,) stand still, asked together with those next to them in the same run (N,)."""
        index = np.arange(len(run))
        if not index.size:
            return np.zeros(0, bool)
        first = np.maximum(index - _TOGETHER, np.searchsorted(run, run))
        stop = np.minimum(index + _TOGETHER + 1, np.searchsorted(run, run, side="right"))
        seen, agreed = self._agreement(bearing, places, coarse)
        enough = _between(agreed - share.astype(np.float32) * seen, first, stop) >= -_ROUNDING
        return np.asarray(np.any((_between(seen, first, stop) >= _LEAST_VIEWS * (stop - first)) & enough, axis=0))

    def mask(self, bearing: float, ridges: U8) -> Mask:
        """Where a picture taken at `bearing` [rad], of these `ridges`, shows what stands still (ceil(H / BLOCK), W)."""
        highest = cv2.dilate(ridges, np.ones((1, _MAXIMUM_PX), np.uint8))
        i, u = np.nonzero((ridges == highest) & (ridges >= _LEAST_HEIGHT))
        things = np.zeros(ridges.shape, np.uint8)
        if not i.size:
            return things.astype(bool)
        row = np.minimum(i * BLOCK + _FIRST, self._own.height - 1)
        places = row, u.astype(np.float64), _PART * ridges[i, u].astype(np.float64)
        seen, agreed = self._agreement(bearing, places)
        stands = np.zeros(len(i), bool)
        # Places close by at the same distance are asked together.
        cells = (len(ridges), ridges.shape[1] // 4 + 1)
        cell = np.ravel_multi_index((i, u // 4), cells)
        one = _around(np.ones(len(i)), cell, cells)
        for s, a in zip(seen, agreed, strict=True):
            views = _around(s, cell, cells)
            stands |= (views >= _LEAST_VIEWS * one) & (_around(a, cell, cells) >= _PLACES_SHARE * views)
        things[i[stands], u[stands]] = 1
        return np.asarray(cv2.dilate(things, np.ones((3, 2 * _AROUND_PX + 1), np.uint8)), np.uint8).astype(bool)

    def _agreement(self, bearing: float, places: _Places, coarse: bool = False) -> tuple[F32, F32]:
        """How many other pictures see where N places would be, at each distance, and in how many something is there.

        Args:
            places: of the picture taken at `bearing` [rad].
            coarse: at few distances, and anywhere near.

        Returns:
            both (distances, N).
        """
        row, column, least = places
        R, centre = self._T_axis_camera[:3, :3], self._T_axis_camera[:3, 3]
        ray = self._own.rays(column, row.astype(np.float64)) @ R.T
        ray /= np.hypot(ray[:, 0], ray[:, 1])[:, None]
        w = (self._few if coarse else self._inverse)[:, None]
        # The ray passes the axis at a distance, and the camera stands beyond that point; 1/w is the place's own.
        passing, beyond = centre[0] * ray[:, 1] - centre[1] * ray[:, 0], ray[:, :2] @ centre[:2]
        along = np.sqrt(np.maximum(1.0 - (passing * w) ** 2, 0.0)) - beyond * w
        # In units of that distance, so that infinity is one of them; (3, distances N).
        place = (centre * w[..., None] + ray * along[..., None]).reshape(-1, 3).T
        seen, agreed = np.zeros(along.shape, np.float32), np.zeros(along.shape, np.float32)
        others = self._others(bearing)
        together = max(_AT_ONCE // along.size, 1)
        for k in range(0, len(others), together):
            some = others[k : k + together]
            turn = np.array([turn for turn, _ in some])
            c, s, zero = np.cos(turn), np.sin(turn), np.zeros(len(turn))
            back = np.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1.0]]).transpose(2, 0, 1)
            # (views, distances N, 3), one coordinate after the other in memory.
            from_camera = ((back @ R).transpose(0, 2, 1) @ place).transpose(0, 2, 1)
            from_camera -= (centre @ R) * np.repeat(w, len(row), axis=0)
            x, y, z = (from_camera[..., i] for i in range(3))
            u, v = np.moveaxis(self._own.project(from_camera), -1, 0)
            inside = (u >= 0.0) & (u <= self._own.width - 1.0) & (v >= 0.0) & (v <= self._own.height - 1.0)
            inside &= (x * x + y * y < np.square(self._widest * z)) & (along.ravel() > 0.0)
            i, j = (np.rint(np.where(inside, values, 0.0)).astype(np.intp) for values in (v, u))
            at = i // BLOCK * self._own.width + j
            views = (view.coarse if coarse else view.fine for _, view in some)
            height = np.array([view.take(own) for view, own in zip(views, at, strict=True)])
            shown = (height.reshape(-1, *along.shape) >= least) & inside.reshape(-1, *along.shape)
            seen += inside.sum(axis=0).reshape(along.shape)
            agreed += shown.sum(axis=0)
        return seen, agreed

    def _others(self, bearing: float) -> list[tuple[float, _View]]:
        """The nearest views from other bearings, and how far the head turns to them [rad]."""
        turns = [((b - bearing + np.pi) % (2.0 * np.pi) - np.pi, view) for b, view in self._views.items()]
        others = [(turn, view) for turn, view in turns if _APART <= abs(turn) <= _FARTHEST]
        return sorted(others, key=lambda other: (abs(other[0]), other[0]))[:_VIEWS]


def _between(counts: F32, first: Index, stop: Index) -> F64:
    """Sums (..., N) of counts from `first` up to `stop` (N,)."""
    total = np.zeros((len(counts), counts.shape[1] + 1))
    np.cumsum(counts, axis=1, out=total[:, 1:])
    sums: F64 = total[:, stop] - total[:, first]
    return sums


def _around(values: F32 | F64, cell: Index, cells: tuple[int, int]) -> F32:
    """The sums over 3 x 3 cells around each of N values."""
    total = np.bincount(cell, values, minlength=cells[0] * cells[1]).astype(np.float32).reshape(cells)
    near = cv2.boxFilter(total, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(near.ravel()[cell], np.float32)
