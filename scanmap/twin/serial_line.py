"""The wire from the twin's board to the host, and what can go wrong on it."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass


@dataclass
class Faults:
    """What can go wrong. Plain attributes: turn any of them at any time; counts run down by themselves."""

    latency_s: float = 0.0  # every answer comes that much later
    lose_status: int = 0  # so many of the next `?` go unanswered
    lose_ok: int = 0  # so many of the next `ok` get lost on the way
    lose_lines: int = 0  # so many of the next lines never reach the board
    garbage: bytes = b""  # noise before the next answer
    mute: bool = False  # the board hangs
    unplugged: bool = False  # the cable is out


class SerialLine:
    """Lines on their way to the host."""

    def __init__(self, faults: Faults) -> None:
        self._faults = faults
        self._under_way: deque[tuple[float, bytes]] = deque()  # when it arrives, what

    def send(self, line: str, now: float) -> None:
        """The board says a line."""
        faults = self._faults
        if faults.mute:
            return
        if line == "ok" and faults.lose_ok > 0:
            faults.lose_ok -= 1
            return
        noise, faults.garbage = faults.garbage, b""
        self._under_way.append((now + faults.latency_s, noise + line.encode("ascii") + b"\r\n"))

    def take(self, size: int, now: float) -> bytes:
        """What has arrived by now, at most `size` bytes."""
        out = bytearray()
        while self._under_way and self._under_way[0][0] <= now and len(out) < size:
            due, data = self._under_way.popleft()
            room = size - len(out)
            out += data[:room]
            if data[room:]:
                self._under_way.appendleft((due, data[room:]))
        return bytes(out)

    def waiting(self, now: float) -> int:
        """Bytes that have arrived by now."""
        return sum(len(data) for due, data in self._under_way if due <= now)

    @property
    def next_time(self) -> float:
        """When the next line arrives; infinity if none is under way."""
        return self._under_way[0][0] if self._under_way else math.inf

    def clear(self) -> None:
        """Lose what is under way."""
        self._under_way.clear()
