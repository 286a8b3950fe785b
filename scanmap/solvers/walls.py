"""Flat pieces of a scan measured as walls: how rough, how bowed, and how much of either was promised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from scanmap.calibration import Calibration
from scanmap.calibration.uncertainty import moved, uncertainty_of
from scanmap.solvers.budget import deviations
from scanmap.solvers.flat_segments import Segments, beside, fitted_plane, steepness
from scanmap.solvers.sight import Patches, Sight, located, places_of, sight_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# How many standard deviations a measured value may be from what was promised.
DEVIATIONS = 3.0
# The coefficient of a parabola over [-1, 1], of n even samples with unit noise, has this deviation times 1 / sqrt(n).
PARABOLA = float(np.sqrt(45.0 / 4.0))


class CheckParams(BaseModel, frozen=True, extra="forbid"):
    """What a check asks of a scan."""

    tolerance_px: float = Field(
        3.0, gt=0, le=30, description="how bent a wall may be and still be one, where self-calibration cannot help [px]"
    )
    line_error_px: float = Field(
        0.03, gt=0, le=2, description="error that all rows of a shot share, beside their noise [px]"
    )
    wall_mm_per_m: float = Field(0.5, ge=0, le=20, description="how flat walls themselves are [mm per m of length]")
    smallest_share: float = Field(0.02, gt=0, lt=1, description="a wall has at least this share of all flat patches")
    corner_deg: float = Field(0.5, gt=0, le=10, description="how far from square a room's corners may be [deg]")
    square: bool = Field(True, description="whether the room's corners are square at all")


@dataclass(frozen=True)
class Wall:
    """One flat piece, measured."""

    plane: Array  # (4,) world frame
    places: int  # different ones in the picture: a line that stands still says the same again
    bearings: int
    length_m: float
    range_m: float  # median
    rms_m: float
    rms_limit_m: float
    bow_m: float  # height of the arc along its length; positive if its ends come toward the scanner
    bow_limit_m: float

    @property
    def strain(self) -> float:
        """The worse of rms and bow in units of its limit; above 1 the wall is not as flat as promised."""
        return max(self.rms_m / self.rms_limit_m, abs(self.bow_m) / self.bow_limit_m)


def walls_under(
    calibration: Calibration,
    patches: Patches,
    segments: Segments,
    chosen: list[int],
    allowed: tuple[float, CheckParams],
) -> tuple[tuple[Wall, ...], Array]:
    """Flat pieces as they come out under a calibration, whichever they were found with.

    Args:
        chosen: numbers of the pieces.
        allowed: error that a shot's rows share [px], and the check's parameters.

    Returns:
        A `Wall` each, and columns (B, R) that patches lie beside their own wall's plane, NaN off the walls.
    """
    sight = sight_of(patches, calibration.intrinsics)
    points, per_column = located(sight, calibration)
    spread = _Spread.of(calibration, sight)
    off = np.full(points.shape[:2], np.nan)
    walls = []
    for k in chosen:
        member = (segments.label == k) & np.isfinite(points[..., 0])
        plane = fitted_plane(points[member], per_column[member], segments.planes[k, :3])
        plane *= np.sign(plane[3]) or 1.0  # the normal toward the axis
        off[member] = beside(points[member], per_column[member], plane)
        walls.append(_wall(points[member], per_column[member], plane, patches, member, spread, allowed))
    return tuple(walls), off


@dataclass(frozen=True)
class _Spread:
    """How the calibration's covariance moves every patch: world displacements by one deviation of each direction."""

    displacement: Array  # (D, B, R, 3) [m]

    @classmethod
    def of(cls, calibration: Calibration, sight: Sight) -> _Spread:
        known = uncertainty_of(calibration)
        if known is None:
            return cls(np.zeros((0, *sight.ray.shape)))
        here, _ = located(sight, calibration)
        # The intrinsics change the rays themselves, which here are fixed: only plane and mount can be moved.
        names = tuple(n for n in known.names if n.startswith(("plane", "offset", "tilt")))
        if not names:
            return cls(np.zeros((0, *sight.ray.shape)))
        part = known.without(tuple(n for n in known.names if n not in names))
        steps = deviations(part)
        return cls(np.stack([located(sight, moved(calibration, part.names, step))[0] - here for step in steps]))

    def along(self, member: Mask, normal: Array) -> Array:
        """(D, N) displacement of the members along a normal [m]."""
        along: Array = np.nan_to_num(self.displacement[:, member] @ normal)
        return along


def _wall(
    points: Array,
    per_column: Array,
    plane: Array,
    patches: Patches,
    member: Mask,
    spread: _Spread,
    allowed: tuple[float, CheckParams],
) -> Wall:
    noise_px, params = allowed
    normal = plane[:3]
    height = points @ normal + plane[3]
    per_px = np.abs(steepness(per_column, normal))
    along = _longest(points, normal)
    length = float(np.ptp(np.percentile(along, [1.0, 99.0])))
    own_m = 1e-3 * params.wall_mm_per_m * length
    moved_by = spread.along(member, normal)
    line = np.hypot(patches.sigma_px[member], noise_px) * per_px
    bearings = int(np.count_nonzero(member.any(axis=1)))
    bow = _bow(along, height, per_px)
    tilted = [_without_plane(points, part, normal) for part in moved_by]
    rms_limit = np.sqrt(np.median(line**2) + sum(float(np.mean(part**2)) for part in tilted))
    bow_limit = np.sqrt(
        (PARABOLA * noise_px * float(np.median(per_px))) ** 2 / bearings
        + sum(_bow(along, part, per_px) ** 2 for part in moved_by)
    )
    inside = np.abs(height) <= 4.0 * 1.4826 * np.median(np.abs(height))
    return Wall(
        plane=plane,
        places=len(np.unique(places_of(patches)[member])),
        bearings=bearings,
        length_m=length,
        range_m=float(np.median(np.linalg.norm(points, axis=1))),
        rms_m=float(np.sqrt(np.mean(height[inside] ** 2))),
        rms_limit_m=float(np.hypot(DEVIATIONS * rms_limit, own_m)),
        bow_m=bow,
        bow_limit_m=float(np.hypot(DEVIATIONS * bow_limit, own_m)),
    )


def _longest(points: Array, normal: Array) -> Array:
    """Coordinate (N,) of points along the direction in their plane in which they reach farthest [m]."""
    q = points - points.mean(axis=0)
    q = q - (q @ normal)[:, None] * normal
    direction = np.linalg.eigh(q.T @ q)[1][:, 2]
    along: Array = q @ direction
    return along


def _bow(along: Array, height: Array, per_px: Array) -> float:
    """Height [m] of the arc that a parabola through (along, height) makes over the wall's length, Cauchy-weighted."""
    half = 0.5 * float(np.ptp(np.percentile(along, [1.0, 99.0]))) or 1.0
    s = (along - np.median(along)) / half
    A = np.stack([np.ones_like(s), s, s * s], axis=1)
    weight = 1.0 / per_px
    for _ in range(4):
        coefficients = np.linalg.lstsq(A * weight[:, None], height * weight, rcond=None)[0]
        left = (height - A @ coefficients) / per_px
        scatter = max(1.4826 * float(np.median(np.abs(left))), 1e-6)
        weight = 1.0 / per_px / np.sqrt(1.0 + (left / (2.0 * scatter)) ** 2)
    return float(coefficients[2])


def _without_plane(points: Array, height: Array, normal: Array) -> Array:
    """Heights (N,) less the plane through them: what of a displacement is no shift and no turn."""
    A = np.column_stack([np.ones(len(points)), points - (points @ normal)[:, None] * normal])
    left: Array = height - A @ np.linalg.lstsq(A, height, rcond=None)[0]
    return left
