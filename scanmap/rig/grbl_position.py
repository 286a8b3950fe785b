"""Where a GRBL board says its X axis stands, in degrees and whole motor steps."""

from __future__ import annotations

from scanmap.errors import StageError
from scanmap.rig import grbl_protocol as protocol
from scanmap.rig.grbl_link import GrblLink
from scanmap.rig.grbl_protocol import Status

REPORT_DEG = 0.001  # resolution of a status report
REPORT_INCH_DEG = 25.4e-4  # the same for a board that reports in inches ($13=1)
STEP_DEG_UNKNOWN = 0.1  # how far off an arrival may be where the board does not tell its steps
OFFSET_REPORTS = 12  # a board at rest that tells its work offset does so with every 10th report


class BoardPosition:
    """Reads status reports; knows the board's units, steps and work offset."""

    def __init__(self, link: GrblLink, steps_per_deg: float | None) -> None:
        """`steps_per_deg` as the rig has it, None where the board is to be believed [1/deg]."""
        self._link = link
        self._steps_per_deg = steps_per_deg
        self._work_offset: tuple[float, ...] | None = None
        self.settings: dict[str, float] = {}  # the board's, by number

    def status(self) -> Status:
        """A status report; where it is in work coordinates, the offset is known afterwards.

        Raises:
            StageError: none came, or the offset cannot be learned.
        """
        status = self._link.status()
        for _ in range(OFFSET_REPORTS):
            if status.work_offset is not None:
                self._work_offset = status.work_offset
            if not status.is_work or self._work_offset is not None:
                return status
            status = self._link.status()
        self._work_offset = self._ask_offset()
        return status

    def now(self) -> float:
        """The board's X in machine coordinates [deg].

        Raises:
            StageError: as `status`.
        """
        status = self.status()
        x = status.position[0]
        if status.is_work and self._work_offset:
            x += self._work_offset[0]
        return self.whole_steps(x)

    @property
    def resolution_deg(self) -> float:
        """The least difference between two reports [deg]."""
        return REPORT_INCH_DEG if self.settings.get("13") else REPORT_DEG

    @property
    def arrival_deg(self) -> float:
        """How far from its target a head may be reported that has arrived [deg]."""
        step = 1.0 / self.settings["100"] if self.settings.get("100") else STEP_DEG_UNKNOWN
        return step + self.resolution_deg

    def whole_steps(self, reported: float) -> float:
        """A reported X as the whole motor step that it stands for [deg].

        A board tells `$100` with three decimals (4.444 for 4.44444), whatever it counts with. That is enough to
        know the step; where the rig says how many make a degree, the rig is believed.
        """
        x = reported * 25.4 if self.settings.get("13") else reported  # $13 makes degrees "inches" too
        told = self.settings.get("100")
        if not told:
            return x
        count = round(x * told)
        if self._steps_per_deg:
            return count / self._steps_per_deg
        return count / told if abs(count / told - x) <= self.resolution_deg else x

    def _ask_offset(self) -> tuple[float, ...]:
        """What a grblHAL leaves out whose `$10` says so."""
        modes = " ".join(self._link.command("$G", despite_fault=True)).replace("[GC:", " ").split()
        offsets = protocol.parse_offsets(self._link.command("$#", despite_fault=True))
        system = next((mode for mode in modes if mode in offsets and mode.startswith("G5")), None)
        if system is None:
            raise StageError(
                f"stage {self._link.name} reports work positions without their offset: set $10=1, or add 32 to it"
            )
        g92 = offsets.get("G92", (0.0,) * len(offsets[system]))
        return tuple(a + b for a, b in zip(offsets[system], g92, strict=True))
