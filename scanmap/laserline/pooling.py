"""Pooling along the line: neighbouring rows of one surface know each other's column."""

from __future__ import annotations

import math
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.pictures import not_one

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# How far two neighbouring rows' columns may differ beyond the line's own slope: in sigmas, and at least [px].
_BREAK_SIGMA, _BREAK_PX = 6.0, 0.35
_FAR_PX = 8.0  # a step that is no slope's
# A quadratic that misses its own rows by more than this (reduced chi^2) is not what the surface is.
_MISFIT = 4.5
# Chi^2 of a bend that is kept by half; rows over which is told what shrinking it leaves of its variance, at least 0.3.
_BEND_DOUBT, _BEND_ROWS, _BEND_LEAST = 2.0, 129, 0.3

# Rows apart in which a JPEG's errors are not the same: its blocks have eight.
APART_ROWS = (5, 6)
TELLING = 75  # rows that tell whether sigma is too small
_LEAN_ROWS = 16  # on either side, that tell how a line leans


def pool(column: Array, sigma: Array, support: int, parts: tuple[Index, Index] | None = None) -> tuple[Array, Array]:
    """Columns and sigmas (..., H) after a weighted quadratic over at most `support` rows of one segment.

    Args:
        column: (..., H) of one picture or several, NaN where a row has no line.
        sigma: (..., H) standard deviations.
        support: odd number of rows.
        parts: what `segments` gives, where it is known.

    Segments end at missing rows and where the column steps; the window of a row slides inward at a segment's
    ends and never reaches over them. Where the quadratic does not describe the rows (texture, a bend) the
    support shrinks to 5 and then 1. Source: Savitzky and Golay 1964, with weights.
    """
    out_column, out_sigma = column.copy(), sigma.copy()
    start, stop = segments(column, sigma) if parts is None else parts
    pending = np.isfinite(column).ravel()
    for rows in (support, 5):
        if rows > support or rows > column.shape[-1]:
            continue
        at = not_one((pending & (stop - start >= rows)).nonzero()[0])
        if not at.size:
            continue
        first = np.minimum(np.maximum(at - rows // 2, start[at]), stop[at] - rows)
        fitted, spread, chi2 = _quadratic(column, sigma, at, first, rows)
        good = chi2 < _MISFIT
        good_at = at[good]
        out_column.reshape(-1)[good_at], out_sigma.reshape(-1)[good_at] = fitted[good], spread[good]
        pending[good_at] = False
    return out_column, out_sigma


def unexplained(column: Array, sigma: Array, start: Index, lags: tuple[int, ...]) -> Array:
    """How much more (or less) lines scatter than their sigmas say: a factor (P,) for each; NaN where too few rows tell.

    Args:
        column: (P, H) of P pictures, NaN where a row has no line.
        sigma: (P, H) standard deviations.
        start: (P H,) first row of the segment each row belongs to, of all pictures below each other.
        lags: rows so far apart that their errors have little to do with each other.

    What JPEG's blocks and a camera's sharpening do to a line looks like a line moved: a row's own samples cannot tell.
    Other rows can: fourth differences of a line are zero on every surface bent no more than a cubic, and 70 variances
    of noise. The median of all rows counts, so that edges do not.
    """
    told = _fourth_differences(column, sigma, start, lags)
    return np.array([_typical([ratio for _, ratio in one]) for one in told])


def unexplained_by_height(column: Array, sigma: Array, start: Index, lags: tuple[int, ...], height: Array) -> Array:
    """`unexplained` (P, H) for the rows of each octave of `height` (P, H) by themselves, as far as enough of them tell.

    A bright line is no Gaussian after a camera's tone curve, which its own residuals take for noise; a dim one is.
    """
    factor = np.full(column.shape, np.nan)
    octave = np.rint(np.log2(np.maximum(height, 1.0, dtype=np.float32)))
    lowest, highest = np.fmin.reduce(octave, axis=1), np.fmax.reduce(octave, axis=1)
    for k, told in enumerate(_fourth_differences(column, sigma, start, lags)):
        factor[k] = of_all = _typical([ratio for _, ratio in told])
        if not of_all > 0.0 or lowest[k] == highest[k]:
            continue
        for one in range(int(lowest[k]), int(highest[k]) + 1):
            high = octave[k] == one
            some = [ratio[high[at]] for at, ratio in told]
            own, count = _typical(some), min(map(len, some))
            if own >= 0.0:
                np.copyto(factor[k], of_all * (own / of_all) ** (count / (count + TELLING)), where=high)
    return factor


def moved(column: Array, parts: tuple[Index, Index], lag: Array) -> Array:
    """Columns (P, H) that lines move on by in `lag` (P,) rows [px], as they lean around each of their rows."""
    row = np.arange(column.size)
    first, last = np.maximum(row - _LEAN_ROWS, parts[0]), np.minimum(row + _LEAN_ROWS, parts[1] - 1)
    flat = column.ravel()
    by: Array = ((flat[last] - flat[first]) / np.maximum(last - first, 1)).reshape(column.shape) * lag[:, None]
    return by


def _typical(told: list[Array]) -> float:
    """Standard deviation of values whose squares are given, some for each lag, by their medians; NaN of too few."""
    if min(map(len, told)) < TELLING:
        return float("nan")
    total = 0.0
    for ratio in told:
        ordered, middle = ratio.copy(), len(ratio) // 2
        ordered.partition(middle)
        total += float(ordered[middle])
    return math.sqrt(total / len(told) / 0.455)  # the median of chi^2 with one degree of freedom


def _fourth_differences(
    column: Array, sigma: Array, start: Index, lags: tuple[int, ...]
) -> list[list[tuple[Index | slice, Array]]]:
    """For each picture and lag: middle rows of every other fourth difference, its square over what sigmas expect."""
    pictures, height = column.shape
    variance, start = np.square(sigma), start.reshape(column.shape)
    told: list[list[tuple[Index | slice, Array]]] = [[] for _ in range(pictures)]
    for lag in lags:
        rows = max(height - 4 * lag, 0)
        a, b, c, d, e = (column[:, k * lag : k * lag + rows : 2] for k in range(5))
        va, vb, vc, vd, ve = (variance[:, k * lag : k * lag + rows : 2] for k in range(5))
        step = a + e - 4.0 * (b + d) + 6.0 * c
        ratio = step * step / (va + ve + 16.0 * (vb + vd) + 36.0 * vc)
        one = (start[:, :rows:2] == start[:, 4 * lag : 4 * lag + rows : 2]) & np.isfinite(a)
        for k, whole in enumerate(one.all(axis=1).tolist()):
            if whole:
                told[k].append((slice(2 * lag, 2 * lag + rows, 2), ratio[k]))
            else:
                some = one[k].nonzero()[0]
                told[k].append((2 * (some + lag), ratio[k, some]))
    return told


def segments(column: Array, sigma: Array, steps: Array | None = None) -> tuple[Index, Index]:
    """First row and end of the segment that each row of pictures (..., H) belongs to, counted through all of them.

    Args:
        column: (..., H) NaN where a row has no line.
        sigma: (..., H) standard deviations.
        steps: what `unforeseen` gives, where it is known.
    """
    rows = column.shape[-1]
    variance = np.square(sigma.reshape(-1, rows))
    limit = np.maximum(_BREAK_PX**2, _BREAK_SIGMA**2 * (variance[:, 1:] + variance[:, :-1]))
    edge = np.ones(variance.shape, bool)
    edge[:, 1:] = ~((unforeseen(column) if steps is None else steps) <= limit)
    begins = np.append(edge.ravel().nonzero()[0], edge.size)
    length = np.diff(begins)
    return begins[:-1].repeat(length), begins[1:].repeat(length)


def unforeseen(column: Array) -> Array:
    """Squares (P, H - 1) [px^2] of how far columns (..., H) step beyond the slope of their line, infinite far away."""
    column = column.reshape(-1, column.shape[-1])
    step = column[:, 1:] - column[:, :-1]
    size = np.abs(step)
    # The slope on either side of a step; the smaller disagreement counts, so that a bend is no break.
    bend = np.abs(step[:, 2:] - step[:, :-2])
    off = np.full(step.shape, np.nan)
    off[:, 2:] = bend
    np.fmin(off[:, :-2], bend, out=off[:, :-2])
    np.copyto(off, size, where=np.isnan(off))
    np.copyto(off, np.inf, where=size > _FAR_PX)
    off *= off
    return off


def _quadratic(column: Array, sigma: Array, at: Index, first: Index, rows: int) -> tuple[Array, Array, Array]:
    """Value at rows `at` (N,), its sigma, and reduced chi^2 of the weighted quadratic over `rows` rows from `first`.

    Most surfaces are straight over so few rows, and a bend that is not there costs half of what pooling gains: it
    is shrunk by how far it stands out of its own uncertainty (James and Stein 1961).
    """
    height = column.shape[-1]
    column, sigma = column.reshape(-1, height), sigma.reshape(-1, height)
    known = np.isfinite(column)
    weight = np.where(known, 1.0 / np.square(np.maximum(sigma, 1e-4)), 0.0).ravel()
    # Near zero, so that nothing is lost where squares are subtracted.
    base = np.where(known, column, 0.0).sum(axis=1) / np.maximum(np.count_nonzero(known, axis=1), 1)
    y = np.where(known, column - base[:, None], 0.0).ravel()
    wy = weight * y
    # All moments of all windows at once: one row of the picture after the other, times powers of its place.
    powers = _powers(rows)
    # A window for every row of the picture, or only those asked for.
    few = 4 * len(at) < len(y)
    asked: Index | slice = first if few else slice(None)
    m0, m1, m2, m3, m4 = (np.correlate(weight, power)[asked] for power in powers)
    r0, r1, r2 = (np.correlate(wy, power)[asked] for power in powers[:3])
    q0 = np.correlate(wy * y, powers[0])[asked]
    # The straight line first, then what the bend adds to it, orthogonal to it.
    per_det = 1.0 / (m0 * m2 - m1 * m1 + 1e-9 * m0 * m0 + 1e-30)
    c0, c1 = (m2 * r0 - m1 * r1) * per_det, (m0 * r1 - m1 * r0) * per_det
    b0, b1 = (m2 * m2 - m1 * m3) * per_det, (m0 * m3 - m1 * m2) * per_det  # of t^2 by the straight line
    power = np.maximum(m4 - b0 * m2 - b1 * m3, 1e-9 * m0 + 1e-30)
    bend = (r2 - c0 * m2 - c1 * m3) / power
    significance = bend * bend * power
    kept = significance / (significance + _BEND_DOUBT)
    # What the straight line leaves over, less what the kept part of the bend explains of it.
    chi2 = (q0 - c0 * r0 - c1 * r1 - significance * (kept * (2.0 - kept))) / max(rows - 3, 1)
    bend *= kept
    # Each row by the polynomial of its own window, which is centred on it except at a segment's ends.
    own = np.arange(len(at)) if few else first
    value, line, bent = ((c0 - bend * b0)[own], (m2 * per_det)[own], (b0 * b0 / power)[own])
    aside = at - first - rows // 2
    ends = aside.nonzero()[0]
    i, tau = own[ends], aside[ends] * (2.0 / rows)
    off = tau * tau - b0[i] - b1[i] * tau
    value[ends] = c0[i] + c1[i] * tau + bend[i] * off
    line[ends] = (m2[i] - 2.0 * tau * m1[i] + tau * tau * m0[i]) * per_det[i]
    bent[ends] = off * off / power[i]
    variance = line + bent * _risk(significance[own], at, column.shape)
    return base[at // height] + value, np.sqrt(variance), chi2[own]


def _risk(significance: Array, at: Index, shape: tuple[int, ...]) -> Array:
    """Mean square error (N,) of shrunk bends at rows `at` (N,), in their variance, from their chi^2 nearby.

    Without a bend 0.3 is left of it, at the worst, where it is 3 standard deviations, 1.5. Stein's unbiased estimate
    (1981) of the risk of x^3 / (x^2 + 2), which single rows scatter too much to give.
    """
    doubtful = significance + _BEND_DOUBT
    rows = np.zeros((2, int(np.prod(shape[:-1])), shape[-1]))
    rows[0].ravel()[at] = 1.0 + (6.0 * _BEND_DOUBT * significance / doubtful - 2.0 * _BEND_DOUBT) / doubtful
    rows[1].ravel()[at] = 1.0
    total, count = (
        cv2.boxFilter(values, -1, (_BEND_ROWS, 1), normalize=False, borderType=cv2.BORDER_CONSTANT) for values in rows
    )
    risk: Array = np.maximum(np.asarray(total).ravel()[at] / np.asarray(count).ravel()[at], _BEND_LEAST)
    return risk


@cache
def _powers(rows: int) -> Array:
    """Powers 0 to 4 (5, rows) of the places in a window, from about -1 to 1."""
    t = (np.arange(rows) - rows // 2) * (2.0 / rows)
    return np.asarray(t ** np.arange(5)[:, None], np.float64)
