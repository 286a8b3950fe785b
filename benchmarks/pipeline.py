"""ms per frame of every part, and replay against decoding alone, in one run.

    python benchmarks/pipeline.py [--frames 300] [--red-filter]

The frames are 1600x1200 JPEGs of about 285 kB: a curved line of sigma 2 px over a noisy, textured background.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from scanmap.config import load
from scanmap.grid import OccupancyGrid
from scanmap.laserline import find_laser_line
from scanmap.pipeline import Pipeline, Processes
from scanmap.recording import Recorder, open_source
from scanmap.scan import Scan
from scanmap.session.job import finished_scan
from scanmap.shot import Shot, decode_image
from scanmap.triangulation import triangulate

WIDTH, HEIGHT = 1600, 1200
DISTINCT = 24
QUALITY, QUALITY_GREY = 89, 88  # of 285 kB a frame


def frames(red_filter: bool = False) -> list[bytes]:
    """Distinct JPEGs of a line that wanders between 2 and 5 m; grey ones as behind a red filter."""
    rng = np.random.default_rng(1)
    rows, columns = np.arange(HEIGHT)[:, None], np.arange(WIDTH)[None, :]
    texture = cv2.GaussianBlur(rng.normal(0, 60, (HEIGHT, WIDTH, 3)).astype(np.float32), (0, 0), 3)
    quality = [cv2.IMWRITE_JPEG_QUALITY, QUALITY_GREY if red_filter else QUALITY]
    made = []
    for k in range(DISTINCT):
        centre = 230 + 20 * np.sin(rows / 190 + k) + k
        line = 190 * np.exp(-0.5 * ((columns - centre) / 2.0) ** 2)
        image = 25 + texture + rng.normal(0, 3, (HEIGHT, WIDTH, 3))
        image += line[..., None] * np.array([0.1, 0.15, 1.0])
        pixels = np.clip(image[..., 2] if red_filter else image, 0, 255).astype(np.uint8)
        made.append(bytes(cv2.imencode(".jpg", pixels, quality)[1]))
    return made


def cpu_ms(action: Callable[[int], object], repeats: int) -> float:
    """Median CPU milliseconds of this thread."""
    spent = []
    for k in range(repeats):
        start = time.thread_time()
        action(k)
        spent.append(1e3 * (time.thread_time() - start))
    return float(np.median(spent))


def peak_mb(pid: int) -> float:
    """Largest resident memory of a process so far."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--red-filter", action="store_true", help="a camera behind a red filter: grey decode")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    settings = ['laserline.grey="luminance_601"'] if options.red_filter else []
    config = load("twin-room", settings)
    head = config.head()
    jpegs = frames(options.red_filter)
    pipeline = Pipeline(head, config.laserline, config.triangulation)
    grey = not pipeline.colour
    print(f"{os.cpu_count()} cores, {DISTINCT} distinct JPEGs of {np.mean([len(j) for j in jpegs]) / 1e3:.0f} kB")

    images = [decode_image(jpeg, grey=grey).image for jpeg in jpegs[:4]]
    lines = [find_laser_line(image, config.laserline, None, pipeline.window) for image in images]
    for name, action in (
        ("decode to grey", lambda k: decode_image(jpegs[k % DISTINCT], grey=True)),
        ("decode to BGR", lambda k: decode_image(jpegs[k % DISTINCT])),
        ("laser line, with window", lambda k: find_laser_line(images[k % 4], config.laserline, None, pipeline.window)),
        ("triangulation", lambda k: triangulate(lines[k % 4], head, config.triangulation)),
    ):
        print(f"{name:28s} {cpu_ms(action, 40):7.2f} ms CPU a frame")

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.mcap"
        with Recorder(path, calibration=head, source="benchmark") as recorder:
            for k in range(options.frames):
                bearing = float(np.radians(180.0 * k / options.frames))
                recorder.write(Shot(k, bearing, bearing, 0.1 * k, jpegs[k % DISTINCT]))
        workers = os.cpu_count() or 1
        start = time.perf_counter()
        with ThreadPoolExecutor(workers) as pool:
            for _ in pool.map(
                lambda k: decode_image(jpegs[k % DISTINCT], grey=grey).image[0, 0], range(options.frames)
            ):
                pass
        decode_s = time.perf_counter() - start
        start = time.perf_counter()
        scan = Scan(head.mount, HEIGHT)
        with Processes(pipeline) as workers:  # their start counts
            sinks = [lambda step: scan.add(step.profile, step.shot.bearing)]
            workers.run(open_source(path).shots(), sinks)
            worker_mb = [peak_mb(pid) for pid in workers.pids]
        replay_s = time.perf_counter() - start
        start = time.perf_counter()
        clean = finished_scan(scan, config)
        finish_s = time.perf_counter() - start
        start = time.perf_counter()
        OccupancyGrid.from_scan(clean, config.grid)
        grid_s = time.perf_counter() - start
    rate = options.frames / decode_s, options.frames / replay_s
    print(f"decode only {rate[0]:.1f} frames/s, replay to Scan {rate[1]:.1f} frames/s, ratio {replay_s / decode_s:.2f}")
    print(f"merge and filter {1e3 * finish_s:.0f} ms, grid {1e3 * grid_s:.0f} ms for {options.frames} bearings")
    print(f"peak memory {peak_mb(os.getpid()):.0f} MB, of the workers {', '.join(f'{mb:.0f}' for mb in worker_mb)} MB")


if __name__ == "__main__":
    main()
