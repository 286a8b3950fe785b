"""A sweep in steps: stop, settle, shoot."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import CameraError, ConfigError, StageError
from scanmap.rig import Camera, Exposing, Frame, Rig, Streaming
from scanmap.shot import Shot
from scanmap.sweep.planning import Plan
from scanmap.sweep.proving import Place, Proof, Withdraw
from scanmap.sweep.watching import Watch

STILL_RAD = math.radians(0.01)  # a head that stands is reported at one place

logger = logging.getLogger(__name__)

Refine = Callable[[int], NDArray[np.float64]]  # further bearings [rad] of an adaptive sweep, after so many shots


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
        withdraw: Withdraw = lambda indices, why: None,
    ) -> None:
        self._note = note
        self._rig = rig
        self._planned = planned
        self._params = planned.params
        self._sleep = sleep
        self._watch = watch
        self._proof = Proof(rig, planned, watch, self.shoot, note, withdraw)
        self._seen: tuple[bytes, float] = (b"", 0.0)  # the last picture, and where it was taken
        self._exposure_us: float | None = None  # as last asked for

    def shots(self, stop: Callable[[], bool], refine: Refine | None, done: Collection[int]) -> Iterator[Shot]:
        """Every shot of the plan but those `done`; then what `refine` asks for, to and fro, until it asks for no more.

        A shot that was withdrawn comes again under its index.
        """
        bearings = self._planned.bearings
        yield from self._visit(map(Place, range(len(bearings)), bearings.tolist()), stop, done)
        count, upward = len(bearings), bearings[-1] < bearings[0]
        while self._params.mode == "adaptive" and refine is not None and not stop() and len(further := refine(count)):
            on_the_way = np.sort(further)[:: 1 if upward else -1]
            yield from self._visit(map(Place, range(count, count + len(further)), on_the_way.tolist()), stop, done)
            count, upward = count + len(further), not upward
        while not stop():
            self._proof.look_back()
            again = self._proof.take_again()
            if not again:
                return
            yield from self._visit(again, stop, ())

    def _visit(self, places: Iterable[Place], stop: Callable[[], bool], done: Collection[int]) -> Iterator[Shot]:
        to_do = deque(place for place in places if place.index not in done)
        while to_do and not stop():
            shot = self._proof.confirmed(self.shoot(to_do.popleft()))
            if self._watch is not None and not self._watch.knows_noise:
                self._watch.learn(shot.image, grab(self._rig.camera, self._params.retries, self._note).image)
            yield shot
            to_do.extendleft(reversed(self._proof.take_again()))

    def shoot(self, place: Place) -> Shot:
        """Turn there and take the picture; a head that lost its place is homed again where it can be.

        Raises:
            StageError, CameraError: no way to get it.
        """
        while True:
            try:
                reported = self._rig.stage.move_to(place.bearing)
                if self._params.settle_s:
                    self._sleep(self._params.settle_s)
                self._expose(place.index)
                frame, background = self._take()
                self._check_alive(frame.image, background, reported)
                after = self._rig.stage.where()
                if abs(after - reported) > STILL_RAD:
                    raise StageError(
                        f"the head moved from {math.degrees(reported):.3f} to {math.degrees(after):.3f} deg while a "
                        "picture was taken: check its power supply and whether something pushes it"
                    )
            except StageError as error:
                self._proof.home_again(error)
                continue
            return Shot(place.index, reported, place.bearing, frame.time, frame.image, background)

    def look(self) -> Shot:
        """A picture from where the head stands; nothing turns. Raises StageError, CameraError."""
        frame, background = self._take()
        here = self._rig.stage.where()
        return Shot(0, here, here, frame.time, frame.image, background)

    def _expose(self, index: int) -> None:
        """Change the exposure where another pass begins."""
        wanted = self._planned.exposure_us(self._planned.pass_of(max(index, 0)))
        if wanted is not None and wanted != self._exposure_us:
            expose(self._rig.camera, wanted)
            self._exposure_us = wanted

    def _check_alive(self, image: bytes, background: bytes | None, bearing: float) -> None:
        """Raise CameraError where a picture is, to the last bit, one from elsewhere or with the laser off."""
        before, self._seen = self._seen, (image, bearing)
        if image == background or (image == before[0] and abs(bearing - before[1]) > STILL_RAD):
            raise frozen()

    def _take(self) -> tuple[Frame, bytes | None]:
        """A frame with the laser on and, if asked for and possible, one with it off, taken just before."""
        stage, retries, background = self._rig.stage, self._params.retries, None
        if self._params.off_frames and stage.laser_switchable:
            stage.laser(False)
            background = grab(self._rig.camera, retries, self._note).image
        stage.laser(True)
        return grab(self._rig.camera, retries, self._note), background


def frozen() -> CameraError:
    """What a camera that sends one picture for two bearings is told of."""
    return CameraError(
        "the camera sends the same picture again and again: it is frozen, plug it in anew; `scanmap doctor` "
        "shows what it delivers, scanmap scan --resume goes on"
    )


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
