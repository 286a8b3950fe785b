"""A small process that switches the laser off if the program that started it dies without doing so.

`kill -9` and a crash run no clean-up code. The program holds a pipe to this process; when the pipe breaks
without a goodbye, this process opens the port and resets the board, which stops the motor and the laser.
Against a pulled USB cable or the computer's own power failure only the laser's switch helps.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time

GOODBYE = b"bye\n"
HOLD, RESET = b"!", b"\x18"
BRAKE_S = 0.5  # between the feed hold and the reset, so that the position is kept
OPEN_S = 10.0  # how long the dead program's port may stay locked


class Watchdog:
    """The program's end: keeps the process until `dismiss`."""

    def __init__(self, url: str, baud: int) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "scanmap.rig.watchdog", url, str(baud)],
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


def watch(url: str, baud: int) -> None:
    """Wait for the goodbye on standard input; at its end without one, reset the board."""
    if GOODBYE in sys.stdin.buffer.read():
        return
    import serial

    from scanmap.rig.serial_port import write_timeout_s

    deadline = time.monotonic() + OPEN_S
    while time.monotonic() < deadline:
        try:
            with serial.serial_for_url(url, baudrate=baud, write_timeout=write_timeout_s(url)) as port:
                port.write(HOLD)
                time.sleep(BRAKE_S)
                port.write(RESET)
                port.flush()
                time.sleep(0.1)
            return
        except (OSError, ValueError):
            time.sleep(0.2)


if __name__ == "__main__":
    watch(sys.argv[1], int(sys.argv[2]))
