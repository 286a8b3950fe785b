"""Walls of a scan, and what is seen through them as if they were cut out: mirrors, windows without reveals."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.scan.panorama import Panorama

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

_WALLS = 8  # planes that are asked
_LEAST_SHARE, _LEAST_CELLS = 0.01, 60  # of the cells, on a wall
_UPRIGHT = 0.25  # sine of the angle by which a wall may lean
_FLAT_M = 0.03  # how far from its plane a wall's own points are
BEHIND_M = 0.08  # so far behind a wall's plane begins what is seen through it, beside 3 standard deviations
_CELLS = 30  # an opening has at least so many
_BRIDGE = np.ones((3, 41), np.uint8)  # columns x rows without points that a faint image may have
_REVEAL_M = 0.03  # a rim that lies so far behind the plane shows the wall's thickness
_JUMP_M = 0.15  # from the rim to what is seen through it
_MOST_NOISE_M = 0.15
_APART_M = 0.12  # bearings whose points are farther apart than this do not show how a surface runs on
_SHARP, _ENDS = 0.8, 2  # share of the ends that must be cut sharply; upper and lower ends that must be seen
_RIM_M, _ON_WALL = 0.06, 0.5  # a frame stands out or back so far; share of the ends on wall or frame


def walls(points: F64, facing: F64) -> list[F64]:
    """Upright planes (4,) that hold most of the points (N, 3) with normals (N, 3), the strongest first."""
    level = np.hypot(facing[:, 0], facing[:, 1])
    upright = level > np.cos(np.arcsin(_UPRIGHT))
    points, facing = points[upright], facing[upright] / level[upright, None]
    least = max(_LEAST_CELLS, int(_LEAST_SHARE * len(upright)))
    planes: list[F64] = []
    for _ in range(2 * _WALLS):
        if len(points) < least or len(planes) == _WALLS:
            break
        # Votes for direction (2 deg) and distance (5 cm); most in 3 x 3 cells (Hough 1962).
        turn = np.floor(np.degrees(np.arctan2(facing[:, 1], facing[:, 0])) / 2.0).astype(np.intp) % 180
        away = np.clip((-np.einsum("ij,ij->i", points, facing) + 1.0) / 0.05, 0, 259).astype(np.intp)
        votes = np.bincount(turn * 260 + away, minlength=180 * 260).reshape(180, 260).astype(np.float32)
        near = cv2.blur(np.concatenate([votes[-1:], votes, votes[:1]]), (3, 3), borderType=cv2.BORDER_CONSTANT)[1:-1]
        i, j = np.unravel_index(near.argmax(), near.shape)
        angle = np.radians(2.0 * i + 1.0)
        plane = np.array([np.cos(angle), np.sin(angle), 0.0, 0.05 * (j + 0.5) - 1.0])
        on = np.zeros(len(points), bool)
        for gate in (0.1, 0.06, 0.04, _FLAT_M):
            on = (np.abs(points @ plane[:3] + plane[3]) < gate) & (facing @ plane[:3] > 0.95)
            if on.sum() < least:
                break
            middle = points[on].mean(axis=0)
            normal = np.linalg.eigh(np.cov((points[on] - middle).T))[1][:, 0]
            normal *= np.sign(normal @ plane[:3])
            plane = np.append(normal, -normal @ middle)
        if on.sum() >= least and plane[3] > 0:
            planes.append(plane)
        used = (np.abs(points @ plane[:3] + plane[3]) < 2.0 * _FLAT_M) & (facing @ plane[:3] > 0.9)
        used |= (np.abs((turn - i + 90) % 180 - 90) <= 1) & (np.abs(away - j) <= 1)
        points, facing = points[~used], facing[~used]
    return planes


class Opening(NamedTuple):
    """What is seen through a wall as if it were cut out."""

    cells: Mask  # (B, H) connected, with points behind the wall's plane
    cut: bool  # its ends are sharp, and on the wall
    framed: bool  # so are nearly all the upper and all the lower ones, seen at nearly every bearing


def openings(seen: Panorama, wall: F64) -> list[Opening]:
    """All that is seen through a wall."""
    height = seen.points @ wall[:3] + wall[3]
    behind = seen.valid & (height < -BEHIND_M - 3.0 * seen.sigma)
    # A faint image is full of gaps: they are bridged, but for points that lie before the wall.
    closed = cv2.morphologyEx(behind.astype(np.uint8), cv2.MORPH_CLOSE, _BRIDGE) * (behind | ~seen.valid)
    count, label, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    found = list[Opening]()
    for k in range(1, count):
        if stats[k, cv2.CC_STAT_AREA] >= _CELLS:
            cells = behind & (label == k)
            sharp, on_wall, framed = _rim(seen, cells, wall, height)
            cut = sharp >= _SHARP and on_wall >= _ON_WALL
            found.append(Opening(cells, cut, cut and framed))
    return found


def _rim(seen: Panorama, cells: Mask, wall: F64, height: F64) -> tuple[float, float, bool]:
    """How a hole `cells` (B, H) ends: the share of its ends that is cut sharply, and that lies on the wall; framed?

    Args:
        height: (B, H) of the points before the wall [m].

    Surfaces that run on through the wall's plane, and reveals, are no sharp ends. Of the ends along the rows and those
    along the bearings the less sharp count.
    """
    sharp, on_wall, enough, framed = list[float](), list[Mask](), True, True
    for axis in (1, 0):
        inside, valid = (mask if axis else mask.T for mask in (cells, seen.valid))
        line = np.flatnonzero(inside.any(axis=1))
        reach = max(4, inside.shape[1] // 5) if axis else 2
        cut = list[Mask]()
        for way in (slice(None), slice(None, None, -1)):
            place = np.arange(inside.shape[1])
            before = np.maximum.accumulate(np.where(valid[line][:, way], place, -1), axis=1)
            first = inside[line][:, way].argmax(axis=1)
            last = np.where(first > 0, before[np.arange(len(line)), first - 1], -1)
            known = (last >= 0) & (first - last <= reach)
            rim, edge = ((line[known], place[way][k[known]])[:: 1 if axis else -1] for k in (last, first))
            on_wall.append(np.abs(height[rim]) < _RIM_M + 3.0 * seen.sigma[rim])
            # Between bearings far apart a frame may stand unseen, and a corner be stepped over.
            near = np.abs(seen.bearings[rim[0]] - seen.bearings[edge[0]]) * seen.distance[rim] < _APART_M
            cut.append(_cut(seen, rim, edge, wall)[near])
            framed &= not axis or (cut[-1] & on_wall[-1][near]).sum() >= _SHARP * len(line)
        ends_cut = np.concatenate(cut)
        enough &= not axis or len(ends_cut) >= max(_ENDS, 0.5 * len(line))  # an end may be out of view
        sharp.append(float(ends_cut.mean()) if len(ends_cut) else 1.0)
    closed = np.concatenate(on_wall)
    return (min(sharp) if enough else 0.0), float(closed.mean()) if len(closed) else 0.0, bool(framed)


def _cut(seen: Panorama, rim: tuple[Index, Index], first: tuple[Index, Index], wall: F64) -> Mask:
    """Whether the range jumps (N,) from cells of the `rim` to the `first` ones of the hole, and nothing runs on."""
    apart, normal = seen.points[first] - seen.points[rim], seen.normals[rim]
    slack = np.minimum(3.0 * np.hypot(seen.sigma[rim], seen.sigma[first]), _MOST_NOISE_M)
    with np.errstate(invalid="ignore"):  # no normal, nothing known to run on
        runs_on = np.abs(np.einsum("ij,ij->i", apart, normal)) < _FLAT_M + slack
        runs_on &= np.abs(normal @ wall[:3]) < 0.7
    jump = seen.distance[first] - seen.distance[rim] > _JUMP_M
    before = seen.points[rim] @ wall[:3] + wall[3] > -_REVEAL_M - 3.0 * seen.sigma[rim]
    cut: Mask = jump & ~runs_on & before
    return cut
