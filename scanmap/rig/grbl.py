"""The stage on a GRBL board: one driver for grbl 1.1, grblHAL and FluidNC, real or twin.

The head is the board's X axis and one unit is one degree. A shot's bearing is what the board reports, a whole
number of motor steps, not what was asked for.
"""

from __future__ import annotations

import logging
import math

from scanmap.errors import StageError
from scanmap.rig import grbl_protocol as protocol
from scanmap.rig.grbl_link import GrblLink
from scanmap.rig.grbl_protocol import Dialect, Status
from scanmap.rig.grbl_settings import fit_settings, idle_setting_afterwards
from scanmap.rig.stage import StageParams, check_limits
from scanmap.rig.watchdog import Watchdog

HOMING_S = 120.0  # a board that homes answers nothing, not even `?`
REPORT_DEG = 0.001  # resolution of a status report
REPORT_INCH_DEG = 25.4e-4  # the same for a board that reports in inches ($13=1)
STEP_DEG_UNKNOWN = 0.1  # how far off an arrival may be where the board does not tell its steps
FAREWELL_S = 0.5  # how long the last reset may take to be confirmed

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
        self._settings: dict[str, float] = {}
        self._zero_deg = 0.0  # the board's X where the head stands at home_deg
        self._work_offset: tuple[float, ...] | None = None
        self._from_below = False  # whether the last arrival took up the play
        self._closed = False
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
        target = math.degrees(bearing)
        check_limits(target, self._params)
        if self._params.backlash_deg:
            way = target - self._where_deg()
            if way < 0 or (not self._from_below and way < self._params.backlash_deg):
                self._go(target - self._params.backlash_deg)
            self._from_below = True
        return math.radians(self._go(target))

    def watch_over(self, watchdog: Watchdog) -> None:
        """Keep a watchdog until `close`."""
        self._watchdog = watchdog

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
        self._link.command(f"G53 G1 X{self._x_of(target):.4f} F{math.degrees(speed) * 60:.1f}")

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
        machine_deg = self._machine_deg(self._status())
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
        self._zero_deg = self._find_index() if by_index else self._machine_deg(self._status())
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
                self._link.command(f"$1={idle_setting_afterwards(self._settings):g}", despite_fault=True)
        except StageError as error:
            logger.warning("%s was not shut down in order but told to reset (%s)", self._link.name, error)
        finally:
            try:
                self._link.send_reset()
                if self._link.await_banner(FAREWELL_S) and not self.dialect.has_numbered_settings:
                    self._link.command("$MD", despite_fault=True)  # before the reset it would be undone by it
            except StageError:
                logger.warning("%s is gone: switch the laser off by hand", self._link.name)
            self._link.close()
            if self._watchdog:
                self._watchdog.dismiss()

    def _prepare(self) -> None:
        if self._status().state == "Alarm" and self._params.homing != "switch":
            self._unlock()
        self._link.fault = None
        self._settings = fit_settings(self._link, self.dialect, self._params)
        # G1 as the standing mode: a board in laser mode lights a standing laser only then.
        self._link.preamble = [f"G21 G90 G94 G1 F{self._params.speed_deg_s * 60:.1f}"]
        if self._params.homing == "hand":
            for line in self._link.preamble:
                self._link.command(line)
        else:
            self.home()
        self.laser(False)

    def _unlock(self) -> None:
        for attempt in range(2):
            self._link.command("$X", despite_fault=True)
            if self._status().state != "Alarm":
                break
            if attempt == 0:
                self._link.reset()
        else:
            raise StageError(self._link.fault or f"stage {self._link.name} stays in alarm: check its limit switches")
        self._link.fault = None

    def _seek_switch(self) -> None:
        alone = self.dialect is Dialect.FLUIDNC or (
            self.dialect is Dialect.GRBLHAL and bool(int(self._settings.get("22", 0.0)) & 2)
        )
        self._link.command("$HX" if alone else "$H", despite_fault=True, silence_s=HOMING_S)
        if self._status().state == "Alarm":  # grbl says ok although it found no switch
            raise StageError(self._link.fault or f"stage {self._link.name} could not home")

    def _find_index(self) -> float:
        """Turn toward smaller bearings until the probe input sees the mark; the board's X of the mark."""
        travel = self._params.direction * (self._params.max_deg - self._params.min_deg)
        feed = self._params.speed_deg_s * 60 / 4
        answers = self._link.command(f"G91 G38.2 X{-travel:.3f} F{feed:.1f}", silence_s=HOMING_S)
        self._link.command("G90")
        found = next(filter(None, map(protocol.parse_probe, answers)), None)
        if found is None:
            raise StageError(f"stage {self._link.name} did not say where the index mark is: check the probe input")
        return self._whole_steps(found)

    def _go(self, target_deg: float) -> float:
        """Move, prove the arrival, and return the bearing reported [deg]."""
        params = self._params
        x = self._x_of(target_deg)
        here = math.nan
        for _ in range(2):  # a line damaged on its way can name another target
            self._link.command(f"G53 G1 X{x:.4f} F{params.speed_deg_s * 60:.1f}")
            self._link.command("G4 P0.01")  # answered only when all that was planned is done
            self._link.in_motion = False
            here = self._where_deg()
            step = 1.0 / self._settings["100"] if self._settings.get("100") else STEP_DEG_UNKNOWN
            if abs(here - target_deg) <= step + self._report_deg:
                return here
        raise StageError(
            f"stage {self._link.name} was asked for {target_deg:g} deg and stands at {here:g}: check for a blocked "
            "head or a limit switch, then `scanmap stage home`"
        )

    def _x_of(self, bearing_deg: float) -> float:
        """The board's X at a bearing."""
        return self._zero_deg + self._params.direction * (bearing_deg - self._params.home_deg)

    def _where_deg(self) -> float:
        x = self._machine_deg(self._status())
        return self._params.home_deg + self._params.direction * (x - self._zero_deg)

    def _status(self) -> Status:
        status = self._link.status()
        if status.work_offset is not None:
            self._work_offset = status.work_offset
        for _ in range(40):  # the offset comes with every 10th to 30th report
            if not status.is_work or self._work_offset is not None:
                break
            status = self._link.status()
            self._work_offset = status.work_offset
        return status

    def _machine_deg(self, status: Status) -> float:
        """The board's X [deg]."""
        x = status.position[0]
        if status.is_work and self._work_offset:
            x += self._work_offset[0]
        return self._whole_steps(x)

    @property
    def _report_deg(self) -> float:
        return REPORT_INCH_DEG if self._settings.get("13") else REPORT_DEG

    def _whole_steps(self, reported: float) -> float:
        """A reported X [deg] as the whole motor step that it stands for.

        A board tells `$100` with three decimals (4.444 for 4.44444), whatever it counts with. That is enough to
        know the step; where the rig says how many make a degree, the rig is believed.
        """
        x = reported * 25.4 if self._settings.get("13") else reported  # $13 makes degrees "inches" too
        told = self._settings.get("100")
        if not told:
            return x
        count = round(x * told)
        if self._params.steps_per_deg:
            return count / self._params.steps_per_deg
        return count / told if abs(count / told - x) <= self._report_deg else x
