"""Rigid transforms, rotation about the scanner's axis, planes and rays.

Transforms are 4x4 matrices named `T_target_source`; frames follow REP-103 (x forward, y left, z up).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def rotation_x(angle: float) -> Array:
    """Rotation by `angle` [rad] about x, (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle: float) -> Array:
    """Rotation by `angle` [rad] about y, (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rotation_z(angle: float) -> Array:
    """Rotation by `angle` [rad] about z, counter-clockwise seen from above, (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rigid(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """(4, 4) transform from a (3, 3) rotation and a (3,) translation [m]."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def inverse(T: Array) -> Array:
    """Inverse of a rigid (4, 4) transform."""
    R = T[:3, :3]
    return rigid(R.T, -R.T @ T[:3, 3])


def transform(T: Array, points: Array) -> Array:
    """Points (..., 3) in the source frame of `T`, given in its target frame."""
    moved: Array = points @ T[:3, :3].T + T[:3, 3]
    return moved


def is_rotation(R: Array, tolerance: float = 1e-3) -> bool:
    """Whether a (3, 3) matrix is orthonormal with determinant +1, within `tolerance`."""
    return bool(np.allclose(R @ R.T, np.eye(3), atol=tolerance) and np.linalg.det(R) > 0)


class HeadMount(NamedTuple):
    """How the head sits on the rotation axis.

    `p_world = Rz(bearing) (Ry(tilt_y) Rx(tilt_x) p_head + offset)`; the world's origin is on the axis at
    laser height, x is bearing 0, z is up.
    """

    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # head origin seen from the axis
    # Kept in degrees, the unit of its file: a conversion there and back would cost the last bit.
    tilt_deg: tuple[float, float] = (0.0, 0.0)  # axis against the head's z, about x and y

    def T_axis_head(self) -> Array:
        """(4, 4) head frame to the frame of the axis at bearing 0."""
        tilt_x, tilt_y = np.radians(self.tilt_deg)
        return rigid(rotation_y(tilt_y) @ rotation_x(tilt_x), self.offset_m)

    def T_world_head(self, bearing: float) -> Array:
        """(4, 4) head frame to world at `bearing` [rad]."""
        return rigid(rotation_z(bearing), np.zeros(3)) @ self.T_axis_head()


class PlaneFit(NamedTuple):
    """Plane `normal . x + d = 0` through points, least squares."""

    normal: Array  # (3,) unit
    d: float  # [m]
    rms_m: float


def fit_plane(points: Array) -> PlaneFit:
    """Total least squares plane through (N, 3) points [m], N >= 3.

    Source: eigenvector of the scatter matrix with the smallest eigenvalue (Pearson 1901).
    """
    centre = points.mean(axis=0)
    q = points - centre
    values, vectors = np.linalg.eigh(q.T @ q)
    normal = vectors[:, 0]
    return PlaneFit(normal, float(-normal @ centre), float(np.sqrt(max(values[0], 0.0) / len(points))))


def intersect_rays_plane(origin: Array, directions: Array, plane: Array) -> Array:
    """Where rays meet a plane: parameter t with `origin + t direction` on it, (...,).

    Args:
        origin: (3,) common origin [m].
        directions: (..., 3), any length.
        plane: (4,) n.x + d = 0 in the same frame.

    NaN where a ray is parallel to the plane; negative behind the origin.
    """
    # Not BLAS, whose sums depend on how many rays there are.
    along = directions[..., 0] * plane[0] + directions[..., 1] * plane[1] + directions[..., 2] * plane[2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        t = -(plane[:3] @ origin + plane[3]) / along
    met: Array = np.where(np.isfinite(t), t, np.nan)
    return met
