"""How bright surfaces are in the laser's light: what none is, and what is so strange that a neighbour must go on to it.

Light and width of a line, times the square of its range, are what the surface reflects: 400 times less than the usual
surface of a scan is less than black paint seen at a grazing angle. A mirror throws the line on what the camera sees
straight: as bright as the things it falls on, and by its column something near and nearly black. So is a black rod
before a wall; but on either side of a rod the wall is seen, and beside the other on one side at most. What polished
tiles show of a line that is itself hidden is dim and by its column blacker still: such a rod is lost on its flanks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.pipeline.step import Step

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Of the usual reflectance: what no surface has, and hardly one that no neighbouring bearing goes on to (in 22 drawn
# sweeps 2 of 620,000 true points, and 258 false ones); grey levels up to which a height says how bright a line is.
_DIM, _DIM_ALONE, _UNCLIPPED = 0.0025, 0.01, 200.0
# So little of the usual reflectance with at least so much of the usual light, where a neighbour sees nothing: in 16
# drawn sweeps 341 false points, and none true; 80 true ones of black chairs have a thirtieth of that light.
_DIM_NEAR, _BRIGHT = 0.03, 0.15
# Less of it, and of light as much as polish throws back, wherever no neighbour goes on: in 50 drawn sweeps 375 false
# points, and one true.
_BLACK, _POLISHED = 0.02, (0.05, 0.15)
# What no surface has that shows so much light: 44 false points there, and none true.
_BLACKEST, _SHOWN = 0.004, 0.1


def reflectance(step: Step) -> F32:
    """Light of the line (H,) times the square of its range, NaN where it is clipped or there is none."""
    with np.errstate(invalid="ignore"):
        light = np.where(step.line.peak < _UNCLIPPED, step.line.peak * step.line.width_px, np.nan)
        return (light * step.profile.range_m**2).astype(np.float32)


def shape_of(step: Step) -> F32:
    """Height [grey levels] and width [px] of the line (2, H)."""
    return np.array([step.line.peak, step.line.width_px], np.float32)


class Usual(NamedTuple):
    """What is usual in a scan."""

    reflectance: float
    light: float  # of a line, height times width

    @classmethod
    def of(cls, reflectances: Sequence[F32], shapes: Sequence[F32]) -> Usual:
        """Of bearings' reflectances (H,) each, and their lines' heights and widths, (2, H) each."""
        return cls(_median(reflectances), _median([height * width for height, width in shapes]))

    def nothing(self, reflectances: F32, shape: F32) -> Mask:
        """Which lines (H,) are darker than any surface, of `shape` (2, H), their heights and widths."""
        with np.errstate(invalid="ignore"):
            seen = shape[0] * shape[1] > _SHOWN * self.light
            return np.asarray(reflectances < np.where(seen, _BLACKEST, _DIM) * self.reflectance)

    def hardly(self, reflectances: F32) -> Mask:
        """Which lines (H,) are darker than almost any surface."""
        with np.errstate(invalid="ignore"):
            return np.asarray(reflectances < _DIM_ALONE * self.reflectance)

    def thrown(self, shape: F32, range_m: F32) -> Mask:
        """Which lines (H,) are as bright as usual, and by their range [m] of something black.

        Args:
            shape: (2, H) their heights and widths.
        """
        light = shape[0] * shape[1]
        with np.errstate(invalid="ignore"):
            return np.asarray((light * range_m**2 < _DIM_NEAR * self.reflectance) & (light > _BRIGHT * self.light))

    def polish(self, reflectances: F32, shape: F32) -> Mask:
        """Which lines (H,) are as dim as what polish shows of one elsewhere, and blacker than it at their range."""
        light, (least, most) = shape[0] * shape[1], _POLISHED
        with np.errstate(invalid="ignore"):
            dim = (light > least * self.light) & (light < most * self.light)
            return np.asarray(dim & (reflectances < _BLACK * self.reflectance))


def _median(values: Sequence[F32]) -> float:
    """Of what is known of values (H,), of several bearings."""
    known = np.concatenate([own[np.isfinite(own)][::4] for own in values] or [np.empty(0, np.float32)])
    return float(np.median(known)) if known.size else 0.0
