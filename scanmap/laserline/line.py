"""Find the laser line in an image: one sub-pixel column per row."""

from __future__ import annotations

from enum import IntEnum
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from scanmap.laserline.candidates import choose_path, colour_doubt, columns_of_rows, find_candidates, noise_of
from scanmap.laserline.grey import Grey, laser_channel, to_grey, without_background
from scanmap.laserline.peaks import SATURATED, Peaks, centre_of_gravity, fit_gaussian
from scanmap.laserline.pooling import pool

Array = NDArray[np.float64]
U8 = NDArray[np.uint8]


class Reason(IntEnum):
    """Why a row has no point. One list from image to range image, so that a summary can add them up."""

    OK = 0
    WEAK = 1  # no peak above the noise
    WIDE = 2  # too wide to be the laser line: lamp, window, halo
    WINDOW = 3  # only outside the columns that geometry allows
    AMBIGUOUS = 4  # several candidates, none clearly the line
    EDGE = 5  # cut by the image border or by a depth edge too close to correct
    DAMAGED = 6  # the image has no data here
    BELOW_RANGE = 7  # nearer than the model or range_min allows
    BEYOND_RANGE = 8  # farther than range_max, or at infinity
    OUTLIER = 9  # removed by the filter over neighbours in the range image
    NOT_SCANNED = 10  # no shot covers this cell
    NARROW = 11  # narrower than any line: hot pixels, a bad sensor column

    @property
    def words(self) -> str:
        """The reason as a summary prints it."""
        return _WORDS[self]


_WORDS = {
    Reason.OK: "found",
    Reason.WEAK: "too weak",
    Reason.WIDE: "too wide for the line",
    Reason.WINDOW: "outside the geometry window",
    Reason.AMBIGUOUS: "ambiguous",
    Reason.EDGE: "cut by an edge",
    Reason.DAMAGED: "image damaged",
    Reason.BELOW_RANGE: "below range",
    Reason.BEYOND_RANGE: "beyond range",
    Reason.OUTLIER: "outlier among its neighbours",
    Reason.NOT_SCANNED: "not scanned",
    Reason.NARROW: "too narrow for the line",
}


class LaserLine(NamedTuple):
    """Laser line of one shot. Arrays of length H, the image's rows; NaN where a row has no line."""

    column_px: Array  # (H,) sub-pixel column, 0 = centre of the first pixel
    peak: Array  # (H,) height above the background [grey levels]
    width_px: Array  # (H,) standard deviation of the line's profile
    sigma_px: Array  # (H,) standard deviation of column_px
    reason: NDArray[np.uint8]  # (H,) Reason: OK, or why the row has no line


class LaserLineParams(BaseModel, frozen=True, extra="forbid"):
    """How a row's peak is found; `[laserline]` in a rig's TOML."""

    method: Literal["gauss", "cog", "brightest"] = Field(
        "gauss", description="gauss: fit at the noise bound; cog: centre of gravity; brightest: the thesis, exactly"
    )
    grey: Grey = Field("auto", description="plane the line is looked for in; auto: the channel where it stands out")
    bit_index: int = Field(16, ge=0, le=24, description="for grey = bit_index: lowest of the 8 bits, 0 blue to 24")
    noise: Literal["auto", "additive", "speckle"] = Field(
        "auto", description="what scatters the samples; auto judges from the image"
    )
    min_peak: float = Field(
        3.0, gt=0, le=255, description="least height of the line above its background [grey levels]"
    )
    min_snr: float = Field(6.0, ge=2, le=100, description="least signal to noise of the line in its row")
    max_width_px: float = Field(12.0, gt=1, le=14, description="widest profile taken for the line, as sigma [px]")
    off_threshold: float = Field(
        0.0, ge=0, le=255, description="with a laser-off frame: differences below this count as none [grey levels]"
    )
    pool_rows: int = Field(0, ge=0, le=31, description="rows along the line that a column draws on; 0 = its own only")


def needs_colour(params: LaserLineParams) -> bool:
    """Whether the line is looked for in colour; if not, decoding to luminance (the JPEG's own plane) will do."""
    return params.grey not in ("luminance_601", "ycbcr_y")


def find_laser_line(
    image: U8,
    params: LaserLineParams,
    background: U8 | None = None,
    window: Array | None = None,
) -> LaserLine:
    """Locate the laser line.

    Args:
        image: (H, W) grey or (H, W, 3) BGR, laser on.
        params: how.
        background: the same view with the laser off, or None.
        window: (H, 2) first and last column a return can have, from the calibration; NaN = none in this row.

    Returns:
        LaserLine of length H. A row that is not sure has NaN and a reason.
    """
    channel = laser_channel(image) if image.ndim == 3 and params.grey == "auto" else None
    plane = to_grey(image, params.grey, params.bit_index, channel)
    if params.method == "brightest":
        return _brightest(plane, params, window)
    lit = plane
    if background is not None:
        lit = without_background(
            plane, to_grey(background, params.grey, params.bit_index, channel), params.off_threshold
        )
    if window is None:
        window = np.tile([0.0, plane.shape[1] - 1.0], (len(plane), 1))
    if not np.isfinite(window).any():
        return _nothing(len(plane), Reason.WINDOW)
    noise = noise_of(lit)
    candidates = find_candidates(lit, window, noise)
    score = candidates.snr
    if channel is not None:
        score = score * colour_doubt(image, channel, candidates, noise)
    path = choose_path(candidates, score, params.min_snr)
    row, column = columns_of_rows(lit, path, window)
    line = _located(plane, lit, row, column, params)
    line = _within(line, window)
    line = _without_crumbs(line)
    if params.pool_rows >= 3:
        pooled, sigma = pool(line.column_px, line.sigma_px, params.pool_rows)
        line = line._replace(column_px=pooled, sigma_px=sigma)
    return line


def _located(plane: U8, lit: U8, row: NDArray[np.intp], column: NDArray[np.intp], params: LaserLineParams) -> LaserLine:
    """The line at integer columns (N,) of rows (N,), fitted, judged, spread over all H rows."""
    height, width = plane.shape
    line = _nothing(height, Reason.WEAK)
    if not row.size:
        return line
    for wide, at in _by_width(lit, row, column):
        if not at.size:
            continue
        r, c = row[at], column[at]
        x = c[:, None] + np.arange(-wide, wide + 1)
        outside = (x < 0) | (x >= width)
        x = np.clip(x, 0, width - 1)
        y = lit[r[:, None], x].astype(np.float32)
        saturated = (plane[r[:, None], x] >= SATURATED) | outside
        peaks = fit_gaussian(y, saturated, params.noise)
        offset = centre_of_gravity(y) if params.method == "cog" else peaks.offset_px
        reason = _judged(peaks, params)
        # An edge that cuts the line shows as an odd residual; what it may have moved the column by is added.
        bias = 0.5 * peaks.width_px * np.maximum(np.abs(peaks.asymmetry) - 0.05, 0.0)
        line.column_px[r], line.peak[r], line.width_px[r] = c + offset, peaks.height, peaks.width_px
        line.sigma_px[r] = np.hypot(peaks.sigma_px, bias)
        line.reason[r] = reason
        lost = r[reason != Reason.OK]
        for values in line[:4]:
            values[lost] = np.nan
    return line


def _by_width(lit: U8, row: NDArray[np.intp], column: NDArray[np.intp]) -> list[tuple[int, NDArray[np.intp]]]:
    """Rows sorted by how wide their line roughly is: (half width of the fit's window, indices)."""
    reach = 24
    x = np.clip(column[:, None] + np.arange(-reach, reach + 1), 0, lit.shape[1] - 1)
    y = lit[row[:, None], x]
    floor = np.minimum(y[:, :4].mean(axis=1), y[:, -4:].mean(axis=1))
    top = y[:, reach - 1 : reach + 2].mean(axis=1)
    above = y > (0.5 * (floor + top))[:, None]
    # Width of the run above half height that holds the middle.
    left = (~above[:, reach::-1]).argmax(axis=1)
    right = (~above[:, reach:]).argmax(axis=1)
    full = np.where(above.all(axis=1), 2 * reach, left + right - 1)
    limits = ((8, 6), (13, 11), (24, 200))  # half window, largest full width at half height
    found, lower = [], -1
    for half, upper in limits:
        found.append((half, np.flatnonzero((full > lower) & (full <= upper))))
        lower = upper
    return found


def _judged(peaks: Peaks, params: LaserLineParams) -> NDArray[np.uint8]:
    """Reason (N,) of each fit."""
    reason = np.full(len(peaks.height), Reason.OK, np.uint8)
    snr = peaks.height * np.sqrt(1.77 * peaks.width_px) / peaks.noise
    reason[np.abs(peaks.offset_px) > 3.0 + 0.7 * peaks.width_px] = Reason.AMBIGUOUS
    reason[peaks.sigma_px > 1.5] = Reason.WEAK
    reason[(snr < params.min_snr) | (peaks.height < params.min_peak)] = Reason.WEAK
    reason[peaks.width_px > params.max_width_px] = Reason.WIDE
    reason[peaks.width_px < 0.5] = Reason.NARROW
    return reason


def _within(line: LaserLine, window: Array) -> LaserLine:
    """Give up what lies outside the columns geometry allows."""
    column = line.column_px
    with np.errstate(invalid="ignore"):
        outside = np.isfinite(column) & ~((column >= window[:, 0]) & (column <= window[:, 1]))
    line.reason[np.isnan(window[:, 0])] = Reason.WINDOW
    return _lost(line, outside, Reason.WINDOW)


def _without_crumbs(line: LaserLine) -> LaserLine:
    """Give up runs of fewer than three rows that no neighbour on either side continues."""
    column = line.column_px
    linked = np.abs(np.diff(column)) < 3.0
    number = np.concatenate([[0], np.cumsum(~linked)])
    lonely = np.isfinite(column) & (np.bincount(number)[number] < 3)
    return _lost(line, lonely, Reason.AMBIGUOUS)


def _lost(line: LaserLine, mask: NDArray[np.bool_], reason: Reason) -> LaserLine:
    line.reason[mask] = reason
    for values in line[:4]:
        values[mask] = np.nan
    return line


def _brightest(plane: U8, params: LaserLineParams, window: Array | None) -> LaserLine:
    """T5 of the thesis: value and column of the first maximum of each row, whatever it is."""
    column = plane.argmax(axis=1)
    value = plane[np.arange(len(plane)), column].astype(np.float64)
    reason = np.where(value < params.min_peak, Reason.WEAK, Reason.OK).astype(np.uint8)
    # A column between two pixel borders: the standard deviation of a uniform distribution.
    sigma = np.full(len(plane), np.sqrt(1.0 / 12.0))
    line = LaserLine(column.astype(np.float64), value, np.full(len(plane), np.nan), sigma, reason)
    line = _lost(line, reason == Reason.WEAK, Reason.WEAK)
    return line if window is None else _within(line, window)


def _nothing(height: int, reason: Reason) -> LaserLine:
    column, peak, width, sigma = (np.full(height, np.nan) for _ in range(4))
    return LaserLine(column, peak, width, sigma, np.full(height, reason, np.uint8))
