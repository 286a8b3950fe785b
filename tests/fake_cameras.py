"""Cameras for tests: cv2.VideoCapture as V4L2 would answer, and phones that serve MJPEG or single pictures."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2
import numpy as np
import simplejpeg

MJPG = cv2.VideoWriter.fourcc(*"MJPG")
YUYV = cv2.VideoWriter.fourcc(*"YUYV")


def noisy(rng: np.random.Generator, level: int = 60, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    """A picture (H, W, 3) as a sensor gives it: never twice the same."""
    return np.clip(rng.normal(level, 4, (size[1], size[0], 3)), 0, 255).astype(np.uint8)


def as_jpeg(pixels: np.ndarray, quality: int = 90) -> bytes:
    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(pixels), quality, "BGR", "422"))


@dataclass
class FakeDevice:
    """What stands behind /dev/video0 in a test."""

    period_s: float = 0.01
    latency_s: float = 0.0  # from exposure to the driver's stamp
    transfer_s: float = 0.0  # from the stamp to the arrival
    stamps: bool = True  # whether the driver stamps on the monotonic clock
    sends_jpeg: bool = True
    obeys: bool = True  # whether controls can be set
    sizes: tuple[tuple[int, int], ...] = ((64, 48), (128, 96))
    unplugged: bool = False
    padding: int = 0
    picture: Callable[[tuple[int, int]], bytes | np.ndarray] | None = None  # of what is exposed now
    controls: dict[int, float] = field(default_factory=dict)
    opened: int = 0
    released: int = 0
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(3))


class FakeCapture:
    """cv2.VideoCapture on a `FakeDevice`."""

    def __init__(self, device: FakeDevice) -> None:
        self.device = device
        self.size = device.sizes[0]
        self.jpeg = False
        self.raw = False
        self.stamp = 0.0
        self.due = time.monotonic()
        if not device.unplugged:
            device.opened += 1
        self.is_open = not device.unplugged

    def isOpened(self) -> bool:
        return self.is_open

    def set(self, number: int, value: float) -> bool:
        device = self.device
        if number == cv2.CAP_PROP_FOURCC:
            self.jpeg = device.sends_jpeg and int(value) == MJPG
        elif number in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT):
            at = 0 if number == cv2.CAP_PROP_FRAME_WIDTH else 1
            self.size = min(device.sizes, key=lambda size: abs(size[at] - value))
        elif number == cv2.CAP_PROP_CONVERT_RGB:
            self.raw = value == 0
        elif device.obeys:
            device.controls[number] = value
        return device.obeys

    def get(self, number: int) -> float:
        if number == cv2.CAP_PROP_FOURCC:
            return MJPG if self.jpeg else YUYV
        if number == cv2.CAP_PROP_POS_MSEC:
            return self.stamp * 1e3 if self.device.stamps else 0.0
        if number == cv2.CAP_PROP_FRAME_WIDTH:
            return self.size[0]
        if number == cv2.CAP_PROP_FRAME_HEIGHT:
            return self.size[1]
        return self.device.controls.get(number, 7.0)

    def read(self) -> tuple[bool, Any]:
        device = self.device
        self.due = max(self.due + device.period_s, time.monotonic() - device.period_s)
        time.sleep(max(0.0, self.due - time.monotonic()))
        if device.unplugged:
            return False, None
        self.stamp = time.monotonic() + device.latency_s
        picture = device.picture(self.size) if device.picture else noisy(device.rng, size=self.size)
        time.sleep(max(0.0, self.stamp + device.transfer_s - time.monotonic()))
        if not self.raw:
            return True, picture if isinstance(picture, np.ndarray) else simplejpeg.decode_jpeg(picture, "BGR")
        data = picture if isinstance(picture, bytes) else as_jpeg(picture)
        return True, np.frombuffer(data + bytes(device.padding), np.uint8)[None, :]

    def release(self) -> None:
        self.device.released += self.is_open
        self.is_open = False


@dataclass
class Phone:
    """A phone's camera app."""

    url: str
    picture: Callable[[], bytes]
    boundary: str = "--frame"
    with_length: bool = True
    status: int = 200
    content_type: str = ""
    hang_up_after: int = 10**9
    seen_authorization: str = ""
    period_s: float = 0.01
    requests: int = 0


@contextlib.contextmanager
def phone(picture: Callable[[], bytes], **knobs: Any) -> Iterator[Phone]:
    """Serve pictures at /video (multipart) and /shot.jpg (one each time) on this machine."""
    closing = threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            served.requests += 1
            served.seen_authorization = self.headers.get("Authorization", "")
            if served.status != 200:
                self.send_error(served.status)
                return
            with contextlib.suppress(OSError):
                self._stream() if self.path == "/video" else self._one()

        def _one(self) -> None:
            data = served.picture()
            self.send_response(200)
            self.send_header("Content-Type", served.content_type or "image/jpeg")
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def _stream(self) -> None:
            self.send_response(200)
            kind = f"multipart/x-mixed-replace; boundary={served.boundary.removeprefix('--')}"
            self.send_header("Content-Type", served.content_type or kind)
            self.end_headers()
            for _ in range(served.hang_up_after):
                if closing.wait(served.period_s):
                    return
                data = served.picture()
                length = f"Content-Length: {len(data)}\r\n" if served.with_length else ""
                head = f"{served.boundary}\r\nContent-Type: image/jpeg\r\n{length}\r\n"
                self.wfile.write(head.encode() + data + b"\r\n")

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    served = Phone(f"http://127.0.0.1:{server.server_address[1]}", picture, **knobs)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield served
    finally:
        closing.set()
        server.shutdown()
        thread.join()
        server.server_close()
