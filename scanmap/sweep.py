"""Sweep a rig through a room: plan the bearings, turn, switch the laser, shoot, survive a bad frame.

Uses nothing of a rig but its two protocols, so the twin and the real head are swept by the same lines.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from scanmap.errors import CameraError, ConfigError, ScanmapError
from scanmap.rig import Camera, Frame, Rig
from scanmap.shot import Shot

CABLE_LIMITS = (0.0, math.pi)  # [rad] a head turned further winds up its camera's cable
FRAME_S = 0.1  # a typical camera, for the estimate before the first frame
TURN_RAD_S = math.radians(20.0)  # a typical head, for the same

logger = logging.getLogger(__name__)


class SweepParams(BaseModel, frozen=True, extra="forbid"):
    """Which bearings are shot, and how; `[sweep]` in a rig's TOML."""

    mode: Literal["step"] = Field("step", description="step: stop, settle, shoot")
    start_deg: float = Field(0.0, ge=-3600.0, le=3600.0, description="first bearing [deg]")
    end_deg: float = Field(180.0, ge=-3600.0, le=3600.0, description="last bearing [deg]")
    step_deg: float = Field(1.0, gt=0.0, le=360.0, description="from one bearing to the next [deg]")
    passes: Literal["forward", "forward-backward"] | int = Field(
        "forward", description="forward, forward-backward, or a number of passes in turn"
    )
    settle_s: float = Field(0.15, ge=0.0, le=60.0, description="rest between arrival and exposure [s]")
    off_frames: bool = Field(False, description="also shoot each bearing with the laser off (Shot.background)")
    retries: int = Field(3, ge=0, le=100, description="how often a failed frame is taken again")
    park: bool = Field(True, description="turn back to the first bearing at the end")


class Plan(NamedTuple):
    """What a sweep will do."""

    bearings: NDArray[np.float64]  # (N,) in shooting order [rad]
    time_s: float  # estimate of the whole sweep [s]
    params: SweepParams  # what it was made from

    @property
    def words(self) -> str:
        """One line for people."""
        sweep = self.params
        frames = ", laser on and off" if sweep.off_frames else ""
        minutes, seconds = divmod(round(self.time_s), 60)
        return (
            f"{len(self.bearings)} bearings from {sweep.start_deg:g} to {sweep.end_deg:g} deg every "
            f"{sweep.step_deg:g} deg, {sweep.passes}{frames}; about {minutes}:{seconds:02d} min on a real head"
        )

    def as_metadata(self) -> dict[str, str]:
        """What a recording keeps of it: text for every key."""
        return {
            "shots": str(len(self.bearings)),
            "estimated_s": f"{self.time_s:.1f}",
            **{key: str(value) for key, value in self.params.model_dump().items()},
        }


@runtime_checkable
class Bounded(Protocol):
    """A stage that knows how far it may turn."""

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest bearing [rad]."""
        ...


def plan(params: SweepParams, limits: tuple[float, float] = CABLE_LIMITS) -> Plan:
    """The bearings of a sweep and how long it will take.

    Args:
        limits: smallest and largest bearing [rad]; the stage's own where it has any.

    Raises:
        ConfigError: a bearing outside the limits, or no pass.
    """
    low, high = (math.degrees(limit) for limit in limits)
    for key, value in (("start_deg", params.start_deg), ("end_deg", params.end_deg)):
        if not low - 1e-6 <= value <= high + 1e-6:
            raise ConfigError(
                f"sweep.{key} = {value:g} is outside {low:g} to {high:g} deg, where the cable would wind up: choose a "
                "bearing inside, or set stage.min_deg / stage.max_deg if nothing can"
            )
    span = params.end_deg - params.start_deg
    count = math.floor(abs(span) / params.step_deg + 1e-9) + 1
    forward = np.radians(params.start_deg + math.copysign(params.step_deg, span) * np.arange(count))
    passes = {"forward": 1, "forward-backward": 2}.get(str(params.passes), params.passes)
    if not isinstance(passes, int) or passes < 1:
        raise ConfigError(f"sweep.passes = {params.passes!r}: choose forward, forward-backward or a number from 1")
    bearings = np.concatenate([forward if number % 2 == 0 else forward[::-1] for number in range(passes)])
    turning = float(np.abs(np.diff(bearings)).sum()) / TURN_RAD_S
    frames = (2 if params.off_frames else 1) * len(bearings)
    return Plan(bearings, turning + len(bearings) * params.settle_s + frames * FRAME_S, params)


def sweep(
    rig: Rig,
    params: SweepParams,
    stop: Callable[[], bool] = lambda: False,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Shot]:
    """Shoot a rig around, bearing by bearing.

    However it ends (done, stopped, closed, Ctrl-C, a fault) the laser is switched off and, where the stage
    still answers, the head is parked.

    Args:
        stop: asked before each bearing; True ends the sweep in order.
        sleep: waits for the head to settle; a twin in fast-forward passes time by its own clock.

    Yields:
        `Shot` with the bearing that the stage reported; time counts from the first frame.

    Raises:
        ConfigError: the plan leaves the stage's limits; nothing has moved.
        CameraError: no usable frame after all retries.
        StageError: the stage failed.
    """
    limits = rig.stage.limits if isinstance(rig.stage, Bounded) else CABLE_LIMITS
    return _shoot(rig, params, plan(params, limits), stop, sleep)


def _shoot(
    rig: Rig, params: SweepParams, planned: Plan, stop: Callable[[], bool], sleep: Callable[[float], None]
) -> Iterator[Shot]:
    started: float | None = None
    failed = True
    try:
        for index, bearing in enumerate(planned.bearings.tolist()):
            if stop():
                break
            reported = rig.stage.move_to(bearing)
            if params.settle_s:
                sleep(params.settle_s)
            frame, background = _take(rig, params)
            started = frame.time if started is None else started
            yield Shot(index, reported, bearing, frame.time - started, frame.image, background)
        failed = False
    finally:
        _leave(rig, planned.bearings[0] if params.park else None, failed=failed)


def _take(rig: Rig, params: SweepParams) -> tuple[Frame, bytes | None]:
    """A frame with the laser on and, if asked for and possible, one with it off, taken just before."""
    background = None
    if params.off_frames and rig.stage.laser_switchable:
        rig.stage.laser(False)
        background = _grab(rig.camera, params.retries).image
    rig.stage.laser(True)
    return _grab(rig.camera, params.retries), background


def _grab(camera: Camera, retries: int) -> Frame:
    for attempt in range(retries + 1):
        try:
            return camera.grab()
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
