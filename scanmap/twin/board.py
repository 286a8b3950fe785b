"""What a GRBL board keeps in its memory and says about itself: settings, build info, offsets, modes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

DialectName = Literal["grbl", "grblHAL", "FluidNC"]

BANNERS: dict[str, str] = {
    "grbl": "Grbl 1.1h ['$' for help]",
    "grblHAL": "GrblHAL 1.1f ['$' or '$HELP' for help]",
    "FluidNC": "Grbl 3.7 [FluidNC v3.7.8 (wifi) '$' for help]",
}
BUILD_INFO: dict[str, tuple[str, ...]] = {
    "grbl": ("[VER:1.1h.20190825:{owner}]", "[OPT:V,15,128]"),
    "grblHAL": (
        "[VER:1.1f.20240812:{owner}]",
        "[OPT:VNMSL,35,1024,3,0]",
        "[AXS:3:XYZ]",
        "[NEWOPT:ENUMS,RT{legacy},HOME]",
        "[FIRMWARE:grblHAL]",
        "[DRIVER:STM32F401CC]",
    ),
    "FluidNC": ("[VER:3.7 FluidNC v3.7.8 (wifi) :]", "[OPT:PHS]", "[MSG: Machine: scanner head]"),
}

_DEFAULTS: dict[int, float] = {
    **{0: 10, 1: 25, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 1, 11: 0.01, 12: 0.002, 13: 0},
    **{20: 0, 21: 0, 22: 0, 23: 0, 24: 25.0, 25: 500.0, 26: 250, 27: 1.0, 30: 1000, 31: 0, 32: 0},
    **{100: 80.0, 101: 250.0, 102: 250.0, 110: 3600.0, 111: 500.0, 112: 500.0},
    **{120: 360.0, 121: 10.0, 122: 10.0, 130: 200.0, 131: 200.0, 132: 200.0},
}
OF_GRBLHAL: dict[int, float] = {10: 511, 39: 1}  # what it reports; whether `?`, `!`, `~` count inside `$` lines
_THREE_DECIMALS = {11, 12, 24, 25, 27} | {number for number in _DEFAULTS if number >= 100}
_WHOLE_OUTSIDE = {30, 31}  # kept as they are, told without decimals
_FLAGS = {4, 5, 6, 13, 20, 21, 22, 32}
ALARM_S = {"grbl": 0.5, "grblHAL": 0.1, "FluidNC": 0.5}  # the processor waits so long for `ALARM:n` to get out
EEPROM_BYTE_S = 3.4e-3  # an AVR writes a byte of its memory so long, and hears nothing meanwhile
HOMING, HOMING_ONE_AXIS, HOMING_FIRST = 1, 2, 4  # bits of $22; the last two are grblHAL's


@dataclass
class Memory:
    """Survives resets and power loss, like the EEPROM."""

    settings: dict[int, float] = field(default_factory=lambda: dict(_DEFAULTS))
    startup: list[str] = field(default_factory=lambda: ["", ""])
    owner: str = ""  # what `$I=` has noted
    offsets: dict[str, NDArray[np.float64]] = field(
        default_factory=lambda: {f"G{number}": np.zeros(3) for number in range(54, 60)}
    )
    writes: int = 0  # the real one wears out after 100000

    def lines(self) -> list[str]:
        """The answer to `$$`."""
        return [
            f"${number}=" + decimal(value, 3 if number in _THREE_DECIMALS else 0)
            for number, value in sorted(self.settings.items())
        ]

    def restore(self, what: str, dialect: DialectName) -> None:
        """`$RST=`: `$` the settings, `#` the offsets, `*` everything."""
        fresh = Memory()
        if what in "$*":
            self.settings = fresh.settings | (OF_GRBLHAL if dialect == "grblHAL" else {})
        if what in "#*":
            self.offsets = fresh.offsets
        if what == "*":
            self.startup, self.owner = fresh.startup, fresh.owner

    def store(self, number: int, value: float, dialect: DialectName = "grbl") -> int:
        """Write a setting; returns grbl's error number, 0 if it was taken."""
        if value < 0:
            return 4
        if number not in self.settings:
            return 3
        if number not in _THREE_DECIMALS | _WHOLE_OUTSIDE:
            value = float(int(value) & (0xFFFF if dialect == "grblHAL" else 0xFF))  # as wide as the board keeps it
        if number == 0 and value < 3:
            return 6
        if number == 20 and value and not self.settings[22]:
            return 10
        if number in _FLAGS and not (number == 22 and dialect == "grblHAL"):
            value = float(bool(value))
        self.settings[number] = value
        if number == 22 and not value:
            self.settings[20] = 0.0
        return 0


@dataclass
class Modes:
    """The parser's state; back to these defaults after every reset."""

    codes: dict[str, str] = field(
        default_factory=lambda: {
            "motion": "G0",
            "coordinates": "G54",
            "plane": "G17",
            "units": "G21",
            "distance": "G90",
            "feed": "G94",
            "spindle": "M5",
            "coolant": "M9",
        }
    )
    feed: float = 0.0  # [units/min]
    speed: float = 0.0  # S word
    tool: int = 0
    g92: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def line(self, *, in_inches: bool) -> str:
        """The answer to `$G`."""
        feed = decimal(self.feed / 25.4, 1) if in_inches else decimal(self.feed, 0)
        return f"[GC:{' '.join(self.codes.values())} T{self.tool} F{feed} S{decimal(self.speed, 0)}]"


def decimal(value: float, places: int) -> str:
    """A number as the board writes it: single precision, halves away from zero."""
    digits = math.floor(float(abs(np.float32(value)) * np.float32(10**places)) + 0.5)
    whole, rest = divmod(digits, 10**places)
    return ("-" if value < 0 else "") + f"{whole}" + (f".{rest:0{places}d}" if places else "")


def triple(values: NDArray[np.float64], in_inches: bool) -> str:
    """Three coordinates [units] as the board writes them: three decimals, or four of inches."""
    return ",".join(decimal(value / 25.4, 4) if in_inches else decimal(value, 3) for value in values)
