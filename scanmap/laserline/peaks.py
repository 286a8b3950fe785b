"""Where exactly: the sub-pixel column of each row's peak, and how well it is known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]

SATURATED = 250  # [grey levels] from here on a sample says only "bright"
SIGMA_MIN_PX, SIGMA_MAX_PX = 0.3, 14.0
_REACH = 3.2  # [sigma] samples farther from the line say nothing of it
_ITERATIONS = 2
_ROWS_POOLED = 32  # rows over which the noise is taken for the same
_CORE_SHARE = 0.35  # of the height that a core is taken from
_SPECKLE_FROM = 0.06  # contrast from which the noise counts as speckle


class Peaks(NamedTuple):
    """Gaussian peaks of N rows, arrays (N,)."""

    offset_px: F32  # from the middle of the window
    sigma_px: F32  # standard deviation of offset_px
    width_px: F32  # standard deviation of the profile
    height: F32  # above the background [grey levels]
    noise: F32  # standard deviation of a sample [grey levels]
    asymmetry: F32  # odd part of the residual as a fraction of the height
    clipped: NDArray[np.bool_]  # the core is saturated


def fit_gaussian(y: F32, saturated: NDArray[np.bool_], sample_noise: float, noise: str = "auto") -> Peaks:
    """Fit b + A exp(-(x - u)^2 / 2 s^2) to each row of windows.

    Args:
        y: (N, n) grey levels around each row's peak, n odd.
        saturated: (N, n) samples that say only "bright", or lie outside the image.
        sample_noise: rough standard deviation of a sample [grey levels].
        noise: `additive`, `speckle`, or `auto`, which judges from the residuals.

    Gauss-Newton on four parameters, saturated samples left out: the maximum-likelihood estimate for additive
    Gaussian noise, whose bound for u is 2 s_n^2 s / (sqrt(pi) A^2) (Cramer-Rao; Hagen and others 2007). Under
    speckle the samples are weighted by the variance of the model, s_n^2 + C^2 (model - b)^2.
    """
    n = y.shape[1]
    x = np.arange(n, dtype=np.float32) - n // 2
    usable = (~saturated).astype(np.float32)
    clipped = np.asarray(saturated[:, n // 2 - 1 : n // 2 + 2].any(axis=1))
    y = _levelled(y, x, sample_noise)
    u, s, A, b = _start(y, x)
    weight = usable
    information = np.zeros(len(y), np.float32)
    for _ in range(_ITERATIONS):
        near = np.abs(x - u[:, None]) <= np.maximum(_REACH * s, 3.0)[:, None] + 0.5
        weight = usable * near
        u, s, A, b, information = _improve(y, x, weight, u, s)
    model = b[:, None] + A[:, None] * _bell(x, u, s)
    contrast = _contrast(y - model, model - b[:, None], weight) if noise != "additive" else 0.0
    if noise == "speckle" or contrast > _SPECKLE_FROM:
        variance = _noise_variance(y - model, weight * (model - b[:, None] < 0.2 * A[:, None]))
        for _ in range(_ITERATIONS + 1):
            signal = A[:, None] * _bell(x, u, s)
            speckle = variance[:, None] + (max(contrast, 0.05) * signal) ** 2
            near = np.abs(x - u[:, None]) <= (_REACH * s)[:, None] + 0.5
            weight = usable * near * (variance[:, None] / speckle).astype(np.float32)
            u, s, A, b, information = _improve(y, x, weight, u, s)
        model = b[:, None] + A[:, None] * _bell(x, u, s)
    # Of a saturated core the fit's height is a guess; that it rises to saturation is known.
    A = np.where(clipped, np.maximum(A, SATURATED - b), A)
    residual = y - model
    sample_variance = _noise_variance(residual, weight)
    spread = np.sqrt(sample_variance / np.maximum(information, 1e-6)) * s / A
    z = (x - u[:, None]) / s[:, None]
    odd = _bell(x, u, s) * z * (z * z - 1.5)  # orthogonal to the derivative by u over the whole line
    asymmetry = _dot(weight * odd, residual) / np.maximum(_dot(weight * odd, odd), 1e-6) / A
    return Peaks(
        u,
        spread.astype(np.float32),
        s,
        A,
        np.sqrt(sample_variance).astype(np.float32),
        asymmetry.astype(np.float32),
        clipped,
    )


class Cores(NamedTuple):
    """The bright cores of N rows whose profile is no Gaussian, arrays (N,)."""

    offset_px: F32  # from the middle of the window
    sigma_px: F32
    width_px: F32  # standard deviation a uniform core of this width has
    contrast: F32  # height over the brighter of its two sides [grey levels]


def bright_core(y: F32) -> Cores:
    """Middle of the core of each row (N, n), whatever surrounds it.

    For lines of one or two pixels that a camera has sharpened, and for saturated lines in the halo of wax, skin or
    paint: there the core says where the light fell, the rest where it went. Centre of gravity of the run around the
    peak that rises above the brighter side 6 to 8 px away and above most of the height.
    """
    half = y.shape[1] // 2
    rows = np.arange(len(y))
    x = np.arange(y.shape[1], dtype=np.float32) - half
    top = y[:, half - 4 : half + 5].max(axis=1)
    peak = half - 4 + y[:, half - 4 : half + 5].argmax(axis=1)
    left, right = y[:, half - 8 : half - 5].mean(axis=1), y[:, half + 6 : half + 9].mean(axis=1)
    side = np.maximum(left, right)
    level = np.maximum(np.minimum(side, top - 4.0), top - _CORE_SHARE * (top - np.minimum(left, right)))
    w = np.maximum(y - level[:, None], 0.0)
    # Only the run that holds the peak: cut at the first sample below the level on either side.
    gap = np.cumsum(w == 0.0, axis=1)
    w *= gap == gap[rows, peak][:, None]
    total = np.maximum(w.sum(axis=1), 1e-3)
    offset = w @ x / total
    width = np.sqrt(np.maximum(w @ (x * x) / total - offset**2, 0.0) + 1.0 / 12.0)
    sigma = np.maximum(0.12, 0.3 * width)
    return Cores(offset.astype(np.float32), sigma.astype(np.float32), width.astype(np.float32), top - side)


def centre_of_gravity(y: F32, height_share: float = 0.2) -> F32:
    """Offset (N,) of the centre of gravity of what rises above a fifth of each row's peak; windows (N, n)."""
    n = y.shape[1]
    floor = np.minimum(y[:, :2].mean(axis=1), y[:, -2:].mean(axis=1))
    top = y.max(axis=1)
    level = floor + height_share * (top - floor)
    w = np.maximum(y - level[:, None], 0.0)
    x = np.arange(n, dtype=np.float32) - n // 2
    offset: F32 = (w @ x / np.maximum(w.sum(axis=1), 1e-6)).astype(np.float32)
    return offset


def _levelled(y: F32, x: F32, sample_noise: float) -> F32:
    """Windows with the ramp between their two ends taken out, where it is more than noise.

    A line beside an edge of the room's own brightness would be fitted too wide. Everywhere else a ramp as a fifth
    parameter would cost a fifth of the accuracy.
    """
    k = max(2, len(x) // 6)
    left, right = y[:, :k].mean(axis=1), y[:, -k:].mean(axis=1)
    ramp = right - left
    height = y.max(axis=1) - np.maximum(left, right)
    ramp[np.abs(ramp) < np.maximum(4.5 * sample_noise * np.sqrt(2.0 / k), 0.3 * height)] = 0.0
    if not ramp.any():
        return y
    levelled: F32 = y - ramp[:, None] * (x / (len(x) - k))[None, :].astype(np.float32)
    return levelled


def _start(y: F32, x: F32) -> tuple[F32, F32, F32, F32]:
    """First guess: background from the window's ends, width from area over height."""
    k = max(2, len(x) // 6)
    b = np.minimum(y[:, :k].mean(axis=1), y[:, -k:].mean(axis=1))
    above = np.maximum(y - b[:, None], 0.0)
    A = np.maximum(above.max(axis=1), 1.0)
    above *= above > 0.25 * A[:, None]
    area = above.sum(axis=1)
    u = np.clip(above @ x / np.maximum(area, 1.0), -2.0, 2.0)
    s = np.clip(area / A / 2.35, 0.7, 0.3 * len(x))
    return u.astype(np.float32), s.astype(np.float32), A, b


def _improve(y: F32, x: F32, weight: F32, u: F32, s: F32) -> tuple[F32, F32, F32, F32, F32]:
    """One Gauss-Newton step; the last array is the information on u, in units of (A / s)^2 / noise^2."""
    z = (x - u[:, None]) / s[:, None]
    g = np.exp(-0.5 * z * z)
    d = g * z  # derivative by u, times s / A
    q = d * z  # derivative by s, times s / A
    basis = np.stack([np.ones_like(g), g, d, q])  # (4, N, n)
    weighted = basis * weight
    normal = np.einsum("anx,bnx->nab", weighted, basis, optimize=False).astype(np.float64)
    right = np.einsum("anx,nx->na", weighted, y, optimize=False).astype(np.float64)
    normal[:, range(4), range(4)] *= 1.0 + 1e-6
    normal[:, range(4), range(4)] += 1e-6
    b, A, p, t = np.linalg.solve(normal, right[:, :, None])[:, :, 0].T
    A = np.maximum(A, 0.5)
    u = u + np.clip(p / A, -1.0, 1.0) * s
    s = np.clip(s * (1.0 + np.clip(t / A, -0.4, 0.6)), SIGMA_MIN_PX, SIGMA_MAX_PX)
    half = len(x) // 2
    u = np.clip(u, -half, half)
    return u.astype(np.float32), s.astype(np.float32), A.astype(np.float32), b.astype(np.float32), normal[:, 2, 2]


def _bell(x: F32, u: F32, s: F32) -> F32:
    z = (x - u[:, None]) / s[:, None]
    bell: F32 = np.exp(-0.5 * z * z)
    return bell


def _noise_variance(residual: F32, weight: F32) -> F32:
    """Variance (N,) of a sample of weight 1: the rows' own, its median over neighbouring rows.

    A row far worse than its neighbours (an edge, a second line) keeps its own.
    """
    freedom = np.maximum(weight.sum(axis=1) - 4.0, 1.0)
    own = _dot(weight * residual, residual) / freedom
    count = -(-len(own) // _ROWS_POOLED)
    filled = np.empty(count * _ROWS_POOLED, np.float32)
    filled[: len(own)] = own
    filled[len(own) :] = np.median(own[-_ROWS_POOLED:])
    pooled = np.median(filled.reshape(count, _ROWS_POOLED), axis=1)
    # The median of chi^2 / k lies below its mean by (1 - 2 / 9k)^3 (Wilson and Hilferty).
    k = float(np.median(freedom)) if len(own) else 1.0
    common = np.repeat(pooled, _ROWS_POOLED)[: len(own)] / (1.0 - 2.0 / (9.0 * k)) ** 3
    limit = 1.0 + 4.0 * np.sqrt(2.0 / freedom)
    variance: F32 = np.maximum(np.where(own > limit * common, own, common), 1.0 / 12.0)
    return variance


def _contrast(residual: F32, signal: F32, weight: F32) -> float:
    """Speckle contrast: how much the residual grows with the signal."""
    height = signal.max(axis=1, keepdims=True)
    core = weight * (signal > 0.5 * height)
    flank = weight * (signal < 0.1 * height)
    if core.sum() < 100 or flank.sum() < 100:
        return 0.0
    # Four parameters were fitted to about as many samples of the core: it keeps a fraction of its variance.
    kept = 0.5
    excess = (core * residual**2).sum() / core.sum() / kept - (flank * residual**2).sum() / flank.sum() / 0.9
    power = (core * signal**2).sum() / core.sum()
    return float(np.sqrt(max(excess, 0.0) / max(power, 1e-6)))


def _dot(a: F32, b: F32) -> F32:
    product: F32 = np.einsum("ij,ij->i", a, b)
    return product
