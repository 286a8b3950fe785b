"""Short runs of doubtful rows with a laser-off frame: the line on print, and what is none."""

import numpy as np
import pytest
from synthetic_lines import line_light, sensor

from scanmap.laserline.offframe import borne_out

HEIGHT, WIDTH, RUN = 60, 200, slice(20, 29)
COLUMN = 100.0 + 0.2 * np.arange(HEIGHT)
ALL = np.ones(HEIGHT, bool)


def asked(added, room=60.0, column=COLUMN, doubtful=ALL, most=18):
    """Share of the rows of a run that are borne out where `added` is the light over a `room`."""
    run = np.full(HEIGHT, np.nan)
    run[RUN] = column[RUN]
    rng = np.random.default_rng(3)
    off = sensor(np.broadcast_to(np.float32(room), (HEIGHT, WIDTH)), 3.0, rng)
    lit = sensor(np.float32(added) + 16.0 + np.zeros((HEIGHT, WIDTH), np.float32), 4.0, rng)
    return borne_out(run, doubtful, most, lit, off, 1.0)[RUN].mean()


LINE = line_light(COLUMN, 24.0, 0.8, WIDTH)


def test_a_line_that_no_row_tells_is_told_by_the_mean_along_it():
    assert asked(LINE) == 1.0
    assert asked(np.zeros((HEIGHT, WIDTH), np.float32)) == 0.0
    # Rows that need no help are not asked, nor are long runs, nor what runs to and fro.
    assert asked(LINE, doubtful=np.arange(HEIGHT) < 24) == 0.0
    assert asked(LINE, most=8) == 0.0
    assert asked(LINE, column=COLUMN + 2.0 * (np.arange(HEIGHT) % 2)) == 0.0


def test_ripples_of_the_compression_go_both_ways_and_are_elsewhere_too():
    cosine = np.cos(np.pi * 3.0 * (np.arange(WIDTH) - 100.0) / 8.0, dtype=np.float32)
    block = np.abs(np.arange(WIDTH) - 101) < 5
    upright = np.full(HEIGHT, 100.0)
    assert asked(20.0 * cosine * block, column=upright) == 0.0
    # Ripples above the line's sides in other blocks, none missing.
    assert asked(LINE + line_light(COLUMN + 30.0, 18.0, 0.8, WIDTH)) == 0.0


@pytest.mark.parametrize(("step", "told"), [(30.0, 0.0), (8.0, 1.0)])
def test_what_an_edge_out_of_its_place_leaves_is_no_line(step, told):
    away = np.arange(WIDTH) - COLUMN[:, None]
    assert asked(LINE, 60.0 + step * (away > 0.0)) == told


def test_a_picture_whose_line_was_given_up_has_nothing_to_be_borne_out():
    plane = np.zeros((40, 200), np.uint8)
    assert not borne_out(np.full(40, np.nan), np.ones(40, bool), 18, plane, plane, 1.0).any()
