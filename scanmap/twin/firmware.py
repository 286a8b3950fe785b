"""A GRBL 1.1 board that exists only here: bytes in, bytes out, and the truth about the head it turns.

Faithful to gnea/grbl (doc/markdown: interface, commands, settings; protocol.c, report.c, limits.c, eeprom.c) as far
as a turning axis and a laser go; it shares no code with the driver it is there to test. It has no thread: it lives
whenever somebody looks at it, up to the present moment. In `instant` mode the present is a clock of its own, which
jumps to the next event whenever somebody waits for an answer, so that a scan's moves cost no real time.
"""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass, field

from scanmap.twin.board import ALARM_S, EEPROM_BYTE_S, HOMING, HOMING_FIRST, OF_GRBLHAL, DialectName, Memory
from scanmap.twin.main_loop import MainLoop
from scanmap.twin.motion import Drivetrain
from scanmap.twin.overrides import Door, obey
from scanmap.twin.planner import Planner
from scanmap.twin.receiver import UART_BYTES, real_time
from scanmap.twin.serial_line import Faults, SerialLine
from scanmap.twin.status_report import status_line

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
        if self.dialect == "grblHAL":
            self.memory.settings |= OF_GRBLHAL
        self._line = SerialLine(self.faults)
        self._status_wanted = False
        self.loop: MainLoop
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
            return self.loop.executor.spindle.share > 0 and not self.laser_dead

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
            return self.present_state

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
        """Stop dead, laser off, as on that alarm; FluidNC leaves it on (`off_on_alarm` is false) until the reset."""
        self.planner.abort(self._now)
        if self.dialect != "FluidNC":
            self.loop.executor.spindle.stop()
        self.alarm = True
        self.say(f"ALARM:{code}")
        self.work(ALARM_S[self.dialect])
        if code in _DEAD_STOPS:
            self.release_motor()
        self._halting = code in _CRITICAL_ALARMS

    def work(self, seconds: float) -> None:
        """The processor is busy from now on: it takes bytes in and answers nothing, not even `?`."""
        self._busy_until = self._now + seconds

    def write_memory(self, size: int) -> None:
        """Bytes of the EEPROM are written: an AVR has its interrupts off and loses what the host sends."""
        self.memory.writes += 1
        if self.dialect == "grbl":
            self.work(size * EEPROM_BYTE_S)
            self._deaf_until = self._busy_until

    def answer_status(self) -> None:
        """Send the report that was asked for, if one was."""
        if self._status_wanted:
            self._status_wanted = False
            self.say(status_line(self))

    def tell_offset(self) -> None:
        """The work offset has changed: the next status report has it."""
        self.loop.rare.offset_in = 0

    def tell_overrides(self) -> None:
        """The spindle has changed: the next status report says what is on."""
        self.loop.rare.overrides_in = 0

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
                if self.instant or byte in b"\r\n":
                    self._live()
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
        self.restart()

    def restart(self) -> None:
        """A new life; memory, position and alarm stay."""
        self._uart = bytearray()  # what came while the processor was deaf
        self._busy_until = self._deaf_until = -math.inf
        self._halted = self._halting = self._reset_wanted = self._status_wanted = False
        self.asleep = self.homing = self.checking = self.restart_requested = False
        self.door = Door(self)
        self.loop = MainLoop(self)
        self._wake = math.inf
        self.go_idle()

    def _live(self, until: float | None = None) -> None:
        """Bring the board to the present."""
        if until is None:
            until = self._now if self.instant else time.monotonic() - self._epoch
        while True:
            was_moving, was_cancelling = self.planner.moving, self.planner.cancelling
            self.planner.advance(self._now)
            self.loop.executor.follow_moves()
            if was_cancelling and not self.planner.cancelling:
                self.loop.executor.synchronise_position()
            self._wake = min(self._compute(), self.door.advance())
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

    def _compute(self) -> float:
        """What the processor does now; returns when it must be looked at again."""
        if self._now < self._busy_until:
            return self._busy_until
        late, self._uart = self._uart, bytearray()
        for byte in late:
            self._receive(byte)
        if self._halting:  # a reset that came earlier is forgotten
            self.message("Reset to continue")
            self._halting, self._halted, self._reset_wanted = False, True, False
        if self._reset_wanted and self._now >= self._busy_until:
            self.loop.end()
            self.restart()
        if not self.homing and not (self._halted and self.dialect == "grbl"):
            self.answer_status()
        return self.loop.answer_halted() if self._halted else self.loop.next()

    def _receive(self, byte: int) -> None:
        """One byte: a real-time command, or something for the main loop."""
        if self._now < self._deaf_until:
            if len(self._uart) < UART_BYTES:
                self._uart.append(byte)
            return
        in_text = self.loop.receiver.keeps_text and not self.memory.settings.get(39)
        command = real_time(byte, self.dialect, in_text=in_text)
        if command == 0x18:
            self._soft_reset()
        elif command == 0x80:
            self._want_status()
        elif command == 0x82:
            self._hold()
        elif command < 0x80:
            self.loop.receiver.add(byte)
        else:
            obey(self, command)

    def _soft_reset(self) -> None:
        if self._reset_wanted:
            return
        if (self.homing or self.planner.moving) and not self._halting:
            self.raise_alarm(6 if self.homing else 3)
        self.loop.executor.spindle.stop()
        self.planner.abort(self._now)
        self.alarm = self.alarm or self.asleep
        self._reset_wanted = True

    def _hold(self) -> None:
        if self.alarm or self.asleep or self.checking or self.homing or self.door.is_open:
            return
        brake = self.planner.cancel if self.planner.jogging else self.planner.hold
        brake(self._now)

    @property
    def present_state(self) -> str:
        """The state as it stands, for the code that runs on the board."""
        flags = {"Sleep": self.asleep, "Alarm": self.alarm, "Home": self.homing, "Check": self.checking}
        flags |= {
            "Door": self.door.is_open,
            "Hold": self.planner.held,
            "Jog": self.planner.jogging,
            "Run": self.planner.busy,
        }
        return next((name for name, is_so in flags.items() if is_so), "Idle")

    def _want_status(self) -> None:
        """`?`: answered as soon as the processor looks, and once however often it was asked meanwhile."""
        if self.faults.lose_status > 0:
            self.faults.lose_status -= 1
        else:
            self._status_wanted = True
