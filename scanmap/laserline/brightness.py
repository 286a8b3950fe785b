"""Saturated lines placed by what a JPEG stores of brightness, which is sharp, not by its colour, which is smeared."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.edges import sides_of
from scanmap.laserline.peaks import Peaks, fit_gaussian
from scanmap.laserline.pictures import Rows, not_one
from scanmap.laserline.samples import REACH, Samples, ends, span_of, without_ramp
from scanmap.laserline.steps import Fit

F32 = NDArray[np.float32]
Index = NDArray[np.intp]

# Brightness places a saturated core at most this far [px] from where its flanks do, and not much less surely.
_SAME_PX, _NO_WORSE = 1.0, 2.0
_NOISES = 2.0  # that a sample may lie above where the core is cut
_BAR_PX = 7.0  # wider, it is a bar, whose edges tell more
_MISFIT = 0.05  # share of a line's height that compression and texture leave of it


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
    own = around.rows.of(rows)
    wide = min(half + half // 2, REACH)
    y, usable, cut, share = around.brightness_of(wide, rows, peaks.height[again])
    # What is brighter than that is of the cut core, whatever a fit that it has moved makes of it.
    usable *= y < cut + np.float32(_NOISES) * own.noise
    span = slice(wide - half, wide + half + 1)
    y = without_ramp(y, (np.arange(len(y), dtype=np.float32) - wide)[:, None], _ramp(y, y[span], own))[span]
    level = np.minimum(*ends(y))
    start = Fit(peaks.offset_px[again], peaks.width_px[again], share * peaks.height[again], level, np.zeros_like(level))
    found = fit_gaussian(y, usable[span], own, peaks.contrast, limit=cut, start=start)
    agrees = np.abs(found.offset_px - peaks.offset_px[again]) < _SAME_PX
    agrees &= (found.sigma_px < _NO_WORSE * peaks.sigma_px[again]) & ~found.one_sided
    at = again[agrees]
    offset, sigma, bias = peaks.offset_px.copy(), peaks.sigma_px.copy(), peaks.bias_px.copy()
    offset[at], sigma[at], bias[at] = found.offset_px[agrees], found.sigma_px[agrees], found.bias_px[agrees]
    halo[at] &= found.noise[agrees] > np.maximum(misfit[at], np.float32(_MISFIT) * found.height[agrees])
    return peaks._replace(offset_px=offset, sigma_px=sigma, bias_px=bias)


def _ramp(wide: F32, narrow: F32, rows: Rows) -> F32:
    """By how much (N,) the room's light rises from one end of wide windows (n, N) to the other.

    In its own channel a saturated line is twice as high, and is moved by a slope half as far. What narrower windows do
    not show as well is an edge farther away.
    """
    far, near = ((sides.right - sides.left) / span_of(y) for y in (wide, narrow) for sides in [sides_of(y, rows)])
    slope = np.where(far * near > 0.0, np.sign(far) * np.minimum(np.abs(far), np.abs(near)), np.float32(0.0))
    ramp: F32 = slope * span_of(wide)
    return ramp
