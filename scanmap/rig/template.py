"""A stage that speaks a language of its own: command strings from the configuration, for home-made boards.

A sketch that reads `S90` and turns a servo is a stage with `command_move = "S{deg:.1f}"`. Such a board reports
no position, so the bearing is the commanded one.
"""

from __future__ import annotations

import logging
import math
import time

from scanmap.errors import ConfigError, StageError
from scanmap.rig.serial_port import SerialPort, open_serial
from scanmap.rig.stage import StageParams, check_limits

SERVO_CENTRE_US, SERVO_US_PER_DEG = 1500.0, 2000.0 / 180.0

logger = logging.getLogger(__name__)


class TemplateStage:
    """A stage driven by the command strings of `[stage]`. Implements `scanmap.rig.Stage`; not thread-safe."""

    def __init__(self, port: SerialPort, params: StageParams) -> None:
        """Takes over an open port.

        Raises:
            ConfigError: a command string has an unknown field.
        """
        self._port = port
        self._params = params
        self._bearing_deg = params.home_deg
        self._closed = False
        self._move_line(params.home_deg)

    @property
    def laser_switchable(self) -> bool:
        """Whether there are commands for both."""
        params = self._params
        return params.laser == "grbl" and bool(params.command_laser_on and params.command_laser_off)

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest bearing [rad]."""
        return self._params.limits

    def move_to(self, bearing: float) -> float:
        """Send the move, wait for the answer and for the time the way takes; returns `bearing` [rad].

        Raises:
            StageError: outside the limits, or no answer.
        """
        target = math.degrees(bearing)
        check_limits(target, self._params)
        if self._params.backlash_deg and target < self._bearing_deg:
            self._turn(target - self._params.backlash_deg)
        self._turn(target)
        return bearing

    def where(self) -> float:
        """The bearing last commanded [rad]."""
        return math.radians(self._bearing_deg)

    def laser(self, on: bool) -> None:
        """Switch the laser; does nothing where it cannot be switched."""
        if self.laser_switchable:
            self._command(self._params.command_laser_on if on else self._params.command_laser_off)

    def close(self) -> None:
        """Laser off, motor free, port closed; may be called twice and never raises."""
        if self._closed:
            return
        self._closed = True
        for line in (self._params.command_laser_off if self.laser_switchable else "", self._params.command_release):
            try:
                self._command(line)
            except StageError:
                logger.warning("%s did not confirm %r: look whether the laser is off", self._port.name, line)
        self._port.close()

    def _turn(self, target_deg: float) -> None:
        way_s = abs(target_deg - self._bearing_deg) / self._params.speed_deg_s
        started = time.monotonic()
        self._command(self._move_line(target_deg), extra_s=way_s)
        self._bearing_deg = target_deg
        # `ok` may mean planned, not done; the way takes this long at least.
        time.sleep(max(0.0, started + way_s - time.monotonic()))

    def _move_line(self, deg: float) -> str:
        fields = {
            "deg": deg,
            "rad": math.radians(deg),
            "feed": self._params.speed_deg_s * 60,
            "us": SERVO_CENTRE_US + SERVO_US_PER_DEG * (deg - (self._params.min_deg + self._params.max_deg) / 2),
        }
        try:
            return self._params.command_move.format(**fields)
        except (KeyError, ValueError, IndexError) as error:
            raise ConfigError(
                f"stage.command_move = {self._params.command_move!r} cannot be filled in ({error}): its fields are "
                "{deg}, {rad}, {feed}, {us}, as in 'G1 X{deg:.3f} F{feed:.0f}'"
            ) from error

    def _command(self, line: str, extra_s: float = 0.0) -> None:
        if not line:
            return
        self._port.drain()
        self._port.write_line(line)
        deadline = time.monotonic() + self._params.timeout_s + extra_s
        heard = ""
        while self._params.answer:
            answer = self._port.read_line(max(0.0, deadline - time.monotonic()))
            if answer is None:
                raise StageError(
                    f"stage {self._port.name} did not answer {self._params.answer!r} to {line!r} (last heard: "
                    f"{heard!r}): check stage.answer, stage.baud and the board's program"
                )
            if self._params.answer in answer:
                return
            heard = answer


def open_template(params: StageParams) -> TemplateStage:
    """Open the port of a home-made board; `auto` cannot recognise one.

    Raises:
        ConfigError: no port is named, or a command string has an unknown field.
        StageError: the port cannot be opened.
    """
    if params.port == "auto":
        raise ConfigError("stage.port = 'auto' cannot find a board of kind template: name its port")
    port = open_serial(params.port, params.baud)
    try:
        return TemplateStage(port, params)
    except BaseException:
        port.close()
        raise
