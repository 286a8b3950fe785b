"""What a laser-off frame cannot take away: where the room has contrast, no two pictures of it are the same."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.path import strips
from scanmap.laserline.result import LaserLine, Reason, without
from scanmap.laserline.runs import GAP_ROWS, crumbs, numbered
from scanmap.laserline.sight import Sight

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]

# What stands out of what is left of the room's own edges by no more than this is given up: single rows by the first,
# short runs by the second. Two compressions of one picture differ by blocks of 8 rows, and of 16 in colour.
_STANDS_OUT, _BLOCKS_ROWS = (2.5, 4.5), 18
_REACH = 2  # [px] on either side of a place whose contrast counts
_CONTRAST = 16  # [grey levels] from which on a place has any
_BRIGHTEST = 240  # [grey levels] brighter ones are cut
_ROW_STEP = 8
_FEW = 50
_OWN_PX = 12  # on either side of the line, where the difference is its own light
_SHARE = 0.04  # of a contrast that a shaken camera leaves besides
# A run, asked along it as a whole: rows that it has at least, and how far they lie from a straight line.
_RUN_ROWS, _STRAIGHT_PX = 4, 0.8
# Columns on either side that are asked besides, from where on they are not its own, and how far their sides are [px].
_HALF, _BESIDE_PX, _AWAY_PX = 40, 9, 6
# How much higher a run is than all of those, and than what neighbouring columns of the laser-off frame differ by.
_HIGHER, _STEEPER = 2.0, 1.5


def told_from_edges(line: LaserLine, weak: Mask, sight: Sight) -> tuple[LaserLine, Mask]:
    """The line of one picture without what edges of the room leave of its laser-off frame; and rows (H,) still weak."""
    assert sight.off is not None
    standing = standing_out(line.column_px, line.peak, sight.on, sight.off, sight.gain)
    line = without(line, standing < _STANDS_OUT[0], Reason.AMBIGUOUS)
    disturbed = standing < _STANDS_OUT[1]
    borne = borne_out(line.column_px, disturbed | weak, _BLOCKS_ROWS, sight.lit, sight.off, sight.gain)
    disturbed &= ~borne
    line = without(line, crumbs(line.column_px, disturbed, sight.height, _BLOCKS_ROWS), Reason.AMBIGUOUS)
    return line, (weak | disturbed) & ~borne


def standing_out(column: F64, peak: F64, image: U8, background: U8, gain: float) -> F64:
    """Height of each row's line over what a shaken or recompressed edge leaves there in the difference.

    Args:
        column, peak: (H,) of the line, NaN where none.
        image, background: (H, W) laser on and off.
        gain: that the background is multiplied by.

    Returns:
        Heights (H,) in standard deviations of what is left, infinite where the room is even or has no line.

    What remains where the room has contrast is measured in the two pictures themselves.
    """
    ratio = np.full(len(column), np.inf)
    row = np.flatnonzero(np.isfinite(column))
    left = _remaining(image, background, gain, column) if row.size else 0.0
    if left > 0.0:
        middle = np.rint(column[row]).astype(np.intp)
        x = np.clip(middle[:, None] + np.arange(-_REACH, _REACH + 1), 0, background.shape[1] - 1)
        contrast = gain * np.ptp(background[row[:, None], x].astype(np.float32), axis=1)
        uneven = contrast > _CONTRAST
        row = row[uneven]
        ratio[row] = peak[row] / np.hypot(left, _SHARE * contrast[uneven])
    return ratio


def _remaining(image: U8, background: U8, gain: float, column: F64) -> float:
    """Standard deviation of the difference where there is contrast [grey levels]; 0 where only the line has any."""
    on, off = (np.ascontiguousarray(plane[_ROW_STEP // 2 :: _ROW_STEP]) for plane in (image, background))
    if not len(on):
        return 0.0
    around = np.ones((1, 2 * _REACH + 1), np.uint8)
    contrast = np.asarray(cv2.subtract(cv2.dilate(off, around), cv2.erode(off, around)))
    usable = (contrast * np.float32(gain) > _CONTRAST) & (cv2.max(on, off) < _BRIGHTEST)
    line = column[_ROW_STEP // 2 :: _ROW_STEP]
    for k in np.flatnonzero(np.isfinite(line)).tolist():
        usable[k, max(0, int(line[k]) - _OWN_PX) : int(line[k]) + _OWN_PX + 1] = False
    if np.count_nonzero(usable) < _FEW:
        return 0.0
    left = np.abs(on[usable] - gain * off[usable].astype(np.float32))
    return float(1.48 * np.median(left))


def borne_out(column: F64, doubtful: Mask, most: int, lit: U8, background: U8, gain: float) -> Mask:
    """Rows (H,) of runs, most of them doubtful, that are the line beyond doubt in their mean along a straight line.

    Args:
        column: (H,) of the line, NaN where none.
        doubtful: (H,) rows that could not be told alone.
        most: rows that a run in question has at most.
        lit: (H, W) what the laser added.
        background: (H, W) laser off.
        gain: that it is multiplied by.

    What two compressions differ by comes with both signs and at all columns of these rows alike: averaged along the
    line it is told by the other columns. What an edge leaves that is not quite in its place lies along the line too,
    but is no higher than the edge is steep.
    """
    borne = np.zeros(len(column), bool)
    row = np.flatnonzero(np.isfinite(column))
    if not row.size or not doubtful.any() or lit.shape[1] <= 2 * _HALF:
        return borne
    run = numbered(row, column[row], GAP_ROWS + 1, len(column))
    length = np.bincount(run)
    short = (length >= _RUN_ROWS) & (length <= most)
    for k in np.flatnonzero(short & (np.bincount(run, doubtful[row]) > 0.5 * length)):
        rows = row[run == k]
        slope, middle = np.polyfit(rows - rows[0], column[rows], 1)
        along = middle + slope * (rows - rows[0])
        if np.std(column[rows] - along) > _STRAIGHT_PX:
            continue
        along = np.clip(np.rint(along).astype(np.intp), 0, lit.shape[1] - 1)
        added, room = (strips(plane, rows, along, _HALF).mean(axis=1) for plane in (lit, background))
        rise = added[_AWAY_PX:-_AWAY_PX] - np.maximum(added[: -2 * _AWAY_PX], added[2 * _AWAY_PX :])
        own = len(rise) // 2
        missing = np.median(added) - added.min()
        beside = max(rise[: own - _BESIDE_PX].max(), rise[own + _BESIDE_PX + 1 :].max(), missing)
        steep = gain * np.abs(np.diff(room[_HALF - _REACH - 1 : _HALF + _REACH + 2])).max()
        borne[rows] = rise[own - 1 : own + 2].max() > max(_HIGHER * beside, _STEEPER * steep)
    return borne
