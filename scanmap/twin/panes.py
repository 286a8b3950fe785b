"""Flat glossy things: planes that turn the laser's fan away, and in which the camera sees the room again."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.geometry import Array, transform
from scanmap.twin.scene import Scene

LEAST_AREA_M2 = 0.25  # of smaller ones only the glossy lobe is drawn
_SAME_M = 1e-4  # faces this near one plane are one pane


class Pane(NamedTuple):
    """A plane mirror in some frame."""

    normal: Array  # (3,) unit
    d: float  # normal . x + d = 0 [m]
    reflectance: float
    faces: NDArray[np.bool_]  # (M,) of the room's triangles

    def moved(self, T: Array) -> Pane:
        """The pane in the target frame of the rigid transform `T` (4, 4)."""
        normal = T[:3, :3] @ self.normal
        return self._replace(normal=normal, d=self.d - float(normal @ T[:3, 3]))

    def image(self, points: Array) -> Array:
        """Where points (..., 3) seem to be in this mirror."""
        reflected: Array = points - 2.0 * (points @ self.normal + self.d)[..., None] * self.normal
        return reflected

    def turned(self, directions: Array) -> Array:
        """Directions (..., 3) after this mirror."""
        reflected: Array = directions - 2.0 * (directions @ self.normal)[..., None] * self.normal
        return reflected

    def shows(self, scene: Scene, T_world_head: Array, eye: Array, points: Array) -> NDArray[np.bool_]:
        """Whether points (N, 3) are seen from `eye` (3,) by way of this mirror; all in the head frame."""
        way = self.image(points) - eye
        start = transform(T_world_head, eye)
        hits = scene.rays.cast(start, way @ T_world_head[:3, :3].T)
        met = (hits.triangle >= 0) & self.faces[hits.triangle] & (hits.distance < 1.0)
        k = np.flatnonzero(met)
        onward = way[k]
        depth = -(eye @ self.normal + self.d) / (onward @ self.normal)
        cross = eye + depth[:, None] * onward
        cross += 1e-3 * (points[k] - cross)
        met[k] = ~scene.rays.occluded(transform(T_world_head, cross), transform(T_world_head, points[k]))
        return met


def panes_of(scene: Scene) -> list[Pane]:
    """The panes of a room in the scanner's world frame, from the faces of glossy things that lie in one plane."""
    rays, thing = scene.rays, scene.room.thing_of
    glossy = np.flatnonzero(scene.gloss[thing] > 0)
    d = -np.einsum("ij,ij->i", rays.normals, rays.vertices[rays.triangles[:, 0]])
    found: list[Pane] = []
    while len(glossy):
        k = glossy[0]
        one = (thing[glossy] == thing[k]) & (rays.normals[glossy] @ rays.normals[k] > 1.0 - 1e-8)
        one &= np.abs(d[glossy] - d[k]) < _SAME_M
        faces = np.zeros(len(thing), bool)
        faces[glossy[one]] = True
        if rays.areas[faces].sum() >= LEAST_AREA_M2:
            found.append(Pane(rays.normals[k], float(d[k]), float(scene.gloss[thing[k]]), faces))
        glossy = glossy[~one]
    return found
