"""What is true of the twin's room: the surface, what could be measured of it, its walls, its outline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanmap.calibration import Calibration
from scanmap.geometry import transform
from scanmap.twin.laser import LaserFan, LaserParams
from scanmap.twin.room import Wall
from scanmap.twin.scene import Scene

F64 = NDArray[np.float64]

CHUNK = 500_000  # points per query, which bounds the memory of a large cloud
REACH_M = 0.05  # a truth point is complete with a measured point this near
SLICE_STEP_M = 0.02


class LitPoints(NamedTuple):
    """Surface points that the laser lights and the camera sees: one per bearing, image row and thing."""

    points: F64  # (N, 3) world [m]
    bearing_index: NDArray[np.int64]  # (N,)
    row: NDArray[np.int64]  # (N,) image row
    thing: NDArray[np.int64]  # (N,) index into the room's things


class TruthReport(NamedTuple):
    """A measured cloud against the truth."""

    points: int  # finite points compared
    median_m: float  # unsigned distance to the surface; NaN without points
    p95_m: float
    within_1cm: float  # fraction of the points
    beyond_10cm: float  # fraction of the points: gross errors
    completeness: float  # fraction of the lit and seen points with a measured point within 5 cm


class Truth:
    """Truth of one scene seen by one head."""

    def __init__(self, scene: Scene, calibration: Calibration, laser: LaserParams) -> None:
        self._scene, self._mount = scene, calibration.mount
        self._fan = LaserFan(scene, calibration, laser, 0.0)
        self._height = calibration.intrinsics.height
        self._width = calibration.intrinsics.width

    @property
    def walls(self) -> tuple[Wall, ...]:
        """Boundary planes of the room, floor and ceiling among them; empty for rooms from files."""
        return self._scene.room.walls

    @property
    def footprint(self) -> F64 | None:
        """Corners (N, 2) of the floor plan in the world [m], or None for rooms from files."""
        return self._scene.room.footprint

    @property
    def area_m2(self) -> float:
        """Area of the floor plan [m^2]; NaN for rooms from files."""
        return self._scene.room.area_m2

    def distance(self, points: ArrayLike) -> F64:
        """Unsigned distance (N,) [m] of world points (N, 3) to the surface."""
        query = np.asarray(points, np.float64).reshape(-1, 3)
        parts = [self._scene.rays.distance(query[k : k + CHUNK]) for k in range(0, len(query), CHUNK)]
        return np.concatenate(parts).astype(np.float64) if parts else np.empty(0)

    def lit_and_seen(self, bearings: Sequence[float] | F64) -> LitPoints:
        """What a perfect scanner would measure at `bearings` [rad]; things no line scanner measures left out."""
        measurable = np.array([thing.measurable for thing in self._scene.room.things])
        found = []
        for k, bearing in enumerate(bearings):
            line = self._fan.trace(float(bearing))
            column, row = line.pixel.T
            with np.errstate(invalid="ignore"):
                inside = (np.abs(column - 0.5 * (self._width - 1)) < 0.5 * self._width) & (row > -0.5)
                inside &= row < self._height - 0.5
            at = np.flatnonzero(line.seen & inside & measurable[line.thing])
            rows = np.rint(row[at]).astype(np.int64)
            _, first = np.unique(rows * len(measurable) + line.thing[at], return_index=True)
            at, rows = at[first], rows[first]
            world = transform(self._mount.T_world_head(float(bearing)), line.points[at])
            found.append((world, np.full(len(at), k), rows, line.thing[at]))
        if not found:
            return LitPoints(np.empty((0, 3)), *(np.empty(0, np.int64) for _ in range(3)))
        return LitPoints(*(np.concatenate(parts) for parts in zip(*found, strict=True)))

    def compare(self, points: ArrayLike, bearings: Sequence[float] | F64) -> TruthReport:
        """A cloud (N, 3) in the world frame, measured at `bearings` [rad], against the truth; NaN rows are skipped."""
        from scipy.spatial import cKDTree

        cloud = np.asarray(points, np.float64).reshape(-1, 3)
        cloud = cloud[np.isfinite(cloud).all(axis=1)]
        lit = self.lit_and_seen(bearings)
        if not len(cloud):
            return TruthReport(0, np.nan, np.nan, np.nan, np.nan, 0.0 if len(lit.points) else np.nan)
        error = self.distance(cloud)
        near, _ = cKDTree(cloud).query(lit.points, distance_upper_bound=REACH_M)
        return TruthReport(
            points=len(cloud),
            median_m=float(np.median(error)),
            p95_m=float(np.percentile(error, 95)),
            within_1cm=float((error <= 0.01).mean()),
            beyond_10cm=float((error > 0.10).mean()),
            completeness=float(np.isfinite(near).mean()) if len(near) else float("nan"),
        )

    def outline(self, low_m: float, high_m: float) -> F64:
        """Where surfaces stand between two heights: segments (N, 2, 2) on the floor plane [m].

        The heights are world z: 0 is the laser, the floor minus the scanner's height. The mesh is cut
        every 2 cm; thinner plates between two cuts are missed.
        """
        levels = np.linspace(low_m, high_m, max(2, int(np.ceil((high_m - low_m) / SLICE_STEP_M)) + 1))
        corners = self._scene.rays.vertices[self._scene.rays.triangles]
        return np.concatenate([_cut(corners, float(level)) for level in levels])

    def occupancy(
        self, low_m: float, high_m: float, origin: tuple[float, float], resolution_m: float, shape: tuple[int, int]
    ) -> NDArray[np.bool_]:
        """Cells (rows, columns) that the outline between two heights touches.

        Cell (i, j) covers x from origin[0] + j resolution, y from origin[1] + i resolution: row 0 is at the
        lowest y, as in a ROS OccupancyGrid.
        """
        segments = self.outline(low_m, high_m)
        start, way = segments[:, 0], segments[:, 1] - segments[:, 0]
        steps = np.ceil(np.linalg.norm(way, axis=1) / (0.25 * resolution_m)).astype(np.int64) + 1
        k = np.repeat(np.arange(len(segments)), steps)
        part = (np.arange(len(k)) - np.repeat(np.cumsum(steps) - steps, steps)) / np.maximum(steps[k] - 1, 1)
        cell = np.floor((start[k] + part[:, None] * way[k] - np.asarray(origin)) / resolution_m).astype(np.int64)
        inside = (cell >= 0).all(axis=1) & (cell[:, 1] < shape[0]) & (cell[:, 0] < shape[1])
        touched = np.zeros(shape, bool)
        touched[cell[inside, 1], cell[inside, 0]] = True
        return touched


def _cut(corners: F64, level: float) -> F64:
    """Segments (K, 2, 2) in which triangles (M, 3, 3) meet the plane z = level."""
    above = corners[:, :, 2] > level
    crossing = corners[above.any(axis=1) & ~above.all(axis=1)]
    side = crossing[:, :, 2] > level
    # The corner that stands alone on its side: both edges from it are cut.
    alone = np.where(side.sum(axis=1) == 1, side.argmax(axis=1), side.argmin(axis=1))
    row = np.arange(len(crossing))
    apex = crossing[row, alone]
    ends = []
    for step in (1, 2):
        other = crossing[row, (alone + step) % 3]
        part = (level - apex[:, 2]) / (other[:, 2] - apex[:, 2])
        ends.append(apex[:, :2] + part[:, None] * (other[:, :2] - apex[:, :2]))
    return np.stack(ends, axis=1)
