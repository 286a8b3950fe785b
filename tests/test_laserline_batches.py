"""Several pictures looked at together give what each gives alone, bit for bit."""

import cv2
import numpy as np
import pytest
from synthetic_lines import HARD, RED, LineSpec, clean, hard_frame

from scanmap.laserline import LaserLineParams, look, look_at_all, rounding_of

POOLED = LaserLineParams(pool_rows=9)
ODD = [  # next to each other lines of all kinds: saturated, dim, thin, wide, speckled, stepped, none
    LineSpec(height=400, width=500, peak=510.0),
    LineSpec(height=400, width=500, peak=30.0, noise=6.0),
    LineSpec(height=400, width=500, sigma=0.6),
    LineSpec(height=400, width=500, sigma=5.0),
    LineSpec(height=400, width=500, speckle=0.3),
    LineSpec(height=400, width=500, step_px=40.0, step_rows=37),
    LineSpec(height=400, width=500, peak=0.01),
]


def assert_as_alone(pictures, params=POOLED, window=None, roundings=None):
    found = look_at_all(np.stack(pictures), params, window, roundings=roundings)
    for picture, rounding, together in zip(pictures, roundings or [None] * len(found), found, strict=True):
        alone = look(picture, params, None, window, rounding=rounding)
        for name, own, same in zip(alone.line._fields, alone.line, together.line, strict=True):
            np.testing.assert_array_equal(own, same, err_msg=name)
        np.testing.assert_array_equal(alone.places, together.places)


@pytest.mark.parametrize("colour", [None, RED])
def test_lines_of_all_kinds(colour):
    rng = np.random.default_rng(0)
    pictures = [clean(LineSpec(**{**vars(spec), "colour": colour}), rng)[0] for spec in ODD]
    assert_as_alone(pictures)
    assert_as_alone(pictures[::-2], LaserLineParams())


@pytest.mark.parametrize("colour", [True, False])
@pytest.mark.parametrize("first", range(4))
def test_hard_rooms(first, colour):
    assert_as_alone([hard_frame(name, colour=colour).image for name in sorted(HARD)[first::7]])


@pytest.mark.parametrize("height", [901, 920])
def test_large_pictures_compressed_by_a_camera(height):
    """Large ones are settled by a quick look; rows need not fill their blocks; the window leaves rows out."""
    rng = np.random.default_rng(1)
    window = np.tile([20.0, 600.0], (height, 1))
    window[:100] = np.nan
    pictures, roundings = [], []
    for k, spec in enumerate(ODD[:6]):
        picture, _ = clean(LineSpec(**{**vars(spec), "height": height, "width": 640, "colour": RED}), rng)
        jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80 + 3 * k])[1]
        pictures.append(np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), np.uint8))
        roundings.append(rounding_of(jpeg.tobytes()) if k % 3 else None)
    assert_as_alone(pictures, POOLED, window)
    assert_as_alone(pictures, POOLED, window, roundings)


@pytest.mark.parametrize("method", ["cog", "brightest"])
def test_other_methods(method):
    rng = np.random.default_rng(2)
    assert_as_alone([clean(spec, rng)[0] for spec in ODD[:3]], LaserLineParams(method=method))


def test_rows_found_in_one_picture_say_nothing_of_the_next():
    """A line that ends at the last row of one picture and begins in the first row of the next is not one line."""
    rng = np.random.default_rng(3)
    lower, upper = (clean(LineSpec(height=400, width=500), rng)[0] for _ in range(2))
    lower[:-3], upper[2:] = 10, 10
    assert_as_alone([lower, upper, lower])
