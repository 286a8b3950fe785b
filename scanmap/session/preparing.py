"""From what a user named (configuration, source, files) to a `Job` that is ready to run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from scanmap import config as configuration
from scanmap.calibration import Calibration
from scanmap.config import Config
from scanmap.errors import ConfigError
from scanmap.recording import Recorder, Source, open_source
from scanmap.session.job import Job
from scanmap.session.outputs import Outputs
from scanmap.session.rigs import TWIN_NAME, open_twin
from scanmap.sweep import plan, sweep
from scanmap.view import View, open_view, show


@dataclass(frozen=True)
class Choice:
    """Which configuration and calibration a user chose on the command line."""

    config: str | None = None  # path or preset
    settings: tuple[str, ...] = ()  # key=value
    calibration: str | None = None  # path; goes before every other calibration

    def load(self) -> Config:
        """The chosen configuration, or the default."""
        return configuration.load(self.config, self.settings)


def prepare_scan(choice: Choice, outputs: Outputs, *, view: bool) -> Job:
    """Open the rig that a configuration names, and everything its sweep will be written to.

    Raises:
        ConfigError, CalibrationError, StageError, CameraError: before anything turns.
    """
    config = choice.load()
    if config.rig != "twin":
        raise ConfigError(
            f"configuration {choice.config} has rig = {config.rig!r}: it describes recordings, not a rig that is here; "
            f"try scanmap replay SOURCE --config {choice.config}"
        )
    outputs.check()
    head = Calibration.load(choice.calibration) if choice.calibration else config.head()
    swept = plan(config.sweep)
    twin = open_twin(config, head)
    try:
        recorder = _recorder(config, head, outputs, swept.as_metadata(), len(swept.bearings))
        viewer = _open_view(config, head, outputs, title=config.description or TWIN_NAME, is_twin=True, live=view)
    except BaseException:
        twin.close()
        raise
    job = Job(
        config=config,
        calibration=head,
        outputs=outputs,
        shots=lambda: sweep(twin.rig, config.sweep, sleep=twin.sleep),
        total=len(swept.bearings),
        comments=_comments(is_twin=True),
        announcement=[
            f"DIGITAL TWIN: no hardware is used and the room is made up ({config.twin.room}); "
            "your own rig: scanmap scan --config my-rig.toml",
            swept.words,
        ],
        recorder=recorder,
        view=viewer,
        truth=twin.truth,
        closers=[twin.close],
    )
    _watch_it(job, view)
    return job


def prepare_replay(
    path: Path, choice: Choice, outputs: Outputs, *, bearings: Path | None = None, view: bool = False
) -> Job:
    """Open a recording, a folder of frames or a video for replay.

    The configuration is the chosen one, else the recording's own, else the defaults; the calibration is the
    chosen one, else the configuration's, else the recording's attachment.

    Args:
        bearings: csv of a video's bearings, where it is not beside it.

    Raises:
        ConfigError, CalibrationError, RecordingError: before anything is processed.
    """
    config, source = _source(path, bearings, choice)
    outputs.check()
    head = _head(config, source, choice)
    viewer = _open_view(config, head, outputs, title=path.name, is_twin=source.is_twin, live=view)
    job = Job(
        config=config,
        calibration=head,
        outputs=outputs,
        shots=source.shots,
        total=source.count,
        comments=_comments(is_twin=source.is_twin),
        announcement=[_announcement(source)],
        view=viewer,
        source_faults=source.faults,
    )
    _watch_it(job, view)
    return job


def _source(path: Path, bearings: Path | None, choice: Choice) -> tuple[Config, Source]:
    """The configuration says how to open the source, and the source may bring the configuration: so twice."""
    if choice.config is not None:
        config = choice.load()
        return config, open_source(path, config.recording, bearings=bearings)
    topics = [setting for setting in choice.settings if setting.startswith("recording.")]
    source = open_source(path, configuration.parse("", "settings", topics).recording, bearings=bearings)
    return configuration.parse(source.rig_toml, f"configuration in {path}", choice.settings), source


def _head(config: Config, source: Source, choice: Choice) -> Calibration:
    if choice.calibration is not None:
        return Calibration.load(choice.calibration)
    return config.head() if config.calibration is not None else source.calibration()


def _comments(*, is_twin: bool) -> dict[str, Any]:
    comments: dict[str, Any] = {"software": f"scanmap {version('scanmap')}"}
    if is_twin:
        comments["source"] = TWIN_NAME
    return comments


def _announcement(source: Source) -> str:
    shots = f"{source.count} shots" if source.count is not None else "shots"
    made_up = "; DIGITAL TWIN, its room is made up" if source.is_twin else ""
    ended = f", which ended: {source.end_reason}" if source.end_reason not in ("", "finished") else ""
    return f"replaying {shots} of {source.path}{ended}{made_up}"


def _recorder(
    config: Config, head: Calibration, outputs: Outputs, planned: Mapping[str, object], shots: int
) -> Recorder | None:
    if outputs.record is None:
        return None
    # The attached configuration leaves its calibration to the calibration's own attachment.
    rig_toml = config.model_copy(update={"calibration": None}).dumps()
    return Recorder(
        outputs.record,
        calibration=head,
        source=TWIN_NAME,
        rig_toml=rig_toml,
        plan=planned,
        expected_shots=shots,
        params=config.recording,
    )


def _open_view(
    config: Config, head: Calibration, outputs: Outputs, *, title: str, is_twin: bool, live: bool
) -> View | None:
    if outputs.rrd is None and not live:
        return None
    return open_view(
        calibration=head,
        params=config.view,
        settings_toml=config.dumps(),
        title=title,
        is_twin=is_twin,
        rrd=outputs.rrd,
        live_port=config.view.live_port if live else None,
        laserline=config.laserline,
    )


def _watch_it(job: Job, view: bool) -> None:
    if not view:
        return
    try:
        show(job.config.view.live_port)
    except ConfigError:
        if job.view is not None:
            job.view.close()
        job.__exit__(None, None, None)
        raise
