"""`scanmap calibrate latency`: how much later than its exposure the camera's picture is stamped."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from scanmap.cli.settings import CalibrationOption, ConfigOption, SetOption


def latency(
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: CalibrationOption = None,
    method: Annotated[
        Literal["sweep", "blink"],
        typer.Option(
            "--method",
            metavar="sweep|blink",
            help="sweep: turn forward and backward; blink: switch the laser, with the head at rest.",
        ),
    ] = "sweep",
    speed_deg_s: Annotated[
        list[float] | None,
        typer.Option(
            "--speed-deg-s",
            min=0.1,
            max=360.0,
            metavar="SPEED",
            help="Of the sweeps; two tell latency and backlash apart. Left out: sweep.speed_deg_s and thrice it.",
        ),
    ] = None,
    span_deg: Annotated[
        float | None,
        typer.Option(
            "--span-deg",
            min=1.0,
            max=3600.0,
            metavar="SPAN",
            help="Of the sweeps, about the middle of sweep.start_deg and end_deg; 4 s of turning if left out.",
        ),
    ] = None,
) -> None:
    """Measure the camera's latency, for sweeps that shoot while turning.

    Example: scanmap calibrate latency --config my-rig.toml
    """
    from scanmap import session
    from scanmap.cli.terminal import say, stop_on_signal

    choice = session.Choice(config, tuple(set_ or ()), calibration)
    with stop_on_signal():
        for line in session.measure_latency(choice, method, tuple(speed_deg_s or ()), say, span_deg):
            say(line)
