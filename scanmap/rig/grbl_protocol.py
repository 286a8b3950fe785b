"""What GRBL boards say, read into values: banner, status report, settings, errors and alarms in words.

Pure functions of one line of text; noise gives `None`, never an exception. Covers grbl 1.1, grblHAL and
FluidNC. Source: gnea/grbl, doc/markdown/interface.md and doc/csv; grblHAL/core, errors.c and alarms.c;
bdring/FluidNC, Channel.cpp and Report.cpp.
"""

from __future__ import annotations

import math
import re
from enum import Enum
from typing import NamedTuple

# Real-time bytes: acted on at once, never queued, never answered by `ok`.
RESET = b"\x18"
JOG_CANCEL = b"\x85"

LINE_CHARACTERS = 79  # grbl's line buffer; its receive buffer of 128 bytes holds one line of ours at any time


class RealTime(NamedTuple):
    """Real-time bytes that have two names."""

    status: bytes = b"?"
    hold: bytes = b"!"
    resume: bytes = b"~"


OUT_OF_TEXT = RealTime(b"\x80", b"\x82", b"\x81")  # grblHAL's own, which no line can contain

ERRORS = {
    1: "a G-code word lost its letter",
    2: "a number is damaged or missing",
    3: "the board does not know this $ command",
    4: "a value must not be negative",
    5: "homing is off: set $22=1, or stage.homing = 'hand'",
    6: "the step pulse is shorter than 3 us: raise $0",
    7: "the settings memory was damaged and went back to defaults: check $100, $110, $120",
    8: "the board is busy: wait until it is idle",
    9: "the board is locked by an alarm: `scanmap stage home`",
    10: "$20=1 needs homing, $22=1",
    11: "the line is too long",
    12: "$100 times $110 is more steps per second than the board can make: lower the speed",
    13: "the safety door is open: close it, or tie its input",
    14: "the stored line is too long",
    15: "the jog would leave the travel set by $130",
    16: "the jog command is damaged",
    17: "laser mode needs a PWM output: set $32=0",
    20: "the board does not know this G-code",
    21: "two G-codes of one modal group in a line",
    22: "no feed rate: set stage.speed_deg_s",
    23: "a G-code needs a whole number",
    24: "two G-codes in a line want the axis word",
    25: "a G-code word came twice in a line",
    26: "an axis word is missing",
    27: "the line number is invalid",
    28: "a G-code lacks its P or L word",
    30: "G53 works only with G0 and G1",
    31: "an axis word is not used",
    33: "the target is invalid",
    36: "a word is not used",
    38: "the tool number is too large",
    45: "a limit switch is held: turn the head off it by hand",
    46: "the board must be homed first: stage.homing = 'switch', or switch off its homing lock ($22)",
    50: "the emergency stop is pressed: release it",
    51: "a motor driver reports a fault: check its power, heat and wiring",
    52: "a setting is out of the board's range",
    53: "the board has no such setting",
    79: "the board is halted by an alarm: `scanmap stage home`",
}

ALARMS = {
    1: "a limit switch was hit and the position is lost: free the head by hand, then `scanmap stage home`",
    2: "the target lies outside the board's own travel: raise $130 or set $20=0; the position is kept",
    3: "reset while moving, so the position is lost: `scanmap stage home`",
    4: "the index sensor was already triggered: turn the head off the mark and home again",
    5: "the index mark was not found: check the sensor, then home again",
    6: "homing was interrupted: home again",
    7: "the safety door opened while homing: close it and home again",
    8: "the limit switch did not release: raise $27 or check its wiring",
    9: "the limit switch was not found: check its wiring, $23, $130, and that the board homes X alone (docs/wiring.md)",
    10: "the emergency stop is pressed: release it, then `scanmap stage home`",
    11: "the board must be homed first: `scanmap stage home`",
    12: "a limit switch is held: turn the head off it by hand",
    13: "the probe input was touched: free it, then `scanmap stage home`",
    14: "the board's laser output did not answer, or it must be homed first: check its configuration",
    16: "the board's own test failed: switch it off and on",
    17: "a motor driver reports a fault: check its power, heat and wiring",
    18: "homing is set up wrongly on the board: check $22 to $27 and $44",
}


class Dialect(Enum):
    """Which firmware answers."""

    GRBL = "grbl"
    GRBLHAL = "grblHAL"
    FLUIDNC = "FluidNC"

    @property
    def has_numbered_settings(self) -> bool:
        """Whether `$100`, `$1`, `$32` exist; FluidNC keeps its machine in a YAML file instead."""
        return self is not Dialect.FLUIDNC


class Banner(NamedTuple):
    """What a board says after a reset."""

    dialect: Dialect
    version: str


class Status(NamedTuple):
    """A status report, `<Idle|MPos:...|...>`."""

    state: str  # Idle, Run, Jog, Hold, Door, Home, Alarm, Check, Sleep
    substate: int  # Hold:0 = stands still, Hold:1 = still braking; 0 if none is given
    position: tuple[float, ...]  # as reported: machine, or work coordinates if `is_work`
    is_work: bool
    work_offset: tuple[float, ...] | None  # only in some reports


_STARTUP_LIGHT = re.compile(r">.*M0*[34](?!\d).*:ok$")
_BANNER = re.compile(r"\bGrbl(?P<hal>HAL)? (?P<version>[\d.]+\w*) ?\[(?P<rest>[^\]]*)")
_CODE = re.compile(r"(?P<kind>error|ALARM): ?(?P<code>\d+)$")
_SETTING = re.compile(r"\$(?P<name>[\w/]+)=(?P<value>-?\d+(\.\d+)?)(?=$|\s)")
_STATES = {"Idle", "Run", "Jog", "Hold", "Door", "Home", "Alarm", "Check", "Sleep", "Tool"}


def parse_banner(line: str) -> Banner | None:
    """`Grbl 1.1h ['$' for help]`, `GrblHAL 1.1f [...]`, `Grbl 3.7 [FluidNC v3.7.8 ...]`."""
    match = _BANNER.search(line)
    if not match:
        return None
    if "FluidNC" in match["rest"]:
        return Banner(Dialect.FLUIDNC, match["version"])
    return Banner(Dialect.GRBLHAL if match["hal"] else Dialect.GRBL, match["version"])


def dialect_of_build_info(lines: list[str], otherwise: Dialect) -> Dialect:
    """The dialect told by the answer to `$I`, where it tells one: banners can be silenced or rebranded."""
    text = "\n".join(lines)
    if "FluidNC" in text:
        return Dialect.FLUIDNC
    return Dialect.GRBLHAL if "grblHAL" in text else otherwise


def real_time_of_build_info(lines: list[str]) -> RealTime:
    """Which real-time bytes to use: a grblHAL with `RT-` takes the printable ones for text inside `$` lines."""
    options = next((line for line in lines if line.startswith("[NEWOPT:")), "")
    return OUT_OF_TEXT if "RT-" in re.split(r"[:,\]]", options) else RealTime()


def is_greeting(line: str) -> bool:
    """Whether a board says this when it restarts; a damaged banner counts too."""
    return parse_banner(line) is not None or "for help]" in line


def lights_laser(line: str) -> bool:
    """Whether a board tells that one of its stored startup lines has just switched the laser on."""
    return _STARTUP_LIGHT.match(line) is not None


def writes_memory(line: str) -> bool:
    """Whether a board stores what this line says."""
    return re.match(r"\$(N\d)?\d*=", line) is not None


def parse_offsets(lines: list[str]) -> dict[str, tuple[float, ...]]:
    """The answer to `$#`: `[G54:4.000,0.000,0.000]` gives `{"G54": (4.0, 0.0, 0.0)}`."""
    pairs = (line[1:-1].split(":", 1) for line in lines if line.startswith("[") and line.endswith("]") and ":" in line)
    return {name: place for name, text in pairs if (place := _numbers(text)) is not None}


def parse_status(line: str) -> Status | None:
    """Read a status report; None if the line is not a whole one."""
    if not (line.startswith("<") and line.endswith(">")):
        return None
    state, *fields = line[1:-1].split("|")
    name, _, sub = state.partition(":")
    values = dict(field.split(":", 1) for field in fields if ":" in field)
    is_work = "WPos" in values
    position = _numbers(values.get("WPos" if is_work else "MPos", ""))
    if name not in _STATES or position is None or (sub and not sub.isdecimal()):
        return None
    return Status(name, int(sub or 0), position, is_work, _numbers(values.get("WCO", "")))


def parse_code(line: str) -> tuple[str, int] | None:
    """`("error", 9)` or `("ALARM", 1)`."""
    match = _CODE.match(line)
    return (match["kind"], int(match["code"])) if match else None


def parse_error(line: str) -> str | None:
    """A refusal in words; FluidNC says its own instead of a number where `verbose_errors` is set."""
    code = parse_code(line)
    if code:
        return explain(*code) if code[0] == "error" else None
    return line if line.startswith("error:") else None


def parse_setting(line: str) -> tuple[str, float] | None:
    """`$100=80.000` gives `("100", 80.0)`; comments of old versions are ignored."""
    match = _SETTING.match(line)
    return (match["name"], float(match["value"])) if match else None


def parse_probe(line: str) -> float | None:
    """X where the probe input closed, `[PRB:-12.500,0.000,0.000:1]`; None for one that did not close."""
    place, _, closed = line.removeprefix("[PRB:").partition(":")
    values = _numbers(place)
    return values[0] if values and line.startswith("[PRB:") and closed == "1]" else None


def explain(kind: str, code: int) -> str:
    """An error or alarm in words, with what to do."""
    words = (ERRORS if kind == "error" else ALARMS).get(code, "see the firmware's list of codes")
    return f"{kind}:{code}, {words}"


def _numbers(text: str) -> tuple[float, ...] | None:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        return None
    return values if all(math.isfinite(value) for value in values) else None
