"""Which channel of a colour picture the laser shows in, judged from the picture."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

U8 = NDArray[np.uint8]

SATURATED = 250  # [grey levels] from here on a sample says only "bright"
# Pairs of rows that the laser's colour is measured on: more where few do not tell; and what does, in grey levels.
_COLOUR_PAIRS = (4, 12, 32)
_CLEAR_RATIO, _CLEAR = 2.5, 15.0
# Blue line lasers are rare, and what is blue in a room without any is not: they must stand out twice as much.
_USUAL = (0.5, 1.0, 1.0)
_NARROW_PX, _BRIGHT_PX = (5, 160), (16, 40)  # distance of a line's sides: at least, and as a part of the width
_BLAZING, _ALONE = 240, 100  # [grey levels] of a channel, and above the other two
# What a place counts at most beside the others of its chain [grey levels], and what a chain pays for going on
# elsewhere, in such places; columns a row that a line runs at most.
_ENOUGH, _JUMP, _STEEP = 30, 2, 1.0
_MANY = 0.3  # share of the rows
_DARK, _TINT = 12, 0.5  # [grey levels] of a dark room; the least factor that brings a channel's light to grey


def laser_channel(image: U8) -> int:
    """Channel (0 blue, 1 green, 2 red) of a BGR image in which a narrow bright line stands out by its colour."""
    return judged_channel(image)[0]


def judged_channel(image: U8, background: U8 | None = None) -> tuple[int, bool]:
    """The laser's channel (0 blue, 1 green, 2 red) in a BGR image, and whether there is no doubt about it.

    With a `background`, of the same view with the laser off, in what that lacks.

    Measured on some pairs of rows: how far the best place rises above both its sides in the channel and in the
    channel's lead over each of the other two, whichever is least, and in both rows; the better half of the pairs
    counts. So neither white things vote, however bright, nor wide coloured ones, nor specks; and green light on red
    wood, where red remains the brighter, is still green. Where the core saturates every channel alike, its flanks
    still have the laser's colour and lend it theirs. Where few pairs do not tell, more do, and in the end it counts
    what goes on from pair to pair: the line does, and cables, spines of books and skin do not.
    """
    for pairs in _COLOUR_PAIRS:
        step = max(1, len(image) // pairs)
        above, below = (_every(step, first, image, background) for first in (0, min(2, len(image) - 1)))
        n = len(below)
        both_rows = np.concatenate([above[:n], below])
        planes = _planes(both_rows if background is not None else _neutral(both_rows))
        cut = _planes(np.asarray(cv2.threshold(both_rows, SATURATED - 1, 255, cv2.THRESH_BINARY)[1], np.uint8))
        rows = [plane[:n] for plane in planes]
        blazing = _blazing_channel(rows)
        if blazing is not None:
            return blazing, True
        upper, lower = _by_colour(planes, cut).reshape(3, 2, n, -1).swapaxes(0, 1).reshape(2, 3 * n, -1)
        both = np.asarray(cv2.min(upper, cv2.dilate(lower, np.ones((1, 5), np.uint8))), np.uint8)
        best = np.sort(both.max(axis=1).reshape(3, n), axis=1)
        strength = [rare * float(rising[n // 2 :].mean()) for rare, rising in zip(_USUAL, best, strict=True)]
        second, first = sorted(strength)[1:]
        clear = first > max(_CLEAR_RATIO * second, _CLEAR)
        if pairs == _COLOUR_PAIRS[0]:
            # So few must agree, nearly all of them.
            clear &= bool(best[int(np.argmax(strength))][n // 4] > max(_CLEAR_RATIO * second, _CLEAR))
        if clear:
            return int(np.argmax(strength)), True
    # A grey picture in three channels has no lead at all: then the brightest line counts.
    if first <= 1.0:
        strength = [float(_ridge(plane, max(9, image.shape[1] // 96)).max(axis=1).mean()) for plane in rows]
    else:
        strength = [rare * chain for rare, chain in zip(_USUAL, _chains(both.reshape(3, n, -1), step), strict=True)]
    return int(np.argmax(strength)), False


def _neutral(rows: U8) -> U8:
    """Rows (n, W, 3) with the room's usual colour taken for grey: what is white in coloured light is not coloured.

    The median, which the line's own light does not reach, of a dark room hardly counts. Source: Buchsbaum 1980.
    """
    usual = np.median(rows[:, ::8].reshape(-1, 3), axis=0) + _DARK
    factor = np.clip(usual.min() / usual, _TINT, 1.0)
    return np.asarray(cv2.transform(rows, np.diag(factor).astype(np.float32)), np.uint8)


def _every(step: int, first: int, image: U8, background: U8 | None) -> U8:
    """Some rows (n, W, 3) of a picture, less those of the background as each channel is exposed."""
    rows = image[first::step]
    if background is None:
        return rows
    off = background[first::step]
    for_each = np.diag([exposure_gain(rows[:, ::4, c], off[:, ::4, c]) for c in range(3)]).astype(np.float32)
    return np.asarray(cv2.subtract(rows, cv2.transform(off, for_each)), np.uint8)


def exposure_gain(plane: U8, background: U8) -> float:
    """What laser-off samples must be multiplied by to match the laser-on ones where neither saturates."""
    on, off = plane.astype(np.float32), background.astype(np.float32)
    usable = (off > 8) & (off < 240) & (on < 240)
    return float(np.median(on[usable] / off[usable])) if np.count_nonzero(usable) > 50 else 1.0


def _chains(rising: U8, step: int) -> list[float]:
    """The best sum along a chain of places, one in each of n rows `step` apart, for each channel (3, n, W)."""
    enough = np.minimum(rising, _ENOUGH).astype(np.float32)
    reach = np.ones((1, 2 * max(2, int(_STEEP * step)) + 1), np.uint8)
    total = enough[:, 0].copy()
    for row in range(1, enough.shape[1]):
        elsewhere = total.max(axis=1, keepdims=True) - _JUMP * _ENOUGH
        total = enough[:, row] + np.maximum(cv2.dilate(total, reach), elsewhere)
    return [float(best) for best in total.max(axis=1)]


def _planes(rows: U8) -> list[U8]:
    return [np.asarray(plane, np.uint8) for plane in cv2.split(np.ascontiguousarray(rows))]


def _by_colour(planes: Sequence[U8], cut: Sequence[U8]) -> U8:
    """How far each place (n, W) rises in a channel and in its leads over the others; the channels below each other.

    Args:
        planes: (n, W) each.
        cut: (n, W) each, 255 where the picture was saturated.
    """
    # The channels below each other: a third of the calls.
    own, after, before = (np.concatenate([planes[(c + k) % 3] for c in range(3)]) for k in range(3))
    white = np.tile(np.asarray(cv2.max(cv2.max(cut[0], cut[1]), cut[2]), np.uint8), (3, 1))
    # The leads are halved to fit eight bits.
    leads = [np.asarray(cv2.addWeighted(own, 0.5, other, -0.5, 128.0), np.uint8) for other in (after, before)]
    width = own.shape[1]
    rise = _least(own, leads, white, max(_NARROW_PX[0], width // _NARROW_PX[1]), 5)
    clipped = np.concatenate(cut)
    if np.asarray(cv2.erode(clipped, np.ones((1, 3), np.uint8))).any():
        # A saturated core of some width may be wider than that.
        away = max(_BRIGHT_PX[0], width // _BRIGHT_PX[1])
        wide = cv2.min(_least(own, leads, white, away, 2 * away + 1), clipped)
        rise = np.asarray(cv2.max(rise, wide), np.uint8)
    return rise


def _least(own: U8, leads: Sequence[U8], white: U8, away: int, around: int) -> U8:
    """The least rise (n, W) of a channel and of its leads, which white places are lent from `around` them."""
    rise = _ridge(own, away)
    for lead in leads:
        half = _ridge(_lent(lead, white, around), away)
        rise = np.asarray(cv2.min(cv2.add(half, half), rise), np.uint8)
    return rise


def _lent(lead: U8, white: U8, around: int) -> U8:
    """A lead (n, W) whose white places have the largest of those within `around` columns that are not."""
    if not white.any():
        return lead
    lent = cv2.dilate(cv2.subtract(lead, white), np.ones((1, around), np.uint8))
    return np.asarray(cv2.copyTo(lent, white, lead.copy()), np.uint8)


def _ridge(plane: U8, away: int) -> U8:
    """Mean of three columns less the brighter of those `away` columns to either side, at least 0."""
    core = cv2.blur(plane, (3, 1))
    padded = cv2.copyMakeBorder(core, 0, 0, away, away, cv2.BORDER_REPLICATE)
    return np.asarray(cv2.subtract(core, cv2.max(padded[:, : -2 * away], padded[:, 2 * away :])), np.uint8)


def _blazing_channel(planes: Sequence[U8]) -> int | None:
    """The channel that is nearly saturated and alone in it, side by side, in a good part of the rows (n, W) of three.

    On a near surface the line is a bar so wide that nothing of it is narrow in its own colour; what is narrow there
    are the other channels. Nothing else in a room is as bright as that in one colour only.
    """
    share = [0.0, 0.0, 0.0]
    for c in range(3):
        some = np.flatnonzero(planes[c].max(axis=1) > _BLAZING)
        if len(some) > _MANY * len(planes[c]):
            plane, one, two = (np.ascontiguousarray(planes[k][some]) for k in (c, c - 1, c - 2))
            _, alone = cv2.threshold(cv2.subtract(plane, cv2.max(one, two)), _ALONE, 255, cv2.THRESH_BINARY)
            _, bright = cv2.threshold(plane, _BLAZING, 255, cv2.THRESH_BINARY)
            run = np.asarray(cv2.erode(cv2.min(alone, bright), np.ones((1, 5), np.uint8)))
            share[c] = np.count_nonzero(run.max(axis=1)) / len(planes[c])
    best = int(np.argmax(share))
    return best if share[best] > _MANY else None
