"""Points moved to where a line is found to be after all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanmap.pipeline.step import Pipeline
from scanmap.scan import Scan
from scanmap.triangulation import locate

F64 = NDArray[np.float64]
Index = NDArray[np.intp]


def per_column(pipeline: Pipeline, column: F64, row: F64) -> F64:
    """How far points of lines at columns and rows (N,) move with a column, (N, 3) in the head frame [m/px]."""
    ends = [locate(column + half, row, pipeline.calibration, pipeline.triangulation)[0] for half in (0.5, -0.5)]
    return np.asarray(ends[0] - ends[1])


def move(scan: Scan, pipeline: Pipeline, k: int, rows: Index, by: F64 | float, doubt: F64 | float) -> Index:
    """Move the line of the `k`-th bearing in `rows` (N,), in place; returns those in which it still is in range.

    Args:
        by: (N,) columns to the right [px].
        doubt: (N,) standard deviation of that, beside what was known of the line before [px].
    """
    before, row = scan.column_px[k, rows].astype(np.float64), rows.astype(np.float64)
    column = before + by
    points = locate(column, row, pipeline.calibration, pipeline.triangulation)[0]
    range_m = np.sqrt(np.square(points).sum(axis=1))
    with np.errstate(invalid="ignore"):
        kept = range_m <= pipeline.triangulation.range_max_m
    at: Index = rows[kept]
    T = scan.mount.T_world_head(float(scan.bearings[k]))
    scan.points[k, at] = points[kept] @ T[:3, :3].T + T[:3, 3]
    scan.range_m[k, at], scan.column_px[k, at] = range_m[kept], column[kept]
    sigma = np.broadcast_to(doubt, before.shape)[kept] * np.sqrt(
        np.square(per_column(pipeline, before[kept], row[kept])).sum(axis=1)
    )
    scan.sigma_m[k, at] = np.hypot(scan.sigma_m[k, at], sigma)
    return at
