"""Lines beside or on print, told apart from it by what another channel shows of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.channel import SATURATED
from scanmap.laserline.grey import NEIGHBOUR
from scanmap.laserline.noise import dot
from scanmap.laserline.params import LaserLineParams
from scanmap.laserline.path import strips
from scanmap.laserline.peaks import Peaks, fit_gaussian, judged
from scanmap.laserline.pictures import Rows, not_one
from scanmap.laserline.result import Reason
from scanmap.laserline.sight import Sight

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_HALF = 13  # of the window [px]
_MISFIT, _NOISE = 3.0, 1.5  # noises that a profile is no beam's from, and what noise is at least [grey levels]
_FEW, _SOME = 0.01, 0.03  # shares of a picture's rows that are let be: odd ones, and those that print could explain
_TELLING, _WIDER = 40, 1.3  # lines that tell the usual width, and how much wider one may be
_CORE = 2.0  # such widths beside the middle that say nothing of the room
_SHOWN = 4.0  # noises that the other channel must explain beside the line
_MOST, _KEPT = 2.0, 0.4  # of the other channel that is taken away; of a line's height that must be left
_BETTER = 0.6  # of what was left unexplained, at most


def apart_from_print(
    peaks: Peaks,
    reason: NDArray[np.uint8],
    sight: Sight,
    at: tuple[Index, Index],
    rows: Rows,
    params: LaserLineParams,
    usual: F32,
) -> None:
    """Lines (N,) whose profile is no beam's, fitted again without what another channel shows of the room; in place.

    Args:
        peaks, reason: of the lines, as fitted and judged.
        at: rows and columns (N,) of the middles of their windows.
        rows: which pictures they are of.
        usual: (P,) width of each picture's other lines [px]; told here where it is NaN.

    On either side of an edge of two surfaces, however blurred, what a channel has more is a multiple of what another
    one has more; a multiple that the samples beside the line tell. Less that, an edge is gone, and of the line all but
    that part of its light that it shows in the other channel remains. One beam has one width: what is wider then is
    paint.
    """
    if sight.image is None:
        return
    odd = peaks.noise > np.float32(_MISFIT) * np.maximum(rows.noise, np.float32(_NOISE))
    odd |= (reason == Reason.WIDE) | (reason == Reason.AMBIGUOUS)
    # Of a core that is cut the flanks tell, and its brightness.
    odd &= ~peaks.clipped
    worth = _worth(odd, rows, _FEW * sight.height)
    for k in np.flatnonzero(worth & np.isnan(usual)):
        own = peaks.width_px[rows.parts[k]][~odd[rows.parts[k]]]
        if len(own) >= _TELLING:
            own = np.sort(own[:: 1 + len(own) // _TELLING])
            usual[k] = own[len(own) // 2]
    some = not_one(np.flatnonzero(odd & (worth & (usual > 0))[rows.picture]))
    if not some.size:
        return
    across = strips(sight.image, at[0][some], at[1][some], _HALF)
    own, other = across[:, sight.channel].astype(np.float32), across[:, NEIGHBOUR[sight.channel]].astype(np.float32)
    usable = (np.maximum(own, other) < SATURATED).astype(np.float32)
    beside = np.abs(np.arange(-_HALF, _HALF + 1))[:, None] > _CORE * _WIDER * usual[rows.picture[some]]
    slope, shown = _slope(other, own, usable * beside)
    # Of most rows the other channel shows nothing that could explain them.
    tells = slope * shown > np.float32(_SHOWN) * rows.noise[some]
    tell = not_one(np.flatnonzero(tells & _worth(tells, rows.of(some), _SOME * sight.height)[rows.picture[some]]))
    if not tell.size:
        return
    own -= slope * other
    some, slope, few = some[tell], slope[tell], rows.of(some[tell])
    found = fit_gaussian(own.take(tell, axis=1), usable.take(tell, axis=1), few, peaks.contrast)
    told = judged(found, few.noise * np.sqrt(np.float32(1.0) + slope * slope), params)
    before = peaks.height[some]
    better = (told == Reason.OK) & ~found.one_sided & (found.noise < _BETTER * peaks.noise[some])
    better &= (found.width_px < _WIDER * usual[few.picture]) & (found.height > _KEPT * before)
    # What the line shows in the other channel went with the room.
    found = found._replace(height=np.clip(before, found.height, found.height / np.float32(_KEPT)))
    lines = some[better]
    for values, again in zip(peaks[:-1], found[:-1], strict=True):
        values[lines] = again[better]
    reason[lines] = Reason.OK


def _worth(odd: Mask, rows: Rows, most: float) -> Mask:
    """Pictures (P,) with more odd rows (N,) than are let be."""
    return np.asarray(np.bincount(rows.picture[odd], minlength=len(rows.noise_of)) > most)


def _slope(other: F32, own: F32, weight: F32) -> tuple[F32, F32]:
    """By how much more the samples (n, N) of a channel vary than another's do, and the other's scatter (N,)."""
    count = np.maximum(weight.sum(axis=0), np.float32(1.0))
    other, own = (values - dot(weight, values) / count for values in (other, own))
    power = dot(weight * other, other)
    slope = np.clip(dot(weight * other, own) / np.maximum(power, np.float32(1.0)), 0.0, _MOST)
    return slope.astype(np.float32), np.sqrt(power / count)
