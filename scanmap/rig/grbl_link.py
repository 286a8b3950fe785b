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
from scanmap.rig.grbl_protocol import Banner, Status
from scanmap.rig.serial_port import SerialPort

POLL_S = 0.25  # `?` while waiting, or more often for a short time-out; grbl wants no more than 5 to 10 a second
BUSY_STATES = ("Run", "Jog", "Home", "Hold", "Door")  # a board in another state has nothing left to do
BRAKE_POLL_S = 0.05
ATTEMPTS = 3
SILENT_PATIENCE_S = 0.3  # so that leaving a dead board does not take a minute
LATE_BANNER_S = 0.5
STILL_S = 3.0  # a board that is running but whose position stands this long is stuck

logger = logging.getLogger(__name__)


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
        if len(line) + 1 > protocol.RX_BUFFER_BYTES:
            raise StageError(f"line of {len(line)} characters does not fit the board's buffer of 127: {line[:40]}...")
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
            answer, information = self._await_answer(silence_s or self._patience_s, despite_fault)
            self._answered = True
            if answer == "ok":
                return information
            if answer and self.latches_errors:
                self._clear_error()
            if answer and answer == refusal:
                break
            refusal = answer or f"no ok for {line!r}"
            logger.warning("%s: %s; sent again", self.name, refusal)
        if not answer and self.fault:
            raise StageError(self.fault)
        raise StageError(f"stage {self.name} refused {line!r}: {refusal}")

    def status(self) -> Status:
        """Ask for a status report until one comes.

        Raises:
            StageError: none came in time, or the port is gone.
        """
        deadline = time.monotonic() + self._patience_s
        while time.monotonic() < deadline:
            self._port.write(protocol.STATUS)
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
        self._port.write(protocol.HOLD)
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

    def send_reset(self) -> None:
        """Reset without waiting: the last means to switch a laser off."""
        self._port.write(protocol.RESET)

    def close(self) -> None:
        """Free the port; never raises."""
        self._port.close()

    def _clear_error(self) -> None:
        self._answered = False
        self._port.write_line("")
        self._await_answer(self._patience_s, despite_fault=True)
        self._answered = True

    def _await_rest(self) -> None:
        deadline = time.monotonic() + max(self._patience_s, STILL_S)
        while time.monotonic() < deadline:
            status = self.status()
            if status.state not in ("Run", "Jog", "Home") and not (status.state == "Hold" and status.substate):
                return
            if line := self._port.read_line(BRAKE_POLL_S):
                self._note(line)

    def _await_answer(self, silence_s: float, despite_fault: bool) -> tuple[str, list[str]]:
        """`ok`, an error in words, or `""` where the board rests and the answer got lost."""
        wait = _Wait(silence_s, self._poll_s)
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
                elif wait.is_over(status, self._port):
                    return "", information
            elif wait.is_silent():
                raise StageError(self._silence())
            if wait.poll_due():
                self._port.write(protocol.STATUS)

    def _note(self, line: str) -> Status | None:
        """Keep what an unasked line means; returns a status report."""
        code = protocol.parse_code(line)
        if code and code[0] == "ALARM":
            self.fault = f"stage {self.name} stopped with {protocol.explain(*code)}"
        elif protocol.parse_banner(line) and not self.fault:  # after a failed homing the board restarts too
            self.fault = (
                f"stage {self.name} restarted by itself, so its position is lost: check its power supply, "
                "then `scanmap stage home`"
            )
        status = protocol.parse_status(line)
        if status and status.state == "Alarm" and not self.fault:
            words = protocol.explain("ALARM", status.substate) if status.substate else "alarm: `scanmap stage home`"
            self.fault = f"stage {self.name} is in {words}"
        return status

    def _silence(self) -> str:
        self._patience_s = min(self._timeout_s, SILENT_PATIENCE_S)
        return (
            f"stage {self.name} has not answered for {self._timeout_s:g} s: check its power and cable, "
            "then `scanmap doctor`"
        )


class _Wait:
    """How long to wait for an answer: as long as the board is alive and busy."""

    def __init__(self, silence_s: float, poll_s: float) -> None:
        now = time.monotonic()
        self._poll_s = poll_s
        self._silence_s = silence_s
        self._heard = self._polled = self._moved = now
        self._position: tuple[float, ...] | None = None
        self._unanswered_polls = self._resting_reports = 0
        self._resumed = False

    def is_silent(self) -> bool:
        return time.monotonic() - self._heard > self._silence_s

    def poll_due(self) -> bool:
        now = time.monotonic()
        if now - self._polled < self._poll_s:
            return False
        self._polled = now
        self._unanswered_polls += 1
        return True

    def is_over(self, status: Status, port: SerialPort) -> bool:
        """Whether the report proves that no answer will come.

        Raises:
            StageError: the board is held or stuck.
        """
        now = self._heard = time.monotonic()
        if status.position != self._position:
            self._position, self._moved = status.position, now
        if status.state in BUSY_STATES:
            self._resting_reports = 0
        elif self._unanswered_polls:  # a report that the board sends by itself can be older than the line
            self._resting_reports += 1
        self._unanswered_polls = 0
        if status.state in ("Hold", "Door") and status.substate == 0:
            if self._resumed:
                raise StageError(
                    f"stage {port.name} is on {status.state.lower()}: release its hold button or close its door, "
                    "then start again"
                )
            port.write(protocol.RESUME)
            self._resumed = True
        if status.state == "Run" and now - self._moved > STILL_S:
            raise StageError(
                f"stage {port.name} runs but stands at {status.position[0]:g}: check the motor, then home it"
            )
        return self._resting_reports >= 2
