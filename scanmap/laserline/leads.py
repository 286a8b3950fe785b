"""The quick look: one row of each block tells where the line is, unless something there comes near it."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from scanmap.laserline.candidates import COLOURLESS
from scanmap.laserline.grey import flat
from scanmap.laserline.path import CONNECTED_PX, JUMP

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
Mask = NDArray[np.bool_]

_CENTRE, _AWAY = 3, 4  # of the filter: width of its centre, distance of its sides, at each resolution
_LEVELS = 3  # resolutions: sums of 2, 4 and 8 columns
_APART_PX = 14.0  # what is nearer to the lead is its own
_LEAST_SNR = 12.0  # of a lead that is believed
_SETTLED = 2.0  # how far a chain's leads are ahead of their rivals, in costs of a jump there and back
_PURE = 0.4  # share of a line's height in other channels that no laser is doubted for
_LEAST_BLOCKS = 3


class Leads(NamedTuple):
    """The best place of each of B blocks, arrays (B,)."""

    column: F32  # [px] to a pixel or two
    height: F32  # over the brighter of its two sides [grey levels]
    rival: F32  # the highest elsewhere in the block [grey levels]


def find_leads(rows: U8, limits: tuple[F64, F64]) -> Leads:
    """The best place of each block, and the next best at three resolutions.

    Args:
        rows: (B, W) one row of each block.
        limits: first and last column (B,) that a block's line can have, NaN where it can have none.
    """
    sums, scale = _halved(rows), 2
    response = _allowed(_stands_out(sums), scale, limits)
    index = np.arange(len(rows))
    at = response.argmax(axis=1)
    height = response[index, at].astype(np.float32) * np.float32(1.0 / 6.0)
    column = (scale * at + 0.5 * (scale - 1)).astype(np.float32)
    rival = np.zeros_like(height)
    for level in range(_LEVELS):
        if level:
            sums, scale = _halved(sums), 2 * scale
            if sums.shape[1] <= 2 * _AWAY:
                break
            response = _allowed(_stands_out(sums), scale, limits)
        reach = max(int(_APART_PX) // scale, _CENTRE + 1)
        runs = sliding_window_view(response, min(2 * reach + 1, response.shape[1]), axis=1, writeable=True)
        runs[index, np.clip(column.astype(np.intp) // scale - reach, 0, runs.shape[1] - 1)] = 0
        np.maximum(rival, response.max(axis=1) * np.float32(1.0 / (_CENTRE * scale)), out=rival)
    return Leads(column, height, rival)


def settled(leads: Leads, noise: float, min_snr: float) -> Mask:
    """Blocks (B,) whose lead no path over the candidates would leave.

    A chain of leads that continue each other costs the path nothing, and every block of it gives more than any
    other place there. The path takes it whole unless a rival chain is so near in height that a jump there and
    back would pay.
    """
    # The noise of the largest of two sides and a centre of six samples, as of one row.
    unit = 1.35 * max(noise, 1.2) / np.sqrt(2.0 * _CENTRE)
    believed = (leads.height > _LEAST_SNR * unit) & (leads.height > leads.rival)
    ahead = np.log(np.maximum(leads.height, 1e-3) / np.maximum(leads.rival, min_snr * unit))
    linked = believed[1:] & believed[:-1] & (np.abs(np.diff(leads.column)) <= CONNECTED_PX)
    chain = np.concatenate([[0], np.cumsum(~linked)])
    long = np.bincount(chain) >= _LEAST_BLOCKS
    won = np.bincount(chain, ahead) > _SETTLED * JUMP
    good: Mask = believed & (long & won)[chain]
    return good


def of_one_colour(rows: U8, leads: Leads, channel: int, good: Mask) -> Mask:
    """Those of the `good` blocks (B,) whose lead is as pure as any laser or too bright to have a colour.

    Args:
        rows: (B, W, 3) BGR, one row of each block.
    """
    block = np.flatnonzero(good)
    pure = np.zeros(len(rows), bool)
    width = rows.shape[1]
    if not block.size or width < 19:
        return pure
    x = np.clip(np.rint(leads.column[block]).astype(np.intp), 9, width - 10)
    runs = sliding_window_view(flat(rows), 57, axis=1)[block, 3 * (x - 9)]
    samples = np.ascontiguousarray(runs.T).reshape(19, 3, -1).astype(np.int16)
    core = samples[7] + samples[8] + samples[9] + samples[10] + samples[11]
    side = samples[0] + samples[1] + samples[17] + samples[18]
    height = core * np.float32(0.2) - side * np.float32(0.25)
    own = height[channel]
    other = np.maximum(height[channel - 1], height[channel - 2])
    saturated = samples[7:12, channel].max(axis=0) >= COLOURLESS
    # The mean over neighbours on the same line is known far better than one row's.
    share = cv2.blur(np.stack([other, own]), (5, 1), borderType=cv2.BORDER_REPLICATE)
    pure[block] = saturated | ((other < _PURE * own) | (share[0] < 0.9 * _PURE * share[1]))
    return pure


def _halved(values: U8 | U16) -> U16:
    """Sums of pairs of columns (B, W // 2)."""
    even = values.shape[1] // 2 * 2
    if values.dtype == np.uint8 and values.flags.c_contiguous and even == values.shape[1]:
        # Two samples as one word, ten times the speed of every second sample.
        pairs = values.view(np.uint16)
        sums = np.asarray(pairs >> 8, np.uint16)
        sums += pairs & 255
        return sums
    return np.add(values[:, 0:even:2], values[:, 1:even:2], dtype=np.uint16)


def _stands_out(values: U16) -> U16:
    """Sum over the line's width minus the brighter of its two sides, at least 0; 0 where a side is missing."""
    summed = values[:, :-2] + values[:, 1:-1]
    summed += values[:, 2:]
    side = cv2.max(summed[:, : -2 * _AWAY], summed[:, 2 * _AWAY :])
    response = cv2.subtract(summed[:, _AWAY:-_AWAY], side)
    edge = _AWAY + _CENTRE // 2
    return np.asarray(cv2.copyMakeBorder(response, 0, 0, edge, edge, cv2.BORDER_CONSTANT, value=0), np.uint16)


def _allowed(response: U16, scale: int, limits: tuple[F64, F64]) -> U16:
    """The response, 0 outside the limits, in place."""
    first, last = limits
    width = response.shape[1]
    none = np.isnan(first)
    response[none] = 0
    if none.all():
        return response
    ends = np.array([np.nanmin(first), np.nanmax(first), np.nanmin(last), np.nanmax(last)]) / scale
    left, inner_left, inner_right, right = np.clip(np.rint(ends), -1, width).astype(np.intp)
    response[:, : max(left, 0)] = 0
    response[:, right + 1 :] = 0
    # Only between the extremes do rows differ.
    for start, stop in ((max(left, 0), inner_left + 1), (max(inner_right, 0), right + 1)):
        x = np.arange(start, min(stop, width), dtype=np.float32) * scale + 0.5 * (scale - 1)
        if stop - start > 2:
            response[:, start:stop][~((x >= first[:, None] - scale) & (x <= last[:, None] + scale))] = 0
    return response
