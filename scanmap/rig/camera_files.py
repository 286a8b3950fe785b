"""Pictures of a folder or a video as a camera: each grab gives the next one. For trying things without a camera."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from scanmap.errors import CameraError
from scanmap.rig import Frame
from scanmap.rig.camera import CameraParams
from scanmap.rig.camera_checks import check_header, is_black
from scanmap.shot import encode_png, image_format

SUFFIXES = (".jpg", ".jpeg", ".png")


class NoMorePicturesError(CameraError):
    """A file or folder came to its end."""


class FileCamera:
    """Hands out pictures in order, stamped with the time they are asked for. Implements `scanmap.rig.Camera`."""

    def __init__(self, name: str, pictures: Iterator[bytes], clock: Callable[[], float] = time.monotonic) -> None:
        """Look at the first picture.

        Raises:
            CameraError: there is none, or it is damaged.
        """
        self.name = name
        self._pictures = pictures
        self._clock = clock
        self._waiting: bytes | None = self._next()
        self._size = check_header(self._waiting, None)

    @property
    def width(self) -> int:
        """Image width [px]."""
        return self._size.width

    @property
    def height(self) -> int:
        """Image height [px]."""
        return self._size.height

    def grab(self) -> Frame:
        """The next picture, whatever it shows.

        Raises:
            CameraError: there are no more, or it is cut, damaged or of another size.
        """
        frame = self.newest()
        is_black(frame.image)
        return frame

    def newest(self) -> Frame:
        """The next picture; only its header is looked at. Raises CameraError as `grab`."""
        data, self._waiting = (self._next() if self._waiting is None else self._waiting), None
        check_header(data, self._size)
        return Frame(data, self._clock())

    def close(self) -> None:
        """Free the file; may be called twice."""
        close = getattr(self._pictures, "close", None)
        if close is not None:
            close()

    def _next(self) -> bytes:
        try:
            return next(self._pictures)
        except StopIteration:
            raise NoMorePicturesError(
                f"camera {self.name} has no more pictures: it is a file or folder, and at its end"
            ) from None
        except OSError as error:
            raise CameraError(f"camera {self.name} cannot be read: {error}") from error


def open_files(params: CameraParams) -> FileCamera:
    """The folder or video that `params.source` names.

    Raises:
        CameraError: it does not exist, or holds no picture.
    """
    path = Path(str(params.source))
    if not path.exists():
        raise CameraError(
            f"camera.source = {str(path)!r} is no index, no URL and no file; valid: auto, 0, /dev/video0, "
            "http://phone:8080/video, rtsp://..., a video file, a folder of pictures"
        )
    return FileCamera(str(path), _of_folder(path) if path.is_dir() else _of_video(path))


def _of_folder(path: Path) -> Iterator[bytes]:
    files = sorted(entry for entry in path.iterdir() if entry.suffix.lower() in SUFFIXES)
    if not files:
        kinds = ", ".join(SUFFIXES)
        raise CameraError(f"camera.source = {str(path)!r}: no pictures ({kinds}) in it; name their folder")
    for file in files:
        yield file.read_bytes()


def _of_video(path: Path) -> Iterator[bytes]:
    """A motion JPEG's pictures as they are, those of any other video as PNG."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    is_jpeg = capture.isOpened() and int(capture.get(cv2.CAP_PROP_FOURCC)) == cv2.VideoWriter.fourcc(*"MJPG")
    if not is_jpeg:
        capture.release()
        capture = cv2.VideoCapture(str(path))
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # as the sensor read it, like a phone's pictures
    try:
        if not capture.isOpened():
            raise CameraError(f"video {path} cannot be opened: no video, damaged, or a codec that OpenCV lacks")
        while True:
            ok, pixels = capture.read()
            if not ok:
                return
            packet = pixels.tobytes() if pixels.shape[0] == 1 else b""
            yield packet if image_format(packet) == "jpeg" else encode_png(np.asarray(pixels, np.uint8))
    finally:
        capture.release()
