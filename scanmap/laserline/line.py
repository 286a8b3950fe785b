"""Find the laser line in an image: one sub-pixel column per row."""

from __future__ import annotations

from enum import IntEnum
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from scanmap.laserline.candidates import choose_path, colour_doubt, columns_of_rows, find_candidates, noise_of
from scanmap.laserline.grey import CHANNEL, NEIGHBOUR, Grey, extract, laser_channel, to_grey, without_background
from scanmap.laserline.peaks import SATURATED, Peaks, bright_core, centre_of_gravity, fit_gaussian
from scanmap.laserline.pooling import pool

Array = NDArray[np.float64]
U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]

# A run is not the laser line from this share of its height in another channel on.
_STRANGER = 0.62
# What a core must stand out by where no profile could be fitted: in noise, and in grey levels.
_CORE_SNR, _CORE_CONTRAST = 8.0, 12.0
# A saturated line this wide, fitted this many times worse than noise explains, is a core in a halo.
_HALO_WIDTH_PX, _HALO_MISFIT = 2.5, 2.5


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
    channel = CHANNEL.get(params.grey) if image.ndim == 3 else None
    if image.ndim == 3 and params.grey == "auto":
        channel = laser_channel(image if background is None else np.asarray(cv2.subtract(image, background), np.uint8))
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
    other = None if channel is None or background is not None else extract(image, NEIGHBOUR[channel])
    candidates = find_candidates(lit, window, noise, other)
    score = candidates.snr
    if channel is not None and background is None:
        score = score * colour_doubt(image, channel, candidates, noise)
    path = choose_path(candidates, score, params.min_snr)
    row, column = columns_of_rows(lit, path, window)
    line = _located(plane, lit, (row, column), noise, params)
    line = _within(line, window)
    line = _without_blobs(line)
    if channel is not None and background is None:
        line = _without_strangers(line, image, channel)
    line = _without_crumbs(line)
    if params.pool_rows >= 3:
        pooled, sigma = pool(line.column_px, line.sigma_px, params.pool_rows)
        line = line._replace(column_px=pooled, sigma_px=sigma)
    return line


def _located(
    plane: U8, lit: U8, at: tuple[NDArray[np.intp], NDArray[np.intp]], noise: float, params: LaserLineParams
) -> LaserLine:
    """The line at integer columns (N,) of rows (N,), fitted, judged, spread over all H rows."""
    height, width = plane.shape
    line = _nothing(height, Reason.WEAK)
    row, column = at
    if not row.size:
        return line
    for wide, some in _by_width(lit, row, column):
        if not some.size:
            continue
        r, c = row[some], column[some]
        x = c[:, None] + np.arange(-wide, wide + 1)
        outside = (x < 0) | (x >= width)
        x = np.clip(x, 0, width - 1)
        y = lit[r[:, None], x].astype(np.float32)
        saturated = (plane[r[:, None], x] >= SATURATED) | outside
        peaks = fit_gaussian(y, saturated, noise, params.noise)
        offset = centre_of_gravity(y) if params.method == "cog" else peaks.offset_px
        reason = _judged(peaks, noise, params)
        if params.method == "gauss":
            # A wide saturated line whose flanks are no Gaussian's stands in a halo.
            misfit = peaks.noise > _HALO_MISFIT * max(noise, 1.5)
            reason[peaks.clipped & (peaks.width_px > _HALO_WIDTH_PX) & misfit & (reason == Reason.OK)] = Reason.WIDE
            _take_cores(line, r, c, y, reason, noise)
        # An edge that cuts the line shows as an odd residual; what it may have moved the column by is added.
        bias = 0.5 * peaks.width_px * np.maximum(np.abs(peaks.asymmetry) - 0.05, 0.0)
        good = reason == Reason.OK
        at_good = r[good]
        line.column_px[at_good], line.peak[at_good] = (c + offset)[good], peaks.height[good]
        line.width_px[at_good], line.sigma_px[at_good] = peaks.width_px[good], np.hypot(peaks.sigma_px, bias)[good]
        rest = r[~good & (line.reason[r] != Reason.OK)]
        line.reason[at_good] = Reason.OK
        line.reason[rest] = reason[~good & (line.reason[r] != Reason.OK)]
    return line


def _take_cores(
    line: LaserLine, row: NDArray[np.intp], column: NDArray[np.intp], y: F32, reason: NDArray[np.uint8], noise: float
) -> None:
    """Where the profile is no Gaussian but has a core that stands out sharply, take the core."""
    at = np.flatnonzero(reason != Reason.OK)
    if not at.size:
        return
    cores = bright_core(y[at])
    sharp = (cores.contrast > max(_CORE_SNR * noise, _CORE_CONTRAST)) & (np.abs(cores.offset_px) < 3.0)
    r = row[at[sharp]]
    line.column_px[r] = column[at[sharp]] + cores.offset_px[sharp]
    line.peak[r], line.width_px[r] = cores.contrast[sharp], cores.width_px[sharp]
    line.sigma_px[r], line.reason[r] = cores.sigma_px[sharp], Reason.OK


def _by_width(lit: U8, row: NDArray[np.intp], column: NDArray[np.intp]) -> list[tuple[int, NDArray[np.intp]]]:
    """Rows sorted by how wide their line roughly is: (half width of the fit's window, indices)."""
    reach = 24
    x = np.clip(column[:, None] + np.arange(-reach, reach + 1), 0, lit.shape[1] - 1)
    y = lit[row[:, None], x]
    top = y[:, reach - 1 : reach + 2].mean(axis=1)
    # The brighter side counts: beside an edge of the room the run would never end at the darker one's level.
    sides = np.maximum(y[:, 4:12].mean(axis=1), y[:, -12:-4].mean(axis=1))
    above = y > (0.5 * (np.minimum(sides, top - 2.0) + top))[:, None]
    # Width of the run above half height that holds the middle.
    left = (~above[:, reach::-1]).argmax(axis=1)
    right = (~above[:, reach:]).argmax(axis=1)
    full = np.where(above.all(axis=1), 2 * reach, np.maximum(left + right - 1, 0))
    limits = ((8, 6), (13, 11), (24, 200))  # half window, largest full width at half height
    found, lower = [], -1
    for half, upper in limits:
        found.append((half, np.flatnonzero((full > lower) & (full <= upper))))
        lower = upper
    return found


def _judged(peaks: Peaks, noise: float, params: LaserLineParams) -> NDArray[np.uint8]:
    """Reason (N,) of each fit."""
    reason = np.full(len(peaks.height), Reason.OK, np.uint8)
    snr = peaks.height * np.sqrt(1.77 * peaks.width_px) / max(noise, 1.0)
    reason[np.abs(peaks.offset_px) > 3.0 + 0.7 * peaks.width_px] = Reason.AMBIGUOUS
    reason[peaks.sigma_px > 1.5] = Reason.WEAK
    # A dim bump whose samples scatter far more than the sensor's do is texture of the room.
    reason[(peaks.noise > 2.5 * max(noise, 1.5)) & (peaks.height < 3.5 * peaks.noise)] = Reason.AMBIGUOUS
    reason[(snr < params.min_snr) | (peaks.height < params.min_peak)] = Reason.WEAK
    reason[peaks.width_px > params.max_width_px] = Reason.WIDE
    reason[peaks.width_px < 0.33] = Reason.NARROW
    return reason


def _within(line: LaserLine, window: Array) -> LaserLine:
    """Give up what lies outside the columns geometry allows."""
    column = line.column_px
    with np.errstate(invalid="ignore"):
        outside = np.isfinite(column) & ~((column >= window[:, 0]) & (column <= window[:, 1]))
    line.reason[np.isnan(window[:, 0])] = Reason.WINDOW
    return _lost(line, outside, Reason.WINDOW)


def _without_blobs(line: LaserLine) -> LaserLine:
    """Give up rows far wider across the line than the sharpest good part of it, unless near and therefore bright.

    One beam has one width, which grows toward near things as the light does; what is wide and dim is a thing in
    the room. The width across a slanted line is its width in the row times the cosine of the slant.
    """
    strong = np.isfinite(line.column_px) & (line.peak > 10.0 * line.sigma_px)
    if strong.sum() < 20:
        return line
    slope = np.gradient(np.nan_to_num(line.column_px, nan=-1e4))
    across = line.width_px / np.sqrt(1.0 + np.clip(slope, -4.0, 4.0) ** 2)
    sharp = np.percentile(across[strong], 40)
    with np.errstate(invalid="ignore"):
        blob = (across > 2.2 * sharp + 0.5) & (line.peak < 140.0)
        blob |= (across > 1.5 * sharp + 0.3) & (line.peak < 0.25 * np.median(line.peak[strong]))
    return _lost(line, blob, Reason.WIDE)


def _without_strangers(line: LaserLine, image: U8, channel: int) -> LaserLine:
    """Give up runs of rows that stand out in another channel nearly as much as in the laser's own.

    Over a whole run the shares of the channels are known far better than in a row. Runs whose core saturates are left
    alone, and so is all of a picture without colour.
    """
    row = np.flatnonzero(np.isfinite(line.column_px))
    if not row.size or np.abs(np.diff(image[::16, ::16].astype(np.int16), axis=2)).mean() < 1.0:
        return line
    run = np.concatenate([[0], np.cumsum((np.diff(row) > 1) | (np.abs(np.diff(line.column_px[row])) > 3.0))])
    middle = np.rint(line.column_px[row]).astype(np.intp)
    x = np.clip(middle[:, None] + np.array([-2, -1, 0, 1, 2, -9, -8, 8, 9]), 0, image.shape[1] - 1)
    samples = image[row[:, None], x].astype(np.float32)
    height = samples[:, :5].mean(axis=1) - samples[:, 5:].mean(axis=1)
    by_run = np.stack([np.bincount(run, height[:, c]) for c in range(3)], axis=-1)
    clipped = np.bincount(run, (samples[:, :5, channel].max(axis=1) >= SATURATED - 10).astype(np.float64))
    other = np.delete(by_run, channel, axis=1).max(axis=1)
    stranger = (other > _STRANGER * by_run[:, channel]) & (clipped < 0.3 * np.bincount(run))
    lost = np.zeros(len(line.column_px), bool)
    lost[row[stranger[run]]] = True
    return _lost(line, lost, Reason.AMBIGUOUS)


def _without_crumbs(line: LaserLine) -> LaserLine:
    """Give up short runs of rows that no neighbour on either side continues: 3 rows always, 10 rows if weak."""
    column = line.column_px
    linked = np.abs(np.diff(column)) < 3.0
    number = np.concatenate([[0], np.cumsum(~linked)])
    rows = np.bincount(number)
    weak = np.bincount(number, np.nan_to_num(line.sigma_px, nan=0.0)) > 0.2 * rows
    lonely = np.isfinite(column) & ((rows < 4) | (weak & (rows < 12)))[number]
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
