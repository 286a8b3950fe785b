"""The line on a surface in reach of a hand: a saturated bar tens of columns wide, found by its two edges."""

import cv2
import numpy as np
import pytest

from scanmap.laserline import LaserLineParams, find_laser_line
from scanmap.laserline.channel import judged_channel

GAUSS = LaserLineParams()


def srgb(light):
    """Grey levels of linear light, 1 = saturation."""
    light = np.clip(light, 0.0, 1.0)
    return 255.0 * np.where(light < 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def near_line(column, sigma, peak, seed=0):
    """A grey frame (H, 1600) of a beam far beyond saturation, with one per cent of veiling glare."""
    light = peak * np.exp(-0.5 * ((np.arange(1600.0) - column[:, None]) / sigma) ** 2)
    light = 0.99 * light + 0.01 * cv2.GaussianBlur(light, (0, 0), 6.0) + 0.02
    scattered = srgb(light) + 1.5 * np.random.default_rng(seed).standard_normal(light.shape)
    return np.clip(np.rint(scattered), 0, 255).astype(np.uint8)


# Columns, beam widths and brightness of the thesis's head at 0.05, 0.1, 0.15 and 0.3 m.
@pytest.mark.parametrize(("u", "sigma", "peak"), [(1530, 12.6, 150), (1072, 6.4, 38), (848, 4.2, 15), (530, 2.5, 8)])
def test_the_line_is_found_down_to_the_nearest_range(u, sigma, peak):
    column = u + 0.02 * (np.arange(400) - 200.0)
    line = find_laser_line(near_line(column, sigma, peak), GAUSS)
    off = line.column_px - column
    assert np.isfinite(off).mean() >= 0.94
    assert np.sqrt(np.nanmean(off**2)) < 0.03
    assert abs(np.nanmean(off)) < 0.005


@pytest.mark.parametrize(("sigma", "peak"), [(4.0, 30.0), (4.0, 60.0)])
def test_a_bar_hardly_wide_enough_for_one_is_found_in_all_rows(sigma, peak):
    """Some rows are profiles, of a height far beyond saturation, and some are bars: 0.89 and 0.94 were found."""
    found = []
    for seed in range(4):
        column = 180.0 + seed + 0.1 * (np.arange(600) - 300.0)
        light = peak * np.exp(-0.5 * ((np.arange(400.0) - column[:, None]) / sigma) ** 2)
        light = 0.99 * light + 0.01 * cv2.GaussianBlur(light, (0, 0), 6.0)
        pixels = srgb(light[..., None] * np.array([0.015, 0.06, 1.0]) + 0.02)
        pixels += 1.5 * np.random.default_rng(seed).standard_normal(pixels.shape)
        data = cv2.imencode(
            ".jpg",
            np.clip(np.rint(pixels), 0, 255).astype(np.uint8),
            [cv2.IMWRITE_JPEG_QUALITY, 90, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422],
        )[1]
        off = find_laser_line(cv2.imdecode(data, cv2.IMREAD_COLOR), GAUSS).column_px - column
        found.append(np.isfinite(off))
        assert np.nanmax(np.abs(off)) < 1.0
    assert np.mean(found) >= 0.985


def test_a_window_as_wide_as_a_bar_has_no_beams_edges():
    image = np.full((400, 1600), 30.0)
    image[40:360, 700:760] = 400.0
    image = cv2.GaussianBlur(image, (0, 0), 0.6)
    line = find_laser_line(np.clip(np.rint(image), 0, 255).astype(np.uint8), GAUSS)
    assert np.isnan(line.column_px).all()


def test_a_saturated_line_along_one_column_is_no_fault_of_the_sensor():
    column = np.full(300, 400.2)
    line = find_laser_line(near_line(column, 0.9, 3.0), GAUSS)
    np.testing.assert_allclose(line.column_px, column, atol=0.1)


NEAR = [(1530, 12.6, 150), (1264, 8.4, 70), (1072, 6.4, 38), (848, 4.2, 15), (698, 3.2, 11), (530, 2.5, 8)]


@pytest.mark.parametrize(("u", "sigma", "peak"), NEAR)
def test_a_red_bar_in_a_colour_jpeg_is_not_taken_for_its_blue_core(u, sigma, peak):
    """Where red saturates over tens of columns, only green and blue are narrow there."""
    column = u + 0.02 * (np.arange(400) - 200.0)
    light = peak * np.exp(-0.5 * ((np.arange(1600.0) - column[:, None]) / sigma) ** 2)
    light = 0.99 * light + 0.01 * cv2.GaussianBlur(light, (0, 0), 6.0)
    image = np.stack([srgb(share * light + 0.02) for share in (0.015, 0.06, 1.0)], axis=-1)
    image += 1.5 * np.random.default_rng(0).standard_normal(image.shape)
    data = cv2.imencode(".jpg", np.clip(np.rint(image), 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
    line = find_laser_line(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8), GAUSS)
    off = line.column_px - column
    assert np.isfinite(off).mean() >= 0.95
    assert np.sqrt(np.nanmean(off**2)) < 0.3
    assert abs(np.nanmean(off)) < 0.02


@pytest.mark.parametrize(
    "light", [(1.0, 1.0, 1.0), (0.97, 0.98, 1.0), (0.6, 0.8, 1.0)], ids=["white", "nearly", "warm"]
)
def test_a_cut_core_is_cut_in_coloured_light_too(light):
    """Where the room's light is taken for grey, what was cut is no longer 255; only in green is it narrow there."""
    x = np.arange(800.0) - 400.0
    image = 70.0 * np.array(light) + (5.0 * 255.0 * np.exp(-0.5 * (x / 2.4) ** 2))[:, None] * np.array((0.06, 0.1, 1.0))
    image = image + 1.5 * np.random.default_rng(0).standard_normal((320, 800, 3))
    assert judged_channel(np.clip(np.rint(image), 0, 255).astype(np.uint8)) == (2, True)
