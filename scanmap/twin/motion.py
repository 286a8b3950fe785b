"""What moves in the twin: trapezoidal moves as GRBL's planner makes them, and the gear that follows them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field


class DriveParams(BaseModel, frozen=True, extra="forbid"):
    """The twin's head as it stands and turns; `[twin.drive]`."""

    head_deg: float = Field(
        0.0, ge=-3600, le=3600, description="true bearing of the head when its board is switched on [deg]"
    )
    backlash_deg: float = Field(0.0, ge=0, le=10, description="play between motor and head [deg]")
    switch_deg: float | None = Field(
        None, ge=-3600, le=3600, description="true bearing of a limit switch, for stage.homing = 'switch' [deg]"
    )
    index_deg: float | None = Field(
        None, ge=-3600, le=3600, description="true bearing of an index mark, for stage.homing = 'index' [deg]"
    )


@dataclass(frozen=True)
class Move:
    """A straight move from rest to rest with limited speed and acceleration.

    `start` and `end` are machine positions of the three axes [units]; the spindle gets `power` where a move begins.
    """

    start: NDArray[np.float64]
    end: NDArray[np.float64]
    speed: float  # [units/s]
    acceleration: float  # [units/s^2]
    start_time: float  # [s]
    is_jog: bool = False
    power: float = 0.0  # S word of a move under M3 or M4

    @property
    def length(self) -> float:
        """Path length [units]."""
        return float(np.linalg.norm(self.end - self.start))

    @property
    def duration(self) -> float:
        """From rest to rest [s]."""
        ramp = self._ramp_s()
        peak = self.acceleration * ramp
        return 2 * ramp + (max(0.0, self.length - peak * ramp) / peak if peak else 0.0)

    @property
    def end_time(self) -> float:
        """When it stands again [s]."""
        return self.start_time + self.duration

    def travelled(self, time: float) -> float:
        """Path covered until `time` [units]."""
        ramp, total = self._ramp_s(), self.duration
        t = min(max(time - self.start_time, 0.0), total)
        if t < ramp:
            return 0.5 * self.acceleration * t * t
        if t > total - ramp:
            return self.length - 0.5 * self.acceleration * (total - t) ** 2
        return self.acceleration * ramp * (t - 0.5 * ramp)

    def speed_at(self, time: float) -> float:
        """Speed along the path [units/s]."""
        ramp, total = self._ramp_s(), self.duration
        t = time - self.start_time
        return self.acceleration * min(max(t, 0.0), max(total - t, 0.0), ramp)

    def position(self, time: float) -> NDArray[np.float64]:
        """Machine position at `time`."""
        return self.at_length(self.travelled(time))

    def at_length(self, travelled: float) -> NDArray[np.float64]:
        """Machine position after a stretch of the path."""
        share = travelled / self.length if self.length else 1.0
        return self.start + (self.end - self.start) * share

    def braked(self, time: float) -> Move:
        """The same move, brought to rest from `time` on; as a new move from there."""
        speed = self.speed_at(time)
        start = self.position(time)
        distance = min(0.5 * speed**2 / self.acceleration, self.length - self.travelled(time))
        return Brake(
            start=start,
            end=self.at_length(self.travelled(time) + distance),
            speed=speed,
            acceleration=self.acceleration,
            start_time=time,
            is_jog=self.is_jog,
            power=self.power,
        )

    def _ramp_s(self) -> float:
        return min(self.speed / self.acceleration, math.sqrt(self.length / self.acceleration))


@dataclass(frozen=True)
class Brake(Move):
    """A move that begins at `speed` and ends at rest: a feed hold."""

    @property
    def duration(self) -> float:
        """Until rest [s]."""
        return self.speed / self.acceleration

    def travelled(self, time: float) -> float:
        """Path covered until `time` [units]."""
        t = min(max(time - self.start_time, 0.0), self.duration)
        return min(self.length, self.speed * t - 0.5 * self.acceleration * t * t)

    def speed_at(self, time: float) -> float:
        """Speed along the path [units/s]."""
        return max(0.0, self.speed - self.acceleration * max(0.0, time - self.start_time))


@dataclass
class Drivetrain:
    """From motor steps to the true bearing of the head. Every attribute is a knob and may be turned at any time."""

    steps_per_deg: float = 80.0  # of the gear as built, whatever $100 says
    backlash_deg: float = 0.0  # play between motor and head
    stalled: bool = False  # the motor hums and does not turn
    bearing_deg: float = 0.0  # the head's true bearing

    def __post_init__(self) -> None:
        self._counted = 0  # what the board believes
        self._made = 0  # steps that the motor really made
        self._start_deg = self.bearing_deg

    def follow(self, steps: int) -> None:
        """The board's step count is now `steps`; monotonic since the last call."""
        change, self._counted = steps - self._counted, steps
        if not self.stalled:
            self._turn(change)

    def recount(self, steps: int) -> None:
        """The board set its count anew; the head stays where it is."""
        self._counted = steps

    def slip(self, steps: int) -> None:
        """Lose `steps`: the board counted them, the motor fell back by them."""
        self._turn(-steps)

    def _turn(self, steps: int) -> None:
        self._made += steps
        shaft = self._start_deg + self._made / self.steps_per_deg
        play = self.backlash_deg / 2
        self.bearing_deg = min(max(self.bearing_deg, shaft - play), shaft + play)
