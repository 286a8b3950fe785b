"""What the line is looked for in: the plane as the camera saw it, what of it the laser lit, and the noise."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.candidates import BLOCK, is_large, noise_of
from scanmap.laserline.channel import judged_channel
from scanmap.laserline.colour import without_colour
from scanmap.laserline.grey import CHANNEL, NEIGHBOUR, Grey, extract, to_grey, without_background
from scanmap.laserline.offmatch import at_exposure, in_place

U8 = NDArray[np.uint8]


# Noise of the difference of two channels over that of one, from which on they are independent; below, in grey levels,
# no difference is measured.
_INDEPENDENT, _NONE = 1.2, 0.3


class Conversion(NamedTuple):
    """How a colour picture becomes one plane; see `to_grey` and `without_background`."""

    grey: Grey
    bit_index: int
    off_threshold: float


class Sight(NamedTuple):
    """One picture, seen in the laser's light."""

    on: U8  # (H, W) the picture's plane; a view where one of its channels will do
    off: U8 | None  # (H, W) the laser-off frame's
    plane: U8  # (H, W) the brighter of both
    lit: U8  # (H, W) what the laser added, lifted by PEDESTAL, with a laser-off frame; else the plane
    rows: U8  # (ceil(B / 2), W) of lit: one row of every other block, contiguous
    image: U8 | None  # (H, W, 3) where colour tells the laser from other things
    channel: int  # of the image; -1 without one
    noise: float  # of a sample of lit [grey levels]
    colour: float = 1.0  # how finely it is stored: 0 where the channels' noise is one, 1 where they are independent
    gain: float = 1.0  # that the laser-off frame's exposure is matched by


def sight_of(image: U8, background: U8 | None, how: Conversion) -> Sight:
    """Look at a grey (H, W) or BGR picture (H, W, 3), with the laser-off frame of the same view or None."""
    channel = None
    if background is not None:
        background = in_place(image, background)
    if image.ndim == 3:
        channel, clear = channel_of(image, background, how.grey)
        if channel is not None and not clear and without_colour(image):
            # A monochrome camera's picture in three equal channels.
            channel, image, background = None, image[..., 1], background if background is None else background[..., 1]
    if channel is not None and background is None:
        rows = np.asarray(cv2.extractChannel(quick_rows(image), channel), np.uint8)
        # Most of a large picture is never looked at.
        plane = image[..., channel] if is_large(image) else extract(image, channel)
        return Sight(plane, None, plane, plane, rows, image, channel, _noise(plane, rows), _fineness(image, channel))
    on = plane = lit = to_grey(image, how.grey, how.bit_index, channel)
    off, gain = None, 1.0
    if background is not None:
        off, gain = at_exposure(on, to_grey(background, how.grey, how.bit_index, channel))
        lit, plane = without_background(on, off, how.off_threshold, gain), np.asarray(cv2.max(on, off), np.uint8)
    rows = np.ascontiguousarray(quick_rows(lit))
    return Sight(on, off, plane, lit, rows, None, -1, _noise(lit, rows), gain=gain)


def channel_of(image: U8, background: U8 | None, grey: Grey) -> tuple[int | None, bool]:
    """The channel of a BGR picture that the line is looked for in, and whether the laser is surely seen there.

    None for a conversion that mixes the channels.
    """
    if grey == "auto":
        return judged_channel(image, background)
    return CHANNEL.get(grey), False


def quick_rows(image: U8) -> U8:
    """The second row of every other block of rows (ceil(B / 2), ...)."""
    rows = image[1 :: 2 * BLOCK]
    return rows if len(rows) == -(-len(image) // (2 * BLOCK)) else np.concatenate([rows, image[-1:]])


def _noise(plane: U8, rows: U8) -> float:
    # What is in the cache already, where it is enough.
    return noise_of(rows if is_large(plane) else plane)


def _fineness(image: U8, channel: int) -> float:
    """How much of the noise of colour is there: less than 1 after JPEG, or after a camera's own matrix.

    Independent noises differ by more than each, by the root of two; what JPEG stores of colour, at fewer columns and
    coarser steps, differs by less the coarser it is.
    """
    rows = np.ascontiguousarray(image[:: max(1, len(image) // 8), ::2])
    own, other = (np.asarray(cv2.extractChannel(rows, c), np.uint8) for c in (channel, NEIGHBOUR[channel]))
    difference = noise_of(np.asarray(cv2.addWeighted(own, 1.0, other, -1.0, 128.0), np.uint8))
    return min(difference / (_INDEPENDENT * noise_of(other)), 1.0) if difference > _NONE else 0.0
