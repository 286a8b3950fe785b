"""CPU time and peak memory of everything done to a range image after the last shot: filter, normals, mesh, files.

    python benchmarks/scan.py [--bearings 1800] [--rows 1200]

A box room with boxes in it, seen by a head of 8 cm baseline with 0.05 px of column noise.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scanmap.geometry import HeadMount
from scanmap.laserline import Reason
from scanmap.scan import Scan
from scanmap.scan.formats import read_ply, write
from scanmap.scan.mesh import mesh
from scanmap.scan.ply import write_ply
from scanmap.scan.surface import normals, remove_outliers
from scanmap.triangulation import Profile

ROOM = ((-2.0, -1.5, -0.9), (2.5, 3.8, 1.6))
BOXES = (((0.8, 1.0, -0.9), (1.3, 1.6, 0.1)), ((-1.2, 1.4, -0.9), (-0.9, 1.7, 0.9)))
SIGMA_PX, COLUMNS_PER_INVERSE_M = 0.05, 101.0


def room_scan(bearings: int, rows: int, first: float = 0.0, last: float = np.pi) -> Scan:
    """The scan; one cell in 50 has no return."""
    rng = np.random.default_rng(0)
    scan = Scan(HeadMount((0.03, 0.0, 0.0)), rows, {"source": "benchmark"})
    slope = np.tan(np.radians(np.linspace(25, -25, rows)))
    head = np.stack([np.ones(rows), np.zeros(rows), slope], axis=1) / np.hypot(1.0, slope)[:, None]
    for bearing in np.linspace(first, last, bearings):
        T = scan.mount.T_world_head(float(bearing))
        rays = head @ T[:3, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.maximum(*((corner - T[:3, 3]) / rays for corner in np.array(ROOM))).min(axis=1)
            for low, high in np.array(BOXES):
                sides = ((low - T[:3, 3]) / rays, (high - T[:3, 3]) / rays)
                enter, leave = np.minimum(*sides).max(axis=1), np.maximum(*sides).min(axis=1)
                t = np.where((enter < leave) & (enter > 0), np.minimum(t, enter), t)
        sigma = t**2 * SIGMA_PX / COLUMNS_PER_INVERSE_M
        t = t + sigma * rng.standard_normal(rows)
        lost = rng.random(rows) < 0.02
        t[lost] = np.nan
        reason = np.where(lost, Reason.WEAK, Reason.OK).astype(np.uint8)
        line = (0.0 * t + 120.0, COLUMNS_PER_INVERSE_M / t)
        scan.add(Profile(head * t[:, None], t, sigma, *line, reason), float(bearing))
    return scan


def measure(call: Callable[[], Any]) -> tuple[float, float]:
    """CPU time of the process [s], least of two calls, and peak memory beyond what was there before [MB]."""
    seconds = []
    for _ in range(2):
        start = time.process_time()
        call()
        seconds.append(time.process_time() - start)
    tracemalloc.start()
    call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return min(seconds), peak / 1e6


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bearings", type=int, default=1800)
    parser.add_argument("--rows", type=int, default=1200)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    scan = room_scan(options.bearings, options.rows)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(scan, folder / "in.ply")
        steps: dict[str, Callable[[], Any]] = {
            "merge": scan.merged,
            "filter": lambda: remove_outliers(scan),
            "normals": lambda: normals(scan),
            "mesh": lambda: mesh(scan),
            "PLY in memory": lambda: write_ply(scan, BytesIO()),
            "PLY read": lambda: read_ply(folder / "in.ply"),
        }
        for ending in ("ply", "pcd", "xyz", "mesh.ply", "glb", "stl"):
            steps[f"write .{ending}"] = lambda ending=ending: write(scan, folder / f"out.{ending}")  # type: ignore[misc]
        print(f"{len(scan)} bearings x {scan.rows} rows, {np.count_nonzero(scan.valid)} points, "
              f"{len(mesh(scan).triangles)} triangles\n")  # fmt: skip
        print("| step | CPU s | peak MB |\n|---|---|---|")
        for step, call in steps.items():
            seconds, peak = measure(call)
            print(f"| {step} | {seconds:.2f} | {peak:.0f} |", flush=True)


if __name__ == "__main__":
    main()
