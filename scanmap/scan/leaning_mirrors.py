"""Mirrors that lean: no wall tells their plane, but what is seen in them does.

One point and its image tell the plane of a mirror: it stands square on the middle between them. Points of an opening
are paired with points of the room; planes at which most of the opening is reflected onto what was measured are moved
until it lies there (point to plane: Chen and Medioni 1992). A plane has three degrees of freedom, and any wall can be
laid on any other wall: what proves a mirror is what agrees beyond that. It has to lean. Rooms are built upright, so in
an upright mirror another room of the same size may look like the image of this one. In one that leans walls lean twice
as much, which no room behind an opening does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.scan.panorama import Panorama, patches

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_WIDEST = float(np.radians(60.0))  # an opening; what is wider is a room
_IMAGES, _ROOM, _PLANES = 30, 1200, 2000  # points that are paired, and planes that are tried
_ASKED, _FITTED = 24, 20  # points by which planes are tried, and planes that are fitted
_NEAREST_M, _BEFORE_M = 0.2, (-0.06, 0.8)  # of the mirror before the scanner, and before the wall
_SLOPE = (0.1, 0.3)  # sine of the angle by which a mirror that leans looks up
_FACING = 0.25  # cosine of the angle under which it is seen, at least
_COARSE_M, _GATES_M = 0.15, (0.4, 0.25, 0.15, 0.1, 0.06, 0.06)  # of points against surfaces, while a plane is moved
_SOME = 0.3  # share of the points that try a plane that must fall on something
_SOFT_M, _TURN, _MOVE_M = 0.03, 0.15, 0.3  # where a distance counts half as much; a plane's longest step
_LEAST = 8  # points that move a plane
_MOST = 400  # points it is fitted to
_WALLS = 40  # of these, asked for the one wall
_SAME_M, _SAME_COSINE = 0.06, 0.9  # how alike its points are


class Fit(NamedTuple):
    """A plane at which an opening's points are reflected onto what was measured."""

    plane: F64  # (4,) n.x + d = 0 [m], n toward the scanner
    agree: int  # patches of upright surfaces on which they fall
    beyond: int  # of these, all but those on the one wall that holds most
    hanging: int  # patches in which they hang in the air


def leaning_mirror(seen: Panorama, cells: Mask, wall: F64) -> Fit | None:
    """The plane that explains an opening `cells` (B, H) of a wall (4,) best as a mirror; None where none does."""
    bearings = seen.bearings[cells.any(axis=1)]
    room = seen.valid & ~cells
    room[room] = seen.points[room] @ wall[:3] + wall[3] > -2.0 * _BEFORE_M[0]
    if bearings[-1] - bearings[0] > _WIDEST or not room.any():
        return None
    points = seen.points[cells]
    planes = _paired(_some(points, _IMAGES), _some(seen.points[room], _ROOM), seen.eye, wall)
    asked = _some(points, _ASKED)
    height = planes[:, :3] @ asked.T + planes[:, 3:]
    image = asked - 2.0 * height[..., None] * planes[:, None, :3]
    on, _, through = seen.images(image.reshape(-1, 3), np.full(height.size, _COARSE_M), room)
    # A mirror stands before all that is seen in it.
    likely = (1.0 * on - through).reshape(height.shape).sum(axis=1) - 2.0 * (height > 0).sum(axis=1)
    best: Fit | None = None
    for k in np.argsort(-likely)[:_FITTED]:
        if likely[k] < _SOME * len(asked):
            break
        plane = _fitted(seen, _some(points, _MOST), planes[k], room)
        if not _stands(plane, seen.eye):
            continue
        mirror = judged(seen, cells, plane, room)
        if best is None or mirror.agree - 2 * mirror.hanging > best.agree - 2 * best.hanging:
            best = mirror
    return best


def _some(points: F64, most: int) -> F64:
    """At most so many of points (N, 3), evenly."""
    return points[np.linspace(0, len(points) - 1, min(most, len(points))).astype(np.intp)]


def _paired(images: F64, room: F64, eye: F64, wall: F64) -> F64:
    """Planes (M, 4) that have one of the `images` (N, 3) where one of the points (K, 3) of the room is reflected."""
    apart = room - images[:, None]
    normal = apart / np.maximum(np.linalg.norm(apart, axis=2), 1e-9)[..., None]
    d = -np.einsum("ijk,ijk->ij", normal, 0.5 * (room + images[:, None]))
    planes = np.concatenate([normal, d[..., None]], axis=2).reshape(-1, 4)
    way = images.mean(axis=0) - eye
    facing, height = planes[:, :3] @ way, planes[:, :3] @ eye + planes[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        before = eye @ wall[:3] + wall[3] - height / facing * (way @ wall[:3])
        good = (height > _NEAREST_M) & (facing < -_FACING * np.linalg.norm(way))
        good &= (before > _BEFORE_M[0]) & (before < _BEFORE_M[1])
    good &= (planes[:, 2] > _SLOPE[0]) & (planes[:, 2] < _SLOPE[1])
    planes = planes[good]
    return _some(planes, _PLANES)


def _stands(plane: F64, eye: F64) -> bool:
    """Whether a plane stands before the scanner as mirrors that lean do."""
    return bool(_SLOPE[0] < plane[2] < _SLOPE[1] and eye @ plane[:3] + plane[3] > _NEAREST_M)


def _fitted(seen: Panorama, points: F64, plane: F64, room: Mask) -> F64:
    """The plane (4,), moved so that points (N, 3), reflected at it, lie on what was measured."""
    for gate in _GATES_M:
        normal = plane[:3]
        height = points @ normal + plane[3]
        off, facing = seen.nearest(points - 2.0 * height[:, None] * normal, room)
        k = np.flatnonzero(np.abs(off) < gate)
        if len(k) < _LEAST:
            break
        across = np.cross(normal, [0.0, 0.0, 1.0])
        across /= np.linalg.norm(across)
        turns = np.stack([across, np.cross(normal, across)])
        cosine = facing[k] @ normal
        # d(off) of turning the normal and of moving the plane.
        moved = cosine[:, None] * (points[k] @ turns.T) + height[k, None] * (facing[k] @ turns.T)
        jacobian = -2.0 * np.column_stack([moved, cosine])
        weighted = jacobian / np.hypot(1.0, off[k] / _SOFT_M)[:, None]
        step = np.linalg.solve(weighted.T @ jacobian + 1e-3 * np.eye(3), -weighted.T @ off[k])
        step = np.clip(step, [-_TURN, -_TURN, -_MOVE_M], [_TURN, _TURN, _MOVE_M])
        plane = np.append(normal + step[:2] @ turns, plane[3] + step[2])
        plane = np.asarray(plane / np.linalg.norm(plane[:3]), np.float64)
    return plane


def judged(seen: Panorama, cells: Mask, plane: F64, among: Mask) -> Fit:
    """How points of an opening `cells` (B, H), reflected at a plane (4,), lie on those of the cells `among`."""
    points = seen.points[cells]
    image = points - 2.0 * (points @ plane[:3] + plane[3])[:, None] * plane[:3]
    on, upright, through = seen.images(image, seen.tolerance(cells), among)
    hanging = len(np.setdiff1d(patches(image[through]), patches(image[on])))
    off, facing = seen.nearest(image, among)
    k = np.flatnonzero(upright & np.isfinite(off))
    image, facing, patch = image[k], facing[k], patches(image[k])
    whole = set(patch.tolist())
    one = set[int]()
    for i in range(0, len(k), max(1, len(k) // _WALLS)):
        wall = (np.abs((image - image[i]) @ facing[i]) < _SAME_M) & (np.abs(facing @ facing[i]) > _SAME_COSINE)
        one = max(one, set(patch[wall].tolist()), key=len)
    return Fit(plane, len(whole), len(whole - one), hanging)
