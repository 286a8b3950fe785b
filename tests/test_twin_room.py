"""Rooms of the twin: bodies, boundaries, files, light."""

from pathlib import Path

import numpy as np
import pytest

from scanmap.errors import ConfigError
from scanmap.geometry import rigid, rotation_z
from scanmap.twin import LightParams, RoomParams, build_scene
from scanmap.twin.furnished import furnished_room
from scanmap.twin.mesh import Mesh, box, cylinder, quad, sphere, wall_with_hole
from scanmap.twin.overview import overview
from scanmap.twin.room import empty_box, load_room, placed
from scanmap.twin.scene import Scene

COPYROOM = Path(__file__).parent.parent.parent / "shared/data/rooms/copyroom/copyroom_aligned.ply"


def volume(mesh: Mesh) -> float:
    """Signed volume a closed mesh encloses, positive with normals outward (divergence theorem)."""
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def area(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def test_bodies_enclose_their_volume_with_normals_outward() -> None:
    assert volume(box([1, 2, 3], [0.4, 0.5, 0.6], 31.0)) == pytest.approx(0.12)
    assert volume(box([1, 2, 3], [0.4, 0.5, 0.6], inward=True)) == pytest.approx(-0.12)
    assert volume(sphere([3, 1, 2], 0.5, 96)) == pytest.approx(4 / 3 * np.pi * 0.125, rel=3e-3)
    # A cylinder has no bottom; standing on z = 0 the missing disc adds nothing to the integral.
    assert volume(cylinder([2, 1, 0], 0.3, 1.2, sides=200)) == pytest.approx(np.pi * 0.09 * 1.2, rel=1e-3)
    assert volume(cylinder([2, 1, 0], 0.3, 1.2, 0.0, sides=200)) == pytest.approx(np.pi * 0.09 * 0.4, rel=1e-3)


def test_a_hole_takes_its_area_from_the_wall() -> None:
    wall = wall_with_hole([0, 3, 0], [4, 0, 0], [0, 0, 2.5], (1.0, 1.8, 0.9, 2.0))
    assert area(wall) == pytest.approx(4 * 2.5 - 0.8 * 1.1)
    assert area(quad([0, 0, 0], [3, 0, 0], [1, 2, 0])) == pytest.approx(6.0)


@pytest.mark.parametrize("heading", [0.0, 33.0, -120.0])
def test_boundaries_follow_the_scanner(heading: float) -> None:
    room = placed(empty_box(5.0, 4.0, 3.0), (2.0, 1.5), 1.2, heading)
    assert {w.name: round(w.d, 9) for w in room.walls} == {
        "west": 2.0, "east": 3.0, "south": 1.5, "north": 2.5, "floor": 1.2, "ceiling": 1.8,
    }  # fmt: skip
    off = np.stack([room.vertices @ w.normal + w.d for w in room.walls])
    np.testing.assert_allclose(np.abs(off).min(axis=0), 0.0, atol=1e-12)
    assert off.min() > -1e-12, "normals point into the room"
    assert room.area_m2 == pytest.approx(20.0)
    assert room.footprint is not None
    np.testing.assert_allclose(np.abs(room.footprint @ rotation_z(np.radians(heading))[:2, :2].T).min(), 1.5, atol=1e-9)


def test_textures_move_with_the_room() -> None:
    room = furnished_room(0.0, np.random.default_rng(7))
    T = rigid(rotation_z(0.7), [1.0, -2.0, 0.3])
    painted = next(t.material.texture for t in room.things if t.name == "picture")
    rng = np.random.default_rng(0)
    points = rng.uniform([3.9, 1.0, 1.3], [4.0, 1.9, 1.9], (200, 3))
    moved = painted.moved(T)
    np.testing.assert_array_equal(moved.at(points @ T[:3, :3].T + T[:3, 3]), painted.at(points))


def test_furnished_room_keeps_its_promises() -> None:
    room = furnished_room(0.0, np.random.default_rng(7))
    names = {thing.name for thing in room.things}
    assert {"table", "cupboard", "column", "picture", "armchair", "screen", "blind"} <= names
    dark = {t.name for t in room.things if max(t.material.albedo) < 0.07}
    assert {"screen", "armchair"} <= dark
    assert next(t for t in room.things if t.name == "screen").material.gloss > 0
    furniture = ~np.isin(room.thing_of, [k for k, t in enumerate(room.things) if t.name.startswith("corridor")])
    inside = room.vertices[room.triangles[furniture]].reshape(-1, 3)
    assert inside[:, 0].min() >= 0 and inside[:, 0].max() <= 4.0 + 1e-9
    assert inside[:, 1].max() <= 3.14 + 1e-9 and inside[:, 2].max() <= 2.5 + 1e-9
    assert all(thing.measurable for thing in room.things)
    bright = furnished_room(2.0, np.random.default_rng(7))
    assert [t.name for t in bright.things if not t.measurable] == ["window"]


def test_a_mesh_file_is_a_room_with_its_colours(tmp_path: Path) -> None:
    import trimesh

    shell = box([0, 0, 1.25], [4, 3, 2.5], inward=True)
    colours = np.tile(np.array([[255, 0, 128, 255]], np.uint8), (len(shell.vertices), 1))
    for suffix in ("ply", "obj", "glb", "stl"):
        path = tmp_path / f"room.{suffix}"
        trimesh.Trimesh(shell.vertices, shell.triangles, vertex_colors=colours, process=False).export(path)
        room = load_room(path)
        assert area(Mesh(room.vertices, room.triangles)) == pytest.approx(area(shell), rel=1e-5)
        if suffix in ("ply", "glb"):
            assert room.vertex_albedo is not None
            np.testing.assert_allclose(room.vertex_albedo[0], [0.9, 0.02, (128 / 255) ** 2.2], atol=1e-6)
        assert np.isnan(room.area_m2) and room.walls == ()


def test_large_faces_of_a_file_are_divided_without_changing_the_surface(tmp_path: Path) -> None:
    import trimesh

    path = tmp_path / "big.ply"
    big = quad([0, 0, 0], [4, 0, 0], [0, 3, 0], face_m=10.0)
    trimesh.Trimesh(big.vertices, big.triangles, process=False).export(path)
    room = load_room(path)
    corners = room.vertices[room.triangles]
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max() <= 0.25
    assert area(Mesh(room.vertices, room.triangles)) == pytest.approx(12.0)


def test_y_up_files_are_stood_upright(tmp_path: Path) -> None:
    import trimesh

    path = tmp_path / "y.ply"
    tall = box([0, 5, 0], [1, 10, 2])
    trimesh.Trimesh(tall.vertices, tall.triangles, process=False).export(path)
    room = load_room(path, up="y")
    np.testing.assert_allclose(room.vertices.max(axis=0) - room.vertices.min(axis=0), [1, 2, 10], atol=1e-6)
    assert volume(Mesh(room.vertices, room.triangles)) == pytest.approx(20.0, rel=1e-5)


def test_faulty_rooms_are_refused_in_one_line(tmp_path: Path) -> None:
    light = LightParams()
    broken, cloud = tmp_path / "broken.ply", tmp_path / "cloud.ply"
    broken.write_bytes(b"ply\nformat nonsense")
    cloud.write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n0 0 0\n"
    )
    (tmp_path / "room.txt").write_text("a room")
    faults = {
        "attic": "furnished, box",
        str(tmp_path / "room.txt"): "not a mesh file",
        str(broken): "cannot be read as a mesh",
        str(cloud): "triangles",
    }
    for name, words in faults.items():
        with pytest.raises(ConfigError, match=words) as caught:
            build_scene(RoomParams(room=name), light)
        assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match=r"outside room box: x 0.00 to 4.00"):
        build_scene(RoomParams(room="box", scanner_position_m=(9.0, 1.0)), light)
    with pytest.raises(ConfigError, match=r"height up to 2.50"):
        build_scene(RoomParams(room="box", scanner_height_m=3.0), light)


def wall_light(scene: Scene, y: float, z: float) -> float:
    return float(scene.radiance(np.zeros(3), np.array([[1.0, y, z]], np.float32)).mean())


def test_light_is_linear_in_ambient_and_darker_in_corners() -> None:
    room = RoomParams(room="box", scanner_position_m=(2.0, 1.5))
    dim, bright = (build_scene(room, LightParams(ambient=a)) for a in (0.02, 0.06))
    assert wall_light(bright, 0.1, 0.1) == pytest.approx(3.0 * wall_light(dim, 0.1, 0.1), rel=1e-4)
    assert wall_light(dim, 0.745, -0.495) < 0.8 * wall_light(dim, 0.1, 0.0)
    assert wall_light(build_scene(room, LightParams(ambient=0.0)), 0.1, 0.1) == 0.0
    # `ambient` is the mean brightness of white walls.
    directions = np.random.default_rng(0).standard_normal((4000, 3)).astype(np.float32)
    assert dim.radiance(np.zeros(3), directions).mean() == pytest.approx(0.02, rel=0.25)


def test_the_window_shines_into_the_room() -> None:
    dark = build_scene(RoomParams(), LightParams(ambient=0.03))
    lit = build_scene(RoomParams(), LightParams(ambient=0.03, window=True, window_radiance=2.0))
    floor = np.array([[0.3, 1.2, -1.0]], np.float32)
    pane = np.array([[-0.85, 2.68, 0.5]], np.float32)
    assert lit.radiance(np.zeros(3), pane)[0, 1] == pytest.approx(2.0, rel=0.05)
    assert (lit.radiance(np.zeros(3), floor) > 1.15 * dark.radiance(np.zeros(3), floor)).all()


def test_a_glossy_screen_mirrors_the_room() -> None:
    scene = build_scene(RoomParams(), LightParams(ambient=0.03))
    k = next(k for k, thing in enumerate(scene.room.things) if thing.name == "screen")
    centre = scene.rays.vertices[scene.room.triangles[scene.room.thing_of == k]].reshape(-1, 3).mean(axis=0)
    way = (centre + np.array([0.0, 0.0, 0.1]))[None].astype(np.float32)
    with_gloss = scene.radiance(np.zeros(3), way)
    scene.gloss[k] = 0.0
    assert (with_gloss > scene.radiance(np.zeros(3), way)).all()


def test_the_room_from_outside_shows_floor_and_background() -> None:
    picture = overview(build_scene(RoomParams(room="box"), LightParams()), size=(160, 120))
    assert picture.shape == (120, 160, 3)
    white = (picture == 255).all(axis=2)
    assert white[0, 0] and not white[60, 80]


def test_copyroom_loads_and_lights() -> None:
    if not COPYROOM.exists():
        pytest.skip("the copyroom mesh is not here")
    scene = build_scene(RoomParams(room=str(COPYROOM)), LightParams())
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    rays = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1).astype(np.float32)
    seen = scene.radiance(np.zeros(3), rays)
    assert (seen.max(axis=1) > 0).mean() > 0.85
    assert scene.rays.vertices[:, 2].min() == pytest.approx(-1.0, abs=1e-6)
