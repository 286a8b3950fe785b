"""Sweep a rig through a room: turn, switch the laser, shoot, survive a bad frame.

Uses nothing of a rig but its two protocols, so the twin and the real head are swept by the same lines.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Protocol, runtime_checkable

import numpy as np

from scanmap.errors import ConfigError, ScanmapError
from scanmap.rig import Rig
from scanmap.shot import Shot
from scanmap.sweep.planning import CABLE_LIMITS, Plan, SweepParams, plan
from scanmap.sweep.stepping import Refine, Steps, expose, grab
from scanmap.sweep.watching import Watch

HISTORY = 100  # reports kept for frames that arrive late
SAMPLE_RAD = math.radians(0.02)  # how far off one report of a turning head may be

logger = logging.getLogger(__name__)


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
    watch: Watch | None = None,
    done: Collection[int] = (),
    note: Callable[[str], None] = lambda _: None,
) -> Iterator[Shot]:
    """Shoot a rig around, bearing by bearing.

    However it ends (done, stopped, closed, Ctrl-C, a fault) the laser is switched off and, where the stage
    still answers, the head is parked.

    Args:
        stop: asked before each bearing; True ends the sweep in order.
        sleep: waits for the head to settle; a twin in fast-forward passes time by its own clock.
        clock: the clock that frames are stamped with [s]; continuous sweeps ask the stage by it.
        refine: adaptive sweeps ask it for further bearings after the first pass.
        watch: holds the pictures against each other, to notice lost steps, a stalled motor and a dead laser.
        done: indices of shots that an interrupted sweep took already; not for continuous ones.
        note: told of every fault that was overcome: a retry, a homing.

    Yields:
        `Shot` with the bearing that the stage reported; time counts from the first frame.

    Raises:
        ConfigError: the plan leaves the stage's limits, or the stage cannot do the mode; nothing has moved.
        CameraError: no usable frame after all retries.
        StageError: the stage failed, or lost its place and cannot find it again by itself.
    """
    limits = rig.stage.limits if isinstance(rig.stage, Bounded) else CABLE_LIMITS
    planned = plan(params, limits)
    if params.mode == "continuous":
        if not isinstance(rig.stage, Turning):
            raise ConfigError("sweep.mode = 'continuous' needs a stage of kind grbl: choose step or adaptive")
        return _guarded(rig, params, planned, _turn(rig, rig.stage, planned, stop, clock, note))
    steps = Steps(rig, planned, sleep, watch, note)
    return _guarded(rig, params, planned, steps.shots(stop, refine, done))


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


def _turn(
    rig: Rig,
    stage: Turning,
    planned: Plan,
    stop: Callable[[], bool],
    clock: Callable[[], float],
    note: Callable[[str], None],
) -> Iterator[Shot]:
    """Shoot while turning; a frame's bearing is interpolated between what the stage reported around it.

    Frames taken while the head sped up or slowed down are left out: a line between two reports is wrong there.
    """
    params = planned.params
    speed = math.radians(params.speed_deg_s)
    count = len(np.unique(planned.bearings))
    index = 0
    for number, (start, end) in enumerate(planned.bearings.reshape(-1, count)[:, [0, -1]].tolist()):
        rig.stage.move_to(start)
        if (exposure_us := planned.exposure_us(number)) is not None:
            expose(rig.camera, exposure_us)
        rig.stage.laser(True)
        track = [_sample(rig, clock)]
        stage.start_turn(end, speed)
        last = -math.inf
        while abs(track[-1][1] - start) < abs(end - start) - 1e-4 and not stop():
            frame = grab(rig.camera, params.retries, note, moving=True)
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
