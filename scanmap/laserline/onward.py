"""Where a run of the line goes on over rows that are not sure alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.candidates import BLOCK
from scanmap.laserline.path import strips
from scanmap.laserline.result import LaserLine
from scanmap.laserline.runs import GAP_ROWS, numbered

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_LEAST_ROWS, _END_ROWS = 24, 32  # of a run that says where it goes on, and of its end that are asked
_STRAIGHT_PX = 0.6  # scatter of those about a straight line
_FARTHEST = 3  # lengths of a run that it is followed for
_WIDEST_PX = 6.0  # wider lines are asked for as if they were this wide
_BLOCK, _FEW = 8, 3  # rows that are asked together, and at least
_HALF = 40  # [px] columns on either side that tell what a place stands out by at random
_OFF_PX, _BESIDE_PX = 2, 9  # from where the line should be, it may be, and everything else begins
_SURE, _LEAST = 5.0, 2.0  # standard deviations of that, and grey levels, that the line must stand out by


class _Ends(NamedTuple):
    """Ends of straight runs beside which rows are free, arrays (E,)."""

    row: Index
    step: Index  # 1 down, -1 up
    reach: Index  # free rows that it is followed over
    column: F64  # [px]
    slope: F64  # columns a row

    def ahead(self, end: Index | int, rows: Index) -> tuple[Index, Index]:
        """Rows so far ahead of ends, and the columns there."""
        away = self.step[end] * rows
        return self.row[end] + away, np.rint(self.column[end] + self.slope[end] * away).astype(np.intp)


def gaps_in(column: F64, free: Mask, height: int) -> Mask:
    """Pictures (P,) of `height` rows with gaps in their lines (P H,) in which rows may have a point (P H,)."""
    missing = (np.isnan(column) & free).reshape(-1, height)
    wide = [missing[:, k : height - _FEW + 1 + k] for k in range(_FEW)]
    return np.asarray(np.logical_and.reduce(wide).any(axis=1))


def goes_on(line: LaserLine, plane: U8, noise: float, free: Mask, still: Mask | None = None) -> tuple[Index, Index]:
    """Rows (N,) without a point in which a run of the line goes on straight, and the integer columns (N,) there.

    Args:
        line: of one picture, H rows.
        plane: (H, W) it was found in.
        noise: standard deviation of a sample [grey levels].
        free: (H,) rows that may have one.
        still: (ceil(H / BLOCK), W) where there can be none, in blocks of rows; or None.

    Light on a plane lies on a straight line. Of some rows side by side the mean is taken along it: there the line must
    stand out far more than anything does at other columns of these rows. Only where to look is said here; what is seen
    there is judged as in all rows.
    """
    ends = _ends(line.column_px, free)
    if not ends.row.size:
        return ends.row, ends.row
    usual = min(float(np.nanmedian(line.width_px)), _WIDEST_PX)
    # Half of what the line's height is the mean of, and how far its two sides are.
    kernel = 1 + int(0.5 * usual), max(5, int(2.2 * usual) + 2)
    # Most runs end where the line does, and their next rows say so.
    first = np.minimum(np.arange(1, _BLOCK + 1), ends.reach[:, None]).ravel()
    row, at = ends.ahead(np.repeat(np.arange(len(ends.row)), _BLOCK), first)
    sure, _ = _stands_out(plane, row, at, np.arange(0, len(row), _BLOCK), kernel, noise)
    rows, columns = [row[:0]], [row[:0]]
    for end in np.flatnonzero(sure).tolist():
        row, at = ends.ahead(end, np.arange(1, ends.reach[end] + 1))
        starts = np.arange(0, max(len(row) - _FEW + 1, 1), _BLOCK)
        sure, offset = _stands_out(plane, row, at, starts, kernel, noise)
        # Two blocks side by side that do not show it are its end.
        sure &= np.cumsum(~sure & ~np.append(sure[1:], False)) == 0
        block = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(row)))
        rows.append(row[sure[block]])
        columns.append((at + offset[block])[sure[block]])
    found, index = np.unique(np.concatenate(rows), return_index=True)
    at = np.clip(np.concatenate(columns)[index], 0, plane.shape[1] - 1)
    elsewhere = np.ones(len(found), bool) if still is None else ~still[found // BLOCK, at]
    return found[elsewhere], at[elsewhere]


def _ends(column: F64, may: Mask) -> _Ends:
    """The ends of the line's long straight runs (H,) that have free rows, which may have a point, beside them."""
    row = np.flatnonzero(np.isfinite(column))
    # Rows that may have none count as ones that have.
    known = np.flatnonzero(np.isfinite(column) | ~may)
    known = np.concatenate([[-1], known, [len(column)]])
    at = np.searchsorted(known, row)
    before, after = row - known[at - 1] - 1, known[at + 1] - row - 1
    none = np.empty(0)
    if len(row) < _LEAST_ROWS or not (np.maximum(before, after) >= _FEW).any():
        return _Ends(row[:0], row[:0], row[:0], none, none)
    run = numbered(row, column[row], GAP_ROWS + 1, len(column))
    first = np.flatnonzero(np.diff(run, prepend=-1))
    length = np.diff(first, append=len(row))
    end, step = np.concatenate([first, first + length - 1]), np.repeat([-1, 1], len(first))
    free, length = np.concatenate([before[first], after[first + length - 1]]), np.tile(length, 2)
    some = np.flatnonzero((length >= _LEAST_ROWS) & (free >= _FEW))
    end, step, length = end[some], step[some], length[some]
    back = np.minimum(np.arange(_END_ROWS), length[:, None] - 1)
    index, own = end[:, None] - step[:, None] * back, np.arange(_END_ROWS) < length[:, None]
    x, y = row[index] - row[end][:, None], column[row[index]]
    total = own.sum(axis=1)
    middle, level = (own * x).sum(axis=1) / total, (own * y).sum(axis=1) / total
    x, y = own * (x - middle[:, None]), own * (y - level[:, None])
    slope = (x * y).sum(axis=1) / (x * x).sum(axis=1)
    straight = np.square(y - slope[:, None] * x).sum(axis=1) < np.square(_STRAIGHT_PX) * total
    reach = np.minimum(free[some], _FARTHEST * length)
    return _Ends(*(v[straight] for v in (row[end], step, reach, level - slope * middle, slope)))


def _stands_out(
    plane: U8, row: Index, column: Index, starts: Index, kernel: tuple[int, int], noise: float
) -> tuple[Mask, Index]:
    """Whether blocks (n,) of rows (N,) show the line, and how far [px] from `column` (N,).

    Args:
        starts: (n,) of the blocks.
        kernel: half of what the line's height is the mean of, and how far its two sides are [px].
        noise: standard deviation of a sample [grey levels].
    """
    count = np.diff(starts, append=len(row))
    column = np.clip(column, 0, plane.shape[1] - 1)
    mean = np.add.reduceat(strips(plane, row, column, _HALF).astype(np.float32), starts, axis=1) / count
    core, away = kernel
    total = np.cumsum(np.pad(mean, ((1, 0), (0, 0))), axis=0)
    smooth = (total[2 * core + 1 :] - total[: -2 * core - 1]) / (2 * core + 1)
    rise = smooth[away:-away] - np.maximum(smooth[: -2 * away], smooth[2 * away :])
    middle = len(rise) // 2
    near = rise[middle - _OFF_PX : middle + _OFF_PX + 1]
    beside = np.concatenate([rise[: middle - _BESIDE_PX], rise[middle + _BESIDE_PX + 1 :]])
    usual = np.median(beside, axis=0)
    scatter = 1.48 * np.median(np.abs(beside - usual), axis=0)
    scatter = np.maximum(scatter, noise * np.sqrt(1.5 / ((2 * core + 1) * count)))
    best = near.max(axis=0)
    return (best > usual + _SURE * scatter) & (best > _LEAST), near.argmax(axis=0) - _OFF_PX
