"""Lines along an edge of the room's own brightness: paint under half of the line."""

import cv2
import numpy as np
import pytest

from scanmap.laserline import LaserLineParams, find_laser_line, rounding_of

ALONE, POOLED = LaserLineParams(), LaserLineParams(pool_rows=9)
PLACES_PX = (-6, -4, -3, -2, -1, 1, 2, 3, 4, 6)


def frames(ratio, place_px, *, slope=0.0, seed=0):
    """Laser on, laser off (200, 240), and columns: paint `ratio` times as bright right of an edge along the line.

    Light is blurred by 0.6 px, summed over pixels, coded by a power as cameras do, and scattered.
    """
    rng = np.random.default_rng(seed)
    column = 120.0 + rng.random() + slope * (np.arange(200.0) - 100.0)
    x = np.arange(-4.0, 244.0, 0.25) - 0.375
    paint = np.where(x > (column + place_px)[:, None], ratio, 1.0) / np.sqrt(ratio)
    # A room has more in it than one edge, by which two pictures are known to be of one view.
    patches = np.kron(rng.uniform(0.5, 2.0, (10, 62)), np.ones((20, 16)))
    paint = np.where(np.abs(x - 120.0) > 50.0, patches, paint)
    laser = 0.25 * np.exp(-0.5 * np.square((x - column[:, None]) / 1.8))
    pictures = []
    for lit in (1.0, 0.0):
        light = cv2.GaussianBlur(paint * (lit * laser + 0.03), (0, 0), 2.4, sigmaY=1e-3)
        coded = 255.0 * light[:, 16:-16].reshape(200, 240, 4).mean(axis=2) ** (1 / 2.2)
        pictures.append(np.clip(np.rint(coded + 1.5 * rng.standard_normal(coded.shape)), 0, 255).astype(np.uint8))
    return pictures[0], pictures[1], column


def shared(ratio, with_off, params=POOLED):
    """What all rows of upright lines are off by [px], and that over the sigma stated, for edges at several places."""
    off, scaled = [], []
    for seed, place in enumerate(PLACES_PX):
        on, dark, column = frames(ratio, place, seed=seed)
        line = find_laser_line(on, params, dark if with_off else None)
        found = np.isfinite(line.column_px)
        assert found.mean() > 0.98
        off.append(np.mean((line.column_px - column)[found]))
        scaled.append(off[-1] / np.median(line.sigma_px[found]))
    return np.array(off), np.array(scaled)


@pytest.mark.parametrize(("ratio", "limit"), [(1.3, 0.12), (2.0, 0.17)])  # without a look at the edge: 0.16 and 0.43
def test_a_line_along_an_edge_of_paint_is_moved_little_and_says_how_much(ratio, limit):
    off, scaled = shared(ratio, with_off=False)
    assert np.sqrt(np.mean(off**2)) < limit
    # A third of that, where nobody looks, is beyond 5 sigma.
    assert np.sqrt(np.mean(scaled**2)) < 1.6
    assert np.abs(scaled).max() < 4.0


@pytest.mark.parametrize("ratio", [1.3, 2.0])
def test_with_an_off_frame_an_edge_that_moves_the_line_is_in_its_sigma(ratio):
    off, scaled = shared(ratio, with_off=True)
    assert np.sqrt(np.mean(off**2)) < 0.25
    assert np.abs(scaled).max() < 5.0


def test_even_surfaces_are_left_as_they_are():
    on, dark, column = frames(1.0, 0.0, slope=0.1)
    for off in (None, dark):
        line = find_laser_line(on, ALONE, off)
        z = (line.column_px - column) / line.sigma_px
        assert np.isfinite(z).all()
        assert 0.75 < np.std(z) < 1.2


def test_doubt_about_an_edge_does_not_average_out():
    """All rows of an upright line are off alike: pooling must not promise less."""
    on, _, _ = frames(2.0, 1.0)
    alone, pooled = (find_laser_line(on, params) for params in (ALONE, POOLED))
    assert np.nanmedian(pooled.sigma_px) > 0.6 * np.nanmedian(alone.sigma_px)


# Limits: RMS [px]; as the camera's curve codes it, 0.33, 0.12, 0.80 and 0.58.
@pytest.mark.parametrize(
    ("away", "levels", "limit"),
    [(0.0, (0.03, 0.2), 0.15), (0.0, (0.1, 0.3), 0.1), (2.0, (0.03, 0.2), 0.3), (2.0, (0.1, 0.3), 0.3)],
)
def test_along_a_shadow_the_line_is_where_its_light_is(away, levels, limit):
    """Of a camera's curve the same light is less on the bright side.

    The shadow is the only contrast in the picture; what is left of it in the difference is the line itself.
    """
    dark, bright = levels
    off, scaled = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        column, x = 200.3 + 0.05 * (np.arange(300) - 150.0), np.arange(400.0)
        room = dark + (bright - dark) / (1.0 + np.exp(-(x - (column[:, None] + away)) / 0.8))
        line = 0.5 * np.exp(-0.5 * ((x - column[:, None]) / 1.8) ** 2)
        files = []
        for part in (1.0, 0.0):
            light = room[..., None] + part * line[..., None] * np.array([0.015, 0.06, 1.0])
            coded = np.where(light < 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
            pixels = 255.0 * np.clip(coded, 0.0, 1.0) + 1.5 * rng.standard_normal(light.shape)
            data = np.clip(np.rint(pixels), 0, 255).astype(np.uint8)
            files.append(cv2.imencode(".jpg", data, [cv2.IMWRITE_JPEG_QUALITY, 90])[1])
        image, background = (cv2.imdecode(data, cv2.IMREAD_COLOR) for data in files)
        found = find_laser_line(image, POOLED, background, rounding=rounding_of(files[0].tobytes()))
        off.append(found.column_px - column)
        scaled.append(off[-1] / found.sigma_px)
    assert np.isfinite(off).mean() > 0.99
    assert np.sqrt(np.nanmean(np.square(off))) < limit
    assert np.sqrt(np.nanmean(np.square(scaled))) < 1.0
