"""The main loop of the twin's board: a banner, its stored lines, then line by line what the host sends.

Source: gnea/grbl, grbl/protocol.c and main.c; grblHAL/core, protocol.c.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from typing import TYPE_CHECKING

from scanmap.twin.board import BANNERS
from scanmap.twin.executor import Executor
from scanmap.twin.receiver import Receiver
from scanmap.twin.status_report import RareFields

if TYPE_CHECKING:
    from scanmap.twin.firmware import Firmware


class MainLoop:
    """One life of the board, from a reset to the next."""

    def __init__(self, board: Firmware) -> None:
        self._board = board
        self.receiver = Receiver(board.dialect)
        self.executor = Executor(board)
        self.rare = RareFields()
        self._unfinished = ""  # what is said of the line in work if a reset ends it
        self._steps = self._run()

    def next(self) -> float:
        """Go on; returns the time before which there is nothing to do."""
        return next(self._steps)

    def end(self) -> None:
        """A reset: grbl still answers the line that it broke off, grblHAL does not."""
        if self._unfinished and self._board.dialect == "grbl":
            self._board.say(self._unfinished)

    def run_startup(self) -> Generator[float, None, None]:
        """The stored lines, after a reset and after homing."""
        for line in filter(None, self._board.memory.startup):
            before, self._unfinished = self._unfinished, f">{line}:ok"
            error = yield from self.executor.gcode(line)
            self._unfinished = before
            self._board.say(f">{line}:" + (f"error:{error}" if error else "ok"))

    def answer_halted(self) -> float:
        """grblHAL refuses what it is told between an alarm and the reset; grbl does not even listen."""
        while self._board.dialect == "grblHAL" and (line := self.receiver.take_line()) is not None:
            self._board.say("error:79" if line.startswith("$") else "error:9" if line else "ok")
        return math.inf

    def _run(self) -> Generator[float, None, None]:
        board = self._board
        board.say("")
        board.say(BANNERS[board.dialect])
        if board.alarm and board.must_home and board.dialect == "grblHAL":
            board.say("ALARM:11")
            board.message("Homing cycle required")
        elif board.alarm:
            board.message("'$H'|'$X' to unlock")
        else:
            yield from self.run_startup()
        while True:
            line = yield from self._read_line()
            if board.faults.lose_lines > 0:
                board.faults.lose_lines -= 1
                continue
            self._unfinished = "ok"
            answer = 11 if self.receiver.is_too_long(line) else (yield from self.executor.execute(line))
            self._unfinished, self.receiver.keeps_text = "", False
            board.say(f"error:{answer}" if answer else "ok")
            if board.asleep:
                board.message("Sleeping")
                board.release_motor()
            if board.restart_requested:
                board.restart()
                yield board.present  # the new life begins at once

    def _read_line(self) -> Generator[float, None, str]:
        board = self._board
        while True:
            if not (board.planner.held or board.planner.cancelling or board.asleep):
                line = self.receiver.take_line()
                if line is not None:
                    return line
            yield math.inf
