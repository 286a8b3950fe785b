"""Pooling along the line: neighbouring rows of one surface know each other's column."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[np.float64]

# How far two neighbouring rows' columns may differ beyond the line's own slope: in sigmas, and at least [px].
_BREAK_SIGMA, _BREAK_PX = 6.0, 0.35
# A quadratic that misses its own rows by more than this (reduced chi^2) is not what the surface is.
_MISFIT = 4.5
# Chi^2 of a bend that is kept by half; share of a bend's variance that remains when nothing of it is kept.
_BEND_DOUBT, _BEND_LEAST = 2.0, 0.5


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
    """Value at `at`, its sigma, and reduced chi^2 of the weighted quadratic over each row's window.

    Most surfaces are straight over so few rows, and a bend that is not there costs half of what pooling gains: it
    is shrunk by how far it stands out of its own uncertainty (James and Stein 1961).
    """
    first = np.clip(at - rows // 2, start, np.maximum(stop - rows, start))
    # One array row per row of support: every sum below runs along the rows of the image.
    end = np.full(rows, np.nan)
    base = column[at]
    y = sliding_window_view(np.concatenate([column, end]), rows)[first].T - base
    weight = 1.0 / np.maximum(sliding_window_view(np.concatenate([sigma, end]), rows)[first].T, 1e-4) ** 2
    steps = first - at + np.arange(rows)[:, None]
    if (stop - first).min() < rows:
        outside = steps >= stop - at
        y[outside] = weight[outside] = 0.0
    t = steps * (2.0 / rows)
    wt = weight * t
    wtt = wt * t
    m0, m1, m2 = weight.sum(axis=0), wt.sum(axis=0), wtt.sum(axis=0)
    m3, m4 = (np.einsum("ij,ij->j", wtt, power) for power in (t, t * t))
    r0, r1, r2 = (np.einsum("ij,ij->j", power, y) for power in (weight, wt, wtt))
    # The straight line first, then what the bend adds to it, orthogonal to it.
    det = m0 * m2 - m1 * m1 + 1e-9 * m0 * m0
    c0, c1 = (m2 * r0 - m1 * r1) / det, (m0 * r1 - m1 * r0) / det
    b0, b1 = (m2 * m2 - m1 * m3) / det, (m0 * m3 - m1 * m2) / det  # of t^2 by the straight line
    power = np.maximum(m4 - b0 * m2 - b1 * m3, 1e-9 * m0)
    bend = (r2 - c0 * m2 - c1 * m3) / power
    significance = bend * bend * power
    kept = significance / (significance + _BEND_DOUBT)
    bend = bend * kept
    value, variance = c0 - b0 * bend, m2 / det + b0 * b0 / power * (_BEND_LEAST + (1.0 - _BEND_LEAST) * kept)
    residual = y - (c0 - b0 * bend) - t * (c1 - b1 * bend + t * bend)
    freedom = np.maximum(np.minimum(stop - first, rows) - 3, 1)
    chi2 = np.einsum("ij,ij->j", weight * residual, residual) / freedom
    return base + value, np.sqrt(variance), chi2
