"""Pictures over HTTP: an MJPEG stream (multipart) or a URL that gives one picture each time. Phones do either.

The JPEG bytes are kept as they came. Nothing is decoded here.
"""

from __future__ import annotations

import base64
import http.client
import re
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from typing import Any

from scanmap.errors import CameraError
from scanmap.rig.camera import CameraParams
from scanmap.rig.camera_checks import START_OF_SCAN, segments, without_padding
from scanmap.rig.camera_stream import Picture
from scanmap.shot import JPEG_END, JPEG_MAGIC

MAX_PICTURE_BYTES = 64_000_000
MAX_TABLES_BYTES = 1 << 20
MAX_HEADER_LINES = 64
CHUNK_BYTES = 16384
SNAPSHOTS_HZ = 10.0  # how often a single-picture URL is asked where no rate is set


class HttpPictures:
    """A `PictureSource` on a URL."""

    def __init__(self, url: str, params: CameraParams, clock: Callable[[], float] = time.monotonic) -> None:
        self._url, self._headers = _without_password(url)
        self._params = params
        self._clock = clock
        # A camera stands on the local network, where no proxy leads.
        self._opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        self._response: Any = None  # of a multipart stream, open; None for single pictures
        self._first: Picture | None = None
        self._buffer = bytearray()
        self._asked = -1e9

    @property
    def name(self) -> str:
        """The URL, without its password."""
        return self._url

    def open(self) -> None:
        """Connect and see whether it is a stream or single pictures.

        Raises:
            CameraError: no answer, refused, or no pictures.
        """
        self.close()
        response = self._request()
        kind = response.headers.get_content_type()
        if kind.startswith("multipart/"):
            self._response = response
            return
        with response:
            if not kind.startswith("image/"):
                raise CameraError(
                    f"camera {self._url} sends {kind}, no pictures: give the URL of the stream itself; the phone's app "
                    "shows it, it often ends in /video, /videofeed or /shot.jpg"
                )
            self._first = self._body(response)

    def read(self) -> Picture:
        """The next picture.

        Raises:
            CameraError: the connection is lost, or what comes is no picture.
        """
        try:
            if self._response is not None:
                return self._part()
            if self._first is not None:
                first, self._first = self._first, None
                return first
            pause = self._asked + 1.0 / (self._params.rate_hz or SNAPSHOTS_HZ) - self._clock()
            time.sleep(max(0.0, pause))
            with self._request() as response:
                return self._body(response)
        except (OSError, http.client.HTTPException, ValueError, AttributeError) as error:
            # AttributeError: http.client's own, when it is closed in the middle of a read.
            raise self._lost(error) from error

    def close(self) -> None:
        """Hang up; may be called twice."""
        if self._response is not None:
            self._response.close()
            self._response = None
        self._first = None
        self._buffer.clear()

    def _request(self) -> Any:
        self._asked = self._clock()
        request = urllib.request.Request(self._url, headers=self._headers)
        try:
            return self._opener.open(request, timeout=self._params.timeout_s)
        except urllib.error.HTTPError as error:
            with error:
                hint = "give user and password as http://user:password@host" if error.code == 401 else "check its path"
                raise CameraError(f"camera {self._url} answered {error.code} {error.reason}: {hint}") from error
        except (OSError, http.client.HTTPException, ValueError) as error:
            reason = getattr(error, "reason", error)
            raise CameraError(
                f"camera {self._url} does not answer ({reason}): is its app running, and is it on this network?"
            ) from error

    def _body(self, response: Any) -> Picture:
        """One picture that is the whole answer."""
        data = response.read(MAX_PICTURE_BYTES)
        return Picture(without_padding(bytes(data)), self._clock())

    def _part(self) -> Picture:
        """The next part of a multipart stream: by its length, or where none is given by the JPEG's own ends."""
        length = None
        for _ in range(MAX_HEADER_LINES):
            line = self._line()
            if line == b"" and length is not None:
                return Picture(without_padding(self._take(length)), self._clock())
            if match := re.match(rb"content-length:\s*(\d+)", line, re.IGNORECASE):
                length = int(match[1])
            if line == b"" and self._peek(3) == JPEG_MAGIC:
                return Picture(self._until_end(), self._clock())
        raise ValueError("no picture in the stream")

    def _line(self) -> bytes:
        while (end := self._buffer.find(b"\n")) < 0:
            if len(self._buffer) > CHUNK_BYTES:
                raise ValueError("the stream's header does not end")
            self._receive()
        line = bytes(self._buffer[:end]).rstrip(b"\r")
        del self._buffer[: end + 1]
        return line

    def _peek(self, count: int) -> bytes:
        while len(self._buffer) < count:
            self._receive()
        return bytes(self._buffer[:count])

    def _take(self, count: int) -> bytes:
        if count > MAX_PICTURE_BYTES:
            raise ValueError(f"a picture of {count} bytes")
        data = self._peek(count)
        del self._buffer[:count]
        return data

    def _until_end(self) -> bytes:
        # Only behind its tables: a thumbnail among them has an end of its own.
        while not (found := segments(bytes(self._buffer[:MAX_TABLES_BYTES]))) or found[-1][0] != START_OF_SCAN:
            if len(self._buffer) > MAX_TABLES_BYTES:
                raise ValueError("a picture without a beginning")
            self._receive()
        searched = found[-1][1]
        while (end := self._buffer.find(JPEG_END, searched)) < 0:
            searched = len(self._buffer) - 1
            if searched > MAX_PICTURE_BYTES:
                raise ValueError("a picture that does not end")
            self._receive()
        return self._take(end + len(JPEG_END))

    def _receive(self) -> None:
        chunk = self._response.read1(CHUNK_BYTES)
        if not chunk:
            raise OSError("the stream ended")
        self._buffer += chunk

    def _lost(self, error: Exception) -> CameraError:
        return CameraError(f"camera {self._url} was lost ({error}): is its app still running, and its network up?")


def _without_password(url: str) -> tuple[str, dict[str, str]]:
    """The URL to show and to ask, and the header that carries its user and password."""
    parts = urllib.parse.urlsplit(url)
    if parts.username is None:
        return url, {}
    user, password = urllib.parse.unquote(parts.username), urllib.parse.unquote(parts.password or "")
    secret = base64.b64encode(f"{user}:{password}".encode()).decode()
    host = parts.netloc.rpartition("@")[2]
    return urllib.parse.urlunsplit(parts._replace(netloc=host)), {"Authorization": f"Basic {secret}"}
