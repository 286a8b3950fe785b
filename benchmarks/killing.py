"""Kill a scan with SIGKILL at random moments, cut and flip its file: is every shot before it readable?

    python benchmarks/killing.py [--kills 50] [--cuts 100] [--flips 100]

A real `scanmap scan` process each time; the figures of docs/reliability.md.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from scanmap.errors import ScanmapError
from scanmap.recording import describe, open_source
from scanmap.shot import Shot

SCAN = (
    "scan", "--config", "twin-quick", "--set", "calibration.image.width=320", "--set", "calibration.image.height=240",
    "--set", "sweep.step_deg=1", "--set", "recording.min_free_mb=0", "--out", "a.ply",
)  # fmt: skip


def readable(path: Path) -> list[Shot]:
    """Every shot that can be read; none where scanmap says that there is nothing."""
    try:
        describe(path)
        return list(open_source(path).shots())
    except ScanmapError:
        return []


def kill(rng: np.random.Generator, whole: dict[int, Shot]) -> tuple[int, int, bool]:
    """Kill a scan; shots handed to the operating system before, shots readable, all as they should be."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "a.mcap"
        command = [sys.executable, "-c", "from scanmap.cli import main; main()", *SCAN]
        process = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        target = int(rng.integers(20_000, 1_200_000))
        while process.poll() is None and not (recording.exists() and recording.stat().st_size > target):
            time.sleep(float(rng.uniform(0.0, 0.01)))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        shots = readable(recording)
        images = len(re.findall(rb"\xff\xd8\xff", recording.read_bytes()))
        return images, len(shots), all(shot.image == whole[shot.index].image for shot in shots)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, count in (("kills", 50), ("cuts", 100), ("flips", 100)):
        parser.add_argument(f"--{name}", type=int, default=count)
    options = parser.parse_args()
    rng = np.random.default_rng(9)
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        command = [sys.executable, "-c", "from scanmap.cli import main; main()", *SCAN]
        subprocess.run(command, cwd=folder, stdout=subprocess.DEVNULL, check=True)
        data = (folder / "a.mcap").read_bytes()
        whole = {shot.index: shot for shot in open_source(folder / "a.mcap").shots()}
        lost, wrong = [], 0
        for _ in range(options.kills):
            begun, read, right = kill(rng, whole)
            lost.append(begun - read)
            wrong += not right
        if lost:
            print(f"{options.kills} kills: {max(lost)} shots lost at most, {sum(lost)} in all, {wrong} files wrong")
        damaged = folder / "b.mcap"
        for name, count in (("cuts", options.cuts), ("flips", options.flips)):
            wrong, fewest, most = 0, 0, 0
            for _ in range(count):
                at = int(rng.integers(8, len(data)))
                flip = bytes([data[at] ^ int(rng.integers(1, 256))]) + data[at + 1 :]
                damaged.write_bytes(data[:at] + (flip if name == "flips" else b""))
                shots = readable(damaged)
                wrong += any(shot.image != whole[shot.index].image for shot in shots if shot.index in whole)
                before = sum(data.find(shot.image) + len(shot.image) <= at for shot in whole.values())
                there = before - len(shots) if name == "cuts" else len(whole) - len(shots)
                fewest, most = min(fewest, there), max(most, there)
            print(f"{count} {name}: {most} shots lost at most that stood before the damage, {wrong} files wrong")


if __name__ == "__main__":
    main()
