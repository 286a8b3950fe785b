"""The laser-off frame as the camera would have taken it with the laser on: at the same place and exposure."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.channel import SATURATED

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

_SHIFT = 3  # [px] looked for at most, down and right
_SAMPLES, _LEAST_ROWS = 16_000, 10  # that are held against each other
_MOVED_PX, _SURE = 0.15, 5.0  # a shift that matters: this far, and in its standard deviations
_SHOWN = 0.3  # share of what pictures change by from pixel to pixel that is no noise, at least, of such as tell a shift
_BEYOND = 20  # [grey levels] a difference that counts no more for being larger: the line's, a thing that moved
_MANY = 0.01  # share of such from which on something may have moved
_BRIGHTEST = 245  # [grey levels] brighter ones may be cut
_GROUPS, _TELLING = 8, 40  # of samples by brightness, and how many a group must have
_LARGE = 1_000_000  # samples of a plane from which on fewer of them tell
_AROUND_PX, _BY_NOISE = 5, 4.0  # [grey levels] that noise makes samples darker or brighter than their group by
_DARKEST = 8  # [grey levels]
_DIFFERENT = 0.02  # by how much the factor of a group must differ to be its own


def in_place(image: U8, background: U8) -> U8:
    """The laser-off frame (H, W[, 3]) moved onto the laser-on one where a camera that shakes or sags has moved it."""
    down, right = shift_between(*(picture if picture.ndim == 2 else picture[..., 1] for picture in (image, background)))
    if not down and not right:
        return background
    matrix = np.array([[1.0, 0.0, right], [0.0, 1.0, down]], np.float32)
    size = background.shape[1::-1]
    return np.asarray(cv2.warpAffine(background, matrix, size, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def shift_between(plane: U8, background: U8) -> tuple[float, float]:
    """How far down and right [px] the laser-off plane (H, W) must be moved to lie on the laser-on one; 0 if not at all.

    Some rows are held against each other; if they do not fit, at every whole shift; and from the best a step of Gauss
    and Newton gives the rest (Lucas and Kanade 1981).
    """
    height, width = plane.shape
    reach = _SHIFT + 1
    rows = np.arange(reach, height - reach, max(1, height // max(_SAMPLES // width, _LEAST_ROWS)))
    if rows.size < 2 or width < 8 * reach:
        return 0.0, 0.0
    on, off = plane[rows], background[rows]
    usable = (off > _DARKEST) & (np.maximum(on, off) < _BRIGHTEST)
    if np.count_nonzero(usable) < 200:
        return 0.0, 0.0
    gain = float(np.median(on[usable].astype(np.float32) / off[usable]))
    on = on[:, reach : width - reach]

    def moved_by(down: int, right: int) -> U8:
        return np.asarray(background[rows - down, reach - right : width - reach - right], np.uint8)

    around = ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0))
    here = [moved_by(*by) for by in around]
    step, sigma = _step(on, gain, here)
    apart = cv2.absdiff(on, cv2.convertScaleAbs(here[0], alpha=gain))
    # A step says little where the shift is larger than what it moves.
    if not (np.abs(step) > np.maximum(_MOVED_PX, _SURE * sigma)).any() and np.mean(apart > _BEYOND) < _MANY:
        return 0.0, 0.0
    best = (np.inf, 0, 0)
    for down in range(-_SHIFT, _SHIFT + 1):
        for right in range(-_SHIFT, _SHIFT + 1):
            there = cv2.convertScaleAbs(moved_by(down, right), alpha=gain)
            apart = cv2.threshold(cv2.absdiff(on, there), _BEYOND, _BEYOND, cv2.THRESH_TRUNC)[1]
            best = min(best, (cv2.mean(apart)[0], down, right))
    _, down, right = best
    step, sigma = _step(on, gain, [moved_by(down + y, right + x) for y, x in around])
    total = np.array([down, right]) + np.clip(step, -1.0, 1.0)
    if not (np.abs(total) > np.maximum(_MOVED_PX, _SURE * sigma)).any():
        return 0.0, 0.0
    total[sigma > _MOVED_PX] = 0.0  # as along stripes
    return float(total[0]), float(total[1])


def _step(on: U8, gain: float, off: list[U8]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What is left of the shift, down and right [px], and its standard deviations.

    Args:
        on: (n, W) rows with the laser.
        gain: that the laser-off ones are multiplied by.
        off: those rows as they are, and moved left, right, up and down by a pixel.
    """
    middle, left, right, up, down = (np.float32(gain) * plane for plane in off)
    apart = on - middle
    fits = (np.abs(apart) < _BEYOND) & (np.maximum(on, middle) < _BRIGHTEST)
    # Moved right by a pixel, a picture changes by as much as it has risen from the pixel on the left.
    slopes = np.stack([0.5 * (down - up)[fits], 0.5 * (right - left)[fits]]).astype(np.float64)
    normal = slopes @ slopes.T + np.eye(2)
    rest = apart[fits].astype(np.float64)
    step = np.linalg.solve(normal, slopes @ rest)
    noise = rest - step @ slopes
    variance = float((noise @ noise) / max(noise.size - 2, 1))
    # Of the slopes noise makes a part, half of one picture's variance, which tells of no shift: on a bare wall all.
    shown = 1.0 - 0.25 * noise.size * variance / np.diag(normal)
    certain = np.where(shown > _SHOWN, shown / np.diag(np.linalg.inv(normal)), 1e-9)
    return step, np.sqrt(variance / certain)


def at_exposure(plane: U8, background: U8) -> tuple[U8, float]:
    """The laser-off plane (H, W), and what it must be multiplied by to have the laser-on one's exposure.

    A camera that exposes by itself need not scale dark and bright alike: the factor is measured for some groups of
    brightness. Where one's own is surely different, the plane is scaled by them; what it saturates in stays saturated.
    """
    apart = 8 if plane.size < _LARGE else 16
    around = cv2.blur(background, (_AROUND_PX, _AROUND_PX))
    on, off, level = (values[::apart, ::apart].ravel() for values in (plane, background, around))
    usable = (off > _DARKEST) & (np.maximum(on, off) < _BRIGHTEST)
    on, off, level = on[usable].astype(np.float32), off[usable].astype(np.float32), level[usable]
    if len(on) < _TELLING:
        return background, 1.0
    common = float(np.median(on / off))
    middle, factor = _factors(on, off, off, common)
    if (factor == common).all():
        return background, common
    # What noise makes darker than its group seems brighter in the other picture, and it is best to expect just that;
    # but not of what is darker by itself, as the brightness around it tells, or brighter.
    true = _factors(on, off, level, common)[1]
    middle = np.array([middle[0] - _BY_NOISE, *middle, middle[-1] + _BY_NOISE])
    values = np.arange(256.0)
    table = np.interp(values, middle, [true[0], *factor, true[-1]])
    table = np.clip(np.rint(values * table), 0, SATURATED - 1)
    table[SATURATED:] = 255
    return np.asarray(cv2.LUT(background, table.astype(np.uint8)), np.uint8), 1.0


def _factors(on: F32, off: F32, by: NDArray[Any], common: float) -> tuple[F64, F64]:
    """Brightness of groups of samples (N,), in the order of `by` (N,), and the factors from `off` to `on`.

    The common factor stands for those that are not surely different.
    """
    groups = np.array_split(np.argsort(by, kind="stable"), min(_GROUPS, len(on) // _TELLING))
    ratios = [on[g] / off[g] for g in groups]
    factor = np.array([np.median(ratio) for ratio in ratios])
    scatter = np.array([1.48 * np.median(np.abs(ratio - f)) for ratio, f in zip(ratios, factor, strict=True)])
    # The median's own standard deviation, four times.
    uncertain = 5.0 * scatter / np.sqrt([len(g) for g in groups])
    own = np.abs(factor - common) > np.maximum(uncertain, _DIFFERENT)
    return np.array([np.median(off[g]) for g in groups]), np.where(own, factor, common)
