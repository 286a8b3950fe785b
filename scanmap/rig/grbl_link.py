"""The conversation with a GRBL board: one line, one answer, and what to do when the answer is missing.

`ok` means accepted, not done; `?` is answered at once or never, so it is asked again; a reset or an alarm can
come at any moment. Every command sent through here may be sent twice without harm (absolute targets,
switches, settings): that is what makes a lost `ok` repairable.
"""

from __future__ import annotations

import contextlib
import logging
import time

from scanmap.errors import StageError
from scanmap.rig import grbl_protocol as protocol
from scanmap.rig.grbl_protocol import Banner, RealTime, Status
from scanmap.rig.grbl_wait import WRITING_S, Wait
from scanmap.rig.serial_port import SerialPort

POLL_S = 0.25  # `?` while waiting, or more often for a short time-out; grbl wants no more than 5 to 10 a second
BRAKE_POLL_S = 0.05
ATTEMPTS = 3
SILENT_PATIENCE_S = 0.3  # so that leaving a dead board does not take a minute
LATE_BANNER_S = 0.5
BRAKING_S = 3.0  # longer than any head needs to come to rest
STARTUP_S = 0.03  # after its banner a board says what its stored lines did
FAREWELL_S = 0.8  # how long the last reset may take to be confirmed; grbl waits 0.5 s to say an alarm

logger = logging.getLogger(__name__)


class RefusedError(StageError):
    """The board has answered `error:n`."""

    def __init__(self, message: str, answer: str) -> None:
        super().__init__(message)
        self.is_unknown = answer.startswith("error:3,")  # a $ command that this board does not have


class GrblLink:
    """Commands and status of one board. Not thread-safe."""

    def __init__(self, port: SerialPort, timeout_s: float) -> None:
        self._port = port
        self._timeout_s = timeout_s
        self._patience_s = timeout_s  # short once the board has fallen silent, until it speaks again
        self._poll_s = min(POLL_S, timeout_s / 4)
        self._answered = True  # False while a line is out; stays so if the caller was interrupted
        self.in_motion = False  # True between the start of a turn and its arrival
        self.preamble: list[str] = []  # sent after every reset that was asked for
        self.latches_errors = False  # grblHAL: after an error it refuses all G-code until it hears an empty line
        self.real_time = RealTime()
        self.lit_by_startup = False  # one of the board's stored lines switches its laser on, after every reset
        self.fault: str | None = None  # why commands are refused: position lost, alarm

    @property
    def name(self) -> str:
        """The port, as the user wrote it."""
        return self._port.name

    def command(self, line: str, *, despite_fault: bool = False, silence_s: float | None = None) -> list[str]:
        """Send one line and wait for its `ok`; returns the lines that came with it.

        Args:
            despite_fault: send it although the position is lost or the board is in alarm (laser off, unlock).
            silence_s: how long the board may say nothing at all; homing answers not even `?`.

        Raises:
            StageError: refused, reset, alarm, no answer, or the port is gone.
        """
        if len(line) > protocol.LINE_CHARACTERS:
            raise StageError(f"a line of {len(line)} characters is longer than the board's 79: {line[:40]}...")
        if not self._answered:
            self.stop()
        answer = refusal = ""
        for _ in range(ATTEMPTS):
            for stale in self._port.drain():
                self._note(stale)
            if self.fault and not despite_fault:
                raise StageError(self.fault)
            self._answered = False
            self._port.write_line(line)
            peace_s = WRITING_S if protocol.writes_memory(line) else 0.0
            wait = Wait(self.name, silence_s or self._patience_s, self._poll_s, peace_s=peace_s)
            answer, information = self._await_answer(wait, despite_fault)
            self._answered = True
            if answer == "ok":
                return information
            if answer and self.latches_errors:
                self._clear_error()
            if answer.startswith("error:22,") and self.preamble:  # the preamble's feed rate is gone
                self.fault = self.fault or self._restarted()
                raise StageError(self.fault)
            if answer and answer == refusal:
                break
            refusal = answer or f"no ok for {line!r}"
            logger.warning("%s: %s; sent again", self.name, refusal)
        if not answer and self.fault:
            raise StageError(self.fault)
        raise RefusedError(f"stage {self.name} refused {line!r}: {refusal}", refusal)

    def jog(self, line: str) -> None:
        """Send a `$J=` line and wait until the head stands; an interruption brakes it, with its place kept.

        Raises:
            RefusedError: by the board, for instance because it knows no jogs.
            StageError: alarm, reset, stuck, no answer, or the port is gone.
        """
        try:
            self.command(line)
            wait = Wait(self.name, self._patience_s, self._poll_s)
            while not self._is_at_rest(status := self.status()):
                wait.is_over(status)
                if line_heard := self._port.read_line(BRAKE_POLL_S):
                    self._note(line_heard)
        except RefusedError:
            raise
        except BaseException:
            with contextlib.suppress(StageError):
                self._port.write(protocol.JOG_CANCEL)
                self._await_rest()
            raise
        if self.fault:
            raise StageError(self.fault)

    def status(self) -> Status:
        """Ask for a status report until one comes.

        Raises:
            StageError: none came in time, or the port is gone.
        """
        deadline = time.monotonic() + self._patience_s
        while time.monotonic() < deadline:
            self._port.write(self.real_time.status)
            asked = time.monotonic()
            while (line := self._port.read_line(max(0.0, asked + self._poll_s - time.monotonic()))) is not None:
                self._patience_s = self._timeout_s
                if (status := self._note(line)) is not None:
                    return status
        raise StageError(self._silence())

    def stop(self) -> None:
        """Brake, then reset: nothing is queued any more, the laser is off and the position is kept.

        Raises:
            StageError: the board does not answer.
        """
        self._port.write(self.real_time.hold)
        with contextlib.suppress(StageError):  # a board halted by an alarm obeys nothing but the reset
            self._await_rest()
        self.reset()

    def reset(self) -> Banner:
        """Soft reset; waits for the banner and sends the preamble.

        Raises:
            StageError: no banner came.
        """
        for attempt in range(ATTEMPTS):
            self._port.write(protocol.RESET)
            banner = self.await_banner(self._patience_s)
            if banner:
                if attempt:  # a slow board may yet answer the other resets
                    while self.await_banner(LATE_BANNER_S):
                        pass
                self._answered, self.in_motion = True, False
                for line in self.preamble if self.status().state != "Alarm" else []:
                    self.command(line, despite_fault=True)
                if self.lit_by_startup:
                    self.command("M5", despite_fault=True)
                return banner
        raise StageError(self._silence())

    def await_banner(self, timeout_s: float) -> Banner | None:
        """The banner of a board that restarts; None if none came. Alarms it reports on the way are kept."""
        deadline = time.monotonic() + timeout_s
        while (line := self._port.read_line(max(0.0, deadline - time.monotonic()))) is not None:
            banner = protocol.parse_banner(line)
            self._patience_s = self._timeout_s
            if banner:
                return banner
            self._note(line)
        return None

    def leave(self, *last_words: str) -> None:
        """Reset as the last means to switch a laser off, then say what the reset would have undone.

        Raises:
            StageError: the port is gone, or a last word got no answer.
        """
        self._port.write(protocol.RESET)
        if self.await_banner(FAREWELL_S):
            self._answered, self.in_motion = True, False
            while line := self._port.read_line(STARTUP_S):
                self._note(line)
            for word in last_words:
                self.command(word, despite_fault=True)
            if self.lit_by_startup:
                self.command("M5", despite_fault=True)

    def close(self) -> None:
        """Free the port; never raises."""
        self._port.close()

    def _clear_error(self) -> None:
        self._answered = False
        self._port.write_line("")
        self._await_answer(Wait(self.name, self._patience_s, self._poll_s), despite_fault=True)
        self._answered = True

    def _await_rest(self) -> None:
        deadline = time.monotonic() + max(self._patience_s, BRAKING_S)
        while time.monotonic() < deadline:
            if self._is_at_rest(self.status()):
                return
            if line := self._port.read_line(BRAKE_POLL_S):
                self._note(line)

    def _is_at_rest(self, status: Status) -> bool:
        return status.state not in ("Run", "Jog", "Home") and not (status.state == "Hold" and status.substate)

    def _await_answer(self, wait: Wait, despite_fault: bool) -> tuple[str, list[str]]:
        """`ok`, an error in words, or `""` where the board rests and the answer got lost."""
        information: list[str] = []
        while True:
            line = self._port.read_line(self._poll_s)
            if line == "ok":
                return "ok", information
            if line:
                self._patience_s = self._timeout_s
            refusal = protocol.parse_error(line) if line else None
            if refusal:
                return refusal, information
            if line is not None:
                status = self._note(line)
                if self.fault and not despite_fault:
                    raise StageError(self.fault)
                if status is None:
                    information.append(line)
                elif wait.is_over(status):
                    return "", information
                elif wait.resume_due(status):
                    self._port.write(self.real_time.resume)
            elif wait.is_silent():
                raise StageError(self._silence())
            if wait.poll_due():
                self._port.write(self.real_time.status)

    def _note(self, line: str) -> Status | None:
        """Keep what an unasked line means; returns a status report."""
        code = protocol.parse_code(line)
        if code and code[0] == "ALARM":
            self.fault = f"stage {self.name} stopped with {protocol.explain(*code)}"
        elif protocol.is_greeting(line) and not self.fault:  # after a failed homing the board restarts too
            self.fault = self._restarted()
        self.lit_by_startup |= protocol.lights_laser(line)
        status = protocol.parse_status(line)
        if status and status.state == "Alarm" and not self.fault:
            words = protocol.explain("ALARM", status.substate) if status.substate else "alarm: `scanmap stage home`"
            self.fault = f"stage {self.name} is in {words}"
        return status

    def _restarted(self) -> str:
        return (
            f"stage {self.name} restarted by itself, so its position is lost: check its power supply, "
            "then `scanmap stage home`"
        )

    def _silence(self) -> str:
        self._patience_s = min(self._timeout_s, SILENT_PATIENCE_S)
        return (
            f"stage {self.name} has not answered for {self._timeout_s:g} s: check its power and cable, "
            "then `scanmap doctor`"
        )
