"""The occupancy grid against rooms whose truth is known."""

import numpy as np
import pytest
from analytic_scan import box_scan
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from rooms_by_rays import scan_room

from scanmap.geometry import HeadMount, rotation_x, rotation_y
from scanmap.grid import GridParams, OccupancyGrid, find_floor
from scanmap.grid.evidence import polar_evidence
from scanmap.laserline import Reason
from scanmap.scan import Scan

# Off the cells' borders and different on every side: a mirrored or shifted grid cannot pass.
ROOM = ((-1.52, -0.63, 0.0), (3.11, 2.42, 2.6))
CELL = 0.05


def scan_of(bearings=None, room=ROOM, boxes=(), **kwargs):
    bearings = np.arange(0, 360, 1.0) if bearings is None else bearings
    return scan_room(bearings, room, boxes, **kwargs)


def grid_of(*args, params=None, **kwargs):
    return OccupancyGrid.from_scan(scan_of(*args, **kwargs), params)


def places(grid, mask):
    """(N, 2) centres of the cells of `mask`."""
    x, y = grid.centres()
    row, col = np.nonzero(mask)
    return np.stack([x[col], y[row]], axis=1)


def outside(xy, room=ROOM):
    """How far (N,) places lie outside of the room; negative inside."""
    low, high = np.array(room[0][:2]), np.array(room[1][:2])
    return np.maximum(low - xy, xy - high).max(axis=1)


def at(grid, x, y):
    """-1, 0 or 100 at a place."""
    row, col = grid.index(x, y)
    inside = 0 <= row < grid.shape[0] and 0 <= col < grid.shape[1]
    return int(grid.to_ros()[row, col]) if inside else -1


def assert_walls_closed(grid, room=ROOM, reach=CELL):
    """Every centimetre of the four walls has an occupied cell within one cell of it."""
    low, high = np.array(room[0][:2]), np.array(room[1][:2])
    occupied = places(grid, grid.occupied)
    s = np.arange(0.05, 0.96, 0.01)[:, None]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        gap = np.linalg.norm((a + s * (b - a))[:, None] - occupied, axis=2).min(axis=1)
        assert gap.max() <= reach, f"wall {a} to {b} open by {gap.max():.3f} m"


@pytest.mark.parametrize("step", [0.25, 1.0, 6.0])
@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (-0.3, 0.05, 0.0), (0.1, -0.2, 0.0)])
def test_walls_are_in_place_and_closed_and_nothing_behind_them_is_free(step, offset):
    grid = grid_of(np.arange(0, 360, step), mount=HeadMount(offset), rows=150)
    assert np.abs(outside(places(grid, grid.occupied))).max() <= CELL
    assert outside(places(grid, grid.free)).max() < 0
    assert_walls_closed(grid)


def test_noise_leaning_and_offset_together_keep_the_walls_within_a_cell():
    R = rotation_x(np.radians(2.0)) @ rotation_y(np.radians(-1.5))
    rng = np.random.default_rng(3)
    scan = scan_of(rows=400, mount=HeadMount((0.1, 0.0, 0.0)), R_room_world=R, noise=1e-3, rng=rng)
    grid = OccupancyGrid.from_scan(scan)
    assert grid.floor.how == "fitted"
    near = np.abs(outside(places(grid, grid.occupied))) <= CELL
    assert near.mean() > 0.99
    assert outside(places(grid, grid.free)).max() < 0
    assert_walls_closed(grid, reach=1.5 * CELL)


def test_floor_and_ceiling_are_no_obstacles_but_free_the_space_before_them():
    grid = grid_of()
    inside = places(grid, grid.occupied)
    assert np.all(outside(inside) > -CELL)
    truly_free = (outside(places(grid, np.ones(grid.shape, bool))) < -CELL).sum()
    blind = np.pi * 0.95**2 / CELL**2  # where the view is narrower than 60 % of the band
    assert grid.free.sum() > 0.98 * (truly_free - blind)


def test_without_height_to_look_through_nothing_near_is_called_free():
    """25 deg up and down at 0.5 m see half a metre of a band of 1.7 m: a box on the floor would be missed."""
    low_box = ((0.3, -0.2, 0.0), (0.6, 0.2, 0.4))
    grid = grid_of(boxes=[low_box])
    assert at(grid, 0.45, 0.0) == -1
    assert at(grid_of(boxes=[low_box], params=GridParams(height_low_m=0.85, height_high_m=1.2)), 0.45, 0.0) == 0


def test_a_missing_return_is_unknown_never_free():
    grid = grid_of(lost=lambda b, rows: (rows >= 0) & (40 <= b <= 60))
    for bearing in (42, 50, 58):
        for r in (0.5, 1.2, 2.0, 2.4):
            assert at(grid, r * np.cos(np.radians(bearing)), r * np.sin(np.radians(bearing))) == -1
    assert at(grid, 1.2, 0.2) == 0


@pytest.mark.parametrize(("share", "free"), [(0.3, True), (0.5, False)])
def test_through_gap_rule(share, free):
    """Lost rows, every n-th, leave the rest; less than 60 % of the band's elevations prove nothing."""
    pattern = np.random.default_rng(1).permutation(300) < 300 * share
    grid = grid_of(lost=lambda _, rows: pattern[rows])
    # At 2 m the view of 50 deg covers the band of 44 deg whole.
    assert (at(grid, 2.0, 0.0) == 0) is free
    assert at(grid, 3.13, 0.0) == 100


def test_a_doorway_is_free_and_so_is_the_corridor_behind_it():
    wall = [((1.5, -0.63, 0), (1.6, 0.4, 2.6)), ((1.5, 1.2, 0), (1.6, 2.42, 2.6))]
    grid = grid_of(boxes=wall)
    for x in (1.4, 1.55, 2.0, 2.9):
        assert at(grid, x, 0.5 * x) == 0, x
    assert at(grid, 1.525, 0.2) == 100
    assert at(grid, 2.2, 0.2) == -1
    # Behind the wall only what lies within the sight lines through the door may be free.
    behind = places(grid, grid.free)
    behind = behind[behind[:, 0] > 1.6 + CELL]
    angle = np.arctan2(behind[:, 1], behind[:, 0])
    assert angle.min() > np.arctan2(0.4, 1.6)
    assert angle.max() < np.arctan2(1.2, 1.5)


@pytest.mark.parametrize("step", [1.0, 6.0])
def test_nothing_behind_a_wall_is_free_at_its_ends(step):
    """The doorway's jambs at coarse steps: half a step may not reach round the corner."""
    wall = [((1.5, -0.63, 0), (1.6, 0.4, 2.6)), ((1.5, 1.2, 0), (1.6, 2.42, 2.6))]
    grid = grid_of(np.arange(2, 362, step), boxes=wall)
    behind = places(grid, grid.free)
    behind = behind[behind[:, 0] > 1.6]
    angle = np.arctan2(behind[:, 1], behind[:, 0])
    assert np.all((angle > np.arctan2(0.4, 1.6)) & (angle < np.arctan2(1.2, 1.5)))


def test_a_table_is_an_obstacle_though_one_can_look_under_and_over_it():
    table = ((1.3, 0.3, 0.70), (2.1, 1.1, 0.75))
    grid = grid_of(np.arange(0, 360, 0.5), boxes=[table], rows=600)
    top = places(grid, np.ones(grid.shape, bool))
    top = top[(np.abs(top - [1.7, 0.7]) < 0.4 - CELL).all(axis=1)]
    values = np.array([at(grid, *p) for p in top])
    assert (values == 100).mean() > 0.95
    assert not (values == 0).any()
    # The rows over and under it do not speak against the rows of the same bearing that hit it.
    single = grid_of(np.array([22.0]), boxes=[table], rows=600)
    assert at(single, 1.6, 1.6 * np.tan(np.radians(22))) == 100
    assert at(single, 2.4, 2.4 * np.tan(np.radians(22))) == 0
    assert set(np.unique(single.log_odds)) == {np.float32(0.85), np.float32(0.0), np.float32(-0.4)}
    assert at(grid, 2.8, 1.15) == 0  # seen over the table and under it


def test_a_low_ceiling_lamp_above_the_band_is_no_obstacle():
    lamp = ((1.0, -0.1, 1.9), (1.3, 0.2, 2.0))
    assert at(grid_of(boxes=[lamp]), 1.15, 0.05) == 0


def test_the_grid_is_neither_mirrored_nor_turned():
    post = ((1.02, 1.52, 0.0), (1.22, 1.72, 2.2))
    grid = grid_of(boxes=[post])
    assert at(grid, 1.03, 1.53) == 100
    assert at(grid, 1.03, -0.53) == 0
    assert at(grid, -1.03, 1.53) == 0
    rows, cols = grid.shape
    assert grid.origin[0] == pytest.approx(-1.52, abs=4 * CELL)
    assert grid.origin[1] == pytest.approx(-0.63, abs=4 * CELL)
    assert grid.origin[0] + cols * CELL == pytest.approx(3.11, abs=4 * CELL)
    assert grid.origin[1] + rows * CELL == pytest.approx(2.42, abs=4 * CELL)


def test_wide_gaps_between_bearings_stay_unknown():
    grid = grid_of(np.arange(0, 360, 20.0))
    r = 2.0
    on, between = np.radians([40.0, 50.0])
    assert at(grid, r * np.cos(on), r * np.sin(on)) == 0
    assert at(grid, r * np.cos(between), r * np.sin(between)) == -1


def test_coarse_bearings_leave_no_holes_in_the_free_space():
    grid = grid_of(np.arange(0, 360, 6.0))
    xy = places(grid, np.ones(grid.shape, bool))
    well_inside = (outside(xy) < -2 * CELL) & (np.linalg.norm(xy, axis=1) > 1.0)
    assert grid.free.ravel()[well_inside].all()


def test_order_of_bearings_and_passes_does_not_matter():
    bearings = np.arange(0, 180, 2.0)
    forward = grid_of(bearings)
    shuffled = grid_of(np.random.default_rng(0).permutation(bearings))
    np.testing.assert_array_equal(forward.log_odds, shuffled.log_odds)


@settings(max_examples=10, deadline=None)
@given(st.integers(20, 340))
def test_a_growing_scan_keeps_what_it_knows(count):
    """More bearings add evidence; what two of them agree on does not turn over."""
    whole = scan_of(rows=100)
    part = OccupancyGrid.from_scan(whole.taken(np.arange(count)))
    grown = OccupancyGrid.from_scan(whole)
    xy = places(part, part.log_odds > 1.0)
    assert len(xy)
    assert not any(at(grown, *p) == 0 for p in xy)


@settings(max_examples=10, deadline=None)
@given(st.integers(1, 3), st.sampled_from(["octomap", "cartographer"]))
def test_evidence_grows_with_every_pass_up_to_the_clamp(passes, model):
    bearings = np.arange(0, 90, 2.0)
    params = GridParams(evidence=model)
    once = grid_of(bearings, rows=80, params=params)
    more = grid_of(np.concatenate([bearings] * passes), rows=80, params=params)
    assert once.shape == more.shape
    assert np.all(more.log_odds[once.occupied] >= once.log_odds[once.occupied])
    inner = once.free & (outside(places(once, np.ones(once.shape, bool))) < -2 * CELL).reshape(once.shape)
    assert np.all(more.log_odds[inner] <= once.log_odds[inner])
    assert np.any(more.log_odds[inner] < once.log_odds[inner]) == (passes > 1)
    low, high = (-2.0, 3.5) if model == "octomap" else (np.log(0.1 / 0.9), np.log(0.9 / 0.1))
    assert more.log_odds.min() >= np.float32(low)
    assert more.log_odds.max() <= np.float32(high)


def test_one_bearing_is_one_piece_of_evidence_however_many_rows_it_has():
    few, many = (grid_of(np.array([0.0]), rows=rows) for rows in (100, 1200))
    for grid in (few, many):
        assert set(np.unique(grid.log_odds)) == {np.float32(0.85), np.float32(0.0), np.float32(-0.4)}
        assert at(grid, 3.12, 0.0) == 100
        assert at(grid, 2.0, 0.0) == 0


def test_a_single_stray_row_is_no_obstacle():
    scan = scan_of(np.array([0.0, 2.0, 4.0]))
    scan.points[1, 150] *= 0.5
    grid = OccupancyGrid.from_scan(scan)
    assert not (places(grid, grid.occupied)[:, 0] < 3.0).any()


def test_free_space_begins_where_the_view_covers_its_share_of_the_band():
    """From 1 m up, the band of 0.1 to 1.8 m spans atan(0.9 / r) + atan(0.8 / r), of which 60 % must be seen.

    A camera's rows are even in the tangent of their elevation, not in the elevation that counts.
    """
    scan = box_scan(np.array([0.0]), 480, room=((-1.0, -1.0, -1.0), (3.1, 1.0, 1.6)))
    found = polar_evidence(scan, find_floor(scan), GridParams())
    above, below = np.abs(np.arctan2(scan.points[0, [0, -1], 2], scan.points[0, [0, -1], 0]))
    r = np.arange(0.05, 2.0, 0.001)
    up, down = np.arctan(0.8 / r), np.arctan(0.9 / r)
    first = r[np.argmax(np.minimum(up, above) + np.minimum(down, below) >= 0.6 * (up + down))]
    assert found.free_from[0] == pytest.approx(first, abs=1.5 * CELL / 3)


def test_a_thing_close_before_a_far_wall_is_told_from_the_walls_noise():
    """At 5 m rows scatter by 25 mm; what 80 mm before the wall is seen by a third as many rows is no part of it."""
    room, fine = ((-1.0, -1.0, 0.0), (5.0, 1.0, 2.6)), GridParams(resolution_m=0.02)
    box = ((4.92, -0.5, 0.0), (5.0, 0.5, 0.55))
    with_box, without = (
        grid_of(
            np.arange(-4, 5, 1.0), room=room, boxes=boxes, params=fine,
            rows=600, noise=1e-3, rng=np.random.default_rng(2),
        )
        for boxes in ([box], [])
    )  # fmt: skip
    assert at(with_box, 4.925, 0.0) == at(with_box, 5.005, 0.0) == 100
    assert at(without, 5.005, 0.0) == 100
    assert (places(without, without.occupied)[:, 0] > 5.0 - 2.5 * 0.025).all()


def test_empty_and_hopeless_scans_give_an_unknown_grid():
    empty = Scan(HeadMount(), 100)
    blank = scan_of(np.arange(0, 20, 1.0)).without(np.ones((20, 300), bool), Reason.WEAK)
    for scan in (empty, blank):
        grid = OccupancyGrid.from_scan(scan)
        assert grid.unknown.all()
        assert grid.log_odds.size > 0


def test_the_floor_and_the_comments_come_with_the_grid():
    grid = grid_of()
    assert grid.floor.how == "fitted"
    assert grid.comments == {"source": "digital twin"}
    np.testing.assert_array_equal(np.unique(grid.to_ros()), [-1, 0, 100])
    np.testing.assert_allclose(grid.probability(), 1 / (1 + np.exp(-grid.log_odds.astype(float))), rtol=1e-5)


@pytest.mark.parametrize(
    "wrong", [{"resolution_m": 0}, {"height_low_m": 2.0}, {"evidence": "karto"}, {"min_coverage": 1.2}, {"cell": 1}]
)
def test_impossible_parameters_are_refused(wrong):
    with pytest.raises(ValidationError):
        GridParams(**wrong)
