"""What the laser added: what stays of the room, and how much noise the laser-off frame adds."""

import cv2
import numpy as np
import pytest
from synthetic_lines import sensor

from scanmap.laserline.difference import PEDESTAL, without_background


def compressed(plane, quality):
    data = cv2.imencode(".jpg", plane, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))


def added(on, off):
    return without_background(on, off).lit.astype(np.float64) - PEDESTAL


@pytest.mark.parametrize("gain", [0.6, 1.0, 1.5])
def test_the_off_frame_takes_the_room_away_whatever_its_exposure(gain):
    rng = np.random.default_rng(2)
    room = np.repeat(rng.uniform(20, 110, (6, 8)), 40, axis=0).repeat(40, axis=1).astype(np.float32)
    line = np.zeros_like(room)
    line[:, 100:103] = 80.0
    lit = added(sensor(room + line, 1.0, rng), sensor(room * gain, 1.0, rng))
    dark = np.ones(room.shape, bool)
    dark[:, 96:107] = False
    # Edges of the room differ by the smoothing of the off frame; between them nothing is left but noise.
    dark[:, ::40] = dark[:, 1::40] = dark[:, 39::40] = dark[:, 38::40] = False
    dark[::40] = dark[39::40] = dark[1::40] = dark[38::40] = False
    level = np.median(lit[dark])
    assert abs(lit[dark].mean() - level) < 0.5
    assert lit[dark].std() < 2.0
    assert abs(lit[:, 101].mean() - level - 80.0) < 3.0


def test_of_an_even_room_the_off_frame_adds_hardly_any_noise_and_of_its_edges_nothing_stays():
    rng = np.random.default_rng(4)
    room = np.full((400, 400), 60.0, np.float32)
    room[:, 200:] = 110.0
    on, off = sensor(room, 3.0, rng), sensor(room, 3.0, rng)
    lit = added(on, off)
    assert lit[:, :190].std() / on[:, :190].std() < 1.04
    assert abs(lit[:, 195:205].mean(axis=0) - np.median(lit)).max() < 1.0


def test_the_off_threshold_takes_small_differences_for_none():
    rng = np.random.default_rng(3)
    room = np.full((80, 80), 60.0, np.float32)
    line = np.zeros_like(room)
    line[:, 40] = 50.0
    on, off = sensor(room + line, 2.0, rng), sensor(room, 2.0, rng)
    lit = without_background(on, off, threshold=15.0).lit
    level = np.median(lit)
    assert (np.delete(lit, [39, 40, 41], axis=1) == level).all()
    assert (lit[:, 40] > level + 15).all()


@pytest.mark.parametrize("quality", [85, 92, 98])
def test_noise_that_compression_has_spread_is_taken_out_too(quality):
    """Neighbours hardly differ by it: how much of it there is only the two pictures together tell."""
    rng = np.random.default_rng(5)
    room = np.full((400, 400), 60.0, np.float32)
    on, off = (compressed(sensor(room, 2.0, rng), quality) for _ in range(2))
    plain = on.astype(np.float64) - off
    # Over lines, which are 9 px wide and wider, only what is left in their band counts.
    band = [cv2.blur(values, (5, 1)).std() for values in (plain, added(on, off), on.astype(np.float64))]
    brings, leaves = (np.square(band[k]) - np.square(band[2]) for k in (0, 1))
    assert brings > 0.8 * np.square(band[2])
    assert leaves < 0.2 * brings


@pytest.mark.parametrize("slope", [0.0, 0.3, 1.0])
def test_fine_texture_of_the_room_that_stands_out_of_the_noise_is_taken_away(slope):
    """Stripes of a wallpaper as fine as the line and lower than what noise was once taken for."""
    rng = np.random.default_rng(6)
    x = np.arange(400.0) + slope * np.arange(400.0)[:, None]
    room = (60.0 + 3.0 * np.sin(x * (2.0 * np.pi / 8.0))).astype(np.float32)
    on, off = (sensor(room, 0.7, rng) for _ in range(2))
    wave = np.exp(2j * np.pi * x / 8.0)
    stays, before = (2.0 * abs((values * wave).mean()) for values in (added(on, off), on - room.mean()))
    assert before > 2.9
    assert stays < (0.15 if slope == 0.0 else 1.2)


def test_what_is_narrow_and_brighter_than_the_wall_is_as_bright_in_both_pictures():
    """The frame of a door, in a dim picture whose exposure changed: it stood out as a line would."""
    rng = np.random.default_rng(7)
    room = np.full((400, 600), 30.0, np.float32)
    room[:, 300:308] = 38.0
    room[:, 308:] = 8.0
    on, off = sensor(room, 1.5, rng), sensor(1.03 * room, 1.5, rng)
    lit = added(on, off)
    assert abs(lit[:, 301:307].mean()) < 0.4
    assert abs(lit[:, 100:290].mean()) < 0.2


def test_of_a_picture_brighter_than_can_be_told_nothing_is_added():
    on, off = np.full((60, 80), 255, np.uint8), np.full((60, 80), 255, np.uint8)
    assert (without_background(on, off).lit == PEDESTAL).all()


@pytest.mark.parametrize("shape", [(1, 6), (3, 7), (25, 9), (201, 33)])
def test_small_pictures_have_differences_too(shape):
    rng = np.random.default_rng(8)
    off = rng.integers(20, 60, shape).astype(np.uint8)
    lit = without_background(off, off).lit
    assert lit.shape == shape
    assert abs(np.median(lit.astype(int)) - PEDESTAL) <= 20
