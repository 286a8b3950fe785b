"""What the twin's board does with a line of G-code: modes, moves, jogs, probing, laser.

Source: gnea/grbl, doc/markdown/commands.md, jogging.md, laser_mode.md. Lines that must wait are generators: they
yield the time before which nothing will happen.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanmap.twin.board import Modes, triple
from scanmap.twin.gcode import GcodeError, Words, read_words
from scanmap.twin.overrides import Overrides
from scanmap.twin.spindle import Spindle
from scanmap.twin.system_commands import Answer, SystemCommands, Wait

if TYPE_CHECKING:
    from scanmap.twin.firmware import Firmware

MARK_DEG = 0.2  # half the width of the index mark
DWELL_STEP_S = 0.05  # a dwell is so many of these, rounded up; in between the board answers `?`
SLOWEST_FEED = 1.0  # [units/min]


class Executor:
    """Carries out lines on a board; one for each life between two resets."""

    def __init__(self, board: Firmware) -> None:
        self._board = board
        self.modes = Modes()
        self.overrides = Overrides()
        self.spindle = Spindle(board)
        self._position = board.planner.position()  # where the parser believes to stand, not rounded to steps
        self.probed, self.probe_closed = np.zeros(3), False
        self._last_error = 0
        self._system = SystemCommands(board, self)
        self.apply_steps()

    def work_offset(self) -> NDArray[np.float64]:
        """Work zero seen from machine zero [units]."""
        return self._board.memory.offsets[self.modes.codes["coordinates"]] + self.modes.g92

    def execute(self, line: str) -> Answer:
        """Carry out one line, stripped and in upper case."""
        board = self._board
        if line.startswith("$"):
            error = yield from self._system.execute(line[1:])
        elif not line:
            error = 0
        elif board.alarm or board.planner.jogging:
            error = 9
        elif self._last_error and board.dialect == "grblHAL":  # until an empty line or one with a $
            error = self._last_error
        else:
            error = yield from self.gcode(line)
        self._last_error = error
        return error

    def apply_steps(self) -> None:
        """`$100` to `$102` have changed."""
        settings = self._board.memory.settings
        self._board.planner.set_steps_per_unit(np.array([settings[100], settings[101], settings[102]]))

    def synchronise(self) -> Wait:
        """Until all that was planned is done."""
        while self._board.planner.busy:
            yield self._board.planner.end_time

    def _halt(self) -> Wait:
        while True:
            yield math.inf

    def gcode(self, line: str) -> Answer:
        """Carry out one line of G-code."""
        try:
            words = read_words(line)
            motion = words.codes.get("motion", self.modes.codes["motion"])
            if words.in_machine_coordinates and motion not in ("G0", "G1"):
                raise GcodeError(30)
            moves = bool(words.axes) and words.codes.get("nonmodal") not in ("G10", "G92")
            feed = words.values.get("F", 0.0) * self._scale(words) or self.modes.feed
            if moves and motion == "G80":
                raise GcodeError(31)
            if moves and motion != "G0" and not feed:
                raise GcodeError(22)
            if moves and motion == "G38.2" and np.array_equal(self._target(words), self._position):
                raise GcodeError(33)
        except GcodeError as error:
            return error.code
        self.modes.feed = feed
        self.modes.tool = int(words.values.get("T", self.modes.tool))
        yield from self._switch_laser(words, motion)
        if words.codes.get("nonmodal") == "G4":
            yield from self._dwell(words.values["P"])
        place = words.codes.get("coordinates", self.modes.codes["coordinates"])
        if words.codes.get("nonmodal") in ("G10", "G92", "G92.1") or place != self.modes.codes["coordinates"]:
            yield from self.synchronise()  # the work offset changes
            self._board.tell_offset()
        self.modes.codes |= {
            group: code
            for group, code in words.codes.items()
            if group in self.modes.codes and group not in ("spindle", "motion")
        }
        yield from self._set_offsets(words)
        self.modes.codes["motion"] = motion
        if moves:
            yield from self._move(words, motion, feed)
        if words.codes.get("stopping") == "M0" and not self._board.checking:
            yield from self.synchronise()
            self._board.planner.hold(self._board.present)
            while self._board.planner.held:
                yield math.inf
        if words.codes.get("stopping") in ("M2", "M30"):
            yield from self.synchronise()
            self.overrides = Overrides()
            self.spindle.stand("M5", 0.0, motion)
            self._board.tell_offset()
            resting = Modes()
            kept = {"units": self.modes.codes["units"], "motion": "G1"}
            self.modes.codes = {**resting.codes, **kept}
            self._board.message("Program End" if self._board.dialect == "FluidNC" else "Pgm End")
        return 0

    def _scale(self, words: Words) -> float:
        return 25.4 if words.codes.get("units", self.modes.codes["units"]) == "G20" else 1.0

    def _switch_laser(self, words: Words, motion: str) -> Wait:
        spindle = words.codes.get("spindle", self.modes.codes["spindle"])
        speed = words.values.get("S", self.modes.speed)
        # Only a change reaches the pin: a second M3 does not light what a setting has switched off; a move does.
        changes = spindle != self.modes.codes["spindle"] or (spindle != "M5" and speed != self.modes.speed)
        if self.spindle.is_laser and not words.axes and spindle == "M3":
            changes |= (motion == "G1") != (self.modes.codes["motion"] == "G1")
        elif self.spindle.is_laser and words.axes and spindle == self.modes.codes["spindle"]:
            changes = False  # the move itself brings it
        self.modes.speed = speed
        if changes and not self._board.checking:
            yield from self.synchronise()
            self.spindle.stand(spindle, speed, motion)
        self.modes.codes["spindle"] = spindle

    def _dwell(self, seconds: float) -> Wait:
        if self._board.checking:
            return
        yield from self.synchronise()
        for _ in range(math.ceil(seconds / DWELL_STEP_S)):
            self._board.work(DWELL_STEP_S)
            yield self._board.present

    def _set_offsets(self, words: Words) -> Wait:
        nonmodal = words.codes.get("nonmodal")
        here = self._position
        scale = self._scale(words)
        if nonmodal == "G92":
            base = self._board.memory.offsets[self.modes.codes["coordinates"]]
            for axis, value in words.axes.items():
                self.modes.g92[axis] = here[axis] - base[axis] - value * scale
        elif nonmodal == "G92.1":
            self.modes.g92 = np.zeros(3)
        elif nonmodal == "G10":
            number = int(words.values["P"])
            name = f"G{53 + number}" if number else self.modes.codes["coordinates"]
            offset = self._board.memory.offsets[name]
            for axis, value in words.axes.items():
                absolute = value * scale
                offset[axis] = here[axis] - self.modes.g92[axis] - absolute if words.values["L"] == 20 else absolute
            self._board.write_memory(3 * 4 + 1)
            yield self._board.present

    def _target(self, words: Words) -> NDArray[np.float64]:
        target = self._position.copy()
        offset = np.zeros(3) if words.in_machine_coordinates else self.work_offset()
        relative = words.codes.get("distance", self.modes.codes["distance"]) == "G91"
        for axis, value in words.axes.items():
            distance = value * self._scale(words)
            if relative and not words.in_machine_coordinates:
                target[axis] += distance
            else:
                target[axis] = offset[axis] + distance
        return target

    def _move(self, words: Words, motion: str, feed: float) -> Wait:
        board = self._board
        target = self._target(words)
        if board.checking:
            self._position = target
            return
        if self._beyond_travel(target):
            board.planner.hold(board.present)
            while board.planner.moving:
                yield board.planner.end_time
            board.raise_alarm(2)
            yield from self._halt()
        if motion == "G38.2":
            yield from self.synchronise()
            yield from self._probe(target, feed)
            return
        while board.planner.full:
            yield board.planner.next_time
        self._position = target
        self.plan(target, None if motion == "G0" else feed, self._share(motion))

    def _share(self, motion: str) -> float:
        return self.spindle.share_of_move(self.modes.codes["spindle"], self.modes.speed, motion)

    def toggle_coolant(self) -> None:
        """As M8 or M9 would, but at once."""
        if self._board.present_state in ("Idle", "Run", "Hold"):
            self.modes.codes["coolant"] = "M9" if self.modes.codes["coolant"] == "M8" else "M8"
            self._board.tell_overrides()

    def follow_moves(self) -> None:
        """Moves have begun or ended: the laser goes with them."""
        self.spindle.follow(self._board.planner.take_power(), self.modes.codes["spindle"], self.modes.speed)

    def synchronise_position(self) -> None:
        """The parser learns where the machine stands."""
        self._position = self._board.planner.position()

    def plan(self, target: NDArray[np.float64], feed: float | None, share: float, *, is_jog: bool = False) -> None:
        """Limit speed and acceleration so that no axis exceeds its own, and queue the move."""
        board, settings = self._board, self._board.memory.settings
        way = np.abs(target - board.planner.target())
        length = float(np.linalg.norm(way))
        if not length:
            return
        along = np.maximum(way / length, 1e-12)
        fastest = float(np.min([settings[110 + axis] / along[axis] for axis in range(3)]))
        acceleration = float(np.min([settings[120 + axis] / along[axis] for axis in range(3)]))
        wanted = fastest * self.overrides.rapid / 100 if feed is None else feed
        if feed is not None and not is_jog:
            wanted *= self.overrides.feed / 100
        speed = max(min(wanted, fastest), SLOWEST_FEED) / 60
        board.planner.add(target, speed, acceleration, board.present, is_jog=is_jog, power=share)

    def jog(self, text: str) -> Answer:
        """Carry out what follows `$J=`."""
        try:
            words = read_words(text)
        except GcodeError as error:
            return error.code
        if set(words.codes) - {"units", "distance"} or not words.axes or set(words.values) - set("XYZF"):
            return 16
        if "F" not in words.values:
            return 22
        target = self._target(words)
        if self._beyond_travel(target):
            return 15
        while self._board.planner.full:
            yield self._board.planner.next_time
        self._position = target
        self.plan(target, words.values["F"] * self._scale(words), self._share("G1"), is_jog=True)
        return 0

    def _beyond_travel(self, target: NDArray[np.float64]) -> bool:
        """`$20`: machine space is negative, from minus `$130` to zero."""
        settings = self._board.memory.settings
        travel = np.array([settings[130], settings[131], settings[132]])
        return bool(settings[20] and ((target > 0) | (target < -travel)).any())

    def _probe(self, target: NDArray[np.float64], feed: float) -> Wait:
        """Turn toward `target` until the index mark is seen."""
        board = self._board
        start = board.planner.position()
        if self.at_mark():
            board.raise_alarm(4)
            yield board.present
            return
        mark = None if board.index_deg is None else start[0] + board.index_deg - board.drivetrain.bearing_deg
        found = mark is not None and min(start[0], target[0]) <= mark <= max(start[0], target[0])
        self.probed, self.probe_closed = np.zeros(3), found
        if mark is not None and found:
            self.probed = np.array([mark, *start[1:]])
            target = self._braked_behind(mark, start, target, feed)
        self.plan(target, feed, self._share("G38.2"))
        yield from self.synchronise()
        self.synchronise_position()
        if not found:
            board.raise_alarm(5)
            yield board.present
        board.say(self.probe_report())

    def _braked_behind(
        self, mark: float, start: NDArray[np.float64], target: NDArray[np.float64], feed: float
    ) -> NDArray[np.float64]:
        """Where a head comes to rest that begins to brake at the mark."""
        acceleration = self._board.memory.settings[120]
        speed = min(
            min(feed, self._board.memory.settings[110]) / 60, math.sqrt(2 * acceleration * abs(mark - start[0]))
        )
        way = min(speed**2 / (2 * acceleration), abs(target[0] - mark))
        return np.array([mark + math.copysign(way, target[0] - mark), *start[1:]])

    def at_mark(self) -> bool:
        """Whether the probe input sees the index mark."""
        index = self._board.index_deg
        return index is not None and abs(index - self._board.drivetrain.bearing_deg) < MARK_DEG

    def probe_report(self) -> str:
        """Where the last probing ended and whether the input closed."""
        place = triple(self.probed, bool(self._board.memory.settings[13]))
        return f"[PRB:{place}:{int(self.probe_closed)}]"
