"""However a scan of hardware ends, as a process: the board is left with its laser off, and its motor free."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from scanmap.recording import describe, open_source
from scanmap.twin.firmware import Firmware
from scanmap.twin.ports import pty_port

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals and a pty need POSIX")

IDLE_MS = 40.0  # $1 as the board's owner has it

# A webcam that sees a line on a plain wall. In mid-scan it may be lost, or break in a way nobody foresaw.
SCAN = """
import os
import sys
import cv2
import numpy as np
from fake_cameras import FakeCapture, FakeDevice, noisy
from scanmap.cli import main
from scanmap.rig import camera_stream, grbl_opening
port, ending = sys.argv[1:]
grbl_opening.BOOT_S = camera_stream.WARM_UP_S = camera_stream.AUTOMATIC_WARM_UP_S = camera_stream.FOLLOW_S = 0.1
device = FakeDevice(sizes=((160, 120),), period_s=0.02)

def picture(size):
    is_time = os.path.exists("a.mcap") and os.path.getsize("a.mcap") > 40_000
    device.unplugged = is_time and ending == "lost"
    if is_time and ending == "breaks":
        raise ZeroDivisionError("a bug in a camera's driver")
    pixels = noisy(device.rng, 40, size)
    pixels[:, 30:32, 2] += 120
    return pixels

device.picture = picture
cv2.VideoCapture = lambda *_: FakeCapture(device)
settings = ("rig=hardware", "camera.source=0", "camera.latency_s=0", "calibration.image.width=160",
            "calibration.image.height=120", "camera.timeout_s=0.3", "sweep.step_deg=0.2", "sweep.settle_s=0",
            "sweep.retries=1", "recording.min_free_mb=0", f"stage.port={port}")
words = [word for setting in settings for word in ("--set", setting)]
main(["scan", *words, "--record", "a.mcap", "--out", "a.ply"])
"""


@dataclass
class Board:
    """A firmware behind a pty, and every line it was sent."""

    firmware: Firmware
    port: str
    log: bytearray = field(default_factory=bytearray)

    @property
    def laser_words(self) -> list[bytes]:
        """What was said of the laser: M3, M5 or a reset."""
        return re.findall(rb"M3|M5|\x18", bytes(self.log))

    @property
    def idle_words(self) -> list[bytes]:
        """What was said of the motor between moves."""
        return re.findall(rb"\$1=([\d.]+)", bytes(self.log))


@pytest.fixture
def board() -> Iterator[Board]:
    firmware = Firmware(resets_on_open=False)
    firmware.memory.settings[1] = IDLE_MS
    with pty_port(firmware) as port:
        board = Board(firmware, port)
        plain = firmware.write

        def write(data: bytes) -> None:
            board.log += data
            plain(data)

        firmware.write = write  # type: ignore[method-assign]
        yield board


def start(board: Board, folder: Path, ending: str = "") -> subprocess.Popen[str]:
    command = [sys.executable, "-c", SCAN, board.port, ending]
    paths = os.pathsep.join([*filter(None, sys.path), str(Path(__file__).parent)])
    return subprocess.Popen(
        command,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": paths},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for_shots(process: subprocess.Popen[str], board: Board, recording: Path) -> None:
    """Until the scan is under way with its laser on."""
    deadline = time.monotonic() + 60
    while process.poll() is None and time.monotonic() < deadline:
        if board.firmware.laser_on and recording.exists() and recording.stat().st_size > 40_000:
            return
        time.sleep(0.02)
    process.kill()
    raise AssertionError(process.communicate(timeout=30))


def is_left_in_peace(board: Board) -> bool:
    """The last words were: laser off, and the motor as its owner has it."""
    return (
        not board.firmware.laser_on
        and board.laser_words[-1] in (b"M5", b"\x18")
        and not board.firmware.motor_on
        and float(board.idle_words[-1]) == IDLE_MS == board.firmware.memory.settings[1]
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_scan_in_good_order(board: Board, tmp_path: Path, number: signal.Signals) -> None:
    process = start(board, tmp_path)
    wait_for_shots(process, board, tmp_path / "a.mcap")
    assert b"M3" in board.laser_words and float(board.idle_words[0]) == 255.0
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert is_left_in_peace(board)
    assert describe(tmp_path / "a.mcap").end_reason == "interrupted"
    assert (tmp_path / "a.ply").exists()


@pytest.mark.parametrize(
    ("ending", "words"), [("lost", "no usable frame after 2 tries"), ("breaks", "ZeroDivisionError")]
)
def test_a_camera_that_fails_ends_a_scan_in_good_order(board: Board, tmp_path: Path, ending: str, words: str) -> None:
    process = start(board, tmp_path, ending)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1 and words in errors and "Traceback" not in errors
    assert b"M3" in board.laser_words
    assert is_left_in_peace(board)
    assert len(list(open_source(tmp_path / "a.mcap").shots())) >= 2
    assert describe(tmp_path / "a.mcap").end_reason.startswith("error: ")


def test_after_kill_9_the_watchdog_leaves_the_board_in_peace_as_the_program_would_have(
    board: Board, tmp_path: Path
) -> None:
    process = start(board, tmp_path)
    wait_for_shots(process, board, tmp_path / "a.mcap")
    process.kill()
    process.communicate(timeout=30)
    deadline = time.monotonic() + 15
    while not is_left_in_peace(board) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert is_left_in_peace(board)
    assert len(list(open_source(tmp_path / "a.mcap").shots())) >= 2
    assert "ALARM" not in board.firmware.state  # braked first: the position is kept
