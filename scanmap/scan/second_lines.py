"""Second lines in the pictures of a sweep: where a mirror shows the laser's line once more.

What the laser lights straight, and the camera sees straight, is measured. In a mirror the camera sees it again, and
where is foretold by the mirror's plane alone: the picture of the reflected point, at the same bearing. No door and no
window makes such a line. Where it was taken for the line itself, the point hangs beside the laser's plane, at a place
that the same law foretells; so do points of the line that the mirror throws to where the camera sees it straight.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.geometry import inverse, transform
from scanmap.scan.panorama import Panorama
from scanmap.scan.range_image import Scan

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_APART = float(np.radians(2.9))  # between pictures that are asked
_BEYOND = 0.7  # of the picture's height from its middle
_SAME = float(np.radians(0.1))  # between a picture and its column of the scan
_ROWS = 8  # of the picture between points whose images are looked for
_BEFORE_M = 0.15  # so far before a mirror, a thing and its image are not the same line
_FLAT_M = 0.03  # how far beside a surface the point at the next bearing lies
_SLACK_M = 0.1  # by which a mirror may throw the fan elsewhere than the wall's plane would
_OFFSETS_M = (0.0, 0.01, -0.01, 0.02, -0.02, 0.03, 0.04)  # of the mirror before the wall it hangs on
_TURNS = tuple(np.radians([0.0, 0.2, -0.2, 0.4, -0.4, 0.6, -0.6]))  # of a wall of which few bearings tell
_MET_PX, _EDGE_PX = 4.0, 5.0  # how near a line must be; so near the border of the window none is listed
_FAR_PX = 30.0  # how near one is at least, though the mirror lies beside the wall's plane
_OWN_PX = 8.0  # what is so near the line itself says nothing
_VIEW_SHARE, _VIEW_LEAST = 0.6, 6  # of images met in a picture that shows them
_SHARE, _LEAST = 0.1, 24  # in all such pictures


class Pictures(NamedTuple):
    """What the pictures of a sweep list as line-like, and the head that took them, as it stands at bearing 0."""

    bearings: F64  # (V,) [rad]
    places: F32  # (V, K, n) columns in K blocks of rows, infinite where nothing is listed
    rows: F64  # (K,) the blocks' middles [px]
    window: F64  # (H, 2) first and last column of each row in which a line was looked for
    T_axis_camera: F64  # (4, 4)
    laser_plane: F64  # (4,) n.x + d = 0 in the frame of the axis [m]
    project: Callable[[F64], F64]  # points (N, 3) of the camera frame to column and row (N, 2) [px]

    def pixels(self, points: F64) -> F64:
        """Column and row (N, 2) of points (N, 3) in a picture taken at bearing 0; far outside where behind."""
        pixel = self.project(transform(inverse(self.T_axis_camera), points))
        return np.where(np.isfinite(pixel), pixel, -1e4)

    def within(self, scan: Scan, points: F64, hole: Mask) -> Mask:
        """Whether points (N, 3) lie in the directions of the cells `hole` (b, h) of an evenly thinned scan."""
        every, each = max(1, len(scan) // hole.shape[0]), scan.rows / hole.shape[1]
        bearings = scan.bearings[::every][: len(hole)]
        turn = np.arctan2(points[:, 1], points[:, 0])
        # From half a turn before the middle bearing to half a turn after it.
        turn += 2.0 * np.pi * np.round((0.5 * (bearings[0] + bearings[-1]) - turn) / (2.0 * np.pi))
        after = np.clip(np.searchsorted(bearings, turn), 1, len(bearings) - 1)
        column = after - (turn - bearings[after - 1] < bearings[after] - turn)
        seen: Mask = np.any(hole, axis=1)[column]
        seen &= np.abs(turn - bearings[column]) < 2.0 * _APART
        k = np.flatnonzero(seen)
        row = self.pixels(turned(points[k], -turn[k]))[:, 1]
        # A mirror that reaches out of view goes on there.
        seen[k] = np.abs(row / scan.rows - 0.5) < _BEYOND
        seen[k] &= hole[column[k], np.clip(row / each, 0, hole.shape[1] - 1).astype(np.intp)]
        return seen


class Shown(NamedTuple):
    """Whether the pictures show a room in a mirror."""

    plane: F64  # (4,) n.x + d = 0 [m] that explains the most
    lines: int  # blocks of rows with a second line where it must be, in pictures that show most of theirs
    views: int  # such pictures
    asked: int  # blocks of rows where it would be, if the opening were all mirror

    def proves(self, *, cut: bool) -> bool:
        """Whether there is a mirror; one picture is enough where the opening is cut as a mirror is."""
        return self.lines >= max(_LEAST, _SHARE * self.asked) and self.views >= (1 if cut else 2)


class _Seen(NamedTuple):
    """Points that the laser lights straight, seen by way of the mirror."""

    points: F64  # (N, 3) as if the picture were taken at bearing 0 [m]
    turn: F64  # (N,) its bearing [rad]
    view: Index  # (N,) the picture

    def lines(self, plane: F64) -> tuple[F64, Index]:
        """Where (N, 3) the camera sees the line, and in which pictures (N,)."""
        normal = turned(np.broadcast_to(plane[:3], self.points.shape), -self.turn)
        height = np.einsum("ij,ij->i", self.points, normal) + plane[3]
        return self.points - 2.0 * height[:, None] * normal, self.view


class _Thrown(NamedTuple):
    """Pieces of surface between two bearings that the mirror may throw the fan on."""

    start: F64  # (N, 3) world frame [m]
    end: F64  # (N, 3)
    sheet: F64  # (N, 4) the laser's plane, world frame
    turn: F64  # (N,) the picture's bearing [rad]
    view: Index  # (N,) the picture

    def lines(self, plane: F64) -> tuple[F64, Index]:
        """As in `_Seen`."""
        sheet = _mirrored_planes(self.sheet, plane)
        before, after = (np.einsum("ij,ij->i", x, sheet[:, :3]) + sheet[:, 3] for x in (self.start, self.end))
        k = np.flatnonzero((before > 0) != (after > 0))
        part = (before[k] / (before[k] - after[k]))[:, None]
        place = (1.0 - part) * self.start[k] + part * self.end[k]
        return turned(place, -self.turn[k]), self.view[k]


def shown(scan: Scan, pictures: Pictures, seen: Panorama, wall: F64, hole: Mask) -> Shown:
    """Whether pictures show second lines in an opening of a wall, as a mirror near the wall's plane would.

    Args:
        scan: bearings ascending.
        seen: the same, thinned evenly.
        wall: (4,) its plane, n toward the scanner.
        hole: (b, h) the opening, of the thinned scan.
    """
    best = Shown(wall, 0, 0, 0)
    if not (hole & seen.valid).any():  # all of it was seen in another mirror
        return best
    views, columns = _views(scan, pictures)
    lit = (
        _by_camera(scan, pictures, (views, columns), wall, hole),
        _by_laser(scan, pictures, (views, columns), seen, wall, hole),
    )
    own = np.full((len(pictures.bearings), scan.rows), np.nan, np.float32)
    own[views] = scan.column_px[columns]
    way = np.nan_to_num(seen.points[hole & seen.valid]).mean(axis=0)
    foot = way * (-wall[3] / (way @ wall[:3]))
    if sum(_met(pictures, own, *kind.lines(wall), _FAR_PX)[0] for kind in lit) < _LEAST:
        return best
    for turn in _TURNS:
        normal = turned(wall[None, :3], np.array([turn]))[0]
        for offset in _OFFSETS_M:
            plane = np.append(normal, -normal @ foot - offset)
            met = np.array([_met(pictures, own, *kind.lines(plane)) for kind in lit]).sum(axis=0)
            if met[0] > best.lines:
                best = Shown(plane, *map(int, met))
    return best


def _views(scan: Scan, pictures: Pictures) -> tuple[Index, Index]:
    """Pictures that are far enough apart, and the columns of the scan that were made of them."""
    views, last = list[int](), -np.inf
    for view in np.argsort(pictures.bearings):
        if pictures.bearings[view] - last >= _APART:
            views.append(int(view))
            last = float(pictures.bearings[view])
    apart = np.abs(scan.bearings - pictures.bearings[views][:, None])
    same = apart.min(axis=1) < _SAME  # of others nothing was made
    return np.array(views)[same], apart.argmin(axis=1)[same]


def _by_camera(scan: Scan, pictures: Pictures, views: tuple[Index, Index], wall: F64, hole: Mask) -> _Seen:
    """Points that the camera sees again through the opening."""
    k, row = np.nonzero(scan.valid[views[1], ::_ROWS])
    view, turn = views[0][k], pictures.bearings[views[0][k]]
    points = scan.points[views[1][k], row * _ROWS].astype(np.float64)
    seen = _Seen(turned(points, -turn), turn, view)
    eye = turned(np.broadcast_to(pictures.T_axis_camera[:3, 3], points.shape), turn)
    height, above = points @ wall[:3] + wall[3], eye @ wall[:3] + wall[3]
    image = points - 2.0 * height[:, None] * wall[:3]
    cross = eye + (above / np.maximum(above + height, 1e-9))[:, None] * (image - eye)
    some = np.flatnonzero((height > _BEFORE_M) & (above > 0))
    some = some[pictures.within(scan, cross[some], hole)]
    return _Seen(seen.points[some], seen.turn[some], seen.view[some])


def _by_laser(
    scan: Scan, pictures: Pictures, views: tuple[Index, Index], seen: Panorama, wall: F64, hole: Mask
) -> _Thrown:
    """Surfaces, swept at other bearings, on which the fan may fall by way of the opening."""
    # Only pictures whose light goes into the opening.
    reach = np.deg2rad(1.0) + np.abs(np.diff(seen.bearings)).max(initial=0.0)
    into = (
        np.abs(pictures.bearings[views[0], None] - seen.bearings[hole.any(axis=1)]).min(axis=1, initial=np.inf) < reach
    )
    views = views[0][into], views[1][into]
    turn = pictures.bearings[views[0]]
    sheet = np.broadcast_to(pictures.laser_plane, (len(turn), 4)).copy()
    sheet[:, :3] = turned(sheet[:, :3], turn)
    source = -sheet[:, 3:] * sheet[:, :3]
    gap = seen.points[1:] - seen.points[:-1]
    flat = seen.valid[1:] & seen.valid[:-1] & ~(hole[1:] | hole[:-1])
    with np.errstate(invalid="ignore"):
        flat &= np.abs(np.einsum("ijk,ijk->ij", gap, seen.normals[:-1])) < _FLAT_M
        flat &= seen.points[:-1] @ wall[:3] + wall[3] > _BEFORE_M
    flat[:, 1::2] = False
    column, row = np.nonzero(flat)
    start, end = seen.points[column, row], seen.points[column + 1, row]
    mirrored = _mirrored_planes(sheet, wall)
    heights = [mirrored[:, :3] @ x.T + mirrored[:, 3:] for x in (start, end)]
    near = np.minimum(*np.abs(heights)) < _SLACK_M
    near |= (heights[0] > 0) != (heights[1] > 0)
    v, k = np.nonzero(near)
    # From the laser's image through the opening.
    origin = source[v] - 2.0 * (source[v] @ wall[:3] + wall[3])[:, None] * wall[:3]
    light = 0.5 * (start[k] + end[k]) - origin
    depth = source[v] @ wall[:3] + wall[3]
    cross = origin + (depth / np.maximum(light @ wall[:3], 1e-9))[:, None] * light
    some = np.flatnonzero(depth > 0)
    some = some[pictures.within(scan, cross[some], hole)]
    v, k = v[some], k[some]
    return _Thrown(start[k], end[k], sheet[v], turn[v], views[0][v])


def _mirrored_planes(planes: F64, mirror: F64) -> F64:
    """Planes (N, 4) reflected at another (4,)."""
    cosine = planes[:, :3] @ mirror[:3]
    normal = planes[:, :3] - 2.0 * cosine[:, None] * mirror[:3]
    return np.concatenate([normal, (planes[:, 3] - 2.0 * mirror[3] * cosine)[:, None]], axis=1)


def turned(points: F64, turn: F64) -> F64:
    """Points (N, 3) turned about the axis by (N,) [rad]."""
    c, s = np.cos(turn), np.sin(turn)
    x, y, z = points.T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1)


def _met(pictures: Pictures, own: F32, points: F64, view: Index, within_px: float = _MET_PX) -> tuple[int, int, int]:
    """In how many blocks of rows pictures list a line, of those that list most; how many do; in how many they must.

    Args:
        own: (V, H) columns of the line itself.
        points: (N, 3) where it is seen again, as if the picture were taken at bearing 0.
        view: (N,) the picture.
    """
    column, row = pictures.pixels(points).T
    block = np.abs(row[:, None] - pictures.rows).argmin(axis=1)
    at = np.clip(np.rint(row), 0, own.shape[1] - 1).astype(np.intp)
    near = np.abs(row - pictures.rows[block]) <= 0.5 * _ROWS
    near &= (column > pictures.window[at, 0] + _EDGE_PX) & (column < pictures.window[at, 1] - _EDGE_PX)
    near &= ~(np.abs(own[view, at] - column) < _OWN_PX)
    hit = near & (np.abs(pictures.places[view, block] - column[:, None]).min(axis=1) <= within_px)
    count, views = len(pictures.rows), len(pictures.bearings)
    asked, met = (np.bincount(np.unique(view[k] * count + block[k]) // count, minlength=views) for k in (near, hit))
    most = (met >= _VIEW_LEAST) & (met >= _VIEW_SHARE * asked)
    return int(met[most].sum()), int(most.sum()), int(asked.sum())
