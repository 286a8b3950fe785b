"""ms per frame of every part, and replay against decoding alone by our decoder and by OpenCV's, in one run.

    python benchmarks/pipeline.py [--frames 300] [--red-filter]

The frames are 1600x1200 JPEGs of about 285 kB: a curved line of sigma 2 px over a noisy, textured background.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `scanmap replay` has it

import cv2
import numpy as np

from scanmap.calibration import Calibration
from scanmap.config import load
from scanmap.grid import OccupancyGrid
from scanmap.laserline import laser_of, look_at_all
from scanmap.pipeline import TOGETHER, Pipeline, Processes, SecondLook, checked
from scanmap.recording import Recorder, open_source
from scanmap.scan import Scan
from scanmap.session.job import finished_scan
from scanmap.shot import Shot, decode_image
from scanmap.triangulation import triangulate_all

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


class Spent(NamedTuple):
    """What some work took [s]."""

    wall: float
    cpu: float  # of this process and of its workers, once they have ended


def spent(work: Callable[[], object]) -> Spent:
    """Do the work, say what it took."""

    def cpu() -> float:
        used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return sum(one.ru_utime + one.ru_stime for one in used)

    wall, before = time.perf_counter(), cpu()
    work()
    return Spent(time.perf_counter() - wall, cpu() - before)


def decode_all(decode: Callable[[bytes], np.ndarray], jpegs: list[bytes], count: int) -> None:
    """Only decode, in as many threads as there are cores: decoders leave the interpreter's lock."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for _ in pool.map(lambda k: decode(jpegs[k % DISTINCT])[0, 0], range(count)):
            pass


def record(path: Path, jpegs: list[bytes], count: int, head: Calibration) -> None:
    """A recording of so many shots over half a turn."""
    with Recorder(path, calibration=head, source="benchmark") as recorder:
        for k in range(count):
            bearing = float(np.radians(180.0 * k / count))
            recorder.write(Shot(k, bearing, bearing, 0.1 * k, jpegs[k % DISTINCT]))


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
    config = load("twin-room", ['laserline.grey="luminance_601"'] if options.red_filter else [])
    head = config.head()
    jpegs = frames(options.red_filter)
    pipeline = Pipeline(head, config.laserline, config.triangulation)
    grey = not pipeline.colour
    planes = "grey" if grey else "BGR"
    print(f"{os.cpu_count()} cores, {DISTINCT} distinct JPEGs of {np.mean([len(j) for j in jpegs]) / 1e3:.0f} kB")

    decoders: dict[str, Callable[[bytes], np.ndarray]] = {
        "decoder": lambda jpeg: decode_image(jpeg, grey=grey).image,
        "cv2.imdecode": lambda jpeg: cv2.imdecode(
            np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
        ),
    }
    images = np.stack([decode_image(jpeg, grey=grey).image for jpeg in jpegs[:TOGETHER]])
    laser = None if grey else laser_of(images[0], config.laserline)
    lines = [look.line for look in look_at_all(images, config.laserline, pipeline.window, laser)]
    parts: dict[str, Callable[[int], object]] = {
        f"{name} to {planes}": lambda k, decode=decode: decode(jpegs[k % DISTINCT]) for name, decode in decoders.items()
    }
    parts[f"triangulation, {TOGETHER} at once"] = lambda k: triangulate_all(lines, head, config.triangulation)
    for together in (1, TOGETHER):
        parts[f"laser line, {together} at once"] = lambda k, some=images[:together]: [
            look_at_all(some, config.laserline, pipeline.window, laser) for _ in range(TOGETHER // len(some))
        ]
    for name, action in parts.items():
        frames_each = TOGETHER if "at once" in name else 1
        print(f"{name:28s} {cpu_ms(action, 40) / frames_each:7.2f} ms CPU a frame")

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.mcap"
        record(path, jpegs, options.frames, head)
        decoding = {
            name: spent(partial(decode_all, decode, jpegs, options.frames)) for name, decode in decoders.items()
        }
        scan = Scan(head.mount, HEIGHT, capacity=options.frames)
        second_look = SecondLook(pipeline)
        worker_mb = []

        def replay() -> None:
            with Processes(pipeline) as workers:  # their start counts
                sinks = [lambda step: scan.add(step.profile, step.shot.bearing), second_look]
                workers.run(checked(open_source(path).shots(), pipeline), sinks)
                worker_mb.extend(peak_mb(pid) for pid in workers.pids)

        replaying = spent(replay)
        looking = spent(lambda: second_look.settle(scan, open_source(path).shots))
    clean: list[Scan] = []
    finish = spent(lambda: clean.append(finished_scan(scan, config, second_look.pictures())))
    grid = spent(lambda: OccupancyGrid.from_scan(clean[0], config.grid))
    print(f"{'':28s} frames/s  core-ms CPU a frame   replay over it: wall   CPU")
    for name, only in (
        *((f"only {name} to {planes}", only) for name, only in decoding.items()),
        ("replay to Scan", replaying),
    ):
        ratios = "" if only is replaying else f"{replaying.wall / only.wall:27.2f} {replaying.cpu / only.cpu:5.2f}"
        print(f"{name:28s} {options.frames / only.wall:8.1f} {1e3 * only.cpu / options.frames:20.2f}{ratios}")
    print(
        f"second look {1e3 * looking.wall:.0f} ms, merge and filter {1e3 * finish.wall:.0f} ms, "
        f"grid {1e3 * grid.wall:.0f} ms for {options.frames} bearings"
    )
    print(f"peak memory {peak_mb(os.getpid()):.0f} MB, of the workers {', '.join(f'{mb:.0f}' for mb in worker_mb)} MB")


if __name__ == "__main__":
    main()
