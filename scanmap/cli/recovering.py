"""`scanmap recover`: a whole recording made of a cut, damaged or continued one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def recover(
    recording: Annotated[Path, typer.Argument(metavar="F.mcap", help="A recording that is cut or damaged.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="G.mcap", help="The new file; F.whole.mcap by default.")
    ] = None,
) -> None:
    """Make a whole recording of one that was cut or damaged.

    Everything that can be read goes into a new file, which every MCAP reader opens; parts of a resumed scan are
    joined. The old file is not touched. scanmap itself replays a cut file as it is.

    Example: scanmap recover room.mcap
    """
    from scanmap import session
    from scanmap.cli.terminal import say, stop_on_signal

    with stop_on_signal():
        lines = session.recover(recording, out)
    for line in lines:
        say(line)
