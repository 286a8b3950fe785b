"""A run of the line followed over rows that are not sure alone; and not over what only lies in its way."""

import numpy as np
import pytest
from synthetic_lines import GREEN, line_light, sensor

from scanmap.laserline import Laser, LaserLineParams, find_laser_line, look, look_at_all
from scanmap.laserline.onward import goes_on

GAUSS = LaserLineParams()
ROWS, WIDTH, END = 480, 640, 300  # the surface on which the line is clear ends at row END
LEAKY = (0.75, 1.0, 0.7)  # a green laser in a camera that shows bright colours pale
# What the line goes on over, and how high: cut in two channels, so that colour says nothing; and pale, as paint may be.
UNTOLD = [((252.0, 228.0, 205.0), 34.0), ((130.0, 120.0, 110.0), 40.0)]
COLUMN = 250.3 + 0.15 * np.arange(ROWS)


def picture(below, peak, colour=GREEN, peak_below=None, seed=0):
    """A line on grey, and from row END on `peak_below` high, of colour `colour`, on what `below` (BGR) says."""
    light = np.full((ROWS, WIDTH, 3), (60.0, 58.0, 55.0), np.float32)
    light[END:] = below
    height = np.where(np.arange(ROWS) < END, peak, peak if peak_below is None else peak_below)
    line = line_light(COLUMN, height, 1.4, WIDTH)[..., None]
    light[:END] += line[:END] * np.float32(GREEN)
    light[END:] += line[END:] * np.float32(colour)
    return sensor(light, 1.5, np.random.default_rng(seed))


@pytest.mark.parametrize(("below", "peak"), UNTOLD)
def test_a_line_goes_on_where_its_colour_is_not_told(below, peak):
    line = find_laser_line(picture(below, 120.0, LEAKY, peak), GAUSS)
    off = line.column_px - COLUMN
    assert np.mean(np.abs(off[END + 4 :]) < 1.0) >= 0.95
    assert np.nanmax(np.abs(off)) < 1.5
    assert np.nanstd(off[END + 4 :] / line.sigma_px[END + 4 :]) < 1.3


@pytest.mark.parametrize("seed", range(4))
def test_noise_and_an_edge_in_its_way_are_no_line(seed):
    below = np.full((ROWS - END, WIDTH, 3), 90.0, np.float32)
    if seed % 2:
        below[np.arange(WIDTH) > COLUMN[END:, None]] = 130.0
    line = find_laser_line(picture(below, 120.0, peak_below=0.0, seed=seed), GAUSS)
    assert np.isfinite(line.column_px[: END - 3]).all()
    assert np.isfinite(line.column_px[END + 3 :]).mean() <= 0.01


@pytest.mark.parametrize("peak", [15.0, 60.0])
def test_white_paint_in_its_way_is_no_line(peak):
    line = find_laser_line(picture((90.0, 90.0, 90.0), 120.0, (1.0, 1.0, 1.0), peak), GAUSS)
    assert np.isfinite(line.column_px[END + 3 :]).mean() <= 0.01


def test_only_free_rows_ahead_of_long_straight_runs_are_asked():
    plane = picture((60.0, 58.0, 55.0), 120.0)[..., 1]
    line, free = find_laser_line(plane, GAUSS), np.ones(ROWS, bool)
    gap = slice(200, 240)
    line.column_px[gap] = np.nan
    rows, columns = goes_on(line, plane, 1.5, free)
    np.testing.assert_array_equal(rows, np.arange(gap.start, gap.stop))
    assert np.abs(columns - COLUMN[gap]).max() <= 1.0
    dark = np.where(np.isnan(line.column_px)[:, None], np.uint8(58), plane)
    assert not goes_on(line, dark, 1.5, free)[0].size
    # Rows that may have none are not asked, nor what is beyond them.
    free[220] = False
    np.testing.assert_array_equal(goes_on(line, plane, 1.5, free)[0], np.delete(rows, 20))
    free[200:240] = False
    assert not goes_on(line, plane, 1.5, free)[0].size
    free[:] = True
    # The same gap beside runs that are too short, or run to and fro.
    for spoilt in (np.where(np.arange(ROWS) % 30 < 10, np.nan, line.column_px), COLUMN + 2.0 * (np.arange(ROWS) % 2)):
        spoilt[gap] = np.nan
        assert not goes_on(line._replace(column_px=spoilt), plane, 1.5, free)[0].size


def test_a_line_is_followed_in_several_pictures_as_in_each_alone():
    images = [picture(below, 120.0, LEAKY, 40.0, seed) for seed, (below, _) in enumerate([*UNTOLD, *UNTOLD])]
    images.append(sensor(np.full((ROWS, WIDTH, 3), 40.0, np.float32), 1.5, np.random.default_rng(9)))
    green = Laser(1, (1.5, 1.5, 2.1))
    for one, image in zip(look_at_all(np.stack(images), GAUSS, None, green), images, strict=True):
        for together, alone in zip(one.line, look(image, GAUSS, laser=green).line, strict=True):
            np.testing.assert_array_equal(together, alone)
