"""Points seen in mirrors: the room behind a wall that is the image of the room before it.

A laser plane that a plane mirror turns away, seen through the same mirror, is measured without any error where the
mirror's image of the room is: behind the mirror's plane, in one piece over the bearings. Colour, width and range are
those of a line. Three things tell it from a room behind an opening, and all three must speak:

- The opening is cut sharply. Through a door the floor runs on, and the reveal of a wall shows its thickness; beside a
  mirror the range jumps from the frame straight into the image.
- Reflected at the plane, the points lie on surfaces that the scan measured in front. Floor and ceiling say nothing:
  they lie on themselves for every upright plane.
- Nothing denies it: no point hangs in the air once reflected, where the scan looked through, and nothing of the room is
  missing where the mirror must show it.

What the scan did not see, behind furniture or in the half that was not swept, says nothing either way.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import Reason
from scanmap.scan.openings import BEHIND_M, openings, walls
from scanmap.scan.panorama import Panorama
from scanmap.scan.range_image import Scan, ScanParams

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_COLUMNS, _ROWS = 240, 300  # the range image is thinned to about this before anything is looked for
_OFF_AXIS_M = 0.2  # a head farther from the axis than this sees a turntable, not a room
_OFFSETS_M = (0.0, 0.01, -0.01, 0.02, -0.02, 0.03, 0.04)  # of the mirror before its wall
_PATCH_M = 0.15  # what lies in one cube of this size counts once
_PATCHES = 20  # of upright surfaces, that must agree
_SUPPORT = 0.15  # of all patches of an opening; where most reflects to what was not swept, a few prove nothing
_AGREE = 0.97  # share of those that agree or deny, that must agree
_NARROW_M = 0.2  # a surface is wide where the points at the bearings beside are no more than this nearer or farther


class Mirror(NamedTuple):
    """A mirror, and what was seen in it."""

    plane: F64  # (4,) n.x + d = 0 in the world frame [m], n toward the scanner
    cells: Mask  # (B, H) of the scan: points that are images
    agree: int  # patches of upright surfaces on which an image lies
    deny: int  # patches in which an image hangs in the air


def without_mirrors(scan: Scan, params: ScanParams | None = None) -> Scan:
    """A copy without the points seen in mirrors (`Reason.MIRROR`); the scan itself where there are none.

    Args:
        scan: bearings ascending, as `Scan.merged` leaves them.
    """
    found = find_mirrors(scan, params)
    if not found:
        return scan
    return scan.without(np.logical_or.reduce([mirror.cells for mirror in found]), Reason.MIRROR)


def find_mirrors(scan: Scan, params: ScanParams | None = None) -> list[Mirror]:
    """Upright mirrors on the walls of a scan whose bearings ascend, and the cells that show images in them."""
    every, each = max(1, len(scan) // _COLUMNS), max(1, scan.rows // _ROWS)
    thin = _thinned(scan, every, each)
    if min(len(thin), thin.rows) < 3 or not thin.valid.any() or np.hypot(*scan.mount.offset_m[:2]) > _OFF_AXIS_M:
        return []
    seen = Panorama(thin, params or ScanParams())
    found: list[Mirror] = []
    for wall in walls(seen.points[seen.valid], np.nan_to_num(seen.normals[seen.valid])):
        for cells in openings(seen, wall):
            offset, agree, deny = _likeness(seen, cells, wall)
            support = _SUPPORT * len(np.unique(_patches(seen.points[cells])))
            if agree >= max(_PATCHES, support) and agree >= _AGREE * (agree + deny):
                seen.valid[cells] = False
                plane = wall - [0.0, 0.0, 0.0, offset]
                found.append(Mirror(plane, _behind(scan, wall, cells, every, each), agree, deny))
    return found


def _thinned(scan: Scan, every: int, each: int) -> Scan:
    names = ("points", "range_m", "sigma_m", "intensity", "column_px", "reason")
    fields = {name: getattr(scan, name)[::every, ::each] for name in names}
    return Scan.from_arrays(scan.mount, scan.bearings[::every], fields)


def _likeness(seen: Panorama, cells: Mask, wall: F64) -> tuple[float, int, int]:
    """Where before the wall a mirror would stand [m], and in how many patches its images agree and do not.

    Points of the hole must lie on the room, not hang in it; and of the room before the wall nothing that must be seen
    in the mirror may be missing there.
    """
    points, tolerance = seen.points[cells], seen.tolerance(cells)
    best, least = (0.0, 0, 0), -np.inf
    for offset in _OFFSETS_M:
        image = _reflected(points, wall, offset)
        on, upright, through = seen.images(image, tolerance, seen.valid)
        agreeing = len(np.unique(_patches(image[upright])))
        denying = len(np.setdiff1d(_patches(image[through]), _patches(image[on])))
        if agreeing - 2 * denying > least:
            best, least = (offset, agreeing, denying), agreeing - 2 * denying
    offset, agree, deny = best
    if not agree:
        return best
    # Between the bearings a narrow thing may be seen in one of two views only: it is not asked for.
    wide = np.zeros_like(cells)
    with np.errstate(invalid="ignore"):
        beside = np.abs(np.diff(seen.distance, axis=0)) < _NARROW_M
    wide[1:-1] = beside[1:] & beside[:-1]
    wide[:, 1::2] = False
    wide &= seen.points @ wall[:3] + wall[3] > BEHIND_M
    image = _reflected(seen.points[wide], wall, offset)
    _, upright, missing = seen.images(image, seen.tolerance(wide), cells)
    there = len(np.unique(_patches(image[upright])))
    return offset, agree + there, deny + len(np.unique(_patches(image[missing])))


def _reflected(points: F64, wall: F64, offset: float) -> F64:
    """Points (N, 3) reflected at the plane `offset` before a wall."""
    image: F64 = points - 2.0 * (points @ wall[:3] + wall[3] - offset)[:, None] * wall[:3]
    return image


def _patches(points: F64) -> NDArray[np.int64]:
    """Number (N,) of the cube of space that each point lies in."""
    number: NDArray[np.int64] = np.floor(points / _PATCH_M).astype(np.int64) @ np.array([1, 4096, 4096**2])
    return number


def _behind(scan: Scan, wall: F64, cells: Mask, every: int, each: int) -> Mask:
    """The cells (B, H) of the whole scan behind a wall, in the hole `cells` of the thinned one."""
    column = np.minimum(np.arange(len(scan)) // every, cells.shape[0] - 1)
    row = np.minimum(np.arange(scan.rows) // each, cells.shape[1] - 1)
    closed = cv2.morphologyEx(cells.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 7), np.uint8))
    # What was left out by thinning lies around.
    around = np.ones((3 if every > 1 else 1, 3), np.uint8)
    hole = cv2.dilate(closed, around).astype(bool)[column][:, row]
    with np.errstate(invalid="ignore"):
        behind = scan.points @ wall[:3].astype(np.float32) + np.float32(wall[3]) < -BEHIND_M - 3.0 * scan.sigma_m
    images: Mask = behind & hole
    return images
