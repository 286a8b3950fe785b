"""Which bearings a sweep visits, and how long it will take."""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from scanmap.errors import ConfigError

CABLE_LIMITS = (0.0, math.pi)  # [rad] a head turned further winds up its camera's cable
MAX_BEARINGS = 1_000_000  # of a sweep; a finer one is a slip of the keyboard
FRAME_S = 0.1  # a typical camera, for the estimate before the first frame
TURN_RAD_S = math.radians(20.0)  # a typical head, for the same


class SweepParams(BaseModel, frozen=True, extra="forbid"):
    """Which bearings are shot, and how; `[sweep]` in a rig's TOML."""

    mode: Literal["step", "continuous", "adaptive"] = Field(
        "step",
        description="step: stop, settle, shoot; continuous: shoot while turning; adaptive: step, then finer "
        "bearings where the picture asks for them",
    )
    start_deg: float = Field(0.0, ge=-3600.0, le=3600.0, description="first bearing [deg]")
    end_deg: float = Field(180.0, ge=-3600.0, le=3600.0, description="last bearing [deg]")
    step_deg: float = Field(1.0, gt=0.0, le=360.0, description="from one bearing to the next [deg]")
    passes: Literal["forward", "forward-backward"] | int = Field(
        "forward", description="forward, forward-backward, or a number of passes in turn"
    )
    exposures_us: tuple[Annotated[float, Field(gt=0.0, le=1e7)], ...] = Field(
        (),
        max_length=8,
        description="every pass is made once with each of these exposures, for rooms both dark and shiny; each row "
        "then comes from the picture that knows it best; empty = camera.exposure_us [us]",
    )
    speed_deg_s: float = Field(6.0, gt=0.0, le=720.0, description="continuous: turning speed [deg/s]")
    latency_s: float = Field(
        0.0, ge=-1.0, le=5.0, description="continuous: how much later than the exposure a frame is stamped [s]"
    )
    fine_deg: float = Field(0.25, gt=0.0, le=360.0, description="adaptive: finest step [deg]")
    spacing_m: float = Field(
        0.06, gt=0.0, le=10.0, description="adaptive: points farther apart than this get bearings between them [m]"
    )
    settle_s: float = Field(0.15, ge=0.0, le=60.0, description="rest between arrival and exposure [s]")
    off_frames: bool = Field(False, description="also shoot each bearing with the laser off (Shot.background)")
    retries: int = Field(3, ge=0, le=100, description="how often a failed frame is taken again")
    rehomings: int = Field(
        2,
        ge=0,
        le=100,
        description="how often a head with a switch or index mark is homed again after losing its place",
    )
    watch: bool = Field(
        True, description="step, adaptive: notice lost steps, a stalled motor and a dead laser in the pictures"
    )
    park: bool = Field(True, description="turn back to the first bearing at the end")


class Plan(NamedTuple):
    """What a sweep will do."""

    bearings: NDArray[np.float64]  # (N,) in shooting order [rad]
    time_s: float  # estimate of the whole sweep [s]
    params: SweepParams  # what it was made from

    def exposure_us(self, number: int) -> float | None:
        """Exposure of the pass with this number [us]; None = as the camera has it."""
        exposures = self.params.exposures_us
        return exposures[number % len(exposures)] if exposures else None

    def pass_of(self, index: int) -> int:
        """Number of the pass that shot `index` belongs to."""
        return index // len(np.unique(self.bearings))

    @property
    def words(self) -> str:
        """One line for people."""
        sweep = self.params
        frames = ", laser on and off" if sweep.off_frames else ""
        finer = f", then every {sweep.fine_deg:g} deg where it is needed" if sweep.mode == "adaptive" else ""
        minutes, seconds = divmod(round(self.time_s), 60)
        time = f"{'at least' if finer else 'about'} {minutes}:{seconds:02d} min"
        return f"{self._where}{finer}{frames}; {time} on a real head"

    @property
    def _where(self) -> str:
        sweep = self.params
        if len(self.bearings) == 1:
            return f"1 bearing at {sweep.start_deg:g} deg"
        span = f"from {sweep.start_deg:g} to {sweep.end_deg:g} deg"
        if len(np.unique(self.bearings)) == 1:
            return f"{len(self.bearings)} shots at {sweep.start_deg:g} deg"
        passes = (
            sweep.passes
            if isinstance(sweep.passes, str)
            else "1 pass"
            if sweep.passes == 1
            else f"{sweep.passes} passes"
        )
        if sweep.exposures_us:
            passes += f", each with {len(sweep.exposures_us)} exposures"
        return f"{len(self.bearings)} bearings {span} every {sweep.step_deg:g} deg, {passes}"

    def as_metadata(self) -> dict[str, str]:
        """What a recording keeps of it: text for every key."""
        return {
            "shots": str(len(self.bearings)),
            "estimated_s": f"{self.time_s:.1f}",
            **{key: str(value) for key, value in self.params.model_dump(mode="json").items()},
        }


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
    if abs(span) / params.step_deg > MAX_BEARINGS:
        raise ConfigError(
            f"sweep.step_deg = {params.step_deg:g} makes more than {MAX_BEARINGS} bearings; "
            f"take {abs(span) / MAX_BEARINGS:g} or more"
        )
    count = math.floor(abs(span) / params.step_deg + 1e-9) + 1
    forward = np.radians(params.start_deg + math.copysign(params.step_deg, span) * np.arange(count))
    passes = {"forward": 1, "forward-backward": 2}.get(str(params.passes), params.passes)
    if not isinstance(passes, int) or not 1 <= passes <= MAX_BEARINGS // count:
        raise ConfigError(
            f"sweep.passes = {params.passes!r}: choose forward, forward-backward or a number from 1 "
            f"to {MAX_BEARINGS // count}"
        )
    passes *= max(1, len(params.exposures_us))
    if params.exposures_us and params.mode == "adaptive":
        raise ConfigError(
            "sweep.exposures_us and sweep.mode = 'adaptive' exclude each other; choose step or continuous"
        )
    bearings = np.concatenate([forward if number % 2 == 0 else forward[::-1] for number in range(passes)])
    turning = float(np.abs(np.diff(bearings)).sum())
    if params.mode == "continuous":
        return Plan(bearings, turning / math.radians(params.speed_deg_s), params)
    frames = (2 if params.off_frames else 1) * len(bearings)
    return Plan(bearings, turning / TURN_RAD_S + len(bearings) * params.settle_s + frames * FRAME_S, params)


def between(
    bearings: NDArray[np.float64], gaps: NDArray[np.bool_], fine_deg: float | NDArray[np.float64]
) -> NDArray[np.float64]:
    """Bearings that fill the gaps of a coarse pass evenly, in steps of at most `fine_deg`.

    Args:
        bearings: (N,) of the coarse pass, in order [rad].
        gaps: (N - 1,) which of the gaps between neighbours to fill.
        fine_deg: for all gaps, or (N - 1,) for each [deg].
    """
    parts = np.ceil(np.abs(np.diff(bearings)) / np.radians(fine_deg) - 1e-9).astype(int)
    filled = [
        np.linspace(bearings[gap], bearings[gap + 1], parts[gap] + 1)[1:-1]
        for gap in np.flatnonzero(np.asarray(gaps, bool))
    ]
    return np.concatenate(filled) if filled else np.empty(0)
