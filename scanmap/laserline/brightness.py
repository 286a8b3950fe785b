"""Saturated lines placed by what a JPEG stores of brightness, which is sharp, not by its colour, which is smeared."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.peaks import Peaks, fit_gaussian
from scanmap.laserline.pictures import not_one
from scanmap.laserline.samples import Samples

Index = NDArray[np.intp]

# Brightness places a saturated core at most this far [px] from where its flanks do, and not much less surely.
_SAME_PX, _NO_WORSE = 1.0, 2.0
# A line without a halo is as wide in it, and a Gaussian but for its top, cut flat: that share of its height is misfit.
# Beyond the last width [px] it is a bar, whose edges tell more.
_AS_WIDE, _FLAT_MISFIT, _BAR_PX = 0.9, 0.055, 5.0


def by_brightness(
    peaks: Peaks, good: NDArray[np.bool_], around: Samples, half: int, some: Index | slice
) -> tuple[Peaks, NDArray[np.bool_]]:
    """The peaks, those with a saturated core placed by brightness, where colour was compressed.

    With them (N,) which are as wide in brightness as in the laser's channel, and a Gaussian but for their cut top: what
    does not fit there is smeared colour, not a halo, for a halo is dimmer in the other channels.
    """
    even = np.zeros(len(good), bool)
    smeared = around.smeared[some]
    again = not_one(np.flatnonzero(peaks.clipped & good & smeared & (peaks.width_px < _BAR_PX)))
    if around.beside is None or not again.size:
        return peaks, even
    rows = again if isinstance(some, slice) else some[again]
    found = fit_gaussian(*around.brightness_of(half, rows), around.rows.of(rows), peaks.contrast)
    agrees = np.abs(found.offset_px - peaks.offset_px[again]) < _SAME_PX
    agrees &= (found.sigma_px < _NO_WORSE * peaks.sigma_px[again]) & ~found.one_sided
    even[again] = agrees & (found.width_px > _AS_WIDE * peaks.width_px[again])
    even[again] &= found.noise < _FLAT_MISFIT * found.height
    at = again[agrees]
    offset, sigma, bias = peaks.offset_px.copy(), peaks.sigma_px.copy(), peaks.bias_px.copy()
    offset[at], sigma[at], bias[at] = found.offset_px[agrees], found.sigma_px[agrees], found.bias_px[agrees]
    return peaks._replace(offset_px=offset, sigma_px=sigma, bias_px=bias), even
