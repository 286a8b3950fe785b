"""What can be changed while `scanmap live` runs, and the keys that do it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

from scanmap.laserline.grey import Grey

MODELS = ("plane", "ratio", "pixel_angle")
COLOURS = ("red", "green", "blue")
GREYS: tuple[Grey, ...] = get_args(Grey)
Model = Literal["plane", "ratio", "pixel_angle"]
Colour = Literal["red", "green", "blue"]


@dataclass(frozen=True)
class Knobs:
    """What can be changed while it runs."""

    grey: Grey
    bit_index: int
    row: int
    colour: Colour
    model: Model
    ended: bool = False

    def pressed(self, key: str, rows: int) -> Knobs:
        """What a key makes of it; keys without a meaning change nothing.

        Args:
            key: a character, or `up`, `down`.
            rows: height of the image.
        """
        if key in ("+", "-"):
            step = 1 if key == "+" else -1
            return replace(self, grey="bit_index", bit_index=min(24, max(0, self.bit_index + step)))
        if key in ("up", "k", "down", "j", "K", "J"):
            step = {"up": -1, "k": -1, "down": 1, "j": 1, "K": -10, "J": 10}[key]
            return replace(self, row=min(rows - 1, max(0, self.row + step)))
        if key in ("g", "G"):
            at = GREYS.index(self.grey) + (1 if key == "g" else -1)
            return replace(self, grey=GREYS[at % len(GREYS)])
        if key == "c":
            return replace(self, colour=_after(COLOURS, self.colour))
        if key == "m":
            return replace(self, model=_after(MODELS, self.model))
        return replace(self, ended=True) if key == "q" else self


HELP = "+ - bit index, g grey, up down (J K: ten) row, c colour, m model, q or Ctrl-C end"


def _after(choices: tuple[str, ...], one: str) -> Any:
    return choices[(choices.index(one) + 1) % len(choices)]
