"""What a picture lists beside its line, for mirrors and the second look, and how high a place counts there."""

import numpy as np
import pytest
from synthetic_lines import LineSpec, clean, line_light, sensor

from scanmap.laserline import LaserLineParams, look, ridge_of, ridges

PARAMS = LaserLineParams(grey="luminance_601")


@pytest.mark.parametrize("sigma", [1.0, 2.5, 4.0])
def test_a_line_is_not_listed_beside_itself(sigma):
    image, _ = clean(LineSpec(sigma=sigma), np.random.default_rng(0))
    seen = look(image, PARAMS)
    own = seen.line.column_px[1::8]
    away = np.abs(seen.places - own[:, None])
    assert (np.nanmin(away, axis=1) < 3.0).all()
    # Farther away noise comes near the least that is listed.
    assert ((away > 3.0) & (away < 25.0)).mean() < 0.01


def test_what_is_as_narrow_as_the_line_is_listed_beside_it():
    line, thing = np.full(1200, 500.3), np.full(1200, 540.6)
    light = line_light(line, 150.0, 2.0, 1600) + line_light(thing, 60.0, 2.0, 1600) + np.float32(10.0)
    seen = look(sensor(light, 2.0, np.random.default_rng(0)), PARAMS)
    assert (np.nanmin(np.abs(seen.places - 540.6), axis=1) < 3.0).mean() > 0.99
    np.testing.assert_allclose(seen.line.column_px, 500.3, atol=0.2)


@pytest.mark.parametrize("sigma", [0.8, 1.5, 2.5, 4.0, 6.0, 9.0])
def test_a_ridge_is_as_high_as_its_line_makes_it(sigma):
    """The second look compares a line's height and width with what other pictures show there."""
    light = line_light(np.full(64, 200.3), 120.0, sigma, 400) + np.float32(20.0)
    shown = ridges(sensor(light, 1.0, np.random.default_rng(0)), PARAMS)[:, 195:206].max(axis=1)
    expected = float(ridge_of(np.array([120.0]), np.array([sigma]))[0])
    assert 0.85 * expected <= np.median(shown) <= 1.3 * expected + 3.0


def test_what_touches_the_line_is_not_listed_as_another_thing():
    """Rings of a halo, a glossy edge: 11 px beside the line, which is what its own filters reach over."""
    light = line_light(np.full(1200, 500.3), 150.0, 2.0, 1600) + line_light(np.full(1200, 511.3), 60.0, 1.5, 1600)
    seen = look(sensor(light + np.float32(10.0), 2.0, np.random.default_rng(0)), PARAMS)
    away = np.abs(seen.places - 500.3)
    assert ((away > 4.0) & (away < 20.0)).mean() < 0.01
    np.testing.assert_allclose(seen.line.column_px, 500.3, atol=0.3)
