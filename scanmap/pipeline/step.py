"""One shot, and what was made of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.errors import CameraError
from scanmap.laserline import LaserLine, LaserLineParams, Reason, look, needs_colour
from scanmap.shot import Decoded, Shot, decode_image
from scanmap.triangulation import Profile, TriangulationParams, column_window, triangulate


class Step(NamedTuple):
    """One shot, and what was made of it."""

    shot: Shot
    line: LaserLine  # (H,)
    profile: Profile  # (H,) head frame
    fault: str = ""  # what was wrong with the image; empty when nothing was
    places: NDArray[np.float32] | None = None  # all that looks like a line, as `Look` has it


Sink = Callable[[Step], None]


class Pipeline:
    """What turns one shot into points; the same object serves every worker, for it changes nothing."""

    def __init__(
        self,
        calibration: Calibration,
        laserline: LaserLineParams,
        triangulation: TriangulationParams,
        slack_px: float = 0.0,
    ) -> None:
        """Make ready; with `slack_px` more columns to either side than range_min and range_max allow.

        A calibration that is to be judged or refined must not hide from view what speaks against it.
        """
        self.calibration = calibration
        self.laserline = laserline
        self.triangulation = triangulation
        self.window: NDArray[np.float64] = column_window(calibration, triangulation)
        self.window += np.array([-slack_px, slack_px])
        self.colour = needs_colour(laserline)  # whether the line is found in colour or a grey decode will do

    def process(self, shot: Shot, still: NDArray[np.bool_] | None = None) -> Step:
        """Decode, find the line, triangulate. A bad image gives a Step without points and its fault.

        Args:
            still: where things of the room are known to be, as `laserline.look` takes it.
        """
        try:
            image = self._decode(shot.image)
            background = self._decode(shot.background) if shot.background is not None else None
        except CameraError as error:
            return self._blind(shot, str(error))
        dark = background.image if background else None
        line, places = look(image.image, self.laserline, dark, self.window, still)
        fault = ""
        rows = min(image.rows_valid, background.rows_valid if background else image.rows_valid)
        if rows < len(line.reason):
            line = _without_rows(line, rows)
            fault = f"image is cut: {rows} of {len(line.reason)} rows are whole"
        return Step(shot, line, triangulate(line, self.calibration, self.triangulation), fault, places)

    def _decode(self, data: bytes) -> Decoded:
        decoded = decode_image(data, grey=not self.colour)
        height, width = decoded.image.shape[:2]
        own = self.calibration.intrinsics
        if (width, height) != (own.width, own.height):
            raise CameraError(f"image is {width}x{height}, the calibration is for {own.width}x{own.height}")
        return decoded

    def _blind(self, shot: Shot, fault: str) -> Step:
        rows = self.calibration.intrinsics.height
        nan = np.full(rows, np.nan)
        line = LaserLine(nan, nan, nan, nan, np.full(rows, Reason.DAMAGED, np.uint8))
        return Step(shot, line, triangulate(line, self.calibration, self.triangulation), fault)


def _without_rows(line: LaserLine, first: int) -> LaserLine:
    """The line with every row from `first` on given up as damaged."""
    damaged = np.arange(len(line.reason)) >= first
    column, peak, width, sigma = (np.where(damaged, np.nan, values) for values in line[:4])
    return LaserLine(column, peak, width, sigma, np.where(damaged, Reason.DAMAGED, line.reason).astype(np.uint8))
