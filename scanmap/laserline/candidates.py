"""Where the line could be: a few columns per block of rows, and the path through them."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

BLOCK = 4  # rows summed into one: a quarter of the search, twice the signal to noise
COUNT = 3  # candidates per block
# The matched filter: width of its centre and distance of the two sides that the line must outshine [px]. It is used
# at full, half and quarter resolution, for lines of sigma 0.7 to 8 px.
_CENTRE, _AWAY = 5, 7
_MARGIN = 48  # [px] what the filter needs beside the window at quarter resolution; divisible by 4
_COLOURLESS_SHARE = 0.7  # a line that stands out in other channels this much has no colour to tell it by
_COLOURLESS = 240  # [grey levels] from here on a sample has no colour
_APART = 14  # [px] two candidates are at least this far apart: nearer ones are one line in two filters
_CONNECTED_PX = 9.0  # a line does not run farther than this from block to block
_JUMP = 1.6  # what leaving a line costs, in logarithms of signal to noise


class Candidates(NamedTuple):
    """Candidates of B blocks, strongest first; arrays (B, COUNT)."""

    column: F32  # [px] in the whole image, to a pixel or two
    snr: F32  # response over the noise; 0 where there is none


def noise_of(plane: U8) -> float:
    """Standard deviation of a sample's noise [grey levels], from differences of neighbours in a few rows."""
    rows = plane[:: max(1, len(plane) // 48)].astype(np.int16)
    step = np.abs(rows[:, 1:] - rows[:, :-1])
    # Half of all differences of Gaussian noise lie below 0.954 sigma; counting is finer than the median of integers.
    count = np.bincount(step.ravel(), minlength=64)[:64].cumsum() / step.size
    k = int(np.searchsorted(count, 0.5))
    below = count[k - 1] if k else 0.0
    median = k - 0.5 + (0.5 - below) / max(count[k] - below, 1e-9)
    return float(max(median / 0.954, 0.3))


def find_candidates(plane: U8, window: NDArray[np.float64], noise: float, other: U8 | None = None) -> Candidates:
    """The strongest narrow bright places of each block of rows.

    Args:
        plane: (H, W).
        window: (H, 2) first and last column of each row, NaN where a row can have no line.
        noise: standard deviation of a sample [grey levels].
        other: (H, W) a channel in which the laser hardly shows; what stands out there too is a thing, not the line.

    The response is the mean over the line minus the brighter of its two sides: a wide bright blob and an edge
    have a bright side and score nothing.
    """
    height, width = plane.shape
    blocks = -(-height // BLOCK)
    first, last = _block_window(window, blocks)
    low = max(0, int(np.nanmin(first)) - _MARGIN)
    high = min(width, int(np.nanmax(last)) + _MARGIN + 1)
    own = _by_block(plane[:, low:high], blocks)
    if other is None:
        response = _response(own.sum(axis=1, dtype=np.uint16), None, None)
    else:
        elsewhere = _by_block(other[:, low:high], blocks).sum(axis=1, dtype=np.uint16)
        # A saturated core says nothing of its colour, nor do the columns beside it that optics and chroma blur.
        saturated = (own.max(axis=1) >= _COLOURLESS).view(np.uint8)
        saturated = np.asarray(cv2.dilate(saturated, np.ones((1, 9), np.uint8)), np.uint8)
        response = _response(own.sum(axis=1, dtype=np.uint16), elsewhere, saturated)
    x = np.arange(low, high, dtype=np.float32)
    if (np.nanmax(first) - np.nanmin(first) > 1) or (np.nanmax(last) - np.nanmin(last) > 1) or np.isnan(first).any():
        outside = (x < first[:, None]) | (x > last[:, None]) | np.isnan(first)[:, None]
        response[outside] = 0
    else:
        response[:, : int(np.ceil(first[0])) - low] = 0
        response[:, int(np.floor(last[0])) - low + 1 :] = 0
    column = np.empty((blocks, COUNT), np.float32)
    snr = np.empty((blocks, COUNT), np.float32)
    rows = np.arange(blocks)
    around = np.arange(-_APART, _APART + 1)
    for k in range(COUNT):
        best = response.argmax(axis=1)
        column[:, k], snr[:, k] = best + low, response[rows, best]
        if k + 1 < COUNT:
            response[rows[:, None], np.clip(best[:, None] + around, 0, response.shape[1] - 1)] = 0
    # A mean of 5 columns of 4 rows, minus the larger of two such: 1.35 / sqrt(5) of the sum's noise.
    snr /= np.float32(max(noise, 1.2) * 1.35 * np.sqrt(BLOCK / _CENTRE))
    return Candidates(column, snr)


def colour_doubt(image: U8, channel: int, candidates: Candidates, noise: float) -> F32:
    """Factors (B, COUNT) for the candidates' scores: 1 for the laser's colour, down to 0 for another.

    Args:
        image: (H, W, 3).
        channel: the laser's own.
        noise: standard deviation of a sample [grey levels].

    The laser's colour is measured from the strongest candidates, as the height of the line in the other
    channels over its height in its own: the light is of one colour, so whatever it falls on, that share stays. A
    candidate is in doubt when another channel rises above it by more than noise explains. Where its own channel is
    saturated, colour says nothing.
    """
    rows = np.minimum(np.arange(len(candidates.column)) * BLOCK, len(image) - BLOCK)
    middle = np.clip(candidates.column.astype(np.intp), 0, image.shape[1] - 1)
    core, side = np.zeros((2, *middle.shape, 3), np.float32)
    for place, offsets in ((core, range(-2, 3)), (side, (-9, -8, 8, 9))):
        for offset in offsets:
            x = np.clip(middle + offset, 0, image.shape[1] - 1)
            for row in range(BLOCK):
                place[:] += image[rows[:, None] + row, x]
    height = core / (5 * BLOCK) - side / (4 * BLOCK)
    own = np.maximum(height[..., channel], 1.0)
    other = np.delete(height, channel, axis=-1).max(axis=-1)
    beside = np.clip(middle[..., None] + np.arange(-2, 3), 0, image.shape[1] - 1)
    brightest = [image[rows[:, None, None] + row, beside, channel].max(axis=-1) for row in range(BLOCK)]
    saturated = np.max(brightest, axis=0) >= _COLOURLESS
    strong = ~saturated & (candidates.snr > 20.0)
    if strong[:, 0].sum() < 8:
        return np.ones_like(candidates.snr)
    share, weight = (other / own)[strong], np.minimum(candidates.snr[strong], 100.0)
    order = np.argsort(share)
    laser = float(share[order][np.searchsorted(np.cumsum(weight[order]), 0.1 * weight.sum())])
    # Chroma is stored at half the columns by most cameras: the line's colour bleeds, its share by half that again.
    if laser > _COLOURLESS_SHARE:
        return np.ones_like(candidates.snr)
    excess = other - (max(laser, 0.0) + 0.45) * own
    uncertain = 3.0 * noise / np.sqrt(2.0 * BLOCK)
    doubt = np.clip(1.0 - (excess - uncertain) / np.maximum(uncertain, 0.25 * own), 0.0, 1.0)
    return np.where(saturated, 1.0, doubt).astype(np.float32)


def choose_path(candidates: Candidates, score: F32, min_snr: float) -> F32:
    """One column (B,) for each block, NaN where none is good enough.

    Dynamic programming over the candidates: the path with the largest sum of log(score / min_snr), where
    going on along a line is free and jumping to another costs. Where no block has a rival the best is taken.
    """
    gain = np.log(np.maximum(score, 1e-3) / min_snr)
    best = gain.argmax(axis=1)
    rows = np.arange(len(best))
    chosen = np.where(gain[rows, best] > 0, candidates.column[rows, best], np.nan).astype(np.float32)
    rivals = (gain > 0).sum(axis=1) > 1
    if not rivals.any():
        return chosen
    return _best_path(candidates.column, gain, chosen)


def columns_of_rows(plane: U8, path: F32, window: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows (N,) that may carry the line, and the integer column (N,) of its peak in each.

    A row looks around the column its block's path has there, interpolated along the line; near a jump it looks
    at the neighbours' columns too and takes where the line stands out most.
    """
    row = np.arange(len(plane))
    block = row // BLOCK
    centre = np.arange(len(path)) * BLOCK + 0.5 * (BLOCK - 1)
    step = np.diff(path)
    smooth = np.abs(step) <= _CONNECTED_PX
    slope = np.zeros(len(path), np.float32)
    slope[1:-1] = np.where(smooth[1:] & smooth[:-1], 0.5 * (step[1:] + step[:-1]), 0.0) / BLOCK
    padded = np.concatenate([[np.nan], path, [np.nan]])
    own = path[block] + slope[block] * (row - centre[block])
    best, height_of_best = _stand_out(plane, row, own)
    jumpy = ~np.concatenate([[True], smooth, [True]])
    near_jump = (jumpy[1:] | jumpy[:-1])[block]
    at = np.flatnonzero(near_jump)
    if not at.size:
        found = np.flatnonzero((height_of_best > 0) & np.isfinite(window[:, 0]))
        return found, best[found]
    for neighbour in (padded[:-2], padded[2:]):
        rival, response = _stand_out(plane, at, neighbour[block[at]])
        better = response > height_of_best[at] * 1.05
        best[at[better]], height_of_best[at[better]] = rival[better], response[better]
    found = np.flatnonzero((height_of_best > 0) & np.isfinite(window[:, 0]))
    return found, best[found]


def _stand_out(plane: U8, row: NDArray[np.intp], column: F32) -> tuple[NDArray[np.intp], F32]:
    """The place within 5 px of `column` (N,) that stands out most, and by how much; 0 where column is NaN."""
    reach, far = 5, 9
    middle = np.rint(np.nan_to_num(column, nan=0.0)).astype(np.intp)
    x = np.clip(middle[:, None] + np.arange(-reach - far, reach + far + 1), 0, plane.shape[1] - 1)
    y = plane[row[:, None], x].astype(np.float32)
    smooth = cv2.blur(y, (5, 1), borderType=cv2.BORDER_REPLICATE)
    inner = smooth[:, far:-far]
    side = np.maximum(smooth[:, : -2 * far], smooth[:, 2 * far :])
    at = (inner - 0.5 * side).argmax(axis=1)
    index = np.arange(len(row))
    response = np.where(np.isfinite(column), np.maximum(inner[index, at] - side[index, at], 1e-3), 0.0)
    return middle - reach + at, response.astype(np.float32)


def _best_path(column: F32, gain: F32, fallback: F32) -> F32:
    blocks = len(column)
    columns, gains = column.tolist(), gain.tolist()
    # A state per candidate and one for "no line here", which costs nothing and connects to everything.
    total = [0.0] * (COUNT + 1)
    where: list[float] = [float("nan")] * (COUNT + 1)
    back: list[list[int]] = []
    for k in range(blocks):
        fresh, came = [], []
        for j in range(COUNT + 1):
            own = gains[k][j] if j < COUNT else 0.0
            value, source = -1e30, COUNT
            for i in range(COUNT + 1):
                jump = j < COUNT and i < COUNT and abs(columns[k][j] - where[i]) > _CONNECTED_PX
                candidate = total[i] - (_JUMP if jump else 0.5 * _JUMP if (j == COUNT) != (i == COUNT) else 0.0)
                if candidate > value:
                    value, source = candidate, i
            fresh.append(value + own if j == COUNT or own > 0 else -1e29)
            came.append(source)
        total, where = fresh, [*columns[k], float("nan")]
        back.append(came)
    path = fallback.copy()
    state = max(range(COUNT + 1), key=lambda j: total[j])
    for k in range(blocks - 1, -1, -1):
        path[k] = columns[k][state] if state < COUNT else np.nan
        state = back[k][state]
    return path


def _block_window(window: NDArray[np.float64], blocks: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """First and last column (B,) that any row of a block can have."""
    padded = np.full((blocks * BLOCK, 2), np.nan)
    padded[: len(window)] = window
    by_block = padded.reshape(blocks, BLOCK, 2)
    some = np.isfinite(by_block[..., 0]).any(axis=1)
    first, last = np.full(blocks, np.nan), np.full(blocks, np.nan)
    first[some] = np.nanmin(by_block[some, :, 0], axis=1)
    last[some] = np.nanmax(by_block[some, :, 1], axis=1)
    return first, last


def _by_block(plane: U8, blocks: int) -> U8:
    """(B, BLOCK, W): the rows by blocks, the last one filled up with the last row."""
    height, width = plane.shape
    if height % BLOCK:
        plane = np.concatenate([plane, np.repeat(plane[-1:], blocks * BLOCK - height, axis=0)])
    return plane.reshape(blocks, BLOCK, width)


def _response(own: U16, other: U16 | None, saturated: U8 | None) -> U16:
    """Largest response of the filter at full, half and quarter resolution.

    In grey levels, not in units of noise: what competes with the line is the room, not noise, and the room has more
    of everything the wider it is looked at.
    """
    best = _line_filter(own, other, saturated)
    height, width = own.shape
    for k in (1, 2):
        size = (-(-width // 2**k), height)
        own = np.asarray(cv2.resize(own, size, interpolation=cv2.INTER_AREA), np.uint16)
        if other is not None and saturated is not None:
            other = np.asarray(cv2.resize(other, size, interpolation=cv2.INTER_AREA), np.uint16)
            saturated = np.asarray(cv2.resize(saturated, size, interpolation=cv2.INTER_NEAREST), np.uint8)
        response = _line_filter(own, other, saturated)
        cv2.max(best, cv2.resize(response, (width, height), interpolation=cv2.INTER_NEAREST), best)
    return best


def _line_filter(own: U16, other: U16 | None, saturated: U8 | None) -> U16:
    """Mean over the line's width minus the brighter of its two sides, at least 0; less what the other channel has."""
    response = _stands_out(own)
    if other is None or saturated is None:
        return response
    elsewhere = _stands_out(other)
    elsewhere[saturated > 0] = 0
    return np.asarray(cv2.subtract(response, cv2.addWeighted(elsewhere, 1.25, elsewhere, 0.0, 0.0)), np.uint16)


def _stands_out(values: U16) -> U16:
    mean = cv2.blur(values, (_CENTRE, 1), borderType=cv2.BORDER_REPLICATE)
    padded = cv2.copyMakeBorder(mean, 0, 0, _AWAY, _AWAY, cv2.BORDER_REPLICATE)
    side = cv2.max(padded[:, : -2 * _AWAY], padded[:, 2 * _AWAY :])
    return np.asarray(cv2.subtract(mean, side), np.uint16)
