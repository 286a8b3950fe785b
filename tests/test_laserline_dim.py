"""Lines at the edge of what noise lets through: neighbours lend their width, and sigmas stay honest."""

import numpy as np
import pytest
from synthetic_lines import LineSpec, bound, errors, line_light, sensor

from scanmap.laserline import LaserLineParams, find_laser_line
from scanmap.laserline.pooling import pool

ALONE, POOLED = LaserLineParams(), LaserLineParams(pool_rows=9)


@pytest.mark.parametrize(
    ("sigma", "peak", "noise"),
    [(1.0, 30.0, 6.0), (1.0, 40.0, 6.0), (2.0, 30.0, 6.0), (3.0, 30.0, 6.0), (2.0, 40.0, 6.0)],
)
def test_a_dim_line_is_at_the_bound_without_gross_rows(sigma, peak, noise):
    """Fitted with widths of their own, 0.91 of the rows of the first are found, at 1.4 bounds, one in 100 1 px off."""
    spec = LineSpec(width=700, sigma=sigma, peak=peak, noise=noise)
    off, scaled = errors(spec, ALONE, range(4))
    assert np.isfinite(off).mean() >= 0.985
    assert np.sqrt(np.nanmean(off**2)) <= 1.08 * bound(spec)
    assert (np.abs(off) > max(1.0, 5.0 * bound(spec))).mean() <= 0.001
    assert 0.9 <= np.nanstd(scaled) <= 1.1
    # Nine rows in a pool share what they draw on: that few tell the spread to a twentieth.
    _, scaled = errors(spec, POOLED, range(4))
    assert 0.88 <= np.nanstd(scaled) <= 1.12


def test_a_dim_line_is_no_wider_or_narrower_where_another_surface_begins():
    """Two surfaces with lines of different width, one below the other."""
    rng = np.random.default_rng(0)
    rows = np.arange(400)
    column, width = np.where(rows < 200, 150.3, 210.8), np.where(rows < 200, 1.2, 3.0)
    image = sensor(line_light(column, 30.0, width, 400) + np.float32(10.0), 4.5, rng)
    line = find_laser_line(image, ALONE)
    for part, own in ((slice(20, 180), 1.2), (slice(220, 380), 3.0)):
        off = (line.column_px - column)[part]
        spec = LineSpec(sigma=own, peak=30.0, noise=4.5)
        assert np.isfinite(off).mean() > 0.97
        assert np.sqrt(np.nanmean(off**2)) <= 1.15 * bound(spec)
        assert np.nanmedian(line.width_px[part]) == pytest.approx(own, rel=0.15)


@pytest.mark.parametrize("bend", [0.0, 2e-3, 6e-3])
def test_pooled_sigma_is_honest_whether_the_line_bends_or_not(bend):
    """`bend` [px a row^2] against noise of 0.1 px: of none, of some, and of much that shrinking takes away."""
    rng = np.random.default_rng(1)
    scaled = []
    for _ in range(12):
        row = np.arange(600.0)
        truth = 0.5 * bend * 60.0**2 * np.sin(row / 60.0)
        sigma = np.full(600, 0.1)
        pooled, spread = pool(truth + sigma * rng.standard_normal(600), sigma, 9)
        scaled.append((pooled - truth) / spread)
    assert 0.93 <= np.std(np.concatenate(scaled)) <= 1.07
