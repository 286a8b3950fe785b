"""Whether a picture can be believed: whole, of the right size, not black, not the one before again."""

from __future__ import annotations

import zlib
from typing import NamedTuple

import numpy as np

from scanmap.errors import CameraError
from scanmap.shot import JPEG_END, decode_image, image_format

# Every frame header of JPEG; the other numbers between them are tables.
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
START_OF_SCAN = 0xDA
BLACK_DN = 3  # [grey levels] a picture whose brightest pixel is no brighter shows nothing at all


class Size(NamedTuple):
    """Of a picture [px]."""

    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.width}x{self.height}"


def without_padding(data: bytes) -> bytes:
    """JPEG bytes without the zeros some drivers fill their buffers up with; the picture itself stays untouched."""
    stripped = data.rstrip(b"\0")
    return stripped if stripped.endswith(JPEG_END) else data


def size_of(data: bytes) -> Size:
    """Width and height from a JPEG's or PNG's header.

    Raises:
        CameraError: no picture, or cut before its header ends.
    """
    if image_format(data) == "png" and len(data) >= 24:
        return Size(int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big"))
    for marker, at in segments(data):
        if marker in _FRAME_HEADERS and at + 9 <= len(data):
            return Size(int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big"))
    raise CameraError(f"camera sent {len(data)} bytes that are no JPEG or PNG")


def fingerprint(data: bytes) -> int:
    """The same for two JPEGs that decode alike, whatever their time stamps and comments say."""
    for marker, at in segments(data):
        if marker == START_OF_SCAN:
            return zlib.crc32(data[at:])
    return zlib.crc32(data)


def check_header(data: bytes, expected: Size | None) -> Size:
    """Cheap checks: a picture, of the expected size, not cut short.

    Raises:
        CameraError: none of that.
    """
    size = size_of(data)
    if expected is not None and size != expected:
        raise CameraError(f"camera sent a picture of {size} instead of {expected}")
    if image_format(data) == "jpeg" and JPEG_END not in data[-16:]:
        raise CameraError(f"camera sent a picture that is cut short, {len(data)} bytes")
    return size


def is_black(data: bytes) -> bool:
    """Whether nothing at all can be seen on it.

    Raises:
        CameraError: it cannot be decoded, or only in part.
    """
    decoded = decode_image(data, grey=True)
    if decoded.rows_valid < len(decoded.image):
        raise CameraError(f"camera sent a damaged picture: {decoded.rows_valid} of {len(decoded.image)} rows are whole")
    return int(np.max(decoded.image)) <= BLACK_DN


def segments(data: bytes) -> list[tuple[int, int]]:
    """Marker and position of a JPEG's segments up to its first scan."""
    found: list[tuple[int, int]] = []
    at = 2
    while data[:2] == b"\xff\xd8" and at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        found.append((marker, at))
        if marker == START_OF_SCAN:
            break
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return found
