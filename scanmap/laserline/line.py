"""Find the laser line in an image: one sub-pixel column per row."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

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

    min_peak: float = Field(18.0, gt=0, description="line height above the background [grey levels]")


def find_laser_line(
    image: NDArray[np.uint8],
    params: LaserLineParams,
    background: NDArray[np.uint8] | None = None,
    window: NDArray[np.float64] | None = None,
) -> LaserLine:
    """Locate the laser line.

    Args:
        image: (H, W) grey or (H, W, 3) BGR, laser on.
        params: how.
        background: the same view with the laser off, or None.
        window: (H, 2) first and last column a return can have, from the calibration; NaN = none in this row.
    """
    raise NotImplementedError
