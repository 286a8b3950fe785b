"""What a scan says of itself where it measured the same bearing more than once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.solvers.sight import SAME_BEARING, Lines


class Passes(NamedTuple):
    """Bearings that were measured more than once."""

    bearings: int
    rms_px: float  # of one measurement, from the differences
    promised_px: float
    lag_deg: float  # bearing by which the ways back and forth differ; NaN where not both were gone


def compare_passes(lines: Lines, line_error_px: float) -> Passes | None:
    """How well repeated bearings agree; None where nothing was repeated.

    Args:
        line_error_px: error that all rows of a shot share, beside their noise.
    """
    turned = np.mod(lines.bearings - lines.bearings.min() + 1e-9, 2.0 * np.pi)
    order = np.argsort(turned, kind="stable")
    close = np.flatnonzero(np.diff(turned[order]) < SAME_BEARING)
    if len(close) < 3:
        return None
    first, second = order[close], order[close + 1]
    first, second = np.minimum(first, second), np.maximum(first, second)
    difference = lines.column_px[second] - lines.column_px[first]
    promised = np.sqrt(lines.sigma_px[first] ** 2 + lines.sigma_px[second] ** 2 + 2.0 * line_error_px**2)
    known = np.isfinite(difference)
    if known.sum() < 50:
        return None
    scatter = 1.4826 * float(np.median(np.abs(difference[known]))) / np.sqrt(2.0)
    return Passes(len(close), scatter, float(np.median(promised[known])) / np.sqrt(2.0), _lag(lines, first, second))


def _lag(lines: Lines, first: NDArray[np.intp], second: NDArray[np.intp]) -> float:
    """Bearing [deg] by which the second pass trails the first where they were gone in opposite directions.

    The columns' change with the bearing is measured in the scan itself: du = (du/db) lag.
    """
    before, after = np.clip(first - 1, 0, None), np.clip(first + 1, None, len(lines.bearings) - 1)
    span = lines.bearings[after] - lines.bearings[before]
    last = len(lines.bearings) - 1
    back = lines.bearings[np.clip(second + 1, None, last)] - lines.bearings[np.clip(second - 1, 0, None)]
    opposite = np.sign(span) * np.sign(back) < 0
    if opposite.sum() < 3:
        return float("nan")
    slope = (lines.column_px[after] - lines.column_px[before]) / span[:, None]
    difference = lines.column_px[second] - lines.column_px[first]
    smooth = np.isfinite(slope) & np.isfinite(difference) & (np.abs(slope) < 20.0 / np.radians(1.0))
    smooth &= opposite[:, None]
    if smooth.sum() < 50:
        return float("nan")
    x, y = slope[smooth], difference[smooth]
    lag = 0.0
    for _ in range(10):
        left = y - lag * x
        weight = 1.0 / (1.0 + (left / (2.0 * max(1.4826 * float(np.median(np.abs(left))), 1e-3))) ** 2)
        lag = float((weight * x * y).sum() / max((weight * x * x).sum(), 1e-12))
    return float(np.degrees(lag))
