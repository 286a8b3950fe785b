"""Pooling along the line: neighbouring rows of one surface know each other's column."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# How far two neighbouring rows' columns may differ beyond the line's own slope: in sigmas, and at least [px].
_BREAK_SIGMA, _BREAK_PX = 6.0, 0.35
# A quadratic that misses its own rows by more than this (reduced chi^2) is not what the surface is.
_MISFIT = 4.5


def pool(column: Array, sigma: Array, support: int) -> tuple[Array, Array]:
    """Columns and sigmas (H,) after a weighted quadratic over at most `support` rows of one segment.

    Args:
        column: (H,) NaN where a row has no line.
        sigma: (H,) standard deviations.
        support: odd number of rows.

    Segments end at missing rows and where the column steps; the window of a row slides inward at a segment's
    ends and never reaches over them. Where the quadratic does not describe the rows (texture, a bend) the
    support shrinks to 5 and then 1. Source: Savitzky and Golay 1964, with weights.
    """
    out_column, out_sigma = column.copy(), sigma.copy()
    start, stop = _segments(column, sigma)
    pending = np.isfinite(column)
    for rows in (support, 5):
        if rows > support:
            continue
        fits = pending & (stop - start >= min(rows, 5))
        at = np.flatnonzero(fits)
        if not at.size:
            continue
        fitted, spread, chi2 = _quadratic(column, sigma, at, start[at], stop[at], rows)
        good = chi2 < _MISFIT
        out_column[at[good]], out_sigma[at[good]] = fitted[good], spread[good]
        pending[at[good]] = False
    return out_column, out_sigma


def _segments(column: Array, sigma: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First row and end of the segment that each row belongs to."""
    rows = len(column)
    step = np.diff(column)
    # The slope on either side of a step; the smaller disagreement counts, so that a bend is no break.
    before = np.concatenate([[np.nan, np.nan], step[:-2]]) if rows > 2 else np.full(rows - 1, np.nan)
    after = np.concatenate([step[2:], [np.nan, np.nan]]) if rows > 2 else np.full(rows - 1, np.nan)
    off = np.fmin(np.abs(step - before), np.abs(step - after))
    off = np.where(np.isfinite(off), off, np.abs(step))
    limit = np.maximum(_BREAK_PX, _BREAK_SIGMA * np.hypot(sigma[1:], sigma[:-1]))
    broken = ~(off <= limit) | (np.abs(step) > 8.0)
    edge = np.concatenate([[True], broken, [True]])
    begins = np.flatnonzero(edge)
    number = np.cumsum(edge[:-1]) - 1
    return begins[number], begins[number + 1]


def _quadratic(
    column: Array, sigma: Array, at: NDArray[np.intp], start: NDArray[np.intp], stop: NDArray[np.intp], rows: int
) -> tuple[Array, Array, Array]:
    """Value at `at`, its sigma, and reduced chi^2 of the weighted quadratic over each row's window."""
    first = np.clip(at - rows // 2, start, np.maximum(stop - rows, start))
    index = first[:, None] + np.arange(rows)
    inside = index < stop[:, None]
    index = np.minimum(index, len(column) - 1)
    t = (index - at[:, None]) / (0.5 * rows)
    weight = np.where(inside, 1.0 / np.maximum(sigma[index], 1e-4) ** 2, 0.0)
    base = column[at]
    y = np.where(inside, column[index] - base[:, None], 0.0)
    powers = [weight, weight * t]
    for _ in range(3):
        powers.append(powers[-1] * t)
    m = [power.sum(axis=1) for power in powers]
    r = [np.einsum("ij,ij->i", power, y) for power in powers[:3]]
    # Cramer's rule on [[m0 m1 m2] [m1 m2 m3] [m2 m3 m4]]; a trace of m0 on the diagonal keeps it regular.
    a, d, f = m[0] * (1 + 1e-9), m[2] + 1e-9 * m[0], m[4] + 1e-9 * m[0]
    b, c, e = m[1], m[2], m[3]
    i00, i01, i02 = d * f - e * e, c * e - b * f, b * e - c * d
    i11, i12, i22 = a * f - c * c, b * c - a * e, a * d - b * b
    det = a * i00 + b * i01 + c * i02
    c0 = (i00 * r[0] + i01 * r[1] + i02 * r[2]) / det
    c1 = (i01 * r[0] + i11 * r[1] + i12 * r[2]) / det
    c2 = (i02 * r[0] + i12 * r[1] + i22 * r[2]) / det
    residual = y - (c0[:, None] + t * (c1[:, None] + t * c2[:, None]))
    freedom = np.maximum(inside.sum(axis=1) - 3, 1)
    chi2 = np.einsum("ij,ij,ij->i", weight, residual, residual) / freedom
    return base + c0, np.sqrt(i00 / det), chi2
