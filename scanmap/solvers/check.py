"""Is a calibration as good as it says? A scan of a room judged by its flat walls, its corners and its own passes.

A wall is a piece that is flat under the calibration that self-calibration would make of this scan; so what it deviates
by under the calibration that is judged is the calibration's doing, not the room's. It may deviate by what was promised
there: the line's noise and shared error, the calibration's covariance, and a wall's own flatness.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.calibration.uncertainty import Uncertainty, uncertainty_of
from scanmap.errors import CalibrationError
from scanmap.solvers.flat_segments import Segments, grow
from scanmap.solvers.marks import Marks
from scanmap.solvers.passes import Passes, compare_passes
from scanmap.solvers.self_calibration import Estimate, Refined, refine
from scanmap.solvers.sight import Lines, Patches, located, patches_of, sight_of
from scanmap.solvers.walls import DEVIATIONS, CheckParams, Wall, walls_under

Array = NDArray[np.float64]

# Self-calibration contradicts a calibration if it changes it by more than this many deviations and makes all walls
# flatter by this factor: deviations alone leave systematic errors out.
CHANGE_DEVIATIONS = 5.0
CHANGE_GAIN = 1.1
# Of all patches with a line so many must lie on walls that are judged.
LEAST_SHARE = 0.05


class Corner(NamedTuple):
    """Where two upright walls meet."""

    first: int
    second: int
    angle_deg: float
    sigma_deg: float


@dataclass(frozen=True)
class Check:
    """What a scan says of its calibration."""

    walls: tuple[Wall, ...]  # largest first
    corners: tuple[Corner, ...]
    passes: Passes | None
    segments: Segments
    patches: Patches
    off_px: Array  # (B, R) columns beside the own wall's plane, NaN elsewhere
    params: CheckParams
    known: Uncertainty | None  # what the calibration says of itself
    refined: Refined | None  # what self-calibration makes of the scan; None where it cannot
    unrefined: str = ""  # why it cannot

    @property
    def strain(self) -> float:
        """Median over what is seen of the walls: one that really is bent does not condemn a calibration."""
        order = np.argsort([wall.strain for wall in self.walls])
        share = np.cumsum([self.walls[k].places for k in order], dtype=float)
        return float(self.walls[order[int(np.searchsorted(share, 0.5 * share[-1]))]].strain)

    @property
    def flat(self) -> bool:
        """Whether the walls are as flat as promised."""
        return self.strain <= 1.0

    @property
    def corners_hold(self) -> bool:
        """Whether the corners are square, as far as that is asked and can be told."""
        if not self.params.square or not self.corners:
            return True
        over = [abs(c.angle_deg - 90.0) - DEVIATIONS * c.sigma_deg for c in self.corners]
        return float(np.median(over)) <= self.params.corner_deg

    @property
    def contradictions(self) -> list[Estimate]:
        """What self-calibration changes beyond all that was promised."""
        if self.refined is None or self.refined.rms_before_px < CHANGE_GAIN * self.refined.rms_after_px:
            return []
        promised = {"yaw": "plane_nx", "roll": "plane_nz", "distance": "plane_d", "aside": "offset_y"}
        return [
            e for e in self.refined.estimates
            if e.observed and abs(e.change) > CHANGE_DEVIATIONS * np.hypot(
                e.sigma, self.known.sigma(promised.get(e.name, e.name)) if self.known is not None else 0.0)
        ]  # fmt: skip

    @property
    def passes_agree(self) -> bool:
        """Whether repeated bearings give the same columns."""
        return self.passes is None or self.passes.rms_px <= DEVIATIONS * self.passes.promised_px

    @property
    def passed(self) -> bool:
        """Whether nothing contradicts the calibration."""
        return self.flat and self.corners_hold and self.passes_agree and not self.contradictions


def check(
    lines: Lines, calibration: Calibration, params: CheckParams | None = None, *, marks: Marks | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Check:  # fmt: skip
    """Judge a calibration by one scan.

    Args:
        marks: printed markers on a turntable, for self-calibration.
        progress: told after every round how many of how many are done.

    Raises:
        CalibrationError: the scan shows too little that is flat to judge anything by.
    """
    params = params or CheckParams()
    patches = patches_of(lines)
    sight = sight_of(patches, calibration.intrinsics)
    points, per_column = located(sight, calibration)
    refined: Refined | None = None
    unrefined = ""
    try:
        refined = refine(lines, calibration, marks=marks, progress=progress)
    except CalibrationError as error:
        unrefined = str(error)
    segments = refined.segments if refined else grow(points, per_column, patches, params.tolerance_px)
    noise = max(params.line_error_px, refined.rms_after_px if refined else 0.0)
    known = int(np.isfinite(points[..., 0]).sum())
    sizes = np.bincount(segments.label[segments.label >= 0], minlength=len(segments))
    chosen = [int(k) for k in np.argsort(-sizes) if sizes[k] >= params.smallest_share * sizes.sum()]
    if not chosen or sizes[chosen].sum() < LEAST_SHARE * known:
        raise CalibrationError(
            f"too little in this recording is flat to judge by ({len(segments)} pieces, {known} patches with a line): "
            "scan a room with bare walls; if this one has them, the calibration is far off: scanmap calibrate laser"
        )
    walls, off = walls_under(calibration, patches, segments, chosen, (noise, params))
    return Check(
        walls, _corners(walls), compare_passes(lines, params.line_error_px), segments, patches, off, params,
        uncertainty_of(calibration), refined, unrefined,
    )  # fmt: skip


def _corners(walls: tuple[Wall, ...]) -> tuple[Corner, ...]:
    """Pairs of upright walls nearly square to each other, the largest first."""
    upright = [k for k, wall in enumerate(walls) if abs(wall.plane[2]) < 0.15]
    corners = []
    for a in upright:
        for b in upright:
            if b <= a:
                continue
            angle = float(np.degrees(np.arccos(np.clip(walls[a].plane[:3] @ walls[b].plane[:3], -1.0, 1.0))))
            if abs(angle - 90.0) < 15.0:
                slack = [
                    np.degrees(wall.rms_limit_m / DEVIATIONS / max(wall.length_m, 1e-3))
                    for wall in (walls[a], walls[b])
                ]
                corners.append(Corner(a, b, angle, float(np.hypot(*slack))))
    return tuple(corners[:12])
