"""Where pictures of a board come from: a file, the camera in somebody's hands, or a head that turns."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

from scanmap.calibration import Calibration
from scanmap.config import Config
from scanmap.errors import CalibrationError, CameraError, ConfigError
from scanmap.laserline import rounding_of
from scanmap.rig.camera import open_camera
from scanmap.session.rigs import open_hardware
from scanmap.shot import decode_image
from scanmap.solvers.detection import Rejected
from scanmap.solvers.pictures import Picture, pictures_of, read_pictures
from scanmap.sweep import sweep

LIVE = "camera"


def is_live(source: str) -> bool:
    """Whether a camera delivers the pictures; a folder or file of that name goes first."""
    if not source.startswith("/dev/") and Path(source).exists():
        return False
    return source == LIVE or "://" in source or source.startswith("/dev/") or source.isdecimal()


def pictures_of_source(
    source: str, config: Config, base: Calibration | None = None, *, laser: bool = False
) -> Iterator[Picture | Rejected]:
    """Pictures of a file, or live until nobody asks for more.

    Args:
        source: path, `camera` (that of `config`), or a camera's index, device or URL.
        base: what the camera's size must be; None = as `config` has it.
        laser: light it, where `config` names a rig that can.

    Raises:
        RecordingError: nothing to read.
        CameraError, StageError: the device is missing, or does not do what it should.
    """
    if not is_live(source):
        return read_pictures(Path(source))
    return _live(_with_camera(source, config), _size(config, base), laser=laser and source == LIVE)


def turning_pictures(source: str, config: Config, base: Calibration) -> Iterator[Picture | Rejected]:
    """Pictures with bearings: of a recording, or live while the head of `config` makes its sweep.

    Raises:
        ConfigError: `config` has no head that turns.
        RecordingError, CameraError, StageError: as `pictures_of_source`.
    """
    if not is_live(source):
        return read_pictures(Path(source))
    if source != LIVE or config.rig != "hardware":
        raise ConfigError(
            "the axis needs a head that turns: SOURCE = camera with --config of your rig (rig = 'hardware')"
        )
    return _turning(config, (base.intrinsics.width, base.intrinsics.height))


def _with_camera(source: str, config: Config) -> Config:
    if source == LIVE:
        return config
    given: int | str = int(source) if source.isdecimal() else source
    return config.model_copy(update={"camera": config.camera.model_copy(update={"source": given})})


def _size(config: Config, base: Calibration | None) -> tuple[int, int] | None:
    """Width and height the camera is asked for; a head that is not calibrated yet may have no file."""
    if base is None and config.rig == "hardware":
        try:
            base = config.head()
        except CalibrationError:
            return None
    return None if base is None else (base.intrinsics.width, base.intrinsics.height)


def _turning(config: Config, size: tuple[int, int]) -> Iterator[Picture | Rejected]:
    opened = open_hardware(config, size)
    try:
        yield from pictures_of(sweep(opened.rig, config.sweep, sleep=opened.sleep, clock=opened.clock))
    finally:
        opened.close()


def _live(config: Config, size: tuple[int, int] | None, *, laser: bool) -> Iterator[Picture | Rejected]:
    """Pictures as the camera sends them, until nobody asks for more; the laser lit where the rig can."""
    with ExitStack() as opened:
        if laser and config.rig == "hardware":
            # Nothing turns, so nothing need be at home.
            unmoved = config.model_copy(update={"stage": config.stage.model_copy(update={"homing": "hand"})})
            rig = open_hardware(unmoved, size)
            opened.callback(rig.close)
            if rig.rig.stage.laser_switchable:
                rig.rig.stage.laser(True)
            camera = rig.rig.camera
        else:
            camera = open_camera(config.camera, size)
            opened.callback(camera.close)
        number = 0
        while True:
            try:
                frame = camera.grab()
            except CameraError as error:
                if not number:
                    raise
                # What was collected before the camera went is not lost.
                yield Rejected("the camera", f"{error}; going on with the pictures so far")
                return
            try:
                image = decode_image(frame.image).image
                yield Picture(f"picture {number}", image, rounding=rounding_of(frame.image))
            except CameraError as error:
                yield Rejected(f"picture {number}", str(error))
            number += 1
