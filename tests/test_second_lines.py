"""What a mirror leaves in the pictures of a sweep: it proves mirrors that the range image cannot, and takes streaks."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from test_mirrors import EAST, FURNITURE, HANGING, Pane, Swept, swept, walled

from scanmap.calibration import Calibration, Intrinsics
from scanmap.geometry import HeadMount, rigid, rotation_z
from scanmap.laserline import Reason
from scanmap.scan import Scan
from scanmap.scan.mirrors import find_mirrors, without_mirrors
from scanmap.scan.second_lines import Pictures

F64 = NDArray[np.float64]

ROWS, WIDTH = 240, 480
YAW = np.radians(25.7)
AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # of a camera that looks along x
HEAD = Calibration(
    Intrinsics(WIDTH, ROWS, 230.0, 230.0, 239.5, 119.5, (0.0,) * 5),
    rigid(rotation_z(-YAW) @ AXES, [0.0, 0.08, 0.0]),
    np.array([0.0, 1.0, 0.0, 0.0]),
    HeadMount(),
)
FLOOR_TO_CEILING: Pane = ((-0.5, -1.0), (1.4, 1.6))  # its ends are out of view
UNSWEPT = {"turn_deg": 100.0, "step_deg": 2.0}


def pixels(points: F64) -> F64:
    """Column and row (N, 2) in a picture taken at bearing 0, by OpenCV."""
    if not len(points):
        return np.empty((0, 2))
    T = np.linalg.inv(HEAD.T_head_camera)
    seen = points @ T[:3, :3].T + T[:3, 3]
    pixel = cv2.projectPoints(seen[:, None], np.zeros(3), np.zeros(3), HEAD.intrinsics.matrix, None)[0][:, 0]
    pixel[seen[:, 2] < 0.05] = np.nan
    return np.asarray(pixel, np.float64)


def second_line(scan: Scan, k: int, pane: Pane, before: float) -> tuple[F64, F64]:
    """Column and row (N, 2) of what the camera sees in a mirror of the k-th profile, and those points (N, 3)."""
    (y0, z0), (y1, z1) = pane
    plane = EAST - before
    points = scan.points[k][scan.valid[k]].astype(float)
    points = points[points[:, 0] < plane - 0.02]
    turn = rotation_z(scan.bearings[k])
    eye = turn @ HEAD.T_head_camera[:3, 3]
    image = points * [-1.0, 1.0, 1.0] + [2.0 * plane, 0.0, 0.0]
    cross = eye + ((plane - eye[0]) / (image[:, 0] - eye[0]))[:, None] * (image - eye)
    inside = (cross[:, 1] > y0) & (cross[:, 1] < y1) & (cross[:, 2] > z0) & (cross[:, 2] < z1)
    return pixels(image[inside] @ turn), points[inside]


def pictures_of(scan: Scan, mirrors=(), rng: np.random.Generator | None = None) -> Pictures:
    """Pictures that list the second lines of mirrors, and with `rng` an upright edge and specks anywhere."""
    places = np.full((len(scan), ROWS // 8, 6), np.inf, np.float32)
    for k in range(len(scan)):
        for pane, before in mirrors:
            for column, row in second_line(scan, k, pane, before)[0]:
                if 0 <= row < ROWS and 0 <= column < WIDTH and row % 8 < 4:
                    places[k, int(row) // 8, 0] = column
        if rng is not None:
            places[k, :, 1] = rng.uniform(0, WIDTH)
            places[k, :, 2:] = rng.uniform(0, WIDTH, (ROWS // 8, 4))
    window = np.tile([0.0, WIDTH - 1.0], (ROWS, 1))
    middles = 8.0 * np.arange(ROWS // 8) + 1.5
    project = HEAD.intrinsics.project
    return Pictures(scan.bearings, places, middles, window, HEAD.T_head_camera, HEAD.laser_plane, project)


def test_a_mirror_whose_ends_are_out_of_view_is_proved_by_pictures() -> None:
    scan, image = swept(mirrors=[(FLOOR_TO_CEILING, 0.015)])
    assert without_mirrors(scan) is scan
    rng = np.random.default_rng(3)
    mirrors = find_mirrors(scan, None, pictures_of(scan, [(FLOOR_TO_CEILING, 0.015)], rng))
    cells = np.logical_or.reduce([mirror.cells for mirror in mirrors])
    assert cells[image].mean() > 0.95
    assert not cells[~image].any()
    for mirror in mirrors:
        np.testing.assert_allclose(mirror.plane[:3], [-1.0, 0.0, 0.0], atol=0.02)
        assert mirror.plane[3] == pytest.approx(EAST - 0.015, abs=0.03)


@pytest.mark.parametrize("seed", range(5))
def test_other_lines_in_pictures_prove_no_mirror(seed: int) -> None:
    """A room behind a wall of glass, without a reveal, in pictures full of edges."""
    room, boxes = walled(FLOOR_TO_CEILING, 0.0, 2.0, FURNITURE)
    scan = swept(room, boxes, step_deg=(1.0, 2.0, 6.0)[seed % 3]).scan
    assert find_mirrors(scan, None, pictures_of(scan, (), np.random.default_rng(seed))) == []


def test_the_room_behind_a_door_stays_though_a_mirror_hangs_beside_it() -> None:
    room, boxes = walled(((-1.0, -1.0), (0.1, 1.05)), 0.1, 2.0)
    scan, image = swept(room, boxes, [(((0.6, -1.0), (1.4, 1.6)), 0.015)])
    pictures = pictures_of(scan, [(((0.6, -1.0), (1.4, 1.6)), 0.015)], np.random.default_rng(1))
    gone = scan.valid & ~without_mirrors(scan, None, pictures).valid
    assert gone[image].mean() > 0.9
    assert not gone[~image].any()


def test_a_mirror_that_shows_only_what_was_not_swept_is_told_by_its_edge() -> None:
    """Nothing compares, but no wall is cut without showing how thick it is."""
    scan, image = swept(mirrors=[(HANGING, 0.015)], **UNSWEPT)
    gone = scan.valid & ~without_mirrors(scan).valid
    assert gone[image].mean() > 0.95
    assert not gone[~image].any()


@pytest.mark.parametrize(
    ("opening", "thick", "depth"),
    [
        (HANGING, 0.1, 3.0),  # a window
        (HANGING, 0.0, 0.4),  # a shelf or a niche
        (((-0.5, -1.0), (1.4, 0.9)), 0.0, 3.0),  # the floor runs on
        (((-0.5, 0.1), (1.4, 1.59)), 0.0, 3.0),  # over half a wall
    ],
)
def test_other_openings_stay_where_nothing_compares(opening: Pane, thick: float, depth: float) -> None:
    room, boxes = walled(opening, thick, depth, [])
    scan = swept(room, boxes, **UNSWEPT).scan
    assert (scan.points[..., 0] > EAST + 0.1).sum() > 200
    assert find_mirrors(scan, None, pictures_of(scan, (), np.random.default_rng(2))) == []


def streaked(swept_room: Swept, pane: Pane, before: float) -> tuple[Scan, NDArray[np.bool_]]:
    """The scan with second lines in it, as they are measured: on the camera's ray, in the laser's plane."""
    scan = swept_room.scan
    streak = np.zeros_like(swept_room.image)
    for k in range(len(scan)):
        pixel, _ = second_line(scan, k, pane, before)
        eye = HEAD.T_head_camera[:3, 3]
        ray = HEAD.intrinsics.rays(*pixel.T) @ HEAD.T_head_camera[:3, :3].T
        place = eye - (eye[1] / ray[:, 1])[:, None] * ray
        reach = np.linalg.norm(place, axis=1)
        for (column, row), point, r in zip(pixel, place, reach, strict=True):
            if 0 <= row <= ROWS - 1 and point[0] > 0.05 and r < 1.8:
                at = k, round(row)
                scan.points[at] = rotation_z(scan.bearings[k]) @ point
                scan.range_m[at], scan.sigma_m[at], scan.column_px[at] = r, 5e-4 * r**2, column
                scan.reason[at], streak[at] = Reason.OK, True
    return scan, streak


def test_lines_seen_in_a_mirror_that_were_taken_for_the_line_go_and_a_rod_before_it_stays() -> None:
    rod = ((1.4, 0.55, -1.0), (1.42, 0.57, 1.6))
    room = swept(boxes=[*FURNITURE, rod], mirrors=[(HANGING, 0.015)], step_deg=0.5)
    scan, streak = streaked(room, HANGING, 0.015)
    beside = (np.abs(scan.points[..., :2] - [1.41, 0.56]) < 0.03).all(axis=-1) & ~streak
    assert streak.sum() > 200
    assert beside.sum() > 100
    gone = scan.valid & ~without_mirrors(scan, None, pictures_of(scan)).valid
    assert gone[streak].mean() > 0.7
    assert not gone[beside].any()
    assert gone[~streak & ~room.image].mean() < 1e-4


def test_an_axis_that_leans_and_a_head_beside_it_are_reckoned_with() -> None:
    """`Pictures` speak of the head as it stands at bearing 0, lean and offset and all."""
    from scanmap.laserline import LaserLineParams
    from scanmap.pipeline import Pipeline, SecondLook, run
    from scanmap.shot import Shot
    from scanmap.triangulation import TriangulationParams

    mount = HeadMount((0.03, 0.01, 0.0), (2.0, -3.0))
    head = Calibration(HEAD.intrinsics, HEAD.T_head_camera, HEAD.laser_plane, mount)
    pipeline = Pipeline(head, LaserLineParams(), TriangulationParams())
    look = SecondLook(pipeline)
    assert look.pictures() is None
    picture = np.full((ROWS, WIDTH), 10, np.uint8)
    picture[:, 300:304] = [[90, 200, 200, 90]]
    code = bytes(cv2.imencode(".png", picture)[1])
    run([Shot(0, 0.2, 0.2, 0.0, code, None)], pipeline.process, [look])
    pictures = look.pictures()
    assert pictures is not None
    T = mount.T_world_head(0.0)
    np.testing.assert_allclose(pictures.T_axis_camera, T @ head.T_head_camera)
    on_plane = np.array([[1.0, 0.0, 0.5], [2.0, 0.0, -0.3], [0.5, 0.0, 0.0]]) @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(on_plane @ pictures.laser_plane[:3] + pictures.laser_plane[3], 0.0, atol=1e-12)
    listed = pictures.places[0]
    assert (np.abs(listed - 301.5).min(axis=1) < 2.0).mean() > 0.9
