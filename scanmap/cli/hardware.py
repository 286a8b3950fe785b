"""`scanmap doctor`, `stage` and `init`: the hands-on commands."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from scanmap.cli.settings import CalibrationOption, ConfigOption, SetOption

if TYPE_CHECKING:
    from scanmap.config import Config

stage = typer.Typer(
    name="stage",
    help="Turn the head and switch its laser by hand. Whenever one of these ends, the laser is off, the motor free.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


def doctor(config: ConfigOption = None, set_: SetOption = None, calibration: CalibrationOption = None) -> None:
    """Look at everything a scan needs and say what to do about each fault.

    Cameras and their picture sizes, serial ports and what answers there, the laser's contrast, the camera's
    latency, disk and speed. The laser blinks and a board may reset. Exit code 1 if the configuration's own rig has a
    fault; what it does not need is only noted.

    Example: scanmap doctor --config my-rig.toml
    """
    from contextlib import closing

    from scanmap import session
    from scanmap.cli.terminal import say, stop_on_signal

    marks = {"ok": "ok   ", "note": "note ", "fault": "FAULT", "busy": "...  "}
    faults = 0
    choice = session.Choice(config, tuple(set_ or ()), calibration)
    with stop_on_signal(), closing(session.examine(choice, Path.cwd())) as findings:
        for finding in findings:
            say(f"{marks[finding.state]} {finding.part}: {finding.words}")
            faults += finding.state == "fault"
    say(f"{faults} {'fault' if faults == 1 else 'faults'}" if faults else "ready to scan")
    if faults:
        raise typer.Exit(1)


def init(
    out: Annotated[Path, typer.Option("--out", metavar="F.toml", help="The rig's TOML; never overwritten.")],
    camera: Annotated[
        str | None,
        typer.Option("--camera", metavar="SOURCE", help="Index, device or URL; found by itself if left out."),
    ] = None,
    port: Annotated[
        str | None, typer.Option("--port", metavar="PORT", help="Of the board; found by itself if left out.")
    ] = None,
    steps: Annotated[
        int, typer.Option("--steps", metavar="N", min=1, help="Full steps of one turn of the motor.")
    ] = 200,
    microsteps: Annotated[
        int, typer.Option("--microsteps", metavar="N", min=1, max=256, help="As the driver's jumpers are set.")
    ] = 16,
    gear: Annotated[
        float,
        typer.Option(
            "--gear", metavar="RATIO", min=0.001, max=10000.0, help="Turns of the motor for one turn of the head."
        ),
    ] = 1.0,
    baseline_m: Annotated[
        float,
        typer.Option("--baseline-m", metavar="METRES", min=0.001, max=5.0, help="From the laser to the lens [m]."),
    ] = 0.08,
    beta_deg: Annotated[
        float,
        typer.Option(
            "--beta-deg", metavar="DEG", min=-79.0, max=79.0, help="By how much the camera is turned inward [deg]."
        ),
    ] = 25.7,
    alpha_deg: Annotated[
        float,
        typer.Option(
            "--alpha-deg", metavar="DEG", min=2.0, max=84.0, help="Half the camera's horizontal field of view [deg]."
        ),
    ] = 32.3,
    laser: Annotated[
        Literal["grbl", "always-on"],
        typer.Option("--laser", metavar="grbl|always-on", help="Switched by the board, or on batteries."),
    ] = "grbl",
) -> None:
    """Write a first configuration from what is plugged in.

    Example: scanmap init --out my-rig.toml --microsteps 16 --gear 3
    """
    from scanmap import session
    from scanmap.cli.terminal import say, stop_on_signal

    with stop_on_signal():
        drive, head = session.Drive(steps, microsteps, gear), session.Head(baseline_m, beta_deg, alpha_deg)
        for line in session.first_config(out, camera, port, drive, head, laser=laser):
            say(line)


@stage.command(context_settings={"ignore_unknown_options": True})  # -5 is an angle, not an option
def jog(
    by_deg: Annotated[
        float | None, typer.Argument(metavar="DEG", help="Turn by so much; negative is clockwise [deg].")
    ] = None,
    to: Annotated[float | None, typer.Option("--to", metavar="DEG", help="Turn to this bearing instead [deg].")] = None,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Turn the head by some degrees, or to a bearing; Ctrl-C stops it where it is.

    Examples: scanmap stage jog 10 --config my-rig.toml

    scanmap stage jog --to 90 --config my-rig.toml

    scanmap stage jog -5 --config my-rig.toml
    """
    from scanmap import session
    from scanmap.cli.terminal import say

    _work(config, set_, lambda rig: session.jog(rig, by_deg, to, say))


@stage.command()
def home(config: ConfigOption = None, set_: SetOption = None) -> None:
    """Find the head's home as stage.homing says: by switch, by index mark, or by hand."""
    from scanmap import session
    from scanmap.cli.terminal import say

    _work(config, set_, lambda rig: session.home(rig, say))


@stage.command()
def where(config: ConfigOption = None, set_: SetOption = None) -> None:
    """Say the bearing that the board reports; nothing moves."""
    from scanmap import session
    from scanmap.cli.terminal import say

    _work(config, set_, lambda rig: session.where(rig, say))


@stage.command()
def laser(
    switch: Annotated[Literal["on", "off"], typer.Argument(metavar="on|off", help="What the laser is to be.")],
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="S", min=0.1, max=600.0, help="It goes off after this long [s].")
    ] = 30.0,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Switch the laser on while this command runs, or off.

    It never stays on by itself: on lasts for --seconds, or until Ctrl-C. Read docs/laser-safety.md first.
    """
    from scanmap import session
    from scanmap.cli.terminal import say

    _work(config, set_, lambda rig: session.switch_laser(rig, say, on=switch == "on", seconds=seconds))


def _work(config: str | None, set_: list[str] | None, work: Callable[[Config], None]) -> None:
    """Load the configuration and do it, Ctrl-C and SIGTERM ending it with the laser off."""
    from scanmap.cli.terminal import stop_on_signal
    from scanmap.config import load

    with stop_on_signal():
        work(load(config, set_ or ()))
