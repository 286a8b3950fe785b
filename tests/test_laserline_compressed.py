"""The laser line in pictures as cameras send them: JPEG, with colour at half the columns or less."""

import cv2
import numpy as np
import pytest
from synthetic_lines import GREEN, RED, LineSpec, clean

from scanmap.laserline import LaserLineParams, find_laser_line
from scanmap.laserline.colour import without_colour

ALONE, POOLED = LaserLineParams(), LaserLineParams(pool_rows=9)
SUBSAMPLING = {
    "422": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    "420": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
    "444": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
}


def compressed(image, quality, subsampling="422"):
    """The picture after JPEG."""
    how = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, SUBSAMPLING[subsampling]]
    return cv2.imdecode(cv2.imencode(".jpg", image, how)[1], cv2.IMREAD_UNCHANGED)


def errors(spec, params, quality, subsampling, seeds=range(2)):
    """Errors [px] and errors over sigma_px of all rows."""
    off, scaled = [], []
    for seed in seeds:
        image, truth = clean(spec, np.random.default_rng(seed))
        line = find_laser_line(compressed(image, quality, subsampling), params)
        off.append(line.column_px - truth)
        scaled.append(off[-1] / line.sigma_px)
    return np.concatenate(off), np.concatenate(scaled)


@pytest.mark.parametrize(
    ("colour", "quality", "subsampling", "peak", "limit"),
    [  # limits: RMS pooled [px]; of the laser's own channel alone, without the neighbouring one, 1.3 to 2 times that
        (RED, 85, "422", 200.0, 0.035),
        (RED, 85, "420", 200.0, 0.045),
        (RED, 92, "422", 60.0, 0.065),
        (GREEN, 85, "422", 200.0, 0.020),
        (RED, 95, "444", 200.0, 0.014),
        (None, 85, "422", 60.0, 0.040),
    ],
)
def test_sigma_is_honest_and_pooling_pays_in_a_jpeg(colour, quality, subsampling, peak, limit):
    spec = LineSpec(colour=colour, peak=peak)
    alone, scaled = errors(spec, ALONE, quality, subsampling)
    assert np.isfinite(alone).mean() >= 0.999
    assert 0.8 <= np.nanstd(scaled) <= 1.2
    pooled, scaled = errors(spec, POOLED, quality, subsampling)
    assert np.sqrt(np.nanmean(pooled**2)) <= min(limit, 0.7 * np.sqrt(np.nanmean(alone**2)))
    assert 0.8 <= np.nanstd(scaled) <= 1.2


@pytest.mark.parametrize(("laser", "limit"), [(RED, 0.085), (GREEN, 0.056)], ids=["red", "green"])
def test_with_a_laser_off_frame_the_neighbouring_channel_tells_of_the_place_too(laser, limit):
    """Limits: RMS of each row alone [px]; by the laser's own channel, less the laser-off frame's, 0.106 and 0.062."""
    off, scaled = [], []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        image, truth = clean(LineSpec(height=600, width=800, colour=laser, peak=120.0, sigma=1.0), rng)
        dark = np.clip(np.rint(image.min(axis=1).mean() + 3.0 + 3.0 * rng.standard_normal(image.shape)), 0, 255)
        line = find_laser_line(compressed(image, 85, "420"), ALONE, compressed(dark.astype(np.uint8), 85, "420"))
        off.append(line.column_px - truth)
        scaled.append(off[-1] / line.sigma_px)
    assert np.isfinite(off).mean() >= 0.999
    assert np.sqrt(np.nanmean(np.square(off))) <= limit
    assert 0.8 <= np.nanstd(scaled) <= 1.2


@pytest.mark.parametrize("laser", [RED, GREEN], ids=["red", "green"])
def test_a_line_is_seen_in_its_own_colour_in_a_grey_room(laser):
    """Compressed, an even grey room has no trace of colour but the line."""
    image, truth = clean(LineSpec(colour=laser, noise=1.0), np.random.default_rng(0))
    picture = compressed(image, 85)
    assert not without_colour(picture)
    line = find_laser_line(picture, ALONE)
    assert np.median(line.peak) > 150.0
    assert np.sqrt(np.nanmean((line.column_px - truth) ** 2)) < 0.1


def test_a_grey_picture_in_three_channels_is_told_from_colour():
    image, _ = clean(LineSpec(height=600, width=800), np.random.default_rng(0))
    picture = compressed(np.repeat(image[..., None], 3, axis=2), 85)
    assert without_colour(picture)
    found = find_laser_line(picture, ALONE).column_px
    np.testing.assert_allclose(found, find_laser_line(np.ascontiguousarray(picture[..., 1]), ALONE).column_px)


def test_a_turned_picture_gives_the_line_of_its_copy():
    """Pictures whose rows are another's columns lie otherwise in memory."""
    image, _ = clean(LineSpec(height=400, width=640, colour=RED), np.random.default_rng(0))
    turned = np.ascontiguousarray(image.transpose(1, 0, 2)).transpose(1, 0, 2)
    for view in (turned, image[:, ::-1][:, ::-1]):
        np.testing.assert_array_equal(find_laser_line(view, POOLED).column_px, find_laser_line(image, POOLED).column_px)
    mirrored = image[:, ::-1]
    np.testing.assert_array_equal(
        find_laser_line(mirrored, POOLED).column_px, find_laser_line(np.ascontiguousarray(mirrored), POOLED).column_px
    )


@pytest.mark.parametrize("phase", [0.0, 0.6, 1.3])
def test_a_saturated_upright_line_is_not_moved_by_smeared_colour(phase: float) -> None:
    """Every row lies alike in the JPEG's blocks: what moves one row moves them all, and no pooling takes it out."""
    column = np.full(400, 250.0 + phase)
    light = 4.0 * np.exp(-0.5 * ((np.arange(500.0) - column[:, None]) / 1.9) ** 2)
    rng = np.random.default_rng(3)
    sensor = np.stack([share * light + 0.06 for share in (0.05, 0.12, 1.0)], axis=-1)
    sensor += 0.01 * rng.standard_normal(sensor.shape)
    pixels = np.clip(np.rint(255.0 * np.clip(sensor, 0, 1) ** (1 / 2.2)), 0, 255).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, 90, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    image = cv2.imdecode(cv2.imencode(".jpg", pixels, options)[1], cv2.IMREAD_COLOR)
    line = find_laser_line(np.asarray(image, np.uint8), LaserLineParams(pool_rows=9))
    off = line.column_px - column
    assert np.isfinite(off).mean() > 0.99
    assert abs(np.nanmean(off)) < 0.02 and np.nanstd(off) < 0.03


def test_a_cut_core_in_a_grey_jpeg_is_told_by_its_flanks_alone() -> None:
    """Of the cut top JPEG makes samples below saturation, too. Taken for the line's own they move it by 0.1 px."""
    for peak, sigma, limit in ((500.0, 2.0, 0.025), (400.0, 1.5, 0.03), (300.0, 3.0, 0.025)):
        spec = LineSpec(height=480, width=400, peak=peak, sigma=sigma, noise=1.5)
        off, scaled = errors(spec, ALONE, 85, "422", seeds=range(4))
        assert np.isfinite(off).all()
        assert np.sqrt(np.mean(off**2)) < limit
        assert 0.8 < np.sqrt(np.mean(scaled**2)) < 1.15


@pytest.mark.parametrize(("sigma", "limit"), [(1.2, 0.035), (2.0, 0.02)])  # RMS pooled [px]; before, 0.054 and 0.034
def test_lines_cut_four_times_over_are_placed_where_the_cut_is_told(sigma: float, limit: float) -> None:
    """The cut core lacks colour, which smeared makes the other channels see too much of its flanks."""
    off, scaled = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        column = 180.0 + rng.uniform(0.0, 8.0) + 0.02 * (np.arange(480) - 240.0)
        bell = np.exp(-0.5 * ((np.arange(400.0) - column[:, None]) / sigma) ** 2)[..., None]
        light = 40.0 + 1000.0 * bell * np.array(RED) + 2.5 * rng.standard_normal((480, 400, 3))
        picture = compressed(np.clip(np.rint(light), 0, 255).astype(np.uint8), 90, "420")
        line = find_laser_line(picture, POOLED)
        off.append(line.column_px - column)
        scaled.append(off[-1] / line.sigma_px)
    assert np.isfinite(off).mean() > 0.99
    assert np.sqrt(np.nanmean(np.square(off))) < limit
    assert np.nanstd(scaled) < 2.0


@pytest.mark.parametrize(
    ("subsampling", "lean", "limit"),
    # Limits: RMS pooled [px]; by the laser's channel alone, uncut as it seems, 0.069, 0.050 and 0.053.
    [("420", 0.0, 0.025), ("420", 0.3, 0.022), ("444", 0.02, 0.02)],
)
def test_less_a_laser_off_frame_saturated_lines_are_placed_by_brightness_too(subsampling, lean, limit) -> None:
    off, scaled = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        column = 180.0 + rng.uniform(0.0, 8.0) + lean * (np.arange(480) - 240.0)
        room = 40.0 + 6.0 * cv2.GaussianBlur(rng.standard_normal((480, 400)), (0, 0), 25.0)[..., None] * 40.0
        bell = np.exp(-0.5 * ((np.arange(400.0) - column[:, None]) / 2.0) ** 2)[..., None]
        pictures = [room + part * bell * np.array(RED) + 2.5 * rng.standard_normal((480, 400, 3)) for part in (500, 0)]
        on, dark = (compressed(np.clip(np.rint(p), 0, 255).astype(np.uint8), 90, subsampling) for p in pictures)
        line = find_laser_line(on, POOLED, dark)
        off.append(line.column_px - column)
        scaled.append(off[-1] / line.sigma_px)
    assert np.isfinite(off).mean() > 0.99
    assert np.sqrt(np.nanmean(np.square(off))) < limit
    assert np.nanstd(scaled) < 1.15


@pytest.mark.parametrize("laser", [RED, GREEN], ids=["red", "green"])
def test_smeared_colour_beside_a_cut_core_is_no_halo(laser) -> None:
    """What smeared colour leaves of the flanks is no Gaussian; in brightness they are. As a halo's core: 0.1 px off."""
    for seed, over in enumerate((2.2, 3.0, 4.5, 4.5)):
        rng = np.random.default_rng(seed)
        column = rng.uniform(140.0, 156.0) + 0.002 * np.arange(320)
        bell = np.exp(-0.5 * ((np.arange(300.0) - column[:, None]) / rng.uniform(2.3, 3.4)) ** 2)[..., None]
        light = 255.0 * (over * bell * np.array(laser) + 0.05) + 2.0 * rng.standard_normal((320, 300, 3))
        for quality in (85, 76):
            data = compressed(np.clip(np.rint(light), 0, 255).astype(np.uint8), quality, ("422", "420")[seed % 2])
            line = find_laser_line(data, ALONE)
            off = line.column_px - column
            assert np.isfinite(off).mean() > 0.99
            assert np.sqrt(np.nanmean(off**2)) < 0.05
            assert np.nanpercentile(line.sigma_px, 90) < 0.06


def test_what_other_channels_see_of_a_cut_core_counts_as_its_flanks() -> None:
    """After a tone curve they see a third of it, all below saturation: without that part, 0.026 px."""
    off = []
    for seed in range(4):
        for over in (1.3, 2.0):
            rng, column = np.random.default_rng(seed), 150.0 + 0.29 * seed + 0.05 * np.arange(320)
            bell = np.exp(-0.5 * ((np.arange(320.0) - column[:, None]) / 2.5) ** 2)[..., None]
            light = (over * bell * np.array((0.015, 0.06, 1.0)) + 0.05) ** (1 / 2.2)
            picture = np.clip(np.rint(255.0 * light + 1.5 * rng.standard_normal(light.shape)), 0, 255)
            off.append(find_laser_line(compressed(picture.astype(np.uint8), 92), ALONE).column_px - column)
    assert np.sqrt(np.nanmean(np.square(off))) < 0.0248


@pytest.mark.parametrize(
    ("quality", "subsampling", "limit"),
    [(75, "420", 0.025), (85, "422", 0.015), (90, "422", 0.0125)],  # of 0.7 red and 0.3 green: 0.036, 0.026, 0.018
)
def test_little_is_left_of_what_all_rows_of_an_upright_line_share(quality: int, subsampling: str, limit: float) -> None:
    shared = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        column, width = 200.0 + 16.0 * rng.random(), rng.uniform(1.2, 2.2)
        light = 0.3 * np.exp(-0.5 * ((np.arange(400.0) - column) / width) ** 2)
        sensor = np.stack([share * light + 0.02 for share in (0.05, 0.12, 1.0)], axis=-1)
        sensor = 255.0 * np.tile(sensor, (240, 1, 1)) ** (1 / 2.2) + 2.0 * rng.standard_normal((240, 400, 3))
        picture = compressed(np.clip(np.rint(sensor), 0, 255).astype(np.uint8), quality, subsampling)
        off = find_laser_line(picture, POOLED).column_px - column
        assert np.isfinite(off).mean() > 0.99
        shared.append(np.nanmean(off))
    assert np.sqrt(np.mean(np.square(shared))) < limit


def test_a_slope_of_the_rooms_light_does_not_move_a_cut_core() -> None:
    """It is three widths squared of the slope over the line's height, and in brightness the line is half as high."""
    off = []
    for seed, slope in enumerate((-0.5, -0.3, 0.3, 0.5)):
        rng, column = np.random.default_rng(seed), np.full(320, 150.0 + 0.29 * seed)
        x = np.arange(300.0) - column[:, None]
        light = (2.5 * np.exp(-0.5 * (x / 2.4) ** 2))[..., None] * np.array(RED)
        light = 255.0 * light + (70.0 + slope * x)[..., None] + 1.5 * rng.standard_normal((320, 300, 3))
        picture = compressed(np.clip(np.rint(light), 0, 255).astype(np.uint8), 92)
        off.append(np.nanmean(find_laser_line(picture, POOLED).column_px - column) * np.sign(slope))
    assert abs(np.mean(off)) < 0.015
