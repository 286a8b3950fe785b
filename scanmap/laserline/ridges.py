"""What of a picture looks like a line, whatever its colour, for comparison with other pictures of the same room."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.candidates import BLOCK
from scanmap.laserline.grey import extract, to_grey
from scanmap.laserline.params import LaserLineParams
from scanmap.laserline.sight import ONE_FOR_ALL, Laser, channel_of

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

# Widths of a place, and how far beside it its sides are [px].
_WIDTHS = ((3, 4), (6, 8), (12, 16))
_SHARE = 0.8  # of its height that a line has in the best of these, unless it is narrower than all
_CUT = 140.0  # [grey levels] what a bright line has more than this is often cut at white in another picture


def ridges(image: U8, params: LaserLineParams, laser: Laser | None = None) -> U8:
    """How far each place of a picture (H, W) or (H, W, 3) rises over both its sides (ceil(H / BLOCK), W) [grey levels].

    In the plane that the line is looked for in, in means over BLOCK rows, and at the best of three widths.

    Args:
        laser: what another picture of the scan has told of it.
    """
    channel = channel_of(image, None, params.grey) if laser is None or image.ndim == 2 else laser.channel
    own = channel == ONE_FOR_ALL
    plane = extract(image, 1) if own else to_grey(image, params.grey, params.bit_index, channel)
    height, width = plane.shape
    rows = cv2.resize(plane, (width, -(-height // BLOCK)), interpolation=cv2.INTER_AREA)
    risen = np.zeros_like(rows)
    for across, away in _WIDTHS:
        mean = cv2.blur(rows, (across, 1), borderType=cv2.BORDER_REPLICATE)
        padded = cv2.copyMakeBorder(mean, 0, 0, away, away, cv2.BORDER_REPLICATE)
        side = cv2.max(padded[:, : -2 * away], padded[:, 2 * away :])
        cv2.max(risen, cv2.subtract(mean, side), risen)
    return np.asarray(risen, np.uint8)


def ridge_of(peak: F64, width: F64) -> F64:
    """About what `ridges` has of lines (N,) of a height [grey levels] and standard deviation [px]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        light = np.sqrt(2.0 * np.pi) * width
        share = [np.minimum(light / across, _SHARE) - np.exp(-0.5 * (away / width) ** 2) for across, away in _WIDTHS]
        height: F64 = np.maximum.reduce(share) * np.minimum(peak, _CUT)
    return height
