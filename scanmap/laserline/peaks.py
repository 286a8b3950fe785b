"""Where exactly: the sub-pixel column of each row's peak, and how well it is known."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.channel import SATURATED
from scanmap.laserline.dim import DimRows, dim_rows
from scanmap.laserline.noise import dot, noise_variance, speckle_contrast
from scanmap.laserline.samples import levelled

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

SIGMA_MIN_PX, SIGMA_MAX_PX = 0.3, 14.0
_REACH = 3.2  # [sigma] samples farther from the line say nothing of it
_ITERATIONS = 2
_SPECKLE_REACH = 5.0  # [sigma] under speckle the flanks say more than the core
_SPECKLE_ROWS = 31  # rows over which the line's height is smoothed for a first model of its speckle
_OFF_MOST = 1.2  # [px] from the middle of the window, and
_NARROW_PX, _WIDEST = 0.75, 6.2  # the widths, the wider as a part of the window, at which sums are integrals
_MOSTLY = 0.75  # share of the rows that lack samples, from which on all are fitted as they are
_FEW_ROWS = 64
_STRAY = 0.01  # share of the rows that is not worth another kind of step
_DIM = 11.0  # heights, in noise, from whose first guess the way is too long for that
_ROOT_PI, _ROOT_2PI = float(np.sqrt(np.pi)), float(np.sqrt(2.0 * np.pi))
_CURVED = 5.0  # how much, measured on dim lines: of (sigma_px / width_px)^2
_FLANK_SHARE = 0.1  # of what the better flank says of u, at least from the other
SPECKLE_FROM = 0.06  # contrast from which the noise counts as speckle


class Peaks(NamedTuple):
    """Gaussian peaks of N rows, arrays (N,)."""

    offset_px: F32  # from the middle of the window
    sigma_px: F32  # standard deviation of offset_px
    width_px: F32  # standard deviation of the profile
    height: F32  # above the background [grey levels]
    noise: F32  # standard deviation of a sample [grey levels]
    bias_px: F32  # what an odd residual, larger than noise explains, may have moved offset_px by
    contrast: float  # of the speckle, of all rows
    clipped: NDArray[np.bool_]  # the core is saturated
    one_sided: NDArray[np.bool_]  # nothing usable on one of the two flanks


def fit_gaussian(
    y: F32,
    usable: F32,
    sample_noise: float,
    contrast: float | None = None,
    samples: Callable[[int], tuple[F32, F32]] | None = None,
) -> Peaks:
    """Fit b + A exp(-(x - u)^2 / 2 s^2) to each row's window.

    Args:
        y: (n, N) grey levels around each row's peak, n odd; one row of the image per column.
        usable: (n, N) 1, or 0 for samples that say only "bright" or lie outside the image.
        sample_noise: rough standard deviation of a sample [grey levels].
        contrast: of the speckle; None: judged from the residuals.
        samples: gives y and usable for another half width of the window.

    Gauss-Newton on four parameters, saturated samples left out: the maximum-likelihood estimate for additive
    Gaussian noise, whose bound for u is 2 s_n^2 s / (sqrt(pi) A^2) (Cramer-Rao; Hagen and others 2007). Under
    speckle the samples are weighted by the variance of the model, s_n^2 + C^2 (model - b)^2.
    """
    n = len(y)
    x = (np.arange(n, dtype=np.float32) - n // 2)[:, None]
    cut = (usable.min(axis=0) < 1).nonzero()[0]  # rows with samples that say little
    clipped = np.zeros(y.shape[1], bool)
    clipped[cut] = ~usable[n // 2 - 1 : n // 2 + 2, cut].all(axis=0)
    y, low, high = levelled(y, x, sample_noise)
    fit = start = _start(y, x, low, high)
    # A step for so few costs as much as for many, and those for whole lines are not the last ones.
    mostly_cut = len(cut) > _MOSTLY * y.shape[1] or y.shape[1] < _FEW_ROWS
    for _ in range(0 if mostly_cut else _ITERATIONS):
        fit = _improve_whole(x, _Look(y, x, fit), fit)
    odd = (np.abs(fit.u) > _OFF_MOST) | (fit.s < _NARROW_PX) | (fit.s > n / _WIDEST) | (_DIM * sample_noise > fit.A)
    odd[slice(None) if mostly_cut else cut] = True
    part = odd.nonzero()[0]
    # What is left of a clipped line needs more of its background to be told four parameters from.
    least = np.where(clipped[part], np.float32(6.0), np.float32(3.0))
    if len(part) <= _STRAY * len(odd) and not cut.size:
        part = part[:0]
    if part.size:
        fit = fit.with_rows(part, _fit_part(y[:, part], x, usable[:, part], start.of(part), least))
    dim = dim_rows(y, x, cut, fit.s, fit.A, sample_noise)
    if dim is not None:
        fit = fit.with_rows(dim.rows, _Fit(dim.u, dim.s, dim.A, dim.b, dim.s * np.float32(0.5 * _ROOT_PI)))
    look = _Look(y, x, fit)
    if part.size:
        look.weight[:, part] = usable[:, part] * _near(x, fit.of(part), _REACH, least)
    if contrast is None:
        contrast = speckle_contrast(look.residual, fit.A * look.bell, look.weight, sample_noise)
    if contrast > SPECKLE_FROM:
        if samples is not None:
            y, usable = samples(n // 2 + n // 4)
            x = (np.arange(len(y), dtype=np.float32) - len(y) // 2)[:, None]
            y, _, _ = levelled(y, x, sample_noise)
        fit, weight = _fit_speckle(y, x, usable, fit, sample_noise, contrast)
        look = _Look(y, x, fit)
        look.weight = weight
    return _peaks(fit, look, clipped, cut, contrast, dim)


def _peaks(
    fit: _Fit,
    look: _Look,
    clipped: NDArray[np.bool_],
    cut: NDArray[np.intp],
    contrast: float,
    dim: DimRows | None,
) -> Peaks:
    """What the fits say, and how well; `cut`: the rows some of whose samples say little."""
    # Of a saturated core the fit's height is a guess; that it rises to saturation is known.
    A = np.where(clipped, np.maximum(fit.A, SATURATED - fit.b), fit.A)
    fitted = np.full(len(fit.u), 4.0, np.float32)
    if dim is not None:
        fitted[dim.rows] = 3.0
    variance = noise_variance(look.residual, look.weight, fitted)
    # Cramer-Rao with the other three parameters unknown.
    own = np.sqrt(variance / np.maximum(fit.information, np.float32(1e-6))) * fit.s
    # A and s are estimates too: what scatters them makes the bound itself too small by their variance.
    sigma = own / fit.A
    sigma *= np.float32(1.0) + np.float32(_CURVED) * np.square(np.minimum(sigma / fit.s, np.float32(0.4)))
    if dim is not None:
        sigma[dim.rows] = own[dim.rows] / dim.height
    slope = look.slope
    slope *= look.weight
    odd = np.square(look.z)
    odd -= np.float32(1.5)
    odd *= slope  # orthogonal to the derivative by u over the whole line
    power = np.maximum(dot(odd, odd), np.float32(1e-6))
    asymmetry, uncertain = np.abs(dot(odd, look.residual)) / power / A, np.sqrt(variance / power) / A
    bias = np.float32(0.5) * fit.s * np.maximum(asymmetry - np.float32(0.05) - np.float32(2.5) * uncertain, 0.0)
    one_sided = np.zeros(len(fit.u), bool)
    if cut.size:
        # What each flank adds to the knowledge of u.
        left, right = -np.minimum(slope[:, cut], 0.0).sum(axis=0), np.maximum(slope[:, cut], 0.0).sum(axis=0)
        one_sided[cut] = np.minimum(left, right) < _FLANK_SHARE * np.maximum(left, right)
    return Peaks(fit.u, sigma, fit.s, A, np.sqrt(variance), bias, contrast, clipped, one_sided)


class _Fit(NamedTuple):
    """A line per row, arrays (N,)."""

    u: F32
    s: F32
    A: F32
    b: F32
    information: F32  # on u, in units of (A / s)^2 / noise^2

    def of(self, rows: NDArray[np.intp]) -> _Fit:
        """The fits of some rows."""
        return _Fit(*(values[rows] for values in self))

    def with_rows(self, rows: NDArray[np.intp], others: _Fit) -> _Fit:
        """These fits, with those of some rows replaced."""
        for values, other in zip(self, others, strict=True):
            values[rows] = other
        return self


class _Look:
    """What a fit leaves over in y (n, N), and where its samples count."""

    def __init__(self, y: F32, x: F32, fit: _Fit) -> None:
        self.z = x - fit.u
        self.z *= np.float32(1.0) / fit.s
        self.bell = np.square(self.z)
        self.bell *= np.float32(-0.5)
        np.exp(self.bell, out=self.bell)
        self.slope = self.bell * self.z  # derivative by u, times s / A
        self.residual = self.bell * -fit.A
        self.residual += y
        self.residual -= fit.b
        reach = np.maximum(np.float32(_REACH), np.float32(3.0) / fit.s) + np.float32(0.5) / fit.s
        self.weight = (np.abs(self.z) <= reach).astype(np.float32)


def _start(y: F32, x: F32, b: F32, top: F32) -> _Fit:
    """First guess: background from the window's ends, width from area over height."""
    above = y - b
    A = np.maximum(top - b, np.float32(1.0))
    above *= above > np.float32(0.25) * A
    area = above.sum(axis=0)
    u = _clipped((x[:, 0] @ above) / np.maximum(area, np.float32(1.0)), -2.0, 2.0)
    s = _clipped(area / (A * np.float32(2.35)), 0.7, 0.3 * len(x))
    return _Fit(u, s, A, b, np.zeros_like(b))


def _improve_whole(x: F32, look: _Look, fit: _Fit) -> _Fit:
    """One step for rows with a whole line: the normal equations are those of the integrals over it.

    Sums over samples of a smooth peak wider than 0.75 px are its integrals to a part in a hundred, and the odd ones
    vanish, so that only the gradient is summed; what the matrix lacks costs convergence, not accuracy (the chord
    method, Kantorovich).
    """
    wr = look.weight * look.residual
    per_s = np.float32(1.0) / fit.s
    level, bell, slope = wr.sum(axis=0) * per_s, dot(wr, look.bell) * per_s, dot(wr, look.slope) * per_s
    wr *= look.slope
    bent = dot(wr, look.z) * per_s
    count = look.weight.sum(axis=0) * per_s
    # The level eliminated, then height and width; all per sigma.
    k = np.float32(2.0 * np.pi) / count
    share = level * np.float32(_ROOT_2PI) / count
    bell -= share
    bent -= share
    aa, at, tt = np.float32(_ROOT_PI) - k, np.float32(0.5 * _ROOT_PI) - k, np.float32(0.75 * _ROOT_PI) - k
    per_det = np.float32(1.0) / (aa * tt - at * at)
    a, t = (tt * bell - at * bent) * per_det, (aa * bent - at * bell) * per_det
    b = fit.b + (level - np.float32(_ROOT_2PI) * (a + t)) / count
    p = slope * np.float32(2.0 / _ROOT_PI)
    A = np.maximum(fit.A + a, np.float32(0.5))
    per_A = np.float32(1.0) / A
    half = len(x) // 2
    u = _clipped(fit.u + _clipped(p * per_A, -1.0, 1.0) * fit.s, -half, half)
    s = _clipped(fit.s * (np.float32(1.0) + _clipped(t * per_A, -0.4, 0.6)), SIGMA_MIN_PX, SIGMA_MAX_PX)
    return _Fit(u, s, A, b, s * np.float32(0.5 * _ROOT_PI))


def _fit_part(y: F32, x: F32, usable: F32, fit: _Fit, least: F32) -> _Fit:
    """The fits (M,) of rows that lack samples, or whose sums are not the integrals."""
    for _ in range(_ITERATIONS + 2 * bool((usable == 0).any())):
        fit = _improve(y, x, usable * _near(x, fit, _REACH, least), fit)
    return fit


def _improve(y: F32, x: F32, weight: F32, fit: _Fit) -> _Fit:
    """One Gauss-Newton step."""
    basis = np.empty((5, *y.shape), np.float32)
    level, g, q, d, basis[4] = *basis[:4], y
    z = (x - fit.u) / fit.s
    level[:] = 1.0
    np.exp(np.float32(-0.5) * z * z, out=g)
    np.multiply(g, z, out=d)  # derivative by u, times s / A
    np.multiply(d, z, out=q)  # derivative by s, times s / A
    # Normal equations of (b, A, s, u), upper triangle, and their right side.
    normal = np.zeros((4, 5, y.shape[1]))
    for i, own in enumerate((weight, weight * g, weight * q, weight * d)):
        normal[i, i:] = np.einsum("jn,kjn->kn", own, basis[i:])
    (b, A, t, p), information = _solved(normal)
    A = np.maximum(A, 0.5)
    half = len(x) // 2
    u = _clipped(fit.u + _clipped(p / A, -1.0, 1.0) * fit.s, -half, half)
    s = _clipped(fit.s * (1.0 + _clipped(t / A, -0.4, 0.6)), SIGMA_MIN_PX, SIGMA_MAX_PX)
    return _Fit(*(values.astype(np.float32) for values in (u, s, A, b, information)))


def _solved(normal: F64) -> tuple[F64, F64]:
    """Solutions (n, N) of N symmetric systems, by elimination; and 1 / inverse[-1, -1] of each.

    Args:
        normal: (n, n + 1, N) upper triangles and right sides; changed.
    """
    n = len(normal)
    # What ill-conditioned rows need to be solved at all.
    diagonal = np.einsum("iik->ik", normal[:, :n])
    diagonal *= 1.0 + 1e-6
    diagonal += 1e-6
    for i, row in enumerate(normal):
        np.maximum(row[i], 1e-9, out=row[i])
        below = row[i + 1 : n, None].copy()
        row[i + 1 :] /= row[i]
        normal[i + 1 :, i + 1 :] -= below * row[i + 1 :]
    information = normal[-1, -2].copy()
    solution = normal[:, n]
    for i in range(n - 1, 0, -1):
        solution[:i] -= normal[:i, i] * solution[i]
    return solution, information


def _fit_speckle(y: F32, x: F32, usable: F32, fit: _Fit, sample_noise: float, contrast: float) -> tuple[_Fit, F32]:
    """The fit again, its samples weighted by the model's own variance; and the weights (n, N)."""
    floor = np.float32(max(sample_noise, 0.5) ** 2)
    # A row's own fit takes a part of its speckle for signal; the first weights are those of its neighbourhood.
    smooth = cv2.blur(fit.A[None], (_SPECKLE_ROWS, 1), borderType=cv2.BORDER_REPLICATE)[0]
    model = fit._replace(s=np.full_like(fit.s, np.median(fit.s)), A=np.asarray(smooth, np.float32))
    weight = usable
    for _ in range(_ITERATIONS):
        variance = floor + np.square(np.float32(contrast) * model.A * _bell(x, model))
        weight = usable * _near(x, model, _SPECKLE_REACH) * (floor / variance)
        model = _improve(y, x, weight, model)
    return model, weight


def _near(x: F32, fit: _Fit, reach: float, least: float | F32 = 3.0) -> F32:
    """1 for samples that say something of the line, else 0."""
    near: F32 = (np.abs(x - fit.u) <= np.maximum(reach * fit.s, least) + np.float32(0.5)).astype(np.float32)
    return near


def _clipped(values: F32 | F64, low: float, high: float) -> NDArray[np.floating]:
    # What np.clip does before it clips costs more than clipping does.
    clipped: NDArray[np.floating] = np.minimum(np.maximum(values, low), high)
    return clipped


def _bell(x: F32, fit: _Fit) -> F32:
    z = (x - fit.u) / fit.s
    bell: F32 = np.exp(np.float32(-0.5) * z * z)
    return bell
