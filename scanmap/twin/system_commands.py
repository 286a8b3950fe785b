"""What the twin's board does with a line that begins with `$`: settings, reports, unlock, sleep, homing.

Source: gnea/grbl, doc/markdown/commands.md, settings.md, grbl/system.c; grblHAL/core, system.c.
Lines that must wait are generators: they yield the time before which nothing will happen.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING

import numpy as np

from scanmap.twin.board import BUILD_INFO, HOMING, HOMING_ONE_AXIS, triple

if TYPE_CHECKING:
    from scanmap.twin.executor import Executor
    from scanmap.twin.firmware import Firmware

Wait = Generator[float, None, None]
Answer = Generator[float, None, int]  # grbl's error number, 0 for ok

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)")
_SPINDLE_SETTINGS = {30, 31, 32}  # writing them starts the output anew, switched off
_INCHES = 13
_BYTES_OF_A_SETTING = 5  # a number and the checksum
_SEARCH = 1.5  # homing looks as far as this times $130


class SystemCommands:
    """The `$` commands of a board."""

    def __init__(self, board: Firmware, executor: Executor) -> None:
        self._board = board
        self._executor = executor

    def execute(self, command: str) -> Answer:
        """Carry out what follows the `$`."""
        board = self._board
        if command.startswith("J="):
            if board.alarm or board.checking or (board.planner.busy and not board.planner.jogging):
                return 8
            return (yield from self._executor.jog(command[2:]))
        anytime: dict[str, Callable[[], None]] = {
            "": self._help,
            "G": lambda: board.say(self._executor.modes.line(in_inches=bool(board.memory.settings[13]))),
        }
        if command in anytime:
            anytime[command]()
            return 0
        if command == "X":
            return self._unlock()
        if command == "$" and board.planner.jogging:
            return self._idle_command(command)
        if board.planner.busy or (board.checking and command not in ("$", "C")):
            return 8
        if command[:3] in ("N0=", "N1=") and not board.alarm:
            return (yield from self._store_startup(int(command[1]), command[3:]))
        if command == "H" or (command == "HX" and board.dialect != "grbl"):
            return (yield from self._home(alone=command == "HX"))
        error = self._idle_command(command)
        yield board.present  # it may take its time
        return error

    def _help(self) -> None:
        self._board.say("[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]")

    def _unlock(self) -> int:
        board = self._board
        if board.alarm and board.must_home and board.dialect == "grblHAL":
            return 46
        if board.alarm:
            board.message("Caution: Unlocked")
            board.alarm = False
        return 0

    def _parameters(self) -> list[str]:
        """The answer to `$#`."""
        executor, in_inches = self._executor, bool(self._board.memory.settings[13])
        zero = [0.0, 0.0, 0.0]
        places = {**self._board.memory.offsets, "G28": zero, "G30": zero, "G92": executor.modes.g92}
        tool = "0.0000" if in_inches else "0.000"
        lines = [f"[{name}:{triple(np.asarray(place), in_inches)}]" for name, place in places.items()]
        return [*lines, f"[TLO:{tool}]", executor.probe_report()]

    def _idle_command(self, command: str) -> int:
        """Commands that need a board at rest."""
        board, memory = self._board, self._board.memory
        reports = {
            "I": [
                line.format(legacy="+" if memory.settings.get(39) else "-", owner=memory.owner)
                for line in BUILD_INFO[board.dialect]
            ],
            "N": [f"$N{number}={line}" for number, line in enumerate(memory.startup)],
            "#": self._parameters(),
        }
        if board.dialect != "FluidNC":
            reports["$"] = memory.lines()
        for line in reports.get(command, ()):
            board.say(line)
        if command in reports:
            return 0
        if board.alarm and (command == "C" or command[:3] in ("N0=", "N1=")):
            return 8
        if command == "SLP":
            board.asleep = True
            self._executor.spindle.stop()
        elif command == "C":
            board.checking = not board.checking
            board.message("Enabled" if board.checking else "Disabled")
            board.restart_requested = not board.checking
        elif command.startswith("I=") and board.dialect != "FluidNC":
            memory.owner = command[2:]
            board.write_memory(len(memory.owner) + 2)
        elif command in ("RST=$", "RST=#", "RST=*") and board.dialect != "FluidNC":
            memory.restore(command[-1], board.dialect)
            self._executor.apply_steps()
            board.message("Restoring defaults")
            board.restart_requested = True
        else:
            return self._fluidnc(command) if board.dialect == "FluidNC" else self._store(command)
        return 0

    def _store_startup(self, number: int, line: str) -> Answer:
        """Keep a line for the next start; it is carried out now, to see whether it is good."""
        error = yield from self._executor.gcode(line)
        if not error:
            yield from self._executor.synchronise()
            self._board.memory.startup[number] = line
            self._board.write_memory(len(line) + 2)
            yield self._board.present
        return error

    def _fluidnc(self, command: str) -> int:
        """FluidNC has its machine in a YAML tree and no numbered settings to write."""
        board, settings = self._board, self._board.memory.settings
        tree = {
            "/axes/x/steps_per_mm": f"{settings[100]:.3f}",
            "/axes/x/max_rate_mm_per_min": f"{settings[110]:.3f}",
            "/stepping/idle_ms": f"{settings[1]:.0f}",
        }
        if command == "MD":
            board.message("Disabling all motors")
            board.release_motor()
        elif command == "13":
            board.say(f"$13={settings[13]:.0f}")
        elif command.lower() in tree:
            board.say(f"${command.lower()}={tree[command.lower()]}")
        else:
            return 3
        return 0

    def _store(self, command: str) -> int:
        dialect = self._board.dialect
        number = _NUMBER.match(command)
        if not number:  # grbl takes every unknown letter for a setting whose number is missing
            return 2 if dialect == "grbl" and command[0] not in "$GCXJ#HSIR" else 3
        rest = command[number.end() :]
        if not rest.startswith("="):
            return 3
        value = _NUMBER.match(rest, 1)
        if not value:
            return 2
        if value.end() != len(rest) or float(number[0]) > 255:
            return 3
        index = int(float(number[0]))
        error = self._board.memory.store(index, float(value[0]), dialect)
        if not error:
            self._board.write_memory(_BYTES_OF_A_SETTING)
        self._executor.apply_steps()
        if index in _SPINDLE_SETTINGS and not error:
            self._executor.spindle.stop()
        if index == _INCHES:
            self._board.tell_offset()
        return error

    def _home(self, *, alone: bool) -> Answer:
        """Seek the switch, back off, and name the place. Silent meanwhile, as the real one is."""
        board, settings = self._board, self._board.memory.settings
        if not int(settings[22]) & HOMING:
            return 5
        if alone and board.dialect == "grblHAL" and not int(settings[22]) & HOMING_ONE_AXIS:
            return 5
        board.homing, board.alarm = True, False
        toward = -1.0 if int(settings[23]) & 1 else 1.0
        distance = math.inf if board.switch_deg is None else (board.switch_deg - board.drivetrain.bearing_deg) * toward
        found = 0 <= distance <= _SEARCH * settings[130]
        travel = distance if found else _SEARCH * settings[130]
        yield from self._creep(toward * travel, settings[25])
        if found:  # touched twice, the second time slowly
            yield from self._creep(-toward * settings[27], settings[25])
            yield from self._creep(toward * settings[27], settings[24])
            yield from self._creep(-toward * settings[27], settings[25])
        if not found:
            board.homing = False
            board.raise_alarm(9)
            yield board.present
            board.restart_requested = True
            return 0
        place = -settings[27] if toward > 0 else settings[27] - settings[130]
        board.must_home = False
        board.planner.set_counter(0, round(place * settings[100]))
        self._executor.synchronise_position()
        board.answer_status()  # asked in the meantime; it still says Home
        board.homing = False
        board.go_idle()
        if not alone:
            yield from board.loop.run_startup()
        return 0

    def _creep(self, distance: float, rate: float) -> Wait:
        target = self._board.planner.position()
        target[0] += distance
        self._executor.plan(target, rate, 0.0)
        yield from self._executor.synchronise()
        settled = self._board.present + self._board.memory.settings[26] / 1e3
        while self._board.present < settled:
            yield settled
