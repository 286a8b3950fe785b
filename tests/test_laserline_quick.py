"""The quick look of large pictures: it may settle only what the whole search would find."""

import numpy as np
import pytest
from synthetic_lines import HARD, RED, LineSpec, clean, hard_frame, line_light, sensor

from scanmap.laserline import LaserLineParams, find_laser_line, search

PARAMS = LaserLineParams()


def with_and_without(image, monkeypatch):
    """Lines with the quick look and with the whole search alone."""
    quick = find_laser_line(image, PARAMS)
    with monkeypatch.context() as patched:
        patched.setattr(search, "settled", lambda leads, noise, min_snr: np.zeros(leads.column.shape, bool))
        return quick, find_laser_line(image, PARAMS)


@pytest.mark.parametrize("name", sorted(HARD)[::2])
def test_hard_rooms_give_the_same_line_with_the_quick_look(name, monkeypatch):
    quick, whole = with_and_without(hard_frame(name, height=920, width=1240).image, monkeypatch)
    either = np.isfinite(quick.column_px) | np.isfinite(whole.column_px)
    same = np.abs(quick.column_px - whole.column_px) < 0.3
    assert (either & ~same).mean() <= 0.005


def test_a_clean_line_is_settled_by_the_quick_look(monkeypatch):
    image, _ = clean(LineSpec(colour=RED, step_px=40.0), np.random.default_rng(0))
    whole, asked = search.find_candidates, []

    def counted(plane, *rest, **more):
        asked.append(len(plane))
        return whole(plane, *rest, **more)

    monkeypatch.setattr(search, "find_candidates", counted)
    found = find_laser_line(image, PARAMS)
    assert np.isfinite(found.column_px).all()
    assert sum(asked) < 0.25 * len(image)  # the blocks at the steps


@pytest.mark.parametrize("first", range(601, 609))
def test_a_small_thing_between_the_rows_looked_at_is_not_lost(first, monkeypatch):
    column = np.full(1200, 500.0)
    column[first : first + 7] = 560.0
    image = sensor(line_light(column, 200.0, 2.0, 1600) + np.float32(10.0), 3.0, np.random.default_rng(0))
    quick, whole = with_and_without(image, monkeypatch)
    np.testing.assert_array_equal(np.isfinite(quick.column_px), np.isfinite(whole.column_px))
    assert np.isfinite(quick.column_px[first + 1 : first + 6]).all()
    np.testing.assert_allclose(quick.column_px, column, atol=0.3)


def test_a_brighter_thing_for_half_the_height_does_not_take_the_line_along(monkeypatch):
    """A brighter line of another colour beside the laser's: the quick look must leave those rows to the search."""
    rng = np.random.default_rng(0)
    light = np.repeat(np.full((1200, 1600, 1), 12.0, np.float32), 3, axis=2)
    light += line_light(np.full(1200, 500.0), 120.0, 2.0, 1600)[..., None] * np.array(RED, np.float32)
    stripe = line_light(np.full(1200, 900.0), 200.0, 2.0, 1600)
    stripe[600:] = 0.0
    light += stripe[..., None] * np.array([0.9, 1.0, 0.95], np.float32)
    found = find_laser_line(sensor(light, 2.0, rng), PARAMS).column_px
    assert (np.abs(found - 500.0) < 0.5).mean() > 0.98
