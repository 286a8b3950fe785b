"""Which camera a rig has: the `[camera]` section and what opens it."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import BaseModel, Field

from scanmap.errors import CameraError, ConfigError
from scanmap.rig import Camera

if TYPE_CHECKING:
    from scanmap.rig.camera_stream import PictureSource

URL = re.compile(r"^[a-z][a-z0-9+.-]+://", re.IGNORECASE)
NETWORK_VIDEO = ("rtsp", "rtsps", "rtmp", "udp", "tcp")
MAX_INDEX = 8  # cameras looked for where the system has no list of them

Kind = Literal["device", "http", "stream", "file", "folder"]

# How much older than its time stamp a picture may be before anybody measured it [s]: on the safe side, so that a
# picture from before the head stopped is never taken. Devices stamp near the exposure, networks on arrival.
LATENCY_GUESS_S: dict[Kind, float] = {"device": 0.05, "http": 0.3, "stream": 1.0, "file": 0.0, "folder": 0.0}


class CameraParams(BaseModel, frozen=True, extra="forbid"):
    """Which camera looks at the line, and how; `[camera]` in a rig's TOML."""

    source: int | str = Field(
        "auto",
        description="auto (the first that delivers), index, /dev/video0, http://phone:8080/video (MJPEG or single "
        "pictures), rtsp://..., a video file, or a folder of pictures",
    )
    width: int | None = Field(None, ge=16, le=16384, description="image width; none = the calibration's [px]")
    height: int | None = Field(None, ge=16, le=16384, description="image height; none = the calibration's [px]")
    rate_hz: float | None = Field(None, gt=0.0, le=1000.0, description="pictures a second; none = the camera's choice")
    format: Literal["mjpeg", "raw"] = Field(
        "mjpeg", description="mjpeg: the camera's own JPEGs, kept untouched; raw: uncompressed, kept as lossless PNG"
    )
    exposure_us: float | None = Field(
        None, gt=0.0, le=1e7, description="exposure time, fixed; none = the camera's automatic [us]"
    )
    gain: float | None = Field(None, ge=0.0, le=1e5, description="gain; none = as the camera has it [camera's units]")
    focus: float | None = Field(
        None, ge=0.0, le=1e5, description="focus, fixed; none = as the camera has it [camera's units]"
    )
    white_balance_k: float | None = Field(
        None, ge=1000.0, le=20000.0, description="white balance, fixed; none = the camera's automatic [K]"
    )
    latency_s: float | None = Field(
        None,
        ge=-0.1,
        le=5.0,
        description="how much later than the middle of its exposure a picture is stamped; none = not measured yet, "
        "see scanmap calibrate latency [s]",
    )
    timeout_s: float = Field(2.0, gt=0.0, le=60.0, description="how long no usable picture may come [s]")

    @property
    def kind(self) -> Kind:
        """What the source is: a device of this machine, a network stream or a file."""
        text = str(self.source)
        if URL.match(text):
            scheme = text.partition("://")[0].lower()
            if scheme in ("http", "https"):
                return "http"
            if scheme in NETWORK_VIDEO:
                return "stream"
            raise ConfigError(
                f"camera.source = {text!r}: {scheme}:// is no way to a camera; valid: http://, https://, rtsp://"
            )
        if text == "auto" or text.isdigit() or text.startswith("/dev/"):
            return "device"
        return "folder" if Path(text).is_dir() else "file"

    @property
    def latency(self) -> float:
        """Seconds by which a time stamp is late: measured, or a guess on the safe side."""
        return LATENCY_GUESS_S[self.kind] if self.latency_s is None else self.latency_s


def open_camera(params: CameraParams, size: tuple[int, int] | None = None) -> Camera:
    """Open the camera that `params` names, and wait for its first picture.

    What the camera refuses (a size, an exposure) is a warning; the pictures are what it sends.

    Args:
        size: width and height [px] to ask for where `params` names none: the calibration's.

    Raises:
        ConfigError: the source is of no known kind.
        CameraError: no camera, or no usable picture came.
    """
    wanted = params
    if size is not None:
        wanted = params.model_copy(update={"width": params.width or size[0], "height": params.height or size[1]})
    if params.kind in ("file", "folder"):
        from scanmap.rig.camera_files import open_files

        return open_files(wanted)
    if params.source == "auto":
        return _first_that_delivers(wanted)
    return _open_stream(wanted)


def camera_devices() -> list[tuple[int, str]]:
    """Index and name of every camera of this machine; on systems without a list, of every index that opens."""
    listed = Path("/sys/class/video4linux")
    if sys.platform == "linux":
        nodes = sorted(listed.glob("video*"), key=lambda node: int(node.name[5:])) if listed.is_dir() else []
        # A camera has further nodes, for metadata; its pictures come from the one with index 0.
        return [(int(node.name[5:]), _text(node / "name")) for node in nodes if _text(node / "index") in ("0", "")]
    import cv2

    found = []
    for index in range(MAX_INDEX):
        capture = cv2.VideoCapture(index)
        if capture.isOpened():
            found.append((index, f"camera {index}"))
        capture.release()
    return found


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def _first_that_delivers(params: CameraParams) -> Camera:
    faults = []
    for index, name in camera_devices():
        try:
            return _open_stream(params.model_copy(update={"source": index}))
        except CameraError as error:
            faults.append(f"{index} ({name}): {error}")
    raise CameraError(
        f"no camera found ({'; '.join(faults) or 'none on this machine'}): plug one in, or set camera.source to its "
        "index or URL; `scanmap doctor` lists what is there"
    )


def _open_stream(params: CameraParams) -> Camera:
    from scanmap.rig.camera_stream import StreamCamera

    return StreamCamera(_picture_source(params), params)


def _picture_source(params: CameraParams) -> PictureSource:
    if params.kind == "http":
        from scanmap.rig.camera_http import HttpPictures

        return HttpPictures(str(params.source), params)
    from scanmap.rig.camera_capture import CapturedPictures

    return CapturedPictures(params)
