"""From candidates to one column per row: the path along the line, then where it stands out in each row."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from scanmap.laserline.candidates import BLOCK, Candidates

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Index = NDArray[np.intp]

CONNECTED_PX = 9.0  # a line does not run farther than this from block to block
JUMP = 1.6  # what leaving a line costs, in logarithms of signal to noise
_STATES = 4  # candidates that a block's path can choose from
_PATH_WORTH = 0.15  # what a pixel away from the path costs, squared, in the noise of a sample
_CONTEXT = 6  # blocks on either side of a contested one that decide with it


def windows(plane: U8, row: Index, column: Index, half: int) -> U8:
    """Samples (N, 2 half + 1) around each column; the edge's own repeated outside the image."""
    width = plane.shape[1]
    if not row.size or (column.min() >= half and column.max() < width - half):
        # Strided views copy whole runs of bytes, ten times the speed of picking samples one by one.
        view = sliding_window_view(plane, 2 * half + 1, axis=1) if row.size else None
        return np.empty((0, 2 * half + 1), np.uint8) if view is None else np.asarray(view[row, column - half])
    x = np.clip(column[:, None] + np.arange(-half, half + 1), 0, width - 1)
    return np.asarray(plane[row[:, None], x])


def choose_path(candidates: Candidates, score: F32, min_snr: float) -> F32:
    """One column (B,) for each block, NaN where none is good enough.

    Dynamic programming over the candidates: the path with the largest sum of log(score / min_snr), where
    going on along a line is free and jumping to another costs. Where no block has a rival the best is taken.
    """
    order = np.argsort(-score, axis=1, kind="stable")[:, :_STATES]
    column = np.take_along_axis(candidates.column, order, 1)
    gain = np.log(np.maximum(np.take_along_axis(score, order, 1), 1e-3) / min_snr)
    chosen = np.where(gain[:, 0] > 0, column[:, 0], np.nan).astype(np.float32)
    contested = np.flatnonzero((gain[:, 1:2] > 0).any(axis=1))
    if not contested.size:
        return chosen
    # Stretches between blocks that nothing contests are decided on their own.
    breaks = np.flatnonzero(np.diff(contested) > 2 * _CONTEXT)
    firsts = np.maximum(contested[np.concatenate([[0], breaks + 1])] - _CONTEXT, 0)
    lasts = np.minimum(contested[np.concatenate([breaks, [len(contested) - 1]])] + _CONTEXT + 1, len(chosen))
    for first, last in zip(firsts.tolist(), lasts.tolist(), strict=True):
        chosen[first:last] = _best_path(column[first:last], gain[first:last])
    return chosen


def columns_of_rows(plane: U8, path: F32, window: NDArray[np.float64], noise: float) -> tuple[Index, Index]:
    """Rows (N,) that may carry the line, and the integer column (N,) of its peak in each.

    A row looks around the column its block's path has there, interpolated along the line; near a jump it looks
    at the neighbours' columns too and takes where the line stands out most.
    """
    row = np.arange(len(plane))
    block = row // BLOCK
    step = np.diff(path)
    smooth = np.abs(step) <= CONNECTED_PX
    slope = np.zeros(len(path), np.float32)
    slope[1:-1] = np.where(smooth[1:] & smooth[:-1], 0.5 * (step[1:] + step[:-1]), 0.0) / BLOCK
    own = path[block] + slope[block] * (row % BLOCK - np.float32(0.5 * (BLOCK - 1)))
    best, height_of_best = _stand_out(plane, row, own, noise)
    jumpy = ~np.concatenate([[True], smooth, [True]])
    at = np.flatnonzero((jumpy[1:] | jumpy[:-1])[block])
    if at.size:
        padded = np.concatenate([[np.nan], path, [np.nan]])
        for neighbour in (padded[:-2], padded[2:]):
            rival, response = _stand_out(plane, at, neighbour[block[at]], noise)
            better = response > height_of_best[at] * 1.05
            best[at[better]], height_of_best[at[better]] = rival[better], response[better]
    found = np.flatnonzero((height_of_best > 0) & np.isfinite(window[:, 0]))
    return found, best[found]


def by_width(lit: U8, row: Index, column: Index) -> list[tuple[int, Index]]:
    """Rows sorted by how wide their line roughly is: (half width of the fit's window, indices)."""
    reach = 24
    y = np.ascontiguousarray(windows(lit, row, column, reach).T)
    top = y[reach - 1 : reach + 2].sum(axis=0, dtype=np.uint16) // 3
    # The brighter side counts: beside an edge of the room the run would never end at the darker one's level.
    sides = np.maximum(y[4:12].sum(axis=0, dtype=np.uint16), y[-12:-4].sum(axis=0, dtype=np.uint16)) // 8
    level = (np.minimum(sides, np.maximum(top, 2) - 2) + top) // 2
    above = y > level.astype(np.uint8)
    # Width of the run above half height that holds the middle.
    left = np.logical_and.accumulate(above[reach::-1], axis=0).sum(axis=0)
    right = np.logical_and.accumulate(above[reach:], axis=0).sum(axis=0)
    full = left + right - 1
    limits = ((8, 6), (13, 11), (24, 200))  # half window, largest full width at half height
    found, lower = [], -2
    for half, upper in limits:
        found.append((half, np.flatnonzero((full > lower) & (full <= upper))))
        lower = upper
    return found


def _stand_out(plane: U8, row: Index, column: F32, noise: float) -> tuple[Index, F32]:
    """The place within 5 px of `column` (N,) that stands out most, and by how much; 0 where column is NaN."""
    reach, far = 5, 9
    middle = np.rint(np.nan_to_num(column, nan=0.0)).astype(np.intp)
    y = windows(plane, row, middle, reach + far)
    # Sums of five columns, one array row per column: every step below runs along the rows of the image.
    smooth = np.asarray(cv2.blur(np.ascontiguousarray(y.T).astype(np.float32), (1, 5), borderType=cv2.BORDER_REPLICATE))
    inner = smooth[far:-far]
    side = np.maximum(smooth[: -2 * far], smooth[2 * far :])
    # Noise moves the maximum of a dim line; the path is worth something too.
    away = np.square(np.arange(-reach, reach + 1, dtype=np.float32))[:, None] * np.float32(_PATH_WORTH * noise)
    at = (inner - np.float32(0.5) * side - away).argmax(axis=0)
    index = np.arange(len(row))
    response = np.where(np.isfinite(column), np.maximum(inner[at, index] - side[at, index], 1e-3), 0.0)
    return middle - reach + at, response.astype(np.float32)


def _best_path(column: F32, gain: F32) -> F32:
    """Columns (B,) of the best path through the candidates (B, n) of one stretch."""
    blocks, states = column.shape
    columns, gains = column.tolist(), gain.tolist()
    # A state per candidate and one for "no line here", which costs nothing and connects to everything.
    total = [0.0] * (states + 1)
    where: list[float] = [float("nan")] * (states + 1)
    back: list[list[int]] = []
    for k in range(blocks):
        line = max(range(states), key=total.__getitem__)
        from_none = total[states] - 0.5 * JUMP
        fresh, came = [], []
        for j in range(states):
            if gains[k][j] <= 0:
                fresh.append(-1e29)
                came.append(states)
                continue
            value, source = total[line] - JUMP, line
            if from_none > value:
                value, source = from_none, states
            for i in range(states):
                if total[i] > value and not abs(columns[k][j] - where[i]) > CONNECTED_PX:
                    value, source = total[i], i
            fresh.append(value + gains[k][j])
            came.append(source)
        end = total[line] - 0.5 * JUMP
        fresh.append(max(total[states], end))
        came.append(line if end > total[states] else states)
        total, where = fresh, [*columns[k], float("nan")]
        back.append(came)
    path = np.full(blocks, np.nan, np.float32)
    state = max(range(states + 1), key=lambda j: total[j])
    for k in range(blocks - 1, -1, -1):
        if state < states:
            path[k] = columns[k][state]
        state = back[k][state]
    return path
