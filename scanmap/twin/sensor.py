"""From light on the sensor to the bytes a webcam sends: noise, transfer curve, 8 bit, JPEG.

Full-frame arithmetic is on int16 in 64ths of a grey level, after the transfer curve; noise is added there
with the standard deviation that shot noise has at that level.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from scanmap.shot import encode_png

F32 = NDArray[np.float32]
Coded = NDArray[np.int16]

STEPS = 64  # of int16 per grey level
TOP = 400  # [grey levels] the curve goes on above 255, so that noise does not pull saturated pixels down


class SensorParams(BaseModel, frozen=True, extra="forbid"):
    """The twin's camera behind the lens; `[twin.sensor]`."""

    transfer: Literal["srgb", "linear"] = Field(
        "srgb", description="tone curve; srgb is what webcams send: noise is then even, the line flat-topped"
    )
    noise: bool = Field(True, description="shot, read noise")
    full_well_e: float = Field(8000.0, gt=10, description="electrons at saturation: fewer, more shot noise")
    read_noise_dn: float = Field(1.0, ge=0, le=10, description="noise of electronics and processing [grey levels]")
    blur_px: float = Field(0.6, ge=0, le=10, description="optical blur, standard deviation [px]")
    glare: float = Field(0.01, ge=0, le=0.5, description="part of the light scattered around bright places")
    glare_px: float = Field(6.0, gt=0, le=200, description="reach of that, standard deviation [px]")
    red_filter: bool = Field(False, description="red glass before the lens: green and blue dimmed 20 times")
    encoding: Literal["jpeg", "png"] = Field("jpeg", description="what the camera sends")
    jpeg_quality: int = Field(90, ge=1, le=100, description="JPEG quality")
    jpeg_subsampling: Literal["444", "422", "420"] = Field("422", description="JPEG colour resolution; webcams: 422")

    @property
    def filter_rgb(self) -> F32:
        """(3,) transmission of the glass before the lens."""
        return np.array((0.92, 0.05, 0.05) if self.red_filter else (1.0, 1.0, 1.0), np.float32)


class Sensor:
    """A camera's chip and its encoder; the tile its noise is cut from is drawn from `rng`."""

    def __init__(self, params: SensorParams, width: int, height: int, rng: np.random.Generator) -> None:
        self._params = params
        self._shape = (height, width)
        self._linear = self._decoded(np.arange(TOP * STEPS + 1) / STEPS).astype(np.float32)
        self._sigma = self._noise_per_level()
        self._work = np.empty((height, width, 3), np.int16)
        size = (height + 1) * width * 3 if params.noise else 0
        # Standard normal in 32nds. Every row of a frame is cut out of it at random, so it need not be drawn anew; a
        # whole picture cut out in one piece would let two frames be matched by their noise.
        self._strip = np.clip(np.rint(rng.standard_normal(size, np.float32) * 32), -127, 127).astype(np.int8)

    def code(self, light: F32) -> Coded:
        """Light [fraction of saturation] to grey levels times STEPS, before noise; any shape."""
        if self._params.transfer == "linear":
            level = light * 255.0
        else:
            # IEC 61966-2-1; above 1 the same curve goes on.
            root = np.maximum(light, np.float32(0.0031308)) ** np.float32(1 / 2.4)
            level = np.where(light <= 0.0031308, 12.92 * light, 1.055 * root - 0.055) * 255.0
        coded: Coded = np.rint(np.clip(level, 0.0, TOP) * STEPS).astype(np.int16)
        return coded

    def light(self, coded: Coded) -> F32:
        """The inverse of `code`."""
        return self._linear[coded]

    def noise_amplitude(self, coded: Coded) -> NDArray[np.uint8]:
        """Noise of coded values, standard deviation in 16ths of a grey level."""
        level = cv2.convertScaleAbs(coded, alpha=1.0 / STEPS)
        return np.asarray(cv2.LUT(level, self._sigma), np.uint8)

    def read_out(self, coded: Coded, amplitude: NDArray[np.uint8], rng: np.random.Generator) -> bytes:
        """One picture (H, W, 3) RGB with its noise, encoded; `rng` says which."""
        work = self._work
        if self._params.noise:
            rows, columns = self._shape
            starts = rng.integers(0, self._strip.size - 3 * columns + 1, rows)
            noise = np.lib.stride_tricks.sliding_window_view(self._strip, 3 * columns)[starts]
            np.multiply(amplitude, noise.reshape(rows, columns, 3), out=work, dtype=np.int16, casting="unsafe")
            np.right_shift(work, 3, out=work)
            np.add(work, coded, out=work)
            np.add(work, STEPS // 2, out=work)
        else:
            np.add(coded, STEPS // 2, out=work)
        np.right_shift(work, 6, out=work)
        np.clip(work, 0, 255, out=work)
        return self._encoded(work.astype(np.uint8))

    def _encoded(self, picture: NDArray[np.uint8]) -> bytes:
        if self._params.encoding == "png":
            return encode_png(np.ascontiguousarray(picture[:, :, ::-1]))
        # Not TurboJPEG: below quality 96 its fast DCT is off by several grey levels beside a line, in every row alike.
        sampling = getattr(cv2, f"IMWRITE_JPEG_SAMPLING_FACTOR_{self._params.jpeg_subsampling}")
        how = [cv2.IMWRITE_JPEG_QUALITY, self._params.jpeg_quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
        return cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), how)[1].tobytes()

    def _decoded(self, level: NDArray[np.float64]) -> NDArray[np.float64]:
        v = level / 255.0
        if self._params.transfer == "linear":
            return v
        return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)

    def _noise_per_level(self) -> NDArray[np.uint8]:
        """Per grey level: shot noise through the slope of the transfer curve, and read noise."""
        level = np.arange(256, dtype=np.float64)
        light = self._decoded(level)
        slope = 1.0 / (self._decoded(level + 0.5) - self._decoded(level - 0.5))
        shot = slope * np.sqrt(light / self._params.full_well_e)
        return np.clip(np.rint(16.0 * np.hypot(shot, self._params.read_noise_dn)), 0, 255).astype(np.uint8)
