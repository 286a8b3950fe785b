"""Sweep a rig through a room: turn, switch the laser, shoot, survive a bad frame.

Uses nothing of a rig but its two protocols, so the twin and the real head are swept by the same lines.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from typing import Protocol, runtime_checkable

from scanmap.errors import ConfigError, ScanmapError
from scanmap.rig import Rig
from scanmap.shot import Shot
from scanmap.sweep.planning import CABLE_LIMITS, Plan, SweepParams, plan
from scanmap.sweep.proving import Withdraw
from scanmap.sweep.stepping import Refine, Steps
from scanmap.sweep.turning import Turning, Turns
from scanmap.sweep.watching import Watch

logger = logging.getLogger(__name__)


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
    withdraw: Withdraw = lambda indices, why: None,
) -> Iterator[Shot]:
    """Shoot a rig around, bearing by bearing.

    However it ends (done, stopped, closed, Ctrl-C, a fault) the laser is switched off and, where the stage
    still answers, the head is parked.

    Args:
        stop: asked before each bearing; True ends the sweep in order.
        sleep: waits for the head to settle; a twin in fast-forward passes time by its own clock.
        clock: the clock that frames are stamped with [s]; continuous sweeps ask the stage by it.
        refine: adaptive sweeps ask it for further bearings after each pass, until it has none.
        watch: holds the pictures against each other, to notice lost steps, a stalled motor and a dead laser.
        done: indices of shots that an interrupted sweep took already.
        note: told of every fault that was overcome: a retry, a homing.
        withdraw: told of shots that turned out not to be trusted; they come again under their index, if they can.

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
        turns = Turns(rig, rig.stage, planned, clock, watch, note, withdraw)
        return _guarded(rig, params, planned, turns.shots(stop, done))
    steps = Steps(rig, planned, sleep, watch, note, withdraw)
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
