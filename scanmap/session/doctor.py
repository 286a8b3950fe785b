"""Look at everything a scan needs, and say what to do about each fault."""

from __future__ import annotations

import shutil
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

from scanmap.calibration import Calibration
from scanmap.config import Config
from scanmap.errors import CalibrationError, CameraError, ConfigError, ScanmapError, StageError
from scanmap.pipeline import Pipeline
from scanmap.rig import Frame, Streaming
from scanmap.rig.camera import camera_devices
from scanmap.rig.camera_probe import probe_modes
from scanmap.rig.grbl_opening import identify
from scanmap.rig.serial_port import serial_devices
from scanmap.session.latency import laser_contrast, latency_by_blinks
from scanmap.session.preparing import Choice, rig_words
from scanmap.session.rigs import OpenRig, open_rig
from scanmap.shot import Shot
from scanmap.sweep import plan

TIMED_SHOTS = 6
BLINKS = 8  # enough for a few milliseconds
WEAK_CONTRAST_DN = 25.0  # [grey levels] below it the line is lost on dark things
MB = 1e6

State = Literal["ok", "note", "fault", "busy"]


class Finding(NamedTuple):
    """One thing that was looked at."""

    part: str  # camera, board, rig, laser, latency, disk, speed, calibration
    state: State  # note: worth knowing, but nothing that this configuration needs; busy: what it is about to do
    words: str


def examine(choice: Choice, folder: Path) -> Generator[Finding]:
    """Everything a scan with this configuration needs; each finding as soon as it is known.

    Args:
        folder: where recordings will go.

    Raises:
        ConfigError: the configuration itself is faulty.
    """
    config = choice.load()
    yield from cameras(needed=config.rig == "hardware" and config.camera.kind == "device")
    yield from boards(config, needed=config.rig == "hardware" and config.stage.kind == "grbl")
    head, finding = _head(choice, config)
    yield finding
    if config.rig == "replay-only":
        yield Finding("rig", "note", "this configuration is for recordings: there is no rig to look at")
    elif head is not None:
        yield from _rig(config, head, folder)


def cameras(*, needed: bool) -> Iterator[Finding]:
    """Every camera of this machine with its picture sizes and rates."""
    devices = camera_devices()
    if not devices:
        advice = "plug a webcam in; on Linux it appears as /dev/video0. A phone's camera app works too: camera.source"
        yield Finding("camera", "fault" if needed else "note", f"none on this machine: {advice}")
    for index, name in devices:
        try:
            modes = probe_modes(index)
        except CameraError as error:
            yield Finding("camera", "fault" if needed else "note", f"{index} ({name}): {error}")
            continue
        words = ", ".join(mode.words for mode in modes) or "sends no picture: unplug it and plug it in again"
        yield Finding("camera", "ok" if modes else "fault", f"{index} ({name}): {words}")


def boards(config: Config, *, needed: bool) -> Iterator[Finding]:
    """Every serial port of this machine and what answers there."""
    ports = serial_devices()
    if config.rig == "hardware" and config.stage.kind == "grbl" and config.stage.port not in ("auto", *ports):
        ports.append(config.stage.port)
    if not ports:
        advice = "plug the board in and give it power; the cable must carry data, not only power"
        yield Finding("board", "fault" if needed else "note", f"no serial port on this machine: {advice}")
    for port in ports:
        try:
            yield Finding("board", "ok", f"{port}: {identify(port, config.stage)}")
        except StageError as error:
            chosen = needed and config.stage.port == port
            words = str(error).removeprefix(f"stage port {port} ").removeprefix(f"{port}: ")
            yield Finding("board", "fault" if chosen else "note", f"{port}: {words}")


def _head(choice: Choice, config: Config) -> tuple[Calibration | None, Finding]:
    try:
        head = choice.head() or config.head()
    except (CalibrationError, ConfigError) as error:
        return None, Finding("calibration", "fault", str(error))
    size = f"{head.intrinsics.width}x{head.intrinsics.height} px"
    measured = "measured" if head.residuals else "from its drawing, not measured"
    return head, Finding("calibration", "ok", f"baseline {1e3 * head.baseline_m:.1f} mm, {size}, {measured}")


def _rig(config: Config, head: Calibration, folder: Path) -> Iterator[Finding]:
    """The rig itself, opened; closed at the end, laser off."""
    try:
        opened = open_rig(config, head)
    except ScanmapError as error:
        yield Finding("rig", "fault", str(error))
        return
    try:
        yield Finding("rig", "ok", rig_words(config, opened.rig).removeprefix("rig: "))
        opened.rig.stage.laser(True)
        frame = opened.rig.camera.grab()
        opened.rig.stage.laser(False)
        yield _picture(opened, config, head)
        yield from _speed(opened, config, head, frame)
        yield _disk(config, folder, len(frame.image))
        if config.camera.kind in ("device", "http", "stream") or opened.rig.is_twin:
            yield from _laser(opened, config)
    except ScanmapError as error:
        yield Finding("rig", "fault", str(error))
    finally:
        opened.close()


def _picture(opened: OpenRig, config: Config, head: Calibration) -> Finding:
    camera = opened.rig.camera
    head.check_image(camera.width, camera.height)
    size = f"pictures of {camera.width}x{camera.height}"
    if not isinstance(camera, Streaming) or (config.camera.kind in ("file", "folder") and not opened.rig.is_twin):
        return Finding("picture", "ok", size)
    return Finding("picture", "ok", f"{size}, {_rate(camera):.1f} a second")


def _rate(camera: Streaming) -> float:
    """Pictures a second."""
    times = [camera.newest().time for _ in range(10)]
    return 9 / max(times[-1] - times[0], 1e-6)


def _laser(opened: OpenRig, config: Config) -> Iterator[Finding]:
    """Contrast and latency, both by switching it."""
    rig = opened.rig
    if not rig.stage.laser_switchable:
        yield Finding("laser", "note", "cannot be switched by software: it shines until you turn it off")
        return
    if isinstance(rig.camera, Streaming):
        yield Finding("laser", "busy", f"blinking it {BLINKS} times")
        found, contrast = latency_by_blinks(opened, lambda _: None, BLINKS)
    else:
        found, contrast = None, laser_contrast(rig)
    words = f"on and off differ by {contrast.level_dn:.0f} grey levels in {contrast.lit_px} pixels"
    weak = contrast.level_dn < WEAK_CONTRAST_DN
    advice = ": little; darken the room, expose longer (camera.exposure_us), or put a red filter before the lens"
    yield Finding("laser", "fault" if weak else "ok", words + (advice if weak else ""))
    if found is not None:
        taken_off = (config.camera.latency_s or 0.0) if rig.is_twin else config.camera.latency
        latency_s = taken_off + found.latency_s
        unset = config.camera.latency_s is None and not rig.is_twin
        advice = f"; set camera.latency_s = {latency_s:.3f}" if unset else ""
        state: State = "note" if unset else "ok"
        yield Finding("latency", state, f"{1e3 * latency_s:.0f} +- {1e3 * found.sigma_s:.0f} ms{advice}")


def _speed(opened: OpenRig, config: Config, head: Calibration, frame: Frame) -> Iterator[Finding]:
    """Pictures a second that one core decodes and finds the line in, against the camera's."""
    camera = opened.rig.camera
    process = Pipeline(head, config.laserline, config.triangulation).process
    shot = Shot(0, 0.0, 0.0, 0.0, frame.image)
    process(shot)
    begun = time.thread_time()
    for _ in range(TIMED_SHOTS):
        step = process(shot)
    rate = TIMED_SHOTS / max(time.thread_time() - begun, 1e-6)
    rows = int((step.profile.range_m > 0).sum())
    yield Finding("line", "ok" if rows else "note", f"{rows} of {camera.height} rows have a point just here")
    slow = config.sweep.mode == "continuous" and isinstance(camera, Streaming) and rate < _rate(camera)
    advice = ": fewer than the camera sends, so a continuous sweep will skip some; sweep in steps" if slow else ""
    state: State = "note" if slow else "ok"
    yield Finding("speed", state, f"one core finds the line in {rate:.0f} pictures a second{advice}")


def _disk(config: Config, folder: Path, picture_bytes: int) -> Finding:
    free = shutil.disk_usage(folder).free
    frames = len(plan(config.sweep).bearings) * (2 if config.sweep.off_frames else 1)
    need, kept = frames * picture_bytes, config.recording.min_free_mb * MB
    words = f"{free / MB:.0f} MB free, a scan of {frames} pictures needs {need / MB:.0f}"
    if kept:
        words += f", and {kept / MB:.0f} MB are to stay free (recording.min_free_mb)"
    fits = free > need + kept
    return Finding("disk", "ok" if fits else "fault", words + ("" if fits else ": free some, or record elsewhere"))
