"""Where a line is no Gaussian: its brightest pixel, the middle of its bright core, or its centre of gravity."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.params import LaserLineParams
from scanmap.laserline.pictures import Rows
from scanmap.laserline.pooling import APART_ROWS, TELLING, segments, unexplained
from scanmap.laserline.result import LaserLine, Reason, without

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Array = NDArray[np.float64]
Index = NDArray[np.intp]

# What a core must stand out by where no profile could be fitted: in noise, and in grey levels.
_CORE_SNR, _CORE_CONTRAST = 8.0, 12.0
# What may be wrong of a core's place, as a share of its width, however smooth the line of cores is.
_CORE_BIAS = 0.03
_CORE_SHARE = 0.35  # of the height that a core is taken from


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
    left, right = y[:, half - 8] + y[:, half - 7] + y[:, half - 6], y[:, half + 6] + y[:, half + 7] + y[:, half + 8]
    left, right = left * np.float32(1.0 / 3.0), right * np.float32(1.0 / 3.0)
    side = np.maximum(left, right)
    level = np.maximum(np.minimum(side, top - 4.0), top - _CORE_SHARE * (top - np.minimum(left, right)))
    w = np.maximum(y - level[:, None], 0.0)
    # Only the run that holds the peak: cut at the first sample below the level on either side.
    gap = np.cumsum(w == 0.0, axis=1)
    w *= gap == gap[rows, peak][:, None]
    total = np.maximum(w.sum(axis=1), 1e-3)
    offset = np.einsum("ij,j->i", w, x) / total
    width = np.sqrt(np.maximum(np.einsum("ij,j->i", w, x * x) / total - offset**2, 0.0) + 1.0 / 12.0)
    sigma = np.maximum(0.12, 0.3 * width)
    return Cores(offset.astype(np.float32), sigma.astype(np.float32), width.astype(np.float32), top - side)


def brightest(plane: U8, min_peak: float) -> LaserLine:
    """T5 of the thesis: value and column of the first maximum of each row of a plane (H, W), whatever it is."""
    column = plane.argmax(axis=1)
    value = plane[np.arange(len(plane)), column].astype(np.float64)
    reason = np.where(value < min_peak, Reason.WEAK, Reason.OK).astype(np.uint8)
    # A column between two pixel borders: the standard deviation of a uniform distribution.
    sigma = np.full(len(plane), np.sqrt(1.0 / 12.0))
    line = LaserLine(column.astype(np.float64), value, np.full(len(plane), np.nan), sigma, reason)
    return without(line, reason == Reason.WEAK, Reason.WEAK)


def centre_of_gravity(y: F32, height_share: float = 0.2) -> F32:
    """Offset (N,) of the centre of gravity of what rises above a fifth of each row's peak; windows (N, n)."""
    n = y.shape[1]
    floor = np.minimum(y[:, :2].mean(axis=1), y[:, -2:].mean(axis=1))
    top = y.max(axis=1)
    level = floor + height_share * (top - floor)
    w = np.maximum(y - level[:, None], 0.0)
    x = np.arange(n, dtype=np.float32) - n // 2
    offset: F32 = (np.einsum("ij,j->i", w, x) / np.maximum(w.sum(axis=1), 1e-6)).astype(np.float32)
    return offset


def take_cores(
    line: LaserLine, at: tuple[Index, Index], y: F32, widest: float | Array, rows: Rows, params: LaserLineParams
) -> None:
    """Where the profile is no Gaussian but has a core that stands out sharply, take the core."""
    row, column = at
    if not row.size:
        return
    cores = bright_core(y)
    least = np.maximum(_CORE_SNR * rows.noise, max(_CORE_CONTRAST, params.min_peak))
    sharp = (cores.contrast > least) & (np.abs(cores.offset_px) < 3.0)
    sharp &= cores.width_px <= widest
    r = row[sharp]
    line.column_px[r] = column[sharp] + cores.offset_px[sharp]
    # The contrast is over what is beside the core; the line's height is over what is beside the line.
    beside = np.minimum(y[:, :3].mean(axis=1), y[:, -3:].mean(axis=1))
    line.peak[r] = np.maximum(cores.contrast, y.max(axis=1) - beside)[sharp]
    line.width_px[r] = cores.width_px[sharp]
    line.sigma_px[r], line.reason[r] = (
        _borne_out(line.column_px, r, cores.sigma_px[sharp], cores.width_px[sharp], len(rows.noise_of)),
        Reason.OK,
    )


def _borne_out(column: Array, row: Index, sigma: F32, width: F32, pictures: int) -> Array:
    """Sigmas (N,) of cores, which are guesses from their width, brought down to what they scatter along the line.

    A halo that is stronger on one side moves all of them alike: a part of the width always remains.
    """
    if len(row) < TELLING:
        return sigma.astype(np.float64)
    columns, sigmas = np.full((2, pictures, len(column) // pictures), np.nan)
    columns.reshape(-1)[row], sigmas.reshape(-1)[row] = column[row], sigma
    factor = np.fmin(unexplained(columns, sigmas, segments(columns, sigmas)[0], APART_ROWS), 1.0)
    least = np.minimum(_CORE_BIAS * width, sigma)
    return np.asarray(np.maximum(factor[row // columns.shape[1]] * sigma, least), np.float64)
