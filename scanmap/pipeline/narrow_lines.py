"""Lines that are narrower than a line is, where no plane of the next bearings tells which part of the beam is missing.

An edge that cuts the beam leaves a narrower line beside the beam's middle (`cut_beams`). How far beside is told by how
narrow it is: of a Gaussian of which a share f = Phi(t) is left, t m + m^2 of the variance is gone, and its mean is
m = phi(t) / f of the standard deviation off (a truncated normal; Johnson, Kotz and Balakrishnan 1994, 13.10). What is
left falls off steeply where it was cut and slowly on its other side, to which it was moved: with a laser-off frame, by
which the room's own brightness is gone, its lean tells to which. Else sigma says that it may be either.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import MEAN_ROWS
from scanmap.pipeline.moving import move
from scanmap.pipeline.step import Pipeline
from scanmap.pipeline.widths import Widths
from scanmap.scan import Scan

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

# Of the usual width: slanted surfaces and tone curves seldom make a line narrower. In 66 drawn sweeps 1 % of a million
# rows are; where the middle of the beam meets a surface at all, 0.89 (rms) of what is foretold is how far they are off.
_NARROW = 0.85
_SOME = 0.7  # of that, in means of a few rows, before all are asked
_ROWS, _FEWEST, _MOSTLY = 25, 8, 0.6  # rows along each other that tell, how many must be narrow, and their share
# The lean of a run of such rows, in heights of the line, from which on it is believed, and in its own scatter along
# the run, of which so many means are asked. In 14 sweeps 2,400 rows are 32 mm off, and 97 % of them lie where it says.
_LEANS, _SURE, _MEANS = 0.012, 3.0, 3
# Rows of a run that are narrow, as where an edge cuts the beam all are; and rows between runs that one edge may cut.
_WHOLE, _GAP = 0.8, 60
_LEAST_PX = 1.2  # usual width: thinner lines lean by where they fall between samples
_DOUBT = 0.5  # of how far a line is moved: edges are not as sharp as that, and lenses blur what is left
_T = np.linspace(4.0, -2.0, 200)  # where a beam is cut
_OFF = np.array([NormalDist().pdf(t) / NormalDist().cdf(t) for t in _T])
_GONE = _OFF * (_T + _OFF)  # rises from 0 to 0.9


def place_narrow_lines(
    scan: Scan,
    pipeline: Pipeline,
    usual: Widths,
    width_px: Sequence[F32],
    lean: Sequence[F32 | None],
    asked: Mask,
) -> None:
    """Move lines in `scan`, in place, that are narrower than usual and lean; of others sigma says how far they may be.

    Args:
        usual: how wide the scan's lines are.
        width_px: (H,) of each bearing: standard deviation of the line's profile.
        lean: of each bearing, how much the profile leans, as `Look` has it; None where that tells nothing of the beam.
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
        off = expected[rows] * np.interp(1.0 - np.square(mean), _GONE, _OFF)
        side = np.where(expected[rows] < _LEAST_PX, 0.0, _side(rows, lean[k]))
        move(scan, pipeline, k, rows, side * off, np.where(side == 0.0, off, _DOUBT * off))


def _side(rows: Index, lean: F32 | None) -> F64:
    """To which side (N,) of narrow lines in `rows` (N,) their beam's middle is: -1 left, 1 right, 0 nobody knows."""
    side = np.zeros(len(rows))
    if lean is None:
        return side
    runs = [run for run in _runs(rows, MEAN_ROWS) if len(run) >= _WHOLE * (rows[run[-1]] - rows[run[0]] + 1)]
    whole = np.concatenate([np.zeros(0, np.intp), *runs])
    for part in _runs(rows[whole], _GAP):
        run = whole[part]
        means = lean[np.unique(rows[run] // MEAN_ROWS)]
        means = means[np.isfinite(means)]
        if len(means) < _MEANS:
            continue
        leans, scatter = float(means.mean()), float(means.std(ddof=1)) / np.sqrt(len(means))
        if abs(leans) > max(_LEANS, _SURE * scatter):
            side[run] = -np.sign(leans)
    return side


def _runs(rows: Index, gap: int) -> list[Index]:
    """Runs of `rows` (N,), by their places among them, with no more than `gap` from one to the next."""
    return np.split(np.arange(len(rows)), np.flatnonzero(np.diff(rows) > gap) + 1)


def _narrow(ratio: F64) -> Mask:
    """Rows (H,) that are narrow among others, of widths over what is usual, NaN where there is no line."""
    known, narrow = np.isfinite(ratio), ratio < _NARROW
    some, all_of_them = (_count(values) for values in (narrow, known))
    sure = narrow & (some >= _FEWEST) & (some >= _MOSTLY * all_of_them)
    # At the ends of a run the rows beyond are counted, too.
    beside = cv2.dilate(sure.astype(np.uint8)[None], np.ones((1, _ROWS), np.uint8))[0]
    return np.asarray(narrow & beside.astype(bool))


def _means(values: F64, some: Mask) -> F64:
    """Means (H,) of `some` values (H,) around each row; NaN where there are none."""
    total = cv2.blur(np.where(some, values, 0.0)[None], (_ROWS, 1), borderType=cv2.BORDER_CONSTANT)[0] * _ROWS
    count = _count(some)
    return np.asarray(np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0))


def _count(some: Mask) -> F64:
    """How many rows (H,) around each one."""
    counted = cv2.blur(some.astype(np.float64)[None], (_ROWS, 1), borderType=cv2.BORDER_CONSTANT)[0] * _ROWS
    return np.asarray(np.rint(counted), np.float64)
