"""The stage on a GRBL board: one driver for grbl 1.1, grblHAL and FluidNC, real or twin.

The head is the board's X axis and one unit is one degree. A shot's bearing is what the board reports, a whole
number of motor steps, not what was asked for.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

from scanmap.errors import StageError
from scanmap.rig import grbl_protocol as protocol
from scanmap.rig.grbl_link import GrblLink, RefusedError
from scanmap.rig.grbl_position import BoardPosition
from scanmap.rig.grbl_protocol import Dialect
from scanmap.rig.grbl_settings import fit_settings, idle_setting_afterwards
from scanmap.rig.stage import StageParams, check_limits
from scanmap.rig.watchdog import Watchdog

HOMING_S = 120.0  # a board that homes answers nothing, not even `?`

logger = logging.getLogger(__name__)


class GrblStage:
    """A head on a GRBL board. Implements `scanmap.rig.Stage`; not thread-safe."""

    def __init__(self, link: GrblLink, dialect: Dialect, params: StageParams) -> None:
        """Take over a board that has just answered with its banner; `grbl_opening.open_grbl` makes one.

        Raises:
            StageError: the board is in an alarm that cannot be cleared, or its settings cannot be made to fit.
        """
        self._link = link
        self._params = params
        self.dialect = dialect
        self._position = BoardPosition(link, params.steps_per_deg)
        self._zero_deg = 0.0  # the board's X where the head stands at home_deg
        self._from_below = False  # whether the last arrival took up the play
        self._closed = False
        self._turning_to: float | None = None  # the board's X where a turn ends that was begun and not waited for
        self._full_feed = self._feed = params.speed_deg_s * 60  # [deg/min]: of all moves; what the board has now
        self._watchdog: Watchdog | None = None
        link.latches_errors = dialect is Dialect.GRBLHAL
        self._prepare()

    @property
    def name(self) -> str:
        """Firmware and port."""
        return f"{self.dialect.value} on {self._link.name}"

    @property
    def laser_switchable(self) -> bool:
        """False for a laser on batteries."""
        return self._params.laser == "grbl"

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest bearing [rad]."""
        return self._params.limits

    def move_to(self, bearing: float) -> float:
        """Turn to `bearing` [rad] and return the bearing reported after arrival [rad].

        Raises:
            StageError: outside the limits, no answer, reset, alarm, or not arrived.
        """
        return self._turn(bearing, self._arrive)

    def jog(self, bearing: float) -> float:
        """As `move_to`, but an interruption (Ctrl-C) stops the head where it is, with its place kept.

        Raises:
            StageError: as `move_to`.
        """
        return self._turn(bearing, self._arrive_by_jog)

    def watch_over(self, watchdog: Watchdog) -> None:
        """Keep a watchdog until `close`."""
        self._watchdog = watchdog

    @property
    def last_words(self) -> list[str]:
        """What leaves the board in peace after a reset, should this program not come to it: laser off, motor free."""
        if self.dialect.has_numbered_settings:
            return [f"$1={self._idle_ms:g}", protocol.RESET.decode(), "M5"]
        return ["M5", "$MD"]

    @property
    def _idle_ms(self) -> float:
        return idle_setting_afterwards(self._position.settings, self._params)

    def start_turn(self, bearing: float, speed: float) -> None:
        """Begin to turn to `bearing` [rad] at `speed` [rad/s] and return at once; `move_to` then arrives.

        Raises:
            StageError: outside the limits, or refused.
        """
        target = math.degrees(bearing)
        check_limits(target, self._params)
        if math.degrees(speed) > self._params.speed_deg_s * (1 + 1e-9):
            raise StageError(
                f"a turn at {math.degrees(speed):g} deg/s exceeds stage.speed_deg_s = {self._params.speed_deg_s:g}: "
                "turn slower (sweep.speed_deg_s), or raise the stage's"
            )
        self._link.in_motion = True
        self._feed = math.degrees(speed) * 60
        self._turning_to = self._x_of(target)
        self._link.command(f"G53 G1 X{self._turning_to:.4f} F{self._feed:.1f}")

    @property
    def homes_itself(self) -> bool:
        """Whether `home` needs nobody's hand."""
        return self._params.homing != "hand"

    def where(self) -> float:
        """The bearing reported now [rad].

        Raises:
            StageError: no answer, or the place is lost.
        """
        here = self._where_deg()
        if self._link.fault:
            raise StageError(self._link.fault)
        return math.radians(here)

    def stand_at(self, bearing: float) -> None:
        """From now on the place where the head stands is `bearing` [rad]: somebody who can see it says so.

        Raises:
            StageError: no answer.
        """
        machine_deg = self._position.now()
        self._zero_deg = machine_deg - self._params.direction * (math.degrees(bearing) - self._params.home_deg)
        self._from_below = False

    def laser(self, on: bool) -> None:
        """Switch the laser; does nothing where it cannot be switched.

        Raises:
            StageError: no answer, or refused.
        """
        if not self.laser_switchable:
            return
        if on:
            self._link.command(f"M3 S{self._params.laser_s:g}")
        elif self._link.in_motion or self._link.fault:
            self._link.stop()  # M5 would wait for the end of the way, and be refused in an alarm; a reset is obeyed
        else:
            try:
                self._link.command("M5")
            except StageError as error:  # an alarm nobody has told of yet
                logger.warning("%s, so the laser is switched off by a reset", error)
                self._link.stop()

    def home(self) -> float:
        """Find `home_deg` as `[stage] homing` says and return the bearing reported [rad].

        By hand: where the head stands now is `home_deg`.

        Raises:
            StageError: no switch or mark was found.
        """
        if self._link.fault:
            self._link.reset()  # a board that a limit switch stopped hears nothing else
            self._link.fault = None
        if self._params.homing == "switch":
            self._seek_switch()
        else:
            self._unlock()
        self._link.fault = None
        for line in self._link.preamble:
            self._link.command(line)
        by_index = self._params.homing == "index"
        self._zero_deg = self._find_index() if by_index else self._position.now()
        self._from_below = False
        return self.where()

    def close(self) -> None:
        """Laser off, motor free, port closed; may be called twice and never raises."""
        if self._closed:
            return
        self._closed = True
        try:
            self.laser(False)
            if self._link.in_motion:
                self._link.stop()
            if self.dialect.has_numbered_settings:  # the reset that follows lets the motor go
                self._link.command(f"$1={self._idle_ms:g}", despite_fault=True)
        except StageError as error:
            logger.warning("%s was not shut down in order but told to reset (%s)", self._link.name, error)
        finally:
            try:
                self._link.leave(*([] if self.dialect.has_numbered_settings else ["$MD"]))
            except StageError:
                logger.warning("%s is gone: switch the laser off by hand", self._link.name)
            self._link.close()
            if self._watchdog:
                self._watchdog.dismiss()

    def _prepare(self) -> None:
        if self._position.status().state == "Alarm" and self._params.homing != "switch":
            self._unlock()
        self._link.fault = None
        self._position.settings = fit_settings(self._link, self.dialect, self._params)
        # G1 as the standing mode: a board in laser mode lights a standing laser only then.
        self._link.preamble = [f"G21 G90 G94 G1 F{self._full_feed:.1f}"]
        if self._params.homing == "hand":
            for line in self._link.preamble:
                self._link.command(line)
        else:
            self.home()
        self.laser(False)
        if self._link.lit_by_startup and self.laser_switchable:
            logger.warning(
                "%s switched its laser on by a startup line, and does so after every reset: clear $N0 and $N1 "
                "(`$N0=`); it is off now",
                self._link.name,
            )

    def _unlock(self) -> None:
        for attempt in range(2):
            self._link.command("$X", despite_fault=True)
            if self._link.status().state != "Alarm":
                break
            if attempt == 0:
                self._link.reset()
        else:
            raise StageError(self._link.fault or f"stage {self._link.name} stays in alarm: check its limit switches")
        self._link.fault = None

    def _seek_switch(self) -> None:
        alone = self.dialect is Dialect.FLUIDNC or (
            self.dialect is Dialect.GRBLHAL and bool(int(self._position.settings.get("22", 0.0)) & 2)
        )
        self._link.command("$HX" if alone else "$H", despite_fault=True, silence_s=HOMING_S)
        if self._link.status().state == "Alarm":  # grbl says ok although it found no switch
            raise StageError(self._link.fault or f"stage {self._link.name} could not home")

    def _find_index(self) -> float:
        """Turn toward smaller bearings until the probe input sees the mark; the board's X of the mark."""
        travel = self._params.direction * (self._params.max_deg - self._params.min_deg)
        self._feed = self._full_feed / 4
        answers = self._link.command(f"G91 G38.2 X{-travel:.3f} F{self._feed:.1f}", silence_s=HOMING_S)
        self._link.command("G90")
        found = next(filter(None, map(protocol.parse_probe, answers)), None)
        if found is None:
            raise StageError(f"stage {self._link.name} did not say where the index mark is: check the probe input")
        return self._position.whole_steps(found)

    def _turn(self, bearing: float, arrive: Callable[[float], None]) -> float:
        target = math.degrees(bearing)
        check_limits(target, self._params)
        if self._params.backlash_deg:
            way = target - self._where_deg()
            if way < 0 or (not self._from_below and way < self._params.backlash_deg):
                self._go(target - self._params.backlash_deg, arrive)
            self._from_below = True
        return math.radians(self._go(target, arrive))

    def _go(self, target_deg: float, arrive: Callable[[float], None]) -> float:
        """Move, prove the arrival, and return the bearing reported [deg]."""
        here = math.nan
        for _ in range(2):  # a line damaged on its way can name another target
            arrive(self._x_of(target_deg))
            here = self._where_deg()
            if abs(here - target_deg) <= self._position.arrival_deg:
                return here
        raise StageError(
            f"stage {self._link.name} was asked for {target_deg:g} deg and stands at {here:g}: check for a blocked "
            "head or a limit switch, then `scanmap stage home`"
        )

    def _arrive(self, x: float) -> None:
        """Without F: a board that has restarted, and whose banner got lost, has none and refuses."""
        if self._feed != self._full_feed:
            if self._turning_to is not None and self._link.in_motion:  # a reset has ended the turn
                self._link.command(f"G53 G1 X{self._turning_to:.4f}")
            self._feed, self._turning_to = self._full_feed, None
            self._link.command(f"G1 F{self._feed:.1f}")
        self._link.command(f"G53 G1 X{x:.4f}")
        self._link.command("G4 P0.01")  # answered only when all that was planned is done
        self._link.in_motion = False

    def _arrive_by_jog(self, x: float) -> None:
        """A jog to a place, not by a distance: sent twice for a lost `ok`, it must not go twice as far."""
        try:
            self._link.jog(f"$J=G53 G21 X{x:.4f} F{self._full_feed:.1f}")
        except RefusedError as refusal:
            if not refusal.is_unknown:
                raise
            self._arrive(x)

    def _x_of(self, bearing_deg: float) -> float:
        """The board's X at a bearing."""
        return self._zero_deg + self._params.direction * (bearing_deg - self._params.home_deg)

    def _where_deg(self) -> float:
        return self._params.home_deg + self._params.direction * (self._position.now() - self._zero_deg)
