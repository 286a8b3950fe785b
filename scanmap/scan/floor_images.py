"""Points below a floor that shines: the line on a wall, seen once more in the polished floor before it.

Where that shows, the camera's ray is right, and where it meets the surface is foretold: the ray as the floor reflects
it cuts the laser's plane on a wall that the scan measured. It is dim: what a floor reflects at less than 80 degrees is
less than half (Fresnel). A wall that goes on below the floor, of stairs or a gallery, is as bright as it is above.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.scan.panorama import Panorama
from scanmap.scan.range_image import Scan
from scanmap.scan.second_lines import Pictures, turned
from scanmap.scan.streaks import camera_turned

F64 = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_BELOW_M, _SIGMAS = 0.08, 4.0  # so far below the floor a point is not the floor's own
_TOLERANCE, _MOST_M = (0.03, 0.01), 0.15  # of the place against a surface: constant [m], share of the range
_SHARE = 0.5  # of a bearing's points below the floor that must meet a surface
_DIM = 0.6  # of the light that upright things there return, at most
_AS_FAR, _LEAST_CELLS = 0.2, 5  # share of the range by which such things are nearer or farther; so many tell
_FLOOR_M, _CELL_M = 0.03, 0.1  # how flat the floor is; cells it is asked in
_AROUND_M = 0.6  # so near where the ray meets it, the floor must have been measured


def floor_images(scan: Scan, pictures: Pictures, seen: Panorama, floor: float, walls: Sequence[F64]) -> Mask:
    """The cells (B, H) of a scan that show images in its floor.

    Args:
        seen: the scan, thinned evenly.
        floor: its height [m].
        walls: (4,) planes of walls, which go on where nothing of them was measured.
    """
    found = np.zeros((len(scan), scan.rows), bool)
    with np.errstate(invalid="ignore"):
        below = scan.valid & (scan.points[..., 2] < floor - np.maximum(_BELOW_M, _SIGMAS * scan.sigma_m))
    column, row = below.nonzero()
    if not column.size:
        return found
    eye, sheet, turn = pictures.T_axis_camera[:3, 3], pictures.laser_plane[:3], scan.bearings[column]
    up = turned(np.broadcast_to([0.0, 0.0, 1.0], (len(turn), 3)), -turn)
    way = turned(scan.points[column, row].astype(np.float64), -turn) - eye
    with np.errstate(divide="ignore", invalid="ignore"):
        lit = camera_turned(eye, way, sheet, -pictures.laser_plane[3] * sheet, up, -floor)
    some = np.flatnonzero(np.isfinite(np.hstack(lit)).all(axis=1))
    column, row, turn = column[some], row[some], turn[some]
    place, cross = (turned(points[some], turn) for points in lit)
    tolerance = np.minimum(_TOLERANCE[0] + _TOLERANCE[1] * np.linalg.norm(place, axis=1), _MOST_M)
    met = seen.images(place, tolerance, seen.valid)[0]
    for wall in walls:
        met |= np.abs(place @ wall[:3] + wall[3]) < tolerance
    met &= _near(cross, seen.points[seen.valid & (np.abs(seen.points[..., 2] - floor) < _FLOOR_M)])
    for k in np.unique(column):
        own = column == k
        if met[own].mean() >= _SHARE and _dim(scan, k, row[own], place[own], floor):
            found[k, row[own]] = True
    return found


def _dim(scan: Scan, k: int, rows: Index, place: F64, floor: float) -> bool:
    """Whether the k-th bearing has less light from places (N, 3), in cells `rows` (N,), than from what stands there."""
    # As far as the image is, which lies beside the laser's plane where that leans.
    image = place * [1.0, 1.0, -1.0] + [0.0, 0.0, 2.0 * floor]
    light = scan.intensity[k, rows] * np.square(image).sum(axis=1)
    away = float(np.median(np.hypot(place[:, 0], place[:, 1])))
    points = scan.points[k].astype(np.float64)
    with np.errstate(invalid="ignore"):
        upright = scan.valid[k] & (points[:, 2] > floor + _BELOW_M)
        upright &= np.abs(np.hypot(points[:, 0], points[:, 1]) - away) < _AS_FAR * away
    if upright.sum() < _LEAST_CELLS:
        return False
    usual = scan.intensity[k, upright] * np.square(points[upright]).sum(axis=1)
    return bool(np.median(light) < _DIM * np.median(usual))


def _near(points: F64, floor: F64) -> Mask:
    """Whether measured points (M, 3) of the floor are near each of `points` (N, 3) on it."""
    if not (len(floor) and len(points)):
        return np.zeros(len(points), bool)
    cell = np.floor(np.concatenate([floor, points])[:, :2] / _CELL_M).astype(np.intp)
    cell -= cell.min(axis=0)
    measured = np.zeros(cell.max(axis=0) + 1, np.uint8)
    measured[*cell[: len(floor)].T] = 1
    reach = 2 * round(_AROUND_M / _CELL_M) + 1
    around = cv2.dilate(measured, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    return np.asarray(around[*cell[len(floor) :].T] > 0)
