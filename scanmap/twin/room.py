"""Rooms for the twin: what is in them, what it looks like, and where its walls truly are.

A room is built or loaded in its own coordinates (floor at z = 0, or the file's) and then moved to the
scanner's world: origin on the rotation axis at laser height, x = bearing 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import ConfigError
from scanmap.geometry import inverse, rigid, rotation_z, transform
from scanmap.twin.mesh import Mesh, box
from scanmap.twin.texture import Material

F64 = NDArray[np.float64]

FILE_TYPES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
# Faces larger than this are divided, so that light can vary over them; not in meshes with many triangles.
LARGE_FACE_M, MANY_TRIANGLES = 0.25, 200_000


class Thing(NamedTuple):
    """An object of the room."""

    name: str
    material: Material
    measurable: bool = True  # False for what no line scanner can measure: a bright window


class Wall(NamedTuple):
    """A flat boundary of the room, `normal . x + d = 0`, the normal into the room."""

    name: str
    normal: F64  # (3,) unit
    d: float  # [m]


@dataclass(frozen=True)
class Room:
    """Triangles with the object each belongs to, and what is known of the shape."""

    name: str
    vertices: F64  # (V, 3) [m]
    triangles: NDArray[np.int64]  # (M, 3)
    thing_of: NDArray[np.int64]  # (M,) index into `things`
    things: tuple[Thing, ...]
    lamps: F64  # (L, 3) [m] centres of the lamps, shining down
    walls: tuple[Wall, ...] = ()  # with floor and ceiling; empty where nobody knows
    footprint: F64 | None = None  # (N, 2) [m] corners of the floor plan, counter-clockwise
    vertex_albedo: F64 | None = None  # (V, 3) linear RGB in place of the material's; None where unknown

    def moved(self, T: F64) -> Room:
        """The room in the target frame of the rigid transform `T` (4, 4) about z."""
        walls = []
        for wall in self.walls:
            normal = T[:3, :3] @ wall.normal
            walls.append(wall._replace(normal=normal, d=wall.d - float(normal @ T[:3, 3])))
        plan = self.footprint
        return replace(
            self,
            vertices=transform(T, self.vertices),
            lamps=transform(T, self.lamps),
            walls=tuple(walls),
            footprint=None if plan is None else transform(T, np.pad(plan, ((0, 0), (0, 1))))[:, :2],
            things=tuple(thing._replace(material=thing.material.moved(T)) for thing in self.things),
        )

    @property
    def area_m2(self) -> float:
        """Area of the floor plan [m^2], NaN where unknown (shoelace formula)."""
        if self.footprint is None:
            return float("nan")
        x, y = self.footprint.T
        return float(0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))


def assembled(
    name: str,
    parts: Sequence[tuple[Thing, Mesh]],
    lamps: Sequence[tuple[float, float, float]],
    walls: tuple[Wall, ...] = (),
    footprint: F64 | None = None,
) -> Room:
    """A room of parts; degenerate triangles (poles, apexes) are left out."""
    vertices, triangles, owner, start = [], [], [], 0
    for k, (_, mesh) in enumerate(parts):
        a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
        whole = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-12
        vertices.append(mesh.vertices)
        triangles.append(mesh.triangles[whole] + start)
        owner.append(np.full(int(whole.sum()), k))
        start += len(mesh.vertices)
    return Room(
        name=name,
        vertices=np.concatenate(vertices),
        triangles=np.concatenate(triangles),
        thing_of=np.concatenate(owner),
        things=tuple(thing for thing, _ in parts),
        lamps=np.array(lamps, np.float64).reshape(-1, 3),
        walls=walls,
        footprint=footprint,
    )


def cuboid_walls(length: float, width: float, height: float) -> tuple[tuple[Wall, ...], F64]:
    """The six boundaries and the floor plan of a room [0, length] x [0, width] x [0, height] [m]."""
    named = (
        ("west", (1, 0, 0), 0.0), ("east", (-1, 0, 0), length), ("south", (0, 1, 0), 0.0),
        ("north", (0, -1, 0), width), ("floor", (0, 0, 1), 0.0), ("ceiling", (0, 0, -1), height),
    )  # fmt: skip
    walls = tuple(Wall(name, np.array(normal, np.float64), d) for name, normal, d in named)
    return walls, np.array([[0.0, 0.0], [length, 0.0], [length, width], [0.0, width]])


def empty_box(length: float, width: float, height: float) -> Room:
    """A white room with nothing in it: its truth is six planes."""
    walls, footprint = cuboid_walls(length, width, height)
    shell = box([length / 2, width / 2, height / 2], [length, width, height], inward=True)
    lamp = (0.55 * length, 0.45 * width, 0.94 * height)
    return assembled("box", [(Thing("shell", Material((0.8, 0.8, 0.8))), shell)], [lamp], walls, footprint)


def load_room(path: Path, up: str = "z") -> Room:
    """A mesh file as a room; vertex colours (sRGB) become albedo, else everything is light grey.

    Raises:
        ConfigError: missing, of another kind, or without triangles.
    """
    if not path.is_file():
        raise ConfigError(f"twin.room: no file {path}; rooms with names are furnished, box")
    if path.suffix.lower() not in FILE_TYPES:
        raise ConfigError(f"twin.room: {path} is not a mesh file scanmap loads ({', '.join(FILE_TYPES)})")
    import trimesh

    try:
        loaded = trimesh.load(path, force="mesh", process=False)
        vertices, triangles = np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64)
    except Exception as error:  # each of trimesh's loaders raises its own kinds
        raise ConfigError(f"twin.room: {path} cannot be read as a mesh: {error}") from error
    if not len(triangles) or not np.isfinite(vertices).all():
        raise ConfigError(f"twin.room: {path} holds no triangles, or corners that are not finite")
    colours = getattr(loaded.visual, "vertex_colors", None) if loaded.visual.kind == "vertex" else None
    albedo = np.full((len(vertices), 3), 0.6)
    if colours is not None:
        albedo = np.clip((np.asarray(colours)[:, :3] / 255.0) ** 2.2, 0.02, 0.9)
    if up == "y":
        vertices = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
    vertices, triangles, albedo = _divided(vertices, triangles, albedo)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    lamp = [*(0.5 * (low + high))[:2], high[2] - 0.12]
    return Room(
        path.stem, vertices, triangles, np.zeros(len(triangles), np.int64),
        (Thing(path.stem, Material((1.0, 1.0, 1.0))),), np.array([lamp]), vertex_albedo=albedo,
    )  # fmt: skip


def placed(room: Room, position: tuple[float, float] | None, height: float, heading_deg: float) -> Room:
    """The room seen from the scanner: `position` (x, y) [m] in room coordinates, None for its middle.

    Raises:
        ConfigError: the scanner would stand outside the room.
    """
    low, high = room.vertices.min(axis=0), room.vertices.max(axis=0)
    x, y = position if position is not None else tuple(0.5 * (low + high)[:2])
    if not (low[0] < x < high[0] and low[1] < y < high[1] and 0 < height < high[2] - low[2]):
        raise ConfigError(
            f"twin: scanner at ({x:g}, {y:g}), {height:g} m high, is outside room {room.name}: "
            f"x {low[0]:.2f} to {high[0]:.2f}, y {low[1]:.2f} to {high[1]:.2f}, height up to {high[2] - low[2]:.2f}; "
            "set twin.scanner_position_m and twin.scanner_height_m"
        )
    T_room_world = rigid(rotation_z(np.radians(heading_deg)), [x, y, low[2] + height])
    return room.moved(inverse(T_room_world))


def _divided(vertices: F64, triangles: NDArray[np.int64], albedo: F64) -> tuple[F64, NDArray[np.int64], F64]:
    """Halve the longest edges until faces are small enough to carry shading, or there are too many."""
    for _ in range(12):
        corners = vertices[triangles]
        edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        long = edges.max(axis=1) > LARGE_FACE_M
        if not long.any() or len(triangles) > MANY_TRIANGLES:
            break
        k = edges[long].argmax(axis=1)
        chosen = triangles[long]
        row = np.arange(len(chosen))
        a, b, c = chosen[row, k], chosen[row, (k + 1) % 3], chosen[row, (k + 2) % 3]
        middle = len(vertices) + row
        vertices = np.concatenate([vertices, 0.5 * (vertices[a] + vertices[b])])
        albedo = np.concatenate([albedo, 0.5 * (albedo[a] + albedo[b])])
        halves = [np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)]
        triangles = np.concatenate([triangles[~long], *halves])
    return vertices, triangles, albedo
