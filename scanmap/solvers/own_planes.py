"""Points against the planes fitted through their own pieces, and how those planes stand."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.solvers.flat_segments import steepness

Array = NDArray[np.float64]

# What a head does not see at all counts as the camera's centre, moved by so much: far beside its plane.
UNSEEN_M_PER_PX = 1e-3


class Pieces(NamedTuple):
    """Which of K flat pieces each of N points lies on."""

    piece: NDArray[np.intp]  # (N,) ascending
    first: NDArray[np.intp]  # (K,) the first point of each
    normals: Array  # (K, 3) about how they stand


def beside_own_planes(points: Array, per_column: Array, own: Array, pieces: Pieces) -> tuple[Array, Array]:
    """Columns (N,) that points lie beside the planes fitted through each piece's own, and those planes' normals (K, 3).

    Args:
        points, per_column: (N, 3) as `located` gives them.
        own: weights (N,) of the points in the fits.
        pieces: their normals are where the fits start, and the side on which the new ones are.
    """
    piece, first, normals = pieces
    points, per_column = np.nan_to_num(points), np.nan_to_num(per_column, nan=UNSEEN_M_PER_PX)
    for _ in range(2):
        weight = own / steepness(per_column, normals[piece]) ** 2
        q = points - _centres(points, weight, first)[piece]
        moments = np.add.reduceat(q[:, :, None] * q[:, None, :] * weight[:, None, None], first)
        normals = np.linalg.eigh(moments)[1][:, :, 0]
    off: Array = (q * normals[piece]).sum(axis=1) / steepness(per_column, normals[piece])
    return off, normals * np.copysign(1.0, (normals * pieces.normals).sum(axis=1))[:, None]


def azimuth_influence(points: Array, per_column: Array, own: Array, pieces: Pieces) -> Array:
    """What an error of a column of each point (N,) does to its upright piece's azimuth [rad/px]."""
    piece, first, normals = pieces
    points, per_column = np.nan_to_num(points), np.nan_to_num(per_column, nan=UNSEEN_M_PER_PX)
    steep = steepness(per_column, normals[piece])
    q = points - _centres(points, own / steep**2, first)[piece]
    across = np.stack([-normals[:, 1], normals[:, 0], np.zeros(len(first))], axis=1)
    across /= np.linalg.norm(across, axis=1)[:, None]
    up = np.cross(normals, across)
    slope = np.stack([(q * across[piece]).sum(axis=1), (q * up[piece]).sum(axis=1), np.ones(len(q))], axis=1)
    slope /= steep[:, None]
    square = np.add.reduceat(slope[:, :, None] * slope[:, None, :] * own[:, None, None], first)
    inverse = np.linalg.pinv(square, hermitian=True)
    influence: Array = (inverse[piece, 0] * slope).sum(axis=1) * own
    return influence


def leans(wall: Array, floor: Array) -> Array:
    """How far walls are from upright and floors from level [rad], (M,), beside what the axis leans as a whole.

    Args:
        wall, floor: normals (., 3). With up = (x, y, 1), small, a wall has n . up = 0 and a floor n parallel to up.
    """
    tilt = floor[:, :2] / floor[:, 2:]
    rows = np.concatenate([wall[:, :2], np.tile([1.0, 0.0], (len(floor), 1)), np.tile([0.0, 1.0], (len(floor), 1))])
    lean = np.concatenate([-wall[:, 2], tilt[:, 0], tilt[:, 1]])
    if len(lean) < 3:
        return np.zeros(0)
    # The axis is plumb to some degrees at least: a weak row for each direction keeps two parallel walls solvable.
    up = np.linalg.solve(rows.T @ rows + 0.01 * np.eye(2), rows.T @ lean)
    left: Array = lean - rows @ up
    return left


def _centres(points: Array, weight: Array, first: NDArray[np.intp]) -> Array:
    """(K, 3) weighted means."""
    centre: Array = np.add.reduceat(points * weight[:, None], first) / np.add.reduceat(weight, first)[:, None]
    return centre
