"""Where a line is no Gaussian: the middle of its bright core, or its centre of gravity."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]

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
