"""`scanmap scan` and `scanmap replay`: from a rig or a recording to a cloud, a map and a picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scanmap.cli.settings import CalibrationOption, ConfigOption, SetOption

if TYPE_CHECKING:
    from scanmap.session import Result

OutOption = Annotated[
    list[Path] | None,
    typer.Option("--out", metavar="FILE", help="Cloud (.ply .pcd .xyz) or mesh (.glb .stl, mesh.ply); repeatable."),
]
MapOption = Annotated[Path | None, typer.Option("--map", metavar="F.yaml", help="Occupancy map that Nav2 loads.")]
RrdOption = Annotated[Path | None, typer.Option("--rrd", metavar="F.rrd", help="rerun recording with our layout.")]
ViewOption = Annotated[bool, typer.Option("--view", help="Open the rerun viewer on 127.0.0.1 and show it live.")]


def scan(
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: CalibrationOption = None,
    out: OutOption = None,
    map_: MapOption = None,
    record: Annotated[
        Path | None, typer.Option("--record", metavar="F.mcap", help="The recording; beside --out by default.")
    ] = None,
    no_record: Annotated[bool, typer.Option("--no-record", help="Keep no recording.")] = False,
    rrd: RrdOption = None,
    view: ViewOption = False,
) -> None:
    """Sweep the rig and write what it sees. Without --config the rig is the digital twin: no hardware needed.

    Example: scanmap scan --out room.ply --map room.yaml
    """
    from scanmap import session
    from scanmap.cli.report import progress_bar, say, stop_on_signal
    from scanmap.errors import ConfigError

    if record is not None and no_record:
        raise ConfigError("--record and --no-record exclude each other; give one")
    outputs = session.Outputs.of_scan(tuple(out or ()), map_, record, rrd, keep=not no_record)
    with session.prepare_scan(session.Choice(config, tuple(set_ or ()), calibration), outputs, view=view) as job:
        for line in job.announcement:
            say(line)
        with stop_on_signal() as stop, progress_bar() as progress:
            result = job.run(progress, stop)
    _finish(result)


def replay(
    source: Annotated[Path, typer.Argument(help="A recording (.mcap), a folder with scan.csv, or a video.")],
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: CalibrationOption = None,
    bearings: Annotated[
        Path | None, typer.Option("--bearings", metavar="F.csv", help="Bearings of a video; by default beside it.")
    ] = None,
    out: OutOption = None,
    map_: MapOption = None,
    rrd: RrdOption = None,
    view: ViewOption = False,
) -> None:
    """Make everything again from a recording, with other settings or another calibration if you like.

    With the settings it was recorded with, the result equals the live scan bit for bit.

    Example: scanmap replay room.mcap --set laserline.method=cog --out room-cog.ply
    """
    from scanmap import session
    from scanmap.cli.report import progress_bar, say, stop_on_signal

    outputs = session.Outputs(tuple(out or ()), map_, rrd=rrd)
    choice = session.Choice(config, tuple(set_ or ()), calibration)
    with session.prepare_replay(source, choice, outputs, bearings=bearings, view=view) as job:
        for line in job.announcement:
            say(line)
        with stop_on_signal() as stop, progress_bar() as progress:
            result = job.run(progress, stop)
    _finish(result)


def _finish(result: Result) -> None:
    from scanmap.cli.report import print_result

    print_result(result)
    if result.error is not None:
        raise result.error
    if result.unwritten:
        raise typer.Exit(1)
    if result.ended == "interrupted":
        raise typer.Exit(130)
