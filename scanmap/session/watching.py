"""What a sweep's watch is told of the laser line."""

from __future__ import annotations

import numpy as np

from scanmap.calibration import Calibration
from scanmap.config import Config
from scanmap.errors import CameraError
from scanmap.laserline import find_laser_line, needs_colour
from scanmap.shot import decode_image
from scanmap.sweep import Watch
from scanmap.triangulation import column_window

EVERY_ROW = 8  # of those that are asked for a line: the question is only whether there is one


def watch_of(config: Config, calibration: Calibration) -> Watch:
    """The watch over a sweep with this head."""
    params = config.laserline.model_copy(update={"pool_rows": 1})  # rows so far apart do not help each other
    window = column_window(calibration, config.triangulation)[::EVERY_ROW]
    grey = not needs_colour(params)

    def lit(image: bytes, background: bytes | None) -> float:
        try:
            rows = decode_image(image, grey=grey).image[::EVERY_ROW]
            dark = decode_image(background, grey=grey).image[::EVERY_ROW] if background is not None else None
        except CameraError:
            return 1.0  # a damaged picture says nothing of the laser
        if len(rows) != len(window):
            return 1.0
        return float(np.isfinite(find_laser_line(rows, params, dark, window).column_px).mean())

    return Watch(calibration.intrinsics.fx, calibration.intrinsics.width, lit)
