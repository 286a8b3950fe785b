"""What a sweep's watch is told of the laser line."""

from __future__ import annotations

import math

import numpy as np

from scanmap.calibration import Calibration
from scanmap.config import Config
from scanmap.errors import CameraError
from scanmap.laserline import find_laser_line, needs_colour
from scanmap.shot import decode_image
from scanmap.sweep import Watch
from scanmap.triangulation import column_window

JITTER_S = 0.02  # by which the time of a picture taken while the head turns may be off
LATENCY_S = 0.15  # by which it may be wrong altogether, where the camera's latency was never measured
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

    speed = math.radians(config.sweep.speed_deg_s) if config.sweep.mode == "continuous" else 0.0
    own = calibration.intrinsics
    return Watch(own.fx, own.width, lit, slack_rad=speed * JITTER_S, latency_rad=speed * LATENCY_S)
