"""Find the laser line in an image: one sub-pixel column per row."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import runs
from scanmap.laserline.bars import take_bars
from scanmap.laserline.beside_print import apart_from_print
from scanmap.laserline.brightness import by_brightness
from scanmap.laserline.candidates import BLOCK
from scanmap.laserline.channel import judged_channel
from scanmap.laserline.colour import strangers
from scanmap.laserline.cores import brightest, centre_of_gravity, take_cores
from scanmap.laserline.edges import across_edges, doubt_of_edges, lean_alone, sides_of
from scanmap.laserline.error_bars import Doubts, no_doubts, with_error_bars
from scanmap.laserline.flat import flat_tops
from scanmap.laserline.grey import to_grey
from scanmap.laserline.offframe import told_from_edges
from scanmap.laserline.offmatch import in_place
from scanmap.laserline.onward import gaps_in, goes_on
from scanmap.laserline.params import LaserLineParams
from scanmap.laserline.path import columns_of_rows
from scanmap.laserline.peaks import SPECKLE_FROM, fit_gaussian, judged
from scanmap.laserline.result import LaserLine, Look, Reason, each_picture, means_along, no_line, without
from scanmap.laserline.rivals import contested
from scanmap.laserline.rounding import Rounding
from scanmap.laserline.samples import by_width, samples_of
from scanmap.laserline.search import Course, search
from scanmap.laserline.sight import Conversion, Laser, Sight, channel_of, noises_in_band, sight_of

Array = NDArray[np.float64]
U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

# [px] what the search needs to see beside the window at quarter resolution.
_MARGIN = 64
_SIGMA_LEAST_PX = 0.003  # no sample is known well enough for less
# A saturated line this wide, fitted this many times worse than noise explains, is a core in a halo.
_HALO_WIDTH_PX, _HALO_MISFIT = 2.5, 2.5
_WEAK_PX = 0.2  # short runs of rows known no better are given up
# So are shorter runs than these, with a laser-off frame and without: what one block of rows shows alone may be print.
_FEWEST_ROWS = (4, BLOCK + 2)
# A core inside a blob that was fitted is at most this share of the blob's width; half the window it is looked for in.
_CORE_SHARE, _CORE_HALF = 0.4, 13
# Share of its rows in which a picture must show the line to be thought of the laser's colour.
_MOSTLY = 0.5
_ROUNDS = 3  # in which the line is followed
# A row too dim to be believed alone is known to this [px], and counts where the line goes on above and below.
_DIM_PX = 0.8


def find_laser_line(
    image: U8,
    params: LaserLineParams,
    background: U8 | None = None,
    window: Array | None = None,
    rounding: Rounding | None = None,
) -> LaserLine:
    """Locate the laser line.

    Args:
        image: (H, W) grey or (H, W, 3) BGR, laser on.
        params: how.
        background: the same view with the laser off, or None.
        window: (H, 2) first and last column a return can have, from the calibration; NaN = none in this row.
        rounding: of the file that the picture was, as `rounding_of` reads it.

    Returns:
        LaserLine of length H. A row that is not sure has NaN and a reason.

    Raises:
        CameraError: fewer than six columns, unless the brightest sample is all that is asked for.
    """
    return look(image, params, background, window, rounding=rounding).line


def look(
    image: U8,
    params: LaserLineParams,
    background: U8 | None = None,
    window: Array | None = None,
    still: NDArray[np.bool_] | None = None,
    laser: Laser | None = None,
    rounding: Rounding | None = None,
    matched: bool = False,
) -> Look:
    """Locate the laser line as `find_laser_line` does, and all else that looks like one.

    Args:
        still: (ceil(H / BLOCK), W) where things of the room are known to be, in blocks of rows; the line is looked
            for everywhere else.
        laser: what another picture of the scan has told of it (see `laser_of`), where `params` leave its channel open;
            a picture in which most rows have no line in that channel is asked for its own.
        rounding: of the file that the picture was, as `rounding_of` reads it.
        matched: whether `background` lies on the picture as it is, at its exposure.
    """
    if background is not None and not matched:
        background = in_place(image, background)
    seen = partial(_look, image[None], params, background, window, still, roundings=[rounding], matched=matched)
    if laser is not None and params.grey == "auto" and image.ndim == 3:
        told = seen(laser=laser)[0]
        if _mostly_found(told) or (own := channel_of(image, background, params.grey)) == laser.channel:
            return told
        return seen(laser=own)[0]
    return seen(laser=channel_of(image, background, params.grey))[0]


def look_at_all(
    images: U8,
    params: LaserLineParams,
    window: Array | None = None,
    laser: Laser | None = None,
    roundings: Sequence[Rounding | None] | None = None,
) -> list[Look]:
    """What `look` gives for each of the pictures (P, H, W) or (P, H, W, 3) of one scan, bit for bit, sooner."""
    roundings = [None] * len(images) if roundings is None else roundings
    if laser is not None and params.grey == "auto" and images.ndim == 4:
        looks = _look(images, params, None, window, None, laser, roundings)
        for k, image in enumerate(images):
            if not _mostly_found(looks[k]):
                looks[k] = look(image, params, None, window, None, laser, roundings[k])
        return looks
    channels = [channel_of(image, None, params.grey) for image in images]
    if len(set(channels)) > 1:
        each = zip(images, roundings, strict=True)
        return [look(image, params, None, window, rounding=rounding) for image, rounding in each]
    return _look(images, params, None, window, None, channels[0], roundings)


def laser_of(image: U8, params: LaserLineParams, background: U8 | None = None) -> Laser | None:
    """What a picture tells of the laser, where `params` leave its channel open and it leaves no doubt; else None."""
    if params.grey != "auto" or image.ndim == 2:
        return None
    channel, clear = judged_channel(image, background)
    return Laser(channel, noises_in_band(image, channel)) if clear else None


def _mostly_found(look: Look) -> bool:
    asked = np.count_nonzero(look.line.reason != Reason.WINDOW)
    return bool(np.count_nonzero(look.line.reason == Reason.OK) >= _MOSTLY * asked)


def _look(
    images: U8,
    params: LaserLineParams,
    background: U8 | None,
    window: Array | None,
    still: NDArray[np.bool_] | None,
    laser: Laser | int | None,
    roundings: Sequence[Rounding | None],
    matched: bool = False,
) -> list[Look]:
    """Look at pictures (P, H, W, ...) whose line is looked for in one channel, which may be all that is known of it."""
    channel, noises = laser if isinstance(laser, Laser) else (laser, None)
    pictures, height, width = images.shape[:3]
    # From here on, one below the other.
    image = np.ascontiguousarray(images).reshape(pictures * height, *images.shape[2:])
    if window is None:
        window = np.tile([0.0, width - 1.0], (height, 1))
    windows = np.tile(window, (pictures, 1))
    if params.method == "brightest":
        plane = to_grey(image, params.grey, params.bit_index, max(channel or 0, 0))
        return [Look(line) for line in each_picture(_within(brightest(plane, params.min_peak), windows), height)]
    if not np.isfinite(window).any():
        return [Look(no_line(height, Reason.WINDOW)) for _ in images]
    # Everything below sees only the columns in question; in fours, which are summed in pairs and those again.
    left = max(0, int(np.nanmin(window)) - _MARGIN) // 4 * 4
    image = image[:, left : left + -(-(int(np.nanmax(window)) + _MARGIN + 1 - left) // 4) * 4]
    background = None if background is None else background[:, left : left + image.shape[1]]
    still = None if still is None else still[:, left : left + image.shape[1]]
    how = Conversion(params.grey, params.bit_index, params.off_threshold)
    sight = sight_of(image, background, how, height, channel, roundings, noises, matched)
    course = search(sight, window - left, params.min_snr, still)
    lines, lean = _found(sight, course, params, windows - left, still)
    lines.column_px[:] += left
    places = [own + np.float32(left) for own in course.places]
    means = means_along(lean.reshape(pictures, height))
    return [Look(*each) for each in zip(each_picture(lines, height), places, means, strict=True)]


def _found(
    sight: Sight, course: Course, params: LaserLineParams, window: Array, still: Mask | None
) -> tuple[LaserLine, F32]:
    """The lines of pictures, and how much each row of their profiles leans, arrays (P H,)."""
    noise, height = sight.noise, sight.height
    row, column = columns_of_rows(sight.lit, course.column, window, noise)
    line, doubts = _located(sight, (row, column), params)
    take_bars(line, sight, params)
    line = _within(line, window)
    wide = runs.blobs(line.column_px, line.width_px, line.peak, line.sigma_px, noise)
    at = np.flatnonzero(wide), np.rint(line.column_px[wide]).astype(np.intp)
    widest = _CORE_SHARE * line.width_px[wide]
    line = without(line, wide, Reason.WIDE)
    if params.method == "gauss" and at[0].size:
        around = samples_of(sight, *at)
        y, _ = around.of(_CORE_HALF, slice(None))
        take_cores(line, at, y.T, widest, around.rows, params)
    if sight.image is not None:
        pure = np.repeat(course.pure, BLOCK, axis=1)[:, :height].ravel()
        line = without(line, strangers(line, sight.image, sight.channel, pure, height)[0], Reason.AMBIGUOUS)
    if sight.off is None and params.method == "gauss":
        line = without(line, flat_tops(line.column_px, line.width_px, line.peak, sight.plane, height), Reason.WIDE)
    line = without(line, runs.frayed(line.column_px, line.width_px, line.peak, line.sigma_px, height), Reason.EDGE)
    free = np.isfinite(window[:, 0]) & (line.reason != Reason.EDGE)
    gaps = gaps_in(line.column_px, free, height)
    for k, (picture, one) in enumerate(
        zip(sight.pictures(), each_picture(line, height), strict=True) if gaps.any() else ()
    ):
        own = slice(k * height, (k + 1) * height)
        if gaps[k]:
            _go_on(one, doubts.of(own), picture, params, (window[own], free[own]), still)
    if sight.off is None and still is None:
        line = without(line, contested(line.column_px, course.places, sight), Reason.RIVALS)
    weak = line.sigma_px > _WEAK_PX
    if sight.off is not None:
        line, weak = told_from_edges(line, weak, sight)
    fewest = _FEWEST_ROWS[sight.off is None]
    line = without(line, runs.crumbs(line.column_px, weak, height, fewest=fewest), Reason.AMBIGUOUS)
    line.column_px[:] += doubts.edges.shift
    return with_error_bars(line, sight, params.pool_rows, doubts), doubts.lean


def _located(sight: Sight, at: tuple[Index, Index], params: LaserLineParams) -> tuple[LaserLine, Doubts]:
    """The line at integer columns (N,) of rows (N,), fitted, judged, spread over all H rows; and its doubts."""
    line = no_line(len(sight.lit), Reason.WEAK)
    doubts = no_doubts(len(sight.lit))
    row, column = at
    if not row.size:
        return line, doubts
    around = samples_of(sight, row, column)
    # Speckle is one for a picture; the largest group, which comes first, tells it best.
    contrast = {"auto": np.nan, "additive": 0.0, "speckle": SPECKLE_FROM + 0.1}[params.noise]
    contrasts, usual = np.full(len(sight.noise), contrast), np.full(len(sight.noise), np.nan, np.float32)
    for half, some in by_width(around.lit, around.rows):
        r, c, rows = row[some], column[some], around.rows.of(some)
        noise = rows.noise
        y, usable = around.of(half, some)
        sides = sides_of(y, rows)
        limit = around.limit_of(usable, some)
        peaks = fit_gaussian(y, usable, rows, contrasts, partial(around.of, some=some), limit)
        contrasts = peaks.contrast
        reason = judged(peaks, noise, params)
        apart_from_print(peaks, reason, sight, (r, c), rows, params, usual)
        # A wide saturated line whose flanks are no Gaussian's stands in a halo.
        misfit = np.float32(_HALO_MISFIT) * np.maximum(noise, np.float32(1.5))
        halo = peaks.clipped & (peaks.width_px > _HALO_WIDTH_PX) & (peaks.noise > misfit)
        peaks = by_brightness(peaks, reason == Reason.OK, halo, misfit, around, half, some)
        if sight.off is None:
            own = across_edges(peaks, reason == Reason.OK, sides, around, half, some)
        else:
            own = doubt_of_edges(peaks, reason == Reason.OK, sight, (r, c), usable)
        offset = centre_of_gravity(y.T) if params.method == "cog" else peaks.offset_px
        dim = (reason == Reason.WEAK) & (peaks.height >= params.min_peak) & (peaks.sigma_px < _DIM_PX)
        if dim.any():
            believed = reason == Reason.OK
            reason[runs.continuing(r, c + peaks.offset_px, peaks.sigma_px, believed, dim, sight.height)] = Reason.OK
        good = reason == Reason.OK
        if params.method == "gauss" and not (good.all() and not peaks.clipped.any()):
            reason[halo & good] = Reason.WIDE
            final = (reason == Reason.EDGE) | ((reason == Reason.WIDE) & (peaks.noise <= misfit))
            lost = (reason != Reason.OK) & ~final
            take_cores(line, (r[lost], c[lost]), y[:, lost].T, params.max_width_px, rows.of(lost), params)
            good = reason == Reason.OK
        total_sigma = np.sqrt(np.square(peaks.sigma_px) + np.square(peaks.bias_px))
        k = good.nonzero()[0]
        at_good = r[k]
        line.column_px[at_good], line.peak[at_good] = c[k] + offset[k], peaks.height[k]
        line.width_px[at_good] = peaks.width_px[k]
        line.sigma_px[at_good] = np.maximum(total_sigma[k], _SIGMA_LEAST_PX)
        line.reason[at_good] = Reason.OK
        doubts.edges.shift[at_good], doubts.edges.doubt[at_good] = own.shift[k], own.doubt[k]
        doubts.lean[at_good] = peaks.lean[k] if sight.off is None else lean_alone(y, peaks, sides)[k]
        doubts.plain[at_good] = (peaks.bias_px[k] == 0.0) & ~peaks.clipped[k]
        rest = ~good & (line.reason[r] != Reason.OK)
        line.reason[r[rest]] = reason[rest]
    return line, doubts


def _go_on(
    line: LaserLine,
    doubts: Doubts,
    sight: Sight,
    params: LaserLineParams,
    where: tuple[Array, Mask],
    still: Mask | None,
) -> None:
    """Rows into which a run of a picture's line goes on, in place: what a row leaves open its neighbours tell."""
    window, free = where
    for _ in range(_ROUNDS):
        row, column = goes_on(line, sight.lit, float(sight.noise[0]), free, still)
        if not row.size:
            return
        more, other = _located(sight, (row, column), params)
        line_like = (more.width_px < runs.NO_BLOB_PX + np.nanmedian(line.width_px)) & free
        more = without(_within(more, window), ~line_like, Reason.WEAK)
        if sight.image is not None:
            none = np.zeros(len(free), bool)
            more = without(more, strangers(more, sight.image, sight.channel, none, len(free))[1], Reason.WEAK)
        found = np.isfinite(more.column_px)
        if not found.any():
            return
        for values, new in zip((*line[:4], *doubts.each), (*more[:4], *other.each), strict=True):
            values[found] = new[found]
        line.reason[found] = Reason.OK


def _within(line: LaserLine, window: Array) -> LaserLine:
    """Give up what lies outside the columns geometry allows."""
    column = line.column_px
    with np.errstate(invalid="ignore"):
        outside = np.isfinite(column) & ~((column >= window[:, 0]) & (column <= window[:, 1]))
    line.reason[np.isnan(window[:, 0])] = Reason.WINDOW
    return without(line, outside, Reason.WINDOW)
