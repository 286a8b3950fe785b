"""The calibration's covariance as error of a point: against the spread of drawn calibrations, and as it is printed."""

from dataclasses import replace

import numpy as np
import pytest
from analytic_scan import box_scan

from scanmap.calibration import Calibration, CalibrationFile
from scanmap.calibration.uncertainty import Uncertainty, moved
from scanmap.cli.report import print_summary
from scanmap.session.summary import summarise
from scanmap.solvers.budget import calibration_sigma, deviations
from scanmap.triangulation import TriangulationParams, locate

RANGES = np.array([1.0, 3.0, 5.0])


def head() -> Calibration:
    document = {
        "image": {"width": 1600, "height": 1200},
        "head": {"baseline_m": 0.08, "beta_deg": 25.7, "alpha_deg": 32.3},
    }
    return CalibrationFile.model_validate(document).build()


def known() -> Uncertainty:
    """Focal length and plane offset correlated, as a board gives them; units that differ by a million."""
    matrix = np.diag([0.6**2, (0.02e-3) ** 2, (0.2e-3) ** 2])
    matrix[0, 1] = matrix[1, 0] = 0.7 * 0.6 * 0.02e-3
    return Uncertainty(("fx", "plane_d", "offset_x"), matrix)


def test_sigma_is_the_spread_of_drawn_calibrations() -> None:
    exact, uncertain = head(), known()
    stated = calibration_sigma(replace(exact, covariance=uncertain.table()), RANGES)
    rng = np.random.default_rng(1)
    own = exact.intrinsics
    column = own.cx + own.fx * np.tan(np.arctan2(0.08, RANGES) - np.radians(25.7))
    row = np.full(3, round(own.cy))
    drawn = []
    for change in rng.multivariate_normal(np.zeros(3), uncertain.matrix, 2000):
        other = moved(exact, uncertain.names, change)
        drawn.append(locate(column, row, other, TriangulationParams())[0][:, 0] + other.mount.offset_m[0])
    assert stated == pytest.approx(np.std(drawn, axis=0), rel=0.06)
    assert np.isnan(calibration_sigma(exact, RANGES)).all()
    assert np.isnan(calibration_sigma(replace(exact, covariance=uncertain.table()), np.array([0.01]))).all()


def test_a_turned_plane_costs_the_square_of_the_range() -> None:
    """d = x / tan(angle): turning the plane by e moves a point by d^2 / x e."""
    turn = np.radians(0.005)
    table = Uncertainty(("plane_nx", "plane_d"), np.diag([turn**2, 0.0])).table()
    sigma = calibration_sigma(replace(head(), covariance=table), RANGES)
    assert sigma == pytest.approx(turn * RANGES**2 / 0.08, rel=0.02)


def test_directions_of_a_covariance_give_it_back() -> None:
    steps = deviations(known())
    assert steps.T @ steps == pytest.approx(known().matrix, rel=1e-9)


def test_the_budget_is_that_of_the_points_of_each_band() -> None:
    scan = box_scan(np.arange(0, 90, 10), rows=60, sigma_px=0.1)
    summary = summarise(scan)
    ranges = scan.range_m[scan.valid]
    assert sum(band.points for band in summary.budget) == summary.points == scan.valid.sum()
    assert len(summary.budget) > 2
    for band in summary.budget:
        inside = np.sort(scan.sigma_m[scan.valid & (scan.range_m >= band.near_m) & (scan.range_m < band.far_m)])
        below = np.searchsorted(inside, [band.sigma_median_m, band.sigma_p95_m], side="right") / len(inside)
        assert below == pytest.approx([0.5, 0.95], abs=1.5 / len(inside))
    assert (summary.range_min_m, summary.range_max_m) == (ranges.min(), ranges.max())


def test_the_budget_prints_it_beside_the_noise(capsys: pytest.CaptureFixture[str]) -> None:
    scan = box_scan(np.arange(0, 90, 10), rows=60, sigma_px=0.1)
    print_summary(summarise(scan, replace(head(), covariance=known().table())))
    said = capsys.readouterr().out
    assert "calibration mm" in said and "mm at 1 m" in said and "mm at 5 m" in said
    print_summary(summarise(scan, head()))
    assert "states no covariance" in capsys.readouterr().out
