"""A turntable's axis from printed markers on it: corners of known places, markers drawn as a camera sees them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from room_lines import head, turntable_lines

from scanmap.calibration import Calibration
from scanmap.geometry import HeadMount, inverse, rotation_z
from scanmap.shot import Shot, encode_png
from scanmap.solvers.freedom import Freedom
from scanmap.solvers.marks import TOLD, Marks, MarkSeeker, follow
from scanmap.solvers.self_calibration import refine

HEIGHT = -0.1  # of the plate [m]
TRUE = head(480, HeadMount((-0.42, 0.0, 0.0), (-0.4, 0.5)))
GUESS = replace(TRUE, mount=HeadMount((-0.42, 0.0, 0.0)))
SIDE = 0.03


def marker_corners() -> np.ndarray:
    """Three markers (3, 4, 3) on the plate [m]."""
    square = 0.5 * SIDE * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    middles = np.array([[0.07, 0.0], [-0.02, 0.065], [-0.05, -0.05]])
    flat = middles[:, None] + square
    return np.concatenate([flat, np.full((3, 4, 1), HEIGHT)], axis=2)


def pixels(head: Calibration, bearing: float, places: np.ndarray) -> np.ndarray:
    """Where (..., 2) the camera sees places (..., 3) of the table, which `bearing` turned."""
    T = inverse(head.mount.T_axis_head() @ head.T_head_camera)
    seen = (places @ rotation_z(-bearing).T) @ T[:3, :3].T + T[:3, 3]
    return head.intrinsics.project(seen.reshape(-1, 3)).reshape(*places.shape[:-1], 2)


def marks(noise_px: float, seed: int) -> Marks:
    rng = np.random.default_rng(seed)
    bearings = np.repeat(-np.radians(np.arange(0.0, 360.0, 5.0)), 12)
    pixel = np.concatenate([pixels(TRUE, b, marker_corners()).reshape(-1, 2) for b in bearings[::12]])
    return Marks(np.tile(np.arange(12), len(bearings) // 12), bearings, pixel + noise_px * rng.normal(size=pixel.shape))


def freedom() -> Freedom:
    return Freedom.of(GUESS, "axis", HEIGHT)


def test_exact_corners_give_the_axis_exactly() -> None:
    free = freedom()
    found = follow(marks(0.0, 0), GUESS, free)
    assert found is not None and found.markers == 3 and found.rms_px < 1e-3
    assert np.degrees(found.change[1:]) == pytest.approx([-0.4, 0.5], abs=1e-4)
    change = np.zeros(len(free.names))
    change[[free.names.index(name) for name in TOLD]] = found.change
    # Where the axis runs through the plate is seen under the same angle as the true one.
    middle = np.array([0.0, 0.0, HEIGHT])
    assert pixels(free.changed(GUESS, change), 0.0, middle)[0] == pytest.approx(pixels(TRUE, 0.0, middle)[0], abs=0.05)


def test_stated_deviations_are_those_of_noisy_corners() -> None:
    """Large noise, so that what it does is above the least that is ever stated."""
    free = freedom()
    exact = follow(marks(0.0, 0), GUESS, free)
    assert exact is not None
    off = []
    for seed in range(12):
        found = follow(marks(8.0, seed), GUESS, free)
        assert found is not None
        off.append((found.change - exact.change) / found.sigma)
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.5


def test_a_marker_on_the_wall_and_one_hardly_seen_are_left_out() -> None:
    good = marks(0.2, 1)
    still = marks(0.2, 2)
    still = still._replace(corner=still.corner + 12, pixel=np.tile(still.pixel[:12], (len(still.pixel) // 12, 1)))
    short = marks(0.2, 3)
    short = short._replace(corner=short.corner + 24).where(np.abs(short.bearing) < np.radians(40.0))
    mixed = Marks(*(np.concatenate(parts) for parts in zip(good, still, short, strict=True)))
    alone, found = follow(good, GUESS, freedom()), follow(mixed, GUESS, freedom())
    assert alone is not None and found is not None
    assert found.markers == 3 and found.change == pytest.approx(alone.change)
    assert follow(still, GUESS, freedom()) is None


def test_spoilt_corners_cost_only_themselves() -> None:
    """One that is found in the wrong place nearly always, one where the lens folds over, a head that never turned."""
    good, rng = marks(0.2, 5), np.random.default_rng(6)
    pixel = good.pixel.copy()
    wild = (good.corner == 3) & (rng.random(len(good.corner)) < 0.9)
    pixel[wild] += rng.normal(0.0, 12.0, (int(wild.sum()), 2))
    pixel[(good.corner == 11) & (good.bearing < -3.0)] = np.nan
    found, exact = follow(good._replace(pixel=pixel), GUESS, freedom()), follow(good, GUESS, freedom())
    assert found is not None and exact is not None and np.isfinite(found.sigma).all()
    assert found.change == pytest.approx(exact.change, abs=5e-4)
    assert follow(good._replace(bearing=np.zeros_like(good.bearing)), GUESS, freedom()) is None


def picture(bearing: float, family: int, numbers: tuple[int, ...]) -> bytes:
    """The plate with its markers as the true head sees it, from twice as fine."""
    size = 200
    image = np.full((480 * 2, 640 * 2), 235, np.uint8)
    for number, corners in zip(numbers, marker_corners(), strict=True):
        mark = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(family), number, size)
        source = np.array([[0, 0], [size, 0], [size, size], [0, size]], np.float32) - 0.5
        target = pixels(TRUE, bearing, corners) * 2.0 + 0.5
        H = cv2.getPerspectiveTransform(source, target.astype(np.float32))
        shape = image.shape[::-1]
        inside = cv2.warpPerspective(np.full_like(mark, 255), H, shape)
        image = np.where(inside > 127, cv2.warpPerspective(mark, H, shape, flags=cv2.INTER_LINEAR), image)
    small = cv2.resize(image, (640, 480), interpolation=cv2.INTER_AREA)
    return encode_png(np.asarray(small, np.uint8))


def shots(family: int = cv2.aruco.DICT_4X4_50, numbers: tuple[int, ...] = (5, 18, 27)) -> list[Shot]:
    bearings = -np.radians(np.arange(0.0, 360.0, 8.0))
    return [Shot(k, b, b, float(k), picture(b, family, numbers)) for k, b in enumerate(bearings)]


@pytest.mark.parametrize("family", [cv2.aruco.DICT_4X4_50, cv2.aruco.DICT_APRILTAG_36h11])
def test_markers_in_pictures_tell_the_axis(family: int) -> None:
    seeker = MarkSeeker()
    for shot in shots(family):
        seeker.look(shot)
    seen = seeker.marks()
    assert seen is not None
    found = follow(seen, GUESS, freedom())
    assert found is not None and found.markers == 3 and found.rms_px < 1.0
    assert np.degrees(found.change[1:]) == pytest.approx([-0.4, 0.5], abs=0.05)


def test_pictures_without_markers_say_nothing() -> None:
    seeker = MarkSeeker()
    plain = encode_png(np.full((480, 640), 200, np.uint8))
    for k in range(60):
        seeker.look(Shot(k, 0.1 * k, 0.1 * k, float(k), plain if k else b"no picture"))
    assert seeker.marks() is None


def test_self_calibration_leans_the_axis_as_the_markers_say() -> None:
    """A block's lines hardly tell one of the two leans; with markers both come out, and say so."""
    lines = turntable_lines(0.2, TRUE.mount)
    bare, told = refine(lines, GUESS), refine(lines, GUESS, marks=marks(0.3, 4))
    assert bare.followed is None and told.followed is not None
    assert told.after.mount.tilt_deg == pytest.approx(TRUE.mount.tilt_deg, abs=0.06)
    assert told.estimate("tilt_y").sigma < 0.5 * bare.estimate("tilt_y").sigma
