"""A room with its light: what a ray from the camera sees, and what a ray of the laser meets."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from scanmap.raycast import Hits, RayScene
from scanmap.twin.furnished import SCANNER_POSITION_M, furnished_room
from scanmap.twin.light import LightParams, bake
from scanmap.twin.room import Room, empty_box, load_room, placed

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

FURNISHED, BOX = "furnished", "box"


class RoomParams(BaseModel, frozen=True, extra="forbid"):
    """Which room the twin stands in, and where; part of `[twin]`."""

    room: str = Field(FURNISHED, description="furnished, box, or the path of a .ply .obj .glb .stl mesh [m]")
    box_size_m: tuple[float, float, float] = Field((4.0, 3.0, 2.5), description="size of room box: x, y, height [m]")
    scanner_position_m: tuple[float, float] | None = Field(
        None, description="where the axis stands in the room's own coordinates: x, y [m]; left out: a good place"
    )
    scanner_height_m: float = Field(1.0, gt=0, le=50, description="height of the laser above the floor [m]")
    heading_deg: float = Field(0.0, description="direction of bearing 0 in the room's own coordinates [deg]")
    mesh_up: Literal["z", "y"] = Field("z", description="which axis of a mesh file points up")


class Scene:
    """A room in the scanner's world frame, its ray casting structure and its baked light."""

    def __init__(self, room: Room, light: LightParams) -> None:
        self.room = room
        self.rays = RayScene(room.vertices, room.triangles)
        materials = [thing.material for thing in room.things]
        self._thing_of = room.thing_of
        self._albedo = np.array([m.albedo for m in materials], np.float32)
        self.gloss = np.array([m.gloss for m in materials], np.float32)
        self._emission = np.array([m.emission for m in materials], np.float32)
        self._textures = [(k, m.texture) for k, m in enumerate(materials) if m.texture is not None]
        self._vertex_albedo = None if room.vertex_albedo is None else room.vertex_albedo.astype(np.float32)
        self._light = bake(room, self.rays, light, self._albedo_of_corners())

    def radiance(self, origin: F64, directions: F32) -> F32:
        """RGB radiance (N, 3) [fraction of saturation] seen from `origin` (3,) along `directions` (N, 3)."""
        return self._seen(origin, directions, mirrored=True)

    def albedo(self, hits: Hits, points: F64) -> F32:
        """Diffuse reflectance (N, 3) RGB where rays met the room at world `points` (N, 3)."""
        thing = self._thing_of[hits.triangle]
        known = self._vertex_albedo
        albedo = self._albedo[thing] if known is None else self._interpolated(known, hits)
        for k, texture in self._textures:
            on = np.flatnonzero(thing == k)
            if len(on):
                albedo[on] *= texture.at(points[on])
        return albedo

    def _seen(self, origin: F64, directions: F32, *, mirrored: bool) -> F32:
        hits = self.rays.cast(origin, directions)
        seen = np.zeros((len(directions), 3), np.float32)
        met = np.flatnonzero(hits.triangle >= 0)
        hits = Hits(hits.distance[met], hits.triangle[met], hits.uv[met])
        way = directions[met]
        start = origin if np.ndim(origin) == 1 else origin[met]
        points = start + hits.distance[:, None] * way
        thing = self._thing_of[hits.triangle]
        light = self.albedo(hits, points) * self._interpolated(self._light, hits) + self._emission[thing]
        glossy = np.flatnonzero(self.gloss[thing] > 0) if mirrored else np.empty(0, np.intp)
        if len(glossy):
            normal = self.rays.normals[hits.triangle[glossy]]
            onward = way[glossy] - 2.0 * np.einsum("ij,ij->i", way[glossy], normal)[:, None] * normal
            onward = onward.astype(np.float32)
            reflection = self._seen(points[glossy] + 1e-4 * onward, onward, mirrored=False)
            light[glossy] += self.gloss[thing[glossy], None] * reflection
        seen[met] = light
        return seen

    def _interpolated(self, per_vertex: F32, hits: Hits) -> F32:
        corner = self.rays.triangles[hits.triangle]
        u, v = hits.uv[:, :1], hits.uv[:, 1:]
        mixed: F32 = (
            (1.0 - u - v) * per_vertex[corner[:, 0]] + u * per_vertex[corner[:, 1]] + v * per_vertex[corner[:, 2]]
        )
        return mixed

    def _albedo_of_corners(self) -> F64:
        """Mean reflectance (V, 3) around each corner, textures left aside."""
        if self._vertex_albedo is not None:
            return self._vertex_albedo.astype(np.float64)
        albedo = np.zeros((len(self.room.vertices), 3))
        albedo[self.room.triangles.ravel()] = np.repeat(self._albedo[self._thing_of], 3, axis=0)
        return albedo


def build_scene(params: RoomParams, light: LightParams | None = None) -> Scene:
    """The room that `params` names, in the scanner's world frame, lit.

    Raises:
        ConfigError: no such room or file, or the scanner would stand outside it.
    """
    light = light or LightParams()
    position = params.scanner_position_m
    if params.room == FURNISHED:
        room = furnished_room(light.window_radiance if light.window else 0.0, np.random.default_rng(7))
        position = position or SCANNER_POSITION_M
    elif params.room == BOX:
        room = empty_box(*params.box_size_m)
        position = position or (0.45 * params.box_size_m[0], 0.4 * params.box_size_m[1])
    else:
        room = load_room(Path(params.room).expanduser(), params.mesh_up)
    return Scene(placed(room, position, params.scanner_height_m, params.heading_deg), light)
