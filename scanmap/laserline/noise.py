"""How much a line's samples scatter, and of which kind the scatter is, judged from what the fit leaves over."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]

_CORE_KEEPS = 0.5  # share of its variance that a core keeps when four parameters were fitted to it
_MORE_SCATTER = 1.25  # variance on the line over that of a sample elsewhere, below which speckle is not asked for
_ROWS_POOLED = 32  # rows over which the noise is taken for the same


def noise_variance(residual: F32, weight: F32, fitted: F32 | float = 4.0) -> F32:
    """Variance (N,) of a sample of weight 1: the rows' own, its median over neighbouring rows.

    Args:
        residual: (n, N) what the fit leaves over.
        weight: (n, N) of the samples.
        fitted: (N,) parameters that each row's samples were fitted with.

    A row far worse than its neighbours (an edge, a second line) keeps its own.
    """
    count = (weight > 0).view(np.uint8).sum(axis=0, dtype=np.uint8)
    freedom = np.maximum(count.astype(np.float32) - fitted, np.float32(1.0))
    own = dot(weight * residual, residual) / freedom
    groups = -(-len(own) // _ROWS_POOLED)
    filled = np.empty(groups * _ROWS_POOLED, np.float32)
    filled[: len(own)] = own
    filled[len(own) :] = np.sort(own[-_ROWS_POOLED:])[len(own[-_ROWS_POOLED:]) // 2] if len(own) else 0.0
    ordered = np.sort(filled.reshape(groups, _ROWS_POOLED), axis=1)
    # The median of chi^2 / k lies below its mean by (1 - 2 / 9k)^3 (Wilson and Hilferty).
    k = float(freedom.mean()) if len(own) else 1.0
    middle = ordered[:, _ROWS_POOLED // 2 - 1] + ordered[:, _ROWS_POOLED // 2]
    common = np.repeat(middle * np.float32(0.5 / (1.0 - 2.0 / (9.0 * k)) ** 3), _ROWS_POOLED)[: len(own)]
    limit = np.float32(1.0) + np.sqrt(np.float32(32.0) / freedom)
    variance: F32 = np.maximum(np.where(own > limit * common, own, common), np.float32(1.0 / 12.0))
    return variance


def speckle_contrast(residual: F32, signal: F32, weight: F32, sample_noise: float) -> float:
    """Speckle contrast: how much the scatter between neighbouring rows grows with the signal.

    Differences between rows, because what a profile lacks of a Gaussian is alike in all of them.
    """
    quick = slice(None, None, max(1, residual.shape[1] // 128))
    weights, left = np.ascontiguousarray(weight[:, quick]), np.ascontiguousarray(residual[:, quick])
    own = np.sort(dot(weights * left, left) / np.maximum(weights.sum(axis=0) - 4.0, 1.0))
    if not len(own) or own[len(own) // 2] < _MORE_SCATTER * sample_noise**2:
        return 0.0
    stride = max(1, residual.shape[1] // 300)
    step = residual[:, 1::stride] - residual[:, :-1:stride]
    level = np.minimum(signal[:, 1::stride], signal[:, :-1:stride])
    core = weight[:, 1::stride] * weight[:, :-1:stride]
    core *= level > 0.4 * level.max(axis=0, initial=0.0)
    count = core.sum(axis=0)
    usable = count >= 2
    if usable.sum() < 20:
        return 0.0
    scatter = 0.5 * dot(core * step, step)[usable] / count[usable]
    power = dot(core * level, level)[usable] / count[usable]
    # Four parameters were fitted to about as many samples of the core: it keeps half of its variance.
    excess = (scatter / _CORE_KEEPS - 1.5 * sample_noise**2) / power
    excess.partition(len(excess) // 2)
    return float(np.sqrt(max(float(excess[len(excess) // 2]) / 0.8, 0.0)))


def dot(a: F32, b: F32) -> F32:
    """Sums (N,) of the products of two arrays (n, N)."""
    product: F32 = np.einsum("ij,ij->j", a, b)
    return product
