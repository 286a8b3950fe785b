"""Which shots of a sweep are proved, and what is done about a doubt: look again, home again, withdraw.

A shot is proved when its picture shows that the head turned as far from the last proved one as it is said to. Where
pictures cannot tell, shots stay open until the head, back where it began, is seen to stand as it stood. When the head
turns out to have lost its place, the open ones are withdrawn and taken again: now, if it finds its place by itself,
else when the scan is resumed.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from scanmap.errors import StageError
from scanmap.rig import Rig
from scanmap.shot import Shot, Withdrawal
from scanmap.sweep.planning import Plan
from scanmap.sweep.watching import WITNESSES, Doubt, Verdict, Watch

FAR_RAD = math.radians(50.0)  # from there everything looks different
SAME_SHARE = 0.25  # by which two measures of one slip may differ: nearness of things
NEVER_LIT_SHOTS = 5
NEVER_LIT = f"no laser line in any of the first {NEVER_LIT_SHOTS} shots: is the laser on, the room within reach?"
CHECK_IT = "check its coupling, driver current and speed, set it to its home, then scanmap scan --resume"

logger = logging.getLogger(__name__)

Withdraw = Callable[[Collection[int], Withdrawal], None]  # told of shots that cannot be trusted, and why


@runtime_checkable
class Homable(Protocol):
    """A stage that can find its own zero again."""

    @property
    def homes_itself(self) -> bool:
        """Whether a switch or an index mark tells it where it stands; False for one set by hand."""
        ...

    def home(self) -> float:
        """Find the zero; returns the bearing reported then [rad]. Raises StageError."""
        ...


@dataclass(frozen=True)
class Place:
    """A shot to be taken."""

    index: int
    bearing: float  # [rad]


class Proof:
    """The proof of one sweep's shots; without a watch everything is believed.

    Args:
        shoot: takes the shot of a place; raises StageError, CameraError.
        note: told of every fault that was overcome.
        withdraw: told of shots that cannot be trusted.
    """

    def __init__(
        self,
        rig: Rig,
        planned: Plan,
        watch: Watch | None,
        shoot: Callable[[Place], Shot],
        note: Callable[[str], None],
        withdraw: Withdraw,
    ) -> None:
        self._rig = rig
        self._watch = watch
        self._shoot = shoot
        self._note = note
        self._withdraw = withdraw
        self._park = planned.params.park and len(planned.bearings) > 1
        self._low, self._high = float(planned.bearings.min()), float(planned.bearings.max())
        self.rehomings_left = planned.params.rehomings
        self._taken: list[Place] = []  # every shot so far that was not withdrawn
        self._open: list[Place] = []  # of these, the ones that nothing proves yet
        self._again: list[Place] = []  # withdrawn ones of a head that knows its place again

    def confirmed(self, shot: Shot) -> Shot:
        """The shot, if its picture raises no doubt; else what another look settles.

        Raises:
            StageError: the head has lost its place or the laser is out; the shots that this spoils are withdrawn.
        """
        watch = self._watch
        if watch is None:
            return shot
        verdict, place = watch.judge(shot), Place(shot.index, shot.bearing_commanded)
        if verdict.doubt is not None:
            shot, verdict = self._settled(verdict.doubt, shot)
        self._taken.append(place)
        if self._open or not (verdict.is_proved or watch.first is None):
            self._open.append(place)
        watch.trust(shot)
        if watch.never_lit == NEVER_LIT_SHOTS:
            logger.warning(NEVER_LIT)
            self._note(NEVER_LIT)
        return shot

    def take_again(self) -> list[Place]:
        """Shots that were withdrawn and can be taken again now; each is named once."""
        again, self._again = self._again, []
        return again

    def look_back(self) -> None:
        """At the end, from where the sweep began and from where the line was brightest: is all as it was?

        Raises:
            StageError: it is not, and the head cannot home itself.
        """
        watch = self._watch
        if watch is None or watch.first is None:
            return
        if watch.unlit and watch.brightest is not None:
            self._look_for_the_line(watch, watch.brightest)
        if self._park:
            self._look_from_the_beginning(watch, watch.first)

    def _look_for_the_line(self, watch: Watch, best: Shot) -> None:
        again = self._look(best)
        if not watch.is_laser_out(again):
            return
        if watch.last is None or not (wrong := self._why_dark(best, again, watch.last)):
            self._withdraw(watch.unlit, Withdrawal.LINE)
            raise self._laser_out(best)
        unlit = [place for place in self._taken if place.index in watch.unlit]
        self._lost_place([*unlit, *self._suspects(watch, watch.last, again)], _off_the_board(wrong))

    def _look_from_the_beginning(self, watch: Watch, first: Shot) -> None:
        again = self._look(first)
        off_px = watch.displaced_px(first, again)
        wrong = watch.words(off_px, again)
        since_last = False
        if not watch.came_back(again):
            wrong = "told to go back to where it began, it still shows what it saw last, the motor stalled"
            since_last = not self._open
        elif off_px:
            since_last = self._is_off_since_last(watch, first, off_px)
        elif self._open and watch.shift(first, again) is None:
            wrong = self._moved_lines(watch)
        if not wrong or since_last:
            self._open.clear()
            if wrong:
                self._note(f"on its way back after the last shot the head lost its place: {wrong}")
            return
        # Every link may have been a little too short, so that each seemed proved.
        spoiled = self._open or self._taken[1:]
        self._lost_place(
            spoiled,
            StageError(
                f"the head has lost its place in the course of the scan: {wrong}; {len(spoiled)} shots cannot be "
                f"trusted and are left out: {CHECK_IT}"
            ),
        )

    def _moved_lines(self, watch: Watch) -> str:
        """Where the room is too dark or plain to be matched: what the laser line says, in words; else empty."""
        if watch.last is None or len(watch.telling) < WITNESSES:
            return ""
        noise_dn = watch.line_change(watch.last, self._look(watch.last))  # of going away and coming back
        moved = [shot for shot in watch.telling if watch.has_moved(shot, self._look(shot), noise_dn)]
        if len(moved) < WITNESSES:
            return ""
        places = " and ".join(f"{math.degrees(shot.bearing):.2f}" for shot in moved)
        return f"the laser line at {places} deg is not where it was"

    def _is_off_since_last(self, watch: Watch, first: Shot, off_px: float) -> bool:
        """Whether a head that is off at its first bearing is off at its last by just as much, and goes no farther off.

        Then the last shot was taken before, and so were all.
        """
        if watch.last is None or watch.last is first:
            return False
        others = [watch.displaced_px(shot, self._look(shot)) for shot in (watch.last, first)]
        return all(other and abs(other - off_px) < SAME_SHARE * abs(off_px) for other in others)

    def home_again(self, error: StageError) -> None:
        """Let a stage that can do so find its place after a fault; else raise the fault."""
        stage = self._rig.stage
        if not (isinstance(stage, Homable) and stage.homes_itself and self.rehomings_left):
            raise error
        self.rehomings_left -= 1
        logger.warning("%s; homing again (%d more times at most)", error, self.rehomings_left)
        self._note(f"{error}; the head was homed again")
        stage.home()

    def _settled(self, doubt: Doubt, shot: Shot) -> tuple[Shot, Verdict]:
        """The shot as it is to be believed after another look, and what proves it."""
        watch = self._watch
        assert watch is not None
        trusted = watch.reference(shot)
        assert trusted is not None
        logger.info("shot %d: %s; looking again from %.2f deg", shot.index, doubt.value, math.degrees(trusted.bearing))
        rehomings_left = self.rehomings_left
        again = self._look(trusted)
        if doubt is not Doubt.LASER:
            wrong = self._what_is_wrong(trusted, again, shot)
        elif not watch.is_laser_out(again):
            watch.pardon(doubt)
            # A loose contact puts the laser out for one picture only; where there is no line, the first will do.
            other = self._look(shot)
            return (shot if watch.is_laser_out(other) else other), Verdict(is_proved=watch.agrees(shot, other))
        elif not (wrong := self._why_dark(trusted, again, shot)):
            raise self._laser_out(trusted)
        while wrong:
            self._lost_place(self._suspects(watch, trusted, shot), _off_the_board(wrong))
            trusted = watch.reference(shot) or trusted
            again = self._look(trusted)
            wrong = self._what_is_wrong(trusted, again, shot)
        watch.pardon(doubt)
        proved = watch.agrees(trusted, again)
        if self.rehomings_left == rehomings_left and doubt is not Doubt.STILL and not watch.is_torn(shot):
            return shot, Verdict(is_proved=proved)
        return self._look(shot), Verdict(is_proved=proved)

    def _what_is_wrong(self, trusted: Shot, again: Shot, shot: Shot) -> str:
        """What another look from the trusted bearing says, in words; empty where the head is well."""
        watch = self._watch
        assert watch is not None
        wrong = watch.words(watch.displaced_px(trusted, again), again)
        if wrong or not watch.same(again, shot):
            return wrong
        # A head that never moves is always found where it was left: only from far away can it be told.
        away = FAR_RAD if self._high - trusted.bearing > trusted.bearing - self._low else -FAR_RAD
        for part in (0.4, 1.0):
            there = min(max(trusted.bearing_commanded + part * away, self._low), self._high)
            if not watch.same(again, self._shoot(Place(trusted.index, there))):
                return ""
        return "the picture does not change, however far it is told to turn"

    def _why_dark(self, lit: Shot, again: Shot, shot: Shot) -> str:
        """What is wrong with the head where another look shows no line; empty where it is the laser."""
        watch = self._watch
        # With a dead laser a dark room looks the same from everywhere; that proves nothing against the motor.
        return "" if watch is None or watch.shows_nothing(again) else self._what_is_wrong(lit, again, shot)

    def _suspects(self, watch: Watch, trusted: Shot, shot: Shot) -> list[Place]:
        """The open shots, and those that a place lost since the trusted one spoils."""
        after = (Place(late.index, late.bearing_commanded) for late in watch.suspects(trusted, shot) if late.index >= 0)
        return [*self._open, *after]

    def _look(self, shot: Shot) -> Shot:
        return self._shoot(Place(shot.index, shot.bearing_commanded))

    def _lost_place(self, spoiled: Iterable[Place], error: StageError) -> None:
        """Withdraw what cannot be trusted; home again where that is possible, else raise."""
        lost = {place.index: place for place in spoiled}
        if lost:
            self._withdraw(lost.keys(), Withdrawal.PLACE)
        if self._watch is not None:
            self._watch.forget(lost.keys())
        self._taken = [place for place in self._taken if place.index not in lost]
        self._open.clear()
        self.home_again(error)
        self._again += lost.values()

    def _laser_out(self, lit: Shot) -> StageError:
        return StageError(
            f"the laser has gone out: no line at {math.degrees(lit.bearing):.2f} deg, where there was one; "
            "check its supply and wiring, then go on with scanmap scan --resume"
        )


def _off_the_board(wrong: str) -> StageError:
    return StageError(
        f"the head is not where its board says, for steps were lost or the motor stalled: {wrong}; {CHECK_IT}"
    )
