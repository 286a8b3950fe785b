"""Points seen in mirrors: the room behind a wall that is the image of the room before it.

A laser plane that a plane mirror turns away, seen through the same mirror, is measured without any error where the
mirror's image of the room is: behind the mirror's plane, in one piece over the bearings. Colour, width and range are
those of a line. Three things tell it from a room behind an opening:

- The opening is cut sharply. Through a door the floor runs on, and the reveal of a wall shows its thickness; beside a
  mirror the range jumps from the frame straight into the image.
- Reflected at the plane, the points lie on surfaces that the scan measured in front. Floor and ceiling say nothing:
  they lie on themselves for every upright plane.
- Nothing denies it: no point hangs in the air once reflected, where the scan looked through, and nothing of the room is
  missing where the mirror must show it.

What the scan did not see, behind furniture or in the half that was not swept, says nothing either way. Where nothing
compares, the cut alone is enough if upper and lower ends are seen all along: a wall is as thick as it is. And pictures
prove mirrors whose ends are out of view (`second_lines`). Mirrors that lean on a wall have planes of their own
(`leaning_mirrors`).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import Reason
from scanmap.scan.floor_images import floor_images
from scanmap.scan.leaning_mirrors import judged, leaning_mirror
from scanmap.scan.openings import BEHIND_M, Opening, openings, walls
from scanmap.scan.panorama import Panorama, patches
from scanmap.scan.range_image import Scan, ScanParams
from scanmap.scan.second_lines import Pictures, shown
from scanmap.scan.streaks import level_of, streaks

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_COLUMNS, _ROWS = 240, 300  # the range image is thinned to about this before anything is looked for
_OFF_AXIS_M = 0.2  # a head farther from the axis than this sees a turntable, not a room
_OFFSETS_M = (0.0, 0.01, -0.01, 0.02, -0.02, 0.03, 0.04)  # of the mirror before its wall
_PATCHES = 20  # cubes of upright surfaces, that must agree
_SUPPORT = 0.15  # of all patches of an opening; where most reflects to what was not swept, a few prove nothing
# Of mirrors that lean: share of an opening's patches that must agree; how many beyond one wall, in openings that are
# not cut and in those that are; share that may deny.
_MOST, _BEYOND, _AGAINST = 0.4, (22, 15), 0.1
_ASKED = 0.7  # share of an opening that was asked as that of another wall
_AGREE = 0.97  # share of those that agree or deny, that must agree
# Where no frame is seen all around, so many patches must agree beyond one wall; share of an opening's own patches that
# must agree where they do not, and where they do.
_SURPLUS, _SUPPORT_OWN = 5, (0.5, 0.25)
_MOSTLY, _LITTLE = 0.3, 0.1  # of a bearing's cells that hang in the air once reflected; that must tell
_HANGING = 0.1  # share of all cells that may hang, at most
_AS_HIGH = 0.6  # share of the cells of other bearings, where none tells
_TELLING = 0.2  # cosine of the angle between a surface that tells and the mirror
_AROUND = np.ones((3, 5), np.uint8)  # columns x rows by which a mirror may be larger than what is seen in it
_FEW = 0.02  # share of all patches that may deny where nothing compares
_NARROW_M = 0.2  # a surface is wide where the points at the bearings beside are no more than this nearer or farther


class Mirror(NamedTuple):
    """A mirror, and what was seen in it."""

    plane: F64  # (4,) n.x + d = 0 in the world frame [m], n toward the scanner
    cells: Mask  # (B, H) of the scan: points that are images
    agree: int  # patches of upright surfaces on which an image lies, or second lines in pictures, or cells in a floor
    deny: int  # patches or cells in which an image hangs in the air


def without_mirrors(scan: Scan, params: ScanParams | None = None, pictures: Pictures | None = None) -> Scan:
    """A copy without the points seen in mirrors (`Reason.MIRROR`); the scan itself where there are none.

    Args:
        scan: bearings ascending, as `Scan.merged` leaves them.
    """
    found = find_mirrors(scan, params, pictures)
    if not found:
        return scan
    return scan.without(np.logical_or.reduce([mirror.cells for mirror in found]), Reason.MIRROR)


def find_mirrors(scan: Scan, params: ScanParams | None = None, pictures: Pictures | None = None) -> list[Mirror]:
    """Mirrors on the walls of a scan whose bearings ascend, and its floor; with the cells that show images."""
    every, each = max(1, len(scan) // _COLUMNS), max(1, scan.rows // _ROWS)
    thin = _thinned(scan, every, each)
    if min(len(thin), thin.rows) < 3 or not thin.valid.any() or np.hypot(*scan.mount.offset_m[:2]) > _OFF_AXIS_M:
        return []
    seen = Panorama(thin, params or ScanParams())
    found, asked = list[Mirror](), np.zeros_like(seen.valid)
    planes = walls(seen.points[seen.valid], np.nan_to_num(seen.normals[seen.valid]))
    for wall in planes:
        for opening in openings(seen, wall):
            mirror = _likely(seen, opening, wall) if opening.cut else None
            if mirror is None and pictures is not None:
                mirror = _pictured(scan, pictures, seen, opening, wall)
            if mirror is None and not (asked & opening.cells).sum() > _ASKED * opening.cells.sum():
                asked |= opening.cells
                mirror = _leaning(seen, opening, wall)
            if mirror is not None:
                seen.valid[mirror.cells] = False
                found.append(mirror._replace(cells=_behind(scan, wall, mirror.cells, every, each)))
                if pictures is not None:
                    # Where it ends, little is seen in it.
                    hole = cv2.dilate(_closed(mirror.cells), _AROUND).astype(bool)
                    rows = np.flatnonzero(hole.any(axis=0))
                    hole[hole.any(axis=1), rows[0] : rows[-1] + 1] = True
                    found[-1].cells[:] |= streaks(scan, pictures, seen, mirror.plane, hole)
    floor = level_of(seen, 1.0)
    if pictures is not None and floor is not None:
        images = floor_images(scan, pictures, seen, floor, planes)
        if images.any():
            found.append(Mirror(np.array([0.0, 0.0, 1.0, -floor]), images, int(images.sum()), 0))
    return found


def _likely(seen: Panorama, opening: Opening, wall: F64) -> Mirror | None:
    """The mirror that an opening is, where the room itself proves it; its cells are those of the panorama."""
    points = seen.points[opening.cells]
    offset, agree, deny = _likeness(seen, opening.cells, wall)
    cubes = len(np.unique(patches(points)))
    plane = wall - [0.0, 0.0, 0.0, offset]
    alike = agree >= max(_PATCHES, _SUPPORT * cubes) and agree >= _AGREE * (agree + deny)
    if alike and not opening.framed:
        # One wall of another room lies on one of this room's sooner or later.
        own = judged(seen, opening.cells, plane, seen.valid)
        least = max(_PATCHES / 2, _SUPPORT_OWN[own.beyond >= _SURPLUS] * cubes)
        alike = own.agree >= least and opening.cells.any(axis=1).sum() > 1
    # No wall is cut without showing how thick it is; and what is shallow hangs in the air once reflected.
    if alike or (opening.framed and deny <= _FEW * cubes):
        return Mirror(plane, opening.cells, agree, deny)
    return None


def _leaning(seen: Panorama, opening: Opening, wall: F64) -> Mirror | None:
    """The mirror leaning on a wall that an opening is, where the room itself proves it."""
    cubes = len(np.unique(patches(seen.points[opening.cells])))
    if cubes < _PATCHES:
        return None
    fit = leaning_mirror(seen, opening.cells, wall)
    if fit is None or fit.agree < max(_PATCHES, _MOST * cubes) or fit.beyond < _BEYOND[opening.cut]:
        return None
    there, missing = _there(seen, opening.cells, fit.plane, 0.0)
    agree, deny = fit.agree + there, fit.hanging + missing
    return Mirror(fit.plane, opening.cells, agree, deny) if deny <= _AGAINST * (agree + deny) else None


def _pictured(scan: Scan, pictures: Pictures, seen: Panorama, opening: Opening, wall: F64) -> Mirror | None:
    """The mirror that an opening is, where pictures prove it."""
    hole = cv2.dilate(_closed(opening.cells), _AROUND).astype(bool)
    proof = shown(scan, pictures, seen, wall, hole)
    if not proof.proves(cut=opening.cut):
        return None
    cells, hanging = _beside_left(seen, opening, proof.plane)
    if not cells.any() or hanging > _HANGING * cells.sum():
        return None
    return Mirror(proof.plane, cells, proof.lines, hanging)


def _beside_left(seen: Panorama, opening: Opening, plane: F64) -> tuple[Mask, int]:
    """The cells that are seen in a mirror, without the bearings beside it that hang together with them.

    What hangs in the air once reflected is no image. Floor and ceiling lie on themselves: where little else is seen at
    an end that lies on something, less of it than elsewhere and no frame around, they stay. Returns also how many cells
    hang.
    """
    cells = opening.cells
    image = _reflected(seen.points[cells], plane, 0.0)
    upright, through = np.zeros((2, *cells.shape), bool)
    upright[cells], through[cells] = seen.images(image, seen.tolerance(cells), seen.valid)[1:]
    telling = cells & (np.abs(np.nan_to_num(seen.normals @ plane[:3])) > _TELLING)
    whole = cells.sum(axis=1)
    hangs, borne_out = (some.sum(axis=1) > _MOSTLY * whole for some in (through, upright))
    # Beyond a bearing that shows none of it there may be another opening: a door beside a wardrobe.
    part = np.cumsum(whole == 0)
    if len(np.unique(part[whole > 0])) > 1:
        hangs |= ~np.isin(part, part[borne_out])
    inside = opening.framed | (telling.sum(axis=1) > _LITTLE * whole) | borne_out
    inside &= ~hangs & (whole > 0)
    inside |= (whole >= _AS_HIGH * (np.median(whole[inside]) if inside.any() else np.inf)) & ~hangs
    ends = np.flatnonzero(inside)
    kept = cells & ~hangs[:, None]
    kept[: ends[0] if len(ends) else len(kept)] = False
    kept[ends[-1] + 1 if len(ends) else 0 :] = False
    return kept, int(through[kept].sum())


def _thinned(scan: Scan, every: int, each: int) -> Scan:
    names = ("points", "range_m", "sigma_m", "intensity", "column_px", "reason")
    fields = {name: getattr(scan, name)[::every, ::each] for name in names}
    return Scan.from_arrays(scan.mount, scan.bearings[::every], fields)


def _likeness(seen: Panorama, cells: Mask, wall: F64) -> tuple[float, int, int]:
    """Where before the wall a mirror would stand [m], and in how many patches its images agree and do not.

    Points of the hole must lie on the room, not hang in it; and of the room before the wall nothing that must be seen
    in the mirror may be missing there.
    """
    best, least = (0.0, 0, 0), -np.inf
    for offset in _OFFSETS_M:
        agreeing, denying = _lying(seen, cells, wall, offset)
        if agreeing - 2 * denying > least:
            best, least = (offset, agreeing, denying), agreeing - 2 * denying
    offset, agree, deny = best
    if not agree:
        return best
    there, missing = _there(seen, cells, wall, offset)
    return offset, agree + there, deny + missing


def _lying(seen: Panorama, cells: Mask, wall: F64, offset: float) -> tuple[int, int]:
    """In how many patches points of a hole, reflected `offset` before a wall, lie on something upright, or hang."""
    image = _reflected(seen.points[cells], wall, offset)
    on, upright, through = seen.images(image, seen.tolerance(cells), seen.valid)
    return len(np.unique(patches(image[upright]))), len(np.setdiff1d(patches(image[through]), patches(image[on])))


def _there(seen: Panorama, cells: Mask, wall: F64, offset: float) -> tuple[int, int]:
    """In how many patches the mirror shows what of the room it must show, and in how many that is missing in it."""
    # Between the bearings a narrow thing may be seen in one of two views only: it is not asked for.
    wide = np.zeros_like(cells)
    with np.errstate(invalid="ignore"):
        beside = np.abs(np.diff(seen.distance, axis=0)) < _NARROW_M
    wide[1:-1] = beside[1:] & beside[:-1]
    wide[:, 1::2] = False
    wide &= seen.points @ wall[:3] + wall[3] > BEHIND_M
    image = _reflected(seen.points[wide], wall, offset)
    _, upright, missing = seen.images(image, seen.tolerance(wide), cells)
    return len(np.unique(patches(image[upright]))), len(np.unique(patches(image[missing])))


def _reflected(points: F64, wall: F64, offset: float) -> F64:
    """Points (N, 3) reflected at the plane `offset` before a wall."""
    image: F64 = points - 2.0 * (points @ wall[:3] + wall[3] - offset)[:, None] * wall[:3]
    return image


def _closed(cells: Mask) -> NDArray[np.uint8]:
    return np.asarray(cv2.morphologyEx(cells.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 7), np.uint8)), np.uint8)


def _behind(scan: Scan, wall: F64, cells: Mask, every: int, each: int) -> Mask:
    """The cells (B, H) of the whole scan behind a wall, in the hole `cells` of the thinned one."""
    column = np.minimum(np.arange(len(scan)) // every, cells.shape[0] - 1)
    row = np.minimum(np.arange(scan.rows) // each, cells.shape[1] - 1)
    # What was left out by thinning lies around.
    around = np.ones((3 if every > 1 else 1, 3), np.uint8)
    hole = cv2.dilate(_closed(cells), around).astype(bool)[column][:, row]
    with np.errstate(invalid="ignore"):
        behind = scan.points @ wall[:3].astype(np.float32) + np.float32(wall[3]) < -BEHIND_M - 3.0 * scan.sigma_m
    images: Mask = behind & hole
    return images
