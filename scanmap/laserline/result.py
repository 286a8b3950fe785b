"""What finding the laser line gives: `LaserLine`, and the `Reason` of every row without one."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
    MIRROR = 12  # seen in a mirror: the image of a point elsewhere in the room
    RIVALS = 13  # another thing in the same row may be the line as well

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
    Reason.MIRROR: "seen in a mirror",
    Reason.RIVALS: "one of several alike",
}


MEAN_ROWS = 12  # rows of a line whose means are asked first


class LaserLine(NamedTuple):
    """Laser line of one shot. Arrays of length H, the image's rows; NaN where a row has no line."""

    column_px: Array  # (H,) sub-pixel column, 0 = centre of the first pixel
    peak: Array  # (H,) height above the background [grey levels]
    width_px: Array  # (H,) standard deviation of the line's profile
    sigma_px: Array  # (H,) standard deviation of column_px
    reason: NDArray[np.uint8]  # (H,) Reason: OK, or why the row has no line


class Look(NamedTuple):
    """One picture's laser line, and whatever else in it could be taken for one."""

    line: LaserLine  # (H,)
    # (ceil(H / 8), n) [px] line-like places in every other block of 4 rows, NaN where there are fewer; None where none
    # were looked for.
    places: NDArray[np.float32] | None = None
    # (ceil(H / MEAN_ROWS),) how much the line's profile leans, in heights of it: means along it; None as above.
    lean: NDArray[np.float32] | None = None


def means_along(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means (..., ceil(H / MEAN_ROWS)) along lines of what is known of some values (..., H); NaN where nothing is."""
    starts = np.arange(0, values.shape[-1], MEAN_ROWS)
    known = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        sums = np.add.reduceat(np.where(known, values, np.float32(0.0)), starts, axis=-1)
        return np.asarray(sums / np.add.reduceat(known, starts, axis=-1, dtype=np.float32), np.float32)


def each_picture(lines: LaserLine, height: int) -> list[LaserLine]:
    """The lines of pictures of `height` rows one below the other, each by itself."""
    column, peak, width, sigma, reason = lines
    own = [slice(k, k + height) for k in range(0, len(reason), height)]
    return [LaserLine(column[k], peak[k], width[k], sigma[k], reason[k]) for k in own]


def no_line(height: int, reason: Reason) -> LaserLine:
    """A line of `height` rows that has none."""
    column, peak, width, sigma = (np.full(height, np.nan) for _ in range(4))
    return LaserLine(column, peak, width, sigma, np.full(height, reason, np.uint8))


def without(line: LaserLine, mask: NDArray[np.bool_], reason: Reason) -> LaserLine:
    """The line, changed in place, without the rows of `mask` (H,)."""
    if mask.any():
        line.reason[mask] = reason
        for values in line[:4]:
            values[mask] = np.nan
    return line
