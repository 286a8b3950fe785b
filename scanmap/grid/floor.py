"""Find the floor in a scan and level the scan on it."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.geometry import rigid
from scanmap.scan import Scan

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# A surface climbing less than this between two rows of a bearing is taken for horizontal.
_HORIZONTAL_SLOPE = np.tan(np.radians(15.0))
# Fewer candidates than this on the best plane, and there is no floor in view.
_MIN_SUPPORT = 40
# A surface with this share of all points more than that far below it is a table, not the floor.
_MAX_BELOW, _CLEARLY_BELOW_M = 0.03, 0.1
# How far a scanner put up by hand leans [rad]: it decides where the view alone cannot tell, as with one bearing.
_LEAN = np.radians(2.0)
# Points of one bearing share their errors: so many tell as much as one would, unless their scatter tells better.
_SHARED = 100.0
# From so uncertain a tilt on, the view does not tell a floor from a table in front of it [deg].
_UNTOLD_TILT_DEG = 1.0


class Floor(NamedTuple):
    """The floor of a scan, and how it was found."""

    plane: Array  # (4,) n.x + d = 0 in the world frame [m], n up: n.p + d is the height of p above the floor
    sigma_m: float  # rms distance of its points from the plane; NaN where it was not fitted
    points: int  # how many points (of a thinned scan) it stands on
    how: Literal["fitted", "given", "lowest"]
    height_sigma_m: float = np.nan  # of the laser's height above it; NaN where it was not fitted
    tilt_sigma_deg: float = np.nan  # of its tilt, where that is known least

    @property
    def laser_height_m(self) -> float:
        """Height of the world's origin, the laser, above the floor [m]."""
        return float(self.plane[3])

    @property
    def tilt_deg(self) -> float:
        """Angle between the rotation axis and the floor's normal [deg]."""
        return float(np.degrees(np.arccos(np.clip(self.plane[2], -1.0, 1.0))))

    @property
    def T_level_world(self) -> Array:
        """(4, 4) world frame to the level frame: same vertical through the origin, z = height above the floor.

        The smallest rotation that brings the floor's normal to z (Rodrigues).
        """
        nx, ny, nz = self.plane[:3]
        v = np.array([ny, -nx, 0.0])  # n x z
        K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
        return rigid(np.eye(3) + K + K @ K / (1.0 + nz), [0.0, 0.0, self.plane[3]])

    @property
    def words(self) -> str:
        """How the floor was found, as a summary prints it."""
        place = f"{self.laser_height_m:.3f} m below the laser"
        if self.how == "fitted":
            sure = f"sure to {1e3 * self.height_sigma_m:.1f} mm and {self.tilt_sigma_deg:.2f} deg"
            words = f"floor {place}, tilted {self.tilt_deg:.2f} deg, rms {1e3 * self.sigma_m:.1f} mm, {sure}"
            if self.tilt_sigma_deg < _UNTOLD_TILT_DEG:
                return words
            return f"{words}: too little is in view to tell it from a table; set grid.laser_height_m if you know better"
        if self.how == "given":
            return f"too little floor in view: taken {place} as configured"
        return f"no floor in view: lowest points taken for it, {place}; set grid.laser_height_m if you know better"


def find_floor(scan: Scan, laser_height_m: float | None = None, max_tilt_deg: float = 8.0) -> Floor:
    """The floor plane of a scan, by a robust fit to low and nearly horizontal points.

    Candidates are points whose bearing runs on nearly level to the rows next to them. Over a grid of tilts
    the lowest strong layer of candidates is looked for (a table top has points below it, a floor has not);
    iteratively reweighted least squares with a weak prior on the tilt then refine it.

    Args:
        scan: points in the world frame.
        laser_height_m: where the floor is taken to be when none, or too little, is in view; None: at the lowest points.
        max_tilt_deg: largest tilt of the axis against the floor's normal that is looked for.
    """
    points, sigma, level, bearing = _candidates(scan)
    low = level & (points[:, 2] < -0.02)
    if low.sum() >= _MIN_SUPPORT:
        # Floor, table and shelf are parallel: the strongest layer tells the tilt, the lowest strong one is the floor.
        # But a leaning layer may be made of bits of several things, two tables for one: what explains most counts.
        tries = [
            _settled(points[low], sigma[low], bearing[low], np.radians(tilt), refined)
            for tilt in (max_tilt_deg, 0.0)
            for refined in (True, False)
        ]
        slope, inliers, rms, covariance = max(
            tries, key=lambda found: found[1] * (_share_below(points, found[0]) < _MAX_BELOW)
        )
        steep = np.hypot(slope[0], slope[1]) > np.tan(np.radians(max_tilt_deg + 1.0))
        above_others = _share_below(points, slope) >= _MAX_BELOW
        if inliers >= _MIN_SUPPORT and slope[2] < 0.0 and not steep and not above_others:
            tilt_sigma = float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])))
            # A height that is given tells more than a view that does not tell a floor from a table.
            if laser_height_m is None or tilt_sigma < _UNTOLD_TILT_DEG:
                return Floor(_plane(slope), rms, inliers, "fitted", float(np.sqrt(covariance[2, 2])), tilt_sigma)
    if laser_height_m is not None:
        return Floor(np.array([0.0, 0.0, 1.0, laser_height_m]), np.nan, 0, "given")
    lowest = float(np.percentile(points[:, 2], 0.1)) if len(points) else 0.0
    return Floor(np.array([0.0, 0.0, 1.0, -lowest]), np.nan, int((points[:, 2] <= lowest).sum()), "lowest")


def _share_below(points: Array, slope: Array) -> float:
    """Share of the points (N, 3) that lie clearly below a plane: of a floor none do but stray ones."""
    height = points[:, 2] - points[:, :2] @ slope[:2] - slope[2]
    return float((height < -_CLEARLY_BELOW_M).mean())


def _settled(
    points: Array, sigma: Array, bearing: Index, max_tilt: float, refined: bool
) -> tuple[Array, int, float, Array]:
    """The lowest strong layer parallel to the strongest one, as `_refine` has it.

    `refined`: the strongest layer's tilt is that of a plane fitted to it, else the coarse one it was found with.
    """
    seed = _strongest_layer(points, max_tilt)
    seed[2] = _lowest_layer(points, _refine(points, sigma, bearing, seed)[0] if refined else seed)
    return _refine(points, sigma, bearing, seed)


def _plane(slope: Array) -> Array:
    """z = a x + b y + c as n.x + d = 0 with n up."""
    plane = np.array([-slope[0], -slope[1], 1.0, -slope[2]])
    scaled: Array = plane / np.linalg.norm(plane[:3])
    return scaled


def _candidates(scan: Scan) -> tuple[Array, Array, NDArray[np.bool_], Index]:
    """Thinned points (N, 3), their sigma (N,), whether it is nearly level there, and their bearing (N,)."""
    across = max(1, len(scan) // 120)
    down = max(1, scan.rows // int(np.clip(18000 * across / max(len(scan), 1), 150, 600)))
    points = scan.points[::across, ::down].astype(np.float64)
    sigma = np.nan_to_num(scan.sigma_m[::across, ::down].astype(np.float64))
    origins = np.array([scan.mount.T_world_head(float(b))[:3, 3] for b in scan.bearings[::across]]).reshape(-1, 3)
    rho = np.hypot(*np.moveaxis(points[..., :2] - origins[:, None, :2], -1, 0))
    level = np.zeros(rho.shape, dtype=bool)
    # A short step says nothing about the slope where its ranges are noise: then a longer one is asked.
    for step in (1, 2, 4, 8):
        flat = _runs_level(points[..., 2], rho, sigma, step)
        level[:, step:-step] |= flat[:, step:] & flat[:, :-step]  # on both sides: the foot of a wall is not floor
    some = np.isfinite(points).all(axis=-1)
    return points[some], sigma[some], level[some], np.nonzero(some)[0]


def _runs_level(height: Array, rho: Array, sigma: Array, step: int) -> NDArray[np.bool_]:
    """Whether the surface from each row to the one `step` below is nearly horizontal, (B, rows - step)."""
    dz = height[:, step:] - height[:, :-step]
    dr = np.abs(rho[:, step:] - rho[:, :-step])
    flat: NDArray[np.bool_] = np.abs(dz) < _HORIZONTAL_SLOPE * dr
    return flat & (dr > 2.0 * np.maximum(sigma[:, step:], sigma[:, :-step]))


def _strongest_layer(points: Array, max_tilt: float) -> Array:
    """z = a x + b y + c (3,) of the layer of 10 cm that holds most points, over a grid of tilts."""
    points = points[:: max(1, len(points) // 3000)]
    best, seed = -np.inf, np.zeros(3)
    tilts = np.tan(np.linspace(-max_tilt, max_tilt, 9)) if max_tilt > 0 else np.zeros(1)
    for a in tilts:
        for b in tilts:
            count, bottom = _layers(points[:, 2] - a * points[:, 0] - b * points[:, 1], 0.05)
            k = int(count.argmax())
            score = count[k] * (1.0 - 0.15 * np.hypot(a, b))  # between equals level wins
            if score > best:
                best, seed = score, np.array([a, b, bottom + 0.05 * k])
    return seed


def _lowest_layer(points: Array, slope: Array) -> float:
    """Height at the origin of the lowest layer parallel to `slope` with 4 % of the strongest one's points."""
    count, bottom = _layers(points[:, 2] - points[:, :2] @ slope[:2], 0.03)
    k = int((count >= max(0.04 * float(count.max()), _MIN_SUPPORT / 2)).argmax())
    # The layer's strongest place, not its lower edge.
    return bottom + 0.03 * (k + int(count[k : k + 3].argmax()))


def _layers(height: Array, thick: float) -> tuple[NDArray[np.intp], float]:
    """Points within `thick` of each of a row of heights that far apart, and the first of these heights."""
    bottom = float(height.min())
    count = np.bincount(((height - bottom) / thick).astype(np.intp))
    return np.convolve(count, [1, 1]), bottom


def _refine(points: Array, sigma: Array, bearing: Index, slope: Array) -> tuple[Array, int, float, Array]:
    """Least squares over ever closer points: slope (3,), number of inliers, their rms [m], covariance (3, 3)."""
    A = np.column_stack([points[:, :2], np.ones(len(points))])
    inlier, shared = np.zeros(len(points), dtype=bool), _SHARED
    residual: NDArray[Any] = points[:, 2] - A @ slope
    covariance = np.diag([_LEAN**2, _LEAN**2, 1.0])
    for gate in (0.15, 0.08, 0.05, 0.03, 0.015, 0.015):
        # Height follows the ray's error by less than one; sigma as it is makes a generous gate.
        inlier = np.abs(residual) < np.maximum(gate, 3.0 * np.minimum(sigma, 0.03))
        if inlier.sum() < 3:
            break
        weight = inlier / (sigma**2 + 0.003**2)
        normal = A.T @ (A * weight[:, None])
        normal[[0, 1], [0, 1]] += shared / _LEAN**2
        slope = np.linalg.solve(normal, A.T @ (weight * points[:, 2]))
        residual = points[:, 2] - A @ slope
        covariance = _covariance(A * weight[:, None], A, residual, bearing, normal)
        shared = _shared(A * weight[:, None], A, residual, bearing)
    count = int(inlier.sum())
    rms = float(np.sqrt(np.mean(residual[inlier] ** 2))) if count else np.nan
    return slope, count, rms, covariance


def _shared(weighted: Array, A: Array, residual: Array, bearing: Index) -> float:
    """How many points tell the slope as one would: the scatter of whole bearings over what single points foretell."""
    if len(np.unique(bearing[weighted[:, 2] > 0])) <= 3:
        return _SHARED
    scatter = [float((np.bincount(bearing, weighted[:, k] * residual) ** 2).sum()) for k in range(2)]
    foretold = np.einsum("ij,ij->j", weighted, A)[:2]
    return float(np.clip((scatter / np.maximum(foretold, 1e-12)).max(), 1.0, _SHARED))


def _covariance(weighted: Array, A: Array, residual: Array, bearing: Index, normal: Array) -> Array:
    """Covariance (3, 3) of a fit whose points (N,) share errors along a bearing: cluster-robust (Liang, Zeger 1986).

    What the prior on the tilt holds back counts too, as large as a scanner leans.

    Args:
        weighted: (N, 3) rows of `A` times their weight.
        normal: of the fit, with its prior.
    """
    inverse, data = np.linalg.inv(normal), A.T @ weighted
    scores = np.stack([np.bincount(bearing, weighted[:, k] * residual) for k in range(3)], axis=1)
    bearings = len(np.unique(bearing[weighted[:, 2] > 0]))
    # As many bearings as unknowns scatter about nothing.
    scatter = scores.T @ scores * bearings / (bearings - 3) if bearings > 3 else _SHARED * data
    prior = (normal - data)[:, :2]
    if bearings > 3:  # what single points foretell, by how far they lie off
        data = data * float((weighted[:, 2] * residual**2).sum() / np.count_nonzero(weighted[:, 2]))
    covariance: Array = inverse @ (data + scatter + _LEAN**2 * prior @ prior.T) @ inverse
    return covariance
