"""How much a line's samples scatter, and of which kind the scatter is, judged from what the fit leaves over."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.pictures import Rows

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_CORE_TAKES = 2.3  # of the four parameters fitted to a profile, a core's samples determine
_MEDIAN = 0.8  # of what pairs of rows scatter by, over its mean
_MORE_SCATTER = 1.25  # variance on the line over that of a sample elsewhere, below which speckle is not asked for
_TELLING_PAIRS = (75, 300)  # the fewer tell in most pictures that the scatter does not grow at all
_TELLING = 128  # rows that are enough to say so
_ROWS_POOLED = 32  # rows over which the noise is taken for the same


def noise_variance(residual: F32, weight: F32, fitted: F32 | float, parts: Sequence[slice]) -> F32:
    """Variance (N,) of a sample of weight 1: the rows' own, its median over neighbouring rows.

    Args:
        residual: (n, N) what the fit leaves over.
        weight: (n, N) of the samples.
        fitted: (N,) parameters that each row's samples were fitted with.
        parts: the rows of each picture.

    A row far worse than its neighbours (an edge, a second line) keeps its own.
    """
    count = (weight > 0).view(np.uint8).sum(axis=0, dtype=np.uint8)
    freedom = np.maximum(count.astype(np.float32) - fitted, np.float32(1.0))
    own = dot(weight * residual, residual) / freedom
    # Groups of neighbouring rows of one picture, the last of each filled up with its median.
    filled = []
    for part in parts:
        rest = own[part][-_ROWS_POOLED:]
        missing = -len(own[part]) % _ROWS_POOLED
        filled += [own[part], np.sort(rest)[len(rest) // 2].repeat(missing)] if missing else [own[part]]
    ordered = np.sort(np.concatenate(filled).reshape(-1, _ROWS_POOLED), axis=1)
    middle = ordered[:, _ROWS_POOLED // 2 - 1] + ordered[:, _ROWS_POOLED // 2]
    common, first = np.empty_like(own), 0
    for part in parts:
        if rows := len(own[part]):
            last = first - (-rows // _ROWS_POOLED)
            # The median of chi^2 / k lies below its mean by (1 - 2 / 9k)^3 (Wilson and Hilferty).
            k = float(np.add.reduce(freedom[part])) / rows
            scaled = middle[first:last] * np.float32(0.5 / (1.0 - 2.0 / (9.0 * k)) ** 3)
            common[part], first = scaled.repeat(_ROWS_POOLED)[:rows], last
    limit = np.float32(1.0) + np.sqrt(np.float32(32.0) / freedom)
    variance: F32 = np.maximum(np.where(own > limit * common, own, common), np.float32(1.0 / 12.0))
    return variance


def speckle_contrasts(residual: F32, bell: F32, height: F32, weight: F32, rows: Rows) -> F64:
    """Speckle contrast of each picture (P,): how much the scatter between neighbouring rows grows with the signal.

    Args:
        residual: (n, N) what the fit leaves over.
        bell: (n, N) the fitted profiles, of height 1.
        height: (N,) of the lines.
        weight: (n, N) of the samples.
        rows: which pictures they are of.
    """
    contrast = np.zeros(len(rows.noise_of))
    # Some rows tell where there is none.
    quick = [np.arange(p.start, p.stop, max(1, (p.stop - p.start) // _TELLING)) for p in rows.parts]
    at = np.concatenate(quick)
    weights, left = weight.take(at, axis=1), residual.take(at, axis=1)
    own = dot(weights * left, left) / np.maximum(weights.sum(axis=0) - np.float32(4.0), np.float32(1.0))
    first, asked = 0, list[int]()
    for k, some in enumerate(quick):
        scatter, first = np.sort(own[first : first + len(some)]), first + len(some)
        if len(some) and scatter[len(some) // 2] >= _MORE_SCATTER * rows.noise_of[k] ** 2:
            asked.append(k)
    for most in _TELLING_PAIRS if asked else ():
        told = _speckle_contrasts(
            residual, bell, height, weight, [rows.parts[k] for k in asked], rows.noise_of[asked], most
        )
        contrast[asked] = [max(0.0, one) for one in told]
        asked = [k for k, one in zip(asked, told, strict=True) if one != 0.0]
        if not asked:
            break
    return contrast


def _speckle_contrasts(
    residual: F32, bell: F32, height: F32, weight: F32, parts: Sequence[slice], noise: F64, most: int
) -> list[float]:
    """Speckle contrasts of some pictures, by `most` pairs of rows or less than twice as many; NaN of too few.

    Differences between rows, because what a profile lacks of a Gaussian is alike in all of them.
    """
    pairs = [np.arange(p.start, p.stop - 1, max(1, (p.stop - p.start) // most)) for p in parts]
    upper = np.concatenate(pairs)
    lower = upper + 1
    step = residual.take(lower, axis=1) - residual.take(upper, axis=1)
    level = np.minimum(bell.take(upper, axis=1) * height[upper], bell.take(lower, axis=1) * height[lower])
    core = weight.take(upper, axis=1) * weight.take(lower, axis=1)
    core *= level > np.float32(0.4) * level.max(axis=0, initial=0.0)
    count, scatter, power = core.sum(axis=0), dot(core * step, step), dot(core * level, level)
    contrasts, first = [], 0
    for own, one_noise in zip(pairs, noise, strict=True):
        of, first = slice(first, first + len(own)), first + len(own)
        usable = count[of] >= 2
        if usable.sum() < 20:
            contrasts.append(float("nan"))
            continue
        freedom = np.maximum(count[of][usable] - np.float32(_CORE_TAKES), np.float32(0.5))
        kept = 0.5 * scatter[of][usable] / freedom
        excess = (kept - 1.5 * one_noise**2) / np.maximum(power[of][usable] / count[of][usable], np.float32(1e-6))
        excess.partition(len(excess) // 2)
        contrasts.append(float(np.sqrt(max(float(excess[len(excess) // 2]) / _MEDIAN, 0.0))))
    return contrasts


def dot(a: F32, b: F32) -> F32:
    """Sums (N,) of the products of two arrays (n, N)."""
    product: F32 = np.einsum("ij,ij->j", a, b)
    return product
