"""What nothing in a picture tells from the line: ridges that go on beside what was taken for it, and crowds of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.candidates import BLOCK
from scanmap.laserline.path import stand_out
from scanmap.laserline.shares import heights_of
from scanmap.laserline.sight import Sight

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_STEP_PX = 18.0  # a line does not run farther than this from one row looked at to the next, two blocks on
_NEAR_PX = 9.0  # from where a ridge should go on, it may be
_MISSES = 2  # rows looked at in which a ridge may be missing
_LEAST = 3  # rows looked at of a piece
_TELLING = 5  # that tell how a piece goes on
_TURNS = 0.3  # what the last of them counts
_MOST = 0.7  # of a piece's rows looked at
_RIVAL = 0.3  # of the height of what was taken for the line, that a ridge which goes on beside it has
_SHORT = 0.15  # of the length of a piece, that what was taken of a ridge beside it is
_CROWD, _ALIKE = 3, 0.5  # other places in a row that are as high as this part of what was taken
_COLOUR = 0.25  # by which their share in other channels is larger at most


def contested(column: F64, places: Sequence[F32], sight: Sight) -> Mask:
    """Rows (P H,) in which something else may be the line as well as what was taken for it.

    Args:
        column: (P H,) of the lines of P pictures below each other [px], NaN where none.
        places: (ceil(H / 8), n) [px] for each picture: all that looks like a line in every other block of rows.
        sight: of the pictures.

    Where the line leaves a surface for another it is no longer seen on the first. If what was taken for it above or
    below goes on all the same, one of the two is a thing of the room. And many things alike in the same rows, as the
    gaps of a blind are, leave no choice. How bright they are tells nothing: lamps are brighter than lines, lines than
    print.
    """
    lines = column.reshape(-1, sight.height)
    doubtful = np.zeros(lines.shape, bool)
    # Most lines go on from the first row to the last with nothing like them beside.
    seen = lines[:, 1 :: 2 * BLOCK]
    uneven = ~(np.abs(seen[:, 1:] - seen[:, :-1]) <= _STEP_PX).all(axis=1)
    asked = uneven | np.array([listed.shape[1] > _CROWD for listed in places])
    for k, picture in enumerate(sight.pictures() if asked.any() else ()):
        if asked[k]:
            doubtful[k] = _contested(lines[k], places[k], picture)
    return doubtful.ravel()


def _contested(column: F64, places: F32, sight: Sight) -> Mask:
    """The same (H,) of one picture."""
    doubtful = np.zeros(len(places), bool)
    row = np.minimum(2 * BLOCK * np.arange(len(places)) + 1, len(column) - 1)
    own = column[row]
    own = np.where(np.isnan(own), column[np.minimum(row + 1, len(column) - 1)], own)
    pieces = _pieces(own)
    full = np.count_nonzero(np.isfinite(places), axis=1) > _CROWD
    for piece in pieces if full.any() else ():
        doubtful[piece] = full[piece].mean() > _MOST and _crowded(own[piece], places[piece], row[piece], sight)
    listed = places.tolist() if len(pieces) > 1 else []
    for piece, ahead in ((piece, ahead) for piece in pieces for ahead in (1, -1) if listed):
        at, ridge = _followed(own, listed, piece, ahead)
        apart = np.abs(ridge - own[at]) > _STEP_PX
        for other in pieces if apart.any() else ():
            inside = apart & (at >= other[0]) & (at <= other[-1])
            past = at[-1] >= other[-1] if ahead > 0 else at[-1] <= other[0]
            if past and np.count_nonzero(inside) > _MOST * len(other):
                rows = row[at[inside]]
                height, taken = (_heights(sight, rows, values[inside]) for values in (ridge, own[at]))
                if np.median(height) > _RIVAL * np.median(taken):
                    # A short piece of a ridge that was not taken beside a long one is likely none itself.
                    taken_of_it = len(piece) + np.count_nonzero(np.abs(ridge - own[at]) <= _STEP_PX)
                    doubtful[other if taken_of_it > _SHORT * len(other) else piece] = True
    return _rows_beside(column, own, doubtful)


def _pieces(column: F64) -> list[Index]:
    """The pieces of a line with columns (K,) in the rows looked at, by their indices (n,)."""
    at = np.flatnonzero(np.isfinite(column))
    broken = (np.diff(at) > _MISSES + 1) | (np.abs(np.diff(column[at])) > _STEP_PX)
    return [piece for piece in np.split(at, np.flatnonzero(broken) + 1) if len(piece) >= _LEAST]


def _followed(column: F64, listed: Sequence[Sequence[float]], piece: Index, ahead: int) -> tuple[Index, F64]:
    """Where a piece goes on as a ridge, down (1) or up (-1): rows looked at, by their indices (n,), and columns (n,).

    Args:
        column: (K,) of the line in the rows looked at.
        listed: (K, n) [px] all places there; NaN where there are fewer.
    """
    end = piece[-_TELLING:] if ahead > 0 else piece[:_TELLING][::-1]
    last, at = float(column[end[-1]]), int(end[-1])
    slope = (last - float(column[end[0]])) / (at - int(end[0]))
    rows, ridge = list[int](), list[float]()
    for k in range(at + ahead, len(listed) if ahead > 0 else -1, ahead):
        if abs(k - at) > _MISSES + 1:
            break
        course = last + slope * (k - at)
        near = [place for place in listed[k] if abs(place - course) <= _NEAR_PX]
        if near:
            place = min(near, key=lambda place: abs(place - course))
            slope += _TURNS * ((place - last) / (k - at) - slope)
            last, at = place, k
            rows.append(k)
            ridge.append(place)
    return np.array(rows, np.intp), np.array(ridge)


def _crowded(own: F64, places: F32, row: Index, sight: Sight) -> bool:
    """Whether in most rows (n,) many places (n, m) are about as high as the line's own (n,), and of its colour."""
    rows = np.repeat(row, places.shape[1])
    alike = np.abs(places - own[:, None]) > _STEP_PX
    alike &= _heights(sight, rows, places.ravel()).reshape(places.shape) > _ALIKE * _heights(sight, row, own)[:, None]
    share = _shares(sight, rows, places.ravel()).reshape(places.shape)
    alike &= share < np.median(_shares(sight, row, own)) + _COLOUR
    return bool((np.count_nonzero(alike, axis=1) >= _CROWD).mean() > _MOST)


def _heights(sight: Sight, row: Index, column: F64 | F32) -> F32:
    return stand_out(sight.lit, row, column.astype(np.float32), sight.noise)[1]


def _shares(sight: Sight, row: Index, column: F64 | F32) -> F32:
    """Height in other channels over that in the laser's, of places (N,); 0 where there is no colour."""
    if sight.image is None:
        return np.zeros(len(row), np.float32)
    height, _ = heights_of(sight.image, row, np.rint(np.nan_to_num(column)).astype(np.intp))
    other: F32 = np.maximum(height[sight.channel - 1], height[sight.channel - 2])
    share: F32 = other / np.maximum(height[sight.channel], np.float32(1.0))
    return share


def _rows_beside(column: F64, own: F64, doubtful: Mask) -> Mask:
    """The rows (H,) of a line beside those looked at (K,) that are doubtful."""
    rows = np.zeros(len(column), bool)
    for k in np.flatnonzero(doubtful):
        part = slice(max(2 * BLOCK * k - BLOCK, 0), 2 * BLOCK * (k + 1))
        rows[part] |= np.abs(column[part] - own[k]) < _STEP_PX
    return rows
