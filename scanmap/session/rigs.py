"""Open the rig a configuration names."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass

from scanmap.calibration import Calibration
from scanmap.config import Config
from scanmap.rig import Rig
from scanmap.rig.stage import open_stage
from scanmap.twin import Truth, TwinCamera, build_scene
from scanmap.twin.firmware import Firmware
from scanmap.twin.motion import Drivetrain
from scanmap.twin.ports import plug

# What everything made from the twin says of its source; `recording.layout` has the same words.
TWIN_NAME = "digital twin"
FRAME_PERIOD_S = 1 / 30
STEPS_PER_DEG = 80.0  # of the twin's gear where the stage's settings leave it open


@dataclass(frozen=True)
class TwinRig:
    """The twin, opened: the rig, what is true of its room, and its own clock."""

    rig: Rig
    truth: Truth
    sleep: Callable[[float], None]  # passes the board's time: a fast-forward twin waits for nothing
    clock: Callable[[], float]  # the board's time, which frames are stamped with [s]
    close: Callable[[], None]


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


def open_twin(config: Config, calibration: Calibration) -> TwinRig:
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

        def exposed() -> tuple[float, bool]:
            if config.sweep.mode == "continuous":  # the head turns on while the next frame comes
                firmware.wait(FRAME_PERIOD_S)
            return firmware.bearing, lit_for_ever or firmware.laser_on

        camera = TwinCamera(
            scene,
            calibration,
            config.twin,
            state=exposed,
            clock=lambda: firmware.now,
        )
        rig = Rig(camera, stage, TWIN_NAME, is_twin=True)
        return TwinRig(
            rig,
            Truth(scene, calibration, config.twin.laser),
            firmware.wait,
            lambda: firmware.now,
            opened.pop_all().close,
        )
    raise AssertionError("unreachable")
