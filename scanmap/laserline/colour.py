"""The laser's colour, measured from the picture, and what in it is not of that colour."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.candidates import BLOCK, COLOURLESS, Candidates, is_large, unit_of
from scanmap.laserline.grey import runs_at
from scanmap.laserline.path import CONNECTED_PX
from scanmap.laserline.result import LaserLine
from scanmap.laserline.runs import numbered
from scanmap.laserline.shares import HALF, across, flank_lead, light_added

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_GREY = 6  # [grey levels] what compression makes the channels of a grey picture differ by at most
_COLOURLESS_SHARE = 0.85  # a line that stands out in other channels this much has no colour to tell it by
# A run is not the laser line from this share of its height in another channel on.
_STRANGER = 0.62
_UNTOLD = 0.5  # what a saturated candidate's score is worth beside one that shows the laser's colour
# Lead over another channel, in heights of a beam like it and in grey levels, that only what takes light can have; part
# of such a beam's height, for each pixel of its width, that a mean of five columns has.
_TAKES, _CORE_LIGHT = (1.5, 4.0), 0.45
_MOSTLY = 0.75  # share of a run's rows
_PURE = 0.45  # height in other channels of a line whose flanks must show its colour
# A place's share may exceed the laser's by so much, and even where that makes it nearly white by the less.
_BLEEDS, _WHITISH = (0.4, 0.05), 0.8
# By how much the laser's channel leads beside a saturated core, as a share of all light there and of the core's own:
# white by the less, coloured by the more.
_NEAR, _LEAD = (0.07, 0.11), (0.1, 0.3)
# From which share of its rows on a run's core is saturated. What then lags behind the laser's channel by the second
# [grey levels], not cut, is not white; nor is, of other runs, what has less than the third in other channels.
_CLIPPED, _COLOURED, _SURELY = 0.3, 10.0, 0.95
_BRIGHT = 170.0  # [grey levels] beside a core
_NEARBY = 8  # rows of a run on either side of one that are asked with it
_BROAD, _COARSE = 0.6, 4  # part of a candidate's height that narrow ones show near by; columns a sample of others
_TELLING_SNR = 12.0  # of a candidate whose colour is worth asking for
_CHAIN_SHARE = 0.06  # of all blocks, at least, in the chains that the laser's colour is measured from


class _Colours(NamedTuple):
    """What N places show of their colour, arrays (N,)."""

    own: F32  # height in the laser's channel [grey levels], at least 1
    other: F32  # in that of the others where it is highest
    saturated: Mask
    near: F32  # see `flank_lead`; 1 where not saturated
    beyond: F32


def blocks_of(image: U8, channel: int) -> U8:
    """Mean (B, W) of the two middle rows of each block of one channel of a BGR image (H, W, 3)."""
    blocks = -(-len(image) // BLOCK)
    first, second = (
        np.asarray(cv2.extractChannel(image[min(k, len(image) - 1) :: BLOCK], channel), np.uint8) for k in (1, 2)
    )
    first, second = (
        rows if len(rows) == blocks else np.concatenate([rows, np.asarray(cv2.extractChannel(image[-1:], channel))])
        for rows in (first, second)
    )
    return np.asarray(cv2.addWeighted(first, 0.5, second, 0.5, 0.0), np.uint8)


def without_colour(image: U8) -> bool:
    """Whether the three channels of a picture (H, W, 3) are one.

    Asked of whole rows: in a grey room the laser line is the only colour there is, a few pixels in a row.
    """
    blue, green, red = cv2.split(np.ascontiguousarray(image[:: max(1, len(image) // 16)]))
    apart = np.asarray(cv2.max(cv2.absdiff(red, green), cv2.absdiff(green, blue)), np.uint8)
    return bool(np.count_nonzero(apart.max(axis=1) > _GREY) <= 0.1 * len(apart))


def colour_doubt(image: U8, channel: int, candidates: Candidates, noise: float, shares: F32) -> F32:
    """Factors (B, COUNT) for the candidates' scores: 1 for the laser's colour, down to 0 for another.

    Args:
        image: (H, W, 3).
        channel: the laser's own.
        noise: standard deviation of a sample [grey levels].
        shares: (B,) of the first candidates that are beyond doubt, NaN where they are not.

    The laser's colour is measured from candidates that continue each other over several blocks, as the height of
    the line in the other channels over its height in its own: the light is of one colour, so whatever it falls on,
    that share stays, and nothing that hangs together is purer. A candidate is in doubt when another channel
    rises above it by more than noise explains. Where its own channel is saturated, colour says nothing,
    and what shows the laser's is worth more.
    """
    doubt = np.ones_like(candidates.snr)
    block, which = np.nonzero((candidates.snr > 3.0) & np.isnan(shares)[:, None])
    if not block.size or len(image) < BLOCK or image.shape[1] <= 2 * HALF:
        return doubt
    column, response = candidates.column[block, which], candidates.snr[block, which] * unit_of(noise, is_large(image))
    near_by = _colours(image, block, column, channel, 1)
    # What hardly rises so near by is a wide thing: it is asked on the scale it was found on too.
    broad = np.flatnonzero(near_by.own < _BROAD * response)
    if image.shape[1] <= (2 * HALF + 1) * _COARSE:
        broad = broad[:0]
    # A picture narrower than that scale has no profile to take there, not even of no candidate.
    coarse = _colours(image, block[broad], column[broad], channel, _COARSE if broad.size else 1)
    share = np.full(candidates.snr.shape, np.nan, np.float32)
    # Clipped, a line's own height is too small and its share too large: still a bound for the laser's.
    share[:, 0] = shares
    share[block, which] = near_by.other / near_by.own
    share[block[broad], which[broad]] = coarse.other / coarse.own
    laser = _laser_share(candidates, share, shares)
    factor = _of_laser(near_by, laser, noise)
    # A line on a wide thing counts for what it rises by itself; and what is wide must rise on its scale.
    part = np.minimum(near_by.own[broad] / response[broad], 1.0)
    wide = np.where(coarse.own > near_by.own[broad], _of_laser(coarse, laser, noise), 0.0)
    factor[broad] = np.maximum(part * factor[broad], wide)
    doubt[block, which] = factor
    return doubt


def _colours(image: U8, block: Index, column: F32, channel: int, scale: int) -> _Colours:
    """What the rows of blocks (N,) show around columns (N,), on a scale."""
    profile, brightest = _profiles(image, block, column, scale)
    near, beyond = np.ones((2, len(block)), np.float32)
    at = np.flatnonzero(brightest[channel] >= COLOURLESS)
    if at.size:
        near[at], beyond[at] = flank_lead(profile[..., at], channel)
    if scale > 1:
        profile = profile.reshape(2 * HALF + 1, scale, 3, -1).mean(axis=1)
    height = light_added(profile, channel)
    own, other = np.maximum(height[channel], 1.0), np.maximum(height[channel - 1], height[channel - 2])
    return _Colours(own, other, brightest[channel] >= COLOURLESS, near, beyond)


def _of_laser(seen: _Colours, laser: float | None, noise: float) -> F32:
    """Factors (N,): 1 for the laser's colour, down to 0 for another."""
    # A core with no flank in sight is wider than lines are; what bars are is judged elsewhere.
    told = np.where(seen.near < 1.0, 1.0, _UNTOLD).astype(np.float32)
    coloured: F32 = told * np.maximum(_between(seen.near, *_NEAR), _between(seen.beyond, *_LEAD))
    if laser is None or laser > _COLOURLESS_SHARE:
        return np.asarray(np.where(seen.saturated, coloured, 1.0), np.float32)
    # Chroma is stored at half the columns by most cameras: the line's colour bleeds, its share by half that again.
    limit = max(min(max(laser, 0.0) + _BLEEDS[0], _WHITISH), laser + _BLEEDS[1])
    excess = seen.other - limit * seen.own
    uncertain = 3.0 * noise / np.sqrt(2.0 * BLOCK)
    factor = np.clip(1.0 - (excess - uncertain) / np.maximum(uncertain, 0.2 * seen.own), 0.0, 1.0)
    # Where a laser of pure colour saturates white, what is beside the core still has the colour.
    pure = told * _between(seen.beyond, *_LEAD) if laser < _PURE else _UNTOLD * coloured
    return np.asarray(np.where(seen.saturated, np.maximum(factor, pure), factor), np.float32)


def strangers(line: LaserLine, image: U8, channel: int, pure: Mask, rows: int) -> tuple[Mask, Mask]:
    """Rows (P H,) in runs of another colour than the laser's; and those sure to be.

    Args:
        line: (P H,) of P pictures below each other.
        image: (P H, W, 3).
        channel: the laser's own.
        pure: (P H,) rows known to be of its colour; a run of mostly such is not asked.
        rows: of a picture, H.

    What stands out in another channel nearly as much as in the laser's own is of another colour; and so is what leads
    another channel by far more than it rises itself, for a laser takes no light. Over a whole run the shares of the
    channels are known far better than in a row; of a run that is in doubt the parts are asked. Where the core saturates
    they say nothing, but what is beside it must not be white; where that is bright itself, as a white board is, it
    hardly can be anything else, and the core must not be white.
    """
    column = line.column_px
    lost = np.zeros(len(column), bool)
    row = np.flatnonzero(np.isfinite(column))
    if not row.size or image.shape[1] <= 2 * HALF:
        return lost, lost
    run = numbered(row, column[row], 1, rows)
    doubtful = (np.bincount(run, pure[row]) < _MOSTLY * np.bincount(run))[run]
    if not doubtful.any():
        return lost, lost
    row, run = row[doubtful], run[doubtful]
    middle = np.rint(column[row]).astype(np.intp)
    y = across(image, row, middle)
    height = light_added(y.astype(np.float32), channel)
    clipped = y[HALF, channel] >= COLOURLESS
    count = np.bincount(run)
    whole = line.peak[row] * np.minimum(_CORE_LIGHT * line.width_px[row], 1.0)
    values = (*height, clipped, whole)
    by_run = np.array([np.bincount(run, value) for value in values])
    coloured, bright = _core_of(y, channel, run)
    lost[row] = _white_beside(image, row, middle, channel, clipped, run) & ~(coloured & bright)[run]
    stranger = _in_other_channels(by_run, count, channel)[run]
    if stranger.any():
        # Sums over the rows nearby as differences of sums from the start.
        total = np.zeros((len(values), len(row) + 1))
        np.cumsum(values, axis=1, out=total[:, 1:])
        index = np.arange(len(row))
        first = np.maximum(index - _NEARBY, np.searchsorted(run, run))
        stop = np.minimum(index + _NEARBY + 1, np.searchsorted(run, run, side="right"))
        stranger &= _in_other_channels(total[:, stop] - total[:, first], stop - first, channel)
        lost[row[stranger]] = True
    heights = by_run[:3]
    share = np.maximum(heights[channel - 1], heights[channel - 2]) / np.maximum(heights[channel], 1.0)
    sure = lost.copy()
    sure[row[np.where(by_run[3] > _CLIPPED * count, coloured, share < _SURELY)[run]]] = False
    return lost, sure


def _core_of(y: NDArray[np.int16], channel: int, run: Index) -> tuple[Mask, Mask]:
    """Runs (n,) whose cores are not white though they saturate, and runs on something bright.

    Args:
        y: (2 HALF + 1, 3, N) samples across the rows of the runs (N,).
    """
    core, side = (
        np.array([np.bincount(run, values) for values in part]) / np.maximum(np.bincount(run), 1)
        for part in (y[HALF], 0.5 * np.maximum(y[0] + y[1], y[-1] + y[-2]))
    )
    others = core[[channel - 1, channel - 2]]
    coloured = (others < COLOURLESS) & (core[channel] - others > _COLOURED)
    return coloured.any(axis=0), side[channel] > _BRIGHT


def _between(values: F32, low: float, high: float) -> F32:
    """0 below `low`, 1 above `high`, straight between."""
    part: F32 = np.clip((values - low) / (high - low), 0.0, 1.0)
    return part


def _white_beside(image: U8, row: Index, middle: Index, channel: int, clipped: Mask, run: Index) -> Mask:
    """Rows (N,) of runs whose core saturates with white beside it: a gap in a blind, a tube of light."""
    white = np.zeros(len(row), bool)
    many = np.bincount(run, clipped) > _CLIPPED * np.bincount(run)
    at = np.flatnonzero(many[run] & clipped)
    if at.size:
        leads = flank_lead(across(image, row[at], middle[at]).astype(np.float32), channel, purer_side=True)
        seen = leads[0] < 1.0
        count = np.bincount(run[at], seen, minlength=len(many))
        near, beyond = (np.bincount(run[at], seen * lead, minlength=len(many)) for lead in leads)
        white = (many & (near < sum(_NEAR) / 2 * count) & (beyond < sum(_LEAD) / 2 * count))[run]
    return white


def _in_other_channels(total: NDArray[np.float64], rows: Index, channel: int) -> Mask:
    """Whether parts stand out in another channel, or take light there.

    Args:
        total: (5, N) sums of heights by channel, of clipped rows, of heights that beams would have.
        rows: (N,) of the parts.
    """
    own, others = total[channel], total[:3][[channel - 1, channel - 2]]
    takes = own - others.min(axis=0) > _TAKES[0] * np.maximum(own, total[4]) + _TAKES[1] * rows
    in_other: Mask = ((others.max(axis=0) > _STRANGER * own) | takes) & (total[3] < _CLIPPED * rows)
    return in_other


def _profiles(image: U8, block: Index, column: F32, scale: int) -> tuple[F32, U8]:
    """Mean profiles (scale (2 HALF + 1), 3, N) of blocks' rows around N candidates, and their brightest cores (3, N).

    Args:
        scale: how much wider than the narrowest.
    """
    height, width = image.shape[:2]
    row = np.minimum(block * BLOCK, height - BLOCK)
    length = (2 * HALF + 1) * scale
    first = np.clip(np.rint(column).astype(np.intp) - length // 2, 0, width - length)
    runs = [runs_at(image, row + k, 3 * first, 3 * length) for k in range(BLOCK)]
    total, brightest = runs[0].astype(np.uint16), runs[0]
    for run in runs[1:]:
        total += run
        brightest = np.maximum(brightest, run)
    core = brightest.reshape(-1, length, 3)[:, (HALF - 2) * scale : (HALF + 3) * scale].max(axis=1)
    profile = (total * np.float32(1.0 / BLOCK)).reshape(-1, length, 3)
    return profile.transpose(1, 2, 0), core.T


def _laser_share(candidates: Candidates, share: F32, settled: F32) -> float | None:
    """Height of the line in other channels over its own: the purest that enough connected candidates agree on."""
    least = max(6.0, _CHAIN_SHARE * len(share))
    sure = settled[~np.isnan(settled)]
    if 2 * len(sure) > len(settled) and len(sure) > least:
        return float(np.sort(sure)[int(least)])
    telling = np.isfinite(share) & (candidates.snr > _TELLING_SNR)
    # A candidate is part of a chain when the blocks above and below go on from it in place and colour.
    with np.errstate(invalid="ignore"):
        goes_on = np.abs(candidates.column[1:, None, :] - candidates.column[:-1, :, None]) <= CONNECTED_PX
        goes_on &= np.abs(share[1:, None, :] - share[:-1, :, None]) <= 0.25
    goes_on &= telling[1:, None, :] & telling[:-1, :, None]
    chained = telling.copy()
    for _ in range(2):
        above = (goes_on & chained[:-1, :, None]).any(axis=1)
        below = (goes_on & chained[1:, None, :]).any(axis=2)
        chained[1:-1] &= above[:-1] & below[1:]
        chained[0], chained[-1] = False, False
    shares = np.sort(share[chained])
    if len(shares) < least:
        return None
    # The median of the purest part: as many candidates as a chain must have, twice over.
    return float(shares[int(min(least, len(shares) - 1))])
