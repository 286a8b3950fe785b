"""Ray casting: hits, occlusion and distances against formulas."""

import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanmap.errors import ConfigError
from scanmap.raycast import RayScene, load_open3d
from scanmap.twin.mesh import box, quad

ROOM = (4.0, 3.0, 2.5)
unit = st.floats(0.05, 0.95)
part = st.integers(-1000, 1000).map(lambda k: k / 1000)


@pytest.fixture(scope="module")
def room() -> RayScene:
    mesh = box(np.array(ROOM) / 2, ROOM, inward=True)
    return RayScene(mesh.vertices, mesh.triangles)


@settings(deadline=None, max_examples=60)
@given(start=st.tuples(unit, unit, unit), way=st.tuples(part, part, part).filter(lambda w: np.linalg.norm(w) > 0.1))
def test_distance_inside_a_box_is_the_slab_formula(
    room: RayScene, start: tuple[float, float, float], way: tuple[float, float, float]
) -> None:
    origin, direction = np.array(start) * ROOM, np.array(way)
    hits = room.cast(origin, direction[None], exact=True)
    with np.errstate(divide="ignore"):
        leaving = np.where(direction > 0, (np.array(ROOM) - origin) / direction, -origin / direction)
    expected = np.min(leaving[direction != 0])
    # The triangle met beside an edge may be the neighbour's: the float32 ray decides which.
    assert hits.distance[0] == pytest.approx(expected, abs=2e-5)
    assert hits.triangle[0] >= 0


def test_exact_distance_is_exact_away_from_edges(room: RayScene) -> None:
    rng = np.random.default_rng(3)
    targets = np.stack([np.full(500, ROOM[0]), rng.uniform(0.1, 2.9, 500), rng.uniform(0.1, 2.4, 500)], axis=1)
    origin = np.array([0.7, 1.1, 0.9])
    directions = (targets - origin) / np.linalg.norm(targets - origin, axis=1, keepdims=True)
    exact = room.cast(origin, directions, exact=True)
    np.testing.assert_allclose(exact.distance, np.linalg.norm(targets - origin, axis=1), atol=1e-12)
    quick = room.cast(origin, directions)
    np.testing.assert_allclose(quick.distance, exact.distance, atol=5e-6)


def test_barycentric_coordinates_give_the_point() -> None:
    rng = np.random.default_rng(4)
    scene = RayScene([[0, 0, 0], [2, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    u, v = rng.uniform(0.05, 0.45, (2, 50))
    goal = u[:, None] * [2.0, 0, 0] + v[:, None] * [0, 1.0, 0]
    hits = scene.cast([0.5, 0.4, 3.0], goal - [0.5, 0.4, 3.0])
    np.testing.assert_allclose(hits.uv, np.stack([u, v], axis=1), atol=1e-5)
    np.testing.assert_allclose(hits.distance, 1.0, atol=1e-6)


def test_a_ray_that_meets_nothing_says_so(room: RayScene) -> None:
    hits = room.cast([10.0, 0.0, 0.0], [[1.0, 0.0, 0.0], [-1.0, 0.1, 0.1]], exact=True)
    assert hits.distance[0] == np.inf and hits.triangle[0] == -1
    assert np.isfinite(hits.distance[1]) and hits.triangle[1] >= 0


def test_a_plate_hides_what_is_behind_it_and_not_what_is_beside_it() -> None:
    plate = quad([1.0, -0.5, -0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    scene = RayScene(plate.vertices, plate.triangles)
    targets = [[2.0, 0.0, 0.0], [2.0, 1.2, 0.0], [1.0, 0.2, 0.1], [0.9, 0.0, 0.0]]
    hidden = scene.occluded([0.0, 0.0, 0.0], targets)
    # Behind; beside; on the plate itself; before it.
    assert hidden.tolist() == [True, False, False, False]


def test_margin_decides_what_counts_as_the_target_itself() -> None:
    plate = quad([1.0, -0.5, -0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    scene = RayScene(plate.vertices, plate.triangles)
    assert scene.occluded([0.0, 0.0, 0.0], [[1.002, 0.0, 0.0]])[0]
    assert not scene.occluded([0.0, 0.0, 0.0], [[1.002, 0.0, 0.0]], margin_m=0.005)[0]


def test_distance_to_the_surface(room: RayScene) -> None:
    points = [[2.0, 1.5, 1.0], [0.1, 1.5, 1.0], [5.0, 1.5, 1.0], [5.0, 4.0, 1.0]]
    np.testing.assert_allclose(room.distance(points), [1.0, 0.1, 1.0, np.sqrt(2.0)], atol=1e-6)


def test_a_mesh_without_triangles_is_refused() -> None:
    with pytest.raises(ConfigError, match="no triangles"):
        RayScene(np.zeros((5, 3)), np.zeros((0, 3)))


def test_interrupt_waits_until_the_library_is_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "open3d.py").write_text("import signal\nsignal.raise_signal(signal.SIGINT)\nwhole = True\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            load_open3d.__wrapped__()
        assert sys.modules["open3d"].whole
    finally:
        signal.signal(signal.SIGINT, before)
        sys.modules.pop("open3d", None)
