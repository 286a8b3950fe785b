"""Where the twin's board is plugged in: `twin://name` for pyserial, a pty or a TCP port for any program."""

from __future__ import annotations

import contextlib
import io
import math
import os
import select
import socket
import threading
import time
from collections.abc import Callable, Iterator
from itertools import chain, count
from typing import Any

from scanmap.twin.firmware import Firmware

TICK_S = 0.002  # longest sleep between two looks at a board in real time

_PLUGGED: dict[str, Firmware] = {}  # a URL can only name its board


class TwinPort(io.RawIOBase):
    """What pyserial opens for `twin://name`: a port with a `Firmware` at its other end."""

    def __init__(
        self, port: str | None = None, baudrate: int = 115200, timeout: float | None = None, **_: object
    ) -> None:
        """pyserial's arguments; speed, parity and locks mean nothing here."""
        self.port = port
        self.baudrate = baudrate
        self.timeout = timeout
        self.is_open = False
        self._firmware: Firmware | None = None

    def open(self) -> None:
        """Plug into the board; resets it if it is like an Uno."""
        name = (self.port or "").partition("://")[2]
        firmware = _PLUGGED.get(name)
        if firmware is None or firmware.faults.unplugged:
            raise FileNotFoundError(f"no twin named {name!r} is plugged in")
        self._firmware = firmware
        self.is_open = True
        firmware.open()

    def close(self) -> None:
        """Unplug; may be called twice."""
        self.is_open = False
        super().close()

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read at once."""
        return self._board().waiting()

    def read(self, size: int = 1) -> bytes:
        """Up to `size` bytes, fewer if the time-out passes."""
        started = time.monotonic()
        data = bytearray()
        while len(data) < size:
            board = self._board()
            data += board.read(size - len(data))
            if len(data) == size or _pass_time(board, started, self.timeout):
                break
        return bytes(data)

    def write(self, data: Any, /) -> int:
        """Send bytes."""
        payload = bytes(data)
        self._board().write(payload)
        return len(payload)

    def _board(self) -> Firmware:
        if self._firmware is None or not self.is_open:
            raise OSError("the port is not open")
        if self._firmware.faults.unplugged:
            raise OSError("device disconnected")
        return self._firmware


def _pass_time(board: Firmware, started: float, timeout: float | None) -> bool:
    """Let the board go on until something may have happened; True when the reader has waited long enough."""
    event_s = board.next_event()
    if board.instant and event_s != math.inf:
        board.wait(event_s)
        return False
    left_s = math.inf if timeout is None else started + timeout - time.monotonic()
    time.sleep(max(0.0, min(left_s, max(event_s, 1e-4), TICK_S)))
    return left_s <= 0


@contextlib.contextmanager
def plug(firmware: Firmware, name: str = "head") -> Iterator[str]:
    """Plug a board in while the context lasts; yields its URL, `twin://name`, numbered if the name is taken."""
    import serial

    if "scanmap.twin" not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append("scanmap.twin")
    name = next(free for free in chain([name], map(f"{name}-{{}}".format, count(2))) if free not in _PLUGGED)
    _PLUGGED[name] = firmware
    try:
        yield f"twin://{name}"
    finally:
        del _PLUGGED[name]


@contextlib.contextmanager
def pty_port(firmware: Firmware) -> Iterator[str]:
    """Put a board behind a pseudo terminal while the context lasts; yields the device's path. POSIX only.

    Opening a pty toggles no reset line, so the board is powered up when the context is entered.
    """
    import tty

    master, slave = os.openpty()
    tty.setraw(slave)
    firmware.open()

    def serve(stop: int) -> None:
        _pump(firmware, master, stop)
        os.close(master)  # a pulled plug looks like this from the other side

    try:
        with _pumping(serve):
            yield os.ttyname(slave)
    finally:
        os.close(slave)


@contextlib.contextmanager
def tcp_port(firmware: Firmware) -> Iterator[str]:
    """Put a board on a TCP port of this machine, like one with WiFi; yields `socket://127.0.0.1:port`."""
    firmware.open()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve(stop: int) -> None:
            while stop not in select.select([server.fileno(), stop], [], [])[0]:
                connection, _ = server.accept()
                with connection:
                    if _pump(firmware, connection.fileno(), stop):
                        return

        with _pumping(serve):
            yield f"socket://127.0.0.1:{server.getsockname()[1]}"


@contextlib.contextmanager
def _pumping(work: Callable[[int], object]) -> Iterator[None]:
    """Run `work` in a thread; it gets a handle that becomes readable when it is to end."""
    told, tell = os.pipe()
    pump = threading.Thread(target=work, args=(told,), name="twin's wire")
    pump.start()
    try:
        yield
    finally:
        os.write(tell, b"x")
        pump.join()
        os.close(told)
        os.close(tell)


def _pump(firmware: Firmware, wire: int, stop: int) -> bool:
    """Carry bytes both ways until the other side hangs up, or the board is unplugged; True when told to stop."""
    try:
        while not firmware.faults.unplugged:
            pause = 0.0 if firmware.instant else min(firmware.next_event(), TICK_S)
            readable, _, _ = select.select([wire, stop], [], [], max(pause, 5e-4))
            if stop in readable:
                return True
            if wire in readable:
                data = os.read(wire, 1024)
                if not data:
                    return False
                firmware.write(data)
            elif firmware.instant and firmware.next_event() < math.inf:
                firmware.wait(firmware.next_event())
            if out := firmware.read(4096):
                os.write(wire, out)
    except OSError:
        pass  # the other side hung up
    return False
