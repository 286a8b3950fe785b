"""How a narrow place's light is shared among the channels: of itself, and of what is beside a saturated one."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.candidates import COLOURLESS
from scanmap.laserline.grey import runs_at

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Index = NDArray[np.intp]

_FLANK = 15  # [grey levels] that a flank must rise by
HALF = 9  # [px] samples on either side of a line that its colour is measured from
_SMEAR = 5  # [px] on either side of a line that its colour is smeared over
_EDGE = 0.5  # height of an edge of brightness, over the line's, that its light cannot be told across


def heights_of(image: U8, row: Index, column: Index) -> tuple[F32, NDArray[np.int16]]:
    """Heights (3, N) above their sides of N places of a picture (H, W, 3), by channel, and their middles' samples."""
    y = across(image, row, column)
    core = y[HALF - 2] + y[HALF - 1] + y[HALF] + y[HALF + 1] + y[HALF + 2]
    side = y[0] + y[1] + y[-2] + y[-1]
    return core * np.float32(0.2) - side * np.float32(0.25), y[HALF]


def light_added(y: F32, channel: int) -> F32:
    """Light (3, N) by channel that N narrow places of profiles y (2 HALF + 1, 3, N) add, a mean of five columns.

    An edge of brightness looks like light of the room's colour. There it is asked again: how much light there is in the
    laser's channel, of the columns next to the place; how far that leads the others, which an edge does not and which
    cameras smear, over all columns it is smeared over.
    """
    left, right = 0.5 * (y[0] + y[1]), 0.5 * (y[-2] + y[-1])
    side, middle = 0.5 * (left + right), y[HALF - 2 : HALF + 3].sum(axis=0)
    added: F32 = 0.2 * middle - side
    at = np.flatnonzero(np.abs(left[channel] - right[channel]) > _EDGE * added[channel])
    if at.size:
        y, side, middle = y[:, :, at], side[:, at], middle[:, at]
        smeared = 0.2 * (y[HALF - _SMEAR : HALF + _SMEAR + 1].sum(axis=0) - (2 * _SMEAR + 1) * side)
        near = middle[channel] + y[HALF - 3, channel] + y[HALF + 3, channel]
        beside = y[[HALF - 5, HALF - 4, HALF + 4, HALF + 5], channel].sum(axis=0)
        own = 0.2 * (near - 1.75 * beside)
        again = smeared - smeared[channel] + own
        share = [
            np.maximum(h[channel - 1], h[channel - 2]) / np.maximum(h[channel], 1.0) for h in (again, added[:, at])
        ]
        better = at[share[0] < share[1]]
        added[:, better] = again[:, share[0] < share[1]]
    return added


def flank_lead(y: NDArray[np.floating], channel: int, *, purer_side: bool = False) -> tuple[F32, F32]:
    """How far the laser's channel leads the others beside a saturated core, over how bright it is there (N,).

    Args:
        y: (n, 3, N) samples across the core.
        channel: the laser's.
        purer_side: of the light above the ends the purer side's counts, for the other may be an edge of brightness.

    Returns:
        the share of all the light there, and that of the light above the samples' ends; 1 where no flank is seen.
    """
    own, others, half = y[:, channel], (channel - 1, channel - 2), len(y) // 2
    # Where one of the others is cut, the other tells.
    clear = np.maximum(own, np.minimum(y[:, others[0]], y[:, others[1]])) < COLOURLESS
    index, sides = np.arange(y.shape[2]), (slice(0, half), slice(half, None))
    rises = [np.where(clear[side], own[side] - own[side].min(axis=0), 0.0) for side in sides]
    left, right = rises[0].argmax(axis=0), rises[1].argmax(axis=0) + half
    hidden = np.minimum(rises[0].max(axis=0), rises[1].max(axis=0)) < _FLANK
    # A column of the sensor that is always white has none: every beam does.
    bare = [
        np.where(clear[near], own[near] - own[side], 0.0).max(axis=0) < 0.5 * _FLANK
        for near, side in ((slice(half - 3, half), half - 4), (slice(half + 1, half + 4), half + 4))
    ]
    dark = np.maximum(own[half - 4], own[half + 4]) < COLOURLESS - 3 * _FLANK
    # And a saturated line whose flanks are farther out shows them there, on both sides.
    falls = np.minimum(own[half - 4] - own[half - 7], own[half + 4] - own[half + 7])
    dark &= falls < 2 * _FLANK
    fault = bare[0] & bare[1] & dark & (own[half - 1 : half + 2].max(axis=0) >= COLOURLESS)
    light = y[left, :, index] + y[right, :, index]
    near = 1.0 - light[:, others].max(axis=1) / np.maximum(light[:, channel], 1.0)
    # All of a side, for colour is smeared.
    total = [
        np.where(clear[side, None], y[side] - y[ends].mean(axis=0), 0.0).sum(axis=0)
        for side, ends in ((slice(2, half), [0, 1]), (slice(half, -2), [-2, -1]))
    ]
    beyond = np.zeros(y.shape[2], np.float32)
    for light_there in total if purer_side else [total[0] + total[1]]:
        share = np.maximum(light_there[others[0]], light_there[others[1]]) / np.maximum(light_there[channel], 1.0)
        beyond = np.where(light_there[channel] > _FLANK, np.maximum(beyond, 1.0 - share), beyond)
    near, beyond = (np.where(fault, 0.0, np.where(hidden, 1.0, lead)).astype(np.float32) for lead in (near, beyond))
    return near, beyond


def across(image: U8, row: Index, column: Index) -> NDArray[np.int16]:
    """Samples (2 HALF + 1, 3, N) around N places of a picture (H, W, 3)."""
    length = 2 * HALF + 1
    x = np.clip(column, HALF, image.shape[1] - 1 - HALF)
    runs = runs_at(image, row, 3 * (x - HALF), 3 * length)
    return np.asarray(cv2.transpose(runs), np.int16).reshape(length, 3, -1)
