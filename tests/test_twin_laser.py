"""The twin's laser line against formulas, against brute force, and against another renderer's pictures."""

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from scanmap.calibration import Calibration, CalibrationFile, HeadTable, ImageTable
from scanmap.geometry import HeadMount
from scanmap.twin import LaserParams, LightParams, RoomParams, build_scene
from scanmap.twin.laser import LaserFan
from scanmap.twin.mesh import Mesh, merged, quad
from scanmap.twin.optics import Lens
from scanmap.twin.room import Thing, assembled
from scanmap.twin.scene import Scene
from scanmap.twin.texture import Material

F64 = NDArray[np.float64]
RENDERED = Path(__file__).parent.parent.parent / "shared/data/rendered/room-offset"

DISTORTION = (0.05, -0.08, 0.001, -0.0015, 0.02)
DARK = LightParams(ambient=0.0)
WHITE = Thing("white", Material((0.8, 0.8, 0.8)))


def thesis_head() -> Calibration:
    head = HeadTable(baseline_m=0.08, beta_deg=25.7, alpha_deg=32.3)
    return CalibrationFile(image=ImageTable(width=1600, height=1200), head=head).build()


def crooked_head() -> Calibration:
    """Distortion, a laser plane beside the origin and askew, a head off the axis, an axis that leans."""
    head = thesis_head()
    normal = np.array([0.02, 1.0, 0.03])
    return replace(
        head,
        intrinsics=replace(head.intrinsics, distortion=DISTORTION),
        laser_plane=np.append(normal, 0.004) / np.linalg.norm(normal),
        mount=HeadMount((0.03, -0.02, 0.05), (2.0, -3.0)),
    )


def scene_of(*meshes: Mesh) -> Scene:
    return Scene(assembled("test", [(WHITE, mesh) for mesh in meshes], [(0.0, 0.0, 1.0)]), DARK)


def picture(fan: LaserFan, bearing: float, width: int = 1600) -> F64:
    """Red light (H, W) of the line."""
    line = fan.draw(fan.trace(bearing))
    full = np.zeros((line.light.shape[0], width))
    full[:, line.first_column : line.first_column + line.light.shape[1]] = line.light[:, :, 0]
    return full


def row_centres(light: F64) -> F64:
    total = light.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(total > 0.05, light @ np.arange(light.shape[1]) / total, np.nan)


def line_on_wall(head: Calibration, bearing: float, x: float) -> tuple[F64, F64]:
    """Columns and world heights per image row where the laser plane meets the wall at world x, by cv2's projection."""
    T = head.mount.T_world_head(bearing)
    normal = T[:3, :3] @ head.laser_plane[:3]
    d = head.laser_plane[3] - normal @ T[:3, 3]
    z = np.linspace(-0.95, 1.95, 6001)
    points = np.stack([np.full_like(z, x), -(d + normal[0] * x + normal[2] * z) / normal[1], z], axis=1)
    T_camera = np.linalg.inv(T @ head.T_head_camera)
    seen = points @ T_camera[:3, :3].T + T_camera[:3, 3]
    own = head.intrinsics
    pixels = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), own.matrix, np.array(own.distortion))[0][:, 0]
    near = (np.abs(pixels[:, 1] - 600) < 640) & (np.abs(points[:, 1]) < 1.4)
    u, v, z = pixels[near, 0], pixels[near, 1], z[near]
    order = np.argsort(v)
    rows = np.arange(own.height)
    column = np.interp(rows, v[order], u[order], left=np.nan, right=np.nan)
    return column, np.interp(rows, v[order], z[order])


@pytest.mark.parametrize("bearing", [-0.25, 0.0, 0.3])
@pytest.mark.parametrize("head", [thesis_head(), crooked_head()], ids=["thesis", "crooked"])
def test_line_on_a_wall_is_where_geometry_puts_it(head: Calibration, bearing: float) -> None:
    wall = quad([3.0, -2.0, -1.0], [0, 0, 3.0], [0, 4.0, 0])
    fan = LaserFan(scene_of(wall), head, LaserParams(), 0.6)
    column, z = line_on_wall(head, bearing, 3.0)
    inner = (z > -0.9) & (z < 1.9) & np.isfinite(column)
    error = (row_centres(picture(fan, bearing)) - column)[inner]
    assert inner.sum() > 900
    assert np.abs(error).max() < 1e-3


def test_the_lens_is_opencv_s() -> None:
    rng = np.random.default_rng(1)
    head = crooked_head()
    points = rng.uniform([0.5, -0.6, -0.5], [4.0, 1.0, 0.5], (400, 3))
    T = np.linalg.inv(head.T_head_camera)
    own = head.intrinsics
    camera = points @ T[:3, :3].T + T[:3, 3]
    expected = cv2.projectPoints(camera, np.zeros(3), np.zeros(3), own.matrix, np.array(own.distortion))[0][:, 0]
    lens = Lens(head)
    np.testing.assert_allclose(lens.project(points), expected, atol=1e-9)
    inside = (np.abs(expected - [800, 600]) < [820, 620]).all(axis=1)
    rays = lens.rays(*expected[inside].T)
    np.testing.assert_allclose(rays, (camera / camera[:, 2:])[inside], atol=1e-6)
    assert np.isnan(lens.project(np.array([[-1.0, 0.0, 0.0]]))).all()


def test_what_a_folding_lens_would_bring_back_stays_outside() -> None:
    head = thesis_head()
    barrel = replace(head, intrinsics=replace(head.intrinsics, distortion=(-0.35, 0.0, 0.0, 0.0, 0.0)))
    wide = barrel.T_head_camera[:3, :3] @ np.array([3.0, 0.0, 1.0]) + barrel.T_head_camera[:3, 3]
    assert np.isnan(Lens(barrel).project(wide[None])).all()


@pytest.mark.parametrize("height", [-1.0, -0.03], ids=["floor", "table top at eye level"])
def test_slanted_and_grazing_lines_match_brute_force(height: float) -> None:
    """A thick sheet of a million random rays on a horizontal surface, binned into the camera's pixels."""
    head, laser = thesis_head(), LaserParams()
    fan = LaserFan(scene_of(quad([0.3, -1.0, height], [4.0, 0, 0], [0, 2.0, 0])), head, laser, 0.0)
    drawn = picture(fan, 0.0)
    rng = np.random.default_rng(5)
    count = 1_500_000
    ends = np.arctan2(height, [0.3, 4.3])
    angle = rng.uniform(min(ends), max(ends), count)
    distance = height / np.sin(angle)
    # p = o + n t + d s with z = height: parallel rays, displaced by t along the plane's normal, y.
    y = rng.standard_normal(count) * laser.thickness(distance)
    points = np.stack([distance * np.cos(angle), y, np.full(count, height)], axis=1)
    lens, h = Lens(head), 1e-5
    du_dx, du_dy = ((lens.project(points + s) - lens.project(points - s)) / (2 * h) for s in h * np.eye(3)[:2])
    # A pixel shows power per area of surface: rays count by the pixels their area fills.
    pixels_per_area = np.abs(du_dx[:, 0] * du_dy[:, 1] - du_dx[:, 1] * du_dy[:, 0])
    wall = laser.thickness(np.array(2.0))
    spread = head.intrinsics.fx * wall / 2.0
    attenuation = spread / np.hypot(spread, np.sqrt(1 / 12))
    power_per_angle = np.sqrt(2 * np.pi) * laser.white_wall_peak * 2.0 * wall / attenuation
    weight = power_per_angle * abs(ends[1] - ends[0]) / count * pixels_per_area
    column, row = np.rint(lens.project(points)).astype(int).T
    inside = (column >= 0) & (column < 1600) & (row >= 0) & (row < 1200)
    brute = np.zeros((1200, 1600))
    np.add.at(brute, (row[inside], column[inside]), weight[inside])

    def blocks(a: F64) -> F64:
        return a.reshape(150, 8, 200, 8).sum(axis=(1, 3))

    want, got = blocks(brute), blocks(drawn)
    # Ends are cut along rows or columns, not along the surface's edge: not compared.
    end = lens.project(np.array([[0.3, 0.0, height]]))[0, 1]
    strong = (want > 0.2 * want.max()) & (8 * (np.arange(150) + 1)[:, None] < end - 8)
    assert strong.sum() > 15
    np.testing.assert_allclose(got[strong], want[strong], rtol=0.06)
    centre = [
        np.array(np.average(np.indices(a.shape).reshape(2, -1), axis=1, weights=a.ravel())) for a in (drawn, brute)
    ]
    np.testing.assert_allclose(centre[0], centre[1], atol=1.0)


@pytest.mark.parametrize("height", [-1.0, -0.12, -0.03])
def test_blur_of_slanted_lines_is_blur_of_the_picture(height: float) -> None:
    scene = scene_of(quad([0.3, -1.0, height], [4.0, 0, 0], [0, 2.0, 0]))
    sharp, blurred = (picture(LaserFan(scene, thesis_head(), LaserParams(), b), 0.0) for b in (0.4, np.hypot(0.4, 1.5)))
    # `white_wall_peak` makes up for the blur on the wall it is defined by: compare shapes.
    expected = cv2.GaussianBlur(sharp, (0, 0), 1.5)
    gain = blurred.sum() / expected.sum()
    strong = expected > 0.3 * expected.max()
    assert strong.sum() > 300
    np.testing.assert_allclose(np.median(blurred[strong] / expected[strong]), gain, rtol=0.02)
    assert np.mean(np.abs(blurred[strong] / expected[strong] / gain - 1.0) < 0.05) > 0.9


def test_a_jump_in_depth_within_one_thing_cuts_the_line() -> None:
    plate = quad([1.5, -0.6, -0.2], [0, 0, 0.5], [0, 1.2, 0])
    wall = quad([3.0, -2.0, -1.0], [0, 0, 3.0], [0, 4.0, 0])
    both = merged([plate, wall])
    one, two = (
        picture(LaserFan(scene_of(*m), thesis_head(), LaserParams(), 0.6), 0.0) for m in ([both], [plate, wall])
    )
    np.testing.assert_array_equal(one, two)


def test_brightness_follows_range_thickness_and_incidence() -> None:
    head, laser = thesis_head(), LaserParams(white_wall_peak=0.9)

    def peak(x: float, slope: float = 0.0) -> float:
        wall = quad([x, -2.0 - 0, -1.0], [0, 0, 2.0], [4 * slope, 4.0, 0])
        fan = LaserFan(scene_of(wall), head, laser, 0.6)
        line = fan.trace(0.0)
        return float(line.peak[np.abs(line.points[:, 2]).argmin(), 0])

    thickness = laser.thickness(np.array([1.0, 2.0, 3.0]))
    at = np.array([peak(1.0), peak(2.0), peak(3.0)])
    np.testing.assert_allclose(at * [1.0, 2.0, 3.0] * thickness, at[1] * 2.0 * thickness[1], rtol=1e-3)
    slanted = peak(2.0 - 2.0 * 0.75, slope=0.75)  # passes x = 2 at y = 0
    assert slanted == pytest.approx(0.8 * at[1], rel=1e-3)
    wall = scene_of(quad([2.0, -2.0, -1.0], [0, 0, 2.0], [0, 4.0, 0]))
    in_pixels = picture(LaserFan(wall, head, laser, 0.6), 0.0)[600].max()
    assert in_pixels == pytest.approx(0.9, abs=0.03)


def test_line_is_cut_where_the_surface_ends_and_behind_it_there_is_shadow() -> None:
    head = thesis_head()
    plate = quad([1.5, -0.6, -0.2], [0, 0, 0.5], [0, 1.2, 0])
    wall = quad([3.0, -2.0, -1.0], [0, 0, 3.0], [0, 4.0, 0])
    light = picture(LaserFan(scene_of(plate, wall), head, LaserParams(), 0.6), 0.0)
    lens = Lens(head)
    ends = lens.project(np.array([[1.5, 0.0, -0.2], [1.5, 0.0, 0.3]]))
    column = round(ends[0, 0])
    on_plate = light[:, column - 12 : column + 13].sum(axis=1)
    bottom, top = np.rint(ends[:, 1]).astype(int)
    # Rows, and parts of a row, that are lit before the end: with the light ten rows inside as the whole.
    above = on_plate[bottom - 10 : bottom + 10].sum() / on_plate[bottom - 10]
    below = on_plate[top - 10 : top + 11].sum() / on_plate[top + 10]
    assert bottom - 10.5 + above == pytest.approx(ends[0, 1], abs=0.3)
    assert top + 10.5 - below == pytest.approx(ends[1, 1], abs=0.3)
    wall_column = round(lens.project(np.array([[3.0, 0.0, 0.0]]))[0, 0])
    on_wall = light[:, wall_column - 10 : wall_column + 11].sum(axis=1) > 0.1
    shadow = lens.project(np.array([[3.0, 0.0, -0.4], [3.0, 0.0, 0.6]]))[:, 1]
    assert abs(np.flatnonzero(on_wall & (np.arange(1200) < 500))[-1] + 0.5 - shadow[1]) < 1.5
    assert abs(np.flatnonzero(on_wall & (np.arange(1200) > 700))[0] - 0.5 - shadow[0]) < 1.5


def test_what_the_camera_cannot_see_is_dark() -> None:
    head = thesis_head()
    wall = quad([2.0, -2.0, -1.0], [0, 0, 2.0], [0, 4.0, 0])
    # Between camera (y = 0.08) and wall, beside the laser plane (y = 0).
    screen = quad([1.0, 0.02, -0.5], [0, 0, 1.0], [0, 0.3, 0])
    free, hidden = (LaserFan(scene_of(*m), head, LaserParams(), 0.6).trace(0.0) for m in ([wall], [wall, screen]))
    level = np.abs(free.points[:, 2]) < 0.4
    assert free.seen[level].all()
    assert not hidden.seen[level].any()


def test_a_surface_lit_from_behind_is_not_seen() -> None:
    head = thesis_head()
    # So slanted that its plane passes between laser and camera.
    sliver = quad([1.0, 0.01, -0.5], [0, 0, 1.0], [0.5, -0.02, 0])
    line = LaserFan(scene_of(sliver), head, LaserParams(), 0.6).trace(0.0)
    side = np.einsum("ij,ij->i", line.normal, -line.points) * np.einsum(
        "ij,ij->i", line.normal, head.T_head_camera[:3, 3] - line.points
    )
    assert len(line.points) > 100
    assert (side < 0).all()
    assert not line.seen.any()


def test_colour_of_laser_and_surface_multiply() -> None:
    head = thesis_head()
    blue = Thing("blue", Material((0.1, 0.2, 0.8)))
    wall = quad([2.0, -2.0, -1.0], [0, 0, 2.0], [0, 4.0, 0])
    scene = Scene(assembled("test", [(blue, wall)], [(0.0, 0.0, 1.0)]), DARK)
    red = LaserFan(scene, head, LaserParams(), 0.6).trace(0.0).peak[50]
    green = LaserFan(scene, head, LaserParams(colour="green"), 0.6).trace(0.0).peak[50]
    np.testing.assert_allclose(red / red[0], [1.0, 0.06 * 2, 0.015 * 8], rtol=1e-5)
    np.testing.assert_allclose(green / green[1], [0.1 / 2, 1.0, 0.12 * 4], rtol=1e-5)


def test_a_mirror_throws_the_line_and_shows_it_where_optics_says() -> None:
    """A wall at x = 2 with a mirror on it, another wall behind the head: every echo lies on what it shines on."""
    head = thesis_head()
    mirror = Thing("mirror", Material((0.01, 0.01, 0.01), gloss=0.8))
    back = Thing("back", Material((0.5, 0.5, 0.5)))
    pane, wall = quad([2.0, -1.0, -0.5], [0, 0, 1.0], [0, 2.0, 0]), quad([-1.5, -3, -2], [0, 6.0, 0], [0, 0, 4.0])
    scene = Scene(assembled("test", [(mirror, pane), (back, wall)], [(0.0, 0.0, 1.0)]), DARK)
    fan = LaserFan(scene, head, LaserParams(), 0.6)
    (both,) = fan.echoes(0.0)  # the camera looks away from what the mirror lights
    seen = both.points[both.seen]
    assert len(seen) > 1000
    np.testing.assert_allclose(seen[:, 0], -1.5, atol=1e-6)
    np.testing.assert_allclose(seen[:, 1], 0.0, atol=1e-6)
    # It is where the image of the wall is, 5.5 m away in the laser's plane, and as bright as that, twice mirrored.
    image = seen * [-1.0, 1.0, 1.0] + [4.0, 0.0, 0.0]
    np.testing.assert_allclose(both.pixel[both.seen], Lens(head).project(image), atol=1e-3)
    far = quad([5.5, -3.0, -2.0], [0, 0, 4.0], [0, 6.0, 0])
    alone = Scene(assembled("far", [(back, far)], [(0.0, 0.0, 1.0)]), DARK)
    straight = LaserFan(alone, head, LaserParams(), 0.6).trace(0.0)
    level = np.abs(straight.points[:, 2]) < 0.3
    mirrored = both.peak[both.seen & (np.abs(both.points[:, 2]) < 0.3)]
    np.testing.assert_allclose(mirrored.mean(axis=0), 0.64 * straight.peak[level].mean(axis=0), rtol=1e-3)


def test_a_mirror_beside_the_plane_shows_the_line_on_a_wall_once_more() -> None:
    head = thesis_head()
    mirror, paint = Thing("mirror", Material((0.01, 0.01, 0.01), gloss=0.8)), Thing("wall", Material((0.5, 0.5, 0.5)))
    wall, pane = quad([3.0, -3.0, -1.0], [0, 0, 2.0], [0, 6.0, 0]), quad([1.0, -0.5, -1.0], [1.9, 0, 0], [0, 0, 2.0])
    scene = Scene(assembled("test", [(paint, wall), (mirror, pane)], [(0.0, 0.0, 1.0)]), DARK)
    (again,) = LaserFan(scene, head, LaserParams(), 0.6).echoes(0.0)
    seen = again.points[again.seen]
    np.testing.assert_allclose(seen[:, :2], np.broadcast_to([3.0, 0.0], (len(seen), 2)), atol=1e-6)
    np.testing.assert_allclose(
        again.pixel[again.seen], Lens(head).project(seen * [1, -1, 1] + [0.0, -1.0, 0.0]), atol=1e-3
    )
    assert len(seen) > 300


def test_rooms_without_large_flat_glossy_things_have_no_echoes() -> None:
    assert (
        LaserFan(scene_of(quad([2.0, -1, -1], [0, 0, 2.0], [0, 2.0, 0])), thesis_head(), LaserParams(), 0.6).echoes(0.0)
        == []
    )


def test_line_agrees_with_pictures_of_another_renderer() -> None:
    """Mitsuba's frames of the rendered room: the same mesh in our twin gives the same columns."""
    if not RENDERED.exists():
        pytest.skip("the rendered scan is not here")
    head = replace(thesis_head(), mount=HeadMount((0.03, 0.0, 0.0)))
    room = RoomParams(room=str(RENDERED / "truth/scene.ply"), scanner_position_m=(0.0, 0.0), scanner_height_m=1.0)
    fan = LaserFan(build_scene(room, DARK), head, LaserParams(), 0.6)
    table = (RENDERED / "scan.csv").read_text(encoding="utf-8").splitlines()
    bearings = [float(row["bearing_deg"]) for row in csv.DictReader(table)]
    offsets = np.arange(-9, 10)
    for k in (0, 6, 12, 21, 27):
        ours = np.minimum(picture(fan, np.radians(bearings[k])), 1.0)
        red = cv2.imread(str(RENDERED / f"frames/{k:06d}.jpg"))[:, :, 2] / 255.0
        theirs = np.where(red <= 0.04045, red / 12.92, ((red + 0.055) / 1.055) ** 2.4)
        column = ours.argmax(axis=1)
        rows = np.flatnonzero((ours.max(axis=1) > 0.1) & (np.abs(column - 800) < 785))
        assert len(rows) > 900
        mine, other = (a[rows[:, None], column[rows, None] + offsets] for a in (ours, theirs))
        other = np.maximum(other - np.percentile(other, 15, axis=1)[:, None], 0.0)
        difference = np.abs((mine @ offsets) / mine.sum(axis=1) - (other @ offsets) / other.sum(axis=1))
        assert np.median(difference) < 0.06
        assert np.percentile(difference, 90) < 0.2
