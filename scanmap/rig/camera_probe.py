"""What a camera can do: the usual picture sizes tried, and how fast they really come."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2

from scanmap.errors import CameraError
from scanmap.rig.camera_capture import BACKENDS
from scanmap.rig.camera_checks import Size

USUAL_SIZES = (
    (320, 240),
    (640, 480),
    (800, 600),
    (1280, 720),
    (1280, 960),
    (1600, 1200),
    (1920, 1080),
    (2592, 1944),
    (3840, 2160),
)
TIMED_PICTURES = 8
PATIENCE_S = 2.0  # for one size


class Mode(NamedTuple):
    """A picture size and how it comes."""

    size: Size
    rate_hz: float  # measured
    sends_jpeg: bool

    @property
    def words(self) -> str:
        """For people."""
        return f"{self.size} at {self.rate_hz:.0f}/s {'JPEG' if self.sends_jpeg else 'uncompressed'}"


def probe_modes(index: int, clock: Callable[[], float] = time.monotonic) -> list[Mode]:
    """The sizes a camera sends of the usual ones, and the measured rate of each.

    Raises:
        CameraError: it cannot be opened.
    """
    capture = cv2.VideoCapture(index, BACKENDS.get(sys.platform, cv2.CAP_ANY))
    try:
        if not capture.isOpened():
            raise CameraError(
                f"camera {index} cannot be opened: another program may hold it, or you may not use it (group `video`: "
                "`sudo usermod -aG video $USER`, log in again)"
            )
        modes: dict[Size, Mode] = {}
        for wanted in USUAL_SIZES:
            mode = _mode(capture, Size(*wanted), clock)
            if mode is not None and mode.size not in modes:
                modes[mode.size] = mode
        return list(modes.values())
    finally:
        capture.release()


def _mode(capture: Any, wanted: Size, clock: Callable[[], float]) -> Mode | None:
    """What comes when `wanted` is asked for; None if nothing does."""
    jpeg = cv2.VideoWriter.fourcc(*"MJPG")
    capture.set(cv2.CAP_PROP_FOURCC, jpeg)
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, wanted.width)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, wanted.height)
    size = Size(int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
    if size != wanted:
        return None
    sends_jpeg = int(capture.get(cv2.CAP_PROP_FOURCC)) == jpeg
    capture.set(cv2.CAP_PROP_CONVERT_RGB, 0 if sends_jpeg else 1)
    begun = clock()
    times: list[float] = []
    while len(times) <= TIMED_PICTURES and clock() - begun < PATIENCE_S:
        ok, _ = capture.read()
        if not ok:
            break
        times.append(clock())
    if len(times) < 2:
        return None
    return Mode(size, (len(times) - 1) / max(times[-1] - times[0], 1e-6), sends_jpeg)
