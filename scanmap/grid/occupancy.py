"""`OccupancyGrid`: log-odds of the cells of a scan's height band."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.grid.evidence import GridParams, polar_evidence
from scanmap.grid.floor import Floor, find_floor
from scanmap.grid.remap import remap
from scanmap.scan import Scan

Mask = NDArray[np.bool_]


class EvidenceModel(NamedTuple):
    """What one bearing's hit or pass adds to a cell, in log-odds, and where the sum is clamped."""

    hit: float
    miss: float
    low: float
    high: float


def log_odds_of(probability: float) -> float:
    """ln(p / (1 - p))."""
    return float(np.log(probability / (1.0 - probability)))


def probability_of(log_odds: float) -> float:
    """Inverse of `log_odds_of`."""
    return float(1.0 / (1.0 + np.exp(-log_odds)))


# OctoMap (Hornung 2013): its defaults. Cartographer: its defaults for 2D hit and miss probabilities.
EVIDENCE_MODELS: Mapping[str, EvidenceModel] = {
    "octomap": EvidenceModel(0.85, -0.4, -2.0, 3.5),
    "cartographer": EvidenceModel(log_odds_of(0.55), log_odds_of(0.49), log_odds_of(0.1), log_odds_of(0.9)),
}


@dataclass(frozen=True)
class OccupancyGrid:
    """Occupancy of square cells, as log-odds; 0 = never seen.

    Row 0 holds the lowest y, column 0 the lowest x: cell (row, col) spans
    `origin + resolution_m * (col .. col + 1, row .. row + 1)` in the level frame (the world frame turned so
    that the floor is level; x is bearing 0).
    """

    log_odds: NDArray[np.float32]  # (rows, cols)
    resolution_m: float
    origin: tuple[float, float]  # lower-left corner x, y [m]
    floor: Floor | None = None  # what the heights were counted from; None for a map from a file
    occupied_above: float = 0.65  # probability
    free_below: float = 0.196  # probability
    comments: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def from_scan(cls, scan: Scan, params: GridParams | None = None) -> OccupancyGrid:
        """The grid of one station's scan, whole or still growing, in any order of bearings.

        A cell counts as occupied or free once it has half the evidence of a single bearing; a cell between
        that is unknown.
        """
        params = params or GridParams()
        floor = find_floor(scan, params.laser_height_m, params.max_tilt_deg)
        counts = remap(polar_evidence(scan, floor, params), params)
        model = EVIDENCE_MODELS[params.evidence]
        log_odds = np.clip(model.hit * counts.hits + model.miss * counts.passes, model.low, model.high)
        return cls(
            log_odds.astype(np.float32),
            params.resolution_m,
            counts.origin,
            floor,
            probability_of(0.5 * model.hit),
            probability_of(0.5 * model.miss),
            dict(scan.comments),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows (y), columns (x)."""
        rows, cols = self.log_odds.shape
        return rows, cols

    def probability(self) -> NDArray[np.float32]:
        """(rows, cols) probability of being occupied; 0.5 where nothing is known."""
        odds = np.exp(self.log_odds)
        return (odds / (1.0 + odds)).astype(np.float32)

    @property
    def occupied(self) -> Mask:
        """(rows, cols) cells above `occupied_above`."""
        mask: Mask = self.probability() > self.occupied_above
        return mask

    @property
    def free(self) -> Mask:
        """(rows, cols) cells below `free_below`."""
        mask: Mask = self.probability() < self.free_below
        return mask

    @property
    def unknown(self) -> Mask:
        """(rows, cols) cells that are neither."""
        return ~(self.occupied | self.free)

    def to_ros(self) -> NDArray[np.int8]:
        """(rows, cols) as nav_msgs/OccupancyGrid has it: -1 unknown, 0 free, 100 occupied; row 0 = lowest y."""
        values = np.full(self.log_odds.shape, -1, dtype=np.int8)
        values[self.free] = 0
        values[self.occupied] = 100
        return values

    def index(self, x: float, y: float) -> tuple[int, int]:
        """Row and column of the cell that holds (x, y) [m]; may lie outside the grid."""
        col, row = np.floor((np.array([x, y]) - self.origin) / self.resolution_m).astype(int)
        return int(row), int(col)

    def centres(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """x (cols,) and y (rows,) of the cell centres [m]."""
        rows, cols = self.shape
        x, y = (
            corner + (np.arange(n) + 0.5) * self.resolution_m
            for corner, n in zip(self.origin, (cols, rows), strict=True)
        )
        return np.asarray(x, np.float64), np.asarray(y, np.float64)
