"""Calibration without a board: a head refined until the walls of an ordinary room are flat.

Flat pieces of the scan are found with the head as it is, however bent; the head is changed so that each lies in a plane
as well as it can; and again, with less tolerance, until only the line's own noise is left. Repeated bearings and the
overlap of a full turn lie on the same pieces, so that passes must agree and the turn must close.

Where a table turns before a fixed head, printed markers on it tell how its axis leans, which a block's faces hardly do.
In the end walls that seem to be meant square to each other are taken for it, as far as they bear it out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.calibration.uncertainty import PLANE, Uncertainty, uncertainty_of
from scanmap.errors import CalibrationError
from scanmap.solvers.adjustment import Adjustment
from scanmap.solvers.flat_segments import Segments, grow, near_another
from scanmap.solvers.freedom import Freedom, Scale, longer_length, redrawn
from scanmap.solvers.marks import TOLD, Followed, Marks, follow
from scanmap.solvers.sight import Lines, Patches, located, patches_of, sight_of
from scanmap.solvers.squareness import Squared, squared

Array = NDArray[np.float64]

START_TOLERANCE_PX = 3.0
ROUNDS = 6
REWEIGHTED = 4  # times a round; with fewer, where it ends depends on where it began
FEWEST_PIECES = 3
# A parameter is observed if the scan knows it at least this much better than the ruler.
OBSERVED = 0.5
# A change is beyond chance from so many deviations of chi-square on.
CHANCE = 3.0
# A head farther off than this many ruler's deviations is not refined but wrong.
FARTHEST = 3.5
# What a scan must tell, or it tells nothing.
MUST: dict[Scale, tuple[str, ...]] = {
    "baseline": ("yaw", "offset_x", "offset_y"), "axis": ("yaw", "roll", "distance"),
}  # fmt: skip
NO_AXIS = (
    ". This calibration has no axis yet: write the head's offset from it, by a ruler, as head_offset_m under [axis], "
    "or run scanmap calibrate axis"
)


@dataclass(frozen=True)
class Estimate:
    """One parameter of a head before and after."""

    name: str
    change: float  # [rad] or [m]
    sigma: float  # of the change
    observed: bool


@dataclass(frozen=True)
class Refined:
    """A head after self-calibration, and what it is worth."""

    before: Calibration
    after: Calibration
    scale: Scale
    estimates: tuple[Estimate, ...]
    segments: Segments  # of the last round
    patches: Patches
    rms_before_px: float  # of the same pieces, in image columns
    rms_after_px: float
    square: Squared  # what the walls' directions added
    followed: Followed | None  # what markers on the turntable said, if there are any
    gained: bool  # whether walls are flatter after, by a change beyond chance

    def estimate(self, name: str) -> Estimate:
        """One of the parameters by its name."""
        return next(e for e in self.estimates if e.name == name)


def refine(
    lines: Lines, calibration: Calibration, scale: Scale | None = None, *, marks: Marks | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Refined:  # fmt: skip
    """Refine a head from the laser lines of one scan of a room, or of a block on a turntable.

    Args:
        lines: of all shots, laser on anything flat.
        calibration: the head as it is known; its intrinsics stay.
        scale: the length that holds the scale; the longer one if left out.
        marks: printed markers that turn with the table; they tell its axis, where the axis holds the scale.
        progress: told after every round how many of how many are done.

    Raises:
        CalibrationError: the scan cannot tell (too few bearings or flat pieces, walls that leave it open), or what it
            tells is not small: nothing is better than a wrong calibration.
    """
    if "laser plane" in calibration.meta.get("uncalibrated", ()):
        raise CalibrationError(
            "this calibration has no laser plane to refine yet: scanmap calibrate laser, or write that of its drawing"
        )
    patches = patches_of(lines)
    if len(np.unique(np.round(patches.bearings, 3))) < 8:
        raise CalibrationError(
            f"self-calibration needs a sweep; this recording has {len(lines.bearings)} shots. Scan half a turn at "
            "least, with walls in view"
        )
    scale = scale or longer_length(calibration)
    sight = sight_of(patches, calibration.intrinsics)
    height = located(sight, calibration)[0][..., 2]
    free = Freedom.of(calibration, scale, float(np.median(np.append(height[np.isfinite(height)], 0.0))))
    followed = follow(marks, calibration, free) if marks is not None and scale == "axis" else None
    if followed is not None:
        free = free.told(TOLD, followed.change, followed.sigma)
    change, tolerance = free.centre, START_TOLERANCE_PX
    for done in range(1, ROUNDS + 1):
        points, per_column = located(sight, free.changed(calibration, change))
        segments = grow(points, per_column, patches, tolerance)
        clear = ~near_another(points, per_column, segments, 2.0 * tolerance)
        adjustment = Adjustment.of(sight, patches, segments, clear, calibration, free)
        if len(adjustment) < FEWEST_PIECES:
            raise CalibrationError(
                f"only {len(adjustment)} flat pieces found (3 at least): point the scanner at walls, floor and "
                "furniture with flat faces, or calibrate with a board: scanmap calibrate laser"
            )
        solution = adjustment.solve(change, REWEIGHTED)
        change, tolerance = solution.change, max(0.5 * tolerance, min(5.0 * segments.noise_px, tolerance))
        if progress is not None:
            progress(done, ROUNDS)
    square = squared(adjustment.upright(solution), solution.covariance)
    outcome = _Outcome(calibration, scale, free, change + square.change, square, followed)
    return _judged(outcome, (adjustment, solution.weight), segments, patches)


@dataclass(frozen=True)
class _Outcome:
    """What came out of the last round."""

    calibration: Calibration
    scale: Scale
    free: Freedom
    change: Array
    square: Squared
    followed: Followed | None

    @property
    def covariance(self) -> Array:
        return self.square.covariance


def _judged(outcome: _Outcome, fit: tuple[Adjustment, Array], segments: Segments, patches: Patches) -> Refined:
    """The result, or why there is none."""
    sigma = np.sqrt(np.diag(outcome.covariance))
    estimates = tuple(
        Estimate(name, float(change), float(own), bool(own < OBSERVED * before))
        for name, change, own, before in zip(outcome.free.names, outcome.change, sigma, outcome.free.ruler, strict=True)
    )
    blind = [e.name for e in estimates if e.name in MUST[outcome.scale] and not e.observed]
    if blind:
        raise CalibrationError(
            f"this scan cannot tell {', '.join(blind)}: its flat pieces leave it open. Scan a corner of a room, walls "
            "on three sides, a full turn if the cable allows it; nothing is written"
            + NO_AXIS
            * ("axis" in outcome.calibration.meta.get("uncalibrated", ()))
        )
    far = [e.name for e, r in zip(estimates, outcome.free.ruler, strict=True) if abs(e.change) > FARTHEST * r]
    if far:
        raise CalibrationError(
            f"self-calibration would change {', '.join(far)} far more than a ruler errs: the head is not the one of "
            "this calibration, or the scan has hardly a flat wall. Calibrate with a board; nothing is written"
            + NO_AXIS
            * ("axis" in outcome.calibration.meta.get("uncalibrated", ()))
        )
    before, after = (_rms(fit[0].residual(x, fit[1])[0]) for x in (np.zeros(len(outcome.change)), outcome.change))
    # The change against its own covariance: chi-square with as many degrees of freedom as parameters.
    beyond = float(outcome.change @ np.linalg.solve(outcome.covariance, outcome.change))
    chance = len(outcome.change) + CHANCE * float(np.sqrt(2.0 * len(outcome.change)))
    return Refined(
        outcome.calibration, _finished(outcome), outcome.scale, estimates, segments, patches, before, after,
        outcome.square, outcome.followed, after < before and beyond > chance,
    )  # fmt: skip


def _finished(outcome: _Outcome) -> Calibration:
    """The calibration with the change in it, its frame drawn as before, and its covariance."""
    old = outcome.calibration
    new = outcome.free.changed(old, outcome.change)
    if outcome.scale == "baseline":
        new = redrawn(new, old.laser_plane)
    return replace(new, covariance=_uncertainty(outcome, new).table())


def _uncertainty(outcome: _Outcome, new: Calibration) -> Uncertainty:
    """Covariance of laser plane and mount; what was known of other parameters, and of the scale, stays."""
    known = uncertainty_of(outcome.calibration)
    slope = outcome.free.slope(new)
    own = slope @ outcome.covariance @ slope.T
    names = (*PLANE, "offset_x", "offset_y", "tilt_x", "tilt_y")
    if known is None:
        return Uncertainty(names, 0.5 * (own + own.T))
    if outcome.scale == "baseline":
        at = names.index("plane_d")
        own[at, at] += known.sigma("plane_d") ** 2
    others = known.without(names)
    return others.joined(names, own, np.zeros((len(names), len(others.names))))


def _rms(off: Array) -> float:
    """Robust: of what lies within 4 scatters."""
    inside = np.abs(off) <= 4.0 * 1.4826 * np.median(np.abs(off))
    return float(np.sqrt(np.mean(off[inside] ** 2)))
