"""Lines of which one side is another's: a joint beside them, an edge that cuts the beam, a gloss that mirrors it.

What takes light from one half of a line, or adds to it, moves the Gaussian that is fitted to both, and makes it
narrower or wider than lines at this range are. The other half is still what it was: with the width that lines have
elsewhere in the scan, three parameters (place, height, level) are told from that flank alone.

Which flank is clean is seen in what the fits leave over. One row's noise hides that; its mean over two dozen rows along
the line does not. A line that is narrower or wider for a reason of its own (a tone curve, a smeared colour) is so on
both sides alike: its flanks, fitted with the usual width, lie as far to the left of it as to the right.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.offmatch import in_place
from scanmap.laserline.params import LaserLineParams
from scanmap.laserline.rounding import Rounding
from scanmap.laserline.samples import samples_of
from scanmap.laserline.sight import Conversion, Laser, channel_of, sight_of
from scanmap.laserline.steps import Fit, bell_of, fit_part, solved

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

ROWS = 25  # over which what the fits leave is averaged
UNUSUAL = 0.06  # logarithm of a line's width over the usual one, in their mean, from which on its sides are asked
_HALF = 20  # [px] of the window
_X = np.arange(-_HALF, _HALF + 1, dtype=np.float32)[:, None]
_MARGIN = 160  # [px] beside the line that are looked at: they tell the noise, and the exposure of a laser-off frame
_CORE, _REACH, _LEVEL = 0.3, 3.4, 1.2  # [usual widths] where a flank begins and ends, and what it has of the level
_STEPS = 8
_LEAST_PX = 1.2  # usual width; a flank of a thinner line has too few samples
# Rows of a stretch that are sure, and their share of it; of a line that is hardly narrower more of them are asked, for
# print and texture look the same, but do not go on so long.
_SHORTEST, _LONG, _SURE_SHARE = 15, 75, 0.3
_SPOILT = 0.012  # rest of its other flank, at least
# Of the others in it: how unusual they still are, and their clean flank's rest.
_STILL, _HARDLY_STILL, _CLEAN_STILL = 0.04, 0.01, 0.02
_JUMP_PX = 2.0  # between rows of different surfaces
_PLACES = np.linspace(-3.0, 3.0, 13, dtype=np.float32)  # [widths] at which what is left of a line is compared
_FLANK = np.arange(0.5, 3.3, 0.5, dtype=np.float32)  # [usual widths] the same of a flank
# What is left over, rms in heights of the line: of the odd part of a whole line, at least, by itself and in a sample's
# noise; of a clean flank at most, where the line is wide and where it is narrow; how many times that of the other
# flank, at least where the line is wide, and to settle it where the line is narrow.
ODD, _ODD_NOISE = 0.02, 0.4
BOTH = 0.003  # that times UNUSUAL's, at least: what textures and compression do is seldom much of either
SURE = (0.02, 0.01, 0.0002)  # the three where the line is narrow and the usual width known to a hundredth
_CLEAN_WIDE, _CLEAN_NARROW, _CLEARLY, _SETTLED = 0.011, 0.009, 2.5, 4.0
_LOPSIDED = 0.3  # else, of how far both flanks lie from a narrow line, their sum at least
_FARTHEST_WIDE, _FARTHEST_NARROW, _OTHER = 1.2, 0.65, 1.9  # [usual widths] from the line: the clean flank, the other
_LEVELS = 0.2  # of its height, that the levels on both sides of a line may differ by
_DOUBT = 0.25  # of how far a line is moved


class Moved(NamedTuple):
    """What clean flanks say of a line, arrays (H,) [px]; zero where they say nothing."""

    by: F64  # to be added to its columns
    doubt: F64  # standard deviation of that


class Usual(NamedTuple):
    """How wide lines are where a picture's are, arrays (H,)."""

    width_px: F64  # standard deviation of the profile; NaN where there is no line
    sure: Mask  # whether it is known to a hundredth or two


class _Lines(NamedTuple):
    """N lines along each other."""

    y: F32  # (n, N) grey levels of windows around them
    usable: F32  # (n, N) 1, or 0 for samples that say little
    whole: Fit  # Gaussians of the usual kind
    at: F32  # (N,) where they were found, from the middle of the window [px]
    wide: F32  # (N,) how wide they usually are [px]
    sure: Mask  # (N,) of that
    rest: F32  # (m, N) what the Gaussians leave over at some places, in heights of the line
    noise: F32  # (N,) of a sample, in heights of the line

    @property
    def ratio(self) -> F32:
        """Logarithms (N,) of their widths over the usual ones."""
        return np.asarray(np.log(self.whole.s / self.wide))

    def of(self, some: Index) -> _Lines:
        """Some of them."""
        y, usable, rest = (values[:, some] for values in (self.y, self.usable, self.rest))
        at, wide, noise = (values[some] for values in (self.at, self.wide, self.noise))
        return _Lines(y, usable, self.whole.of(some), at, wide, self.sure[some], rest, noise)


class _Flank(NamedTuple):
    """One side of N lines, arrays (N,), in means along the line."""

    off: F32  # where it puts the line, from where the line is [px]
    level: F32  # [grey levels]
    rest: F32  # that the fit leaves of it, rms, in heights of the line


def by_clean_flanks(
    image: U8,
    params: LaserLineParams,
    line: F64,
    usual: Usual,
    asked: Mask,
    background: U8 | None = None,
    laser: Laser | None = None,
    rounding: Rounding | None = None,
    matched: bool = False,
) -> Moved:
    """Where a picture's line is by the clean one of its flanks, in rows where the other is not.

    Args:
        image: (H, W) grey or (H, W, 3) BGR, laser on.
        params: how the line was found.
        line: (H,) columns that it was found in; NaN without one.
        usual: how wide lines are there.
        asked: (H,) rows in question.
        background: the same view with the laser off, or None.
        laser: what another picture of the scan has told of it.
        rounding: of the file that the picture was.
        matched: whether `background` lies on the picture as it is, at its exposure.
    """
    height = len(line)
    moved = Moved(np.zeros(height), np.zeros(height))
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero(asked & np.isfinite(line) & (usual.width_px > _LEAST_PX))
    if len(rows) < ROWS:
        return moved
    if background is not None and not matched:
        background = in_place(image, background)
    channel = channel_of(image, background, params.grey) if laser is None or image.ndim == 2 else laser.channel
    first, last = max(0, int(line[rows].min()) - _MARGIN) // 4 * 4, int(line[rows].max()) + _MARGIN
    image, background = image[:, first:last], None if background is None else background[:, first:last]
    how = Conversion(params.grey, params.bit_index, params.off_threshold)
    sight = sight_of(
        image, background, how, height, channel, [rounding], None if laser is None else laser.noise, matched
    )
    column = np.rint(line[rows]).astype(np.intp)
    y, usable = samples_of(sight, rows, column - first).of(_HALF, slice(None))
    wide, at = usual.width_px[rows].astype(np.float32), (line[rows] - column).astype(np.float32)
    level = np.minimum(y[:4].mean(axis=0), y[-4:].mean(axis=0))
    rises = np.maximum(y[_HALF - 1 : _HALF + 2].max(axis=0) - level, np.float32(1.0))
    start = Fit(at, wide, rises, level, np.zeros_like(at))
    least, free = np.full_like(at, 3.0), np.full_like(at, np.inf)
    whole = fit_part(y, _X, usable, start, least, free)
    rest = _at(_rest(y, usable, whole), whole.u + _PLACES[:, None] * whole.s)
    lines = _Lines(y, usable, whole, at, wide, usual.sure[rows], rest, np.float32(sight.noise[0]) / whole.A)
    for part in _along(rows, line):
        worth = np.flatnonzero(np.any(_uneven(lines.of(part)), axis=0)) if len(part) >= ROWS else part[:0]
        if worth.size:
            around = part[max(0, worth[0] - ROWS) : worth[-1] + ROWS + 1]
            by = _told(lines.of(around))
            moved.by[rows[around]], moved.doubt[rows[around]] = by, _DOUBT * np.abs(by)
    return moved


def _uneven(lines: _Lines) -> tuple[Mask, Mask]:
    """Which lines (N,) are not as wide as usual, and not alike on both sides, in means along them; and which hardly."""
    rest = _mean(lines.rest)
    odd = np.sqrt(np.square(0.5 * (rest - rest[::-1])).mean(axis=0))
    ratio, loud = _mean(lines.ratio), np.float32(_ODD_NOISE) * _mean(lines.noise)

    def beyond(unusual: float, least: float, both: float) -> Mask:
        size = np.abs(ratio)
        return np.asarray((size > unusual) & (odd > np.maximum(np.float32(least), loud)) & (size * odd > both))

    plainly = beyond(UNUSUAL, ODD, BOTH)
    return plainly, beyond(*SURE) & lines.sure & (ratio < 0) & ~plainly


def least_of(sure: Mask) -> tuple[F64, F64, F64]:
    """UNUSUAL, ODD and BOTH, or SURE where lines are narrow and the usual width is sure."""
    unusual, odd, both = (np.where(sure, own, usual) for own, usual in zip(SURE, (UNUSUAL, ODD, BOTH), strict=True))
    return unusual, odd, both


def _told(lines: _Lines) -> F32:
    """How far (N,) the clean flank puts lines from where they are [px]; zero where none is known to be."""
    wide, narrow = lines.wide, _mean(lines.ratio) < 0
    sides = [_flank(lines, side) for side in (-1, 1)]
    rests, off, level = (np.stack([getattr(one, name) for one in sides]) for name in ("rest", "off", "level"))
    clearer = rests.max(axis=0) / np.maximum(rests.min(axis=0), np.float32(1e-6))
    clean = np.where(clearer > _CLEARLY, rests.argmin(axis=0), np.abs(off).argmin(axis=0))
    own, left, other = (
        np.take_along_axis(v, k[None], axis=0)[0] for v, k in ((off, clean), (rests, clean), (off, 1 - clean))
    )
    lopsided = np.abs(off.sum(axis=0)) > _LOPSIDED * np.abs(off).sum(axis=0)
    dimmed = narrow & (left < _CLEAN_NARROW) & (lopsided | (clearer > _SETTLED))
    dimmed &= (np.abs(own) < _FARTHEST_NARROW * wide) & (np.abs(other) < _OTHER * wide)
    added = ~narrow & (left < _CLEAN_WIDE) & (clearer > _CLEARLY) & (np.abs(own) < _FARTHEST_WIDE * wide)
    even = np.abs(level[1] - level[0]) < np.float32(_LEVELS) * _mean(lines.whole.A)
    plainly, hardly = _uneven(lines)
    sure, unusual = plainly & even & (dimmed | added), np.abs(_mean(lines.ratio))
    hardly &= even & dimmed & (rests.max(axis=0) > _SPOILT)
    by: F32 = np.zeros_like(own)
    for side in (0, 1):
        for kind, farthest in ((narrow, _FARTHEST_NARROW), (~narrow, _FARTHEST_WIDE)):
            here = kind & (clean == side)
            # Between rows that are sure the same goes on.
            alike = even & (here | (kind & (rests[side] < rests[1 - side]))) & (rests[side] < _CLEAN_STILL)
            alike &= np.abs(off[side]) < farthest * wide
            stretch = _around_sure(sure & here, alike & (unusual > _STILL), _SHORTEST)
            stretch |= _around_sure((sure | hardly) & here, alike & (unusual > _HARDLY_STILL), _LONG)
            by[stretch] = off[side, stretch]
    return by


def _around_sure(sure: Mask, alike: Mask, shortest: int) -> Mask:
    """Runs (N,) of rows that are sure or alike, of which enough, and a large enough part, are sure."""
    some = sure | alike
    run = np.cumsum(some & ~np.append(False, some[:-1])) * some
    count, whole = np.bincount(run, sure), np.bincount(run)
    kept = (count >= shortest) & (count >= _SURE_SHARE * whole)
    kept[0] = False
    return np.asarray(kept[run])


def _flank(lines: _Lines, side: int) -> _Flank:
    """The left (-1) or right (1) flank of lines, fitted with the known width, in means along the line."""
    y, usable, whole, at, wide = lines[:5]
    outward = np.float32(side) * (_X - np.rint(whole.u))
    within = (outward >= np.float32(_CORE) * wide) & (outward <= np.float32(_REACH + _LEVEL) * wide + np.float32(1.0))
    weight = usable * within
    fit, far = whole._replace(s=wide), np.float32(2.5) * wide
    for _ in range(_STEPS):
        bell = bell_of(_X, fit)
        slope = np.asarray(bell * (_X - fit.u) * (fit.A / np.square(wide)), np.float32)
        basis = np.stack([np.ones_like(bell), bell, slope, y - fit.b - fit.A * bell])
        normal = np.stack([np.einsum("jn,kjn->kn", weight * own, basis) for own in basis[:3]]).astype(np.float64)
        (b, A, u), _ = solved(normal)
        fit = fit._replace(
            u=np.clip(fit.u + np.clip(u, -0.7, 0.7), whole.u - far, whole.u + far).astype(np.float32),
            A=np.maximum(fit.A + np.clip(A, -0.5 * fit.A, fit.A), 0.5).astype(np.float32),
            b=(fit.b + b).astype(np.float32),
        )
    rest = _at(_rest(y, weight, fit), fit.u + np.float32(side) * _FLANK[:, None] * wide)
    return _Flank(_mean(fit.u - at), _mean(fit.b), np.sqrt(np.square(_mean(rest)).mean(axis=0)))


def _rest(y: F32, weight: F32, fit: Fit) -> F32:
    """What fits (N,) leave of windows (n, N), in heights of their lines; nothing where samples do not count."""
    rest = (y - fit.b - fit.A * bell_of(_X, fit)) / fit.A
    return np.where(weight > 0, rest, np.float32(0.0)).astype(np.float32)


def _at(values: F32, place: F32) -> F32:
    """Values (n, N) of windows between their samples, at places (m, N) from the middle [px]; zero outside."""
    along = np.clip(place + np.float32(_HALF), 0.0, 2.0 * _HALF - 1e-3)
    first = along.astype(np.intp)
    share = (along - first).astype(np.float32)
    low, high = (np.take_along_axis(values, first + k, axis=0) for k in (0, 1))
    return np.where(np.abs(place) <= _HALF, low + share * (high - low), np.float32(0.0))


def _mean(values: F32) -> F32:
    """Means (..., N) of values (..., N) along a line."""
    rows = np.ascontiguousarray(values.reshape(-1, values.shape[-1]), np.float32)
    return np.asarray(cv2.blur(rows, (ROWS, 1), borderType=cv2.BORDER_REFLECT), np.float32).reshape(values.shape)


def _along(rows: Index, line: F64) -> list[Index]:
    """Runs of `rows` (N,), by their places among them, that follow each other on one surface."""
    step = np.abs(np.diff(line[rows]))
    return np.split(np.arange(len(rows)), np.flatnonzero((np.diff(rows) > 2) | (step > _JUMP_PX)) + 1)
