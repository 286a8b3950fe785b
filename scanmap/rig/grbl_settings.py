"""Bring a GRBL board's machine settings to what the rig's configuration says."""

from __future__ import annotations

import logging
import math

from scanmap.errors import StageError
from scanmap.rig.grbl_link import GrblLink
from scanmap.rig.grbl_protocol import Dialect, parse_setting
from scanmap.rig.stage import StageParams

HOLD_FOREVER = 255.0  # $1: the motor holds between moves
IDLE_MS_DEFAULT = 25.0  # $1 of a fresh board
MOST_STEPS_HZ = 30_000.0  # of grbl on an AVR; others make more
WRITES = 2  # a setting that is wrong after being written so often is an error

logger = logging.getLogger(__name__)


def fit_settings(link: GrblLink, dialect: Dialect, params: StageParams) -> dict[str, float]:
    """Read the board's settings and change those that do not fit; returns them by number.

    `"1"` in the result is what it was before: the caller puts it back at the end.

    Raises:
        StageError: refused, or FluidNC's file says otherwise than `params`.
    """
    if dialect.has_numbered_settings:
        return _fit_numbered(link, params)
    return _compare_yaml(link, params)


def idle_setting_afterwards(settings: dict[str, float], params: StageParams) -> float:
    """`$1` [ms] with which to leave the board, so that its motor is free."""
    before = settings.get("1", IDLE_MS_DEFAULT) if params.idle_ms is None else params.idle_ms
    if params.idle_ms is None and before == HOLD_FOREVER:
        return IDLE_MS_DEFAULT  # left behind by a run that neither ended nor had a watchdog
    return before


def _fit_numbered(link: GrblLink, params: StageParams) -> dict[str, float]:
    """Write only what differs: the board's memory wears out. Read it back: a damaged line may store anything."""
    found = settings = _read_numbered(link)
    for _ in range(WRITES):
        wrong = _wrong_settings(settings, params)
        for number, value in wrong.items():
            link.command(f"${number}={value:.6f}".rstrip("0").rstrip("."), despite_fault=True)
        if not wrong:
            break
        settings = _read_numbered(link)
    if wrong := _wrong_settings(settings, params):
        number, value = next(iter(wrong.items()))
        kept = settings.get(number, math.nan)
        raise StageError(f"stage {link.name} keeps ${number}={kept:g} although it was told {value:g}: set it by hand")
    _warn(link.name, settings, params)
    exact = {"100": params.steps_per_deg} if params.steps_per_deg and found.get("100") != settings.get("100") else {}
    return settings | exact | {number: found[number] for number in ("1",) if number in found}


def _warn(name: str, settings: dict[str, float], params: StageParams) -> None:
    """Say what the board takes and yet will not do."""
    full = settings.get("30", 0.0)
    if params.laser == "grbl" and "laser_s" not in params.model_fields_set and params.laser_s < full:
        logger.warning(
            "%s gives the laser %.0f %% of its power: $30 is %g; set stage.laser_s",
            name,
            100 * params.laser_s / full,
            full,
        )
    rate = settings.get("100", 0.0) * params.speed_deg_s
    if rate > MOST_STEPS_HZ:
        logger.warning(
            "%s is to make %.0f steps a second, an Arduino makes %.0f: lower stage.speed_deg_s",
            name,
            rate,
            MOST_STEPS_HZ,
        )


def _read_numbered(link: GrblLink) -> dict[str, float]:
    # A board that waits for its homing is in alarm, and tells and takes settings all the same.
    return dict(filter(None, map(parse_setting, link.command("$$", despite_fault=True))))


def _wrong_settings(settings: dict[str, float], params: StageParams) -> dict[str, float]:
    """What must be written, by number."""
    wanted = {"100": params.steps_per_deg, "120": params.acceleration_deg_s2, "1": HOLD_FOREVER}
    feed = params.speed_deg_s * 60
    if settings.get("110", feed) < feed:
        wanted["110"] = feed
    if params.laser == "grbl" and "32" in settings:  # some builds know no laser mode
        wanted["32"] = 0.0
    return {
        number: value
        for number, value in wanted.items()
        if value is not None and not math.isclose(settings.get(number, math.nan), value, rel_tol=2e-6, abs_tol=6e-4)
    }


def _compare_yaml(link: GrblLink, params: StageParams) -> dict[str, float]:
    """FluidNC keeps its machine in a file: compare, and say what to change there."""
    inches = _yaml_value(link, "13")  # the one of grbl's numbers that every version answers
    settings = {} if inches is None else {"13": inches}
    steps = _yaml_value(link, "/axes/x/steps_per_mm")
    wanted = params.steps_per_deg
    if steps is not None:
        settings["100"] = steps
        if wanted is not None and not math.isclose(steps, wanted, rel_tol=1e-4, abs_tol=6e-4):
            raise StageError(
                f"stage {link.name}: axes/x/steps_per_mm is {steps:g} in the board's config.yaml, "
                f"stage.steps_per_deg is {wanted:g}: make them equal"
            )
    idle_ms = _yaml_value(link, "/stepping/idle_ms")
    if idle_ms is not None and idle_ms != HOLD_FOREVER:
        logger.warning("%s lets the motor go after %g ms: set stepping/idle_ms: 255", link.name, idle_ms)
    return settings


def _yaml_value(link: GrblLink, path: str) -> float | None:
    try:
        answers = link.command(f"${path}", despite_fault=True)
    except StageError:
        return None
    told = filter(None, map(parse_setting, answers))  # early versions leave out the first slash
    found = [setting for setting in told if setting[0].lstrip("/") == path.lstrip("/")]
    return found[0][1] if found else None
