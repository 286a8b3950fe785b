"""Verdicts over the whole line: what a row alone cannot know of itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
_GAP_ROWS = 2  # missing rows that do not end a run


def continuing(row: Index, column: F32, sigma: F32, good: Mask, dim: Mask) -> Index:
    """Which of N rows are too dim alone but lie where the rows found above and below say that the line is.

    Args:
        row: (N,) rising.
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
    near = (span <= _NEAR_ROWS) & (np.abs(column[after] - column[before]) < 3.0 + span) & (np.abs(off) < 3.0 * spread)
    return np.asarray(asked[near], np.intp)


def numbered(row: Index, column: Array, gap: int) -> Index:
    """Number (N,) of the run that each of the rows (N,), rising, belongs to: no more than `gap` rows and 3 px a step.

    Args:
        column: (N,) [px].
    """
    run = np.zeros(len(row), np.intp)
    np.cumsum((row[1:] - row[:-1] > gap) | ~(np.abs(column[1:] - column[:-1]) < 3.0), out=run[1:])
    return run


def blobs(column: Array, width: Array, peak: Array, sigma: Array, noise: float) -> Mask:
    """Rows (H,) far wider across the line than the sharpest good part of it, unless near and therefore bright.

    One beam has one width, which grows toward near things as the light does; what is wide and dim is a thing in
    the room. The width across a slanted line is its width in the row times the cosine of the slant.
    """
    mask = np.zeros(len(column), bool)
    with np.errstate(invalid="ignore"):
        if not (width > NO_BLOB_PX).any():
            return mask
    found = np.isfinite(column).nonzero()[0]
    # Known as well as the noise allows, or simply well.
    bound = 1.062 * np.sqrt(width[found]) * max(noise, 1.0) / peak[found]
    known = np.minimum(np.maximum(1.3 * bound, _CERTAIN * width[found]), _POSSIBLE * width[found])
    certain = (sigma[found] < known) | (peak[found] > _BRIGHT)
    if certain.sum() < 0.25 * len(found):
        # Nothing here is surely a line, and what is wide is the room's.
        mask[found[width[found] > NO_BLOB_PX]] = True
        return mask
    strong = peak[found] > 10.0 * sigma[found]
    if strong.sum() < 20:
        return mask
    slope = np.zeros(len(column))
    slope[1:-1] = 0.5 * (column[2:] - column[:-2])
    slope = np.where(np.abs(slope) < 4.0, slope, 0.0)[found]
    across, height = width[found] / np.sqrt(1.0 + slope**2), peak[found]
    good, bright, middle = across[strong], height[strong], int(np.count_nonzero(strong)) // 2
    good.partition(int(0.4 * len(good)))
    bright.partition(middle)
    sharp, usual = good[int(0.4 * len(good))], bright[middle]
    blob = (across > max(2.2 * sharp + 0.5, NO_BLOB_PX)) & (height < _NEAR)
    blob |= (across > max(1.5 * sharp + 0.3, NO_BLOB_PX)) & (height < 0.25 * usual)
    # As wide and dim as the unevenness of a wall.
    blob |= (across > _UNEVEN_PX) & (height < _UNEVEN_HEIGHT)
    mask[found[blob]] = True
    return mask


def frayed(column: Array, width: Array, peak: Array, sigma: Array) -> Mask:
    """Rows (H,) at depth edges in which the light of two surfaces, or half of one's, was taken for the line.

    Ends of a run that are dim and have another width than the rows further in, and rows dimmer and wider than those
    two above and two below.
    """
    mask = np.zeros(len(column), bool)
    found = np.isfinite(column).nonzero()[0]
    if len(found) < _INNER:
        return mask
    at = column[found]
    broken = (found[1:] - found[:-1] > 1) | ~(np.abs(at[1:] - at[:-1]) < 3.0)
    edges = np.concatenate([[0], broken.nonzero()[0] + 1, [len(found)]])
    long = edges[1:] - edges[:-1] >= _INNER
    for end, inward in ((edges[:-1][long], 1), (edges[1:][long] - 1, -1)):
        inner = found[end[:, None] + inward * np.arange(3, 6)]
        usual, bright = width[inner].sum(axis=1) / 3.0, peak[inner].sum(axis=1) / 3.0
        for k in range(2):
            row = found[end + inward * k]
            odd = np.abs(width[row] - usual) > 0.3 * usual + 2.0 * sigma[row]
            mask[row[odd & (peak[row] < 0.6 * bright)]] = True
    wide = np.fmax(width[:-4], width[4:])
    bright = np.fmax(peak[:-4], peak[4:])
    with np.errstate(invalid="ignore"):
        shared = (width[2:-2] > 1.35 * wide + 0.1 + 4.0 * sigma[2:-2]) & (peak[2:-2] < 0.8 * bright)
        mask[2:-2] |= shared & (peak[2:-2] < _NEAR)
    return mask


def crumbs(column: Array, weak: Mask, least: int = 12) -> Mask:
    """Short runs of rows (H,) that no neighbour on either side continues.

    Of 3 rows always, and of fewer than `least` if most are `weak` (H,).
    """
    mask = np.zeros(len(column), bool)
    found = np.isfinite(column).nonzero()[0]
    if not found.size:
        return mask
    number = numbered(found, column[found], _GAP_ROWS + 1)
    rows = np.bincount(number)
    doubtful = np.bincount(number, weak[found]) > 0.5 * rows
    mask[found[((rows < 4) | (doubtful & (rows < least)))[number]]] = True
    return mask
