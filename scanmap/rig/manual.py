"""A head turned by hand: the program asks, the user turns it, reads the scale and presses Enter."""

from __future__ import annotations

import math
from collections.abc import Callable

from scanmap.errors import StageError
from scanmap.rig.stage import StageParams, check_limits


class ManualStage:
    """A stage without a motor. Implements `scanmap.rig.Stage`."""

    laser_switchable = False

    def __init__(self, params: StageParams, ask: Callable[[str], str]) -> None:
        self._params = params
        self._ask = ask
        self._bearing_deg = params.home_deg

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest bearing [rad]."""
        return self._params.limits

    def move_to(self, bearing: float) -> float:
        """Ask the user to turn the head to `bearing` [rad]; returns what the user read off, or `bearing`.

        Raises:
            StageError: outside the limits, or nobody is there to answer.
        """
        target = math.degrees(bearing)
        check_limits(target, self._params)
        question = f"Turn the head to {target:.2f} deg and press Enter (or type the bearing you read): "
        while True:
            try:
                answer = self._ask(question).strip()
            except EOFError as error:
                raise StageError(
                    "nobody answers: a head turned by hand needs a terminal; for one with a motor set stage.kind"
                ) from error
            try:
                read = float(answer) if answer else target
                check_limits(read, self._params)
            except (ValueError, StageError):
                question = f"{answer!r} is no bearing from {self._params.min_deg:g} to {self._params.max_deg:g} deg: "
                continue
            self._bearing_deg = read
            return math.radians(read)

    def where(self) -> float:
        """The bearing last confirmed [rad]."""
        return math.radians(self._bearing_deg)

    def laser(self, on: bool) -> None:
        """Nothing: the user switches it."""

    def close(self) -> None:
        """Nothing to free."""
