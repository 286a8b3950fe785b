"""Room light, baked once per room into the corners of its triangles: lamps, window, and two bounces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from scanmap.raycast import RayScene
from scanmap.twin.room import Room

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

WHITE = 0.8  # reflectance of what the settings call a white wall
LAMP_SIZE_M, LAMP_COLOUR = 0.5, (1.0, 0.90, 0.76)
BOUNCES, DIRECTIONS = 2, 96


class LightParams(BaseModel, frozen=True, extra="forbid"):
    """Light in the twin's room besides the laser; `[twin.light]`."""

    ambient: float = Field(0.035, ge=0, le=2, description="a white wall under the lamps, mean [fraction of saturation]")
    window: bool = Field(False, description="daylight: the window shines; off: its blind is down")
    window_radiance: float = Field(2.0, gt=0, le=100, description="brightness of the window [fraction of saturation]")


class _Source:
    """Small emitters that stand for lamps or a window: position, normal, radiance times area."""

    def __init__(self, points: F64, normals: F64, power: F64) -> None:
        self.points, self.normals, self.power = points, normals, power


def bake(room: Room, rays: RayScene, params: LightParams, albedo: F64) -> F32:
    """Irradiance over pi, (V, 3) RGB, in each corner of the room's triangles [fraction of saturation].

    Args:
        room: with lamps; things with emission light it as well.
        rays: the same triangles.
        params: how bright.
        albedo: (V, 3) mean reflectance around each corner.

    Source: radiosity with gathering over a cosine-weighted hemisphere (Goral et al. 1984).
    """
    light = np.zeros((len(room.vertices), 3))
    position, normal = _sample_places(room, rays)
    gather = _Gathering(rays, position, normal) if params.ambient > 0 or params.window else None
    if gather is None:
        return light.astype(np.float32)
    if params.ambient > 0:
        lamps = gather.solve(_lamp_source(room), albedo)
        corner_light = lamps[room.triangles].mean(axis=(1, 2))
        near = np.linalg.norm(rays.vertices[room.triangles[:, 0]][:, :2], axis=1) < 4.0
        mean = np.average(corner_light[near], weights=rays.areas[near])
        light += lamps * (params.ambient / (WHITE * max(float(mean), 1e-12)))
    shining = np.array([any(thing.material.emission) for thing in room.things])[room.thing_of]
    if shining.any():
        emission = np.array([thing.material.emission for thing in room.things])[room.thing_of[shining]]
        centres = rays.vertices[room.triangles[shining]].mean(axis=1)
        power = emission * rays.areas[shining, None]
        light += gather.solve(_Source(centres, rays.normals[shining], power), albedo)
    return light.astype(np.float32)


def _lamp_source(room: Room) -> _Source:
    """Square lamps facing down, as 4 x 4 emitters each."""
    grid = (np.arange(4) - 1.5) / 4.0 * LAMP_SIZE_M
    offset = np.stack([*np.meshgrid(grid, grid), np.zeros((4, 4))], axis=-1).reshape(-1, 3)
    points = (room.lamps[:, None] + offset[None]).reshape(-1, 3)
    normals = np.tile([0.0, 0.0, -1.0], (len(points), 1))
    # Lamps behind the first (corridors) are dimmer.
    strength = np.repeat([1.0] + [0.25] * (len(room.lamps) - 1), 16)
    return _Source(points, normals, strength[:, None] * np.array(LAMP_COLOUR))


def _sample_places(room: Room, rays: RayScene) -> tuple[F64, F64]:
    """Where light is sampled for each corner: just inside its triangles and off the surface, and the normal there.

    A corner in the angle of two walls lies in both; moved a little towards its own face it sees the room.
    """
    count = len(room.vertices)
    corners = rays.vertices[room.triangles]
    flat = room.triangles.ravel()
    centre = np.repeat(corners.mean(axis=1), 3, axis=0)
    weighted = np.repeat(rays.normals * rays.areas[:, None], 3, axis=0)
    used = np.maximum(np.bincount(flat, minlength=count), 1)
    inside = np.stack([np.bincount(flat, centre[:, k], count) for k in range(3)], axis=1) / used[:, None]
    normal = np.stack([np.bincount(flat, weighted[:, k], count) for k in range(3)], axis=1)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return 0.8 * rays.vertices + 0.2 * inside + 2e-3 * normal, normal


class _Gathering:
    """Hemisphere hits of every place, found once and used for every bounce of every source."""

    def __init__(self, rays: RayScene, position: F64, normal: F64) -> None:
        self._rays, self._position, self._normal = rays, position, normal
        self._met = np.full((DIRECTIONS, len(position)), -1, np.int64)
        tangent = np.cross(normal, np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]]))
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
        other = np.cross(normal, tangent)
        # Cosine-weighted directions on a Fibonacci spiral: no noise, hence no blotches.
        k = np.arange(DIRECTIONS) + 0.5
        radius, turn = np.sqrt(k / DIRECTIONS), np.pi * (1.0 + np.sqrt(5.0)) * k
        for i, (r, phi) in enumerate(zip(radius, turn, strict=True)):
            direction = r * np.cos(phi) * tangent + r * np.sin(phi) * other + np.sqrt(1.0 - r * r) * normal
            triangle = rays.cast(position, direction).triangle
            self._met[i] = np.where(triangle >= 0, rays.triangles[triangle, i % 3], -1)

    def solve(self, source: _Source, albedo: F64) -> F64:
        """Irradiance over pi (V, 3) from a source, direct and by BOUNCES bounces."""
        direct = self._direct(source)
        light = direct
        for _ in range(BOUNCES):
            leaving = np.concatenate([albedo * light, np.zeros((1, 3))])  # index -1: nothing met
            bounced = np.zeros_like(direct)
            for met in self._met:
                bounced += leaving[met]
            light = direct + bounced / DIRECTIONS
        return light

    def _direct(self, source: _Source) -> F64:
        light = np.zeros((len(self._position), 3))
        for point, normal, power in zip(source.points, source.normals, source.power, strict=True):
            way = point - self._position
            squared = np.einsum("ij,ij->i", way, way)
            cosines = np.einsum("ij,ij->i", way, self._normal) * -(way @ normal)
            facing = np.flatnonzero((cosines > 0) & (way @ normal < 0))
            free = facing[~self._rays.occluded(self._position[facing], np.broadcast_to(point, (len(facing), 3)))]
            # The floor under the squared distance keeps a place next to an emitter from blowing up.
            form = cosines[free] / np.maximum(squared[free], 0.01) ** 2 / np.pi
            light[free] += form[:, None] * power
        return light
