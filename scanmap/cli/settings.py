"""`scanmap config`: the effective configuration; and what options of several commands mean."""

from __future__ import annotations

import shlex
from typing import Annotated

import typer

ConfigOption = Annotated[
    str | None, typer.Option("--config", metavar="FILE|PRESET", help="A rig's TOML, or the name of a preset.")
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change one key: sweep.step_deg=0.5. Repeatable.")
]
CalibrationOption = Annotated[
    str | None,
    typer.Option("--calibration", metavar="FILE", help="calibration.toml of the head; goes before all others."),
]


def config(config: ConfigOption = None, set_: SetOption = None) -> None:
    """Print the effective configuration as TOML.

    Every key has its unit, meaning and limits beside it: redirect it to a file for a rig's TOML of your own.
    """
    from scanmap.cli.terminal import output
    from scanmap.config import load

    output.write(load(config, set_ or ()).explained())


def size_of(option: str, text: str) -> tuple[int, int]:
    """Width and height [px] of `1920x1080`; ConfigError where it is none."""
    from scanmap.errors import ConfigError

    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and 8 <= int(width) <= 20000 and 8 <= int(height) <= 20000):
        raise ConfigError(f"{option} {text}: not WIDTHxHEIGHT, 8 to 20000 pixels each; try {option} 1920x1080")
    return int(width), int(height)


def again(config: str | None, set_: list[str] | None) -> str:
    """The options that a following command needs too."""
    options = [] if config is None else [f" --config {shlex.quote(config)}"]
    return "".join([*options, *(f" --set {shlex.quote(one)}" for one in set_ or ())])
