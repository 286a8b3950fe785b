"""A first configuration of a rig, from what is plugged in and how its head is built."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from scanmap.calibration.keeping import refuse_file
from scanmap.config import Config, parse
from scanmap.errors import CameraError, ConfigError, StageError
from scanmap.rig.camera import CameraParams, camera_devices, open_camera
from scanmap.rig.camera_probe import Mode, probe_modes
from scanmap.rig.grbl_opening import identify
from scanmap.rig.serial_port import serial_devices
from scanmap.rig.stage import StageParams

ENOUGH_HZ = 4.0  # a size that comes slower than this makes scans long
DEFAULT_SIZE = (1280, 720)
MOST_PX = 2000  # width; more makes files large and finds the line no better


class Drive(NamedTuple):
    """How the motor turns the head."""

    steps: int  # of the motor, one turn
    microsteps: int
    gear: float  # turns of the motor for one turn of the head

    @property
    def steps_per_deg(self) -> float:
        """$100 of the board, where one unit is one degree."""
        return self.steps * self.microsteps * self.gear / 360.0


class Head(NamedTuple):
    """How camera and laser stand on the head, by its drawing."""

    baseline_m: float
    beta_deg: float
    alpha_deg: float


class Found(NamedTuple):
    """What is plugged in; text for people beside it."""

    camera: int | str
    size: tuple[int, int]  # of its pictures [px]
    port: str
    lines: list[str]


def look_around() -> Found:
    """The first camera that sends pictures and the first port where a GRBL board answers; `auto` where none is."""
    lines: list[str] = []
    camera: int | str = "auto"
    size = DEFAULT_SIZE
    for index, name in camera_devices():
        try:
            modes = probe_modes(index)
        except CameraError as error:
            lines.append(str(error))
            continue
        if modes:
            mode = _best(modes)
            camera, size = index, mode.size
            lines.append(f"camera {index} ({name}): {mode.words}")
            break
    else:
        lines.append("no camera found: camera.source = 'auto' takes the first one that is plugged in later")
    port = "auto"
    for device in serial_devices():
        try:
            lines.append(f"board on {device}: {identify(device, StageParams())}")
        except StageError:
            continue
        port = device
        break
    else:
        lines.append("no GRBL board found: stage.port = 'auto' takes the first one that answers later")
    return Found(camera, size, port, lines)


def first_config(
    path: Path, camera: str | None, port: str | None, drive: Drive, head: Head, *, laser: str
) -> Iterator[str]:
    """Look around, write the TOML and say what was found and what to do next, line by line.

    Raises:
        ConfigError: as `write_first_config`; what is there is never overwritten.
    """
    if path.exists():
        raise ConfigError(f"{path} exists and is not overwritten: choose another --out, or move it away")
    refuse_file("--out", path, ".toml")
    _configuration(Found("auto", DEFAULT_SIZE, "auto", []), drive, head, laser)  # numbers that make no rig: said now
    found = look_around()
    yield from found.lines
    if camera is not None and (chosen := int(camera) if camera.isdigit() else camera) != found.camera:
        size, words = _size_of(chosen)
        yield words
        found = found._replace(camera=chosen, size=size)
    write_first_config(path, found._replace(port=port or found.port), drive, head, laser=laser)
    name = shlex.quote(str(path))
    yield f"wrote {path}: one degree is {drive.steps_per_deg:g} motor steps"
    yield f"next: scanmap doctor --config {name}"
    yield f"next: scanmap stage jog 10 --config {name}"
    yield f"next: scanmap scan --config {name} --out room.ply"


def write_first_config(path: Path, found: Found, drive: Drive, head: Head, *, laser: str) -> Config:
    """Write a rig's TOML in which every key says what it means; returns it as it will be loaded.

    Raises:
        ConfigError: the file exists, cannot be written, or a value is outside its limits.
    """
    if path.suffix != ".toml":
        raise ConfigError(f"--out {path}: must end in .toml; try {path.with_suffix('.toml')}")
    config = _configuration(found, drive, head, laser)
    try:
        with path.open("x", encoding="utf-8") as file:
            file.writelines(f"{line}\n" for line in _text(config, drive))
    except FileExistsError as error:
        raise ConfigError(f"{path} exists and is not overwritten: choose another --out, or move it away") from error
    except OSError as error:
        raise ConfigError(f"{path} cannot be written ({error.strerror}): choose another --out") from error
    return config


def _configuration(found: Found, drive: Drive, head: Head, laser: str) -> Config:
    import tomli_w

    size = found.size
    document: dict[str, Any] = {
        "description": "a first configuration: measure the head, then calibrate it",
        "rig": "hardware",
        "calibration": {"image": {"width": size[0], "height": size[1]}, "head": head._asdict()},
        "camera": {"source": found.camera, "width": size[0], "height": size[1], "exposure_us": 5000.0},
        "stage": {"port": found.port, "steps_per_deg": drive.steps_per_deg, "laser": laser},
        "sweep": {"off_frames": laser == "grbl"},
    }
    return parse(tomli_w.dumps(document), "the first configuration")


def _size_of(source: int | str) -> tuple[tuple[int, int], str]:
    """Picture size of a camera that was named, from its first picture; and words about it."""
    try:
        camera = open_camera(CameraParams(source=source))
    except (CameraError, ConfigError) as error:
        return DEFAULT_SIZE, f"{error}; {DEFAULT_SIZE[0]}x{DEFAULT_SIZE[1]} is written for now"
    with closing(camera):
        return (camera.width, camera.height), f"camera {source}: pictures of {camera.width}x{camera.height}"


def _best(modes: list[Mode]) -> Mode:
    """The widest that comes fast enough, as JPEG if possible."""
    fit = [mode for mode in modes if mode.rate_hz >= ENOUGH_HZ and mode.size.width <= MOST_PX] or modes
    return max(fit, key=lambda mode: (mode.sends_jpeg, mode.size.width * mode.size.height))


def _text(config: Config, drive: Drive) -> Iterator[str]:
    yield "# A rig of your own. What is not here has its default: `scanmap config` lists every key with its meaning."
    yield "# Wiring: docs/wiring.md. Before the laser is switched on: docs/laser-safety.md."
    yield f"# {drive.steps} steps x {drive.microsteps} microsteps x {drive.gear:g} gear / 360 = steps_per_deg."
    yield "# The head below is its drawing. Measure baseline_m between laser and lens, or calibrate: scanmap calibrate."
    yield from config.explained(("description", "rig", "calibration", "sweep", "camera", "stage")).splitlines()
