"""A session at work: shots in, steps to every sink, results written however it ended."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Collection, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from scanmap.calibration import Calibration
from scanmap.config import Config
from scanmap.errors import RecordingError, ScanmapError
from scanmap.grid import OccupancyGrid
from scanmap.laserline import Reason
from scanmap.pipeline import Pipeline, Processes, Runner, SecondLook, Sink, Step, checked, run, worth_processes
from scanmap.recording import Recorder, first_part
from scanmap.scan import Scan
from scanmap.scan.mirrors import without_mirrors
from scanmap.scan.second_lines import Pictures
from scanmap.scan.surface import remove_outliers
from scanmap.session.noting import noting
from scanmap.session.outputs import Outputs, write_results
from scanmap.session.refining import Refinement
from scanmap.session.settling import read_again, settle
from scanmap.session.summary import Summary, summarise
from scanmap.shot import Shot, Withdrawal
from scanmap.twin import Truth, TruthReport
from scanmap.view import View
from scanmap.view.viewer import has_display

# While a scan runs the viewer's map is made anew this often [shots].
MAP_EVERY = 20
MOST_EXPECTED = 4096  # bearings that room is made for beforehand, whatever a recording says it holds


@dataclass(frozen=True)
class Progress:
    """How far a session is."""

    done: int  # shots
    total: int | None  # None where the source does not know
    bearing_deg: float
    rows_found: int
    rows: int


@dataclass(frozen=True)
class Result:
    """How a session ended, and with what."""

    scan: Scan  # merged and filtered
    grid: OccupancyGrid | None  # None where the scan has no point to make one of
    summary: Summary
    ended: str  # finished, interrupted, or error: ...
    shots: int = 0  # that were processed; passes and repeated bearings count each
    error: Exception | None = None  # what ended the scan early, or left nothing to write
    faults: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    unwritten: list[tuple[Path, str]] = field(default_factory=list)
    truth: TruthReport | None = None
    next_commands: list[str] = field(default_factory=list)

    @property
    def floor_note(self) -> str:
        """How the floor was found, one line; empty without a grid."""
        return self.grid.floor.words if self.grid is not None and self.grid.floor is not None else ""


@dataclass
class Job:
    """One scan or replay, opened; a context manager that closes what it holds."""

    config: Config
    calibration: Calibration
    outputs: Outputs
    shots: Callable[[], Iterable[Shot]]
    total: int | None
    comments: dict[str, Any]  # go into every file: source, software version
    announcement: list[str] = field(default_factory=list)
    recorded: bool = False  # the shots come as fast as they are read, not as a camera takes them
    recorder: Recorder | None = None
    view: View | None = None
    truth: Truth | None = None
    source_faults: list[str] = field(default_factory=list)
    earlier: Callable[[], Iterable[Shot]] | None = None  # shots of the parts that this scan continues
    refinement: Refinement | None = None  # of an adaptive sweep
    closers: list[Callable[[], None]] = field(default_factory=list)
    done: int = 0  # shots processed so far
    faults: list[str] = field(default_factory=list)  # seen so far, one line each
    _last_s: float = 0.0  # time of the last shot
    _handed_out_indices: list[int] = field(default_factory=list)  # of shots, in the order in which they reach the scan
    _withdrawn: set[int] = field(default_factory=set)  # places of shots in that list

    def __enter__(self) -> Job:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for close in reversed(self.closers):
            close()
        self._leave_nothing_empty()

    def run(self, progress: Callable[[Progress], None], stop: Callable[[], bool]) -> Result:
        """Process every shot and write the results.

        A fault that ends the scan early, foreseen or not, is in the result's `error`, beside everything scanned
        before it.

        Raises:
            Exception: the very first shot failed, so there is nothing to keep; a ScanmapError where foreseen.
        """
        expected = min(self.total or 0, MOST_EXPECTED)
        scan = Scan(self.calibration.mount, self.calibration.intrinsics.height, self.comments, expected)
        ended = "finished"
        error: Exception | None = None
        try:
            pipeline = Pipeline(self.calibration, self.config.laserline, self.config.triangulation)
            second_look = SecondLook(pipeline)
            sinks: list[Sink] = [*self._sinks(scan, progress), second_look]
            # Closed here, not when Python gets round to it: the sweep switches the laser off as it ends.
            with noting(self.note), closing(self._recorded()) as shots, self.runner(pipeline) as run_shots:
                run_shots(checked(shots, pipeline), sinks=sinks, stop=stop)
            if stop():
                ended = "interrupted"
        except KeyboardInterrupt:
            ended = "interrupted"
        except Exception as raised:
            kind = "" if isinstance(raised, ScanmapError) else f"{type(raised).__name__}: "
            ended, error = f"error: {kind}{raised}", raised
        finally:
            if ended == "finished" and self.recorder is not None and len(scan) and not scan.valid.any():
                ended = "error: no laser line in any shot"
                self._take_back(self._handed_out_indices, Withdrawal.LINE)
            self._close_recording(ended)
        if error is not None and not len(scan):
            raise error
        if not len(scan):
            if ended == "interrupted":
                raise KeyboardInterrupt
            raise RecordingError("; ".join(["there is no shot to make a scan of", *self.source_faults[:1]]))
        if self.config.scan.second_look:
            own = self.shots if self.recorded else None
            self.faults += settle(second_look, scan, [self.earlier, read_again(self.recorder) or own], self._withdrawn)
        return self._finished(scan, second_look.pictures(), ended, error)

    def withdraw(self, indices: Collection[int], why: Withdrawal) -> None:
        """Take back shots handed out so far: they stay in the recording, but nothing is made of them."""
        self._withdrawn.update(k for k, index in enumerate(self._handed_out_indices) if index in indices)
        self._take_back(indices, why)

    def note(self, fault: str, part: str = "sweep") -> None:
        """Keep a fault that was overcome, in the result and in the recording."""
        self.faults.append(fault)
        if self.recorder is not None and not self.recorder.closed:
            self.recorder.fault(fault, part=part, seconds=self._last_s)

    @contextmanager
    def runner(self, pipeline: Pipeline) -> Iterator[Runner]:
        """What processes shots on all cores; a live scan waits for its camera, not for a core."""
        if self.refinement is not None:
            yield partial(run, process=self.refinement.collecting(pipeline.process))
        elif not self.recorded or not worth_processes(self.total):
            yield partial(run, process=pipeline.process)
        else:
            with Processes(pipeline) as workers:
                yield workers.run

    def _recorded(self) -> Generator[Shot]:
        """The shots, each in the recording before anything is done with it."""
        source = self.shots()
        try:
            for shot in self.earlier() if self.earlier is not None else ():
                yield self._handed_out(shot)
            for shot in source:
                yield self._handed_out(self.recorder.write(shot) if self.recorder is not None else shot)
        finally:
            if isinstance(source, Generator):
                source.close()

    def _handed_out(self, shot: Shot) -> Shot:
        self._last_s = shot.time
        self._handed_out_indices.append(shot.index)
        return self.refinement.hand_out(shot) if self.refinement is not None else shot

    def _sinks(self, scan: Scan, progress: Callable[[Progress], None]) -> list[Sink]:
        def collect(step: Step) -> None:
            scan.add(step.profile, step.shot.bearing)
            self.done += 1
            if step.fault:
                self.faults.append(f"shot {step.shot.index} at {np.degrees(step.shot.bearing):.3f} deg: {step.fault}")
                if self.recorder is not None:
                    self.recorder.fault(step.fault, part="camera", seconds=step.shot.time)

        def report(step: Step) -> None:
            found = int(np.isfinite(step.profile.range_m).sum())
            progress(Progress(len(scan), self.total, float(np.degrees(step.shot.bearing)), found, scan.rows))

        sinks: list[Sink] = [collect]
        if self.view is not None:
            sinks += [self.view.step, self._map_while_scanning(scan, self.view)]
        return [*sinks, report]

    def _map_while_scanning(self, scan: Scan, view: View) -> Sink:
        def show(step: Step) -> None:
            if len(scan) % MAP_EVERY == 0 and scan.valid.any():
                view.grid(OccupancyGrid.from_scan(scan.merged(self.config.scan.merge_deg), self.config.grid))

        return show

    def _take_back(self, indices: Collection[int], why: Withdrawal) -> None:
        if self.recorder is not None and not self.recorder.closed:
            self.recorder.withdraw(set(indices), why, seconds=self._last_s)

    def _close_recording(self, ended: str) -> None:
        if self.recorder is None:
            return
        try:
            self.recorder.close(ended)
        except RecordingError as error:
            self.faults.append(str(error))

    def _finished(self, scan: Scan, pictures: Pictures | None, ended: str, error: Exception | None) -> Result:
        if self._withdrawn:
            scan = scan.taken(np.array([k for k in range(len(scan)) if k not in self._withdrawn], np.intp))
        clean = finished_scan(scan, self.config, pictures)
        summary = summarise(clean, self.calibration)
        grid, files, unwritten = None, list[Path](), list[tuple[Path, str]]()
        if summary.points:
            with ThreadPoolExecutor(1) as beside:
                drawn = beside.submit(OccupancyGrid.from_scan, clean, self.config.grid)
                files, unwritten = write_results(clean, drawn.result, self.outputs.after(ended), self.config.scan)
            grid = drawn.result()
        else:
            error = error or RecordingError(self._pointless(summary))
        self._close_view(clean, grid, ended, files, unwritten)
        if self.recorder is not None:
            files.append(self.recorder.path)
        return Result(
            scan=clean,
            grid=grid,
            summary=summary,
            ended=ended,
            shots=self.done,
            error=error,
            faults=[*self.source_faults, *self.faults],
            files=files,
            unwritten=unwritten,
            truth=self.truth.compare(clean.points[clean.valid], clean.bearings) if self.truth is not None else None,
            next_commands=self._next_commands(files, ended),
        )

    def _close_view(
        self, scan: Scan, grid: OccupancyGrid | None, ended: str, files: list[Path], unwritten: list[tuple[Path, str]]
    ) -> None:
        if self.view is None:
            return
        self.view.finish(scan, grid)
        self.view.close()
        if (drawn := self.view.rrd) is not None and self.view.whole:
            files.append(self.outputs.placed_rrd(drawn, ended))
        elif drawn is not None:
            drawn.unlink(missing_ok=True)  # without its end no viewer opens it
            unwritten.append((drawn, "it could not be written to its end; is the disk full?"))

    def _leave_nothing_empty(self) -> None:
        """Close what is still open; a recording or view without a single shot is not worth a file."""
        if self.view is not None:
            self.view.close()
            if not self.done and self.view.rrd is not None:
                self.view.rrd.unlink(missing_ok=True)
        if self.recorder is not None:
            self._close_recording("interrupted")
            if not self.recorder.shots:
                self.recorder.path.unlink(missing_ok=True)

    def _pointless(self, summary: Summary) -> str:
        if set(summary.lost) == {Reason.DAMAGED}:
            return f"no image of {self.done} can be used, so there is no cloud or map to write; the faults say why"
        reasons = ", ".join(reason.words for reason in summary.lost)
        shots = "the only shot" if self.done == 1 else f"any of {self.done} shots"
        return (
            f"no laser line found in {shots} ({reasons}), so there is no cloud or map to write; look at the images: is "
            f"the laser on, the line between {self.config.triangulation.range_min_m:g} and "
            f"{self.config.triangulation.range_max_m:g} m, laserline.min_peak = "
            f"{self.config.laserline.min_peak:g} low enough?"
        )

    def _next_commands(self, files: list[Path], ended: str) -> list[str]:
        if self.recorder is not None:
            recording = first_part(self.recorder.path)  # a part by itself is not the scan
            path, rrd = (shlex.quote(str(file)) for file in (recording, recording.with_suffix(".rrd")))
            look = path if has_display() else f"{path} --save {rrd}"
            cloud = "".join(f" --out {shlex.quote(str(file))}" for file in self.outputs.clouds[:1])
            go_on = [f"scanmap scan --resume {path}{cloud}"] if ended != "finished" else []
            return [*go_on, f"scanmap view {look}", f"scanmap info {path}", f"scanmap replay {path} --out other.ply"]
        clouds = [shlex.quote(str(path)) for path in files if is_scan_file(path)]
        maps = [shlex.quote(str(path)) for path in files if path.suffix == ".yaml"]
        commands = [f"scanmap info {path}" for path in (*clouds[:1], *maps)]
        return commands if maps else [*commands, *(f"scanmap map {cloud} --out map.yaml" for cloud in clouds[:1])]


def is_scan_file(path: Path) -> bool:
    """Whether a cloud keeps the range image, so that a map can be made of it."""
    return path.suffix.lower() == ".ply" and not path.name.lower().endswith("mesh.ply")


def finished_scan(scan: Scan, config: Config, pictures: Pictures | None = None) -> Scan:
    """Passes merged, sorted by bearing, outliers and what was seen in mirrors removed, more of it with `pictures`."""
    finished = scan.merged(config.scan.merge_deg)
    if config.scan.filter_outliers:
        finished = remove_outliers(finished, config.scan)
    return without_mirrors(finished, config.scan, pictures) if config.scan.mirrors else finished
