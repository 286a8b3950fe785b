"""Which stage a rig has: the `[stage]` section and what opens it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

from pydantic import BaseModel, Field, model_validator

from scanmap.errors import StageError
from scanmap.rig import Stage


class StageParams(BaseModel, frozen=True, extra="forbid"):
    """How the head is turned and its laser switched; `[stage]` in a rig's TOML."""

    kind: Literal["grbl", "manual", "template"] = Field(
        "grbl",
        description="grbl (also grblHAL and FluidNC), manual (turned by hand), template (own command strings)",
    )
    port: str = Field(
        "auto", min_length=1, description="auto, /dev/ttyUSB0, COM3, socket://host:23, rfc2217://host:2217"
    )
    baud: int = Field(115200, ge=1200, le=4_000_000, description="speed of the serial line [bit/s]")
    timeout_s: float = Field(2.0, gt=0.0, le=60.0, description="how long the board may be silent [s]")
    steps_per_deg: float | None = Field(
        None,
        gt=0.0,
        le=1e5,
        description="motor steps for one degree of the head, written to $100; none = as the board has it [1/deg]",
    )
    direction: Literal[1, -1] = Field(1, description="1, or -1 where the board's positive turn is clockwise")
    min_deg: float = Field(0.0, ge=-3600.0, le=3600.0, description="smallest bearing the head may turn to [deg]")
    max_deg: float = Field(
        180.0,
        ge=-3600.0,
        le=3600.0,
        description="largest bearing; more than 180 above min_deg winds up the camera's cable [deg]",
    )
    backlash_deg: float = Field(
        0.0,
        ge=0.0,
        le=10.0,
        description="play of the gear; the head arrives from below, going this far past, even below min_deg [deg]",
    )
    speed_deg_s: float = Field(20.0, gt=0.0, le=720.0, description="turning speed [deg/s]")
    acceleration_deg_s2: float | None = Field(
        None, gt=0.0, le=1e5, description="written to $120; none = as the board has it [deg/s^2]"
    )
    homing: Literal["hand", "switch", "index"] = Field(
        "hand",
        description="hand (the head stands at home_deg when the port opens), switch ($H), index (probe input)",
    )
    home_deg: float = Field(0.0, ge=-3600.0, le=3600.0, description="bearing of the head at home [deg]")
    idle_ms: float | None = Field(
        None,
        ge=0.0,
        le=255.0,
        description="$1 with which the board is left, 255 = the motor goes on holding; none = as it was found [ms]",
    )
    laser: Literal["grbl", "always-on"] = Field(
        "grbl", description="grbl (M3/M5 of the board), always-on (on batteries: software cannot switch it)"
    )
    laser_s: float = Field(1000.0, ge=0.0, le=1e6, description="S word sent with M3; $30 is full power [board's units]")
    watchdog: bool = Field(
        True, description="keep a small process that switches the laser off should this program be killed"
    )
    command_move: str = Field(
        "G1 X{deg:.3f} F{feed:.0f}",
        description="template: sent to turn; {deg}, {rad}, {feed} (deg/min), {us} (servo pulse, 500 to 2500 us)",
    )
    command_laser_on: str = Field("M3", description="template: sent to switch the laser on; empty = nothing")
    command_laser_off: str = Field("M5", description="template: sent to switch it off; empty = nothing")
    command_release: str = Field("", description="template: sent at the end to free the motor; empty = nothing")
    answer: str = Field("ok", description="template: what the board says to a command; empty = nothing")

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest bearing [rad]."""
        return math.radians(self.min_deg), math.radians(self.max_deg)

    @model_validator(mode="after")
    def _limits_in_order(self) -> StageParams:
        if self.max_deg <= self.min_deg:
            raise ValueError(f"max_deg {self.max_deg:g} must be larger than min_deg {self.min_deg:g}")
        return self


def open_stage(params: StageParams, ask: Callable[[str], str] = input) -> Stage:
    """Open the stage that `params` names, its laser off.

    Args:
        ask: shows a question to the user and returns the answer; for a head turned by hand.

    Raises:
        StageError: the port cannot be opened, or nothing that answers is a stage.
    """
    if params.kind == "manual":
        from scanmap.rig.manual import ManualStage

        return ManualStage(params, ask)
    if params.kind == "template":
        from scanmap.rig.template import open_template

        return open_template(params)
    from scanmap.rig.grbl_opening import open_grbl

    return open_grbl(params)


def check_limits(bearing_deg: float, params: StageParams) -> None:
    """Refuse a bearing that would wind up the cable.

    Raises:
        StageError: outside `min_deg` to `max_deg`, or not a number.
    """
    if not params.min_deg - 1e-6 <= bearing_deg <= params.max_deg + 1e-6:
        raise StageError(
            f"bearing {bearing_deg:g} deg is outside {params.min_deg:g} to {params.max_deg:g}: the cable would wind "
            "up; choose a bearing inside, or set stage.min_deg / stage.max_deg if nothing can"
        )
