"""A sweep in steps: stop, settle, shoot; and what to do when the head has lost its place or the laser went out."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import CameraError, ConfigError, StageError
from scanmap.rig import Camera, Exposing, Frame, Rig, Streaming
from scanmap.shot import Shot
from scanmap.sweep.planning import Plan
from scanmap.sweep.watching import Doubt, Watch

STILL_RAD = math.radians(0.01)  # a head that stands is reported at one place
FAR_RAD = math.radians(50.0)  # from there everything looks different
NEVER_LIT_SHOTS = 5
NEVER_LIT = f"no laser line in any of the first {NEVER_LIT_SHOTS} shots: is the laser on, the room within reach?"

logger = logging.getLogger(__name__)

Refine = Callable[[], NDArray[np.float64]]  # further bearings [rad], asked for after an adaptive sweep's first pass


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


@runtime_checkable
class Settable(Protocol):
    """A stage that can be told where it stands."""

    def stand_at(self, bearing: float) -> None:
        """From now on the head's present place is `bearing` [rad]. Raises StageError."""
        ...


class Steps:
    """One sweep in steps."""

    def __init__(
        self,
        rig: Rig,
        planned: Plan,
        sleep: Callable[[float], None],
        watch: Watch | None = None,
        note: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._note = note
        self._rig = rig
        self._planned = planned
        self._params = planned.params
        self._sleep = sleep
        self._watch = watch
        self._rehomings_left = planned.params.rehomings
        self._seen: tuple[bytes, float] = (b"", 0.0)  # the last picture, and where it was taken
        self._exposure_us: float | None = None  # as last asked for

    def shots(self, stop: Callable[[], bool], refine: Refine | None, done: Collection[int]) -> Iterator[Shot]:
        """Every shot of the plan but those `done`; then what `refine` asks for, on the way back."""
        bearings = self._planned.bearings
        yield from self._visit(enumerate(bearings.tolist()), stop, done)
        if self._params.mode == "adaptive" and refine is not None and not stop():
            further = np.sort(refine())
            on_the_way_back = further if bearings[-1] < bearings[0] else further[::-1]
            yield from self._visit(enumerate(on_the_way_back.tolist(), len(bearings)), stop, done)
        if not stop():
            self._look_back()

    def _visit(
        self, places: Iterable[tuple[int, float]], stop: Callable[[], bool], done: Collection[int]
    ) -> Iterator[Shot]:
        for index, bearing in places:
            if index in done:
                continue
            if stop():
                return
            shot = self._confirmed(self.shoot(index, bearing))
            if self._watch is not None:
                self._watch.trust(shot)
                if self._watch.never_lit == NEVER_LIT_SHOTS:
                    logger.warning(NEVER_LIT)
                    self._note(NEVER_LIT)
            yield shot

    def shoot(self, index: int, bearing: float) -> Shot:
        """Turn there and take the picture; a head that lost its place is homed again where it can be.

        Raises:
            StageError, CameraError: no way to get it.
        """
        while True:
            try:
                reported = self._rig.stage.move_to(bearing)
                if self._params.settle_s:
                    self._sleep(self._params.settle_s)
                self._expose(index)
                frame, background = self._take()
                self._check_alive(frame.image, background, reported)
                after = self._rig.stage.where()
                if abs(after - reported) > STILL_RAD:
                    raise StageError(
                        f"the head moved from {math.degrees(reported):.3f} to {math.degrees(after):.3f} deg while a "
                        "picture was taken: check its power supply and whether something pushes it"
                    )
            except StageError as error:
                self._home_again(error)
                continue
            return Shot(index, reported, bearing, frame.time, frame.image, background)

    def look(self) -> Shot:
        """A picture from where the head stands; nothing turns. Raises StageError, CameraError."""
        frame, background = self._take()
        here = self._rig.stage.where()
        return Shot(0, here, here, frame.time, frame.image, background)

    def _confirmed(self, shot: Shot) -> Shot:
        """The shot, if its picture raises no doubt; else what another look settles."""
        watch = self._watch
        doubt = watch.doubt(shot) if watch is not None else None
        if watch is None or doubt is None or watch.last is None:
            return shot
        logger.info("shot %d: %s; looking again from the last bearing", shot.index, doubt.value)
        trusted, rehomings_left = watch.last, self._rehomings_left
        while wrong := self._what_is_wrong(watch, doubt, trusted, shot):
            if doubt is Doubt.LASER:
                raise StageError(
                    f"the laser has gone out: no line at {math.degrees(trusted.bearing):.2f} deg, where there was one; "
                    "check its supply and wiring, then go on with scanmap scan --resume"
                )
            self._home_again(
                StageError(
                    f"the head is not where its board says, for steps were lost or the motor stalled: {wrong}; check "
                    "its coupling, driver current and speed, set it to its home, then scanmap scan --resume"
                )
            )
        watch.pardon(doubt)
        if doubt is Doubt.WAY and self._rehomings_left == rehomings_left:
            return shot
        again = self.shoot(shot.index, shot.bearing_commanded)
        # A loose contact puts the laser out for one picture only; where there is no line, the first picture will do.
        return shot if doubt is Doubt.LASER and watch.confirms(doubt, again) else again

    def _what_is_wrong(self, watch: Watch, doubt: Doubt, trusted: Shot, shot: Shot) -> str:
        """What further looks say of a doubt, in words; empty where the head and the laser are well."""
        again = self.shoot(trusted.index, trusted.bearing_commanded)
        wrong = watch.confirms(doubt, again)
        if wrong or doubt is not Doubt.WAY or not watch.stands(again, shot):
            return wrong
        # A head that never moves is always found where it was left: only from far away can it be told.
        low, high = float(self._planned.bearings.min()), float(self._planned.bearings.max())
        away = FAR_RAD if high - trusted.bearing > trusted.bearing - low else -FAR_RAD
        for part in (0.4, 1.0):
            there = min(max(trusted.bearing_commanded + part * away, low), high)
            if not watch.stands(again, self.shoot(trusted.index, there)):
                return ""
        return "the picture does not change, however far it is told to turn"

    def _look_back(self) -> None:
        """At the end, from where the sweep began: has the head lost its place on the way?"""
        first = self._watch.first if self._watch is not None else None
        if self._watch is None or first is None or not self._params.park or len(self._planned.bearings) < 2:
            return
        again = self.shoot(first.index, first.bearing_commanded)
        wrong = self._watch.displaced(first, again)
        if not self._watch.came_back(again):
            wrong = "told to go back to where it began, it still shows what it saw last, the motor stalled"
        if wrong:
            raise StageError(
                f"the head has lost its place in the course of the scan: {wrong}; its bearings cannot be trusted: "
                "check its coupling, driver current and speed, and scan again"
            )

    def _home_again(self, error: StageError) -> None:
        """Let a stage that can do so find its place after a fault; else the fault it is."""
        stage = self._rig.stage
        if not (isinstance(stage, Homable) and stage.homes_itself and self._rehomings_left):
            raise error
        self._rehomings_left -= 1
        logger.warning("%s; homing again (%d more times at most)", error, self._rehomings_left)
        self._note(f"{error}; the head was homed again")
        stage.home()

    def _expose(self, index: int) -> None:
        """Change the exposure where another pass begins."""
        wanted = self._planned.exposure_us(self._planned.pass_of(index))
        if wanted is not None and wanted != self._exposure_us:
            expose(self._rig.camera, wanted)
            self._exposure_us = wanted

    def _check_alive(self, image: bytes, background: bytes | None, bearing: float) -> None:
        """Raise CameraError where a picture is, to the last bit, one from elsewhere or with the laser off."""
        before, self._seen = self._seen, (image, bearing)
        if image == background or (image == before[0] and abs(bearing - before[1]) > STILL_RAD):
            raise CameraError(
                "the camera sends the same picture again and again: it is frozen, plug it in anew; `scanmap doctor` "
                "shows what it delivers, scanmap scan --resume goes on"
            )

    def _take(self) -> tuple[Frame, bytes | None]:
        """A frame with the laser on and, if asked for and possible, one with it off, taken just before."""
        stage, retries, background = self._rig.stage, self._params.retries, None
        if self._params.off_frames and stage.laser_switchable:
            stage.laser(False)
            background = grab(self._rig.camera, retries, self._note).image
        stage.laser(True)
        return grab(self._rig.camera, retries, self._note), background


def expose(camera: Camera, exposure_us: float) -> None:
    """Change the exposure of a camera.

    Raises:
        ConfigError: this kind of camera cannot do that.
        CameraError: it refused.
    """
    if not isinstance(camera, Exposing):
        raise ConfigError("sweep.exposures_us needs a camera whose exposure can be set: a USB webcam, or the twin")
    camera.expose(exposure_us)


def grab(camera: Camera, retries: int, note: Callable[[str], None], *, moving: bool = False) -> Frame:
    """A frame, asked for again where it cannot be used; the newest that has come where the head is `moving`.

    Raises:
        CameraError: not after `retries` more.
    """
    take = camera.newest if moving and isinstance(camera, Streaming) else camera.grab
    for attempt in range(retries + 1):
        try:
            return take()
        except CameraError as error:
            if attempt == retries:
                raise CameraError(
                    f"no usable frame after {attempt + 1} tries: {error}; check the camera's cable, or raise "
                    "sweep.retries; `scanmap doctor` shows what it delivers"
                ) from error
            logger.warning("frame taken again (%d of %d): %s", attempt + 1, retries, error)
            note(f"frame taken again: {error}")
    raise AssertionError("unreachable")
