"""Real-time commands of the twin's board that change what is under way: resume, door, jog cancel, overrides, coolant.

Source: gnea/grbl, doc/markdown/commands.md (extended-ASCII realtime commands) and interface.md (`Ov:`, `Door:n`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scanmap.twin.firmware import Firmware

_FEED = {0x91: 10, 0x92: -10, 0x93: 1, 0x94: -1}  # by how much [%]
_RAPID = {0x95: 100, 0x96: 50, 0x97: 25}  # to which [%]
_SPINDLE = {0x9A: 10, 0x9B: -10, 0x9C: 1, 0x9D: -1}
_LEAST, _MOST = 10, 200  # [%]
SPINDLE_S = 4.0  # a spindle that a door stopped is given so long to turn again; a laser needs none


def obey(board: Firmware, command: int) -> None:
    """Do what a real-time command says; one that means nothing here does nothing."""
    if command == 0x81 and board.door.is_open:
        board.door.resume()
    elif command == 0x81 and not board.homing:
        board.planner.resume(board.present)
    elif command == 0x84:
        board.door.open()
    elif command == 0x85 and board.planner.jogging:
        board.planner.cancel(board.present)
    elif command == 0xA0:
        board.loop.executor.toggle_coolant()
    elif board.loop.executor.overrides.take(command):
        board.tell_overrides()


class Overrides:
    """What the operator has turned up or down, in percent; back to 100 with every reset.

    A move keeps the speed it was planned with; grbl changes that of one under way, too.
    """

    def __init__(self) -> None:
        self.feed = self.rapid = self.spindle = 100

    def take(self, command: int) -> bool:
        """Obey a byte; whether a value has changed, which the next status report tells."""
        before = self.words
        if command == 0x90 or command in _FEED:
            self.feed = _limited(self.feed + _FEED[command]) if command in _FEED else 100
        elif command == 0x99 or command in _SPINDLE:
            self.spindle = _limited(self.spindle + _SPINDLE[command]) if command in _SPINDLE else 100
        else:
            self.rapid = _RAPID.get(command, self.rapid)
        return self.words != before

    @property
    def words(self) -> str:
        """As the status report has them."""
        return f"{self.feed},{self.rapid},{self.spindle}"


class Door:
    """The safety door: opened, it brakes and stops the spindle; closed at once, for there is no switch on it."""

    def __init__(self, board: Firmware) -> None:
        self._board = board
        self.is_open = False
        self._is_resting = False  # the head stands, the spindle is off
        self._goes_on_at = math.inf

    @property
    def substate(self) -> int:
        """As `Door:` has it: 0 ready to go on, 2 braking, 3 going on."""
        if self._goes_on_at < math.inf:
            return 3
        return 0 if self._is_resting else 2

    def open(self) -> None:
        """0x84 has come."""
        board = self._board
        if board.alarm or board.asleep or board.checking:
            return
        board.message("Check Door")
        if board.homing:
            board.raise_alarm(7)
            return
        if board.planner.jogging:
            board.planner.cancel(board.present)
        board.planner.hold(board.present)
        self.is_open, self._is_resting, self._goes_on_at = True, False, math.inf

    def resume(self) -> None:
        """`~` has come: the spindle turns as before, then the move goes on."""
        board = self._board
        if not self._is_resting or self._goes_on_at < math.inf:
            return
        spindle, modes = board.loop.executor.spindle, board.loop.executor.modes
        runs = modes.codes["spindle"] != "M5"
        spindle.stand(modes.codes["spindle"], modes.speed, modes.codes["motion"])
        self._goes_on_at = board.present + (SPINDLE_S if runs and not spindle.is_laser else 0.0)

    def advance(self) -> float:
        """What is due now; returns when something will be."""
        board = self._board
        if self.is_open and not self._is_resting and not board.planner.moving:
            self._is_resting = True
            board.loop.executor.spindle.stop()
        if self._goes_on_at <= board.present:
            self.is_open, self._goes_on_at = False, math.inf
            board.planner.resume(board.present)
        return self._goes_on_at


def _limited(percent: int) -> int:
    return min(max(percent, _LEAST), _MOST)
