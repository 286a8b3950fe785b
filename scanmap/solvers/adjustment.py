"""Least squares over a head's changes, with the planes of all flat pieces eliminated, and what its result is worth.

Variable projection (Golub and Pereyra 1973), residuals in image columns, Cauchy weights; a ruler's knowledge as prior,
or that of markers on a turntable.

What limits such a fit is not a patch's noise but what patches have in common: all that one shot shows of one piece is
off alike, by JPEG's blocks and the lens's glare, and comes again wherever the line stands in the same column. A shot's
patches on one piece therefore count about once (their weights say so), and the covariance is that of this weighting
under errors so shared (the sandwich of Huber 1967). Either way of sharing is counted in full, for planes fitted to such
errors hide some of them. What is seen again at the same place of the picture has all its error again, so a line that
stands still while the head turns, on a level floor or on something that does not turn, is one measurement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.solvers.flat_segments import Segments
from scanmap.solvers.freedom import Freedom
from scanmap.solvers.own_planes import Pieces, azimuth_influence, beside_own_planes, leans
from scanmap.solvers.sight import Patches, Sight, located, places_of
from scanmap.solvers.squareness import Upright

Array = NDArray[np.float64]
Index = NDArray[np.intp]

LARGEST_SOLVE = 15_000  # patches; more of one shot and wall say the same again
FEWEST_PATCHES = 15  # that a piece must have left
NOISE_FLOOR_PX = 0.003  # of what all patches of one shot on one wall may have in common
TYPICAL_SHOTS = 8  # shots on a piece from which on it tells its own noise
# Walls stand upright and floors lie level to each other by so much [rad]; asked of the largest pieces only.
PLUMB = np.radians(0.5)
UPRIGHT_WITHIN = np.radians(12.0)
LARGEST_PIECES = 12
SLOPE_STEP = 1e-5  # [rad] or [m]


@dataclass(frozen=True)
class Shared:
    """What patches have in common, and how large it is."""

    own_px: Array  # (N,) a patch's own noise
    shared_px: Array  # (N,) what it has in common with others
    place: Index  # (N,) where in the picture
    cluster: Index  # (N,) one shot on one piece
    column: Index  # (N,) where the line stands

    def spread(self, influence: Array) -> Array:
        """Covariance (P, P) of sums over patches of influence (N, P) times error."""
        whole = np.zeros((influence.shape[1], influence.shape[1]))
        for group, size in (
            (self.place, self.own_px), (self.cluster, self.shared_px), (self.column, self.shared_px),
        ):  # fmt: skip
            sums = _sums(group, influence * size[:, None])
            whole += sums.T @ sums
        return whole

    def spread_of_pieces(self, influence: Array, piece: Index) -> Array:
        """Variances (K,) of the same sums over the patches of each piece, influence (N,)."""
        whole = np.zeros(piece.max() + 1)
        for group, size in (
            (self.place, self.own_px), (self.cluster, self.shared_px), (self.column, self.shared_px),
        ):  # fmt: skip
            _, here = np.unique(piece * (group.max() + 1) + group, return_inverse=True)
            owner = np.zeros(here.max() + 1, np.intp)
            owner[here] = piece
            whole += np.bincount(owner, np.bincount(here, influence * size) ** 2, minlength=len(whole))
        return whole


@dataclass(frozen=True)
class Solution:
    """The best change of one round."""

    change: Array  # (P,)
    covariance: Array  # (P, P)
    weight: Array  # (N,) of the patches
    shared: Shared


@dataclass(frozen=True)
class Adjustment:
    """The patches of one round, sorted by the piece they lie on."""

    sight: Sight  # N patches
    column: Index  # (N,) where in the picture the line stands
    place: Index  # (N,) and in which row
    pieces: Pieces
    cluster: Index  # (N,) one shot on one piece
    walls: Index  # large pieces that stand upright
    floors: Index  # and that lie
    calibration: Calibration
    free: Freedom

    @classmethod
    def of(
        cls, sight: Sight, patches: Patches, segments: Segments, clear: NDArray[np.bool_], calibration: Calibration,
        free: Freedom,
    ) -> Adjustment:  # fmt: skip
        """Of what lies on flat pieces and is `clear` (B, R) of their edges."""
        label = segments.label.ravel()
        where = np.flatnonzero((label >= 0) & clear.ravel())
        where = where[:: max(1, len(where) // LARGEST_SOLVE)]
        many = np.bincount(label[where], minlength=len(segments)) >= FEWEST_PATCHES
        where = where[many[label[where]]]
        where = where[np.argsort(label[where], kind="stable")]
        numbers, piece = np.unique(label[where], return_inverse=True)
        _, cluster = np.unique(piece * segments.label.shape[0] + where // segments.label.shape[1], return_inverse=True)
        standing = places_of(patches).ravel()[where]
        _, column = np.unique(standing // segments.label.shape[1], return_inverse=True)
        _, place = np.unique(standing, return_inverse=True)
        pieces = Pieces(piece, np.searchsorted(piece, np.arange(len(numbers))), segments.planes[numbers, :3])
        large = np.argsort(-np.bincount(piece))[:LARGEST_PIECES]
        lean = np.abs(pieces.normals[large, 2])
        return cls(
            Sight(*(part.reshape(-1, *part.shape[2:])[where] for part in sight)), column, place, pieces, cluster,
            large[lean < np.sin(UPRIGHT_WITHIN)], large[lean > np.cos(UPRIGHT_WITHIN)], calibration, free,
        )  # fmt: skip

    def __len__(self) -> int:
        """Number of pieces K."""
        return len(self.pieces.first)

    def residual(self, change: Array, weight: Array) -> tuple[Array, Array]:
        """Columns (N,) beside the own planes fitted with `weight` (N,) [px], and leans (M,) in units of PLUMB."""
        off, normals = beside_own_planes(*self._located(change), weight, self.pieces)
        return off, leans(normals[self.walls], normals[self.floors]) / PLUMB

    def solve(self, change: Array, rounds: int) -> Solution:
        """The best change, reweighted so many times."""
        from scipy.optimize import least_squares

        weight = np.ones(len(self.cluster))
        again, together = (np.bincount(group)[group] for group in (self.place, self.cluster))
        for _ in range(rounds):
            off, lean = self.residual(change, weight)
            shared = self._shared(off)
            own = shared.own_px
            robust = 1.0 / (1.0 + (off / (2.0 * own)) ** 2)
            weight = robust / (again * own**2 + together * shared.shared_px**2)
            steady = 1.0 / np.sqrt(1.0 + (lean / 2.0) ** 2)

            def weighed(x: Array, weight: Array = weight, steady: Array = steady) -> Array:
                off, lean = self.residual(x, weight)
                return np.concatenate([off * np.sqrt(weight), lean * steady, (x - self.free.centre) / self.free.sigma])

            found = least_squares(weighed, change, x_scale=self.free.ruler, max_nfev=12, ftol=1e-6, xtol=1e-6)
            change = found.x
        count = len(self.cluster)
        bread = np.linalg.inv(found.jac.T @ found.jac)
        influence, rest = found.jac[:count] * np.sqrt(weight)[:, None], found.jac[count:]
        covariance = bread @ (shared.spread(influence) + rest.T @ rest) @ bread
        return Solution(change, covariance, weight, shared)

    def upright(self, solution: Solution) -> Upright:
        """Which way the upright pieces face, under the best head."""
        points, per_column = self._located(solution.change)
        normals = beside_own_planes(points, per_column, solution.weight, self.pieces)[1]
        which = np.flatnonzero(np.abs(normals[:, 2]) < np.sin(UPRIGHT_WITHIN))
        here = _azimuth(normals[which])
        slope = []
        for step in SLOPE_STEP * np.eye(len(self.free.names)):
            moved = beside_own_planes(*self._located(solution.change + step), solution.weight, self.pieces)[1]
            # A normal found the other way round turned by 180 deg.
            turned = _azimuth(moved[which]) - here
            slope.append((turned - np.pi * np.round(turned / np.pi)) / SLOPE_STEP)
        influence = azimuth_influence(points, per_column, solution.weight, self.pieces._replace(normals=normals))
        sigma = np.sqrt(solution.shared.spread_of_pieces(influence, self.pieces.piece))
        return Upright(here, np.stack(slope, axis=1), sigma[which])

    def _located(self, change: Array) -> tuple[Array, Array]:
        return located(self.sight, self.free.changed(self.calibration, change))

    def _shared(self, off: Array) -> Shared:
        """How much patches scatter, and how much of it those of one shot on one piece have in common.

        Of each piece, as far as it has shots to tell; what it lacks comes from the others.
        """
        piece, cluster = self.pieces.piece, self.cluster
        whole = 1.4826 * np.median(np.abs(off))
        scatter = np.array([1.4826 * np.median(np.abs(part)) for part in np.split(off, self.pieces.first[1:])])
        count = np.bincount(cluster)
        mean = np.bincount(cluster, off) / count
        owner = np.zeros(len(count), np.intp)
        owner[cluster] = piece
        several = count >= 5
        squares = (1.4826 * np.abs(mean[several])) ** 2
        typical = float(np.median(squares)) if several.any() else 0.0
        found = [squares[owner[several] == k] for k in range(len(self))]
        common = np.array([
            (len(s) * float(np.median(s) if len(s) else 0.0) + TYPICAL_SHOTS * typical) / (len(s) + TYPICAL_SHOTS)
            for s in found
        ])  # fmt: skip
        return Shared(
            np.maximum(scatter, max(0.3 * whole, NOISE_FLOOR_PX))[piece],
            np.sqrt(np.maximum(common, NOISE_FLOOR_PX**2))[piece], self.place, cluster, self.column,
        )  # fmt: skip


def _azimuth(normals: Array) -> Array:
    angle: Array = np.arctan2(normals[:, 1], normals[:, 0])
    return angle


def _sums(group: Index, values: Array) -> Array:
    """Sums (G, P) of values (N, P) over groups."""
    return np.stack([np.bincount(group, column) for column in values.T], axis=1)
