"""A serial line in text: whole lines in, whole lines out, bounded time, one kind of error.

Knows no firmware. Every port pyserial can open works: `/dev/ttyUSB0`, `COM3`, `socket://host:23`,
`rfc2217://host:2217`, and `twin://name`, which `scanmap.twin` registers.
"""

from __future__ import annotations

import errno
import logging
import time
from pathlib import Path
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
    text, number = str(error), getattr(error, "errno", None)
    if number in (errno.EACCES, errno.EPERM) or "Permission" in text or "Access is denied" in text:
        group = _group_of(url)
        why = f"you may not use it: join its group `{group}` (`sudo usermod -aG {group} $USER`) and log in again"
    elif number in (errno.EBUSY, errno.EAGAIN) or "lock" in text or "busy" in text:
        why = "another program holds it (Arduino IDE, ModemManager, a second scanmap?): close that one"
    elif "://" in url:
        text = text.removeprefix(f"Could not open port {url}: ")
        why = f"{text}; is the board on, and on this network, and its address in stage.port right?"
    else:
        found = ", ".join(serial_devices()) or "none; plug the board in, with a cable that carries data"
        missing = number == errno.ENOENT or "FileNotFound" in text
        why = f"{'it is not there' if missing else text}; ports of this machine: {found}; choose one with stage.port"
    return f"stage port {url} cannot be opened: {why}"


def _group_of(device: str) -> str:
    """The group that may use a device: `dialout` on Debian and Fedora, `uucp` on Arch."""
    try:
        group = Path(device).group()
    except (OSError, KeyError, NotImplementedError):
        group = "root"
    return "dialout" if group == "root" else group
