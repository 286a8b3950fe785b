"""What the twin's board does with a line that begins with `$`: settings, reports, unlock, sleep, homing.

Source: gnea/grbl, doc/markdown/commands.md, settings.md. Lines that must wait are generators: they yield the
time before which nothing will happen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING

from scanmap.twin.board import BUILD_INFO

if TYPE_CHECKING:
    from scanmap.twin.executor import Executor
    from scanmap.twin.firmware import Firmware

Wait = Generator[float, None, None]
Answer = Generator[float, None, int]  # grbl's error number, 0 for ok

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
            "X": self._unlock,
            "G": lambda: board.say(self._executor.modes.line()),
        }
        if command in anytime:
            anytime[command]()
            return 0
        if board.planner.busy:
            return 8
        if command == "H" or (command == "HX" and board.dialect != "grbl"):
            return (yield from self._home())
        return self._idle_command(command)

    def _help(self) -> None:
        self._board.say("[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]")

    def _unlock(self) -> None:
        if self._board.alarm:
            self._board.say("[MSG:Caution: Unlocked]")
            self._board.alarm = False

    def _idle_command(self, command: str) -> int:
        """Commands that need a board at rest."""
        board, memory = self._board, self._board.memory
        offsets = {**memory.offsets, "G92": self._executor.modes.g92}
        reports = {
            "I": BUILD_INFO[board.dialect],
            "N": [f"$N{number}={line}" for number, line in enumerate(memory.startup)],
            "#": [f"[{name}:{x:.3f},{y:.3f},{z:.3f}]" for name, (x, y, z) in offsets.items()],
        }
        if board.dialect != "FluidNC":
            reports["$"] = memory.lines()
        for line in reports.get(command, ()):
            board.say(line)
        if command in reports:
            return 0
        if command[:3] in ("N0=", "N1="):
            memory.startup[int(command[1])] = command[3:]
            memory.writes += 1
        elif command == "SLP":
            board.asleep = True
            self._executor.laser_power = 0.0
        elif command == "C":
            board.checking = not board.checking
            board.say("[MSG:Enabled]" if board.checking else "[MSG:Disabled]")
            board.restart_requested = not board.checking
        else:
            return self._fluidnc(command) if board.dialect == "FluidNC" else self._store(command)
        return 0

    def _fluidnc(self, command: str) -> int:
        """FluidNC has its machine in a YAML tree and no numbered settings to write."""
        board, settings = self._board, self._board.memory.settings
        tree = {
            "/axes/x/steps_per_mm": f"{settings[100]:.3f}",
            "/axes/x/max_rate_mm_per_min": f"{settings[110]:.3f}",
            "/stepping/idle_ms": f"{settings[1]:.0f}",
        }
        if command == "MD":
            board.release_motor()
        elif command.lower() in tree:
            board.say(f"${command.lower()}={tree[command.lower()]}")
        else:
            return 3
        return 0

    def _store(self, command: str) -> int:
        name, equals, text = command.partition("=")
        try:
            number, value = int(name), float(text)
        except ValueError:
            return 2 if name.isdigit() and equals else 3
        error = self._board.memory.store(number, value)
        self._executor.apply_steps()
        return error

    def _home(self) -> Answer:
        """Seek the switch, back off, and name the place. Silent meanwhile, as the real one is."""
        board, settings = self._board, self._board.memory.settings
        if not settings[22]:
            return 5
        board.homing, board.alarm = True, False
        toward = -1.0 if int(settings[23]) & 1 else 1.0
        distance = math.inf if board.switch_deg is None else (board.switch_deg - board.drivetrain.bearing_deg) * toward
        found = 0 <= distance <= _SEARCH * settings[130]
        travel = distance if found else _SEARCH * settings[130]
        yield from self._creep(toward * travel, settings[25])
        if found:
            yield from self._creep(-toward * settings[27], settings[24])
        board.homing = False
        if not found:
            board.raise_alarm(9)
            board.restart_requested = True
            return 0
        place = -settings[27] if toward > 0 else settings[27] - settings[130]
        board.planner.set_counter(0, round(place * settings[100]))
        board.go_idle()
        yield from self._executor.run_startup()
        return 0

    def _creep(self, distance: float, rate: float) -> Wait:
        target = self._board.planner.position()
        target[0] += distance
        self._executor.plan(target, rate, is_jog=False)
        yield from self._executor.synchronise()
