"""Make a whole recording of one that was cut, damaged or continued in parts."""

from __future__ import annotations

import shlex
from pathlib import Path

from scanmap import recording
from scanmap.errors import ConfigError
from scanmap.scan.formats import check_writable


def recover(path: Path, out: Path | None = None) -> list[str]:
    """Copy what can be read into a new file; returns lines that say what was saved.

    Raises:
        ConfigError: no such file, nothing is wrong with it, or names that cannot be.
        RecordingError: nothing can be saved, or the new file cannot be written.
    """
    if path.suffix != ".mcap" or not path.is_file():
        what = "not a recording" if path.exists() else "there is no such file"
        raise ConfigError(f"{path}: {what}; scanmap recover wants the .mcap file of a scan")
    out = out or path.with_name(f"{path.stem}.whole.mcap")
    if out.suffix != ".mcap" or recording.is_later_part(out):
        raise ConfigError(f"--out {out}: must end in .mcap, and not in .part2.mcap; try {path.stem}.whole.mcap")
    if out.exists():
        raise ConfigError(f"recording {out} exists and is not overwritten; give another --out or move it")
    check_writable(out, suffixes=(".mcap",))
    saved = recording.recover(path, out)
    source = recording.open_source(path)
    readable = sum(1 for _ in source.shots())
    return [
        f"wrote {out}: {readable} shots, whole; {path} is as it was",
        *(f"lost: {fault}" for fault in source.faults),
        *saved.lines[1:3],
        f"next: scanmap replay {shlex.quote(str(out))} --out room.ply",
    ]
