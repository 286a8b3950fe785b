"""CPU time of the twin's frames, one thread, by process clock.

Run: python benchmarks/twin.py
"""

import time
from collections.abc import Callable

import cv2
import numpy as np

from scanmap.calibration import Calibration, CalibrationFile, HeadTable, ImageTable
from scanmap.raycast import load_open3d
from scanmap.twin import Truth, TwinCamera, TwinParams, build_scene

HEADS = {
    "thesis 1600x1200": (1600, 1200, 0.08, 25.7),
    "thesis  800x600 ": (800, 600, 0.08, 25.7),
    "wide   1280x720 ": (1280, 720, 0.20, 20.0),
}


def seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def head(width: int, height: int, baseline_m: float, beta_deg: float) -> Calibration:
    table = HeadTable(baseline_m=baseline_m, beta_deg=beta_deg, alpha_deg=32.3)
    return CalibrationFile(image=ImageTable(width=width, height=height), head=table).build()


def frames(camera: TwinCamera, state: list[float | bool], bearings: list[float], lasers: list[bool]) -> float:
    """Mean milliseconds per bearing of grabbing with the laser in each of the states given."""

    def grab() -> None:
        for bearing in bearings:
            for laser in lasers:
                state[:] = [bearing, laser]
                camera.grab()

    return 1e3 * seconds(grab) / len(bearings)


def main() -> None:
    cv2.setNumThreads(1)
    print(f"importing open3d       {seconds(load_open3d):6.2f} s")
    params = TwinParams()
    start = time.process_time()
    scene = build_scene(params, params.light)
    print(f"furnished room, light  {time.process_time() - start:6.2f} s  ({len(scene.room.triangles)} triangles)")
    bearings = np.radians(np.arange(3.0, 180.0, 8.0)).tolist()
    for name, (width, height, baseline, beta) in HEADS.items():
        state: list[float | bool] = [0.0, True]
        calibration = head(width, height, baseline, beta)
        start = time.process_time()
        camera = TwinCamera(scene, calibration, params, lambda state=state: (float(state[0]), bool(state[1])))
        made = time.process_time() - start
        camera.grab()
        on, both = frames(camera, state, bearings, [True]), frames(camera, state, bearings, [True, False])
        again = frames(camera, state, bearings[-1:] * 20, [True])
        print(
            f"{name}  camera {made:5.2f} s   laser on, new bearing {on:6.1f} ms   on + off {both:6.1f} ms   "
            f"same bearing again {again:6.1f} ms"
        )
    truth = Truth(scene, head(1600, 1200, 0.08, 25.7), params.laser)
    sweep = np.radians(np.arange(0.0, 181.0))
    start = time.process_time()
    points = truth.lit_and_seen(sweep).points
    between = time.process_time()
    truth.compare(points, sweep)
    print(f"truth of 181 bearings  {between - start:6.2f} s, compared with {len(points)} points in "
          f"{time.process_time() - between:.2f} s")  # fmt: skip


if __name__ == "__main__":
    main()
