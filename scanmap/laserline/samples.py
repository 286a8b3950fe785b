"""The samples around each row's column, and how wide the line in them roughly is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.channel import SATURATED
from scanmap.laserline.grey import NEIGHBOUR
from scanmap.laserline.path import strips
from scanmap.laserline.pictures import Rows, not_one
from scanmap.laserline.rounding import LIGHT
from scanmap.laserline.sight import BRIGHTNESS, Sight

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Index = NDArray[np.intp]

REACH = 24  # [px] samples on either side of the column
# Half of the fit's window, and the largest full width at half height it is for.
_WINDOWS = ((8, 6), (13, 11), (REACH, 200))

# How much more the far flanks count of a core that is cut off by a share of its height, up to half.
_LACKS = 1.3

_FEW, _STRAY = 24, 0.006  # rows, and a share of all rows


class Samples(NamedTuple):
    """Samples of N rows around one column each, (2 REACH + 1, N): an image row is an array column."""

    lit: U8  # of the laser's light
    seen: U8  # of the picture, which says where it saturates
    beside: U8 | None  # of the neighbouring channel; None where it nowhere knows more of the place
    seen_beside: U8 | None  # of that channel in the picture, which says where it saturates
    outside: NDArray[np.bool_] | None  # beside the picture; None when nothing is
    rows: Rows  # which pictures they are of
    channel: int  # of the laser, where `beside` is known
    smeared: NDArray[np.bool_]  # (N,) whether `beside` knows more of the place
    share: F32  # (N,) of the laser's channel in the mixture with it

    def of(self, half: int, some: Index | slice) -> tuple[F32, F32]:
        """Samples (2 half + 1, n) of some rows, and 1 where they say more than "bright", else 0."""
        span = slice(REACH - half, REACH + half + 1)
        y = _some(self.lit[span], some).astype(np.float32)
        usable = _some(self.seen[span], some) < SATURATED
        if self.beside is not None:
            y = _mixed(y, _some(self.beside[span], some), usable, self.share[some])
        if self.outside is not None:
            usable &= ~_some(self.outside[span], some)
        return y, usable.astype(np.float32)

    def limit_of(self, usable: F32, some: Index | slice) -> F32:
        """At what grey level (n,) the lines of some rows are cut; infinite: not.

        Of a top that was cut a JPEG makes samples above and below the level: where the line itself is higher, none
        says more than "bright".

        Args:
            usable: (2 half + 1, n) as `of` has it.
            some: the rows.
        """
        half = len(usable) // 2
        limit = np.full(usable.shape[1], np.inf, np.float32)
        cut = np.flatnonzero(usable[half - 1 : half + 2].min(axis=0) < 1)
        if cut.size:
            span = slice(REACH - half, REACH + half + 1)
            rows = cut if isinstance(some, slice) else some[cut]
            limit[cut] = self._cut_at(_some(self.seen[span], rows), _some(self.lit[span], rows))
        return limit

    def brightness_of(self, half: int, some: Index | slice, height: F32) -> tuple[F32, F32, F32, F32]:
        """The same in what JPEG stores as brightness, where (n,) the laser's channel is cut in it, and its share (n,).

        Only where `beside` is known. What the rows' lines would rise to is their `height` (n,) [grey levels].

        Where the laser's channel saturates, colour, smeared over two columns and more, moves what is decoded of its
        flanks by up to a tenth of a pixel, in all rows of an upright line alike. Brightness is not smeared, and the
        other channels in it do not saturate; a top cut flat is as even on both sides as a whole one.
        """
        span = slice(REACH - half, REACH + half + 1)
        assert self.beside is not None and self.seen_beside is not None
        own, beside, seen = (_some(channel[span], some) for channel in (self.lit, self.beside, self.seen))
        usable = _some(self.seen_beside[span], some) < SATURATED
        if self.outside is not None:
            usable &= ~_some(self.outside[span], some)
        share = np.float32(BRIGHTNESS[self.channel])
        brightness: F32 = own * share
        brightness += beside * (np.float32(1.0) - share)
        level = self._cut_at(seen, own)
        own, beside = own.astype(np.float32), beside.astype(np.float32)
        low, low_beside = (np.float32(0.5) * np.add(*ends(channel)) for channel in (own, beside))
        # What the neighbour sees of the flanks, it sees as much more where the laser's channel is cut. The cut core
        # lacks colour, the more the higher it is cut off: smeared, that makes the neighbour see too much of the
        # flanks near it, and too little of them far away.
        light, light_beside, flank = own - low, beside - low_beside, seen < SATURATED
        near, far = (
            (part * light_beside).sum(axis=0) / np.maximum((part * light).sum(axis=0), np.float32(1.0))
            for part in (flank, flank & (light < np.float32(0.5) * (level - low)))
        )
        far = np.minimum(np.maximum(far, np.float32(0.0)), near)
        lacks = np.maximum(np.float32(1.0) - (level - low) / height, np.float32(0.0))
        as_much = near + np.minimum(np.float32(_LACKS) * lacks, np.float32(0.5)) * (far - near)
        cut = share * level + (np.float32(1.0) - share) * (low_beside + as_much * (level - low))
        return brightness, usable.astype(np.float32), cut, share + (np.float32(1.0) - share) * as_much

    def _cut_at(self, seen: U8, own: U8) -> F32 | np.float32:
        """Grey level (n,) that the laser's channel (m, n) is cut at: less what was taken away there, at most."""
        if self.lit is self.seen:
            return np.float32(SATURATED)
        room = np.where(seen < SATURATED, seen.astype(np.int16) - own, np.int16(-255)).max(axis=0)
        limit: F32 = np.float32(SATURATED) - room
        return limit


def _some(values: NDArray[Any], some: Index | slice) -> NDArray[Any]:
    """Columns of an array (n, N), which stays one row after the other in memory."""
    return values[:, some] if isinstance(some, slice) else values.take(some, axis=1)


def samples_of(sight: Sight, row: Index, column: Index) -> Samples:
    """The samples around integer columns (N,) of rows (N,)."""
    lit, seen = sight.lit, sight.plane
    beside = seen_beside = outside = None
    smeared = np.array([mixture.channel >= 0 for mixture in sight.mixtures])
    if sight.image is not None and smeared.any():
        across = strips(sight.image, row, column, REACH)
        y, beside = across[:, sight.channel], across[:, NEIGHBOUR[sight.channel]]
        seen_beside = beside
    else:
        y = strips(lit, row, column, REACH)
        beside, seen_beside = (
            None if plane is None else strips(plane, row, column, REACH) for plane in (sight.beside, sight.on_beside)
        )
    bright = y if seen is lit else strips(seen, row, column, REACH)
    if column.min() < REACH or column.max() >= lit.shape[1] - REACH:
        x = column + np.arange(-REACH, REACH + 1)[:, None]
        outside = (x < 0) | (x >= lit.shape[1])
    share = np.array([mixture.share for mixture in sight.mixtures], np.float32)
    rows = Rows(row // sight.height, sight.noise)
    own = smeared[rows.picture]
    return Samples(y, bright, beside, seen_beside, outside, rows, sight.channel, own, share[rows.picture])


def _mixed(own: F32, beside: U8, usable: NDArray[np.bool_], share: F32) -> F32:
    """The laser's channel with the neighbouring one in it (n, N), as high as the laser's own; whole lines only."""
    rest = np.float32(1.0) - share
    mixed = own * share
    mixed += beside * rest
    mixed *= np.float32(1.0) / (share + rest * np.float32(LIGHT))
    cut = (usable.min(axis=0) < 1).nonzero()[0]
    mixed[:, cut] = own.take(cut, axis=1)
    return mixed


def by_width(lit: U8, rows: Rows) -> Sequence[tuple[int, Index | slice]]:
    """The rows of `Samples.lit` by how wide their line roughly is: (half window, rows), most of a picture's first."""
    top = (lit[REACH - 1].astype(np.int16) + lit[REACH] + lit[REACH + 1]) // 3
    # The brighter side counts: beside an edge of the room the run would never end at the darker one's level.
    sides = np.maximum(lit[4:12].sum(axis=0, dtype=np.int16), lit[-12:-4].sum(axis=0, dtype=np.int16)) >> 3
    level = (np.minimum(sides, np.maximum(top, 2) - 2) + top) >> 1
    above = (lit > level.astype(np.uint8)).view(np.uint8)
    # Width of the run above half height that holds the middle: the first sample below it on either side.
    distance = np.arange(REACH + 1, dtype=np.uint8)[:, None]
    above = above * np.uint8(64)
    left = np.minimum((above[REACH::-1] + distance).min(axis=0), REACH + 1).astype(np.int16)
    right = np.minimum((above[REACH:] + distance).min(axis=0), REACH + 1)
    full = left + right - 1
    # A stray wide row or two of a picture are fitted with the others, a few with the widest.
    picture, pictures = rows.picture, len(rows.noise_of)
    wide = np.bincount(picture, full > _WINDOWS[0][1], pictures)
    stray = wide <= _STRAY * np.bincount(picture, minlength=pictures)
    if stray.all() and len(full) > 1:
        return [(_WINDOWS[0][0], slice(None))]
    widest = np.bincount(picture, full > _WINDOWS[1][1], pictures)
    few = (wide < _FEW) & (widest > 0)
    group = np.where(full > _WINDOWS[1][1], 2, full > _WINDOWS[0][1])
    group = np.where(stray[picture], 0, np.where(few[picture], 2 * (group > 0), group))
    count = np.bincount(3 * picture + group, minlength=3 * pictures).reshape(-1, 3)
    rank = (-count).argsort(axis=1, kind="stable").argsort(axis=1)
    turn = 3 * rank[picture, group] + group
    return [(_WINDOWS[k % 3][0], not_one((turn == k).nonzero()[0])) for k in np.unique(turn)]


def levelled(y: F32, x: F32, noise: F32) -> tuple[F32, F32, F32]:
    """Windows with the ramp between their two ends taken out, where it is more than noise; their lower ends and tops.

    A line beside an edge of the room's own brightness would be fitted too wide. Everywhere else a ramp as a fifth
    parameter would cost a fifth of the accuracy.
    """
    left, right = ends(y)
    ramp = right - left
    low, top = np.minimum(left, right), y.max(axis=0)
    height = top - np.maximum(left, right)
    least = np.float32(4.5 * np.sqrt(2.0 / _end(y))) * noise
    steep = not_one((np.abs(ramp) >= np.maximum(least, np.float32(0.3) * height)).nonzero()[0])
    if steep.size:
        even = without_ramp(y.take(steep, axis=1), x, ramp[steep])
        y[:, steep] = even
        low[steep], top[steep] = np.minimum(*ends(even)), even.max(axis=0)
    return y, low, top


def without_ramp(y: F32, x: F32, ramp: F32) -> F32:
    """Windows (n, N) without the ramp that rises by so much (N,) from the middle of one end to that of the other."""
    return y - ramp * (x / span_of(y))


def span_of(y: F32) -> np.float32:
    """Columns from the middle of one end of windows (n, N) to that of the other [px]."""
    return np.float32(len(y) - _end(y))


def _end(y: F32) -> int:
    return max(2, len(y) // 6)


def ends(y: F32) -> tuple[F32, F32]:
    """Means (N,) of the samples at the two ends of the windows."""
    k = _end(y)
    if k == 2:
        return (y[0] + y[1]) * np.float32(0.5), (y[-1] + y[-2]) * np.float32(0.5)
    share = np.float32(1.0 / k)
    return y[:k].sum(axis=0) * share, y[-k:].sum(axis=0) * share
