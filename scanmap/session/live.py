"""The thesis's own use: a fixed head, its newest picture, and the distance in one chosen row, now."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scanmap.calibration import Calibration
from scanmap.config import Config
from scanmap.errors import CalibrationError, CameraError, ConfigError, StageError
from scanmap.laserline import Reason, to_grey
from scanmap.pipeline import Pipeline, Step
from scanmap.recording import open_source
from scanmap.rig import Camera, Frame, Streaming
from scanmap.rig.camera import open_camera
from scanmap.rig.camera_files import NoMorePicturesError
from scanmap.session.knobs import MODELS, Knobs
from scanmap.session.preparing import Choice, prepare_replay
from scanmap.session.rigs import TWIN_NAME, open_twin, opened_stage
from scanmap.shot import Shot, decode_image
from scanmap.triangulation import TriangulationParams, locate, pixel_ratio

TIMED_FRAMES = 20
PATIENT_FRAMES = 5  # so many faults in a row end it

Say = Callable[[str], None]


class Distance(NamedTuple):
    """What one range model says of the row."""

    depth_m: float  # along the laser's direction, the thesis's d; NaN = none
    sigma_m: float
    words: str  # "below range", "no return", ...; empty where there is a distance


class Reading(NamedTuple):
    """The panel's numbers for one picture."""

    frame: int  # running number
    rate_hz: float  # pictures shown a second
    row: int
    peak: int  # largest grey value of the row
    ppx: float  # column of the line; NaN = none
    p: float  # (l - ppx) / l
    distances: dict[str, Distance]  # by model: ratio = Algorithm 1, pixel_angle = Algorithm 2, plane = calibrated
    fault: str = ""  # what was wrong with the picture


@dataclass
class Live:
    """Opened by `open_live`; a context manager's worth of things to close stands in `closers`."""

    name: str
    is_twin: bool
    config: Config
    calibration: Calibration
    shots: Iterator[Shot]
    closers: ExitStack
    total: Callable[[], int]  # pictures the camera has sent so far
    lines: list[str]  # to say at the start

    def close(self) -> None:
        """Laser off, everything closed; may be called twice."""
        self.closers.close()

    def knobs(self, row: int | None) -> Knobs:
        """What the configuration begins with.

        Raises:
            ConfigError: the image has no such row.
        """
        height = self.calibration.intrinsics.height
        chosen = row if row is not None else self.config.view.row
        chosen = height // 2 if chosen is None else chosen
        if not 0 <= chosen < height:
            raise ConfigError(f"--row {chosen} is not a row of the image; choose 0 to {height - 1}")
        line = self.config.laserline
        return Knobs(
            line.grey, line.bit_index, chosen, self.config.view.overlay_colour, self.config.triangulation.model
        )

    def readings(
        self, knobs: Knobs, keys: Callable[[], str], show: Callable[[Step, Knobs], None]
    ) -> Iterator[tuple[Reading, Knobs]]:
        """Process picture after picture, newest first.

        Args:
            keys: the next key pressed, empty if none.
            show: is given every step and how it was made.

        Raises:
            CameraError: the camera failed several times in a row.
        """
        pipeline, made_with = self._pipeline(knobs), knobs
        times: deque[float] = deque(maxlen=TIMED_FRAMES)
        for shot in self.shots:
            while key := keys():
                knobs = knobs.pressed(key, self.calibration.intrinsics.height)
            if knobs.ended:
                return
            if (knobs.grey, knobs.bit_index, knobs.model) != (made_with.grey, made_with.bit_index, made_with.model):
                pipeline, made_with = self._pipeline(knobs), knobs
            step = pipeline.process(shot)
            times.append(time.monotonic())
            yield self._reading(step, knobs, _rate(times)), knobs
            show(step, knobs)

    def _pipeline(self, knobs: Knobs) -> Pipeline:
        line = self.config.laserline.model_copy(update={"grey": knobs.grey, "bit_index": knobs.bit_index})
        # Down to nothing: what is too near shall be found and called so.
        limits = self.config.triangulation.model_copy(update={"model": knobs.model, "range_min_m": 0.0})
        return Pipeline(self.calibration, line, limits)

    def _reading(self, step: Step, knobs: Knobs, rate_hz: float) -> Reading:
        row, width = knobs.row, self.calibration.intrinsics.width
        ppx = step.line.column_px[row : row + 1]
        reason = Reason(int(step.line.reason[row]))
        peak = 0
        if reason != Reason.DAMAGED:
            image = decode_image(step.shot.image).image[row : row + 1]
            peak = int(to_grey(image, knobs.grey, knobs.bit_index).max())
        distances = {model: self._distance(model, step, row, reason) for model in MODELS}
        return Reading(
            self.total() or step.shot.index + 1,
            rate_hz,
            row,
            peak,
            float(ppx[0]),
            float(pixel_ratio(ppx, width)[0]),
            {name: distance for name, distance in distances.items() if distance is not None},
            step.fault,
        )

    def _distance(self, model: str, step: Step, row: int, reason: Reason) -> Distance | None:
        """None where this head has no such model."""
        ppx = step.line.column_px[row : row + 1]
        params = TriangulationParams(model=model)
        try:
            points, slope, below = locate(ppx, np.array([float(row)]), self.calibration, params)
        except CalibrationError:
            return None
        if reason != Reason.OK:
            found = {Reason.BELOW_RANGE: "below range", Reason.BEYOND_RANGE: "beyond range"}
            return Distance(math.nan, math.nan, found.get(reason, f"no return ({reason.words})"))
        depth = float(points[0, 0])
        limits = self.config.triangulation
        if below[0] or depth < limits.range_min_m:
            return Distance(math.nan, math.nan, "below range")
        if not depth <= limits.range_max_m:
            return Distance(math.nan, math.nan, "beyond range")
        return Distance(depth, float(slope[0] * step.line.sigma_px[row]), "")


def open_live(choice: Choice, source: Path | None, say: Say) -> Live:
    """The camera of a configuration, the twin, or a recording played as if live.

    The head stays where it is. Of a real rig only the laser is asked of the stage.

    Raises:
        ConfigError, CalibrationError, CameraError, RecordingError: it cannot be opened.
    """
    with ExitStack() as opened:
        if source is not None:
            return _of_recording(choice, source, opened)
        config = choice.load()
        head = choice.head() or config.head()
        if config.rig == "twin":
            twin = open_twin(config, head)
            opened.callback(twin.close)
            twin.rig.stage.laser(True)
            lines = [f"DIGITAL TWIN: no hardware is used, the room is made up ({config.twin.room})"]
            shots = _newest(twin.rig.camera, lambda: math.degrees(twin.rig.stage.where()), say, pace=time.sleep)
            return Live(TWIN_NAME, True, config, head, shots, opened.pop_all(), lambda: 0, lines)
        if config.rig != "hardware":
            raise ConfigError(f"rig = {config.rig!r} has no camera: set rig = 'hardware' or 'twin', or give a SOURCE")
        camera = open_camera(config.camera, (head.intrinsics.width, head.intrinsics.height))
        opened.callback(camera.close)
        head.check_image(camera.width, camera.height)
        lines = [f"camera {config.camera.source}, pictures of {camera.width}x{camera.height}"]
        lines.append(_light(config, opened))
        shots = _newest(camera, lambda: 0.0, say)
        total = lambda: int(getattr(camera, "count", 0))  # noqa: E731
        return Live(config.description or "live", False, config, head, shots, opened.pop_all(), total, lines)
    raise AssertionError("unreachable")


def _light(config: Config, opened: ExitStack) -> str:
    """Laser on for as long as it is opened; what became of it."""
    if config.stage.laser == "always-on" or config.stage.kind == "manual":
        return "the laser cannot be switched by software: switch it on yourself, and off afterwards"
    unmoved = config.model_copy(update={"stage": config.stage.model_copy(update={"homing": "hand"})})
    try:
        stage = opened.enter_context(opened_stage(unmoved))
        stage.laser(True)
    except StageError as error:
        return f"the laser was not switched on: {error}"
    return "laser ON until this ends"


def _newest(
    camera: Camera, bearing_deg: Callable[[], float], say: Say, pace: Callable[[float], None] | None = None
) -> Iterator[Shot]:
    """Picture after picture; faults are said, and end it when they do not."""
    faults = index = 0
    bearing = math.radians(bearing_deg())
    while True:
        begun = time.monotonic()
        try:
            frame: Frame = camera.newest() if isinstance(camera, Streaming) else camera.grab()
        except NoMorePicturesError:
            return
        except CameraError as error:
            faults += 1
            if faults >= PATIENT_FRAMES:
                raise
            say(f"fault: {error}")
            continue
        faults = 0
        yield Shot(index, bearing, bearing, frame.time, frame.image)
        index += 1
        if pace is not None:  # the twin's own time goes as fast as it is looked at
            pace(max(0.0, 1 / 30 - (time.monotonic() - begun)))


def _of_recording(choice: Choice, source: Path, opened: ExitStack) -> Live:
    """A recording's shots at the times they were taken."""
    from scanmap.session.outputs import Outputs

    job = prepare_replay(source, choice, Outputs())
    opened.callback(job.__exit__, None, None, None)
    played = open_source(source, job.config.recording)
    lines = [*job.announcement, "played as if live"]
    return Live(
        source.name,
        played.is_twin,
        job.config,
        job.calibration,
        _paced(played.shots()),
        opened.pop_all(),
        lambda: 0,
        lines,
    )


def _paced(shots: Iterator[Shot]) -> Iterator[Shot]:
    begun = time.monotonic()
    first: float | None = None
    for shot in shots:
        first = shot.time if first is None else first
        time.sleep(max(0.0, min(2.0, shot.time - first - (time.monotonic() - begun))))
        yield shot


def _rate(times: deque[float]) -> float:
    return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else 0.0
