"""Looking at what is there: what a file holds, a map of an old scan, the viewer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from scanmap import recording
from scanmap.calibration import Calibration
from scanmap.errors import ConfigError, RecordingError
from scanmap.grid import OccupancyGrid, load_map, save_map
from scanmap.scan.formats import read_ply
from scanmap.session.job import Job, Progress
from scanmap.session.outputs import Outputs
from scanmap.session.preparing import Choice, prepare_replay
from scanmap.session.summary import summarise
from scanmap.view import show


def prepare_view(source: Path, choice: Choice, save: Path | None) -> Job:
    """A replay that leaves nothing but an .rrd: `save`, or a temporary file that lives as long as the job."""
    folder = TemporaryDirectory(prefix="scanmap-") if save is None else None
    rrd = save if folder is None else Path(folder.name) / f"{source.stem or 'scan'}.rrd"
    job = prepare_replay(source, choice, Outputs(rrd=rrd))
    if folder is not None:
        job.closers.append(folder.cleanup)
    return job


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


def make_map(
    source: Path, choice: Choice, outputs: Outputs, progress: Callable[[Progress], None], stop: Callable[[], bool]
) -> list[str]:
    """Write the map of a recording, a folder of frames or a cloud; returns lines that say what was done.

    Args:
        outputs: the map alone.
    """
    if outputs.map is None:
        raise ConfigError("no map named; give --out room.yaml")
    if source.suffix == ".ply":
        outputs.check()
        grid = OccupancyGrid.from_scan(read_ply(source), choice.load().grid)
        save_map(grid, outputs.map, image_format=outputs.map_image, mode=outputs.map_mode)
        return [*grid_lines(grid), f"wrote {outputs.map}"]
    with prepare_replay(source, choice, outputs) as job:
        result = job.run(progress, stop)
    if result.error is not None:
        raise result.error
    if result.grid is None:
        raise RecordingError(f"{source} gives no point to make a map of; scanmap replay {source} says why")
    if result.unwritten:
        raise RecordingError(result.unwritten[0][1])
    return [*(f"fault: {fault}" for fault in result.faults), *grid_lines(result.grid), f"wrote {outputs.map}"]


def describe(path: Path) -> list[str]:
    """What a recording, cloud, map or calibration holds, as lines.

    Raises:
        ConfigError: no such file, or of a kind scanmap does not know.
        RecordingError, CalibrationError: it is damaged.
    """
    if not path.exists():
        raise ConfigError(f"{path} does not exist; scanmap info wants a recording, cloud, map or calibration")
    readers: dict[str, Callable[[Path], list[str]]] = {
        ".ply": _describe_cloud,
        ".yaml": _describe_map,
        ".yml": _describe_map,
        ".toml": _describe_calibration,
    }
    if path.suffix in readers:
        return readers[path.suffix](path)
    return recording.describe(path).lines


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
    return lines + ([grid.floor.words] if grid.floor is not None else [])


def _describe_cloud(path: Path) -> list[str]:
    scan = read_ply(path)
    summary = summarise(scan)
    first, last = np.degrees(scan.bearings[[0, -1]])
    return [
        f"cloud {path}: {summary.points} points",
        f"bearings: {summary.bearings} from {first:.3f} to {last:.3f} deg, {summary.rows} image rows",
        f"range: {summary.range_min_m:.3f} to {summary.range_max_m:.3f} m, median {summary.range_median_m:.3f} m",
        *(f"{key}: {value}" for key, value in scan.comments.items()),
    ]


def _describe_map(path: Path) -> list[str]:
    return [f"map {path}", *grid_lines(load_map(path))]


def _describe_calibration(path: Path) -> list[str]:
    head = Calibration.load(path)
    own = head.intrinsics
    return [
        f"calibration {path}: {own.width}x{own.height} px, fx {own.fx:.2f}, fy {own.fy:.2f}, "
        f"cx {own.cx:.2f}, cy {own.cy:.2f}",
        f"baseline {1e3 * head.baseline_m:.2f} mm, beta {np.degrees(head.beta):.3f} deg, "
        f"half view {np.degrees(head.alpha):.2f} deg",
        f"head offset {tuple(head.mount.offset_m)} m, axis tilt {tuple(head.mount.tilt_deg)} deg",
        *(f"{key}: {value}" for table in (head.residuals, head.meta) for key, value in table.items()),
    ]
