"""The pin of the twin's board that switches the laser: what M3, M4, M5, S and $30 to $32 make of it.

Source: gnea/grbl, grbl/spindle_control.c, stepper.c and doc/markdown/laser_mode.md.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scanmap.twin.firmware import Firmware

PWM_STEPS = 255  # full power; 1 is the least that is not off


class Spindle:
    """What comes out of the pin. The parser's own M3 and S are in its modes: the two can differ."""

    def __init__(self, board: Firmware) -> None:
        self._board = board
        self.share = 0.0  # of full power
        self.speed = 0.0  # S as it came out, for the status report; a pin that was merely stopped keeps it
        self._code = "M5"

    @property
    def is_laser(self) -> bool:
        """Laser mode, `$32=1`: light only in a G1."""
        return bool(self._board.memory.settings[32])

    def stand(self, code: str, speed: float, motion: str) -> None:
        """M3, M4, M5 or another S, while nothing moves."""
        if self.is_laser and (code == "M4" or motion != "G1"):
            speed = 0.0
        self._set(code, 0.0 if code == "M5" else self._share_of(speed), self._limited(speed))

    def share_of_move(self, code: str, speed: float, motion: str) -> float:
        """What a move takes along: a move sets the pin anew when it begins."""
        if code == "M5" or (self.is_laser and motion == "G0"):
            return 0.0
        return self._share_of(speed)

    def follow(self, share: float | None, code: str, speed: float) -> None:
        """A move has begun (`share`, None if none has) or has come to rest."""
        if share is not None:
            self.share, self.speed, self._code = share, self._limited(speed) if share else 0.0, code
        if self.is_laser and code == "M4" and not self._board.planner.moving:
            self.share = 0.0

    def stop(self) -> None:
        """Off, whatever the parser believes."""
        self.share = 0.0

    def accessories(self) -> str:
        """As the status report names it."""
        return ("C" if self._code == "M4" else "S") if self.share else ""

    def _set(self, code: str, share: float, speed: float) -> None:
        self._code, self.share, self.speed = code, share, speed if share else 0.0
        self._board.tell_overrides()

    def _share_of(self, speed: float) -> float:
        most, least = self._range()
        speed *= self._board.loop.executor.overrides.spindle / 100
        if least >= most or speed >= most:
            return 1.0
        if speed <= least:
            return 1 / PWM_STEPS if speed else 0.0
        return (math.floor((speed - least) * (PWM_STEPS - 1) / (most - least)) + 1) / PWM_STEPS

    def _limited(self, speed: float) -> float:
        most, least = self._range()
        speed *= self._board.loop.executor.overrides.spindle / 100
        return most if least >= most else min(max(speed, least), most)

    def _range(self) -> tuple[float, float]:
        settings = self._board.memory.settings
        return settings[30], settings[31]
