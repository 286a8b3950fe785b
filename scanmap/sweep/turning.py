"""A continuous sweep: shoot while turning, a frame's bearing interpolated between what the stage reported around it.

A pass is divided into slots of a step each; a shot is the first frame of its slot, and its index names pass and slot.
So a sweep that was interrupted, or had to look twice at something, turns once more through the slots it lacks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from itertools import pairwise
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from scanmap.errors import CameraError, StageError
from scanmap.rig import Frame, Rig
from scanmap.shot import Shot
from scanmap.sweep.planning import Plan
from scanmap.sweep.proving import Place, Proof, Withdraw
from scanmap.sweep.stepping import expose, frozen, grab
from scanmap.sweep.watching import Watch

HISTORY = 100  # reports kept for frames that arrive late
SAMPLE_RAD = math.radians(0.02)  # how far off one report of a turning head may be
RUN_UP_S = 0.5  # of turning before the first frame that counts, and after the last
NEARLY_RAD = math.radians(0.1)  # a head so near the end of its turn has arrived; no stage stands finer than a step
STANDS_S = 2.0  # a head that turns no farther for so long has stopped


@runtime_checkable
class Turning(Protocol):
    """A stage that can be watched while it turns, as continuous sweeps need."""

    def start_turn(self, bearing: float, speed: float) -> None:
        """Begin to turn to `bearing` [rad] at `speed` [rad/s] and return at once; `move_to` then arrives."""
        ...


class Pass(NamedTuple):
    """One turn from end to end."""

    number: int
    start: float  # [rad]
    end: float  # [rad]
    slots: int

    @property
    def direction(self) -> float:
        """1 toward larger bearings, else -1."""
        return math.copysign(1.0, self.end - self.start)


def passes(planned: Plan) -> list[Pass]:
    """The passes of a plan."""
    slots = len(np.unique(planned.bearings))
    ends = planned.bearings.reshape(-1, slots)[:, [0, -1]].tolist()
    return [Pass(number, start, end, slots) for number, (start, end) in enumerate(ends)]


def missing(planned: Plan, turn: Pass, done: Collection[int], *, ends: bool = True) -> list[tuple[int, int]]:
    """Runs of slots, first and last, of a pass that lack a shot though they could have had one.

    A camera too slow for the step leaves slots empty, and so may the ends, where the head speeds up and slows down.

    Args:
        ends: whether empty ends count: a sweep that was broken off may just not have come there.
    """
    base = turn.number * turn.slots
    there = sorted(index - base for index in done if base <= index < base + turn.slots)
    if not there:
        return [(0, turn.slots - 1)]
    spacing = int(np.median(np.diff(there))) if len(there) > 1 else 1
    natural = 2 * (spacing - 1)
    ramp = natural + (0 if ends else math.ceil(RUN_UP_S * planned.params.speed_deg_s / planned.params.step_deg))
    runs = [(before + 1, after - 1) for before, after in pairwise(there) if after - before - 1 > natural]
    first = [(0, there[0] - 1)] if there[0] > ramp else []
    last = [(there[-1] + 1, turn.slots - 1)] if turn.slots - 1 - there[-1] > ramp else []
    return first + runs + last


class Turns:
    """One continuous sweep."""

    def __init__(
        self,
        rig: Rig,
        stage: Turning,
        planned: Plan,
        clock: Callable[[], float],
        watch: Watch | None = None,
        note: Callable[[str], None] = lambda _: None,
        withdraw: Withdraw = lambda indices, why: None,
    ) -> None:
        self._rig, self._stage, self._clock = rig, stage, clock
        self._planned = planned
        self._params = planned.params
        self._passes = passes(planned)
        self._speed = math.radians(planned.params.speed_deg_s)
        self._watch = watch
        self._note = note
        self._proof = Proof(rig, planned, watch, self.shoot, note, withdraw)
        self._broken = False  # whether a look elsewhere, or a homing, has ended the turn through the slots
        self._is_turning = False
        self._exposure_us: float | None = None

    def shots(self, stop: Callable[[], bool], done: Collection[int]) -> Iterator[Shot]:
        """A shot of every slot but those `done`; one that was withdrawn comes again under its index."""
        for turn in self._passes:
            for first, last in missing(self._planned, turn, done):
                yield from self._run(turn, first, last, stop)
                if stop():
                    return
        while not stop():
            self._proof.look_back()
            if not (again := self._proof.take_again()):
                return
            yield from self._retaken(again, stop)

    def shoot(self, place: Place) -> Shot:
        """The frame nearest to a place, taken in passing as those of the sweep are; a lost head is homed where it can.

        Raises:
            StageError, CameraError: no way to get it.
        """
        turn = self._passes[max(place.index, 0) // self._passes[0].slots]
        low, high = sorted((turn.start, turn.end))
        way = turn.direction * self._speed * RUN_UP_S
        self._broken = True
        while True:
            nearest: tuple[float, Frame] | None = None
            try:
                start, end = (min(max(place.bearing + part * way, low), high) for part in (-1.0, 2.0))
                for bearing, frame in self._frames(turn, start, end):
                    if nearest is None or abs(bearing - place.bearing) < abs(nearest[0] - place.bearing):
                        nearest = bearing, frame
                    elif turn.direction * (bearing - place.bearing) > 0:
                        break
                self._halt()
            except StageError as error:
                self._proof.home_again(error)
                continue
            if nearest is None:
                raise CameraError(
                    f"no picture came while the head passed {math.degrees(place.bearing):.2f} deg: turn slower "
                    "(sweep.speed_deg_s), or sweep in steps"
                )
            return Shot(place.index, nearest[0], nearest[0], nearest[1].time, nearest[1].image)

    def _retaken(self, places: list[Place], stop: Callable[[], bool]) -> Iterator[Shot]:
        """Shots of places that were withdrawn, in turns from the first to the last of each pass."""
        for turn in self._passes:
            slots = [place.index - turn.number * turn.slots for place in places]
            inside = [slot for slot in slots if 0 <= slot < turn.slots]
            if inside:
                yield from self._run(turn, min(inside), max(inside), stop)

    def _run(self, turn: Pass, first: int, last: int, stop: Callable[[], bool]) -> Iterator[Shot]:
        """The slots from `first` to `last`; goes back and on where a doubt, or a lost place, ended the turn."""
        while first <= last and not stop():
            self._broken = False
            for shot in self._slots(turn, first, last, stop):
                first = shot.index - turn.number * turn.slots + 1
                yield self._proof.confirmed(shot)
                if self._broken:
                    break
            again = self._proof.take_again()
            if not again and not self._broken:
                return
            slots = [place.index - turn.number * turn.slots for place in again]
            first = min([first, *(slot for slot in slots if slot >= 0)])
            yield from self._retaken([place for place in again if place.index < turn.number * turn.slots], stop)

    def _slots(self, turn: Pass, first: int, last: int, stop: Callable[[], bool]) -> Iterator[Shot]:
        """One turn through some slots of a pass; it ends early where the head was homed."""
        step = math.radians(self._params.step_deg)
        way = turn.direction * self._speed * RUN_UP_S
        low, high = sorted((turn.start, turn.end))
        start = min(max(turn.start + turn.direction * first * step - way, low), high)
        end = min(max(turn.start + turn.direction * (last + 1) * step + way, low), high)
        taken, before = first - 1, Frame(b"", 0.0)
        try:
            for bearing, frame in self._frames(turn, start, end, stop):
                slot = math.floor(turn.direction * (bearing - turn.start) / step + 1e-6)
                if not taken < slot <= last:
                    continue
                if frame.image == before.image:
                    raise frozen()
                taken, before = slot, frame
                yield Shot(turn.number * turn.slots + slot, bearing, bearing, frame.time, frame.image)
        except StageError as error:
            self._proof.home_again(error)
            self._broken = True

    def _halt(self) -> None:
        """End a turn that is under way: switching the laser off does."""
        if self._is_turning:
            self._is_turning = False
            self._rig.stage.laser(False)

    def _frames(
        self, turn: Pass, start: float, end: float, stop: Callable[[], bool] = lambda: False
    ) -> Iterator[tuple[float, Frame]]:
        """Frames with their bearings while the head turns steadily from `start` to `end`.

        Those taken while it speeds up or slows down are left out: a line between two reports is wrong there.
        """
        stage, params = self._rig.stage, self._params
        self._halt()
        stage.move_to(start)
        wanted = self._planned.exposure_us(turn.number)
        if wanted is not None and wanted != self._exposure_us:
            expose(self._rig.camera, wanted)
            self._exposure_us = wanted
        stage.laser(True)
        if self._watch is not None and not self._watch.knows_noise:
            self._watch.learn(*(grab(self._rig.camera, params.retries, self._note).image for _ in range(2)))
        track = [_sample(self._rig, self._clock)]
        self._stage.start_turn(end, self._speed)
        self._is_turning = True
        moved_at = track[-1][0]
        while abs(end - track[-1][1]) > NEARLY_RAD and not stop():
            frame = grab(self._rig.camera, params.retries, self._note, moving=True)
            track = [*track[-HISTORY:], _sample(self._rig, self._clock)]
            moved_at = track[-1][0] if track[-1][1] != track[-2][1] else moved_at
            if track[-1][0] - moved_at > STANDS_S:
                raise StageError(
                    f"the head has stopped at {math.degrees(track[-1][1]):.2f} deg on its way to "
                    f"{math.degrees(end):.2f}: check for a blocked head, then scanmap scan --resume"
                )
            bearing = _steady_bearing(track, frame.time - params.latency_s, self._speed)
            if not math.isnan(bearing):
                yield bearing, frame
        self._is_turning = stop()


def _steady_bearing(track: list[tuple[float, float]], moment: float, speed: float) -> float:
    """The bearing at `moment` [rad]; NaN if the head did not turn at `speed` then.

    Args:
        track: times [s] and bearings reported then [rad].
    """
    for (before, here), (after, there) in pairwise(track):
        if before <= moment <= after:
            way = abs(there - here)
            if abs(way - speed * (after - before)) > 0.05 * way + SAMPLE_RAD:
                return math.nan
            return here + (there - here) * (moment - before) / (after - before)
    return math.nan


def _sample(rig: Rig, clock: Callable[[], float]) -> tuple[float, float]:
    """When, and the bearing reported then."""
    before = clock()
    bearing = rig.stage.where()
    return (before + clock()) / 2, bearing
