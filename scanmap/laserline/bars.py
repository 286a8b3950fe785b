"""The line on a surface in reach of a hand: a saturated bar tens of columns wide, found by its two edges."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.channel import SATURATED
from scanmap.laserline.params import LaserLineParams
from scanmap.laserline.pictures import by_picture
from scanmap.laserline.result import LaserLine, Reason
from scanmap.laserline.sight import Sight

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
Index = NDArray[np.intp]

_LEAST_PX, _MOST_PX = 12, 150  # saturated columns side by side that make a bar
_NEARLY_PX = 4.5  # width, as sigma, of a profile from which on it may be one in other rows
_REACH = 110  # [px] half the window in which a bar's edges are looked for
_LEVELS = (0.3, 0.45, 0.6, 0.75)  # of a bar's height at which its two edges are taken
_SOFT = (0.03, 0.3)  # how wide an edge of a bar is, as a share of the bar
_LEAST_SIGMA_PX, _MOST_SIGMA_PX = 0.03, 0.75
_FEW_ROWS = 8
_LONG, _EVEN = 2.0, 0.12  # rows of a piece over its width, and how much of that width may vary along it
_LEAST_LIT = 60  # [grey levels] what the laser must have added in the middle of a bar


class Bars(NamedTuple):
    """Bars of the N rows that have one, arrays (N,)."""

    row: Index
    column: F64  # [px] middle between the edges
    sigma_px: F64
    width_px: F64  # standard deviation a Gaussian of the same full width at half height has
    height: F64  # over the brighter of its two sides [grey levels]


def take_bars(line: LaserLine, sight: Sight, params: LaserLineParams) -> None:
    """Rows that no profile was found in, but a saturated bar with a beam's edges."""
    if params.method != "gauss":
        return
    lost = line.reason != Reason.OK
    # A bar hardly too narrow for one is a profile in some rows and none in others: together they are long enough.
    asked = np.flatnonzero(lost | (line.width_px > _NEARLY_PX))
    lit = None if sight.off is None else sight.lit
    for noise, own in zip(sight.noise, by_picture(asked // sight.height, len(sight.noise)), strict=True):
        bars = find_bars(sight.plane, asked[own], SATURATED, noise, lit)
        new = lost[bars.row]
        r = bars.row[new]
        line.column_px[r], line.sigma_px[r] = bars.column[new], bars.sigma_px[new]
        line.width_px[r], line.peak[r], line.reason[r] = bars.width_px[new], bars.height[new], Reason.OK


def find_bars(plane: U8, rows: Index, saturated: int, noise: float, lit: U8 | None = None) -> Bars:
    """The bars in `rows` (N,) of a plane (H, W); rows without one are left out.

    Args:
        lit: what the laser added, where a laser-off frame tells; a bar that was there without it is a lamp.

    So near, the beam saturates tens of columns, and all that is known of it stands in its edges. Their middle is
    taken at four levels, each crossing interpolated between two samples. A beam's edge is as soft as the beam is
    wide; a window's is as sharp as the lens, and a lamp's glow is softer: neither is taken.
    """
    row = middle = rows[:0]
    if len(rows) >= _FEW_ROWS:
        row, middle = _plateaus(plane, rows, saturated)
    if len(row) < _FEW_ROWS:
        return Bars(row[:0], *(np.empty(0) for _ in range(4)))
    x = np.clip(middle[:, None] + np.arange(-_REACH, _REACH + 1), 0, plane.shape[1] - 1)
    y = plane[row[:, None], x].astype(np.float32)
    if lit is not None:
        added = lit[row, middle] > _LEAST_LIT
        row, middle, y = row[added], middle[added], y[added]
    floor = np.maximum(np.median(y[:, :5], axis=1), np.median(y[:, -5:], axis=1))
    height = y[:, _REACH] - floor
    crossings = [_edges(y, floor + share * height) for share in _LEVELS]
    middles = np.array([0.5 * (right - left) for left, right, _ in crossings])
    widths = np.array([left + right for left, right, _ in crossings])
    steepness = np.mean([slope for _, _, slope in crossings], axis=0)
    full = widths.mean(axis=0)
    # Two edges known to noise over slope each; and where the levels disagree the bar is not symmetric.
    sigma = np.hypot(0.5 * noise / steepness, 0.5 * middles.std(axis=0))
    with np.errstate(invalid="ignore"):
        soft = 0.5 * (widths[0] - widths[-1]) / np.maximum(full, 1.0)
        beam = (soft > _SOFT[0]) & (soft < _SOFT[1]) & (sigma < _MOST_SIGMA_PX) & (height > 60.0)
    column = middle + middles.mean(axis=0)
    sigma = np.maximum(sigma, _LEAST_SIGMA_PX)
    beam &= _long(row, column, np.where(beam, full, np.nan))
    return Bars(row[beam], column[beam], sigma[beam], full[beam] / 2.355, height[beam].astype(np.float64))


def _long(row: Index, column: F64, full: F64) -> NDArray[np.bool_]:
    """Whether each bar belongs to a piece longer than it is wide, and of one width: a lamp is round.

    Args:
        full: (N,) full widths [px], NaN where the edges are not a beam's.
    """
    broken = (np.diff(row) > 12) | (np.abs(np.diff(column)) > 4.0)
    piece = np.concatenate([[0], np.cumsum(broken)]) if len(row) else np.zeros(0, np.intp)
    known = np.isfinite(full)
    count = np.bincount(piece, known)
    mean = np.bincount(piece[known], full[known], minlength=len(count)) / np.maximum(count, 1.0)
    square = np.bincount(piece[known], full[known] ** 2, minlength=len(count)) / np.maximum(count, 1.0)
    spread = np.sqrt(np.maximum(square - mean**2, 0.0))
    good = (count > _LONG * mean) & (spread < _EVEN * mean)
    return np.asarray(good[piece])


def _plateaus(plane: U8, rows: Index, saturated: int) -> tuple[Index, Index]:
    """Rows that have one saturated run of a bar's length, and the run's middle column."""
    # A bar is longer than wide: every fourth row of it is enough to say that there is none.
    few = np.count_nonzero(plane[rows[::4]] >= saturated, axis=1) >= _LEAST_PX
    if np.count_nonzero(few) < 2:
        return rows[:0], rows[:0]
    bright = plane[rows] >= saturated
    some = np.flatnonzero(np.count_nonzero(bright, axis=1) >= _LEAST_PX)
    if not some.size:
        return rows[:0], rows[:0]
    padded = np.zeros((len(some), plane.shape[1] + 2), np.int8)
    padded[:, 1:-1] = bright[some]
    # Starts and ends alternate, row by row, so the k-th of one belongs to the k-th of the other.
    step = np.diff(padded, axis=1)
    owner, start = np.nonzero(step == 1)
    _, stop = np.nonzero(step == -1)
    length = stop - start
    fits = (length >= _LEAST_PX) & (length <= _MOST_PX)
    owner, start, stop = owner[fits], start[fits], stop[fits]
    single = np.bincount(owner, minlength=len(some))[owner] == 1
    return rows[some[owner[single]]], ((start + stop - 1) // 2)[single]


def _edges(y: F32, level: F32) -> tuple[F64, F64, F64]:
    """Where each row (N, n) falls below its level, left and right of the middle [px], and the gentler slope there."""
    half, index = y.shape[1] // 2, np.arange(len(y))
    distance, slopes = [], []
    for side in (y[:, half::-1], y[:, half:]):
        below = side < level[:, None]
        out = np.maximum(below.argmax(axis=1), 1)
        inner, outer = side[index, out - 1], side[index, out]
        drop = np.maximum(inner - outer, 1e-3)
        distance.append(np.where(below.any(axis=1), out - 1 + (inner - level) / drop, np.nan))
        slopes.append(drop)
    return distance[0], distance[1], np.minimum(slopes[0], slopes[1])
