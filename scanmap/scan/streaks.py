"""Points that hang in the air because a mirror turned the light away once, before or after the surface it fell on.

The camera's ray is right, and where it meets the surface is foretold: there the laser's plane as the mirror reflects
it cuts the ray; or the ray as the mirror reflects it cuts the laser's plane. A surface that other bearings measured
straight stands at that place, or it does not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanmap.scan.panorama import Panorama
from scanmap.scan.range_image import Scan
from scanmap.scan.second_lines import Pictures, turned

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_BEFORE_M = 0.05  # of a mirror, at least, is a surface that light falls on by it
_APART_M = 0.1  # a place nearer than this to a point is the point
_LEVEL, _FLAT_M = 0.97, 0.03  # cosine of what faces up or down; how flat a floor is
_LEAST_CELLS, _LEVEL_SHARE = 60, 0.05  # that face so, and share of them in one level
_GAP, _STEP_PX, _SHARE = (
    3,
    1.5,
    0.5,
)  # rows between cells of one run of the line, how it moves on in one row; see `_whole_runs`
_TOLERANCE, _MOST_M = (0.03, 0.01), 0.15  # of the place against the surface: constant [m], share of the range


def streaks(scan: Scan, pictures: Pictures, seen: Panorama, mirror: F64, hole: Mask) -> Mask:
    """The cells (B, H) of a scan that show light by way of one mirror where nothing is.

    Args:
        seen: the scan, thinned evenly.
        mirror: (4,) its plane, n toward the scanner.
        hole: (b, h) cells of the thinned scan in its direction.
    """
    found = np.zeros((len(scan), scan.rows), bool)
    column, row = np.nonzero(scan.valid)
    turn = scan.bearings[column]
    # Everything as if at bearing 0: there camera and laser stand still and the mirror turns.
    eye, sheet = pictures.T_axis_camera[:3, 3], pictures.laser_plane[:3]
    source = -pictures.laser_plane[3] * sheet
    normal = turned(np.broadcast_to(mirror[:3], (len(turn), 3)), -turn)
    way = turned(scan.points[column, row].astype(np.float64), -turn) - eye
    among = seen.valid & ~hole
    # Both go on where they are too steep to be in view; an upright mirror shows them at their own height.
    levels = [level for level in (level_of(seen, 1.0), level_of(seen, -1.0)) if level is not None]
    with np.errstate(divide="ignore", invalid="ignore"):
        for place, cross in (
            _laser_turned(eye, way, sheet, source, normal, mirror[3]),
            camera_turned(eye, way, sheet, source, normal, mirror[3]),
        ):
            height = np.einsum("ij,ij->i", place, normal) + mirror[3]
            k = np.flatnonzero((height > _BEFORE_M) & (np.linalg.norm(place - way - eye, axis=1) > _APART_M))
            k = k[pictures.within(scan, turned(cross[k], turn[k]), hole)]
            tolerance = np.minimum(_TOLERANCE[0] + _TOLERANCE[1] * np.linalg.norm(place[k], axis=1), _MOST_M)
            on = seen.images(turned(place[k], turn[k]), tolerance, among)[0]
            for level in levels:
                on |= np.abs(place[k, 2] - level) < tolerance
            found[column[k[on]], row[k[on]]] = True
    return _whole_runs(scan, found)


def level_of(seen: Panorama, facing: float) -> float | None:
    """Height [m] of the floor (`facing` 1) or the ceiling (-1); None where too little faces so."""
    z = seen.points[facing * np.nan_to_num(seen.normals[..., 2]) > _LEVEL, 2]
    if len(z) < _LEAST_CELLS:
        return None
    count, edge = np.histogram(z, np.arange(z.min() - _FLAT_M, z.max() + 2.0 * _FLAT_M, _FLAT_M))
    # Tables and shelves lie between.
    many = edge[np.flatnonzero(count >= _LEVEL_SHARE * len(z))] + 0.5 * _FLAT_M
    middle = (many if len(many) else edge)[0 if facing > 0 else -1]
    return float(np.median(z[np.abs(z - middle) < _FLAT_M]))


def _whole_runs(scan: Scan, some: Mask) -> Mask:
    """The runs of a line, from row to row, of which most cells (B, H) are among `some`."""
    column, row = np.nonzero(scan.valid)
    u = scan.column_px[column, row]
    starts = np.ones(len(row), bool)
    starts[1:] = (np.diff(column) != 0) | (np.diff(row) > _GAP) | (np.abs(np.diff(u)) > _STEP_PX * np.diff(row))
    run = np.cumsum(starts) - 1
    share = np.bincount(run, some[column, row]) / np.maximum(np.bincount(run), 1)
    found = np.zeros_like(some)
    found[column, row] = share[run] >= _SHARE
    return found


def _laser_turned(eye: F64, way: F64, sheet: F64, source: F64, normal: F64, d: float) -> tuple[F64, F64]:
    """Where (N, 3) camera rays meet the laser's plane after the mirror, and where the light left the mirror."""
    laser = source - 2.0 * (normal @ source + d)[:, None] * normal
    plane = sheet - 2.0 * (normal @ sheet)[:, None] * normal
    along = np.einsum("ij,ij->i", plane, laser - eye) / np.einsum("ij,ij->i", plane, way)
    place = eye + np.where(along > 0, along, np.nan)[:, None] * way
    light = place - laser
    part = (normal @ source + d) / np.einsum("ij,ij->i", light, normal)
    return place, laser + np.where((part > 0) & (part < 1), part, np.nan)[:, None] * light


def camera_turned(eye: F64, way: F64, sheet: F64, source: F64, normal: F64, d: float) -> tuple[F64, F64]:
    """Where (N, 3) camera rays after the mirror meet the laser's plane, and where they meet the mirror."""
    before = -(normal @ eye + d) / np.einsum("ij,ij->i", normal, way)
    cross = eye + np.where(before > 0, before, np.nan)[:, None] * way
    onward = way - 2.0 * np.einsum("ij,ij->i", way, normal)[:, None] * normal
    along = ((source - cross) @ sheet) / (onward @ sheet)
    return cross + np.where(along > 0, along, np.nan)[:, None] * onward, cross
