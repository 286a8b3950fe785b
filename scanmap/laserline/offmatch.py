"""The laser-off frame as the camera would have taken it with the laser on: at the same place and exposure."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

_SHIFT = 3  # [px] looked for at most, down and right
_SAMPLES, _LEAST_ROWS = 16_000, 10  # that are held against each other
_MOVED_PX = 0.15  # that a shift matters
_SURE = 5.0  # standard deviations, from which on a shift, or a factor, is there
_SHOWN = 0.3  # share of what pictures change by from pixel to pixel that is no noise, at least, of such as tell a shift
_BEYOND = 20  # [grey levels] a difference that counts no more for being larger: the line's, a thing that moved
_MANY = 0.01  # share of such from which on something may have moved
_BRIGHTEST = 245  # [grey levels] brighter ones may be cut
_GROUPS, _TELLING = 8, 40  # of samples by brightness, and how many a group must have
_SLIDE_STEPS = 3
_LEAST_STRIPS = 2000  # samples of strips that tell how far they must be moved
_LARGE = 1_000_000  # samples of a plane from which on fewer of them tell
_DARKEST = 8  # [grey levels]
_OUTLYING = 3.0  # [scatter] from where on samples may be the line's
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


def slide_between(on: F32, off: F32, farthest: int) -> tuple[float, float]:
    """How far right [px] strips `off` (N, n) of laser-off rows must be moved to lie on `on` (N, n), and its sigma.

    Whole shifts first, then steps of Gauss and Newton, as in `shift_between`. NaN is what says nothing.

    Args:
        farthest: that is looked for [px].
    """
    usable = (off > _DARKEST) & (np.maximum(on, off) < _BRIGHTEST)
    if np.count_nonzero(usable) < _LEAST_STRIPS:
        return 0.0, np.inf
    off = off * np.float32(np.median(on[usable] / off[usable]))
    width = on.shape[1]

    def moved(right: int) -> F32:
        return off[:, farthest - right : width - farthest - right]

    on = on[:, farthest : width - farthest]
    ways = range(2 - farthest, farthest - 1)
    apart = [float(np.nanmean(np.minimum(np.abs(on - moved(right)), _BEYOND))) for right in ways]
    at, sigma = float(ways[int(np.argmin(apart))]), np.inf
    for _ in range(_SLIDE_STEPS):
        first = int(np.floor(at))
        share = np.float32(at - first)
        there, left, right = (
            (1 - share) * moved(first + more) + share * moved(first + more + 1) for more in (0, 1, -1)
        )
        slope, rest = np.float32(0.5) * (right - left), on - there
        fits = np.isfinite(slope) & (np.abs(rest) < _BEYOND)
        # The exposure is told together with the step: what moves changes by how much brighter one of both seems.
        basis, rest = np.stack([-slope[fits], there[fits]]).astype(np.float64), rest[fits].astype(np.float64)
        certain = np.linalg.inv(basis @ basis.T + np.eye(2))
        step, brighter = certain @ (basis @ rest)
        variance = float(np.square(rest - np.array([step, brighter]) @ basis).sum()) / max(rest.size - 2, 1)
        # Slopes are noise in part, half of the moved picture's, and the step is by so much too short.
        noise = 1.0 - 2.0 * float(share) * (1.0 - float(share))
        shown = 1.0 - 0.5 * noise / (1.0 + noise) * rest.size * variance * float(certain[0, 0])
        if shown < _SHOWN:
            return 0.0, np.inf
        at += min(max(float(step) / shown, -0.5), 0.5)
        off *= np.float32(1.0 + brighter)
        sigma = float(np.sqrt(variance * certain[0, 0])) / shown
    return at, sigma


def exposure_between(plane: U8, background: U8, level: U8) -> tuple[float, F32 | None]:
    """What the laser-off plane (H, W) must be multiplied by to have the laser-on one's exposure.

    Args:
        level: (H, W) the laser-off plane without its noise: what noise makes darker in one picture is brighter in the
            other.

    Returns:
        The factor of most of the picture; and, as a camera that exposes by itself need not scale dark and bright alike,
        those of every level (256,), where some are surely different.
    """
    every = 8 if plane.size < _LARGE else 16
    on, off, by = (values[::every, ::every].ravel() for values in (plane, background, level))
    usable = (by > _DARKEST) & (np.maximum(on, off) < _BRIGHTEST)
    on, off, by = on[usable], off[usable], by[usable]
    if len(on) < _TELLING:
        return 1.0, None
    common, _ = _factor(on, off)
    groups = np.array_split(np.argsort(by, kind="stable"), min(_GROUPS, len(on) // _TELLING))
    factors = np.array([_factor(on[group], off[group]) for group in groups])
    apart, sigma = factors[:, 0] - common, factors[:, 1]
    if not (np.abs(apart) > np.maximum(_SURE * sigma, _DIFFERENT)).any():
        return common, None
    believed = common + apart * np.square(apart) / (np.square(apart) + np.square(sigma) + 1e-12)
    table = np.interp(np.arange(256.0), [float(np.median(by[group])) for group in groups], believed)
    return common, table.astype(np.float32)


def _factor(on: U8, off: U8) -> tuple[float, float]:
    """What samples `off` (N,) are multiplied by to be those `on`, and its standard deviation; without the line's."""
    ratio = on / np.maximum(off, np.float32(1.0))
    middle = np.median(ratio)
    scatter = 1.48 * np.median(np.abs(ratio - middle))
    # Medians of what small whole numbers are over each other take steps.
    fits = np.abs(ratio - middle) <= _OUTLYING * scatter
    total = [int(values[fits].sum()) for values in (on, off)]
    return total[0] / max(total[1], 1), float(1.25 * scatter / np.sqrt(len(on)))
