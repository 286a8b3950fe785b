"""A serial line in text: whole lines in, whole lines out, bounded time, one kind of error.

Knows no firmware. Every port pyserial can open works: `/dev/ttyUSB0`, `COM3`, `socket://host:23`,
`rfc2217://host:2217`, and `twin://name`, which `scanmap.twin` registers.
"""

from __future__ import annotations

import logging
import time
from typing import Any

from scanmap.errors import StageError

MAX_LINE_BYTES = 4096  # a longer "line" is noise at the wrong baud rate
MAX_DRAIN_BYTES = 1 << 16  # a line that never falls silent must not hold the program

logger = logging.getLogger(__name__)


class SerialPort:
    """An open port that speaks in lines. Not thread-safe."""

    def __init__(self, port: Any, name: str) -> None:
        """`port` is an open pyserial object with a read timeout of a few hundredths of a second."""
        self._port = port
        self._buffer = bytearray()
        self.name = name

    def write(self, data: bytes) -> None:
        """Send bytes as they are.

        Raises:
            StageError: the port is gone, or takes nothing for two seconds.
        """
        logger.debug("%s <- %r", self.name, data)
        try:
            self._port.write(data)
        except (OSError, ValueError) as error:
            raise self._gone(error) from error

    def write_line(self, line: str) -> None:
        """Send one line of ASCII, ended by a newline."""
        self.write(line.encode("ascii") + b"\n")

    def read_line(self, timeout_s: float) -> str | None:
        """The next line that is not empty, without its end; None if none came in time.

        Bytes outside ASCII become `?`: noise must not raise.

        Raises:
            StageError: the port is gone.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            line = self._take_line()
            if line is not None:
                logger.debug("%s -> %s", self.name, line)
                return line
            try:
                self._buffer += self._port.read(max(1, self._port.in_waiting))
            except (OSError, ValueError, TypeError) as error:  # pyserial on a closed POSIX port: TypeError
                raise self._gone(error) from error
            if b"\n" not in self._buffer and time.monotonic() >= deadline:
                return None

    def drain(self) -> list[str]:
        """Lines that have already arrived, without waiting."""
        try:
            taken = 0
            while taken < MAX_DRAIN_BYTES and (waiting := self._port.in_waiting):
                self._buffer += self._port.read(waiting)  # a socket only ever says 1
                taken += waiting
        except (OSError, ValueError, TypeError) as error:
            raise self._gone(error) from error
        return list(iter(self._take_line, None))

    def close(self) -> None:
        """Free the port; may be called twice and never raises."""
        connection = getattr(self._port, "_socket", None)  # pyserial forgets to close one that is already dead
        try:
            self._port.close()
            if connection is not None:
                connection.close()
        except (OSError, ValueError):
            logger.debug("%s did not close cleanly", self.name, exc_info=True)

    def _take_line(self) -> str | None:
        while b"\n" in self._buffer:
            raw, _, rest = self._buffer.partition(b"\n")
            self._buffer = rest
            line = raw.decode("ascii", errors="replace").replace("\ufffd", "?").strip("\r\0 \t")
            if line:
                return line
        if len(self._buffer) > MAX_LINE_BYTES:
            self._buffer.clear()
        return None

    def _gone(self, error: Exception) -> StageError:
        return StageError(
            f"stage {self.name} is gone ({error}): plug the board in again, check its cable and power, "
            "then run `scanmap doctor`"
        )


def open_serial(url: str, baud: int) -> SerialPort:
    """Open a device or URL at `baud`, 8N1, for this program alone.

    Raises:
        StageError: no such port, no permission, or in use.
    """
    import serial

    try:
        port = serial.serial_for_url(
            url,
            baudrate=baud,
            timeout=0.02,
            write_timeout=write_timeout_s(url),
            exclusive=None if "://" in url else True,
        )
    except (OSError, ValueError) as error:
        raise StageError(_why_not_open(url, error)) from error
    return SerialPort(port, url)


def write_timeout_s(url: str) -> float | None:
    """How long a write may take [s]; pyserial's RFC 2217 client refuses to open with any limit."""
    return None if url.startswith("rfc2217://") else 2.0


def serial_devices() -> list[str]:
    """Names of the serial ports of this machine that have hardware behind them, likely boards first."""
    from serial.tools import list_ports

    ports = [port for port in list_ports.comports() if port.hwid != "n/a"]
    return [port.device for port in sorted(ports, key=lambda port: (port.vid is None, port.device))]


def _why_not_open(url: str, error: Exception) -> str:
    found = ", ".join(serial_devices()) or "none"
    text = str(error)
    if "Permission" in text or "Access is denied" in text:
        advice = "add yourself to the group `dialout` (`sudo usermod -aG dialout $USER`, log in again)"
    elif "lock" in text or "busy" in text:
        advice = "another program holds it: close that one"
    else:
        advice = f"ports of this machine: {found}; set stage.port, or try `scanmap doctor`"
    return f"stage port {url!r} cannot be opened ({text}): {advice}"
