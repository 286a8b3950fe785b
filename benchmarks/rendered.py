"""Replay a rendered scan with known truth through the library and compare the cloud with the true scene.

    python benchmarks/rendered.py SCAN_DIR [--out cloud.ply] [--off] [--set key=value ...]

SCAN_DIR is a folder of frames (scan.csv, frames/, perhaps off/) with rig.json (the head) and truth/scene.ply (the
surface, world frame, metres; truth/faces.npz and objects.json name its things). Accuracy is the unsigned distance of
every point to the surface; completeness the share of the points that the laser lights and the camera sees, one per
bearing, row and thing, that have a measured point within 5 cm.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration, Intrinsics
from scanmap.config import Config, load
from scanmap.geometry import HeadMount, inverse, rigid, transform
from scanmap.laserline import Reason
from scanmap.pipeline import Pipeline, SecondLook, run
from scanmap.raycast import RayScene
from scanmap.recording import open_source
from scanmap.scan import Scan
from scanmap.scan.formats import write
from scanmap.session.job import finished_scan
from scanmap.shot import Shot

F64 = NDArray[np.float64]

RAYS = 8000  # of the fan, for completeness
NEAR_M = 0.05
BANDS_M = (0.0, 1.0, 2.0, 3.0, 5.0, np.inf)


class Truth(NamedTuple):
    """The scene."""

    rays: RayScene
    thing: NDArray[np.int64]  # (M,) of each triangle
    measurable: NDArray[np.bool_]  # (N,) of each thing: mirrors and panes are not


def calibration_of(rig: dict[str, Any]) -> Calibration:
    """The head that rig.json describes."""
    camera, image = rig["camera"], rig["image"]
    k = camera["distortion"]
    intrinsics = Intrinsics(
        image["width"], image["height"], camera["fx"], camera["fy"], camera["cx"], camera["cy"],
        (k["k1"], k.get("k2", 0.0), k.get("p1", 0.0), k.get("p2", 0.0), k.get("k3", 0.0)),
    )  # fmt: skip
    x, y, z = rig["axis"]["head_origin_in_axis_frame_m"]
    return Calibration(
        intrinsics,
        rigid(np.array(camera["R_head_from_camera"]), camera["position_head_m"]),
        np.array(rig["laser"]["plane_head"], np.float64),
        HeadMount((x, y, z)),
    )


def load_truth(path: Path) -> Truth:
    """The mesh of a scene, and which of its triangles belong to what."""
    import trimesh

    mesh = trimesh.load(path, process=False)
    rays = RayScene(mesh.vertices, mesh.faces)
    suffix = path.stem.removeprefix("scene")
    faces = path.with_name(f"faces{suffix}.npz")
    if not faces.exists():
        return Truth(rays, np.zeros(len(mesh.faces), np.int64), np.ones(1, bool))
    things = json.loads(path.with_name(f"objects{suffix}.json").read_text())
    return Truth(rays, np.load(faces)["object_id"].astype(np.int64), np.array([t["countable"] for t in things]))


def replay(shots: list[Shot], calibration: Calibration, config: Config) -> tuple[Scan, F64, float]:
    """The finished scan, counts of all shots' rows by Reason, and CPU seconds."""
    pipeline = Pipeline(calibration, config.laserline, config.triangulation)
    scan = Scan(calibration.mount, calibration.intrinsics.height)
    start = time.process_time()
    second = SecondLook(pipeline)
    run(shots, pipeline.process, [lambda step: scan.add(step.profile, step.shot.bearing), second])
    second.settle(scan, lambda: shots)
    finished = finished_scan(scan, config, second.pictures())
    spent = time.process_time() - start
    return finished, np.bincount(finished.reason.ravel(), minlength=len(Reason)).astype(np.float64), spent


def lit_and_seen(truth: Truth, calibration: Calibration, rig: dict[str, Any], bearings: list[float]) -> Iterator[F64]:
    """World points (N, 3) [m] of each bearing that a perfect scanner would measure: one per row and thing."""
    half = np.radians(rig["laser"]["fan_half_angle_deg"] - 0.5)
    angle = np.linspace(-half, half, RAYS)
    fan = np.stack([np.cos(angle), np.zeros(RAYS), np.sin(angle)], axis=1)
    own = calibration.intrinsics
    for bearing in bearings:
        T = calibration.mount.T_world_head(bearing)
        laser = transform(T, np.array(rig["laser"]["position_head_m"], np.float64))
        camera = transform(T, calibration.T_head_camera[:3, 3])
        hits = truth.rays.cast(laser, fan @ T[:3, :3].T)
        met = np.flatnonzero(hits.triangle >= 0)
        points = laser + hits.distance[met, None] * (fan[met] @ T[:3, :3].T)
        pixel = own.project(transform(inverse(T @ calibration.T_head_camera), points))
        with np.errstate(invalid="ignore"):
            inside = ((pixel > -0.5) & (pixel < [own.width - 0.5, own.height - 0.5])).all(axis=1)
        thing = truth.thing[hits.triangle[met]]
        inside &= truth.measurable[thing] & ~truth.rays.occluded(camera, points, margin_m=3e-3)
        at = np.flatnonzero(inside)
        _, first = np.unique(np.rint(pixel[at, 1]) * 10_000 + thing[at], return_index=True)
        yield points[at[first]]


def report(name: str, scan: Scan, truth: Truth, lit: F64) -> None:
    """Print accuracy, by range, and completeness."""
    from scipy.spatial import cKDTree

    points = scan.points[scan.valid].astype(np.float64)
    error = np.concatenate([truth.rays.distance(part) for part in np.array_split(points, len(points) // 500_000 + 1)])
    far = np.linalg.norm(points, axis=1)
    nearest, _ = cKDTree(points).query(lit, distance_upper_bound=NEAR_M)
    within = [float((error <= limit).mean()) for limit in (0.01, 0.02, 0.05)]
    print(f"{name}: {len(points)} points, within 1/2/5 cm {within[0]:.4f} {within[1]:.4f} {within[2]:.4f}, "
          f"median {1e3 * np.median(error):.2f} mm, p95 {1e3 * np.percentile(error, 95):.2f} mm, "
          f"> 10 cm {(error > 0.1).mean():.5f}, complete {np.isfinite(nearest).mean():.4f} of {len(lit)}")  # fmt: skip
    reach = np.linalg.norm(lit, axis=1)
    for low, high in pairwise(BANDS_M):
        k, band = (far >= low) & (far < high), (reach >= low) & (reach < high)
        if k.any() and band.any():
            print(f"  {low:.0f} to {high:.0f} m: {k.sum():7d} points, median {1e3 * np.median(error[k]):6.2f} mm, "
                  f"p95 {1e3 * np.percentile(error[k], 95):6.2f} mm, > 10 cm {(error[k] > 0.1).mean():.5f}, "
                  f"complete {np.isfinite(nearest[band]).mean():.4f}")  # fmt: skip


def main() -> None:
    """Replay, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scan", type=Path)
    parser.add_argument("--out", type=Path, help="write the cloud too")
    parser.add_argument("--off", action="store_true", help="use the laser-off frames, where the folder has them")
    parser.add_argument("--truth", type=Path, help="the scene's mesh [SCAN_DIR/truth/scene*.ply]")
    parser.add_argument("--set", dest="settings", nargs="*", default=[], help="as of scanmap replay")
    options = parser.parse_args()
    rig = json.loads((options.scan / "rig.json").read_text())
    calibration, config = calibration_of(rig), load("twin-room", options.settings)
    shots = list(open_source(options.scan).shots())
    if not options.off:
        shots = [replace(shot, background=None) for shot in shots]
    scan, reasons, spent = replay(shots, calibration, config)
    print(f"{len(shots)} shots, {1e3 * spent / len(shots):.1f} ms CPU a shot; rows: "
          + ", ".join(f"{Reason(k).words} {n / reasons.sum():.4f}" for k, n in enumerate(reasons) if n))  # fmt: skip
    if options.out:
        write(scan, options.out, config.scan)
    for path in [options.truth] if options.truth else sorted((options.scan / "truth").glob("scene*.ply")):
        truth = load_truth(path)
        lit = np.concatenate(list(lit_and_seen(truth, calibration, rig, [float(shot.bearing) for shot in shots])))
        report(path.stem, scan, truth, lit)


if __name__ == "__main__":
    main()
