"""Calibration without a board: a head refined until the walls of an ordinary room are flat.

Flat pieces of the scan are found with the head as it is, however bent; the head is changed so that each lies in a plane
as well as it can; and again, with less tolerance, until only the line's own noise is left. Repeated bearings and the
overlap of a full turn lie on the same pieces, so that passes must agree and the turn must close.

Least squares over (laser plane, mount) with the planes eliminated (variable projection, Golub and Pereyra 1973),
residuals in image columns, Cauchy weights, a ruler's knowledge as prior.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.calibration.uncertainty import PLANE, Uncertainty, uncertainty_of
from scanmap.errors import CalibrationError
from scanmap.solvers.flat_segments import Segments, grow, near_another
from scanmap.solvers.freedom import FREE, RULER, Scale, changed, longer_length, plane_slope, redrawn
from scanmap.solvers.own_planes import beside_own_planes, leans
from scanmap.solvers.sight import Lines, Patches, Sight, located, patches_of, sight_of

Array = NDArray[np.float64]

START_TOLERANCE_PX = 3.0
ROUNDS = 6
LARGEST_SOLVE = 15_000  # patches; more of one shot and wall say the same again
NOISE_FLOOR_PX = 0.003  # of what all patches of one shot on one wall may have in common
TYPICAL_SHOTS = 8  # shots on a piece from which on it tells its own noise
FEWEST_PIECES = 3
# Walls stand upright and floors lie level to each other by so much [rad]; asked of the largest pieces only.
PLUMB = np.radians(0.5)
UPRIGHT_WITHIN = np.radians(12.0)
LARGEST_PIECES = 12
# A parameter is observed if the scan knows it at least this much better than the ruler.
OBSERVED = 0.5
# A head farther off than this many ruler's deviations is not refined but wrong.
FARTHEST = 3.5


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

    def estimate(self, name: str) -> Estimate:
        """One of the parameters by its name."""
        return next(e for e in self.estimates if e.name == name)


def refine(lines: Lines, calibration: Calibration, scale: Scale | None = None, *, any_gain: bool = False) -> Refined:
    """Refine a head from the laser lines of one scan of a room, or of a block on a turntable.

    Args:
        lines: of all shots, laser on anything flat.
        calibration: the head as it is known; its intrinsics stay.
        scale: the length that holds the scale; the longer one if left out.
        any_gain: give the result even where the head was as good before.

    Raises:
        CalibrationError: the scan cannot tell (too few bearings or flat pieces, walls that leave it open), or what it
            tells is not small: nothing is better than a wrong calibration.
    """
    patches = patches_of(lines)
    if len(np.unique(np.round(patches.bearings, 3))) < 8:
        raise CalibrationError(
            f"self-calibration needs a sweep; this recording has {len(patches.bearings)} shots. Scan half a turn at "
            "least, with walls in view"
        )
    scale = scale or longer_length(calibration)
    sight = sight_of(patches, calibration.intrinsics)
    free, ruler = FREE[scale], np.array([RULER[scale][name] for name in FREE[scale]])
    change, tolerance = np.zeros(len(free)), START_TOLERANCE_PX
    for _ in range(ROUNDS):
        points, per_column = located(sight, changed(calibration, free, change))
        segments = grow(points, per_column, patches, tolerance)
        if len(segments) < FEWEST_PIECES:
            raise CalibrationError(
                f"only {len(segments)} flat pieces found (3 at least): point the scanner at walls, floor and furniture "
                "with flat faces, or calibrate with a board: scanmap calibrate laser"
            )
        clear = ~near_another(points, per_column, segments, 2.0 * tolerance)
        problem = _Problem.of(sight, (segments, clear), calibration, free, ruler)
        change, covariance = problem.solve(change)
        tolerance = max(0.5 * tolerance, min(5.0 * segments.noise_px, tolerance))
    return _judged(_Outcome(calibration, scale, free, ruler, change, covariance), problem, segments, patches, any_gain)


@dataclass(frozen=True)
class _Problem:
    """The patches of one round, sorted by the piece they lie on."""

    # Change (P,) and weights (N,) of the planes' fits -> (N,) [px], and leans (M,) in units of PLUMB.
    residual: Callable[[Array, Array], tuple[Array, Array]]
    piece: NDArray[np.intp]  # (N,) ascending
    cluster: NDArray[np.intp]  # (N,) one shot on one piece: what may share an error
    ruler: Array  # (P,)
    weight: Array  # (N,) of the last solution

    @classmethod
    def of(
        cls, sight: Sight, found: tuple[Segments, NDArray[np.bool_]], calibration: Calibration, free: tuple[str, ...],
        ruler: Array,
    ) -> _Problem:  # fmt: skip
        segments, clear = found
        where = np.flatnonzero(((segments.label >= 0) & clear).ravel())
        where = where[:: max(1, len(where) // LARGEST_SOLVE)]
        where = where[np.argsort(segments.label.ravel()[where], kind="stable")]
        numbers, piece = np.unique(segments.label.ravel()[where], return_inverse=True)
        shot = where // segments.label.shape[1]
        _, cluster = np.unique(piece * segments.label.shape[0] + shot, return_inverse=True)
        flat = Sight(*(part.reshape(-1, *part.shape[2:])[where] for part in sight))
        first, normals = np.searchsorted(piece, np.arange(len(numbers))), segments.planes[numbers, :3]
        large = np.argsort(-np.bincount(piece))[:LARGEST_PIECES]
        lean = np.abs(normals[large, 2])
        walls, floors = large[lean < np.sin(UPRIGHT_WITHIN)], large[lean > np.cos(UPRIGHT_WITHIN)]

        def residual(change: Array, weight: Array) -> tuple[Array, Array]:
            points, per_column = located(flat, changed(calibration, free, change))
            off, now = beside_own_planes(points, per_column, weight, (piece, first, normals))
            now = now * np.copysign(1.0, (now * normals).sum(axis=1))[:, None]
            return off, leans(now[walls], now[floors]) / PLUMB

        return cls(residual, piece, cluster, ruler, np.ones(len(piece)))

    def solve(self, change: Array) -> tuple[Array, Array]:
        """The best change (P,) and its covariance, reweighted three times."""
        from scipy.optimize import least_squares

        weight = np.ones(len(self.piece))
        for _ in range(4):
            off, lean = self.residual(change, weight)
            weight = self._weights(off)
            steady = 1.0 / np.sqrt(1.0 + (lean / 2.0) ** 2)

            def weighed(x: Array, weight: Array = weight, steady: Array = steady) -> Array:
                off, lean = self.residual(x, weight)
                return np.concatenate([off * np.sqrt(weight), lean * steady, x / self.ruler])

            solution = least_squares(weighed, change, x_scale=self.ruler, max_nfev=12)
            change = solution.x
        covariance: Array = np.linalg.inv(solution.jac.T @ solution.jac)
        self.weight[:] = weight
        return change, covariance

    def _weights(self, off: Array) -> Array:
        """Cauchy weights over the variance of each patch; what a shot's patches on one piece share counts once."""
        whole = 1.4826 * np.median(np.abs(off))
        scatter = np.array([1.4826 * np.median(np.abs(part)) for part in np.split(off, self._starts())])
        own = np.maximum(scatter, max(0.3 * whole, NOISE_FLOOR_PX))[self.piece]
        count = np.bincount(self.cluster)
        shared = self._shared(np.bincount(self.cluster, off) / count, count)[self.cluster]
        weight: Array = 1.0 / (1.0 + (off / (2.0 * own)) ** 2) / (own**2 + count[self.cluster] * shared**2)
        return weight

    def _shared(self, mean: Array, count: NDArray[np.intp]) -> Array:
        """What the patches of one shot on one piece have in common, by the scatter of their means: (C,) [px].

        Of each piece, as far as it has shots to tell; what it lacks comes from the others.
        """
        piece = np.zeros(len(mean), np.intp)
        piece[self.cluster] = self.piece
        several = count >= 5
        squares = (1.4826 * np.abs(mean[several])) ** 2
        typical = float(np.median(squares)) if several.any() else 0.0
        found = [squares[piece[several] == k] for k in range(piece.max() + 1)]
        own = np.array([
            (len(s) * float(np.median(s) if len(s) else 0.0) + TYPICAL_SHOTS * typical) / (len(s) + TYPICAL_SHOTS)
            for s in found
        ])  # fmt: skip
        shared: Array = np.sqrt(np.maximum(own, NOISE_FLOOR_PX**2))[piece]
        return shared

    def _starts(self) -> NDArray[np.intp]:
        return np.flatnonzero(np.diff(self.piece)) + 1


@dataclass(frozen=True)
class _Outcome:
    """What came out of the last round."""

    calibration: Calibration
    scale: Scale
    free: tuple[str, ...]
    ruler: Array
    change: Array
    covariance: Array


def _judged(outcome: _Outcome, problem: _Problem, segments: Segments, patches: Patches, any_gain: bool) -> Refined:
    """The result, or why there is none."""
    sigma = np.sqrt(np.diag(outcome.covariance))
    estimates = tuple(
        Estimate(name, float(change), float(own), bool(own < OBSERVED * before))
        for name, change, own, before in zip(outcome.free, outcome.change, sigma, outcome.ruler, strict=True)
    )
    must = ("yaw", "offset_x", "offset_y") if outcome.scale == "baseline" else outcome.free
    blind = [e.name for e in estimates if e.name in must and not e.observed]
    if blind:
        raise CalibrationError(
            f"this scan cannot tell {', '.join(blind)}: its flat pieces leave it open. Scan a corner of a room, walls "
            "on three sides, a full turn if the cable allows it; nothing is written"
        )
    far = [e.name for e, r in zip(estimates, outcome.ruler, strict=True) if abs(e.change) > FARTHEST * r]
    if far:
        raise CalibrationError(
            f"self-calibration would change {', '.join(far)} far more than a ruler errs: the head is not the one of "
            "this calibration, or the scan has hardly a flat wall. Calibrate with a board; nothing is written"
        )
    before, after = (
        _rms(problem.residual(x, problem.weight)[0]) for x in (np.zeros(len(outcome.change)), outcome.change)
    )
    if not after <= before and not any_gain:
        raise CalibrationError(
            f"nothing to gain: flat pieces deviate by {before:.3f} px as it is and {after:.3f} px after; nothing is "
            "written"
        )
    return Refined(outcome.calibration, _finished(outcome), outcome.scale, estimates, segments, patches, before, after)


def _finished(outcome: _Outcome) -> Calibration:
    """The calibration with the change in it, its frame drawn as before, and its covariance."""
    old = outcome.calibration
    new = changed(old, outcome.free, outcome.change)
    if outcome.scale == "baseline":
        new = redrawn(new, old.laser_plane)
    return replace(new, covariance=_uncertainty(outcome, new).table())


def _uncertainty(outcome: _Outcome, new: Calibration) -> Uncertainty:
    """Covariance of laser plane and mount; what was known of other parameters, and of the scale, stays."""
    known = uncertainty_of(outcome.calibration)
    mount = tuple(name for name in outcome.free if name.startswith(("offset", "tilt")))
    slope = np.vstack([plane_slope(new, outcome.free), *(
        np.eye(len(outcome.free))[[outcome.free.index(name)]] for name in mount)])  # fmt: skip
    own = slope @ outcome.covariance @ slope.T
    names = (*PLANE, *mount)
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
