"""A GRBL 1.1 board that exists only here: bytes in, bytes out, and the truth about the head it turns.

Faithful to gnea/grbl (doc/markdown: interface, commands, settings) as far as a turning axis and a laser go; it
shares no code with the driver it is there to test. It has no thread: it lives whenever somebody looks at it,
up to the present moment. In `instant` mode the present is a clock of its own, which jumps to the next event
whenever somebody waits for an answer, so that a scan's moves cost no real time.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass, field

from scanmap.twin.board import BANNERS, HOMING, HOMING_FIRST, DialectName, Memory, StatusReport
from scanmap.twin.executor import Executor
from scanmap.twin.motion import Drivetrain
from scanmap.twin.planner import Planner
from scanmap.twin.serial_line import Faults, SerialLine

RX_BYTES = {"grbl": 128, "grblHAL": 1023, "FluidNC": 256}
LINE_CHARACTERS = 79

_CRITICAL_ALARMS = {1, 2}  # these halt the board until it is reset
_DEAD_STOPS = {1, 3}  # in mid-way: these let the motor go even where $1 is 255


@dataclass
class Firmware:
    """The board. Thread-safe; `scanmap.twin.ports` puts it behind `twin://` and behind a pty."""

    dialect: DialectName = "grbl"
    instant: bool = True  # moves cost no real time
    resets_on_open: bool = True  # like an Uno; grblHAL and FluidNC boards with native USB do not
    drivetrain: Drivetrain = field(default_factory=Drivetrain)
    faults: Faults = field(default_factory=Faults)
    memory: Memory = field(default_factory=Memory)
    switch_deg: float | None = None  # true bearing of the limit switch
    index_deg: float | None = None  # true bearing of the index mark on the probe input
    laser_dead: bool = False  # switched or not, it shines no more

    def __post_init__(self) -> None:
        self._lock = threading.RLock()
        self._epoch = time.monotonic()
        self._now = 0.0
        self._rx: deque[int] = deque()
        self._line = SerialLine(self.faults)
        self._executor: Executor
        self._power_up()

    @property
    def now(self) -> float:
        """The board's present [s]: real, or its own in `instant` mode."""
        with self._lock:
            self._live()
            return self._now

    @property
    def bearing(self) -> float:
        """True bearing of the head at this moment [rad], play and lost steps included."""
        with self._lock:
            self._live()
            return math.radians(self.drivetrain.bearing_deg)

    @property
    def laser_on(self) -> bool:
        """Whether the laser shines at this moment."""
        with self._lock:
            self._live()
            return self._executor.laser_power > 0 and not self.laser_dead

    @property
    def motor_on(self) -> bool:
        """Whether the motor holds the head."""
        with self._lock:
            self._live()
            return self._motor_on or self.planner.moving

    @property
    def state(self) -> str:
        """As the status report names it, without its substate."""
        with self._lock:
            self._live()
            return self._state()

    def open(self) -> None:
        """The port was opened."""
        with self._lock:
            if self.resets_on_open:
                self.power_cycle()

    def power_cycle(self) -> None:
        """Brown-out, or the reset that opening the port gives an Uno: counters to zero, laser off, head stays."""
        with self._lock:
            self._live()
            self.planner.abort(self._now)
            self._line.clear()
            self._power_up()
            self._live()

    def trip_limit(self) -> None:
        """The limit switch closes in mid-run."""
        with self._lock:
            self._live()
            self.raise_alarm(1)
            self._live()

    def raise_alarm(self, code: int) -> None:
        """Stop dead, laser off, as grbl does on that alarm."""
        self.planner.abort(self._now)
        self._executor.laser_power = 0.0
        self.alarm = True
        self.say(f"ALARM:{code}")
        if code in _DEAD_STOPS:
            self.release_motor()
        if code in _CRITICAL_ALARMS:
            self.message("Reset to continue")
            self._halted = True

    def wait(self, seconds: float) -> None:
        """Let time pass: sleeps, or moves the board's own clock."""
        if not self.instant:
            time.sleep(seconds)
            return
        with self._lock:
            self._live(self._now + seconds)

    def write(self, data: bytes) -> None:
        """Bytes from the host."""
        with self._lock:
            self._live()
            if self.faults.unplugged or self.faults.mute:
                return
            for byte in data:
                self._receive(byte)
            self._live()

    def read(self, size: int) -> bytes:
        """Bytes that have arrived at the host by now, at most `size`."""
        with self._lock:
            self._live()
            return self._line.take(size, self._now)

    def waiting(self) -> int:
        """Bytes that have arrived at the host by now."""
        with self._lock:
            self._live()
            return self._line.waiting(self._now)

    def next_event(self) -> float:
        """Seconds until the board does something by itself; infinity if it only waits for bytes."""
        with self._lock:
            self._live()
            return max(0.0, min(self._line.next_time, self._wake, self.planner.next_time) - self._now)

    def say(self, line: str) -> None:
        """Send a line to the host."""
        self._line.send(line, self._now)

    def message(self, text: str) -> None:
        """Tell the host something it did not ask for."""
        self.say(f"[MSG:{'INFO: ' if self.dialect == 'FluidNC' else ''}{text}]")

    def go_idle(self) -> None:
        """Motion has ended: the motor lets go unless `$1` is 255."""
        self._motor_on = self.memory.settings[1] == 255

    def release_motor(self) -> None:
        """The motor lets go now."""
        self._motor_on = False

    @property
    def present(self) -> float:
        """The board's clock as it stands, for the code that runs on the board."""
        return self._now

    def _power_up(self) -> None:
        self.planner = Planner(self.drivetrain)
        self.drivetrain.recount(0)
        must_home = HOMING_FIRST if self.dialect == "grblHAL" else HOMING
        self.alarm = self.must_home = bool(int(self.memory.settings[22]) & must_home)
        self._restart()

    def _restart(self) -> None:
        self._rx.clear()
        self._halted = self.asleep = self.homing = self.checking = self.restart_requested = False
        self._reports = 0
        self._executor = Executor(self)
        self._main = self._run()
        self._wake = math.inf
        self.go_idle()

    def _run(self) -> Generator[float, None, None]:
        """The board's main loop; yields the time before which it has nothing to do."""
        self.say("")
        self.say(BANNERS[self.dialect])
        if self.alarm and self.must_home and self.dialect == "grblHAL":
            self.say("ALARM:11")
            self.message("Homing cycle required")
        elif self.alarm:
            self.message("'$H'|'$X' to unlock")
        else:
            yield from self._executor.run_startup()
        while True:
            line = yield from self._read_line()
            if self.faults.lose_lines > 0:
                self.faults.lose_lines -= 1
                continue
            answer = 11 if len(line) > LINE_CHARACTERS else (yield from self._executor.execute(line))
            self.say(f"error:{answer}" if answer else "ok")
            if self.asleep:
                self.message("Sleeping")
                self.release_motor()
            if self.restart_requested:
                self._restart()
                yield self._now  # the new life begins at once

    def _read_line(self) -> Generator[float, None, str]:
        """Upper case, without blanks and comments."""
        line, comment = "", ""
        while True:
            while not self._rx or self.planner.held or self._halted or self.asleep:
                yield math.inf
            character = chr(self._rx.popleft())
            if character in "\r\n":
                return line
            if comment:
                comment = "" if (comment, character) == ("(", ")") else comment
            elif character in "(;":
                comment = character
            elif character > " " and (character != "/" or self.dialect == "FluidNC"):
                line += character.upper() if len(line) <= LINE_CHARACTERS else ""

    def _live(self, until: float | None = None) -> None:
        """Bring the board to the present."""
        if until is None:
            until = self._now if self.instant else time.monotonic() - self._epoch
        while True:
            was_moving = self.planner.moving
            self.planner.advance(self._now)
            self._wake = math.inf if self._halted else next(self._main)
            if self.planner.moving:
                self._motor_on = True
            elif was_moving:
                self.go_idle()
            due = min(self._wake, self.planner.next_time)
            if due > until:
                break
            self._now = max(self._now, due)
        self._now = max(self._now, until)
        self.planner.advance(self._now)

    def _receive(self, byte: int) -> None:
        """One byte: acted on at once if it is a real-time command, else buffered while there is room."""
        if byte == 0x18:
            self._soft_reset()
        elif self.homing:
            pass
        elif byte == ord("?"):
            self._report()
        elif byte == ord("!"):
            self._hold()
        elif byte == ord("~"):
            self.planner.resume(self._now)
        elif byte == 0x85 and self.planner.jogging:
            self.planner.cancel(self._now)
        elif byte < 0x80 and len(self._rx) < RX_BYTES[self.dialect]:
            self._rx.append(byte)
        if self.instant or byte in b"\r\n":
            self._live()

    def _soft_reset(self) -> None:
        if self.homing or self.planner.moving:
            self.raise_alarm(6 if self.homing else 3)
        self.planner.abort(self._now)
        self.alarm = self.alarm or self.asleep
        self._restart()

    def _hold(self) -> None:
        if self.alarm or self.asleep or self.checking:
            return
        if self.planner.jogging:
            self.planner.cancel(self._now)
        else:
            self.planner.hold(self._now)

    def _state(self) -> str:
        flags = {"Sleep": self.asleep, "Alarm": self.alarm, "Home": self.homing, "Check": self.checking}
        flags |= {"Hold": self.planner.held, "Jog": self.planner.jogging, "Run": self.planner.busy}
        return next((name for name, is_so in flags.items() if is_so), "Idle")

    def _report(self) -> None:
        """The answer to `?`."""
        if self._halted and self.dialect == "grbl":
            return
        if self.faults.lose_status > 0:
            self.faults.lose_status -= 1
            return
        turn = self._reports % (30 if self.planner.busy else 10)
        self._reports += 1
        report = StatusReport(
            state=self._state(),
            braking=self.planner.moving,
            position=self.planner.position(),
            offset=self._executor.work_offset(),
            speed=self.planner.speed(self._now),
            laser_power=self._executor.laser_power,
            free=(self.planner.free_blocks, RX_BYTES[self.dialect] - len(self._rx)),
        )
        self.say(report.line(self.memory.settings, with_offset=turn == 0, with_overrides=turn == 1))
