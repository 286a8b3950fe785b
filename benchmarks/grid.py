"""CPU time from range image to occupancy grid: a live view of 181 bearings, and a scan of 1800."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from scanmap.geometry import HeadMount
from scanmap.grid import GridParams, OccupancyGrid, find_floor
from scanmap.grid.evidence import polar_evidence
from scanmap.grid.remap import remap
from scanmap.laserline import Reason
from scanmap.scan import Scan
from scanmap.triangulation import Profile

ROOM = np.array([[-1.5, -0.6, -1.0], [3.1, 4.4, 1.6]])


def box_scan(bearings: int, rows: int = 1200) -> Scan:
    """A scan of an empty room, with noise as a head of 8 cm baseline has it."""
    rng = np.random.default_rng(0)
    scan = Scan(HeadMount((0.03, 0.0, 0.0)), rows)
    slope = np.tan(np.radians(np.linspace(25, -25, rows)))
    head = np.stack([np.ones(rows), np.zeros(rows), slope], axis=1) / np.hypot(1.0, slope)[:, None]
    ok = np.full(rows, Reason.OK, np.uint8)
    for bearing in np.linspace(0.0, np.pi, bearings):
        T = scan.mount.T_world_head(float(bearing))
        with np.errstate(divide="ignore"):
            t = np.maximum(*((corner - T[:3, 3]) / (head @ T[:3, :3].T) for corner in ROOM)).min(axis=1)
        t += 5e-4 * t**2 * rng.standard_normal(rows)
        scan.add(Profile(head * t[:, None], t, 5e-4 * t**2, t, t, ok), float(bearing))
    return scan


def cpu_ms(call: Callable[[], object], repeats: int = 7) -> float:
    """Median CPU time of a call [ms]."""
    times = []
    for _ in range(repeats):
        start = time.thread_time()
        call()
        times.append(1e3 * (time.thread_time() - start))
    return float(np.median(times))


def main() -> None:
    """Print a table: milliseconds of CPU per stage."""
    params = GridParams()
    print("| bearings x rows | floor | polar evidence | remap | whole |\n|---|---|---|---|---|")
    for bearings in (31, 181, 1800):
        scan = box_scan(bearings)
        floor = find_floor(scan)
        evidence = polar_evidence(scan, floor, params)
        stages = (
            lambda scan=scan: find_floor(scan),
            lambda scan=scan, floor=floor: polar_evidence(scan, floor, params),
            lambda evidence=evidence: remap(evidence, params),
            lambda scan=scan: OccupancyGrid.from_scan(scan, params),
        )
        print(f"| {bearings} x {scan.rows} | " + " | ".join(f"{cpu_ms(stage):.0f} ms" for stage in stages) + " |")


if __name__ == "__main__":
    main()
