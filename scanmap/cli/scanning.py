"""`scanmap scan` and `scanmap replay`: from a rig or a recording to a cloud, a map and a picture."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scanmap.cli.settings import CalibrationOption, ConfigOption, SetOption

if TYPE_CHECKING:
    from scanmap.session import Job

OutOption = Annotated[
    list[Path] | None,
    typer.Option("--out", metavar="FILE", help="Cloud (.ply .pcd .xyz) or mesh (.glb .stl .obj mesh.ply); repeatable."),
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
    resume: Annotated[
        Path | None, typer.Option("--resume", metavar="F.mcap", help="Go on with the scan recorded there.")
    ] = None,
    rrd: RrdOption = None,
    view: ViewOption = False,
) -> None:
    """Sweep the rig and write what it sees.

    Without --config the rig is the digital twin: no hardware needed.

    Example: scanmap scan --out room.ply --map room.yaml
    """
    from scanmap import session
    from scanmap.errors import ConfigError

    if record is not None and no_record:
        raise ConfigError("--record and --no-record exclude each other; give one")
    if resume is not None and (record is not None or no_record):
        raise ConfigError("--resume goes on in a part beside its recording: leave --record and --no-record out")
    keep = not no_record and resume is None
    outputs = session.Outputs.of_scan(tuple(out or ()), map_, record, rrd, keep=keep)
    choice = session.Choice(config, tuple(set_ or ()), calibration)
    words = "stopping: the head parks, everything scanned is kept"
    _run(lambda: session.prepare_scan(choice, outputs, view=view, resume=resume), "scanning", words)


def replay(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="A recording (.mcap), a folder with scan.csv, or a video.")
    ],
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
    """Make everything again from a recording.

    Other settings and another calibration can be given. With the settings it was recorded with, the result
    equals the live scan bit for bit.

    Example: scanmap replay room.mcap --set laserline.method=cog --out cog.ply
    """
    # Nothing here is large matrices, and a process without threads can be copied instead of started anew.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from scanmap import session

    outputs = session.Outputs(tuple(out or ()), map_, rrd=rrd)
    choice = session.Choice(config, tuple(set_ or ()), calibration)
    words = "stopping: everything replayed so far is written"
    _run(
        lambda: session.prepare_replay(source, choice, outputs, bearings=bearings, view=view),
        "replaying",
        words,
    )


def _run(prepare: Callable[[], Job], work: str, words: str) -> None:
    """Open a job, run it, say how it ended, and exit with the code for that."""
    from scanmap.cli.report import print_result, progress_bar
    from scanmap.cli.terminal import say, stop_on_signal

    with stop_on_signal() as stop, prepare() as job:
        for line in job.announcement:
            say(line)
        with progress_bar(work, job.total) as progress:
            result = job.run(progress, stop.orderly(words))
    print_result(result)
    if result.error is not None:
        raise result.error
    if result.unwritten:
        raise typer.Exit(1)
    if result.ended == "interrupted":
        raise typer.Exit(130)
