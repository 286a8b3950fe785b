"""A small process that switches the laser off if the program that started it dies without doing so.

`kill -9` and a crash run no clean-up code. The program holds a pipe to this process; when the pipe breaks
without a goodbye, this process opens the port and resets the board, which stops the motor and the laser; then it
says the last words that the program would have said, so that the motor is free and the board's settings as they were.
Against a pulled USB cable or the computer's own power failure only the laser's switch helps.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import TYPE_CHECKING

from scanmap.rig.grbl_protocol import is_greeting

if TYPE_CHECKING:
    from scanmap.rig.serial_port import SerialPort

GOODBYE = b"bye\n"
HOLD, RESET = b"!", b"\x18"
BRAKE_S = 0.5  # between the feed hold and the reset, so that the position is kept
OPEN_S = 10.0  # how long the dead program's port may stay locked
BOOT_S = 3.0  # an Uno restarts when its port opens; its boot loader takes 1.6 s
ANSWER_S = 1.0


class Watchdog:
    """The program's end: keeps the process until `dismiss`."""

    def __init__(self, url: str, baud: int, last_words: Sequence[str]) -> None:
        """`last_words` are lines, or a reset by itself, to be said one after the other once the board has restarted."""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "scanmap.rig.watchdog", url, str(baud), *last_words],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # a closed terminal and Ctrl-C are for the program, not for its watchdog
        )

    def dismiss(self) -> None:
        """The laser is off: nothing to watch any more. Never raises; may be called twice."""
        if self._process.stdin is None or self._process.stdin.closed:
            return
        with contextlib.suppress(OSError):
            self._process.stdin.write(GOODBYE)
            self._process.stdin.close()
        try:
            self._process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def watch(url: str, baud: int, last_words: Sequence[str]) -> None:
    """Wait for the goodbye on standard input; at its end without one, reset the board and leave it in peace."""
    if GOODBYE in sys.stdin.buffer.read():
        return
    from scanmap.errors import StageError
    from scanmap.rig.serial_port import open_serial

    deadline = time.monotonic() + OPEN_S
    while time.monotonic() < deadline:
        try:
            port = open_serial(url, baud)
        except StageError:
            time.sleep(0.2)
            continue
        with closing(port), contextlib.suppress(StageError):
            _leave_in_peace(port, last_words)
        return


def _leave_in_peace(port: SerialPort, last_words: Sequence[str]) -> None:
    port.write(HOLD)
    time.sleep(BRAKE_S)
    port.write(RESET)
    _await(port, is_greeting, BOOT_S)
    for word in last_words:
        if word == RESET.decode():
            port.write(RESET)
            _await(port, is_greeting, ANSWER_S)
        else:
            port.write_line(word)
            _await(port, lambda line: line == "ok" or line.startswith("error"), ANSWER_S)


def _await(port: SerialPort, is_it: Callable[[str], bool], timeout_s: float) -> None:
    deadline = time.monotonic() + timeout_s
    while (left_s := deadline - time.monotonic()) > 0:
        line = port.read_line(left_s)
        if line is not None and is_it(line):
            return


if __name__ == "__main__":
    watch(sys.argv[1], int(sys.argv[2]), sys.argv[3:])
