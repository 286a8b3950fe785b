"""What a GRBL board keeps in its memory and says about itself: settings, build info, offsets, modes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

DialectName = Literal["grbl", "grblHAL", "FluidNC"]

BANNERS: dict[str, str] = {
    "grbl": "Grbl 1.1h ['$' for help]",
    "grblHAL": "GrblHAL 1.1f ['$' or '$HELP' for help]",
    "FluidNC": "Grbl 3.7 [FluidNC v3.7.8 (wifi) '$' for help]",
}
BUILD_INFO: dict[str, tuple[str, ...]] = {
    "grbl": ("[VER:1.1h.20190825:]", "[OPT:V,15,128]"),
    "grblHAL": (
        "[VER:1.1f.20240812:]",
        "[OPT:VNMSL,35,1024,3,0]",
        "[AXS:3:XYZ]",
        "[NEWOPT:ENUMS,RT+,HOME]",
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
_THREE_DECIMALS = {11, 12, 24, 25, 27} | {number for number in _DEFAULTS if number >= 100}
_FLAGS = {4, 5, 6, 13, 20, 21, 22, 32}
HOMING, HOMING_ONE_AXIS, HOMING_FIRST = 1, 2, 4  # bits of $22; the last two are grblHAL's


@dataclass
class Memory:
    """Survives resets and power loss, like the EEPROM."""

    settings: dict[int, float] = field(default_factory=lambda: dict(_DEFAULTS))
    startup: list[str] = field(default_factory=lambda: ["", ""])
    offsets: dict[str, NDArray[np.float64]] = field(
        default_factory=lambda: {f"G{number}": np.zeros(3) for number in range(54, 60)}
    )
    writes: int = 0  # the real one wears out after 100000

    def lines(self) -> list[str]:
        """The answer to `$$`."""
        return [
            f"${number}={value:.3f}" if number in _THREE_DECIMALS else f"${number}={value:.0f}"
            for number, value in self.settings.items()
        ]

    def store(self, number: int, value: float, dialect: DialectName = "grbl") -> int:
        """Write a setting; returns grbl's error number, 0 if it was taken."""
        if value < 0:
            return 4
        if number not in self.settings:
            return 3
        if number == 0 and value < 3:
            return 6
        if number == 20 and value and not self.settings[22]:
            return 10
        if number in _FLAGS and not (number == 22 and dialect == "grblHAL"):
            value = float(bool(value))
        elif number not in _THREE_DECIMALS:
            value = float(int(value))
        self.settings[number] = value
        if number == 22 and not value:
            self.settings[20] = 0.0
        self.writes += 1
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

    def line(self) -> str:
        """The answer to `$G`."""
        return f"[GC:{' '.join(self.codes.values())} T{self.tool} F{self.feed:g} S{self.speed:g}]"


class StatusReport(NamedTuple):
    """What a board knows when it is asked `?`."""

    state: str
    braking: bool  # a hold has not come to rest yet
    position: NDArray[np.float64]  # machine position [units]
    offset: NDArray[np.float64]  # work zero seen from machine zero [units]
    speed: float  # [units/s]
    laser_power: float
    free: tuple[int, int]  # blocks of the planner, bytes of the receive buffer

    def line(self, settings: dict[int, float], *, with_offset: bool, with_overrides: bool) -> str:
        """As `$10` and `$13` want it; offset and overrides come with some reports only, as on the real board."""
        mask = int(settings[10])
        inch = 25.4 if settings[13] else 1.0
        in_inches = bool(settings[13])
        fields = [f"{self.state}:{int(self.braking)}" if self.state == "Hold" else self.state]
        place = self.position - (0 if mask & 1 else self.offset)
        fields.append(("MPos:" if mask & 1 else "WPos:") + triple(place, in_inches))
        if mask & 2:
            fields.append(f"Bf:{self.free[0]},{self.free[1]}")
        fields.append(f"FS:{self.speed * 60 / inch:.0f},{self.laser_power:.0f}")
        if with_offset:
            fields.append("WCO:" + triple(self.offset, in_inches))
        elif with_overrides:
            fields.append("Ov:100,100,100" + ("|A:S" if self.laser_power else ""))
        return f"<{'|'.join(fields)}>"


def triple(values: NDArray[np.float64], in_inches: bool) -> str:
    """Three coordinates [units] as the board writes them: three decimals, or four of inches."""
    return ",".join(f"{value / 25.4:.4f}" if in_inches else f"{value:.3f}" for value in values)
