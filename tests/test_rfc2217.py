"""A board behind a serial server (RFC 2217), such as ser2net on a small computer at the head."""

from __future__ import annotations

import contextlib
import math
import select
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from scanmap.errors import StageError
from scanmap.rig.grbl_opening import open_grbl
from scanmap.rig.stage import StageParams
from scanmap.twin.firmware import Firmware

# pyserial 3.5 itself still calls these.
pytestmark = pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")


class Line:
    """What the server sets on its port: speed, flow control, modem lines."""

    baudrate, bytesize, parity, stopbits = 115200, 8, "N", 1
    xonxoff = rtscts = dsrdtr = False
    cts = dsr = cd = dtr = rts = True
    ri = break_condition = False

    def reset_input_buffer(self) -> None:
        """Nothing waits."""

    reset_output_buffer = reset_input_buffer


class Answering:
    """The server's way to the client, for its own replies."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection

    def write(self, data: bytes) -> None:
        self._connection.sendall(data)


@contextlib.contextmanager
def served(board: Firmware) -> Iterator[str]:
    from serial.rfc2217 import PortManager

    ended = threading.Event()

    def serve(server: socket.socket) -> None:
        connection, _ = server.accept()
        with connection:
            manager: Any = PortManager(Line(), Answering(connection))
            while not ended.is_set() and not board.faults.unplugged:
                if select.select([connection], [], [], 0.002)[0]:
                    data = connection.recv(1024)
                    if not data:
                        return
                    board.write(b"".join(manager.filter(data)))
                elif board.next_event() < math.inf:
                    board.wait(board.next_event())
                if out := board.read(4096):
                    connection.sendall(b"".join(manager.escape(out)))

    with socket.create_server(("127.0.0.1", 0)) as server:
        worker = threading.Thread(target=serve, args=(server,))
        worker.start()
        try:
            yield f"rfc2217://127.0.0.1:{server.getsockname()[1]}"
        finally:
            ended.set()
            worker.join()


def test_a_board_behind_a_serial_server() -> None:
    board = Firmware(resets_on_open=False)
    with served(board) as url:
        stage = open_grbl(StageParams(port=url, timeout_s=2.0, watchdog=False))
        assert stage.move_to(math.radians(30)) == pytest.approx(math.radians(30))
        stage.laser(True)
        assert board.laser_on
        stage.close()
        until = time.monotonic() + 5.0
        while board.laser_on and time.monotonic() < until:
            time.sleep(0.01)
        assert not board.laser_on


def test_a_serial_server_that_goes_away_is_one_clear_error() -> None:
    board = Firmware(resets_on_open=False)
    with served(board) as url:
        stage = open_grbl(StageParams(port=url, timeout_s=0.5, watchdog=False))
        board.faults.unplugged = True
        with pytest.raises(StageError, match=r"rfc2217://.*(gone|not answered)"):
            for bearing in range(5):
                stage.move_to(math.radians(bearing))
        stage.close()
