"""Writing a calibration without losing the one that is there."""

from __future__ import annotations

import os
import shlex
import tempfile
from collections.abc import Sequence
from pathlib import Path, PurePath

from scanmap.calibration.head import Calibration
from scanmap.errors import CalibrationError, ConfigError


def refuse_path(path: Path) -> None:
    """Raise ConfigError where no calibration can be written; before anything is measured or solved."""
    if path.suffix.lower() != ".toml" and not path.is_dir():
        raise ConfigError(f"--out {path}: a calibration must end in .toml; try {path.with_suffix('.toml')}")
    refuse_file("--out", path)


def refuse_file(option: str, path: Path | None, suffix: str = "") -> None:
    """Raise ConfigError where `path` cannot be written, or does not end in `suffix` if one is asked for."""
    if path is None:
        return
    if path.is_dir():
        raise ConfigError(f"{option} {path} is a folder; give the name of a file in it")
    if suffix and path.suffix.lower() != suffix:
        raise ConfigError(f"{option} {path}: must end in {suffix}; try {path.with_suffix(suffix)}")
    folder = path.absolute().parent
    if not folder.is_dir():
        raise ConfigError(f"{option} {path}: there is no folder {folder}; make it first")
    _try_writing(f"{option} {path}", folder)


def refuse_folder(option: str, folder: Path | None) -> None:
    """Raise ConfigError where no files can be written into `folder`, which is made later if it is not there."""
    if folder is None:
        return
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{option} {folder} is a file; give a folder")
    there = next(each for each in (folder.absolute(), *folder.absolute().parents) if each.exists())
    if not there.is_dir():
        raise ConfigError(f"{option} {folder}: {there} is a file; give another folder")
    _try_writing(f"{option} {folder}", there)


def _try_writing(what: str, folder: Path) -> None:
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ConfigError(
            f"{what} cannot be written: {error.strerror or error}; choose a folder that can be written to"
        ) from error


def save_beside(calibration: Calibration, path: Path) -> Path | None:
    """Write a calibration whole or not at all; one that was there is kept beside it.

    Returns:
        Where the old one is now (`calibration.toml.1`, the next free number), or None where there was none.

    Raises:
        CalibrationError: it cannot be written; the old one is then still in its place.
    """
    text, kept = calibration.dumps(), None
    try:
        with tempfile.NamedTemporaryFile(
            "w", dir=path.absolute().parent, prefix=f".{path.name}.", delete=False, encoding="utf-8"
        ) as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        new = Path(file.name)
        try:
            new.chmod(0o644)
            kept = _kept(path) if path.exists() else None
            new.replace(path)
        finally:
            new.unlink(missing_ok=True)
    except OSError as error:
        raise CalibrationError(f"calibration {path} cannot be written: {error.strerror or error}") from error
    return kept


def existing(path: Path) -> Calibration | None:
    """The calibration at `path`; None where there is none, or a damaged one (which is kept beside all the same)."""
    try:
        return Calibration.load(path) if path.is_file() else None
    except CalibrationError:
        return None


def parts_lost(made: Calibration, path: Path) -> list[str]:
    """What the calibration at `path` has and `made` has not, in words; `made` is about to take its place."""
    old = existing(path)
    missing = list(made.meta.get("uncalibrated", ()))
    return [] if old is None else [part for part in missing if part not in old.meta.get("uncalibrated", ())]


def recorded_command(words: Sequence[str]) -> str:
    """A command line as a calibration keeps it: files by their names alone, addresses without who logs in."""
    return "scanmap " + shlex.join(_without_folders(word) for word in words)


def _without_folders(word: str) -> str:
    if word.startswith("-") or "=" in word.partition("/")[0]:
        name, sign, value = word.partition("=")
        return f"{name}{sign}{_without_folders(value)}" if sign else word
    if "://" in word:
        scheme, _, rest = word.partition("://")
        return f"{scheme}://{rest.partition('/')[0].rpartition('@')[2]}"
    return PurePath(word).name or word


def _kept(path: Path) -> Path:
    """A copy of the file at `path` under its name with the next free number."""
    number = 1
    while (beside := path.with_name(f"{path.name}.{number}")).exists():
        number += 1
    beside.write_bytes(path.read_bytes())
    return beside
