"""How long to wait for a GRBL board: as long as it is alive and busy."""

from __future__ import annotations

import time

from scanmap.errors import StageError
from scanmap.rig.grbl_protocol import Status

BUSY_STATES = ("Run", "Jog", "Home", "Hold", "Door")  # a board in another state has nothing left to do
STILL_S = 3.0  # a board that is running but whose position stands this long is stuck; a door may be open as long
RESTARTING_S = 6.0  # after a door a board stands 4 s, so that its spindle may turn again
WRITING_S = 0.1  # a board that writes its memory may hear nothing (an AVR 3.4 ms a byte): it is left in peace


class Wait:
    """One wait for an answer, or for rest."""

    def __init__(self, name: str, silence_s: float, poll_s: float, *, peace_s: float = 0.0) -> None:
        """Wait through `silence_s` without a sound, asking every `poll_s` but not in the first `peace_s` [s]."""
        self._name = name
        self._poll_s = poll_s
        self._silence_s = silence_s + peace_s
        self._heard = self._moved = now = time.monotonic()
        self._polled = now + peace_s
        self._seen: tuple[object, ...] = ()  # position and state
        self._unanswered_polls = self._resting_reports = 0
        self._resumed = False

    def is_silent(self) -> bool:
        """Whether the board has said nothing for too long."""
        return time.monotonic() - self._heard > self._silence_s

    def poll_due(self) -> bool:
        """Whether to ask for a status report now."""
        now = time.monotonic()
        if now - self._polled < self._poll_s:
            return False
        self._polled = now
        self._unanswered_polls += 1
        return True

    def is_over(self, status: Status) -> bool:
        """Whether the report proves that no answer will come.

        Raises:
            StageError: the board is held or stuck.
        """
        now = self._heard = time.monotonic()
        if (status.position, status.state, status.substate) != self._seen:
            self._seen, self._moved = (status.position, status.state, status.substate), now
        patience_s = RESTARTING_S if (status.state, status.substate) == ("Door", 3) else STILL_S
        if status.state in BUSY_STATES:
            self._resting_reports = 0
        elif self._unanswered_polls:  # a report that the board sends by itself can be older than the line
            self._resting_reports += 1
        self._unanswered_polls = 0
        if status.state in ("Hold", "Door"):
            if (self._resumed and not status.substate) or now - self._moved > patience_s:
                raise StageError(
                    f"stage {self._name} is on {status.state.lower()}: release its hold button or close its door, "
                    "then start again"
                )
        elif status.state in ("Run", "Jog") and now - self._moved > patience_s:
            raise StageError(
                f"stage {self._name} runs but stands at {status.position[0]:g}: check the motor, then home it"
            )
        return self._resting_reports >= 2

    def resume_due(self, status: Status) -> bool:
        """Whether a hold nobody asked for stands and is to be released; once."""
        due = status.state in ("Hold", "Door") and status.substate == 0 and not self._resumed
        self._resumed |= due
        return due
