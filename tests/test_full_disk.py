"""A disk that is really full in mid-scan: one clear line, and everything before it can be read."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from scanmap.recording import describe, open_source, recover

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs tmpfs or RLIMIT_FSIZE")

DISK_BYTES = 16 << 20
FILE_BYTES = 1 << 18
SCAN = [
    "scan", "--config", "twin-quick",
    "--set", "calibration.image.width=160", "--set", "calibration.image.height=120", "--set", "twin.room='box'",
    "--set", "sweep.step_deg=0.5", "--set", "recording.min_free_mb=0", "--record", "a.mcap", "--out",
]  # fmt: skip


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 16 MB; mounting one is for root."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("only root may mount a tmpfs, and not everywhere")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def fill(folder: Path, spare: int = 0) -> None:
    """Take all the room there is, but for some bytes."""
    with (folder / "other").open("wb", buffering=0) as other, contextlib.suppress(OSError):
        for size in (1 << 16, 1 << 10):
            while os.statvfs(folder).f_bavail * os.statvfs(folder).f_frsize >= spare + size:
                other.write(bytes(size))


def scan(folder: Path, cloud: Path, before: str = "", fill_at: int | None = None) -> subprocess.CompletedProcess[str]:
    """Scan; somebody else fills the disk as soon as the recording has so many bytes.

    Args:
        before: code that the process runs first.
    """
    command = [sys.executable, "-c", f"{before}\nfrom scanmap.cli import main; main()", *SCAN, str(cloud)]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    recording = folder / "a.mcap"
    while fill_at is not None and process.poll() is None:
        if recording.exists() and recording.stat().st_size > fill_at:
            fill(folder)
            break
        time.sleep(0.002)
    out, errors = process.communicate(timeout=120)
    return subprocess.CompletedProcess(process.args, process.returncode, out, errors)


def is_one_line(said: subprocess.CompletedProcess[str], *words: str) -> bool:
    return said.returncode == 1 and said.stderr.count("\n") == 1 and all(word in said.stderr for word in words)


def everything_before_is_there(recording: Path) -> None:
    shots = list(open_source(recording).shots())
    assert [shot.index for shot in shots] == list(range(len(shots))) and len(shots) > 10
    assert recording.read_bytes().count(b"\xff\xd8\xff") - len(shots) in (0, 1)  # the shot in flight
    assert describe(recording).shots == len(shots)


def test_in_mid_scan_on_a_real_file_system(small_disk: Path, tmp_path: Path) -> None:
    said = scan(small_disk, tmp_path / "a.ply", fill_at=100_000)
    assert is_one_line(said, "stopped after", "No space left on device"), said
    everything_before_is_there(small_disk / "a.mcap")
    assert (tmp_path / "a.ply").exists()  # the results had room elsewhere
    (small_disk / "other").unlink()
    recover(small_disk / "a.mcap", tmp_path / "b.mcap")
    assert list(open_source(tmp_path / "b.mcap").shots()) == list(open_source(small_disk / "a.mcap").shots())


def test_results_without_room_too(small_disk: Path) -> None:
    said = scan(small_disk, small_disk / "a.ply", fill_at=100_000)
    assert is_one_line(said, "No space left on device"), said
    everything_before_is_there(small_disk / "a.mcap")
    assert sorted(path.name for path in small_disk.iterdir()) == ["a.mcap", "other"]  # no half cloud, no half map


def test_a_disk_too_small_for_the_whole_scan_is_noticed_at_the_first_shot(small_disk: Path, tmp_path: Path) -> None:
    fill(small_disk, spare=FILE_BYTES)
    said = scan(small_disk, tmp_path / "a.ply")
    assert is_one_line(said, "still to come", "1 shots are recorded and readable"), said
    assert len(list(open_source(small_disk / "a.mcap").shots())) == 1


def test_at_a_files_largest_size(tmp_path: Path) -> None:
    limit = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({FILE_BYTES}, {FILE_BYTES}))"
    said = scan(tmp_path, tmp_path / "a.ply", limit)
    assert is_one_line(said, "stopped after", "File too large"), said
    everything_before_is_there(tmp_path / "a.mcap")
