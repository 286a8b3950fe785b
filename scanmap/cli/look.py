"""`scanmap view`, `map` and `info`: looking at what was scanned."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from scanmap.cli.settings import CalibrationOption, ConfigOption, SetOption

Source = Annotated[Path, typer.Argument(help="A recording (.mcap), a folder with scan.csv, or a cloud (.ply).")]


def view(
    source: Annotated[
        Path | None, typer.Argument(help="A recording (.mcap), a folder with scan.csv, or a .rrd.")
    ] = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: CalibrationOption = None,
    save: Annotated[Path | None, typer.Option("--save", metavar="F.rrd", help="Write the .rrd; no viewer.")] = None,
    live: Annotated[
        int | None,
        typer.Option("--live", metavar="PORT", min=1, max=65535, help="Watch the scan that is served on this port."),
    ] = None,
) -> None:
    """Open the rerun viewer on 127.0.0.1 with scanmap's layout.

    Examples: scanmap view room.mcap;  scanmap view room.mcap --save room.rrd;  scanmap view --live 9876
    """
    from scanmap import session
    from scanmap.cli.report import progress_bar, say, stop_on_signal
    from scanmap.errors import ConfigError

    if live is not None:
        if source is not None or save is not None:
            raise ConfigError("--live PORT watches a running scan; it takes neither SOURCE nor --save")
        session.watch(live)
        return
    if source is None:
        raise ConfigError("nothing to view: give SOURCE, or --live PORT of a running scan")
    if source.suffix == ".rrd":
        if save is not None:
            raise ConfigError(f"{source} is a .rrd already; --save wants a recording or a folder")
        session.show(source)
        return
    with session.prepare_view(source, session.Choice(config, tuple(set_ or ()), calibration), save) as job:
        with stop_on_signal() as stop, progress_bar() as progress:
            result = job.run(progress, stop)
        for fault in result.faults:
            say(f"fault: {fault}")
        if save is None and result.files:
            session.show(result.files[0])
        else:
            for path in result.files:
                say(f"wrote {path}")
    if result.error is not None:
        raise result.error


def make_map(
    source: Source,
    out: Annotated[Path, typer.Option("--out", metavar="F.yaml", help="The map's YAML; its image goes beside it.")],
    resolution_m: Annotated[
        float | None, typer.Option("--resolution-m", metavar="METRES", help="Side of a cell [m].")
    ] = None,
    height_m: Annotated[
        str | None,
        typer.Option("--height-m", metavar="LOW:HIGH", help="Heights above the floor that count as obstacles [m]."),
    ] = None,
    image: Annotated[
        Literal["pgm", "png"], typer.Option("--image", metavar="pgm|png", help="Format of the map's image.")
    ] = "pgm",
    mode: Annotated[
        Literal["trinary", "scale"],
        typer.Option("--mode", metavar="trinary|scale", help="How the image's pixels count."),
    ] = "trinary",
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: CalibrationOption = None,
) -> None:
    """Make the occupancy map (image + YAML) that Nav2 loads.

    Example: scanmap map room.mcap --out room.yaml --resolution-m 0.05 --height-m 0.1:1.8
    """
    from scanmap import session
    from scanmap.cli.report import progress_bar, say, stop_on_signal

    settings = (*(set_ or ()), *session.map_settings(resolution_m, height_m))
    outputs = session.Outputs(map=out, map_image=image, map_mode=mode)
    with stop_on_signal() as stop, progress_bar() as progress:
        made = session.make_map(source, session.Choice(config, settings, calibration), outputs, progress, stop)
    for line in made:
        say(line)


def info(file: Annotated[Path, typer.Argument(help="A recording, cloud, map (.yaml) or calibration (.toml).")]) -> None:
    """Say what a recording, cloud or map holds: plan, rig, versions, counts, how it ended."""
    from scanmap import session
    from scanmap.cli.report import say

    for line in session.describe(file):
        say(line)
