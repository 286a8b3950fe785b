"""Pictures for the viewer: made smaller and encoded anew."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from scanmap.shot import Image, decode_image, encode_png, image_format


class Picture(NamedTuple):
    """An encoded picture."""

    data: bytes
    media_type: str


def shrink_factor(width: int, limit: int) -> int:
    """By which whole number to divide an image of `width` so that it is no wider than `limit` (0 = any) [px]."""
    return max(1, -(-width // limit)) if limit else 1


def shrunk(image: Image, factor: int) -> Image:
    """An (H, W) or (H, W, 3) image made smaller by a whole number, each pixel the mean of its block."""
    if factor == 1:
        return image
    height, width = (n // factor * factor for n in image.shape[:2])
    size = (width // factor, height // factor)
    return np.asarray(cv2.resize(image[:height, :width], size, interpolation=cv2.INTER_AREA), np.uint8)


def shrunk_lines(image: Image, factor: int) -> Image:
    """A line image (H, W) or (H, W, 3) made smaller, each pixel the brightest of its block: no line vanishes."""
    height, width = (n // factor for n in image.shape[:2])
    # With this anchor a pixel becomes the largest of the block that it is the upper left corner of.
    largest = cv2.dilate(image, np.ones((factor, factor), np.uint8), anchor=(0, 0), borderType=cv2.BORDER_REPLICATE)
    return np.ascontiguousarray(largest[: height * factor : factor, : width * factor : factor], np.uint8)


def sent(data: bytes, factor: int, quality: int) -> Picture:
    """A camera's picture: its own bytes, or made smaller by `factor`.

    Raises:
        CameraError: it has to be made smaller and cannot be decoded.
    """
    if factor == 1:
        return Picture(data, f"image/{image_format(data)}")
    return jpeg(shrunk(decode_image(data).image, factor), quality)


def jpeg(image: Image, quality: int) -> Picture:
    """JPEG of an (H, W) grey or (H, W, 3) BGR image; colours at full resolution, as a line one pixel wide needs."""
    import simplejpeg

    if image.ndim == 2:
        data = simplejpeg.encode_jpeg(np.ascontiguousarray(image[:, :, None]), quality, colorspace="GRAY")
    else:
        data = simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality, colorspace="BGR", colorsubsampling="444")
    return Picture(data, "image/jpeg")


def png(image: Image) -> Picture:
    """PNG of an (H, W) image of few grey values."""
    return Picture(encode_png(image), "image/png")
