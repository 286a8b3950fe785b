"""Pictures without a laser-off frame in which nothing tells the line from things beside it: such rows have none."""

import numpy as np
import pytest
from synthetic_lines import RED, Room, hard_frame, line_light, score, sensor

from scanmap.laserline import LaserLineParams, Reason, find_laser_line

GAUSS = LaserLineParams()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("size", [(600, 800), (1200, 1600)])
def test_a_tube_of_light_beside_the_line_leaves_it_open_which_is_which(seed, size):
    """The line is seen above, below and beside the tube: in the tube's rows one of the two is a thing of the room."""
    frame = hard_frame("tube of light", seed, height=size[0], width=size[1], colour=False)
    line = find_laser_line(frame.image, GAUSS)
    row = np.arange(size[0]) / size[0]
    beside, elsewhere = (row > 0.12) & (row < 0.73), (row < 0.08) | (row > 0.77)
    assert score(line.column_px, frame).false <= 0.002
    assert np.mean(line.reason[beside] == Reason.RIVALS) >= 0.95
    assert np.mean(np.abs(line.column_px - frame.truth)[elsewhere] < 0.5) >= 0.97


def blind(colour, seed=0, gaps=range(80, 800, 45), rows=slice(180, 480)):
    """A blind whose gaps are as narrow as the line and brighter."""
    room = Room(600, 800, np.random.default_rng(seed))
    for x in gaps:
        if np.abs(room.column[rows] - x).min() > 20:
            room.ambient[rows, x : x + 4] = (300.0, 320.0, 330.0)
    return room.frame(colour)


@pytest.mark.parametrize("seed", range(3))
def test_the_gaps_of_a_blind_are_not_the_line(seed):
    frame = blind(False, seed)
    line = find_laser_line(frame.image, GAUSS)
    assert score(line.column_px, frame).false <= 0.01
    off = np.abs(line.column_px - frame.truth)
    assert np.mean(np.concatenate([off[:172], off[488:]]) < 0.5) >= 0.97


def test_colour_tells_the_line_from_the_gaps_of_a_blind():
    frame = blind(True, gaps=(80, 440, 600), rows=slice(20, 580))
    found, false = score(find_laser_line(frame.image, GAUSS).column_px, frame)
    assert found >= 0.97
    assert false == 0.0


@pytest.mark.parametrize("rows", [slice(180, 480), slice(20, 580)])
def test_more_white_gaps_than_are_listed_hide_no_coloured_line(rows):
    """They saturate, so that only what is beside them tells that they are white; and all are higher than the line."""
    frame = blind(True, 1, rows=rows)
    found, false = score(find_laser_line(frame.image, GAUSS).column_px, frame)
    assert found >= 0.97
    assert false == 0.0


@pytest.mark.parametrize("colour", [True, False])
def test_of_a_long_line_and_a_short_piece_of_a_ridge_beside_it_the_line_stays(colour):
    """A thing of the room is dimmer than the line and goes on where that is swallowed: a few rows of it are taken."""
    row = np.arange(600)
    column = 300.0 + 0.05 * row
    light = line_light(np.where(row < 530, column, np.nan), 120.0, 1.8, 800)
    light += line_light(np.full(600, 520.0), 70.0, 1.8, 800)
    light = light[..., None] * np.float32(RED) if colour else light
    line = find_laser_line(sensor(light + np.float32(15.0), 1.5, np.random.default_rng(0)), GAUSS)
    assert np.mean(np.abs(line.column_px - column)[:525] < 0.5) >= 0.98
    assert np.isnan(line.column_px[540:]).all()


@pytest.mark.parametrize("rows", [slice(0, 600), slice(200, 400)])
def test_what_is_far_lower_than_the_line_is_no_rival(rows):
    """Stripes of a wallpaper; where the line is swallowed they may be taken for it, beside it they are not as high."""
    row = np.arange(600)
    column = np.where((row >= rows.start) & (row < rows.stop), 300.0 + 0.05 * row, np.nan)
    light = line_light(column, 150.0, 1.8, 800) + np.float32(15.0)
    for x in range(60, 800, 80):
        light += line_light(np.where(np.abs(column - x) > 25, x, np.where(np.isnan(column), x, np.nan)), 9.0, 2.0, 800)
    line = find_laser_line(sensor(light, 1.0, np.random.default_rng(0)), GAUSS)
    assert np.mean(np.abs(line.column_px - column)[rows] < 0.5) >= 0.97


@pytest.mark.parametrize("name", ["steps", "two segments", "broken", "reflection", "posters", "stripes", "dark"])
@pytest.mark.parametrize("colour", [True, False])
def test_a_line_that_leaves_one_surface_for_another_has_no_rival(name, colour):
    line = find_laser_line(hard_frame(name, colour=colour).image, GAUSS)
    assert not (line.reason == Reason.RIVALS).any()
