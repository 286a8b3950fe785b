"""Filter, normals and mesh of the range image, on rooms whose surfaces are known."""

import numpy as np
import pytest
from analytic_scan import ROOM, box_scan
from hypothesis import given, settings
from hypothesis import strategies as st

from scanmap.geometry import HeadMount
from scanmap.laserline import Reason
from scanmap.scan import Scan, ScanParams
from scanmap.scan.links import is_full_turn
from scanmap.scan.mesh import mesh
from scanmap.scan.surface import normals, remove_outliers

FIELDS = ("points", "range_m", "sigma_m", "intensity", "column_px", "reason")
HALF_TURN = np.arange(0.0, 181.0, 2.0)
FULL_TURN = np.arange(0.0, 360.0, 2.0)
LEG = ((0.9, 0.29, -0.5), (0.92, 0.31, 0.4))
CABINET = ((0.3, 0.8, -0.5), (1.2, 1.3, 0.2))


def stretched(scan, cells, factor):
    """A copy whose points at `cells` lie at `factor` times their range on the same ray, as a wrong line puts them."""
    fields = {name: getattr(scan, name).copy() for name in FIELDS}
    origin = scan.origins[:, None].astype(np.float32)
    factor = np.where(cells, factor, 1.0).astype(np.float32)
    fields["points"] = origin + (fields["points"] - origin) * factor[..., None]
    fields["range_m"] = fields["range_m"] * factor
    fields["sigma_m"] = fields["sigma_m"] * factor**2
    return Scan.from_arrays(scan.mount, scan.bearings.copy(), fields, scan.comments)


def on_box(scan, box, margin=0.02):
    low, high = np.array(box)
    with np.errstate(invalid="ignore"):
        return ((scan.points > low - margin) & (scan.points < high + margin)).all(axis=-1)


def surface_of(points):
    """The unit normal into the room of the wall, floor or ceiling nearest to each point, and the distance to it."""
    low, high = np.array(ROOM)
    gaps = np.concatenate([points - low, high - points], axis=-1)
    inward = np.concatenate([np.eye(3), -np.eye(3)])
    return inward[np.abs(gaps).argmin(axis=-1)], np.sort(np.abs(gaps), axis=-1)


def lost(before, after):
    return before.valid & ~after.valid


# --- outliers


@given(
    step=st.sampled_from([0.25, 1.0, 2.5, 6.0]),
    sigma=st.sampled_from([0.0, 0.02, 0.1, 0.3]),
    seed=st.integers(0, 99),
)
@settings(max_examples=12, deadline=None)
def test_a_room_keeps_its_points_at_any_step_and_noise(step, sigma, seed):
    scan = box_scan(np.arange(0.0, 60.0 * step, step), 240, boxes=[CABINET], sigma_px=sigma, seed=seed)
    assert lost(scan, remove_outliers(scan)).sum() <= 1e-3 * scan.valid.sum()


def test_a_corridor_floor_seen_at_a_grazing_angle_stays():
    corridor = ((-1.0, -0.6, -0.3), (30.0, 0.6, 1.5))
    scan = box_scan(np.arange(-10.0, 10.0, 0.5), 1200, room=corridor, sigma_px=0.05)
    far_floor = (np.abs(scan.points[..., 2] + 0.3) < 0.2) & (scan.range_m > 5.0)
    steps = np.abs(np.diff(scan.range_m, axis=1))
    assert far_floor.sum() > 500
    assert np.nanmax(steps) > 0.15  # rows are decimetres apart there, and still one floor
    assert not (lost(scan, remove_outliers(scan)) & far_floor).any()


def test_a_chair_leg_one_bearing_wide_stays():
    scan = box_scan(FULL_TURN, 300, boxes=[LEG], sigma_px=0.03)
    leg = on_box(scan, LEG)
    assert (leg.any(axis=1)).sum() == 1
    assert leg.sum() > 100
    assert not (lost(scan, remove_outliers(scan)) & leg).any()


def test_a_wire_one_row_high_stays():
    scan = box_scan(np.arange(-30.0, 30.0, 1.0), 300, sigma_px=0.02)
    wire = np.zeros(scan.valid.shape, bool)
    wire[10:50, 120] = True
    scan = stretched(scan, wire, 0.6)
    assert not (lost(scan, remove_outliers(scan)) & wire).any()


def test_flying_pixels_between_two_surfaces_go():
    scan = box_scan(np.arange(40.0, 100.0, 1.0), 300, boxes=[CABINET], sigma_px=0.03)
    front = on_box(scan, CABINET)
    rows = np.arange(scan.rows)
    top = np.where(front.any(axis=1), np.where(front, rows, 999).min(axis=1), 0)
    flying = np.zeros(scan.valid.shape, bool)
    for k in np.flatnonzero((top > 2) & (np.arange(len(scan)) % 3 == 0)):
        gap = scan.range_m[k, top[k] - 2] / scan.range_m[k, top[k]]
        flying[k, top[k] - 1] = gap > 1.3
    assert flying.sum() >= 8
    between = stretched(scan, flying, 0.85 * np.ones(scan.valid.shape))
    removed = lost(between, remove_outliers(between))
    assert removed[flying].all()
    assert removed[~flying].sum() <= 2


def test_a_row_of_flying_pixels_goes_though_it_lies_in_line():
    scan = box_scan(np.arange(-30.0, 30.0, 1.0), 300, sigma_px=0.02)
    factor = np.ones(scan.valid.shape)
    factor[10:50, 120:160] = 0.5
    factor[10:50, 119] = factor[10:50, 160] = 0.75
    shelf = stretched(scan, factor < 1.0, factor)
    flying = factor == 0.75
    removed = lost(shelf, remove_outliers(shelf))
    assert removed[flying].all()
    assert not removed[~flying].any()


@given(seed=st.integers(0, 999))
@settings(max_examples=10, deadline=None)
def test_isolated_noise_goes_and_its_neighbours_stay(seed):
    rng = np.random.default_rng(seed)
    scan = box_scan(HALF_TURN, 240, boxes=[CABINET], sigma_px=0.03, seed=seed)
    noise = np.zeros(scan.valid.shape, bool)
    noise[rng.integers(7) :: 7, rng.integers(9) :: 9] = True
    factor = rng.choice([0.4, 0.6, 0.8, 1.3], scan.valid.shape)
    noisy = stretched(scan, noise, factor)
    removed = lost(noisy, remove_outliers(noisy))
    assert removed[noise].mean() > 0.985
    assert removed[~noise].mean() < 1e-3


def test_what_is_removed_says_so_and_the_rest_is_untouched():
    scan = box_scan(HALF_TURN, 120)
    cells = np.zeros(scan.valid.shape, bool)
    cells[20, 30] = True
    noisy = stretched(scan, cells, 0.5)
    clean = remove_outliers(noisy)
    assert clean.reason[20, 30] == Reason.OUTLIER
    assert np.isnan(clean.points[20, 30]).all()
    assert noisy.valid[20, 30]
    np.testing.assert_array_equal(clean.points[~cells], noisy.points[~cells])


def test_points_that_say_next_to_nothing_go_and_hold_nothing_up():
    scan = box_scan(HALF_TURN, 120, sigma_px=0.02)
    vague = np.zeros(scan.valid.shape, bool)
    vague[20:24, 30:50] = True
    fields = {name: getattr(scan, name).copy() for name in FIELDS}
    fields["sigma_m"][vague] = 0.06 * fields["range_m"][vague]
    told = Scan.from_arrays(scan.mount, scan.bearings.copy(), fields, scan.comments)
    # A speck between two of them: they are so unsure that it would lie on their surface.
    cells = np.zeros(scan.valid.shape, bool)
    cells[21, 40] = True
    told.sigma_m[cells] = 1e-4
    told = stretched(told, cells, 0.8)
    clean = remove_outliers(told)
    assert (clean.reason[vague & ~cells] == Reason.WEAK).all()
    assert clean.reason[21, 40] == Reason.OUTLIER
    assert not lost(scan, clean)[~vague].any()
    assert not lost(told, remove_outliers(told, ScanParams(max_sigma_share=0.07)))[vague & ~cells].any()


def test_a_scan_without_points_or_with_one_bearing_passes():
    for scan in (box_scan(HALF_TURN[:0], 20), box_scan(HALF_TURN[:1], 20), box_scan(HALF_TURN[:2], 20, range_max=0.01)):
        assert len(remove_outliers(scan)) == len(scan)
        assert normals(scan).shape == (*scan.valid.shape, 3)
        assert mesh(scan).triangles.shape[1] == 3


# --- normals


@pytest.mark.parametrize("mount", [HeadMount(), HeadMount((0.05, 0.02, 0.1), (1.0, -2.0)), HeadMount((-0.4, 0.0, 0.0))])
def test_normals_of_planes_are_exact_whatever_the_mount(mount):
    scan = box_scan(FULL_TURN, 240, mount=mount)
    normal = normals(scan)
    expected, gaps = surface_of(scan.points)
    inside = gaps[..., 1] > 0.25  # away from the edges between two walls
    assert inside.mean() > 0.4
    np.testing.assert_allclose(normal[inside], expected[inside], atol=2e-3)


@given(seed=st.integers(0, 99))
@settings(max_examples=8, deadline=None)
def test_steps_need_not_be_equal(seed):
    rng = np.random.default_rng(seed)
    scan = box_scan(np.cumsum(rng.uniform(0.3, 4.0, 60)), 200)
    normal = normals(scan)
    expected, gaps = surface_of(scan.points)
    inside = gaps[..., 1] > 0.4
    np.testing.assert_allclose(normal[inside], expected[inside], atol=2e-3)


def test_normals_are_unit_and_face_the_head():
    scan = box_scan(FULL_TURN, 200, boxes=[CABINET, LEG], sigma_px=0.05)
    normal = normals(scan)
    known = np.isfinite(normal[..., 0])
    leg = on_box(scan, LEG)  # one bearing wide: there is no telling which way it faces
    assert known[scan.valid & ~leg].mean() > 0.999
    np.testing.assert_allclose(np.linalg.norm(normal[known], axis=-1), 1.0, atol=1e-5)
    toward = scan.origins[:, None] - scan.points
    assert ((normal * toward).sum(axis=-1)[known] >= 0).all()


def test_noise_turns_normals_by_little():
    scan = box_scan(np.arange(0.0, 180.0, 1.0), 1200, sigma_px=0.05)
    normal = normals(scan)
    expected, gaps = surface_of(scan.points)
    inside = gaps[..., 1] > 0.25
    angle = np.degrees(np.arccos(np.clip((normal * expected).sum(axis=-1)[inside], -1, 1)))
    assert np.median(angle) < 1.0
    assert np.quantile(angle, 0.99) < 4.0


def test_normals_do_not_mix_surfaces_at_a_depth_edge():
    scan = box_scan(np.arange(40.0, 110.0, 1.0), 300, boxes=[CABINET])
    x, y, z = np.moveaxis(scan.points, -1, 0)
    front = on_box(scan, CABINET) & (np.abs(y - 0.8) < 1e-3) & (x > 0.37) & (x < 1.13) & (z > -0.43)
    wall = (np.abs(scan.points[..., 1] - ROOM[1][1]) < 1e-3) & (surface_of(scan.points)[1][..., 1] > 0.25)
    assert front.sum() > 1000
    assert wall.sum() > 1000
    for cells in (front, wall):
        facing = normals(scan)[cells][:, 1]
        assert np.isfinite(facing).mean() > 0.999
        assert np.nanmax(facing) < -0.99


def test_lost_rows_cost_no_normals_beside_them():
    scan = box_scan(HALF_TURN, 300, sigma_px=0.004)
    rng = np.random.default_rng(1)
    holes = scan.without(rng.random(scan.valid.shape) < 0.1, Reason.WEAK)
    normal = normals(holes)
    assert np.isnan(normal[~holes.valid]).all()
    assert np.isfinite(normal[holes.valid]).mean() > 0.995
    expected, gaps = surface_of(holes.points)
    inside = holes.valid & (gaps[..., 1] > 0.25) & np.isfinite(normal[..., 0])
    assert np.quantile((normal * expected).sum(axis=-1)[inside], 0.02) > 0.99


def test_a_lonely_point_has_no_normal():
    scan = box_scan(HALF_TURN, 60)
    mask = np.ones(scan.valid.shape, bool)
    mask[10, 20] = False
    normal = normals(scan.without(mask, Reason.WEAK))
    assert np.isnan(normal).all()


# --- full turn


def test_only_a_full_turn_is_one():
    assert is_full_turn(np.radians(FULL_TURN))
    assert is_full_turn(np.radians(-358.0 + FULL_TURN))
    assert not is_full_turn(np.radians(HALF_TURN))
    assert not is_full_turn(np.radians(FULL_TURN[:-4]))
    assert not is_full_turn(np.radians(FULL_TURN[:2]))


def test_a_full_turn_has_no_seam():
    scan = box_scan(FULL_TURN, 160)
    turned = scan.taken(np.roll(np.arange(len(scan)), 37))
    fields = {name: getattr(turned, name) for name in FIELDS}
    rolled = Scan.from_arrays(scan.mount, np.radians(FULL_TURN) - np.radians(74.0), fields)
    np.testing.assert_allclose(np.roll(normals(scan), 37, axis=0), normals(rolled), atol=2e-5)
    assert len(mesh(scan).triangles) == len(mesh(rolled).triangles)


# --- mesh


def test_a_full_turn_of_a_room_is_a_closed_band_facing_the_head():
    scan = box_scan(FULL_TURN, 160)
    vertices, triangles = mesh(scan)
    assert triangles.dtype == np.int32
    assert len(triangles) == 2 * len(FULL_TURN) * 159
    np.testing.assert_array_equal(vertices, scan.points[scan.valid])
    a, b, c = vertices[triangles].astype(float).swapaxes(0, 1)
    assert ((np.cross(b - a, c - a) * -a).sum(axis=-1) > 0).all()
    # Every edge but those of the first and last row lies between two triangles, and they run it in opposite ways.
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    directed = {tuple(edge) for edge in edges.tolist()}
    assert len(directed) == len(edges)
    border = [edge for edge in directed if edge[::-1] not in directed]
    assert len(border) == 2 * len(FULL_TURN)
    assert {int(v) % 160 for edge in border for v in edge} == {0, 159}


def test_a_half_turn_stays_open():
    scan = box_scan(HALF_TURN, 100)
    assert len(mesh(scan).triangles) == 2 * (len(HALF_TURN) - 1) * 99


def test_the_area_of_the_mesh_is_that_of_the_walls():
    low, high = np.array(ROOM)
    scan = box_scan(np.arange(0.0, 360.0, 1.0), 400, room=((-2.0, -1.5, -9.0), (2.5, 1.8, 9.0)))
    vertices, triangles = mesh(scan)
    a, b, c = vertices[triangles].astype(float).swapaxes(0, 1)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum()
    # Between first and last row a wall is seen over a height that grows with its distance: integrate it by hand.
    heights = np.abs(scan.points[:, 0, 2] - scan.points[:, -1, 2]).astype(float)
    ring = np.append(scan.points[:, 0, :2], scan.points[:1, 0, :2], axis=0).astype(float)
    sides = np.linalg.norm(np.diff(ring, axis=0), axis=1)
    expected = (0.5 * (heights + np.roll(heights, -1)) * sides).sum()
    assert area == pytest.approx(expected, rel=2e-3)
    assert sides.sum() == pytest.approx(2 * (high - low)[:2].sum(), rel=5e-3)


@given(step=st.sampled_from([0.5, 1.0, 2.0, 6.0]), sigma=st.sampled_from([0.0, 0.05]))
@settings(max_examples=8, deadline=None)
def test_no_triangle_spans_a_depth_edge(step, sigma):
    box = ((0.2, 0.5, -0.2), (0.9, 0.7, 0.2))  # hangs in the air: nothing joins it to the room
    scan = box_scan(np.arange(0.0, 120.0, step), 300, boxes=[box], sigma_px=sigma)
    member = on_box(scan, box, 0.05)[scan.valid]
    triangles = mesh(scan).triangles
    count = member[triangles].sum(axis=1)
    assert (count == 3).sum() > 100
    assert np.isin(count, (0, 3)).all()


def test_a_missing_corner_leaves_one_triangle():
    scan = box_scan(np.arange(10.0, 14.0, 1.0), 60)
    full = len(mesh(scan).triangles)
    for corner in [(0, 0), (0, 59), (3, 0), (3, 59)]:
        hole = np.zeros(scan.valid.shape, bool)
        hole[corner] = True
        assert len(mesh(scan.without(hole, Reason.WEAK)).triangles) == full - 1
    inner = np.zeros(scan.valid.shape, bool)
    inner[1, 30] = True
    # Four cells of two triangles shrink to one each; indices stay within the points that are left.
    less = mesh(scan.without(inner, Reason.WEAK))
    assert len(less.triangles) == full - 4
    assert less.triangles.max() == len(less.vertices) - 1


def test_a_camera_upside_down_gives_the_same_side():
    scan = box_scan(HALF_TURN, 80)
    fields = {name: getattr(scan, name)[:, ::-1] for name in FIELDS}
    flipped = Scan.from_arrays(scan.mount, scan.bearings, fields)
    vertices, triangles = mesh(flipped)
    a, b, c = vertices[triangles].astype(float).swapaxes(0, 1)
    assert ((np.cross(b - a, c - a) * -a).sum(axis=-1) > 0).all()


def test_a_thing_on_a_turntable_shows_its_front_and_so_does_the_wall_behind():
    thing = ((-0.10, -0.12, -0.5), (0.13, 0.09, 0.1))
    scan = box_scan(FULL_TURN, 120, boxes=[thing], mount=HeadMount((-0.6, 0.0, 0.0)))
    vertices, triangles = mesh(scan)
    column = np.nonzero(scan.valid)[0]
    a, b, c = vertices[triangles].astype(float).swapaxes(0, 1)
    front = (np.cross(b - a, c - a) * (scan.origins[column[triangles[:, 0]]] - a)).sum(axis=-1) > 0
    on_thing = on_box(scan, thing, 0.005)[scan.valid][triangles].all(axis=1)
    assert on_thing.sum() > 5000
    assert (~on_thing).sum() > 5000
    assert front.all()


def test_the_parameters_reach_the_filter():
    scan = box_scan(np.arange(0.0, 60.0, 1.0), 240)
    cells = np.zeros(scan.valid.shape, bool)
    cells[30, 100] = True
    shifted = stretched(scan, cells, 0.8)
    assert lost(shifted, remove_outliers(shifted)).sum() == 1
    assert lost(shifted, remove_outliers(shifted, ScanParams(support_px=20.0))).sum() == 0
