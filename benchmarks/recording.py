"""Cost of recording and of reading back, against writing and reading the same bytes as one plain file.

    python benchmarks/recording.py [--shots 1800] [--off] [--folder DIR]

CPU milliseconds per shot of 285 kB (user and system, all of this process's threads), wall time, MB/s and peak
memory. The file goes to a temporary folder, or to DIR: choose the disk you scan to.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from scanmap.calibration import Calibration
from scanmap.recording import Recorder, describe, open_source
from scanmap.shot import Shot

IMAGE_BYTES = 285_000
HEAD = "[image]\nwidth = 1600\nheight = 1200\n[head]\nbaseline_m = 0.08\nbeta_deg = 25.7\nalpha_deg = 32.3\n"


@contextmanager
def measured(name: str, shots: int, megabytes: float) -> Iterator[None]:
    """Print what the block cost."""
    wall, cpu = time.perf_counter(), time.process_time()
    yield
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    rates = f"{megabytes / cpu:8.0f} MB/s CPU {megabytes / wall:8.0f} MB/s wall"
    print(f"{name:28} {1e3 * cpu / shots:7.3f} ms CPU/shot {rates}")


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shots", type=int, default=1800)
    parser.add_argument("--off", action="store_true", help="with a laser-off image for each shot")
    parser.add_argument("--folder", type=Path, help="where to write")
    options = parser.parse_args()
    rng = np.random.default_rng(1)
    distinct = [b"\xff\xd8\xff" + rng.bytes(IMAGE_BYTES) for _ in range(24)]
    shots = [
        Shot(k, k * 0.0017, k * 0.0017, k / 10, distinct[k % 24], distinct[(k + 7) % 24] if options.off else None)
        for k in range(options.shots)
    ]
    megabytes = sum(len(s.image) + len(s.background or b"") for s in shots) / 1e6
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        plain, recording = Path(folder) / "plain.bin", Path(folder) / "scan.mcap"
        with measured("plain file, write", len(shots), megabytes), plain.open("wb") as file:
            for shot in shots:
                file.write(shot.image + (shot.background or b""))
        with measured("plain file, read", len(shots), megabytes), plain.open("rb") as file:
            while file.read(IMAGE_BYTES):
                pass
        with (
            measured("recording, write", len(shots), megabytes),
            Recorder(recording, calibration=Calibration.loads(HEAD), source="benchmark") as recorder,
        ):
            for shot in shots:
                recorder.write(shot)
        with measured("recording, open", len(shots), megabytes):
            source = open_source(recording)
        with measured("recording, read", len(shots), megabytes):
            count = sum(1 for _ in source.shots())
        with measured("recording, describe", len(shots), megabytes):
            describe(recording)
        overhead = recording.stat().st_size / 1e6 - megabytes
    assert count == len(shots)
    print(f"{overhead * 1e6 / len(shots):.0f} bytes a shot beside the images")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    main()
