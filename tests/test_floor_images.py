"""Images in polished floors go, walls that go on below a floor stay: box rooms by exact ray casting."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from rooms_by_rays import distances
from test_mirrors import FURNITURE, ROOM
from test_second_lines import HEAD

from scanmap.geometry import HeadMount
from scanmap.laserline import Reason
from scanmap.scan import Scan
from scanmap.scan.mirrors import without_mirrors
from scanmap.scan.second_lines import Pictures
from scanmap.triangulation import Profile

ROWS, FLOOR = 400, -1.0
EYE = HEAD.T_head_camera[:3, 3]


class Shining(NamedTuple):
    """A scan with images in the floor, their cells (B, H), and the head that made it."""

    scan: Scan
    image: NDArray[np.bool_]
    pictures: Pictures


def swept(lean_deg: float = 0.0, light: float = 0.3, floor_to: float = 9.0, lowest: float = 0.1) -> Shining:
    """A sweep of a room whose walls are seen in the floor at every sixth bearing, from 0.1 to 0.4 m up.

    Args:
        lean_deg: of the laser's plane.
        light: of the image, over that of the wall.
        floor_to: how far the floor goes from the axis [m]; beyond, nothing of it is measured.
        lowest: below it, walls are not measured themselves.
    """
    rng, mount = np.random.default_rng(4), HeadMount()
    lean = np.radians(lean_deg)
    plane = np.array([0.0, np.cos(lean), -np.sin(lean), 0.0])
    slope = np.tan(np.radians(np.linspace(25.0, -42.0, ROWS)))
    fan = np.array([1.0, 0.0, 0.0]) + slope[:, None] * [0.0, np.sin(lean), np.cos(lean)]
    fan /= np.linalg.norm(fan, axis=1)[:, None]
    scan, image = Scan(mount, ROWS), []
    for k, bearing in enumerate(np.radians(np.arange(-60.0, 120.1, 2.0))):
        R = mount.T_world_head(bearing)[:3, :3]
        reach = distances(np.zeros(3), fan @ R.T, ROOM, FURNITURE)
        points, peak = fan * reach[:, None], np.full(ROWS, 99.0)
        on_floor = points[:, 2] < FLOOR + 1e-6
        foot = ~on_floor & (points[:, 2] < FLOOR + 0.4) & (points[:, 2] > FLOOR + 0.1)
        below = np.zeros(ROWS, bool)
        lost = (on_floor & (np.hypot(points[:, 0], points[:, 1]) > floor_to)) | (
            points[:, 2] < FLOOR + lowest
        ) & ~on_floor
        if k % 6 == 3:
            seen = points[foot]
            seen[:, 2] = 2.0 * FLOOR - seen[:, 2]
            seen = EYE + ((seen - EYE).T * (-(plane[:3] @ EYE) / ((seen - EYE) @ plane[:3]))).T
            at = np.abs(slope - (seen[:, 2] / np.hypot(seen[:, 0], seen[:, 1]))[:, None]).argmin(axis=1)
            points[at], peak[at], below[at] = seen, 99.0 * light, True
        reach = np.linalg.norm(points, axis=1)
        sigma = 5e-4 * reach**2
        points *= (1.0 + sigma / reach * rng.standard_normal(ROWS))[:, None]
        points[lost & ~below] = np.nan
        reason = np.where(lost & ~below, Reason.WEAK, Reason.OK).astype(np.uint8)
        scan.add(Profile(points, reach, sigma, peak, 0 * reach, reason), float(bearing))
        image.append(below)
    nothing = np.full((len(scan), 2, 1), np.inf, np.float32)
    window = np.tile([0.0, HEAD.intrinsics.width - 1.0], (ROWS, 1))
    head = (nothing, np.array([1.5, 9.5]), window, HEAD.T_head_camera, plane, HEAD.intrinsics.project)
    return Shining(scan, np.array(image), Pictures(scan.bearings, *head))


@pytest.mark.parametrize("lean_deg", [0.0, 1.0, 4.0])
@pytest.mark.parametrize("lowest", [0.1, 0.45])
def test_images_in_a_polished_floor_go_and_nothing_else(lean_deg: float, lowest: float) -> None:
    """Also where the wall itself was not measured as low as what the floor shows of it."""
    scan, image, pictures = swept(lean_deg, lowest=lowest)
    assert image.sum() > 200
    gone = scan.valid & ~without_mirrors(scan, None, pictures).valid
    assert gone[image].mean() > 0.85
    assert not gone[~image].any()


@pytest.mark.parametrize(
    "how",
    [
        {"light": 1.0},  # the wall beside stairs goes on below
        {"light": 0.8, "lean_deg": 4.0},
    ],
)
def test_walls_that_go_on_below_the_floor_stay(how: dict[str, float]) -> None:
    scan, image, pictures = swept(**how)
    assert image.sum() > 200
    assert not (scan.valid & ~without_mirrors(scan, None, pictures).valid).any()


def test_a_hall_below_a_gallery_stays_where_no_floor_is_near_the_cameras_ray() -> None:
    scan, image, pictures = swept(floor_to=1.2)
    far = image & (np.hypot(*np.moveaxis(scan.points[..., :2], -1, 0)) > 2.75)
    assert far.sum() > 50
    gone = scan.valid & ~without_mirrors(scan, None, pictures).valid
    assert gone.any()  # near walls stand before floor that was measured
    assert not gone[far].any()


def test_dark_things_below_the_floor_that_reflect_nothing_there_stay() -> None:
    """Steps that go down through a hole: above the floor nothing stands where they would be images of."""
    scan, image, pictures = swept()
    scan.points[image] *= np.float32(0.75)
    scan.points[image, 2] += np.float32(0.25 * FLOOR)
    assert not (scan.valid & ~without_mirrors(scan, None, pictures).valid).any()


def test_without_pictures_nothing_is_known_of_the_camera() -> None:
    scan, _, _ = swept()
    assert without_mirrors(scan).valid.sum() == scan.valid.sum()
