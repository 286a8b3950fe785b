"""GRBL's planner and stepper for the twin: a queue of moves, feed hold, and the step counters."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from scanmap.twin.motion import Drivetrain, Move

QUEUE_MOVES = 15  # grbl's planner holds 16 blocks, one of them always free

Position = NDArray[np.float64]


class Planner:
    """Moves of three axes, one after the other; each stops before the next begins.

    Real grbl rounds the corner between moves of one direction without stopping; a scanner never queues any.
    """

    def __init__(self, drivetrain: Drivetrain) -> None:
        self._drivetrain = drivetrain
        self._steps_per_unit: Position = np.full(3, 80.0)
        self._moves: deque[Move] = deque()
        self._waiting: list[Move] = []  # what a hold put off
        self.steps = np.zeros(3, np.int64)  # the step counters: position as the board believes it
        self.held = False
        self.cancelling = False  # a jog brakes, and what is left of it is forgotten
        self._power: float | None = None

    def set_steps_per_unit(self, steps: Position) -> None:
        """`$100` to `$102` [steps/unit]; the counters stay, so the position reported changes."""
        self._steps_per_unit = steps

    @property
    def moving(self) -> bool:
        """Whether steps are being made."""
        return bool(self._moves)

    @property
    def busy(self) -> bool:
        """Whether anything is planned, held or not."""
        return bool(self._moves or self._waiting)

    @property
    def jogging(self) -> bool:
        """Whether what moves is a jog."""
        return bool(self._moves) and self._moves[0].is_jog

    @property
    def full(self) -> bool:
        """Whether the next move must wait."""
        return len(self._moves) + len(self._waiting) >= QUEUE_MOVES

    @property
    def free_blocks(self) -> int:
        """Moves that still fit, as `Bf:` reports them."""
        return QUEUE_MOVES - len(self._moves) - len(self._waiting)

    @property
    def end_time(self) -> float:
        """When all that moves will stand [s]; infinity if nothing moves."""
        return self._moves[-1].end_time if self._moves else math.inf

    @property
    def next_time(self) -> float:
        """When the present move ends [s]; infinity if nothing moves."""
        return self._moves[0].end_time if self._moves else math.inf

    def position(self) -> Position:
        """Machine position by the counters [units]."""
        return self.steps / self._steps_per_unit

    def target(self) -> Position:
        """Where the machine will stand when all is done [units]."""
        last = self._waiting or self._moves
        return last[-1].end if last else self.position()

    def speed(self, now: float) -> float:
        """Speed at this moment [units/s]."""
        return self._moves[0].speed_at(now) if self._moves else 0.0

    def take_power(self) -> float | None:
        """Power of the move begun last, if one began since this was asked last."""
        power, self._power = self._power, None
        return power

    def add(
        self,
        target: Position,
        speed: float,
        acceleration: float,
        now: float,
        *,
        is_jog: bool = False,
        power: float = 0.0,
    ) -> None:
        """Queue a move to `target` [units], rounded to whole steps."""
        start = self.target()
        end = np.rint(target * self._steps_per_unit) / self._steps_per_unit
        if np.array_equal(start, end):
            return
        begin = self._moves[-1].end_time if self._moves else now
        move = Move(start, end, speed, acceleration, begin, is_jog, power)
        (self._waiting if self.held else self._moves).append(move)

    def advance(self, now: float) -> None:
        """Make the steps that are due."""
        while self._moves and self._moves[0].end_time <= now:
            done = self._moves.popleft()
            self._power = done.power
            self._step_to(done.end)
        if self._moves:
            self._power = self._moves[0].power
            self._step_to(self._moves[0].position(now))
        else:
            self.cancelling = False

    def hold(self, now: float) -> None:
        """Brake, and put off the rest."""
        self.advance(now)
        if self.held:
            return
        self.held = True
        if self._moves:
            present, *rest = self._moves
            self._waiting = [present, *rest, *self._waiting]
            self._moves = deque([present.braked(now)])

    def resume(self, now: float) -> None:
        """Go on with what a hold put off; does nothing before it stands."""
        self.advance(now)
        if self.moving:
            return
        self.held = False
        waiting, self._waiting = self._waiting, []
        for move in waiting:
            self.add(move.end, move.speed, move.acceleration, now, is_jog=move.is_jog, power=move.power)

    def cancel(self, now: float) -> None:
        """Brake and forget the rest: a jog cancel."""
        self.hold(now)
        self._waiting = []
        self.held = False
        self.cancelling = self.moving

    def abort(self, now: float) -> None:
        """Stop dead and forget everything: a reset."""
        self.advance(now)
        self._moves.clear()
        self._waiting = []
        self.held = self.cancelling = False
        self._power = None

    def set_counter(self, axis: int, steps: int) -> None:
        """Name the present position of an axis anew: homing, power-up."""
        self.steps[axis] = steps
        if axis == 0:
            self._drivetrain.recount(steps)

    def _step_to(self, position: Position) -> None:
        self.steps = np.rint(position * self._steps_per_unit).astype(np.int64)
        self._drivetrain.follow(int(self.steps[0]))
