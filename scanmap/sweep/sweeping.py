"""Sweep a rig through a room: turn, switch the laser, shoot, survive a bad frame.

Uses nothing of a rig but its two protocols, so the twin and the real head are swept by the same lines.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import CameraError, ConfigError, ScanmapError
from scanmap.rig import Camera, Frame, Rig, Streaming
from scanmap.shot import Shot
from scanmap.sweep.planning import CABLE_LIMITS, Plan, SweepParams, plan

HISTORY = 100  # reports kept for frames that arrive late
SAMPLE_RAD = math.radians(0.02)  # how far off one report of a turning head may be

logger = logging.getLogger(__name__)


Refine = Callable[[], NDArray[np.float64]]  # further bearings [rad], asked for after an adaptive sweep's first pass


@runtime_checkable
class Turning(Protocol):
    """A stage that can be watched while it turns, as continuous sweeps need."""

    def start_turn(self, bearing: float, speed: float) -> None:
        """Begin to turn to `bearing` [rad] at `speed` [rad/s] and return at once; `move_to` then arrives."""
        ...


@runtime_checkable
class Bounded(Protocol):
    """A stage that knows how far it may turn."""

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest bearing [rad]."""
        ...


def sweep(
    rig: Rig,
    params: SweepParams,
    stop: Callable[[], bool] = lambda: False,
    sleep: Callable[[float], None] = time.sleep,
    *,
    clock: Callable[[], float] = time.monotonic,
    refine: Refine | None = None,
    first: int = 0,
) -> Iterator[Shot]:
    """Shoot a rig around, bearing by bearing.

    However it ends (done, stopped, closed, Ctrl-C, a fault) the laser is switched off and, where the stage
    still answers, the head is parked.

    Args:
        stop: asked before each bearing; True ends the sweep in order.
        sleep: waits for the head to settle; a twin in fast-forward passes time by its own clock.
        clock: the clock that frames are stamped with [s]; continuous sweeps ask the stage by it.
        refine: adaptive sweeps ask it for further bearings after the first pass.
        first: index to begin with, for a sweep that was interrupted; not for continuous ones.

    Yields:
        `Shot` with the bearing that the stage reported; time counts from the first frame.

    Raises:
        ConfigError: the plan leaves the stage's limits, or the stage cannot do the mode; nothing has moved.
        CameraError: no usable frame after all retries.
        StageError: the stage failed.
    """
    limits = rig.stage.limits if isinstance(rig.stage, Bounded) else CABLE_LIMITS
    planned = plan(params, limits)
    if params.mode == "continuous":
        if not isinstance(rig.stage, Turning):
            raise ConfigError("sweep.mode = 'continuous' needs a stage of kind grbl: choose step or adaptive")
        return _guarded(rig, params, planned, _turn(rig, rig.stage, planned, stop, clock))
    return _guarded(rig, params, planned, _step(rig, planned, stop, sleep, refine=refine, first=first))


def _guarded(rig: Rig, params: SweepParams, planned: Plan, shots: Iterator[Shot]) -> Iterator[Shot]:
    """Count time from the first frame; leave the rig safe."""
    failed = True
    try:
        started: float | None = None
        for shot in shots:
            started = shot.time if started is None else started
            yield replace(shot, time=shot.time - started)
        failed = False
    finally:
        _leave(rig, planned.bearings[0] if params.park else None, failed=failed)


def _step(
    rig: Rig,
    planned: Plan,
    stop: Callable[[], bool],
    sleep: Callable[[float], None],
    *,
    refine: Refine | None,
    first: int,
) -> Iterator[Shot]:
    """Stop, settle, shoot; then the same for what `refine` asks for, on the way back."""
    bearings = planned.bearings.tolist()
    index = first
    while True:
        while index < len(bearings) and not stop():
            reported = rig.stage.move_to(bearings[index])
            if planned.params.settle_s:
                sleep(planned.params.settle_s)
            frame, background = _take(rig, planned.params)
            yield Shot(index, reported, bearings[index], frame.time, frame.image, background)
            index += 1
        if planned.params.mode != "adaptive" or refine is None or stop():
            return
        further = np.sort(refine())
        refine = None
        bearings += (further if bearings[-1] < bearings[0] else further[::-1]).tolist()


def _turn(
    rig: Rig, stage: Turning, planned: Plan, stop: Callable[[], bool], clock: Callable[[], float]
) -> Iterator[Shot]:
    """Shoot while turning; a frame's bearing is interpolated between what the stage reported around it.

    Frames taken while the head sped up or slowed down are left out: a line between two reports is wrong there.
    """
    params = planned.params
    speed = math.radians(params.speed_deg_s)
    count = len(np.unique(planned.bearings))
    index = 0
    for start, end in planned.bearings.reshape(-1, count)[:, [0, -1]].tolist():
        rig.stage.move_to(start)
        rig.stage.laser(True)
        track = [_sample(rig, clock)]
        stage.start_turn(end, speed)
        last = -math.inf
        while abs(track[-1][1] - start) < abs(end - start) - 1e-4 and not stop():
            frame = _grab(rig.camera, params.retries, moving=True)
            track = [*track[-HISTORY:], _sample(rig, clock)]
            bearing = _steady_bearing(track, frame.time - params.latency_s, speed)
            if math.isnan(bearing) or abs(bearing - last) < math.radians(params.step_deg) * 0.99:
                continue
            last = bearing
            yield Shot(index, bearing, bearing, frame.time, frame.image, None)
            index += 1
        if stop():
            return


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


def _take(rig: Rig, params: SweepParams) -> tuple[Frame, bytes | None]:
    """A frame with the laser on and, if asked for and possible, one with it off, taken just before."""
    background = None
    if params.off_frames and rig.stage.laser_switchable:
        rig.stage.laser(False)
        background = _grab(rig.camera, params.retries).image
    rig.stage.laser(True)
    return _grab(rig.camera, params.retries), background


def _grab(camera: Camera, retries: int, *, moving: bool = False) -> Frame:
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
    raise AssertionError("unreachable")


def _leave(rig: Rig, park: float | None, *, failed: bool) -> None:
    """Laser off, head parked. After a fault the fault counts, not what fails here."""
    for step in ("laser", "park"):
        try:
            if step == "laser":
                rig.stage.laser(False)
            elif park is not None:
                rig.stage.move_to(park)
        except ScanmapError as error:
            if not failed:
                raise
            logger.warning("while leaving: %s", error)
