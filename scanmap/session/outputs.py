"""Which files a session leaves, checked before anything turns and written however the scan ended."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

from scanmap.errors import ConfigError, ScanmapError
from scanmap.grid import OccupancyGrid, save_map
from scanmap.scan import Scan, ScanParams
from scanmap.scan.formats import check_writable, write


@dataclass(frozen=True)
class Outputs:
    """Files a scan or replay was asked for."""

    clouds: tuple[Path, ...] = ()  # clouds and meshes, by extension
    map: Path | None = None  # the YAML; its image goes beside it
    record: Path | None = None
    rrd: Path | None = None
    map_image: Literal["pgm", "png"] = "pgm"
    map_mode: Literal["trinary", "scale"] = "trinary"

    @classmethod
    def of_scan(
        cls, clouds: tuple[Path, ...], map_: Path | None, record: Path | None, rrd: Path | None, *, keep: bool
    ) -> Outputs:
        """What a live scan leaves: with `--out room.ply` also room.yaml and, if `keep`, the recording room.mcap.

        A recording is never overwritten: where room.mcap exists, the new one is room-2.mcap.
        """
        cls(clouds).refuse_folders()
        first = clouds[0] if clouds else Path("scan.ply")
        if record is not None and record.exists():
            raise ConfigError(f"recording {record} exists and is not overwritten; give another --record or move it")
        if record is None and keep:
            record = first.with_name(f"{first.stem}.mcap")
            number = 2
            while record.exists():
                record = first.with_name(f"{first.stem}-{number}.mcap")
                number += 1
        if map_ is None and clouds:
            map_ = first.with_name(f"{first.stem}.yaml")
        return cls(clouds, map_, record, rrd)

    def after(self, ended: str) -> Outputs:
        """Where results go: those of a scan that broke off stand beside what has their names, which may be whole."""
        if ended == "finished":
            return self
        map_ = _free(self.map, f".{self.map_image}") if self.map is not None else None
        return replace(self, clouds=tuple(_free(path) for path in self.clouds), map=map_)

    @property
    def rrd_drawn(self) -> Path | None:
        """Where a view is written while the scan runs: beside an older one, which is whole."""
        return _free(self.rrd) if self.rrd is not None else None

    def placed_rrd(self, drawn: Path, ended: str) -> Path:
        """Where the view that was `drawn` is in the end: only that of a finished scan replaces an older one."""
        if ended != "finished" or self.rrd is None or drawn == self.rrd:
            return drawn
        try:
            return drawn.replace(self.rrd)
        except OSError:  # it is whole all the same, and named where it is
            return drawn

    def check(self) -> None:
        """Raise ConfigError unless every file can be written; before a scan is wasted on it."""
        self.refuse_folders()
        for path in self.clouds:
            check_writable(path)
        expected = ((self.map, ".yaml", "--map"), (self.record, ".mcap", "--record"), (self.rrd, ".rrd", "--rrd"))
        for path_or_none, suffix, option in expected:
            if path_or_none is None:
                continue
            if path_or_none.suffix != suffix:
                raise ConfigError(
                    f"{option} {path_or_none}: must end in {suffix}; try {path_or_none.with_suffix(suffix)}"
                )
            check_writable(path_or_none, suffixes=(suffix,))
        if self.map_mode == "scale" and self.map_image != "png":
            raise ConfigError(
                f"--mode scale marks unknown cells by transparency, {self.map_image} has none: --image png"
            )
        self._refuse_twins()

    def refuse_folders(self) -> None:
        """Raise ConfigError where a folder was named as a file."""
        for path in (*self.clouds, self.map, self.record, self.rrd):
            if path is not None and (path.is_dir() or path.name in ("", "..")):
                raise ConfigError(f"{path} is a folder; give the name of a file in it")

    def _refuse_twins(self) -> None:
        image = self.map.with_suffix(f".{self.map_image}") if self.map is not None else None
        seen: set[str] = set()
        for path in (*self.clouds, self.map, image, self.record, self.rrd):
            if path is None:
                continue
            name = os.path.realpath(path)
            if name in seen:
                raise ConfigError(f"two outputs have the name {path}; give each its own")
            seen.add(name)


def write_results(
    scan: Scan, grid: Callable[[], OccupancyGrid], outputs: Outputs, params: ScanParams
) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Write clouds and map. One that fails does not cost the others.

    Args:
        grid: gives the map; asked for once the clouds are written.
        params: what normals and meshes are made by.

    Returns:
        Files written, and those that could not be with the reason.
    """
    written: list[Path] = []
    failed: list[tuple[Path, str]] = []

    def attempt(path: Path, action: Callable[[], list[Path] | None]) -> None:
        try:
            written.extend(action() or [path])
        except OSError as error:
            failed.append((path, error.strerror or str(error)))
        except ScanmapError as error:
            failed.append((path, str(error)))

    for path in outputs.clouds:
        attempt(path, partial(write, scan, path, params))
    if outputs.map is not None:
        map_path = outputs.map
        attempt(map_path, lambda: save_map(grid(), map_path, image_format=outputs.map_image, mode=outputs.map_mode))
    return written, failed


def _free(path: Path, *others: str) -> Path:
    """The path, or `unfinished-1-room.ply` where it exists, or one of the same name with another suffix does."""
    free, number = path, 0
    while any(free.with_suffix(suffix).exists() for suffix in (path.suffix, *others)):
        number += 1
        free = path.with_name(f"unfinished-{number}-{path.name}")
    return free
