"""Where exactly: the sub-pixel column of each row's peak, and how well it is known."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.channel import SATURATED
from scanmap.laserline.dim import DimRows, dim_rows
from scanmap.laserline.noise import dot, noise_variance, speckle_contrasts
from scanmap.laserline.params import LaserLineParams
from scanmap.laserline.pictures import Rows, not_one
from scanmap.laserline.result import Reason
from scanmap.laserline.samples import levelled
from scanmap.laserline.steps import (
    ITERATIONS,
    REACH,
    ROOT_PI,
    Fit,
    Leftover,
    bell_of,
    first_guess,
    fit_part,
    fit_whole,
    improve,
    near,
)

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Index = NDArray[np.intp]

_SPECKLE_REACH = 5.0  # [sigma] under speckle the flanks say more than the core
_SPECKLE_ROWS = 31  # rows over which the line's height is smoothed for a first model of its speckle
_OFF_MOST = 1.2  # [px] from the middle of the window, and
_NARROW_PX, _WIDEST = 0.75, 6.2  # the widths, the wider as a part of the window, at which sums are integrals
_STRAY = 0.01  # share of the rows that is not worth another kind of step
_DIM = 11.0  # heights, in noise, from whose first guess the way is too long for that
_CURVED = 5.0  # how much, measured on dim lines: of (sigma_px / width_px)^2
_FLANK_SHARE = 0.1  # of what the better flank says of u, at least from the other
SPECKLE_FROM = 0.06  # contrast from which the noise counts as speckle


class Peaks(NamedTuple):
    """Gaussian peaks of N rows of P pictures, arrays (N,)."""

    offset_px: F32  # from the middle of the window
    sigma_px: F32  # standard deviation of offset_px
    width_px: F32  # standard deviation of the profile
    height: F32  # above the background [grey levels]
    noise: F32  # standard deviation of a sample [grey levels]
    lean: F32  # how much an odd part of the profile is of its height, and to which side
    bias_px: F32  # what that, where it is larger than noise explains, may have moved offset_px by
    clipped: NDArray[np.bool_]  # the core is saturated
    one_sided: NDArray[np.bool_]  # nothing usable on one of the two flanks
    contrast: F64  # (P,) of each picture's speckle

    def with_rows(self, rows: Index, others: Peaks) -> Peaks:
        """These peaks, with those of some rows replaced."""
        for values, other in zip(self[:-1], others[:-1], strict=True):
            values[rows] = other
        return self


def fit_gaussian(
    y: F32,
    usable: F32,
    rows: Rows,
    contrast: F64,
    samples: Callable[[int], tuple[F32, F32]] | None = None,
    limit: F32 | None = None,
    start: Fit | None = None,
) -> Peaks:
    """Fit b + A exp(-(x - u)^2 / 2 s^2) to each row's window.

    Args:
        y: (n, N) grey levels around each row's peak, n odd; one row of the image per column.
        usable: (n, N) 1, or 0 for samples that say only "bright" or lie outside the image.
        rows: N >= 2 of P pictures.
        contrast: (P,) of the speckle; NaN: judged from the residuals.
        samples: gives y and usable for another half width of the window.
        limit: (N,) grey levels at which the lines are cut, infinite where they are whole; None: all of them are.
        start: where the lines nearly are, if that is known.

    Gauss-Newton on four parameters, saturated samples left out: the maximum-likelihood estimate for additive
    Gaussian noise, whose bound for u is 2 s_n^2 s / (sqrt(pi) A^2) (Cramer-Rao; Hagen and others 2007). Under
    speckle the samples are weighted by the variance of the model, s_n^2 + C^2 (model - b)^2.
    """
    n, noise = len(y), rows.noise
    x = (np.arange(n, dtype=np.float32) - n // 2)[:, None]
    limit = np.full(y.shape[1], np.inf, np.float32) if limit is None else limit
    cut = ((usable.min(axis=0) < 1) | (limit < np.inf)).nonzero()[0]  # rows with samples that say little
    clipped = np.zeros(y.shape[1], bool)
    clipped[cut] = ~usable[n // 2 - 1 : n // 2 + 2, cut].all(axis=0)
    y, low, high = levelled(y, x, noise)
    steps = 2 * ITERATIONS if start is None else ITERATIONS
    start = first_guess(y, x, low, high) if start is None else start
    fit = fit_whole(y, x, start, cut)
    odd = (np.abs(fit.u) > _OFF_MOST) | (fit.s < _NARROW_PX) | (fit.s > n / _WIDEST) | (_DIM * noise > fit.A)
    odd[cut] = True
    part = not_one(_without_strays(odd.nonzero()[0], cut, rows))
    if part.size:
        # What is left of a clipped line needs more of its background to be told four parameters from.
        least = np.where(clipped[part], np.float32(6.0), np.float32(3.0))
        taken = y.take(part, axis=1), x, usable.take(part, axis=1), start.of(part)
        fit = fit.with_rows(part, fit_part(*taken, least, limit[part], steps))
    dim = dim_rows(y, x, cut, fit.s, fit.A, rows)
    if dim is not None:
        fit = fit.with_rows(dim.rows, Fit(dim.u, dim.s, dim.A, dim.b, dim.s * np.float32(0.5 * ROOT_PI)))
    look = Leftover(y, x, fit)
    if part.size:
        look.weight[:, part] = usable.take(part, axis=1) * near(x, fit.of(part), REACH, least)
        look.weight[:, part] *= look.bell[:, part] * fit.A[part] < (limit - fit.b)[part]
    unknown = np.isnan(contrast)
    if unknown.any():
        judged = speckle_contrasts(look.residual, look.bell, fit.A, look.weight, rows)
        contrast = np.where(unknown, judged, contrast)
    peaks = _peaks(fit, look, clipped, cut, rows, dim)._replace(contrast=contrast)
    speckled = not_one((contrast[rows.picture] > SPECKLE_FROM).nonzero()[0])
    if not speckled.size:
        return peaks
    if samples is not None:
        y, usable = samples(n // 2 + n // 4)
        x = (np.arange(len(y), dtype=np.float32) - len(y) // 2)[:, None]
        y, _, _ = levelled(y, x, noise)
    y, usable, some = y.take(speckled, axis=1), usable.take(speckled, axis=1), rows.of(speckled)
    fit, weight = _fit_speckle(y, x, usable, fit.of(speckled), some, contrast, limit[speckled])
    look = Leftover(y, x, fit)
    look.weight = weight
    cut = np.isin(speckled, cut).nonzero()[0]
    return peaks.with_rows(speckled, _peaks(fit, look, clipped[speckled], cut, some, None))


def _without_strays(part: Index, cut: Index, rows: Rows) -> Index:
    """The rows `part` of those pictures that have more than some strays of them, or rows `cut`."""
    if not part.size:
        return part
    count, asked, lacking = (
        np.bincount(picture, minlength=len(rows.noise_of))
        for picture in (rows.picture, rows.picture[part], rows.picture[cut])
    )
    worth = (asked > _STRAY * count) | (lacking > 0)
    return part[worth[rows.picture[part]]]


def _peaks(
    fit: Fit,
    look: Leftover,
    clipped: NDArray[np.bool_],
    cut: Index,
    rows: Rows,
    dim: DimRows | None,
) -> Peaks:
    """What the fits say, and how well; `cut`: the rows some of whose samples say little."""
    # Of a saturated core the fit's height is a guess; that it rises to saturation is known.
    A = np.where(clipped, np.maximum(fit.A, SATURATED - fit.b), fit.A)
    fitted = np.full(len(fit.u), 4.0, np.float32)
    if dim is not None:
        fitted[dim.rows] = 3.0
    variance = noise_variance(look.residual, look.weight, fitted, rows.parts)
    # Cramer-Rao with the other three parameters unknown.
    own = np.sqrt(variance / np.maximum(fit.information, np.float32(1e-6))) * fit.s
    # A and s are estimates too: what scatters them makes the bound itself too small by their variance.
    sigma = own / fit.A
    sigma *= np.float32(1.0) + np.float32(_CURVED) * np.square(np.minimum(sigma / fit.s, np.float32(0.4)))
    if dim is not None:
        sigma[dim.rows] = own[dim.rows] / dim.height
    slope = look.bell * look.z  # derivative by u, times s / A
    slope *= look.weight
    odd = np.square(look.z)
    odd -= np.float32(1.5)
    odd *= slope  # orthogonal to the derivative by u over the whole line
    power = np.maximum(dot(odd, odd), np.float32(1e-6))
    lean = np.asarray(dot(odd, look.residual) / power / A, np.float32)
    uncertain = np.sqrt(variance / power) / A
    bias = np.float32(0.5) * fit.s * np.maximum(np.abs(lean) - np.float32(0.05) - np.float32(2.5) * uncertain, 0.0)
    one_sided = np.zeros(len(fit.u), bool)
    if cut.size:
        # What each flank adds to the knowledge of u.
        flanks = slope.take(cut, axis=1)
        left, right = -np.minimum(flanks, 0.0).sum(axis=0), np.maximum(flanks, 0.0).sum(axis=0)
        one_sided[cut] = np.minimum(left, right) < _FLANK_SHARE * np.maximum(left, right)
    return Peaks(fit.u, sigma, fit.s, A, np.sqrt(variance), lean, bias, clipped, one_sided, np.zeros(0))


def _fit_speckle(y: F32, x: F32, usable: F32, fit: Fit, rows: Rows, contrasts: F64, limit: F32) -> tuple[Fit, F32]:
    """The fit again, its samples weighted by the model's own variance; and the weights (n, N)."""
    floor = np.square(np.maximum(rows.noise, np.float32(0.5)))
    contrast = contrasts.astype(np.float32)[rows.picture]
    # A row's own fit takes a part of its speckle for signal; the first weights are those of its neighbourhood.
    model = fit._replace(s=np.empty_like(fit.s), A=np.empty_like(fit.A))
    for part in rows.parts:
        if part.stop > part.start:
            model.A[part] = cv2.blur(fit.A[None, part], (_SPECKLE_ROWS, 1), borderType=cv2.BORDER_REPLICATE)[0]
            model.s[part] = np.median(fit.s[part])
    weight = usable
    for _ in range(ITERATIONS):
        variance = floor + np.square(contrast * model.A * bell_of(x, model))
        weight = usable * near(x, model, _SPECKLE_REACH) * (floor / variance)
        model = improve(y, x, weight, model, limit)
    return model, weight


def judged(peaks: Peaks, noise: F32, params: LaserLineParams) -> NDArray[np.uint8]:
    """Reason (N,) of each fit."""
    reason = np.full(len(peaks.height), Reason.OK, np.uint8)
    snr = peaks.height * np.sqrt(1.77 * peaks.width_px) / np.maximum(noise, 1.0)
    reason[peaks.one_sided] = Reason.EDGE
    reason[np.abs(peaks.offset_px) > 3.0 + 0.7 * peaks.width_px] = Reason.AMBIGUOUS
    reason[peaks.sigma_px > 1.5] = Reason.WEAK
    # A dim bump whose samples scatter far more than the sensor's do is texture of the room.
    reason[(peaks.noise > 2.5 * np.maximum(noise, 1.5)) & (peaks.height < 3.5 * peaks.noise)] = Reason.AMBIGUOUS
    reason[(snr < params.min_snr) | (peaks.height < params.min_peak)] = Reason.WEAK
    reason[peaks.width_px > params.max_width_px] = Reason.WIDE
    reason[peaks.width_px < 0.33] = Reason.NARROW
    return reason
