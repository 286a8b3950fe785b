"""Turning the head and switching its laser by hand; laser off and motor free at every end."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from scanmap.config import Config
from scanmap.errors import ConfigError, StageError
from scanmap.rig import Jogging, Stage
from scanmap.rig.stage import check_limits
from scanmap.session.rigs import TWIN_NAME, opened_stage

Say = Callable[[str], None]
TICK_S = 0.2


def jog(config: Config, by_deg: float | None, to_deg: float | None, say: Say) -> None:
    """Turn by, or to, some degrees and say where the head then stands.

    Raises:
        ConfigError: neither or both are given, or the bearing is outside the limits.
        StageError: no board, or it does not turn there.
    """
    if (by_deg is None) == (to_deg is None):
        raise ConfigError(
            "stage jog wants one of the two: degrees to turn by (scanmap stage jog 10), or --to a bearing"
        )
    span_deg = config.stage.max_deg - config.stage.min_deg
    if to_deg is not None:
        _refuse_outside(to_deg, config)
    elif not abs(by_deg or 0.0) <= span_deg:
        raise ConfigError(
            f"stage jog {by_deg:g}: the head may turn from {config.stage.min_deg:g} to {config.stage.max_deg:g} deg, "
            f"so by no more than {span_deg:g}; see stage.min_deg, stage.max_deg"
        )
    with opened_stage(config) as stage:
        _introduce(config, stage, say)
        target = to_deg if to_deg is not None else math.degrees(stage.where()) + (by_deg or 0.0)
        _refuse_outside(target, config)
        turn = stage.jog if isinstance(stage, Jogging) else stage.move_to
        say(f"bearing {math.degrees(turn(math.radians(target))):.3f} deg")


def home(config: Config, say: Say) -> None:
    """Home the head as the configuration says.

    Raises:
        ConfigError: this kind of stage has no home.
        StageError: no board, or no switch or mark was found.
    """
    if config.stage.kind != "grbl":
        raise ConfigError(
            f"stage.kind = {config.stage.kind!r} cannot be homed: turn the head to stage.home_deg by hand"
        )
    with opened_stage(config) as stage:  # homes by switch or index while it opens
        _introduce(config, stage, say)
        how = {"switch": "by its switch", "index": "by its index mark", "hand": "by hand: where it stands now"}
        say(f"home, {how[config.stage.homing]}: bearing {math.degrees(stage.where()):.3f} deg")
    if config.stage.homing == "hand":
        say("a board that resets when its port opens (an Uno) is at home wherever it stands then: put it there first")


def where(config: Config, say: Say) -> None:
    """Say the bearing that the board reports, without homing.

    Raises:
        StageError: no board.
    """
    with opened_stage(_unmoved(config)) as stage:
        _introduce(config, stage, say)
        counted = " as the board counts since it was switched on, reset or homed" if config.stage.kind == "grbl" else ""
        say(f"bearing {math.degrees(stage.where()):.3f} deg{counted}")


def switch_laser(
    config: Config, say: Say, *, on: bool, seconds: float, sleep: Callable[[float], None] = time.sleep
) -> None:
    """Laser on for so long, or off now. Nothing moves.

    Raises:
        ConfigError: software cannot switch this laser.
        StageError: no board, or it does not answer.
    """
    with opened_stage(_unmoved(config)) as stage:
        if not stage.laser_switchable:
            raise ConfigError(
                f"stage.laser = {config.stage.laser!r}: this laser cannot be switched by software; use its own switch"
            )
        _introduce(config, stage, say)
        if on:
            say(f"laser ON for {seconds:g} s; Ctrl-C ends it. Do not look into it")
            stage.laser(True)
            until = time.monotonic() + seconds
            while time.monotonic() < until:
                sleep(min(TICK_S, max(0.0, until - time.monotonic())))
                stage.where()  # notices a board that is gone
        stage.laser(False)
    say("laser off")


def _refuse_outside(bearing_deg: float, config: Config) -> None:
    try:
        check_limits(bearing_deg, config.stage)
    except StageError as error:
        raise ConfigError(str(error)) from error


def _unmoved(config: Config) -> Config:
    """The same rig, opened without homing."""
    return config.model_copy(update={"stage": config.stage.model_copy(update={"homing": "hand"})})


def _introduce(config: Config, stage: Stage, say: Say) -> None:
    if config.rig == "twin":
        say(f"{TWIN_NAME.upper()}: no hardware is used")
    else:
        say(f"stage: {getattr(stage, 'name', config.stage.kind)}")
