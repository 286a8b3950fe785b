"""What is no line in one picture without a laser-off frame: paint that leads by its colour; and what looks like it."""

import cv2
import numpy as np
import pytest
from synthetic_lines import GREEN, HARD, RED, Room, hard_frame, line_light, score, sensor
from test_laserline_compressed import compressed
from test_laserline_rounding import drawn

from scanmap.laserline import LaserLineParams, Reason, find_laser_line

GAUSS = LaserLineParams()


def test_a_room_full_of_posters_and_no_line():
    frames = [hard_frame("empty posters", seed) for seed in range(16)]
    false = [score(find_laser_line(frame.image, GAUSS).column_px, frame).false for frame in frames]
    assert np.mean(false) <= 0.006
    assert max(false) <= 0.08


def strip(beside, core, seed=0):
    """A strip of paint 4 px wide, `core` (BGR), between a wall and another thing."""
    light = np.full((300, 400, 3), (60.0, 60.0, 60.0), np.float32)
    light[:, 200:] = beside
    light[:, 200:204] = core
    return sensor(cv2.GaussianBlur(light, (0, 0), 0.7), 1.5, np.random.default_rng(seed))


@pytest.mark.parametrize(("beside", "core"), [((110, 30, 60), (30, 95, 65)), ((60, 60, 60), (20, 95, 65))])
def test_what_takes_another_colours_light_is_paint(beside, core):
    line = find_laser_line(strip(beside, core), GAUSS)
    assert np.isnan(line.column_px).all()
    assert (line.reason == Reason.AMBIGUOUS).mean() > 0.9


@pytest.mark.parametrize("dark", [0.0, 25.0])
def test_a_line_on_a_pole_darker_than_the_room_is_one(dark):
    """A pole takes light of every colour alike, which is not the line's doing."""
    light = np.full((300, 400, 3), 70.0, np.float32)
    light[:, 195:206] -= dark
    light += line_light(np.full(300, 200.3), 60.0, 1.2, 400)[..., None] * np.float32((0.1, 1.0, 0.1))
    line = find_laser_line(sensor(light, 1.5, np.random.default_rng(1)), GAUSS)
    assert np.mean(np.abs(line.column_px - 200.3) < 0.5) >= 0.99


# A camera's colour matrix may take from one channel what it gives another.
@pytest.mark.parametrize("laser", [(-0.2, -0.15, 1.0), (-0.15, 1.0, -0.25)])
@pytest.mark.parametrize("name", ["thin line", "posters"])
def test_a_laser_whose_colour_is_less_than_pure_nothing(laser, name):
    room = Room(600, 800, np.random.default_rng(7))
    HARD[name](room)
    room.laser = laser
    frame = room.frame(True)
    picture = np.asarray(cv2.imdecode(cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1], 1))
    found, false = score(find_laser_line(picture, GAUSS).column_px, frame)
    assert found >= 0.99
    assert false <= 0.002


def across_an_edge(left, right, seed=0):
    """A line that crosses an upright edge of two colours (BGR) aslant; its columns."""
    column = 180.0 + 0.1 * np.arange(400)
    light = np.full((400, 400, 3), left, np.float32)
    light[:, 200:] = right
    light = cv2.GaussianBlur(light, (0, 0), 0.7) + line_light(column, 90.0, 1.6, 400)[..., None] * np.float32(RED)
    return sensor(light, 1.5, np.random.default_rng(seed)), column


@pytest.mark.parametrize("right", [(120.0, 120.0, 120.0), (60.0, 95.0, 130.0), (150.0, 110.0, 80.0)])
def test_a_line_across_an_edge_of_eight_times_the_brightness(right):
    off, scaled = [], []
    for seed in range(4):
        image, column = across_an_edge((14.0, 14.0, 16.0), right, seed)
        line = find_laser_line(image, GAUSS)
        off.append(line.column_px - column)
        scaled.append(off[-1] / line.sigma_px)
    # Within 5 px of the edge; by brightness alone 1.6 px, and 2 sigmas.
    near = np.abs(column - 199.5) < 5.0
    assert np.isfinite(off).mean() >= 0.93
    assert np.sqrt(np.nanmean(np.square(off)[:, near])) <= 1.0
    assert np.nanstd(np.array(scaled)[:, near]) <= 1.6


@pytest.mark.parametrize(("colour", "least", "most_false"), [(True, 0.97, 0.001), (False, 0.65, 0.01)])
def test_white_print_under_the_line(colour, least, most_false):
    frames = [hard_frame("white text", seed, colour=colour) for seed in range(8)]
    scores = [score(find_laser_line(frame.image, GAUSS).column_px, frame) for frame in frames]
    found, false = np.mean(scores, axis=0)
    assert found >= least
    assert false <= most_false


@pytest.mark.parametrize("tone", [False, True])
@pytest.mark.parametrize("laser", [RED, GREEN], ids=["red", "green"])
def test_a_saturated_line_of_any_width_is_no_faulty_column(laser, tone):
    """Upright, its flanks lie four columns or so from the middle in all rows alike."""
    rng, shapes = np.random.default_rng(3), [(sigma, peak) for sigma in (1.4, 1.6, 2.2, 3.6) for peak in (650.0, 950.0)]
    found = []
    for sigma, peak in shapes:
        for u in (0.0, 0.15, 0.5, 0.75):
            pixels = drawn(rng, np.full(48, 139.0 + u), peak, sigma, 1.2, laser, tone)
            line = find_laser_line(compressed(pixels, 88, "444"), GAUSS)
            found.append(np.mean(np.abs(line.column_px - 139.0 - u) < 0.5))
    assert min(found) >= 0.95
