"""What a scan amounts to in numbers: range statistics, rows without return and why, the accuracy budget."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from scanmap.calibration import Calibration
from scanmap.laserline import Reason
from scanmap.scan import Scan
from scanmap.solvers.budget import calibration_sigma

RANGE_BANDS_M = (0.0, 0.5, 1.0, 2.0, 3.0, 5.0, np.inf)
CALIBRATION_AT_M = (1.0, 3.0, 5.0)  # where the budget states what the calibration adds


@dataclass(frozen=True)
class Band:
    """Accuracy of the points of one range band."""

    near_m: float
    far_m: float  # inf for the last
    points: int
    sigma_median_m: float
    sigma_p95_m: float
    calibration_m: float  # what the calibration's own uncertainty adds at the median range; NaN if it states none

    @property
    def name(self) -> str:
        """`1 - 2 m`, `over 5 m`."""
        return f"{self.near_m:g} - {self.far_m:g} m" if np.isfinite(self.far_m) else f"over {self.near_m:g} m"


@dataclass(frozen=True)
class Summary:
    """Statistics of a scan."""

    bearings: int
    rows: int
    points: int
    range_min_m: float
    range_median_m: float
    range_max_m: float
    lost: dict[Reason, int]  # cells without a point, by reason, most frequent first
    budget: tuple[Band, ...]  # bands that hold points
    calibration: tuple[tuple[float, float], ...]  # range and the calibration's sigma there [m]; NaN out of view


def summarise(scan: Scan, calibration: Calibration | None = None) -> Summary:
    """`Summary` of a scan; ranges are NaN where it has no point at all.

    Args:
        calibration: the head it was made with; its covariance enters the budget.
    """
    valid = scan.valid
    ranges = scan.range_m[valid]
    low, median, high = np.percentile(ranges, [0, 50, 100]) if ranges.size else (np.nan,) * 3
    counts = np.bincount(scan.reason.ravel(), minlength=len(Reason))
    lost = {reason: int(counts[reason]) for reason in Reason if reason != Reason.OK and counts[reason]}
    return Summary(
        bearings=len(scan),
        rows=scan.rows,
        points=int(ranges.size),
        range_min_m=float(low),
        range_median_m=float(median),
        range_max_m=float(high),
        lost=dict(sorted(lost.items(), key=lambda item: -item[1])),
        budget=_budget(scan, calibration),
        calibration=_calibration(calibration),
    )


def _budget(scan: Scan, calibration: Calibration | None) -> tuple[Band, ...]:
    valid = scan.valid
    ranges, sigma = scan.range_m[valid], scan.sigma_m[valid]
    band_of = np.digitize(ranges, RANGE_BANDS_M[1:-1])
    bands = []
    for k, (near, far) in enumerate(pairwise(RANGE_BANDS_M)):
        inside = sigma[band_of == k]
        if inside.size:
            median, p95 = np.percentile(inside, [50, 95])
            middle = np.array([np.median(ranges[band_of == k])], np.float64)
            own = float(calibration_sigma(calibration, middle)[0]) if calibration is not None else float("nan")
            bands.append(Band(near, far, int(inside.size), float(median), float(p95), own))
    return tuple(bands)


def _calibration(calibration: Calibration | None) -> tuple[tuple[float, float], ...]:
    """The calibration's sigma at round ranges; none where it states no covariance."""
    if calibration is None or not calibration.covariance:
        return ()
    sigma = calibration_sigma(calibration, np.array(CALIBRATION_AT_M))
    return tuple((far, float(own)) for far, own in zip(CALIBRATION_AT_M, sigma, strict=True))
