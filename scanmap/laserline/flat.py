"""What is as bright across as a painted strip: spines of books, stripes of cloth, legs of furniture."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.channel import SATURATED
from scanmap.laserline.grey import runs_at
from scanmap.laserline.runs import numbered

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_WIDE_PX = 1.6  # narrower profiles are blurred too much to have a flat top
_AT = 0.8  # standard deviations from the middle where a profile is asked; a Gaussian has 0.73 of its height there
_FLAT = 0.88  # of the height there from which on the top is flat
_NEARBY = 10  # rows of a run on either side of one that are asked with it
_LEAST_ROWS, _LEAST_ASKED = 4, 3
_ENOUGH_ROWS = 700
_MANY_ROWS, _FEWER = 100, 4  # of so many rows so many times fewer are asked first
_DOUBT = 0.05  # of the height that these may lack of flat for those around them to be asked
_SURE = 3.0  # standard errors of its mean that a stretch's flatness must exceed


def flat_tops(column: F64, width: F64, peak: F64, plane: U8, height: int) -> Mask:
    """Rows (P H,) in stretches whose profile is flat on top, as no unsaturated beam's is.

    Args:
        column, width, peak: (P H,) of the lines of P pictures below each other, NaN where none.
        plane: (P H, W) they were found in.
        height: rows of a picture, H.

    One row's samples scatter too much to say so; the mean of a stretch does not. Both sides are asked, and the higher
    background counts for each, so that a line on a step of brightness is not taken for a strip.
    """
    flat = np.zeros(len(column), bool)
    with np.errstate(invalid="ignore"):
        able = ((width > _WIDE_PX) & (peak < SATURATED)).reshape(-1, height)
    count = np.count_nonzero(able, axis=1)
    if count.sum() < _LEAST_ROWS:
        return flat
    # Of many rows some tell of all, and of most runs a few that they are not.
    step = 1 + count // _ENOUGH_ROWS
    few = _every(able, np.where(count < _MANY_ROWS, step, _FEWER * step))
    excess, top, _ = _profiles(plane, few, column, width)
    doubted = few[excess > -_DOUBT * top]
    if not doubted.size:
        return flat
    near = np.zeros(able.shape, np.uint8)
    near.ravel()[doubted] = 1
    near = np.asarray(cv2.dilate(near, np.ones((1, 4 * _NEARBY + 1), np.uint8)))
    row = _every(able & (near > 0), step)
    if not row.size:
        return flat
    every = able.ravel().nonzero()[0]
    by_run = numbered(every, column[every], 2, height)
    run, step = by_run[np.searchsorted(every, row)], step[row // height]
    excess, top, clipped = _profiles(plane, row, column, width)
    total = np.zeros((5, len(row) + 1))
    np.cumsum([excess, excess * excess, top, peak[row], clipped], axis=1, out=total[:, 1:])
    index, reach = np.arange(len(row)), np.maximum(2, _NEARBY // step)
    first = np.maximum(index - reach, np.searchsorted(run, run))
    stop = np.minimum(index + reach + 1, np.searchsorted(run, run, side="right"))
    rows = stop - first
    mean, square, top, usual, clipped = (total[:, stop] - total[:, first]) / rows
    scatter = np.sqrt(np.maximum(square - mean * mean, 0.0) / np.maximum(rows - 1, 1))
    sure = (mean > _SURE * scatter) & (top > 0.3 * usual) & (clipped < 0.1) & (rows >= _LEAST_ASKED)
    # A row is what the asked ones of its run before and after it are.
    after = np.searchsorted(row, every, side="right")
    for ask in (np.maximum(after - 1, 0), np.minimum(after, len(row) - 1)):
        flat[every] |= sure[ask] & (run[ask] == by_run)
    return flat


def _every(able: Mask, step: Index) -> Index:
    """Every `step`-th (P,) row of pictures (P, H) below each other, as far as it is `able`."""
    some = np.zeros_like(able)
    for own, rows, k in zip(some, able, step.tolist(), strict=True):
        own[::k] = rows[::k]
    return some.ravel().nonzero()[0]


def _profiles(plane: U8, row: Index, column: F64, width: F64) -> tuple[F64, F64, Mask]:
    """How much too high for a Gaussian lines at rows (N,) are at their shoulders; their tops, and if those are cut."""
    at = column[row] + np.array([[0.0], [-_AT], [_AT], [-3.0], [3.0]]) * width[row]
    middle, left, right, below_left, below_right = _sampled(plane, row, at)
    shoulder = np.minimum(left - below_left, right - below_right)
    top = middle - np.maximum(below_left, below_right)
    return shoulder - _FLAT * top, top, middle >= SATURATED


def _sampled(plane: U8, row: Index, column: F64) -> F64:
    """Values (n, N) at columns (n, N) between samples of rows (N,), interpolated."""
    x = np.minimum(np.maximum(column, 0.0), plane.shape[1] - 1.001)
    left = x.astype(np.intp)
    part = x - left
    # Both neighbours in one run.
    both = runs_at(plane, np.broadcast_to(row, left.shape), plane.strides[1] * left, plane.strides[1] + 1)
    value: F64 = both[..., 0] * (1.0 - part) + both[..., -1] * part
    return value
