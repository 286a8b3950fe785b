"""Find a plain chessboard, or as much of it as is in the picture, as a grid of corners."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.shot import Image

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# [px] a chessboard is looked for in pictures of about this size, at a glance and thoroughly.
LOOKED_AT_PX, THOROUGHLY_PX = 1600, 800
# A grid is only grown up to this many corners each way: no board has more.
CORNERS_MOST = 41
# Where a corner's four squares are looked at: this far from it [squares] along both directions.
QUADRANTS = (0.2, 0.3, 0.4)
# The same over whole squares, which only a grid without gap or shear has of one colour.
WHOLE_SQUARES = (0.2, 0.5, 0.8)
DIAGONALS = ((1, 1), (-1, -1), (1, -1), (-1, 1))  # of a corner's squares: two of one colour, two of the other
# Both light squares at a corner are lighter than both dark ones by this share of what lies between them all.
CHEQUERED = 0.35
# [grey levels] between light and dark squares: less is noise.
FAINT_DN = 8.0
# Of the grid's median contrast.
CONTRAST_LEAST = 0.25
# [squares] a corner may lie from where its neighbours put it.
BESIDE_MOST = 0.2
# Corners that a piece of a board has, to begin with: asked for more, OpenCV is less often led astray by clutter.
PIECES = ((3, 3), (5, 3), (6, 3))
# A grid with fewer corners may be anything with right angles in it.
CERTAIN_CORNERS = 12


class Grid(NamedTuple):
    """Corners of a chessboard by their place in it; NaN where one is not seen."""

    corners: Array  # (rows, columns, 2) column, row [px]

    @property
    def shape(self) -> tuple[int, int]:
        """Corners along its columns and rows."""
        return self.corners.shape[1], self.corners.shape[0]

    @property
    def seen(self) -> Mask:
        """(rows, columns) which corners are."""
        return np.isfinite(self.corners[..., 0])

    def wide(self) -> Grid:
        """The same with its longer side along the columns."""
        across, down = self.shape
        return self if across >= down else Grid(np.ascontiguousarray(self.corners.transpose(1, 0, 2)))


def find_whole(grey: Image, across: int, down: int, *, thorough: bool = False) -> Grid | None:
    """A chessboard of `across` x `down` corners, all of them in sight; None if there is none.

    A thorough look, at a smaller picture, costs a hundred times as much on clutter.
    Source: Duda and Frese, "Accurate detection and localization of checkerboard corners for calibration", BMVC 2018.
    """
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER | (cv2.CALIB_CB_EXHAUSTIVE if thorough else 0)
    grid = _looked_for(grey, (across, down), flags, THOROUGHLY_PX if thorough else LOOKED_AT_PX)
    if grid is None or set(grid.shape) != {across, down}:
        return None
    # The outline of a smaller board before a dark table can pass for one more row.
    if trimmed(grey, grid).shape != grid.shape:
        return None
    return grid if grid.shape == (across, down) else Grid(grid.corners.transpose(1, 0, 2))


def find_part(grey: Image, *, thorough: bool = False) -> Grid | None:
    """As much of a chessboard of any size as can be seen: cut off, covered, in glare; None if it may be no chessboard.

    From a piece that is surely found the grid is grown corner by corner, each where its neighbours put it.
    """
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER | (cv2.CALIB_CB_EXHAUSTIVE if thorough else 0)
    for size in PIECES:
        piece = _looked_for(grey, size, flags, THOROUGHLY_PX)
        seed = _sound(grey, piece) if piece is not None else None
        grid = trimmed(grey, grown(grey, seed)) if seed is not None else None
        if grid is not None and grid.seen.sum() >= CERTAIN_CORNERS:
            return grid
    return None


def _sound(grey: Image, piece: Grid) -> Grid | None:
    """The piece or a window of it that surely is a grid: OpenCV's may leave rows out, or go on a column beside."""
    if _is_grid(grey, piece.corners):
        return piece
    across, down = piece.shape
    for rows, columns in ((3, 3), (2, 3), (3, 2)):
        for top, left in product(range(down - rows + 1), range(across - columns + 1)):
            window = piece.corners[top : top + rows, left : left + columns]
            if _is_grid(grey, window):
                return Grid(window)
    return None


def _is_grid(grey: Image, corners: Array) -> bool:
    """Whether the squares around all corners (rows, columns, 2) are light and dark in turn, each all over."""
    samples = [np.array(_samples(grey, corners, *side, WHOLE_SQUARES)) for side in DIAGONALS]
    one, other = np.concatenate(samples[:2]), np.concatenate(samples[2:])
    odd = np.indices(corners.shape[:2]).sum(axis=0) % 2 == 1
    one, other = np.where(odd, other, one), np.where(odd, one, other)
    lighter, darker = one.min(axis=0) - other.max(axis=0), other.min(axis=0) - one.max(axis=0)
    return bool((lighter > FAINT_DN).all() or (darker > FAINT_DN).all())


def grown(grey: Image, piece: Grid) -> Grid:
    """The grid with every corner around it that is one."""
    across, down = piece.shape
    if max(across, down) > CORNERS_MOST:
        return piece
    room = np.full((down + 2 * CORNERS_MOST, across + 2 * CORNERS_MOST, 2), np.nan)
    room[CORNERS_MOST : CORNERS_MOST + down, CORNERS_MOST : CORNERS_MOST + across] = piece.corners
    tried = np.zeros(room.shape[:2], np.bool_)
    while True:
        seen = np.isfinite(room[..., 0])
        beside = cv2.dilate(seen.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & ~seen & ~tried
        if not beside.any() or max(np.ptp(np.nonzero(seen), axis=1)) >= CORNERS_MOST - 1:
            break
        added = [at for at in zip(*np.nonzero(beside), strict=True) if _add(grey, room, at)]
        # A corner that was not found may be when more of its neighbours are known.
        tried |= beside if not added else np.zeros_like(beside)
    return _cropped(room)


def trimmed(grey: Image, grid: Grid) -> Grid:
    """The grid without outer rows and columns whose corners are none: where not two squares of each colour meet."""
    corners = grid.corners.copy()
    corners[~chequered(grey, grid)] = np.nan
    seen = np.isfinite(corners[..., 0])
    top, bottom, left, right = 0, len(seen), 0, seen.shape[1]
    while bottom - top > 2 and right - left > 2:
        part = seen[top:bottom, left:right]
        sides = [part[0].mean(), part[-1].mean(), part[:, 0].mean(), part[:, -1].mean()]
        worst = int(np.argmin(sides))
        if sides[worst] >= 0.2:
            break
        top, bottom = top + (worst == 0), bottom - (worst == 1)
        left, right = left + (worst == 2), right - (worst == 3)
    return Grid(corners[top:bottom, left:right])


def chequered(grey: Image, grid: Grid) -> Mask:
    """(rows, columns) at which corners two light and two dark squares meet, the way round that most corners have."""
    corners = grid.corners
    level = np.array([_levels(grey, corners, *side) for side in DIAGONALS])
    with np.errstate(invalid="ignore"):
        light = np.minimum(level[0], level[1]) - np.maximum(level[2], level[3])
        dark = np.minimum(level[2], level[3]) - np.maximum(level[0], level[1])
    between = level.max(axis=0) - level.min(axis=0)
    sign = np.where(np.indices(between.shape).sum(axis=0) % 2 == 0, 1.0, -1.0)
    # How light the one diagonal is over the other; both ways round have the same sign over a whole board.
    lighter = np.where(light > 0, light, -np.maximum(dark, 0.0)) * sign
    lighter *= 1.0 if np.nansum(np.sign(lighter)) >= 0 else -1.0
    with np.errstate(invalid="ignore"):
        clear = between > CONTRAST_LEAST * np.nanmedian(between) if np.isfinite(between).any() else between > 0
        return np.asarray((lighter > CHEQUERED * between) & clear, np.bool_)


def _looked_for(grey: Image, size: tuple[int, int], flags: int, within: int) -> Grid | None:
    factor = max(1, round(max(grey.shape) / within))
    less = cv2.resize(grey, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA) if factor > 1 else grey
    seen, corners, meta = cv2.findChessboardCornersSBWithMeta(less, size, flags)
    if not seen or meta is None:
        return None
    # A pixel of the smaller picture is the mean of a block.
    whole = (np.asarray(corners, np.float64) + 0.5) * factor - 0.5
    return Grid(whole.reshape(meta.shape[0], meta.shape[1], 2))


def _levels(grey: Image, corners: Array, along: int, across: int) -> Array:
    """Mean grey level (rows, columns) of the square beside each corner in one direction; NaN where it is not known."""
    return np.asarray(sum(_samples(grey, corners, along, across, QUADRANTS)) / len(QUADRANTS) ** 2)


def _samples(grey: Image, corners: Array, along: int, across: int, at_shares: tuple[float, ...]) -> list[Array]:
    """Grey levels (rows, columns) at places in the square beside each corner in one direction; NaN where not known."""
    steps = [along * _steps(corners, 1), across * _steps(corners, 0)]
    height, width = grey.shape
    samples = []
    for a, b in product(at_shares, at_shares):
        at = corners + a * steps[0] + b * steps[1]
        outside = (at < 0).any(axis=-1) | (at > [width - 1, height - 1]).any(axis=-1)
        known = np.isfinite(at).all(axis=-1) & ~outside
        u, v = (np.where(known, at[..., k], 0.0).astype(np.float32) for k in (0, 1))
        samples.append(np.where(known, cv2.remap(grey, u, v, cv2.INTER_LINEAR), np.nan))
    return samples


def _steps(corners: Array, axis: int) -> Array:
    """(rows, columns, 2) from each corner to the next along an axis, from whichever neighbours are there."""
    step = np.diff(corners, axis=axis)
    none = np.full_like(np.take(corners, [0], axis=axis), np.nan)
    both = np.stack([np.concatenate([none, step], axis=axis), np.concatenate([step, none], axis=axis)])
    known = np.isfinite(both)
    count = known.sum(axis=0)
    typical = np.nanmedian(both.reshape(-1, 2), axis=0) if known.any() else np.full(2, np.nan)
    mean = np.where(known, both, 0.0).sum(axis=0) / np.maximum(count, 1)
    return np.where(count > 0, mean, typical)


def _add(grey: Image, room: Array, at: tuple[int, int]) -> bool:
    """Put the corner `at` into the grid if there is one where its neighbours want it."""
    row, column = at
    if not (3 <= row < len(room) - 3 and 3 <= column < room.shape[1] - 3):
        return False
    near = room[row - 3 : row + 4, column - 3 : column + 4]
    known = np.isfinite(near[..., 0])
    if known.sum() < 6:
        return False
    cells = np.argwhere(known)[:, ::-1].astype(np.float64) - 3.0
    H, _ = cv2.findHomography(cells, near[known])
    if H is None:
        return False
    around = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    expected = cv2.perspectiveTransform(around[:, None], H)[:, 0]
    square = float(np.linalg.norm(expected[1:] - expected[0], axis=1).min())
    height, width = grey.shape
    if square < 5.0 or not ((expected[0] > 3) & (expected[0] < [width - 4, height - 4])).all():
        return False
    half = int(np.clip(0.3 * square, 2, 12))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
    start = expected[:1].astype(np.float32)[:, None].copy()
    found = cv2.cornerSubPix(grey, start, (half, half), (-1, -1), criteria).reshape(2).astype(np.float64)
    if np.linalg.norm(found - expected[0]) > BESIDE_MOST * square:
        return False
    small = np.full((3, 3, 2), np.nan)
    small[1, 1], small[1, 2], small[2, 1] = found, found + expected[1] - expected[0], found + expected[2] - expected[0]
    if not _one_chequered(grey, small):
        return False
    room[row, column] = found
    return True


def _one_chequered(grey: Image, small: Array) -> bool:
    """Whether two light and two dark squares meet at the corner in the middle of `small` (3, 3, 2)."""
    level = np.array([_levels(grey, small, *side)[1, 1] for side in DIAGONALS])
    if not np.isfinite(level).all():
        return False
    between = float(np.ptp(level))
    clear = max(min(level[:2]) - max(level[2:]), min(level[2:]) - max(level[:2]))
    return bool(clear > CHEQUERED * between and between > FAINT_DN)


def _cropped(room: Array) -> Grid:
    rows, columns = np.nonzero(np.isfinite(room[..., 0]))
    return Grid(room[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1])
