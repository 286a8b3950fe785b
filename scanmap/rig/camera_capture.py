"""Pictures by way of OpenCV: webcams (V4L2 and its like), and network video such as RTSP.

A webcam's JPEGs are taken as it sent them. One that sends none is decoded by OpenCV and kept as lossless PNG.
"""

from __future__ import annotations

import logging
import math
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from scanmap.errors import CameraError
from scanmap.rig.camera import CameraParams
from scanmap.rig.camera_checks import without_padding
from scanmap.rig.camera_stream import Picture

BACKENDS = {"linux": cv2.CAP_V4L2, "win32": cv2.CAP_DSHOW, "darwin": cv2.CAP_AVFOUNDATION}
BY_ID = Path("/dev/v4l/by-id")
MAX_AGE_S = 1.0  # a device's stamp further back than this is none
PATIENCE_MS = 5000  # of OpenCV with a network stream
# (manual, automatic) exposure as the system's interface numbers them.
EXPOSURE_MODES = {"linux": (1.0, 3.0), "win32": (0.25, 0.75)}

logger = logging.getLogger(__name__)


class Control(NamedTuple):
    """One setting of a camera."""

    name: str  # its key in [camera]
    number: int  # OpenCV's property
    value: float  # in the units of the system's interface
    tolerance: float


class CapturedPictures:
    """A `PictureSource` on cv2.VideoCapture."""

    def __init__(self, params: CameraParams, clock: Any = time.monotonic) -> None:
        self._params = params
        self._clock = clock
        self._capture: Any = None
        self._device_stamps: bool | None = None  # whether the device stamps its pictures; known after the first
        self._known_refusals: list[str] = []
        self._lasting = ""  # finds the same camera again when it is plugged in anew and gets another number

    @property
    def name(self) -> str:
        """What users call it."""
        return str(self._params.source)

    def open(self) -> None:
        """Open the device and ask for everything that is set.

        Raises:
            CameraError: there is no such camera, or another program holds it.
        """
        self.close()
        capture = self._opened()
        if not capture.isOpened():
            capture.release()
            raise CameraError(self._why_not())
        if self._params.kind == "device":
            refusals = [*_ask_for_format(capture, self._params), *_ask_for_controls(capture, self._params)]
            for refusal in refusals:
                if refusal not in self._known_refusals:
                    logger.warning("camera %s: %s", self.name, refusal)
            self._known_refusals = refusals
        self._capture = capture
        self._lasting = self._lasting or _lasting_name(self.name)

    def read(self) -> Picture:
        """The next picture.

        Raises:
            CameraError: none came: unplugged, or the stream ended.
        """
        try:
            ok, pixels = self._capture.read()
        except cv2.error as error:
            raise CameraError(f"camera {self.name} failed: {error}") from error
        arrival = self._clock()
        if not ok or pixels is None or not pixels.size:
            raise CameraError(
                f"camera {self.name} stopped sending: plug it in again and check its cable, then `scanmap doctor`"
            )
        return Picture(_as_sent(np.asarray(pixels, np.uint8)), self._stamp(arrival))

    def expose(self, exposure_us: float) -> None:
        """Expose so long from now on [us]; what is refused is a warning."""
        self._params = self._params.model_copy(update={"exposure_us": exposure_us})
        if self._capture is not None:
            only = CameraParams(source=self._params.source, exposure_us=exposure_us)
            for refusal in _ask_for_controls(self._capture, only):
                logger.warning("camera %s: %s", self.name, refusal)

    def close(self) -> None:
        """Free the device; may be called twice."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _opened(self) -> Any:
        if self._params.kind == "stream":
            patience = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, PATIENCE_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, PATIENCE_MS]
            return cv2.VideoCapture(self.name, cv2.CAP_FFMPEG, patience)
        target = self._lasting or self.name
        return cv2.VideoCapture(int(target) if target.isdigit() else target, BACKENDS.get(sys.platform, cv2.CAP_ANY))

    def _stamp(self, arrival: float) -> float:
        """The driver's own stamp, which is nearer to the exposure, where it is on our clock; else the arrival."""
        if self._params.kind != "device" or self._device_stamps is False:
            return arrival
        stamp = float(self._capture.get(cv2.CAP_PROP_POS_MSEC)) * 1e-3
        believable = -0.01 <= arrival - stamp <= MAX_AGE_S
        if self._device_stamps is None:
            self._device_stamps = believable
            logger.debug("camera %s: pictures are stamped by %s", self.name, "the driver" if believable else "arrival")
        if not believable and self._device_stamps:
            raise CameraError(f"camera {self.name} stamped a picture {arrival - stamp:.3f} s before it came")
        return stamp if self._device_stamps else arrival

    def _why_not(self) -> str:
        if self._params.kind == "stream":
            return (
                f"camera {self.name} does not answer: is the URL right, and can this machine reach it? Test it with a "
                "video player"
            )
        from scanmap.rig.camera import camera_devices

        found = ", ".join(f"{index} ({name})" for index, name in camera_devices()) or "none"
        return (
            f"camera {self.name} cannot be opened; cameras of this machine: {found}. Another program may hold it, or "
            "you may not use it (group `video`: `sudo usermod -aG video $USER`); `scanmap doctor` looks closer"
        )


def _lasting_name(source: str) -> str:
    """The device file, of those named after the camera itself, that leads to `source`; empty where there is none."""
    if sys.platform != "linux" or not BY_ID.is_dir():
        return ""
    device = Path("/dev") / f"video{source}" if source.isdigit() else Path(source)
    return next((str(link) for link in sorted(BY_ID.iterdir()) if link.resolve() == device.resolve()), "")


def _as_sent(pixels: np.ndarray[Any, np.dtype[np.uint8]]) -> bytes | np.ndarray[Any, np.dtype[np.uint8]]:
    """Encoded pictures (1, N) as bytes, decoded ones as BGR."""
    if 1 in pixels.shape[:2]:
        return without_padding(pixels.tobytes())
    if pixels.ndim == 2:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR), np.uint8)
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise CameraError(f"camera sent data of shape {pixels.shape} that is no picture")
    return pixels


def _ask_for_format(capture: Any, params: CameraParams) -> list[str]:
    """Compression, size and rate; what was refused, in words."""
    refusals: list[str] = []
    code = cv2.VideoWriter.fourcc(*("MJPG" if params.format == "mjpeg" else "YUYV"))
    capture.set(cv2.CAP_PROP_FOURCC, code)
    for number, wanted in ((cv2.CAP_PROP_FRAME_WIDTH, params.width), (cv2.CAP_PROP_FRAME_HEIGHT, params.height)):
        if wanted is not None:
            capture.set(number, wanted)  # compared with the first picture, which is what counts
    if params.rate_hz is not None:
        rate = _read_back(capture, cv2.CAP_PROP_FPS, params.rate_hz)
        if abs(rate - params.rate_hz) > 0.05 * params.rate_hz:
            refusals.append(f"rate_hz = {params.rate_hz:g} was refused, it says {rate:g}")
    sends_jpeg = int(capture.get(cv2.CAP_PROP_FOURCC)) == cv2.VideoWriter.fourcc(*"MJPG")
    capture.set(cv2.CAP_PROP_CONVERT_RGB, 0 if sends_jpeg else 1)
    if params.format == "mjpeg" and not sends_jpeg:
        refusals.append("it sends no JPEG at this size; its pictures are kept as PNG, which makes large recordings")
    return refusals


def _ask_for_controls(capture: Any, params: CameraParams) -> list[str]:
    """Exposure, gain, focus, white balance; what was refused, in words."""
    refusals: list[str] = []
    manual, automatic = EXPOSURE_MODES.get(sys.platform, (1.0, 3.0))
    if params.exposure_us is None:
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, automatic)
        refusals.append("its exposure is automatic and the line's brightness will vary; set camera.exposure_us")
    elif not math.isclose(_read_back(capture, cv2.CAP_PROP_AUTO_EXPOSURE, manual), manual, abs_tol=0.01):
        refusals.append("automatic exposure could not be switched off")
    if params.focus is not None and _read_back(capture, cv2.CAP_PROP_AUTOFOCUS, 0.0) > 0:
        refusals.append("automatic focus could not be switched off")
    if params.white_balance_k is not None and _read_back(capture, cv2.CAP_PROP_AUTO_WB, 0.0) > 0:
        refusals.append("automatic white balance could not be switched off")
    for control in _controls(params):
        value = _read_back(capture, control.number, control.value)
        if abs(value - control.value) > control.tolerance:
            refusals.append(f"{control.name} = {getattr(params, control.name):g} was refused, it says {value:g}")
    return refusals


def _controls(params: CameraParams) -> list[Control]:
    controls = []
    if params.exposure_us is not None:
        # V4L2 counts in 100 us, DirectShow in powers of two of a second.
        windows = sys.platform == "win32"
        value = round(math.log2(params.exposure_us * 1e-6)) if windows else max(1.0, round(params.exposure_us / 100))
        controls.append(Control("exposure_us", cv2.CAP_PROP_EXPOSURE, value, max(0.5, 0.1 * abs(value))))
    if params.gain is not None:
        controls.append(Control("gain", cv2.CAP_PROP_GAIN, params.gain, 0.5))
    if params.focus is not None:
        controls.append(Control("focus", cv2.CAP_PROP_FOCUS, params.focus, 0.5))
    if params.white_balance_k is not None:
        controls.append(Control("white_balance_k", cv2.CAP_PROP_WB_TEMPERATURE, params.white_balance_k, 50.0))
    return controls


def _read_back(capture: Any, number: int, value: float) -> float:
    """Ask for a value; what the camera says it has now."""
    capture.set(number, value)
    return float(capture.get(number))
