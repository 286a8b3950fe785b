"""From what a user named (configuration, source, files) to a `Job` that is ready to run."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from scanmap import config as configuration
from scanmap.calibration import Calibration, check_residuals
from scanmap.config import Config
from scanmap.errors import ConfigError, RecordingError
from scanmap.recording import Recorder, Source, open_source
from scanmap.recording.opening import KINDS
from scanmap.recording.video import VIDEO_SUFFIXES
from scanmap.rig import Rig
from scanmap.session.job import Job
from scanmap.session.outputs import Outputs
from scanmap.session.resuming import Earlier, earlier_parts
from scanmap.session.rigs import TWIN_NAME, open_rig
from scanmap.session.sweeping import Sweeping
from scanmap.sweep import Plan, plan
from scanmap.view import open_view, show
from scanmap.view.viewer import has_display

INSTEAD_OF_VIEW = "leave --view out, give --rrd F.rrd, and open that where there is one with scanmap view F.rrd"


@dataclass(frozen=True)
class Choice:
    """Which configuration and calibration a user chose on the command line."""

    config: str | None = None  # path or preset
    settings: tuple[str, ...] = ()  # key=value
    calibration: str | None = None  # path; goes before every other calibration

    def load(self) -> Config:
        """The chosen configuration, or the default."""
        return configuration.load(self.config, self.settings)

    def head(self) -> Calibration | None:
        """The chosen calibration; None where none was chosen."""
        if self.calibration is None:
            return None
        if not Path(self.calibration).is_file():
            raise ConfigError(
                f"--calibration {self.calibration}: there is no such file; leave it out to take the configuration's "
                "or the recording's own"
            )
        return Calibration.load(self.calibration)


def prepare_scan(choice: Choice, outputs: Outputs, *, view: bool, resume: Path | None = None) -> Job:
    """Open the rig that a configuration names, and everything its sweep will be written to.

    What fails here leaves no file behind.

    Args:
        resume: recording of an interrupted scan to go on with; it brings its configuration and calibration.

    Raises:
        ConfigError, CalibrationError, StageError, CameraError, RecordingError: before anything turns; of a resumed
            scan, before anything is shot.
    """
    earlier = _earlier(choice, resume) if resume is not None else None
    config = earlier.config if earlier is not None else choice.load()
    if config.rig == "replay-only":
        raise ConfigError(
            f"rig = {config.rig!r} describes recordings, not a rig that is here; try scanmap replay SOURCE"
            + (f" --config {choice.config}" if choice.config else ", or set rig = 'hardware' or 'twin'")
        )
    if earlier is not None:
        outputs = replace(outputs, record=earlier.part)
    outputs.check()
    if view:
        require_display(INSTEAD_OF_VIEW)
    head = earlier.calibration if earlier is not None else choice.head() or config.head()
    check_residuals(head)
    swept = plan(config.sweep, config.stage.limits)
    opened = open_rig(config, head)
    is_twin = opened.rig.is_twin
    sweeping = Sweeping(config, head, opened, swept, earlier)
    job = Job(
        config=config,
        calibration=head,
        outputs=outputs,
        shots=sweeping.shots,
        total=len(swept.bearings),
        comments=_comments(is_twin=is_twin),
        announcement=[rig_words(config, opened.rig), swept.words, *_missing(head)],
        earlier=earlier.source.shots if earlier is not None else None,
        refinement=sweeping.refinement,
        truth=opened.truth,
        closers=[opened.close],
    )
    sweeping.note, sweeping.withdraw = job.note, job.withdraw
    with _opened(job):
        if not is_twin:
            head.check_image(opened.rig.camera.width, opened.rig.camera.height)
        if earlier is not None:
            job.announcement += [earlier.words, sweeping.prove_place()]
            job.source_faults = earlier.source.faults
        else:
            sweeping.look_first()
        _open_view(job, title=config.description or opened.rig.name, is_twin=is_twin, live=view)
        job.recorder = _recorder(config, head, outputs, swept, opened.rig.name, earlier)
    return job


def prepare_replay(
    path: Path,
    choice: Choice,
    outputs: Outputs,
    *,
    bearings: Path | None = None,
    view: bool = False,
    gated: bool = True,
) -> Job:
    """Open a recording, a folder of frames or a video for replay.

    The configuration is the chosen one, else the recording's own, else the defaults; the calibration is the
    chosen one, else the configuration's, else the recording's attachment.

    Args:
        bearings: csv of a video's bearings, where it is not beside it.
        gated: refuse a calibration that states a residual over its gate; not where it is to be judged or refined.

    Raises:
        ConfigError, CalibrationError, RecordingError: before anything is processed.
    """
    if not path.exists():
        raise ConfigError(f"{path} does not exist; scanmap replays {KINDS}")
    if bearings is not None and path.suffix.lower() not in VIDEO_SUFFIXES:
        raise ConfigError(f"--bearings is for videos ({', '.join(VIDEO_SUFFIXES)}); {path} brings its bearings along")
    config, source = _source(path, bearings, choice)
    outputs.check()
    if view:
        require_display(INSTEAD_OF_VIEW)
    head = choice.head() or (config.head() if config.calibration is not None else source.calibration())
    if gated:
        check_residuals(head)
    job = Job(
        config=config,
        calibration=head,
        outputs=outputs,
        shots=source.shots,
        total=source.count,
        comments=_comments(is_twin=source.is_twin),
        announcement=[_announcement(source), *_missing(head)],
        recorded=True,
        source_faults=source.faults,
    )
    with _opened(job):
        _open_view(job, title=path.name, is_twin=source.is_twin, live=view)
    return job


def require_display(instead: str) -> None:
    """Raise ConfigError with what to do instead, unless a window can be opened here."""
    if not has_display():
        raise ConfigError(f"no display to open the viewer on (DISPLAY and WAYLAND_DISPLAY are not set); {instead}")


@contextmanager
def _opened(job: Job) -> Iterator[None]:
    """Close the job again should its last parts fail to open."""
    try:
        yield
    except BaseException:
        job.__exit__(None, None, None)
        raise


def _earlier(choice: Choice, resume: Path) -> Earlier:
    if choice.config is not None or choice.calibration is not None:
        raise ConfigError(
            "--resume takes configuration and calibration from the recording: leave --config and --calibration out"
        )
    return earlier_parts(resume, choice.settings)


def _source(path: Path, bearings: Path | None, choice: Choice) -> tuple[Config, Source]:
    """The configuration says how to open the source, and the source may bring the configuration: so twice."""
    if choice.config is not None:
        config = choice.load()
        return config, open_source(path, config.recording, bearings=bearings)
    topics = [setting for setting in choice.settings if setting.startswith("recording.")]
    source = open_source(path, configuration.parse("", "--set", topics).recording, bearings=bearings)
    name = f"configuration in {path}"
    try:
        configuration.parse(source.rig_toml, name)
    except ConfigError as error:
        raise ConfigError(f"{error}; or replay it with a configuration of your own: --config FILE|PRESET") from error
    return configuration.parse(source.rig_toml, name, choice.settings), source


def _comments(*, is_twin: bool) -> dict[str, Any]:
    comments: dict[str, Any] = {"software": f"scanmap {version('scanmap')}"}
    if is_twin:
        comments["source"] = TWIN_NAME
    return comments


def rig_words(config: Config, rig: Rig) -> str:
    """What is about to move, or that nothing is."""
    if rig.is_twin:
        return f"DIGITAL TWIN: no hardware is used, the room is made up ({config.twin.room})"
    laser = "" if rig.stage.laser_switchable else "; its laser cannot be switched: it shines until you turn it off"
    return f"rig: {rig.name}, pictures of {rig.camera.width}x{rig.camera.height}{laser}"


def _missing(head: Calibration) -> list[str]:
    if "axis" not in head.meta.get("uncalibrated", ()):
        return []
    return ["note: the calibration's axis is not calibrated, the head is taken to stand on it; scanmap calibrate axis"]


def _announcement(source: Source) -> str:
    shots = "1 shot" if source.count == 1 else f"{'' if source.count is None else f'{source.count} '}shots"
    parts = f" in {len(source.parts)} parts" if len(source.parts) > 1 and source.path.is_file() else ""
    made_up = "; DIGITAL TWIN, its room is made up" if source.is_twin else ""
    ended = {"": "", "finished": "", "cut": ", which is cut"}.get(source.end_reason, f", {source.end_reason}")
    return f"replaying {shots} of {source.path}{parts}{ended}{made_up}"


def _recorder(
    config: Config, head: Calibration, outputs: Outputs, planned: Plan, source: str, earlier: Earlier | None
) -> Recorder | None:
    if outputs.record is None:
        return None
    # The attached configuration leaves its calibration to the calibration's own attachment.
    rig_toml = config.model_copy(update={"calibration": None}).dumps()
    was_there = outputs.record.exists()
    try:
        return Recorder(
            outputs.record,
            calibration=head,
            source=source,
            rig_toml=rig_toml,
            plan=planned.as_metadata(),
            metadata={"continues": earlier.source.path.name} if earlier is not None else None,
            expected_shots=len(planned.bearings) - (earlier.shots if earlier is not None else 0),
            start_ns=earlier.start_ns if earlier is not None else None,
            begun_ns=time.time_ns() if earlier is not None else None,
            params=config.recording,
        )
    except RecordingError:
        if not was_there:
            outputs.record.unlink(missing_ok=True)
        raise


def _open_view(job: Job, *, title: str, is_twin: bool, live: bool) -> None:
    """Give the job its view, if one was asked for, and open the viewer on a live one."""
    config = job.config
    if job.outputs.rrd is None and not live:
        return
    job.view = open_view(
        calibration=job.calibration,
        params=config.view,
        settings_toml=config.dumps(),
        title=title,
        is_twin=is_twin,
        rrd=job.outputs.rrd_drawn,
        live_port=config.view.live_port if live else None,
        laserline=config.laserline,
    )
    if live:
        show(config.view.live_port)
