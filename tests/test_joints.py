"""Lines on dark joints with laser-off frames: light on a surface drawn finely, blurred by a lens, coded, compressed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import curve_fit

from scanmap.laserline import LaserLineParams, find_laser_line, rounding_of
from scanmap.laserline.difference import without_background
from scanmap.laserline.offmatch import shift_between

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

WIDTH, HEIGHT, FINER = 320, 200, 16
PARAMS = LaserLineParams(grey="luminance_601", pool_rows=9)
COLUMNS = 150.0 + 0.07 * np.arange(HEIGHT)  # of the middle of the sheet
ROOM, PEAK = 0.05, 0.35  # light, of saturation
BEAM_PX, LENS_PX = 1.7, 0.9


def coded(light: F64) -> F64:
    """Grey levels by the curve of IEC 61966-2-1."""
    return 255.0 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def pair(
    joint_px: float, wide_px: float = 1.5, albedo: float = 0.35, shadow: bool = False, lens_px: float = LENS_PX
) -> tuple[U8, U8, bytes]:
    """Pictures with the laser on and off, and the first as a file.

    A stripe `wide_px` wide lies `joint_px` beside the middle of the sheet: of paint, or a `shadow` of the room's light.
    """
    x = (np.arange(WIDTH * FINER) + 0.5) / FINER - 0.5
    away = x - COLUMNS[:, None]
    beam = PEAK * np.exp(-0.5 * np.square(away / BEAM_PX))
    dark = np.where(np.abs(away - joint_px) < 0.5 * wide_px, albedo, 1.0)
    rng, pictures = np.random.default_rng(4), []
    for light in ((ROOM + beam) * dark if not shadow else ROOM * dark + beam, ROOM * dark):
        seen = cv2.GaussianBlur(light, (0, 0), lens_px * FINER, sigmaY=1e-3)
        levels = coded(seen.reshape(HEIGHT, WIDTH, FINER).mean(axis=2)) + rng.normal(0.0, 1.0, (HEIGHT, WIDTH))
        data = cv2.imencode(".jpg", np.clip(np.rint(levels), 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 92])
        pictures.append(bytes(data[1]))
    on, off = (np.asarray(cv2.imdecode(np.frombuffer(one, np.uint8), cv2.IMREAD_GRAYSCALE)) for one in pictures)
    return on, off, pictures[0]


def bare_wall() -> tuple[U8, U8]:
    """A wall without anything on it, seen twice."""
    _, one, _ = pair(0.0, albedo=1.0)
    rng = np.random.default_rng(8)
    noisy = [np.clip(np.rint(one + rng.normal(0.0, 2.0, one.shape)), 0, 255).astype(np.uint8) for _ in range(2)]
    files = [cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 92])[1] for picture in noisy]
    first, second = (np.asarray(cv2.imdecode(file, cv2.IMREAD_GRAYSCALE), np.uint8) for file in files)
    return first, second


def test_noise_of_a_bare_wall_is_no_shift() -> None:
    first, second = bare_wall()
    first[:, 150:162] = 200  # the laser
    assert shift_between(first, second) == (0.0, 0.0)


def test_what_is_dark_on_a_bare_wall_is_as_dark_in_both_pictures() -> None:
    """What noise makes dark is brighter in the other picture; a patch that is dark by itself is not."""
    first, second = bare_wall()
    for plane in (first, second):
        plane[40:60, 40:60] -= 15
    _, off, _, gain = without_background(first, second)
    patch, wall = (slice(42, 58),) * 2, (slice(80, 120), slice(40, 100))
    for place in (patch, wall):
        assert abs(gain * off[place].mean() - second[place].mean()) < 0.4


def off_middle(on: U8, off: U8, data: bytes) -> tuple[float, float]:
    """How far a line is found off the middle of the sheet, and its sigma; medians [px]."""
    line = find_laser_line(on, PARAMS, background=off, rounding=rounding_of(data))
    assert np.isfinite(line.column_px).mean() > 0.98
    return float(np.median(line.column_px - COLUMNS)), float(np.median(line.sigma_px))


def plain_fit(on: U8, off: U8) -> float:
    """How far a Gaussian that knows of no joint is off the middle of the sheet [px]."""
    away = np.arange(WIDTH) - COLUMNS[:, None]
    near = np.abs(away) < 7.0
    added = on.astype(np.float64) - off

    def line(x: F64, u: float, s: float, height: float, level: float) -> F64:
        return level + height * np.exp(-0.5 * np.square((x - u) / s))

    return float(curve_fit(line, away[near], added[near], (0.0, 2.0, 100.0, 0.0))[0][0])


@pytest.mark.parametrize(
    ("lens_px", "albedo"), [(0.5, 0.3), (0.5, 0.5), (0.7, 0.3), (0.9, 0.5), (1.1, 0.3), (1.3, 0.3)]
)
def test_a_line_on_a_dark_joint_is_where_the_middle_of_the_sheet_is(lens_px: float, albedo: float) -> None:
    before, after, sigma = [], [], []
    for joint_px in (-1.8, -1.0, -0.4, 0.4, 1.0, 1.8):
        pictures = pair(joint_px, albedo=albedo, lens_px=lens_px)
        before.append(plain_fit(*pictures[:2]))
        off, own = off_middle(*pictures)
        after.append(off)
        sigma.append(own)
    assert np.sqrt(np.mean(np.square(before))) > 0.12
    assert np.sqrt(np.mean(np.square(after))) < 0.4 * np.sqrt(np.mean(np.square(before)))
    assert np.sqrt(np.mean(np.square(np.divide(after, sigma)))) < 1.1


@pytest.mark.parametrize("joint_px", [-1.8, -1.0, 0.4, 1.0, 1.8])
def test_a_shadow_as_wide_as_a_joint_moves_nothing(joint_px: float) -> None:
    assert abs(off_middle(*pair(joint_px, shadow=True))[0]) < 0.04


def test_a_black_gap_that_is_lit_by_the_laser_is_no_joint() -> None:
    """As between things that stand apart: the room's light does not reach there, the laser's does."""
    assert abs(off_middle(*pair(1.0, wide_px=3.0, albedo=0.02, shadow=True))[0]) < 0.12
