"""The thesis's own view: its four pictures, and its numbers for one chosen row."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.errors import CalibrationError, ConfigError
from scanmap.laserline import LaserLineParams, binary_image, overlay, to_grey
from scanmap.pipeline import Step
from scanmap.shot import Image, decode_image
from scanmap.triangulation import (
    TriangulationParams,
    locate,
    pixel_angle_model_of,
    pixel_ratio,
    ratio_model_of,
)
from scanmap.view import entities as at
from scanmap.view.entities import ViewParams
from scanmap.view.pictures import Picture, jpeg, png, shrink_factor, shrunk, shrunk_lines

if TYPE_CHECKING:
    import rerun as rr

Array = NDArray[np.float64]

PANE_PX = 400  # of four pictures side by side in a window none is much wider
ROW_COLOUR = (255, 210, 60, 150)

_MODELS = {
    "algorithm_1": ("Algorithm 1, pixel ratio", TriangulationParams(model="ratio"), (255, 170, 60)),
    "algorithm_2": ("Algorithm 2, pixel angle", TriangulationParams(model="pixel_angle"), (90, 170, 255)),
    "calibrated": ("calibrated plane", TriangulationParams(model="plane"), (110, 230, 120)),
}


class ThesisView:
    """Logs shots the way the thesis's program showed them (features T5 to T9 and T11)."""

    def __init__(
        self, recording: rr.RecordingStream, calibration: Calibration, laserline: LaserLineParams, params: ViewParams
    ) -> None:
        """Raises ConfigError where `params.row` is not a row of the image."""
        own = calibration.intrinsics
        self._recording = recording
        self._calibration, self._models = _with_models(calibration)
        self._laserline = laserline
        self._params = params
        self._row = chosen_row(own.height, params)
        self._shrink = shrink_factor(own.width, params.thesis_width_px)
        self._log_constant()

    def log_numbers(self, step: Step) -> None:
        """`ppx`, `p` and the distance by both algorithms and by the calibration, of the chosen row."""
        import rerun as rr

        log = self._recording.log
        ppx = step.line.column_px[self._row : self._row + 1]
        log(at.THESIS_PPX, rr.Scalars(ppx))
        log(at.THESIS_P, rr.Scalars(pixel_ratio(ppx, self._calibration.intrinsics.width)))
        for name in self._models:
            points, _, _ = locate(ppx, np.array([float(self._row)]), self._calibration, _MODELS[name][1])
            log(f"{at.THESIS_DISTANCE}/{name}", rr.Scalars(points[:, 0]))

    def log_pictures(self, step: Step) -> None:
        """Original, grey, line image and overlay of a shot.

        Raises:
            CameraError: its image cannot be decoded.
        """
        import rerun as rr

        image = decode_image(step.shot.image).image
        for path, picture in self._pictures(image, step.line.column_px).items():
            self._recording.log(path, rr.EncodedImage(contents=picture.data, media_type=picture.media_type))

    def _pictures(self, image: Image, column_px: Array) -> dict[str, Picture]:
        quality, k = self._params.jpeg_quality, self._shrink
        wide = image.shape[1] / k > PANE_PX
        grey = to_grey(image, self._laserline.grey, self._laserline.bit_index)
        return {
            at.THESIS_ORIGINAL: jpeg(shrunk(image, k), quality),
            at.THESIS_GREY: jpeg(shrunk(grey, k), quality),
            at.THESIS_BINARY: png(shrunk_lines(binary_image(grey), k)),
            at.THESIS_OVERLAY: jpeg(painted(grey, column_px, self._params.overlay_colour, k, wide=wide), quality),
        }

    def _log_constant(self) -> None:
        """The chosen row in each picture, and the names of the plots."""
        import rerun as rr

        log = self._recording.log
        v, width = (self._row + 0.5) / self._shrink, self._calibration.intrinsics.width / self._shrink
        for path in at.THESIS_PICTURES:
            strip = rr.LineStrips2D([[[0.0, v], [width, v]]], colors=ROW_COLOUR, radii=-0.75)
            log(f"{path}/row", strip, static=True)
        log(at.THESIS_PPX, rr.SeriesLines(names=f"ppx of row {self._row} [px]", colors=(255, 90, 90)), static=True)
        log(at.THESIS_P, rr.SeriesLines(names="p = (l - ppx) / l", colors=(200, 160, 255)), static=True)
        for name in self._models:
            words, _, colour = _MODELS[name]
            log(f"{at.THESIS_DISTANCE}/{name}", rr.SeriesLines(names=f"{words} [m]", colors=colour), static=True)


def chosen_row(height: int, params: ViewParams) -> int:
    """The row whose numbers are shown.

    Raises:
        ConfigError: an image of this height has no such row.
    """
    row = height // 2 if params.row is None else params.row
    if row >= height:
        raise ConfigError(f"view.row = {row} is not a row of the image; choose 0 to {height - 1}")
    return row


def _with_models(calibration: Calibration) -> tuple[Calibration, tuple[str, ...]]:
    """The calibration with both algorithms' constants, fitted where it has none; and which models this head has."""
    try:
        calibration = replace(calibration, ratio=ratio_model_of(calibration))
        calibration = replace(calibration, pixel_angle=pixel_angle_model_of(calibration))
    except CalibrationError:
        pass
    has = {"algorithm_1": calibration.ratio, "algorithm_2": calibration.pixel_angle, "calibrated": True}
    return calibration, tuple(name for name, there in has.items() if there)


def painted(
    grey: Image, column_px: Array, colour: Literal["red", "green", "blue"], factor: int, *, wide: bool = False
) -> Image:
    """The overlay (T7), BGR, made smaller by `factor`.

    Where it is made smaller, or `wide` asks for it, the line is three pixels wide: a single one beside a saturated
    line would vanish in a window that is smaller still.
    """
    if factor == 1 and not wide:
        return overlay(grey, column_px, colour)
    line = shrunk_lines(overlay(np.zeros_like(grey), column_px, colour), factor)
    line = np.asarray(cv2.dilate(line, np.ones((1, 3), np.uint8)), np.uint8)
    picture = np.repeat(shrunk(grey, factor)[:, :, None], 3, axis=2)
    return np.where(line.any(axis=2, keepdims=True), line, picture)
