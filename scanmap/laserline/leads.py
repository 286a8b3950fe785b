"""The quick look: a row of every other block tells where the line is, unless something there comes near it."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.candidates import runs_in
from scanmap.laserline.path import JUMP
from scanmap.laserline.pictures import by_picture
from scanmap.laserline.shares import heights_of

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
Mask = NDArray[np.bool_]

_CENTRE, _AWAY = 3, 4  # of the filter: width of its centre, distance of its sides, at each resolution
_EDGE = _AWAY + _CENTRE // 2  # columns on either side that the filter cannot judge
_APART_PX = 14.0  # what is nearer to the lead is its own
_LEAST_SNR = 12.0  # of a lead that is believed
_SETTLED = 2.0  # how far a chain's leads are ahead of their rivals, in costs of a jump there and back
_PURE = 0.4  # share of a line's height in other channels that no laser is doubted for
_LEAST_BLOCKS = 3
STEEP_PX = 12.0  # a line that runs farther from one lead to the next is left to the path


class Leads(NamedTuple):
    """The best place of each of N rows of P pictures, arrays (P, N)."""

    column: F32  # [px] to a pixel or two
    height: F32  # over the brighter of its two sides [grey levels]
    rival: F32  # the highest elsewhere in the block [grey levels]
    beside: F32  # where that is [px]


def find_leads(rows: U8, limits: tuple[F64, F64]) -> Leads:
    """The best place of each block, and the next best at two resolutions.

    Args:
        rows: (P, N, W) one row of every other block of each of P pictures.
        limits: first and last column (N,) that a block's line can have, NaN where it can have none.
    """
    # One picture after the other: all of them together would not fit into the processor's cache.
    # As bytes, by which is known what has been told of them before.
    first, last = (limit.tobytes() for limit in limits)
    each = zip(*(_leads_of_one(own, first, last) for own in rows), strict=True)
    return Leads(*(np.concatenate(values).reshape(len(rows), -1) for values in each))


def _leads_of_one(rows: U8, first: bytes, last: bytes) -> Leads:
    sums, scale = _halved(rows), 2
    index = np.arange(len(rows))
    response = _allowed(_stands_out(sums), scale, first, last)
    at = response.argmax(axis=1)
    column = (scale * (at + _EDGE) + 0.5 * (scale - 1)).astype(np.float32)
    height = response[index, at] * np.float32(1.0 / (_CENTRE * scale))
    rival, beside = _highest_elsewhere(response, at, scale)
    sums, scale = _halved(sums), 2 * scale
    if sums.shape[1] > 2 * _EDGE + 2:
        response = _allowed(_stands_out(sums), scale, first, last)
        other, place = _highest_elsewhere(response, (at + _EDGE) // 2 - _EDGE, scale)
        beside = np.where(other > rival, place, beside)
        np.maximum(rival, other, out=rival)
    return Leads(column, height, rival, beside)


def _highest_elsewhere(response: U16, at: NDArray[np.intp], scale: int) -> tuple[F32, F32]:
    """The highest response (B,) of each block apart from the place `at` (B,) [grey levels], and its column [px]."""
    length = min(2 * max(int(_APART_PX) // scale, _CENTRE + 1) + 1, response.shape[1])
    runs, index = runs_in(response, length), np.arange(len(at))
    runs[index, np.minimum(np.maximum(at - length // 2, 0), runs.shape[1] - 1)] = 0
    place = response.argmax(axis=1)
    highest: F32 = response[index, place] * np.float32(1.0 / (_CENTRE * scale))
    return highest, (scale * (place + _EDGE) + 0.5 * (scale - 1)).astype(np.float32)


def settled(leads: Leads, noise: F64, min_snr: float) -> Mask:
    """Blocks (P, N) whose lead no path over the candidates would leave.

    A chain of leads that continue each other costs the path nothing, and every block of it gives more than any
    other place there. The path takes it whole unless a rival chain is so near in height that a jump there and
    back would pay.
    """
    # The noise of the largest of two sides and a centre of six samples, as of one row.
    unit = (1.35 / np.sqrt(2.0 * _CENTRE)) * np.maximum(noise, 1.2)[:, None]
    believed = (leads.height > _LEAST_SNR * unit) & (leads.height > leads.rival)
    ahead = np.log(np.maximum(leads.height, 1e-3) / np.maximum(leads.rival, min_snr * unit))
    linked = np.zeros(believed.shape, bool)
    linked[:, 1:] = believed[:, 1:] & believed[:, :-1] & (np.abs(np.diff(leads.column)) <= STEEP_PX)
    chain = np.cumsum(~linked) - 1
    long = np.bincount(chain) >= _LEAST_BLOCKS
    won = np.bincount(chain, ahead.ravel()) > _SETTLED * JUMP
    good: Mask = believed & (long & won)[chain].reshape(believed.shape)
    return good


def shares_of(rows: U8, leads: Leads, channel: int, good: Mask) -> F32:
    """Height of the leads in the other channels over their own (P, N); NaN where a lead may be of another colour.

    Args:
        rows: (P N, W, 3) BGR, one row of every other block.
        channel: the laser's own.
        good: (P, N) the leads in question.

    As pure as any laser is: clipped, a line's own height is too small and its share too large, never too pure.
    """
    block = np.flatnonzero(good)
    shares = np.full(good.size, np.nan, np.float32)
    if not block.size:
        return shares.reshape(good.shape)
    height, _ = heights_of(rows, block, np.rint(leads.column.ravel()[block]).astype(np.intp))
    own, other = height[channel], np.maximum(height[channel - 1], height[channel - 2])
    # The mean over neighbours on the same line is known far better than one row's.
    smooth = np.stack([other, own])
    for part in by_picture(block // good.shape[1], len(good)):
        if part.stop > part.start:
            smooth[:, part] = cv2.blur(smooth[:, part], (5, 1), borderType=cv2.BORDER_REPLICATE)
    share = smooth[0] / np.maximum(smooth[1], np.float32(1.0))
    pure = (other < _PURE * own) | (share < 0.9 * _PURE)
    shares[block[pure]] = share[pure]
    return shares.reshape(good.shape)


def _halved(values: U8 | U16) -> U16:
    """Sums of pairs of columns (B, W // 2)."""
    even = values.shape[1] // 2 * 2
    if values.dtype == np.uint8 and values.flags.c_contiguous and even == values.shape[1]:
        # Two samples as one word, ten times the speed of every second sample.
        pairs = values.view(np.uint16)
        sums = np.asarray(pairs >> 8, np.uint16)
        sums += pairs & 255
        return sums
    if values.flags.c_contiguous and even == values.shape[1]:
        both = values.view(np.uint32)
        high = both >> 16
        high += both  # its lower half is the sum of both
        return high.astype(np.uint16)
    return np.add(values[:, 0:even:2], values[:, 1:even:2], dtype=np.uint16)


def _stands_out(values: U16) -> U16:
    """Sum over the line's width minus the brighter of its two sides, at least 0, from column _EDGE on.

    As many columns (B, W) as there are values, the last ones 0: one row after the other is summed as if they were one.
    """
    row = values.reshape(1, -1)
    summed = row[:, :-2] + row[:, 1:-1]
    summed += row[:, 2:]
    side = cv2.max(summed[:, : -2 * _AWAY], summed[:, 2 * _AWAY :])
    response = np.empty_like(values)
    cv2.subtract(summed[:, _AWAY:-_AWAY], side, response.reshape(1, -1)[:, : -2 * _EDGE])
    response[:, -2 * _EDGE :] = 0
    return response


def _allowed(response: U16, scale: int, first: bytes, last: bytes) -> U16:
    """The response, 0 outside the limits, in place."""
    left, right, uneven, none = _beyond(first, last, scale, response.shape[1])
    if none.size:
        response[none] = 0
    response[:, :left] = 0
    response[:, right + 1 :] = 0
    for start, inside in uneven:
        response[:, start : start + inside.shape[1]] *= inside
    return response


@lru_cache(maxsize=8)
def _beyond(
    first: bytes, last: bytes, scale: int, width: int
) -> tuple[int, int, list[tuple[int, U16]], NDArray[np.intp]]:
    """First and last column (of `width`) of a response in the limits (N,), the same for every picture of a scan.

    And where rows differ: a first column, and (N, n) 1 for what is within; and rows without limits.
    """
    low, high = np.frombuffer(first), np.frombuffer(last)
    none = np.isnan(low).nonzero()[0]
    if len(none) == len(low):
        return width, width, [], none
    # In columns of the response, which lacks the picture's edge; only between the extremes do rows differ.
    ends = np.array([np.nanmin(low), np.nanmax(low), np.nanmin(high), np.nanmax(high)]) / scale - _EDGE
    left, inner_left, inner_right, right = np.minimum(np.maximum(np.rint(ends), 0), width).astype(np.intp).tolist()
    uneven = []
    for start, stop in ((left, inner_left + 1), (inner_right, right + 1)):
        if stop - start > 2:
            x = np.arange(start + _EDGE, min(stop, width) + _EDGE, dtype=np.float32) * scale + 0.5 * (scale - 1)
            inside = (x >= low[:, None] - scale) & (x <= high[:, None] + scale)
            uneven.append((start, inside.astype(np.uint16)))
    return left, right, uneven, none
