"""Watch a sweep through its own pictures: did the head turn as far as its board says, does the laser still shine?

A board counts the steps it sends, not those that the motor makes. A picture that raises a doubt proves nothing yet
(a door may stand open, somebody may walk by); looking once more from the last trusted bearing does.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from math import degrees

from scanmap.errors import CameraError
from scanmap.shot import Shot
from scanmap.sweep.matching import Shift, same_line, shift_between

Lit = Callable[[bytes, bytes | None], float]  # share of rows that show the laser line, of a picture and its background

WAY_SHARE = 0.25  # of the way expected: nearness of things makes as much
LIT_BEFORE, LIT_NOW = 0.1, 0.01  # shares of rows between which a laser that shone is thought to be out
FARTHEST = 0.15  # of the picture's width: pictures farther apart have too little in common
FALSE_ALARMS = 3  # so many, and the pictures of this room are no witness


class Doubt(Enum):
    """What a picture makes one ask."""

    LASER = "no laser line where there was one"
    WAY = "the picture has not moved as far as the head is said to have turned"


class Watch:
    """What was seen last, to hold the next picture against.

    Args:
        px_per_rad: how far a picture moves when the head turns, about the focal length [px/rad].
        width: of the pictures [px].
        lit: tells how much of the laser line a picture shows; None where nobody can.
    """

    def __init__(self, px_per_rad: float, width: int, lit: Lit | None = None) -> None:
        self.px_per_rad = px_per_rad
        self._width = width
        self._lit = lit
        self._lit_before = 0.0
        self._lit_of: tuple[bytes, float] = (b"", 0.0)  # the last answer, for pictures are asked for it twice
        self._alarms = dict.fromkeys(Doubt, 0)
        self.first: Shot | None = None
        self.last: Shot | None = None  # whose bearing and laser are trusted
        self.never_lit = 0  # shots since the beginning, as long as none showed a line
        self.dark = False  # whether going without a line was looked into already

    def overlap(self, shift: Shift) -> bool:
        """Whether pictures so far apart have enough in common for the shift to be believed."""
        return abs(shift.columns_px) < FARTHEST * self._width

    def trust(self, shot: Shot) -> None:
        """The next shot will be held against this one."""
        self.first = self.first or shot
        if self._lit is not None:
            lit = self._share(shot)
            self.dark = lit < LIT_NOW
            self.never_lit = self.never_lit + 1 if self.dark and not self._lit_before else 0
            self._lit_before = self._lit_before if self.dark else lit
        self.last = shot

    def doubt(self, shot: Shot) -> Doubt | None:
        """What is odd about a shot; None where nothing is, or nothing can be told."""
        if self.last is None:
            return None
        if not self.dark and self._is_out(shot) and self._asks(Doubt.LASER):
            return Doubt.LASER
        if not self._asks(Doubt.WAY):
            return None
        expected = self.px_per_rad * (shot.bearing - self.last.bearing)
        shift = self.shift(self.last, shot)
        if shift is None or not self.overlap(shift) or abs(expected) >= FARTHEST * self._width:
            return None
        slack = max(WAY_SHARE * abs(expected), shift.slack_px)
        return Doubt.WAY if abs(shift.columns_px - expected) > slack else None

    def confirms(self, doubt: Doubt, again: Shot) -> str:
        """What another look from the last trusted bearing says of a doubt: what is wrong, in words; or nothing."""
        if self.last is None:
            return ""
        if doubt is Doubt.LASER:
            return "the laser is out" if self._is_out(again) else ""
        return self.displaced(self.last, again)

    def displaced(self, shot: Shot, again: Shot) -> str:
        """By how much the head stands elsewhere than for an earlier shot of this bearing; empty where it does not."""
        shift = self.shift(shot, again)
        if shift is None or not shift.is_proved:
            return ""
        return (
            f"the picture at {degrees(again.bearing):.2f} deg is shifted by {shift.columns_px:.1f} px, the head off by "
            f"about {degrees(shift.columns_px / self.px_per_rad):.2f} deg"
        )

    def came_back(self, again: Shot) -> bool:
        """Whether the head, shot again at its first bearing, has left its last: False only where that is proved.

        The line is not asked: where it is faint, noise is the brightest thing.
        """
        if self.first is None or self.last is None or self.first is self.last:
            return True
        begun, left = self.shift(self.first, again), self.shift(self.last, again)
        return left is None or not left.is_small or (begun is not None and begun.is_small)

    def stands(self, shot: Shot, elsewhere: Shot) -> bool:
        """Whether two shots that are said to be far apart show the same: room and line in the same place."""
        shift = self.shift(shot, elsewhere)
        if shift is None or not shift.is_small:
            return False
        try:
            return same_line(shot.image, elsewhere.image)
        except CameraError:
            return False

    def pardon(self, doubt: Doubt) -> None:
        """It was a false alarm; after a few the pictures of this room are asked no more."""
        self._alarms[doubt] += 1

    def _asks(self, doubt: Doubt) -> bool:
        return self._alarms[doubt] < FALSE_ALARMS

    def _is_out(self, shot: Shot) -> bool:
        return self._lit_before > LIT_BEFORE and self._share(shot) < LIT_NOW

    def _share(self, shot: Shot) -> float:
        if self._lit is None:
            return 1.0
        if self._lit_of[0] is not shot.image:
            self._lit_of = shot.image, self._lit(shot.image, shot.background)
        return self._lit_of[1]

    @staticmethod
    def shift(before: Shot, after: Shot) -> Shift | None:
        """Shift of a shot's room; None where it cannot be told."""
        try:
            if before.background is not None and after.background is not None:
                shift = shift_between(before.background, after.background)
            else:
                shift = shift_between(before.image, after.image)
        except CameraError:
            return None
        return shift if shift.is_sure else None
