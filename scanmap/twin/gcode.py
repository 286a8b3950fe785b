"""Read a line of G-code as grbl 1.1 does: words, modal groups, and its error numbers.

Source: gnea/grbl, doc/markdown/commands.md and the error codes of doc/csv. Arcs, G28/G30, inverse time feed and
tool offsets, which a turning head never needs, are refused as unknown.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

_WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))")

MODAL_GROUPS: dict[str, tuple[str, ...]] = {
    "nonmodal": ("G4", "G10", "G53", "G92", "G92.1"),
    "motion": ("G0", "G1", "G38.2", "G80"),
    "plane": ("G17", "G18", "G19"),
    "distance": ("G90", "G91"),
    "arc distance": ("G91.1",),
    "feed": ("G94",),
    "units": ("G20", "G21"),
    "cutter": ("G40",),
    "tool length": ("G49",),
    "coordinates": ("G54", "G55", "G56", "G57", "G58", "G59"),
    "path": ("G61",),
    "stopping": ("M0", "M1", "M2", "M30"),
    "spindle": ("M3", "M4", "M5"),
    "coolant": ("M8", "M9"),
}
_GROUP_OF = {code: group for group, codes in MODAL_GROUPS.items() for code in codes}
_WITH_AXES = {"G10", "G92"}
MOST_LINES, MOST_TOOLS, PLACES = 9_999_999, 255, 6  # N, T, and P of G10
_VALUE_LETTERS = "FILNPRSTXYZJK"


class GcodeError(Exception):
    """A line that grbl would refuse."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass(frozen=True)
class Words:
    """A line taken apart: one code for each modal group, one value for each letter."""

    codes: dict[str, str] = field(default_factory=dict)  # modal group -> "G1"; G53 apart
    values: dict[str, float] = field(default_factory=dict)  # letter -> number
    in_machine_coordinates: bool = False  # G53

    @property
    def axes(self) -> dict[int, float]:
        """Axis number -> value."""
        return {"XYZ".index(letter): value for letter, value in self.values.items() if letter in "XYZ"}


def read_words(line: str) -> Words:
    """Take a line (upper case, no blanks, no comments) apart.

    Raises:
        GcodeError: with grbl's error number.
    """
    codes: dict[str, str] = {}
    values: dict[str, float] = {}
    g53 = False
    at = 0
    while at < len(line):
        if not line[at].isalpha():
            raise GcodeError(1)
        match = _WORD.match(line, at)
        if not match:
            raise GcodeError(2)
        at = match.end()
        letter, number = match[1], float(match[2])
        if letter in "GM":
            code = f"{letter}{number:g}"
            group = _GROUP_OF.get(code)
            if group is None:  # G1.5 is not whole, G7 is unknown
                raise GcodeError(23 if number % 1 and f"{letter}{int(number)}" in _GROUP_OF else 20)
            if code == "G53":
                g53 = True
            elif group in codes:
                raise GcodeError(21)
            else:
                codes[group] = code
        elif letter not in _VALUE_LETTERS:
            raise GcodeError(20)
        elif letter in values:
            raise GcodeError(25)
        else:
            values[letter] = number
    return _checked(Words(codes, values, g53))


def _checked(words: Words) -> Words:
    if any(words.values.get(letter, 0.0) < 0 for letter in "FNSTP"):
        raise GcodeError(4)
    if words.values.get("N", 0.0) > MOST_LINES:
        raise GcodeError(27)
    if words.values.get("T", 0.0) > MOST_TOOLS:
        raise GcodeError(38)
    nonmodal = words.codes.get("nonmodal")
    motion = words.codes.get("motion")
    if nonmodal in _WITH_AXES and motion and motion != "G80":
        raise GcodeError(24)
    if nonmodal == "G4" and "P" not in words.values:
        raise GcodeError(28)
    if nonmodal in _WITH_AXES and not words.axes:
        raise GcodeError(26)
    if nonmodal == "G10" and not {"P", "L"} <= set(words.values):
        raise GcodeError(28)
    if nonmodal == "G10" and words.values["P"] > PLACES:
        raise GcodeError(29)
    if nonmodal == "G10" and words.values["L"] not in (2, 20):
        raise GcodeError(20)
    if motion and motion.startswith("G38") and not words.axes:
        raise GcodeError(26)
    used = {"F", "S", "T", "N", "X", "Y", "Z"}
    used |= {"G4": {"P"}, "G10": {"P", "L"}}.get(nonmodal or "", set())
    if set(words.values) - used:
        raise GcodeError(36)
    return words
