"""The floor: found where it is, levelled, and honest where it is not in view."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rooms_by_rays import scan_room

from scanmap.geometry import rotation_x, rotation_y, transform
from scanmap.grid import Floor, find_floor

ROOM = ((-2.0, -1.5, 0.0), (3.0, 2.5, 2.6))
TABLE = ((0.9, -0.4, 0.70), (1.9, 0.6, 0.75))


@settings(max_examples=15, deadline=None)
@given(lean_x=st.floats(-5, 5), lean_y=st.floats(-5, 5), height=st.floats(0.5, 1.1))
def test_a_leaning_scanner_finds_the_floor_it_stands_over(lean_x, lean_y, height):
    R = rotation_y(np.radians(lean_y)) @ rotation_x(np.radians(lean_x))
    rng = np.random.default_rng(0)
    scan = scan_room(
        np.arange(0, 360, 10), ROOM, [TABLE], rows=200, R_room_world=R, laser_height=height, noise=3e-4, rng=rng
    )
    floor = find_floor(scan)
    assert floor.how == "fitted"
    assert np.degrees(np.arccos(floor.plane[:3] @ R.T[:, 2])) < 0.1
    assert floor.laser_height_m == pytest.approx(height, abs=0.004)
    assert 0.0001 < floor.sigma_m < 0.01


def test_a_table_top_is_not_the_floor_though_it_has_more_points():
    table = ((0.5, -1.4, 0.50), (2.0, 2.4, 0.55))
    scan = scan_room(np.arange(-60, 90, 2), ROOM, [table], rows=300)
    assert find_floor(scan).laser_height_m == pytest.approx(1.0, abs=0.002)


def test_two_tables_of_different_heights_are_no_leaning_layer():
    """A plane through both tops holds more points than the strip of floor that a narrow lens sees behind them."""
    tables = [((0.91, -1.301, 0.626), (1.71, -0.501, 0.656)), ((1.256, -0.026, 0.707), (2.056, 0.774, 0.737))]
    boxes = [
        ((1.839, -1.483, 0.0), (3.3, -1.183, 0.336)),
        ((2.3, 1.104, 0.0), (3.3, 1.404, 0.385)),
        ((2.042, 0.685, 0.0), (3.3, 0.985, 0.426)),
    ]
    scan = scan_room(
        np.arange(-60, 61),
        ((-2.0, -2.5, 0.0), (3.11, 2.5, 2.6)),
        tables + boxes,
        rows=500,
        half_view_deg=19.5,
        noise=3e-4,
        rng=np.random.default_rng(162),
    )
    floor = find_floor(scan)
    assert (floor.how, floor.tilt_deg < 0.2) == ("fitted", True)
    assert floor.laser_height_m == pytest.approx(1.0, abs=0.003)


def test_a_single_bearing_gives_the_height_and_does_not_invent_a_tilt():
    floor = find_floor(scan_room(np.array([0.0]), ((-2, -1.5, 0), (5, 2.5, 2.6)), rows=600))
    assert (floor.how, floor.tilt_deg < 0.05) == ("fitted", True)
    assert floor.laser_height_m == pytest.approx(1.0, abs=0.002)


# From many bearings of a room to ten of what a lens of 15 deg sees of the floor, 3.7 m away and farther.
VIEWS = [
    (np.arange(0, 180, 2), ROOM, 25.0, 3e-4, 0.001),
    (np.arange(0, 180, 2), ROOM, 25.0, 1e-3, 0.002),
    (np.arange(60, 120, 6), ((-4.0, -4.0, 0.0), (6.0, 5.0, 2.6)), 15.0, 1e-3, 0.01),
]


@pytest.mark.parametrize(("bearings", "room", "half_view_deg", "noise", "least"), VIEWS)
def test_height_and_tilt_are_as_sure_as_they_say(bearings, room, half_view_deg, noise, least):
    height, tilt, stated = [], [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        lean_x, lean_y = np.radians(rng.normal(0.0, 2.0, 2))
        R = rotation_y(lean_y) @ rotation_x(lean_x)
        scan = scan_room(bearings, room, half_view_deg=half_view_deg, R_room_world=R, noise=noise, rng=rng)
        floor, up = find_floor(scan), R.T[:, 2]
        if floor.how != "fitted":  # it leans so that the narrow lens looks over the floor, and says so
            continue
        off = np.degrees(np.hypot(*(floor.plane[:2] / floor.plane[2] - up[:2] / up[2])))
        height.append((floor.plane[3] / floor.plane[2] - 1.0 / up[2]) / floor.height_sigma_m)
        tilt.append(off / floor.tilt_sigma_deg)
        stated.append(floor.height_sigma_m)
    assert len(stated) >= 14
    assert 0.3 < np.sqrt(np.mean(np.square(height))) < 1.3
    assert 0.3 < np.sqrt(np.mean(np.square(tilt))) < 1.3
    assert np.median(stated) < least


def test_one_bearing_says_that_it_does_not_tell_a_table_from_the_floor():
    scan = scan_room(np.array([0.0]), ROOM, [((0.5, -1.4, 0.5), (2.9, 2.4, 0.55))], rows=600)
    floor = find_floor(scan)
    assert (floor.how, floor.tilt_sigma_deg) == ("fitted", pytest.approx(2.0, abs=0.1))
    assert "too little is in view to tell it from a table; set grid.laser_height_m" in floor.words
    assert find_floor(scan, laser_height_m=1.0).how == "given"
    whole = find_floor(scan_room(np.arange(0, 180, 6), ROOM, rows=300), laser_height_m=0.7)
    assert (whole.how, "from a table" in whole.words) == ("fitted", False)


@pytest.mark.parametrize("given_height", [None, 1.0])
def test_without_a_floor_in_view_it_says_what_was_taken_instead(given_height):
    scan = scan_room(np.arange(0, 180, 3), ROOM, half_view_deg=13.0)
    floor = find_floor(scan, laser_height_m=given_height)
    if given_height is None:
        assert floor.how == "lowest"
        assert floor.laser_height_m == pytest.approx(-np.nanmin(scan.points[..., 2]), abs=0.1)
        assert "lowest points" in floor.words
    else:
        assert (floor.how, floor.laser_height_m) == ("given", 1.0)
        assert "as configured" in floor.words
    assert np.isnan(floor.sigma_m)


def test_a_scan_without_points_has_a_floor_at_the_laser():
    scan = scan_room(np.array([0.0, 5.0]), ROOM, range_max=0.1)
    assert find_floor(scan).how == "lowest"
    assert find_floor(scan).laser_height_m == 0.0


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.1, 2.0))
def test_levelling_brings_every_point_of_the_plane_to_height_zero(a, b, height):
    normal = np.array([a, b, 1.0]) / np.sqrt(a * a + b * b + 1.0)
    floor = Floor(np.append(normal, height), 0.001, 100, "fitted")
    T = floor.T_level_world
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(T[:3, :3] @ normal, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(transform(T, -height * normal)[2], 0.0, atol=1e-12)
    np.testing.assert_allclose(transform(T, np.zeros(3)), [0, 0, height], atol=1e-12)
