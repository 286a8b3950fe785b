"""Triangle meshes of simple bodies, finely divided so that baked light can vary over a face.

Corners run counter-clockwise seen from the side the light falls on: normals point out of the body.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

F64 = NDArray[np.float64]

FACE_M = 0.12  # longest edge of a face's division


class Mesh(NamedTuple):
    """Vertices (N, 3) [m] and triangles (M, 3)."""

    vertices: F64
    triangles: NDArray[np.int64]


def merged(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.triangles + start for m, start in zip(meshes, starts, strict=False)]),
    )


def quad(corner: ArrayLike, edge_a: ArrayLike, edge_b: ArrayLike, face_m: float = FACE_M) -> Mesh:
    """Parallelogram; its normal is edge_a x edge_b."""
    o, a, b = (np.asarray(x, np.float64) for x in (corner, edge_a, edge_b))
    na, nb = (max(1, int(np.ceil(np.linalg.norm(e) / face_m))) for e in (a, b))
    s, t = (np.linspace(0.0, 1.0, n + 1) for n in (na, nb))
    vertices = o + s[:, None, None] * a + t[None, :, None] * b
    return Mesh(vertices.reshape(-1, 3), _grid_triangles(na, nb))


def wall_with_hole(corner: ArrayLike, along: ArrayLike, up: ArrayLike, hole: tuple[float, float, float, float]) -> Mesh:
    """Rectangle with a rectangular hole (start, end, bottom, top) [m] measured along its edges."""
    o, a, b = (np.asarray(x, np.float64) for x in (corner, along, up))
    length, height = float(np.linalg.norm(a)), float(np.linalg.norm(b))
    ua, ub = a / length, b / height
    start, end, bottom, top = hole
    pieces = [
        (0.0, start, 0.0, height),
        (end, length, 0.0, height),
        (start, end, top, height),
        (start, end, 0.0, bottom),
    ]
    return merged(
        [
            quad(o + a0 * ua + b0 * ub, (a1 - a0) * ua, (b1 - b0) * ub)
            for a0, a1, b0, b1 in pieces
            if a1 - a0 > 1e-9 and b1 - b0 > 1e-9
        ]
    )


def box(centre: ArrayLike, size: ArrayLike, yaw_deg: float = 0.0, *, inward: bool = False) -> Mesh:
    """Cuboid, turned about z; `inward` makes it a room seen from inside."""
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    axes = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) * np.asarray(size, np.float64)[:, None]
    faces = []
    middle = np.asarray(centre, np.float64)
    for k in range(3):
        normal, a, b = axes[k], axes[(k + 1) % 3], axes[(k + 2) % 3]
        for side in (-0.5, 0.5):
            first, second = (a, b) if (side > 0) != inward else (b, a)
            faces.append(quad(middle + side * normal - 0.5 * (a + b), first, second))
    return merged(faces)


def cylinder(foot: ArrayLike, radius: float, height: float, top_radius: float | None = None, sides: int = 40) -> Mesh:
    """Upright cylinder or cone with a lid, standing on `foot`."""
    rings = max(1, int(np.ceil(height / FACE_M)))
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    part = np.linspace(0.0, 1.0, rings + 1)
    end = radius if top_radius is None else top_radius
    r = radius + (end - radius) * part
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    mantle = circle[:, None] * r[None, :, None] + part[None, :, None] * [0.0, 0.0, height]
    lid = np.stack([circle * 0.0, circle * end], axis=1)
    lid[..., 2] = height
    foot = np.asarray(foot, np.float64)
    return merged(
        [
            Mesh(mantle.reshape(-1, 3) + foot, _grid_triangles(sides, rings)),
            Mesh(lid.reshape(-1, 3) + foot, _grid_triangles(sides, 1)[:, ::-1]),
        ]
    )


def sphere(centre: ArrayLike, radius: float, sides: int = 48) -> Mesh:
    """Ball of `sides` meridians."""
    rings = sides // 2
    azimuth = np.linspace(0.0, 2.0 * np.pi, sides + 1)[:, None]
    polar = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)[None]
    unit = np.stack(
        [np.cos(azimuth) * np.cos(polar), np.sin(azimuth) * np.cos(polar), np.sin(polar) + 0.0 * azimuth], axis=-1
    )
    return Mesh(unit.reshape(-1, 3) * radius + np.asarray(centre, np.float64), _grid_triangles(sides, rings))


def _grid_triangles(na: int, nb: int) -> NDArray[np.int64]:
    """Triangles of a (na + 1, nb + 1) vertex grid, normals along a x b."""
    index = np.arange((na + 1) * (nb + 1)).reshape(na + 1, nb + 1)
    p, q, r, s = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    return np.stack([np.stack([p, q, r], -1), np.stack([p, r, s], -1)], axis=2).reshape(-1, 3).astype(np.int64)
