"""Looking at what was scanned: the viewer, and a map of an old scan."""

from __future__ import annotations

import shlex
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from scanmap.errors import ConfigError, RecordingError
from scanmap.grid import OccupancyGrid, save_map
from scanmap.scan.formats import read_ply
from scanmap.session.job import Job, Result
from scanmap.session.outputs import Outputs
from scanmap.session.preparing import Choice, prepare_replay, require_display
from scanmap.view import show

# What the viewer opens without a recording to make a view of.
SHOWN_AS_THEY_ARE = (".rrd", ".ply", ".glb", ".stl", ".obj")


def shown_as_it_is(path: Path) -> bool:
    """Whether the viewer opens this file directly: a view, a cloud or a mesh."""
    return path.suffix.lower() in SHOWN_AS_THEY_ARE


def show_as_it_is(path: Path) -> None:
    """Open the viewer on a file that needs no work.

    Raises:
        ConfigError: no such file, no display, or the viewer does not start.
    """
    if not path.is_file():
        raise ConfigError(f"{path} is not a file; make a view with scanmap view SOURCE --save F.rrd")
    require_display(f"open it where there is one: rerun {shlex.quote(str(path))}")
    show(path)


def prepare_view(source: Path, choice: Choice, save: Path | None) -> Job:
    """A replay that leaves nothing but an .rrd: `save`, or a temporary file that lives as long as the job."""
    if save is None:
        require_display("write a file with --save F.rrd and open it where there is one with scanmap view F.rrd")
        folder = TemporaryDirectory(prefix="scanmap-")
        job = prepare_replay(source, choice, Outputs(rrd=Path(folder.name) / f"{source.stem or 'scan'}.rrd"))
        job.closers.append(folder.cleanup)
        return job
    return prepare_replay(source, choice, Outputs(rrd=save))


def watch(port: int) -> None:
    """Attach a viewer to the scan that is served on `port` of this machine."""
    show(port)


def map_settings(resolution_m: float | None, height_m: str | None) -> list[str]:
    """`--resolution-m` and `--height-m LOW:HIGH` as settings of `[grid]`.

    Raises:
        ConfigError: `height_m` is not two numbers.
    """
    settings = [] if resolution_m is None else [f"grid.resolution_m={resolution_m!r}"]
    if height_m is not None:
        low, colon, high = height_m.partition(":")
        try:
            numbers = float(low), float(high)
        except ValueError:
            colon = ""
        if not colon:
            raise ConfigError(f"--height-m {height_m}: not LOW:HIGH in metres; try --height-m 0.1:1.8")
        settings += [f"grid.height_low_m={numbers[0]!r}", f"grid.height_high_m={numbers[1]!r}"]
    return settings


def map_of_cloud(source: Path, choice: Choice, outputs: Outputs) -> list[str]:
    """Write the map of a cloud that scanmap wrote; returns lines that say what was done.

    Raises:
        ConfigError, RecordingError: the cloud is missing, damaged, of another program, or empty.
    """
    outputs.check()
    if not source.exists():
        raise ConfigError(f"{source} does not exist; scanmap map wants a recording, a folder with scan.csv or a cloud")
    scan = read_ply(source)
    if outputs.map is None or not scan.valid.any():
        raise RecordingError(f"{source} holds no point to make a map of")
    grid = OccupancyGrid.from_scan(scan, choice.load().grid)
    files = save_map(grid, outputs.map, image_format=outputs.map_image, mode=outputs.map_mode)
    return [*grid_lines(grid), *(f"wrote {path}" for path in files)]


def map_lines(result: Result) -> list[str]:
    """What a replay made as a map, in lines.

    Raises:
        Exception: what ended the replay, or kept the map from being written.
    """
    if result.unwritten:
        raise RecordingError(result.unwritten[0][1])
    if result.grid is None and result.error is not None:
        raise result.error
    lines = [f"fault: {fault}" for fault in result.faults]
    return lines + (grid_lines(result.grid) if result.grid is not None else []) + [f"wrote {p}" for p in result.files]


def grid_lines(grid: OccupancyGrid) -> list[str]:
    """Size of a grid and what its cells say."""
    rows, columns = grid.log_odds.shape
    cells = rows * columns
    shares = {
        name: 100.0 * int(np.count_nonzero(mask)) / cells
        for name, mask in (("occupied", grid.occupied), ("free", grid.free), ("unknown", grid.unknown))
    }
    lines = [
        f"map: {columns} x {rows} cells of {grid.resolution_m:g} m, lower-left corner at "
        f"({grid.origin[0]:.3f}, {grid.origin[1]:.3f}) m",
        "cells: " + ", ".join(f"{name} {share:.1f} %" for name, share in shares.items()),
    ]
    if not (grid.occupied.any() or grid.free.any()):
        lines.append(
            "nothing was seen at these heights above the floor, so the whole map is unknown: see grid.height_low_m and "
            "grid.height_high_m (--height-m LOW:HIGH)"
        )
    return lines + ([grid.floor.words] if grid.floor is not None else [])
