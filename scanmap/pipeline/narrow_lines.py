"""Lines that are narrower than a line is, and nobody knows which part of the beam is missing: their sigma says so.

An edge that cuts the beam leaves a narrower line beside the beam's middle (`cut_beams`). Where the next bearings do not
see the surface it lies on, as of a post that one bearing meets, no plane tells to which side. How far does: of a
Gaussian of which a share f = Phi(t) is left, t m + m^2 of the variance is gone, and its mean is m = phi(t) / f of the
standard deviation off (a truncated normal; Johnson, Kotz and Balakrishnan 1994, 13.10).
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.pipeline.moving import move
from scanmap.pipeline.step import Pipeline
from scanmap.pipeline.widths import Widths
from scanmap.scan import Scan

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Of the usual width: slanted surfaces and tone curves seldom make a line narrower. In 66 drawn sweeps 1 % of a million
# rows are; where the middle of the beam meets a surface at all, 0.89 (rms) of what is foretold is how far they are off.
_NARROW = 0.85
_SOME = 0.7  # of that, in means of a few rows, before all are asked
_ROWS, _FEWEST, _MOSTLY = 25, 8, 0.6  # rows along each other that tell, how many must be narrow, and their share
_T = np.linspace(4.0, -2.0, 200)  # where a beam is cut
_OFF = np.array([NormalDist().pdf(t) / NormalDist().cdf(t) for t in _T])
_GONE = _OFF * (_T + _OFF)  # rises from 0 to 0.9


def doubt_narrow_lines(scan: Scan, pipeline: Pipeline, usual: Widths, width_px: Sequence[F32], asked: Mask) -> None:
    """Add to sigma in `scan`, in place, how far lines may be off that are narrower than usual.

    Args:
        usual: how wide the scan's lines are.
        width_px: (H,) of each bearing: standard deviation of the line's profile.
        asked: (B, H) cells in question.
    """
    ratios, _ = usual.ratios()
    with np.errstate(invalid="ignore"):
        some = (ratios < _SOME * np.log(_NARROW)).any(axis=1) & asked.any(axis=1)
    for k in np.flatnonzero(some).tolist():
        expected = usual.of_bearing(k).width_px
        ratio = np.where(asked[k], width_px[k] / expected, np.nan)
        rows = np.flatnonzero(_narrow(ratio))
        if not rows.size:
            continue
        mean = _means(ratio, ratio < _NARROW)[rows]
        move(scan, pipeline, k, rows, 0.0, expected[rows] * np.interp(1.0 - np.square(mean), _GONE, _OFF))


def _narrow(ratio: F64) -> Mask:
    """Rows (H,) that are narrow among others, of widths over what is usual, NaN where there is no line."""
    known, narrow = np.isfinite(ratio), ratio < _NARROW
    some, all_of_them = (_count(values) for values in (narrow, known))
    return np.asarray(narrow & (some >= _FEWEST) & (some >= _MOSTLY * all_of_them))


def _means(values: F64, some: Mask) -> F64:
    """Means (H,) of `some` values (H,) around each row; NaN where there are none."""
    total = cv2.blur(np.where(some, values, 0.0)[None], (_ROWS, 1), borderType=cv2.BORDER_CONSTANT)[0] * _ROWS
    count = _count(some)
    return np.asarray(np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0))


def _count(some: Mask) -> F64:
    """How many rows (H,) around each one."""
    counted = cv2.blur(some.astype(np.float64)[None], (_ROWS, 1), borderType=cv2.BORDER_CONSTANT)[0] * _ROWS
    return np.asarray(np.rint(counted), np.float64)
