"""Points against the planes fitted through their own pieces, and how those planes stand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanmap.solvers.flat_segments import FLOOR_M_PER_PX

Array = NDArray[np.float64]


def beside_own_planes(
    points: Array, per_column: Array, own: Array, pieces: tuple[NDArray[np.intp], NDArray[np.intp], Array]
) -> tuple[Array, Array]:
    """Columns (N,) that points lie beside the planes fitted through each piece's own, and those planes' normals.

    Args:
        own: weights (N,) of the points in the fits.
        pieces: the piece (N,) each lies on, ascending; the first point (K,) of each; a normal (K, 3) to start from.
    """
    piece, first, normals = pieces
    points, per_column = np.nan_to_num(points), np.nan_to_num(per_column)
    for _ in range(2):
        along = (per_column * normals[piece]).sum(axis=1)
        weight = own / np.maximum(np.abs(along), FLOOR_M_PER_PX) ** 2
        centre = np.add.reduceat(points * weight[:, None], first) / np.add.reduceat(weight, first)[:, None]
        q = points - centre[piece]
        moments = np.add.reduceat(q[:, :, None] * q[:, None, :] * weight[:, None, None], first)
        normals = np.linalg.eigh(moments)[1][:, :, 0]
    along = (per_column * normals[piece]).sum(axis=1)
    steep = np.where(along >= 0, 1.0, -1.0) * np.maximum(np.abs(along), FLOOR_M_PER_PX)
    off: Array = (q * normals[piece]).sum(axis=1) / steep
    return off, normals


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
