"""Verdicts over the whole line: what a row alone cannot know of itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.pictures import by_picture

Array = NDArray[np.float64]
F32 = NDArray[np.float32]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

NO_BLOB_PX = 2.3  # what is no wider, as sigma, can be a line at any resolution
_NEAR = 140.0  # [grey levels] what is brighter can be a near line, wide by its own light
# Sigma_px over width_px, and peak, of a row that is surely a line; and of one that may be, if noise allows no better.
_CERTAIN, _BRIGHT, _POSSIBLE = 0.06, 40.0, 0.15
_UNEVEN_PX, _UNEVEN_HEIGHT = 3.0, 14.0
_INNER = 8  # rows of a run long enough to have ends and an inside
_NEAR_ROWS = 6  # between the rows found above and below one that is too dim alone
GAP_ROWS = 2  # missing rows that do not end a run


def continuing(row: Index, column: F32, sigma: F32, good: Mask, dim: Mask, height: int) -> Index:
    """Which of N rows are too dim alone but lie where the rows found above and below say that the line is.

    Args:
        row: (N,) rising, of pictures of `height` rows below each other.
        column, sigma: (N,) [px].
        good, dim: (N,) rows found, and rows in question.
    """
    found, asked = good.nonzero()[0], dim.nonzero()[0]
    after = np.searchsorted(found, asked)
    inside = (after > 0) & (after < len(found))
    asked, before, after = asked[inside], found[after[inside] - 1], found[np.minimum(after[inside], len(found) - 1)]
    span = row[after] - row[before]
    share = (row[asked] - row[before]) / np.maximum(span, 1)
    off = column[asked] - (column[before] + share * (column[after] - column[before]))
    spread = np.sqrt(sigma[asked] ** 2 + 0.5 * (sigma[before] ** 2 + sigma[after] ** 2))
    near = (row[before] // height == row[after] // height) & (span <= _NEAR_ROWS)
    near &= (np.abs(column[after] - column[before]) < 3.0 + span) & (np.abs(off) < 3.0 * spread)
    return np.asarray(asked[near], np.intp)


def numbered(row: Index, column: Array, gap: int, height: int) -> Index:
    """Number (N,) of the run that each of the rows (N,), rising, belongs to: no more than `gap` rows and 3 px a step.

    Args:
        row: (N,) of pictures of `height` rows below each other.
        column: (N,) [px].
    """
    run = np.zeros(len(row), np.intp)
    np.cumsum(_breaks(row, column, gap, height), out=run[1:])
    return run


def _breaks(row: Index, column: Array, gap: int, height: int) -> Mask:
    """Whether a run ends between each of the rows (N,) and the next, (N - 1,)."""
    broken: Mask = (row[1:] - row[:-1] > gap) | ~(np.abs(column[1:] - column[:-1]) < 3.0)
    if height <= row[-1]:
        picture = row // height
        broken |= picture[1:] != picture[:-1]
    return broken


def blobs(column: Array, width: Array, peak: Array, sigma: Array, noise: Array) -> Mask:
    """Rows (P H,) far wider across the line than the sharpest good part of it, unless near and therefore bright.

    One beam has one width, which grows toward near things as the light does; what is wide and dim is a thing in
    the room. The width across a slanted line is its width in the row times the cosine of the slant.

    Args:
        column, width, peak, sigma: (P H,) of P pictures below each other.
        noise: (P,) of a sample in each [grey levels].
    """
    mask = np.zeros(len(column), bool)
    with np.errstate(invalid="ignore"):
        if not (width > NO_BLOB_PX).any():
            return mask
    pictures, rows = len(noise), len(column) // len(noise)
    found = np.isfinite(column).nonzero()[0]
    picture = found // rows
    slope = np.zeros((pictures, rows))
    by_row = column.reshape(pictures, rows)
    slope[:, 1:-1] = 0.5 * (by_row[:, 2:] - by_row[:, :-2])
    slope = slope.ravel()[found]
    slope = np.where(np.abs(slope) < 4.0, slope, 0.0)
    wide, height, sigma = width[found], peak[found], sigma[found]
    # Known as well as the noise allows, or simply well.
    bound = 1.062 * np.sqrt(wide) * np.maximum(noise, 1.0)[picture] / height
    certain = (sigma < np.minimum(np.maximum(1.3 * bound, _CERTAIN * wide), _POSSIBLE * wide)) | (height > _BRIGHT)
    across, strong = wide / np.sqrt(1.0 + slope**2), height > 10.0 * sigma
    for own in by_picture(picture, pictures):
        lost = _blobs_of_one(wide[own], across[own], height[own], strong[own], certain[own])
        mask[found[own][lost]] = True
    return mask


def _blobs_of_one(wide: Array, across: Array, height: Array, strong: Mask, certain: Mask) -> Mask:
    """The same for the rows found (N,) of one picture, wide and across the line's own slant."""
    if np.count_nonzero(certain) < 0.25 * len(certain):
        # Nothing here is surely a line, and what is wide is the room's.
        return np.asarray(wide > NO_BLOB_PX)
    good, bright = across[strong], height[strong]
    if len(good) < 20:
        return np.zeros(len(wide), bool)
    good.partition(int(0.4 * len(good)))
    bright.partition(len(bright) // 2)
    sharp, usual = good[int(0.4 * len(good))], bright[len(bright) // 2]
    blob: Mask = (across > max(2.2 * sharp + 0.5, NO_BLOB_PX)) & (height < _NEAR)
    blob |= (across > max(1.5 * sharp + 0.3, NO_BLOB_PX)) & (height < min(0.25 * usual, _NEAR))
    # As wide and dim as the unevenness of a wall.
    blob |= (across > _UNEVEN_PX) & (height < _UNEVEN_HEIGHT)
    return blob


def frayed(column: Array, width: Array, peak: Array, sigma: Array, rows: int) -> Mask:
    """Rows (P H,) at depth edges in which a part of the beam was taken for the line.

    Args:
        column, width, peak, sigma: (P H,) of pictures of `rows` rows below each other.

    These are ends of a run that are dim and have another width than the rows further in.
    """
    mask = np.zeros(len(column), bool)
    found = np.isfinite(column).nonzero()[0]
    if not found.size:
        return mask
    broken = _breaks(found, column[found], 1, rows)
    edges = np.concatenate([[0], broken.nonzero()[0] + 1, [len(found)]])
    long = edges[1:] - edges[:-1] >= _INNER
    for end, inward in ((edges[:-1][long], 1), (edges[1:][long] - 1, -1)):
        inner = found[end[:, None] + inward * np.arange(3, 6)]
        usual, bright = width[inner].sum(axis=1) / 3.0, peak[inner].sum(axis=1) / 3.0
        for k in range(2):
            row = found[end + inward * k]
            odd = np.abs(width[row] - usual) > 0.3 * usual + 2.0 * sigma[row]
            mask[row[odd & (peak[row] < 0.6 * bright)]] = True
    return mask


def crumbs(column: Array, weak: Mask, rows: int, least: int = 12, fewest: int = 4) -> Mask:
    """Short runs of rows (P H,), of pictures of `rows` rows, that no neighbour on either side continues.

    Of fewer than `fewest` always, and of fewer than `least` if most are `weak` (P H,).
    """
    mask = np.zeros(len(column), bool)
    found = np.isfinite(column).nonzero()[0]
    if not found.size:
        return mask
    broken = _breaks(found, column[found], GAP_ROWS + 1, rows)
    edges = np.concatenate([[0], broken.nonzero()[0] + 1, [len(found)]])
    length = edges[1:] - edges[:-1]
    lost = length < least
    if lost.any():
        doubtful = np.add.reduceat(weak[found], edges[:-1], dtype=np.intp) > 0.5 * length
        lost &= doubtful | (length < fewest)
        mask[found[lost.repeat(length)]] = True
    return mask
