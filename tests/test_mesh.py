"""The triangles of a range image: how many, which way they face, and that they are one sheet."""

from collections import Counter

import numpy as np
import pytest
from analytic_scan import ROOM, box_scan

from scanmap.geometry import HeadMount
from scanmap.laserline import Reason
from scanmap.scan.mesh import mesh

QUARTER, TURN = np.arange(0.0, 91.0, 3.0), np.arange(0.0, 360.0, 3.0)
ROWS = 60
OFF_AXIS = HeadMount((0.05, -0.02, 0.03), (0.5, -1.0))


def directed_edges(triangles):
    """How often each edge is run through, by its two ends in the order of running."""
    pairs = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    return Counter(map(tuple, pairs.tolist()))


def border(triangles):
    """Edges that belong to one triangle only; every other must be run through once in either direction."""
    edges = directed_edges(triangles)
    assert set(edges.values()) == {1}
    return {edge for edge in edges if edge[::-1] not in edges}


@pytest.mark.parametrize("mount", [HeadMount(), OFF_AXIS])
def test_a_whole_grid_gives_two_triangles_a_cell(mount):
    scan = box_scan(QUARTER, ROWS, mount=mount)
    assert scan.valid.all()
    triangles = mesh(scan).triangles
    assert triangles.shape == (2 * (len(QUARTER) - 1) * (ROWS - 1), 3)
    assert triangles.dtype == np.int32


def test_the_patch_of_a_room_is_one_sheet_whose_rim_is_that_of_the_grid():
    triangles = mesh(box_scan(QUARTER, ROWS)).triangles
    number = np.arange(len(QUARTER) * ROWS).reshape(len(QUARTER), ROWS)
    around = np.concatenate([number[:, 0], number[-1, 1:], number[-2::-1, -1], number[0, -2::-1]])
    assert {frozenset(edge) for edge in border(triangles)} == set(
        map(frozenset, zip(around[:-1].tolist(), around[1:].tolist(), strict=True))
    )
    assert len(np.unique(triangles)) == number.size


def test_a_full_turn_closes_and_only_its_upper_and_lower_rim_are_open():
    triangles = mesh(box_scan(TURN, ROWS)).triangles
    assert len(triangles) == 2 * len(TURN) * (ROWS - 1)
    assert len(border(triangles)) == 2 * len(TURN)
    assert {row for edge in border(triangles) for row in np.array(edge) % ROWS} == {0, ROWS - 1}


@pytest.mark.parametrize("mount", [HeadMount(), OFF_AXIS])
@pytest.mark.parametrize("bearings", [QUARTER, TURN - 90.0])
def test_every_triangle_faces_the_head(mount, bearings):
    built = mesh(box_scan(bearings, ROWS, mount=mount))
    a, b, c = (built.vertices[built.triangles[:, k]].astype(float) for k in range(3))
    inside = np.array(mount.offset_m) * [0.0, 0.0, 1.0]
    assert ((np.cross(b - a, c - a) * (inside - a)).sum(axis=1) > 0).all()


def test_normals_of_triangles_point_into_the_room():
    """On each wall by its own direction, not merely toward the head."""
    built = mesh(box_scan(TURN, ROWS))
    corners = built.vertices[built.triangles].astype(float)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    for axis in range(3):
        for bound, inward in zip(ROOM, (1.0, -1.0), strict=True):
            on_wall = (np.abs(corners[:, :, axis] - bound[axis]) < 1e-4).all(axis=1)
            assert (normal[on_wall, axis] * inward > 0.999).all()
            assert on_wall.any() or axis == 2


@pytest.mark.parametrize(("jump", "rows"), [(0.5, ROWS), (0.1, 1200)])
def test_a_box_before_the_wall_is_cut_out_whole(jump, rows):
    """A pillar `jump` before the wall at x = 2.5: no triangle spans the gap, and both sides are meshed.

    The smaller the picture, the larger the jump must be to show: 0.5 px and 1.7 px here.
    """
    front = 2.5 - jump
    pillar = ((front, -0.3, -0.5), (front + 0.01, 0.4, 1.9))
    scan = box_scan(np.arange(-20.0, 21.0, 0.5), rows, boxes=[pillar])
    built = mesh(scan)
    corner = built.vertices[built.triangles][..., 0]
    on_pillar, on_wall = (np.abs(corner - x) < 2e-3 for x in (front, 2.5))
    assert not (on_pillar.any(axis=1) & on_wall.any(axis=1)).any()
    assert on_pillar.all(axis=1).sum() > 500
    assert on_wall.all(axis=1).sum() > 500


def test_vertices_are_the_points_in_their_order_and_holes_stay_holes():
    scan = box_scan(QUARTER, ROWS)
    hole = np.zeros(scan.valid.shape, bool)
    hole[10:14, 20:25] = True
    built = mesh(scan.without(hole, Reason.WEAK))
    np.testing.assert_array_equal(built.vertices, scan.points[~hole])
    # Of the cells that touch the hole only the four at its corners keep a triangle.
    touched = (4 + 1) * (5 + 1)
    assert len(built.triangles) == 2 * (len(QUARTER) - 1) * (ROWS - 1) - 2 * touched + 4
    border(built.triangles)


def test_bearings_far_apart_are_no_neighbours_whatever_lies_between():
    assert len(mesh(box_scan(np.array([0.0, 14.0]), ROWS)).triangles) == 2 * (ROWS - 1)
    assert len(mesh(box_scan(np.array([0.0, 16.0]), ROWS)).triangles) == 0


@pytest.mark.parametrize("step", [1.0, 3.0, 6.0])
def test_cells_across_the_edge_of_two_walls_are_split_along_it(step):
    """Of a cell's two ways to be split, the one whose triangles hang less before floor, walls and ceiling."""
    scan = box_scan(np.arange(0.0, 91.0, step), ROWS)
    assert scan.valid.all()
    edges = {frozenset(edge) for edge in directed_edges(mesh(scan).triangles)}
    number = np.arange(scan.valid.size).reshape(scan.valid.shape)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]))
    points = scan.points.reshape(-1, 3).astype(np.float64)

    def hanging(*triangles):
        low, high = np.array(ROOM)
        middles = (points[list(corners)].mean(axis=0) for corners in triangles)
        return sum(np.minimum(middle - low, high - middle).min(axis=1) for middle in middles)

    rising, falling = hanging((a, b, d), (a, d, c)), hanging((a, b, c), (b, d, c))
    taken = np.where([frozenset(pair) in edges for pair in zip(a, d, strict=True)], rising, falling)
    crossed = np.abs(rising - falling) > 1e-4
    assert crossed.sum() > 20
    assert taken[crossed].sum() < 1.05 * np.minimum(rising, falling)[crossed].sum()
