"""Where an adaptive sweep looks closer: where the room jumps from bearing to bearing, and where it is far away."""

from __future__ import annotations

from collections.abc import Callable
from threading import Condition

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.config import Config
from scanmap.pipeline import Step
from scanmap.scan import Scan
from scanmap.scan.links import bearing_links, depth_edge_slope, disparity
from scanmap.shot import Shot
from scanmap.sweep import SweepParams, between
from scanmap.triangulation import Profile

JUMP_SHARE = 0.03  # of a gap's rows that lie on two surfaces: a table leg seen from across the room has more


class Refinement:
    """Collects the shots of an adaptive sweep as they are processed, and asks for what lies between.

    `hand_out` counts the shots, `collecting` keeps what was made of them, in whatever thread; `bearings` waits until
    both are even.
    """

    def __init__(self, config: Config, calibration: Calibration) -> None:
        self._config = config
        self._calibration = calibration
        self._handed_out = 0
        self._processed = 0
        self._profiles: dict[int, tuple[Profile, float]] = {}
        self._changed = Condition()

    def hand_out(self, shot: Shot) -> Shot:
        """The same shot, counted."""
        self._handed_out += 1
        return shot

    def collecting(self, process: Callable[[Shot], Step]) -> Callable[[Shot], Step]:
        """The same processing, its profiles kept."""

        def kept(shot: Shot) -> Step:
            try:
                step = process(shot)
                with self._changed:
                    self._profiles[shot.index] = step.profile, shot.bearing
                return step
            finally:
                with self._changed:
                    self._processed += 1
                    self._changed.notify_all()

        return kept

    def bearings(self, count: int) -> NDArray[np.float64]:
        """Further bearings [rad] after the first `count` shots; none where these will do."""
        with self._changed:
            self._changed.wait_for(lambda: self._processed >= self._handed_out)
        scan = Scan(self._calibration.mount, self._calibration.intrinsics.height)
        for index in sorted(self._profiles):
            if index < count:
                scan.add(*self._profiles[index])
        return further_bearings(scan.merged(self._config.scan.merge_deg), self._config)


def further_bearings(scan: Scan, config: Config) -> NDArray[np.float64]:
    """Bearings [rad] between those of a scan (B, H) so far whose bearings ascend.

    A gap with a jump in range is halved, again and again until the edge is known to `sweep.fine_deg`: that takes three
    shots where filling a gap of eight fine steps takes seven. A gap before far walls is filled at once, so that
    neighbouring points are `sweep.spacing_m` apart, but no finer than `sweep.fine_deg`.
    """
    if len(scan) < 2:
        return np.empty(0)
    gaps_deg = np.degrees(np.diff(scan.bearings))
    halves_deg = np.where(_jumps(scan, config), gaps_deg / 2, np.inf)
    finest_deg = gaps_deg / np.maximum(np.floor(gaps_deg / config.sweep.fine_deg + 1e-6), 1.0)
    step_deg = np.maximum(np.minimum(halves_deg, _step_for_distance(scan, config.sweep)), finest_deg)
    return between(scan.bearings, step_deg < gaps_deg - 1e-6, step_deg)


def _jumps(scan: Scan, config: Config) -> NDArray[np.bool_]:
    """(B - 1,) whether the range jumps in a gap."""
    linked = bearing_links(disparity(scan, config.scan, 0), slice(None), depth_edge_slope(config.scan))
    both = scan.valid[:-1] & scan.valid[1:]
    jumps = (both & ~linked).sum(axis=1) > JUMP_SHARE * scan.rows
    # A surface that ends where nothing returns, at a window or a door, is an edge as well.
    ends = np.abs(np.diff(scan.valid.sum(axis=1))) > 0.1 * scan.rows
    return np.asarray(jumps | ends)


def _step_for_distance(scan: Scan, params: SweepParams) -> NDArray[np.float64]:
    """(B - 1,) step at which the farther quarter of the rows has points `spacing_m` apart [deg]."""
    far = np.array(
        [np.quantile(row[np.isfinite(row)], 0.75) if np.isfinite(row).any() else 0.0 for row in scan.range_m]
    )
    with np.errstate(divide="ignore"):
        return np.asarray(np.degrees(params.spacing_m / np.maximum(far[:-1], far[1:])), np.float64)
