"""The twin's answer to `?`, with the fields that come only now and then.

Source: gnea/grbl, doc/markdown/interface.md and grbl/report.c; grblHAL/core, report.c ($10 is a mask of fields).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.twin.board import decimal, triple

if TYPE_CHECKING:
    from scanmap.twin.firmware import Firmware

_BUSY = {"Run", "Hold", "Jog", "Home", "Door"}
_ALL_FIELDS = 8 | 16 | 32 | 64  # bits of grblHAL's $10; grbl and FluidNC leave none of these fields out


class RareFields:
    """When the work offset and the overrides are told: after a change, and every so many reports."""

    def __init__(self) -> None:
        self.offset_in = 0  # reports until then
        self.overrides_in = 0

    def due(self, state: str) -> tuple[bool, bool]:
        """Whether the next report has the work offset, and the overrides."""
        is_busy = state in _BUSY
        offset = self.offset_in == 0
        self.offset_in = (29 if is_busy else 9) if offset else self.offset_in - 1
        if offset:
            self.overrides_in = max(1, self.overrides_in)  # never both in one report
        overrides = self.overrides_in == 0
        self.overrides_in = (19 if is_busy else 9) if overrides else self.overrides_in - 1
        return offset, overrides


class StatusReport(NamedTuple):
    """What a board knows when it is asked `?`."""

    state: str
    substate: int | None  # of a hold or a door
    position: NDArray[np.float64]  # machine position [units]
    offset: NDArray[np.float64]  # work zero seen from machine zero [units]
    speed: float  # [units/s]
    spindle_speed: float  # [units of S]
    overrides: str  # feed, rapids, spindle [%]
    accessories: str  # S, C, F: what is switched on
    pins: str  # X, P: what is pressed
    free: tuple[int, int]  # blocks of the planner, bytes of the receive buffer

    def line(self, mask: int, *, in_inches: bool, with_offset: bool, with_overrides: bool) -> str:
        """As `$10` (grblHAL's, a superset of grbl's) and `$13` want it."""
        fields = [self.state if self.substate is None else f"{self.state}:{self.substate}"]
        place = self.position - (0 if mask & 1 else self.offset)
        fields.append(("MPos:" if mask & 1 else "WPos:") + triple(place, in_inches))
        if mask & 2:
            fields.append(f"Bf:{self.free[0]},{self.free[1]}")
        if mask & 8:
            feed = decimal(self.speed * 60 / 25.4, 1) if in_inches else decimal(self.speed * 60, 0)
            fields.append(f"FS:{feed},{decimal(self.spindle_speed, 0)}")
        if self.pins and mask & 16:
            fields.append(f"Pn:{self.pins}")
        if with_offset and mask & 32:
            fields.append("WCO:" + triple(self.offset, in_inches))
        if with_overrides and mask & 64:
            fields.append(f"Ov:{self.overrides}" + (f"|A:{self.accessories}" if self.accessories else ""))
        return f"<{'|'.join(fields)}>"


def status_line(board: Firmware) -> str:
    """What the board says to `?` now."""
    settings, executor, state = board.memory.settings, board.loop.executor, board.present_state
    with_offset, with_overrides = board.loop.rare.due(state)
    report = StatusReport(
        state=state,
        substate={"Hold": int(board.planner.moving), "Door": board.door.substate}.get(state),
        position=board.planner.position(),
        offset=executor.work_offset(),
        speed=board.planner.speed(board.present),
        spindle_speed=executor.spindle.speed,
        overrides=executor.overrides.words,
        accessories=executor.spindle.accessories() + "F" * (executor.modes.codes["coolant"] == "M8"),
        pins=_pins(board),
        free=(board.planner.free_blocks, board.loop.receiver.free),
    )
    mask = int(settings[10]) if board.dialect == "grblHAL" else int(settings[10]) & 3 | _ALL_FIELDS
    return report.line(mask, in_inches=bool(settings[13]), with_offset=with_offset, with_overrides=with_overrides)


def _pins(board: Firmware) -> str:
    toward = -1.0 if int(board.memory.settings[23]) & 1 else 1.0
    switch = board.switch_deg
    at_switch = switch is not None and (board.drivetrain.bearing_deg - switch) * toward >= 0
    return "P" * board.loop.executor.at_mark() + "X" * at_switch
