"""A recording read for its laser lines alone: what self-calibration and check work on."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

import numpy as np

from scanmap.calibration import Calibration
from scanmap.calibration.keeping import save_beside
from scanmap.errors import CalibrationError, RecordingError
from scanmap.pipeline import Pipeline, Step, checked
from scanmap.session.job import Job, Progress
from scanmap.shot import Shot
from scanmap.solvers.freedom import longer_length
from scanmap.solvers.marks import Marks, MarkSeeker
from scanmap.solvers.self_calibration import Refined
from scanmap.solvers.sight import Lines, LineStore

# A laser plane turned by so much must still lie in the columns that are searched.
SEARCH_RAD = np.radians(0.6)


@dataclass(frozen=True)
class Measured:
    """The lines of a recording and the head they were measured with."""

    lines: Lines
    marks: Marks | None  # on the turntable
    calibration: Calibration
    faults: list[str]


def measure_lines(job: Job, progress: Callable[[Progress], None], stop: Callable[[], bool]) -> Measured:
    """Find the line in every shot of a replay, a little beyond the columns that the calibration allows.

    On a turntable, the printed markers too.

    Raises:
        CalibrationError: the images are of another size.
        RecordingError: no shot, or none with a line.
        KeyboardInterrupt: it was stopped.
    """
    own = job.calibration.intrinsics
    pipeline = Pipeline(
        job.calibration, job.config.laserline, job.config.triangulation, slack_px=float(own.fx * SEARCH_RAD)
    )
    store, faults, done = LineStore(), list(job.source_faults), 0
    seeker = MarkSeeker() if longer_length(job.calibration) == "axis" else None

    def keep(step: Step) -> None:
        nonlocal done
        done += 1
        if step.fault:
            faults.append(f"shot {step.shot.index}: {step.fault}")
        store.add(step.line, step.shot.bearing)
        if seeker is not None:
            seeker.look(step.shot)
        found = int(np.isfinite(step.line.column_px).sum())
        progress(Progress(done, job.total, float(np.degrees(step.shot.bearing)), found, own.height))

    with closing(_closable(job.shots())) as shots, job.runner(pipeline) as run_shots:
        run_shots(checked(shots, pipeline), sinks=[keep], stop=stop)
    if stop():
        raise KeyboardInterrupt
    if not done:
        raise RecordingError("there is no shot in this recording")
    lines = store.lines()
    if not np.isfinite(lines.column_px).any():
        raise RecordingError("no laser line found in any shot: is the laser on, and is this the head's calibration?")
    return Measured(lines, seeker.marks() if seeker is not None else None, job.calibration, faults)


def write_refined(refined: Refined, out: Path, recording: Path, *, is_twin: bool) -> Path | None:
    """Write what self-calibration found; the calibration that was there is kept beside, and where it is returned.

    Raises:
        CalibrationError: it cannot be written, or it was not better.
    """
    if not refined.gained:
        raise CalibrationError("nothing is written: the calibration is no better than the one before")
    stale = {"laser_rms_px", *(("axis_rms_px",) if refined.scale == "baseline" else ())}
    residuals = {key: value for key, value in refined.after.residuals.items() if key not in stale}
    # What was a guess at the axis before is measured now; a turntable's axis was given.
    missing = [each for each in refined.after.meta.get("uncalibrated", ()) if each != "axis" or refined.scale == "axis"]
    before = {key: value for key, value in refined.after.meta.items() if key != "uncalibrated"}
    meta = {
        **before, **({"uncalibrated": missing} if missing else {}),
        "self_command": "calibrate self", "self_recording": recording.name, "self_date": date.today().isoformat(),
        "self_pieces": len(refined.segments), "self_scale": refined.scale,
        **({"source": "digital twin"} if is_twin else {}),
    }  # fmt: skip
    return save_beside(
        replace(refined.after, residuals={**residuals, "self_rms_px": refined.rms_after_px}, meta=meta), out
    )


def _closable(shots: Iterable[Shot]) -> Generator[Shot]:
    """Any source of shots as one that can be closed."""
    yield from shots
