"""Saturated lines placed by what a JPEG stores of brightness, which is sharp, not by its colour, which is smeared."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.peaks import Peaks, fit_gaussian
from scanmap.laserline.pictures import not_one
from scanmap.laserline.samples import Samples

F32 = NDArray[np.float32]
Index = NDArray[np.intp]

# Brightness places a saturated core at most this far [px] from where its flanks do, and not much less surely.
_SAME_PX, _NO_WORSE = 1.0, 2.0
_BAR_PX = 7.0  # wider, it is a bar, whose edges tell more


def by_brightness(
    peaks: Peaks,
    good: NDArray[np.bool_],
    halo: NDArray[np.bool_],
    misfit: F32,
    around: Samples,
    half: int,
    some: Index | slice,
) -> Peaks:
    """The peaks, those with a saturated core placed by brightness, where colour was compressed.

    Its flanks are a Gaussian's up to where the laser's channel is cut. What looked like a `halo` (N,) is none where
    they are: it was smeared colour. Where they scatter by more than `misfit` (N,) [grey levels] too, it is one.
    """
    smeared = around.smeared[some]
    again = not_one(np.flatnonzero(peaks.clipped & good & smeared & (peaks.width_px < _BAR_PX)))
    if around.beside is None or not again.size:
        return peaks
    rows = again if isinstance(some, slice) else some[again]
    y, usable, cut = around.brightness_of(half, rows)
    found = fit_gaussian(y, usable, around.rows.of(rows), peaks.contrast, limit=cut)
    agrees = np.abs(found.offset_px - peaks.offset_px[again]) < _SAME_PX
    agrees &= (found.sigma_px < _NO_WORSE * peaks.sigma_px[again]) & ~found.one_sided
    at = again[agrees]
    offset, sigma, bias = peaks.offset_px.copy(), peaks.sigma_px.copy(), peaks.bias_px.copy()
    offset[at], sigma[at], bias[at] = found.offset_px[agrees], found.sigma_px[agrees], found.bias_px[agrees]
    halo[at] &= found.noise[agrees] > misfit[at]
    return peaks._replace(offset_px=offset, sigma_px=sigma, bias_px=bias)
