"""From candidates to one column per row: the path along the line, then where it stands out in each row."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.candidates import BLOCK, Candidates
from scanmap.laserline.grey import runs_at

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
Index = NDArray[np.intp]

CONNECTED_PX = 9.0  # a line does not run farther than this from block to block
JUMP = 1.6  # what leaving a line costs, in logarithms of signal to noise
_STATES = 4  # candidates that a block's path can choose from
_PATH_WORTH = 0.15  # what a pixel away from the path costs, squared, in the noise of a sample
_CONTEXT = 6  # blocks on either side of a contested one that decide with it


def strips(plane: U8, row: Index, column: Index, half: int) -> U8:
    """Samples (2 half + 1, N) around each column, or (2 half + 1, 3, N); the edge's own repeated outside the image.

    Args:
        plane: (H, W), or a view of one channel of a picture (H, W, 3), or the picture.
    """
    width, apart, whole = plane.shape[1], plane.strides[1], plane.ndim == 3
    shape = (2 * half + 1, 3, len(row)) if whole else (2 * half + 1, len(row))
    if not row.size:
        return np.empty(shape, np.uint8)
    if column.min() < half or column.max() >= width - half:
        x = np.clip(column[:, None] + np.arange(-half, half + 1), 0, width - 1)
        return np.asarray(cv2.transpose(plane[row[:, None], x].reshape(len(row), -1)), np.uint8).reshape(shape)
    runs = runs_at(plane, row, apart * (column - half), apart * 2 * half + (3 if whole else 1))
    across = np.asarray(cv2.transpose(runs), np.uint8)
    return across.reshape(shape) if whole else across[::apart]


def choose_path(candidates: Candidates, score: F32, min_snr: float) -> F32:
    """One column (B,) for each block, NaN where none is good enough.

    Dynamic programming over the candidates: the path with the largest sum of log(score / min_snr), where
    going on along a line is free and jumping to another costs. Where no block has a rival the best is taken.
    """
    if score.shape[1] == 1:
        # What the general case gives where no block has a rival.
        return np.where(score[:, 0] > min_snr, candidates.column[:, 0], np.float32(np.nan))
    order = np.argsort(-score, axis=1, kind="stable")[:, :_STATES]
    column = np.take_along_axis(candidates.column, order, 1)
    gain = np.log(np.maximum(np.take_along_axis(score, order, 1), 1e-3) / min_snr)
    chosen = np.where(gain[:, 0] > 0, column[:, 0], np.nan).astype(np.float32)
    contested = (gain[:, 1] > 0).nonzero()[0]
    if not contested.size:
        return chosen
    # Stretches between blocks that nothing contests are decided on their own.
    breaks = np.flatnonzero(np.diff(contested) > 2 * _CONTEXT)
    firsts = np.maximum(contested[np.concatenate([[0], breaks + 1])] - _CONTEXT, 0)
    lasts = np.minimum(contested[np.concatenate([breaks, [len(contested) - 1]])] + _CONTEXT + 1, len(chosen))
    for first, last in zip(firsts.tolist(), lasts.tolist(), strict=True):
        chosen[first:last] = _best_path(column[first:last], gain[first:last])
    return chosen


def columns_of_rows(plane: U8, path: F32, window: F64, noise: F64) -> tuple[Index, Index]:
    """Rows (N,) that may carry the line, and the integer column (N,) of its peak in each.

    Args:
        plane: (P H, W) of P pictures below each other.
        path: (P, B) column in each block of rows, NaN where there is none.
        window: (P H, 2) first and last column of each row, NaN where it has none.
        noise: (P,) of a sample [grey levels].

    A row looks around the column its block's path has there, interpolated along the line; near a jump it looks
    at the neighbours' columns too and takes where the line stands out most.
    """
    row, block, place = _rows_of_blocks(len(noise), len(plane) // len(noise))
    step = path[:, 1:] - path[:, :-1]
    smooth = np.abs(step) <= CONNECTED_PX
    slope = np.zeros(path.shape, np.float32)
    slope[:, 1:-1] = np.where(smooth[:, 1:] & smooth[:, :-1], 0.5 * (step[:, 1:] + step[:, :-1]), 0.0) / BLOCK
    own = path.ravel()[block] + slope.ravel()[block] * place
    best, height_of_best = stand_out(plane, row, own, noise)
    jumpy = np.zeros((len(path), path.shape[1] + 1), bool)
    jumpy[:, 1:-1] = ~smooth
    at = (jumpy[:, 1:] | jumpy[:, :-1]).ravel()[block].nonzero()[0]
    if at.size:
        above, below = np.full((2, *path.shape), np.nan, np.float32)
        above[:, 1:], below[:, :-1] = path[:, :-1], path[:, 1:]
        beside = np.concatenate([above.ravel()[block[at]], below.ravel()[block[at]]])
        rivals, responses = stand_out(plane, np.concatenate([at, at]), beside, noise)
        for rival, response in zip(np.split(rivals, 2), np.split(responses, 2), strict=True):
            better = response > height_of_best[at] * 1.05
            best[at[better]], height_of_best[at[better]] = rival[better], response[better]
    found = ((height_of_best > 0) & np.isfinite(window[:, 0])).nonzero()[0]
    return found, best[found]


@cache
def _rows_of_blocks(pictures: int, rows: int) -> tuple[Index, Index, F32]:
    """All rows (P H,) of pictures, the block each lies in, and how far below that block's middle it is."""
    row, blocks = np.tile(np.arange(rows), pictures), -(-rows // BLOCK)
    block = row // BLOCK + np.repeat(np.arange(pictures) * blocks, rows)
    return np.arange(pictures * rows), block, (row % BLOCK - 0.5 * (BLOCK - 1)).astype(np.float32)


def stand_out(plane: U8, row: Index, column: F32, noise: F64) -> tuple[Index, F32]:
    """The place within 5 px of `column` (N,) that stands out most, and by how much; 0 where column is NaN.

    Args:
        plane: (P H, W) of P pictures below each other.
        row: (N,) of it.
        noise: (P,) of a sample [grey levels].
    """
    reach, far, core = 5, 9, 5
    known = ~np.isnan(column)
    middle = np.rint(np.where(known, column, np.float32(plane.shape[1] // 2))).astype(np.intp)
    y = strips(plane, row, middle, reach + far + core // 2).astype(np.int16)
    # Sums of five columns, one array row per column: every step below runs along the rows of the image.
    smooth = y[:-4] + y[1:-3]
    smooth += y[2:-2]
    smooth += y[3:-1]
    smooth += y[4:]
    inner = smooth[far:-far]
    side = np.maximum(smooth[: -2 * far], smooth[2 * far :])
    # Noise moves the maximum of a dim line; the path is worth something too.
    away = np.square(np.arange(-reach, reach + 1))[:, None] * (2 * core * _PATH_WORTH * noise)
    away = np.minimum(away, 1000.0).astype(np.int16)
    rank = 2 * inner - side
    rank -= away if len(noise) == 1 else away.take(row // (len(plane) // len(noise)), axis=1, mode="clip")
    # The place is packed below the rank, so that one maximum gives both: ten times the speed of argmax. From -2275 to
    # 2550 there is room for eleven places in 16 bits.
    packed = rank.view(np.uint16)
    packed += np.uint16(core * 255 + 1000)
    packed *= np.uint16(2 * reach + 1)
    packed += np.arange(2 * reach, -1, -1, dtype=np.uint16)[:, None]
    at = 2 * reach - (packed.max(axis=0) % np.uint16(2 * reach + 1)).astype(np.intp)
    lead = (inner - side).ravel().take(at * len(row) + np.arange(len(row)))
    response = np.maximum(lead * np.float32(1.0 / core), np.float32(1e-3))
    return middle - reach + at, np.where(known, response, np.float32(0.0))


def _best_path(column: F32, gain: F32) -> F32:
    """Columns (B,) of the best path through the candidates (B, n) of one stretch."""
    nan = float("nan")
    # What a path is worth that ends at each candidate, and where; and one for "no line here", which costs nothing and
    # connects to everything.
    ends: list[tuple[float, float]] = [(0.0, nan)]
    without = 0.0
    back: list[list[int]] = []
    places: list[list[float]] = []
    for columns, gains in zip(column.tolist(), gain.tolist(), strict=True):
        last = len(ends)
        line, best = last, -1e29
        for i, (value, _) in enumerate(ends):
            if value > best:
                line, best = i, value
        from_none, from_line = without - 0.5 * JUMP, best - JUMP
        fresh, came = [], []
        for place, worth in zip(columns, gains, strict=True):
            if worth <= 0:
                continue
            value, source = (from_none, last) if from_none > from_line else (from_line, line)
            for i, (total, where) in enumerate(ends):
                if total > value and not abs(place - where) > CONNECTED_PX:
                    value, source = total, i
            fresh.append((value + worth, place))
            came.append(source)
        places.append([place for _, place in fresh])
        end = best - 0.5 * JUMP
        came.append(line if end > without else last)
        without = max(without, end)
        ends = fresh
        back.append(came)
    path = np.full(len(column), nan, np.float32)
    totals = [value for value, _ in ends] + [without]
    state = totals.index(max(totals))
    for k in range(len(path) - 1, -1, -1):
        if state < len(places[k]):
            path[k] = places[k][state]
        state = back[k][state]
    return path
