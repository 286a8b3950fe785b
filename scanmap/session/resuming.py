"""Go on with a scan that was interrupted: what is there, and proof that the head stands where its board says."""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from scanmap import config as configuration
from scanmap.calibration import Calibration
from scanmap.config import Config
from scanmap.errors import ConfigError, StageError
from scanmap.recording import Source, is_later_part, next_part, open_source
from scanmap.session.rigs import OpenRig
from scanmap.shot import Shot
from scanmap.sweep import Homable, Place, Plan, Settable, Steps, Turning, Turns, Watch, missing, passes, plan

CHANGEABLE = ("stage", "camera", "recording", "view")  # sections that may differ: another port, another disk
SAME_PLACE_RAD = math.radians(0.01)
CORRECTIONS = 3  # of the head's place by the picture
AGREE_RAD = math.radians(1.0)  # answers of different pictures that mean one place: nearness of things shifts them
WITNESSES = 6  # recorded pictures that are asked in turn whether the head stands as it did
LANDMARKS = 60  # recorded pictures that the head's present view is searched in


@dataclass(frozen=True)
class Earlier:
    """The parts of a scan that are there."""

    source: Source
    landmarks: Source  # the same, with shots that show the room but not the laser
    config: Config  # what it was scanned with
    calibration: Calibration
    planned: Plan
    done: frozenset[int]  # indices of the shots that can be read
    shots: int  # how many those are
    bearings: tuple[float, ...]  # reported, of each shot [rad]
    last_s: float  # time of the last of them
    part: Path  # the file to go on in
    start_ns: int  # wall clock at the time 0 of its shots

    @property
    def offset_s(self) -> float:
        """What the clock of a sweep that begins now is behind that of the scan [s]."""
        # A twin in fast-forward, or a clock that was set back, must not bring later shots before earlier ones.
        return max((time.time_ns() - self.start_ns) / 1e9, self.last_s + 1.0)

    @property
    def words(self) -> str:
        """One line for people."""
        planned = "" if self.config.sweep.mode == "adaptive" else f" of {len(self.planned.bearings)}"
        return f"going on with {self.source.path}: {self.shots}{planned} shots are there"


def earlier_parts(path: Path, settings: tuple[str, ...] = ()) -> Earlier:
    """Look into the recording of an interrupted scan.

    Args:
        settings: `key=value` of sections that may differ from when it began.

    Raises:
        ConfigError: it cannot be gone on with, or is complete.
        RecordingError: it cannot be read.
    """
    _check(path, settings)
    recording = configuration.parse("", "--set", [s for s in settings if s.startswith("recording.")]).recording
    source = open_source(path, recording)
    if not source.rig_toml or not source.metadata.get("start_ns", "").isdecimal():
        raise ConfigError(f"{path} does not say which rig and plan it is of: only scanmap's own recordings are resumed")
    config = configuration.parse(source.rig_toml, f"configuration in {path}", settings)
    planned = plan(config.sweep, config.stage.limits)
    landmarks = open_source(path, recording.model_copy(update={"withdrawn": "keep-unlit"}))
    seen = [(shot.index, shot.bearing, shot.time) for shot in landmarks.shots()]
    if not seen:
        raise ConfigError(f"{path} has no shot from a bearing that can be trusted: scan again")
    done = frozenset(shot.index for shot in source.shots())
    if _is_complete(planned, done, ended=source.end_reason == "finished"):
        name = shlex.quote(str(path))
        if source.end_reason == "cut":
            lost = "complete but for its end, which is cut off"
            raise ConfigError(f"{path} is {lost}, {len(done)} shots: scanmap recover {name}, or scanmap replay {name}")
        raise ConfigError(f"{path} is complete, {len(done)} shots: scanmap replay {name}")
    return Earlier(
        source=source,
        landmarks=landmarks,
        config=config,
        calibration=source.calibration(),
        planned=planned,
        done=done,
        shots=len(done),
        bearings=tuple(bearing for _, bearing, _ in seen),
        last_s=max(time_s for _, _, time_s in seen),
        part=next_part(path),
        start_ns=int(source.metadata["start_ns"]),
    )


def _is_complete(planned: Plan, done: frozenset[int], *, ended: bool) -> bool:
    if planned.params.mode == "continuous":
        return not any(missing(planned, turn, done, ends=not ended) for turn in passes(planned))
    return done >= set(range(len(planned.bearings))) and (ended or planned.params.mode != "adaptive")


def _check(path: Path, settings: tuple[str, ...]) -> None:
    if path.suffix != ".mcap" or not path.is_file():
        why = "" if path.exists() else ": there is no such file"
        raise ConfigError(f"--resume {path}: not the recording (.mcap) of a scan{why}")
    if is_later_part(path):
        raise ConfigError(f"--resume {path}: name the file that the scan began in, not a later part")
    for setting in settings:
        if setting.partition(".")[0] not in CHANGEABLE:
            raise ConfigError(
                f"--set {setting}: a scan goes on with the settings it began with, but for "
                f"{', '.join(CHANGEABLE)}; scanmap replay can change the others afterwards"
            )


def prove_place(opened: OpenRig, earlier: Earlier, watch: Watch) -> str:
    """Make sure that bearings mean what they meant when the scan began; says how.

    A port that is opened resets many boards, so the position they report means nothing. A stage that has just homed
    itself knows it; else the camera must recognise the room: first where the head stands, before it turns anywhere,
    then again at the bearing shot last.

    Raises:
        StageError: nothing proves it. The head may have turned only where its place was known.
    """
    stage = opened.rig.stage
    if isinstance(stage, Homable) and stage.homes_itself:
        watch.trust(_last(earlier))
        return "the head has been homed"
    steps = Steps(opened.rig, earlier.planned, opened.sleep)
    if isinstance(stage, Settable):
        here = steps.look()
        known = _recognised(here, earlier, watch)
        if known is None:
            raise StageError(
                f"the view from where the head stands is not found in {earlier.source.path}: turn it by "
                f"hand to {math.degrees(earlier.planned.bearings[0]):g} deg, where the scan began, and resume again; a "
                "room too dark or plain to be recognised needs a switch or index mark (stage.homing)"
            )
        if known != here.bearing:
            stage.stand_at(known)
    shoot = steps.shoot
    if earlier.planned.params.mode == "continuous" and isinstance(stage, Turning):
        shoot = Turns(opened.rig, stage, earlier.planned, opened.clock).shoot  # as those it is held against
    for shot in _witnesses(earlier):
        if (slack_px := _recognised_at(shot, shoot, opened, watch)) is not None:
            break
    else:
        raise StageError(
            f"the picture at {math.degrees(shot.bearing):.2f} deg is not recognised, so nothing proves where the head "
            "stands: set the head to its home by hand and resume again, or give it a switch or index mark "
            "(stage.homing)"
        )
    watch.trust(shot)
    return (
        f"the picture at {math.degrees(shot.bearing):.2f} deg was recognised: the head stands within "
        f"{math.degrees(slack_px / watch.px_per_rad):.2f} deg of where it stood"
    )


def _recognised_at(shot: Shot, shoot: Callable[[Place], Shot], opened: OpenRig, watch: Watch) -> float | None:
    """Shoot again where a shot was taken, and set the head's place by it; how far off it may still be [px].

    None where the pictures do not tell.

    Raises:
        StageError: it stands elsewhere, and nobody can tell the stage so.
    """
    stage = opened.rig.stage
    shift, off_px = None, 0.0
    for _ in range(1 + CORRECTIONS):
        if shift is not None and isinstance(stage, Settable):
            stage.stand_at(stage.where() + off_px / watch.px_per_rad)
        again = shoot(Place(shot.index, shot.bearing_commanded))
        shift = watch.shift(shot, again)
        if shift is None:
            return None
        off_px = shift.columns_px - watch.px_per_rad * (again.bearing - shot.bearing)
        if abs(off_px) <= shift.slack_px:
            return shift.slack_px
    raise StageError(
        f"the picture at {math.degrees(shot.bearing):.2f} deg shows the head "
        f"{math.degrees(off_px / watch.px_per_rad):.2f} deg off: set it to its home by hand and resume again"
    )


def _witnesses(earlier: Earlier) -> list[Shot]:
    """Recorded shots that can prove the head's place: the last, and some on the way back to the first."""
    times = sorted((shot.time for shot in earlier.landmarks.shots()), reverse=True)
    wanted = times[:: max(1, (len(times) - 1) // (WITNESSES - 1))][:WITNESSES]
    found = {shot.time: shot for shot in earlier.landmarks.shots() if shot.time in wanted}
    return [found[time_s] for time_s in wanted]


def _last(earlier: Earlier) -> Shot:
    return max(earlier.landmarks.shots(), key=lambda shot: shot.time)


def _recognised(here: Shot, earlier: Earlier, watch: Watch) -> float | None:
    """The bearing [rad] that the head truly stands at, from the recorded pictures; None where they do not tell."""
    nearest = min(earlier.bearings, key=lambda bearing: abs(bearing - here.bearing))
    every = max(1, len(earlier.bearings) // LANDMARKS)
    answers: list[tuple[float, float]] = []  # how much alike, and where that would be [rad]
    for count, shot in enumerate(earlier.landmarks.shots()):
        if count % every and shot.bearing != nearest:
            continue
        shift = watch.shift(shot, here)
        if shift is None or not watch.overlap(shift):
            continue
        if shift.is_small and abs(shot.bearing - here.bearing) < SAME_PLACE_RAD:
            return here.bearing  # just where its board says
        answers.append((shift.likeness, shot.bearing + shift.columns_px / watch.px_per_rad))
    if not answers:
        return None
    best = max(answers)[1]
    # Of places that look the same none is proved; nearness of things lets true answers differ a little.
    return best if all(abs(answer - best) < AGREE_RAD for _, answer in answers) else None
