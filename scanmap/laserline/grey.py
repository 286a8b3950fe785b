"""From a colour image to the one plane in which the line is looked for."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.errors import ConfigError
from scanmap.laserline.channel import laser_channel

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
Index = NDArray[np.intp]

Grey = Literal[
    "auto",
    "bit_index",
    "mean",
    "luminance_601",
    "luminance_709",
    "red",
    "green",
    "blue",
    "red_gain",
    "ycbcr_y",
    "ycbcr_cr",
    "ycbcr_cb",
]

# The channel a laser of one colour shows in least, among those next to it: blue, green and red lasers.
NEIGHBOUR = (1, 2, 1)
CHANNEL = {"blue": 0, "green": 1, "red": 2}
# Weights of blue, green, red.
_WEIGHTS = {
    "mean": (1 / 3, 1 / 3, 1 / 3),
    "luminance_601": (0.114, 0.587, 0.299),
    "luminance_709": (0.072169, 0.715160, 0.212671),
}
_YCRCB = {"ycbcr_y": 0, "ycbcr_cr": 1, "ycbcr_cb": 2}


def to_grey(image: U8, grey: Grey, bit_index: int = 16, channel: int | None = None) -> U8:
    """One plane (H, W) of a BGR image (H, W, 3); a grey image is returned as it is.

    Args:
        grey: conversion; `auto` takes the channel in which the laser stands out most in this image.
        bit_index: for `bit_index`: bits n to n + 7 of the pixel's word 0x00RRGGBB, n = 0 blue, 8 green, 16 red;
            between them they mix two channels, above 16 zeros come in from the top (the thesis's conversion).
        channel: for `auto`: the channel, where it is known already.

    `red_gain` divides red by the pixel's mean, so that bright white things do not outshine the line; the
    YCbCr planes are those of ITU-R BT.601, full range.
    """
    if image.ndim == 2:
        return image
    if grey == "auto":
        return extract(image, laser_channel(image) if channel is None else channel)
    if grey in CHANNEL:
        return extract(image, CHANNEL[grey])
    if grey in _WEIGHTS:
        return np.asarray(cv2.transform(image, np.array([_WEIGHTS[grey]], np.float32)), np.uint8)
    if grey in _YCRCB:
        return extract(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2YCrCb), np.uint8), _YCRCB[grey])
    if grey == "bit_index":
        return _bits(image, bit_index)
    if grey == "red_gain":
        red, total = image[..., 2].astype(np.float32), image.sum(axis=2, dtype=np.float32)
        return np.asarray(np.clip(red * red * 3.0 / np.maximum(total, 1.0), 0, 255), np.uint8)
    raise ConfigError(f"grey conversion {grey!r}; valid: auto, bit_index, red, green, blue, mean, ...")


def binary_image(plane: U8) -> U8:
    """The thesis's line image T6: the first brightest pixel of each row 255, everything else 0, (H, W)."""
    binary = np.zeros_like(plane)
    binary[np.arange(len(plane)), plane.argmax(axis=1)] = 255
    return binary


def overlay(plane: U8, column_px: NDArray[np.floating], colour: Literal["red", "green", "blue"] = "red") -> U8:
    """The thesis's overlay T7: line pixels painted over the grey image, BGR (H, W, 3).

    Args:
        column_px: (H,) columns of the line, NaN where a row has none.
    """
    painted = np.asarray(cv2.cvtColor(plane, cv2.COLOR_GRAY2BGR), np.uint8)
    rows = np.flatnonzero(np.isfinite(column_px))
    columns = np.clip(np.rint(column_px[rows]), 0, plane.shape[1] - 1).astype(np.intp)
    painted[rows, columns] = np.eye(3, dtype=np.uint8)[CHANNEL[colour]] * 255
    return painted


def extract(image: U8, channel: int) -> U8:
    """One channel (H, W) of a BGR image."""
    return np.asarray(cv2.extractChannel(image, channel), np.uint8)


def runs_at(image: U8, row: Index, first: Index, length: int) -> U8:
    """Runs (..., length) of bytes side by side in rows (...), each from its `first` byte on, copied.

    Args:
        image: (H, W), (H, W, 3), or one channel of the latter, whose columns are three bytes apart.

    Whole runs are copied at ten times the speed of picking a picture's samples one by one.
    """
    runs = np.asarray(_Runs(image, length))[row, first]
    return runs.view(np.uint8).reshape(*runs.shape, length)


class _Runs:
    """Every run of bytes in each row of a picture (H, n), each one item, in NumPy's array interface."""

    def __init__(self, image: U8, length: int) -> None:
        size = image.strides[1] * (image.shape[1] - 1) + (image.shape[2] if image.ndim == 3 else 1)
        self.image = image  # must live as long as what is made of this
        self.__array_interface__ = {
            "version": 3,
            "data": (image.__array_interface__["data"][0], True),
            "typestr": f"|V{length}",
            "shape": (len(image), size - length + 1),
            "strides": (image.strides[0], 1),
        }


def _bits(image: U8, n: int) -> U8:
    if n % 8 == 0 and n <= 16:
        return extract(image, n // 8)
    word = image[..., 0].astype(np.uint32)
    word |= image[..., 1].astype(np.uint32) << 8
    word |= image[..., 2].astype(np.uint32) << 16
    return ((word >> n) & 0xFF).astype(np.uint8)
