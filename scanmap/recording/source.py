"""`Source`: anything that can be replayed, as a stream of `Shot`s with what is known about it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from scanmap.calibration import Calibration
from scanmap.errors import CalibrationError, RecordingError
from scanmap.recording.layout import DIGITAL_TWIN
from scanmap.shot import Shot

Report = Callable[[str], None]  # takes one fault, one line


@dataclass
class Source:
    """A recording, a folder of frames or a video, opened; `shots` may be called again and again."""

    path: Path
    kind: Literal["recording", "frames", "video"]
    read: Callable[[Report], Iterator[Shot]]  # streams the shots, reports what is missing or damaged
    calibration_toml: str = ""  # text of the calibration that came with it; empty when none did
    rig_toml: str = ""  # text of the rig's configuration; empty when none came with it
    metadata: dict[str, str] = field(default_factory=dict)
    count: int | None = None  # shots it should hold, as far as that is known beforehand
    parts: tuple[Path, ...] = ()  # the files of a recording, in order
    end_reason: str = ""  # `finished`, `interrupted`, `error: ...`, `cut`; empty where nobody noted it
    faults: list[str] = field(default_factory=list)  # one line each; complete when `shots` has ended

    def shots(self, on_fault: Report | None = None) -> Iterator[Shot]:
        """Every shot in order, streaming: memory does not grow with their number.

        What is missing or damaged costs its own shot and nothing else: the fault goes to `faults` and to
        `on_fault`, and reading goes on.

        Raises:
            RecordingError: there is nothing to read at all, or the disk fails.
        """
        self.faults.clear()

        def report(fault: str) -> None:
            self.faults.append(fault)
            if on_fault is not None:
                on_fault(fault)

        return self._guarded(report)

    def _guarded(self, report: Report) -> Iterator[Shot]:
        try:
            yield from self.read(report)
        except OSError as error:
            raise RecordingError(f"{self.path} cannot be read any further: {error.strerror or error}") from error

    @property
    def has_calibration(self) -> bool:
        """Whether a calibration came with it."""
        return bool(self.calibration_toml)

    def calibration(self) -> Calibration:
        """The calibration that came with it.

        Raises:
            CalibrationError: none did, or it is damaged.
        """
        if not self.calibration_toml:
            raise CalibrationError(f"{self.path} carries no calibration; give one with --calibration calibration.toml")
        return Calibration.loads(self.calibration_toml, source=f"calibration of {self.path}")

    @property
    def is_twin(self) -> bool:
        """Whether it comes from the digital twin; what is made of it must say so."""
        return self.metadata.get("source") == DIGITAL_TWIN


def text_beside(path: Path) -> str:
    """Text of a file that may come along; empty where it does not.

    Raises:
        RecordingError: it is there but cannot be read.
    """
    if not path.exists():
        return ""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error
