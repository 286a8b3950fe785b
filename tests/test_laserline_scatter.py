"""What scatters a line: noise and speckle as they are judged, and what is no scatter but another thing's light."""

import numpy as np
import pytest

from scanmap.laserline.noise import noise_variance
from scanmap.laserline.offframe import standing_out
from scanmap.laserline.peaks import fit_gaussian
from scanmap.laserline.pictures import Rows
from scanmap.laserline.runs import frayed


@pytest.mark.parametrize("freedom", [3, 6, 20])
def test_the_variance_of_a_few_samples_is_not_that_of_their_median(freedom: int) -> None:
    """Half of all rows with three samples to spare scatter by less than 0.79 of their mean."""
    residual = np.zeros((freedom + 4, 32_000), np.float32)
    residual[:freedom] = np.random.default_rng(0).normal(0.0, 2.0, (freedom, 32_000))
    found = noise_variance(residual, np.ones_like(residual), np.float32(4.0), [slice(0, 32_000)])
    assert found.mean() == pytest.approx(4.0, rel=0.03)


@pytest.mark.parametrize(("width", "contrast"), [(1.6, 0.2), (2.2, 0.12), (2.2, 0.2), (3.5, 0.15)])
def test_speckle_is_measured_as_it_is(width: float, contrast: float) -> None:
    """However many samples the fit's four parameters were taken from: of half of each core's, 0.8 to 1.4 of it."""
    rng = np.random.default_rng(1)
    x = np.arange(-16.0, 17.0)[:, None]
    bell = np.exp(-0.5 * ((x - rng.uniform(-0.5, 0.5, 1200)) / width) ** 2)
    light = 150.0 * bell * (1.0 + contrast * rng.standard_normal(bell.shape))
    y = np.rint(10.0 + light + 2.0 * rng.standard_normal(bell.shape)).astype(np.float32)
    rows = Rows(np.zeros(1200, np.intp), np.array([2.0]))
    peaks = fit_gaussian(y, np.ones_like(y), rows, np.array([np.nan]))
    assert 0.98 < peaks.contrast[0] / contrast < 1.14


@pytest.mark.parametrize(("dimmed", "given_up"), [(0.5, True), (0.75, False)])
def test_half_a_beam_at_the_end_of_a_run_is_given_up(dimmed: float, given_up: bool) -> None:
    """At a depth edge one surface has a part of the beam, of another width; a mere change of width is a slant."""
    column, width, peak = np.full(40, 50.0), np.full(40, 2.0), np.full(40, 100.0)
    column[:10] = column[30:] = np.nan
    width[[10, 29]], peak[[10, 29]] = 1.2, 100.0 * dimmed
    given = frayed(column, width, peak, np.full(40, 0.02), 40)
    np.testing.assert_array_equal(np.flatnonzero(given), [10, 29] if given_up else [])


def test_what_a_shaken_camera_leaves_grows_with_the_rooms_contrast() -> None:
    """Both pictures differ by noise alone; of an edge of 150 grey levels a twenty-fifth may be left besides."""
    # The difference of two pictures scatters by 2.1; by its median, a whole grey level, by 1.5.
    rng, column = np.random.default_rng(2), np.repeat([100.0, 200.0], 120)
    room = np.tile(np.select([np.arange(300) < 100, np.arange(300) < 200], [30.0, 60.0], 210.0), (240, 1))
    on, off = (np.rint(room + rng.normal(0.0, 1.5, room.shape)).astype(np.uint8) for _ in range(2))
    ratio = standing_out(column, np.full(240, 20.0), on, off, 1.0)
    for rows, contrast in ((slice(0, 120), 30.0), (slice(120, 240), 150.0)):
        assert np.median(ratio[rows]) == pytest.approx(20.0 / np.hypot(1.5, contrast / 25.0), rel=0.1)
