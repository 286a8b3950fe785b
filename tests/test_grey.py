"""Grey conversions against their definitions, the thesis's two pictures."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from synthetic_lines import GREEN, RED, LineSpec, clean

from scanmap.errors import ConfigError
from scanmap.laserline import LaserLineParams, binary_image, needs_colour, overlay, to_grey
from scanmap.laserline.channel import laser_channel

pictures = arrays(np.uint8, array_shapes(min_dims=2, max_dims=2, max_side=9).map(lambda shape: (*shape, 3)))
planes = arrays(np.uint8, array_shapes(min_dims=2, max_dims=2, max_side=12))


@given(pictures, st.integers(0, 24))
@settings(max_examples=200, deadline=None, derandomize=True)
def test_bit_index_takes_eight_bits_of_the_pixels_word(image, n):
    """T3: bits n to n + 7 of 0xAARRGGBB with AA = 0, pixel by pixel in Python's own integers."""
    expected = [[((int(r) << 16 | int(g) << 8 | int(b)) >> n) & 0xFF for b, g, r in row] for row in image]
    np.testing.assert_array_equal(to_grey(image, "bit_index", n), np.array(expected, np.uint8))


@pytest.mark.parametrize(("n", "channel"), [(0, 0), (8, 1), (16, 2)])
def test_three_bit_indices_are_the_channels(n, channel):
    image = np.random.default_rng(0).integers(0, 256, (7, 5, 3), np.uint8)
    np.testing.assert_array_equal(to_grey(image, "bit_index", n), image[..., channel])


@given(pictures)
@settings(max_examples=50, deadline=None, derandomize=True)
def test_luminances_are_weighted_sums_rounded(image):
    b, g, r = np.moveaxis(image.astype(np.float64), 2, 0)
    exact = {
        "mean": (r + g + b) / 3.0,
        "luminance_601": 0.299 * r + 0.587 * g + 0.114 * b,
        "luminance_709": 0.212671 * r + 0.715160 * g + 0.072169 * b,
        "ycbcr_y": 0.299 * r + 0.587 * g + 0.114 * b,
    }
    for name, value in exact.items():
        # Half a level of rounding, and the conversions' own fixed point.
        np.testing.assert_allclose(to_grey(image, name), value, atol=0.502, err_msg=name)


@given(pictures)
@settings(max_examples=50, deadline=None, derandomize=True)
def test_chrominances_are_those_of_bt601_full_range(image):
    b, g, r = np.moveaxis(image.astype(np.float64), 2, 0)
    y = 0.299 * r + 0.587 * g + 0.114 * b
    # The scale factors 1 / (2 (1 - w)) are rounded to three digits in common implementations: +-0.1 at 255.
    for name, value in (("ycbcr_cr", 128 + (r - y) / 1.402), ("ycbcr_cb", 128 + (b - y) / 1.772)):
        np.testing.assert_allclose(to_grey(image, name), np.clip(value, 0, 255), atol=1.0, err_msg=name)


@given(pictures)
@settings(max_examples=50, deadline=None, derandomize=True)
def test_channels_and_red_gain(image):
    for k, name in enumerate(("blue", "green", "red")):
        np.testing.assert_array_equal(to_grey(image, name), image[..., k])
    total = np.maximum(image.sum(axis=2, dtype=np.float64), 1.0)
    exact = np.clip(image[..., 2].astype(np.float64) ** 2 * 3.0 / total, 0, 255)
    np.testing.assert_allclose(to_grey(image, "red_gain"), exact, atol=1.0)


def test_red_gain_dims_white_and_keeps_red():
    image = np.array([[[200, 200, 200], [20, 20, 200]]], np.uint8)
    white, red = to_grey(image, "red_gain")[0]
    assert white == 200
    assert red == 255


@pytest.mark.parametrize("grey", ["auto", "bit_index", "mean", "red", "ycbcr_cb"])
def test_a_grey_picture_stays_as_it_is(grey):
    image = np.random.default_rng(0).integers(0, 256, (4, 6), np.uint8)
    np.testing.assert_array_equal(to_grey(image, grey), image)


def test_an_unknown_conversion_is_named():
    with pytest.raises(ConfigError, match="'luma'"):
        to_grey(np.zeros((2, 2, 3), np.uint8), "luma")


@pytest.mark.parametrize(("colour", "channel"), [(RED, 2), (GREEN, 1), ((1.0, 0.2, 0.1), 0)])
@pytest.mark.parametrize("peak", [60.0, 900.0])
def test_the_lasers_channel_is_measured_even_where_the_core_is_white(colour, channel, peak):
    spec = LineSpec(height=240, width=320, peak=peak, colour=colour)
    image, _ = clean(spec, np.random.default_rng(1))
    # A window outshines everything in every channel.
    image[40:160, 200:300] = 255
    assert laser_channel(image) == channel


@given(planes)
@settings(max_examples=100, deadline=None, derandomize=True)
def test_the_binary_image_has_the_first_brightest_pixel_of_each_row(plane):
    """T6."""
    binary = binary_image(plane)
    for row, values in zip(binary, plane, strict=True):
        first = values.tolist().index(max(values.tolist()))
        assert np.flatnonzero(row).tolist() == [first]
        assert row[first] == 255


@pytest.mark.parametrize(("colour", "bgr"), [("red", (0, 0, 255)), ("green", (0, 255, 0)), ("blue", (255, 0, 0))])
def test_the_overlay_paints_the_line_and_nothing_else(colour, bgr):
    """T7."""
    plane = np.random.default_rng(4).integers(0, 255, (5, 9), np.uint8)
    painted = overlay(plane, np.array([0.4, np.nan, 8.0, 8.7, 3.6]), colour)
    expected = np.repeat(plane[:, :, None], 3, axis=2)
    for row, column in ((0, 0), (2, 8), (3, 8), (4, 4)):
        expected[row, column] = bgr
    np.testing.assert_array_equal(painted, expected)


@pytest.mark.parametrize(
    ("grey", "colour"),
    [("auto", True), ("bit_index", True), ("red", True), ("mean", True), ("ycbcr_cr", True),
     ("luminance_601", False), ("ycbcr_y", False)],
)  # fmt: skip
def test_only_luminance_is_decoded_without_colour(grey, colour):
    assert needs_colour(LaserLineParams(grey=grey)) is colour
