"""What the twin says is true, held against formulas."""

import numpy as np
import pytest

from scanmap.calibration import Calibration, CalibrationFile, HeadTable, ImageTable
from scanmap.geometry import rotation_z
from scanmap.twin import LaserParams, LightParams, RoomParams, Truth, build_scene

BEARINGS = np.radians([0.0, 20.0, 75.0, 130.0])


def head() -> Calibration:
    file = CalibrationFile(
        image=ImageTable(width=800, height=600), head=HeadTable(baseline_m=0.08, beta_deg=25.7, alpha_deg=32.3)
    )
    return file.build()


def truth_of(room: RoomParams, light: LightParams | None = None) -> Truth:
    return Truth(build_scene(room, light or LightParams(ambient=0.0)), head(), LaserParams())


@pytest.fixture(scope="module")
def box() -> Truth:
    return truth_of(RoomParams(room="box", scanner_position_m=(2.0, 1.0), scanner_height_m=1.0))


@pytest.fixture(scope="module")
def furnished() -> Truth:
    return truth_of(RoomParams())


def test_distance_to_the_box_is_the_distance_to_its_nearest_wall(box: Truth) -> None:
    points = np.random.default_rng(0).uniform([-1.9, -0.9, -0.9], [1.9, 1.9, 1.4], (300, 3))
    to_walls = np.min([points @ wall.normal + wall.d for wall in box.walls], axis=0)
    np.testing.assert_allclose(box.distance(points), to_walls, atol=1e-5)
    assert box.distance(np.empty((0, 3))).shape == (0,)
    assert box.area_m2 == pytest.approx(12.0)


def test_lit_and_seen_points_lie_on_surface_and_laser_plane_in_their_row(furnished: Truth) -> None:
    lit = furnished.lit_and_seen(BEARINGS)
    calibration = head()
    assert furnished.distance(lit.points).max() < 1e-5
    T_camera_head = np.linalg.inv(calibration.T_head_camera)
    for k, bearing in enumerate(BEARINGS):
        own = lit.bearing_index == k
        in_head = lit.points[own] @ rotation_z(bearing)
        np.testing.assert_allclose(in_head[:, 1], 0.0, atol=1e-9)
        pixel = calibration.intrinsics.project(in_head @ T_camera_head[:3, :3].T + T_camera_head[:3, 3])
        np.testing.assert_array_equal(np.rint(pixel[:, 1]), lit.row[own])
        assert pixel[:, 0].min() > -0.5 and pixel[:, 0].max() < 799.5
        assert len(np.unique(lit.row[own])) > 400
        assert len(np.unique(lit.row[own] * 1000 + lit.thing[own])) == own.sum()


def test_a_perfect_cloud_is_perfect_and_half_of_it_is_half_complete(box: Truth) -> None:
    lit = box.lit_and_seen(BEARINGS)
    report = box.compare(lit.points, BEARINGS)
    assert report.points == len(lit.points)
    assert report.median_m < 1e-6 and report.p95_m < 1e-5
    assert report.within_1cm == report.completeness == 1.0 and report.beyond_10cm == 0.0
    half = box.compare(lit.points[lit.bearing_index < 2], BEARINGS)
    assert half.completeness == pytest.approx((lit.bearing_index < 2).mean(), abs=0.01)


def test_errors_are_measured_as_they_are(box: Truth) -> None:
    lit = box.lit_and_seen(BEARINGS[:1]).points
    wall = lit[np.abs(lit[:, 0] - 2.0) < 1e-6]
    moved = (wall - [0.03, 0.0, 0.0])[np.abs(wall[:, 2] - 0.25) < 0.8]
    moved[: round(0.07 * len(moved)), 0] -= 0.27  # the worst twentieth is among them, the worst tenth is not
    report = box.compare(np.concatenate([moved, [[np.nan, 0, 0]]]), BEARINGS[:1])
    share = (moved[:, 0] < 1.8).mean()
    assert report.points == len(moved)
    assert report.median_m == pytest.approx(0.03, abs=1e-6)
    assert report.p95_m == pytest.approx(0.30, abs=1e-6)
    assert report.within_1cm == 0.0
    assert report.beyond_10cm == pytest.approx(share)


def test_nothing_measured_is_nothing_complete(box: Truth) -> None:
    report = box.compare(np.empty((0, 3)), BEARINGS)
    assert report.points == 0 and report.completeness == 0.0
    assert np.isnan(report.median_m) and np.isnan(report.within_1cm)


def test_a_bright_window_is_not_asked_for() -> None:
    bearings = np.radians(np.arange(105.0, 118.0))
    names = {}
    for light in (LightParams(ambient=0.0), LightParams(ambient=0.0, window=True)):
        truth = truth_of(RoomParams(), light)
        things = build_scene(RoomParams(), light).room.things
        names[light.window] = {things[k].name for k in np.unique(truth.lit_and_seen(bearings).thing)}
    assert "blind" in names[False]
    assert names[True] == names[False] - {"blind"}


def test_outline_of_the_box_is_its_footprint(box: Truth) -> None:
    segments = box.outline(-0.5, -0.5)
    assert box.footprint is not None
    perimeter = np.linalg.norm(np.roll(box.footprint, -1, axis=0) - box.footprint, axis=1).sum()
    # Two cuts at the same height.
    assert np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum() == pytest.approx(2 * perimeter, rel=1e-5)
    on_wall = np.min(np.abs([segments.reshape(-1, 2) @ w.normal[:2] + w.d for w in box.walls[:4]]), axis=0)
    assert on_wall.max() < 1e-6


def test_occupied_cells_of_the_box_are_its_border(box: Truth) -> None:
    cells = box.occupancy(-0.5, 0.3, (-2.025, -1.025), 0.05, (70, 100))
    expected = np.zeros((70, 100), bool)
    expected[0:61, 0:81] = True
    expected[1:60, 1:80] = False
    np.testing.assert_array_equal(cells, expected)


def test_occupancy_knows_what_stands_at_which_height(furnished: Truth) -> None:
    """Nothing stands in the doorway but its lintel; the column stands from floor to ceiling."""
    grid = {"origin": (-2.0, -0.42), "resolution_m": 0.05, "shape": (60, 80)}
    # Cell of the door's middle: room (2.97, 3.0) less the scanner's place.
    door = (int(3.0 / 0.05) - 1, int(2.97 / 0.05))
    low = furnished.occupancy(-0.72, -0.68, **grid)
    high = furnished.occupancy(1.2, 1.3, **grid)
    assert not low[door[0] - 1 : door[0] + 1, door[1]].any()
    lintel = furnished.occupancy(1.2, 1.3, (-2.0, -0.42), 0.05, (62, 80))
    assert lintel[59:61, door[1]].any()
    column = (int(1.42 / 0.05), int(1.12 / 0.05))
    around = (slice(column[0] - 3, column[0] + 4), slice(column[1] - 3, column[1] + 4))
    assert low[around].sum() >= 8 and high[around].sum() >= 8
