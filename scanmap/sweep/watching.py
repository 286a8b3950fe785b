"""Watch a sweep through its own pictures: did the head turn as far as its board says, does the laser still shine?

A board counts the steps it sends, not those that the motor makes. A picture that raises a doubt proves nothing yet
(a door may stand open, somebody may walk by); looking once more from the last trusted bearing does.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection
from enum import Enum
from math import degrees
from typing import NamedTuple

from scanmap.errors import CameraError
from scanmap.shot import Shot
from scanmap.sweep.matching import Shift, contrast, difference, line_difference, scale_of, shift_between

Lit = Callable[[bytes, bytes | None], float]  # share of rows that show the laser line, of a picture and its background

WAY_SHARE = 0.25  # of the way expected: nearness of things makes as much
LIT_BEFORE, LIT_NOW = 0.1, 0.01  # shares of rows between which a laser that shone is thought to be out
FARTHEST = 0.15  # of the picture's width: pictures farther apart have too little in common
REACH_PX = 8.0  # [px of the small pictures] what lies nearer together shows too little of a turn
SAME_NOISE, SAME_DN = 1.5, 0.05  # of the difference that noise makes, [grey levels]: pictures of one place have less
TELLING = 5.0  # times the noise: so much a turn must change the line, to tell one place from the other
WITNESSES = 2  # such places, far apart: somebody may stand in the one or the other
FALSE_ALARMS = 3  # so many, and the pictures of this room are no witness


class Doubt(Enum):
    """What a picture makes one ask."""

    LASER = "no laser line where there was one"
    WAY = "the picture has not moved as far as the head is said to have turned"
    STILL = "the picture shows what another bearing showed"


class Verdict(NamedTuple):
    """What a picture says of its shot."""

    doubt: Doubt | None = None
    is_proved: bool = False  # it shows that the head turned as far as it is said to


class Watch:
    """What was seen last, to hold the next picture against.

    Args:
        px_per_rad: how far a picture moves when the head turns, about the focal length [px/rad].
        width: of the pictures [px].
        lit: tells how much of the laser line a picture shows; None where nobody can.
        slack_rad: how far off a bearing may be where nothing is wrong: that of a picture taken while the head turns.
        latency_rad: how far off against pictures of a head that stands.
    """

    def __init__(
        self,
        px_per_rad: float,
        width: int,
        lit: Lit | None = None,
        slack_rad: float = 0.0,
        latency_rad: float = 0.0,
    ) -> None:
        self.px_per_rad = px_per_rad
        self._width = width
        self._lit = lit
        self._slack_px = slack_rad * px_per_rad
        self._latency_px = latency_rad * px_per_rad
        self._lit_before = 0.0
        self._lit_of: tuple[bytes, float] = (b"", 0.0)  # the last answer, for pictures are asked for it twice
        self._alarms = dict.fromkeys(Doubt, 0)
        self._recent: deque[Shot] = deque()  # trusted, the newest last
        self._standing: Shot | None = None
        self._noise_dn: float | None = None  # by which two pictures of one place differ
        self._line_noise_dn = 0.0  # the same, of what is sharp in them
        self._telling: list[tuple[float, Shot]] = []  # by how much the turn there changed the line [grey levels]
        self.first: Shot | None = None
        self.brightest: Shot | None = None  # that showed most of the line
        self._most_lit = 0.0
        self.never_lit = 0  # shots since the beginning, as long as none showed a line
        self.unlit: list[int] = []  # indices of the shots since the last that showed the line
        self.dark = False  # whether going without a line was looked into already

    @property
    def last(self) -> Shot | None:
        """The newest shot whose bearing and laser are trusted."""
        return self._recent[-1] if self._recent else None

    @property
    def knows_noise(self) -> bool:
        """Whether `learn` was called."""
        return self._noise_dn is not None

    def learn(self, image: bytes, again: bytes) -> None:
        """Two pictures of one place, moments apart: so much differs where nothing has changed."""
        try:
            self._noise_dn, self._line_noise_dn = difference(image, again), line_difference(image, again)
        except CameraError:
            self._noise_dn = 0.0

    def overlap(self, shift: Shift) -> bool:
        """Whether pictures so far apart have enough in common for the shift to be believed."""
        return abs(shift.columns_px) < FARTHEST * self._width

    def stand_from(self, shot: Shot) -> None:
        """A look that is no shot of the sweep: the first shot will be held against it."""
        self._standing = shot
        self._recent.append(shot)

    def trust(self, shot: Shot) -> None:
        """The next shots will be held against this one."""
        self.first = self.first or shot
        if self._lit is not None:
            lit = self._share(shot)
            self.dark = lit < LIT_NOW
            self.never_lit = self.never_lit + 1 if self.dark and not self._lit_before else 0
            self._lit_before = self._lit_before if self.dark else lit
            self.unlit = [*self.unlit, shot.index] if self.dark else []
            if lit > self._most_lit:
                self._most_lit, self.brightest = lit, shot
        self._keep_if_telling(shot)
        self._recent.append(shot)
        # Of those farther back than a turn that shows, one is enough.
        while len(self._recent) > 2 and self._turned_px(self._recent[1], shot) >= self._reach_px:
            self._recent.popleft()

    @property
    def telling(self) -> list[Shot]:
        """Early shots, far apart, whose line tells whether the head stands where it stood; one, or none, at times."""
        return [shot for _, shot in self._telling]

    def has_moved(self, shot: Shot, again: Shot, noise_dn: float) -> bool:
        """Whether the line of another look at one of the telling shots is another one, against the noise of a look."""
        turn_dn = next(turn_dn for turn_dn, telling in self._telling if telling is shot)
        change_dn = self.line_change(shot, again) - noise_dn
        return turn_dn > TELLING * noise_dn and change_dn > WAY_SHARE * (turn_dn - noise_dn)

    def _keep_if_telling(self, shot: Shot) -> None:
        before = self.reference(shot)
        if before is None or len(self._telling) == WITNESSES or self._turned_px(before, shot) < self._reach_px / 2:
            return
        turn_dn = self.line_change(before, shot)
        is_far = all(self._turned_px(other, shot) > FARTHEST * self._width for other in self.telling)
        if is_far and self._line_noise_dn and turn_dn > TELLING * self._line_noise_dn:
            self._telling.append((turn_dn, shot))

    @staticmethod
    def line_change(before: Shot, after: Shot) -> float:
        """By how much the laser lines of two shots differ [grey levels, rms]."""
        try:
            return line_difference(before.image, after.image)
        except CameraError:
            return 0.0

    def reference(self, shot: Shot) -> Shot | None:
        """What a shot is held against: the newest trusted one that is far enough from it to show a turn."""
        for before in reversed(self._recent):
            if self._turned_px(before, shot) >= self._reach_px:
                return before
        return self._recent[0] if self._recent else None

    def suspects(self, reference: Shot, shot: Shot) -> list[Shot]:
        """Trusted shots that are spoiled where the head lost its place between a shot and what that was held against.

        A head that has not moved since the reference may have come to a stand on its way there, and so near that nobody
        doubted: shots that show the same belong to them, but not the first, for something must be left to go on from.
        """
        recent = list(self._recent)
        begin = recent.index(reference) + 1 if reference in recent else len(recent)
        while begin and recent[begin - 1] not in (self.first, self._standing) and self.same(recent[begin - 1], shot):
            begin -= 1
        return recent[begin:]

    def forget(self, indices: Collection[int]) -> None:
        """Shots with these indices are trusted no more: nothing is held against them."""
        self._recent = deque(shot for shot in self._recent if shot.index not in indices)
        if self.first is not None and not self._recent:
            self._recent.append(self.first)
        self.unlit = [index for index in self.unlit if index not in indices]
        self._telling = [entry for entry in self._telling if entry[1].index not in indices]
        if self.brightest is not None and self.brightest.index in indices:
            self.brightest, self._most_lit = None, 0.0

    def judge(self, shot: Shot) -> Verdict:
        """What is odd about a shot; nothing where nothing is, or nothing can be told."""
        reference = self.reference(shot)
        if reference is None:
            return Verdict()
        if not self.dark and self._is_out(shot) and self._asks(Doubt.LASER):
            return Verdict(Doubt.LASER)
        if self.is_torn(shot):
            return Verdict(Doubt.WAY if self._asks(Doubt.WAY) else None)
        expected = self._expected_px(reference, shot)
        if abs(expected) > REACH_PX / 2 * self._scale and self.same(reference, shot) and self._asks(Doubt.STILL):
            return Verdict(Doubt.STILL)
        shift = self.shift(reference, shot)
        if shift is None or not self.overlap(shift) or abs(expected) >= FARTHEST * self._width:
            return Verdict()
        slack = max(WAY_SHARE * abs(expected), shift.slack_px) + self._slack_against(reference)
        if abs(shift.columns_px - expected) <= slack:
            return Verdict(is_proved=True)
        return Verdict(Doubt.WAY if self._asks(Doubt.WAY) else None)

    def is_laser_out(self, again: Shot) -> bool:
        """Whether another look from a bearing that showed the line shows none."""
        return max(self._lit_before, self._most_lit) > LIT_BEFORE and self._share(again) < LIT_NOW

    def displaced_px(self, shot: Shot, again: Shot) -> float:
        """How far the head stands from where it stood for an earlier shot [px]; 0 where that is not proved."""
        shift = self.shift(shot, again)
        if shift is None or not shift.is_proved:
            return 0.0
        off_px = shift.columns_px - self._expected_px(shot, again)
        return off_px if abs(off_px) > shift.slack_px + 2.0 * self._slack_against(shot) else 0.0

    def words(self, off_px: float, again: Shot) -> str:
        """What such a picture shows; empty where it shows nothing wrong."""
        if not off_px:
            return ""
        return (
            f"the picture at {degrees(again.bearing):.2f} deg is shifted by {off_px:.1f} px, the head off by "
            f"about {degrees(off_px / self.px_per_rad):.2f} deg"
        )

    def agrees(self, shot: Shot, again: Shot) -> bool:
        """Whether another look from a shot's bearing proves that the head stands where it stood then."""
        shift = self.shift(shot, again)
        if shift is None:
            return self.same(shot, again)
        return abs(shift.columns_px - self._expected_px(shot, again)) <= shift.slack_px + 2.0 * self._slack_against(
            shot
        )

    def came_back(self, again: Shot) -> bool:
        """Whether the head, shot again at its first bearing, has left its last: False only where that is proved."""
        last = self.last
        if self.first is None or last is None or self._turned_px(last, self.first) < self._reach_px:
            return True
        return not self.same(last, again) or self.same(self.first, again)

    def same(self, shot: Shot, elsewhere: Shot) -> bool:
        """Whether two shots differ by no more than noise: they show one place, or nothing at all."""
        try:
            return difference(shot.image, elsewhere.image) <= SAME_NOISE * (self._noise_dn or 0.0) + SAME_DN
        except CameraError:
            return False

    def shows_nothing(self, shot: Shot) -> bool:
        """Whether a picture is dark, or plain, but for noise: then no other looks different."""
        try:
            return contrast(shot.image) <= SAME_NOISE * (self._noise_dn or 0.0) + SAME_DN
        except CameraError:
            return True

    def is_torn(self, shot: Shot) -> bool:
        """Whether the head has moved between the two pictures of a shot."""
        if shot.background is None or shot.background is shot.image:
            return False
        try:
            shift = shift_between(shot.background, shot.image)
        except CameraError:
            return False
        return shift.is_sure and shift.is_proved

    def pardon(self, doubt: Doubt) -> None:
        """It was a false alarm; after a few the pictures of this room are asked no more."""
        self._alarms[doubt] += 1

    def _asks(self, doubt: Doubt) -> bool:
        return self._alarms[doubt] < FALSE_ALARMS

    @property
    def _scale(self) -> float:
        return scale_of(self._width)

    @property
    def _reach_px(self) -> float:
        return REACH_PX * self._scale

    def _slack_against(self, shot: Shot) -> float:
        return self._latency_px if shot is self._standing else self._slack_px

    def _expected_px(self, before: Shot, after: Shot) -> float:
        """How far the picture of a far room moves from one shot to another."""
        return self.px_per_rad * (after.bearing - before.bearing)

    def _turned_px(self, before: Shot, after: Shot) -> float:
        return abs(self._expected_px(before, after))

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
