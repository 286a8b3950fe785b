"""Where the line could be: the strongest narrow bright places of each block of rows."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
Mask = NDArray[np.bool_]

BLOCK = 4  # rows summed into one: a quarter of the search, twice the signal to noise
COUNT, MANY = 6, 24  # candidates per block, and where most are of another colour
COLOURLESS = 240  # [grey levels] from here on a sample has no colour
_PER_LEVEL = (4, 3, 3)  # candidates at each of three resolutions, for lines of sigma 0.7 to 8 px
_LARGE = 900  # rows from which on half the columns are enough for the finest search
_LEAD_SHIFT = 2  # what a lead in colour counts beside brightness: a quarter
_APART = 14  # [px] two candidates are at least this far apart: nearer ones are one line in two filters


class _Filter(NamedTuple):
    """The matched filter: odd width of its centre and distance of the two sides that the line must outshine."""

    centre: int
    away: int


class Candidates(NamedTuple):
    """Candidates of B blocks, strongest first; arrays (B, n)."""

    column: F32  # [px] to a pixel or two
    snr: F32  # response over the noise; 0 where there is none


def noises_of(planes: U8) -> F64:
    """Standard deviations (P,) of the noise of a sample [grey levels] in pictures (P, H, W).

    From differences of neighbours in a few rows.
    """
    pictures, height, width = planes.shape
    # As many samples as tell it to a hundredth.
    rows = planes[:, :: max(1, height * min(width, 1600) // 20_000, height // 24)]
    rows = np.ascontiguousarray(rows)
    flat = rows.reshape(-1, width)
    step = cv2.absdiff(flat[:, 1:], flat[:, :-1]).reshape(pictures, -1)
    noises, median = np.empty(pictures), 3.0
    for k, own in enumerate(step):
        median = _median_of(own, int(median + 0.5))
        noises[k] = _noise_by(median)
    return noises


def noise_of(steps: U8) -> float:
    """The same, from differences (N,) of neighbours."""
    return _noise_by(_median_of(steps, 3))


def _noise_by(median: float) -> float:
    return min(max(median / 0.954, 0.3), 60.0)  # half of all differences of Gaussian noise lie below that


def _median_of(step: NDArray[Any], near: int) -> float:
    """The median of whole numbers up to 63, finer than they are, looked for from `near` on."""
    half, k = 0.5 * max(step.size, 1), near
    below, count = int(np.count_nonzero(step < k)), int(np.count_nonzero(step <= k))
    while below >= half:
        k, below, count = k - 1, int(np.count_nonzero(step < k - 1)), below
    while count < half and k < 63:
        k, below, count = k + 1, count, int(np.count_nonzero(step <= k + 1))
    return k - 0.5 + (half - below) / max(count - below, 1e-9 * half)


def find_candidates(
    plane: U8,
    window: F64,
    noise: float,
    min_snr: float,
    other: U8 | None = None,
    large: bool = False,
    still: Mask | None = None,
    count: int = COUNT,
) -> Candidates:
    """The strongest narrow bright places of each block of rows.

    Args:
        plane: (H, W).
        window: (H, 2) first and last column of each row, NaN where a row can have no line.
        noise: standard deviation of a sample [grey levels].
        min_snr: where a block's best is below, no second one is looked for.
        other: (B, W) the middle rows' mean of a channel in which the laser hardly shows, by blocks; what stands
            out there too is a thing, not the line.
        large: half the columns are enough for the finest search.
        still: (B, W) places that are no candidates.
        count: of each block, COUNT or more.

    The response is the mean over the line minus the brighter of its two sides: a wide bright blob and an edge
    have a bright side and score nothing. It is compared in grey levels, not in units of noise: what competes with
    the line is the room, not noise, and the room has more of everything the wider it is looked at.
    """
    shape = _Filter(3, 4) if large else _Filter(5, 7)
    own = _summed(plane, large)
    saturated = None if other is None else _saturated(plane, large)
    elsewhere = None if other is None else _halved(other) if large else np.left_shift(other, 2, dtype=np.uint16)
    scale = 2 if large else 1
    gain = BLOCK // scale  # of `own` over a grey level
    unit = gain * unit_of(noise, large)
    limits = block_window(window)
    columns, snrs = [], []
    for level, few in enumerate(_PER_LEVEL):
        if level:
            own, scale, unit = _halved(own), 2 * scale, 2 * unit
            if elsewhere is not None and saturated is not None:
                elsewhere, saturated = _halved(elsewhere), saturated[:, : saturated.shape[1] // 2 * 2 : 2]
        if own.shape[1] < shape.centre:
            break
        mean, left, right = _with_sides(own, shape)
        brighter = np.asarray(cv2.max(left, right), np.uint16)
        response = np.asarray(cv2.subtract(mean, brighter), np.uint16)
        if elsewhere is not None and saturated is not None:
            response = _less_elsewhere(response, _stands_out(elsewhere, shape), saturated)
            if not level:
                rise = cv2.subtract(mean, cv2.min(left, right))
                leads = np.asarray(cv2.min(_leads(own, elsewhere, shape), rise), np.uint16) >> _LEAD_SHIFT
                # Of a saturated side the lead is not known.
                leads[brighter >= COLOURLESS * gain] = 0
                response = np.asarray(cv2.max(response, leads), np.uint16)
        if still is not None:
            across = still[:, : scale * response.shape[1]].reshape(len(still), -1, scale)
            response[across.any(axis=2)] = 0
        around = shape.centre if level else _APART // scale
        column, value = _strongest(response, few * count // COUNT, scale, limits, around, min_snr * unit)
        columns.append(column)
        snrs.append(value / np.float32(unit))
    return _apart(np.concatenate(columns, axis=1), np.concatenate(snrs, axis=1), count)


def unit_of(noise: float, large: bool) -> float:
    """Standard deviation of the finest response [grey levels]: a mean of the centre, minus the larger of two such."""
    samples = 3 * 2 * BLOCK if large else 5 * BLOCK
    return 1.35 * max(noise, 1.2) / float(np.sqrt(samples))


def is_large(image: U8) -> bool:
    """Whether half the columns of an (H, W) or (H, W, 3) picture are enough for the finest search."""
    return bool(image.shape[0] >= _LARGE and image.shape[1] >= 64)


def _summed(plane: U8, large: bool) -> U16:
    """Blocks' sums of rows (B, W); of `large` pictures those of the means of 2 x 2 samples (B, W // 2)."""
    if large:
        height, width = plane.shape[0] // 2, plane.shape[1] // 2
        half = cv2.resize(plane[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        half = np.asarray(half, np.uint8)
        if height % 2:
            half = np.concatenate([half, half[-1:]])
        rows = half.reshape(-1, 2, width)
        total = np.add(rows[:, 0], rows[:, 1], dtype=np.uint16)
        # One or two rows too few for a block of four.
        return total if len(total) == -(-len(plane) // BLOCK) else np.concatenate([total, total[-1:]])
    rows = by_block(plane)
    total = np.add(rows[:, 0], rows[:, 1], dtype=np.uint16)
    total += rows[:, 2]
    total += rows[:, 3]
    return total


def _saturated(plane: U8, large: bool) -> U8:
    """1 where a block of rows is saturated or beside it, at the resolution of `_summed`.

    A saturated core says nothing of its colour, nor do the columns beside it that optics and chroma blur.
    """
    step = 2 if large else 1
    bright = (plane[1::BLOCK, : plane.shape[1] // step * step : step] >= COLOURLESS).view(np.uint8)
    missing = -(-len(plane) // BLOCK) - len(bright)
    bright = np.concatenate([bright, np.zeros((missing, bright.shape[1]), np.uint8)]) if missing else bright
    return np.asarray(cv2.dilate(bright, np.ones((1, 9 if step == 1 else 7), np.uint8)), np.uint8)


def by_block(plane: U8) -> U8:
    """(B, BLOCK, W): the rows by blocks, the last one filled up with the last row."""
    height, width = plane.shape
    blocks = -(-height // BLOCK)
    if height % BLOCK:
        plane = np.concatenate([plane, np.repeat(plane[-1:], blocks * BLOCK - height, axis=0)])
    return plane.reshape(blocks, BLOCK, width)


def _strongest(
    response: U16, count: int, scale: int, limits: tuple[F64, F64], around: int, least: float
) -> tuple[F32, F32]:
    """Columns at full resolution and responses (B, count) of the maxima of one resolution, 0 where below `least`."""
    first, last = limits
    blocks, width = response.shape
    if first.max() - first.min() <= 1.0 and last.max() - last.min() <= 1.0:
        response[:, : max(int(np.ceil(first[0])) // scale, 0)] = 0
        response[:, max(int(np.floor(last[0])) // scale + 1, 0) :] = 0
    else:
        x = np.arange(width, dtype=np.float32) * scale + np.float32(0.5 * (scale - 1))
        response *= (x >= (first[:, None] - scale).astype(np.float32)) & (
            x <= (last[:, None] + scale).astype(np.float32)
        )
    column = np.zeros((blocks, count), np.float32)
    value = np.zeros((blocks, count), np.float32)
    rows = np.arange(blocks)
    index = rows
    runs = runs_in(response, 2 * around + 1)
    for k in range(count):
        best = response.argmax(axis=1)
        most = response[index, best]
        column[rows, k], value[rows, k] = best * scale + 0.5 * (scale - 1), most
        # Most blocks have one line and nothing beside it.
        more = most >= least
        left = np.count_nonzero(more)
        if not left or k == count - 1:
            return column[:, : k + 1], value[:, : k + 1]
        if 2 * left < len(rows):
            rows, best, response = rows[more], best[more], response[more]
            index, runs = index[: len(rows)], runs_in(response, 2 * around + 1)
        runs[index, np.minimum(np.maximum(best - around, 0), runs.shape[1] - 1)] = 0
    return column, value


def runs_in(response: U16, length: int) -> U16:
    """Every run of so many columns (B, n, length), a view to write through.

    Whole runs of memory are cleared at once, ten times the speed of picking samples one by one.
    """
    (blocks, width), (row, step) = response.shape, response.strides
    length = min(length, width)
    return np.ndarray((blocks, width - length + 1, length), response.dtype, response, 0, (row, step, step))


def _apart(column: F32, value: F32, count: int) -> Candidates:
    """The `count` strongest of all resolutions' candidates (B, n) that are not the same place, strongest first."""
    order = np.argsort(-value, axis=1, kind="stable")
    column, value = np.take_along_axis(column, order, 1), np.take_along_axis(value, order, 1)
    # Of two equals the finer filter's, which comes first, counts.
    for k in range(1, column.shape[1]):
        if not value[:, k].any():
            break
        near = np.abs(column[:, k, None] - column[:, :k]) < _APART
        value[:, k] *= ~(near & (value[:, :k] > 0)).any(axis=1)
    if not value[:, 1:].any():
        return Candidates(column[:, :count], value[:, :count])
    order = np.argsort(-value, axis=1, kind="stable")[:, :count]
    return Candidates(np.take_along_axis(column, order, 1), np.take_along_axis(value, order, 1))


def block_window(window: F64) -> tuple[F64, F64]:
    """First and last column (B,) that any row of a block can have."""
    blocks = -(-len(window) // BLOCK)
    padded = np.full((blocks * BLOCK, 2), np.nan)
    padded[: len(window)] = window
    by_rows = padded.reshape(blocks, BLOCK, 2)
    first, last = by_rows[:, 0, 0], by_rows[:, 0, 1]
    for k in range(1, BLOCK):
        first, last = np.fmin(first, by_rows[:, k, 0]), np.fmax(last, by_rows[:, k, 1])
    return first, last


def _halved(values: U16 | U8) -> U16:
    """Sums of pairs of columns (B, W // 2)."""
    even = values.shape[1] // 2 * 2
    return np.add(values[:, 0:even:2], values[:, 1:even:2], dtype=np.uint16)


def _less_elsewhere(response: U16, elsewhere: U16, saturated: U8) -> U16:
    """The response less what the other channel has, except where saturation takes the colour."""
    elsewhere[saturated > 0] = 0
    elsewhere += elsewhere >> 2
    return np.asarray(cv2.subtract(response, elsewhere), np.uint16)


def _leads(own: U16, other: U16, shape: _Filter) -> U16:
    """How far a place's lead over the other channel stands out.

    A line along an edge of brightness is outshone by the brighter side, but that side is not of its colour.
    """
    lead = own + np.uint16(BLOCK * 255)
    lead -= other
    return _stands_out(lead, shape)


def _stands_out(values: U16, shape: _Filter) -> U16:
    """Mean over the line's width minus the brighter of its two sides, at least 0."""
    mean, left, right = _with_sides(values, shape)
    return np.asarray(cv2.subtract(mean, cv2.max(left, right)), np.uint16)


def _with_sides(values: U16, shape: _Filter) -> tuple[U16, U16, U16]:
    """Means over the line's width around each place, and to the left and right of it."""
    mean = np.asarray(cv2.blur(values, (shape.centre, 1), borderType=cv2.BORDER_REPLICATE), np.uint16)
    padded = np.asarray(cv2.copyMakeBorder(mean, 0, 0, shape.away, shape.away, cv2.BORDER_REPLICATE), np.uint16)
    return mean, padded[:, : -2 * shape.away], padded[:, 2 * shape.away :]
