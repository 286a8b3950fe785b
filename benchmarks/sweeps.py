"""What adaptive sweeps and exposure brackets gain, each against a plain sweep of as many shots, on the twin's rooms.

    python benchmarks/sweeps.py [--width 640] [adaptive] [bracket]

Points that the laser lights and the camera sees, every half degree (for brackets: at the bearings of the scan), are the
truth; one is measured where a point of the cloud is near. Edges are where the range jumps from one half degree to the
next, far is the farthest quarter, dark are things that throw back less than a twentieth of the light.
"""

from __future__ import annotations

import argparse
import functools
import logging
import tempfile
from pathlib import Path

import numpy as np

from scanmap import session
from scanmap.session import rigs
from scanmap.twin import Truth

FINE_RAD = np.radians(np.arange(0.0, 180.01, 0.5))
ROOMS = {"furnished": (), "empty box, 8 x 3 m": ("twin.room='box'", "twin.box_size_m=[8.0, 3.0, 2.5]")}
ADAPTIVE = ("sweep.mode='adaptive'", "sweep.step_deg=4", "sweep.fine_deg=0.5", "sweep.spacing_m=0.1")
LIGHTS = {"as it comes": (), "a quarter as strong": ("twin.laser.white_wall_peak=0.225",)}
BRACKETS = ((1, 1, 1), (4, 4, 4), (1, 4, 16))  # times the twin's own exposure, three passes each
EXPOSURE_US = 5000.0  # the twin's, at which the line is as bright as it says


def scan(settings: tuple[str, ...]) -> tuple[session.Result, Truth]:
    """One scan of the twin's room and what is true of it."""
    with tempfile.TemporaryDirectory() as text:
        outputs = session.Outputs((Path(text) / "a.ply",), record=Path(text) / "a.mcap")
        with session.prepare_scan(session.Choice("twin-quick", settings), outputs, view=False) as job:
            result = job.run(lambda _: None, lambda: False)
            assert job.truth is not None and result.truth is not None, result.ended
            return result, job.truth


def measured(result: session.Result, truth: Truth, name: str, within_m: float, *, own: bool = False) -> float:
    """Share of the true points of one kind that have a point of the cloud near; of its own bearings or of all."""
    from scipy.spatial import cKDTree

    lit = truth.lit_and_seen(result.scan.bearings if own else FINE_RAD)
    range_m = np.linalg.norm(lit.points, axis=1)
    wanted = range_m > np.quantile(range_m, 0.75) if name == "far" else np.ones(len(range_m), bool)
    if name == "edges":
        grid, index = (np.full((len(FINE_RAD), lit.row.max() + 1), fill) for fill in (np.nan, -1))
        grid[lit.bearing_index, lit.row], index[lit.bearing_index, lit.row] = range_m, np.arange(len(range_m))
        jumps = np.abs(np.diff(grid, axis=0)) > 0.1 * np.fmin(grid[1:], grid[:-1])
        wanted[:] = False
        wanted[np.concatenate([index[:-1][jumps], index[1:][jumps]]).astype(np.intp)] = True
    if name == "dark":
        room = truth._scene.room
        wanted = np.array([max(thing.material.albedo) < 0.05 for thing in room.things])[lit.thing]
    cloud = result.scan.points[result.scan.valid]
    near, _ = cKDTree(cloud).query(lit.points[wanted])
    return float((near < within_m).mean()) if len(near) else float("nan")


def adaptive(size: tuple[str, ...]) -> None:
    """Adaptive against a plain sweep of as many shots."""
    print("\n| room | sweep | shots | edges within 2 cm | 5 cm | far within 5 cm | all within 5 cm | median error mm |")
    print("|---|---|---|---|---|---|---|---|")
    for room, settings in ROOMS.items():
        shots = 0
        for name in ("adaptive", "even"):
            mode = ADAPTIVE if name == "adaptive" else (f"sweep.step_deg={180 / (shots - 1):.6f}",)
            result, truth = scan((*size, *settings, *mode))
            shots = result.shots
            shares = (("edges", 0.02), ("edges", 0.05), ("far", 0.05), ("all", 0.05))
            figures = " | ".join(f"{100 * measured(result, truth, *share):.1f} %" for share in shares).replace(
                "nan %", "-"
            )
            assert result.truth is not None
            print(f"| {room} | {name} | {shots} | {figures} | {1e3 * result.truth.median_m:.1f} |", flush=True)


def bracket(size: tuple[str, ...]) -> None:
    """Three exposures against three passes with one of them."""
    print("\n| laser | exposures | dark within 5 cm | all within 5 cm | median error mm | beyond 10 cm |")
    print("|---|---|---|---|---|---|")
    for light, settings in LIGHTS.items():
        for parts in BRACKETS:
            exposures = ", ".join(f"{EXPOSURE_US * part:g}" for part in parts)
            result, truth = scan((*size, *settings, "sweep.step_deg=4", f"sweep.exposures_us=[{exposures}]"))
            figures = " | ".join(
                f"{100 * measured(result, truth, kind, 0.05, own=True):.1f} %" for kind in ("dark", "all")
            )
            assert result.truth is not None
            last = f"{1e3 * result.truth.median_m:.1f} | {100 * result.truth.beyond_10cm:.2f} %"
            print(f"| {light} | {' '.join(f'{part:g}' for part in parts)} | {figures} | {last} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", metavar="adaptive|bracket", default=["adaptive", "bracket"])
    parser.add_argument("--width", type=int, default=640)
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    rigs.build_scene = functools.lru_cache(rigs.build_scene)  # the light of a room is computed once
    size = (f"calibration.image.width={options.width}", f"calibration.image.height={options.width * 3 // 4}")
    for what in options.what:
        {"adaptive": adaptive, "bracket": bracket}[what]((*size, "recording.min_free_mb=0"))


if __name__ == "__main__":
    main()
