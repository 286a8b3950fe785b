"""Open the rig a configuration names: the twin, or a camera and a stage of this machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scanmap.calibration import Calibration
from scanmap.config import Config
from scanmap.errors import ConfigError
from scanmap.rig import Camera, Rig, Stage
from scanmap.rig.camera import open_camera
from scanmap.rig.stage import open_stage
from scanmap.twin import DelayedCamera, Truth, TwinCamera, build_scene
from scanmap.twin.firmware import Firmware
from scanmap.twin.motion import Drivetrain
from scanmap.twin.ports import plug

# What everything made from the twin says of its source; `recording.layout` has the same words.
TWIN_NAME = "digital twin"
STEPS_PER_DEG = 80.0  # of the twin's gear where the stage's settings leave it open


class TwinDevices(NamedTuple):
    """What only a twin has: devices whose knobs are the faults that a scan can be put through."""

    firmware: Firmware
    camera: TwinCamera


@dataclass(frozen=True)
class OpenRig:
    """A rig, opened, and the clock it lives by."""

    rig: Rig
    sleep: Callable[[float], None]  # a fast-forward twin passes its board's time and waits for nothing
    clock: Callable[[], float]  # what frames are stamped with [s]
    close: Callable[[], None]  # laser off, motor free, everything closed; may be called twice
    truth: Truth | None = None  # of the twin's room
    twin: TwinDevices | None = None


def open_rig(config: Config, calibration: Calibration, ask: Callable[[str], str] = input) -> OpenRig:
    """The rig that `config.rig` names, its laser off.

    Args:
        ask: shows a question to the user and returns the answer; for a head turned by hand.

    Raises:
        ConfigError: it names none, or the twin's room cannot be made.
        CameraError, StageError: the device is missing, or does not do what it should.
    """
    if config.rig == "twin":
        return open_twin(config, calibration)
    if config.rig == "hardware":
        return open_hardware(config, (calibration.intrinsics.width, calibration.intrinsics.height), ask)
    raise ConfigError(
        f"rig = {config.rig!r} describes recordings, not a rig that is here; try scanmap replay SOURCE, or set "
        "rig = 'hardware' or 'twin'"
    )


@contextmanager
def opened_stage(config: Config, ask: Callable[[str], str] = input) -> Iterator[Stage]:
    """The stage alone, of the twin or of this machine; closed at the end: laser off, motor free.

    Raises:
        ConfigError, StageError: there is none, or it does not do what it should.
    """
    with ExitStack() as opened:
        params = config.stage
        if config.rig == "twin":
            params = params.model_copy(update={"kind": "grbl", "port": opened.enter_context(plug(_board(config)))})
        elif config.rig != "hardware":
            raise ConfigError(f"rig = {config.rig!r} has no stage: set rig = 'hardware' or 'twin'")
        stage = open_stage(params, ask)
        opened.callback(stage.close)
        yield stage


def open_hardware(config: Config, size: tuple[int, int] | None, ask: Callable[[str], str] = input) -> OpenRig:
    """The camera of `[camera]` and the stage of `[stage]`.

    The camera first: a board that is opened may reset, home and turn, which is for nothing without a camera.

    Args:
        size: width and height [px] to ask the camera for, where `[camera]` names none.

    Raises:
        ConfigError: the sweep asks for what this camera cannot do.
        CameraError, StageError: the device is missing, or does not do what it should.
    """
    if config.sweep.exposures_us and config.camera.kind != "device":
        raise ConfigError(
            f"sweep.exposures_us needs a USB webcam: nobody can set the exposure of camera.source = "
            f"{config.camera.source!r} from here; leave it empty"
        )
    with ExitStack() as opened:
        camera = open_camera(config.camera, size)
        opened.callback(camera.close)
        stage = open_stage(config.stage, ask)
        turned_by = "a head turned by hand" if config.stage.kind == "manual" else _name(stage, config.stage.port)
        rig = Rig(camera, stage, f"{turned_by} + camera {_name(camera, config.camera.source)}")
        opened.pop_all()
        return OpenRig(rig, time.sleep, time.monotonic, rig.close)
    raise AssertionError("unreachable")


def open_twin(config: Config, calibration: Calibration) -> OpenRig:
    """The twin's camera, and the real GRBL driver talking to the twin's firmware over pyserial.

    Raises:
        ConfigError: the twin's room cannot be made.
        StageError: the stage's settings do not fit the board.
    """
    scene = build_scene(config.twin, config.twin.light)
    firmware = _board(config)
    lit_for_ever = config.stage.laser == "always-on"
    with ExitStack() as opened:
        url = opened.enter_context(plug(firmware))
        stage = open_stage(config.stage.model_copy(update={"kind": "grbl", "port": url}))
        opened.callback(stage.close)
        camera = TwinCamera(
            scene,
            calibration,
            config.twin,
            state=lambda: (firmware.bearing, (lit_for_ever and not firmware.laser_dead) or firmware.laser_on),
            clock=lambda: firmware.now,
        )
        delayed = DelayedCamera(
            camera,
            clock=lambda: firmware.now,
            wait=firmware.wait,
            period_s=1.0 / config.twin.rate_hz,
            latency_s=config.twin.latency_s,
            jitter_s=config.twin.jitter_s,
            corrected_s=config.camera.latency_s or 0.0,
            rng=np.random.default_rng([config.twin.seed, 1]),
        )
        if config.camera.exposure_us is not None:
            delayed.expose(config.camera.exposure_us)
        return OpenRig(
            Rig(delayed, stage, TWIN_NAME, is_twin=True),
            firmware.wait,
            lambda: firmware.now,
            opened.pop_all().close,
            Truth(scene, calibration, config.twin.laser),
            TwinDevices(firmware, camera),
        )
    raise AssertionError("unreachable")


def _board(config: Config) -> Firmware:
    """A board whose gear, switch and mark are what the stage's settings expect, unless `[twin.drive]` says else."""
    drive = config.twin.drive
    drivetrain = Drivetrain(
        steps_per_deg=config.stage.steps_per_deg or STEPS_PER_DEG,
        backlash_deg=drive.backlash_deg,
        bearing_deg=drive.head_deg,
    )
    firmware = Firmware(drivetrain=drivetrain, switch_deg=drive.switch_deg, index_deg=drive.index_deg)
    firmware.memory.settings[100] = drivetrain.steps_per_deg
    if drive.switch_deg is not None:
        firmware.memory.settings.update({22: 1, 23: 1, 130: 400.0})  # homing toward smaller bearings, over a full turn
    return firmware


def _name(part: Camera | Stage, otherwise: object) -> str:
    """What a camera or stage calls itself, else what the configuration calls it."""
    return str(getattr(part, "name", "") or otherwise)
