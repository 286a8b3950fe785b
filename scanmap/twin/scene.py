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
        self._shining, self._mirrors = bool(self._emission.any()), self.gloss > 0
        self._textures = [(k, m.texture) for k, m in enumerate(materials) if m.texture is not None]
        self._file_albedo = None if room.vertex_albedo is None else _spread(room.vertex_albedo, room)
        self._light = _spread(bake(room, self.rays, light, self._albedo_of_corners()), room)

    def radiance(self, origin: F64, directions: F32) -> F32:
        """RGB radiance (N, 3) [fraction of saturation] seen from `origin` (3,) or (N, 3) along `directions` (N, 3)."""
        return self._seen(origin, directions, mirrored=True)

    def albedo(self, hits: Hits, points: NDArray[np.floating]) -> F32:
        """Diffuse reflectance (N, 3) RGB where rays met the room at world `points` (N, 3)."""
        thing = self._thing_of[hits.triangle]
        known = self._file_albedo
        albedo = self._albedo[thing] if known is None else _interpolated(known, hits)
        for k, texture in self._textures:
            on = np.flatnonzero(thing == k)
            if len(on):
                albedo[on] *= texture.at(points[on])
        return albedo

    def _seen(self, origin: F64, directions: F32, *, mirrored: bool) -> F32:
        hits = self.rays.cast(origin, directions)
        missed = hits.triangle < 0
        # Rays that met nothing are shaded as if on triangle -1, and blackened in the end.
        points = np.where(missed, 0, hits.distance)[:, None].astype(np.float32) * directions + origin.astype(np.float32)
        thing = self._thing_of[hits.triangle]
        light = self.albedo(hits, points) * _interpolated(self._light, hits)
        if self._shining:
            light += self._emission[thing]
        glossy = np.flatnonzero(self._mirrors[thing] & ~missed) if mirrored else np.empty(0, np.intp)
        if len(glossy):
            way, normal = directions[glossy], self.rays.normals[hits.triangle[glossy]].astype(np.float32)
            onward = way - 2.0 * np.einsum("ij,ij->i", way, normal)[:, None] * normal
            reflection = self._seen(points[glossy] + 1e-4 * onward, onward, mirrored=False)
            light[glossy] += self.gloss[thing[glossy], None] * reflection
        light[missed] = 0.0
        return light

    def _albedo_of_corners(self) -> F64:
        """Mean reflectance (V, 3) around each corner, textures left aside."""
        if self.room.vertex_albedo is not None:
            return self.room.vertex_albedo
        albedo = np.zeros((len(self.room.vertices), 3))
        albedo[self.room.triangles.ravel()] = np.repeat(self._albedo[self._thing_of], 3, axis=0)
        return albedo


def _spread(per_vertex: NDArray[np.floating], room: Room) -> F32:
    """Per triangle (M, 3, 3) what `_interpolated` needs: the value at corner a, and the steps to b and to c."""
    a, b, c = (per_vertex[room.triangles[:, k]] for k in range(3))
    return np.stack([a, b - a, c - a], axis=1).astype(np.float32)


def _interpolated(spread: F32, hits: Hits) -> F32:
    """Values (N, 3) at hits, by barycentric coordinates."""
    own = spread[hits.triangle]
    value: F32 = own[:, 0] + hits.uv[:, :1] * own[:, 1] + hits.uv[:, 1:] * own[:, 2]
    return value


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
