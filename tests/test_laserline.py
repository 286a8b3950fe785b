"""The laser line on frames with known truth: the thesis's method, the noise bound, honest sigmas, hard rooms."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_lines import GREEN, HARD, RED, LineSpec, bound, clean, errors, hard_frame, line_light, score, sensor

from scanmap.errors import CameraError
from scanmap.laserline import LaserLineParams, Reason, find_laser_line
from scanmap.laserline.channel import laser_channel

GAUSS = LaserLineParams()
POOLED = LaserLineParams(pool_rows=9)


def rms(values):
    return float(np.sqrt(np.nanmean(np.square(values))))


def test_the_bound_is_the_published_one():
    spec = LineSpec()
    closed = 1.062 * np.sqrt(spec.sigma) * np.hypot(spec.noise, np.sqrt(1 / 12)) / spec.peak
    assert bound(spec) == pytest.approx(closed, rel=0.01)


# The thesis's method


def test_brightest_is_value_and_column_of_each_rows_first_maximum():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 40, (60, 80), np.uint8)
    image[5, [70, 12, 30]] = 200  # a tie: the first counts
    image[6] = 0  # nothing at all
    line = find_laser_line(image, LaserLineParams(method="brightest"))
    for row in range(60):
        values = image[row].tolist()
        if max(values) == 0:
            assert np.isnan(line.column_px[row])
            assert line.reason[row] == Reason.WEAK
        else:
            assert line.column_px[row] == values.index(max(values))
            assert line.peak[row] == max(values)
    assert line.column_px[5] == 12


def test_brightest_ignores_the_off_frame_and_takes_the_conversion_it_is_given():
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (20, 30, 3), np.uint8)
    off = rng.integers(0, 256, (20, 30, 3), np.uint8)
    params = LaserLineParams(method="brightest", grey="bit_index", bit_index=13)
    word = image[..., 0] | image[..., 1].astype(np.uint32) << 8 | image[..., 2].astype(np.uint32) << 16
    np.testing.assert_array_equal(
        find_laser_line(image, params, background=off).column_px, ((word >> 13) & 0xFF).argmax(axis=1)
    )


# At the noise bound


@pytest.mark.parametrize("sigma", [1.0, 2.0, 3.0, 4.0])
@pytest.mark.parametrize("peak", [40.0, 200.0])
def test_each_row_alone_is_at_the_noise_bound(sigma, peak):
    spec = LineSpec(sigma=sigma, peak=peak)
    off, scaled = errors(spec)
    assert np.isfinite(off).mean() >= 0.999
    assert np.abs(off[np.isfinite(off)]).max() < 1.0
    assert rms(off) <= 1.05 * bound(spec)
    assert abs(np.nanmean(off)) <= 4.0 * bound(spec) / np.sqrt(off.size)
    assert 0.9 <= np.nanstd(scaled) <= 1.1


@pytest.mark.parametrize(
    "spec",
    [
        LineSpec(peak=30.0, noise=6.0),
        LineSpec(peak=230.0, noise=1.0),
        LineSpec(peak=400.0, sigma=4.0, noise=6.0),
    ],
    ids=str,
)
def test_sigma_is_honest(spec):
    _, scaled = errors(spec)
    assert 0.9 <= np.nanstd(scaled) <= 1.1


def test_rows_too_dim_alone_count_where_the_line_goes_on():
    """Signal to noise of a row 8.9 +- 1; alone, one row in fifty falls below the least of 6."""
    off, scaled = errors(LineSpec(peak=30.0, noise=6.0))
    assert np.isfinite(off).mean() >= 0.998
    assert rms(off) <= 1.05 * bound(LineSpec(peak=30.0, noise=6.0))
    assert 0.9 <= np.nanstd(scaled) <= 1.1


def test_a_saturated_core_costs_little_and_moves_nothing():
    off, scaled = errors(LineSpec(peak=510.0))
    assert np.isfinite(off).mean() >= 0.999
    assert rms(off) <= 0.018
    assert abs(np.nanmean(off)) < 0.005
    assert 0.9 <= np.nanstd(scaled) <= 1.1


def test_speckle_is_told_from_noise_and_weighed():
    """Bound 0.1335 px; weighing the samples as for additive noise gives 0.23."""
    off, scaled = errors(LineSpec(speckle=0.3), seeds=range(6))
    assert np.isfinite(off).mean() >= 0.999
    assert rms(off) <= 0.145
    assert 0.9 <= np.nanstd(scaled) <= 1.1


def test_the_centre_of_gravity_is_sub_pixel_but_not_at_the_bound():
    off, _ = errors(LineSpec(), LaserLineParams(method="cog"))
    assert np.isfinite(off).mean() >= 0.999
    assert bound(LineSpec()) < rms(off) < 0.06


@pytest.mark.parametrize("step_px", [0.0, 0.6, 3.0, 60.0])
def test_pooling_along_the_line_halves_the_error_and_keeps_depth_steps(step_px):
    off, scaled = errors(LineSpec(step_px=step_px), POOLED)
    assert np.isfinite(off).mean() >= 0.999
    assert not (np.abs(off) > 1.0).any()
    assert rms(off) <= 0.012
    assert 0.9 <= np.nanstd(scaled) <= 1.1


def test_pooling_of_a_bent_line_follows_the_bend():
    row = np.arange(400)
    column = 200.0 + 0.6 * np.abs(row - 200) + 0.2
    image = sensor(line_light(column, 200.0, 2.0, 640) + np.float32(10.0), 3.0, np.random.default_rng(0))
    off = find_laser_line(image, POOLED).column_px - column
    assert np.abs(off[190:211]).max() < 0.12
    assert rms(off) <= 0.0150


# Laws


@given(
    shift=st.integers(-40, 40),
    ambient=st.integers(0, 50),
    u=st.floats(-0.5, 0.5),
    sigma=st.floats(0.9, 3.5),
    slope=st.floats(-0.7, 0.7),
)
@settings(max_examples=40, deadline=None, derandomize=True)
def test_a_moved_line_is_found_moved_and_ambient_light_moves_nothing(shift, ambient, u, sigma, slope):
    row = np.arange(64)
    column = 100.0 + u + slope * (row - 32)

    def seen(column, level):
        image = sensor(line_light(column, 150.0, sigma, 200) + np.float32(level), 1.0, np.random.default_rng(7))
        return find_laser_line(image, GAUSS).column_px

    here, there = seen(column, 10), seen(column + shift, 10 + ambient)
    assert np.isfinite(here).all()
    assert np.isfinite(there).all()
    # Six standard deviations of one row: 1.062 sqrt(sigma) s_n / A, and rounding.
    limit = 6.0 * 1.062 * np.sqrt(sigma) * 1.1 / 150.0 + 0.01
    np.testing.assert_allclose(here, column, atol=limit)
    np.testing.assert_allclose(there - shift, column, atol=limit)


def test_a_mirrored_picture_gives_the_mirrored_line():
    image, _ = clean(LineSpec(height=300, width=400), np.random.default_rng(5))
    there = find_laser_line(np.ascontiguousarray(image[:, ::-1]), GAUSS)
    np.testing.assert_allclose(399.0 - there.column_px, find_laser_line(image, GAUSS).column_px, atol=0.02)


def test_the_same_picture_gives_the_same_line_in_any_thread():
    images = [clean(LineSpec(height=240, width=320, step_px=30.0), np.random.default_rng(k))[0] for k in range(8)]
    alone = [find_laser_line(image, POOLED) for image in images]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda image: find_laser_line(image, POOLED), images * 3))
    for k, line in enumerate(together):
        for a, b in zip(alone[k % 8], line, strict=True):
            np.testing.assert_array_equal(a, b)


def test_the_picture_is_left_as_it_was():
    frame = hard_frame("plain wall")
    image, background = frame.image.copy(), frame.background.copy()
    find_laser_line(image, GAUSS, background, np.tile([200.0, 600.0], (len(image), 1)))
    np.testing.assert_array_equal(image, frame.image)
    np.testing.assert_array_equal(background, frame.background)


@pytest.mark.parametrize(("height", "width"), [(1, 64), (2, 64), (3, 40), (7, 33), (61, 97), (240, 320)])
def test_pictures_of_any_size_are_searched(height, width):
    image, _ = clean(LineSpec(height=height, width=width), np.random.default_rng(0))
    for picture in (image, np.dstack([image // 4, image // 4, image])):
        line = find_laser_line(picture, GAUSS)
        assert all(len(values) == height for values in line)


@pytest.mark.parametrize("level", [0, 128, 255])
def test_an_even_picture_has_no_line(level):
    line = find_laser_line(np.full((64, 80, 3), level, np.uint8), GAUSS)
    assert np.isnan(line.column_px).all()
    assert (line.reason != Reason.OK).all()


def test_a_line_drawn_by_a_computer_scatters_nothing_and_is_found():
    u, height = np.arange(200.0), np.repeat([[180.0], [60.0]], 200, axis=0)
    image = np.rint(10.0 + height * np.exp(-0.5 * ((u - 100.0) / 2.0) ** 2)).astype(np.uint8)
    line = find_laser_line(image, LaserLineParams())
    np.testing.assert_allclose(line.column_px, 100.0, atol=1e-3)
    assert (line.sigma_px > 0.0).all()


@pytest.mark.parametrize("noise", [1.0, 3.0, 6.0])
def test_noise_alone_has_no_line(noise):
    found = [
        np.isfinite(find_laser_line(clean(LineSpec(peak=0.0, noise=noise), np.random.default_rng(k))[0], GAUSS)[0])
        for k in range(2)
    ]
    assert np.mean(found) <= 0.001


def test_a_row_without_a_line_is_nan_with_a_reason_and_a_row_with_one_is_ok():
    for name in ("broken", "window over", "empty posters"):
        line = find_laser_line(hard_frame(name).image, GAUSS)
        found = line.reason == Reason.OK
        for values in line[:4]:
            np.testing.assert_array_equal(np.isfinite(values), found)
        assert set(np.unique(line.reason)) <= set(Reason)


# Window and reasons


def test_nothing_outside_the_window_is_the_line():
    image, truth = clean(LineSpec(height=600, width=800), np.random.default_rng(0))
    image[:, 700:704] = 250  # brighter than the line
    window = np.tile([100.0, 500.0], (600, 1))
    window[:150] = np.nan
    window[450:, 1] = 200.0  # the line is to the right of this
    line = find_laser_line(image, GAUSS, window=window)
    assert (line.reason[:150] == Reason.WINDOW).all()
    assert np.isnan(line.column_px[:150]).all()
    inside = (truth > 100) & (truth < window[:, 1]) & np.isfinite(window[:, 0])
    assert inside[150:450].all()
    np.testing.assert_allclose(line.column_px[inside], truth[inside], atol=0.2)
    found = line.column_px[~inside & np.isfinite(line.column_px)]
    assert found.size == 0


def test_a_window_changes_no_column_inside_it():
    image, _ = clean(LineSpec(), np.random.default_rng(1))
    free, bounded = (
        find_laser_line(image, GAUSS, window=window) for window in (None, np.tile([180.0, 900.0], (1200, 1)))
    )
    np.testing.assert_allclose(bounded.column_px, free.column_px, atol=1e-3)


def test_a_window_of_nothing_gives_nothing():
    image, _ = clean(LineSpec(height=64, width=300), np.random.default_rng(0))
    line = find_laser_line(image, GAUSS, window=np.full((64, 2), np.nan))
    assert (line.reason == Reason.WINDOW).all()
    assert np.isnan(line.column_px).all()


# Real rooms


# What the detector does not manage: name, in colour, with an off frame.
BEYOND = {
    ("white text", False, False),
    # Without colour and without an off frame a tube is a line; which of the two moves only the next bearing tells.
    ("tube of light", False, False),
    # On stripes about as wide as what its colour is measured from, a line's light is not told from theirs.
    ("curtain", True, False),
    ("curtain", False, False),
}
ROOMS = [
    (name, colour, off)
    for name in sorted(HARD)
    for colour in (True, False)
    for off in (False, True)
    if (name, colour, off) not in BEYOND
]


@pytest.mark.parametrize(("name", "colour", "off"), ROOMS)
def test_hard_rooms(name, colour, off):
    frame = hard_frame(name, colour=colour)
    line = find_laser_line(frame.image, GAUSS, frame.background if off else None)
    found, false = score(line.column_px, frame)
    assert false <= 0.005
    if np.isfinite(frame.truth).any():
        assert found >= 0.95


@pytest.mark.parametrize("laser", [RED, GREEN], ids=["red", "green"])
def test_colour_finds_what_its_own_plane_finds(laser):
    spec = LineSpec(height=600, width=800, colour=laser)
    image, truth = clean(spec, np.random.default_rng(3))
    own = np.ascontiguousarray(image[..., int(np.argmax(laser))])
    in_colour, in_grey = find_laser_line(image, GAUSS), find_laser_line(own, GAUSS)
    np.testing.assert_allclose(in_colour.column_px, in_grey.column_px, atol=1e-3)
    assert rms(in_colour.column_px - truth) <= 1.1 * bound(spec)


def test_white_between_red_stripes_is_no_green_laser():
    image = np.full((240, 400, 3), 40, np.uint8)
    image[:, 100:300] = (30, 30, 160)
    image[:, 104:300:12], image[:, 105:300:12] = (150, 155, 160), (150, 155, 160)
    red = line_light(np.full(240, 350.0), 60.0, 1.5, 400)[..., None] * np.float32(RED)
    assert laser_channel(sensor(image + red, 1.5, np.random.default_rng(0))) == 2


# What is no picture of a line


@pytest.mark.parametrize("shape", [(20, 1), (20, 4), (1000, 2), (20, 0), (20, 2, 3), (40, 5, 3)])
def test_a_picture_too_narrow_for_a_line_is_refused_in_words(shape):
    image = np.full(shape, 200, np.uint8)
    if len(shape) == 3:  # a laser beyond doubt
        image[:], image[:, shape[1] // 2] = (0, 0, 0), (10, 10, 255)
    with pytest.raises(CameraError, match=f"picture of {shape[1]}x{shape[0]} px is too narrow: .* 6 columns or more"):
        find_laser_line(image, GAUSS)


def test_six_columns_are_enough_and_the_brightest_sample_needs_one():
    image = np.zeros((20, 6, 3), np.uint8)
    image[:, 2] = 200
    assert len(find_laser_line(image, GAUSS).column_px) == 20
    assert (find_laser_line(image[:, 2:3], LaserLineParams(method="brightest")).column_px == 0).all()
