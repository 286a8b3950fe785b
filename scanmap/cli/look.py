"""`scanmap view`, `map` and `info`: looking at what was scanned."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from scanmap.cli.settings import CalibrationOption, ConfigOption, SetOption

Source = Annotated[
    Path, typer.Argument(metavar="SOURCE", help="A recording (.mcap), a folder with scan.csv, or a cloud (.ply).")
]


def view(
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="SOURCE", help="A recording (.mcap), a folder with scan.csv, a video, .rrd, cloud or mesh."
        ),
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

    Examples: scanmap view room.mcap

    scanmap view room.mcap --save room.rrd

    scanmap view --live 9876
    """
    from scanmap import session
    from scanmap.calibration.keeping import refuse_file
    from scanmap.cli.report import progress_bar
    from scanmap.cli.terminal import say, stop_on_signal
    from scanmap.errors import ConfigError, RecordingError

    if live is not None:
        if source is not None or save is not None:
            raise ConfigError("--live PORT watches a running scan; it takes neither SOURCE nor --save")
        session.watch(live)
        return
    if source is None:
        raise ConfigError("nothing to view: give SOURCE, or --live PORT of a running scan")
    if session.shown_as_it_is(source):
        if save is not None:
            raise ConfigError(f"--save makes an .rrd of a recording, a folder or a video; {source} is none")
        session.show_as_it_is(source)
        return
    refuse_file("--save", save, ".rrd")
    choice = session.Choice(config, tuple(set_ or ()), calibration)
    with stop_on_signal() as stop, session.prepare_view(source, choice, save) as job:
        for line in job.announcement:
            say(line)
        with progress_bar("reading", job.total) as progress:
            result = job.run(progress, stop.orderly("stopping: what was read so far is shown"))
        for fault in result.faults:
            say(f"fault: {fault}")
        if save is None and result.files:
            say("the viewer is open; this command ends with it")
            session.show(result.files[0]).wait()
        for path in result.files if save is not None else ():
            say(f"wrote {path}")
    if result.error is not None:
        raise result.error
    for path, error in result.unwritten:
        raise RecordingError(f"{path} could not be written: {error}")
    if result.ended == "interrupted":
        raise typer.Exit(130)


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
    from scanmap.calibration.keeping import refuse_file
    from scanmap.cli.report import progress_bar
    from scanmap.cli.terminal import say, stop_on_signal

    refuse_file("--out", out, ".yaml")
    settings = (*(set_ or ()), *session.map_settings(resolution_m, height_m))
    outputs = session.Outputs(map=out, map_image=image, map_mode=mode)
    choice = session.Choice(config, settings, calibration)
    if source.suffix.lower() == ".ply":
        for line in session.map_of_cloud(source, choice, outputs):
            say(line)
        return
    with (
        stop_on_signal() as stop,
        session.prepare_replay(source, choice, outputs) as job,
        progress_bar("reading", job.total) as progress,
    ):
        result = job.run(progress, stop.orderly("stopping: the map is made of what was read so far"))
    for line in session.map_lines(result):
        say(line)
    if result.error is not None:
        raise result.error
    if result.ended == "interrupted":
        raise typer.Exit(130)


def info(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="Recording, folder, cloud, mesh, map (.yaml), calibration or rig (.toml)."),
    ],
) -> None:
    """Say what a recording, cloud or map holds.

    Of a recording: plan, rig, versions, counts, how it ended.
    """
    from scanmap import session
    from scanmap.cli.terminal import say

    for line in session.describe(file):
        say(line)
