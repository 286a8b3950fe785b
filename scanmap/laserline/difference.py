"""What the laser added: laser on minus laser off, with as little of the laser-off frame's noise as can be."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.channel import SATURATED, exposure_gain
from scanmap.laserline.offmatch import exposure_between

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]

# What a difference image is lifted by, so that noise around zero stays whole: cut at zero it is not Gaussian.
PEDESTAL = 16
# Rows along which what lies upright is the same, and columns that tell with them by how much it is not; columns and
# rows over which an even surface is the same.
_UPRIGHT, _BESIDE, _WIDE = 9, 5, 7
_REACH = 2 * (_UPRIGHT // 2) + 2 * (_WIDE // 2)  # rows on either side that a sample's filters see
_ROWS_AT_ONCE = 200
# What stands out of its surroundings by so many times the noise there, in variance, begins to be kept.
_UPRIGHT_NOISE, _WIDE_NOISE = 1.0, 3.0
# Strips of rows that the noise is measured in, samples of them that are enough, and what is measured where it is not.
_STRIPS, _STRIP_ROWS, _ENOUGH = 8, 24, 50
_DARKEST, _USUAL, _LEAST = 4, (0.5, 0.06), (0.04, 0.01)


class _Noise(NamedTuple):
    """Variances of noise of a laser-off frame [grey levels^2]."""

    upright: float  # of what lies beside the means along the line
    wide: float  # of those means beside means all around


class Difference(NamedTuple):
    """Two pictures of a view, arrays (H, W)."""

    lit: U8  # what the laser added: laser on minus laser off, lifted by `PEDESTAL`
    off: U8  # the laser-off frame, which times `gain` has the laser-on one's exposure
    even: U8  # that, times `gain`, without its noise
    gain: float


def without_background(plane: U8, background: U8, threshold: float = 0.0, matched: bool = False) -> Difference:
    """What the laser added to a plane (H, W), of which `background` is the laser-off frame.

    The noise of the laser-off frame is taken out where the room is even along the line, or all around; what stands out
    of its noise stays (the filter of Lee 1980: a sample is drawn to its surroundings' mean by the share of noise in
    their variance). How much noise there is is told by what the two pictures differ by, in which the room's own texture
    is gone and compression's is not. Then it is brought to the laser-on frame's exposure. What the laser-off frame
    saturates in tells nothing and counts as no light.

    Args:
        threshold: differences below it count as none [grey levels].
        matched: whether both have the same exposure.
    """
    noise = _noise_of(plane, background, 1.0 if matched else exposure_gain(plane[::8, ::8], background[::8, ::8]))
    even = np.empty(plane.shape, np.float32)
    # Some rows at a time, which stay in the processor's cache from step to step; filters see more on each side.
    for top in range(0, len(plane), _ROWS_AT_ONCE):
        first, end = max(top - _REACH, 0), min(top + _ROWS_AT_ONCE, len(plane))
        even[top:end] = _even(background[first : end + _REACH], noise)[top - first : end - first]
    level = np.asarray(cv2.convertScaleAbs(even), np.uint8)
    gain, by_level = (1.0, None) if matched else exposure_between(plane, background, level)
    blind, off = background >= SATURATED, background
    if by_level is not None:
        gain, factor = 1.0, cv2.LUT(level, by_level)
        even *= factor
        off = np.minimum(np.rint(factor * background), np.float32(SATURATED - 1)).astype(np.uint8)
        off[blind] = 255
    lit = np.asarray(cv2.addWeighted(plane, 1.0, even, -gain, float(PEDESTAL), dtype=cv2.CV_8U), np.uint8)
    if blind.any():
        lit[blind] = PEDESTAL
    if threshold > 0:
        lit[lit < PEDESTAL + threshold] = PEDESTAL
    return Difference(lit, off, np.asarray(cv2.convertScaleAbs(even, alpha=gain), np.uint8), gain)


def _noise_of(plane: U8, background: U8, gain: float) -> _Noise:
    """The noise of a laser-off frame, from what it differs by from a laser-on one; medians: the line hardly counts."""
    upright, wide = [], []
    for top in range(0, len(plane), max(_STRIP_ROWS, len(plane) // _STRIPS)):
        on, off = (picture[top : top + _STRIP_ROWS] for picture in (plane, background))
        apart = np.asarray(cv2.addWeighted(on, 1.0, off, -gain, 0.0, dtype=cv2.CV_32F), np.float32)
        along, around = _mean(apart, 1, _UPRIGHT), _mean(apart, _WIDE, _WIDE)
        usable = _halved(((off > _DARKEST) & (np.maximum(on, off) < SATURATED)).astype(np.float32))[::2, ::2] == 1.0
        upright.append(_variance(apart - along, _BESIDE, _UPRIGHT)[::2, ::2][usable])
        wide.append(_variance(along - around, _WIDE, _WIDE)[::2, ::2][usable])
    measured = [np.concatenate(values) for values in (upright, wide)]
    if len(measured[0]) < _ENOUGH:
        return _Noise(*_USUAL)
    medians = (float(np.median(values)) / (1.0 + gain**2) for values in measured)
    return _Noise(*(max(own, least) for own, least in zip(medians, _LEAST, strict=True)))


def _even(background: U8, noise: _Noise) -> F32:
    """A laser-off frame without its noise."""
    along, around = _mean(background, 1, _UPRIGHT), _mean(background, _WIDE, _WIDE)
    rest = background - along
    kept = _kept(rest, _BESIDE, _UPRIGHT, np.float32(_UPRIGHT_NOISE * noise.upright))
    along += _enlarged(kept, rest) * rest
    rest = along - around
    left = np.float32(_WIDE_NOISE * noise.wide) + kept * kept * np.float32(noise.upright)
    around += _enlarged(_kept(rest, _WIDE, _WIDE, left), rest) * rest
    return around


def _kept(rest: F32, columns: int, rows: int, noise: F32 | np.float32) -> F32:
    """Share of what lies beside a mean that is no noise, at half the resolution."""
    variance = np.maximum(_variance(rest, columns, rows), np.float32(1e-6))
    return np.asarray(np.maximum(np.float32(1.0) - noise / variance, np.float32(0.0)), np.float32)


def _variance(rest: F32, columns: int, rows: int) -> F32:
    """Variance around each sample of what lies beside a mean, at half the resolution."""
    return _mean(_halved(rest * rest), columns // 2 + 1, rows // 2 + 1)


def _mean(values: F32 | U8, columns: int, rows: int) -> F32:
    return np.asarray(cv2.boxFilter(values, cv2.CV_32F, (columns, rows)), np.float32)


def _halved(values: F32) -> F32:
    size = -(-values.shape[1] // 2), -(-values.shape[0] // 2)
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float32)


def _enlarged(values: F32, like: F32) -> F32:
    return np.asarray(cv2.resize(values, like.shape[::-1]), np.float32)
