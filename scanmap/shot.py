"""`Shot`: the seam between the world and the mathematics.

A live rig, the digital twin and every kind of recording yield the same `Shot`s; everything below knows
nothing of devices or clocks. Images stay encoded, as the camera sent them, until a decode worker opens them.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.errors import CameraError

Image = NDArray[np.uint8]

JPEG_MAGIC = b"\xff\xd8\xff"
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_END = b"\xff\xd9"
_PNG_COLOUR = 25  # byte that tells a PNG's planes: 0 grey, 4 grey and alpha

# Many webcams leave a few stray bytes before a restart marker; the decoder finds its way back there.
HARMLESS_BYTES = 8


@dataclass(frozen=True, slots=True)
class Shot:
    """One picture of the laser line at one bearing."""

    index: int  # running number within the scan
    bearing: float  # [rad] counter-clockwise about z, as the stage reported it
    bearing_commanded: float  # [rad] as the plan asked for
    time: float  # [s] since the scan began; for recordings of others, since their epoch
    image: bytes  # encoded (JPEG or PNG), laser on
    background: bytes | None = None  # encoded, laser off, same bearing


class Withdrawal(Enum):
    """Why a sweep takes back shots that it had handed out."""

    PLACE = "place"  # the head may not have stood where they say
    LINE = "line"  # the laser was out


class Decoded(NamedTuple):
    """A decoded image, and how much of it can be believed."""

    image: Image  # (H, W) grey or (H, W, 3) BGR
    rows_valid: int  # rows from the top that were decoded from data; H if the file is whole


def image_format(data: bytes) -> str:
    """`"jpeg"` or `"png"` by the first bytes, else `"unknown"`."""
    if data.startswith(JPEG_MAGIC):
        return "jpeg"
    return "png" if data.startswith(PNG_MAGIC) else "unknown"


def is_grey(data: bytes) -> bool:
    """Whether an encoded image holds one plane, as monochrome cameras store it; False where its head cannot be read."""
    kind = image_format(data)
    if kind == "jpeg":
        import simplejpeg

        try:
            return bool(simplejpeg.decode_jpeg_header(data)[2] == "Gray")
        except ValueError:
            return False
    return kind == "png" and data[_PNG_COLOUR : _PNG_COLOUR + 1] in (b"\0", b"\4")


def decode_image(data: bytes, *, grey: bool = False, into: Image | None = None) -> Decoded:
    """Decode JPEG or PNG bytes.

    Args:
        data: encoded image.
        grey: decode to one plane (the JPEG's luminance) instead of BGR.
        into: where a whole JPEG of that shape is written to, contiguous; the image is this array then.

    Raises:
        CameraError: nothing could be decoded.

    A JPEG that was cut short is decoded down to the cut; `rows_valid` says how far. One that is damaged
    inside is refused: nobody knows from which row on it is wrong.
    """
    kind = image_format(data)
    if kind == "jpeg":
        return _decode_jpeg(data, grey, into)
    refusal = f"image cannot be decoded: {len(data)} bytes, neither a whole JPEG nor PNG"
    if not data or (kind == "png" and not _is_whole_png(data)):
        raise CameraError(refusal)
    # As the sensor reads it: a phone's mark that the picture stands on its side is heeded in no format.
    mode = (cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR) | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    except cv2.error as error:  # larger than OpenCV takes
        raise CameraError(refusal) from error
    if pixels is None:
        raise CameraError(refusal)
    return Decoded(np.asarray(pixels, np.uint8), pixels.shape[0])


def encode_png(image: Image) -> bytes:
    """Lossless bytes of an (H, W) or (H, W, 3) BGR image, for sources that have no encoded form."""
    ok, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not ok:
        raise CameraError(f"image of shape {image.shape} cannot be encoded as PNG")
    return bytes(data)


def _decode_jpeg(data: bytes, grey: bool, into: Image | None) -> Decoded:
    import simplejpeg

    colourspace = "GRAY" if grey else "BGR"
    try:
        if into is not None and simplejpeg.decode_jpeg_header(data)[:2] == into.shape[:2]:
            simplejpeg.decode_jpeg(data, colorspace=colourspace, buffer=into)
            return Decoded(into, len(into))
        pixels = simplejpeg.decode_jpeg(data, colorspace=colourspace)
        rows = pixels.shape[0]
    except ValueError as warning:
        try:
            pixels = simplejpeg.decode_jpeg(data, colorspace=colourspace, strict=False)
        except ValueError as error:
            raise CameraError(f"JPEG of {len(data)} bytes cannot be decoded: {error}") from error
        rows = _rows_of_damaged_jpeg(data, pixels, str(warning))
    return Decoded(np.asarray(pixels[:, :, 0] if grey else pixels), rows)


def _rows_of_damaged_jpeg(data: bytes, pixels: Image, warning: str) -> int:
    """How many rows to believe of a JPEG the decoder warned of; CameraError if none."""
    if JPEG_END not in data[-16:]:
        return _rows_before_fill(pixels)
    stray = re.search(r"(\d+) extraneous bytes", warning)
    if stray is None or int(stray[1]) > HARMLESS_BYTES:
        raise CameraError(f"JPEG of {len(data)} bytes is damaged inside: {warning}")
    return len(pixels)


def _is_whole_png(data: bytes) -> bool:
    """Whether every chunk is there and has its CRC; libpng would complain on stderr past every handler."""
    at = len(PNG_MAGIC)
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big") or end + 4 > len(data):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = end + 4
    return False


def _rows_before_fill(pixels: Image) -> int:
    """Rows above the uniform area a decoder fills in where a JPEG was cut, less one block for the cut row.

    Where colour has half the rows (4:2:0) it is interpolated: a row on either side of the block has some of it, too.
    """
    flat = pixels.reshape(pixels.shape[0], -1)
    differs = (flat != flat[-1]).any(axis=1)
    last = int(np.flatnonzero(differs)[-1]) + 1 if differs.any() else 0
    return max(0, last - 18) if last < len(flat) else len(flat)
