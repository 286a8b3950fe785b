"""Drive a rig so that its camera's latency shows: sweeps in both directions, or a blinking laser."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.config import Config
from scanmap.errors import CameraError, ConfigError
from scanmap.pipeline import Pipeline
from scanmap.rig import Frame, Rig, Streaming
from scanmap.session.preparing import Choice, rig_words
from scanmap.session.rigs import OpenRig, open_rig
from scanmap.shot import decode_image
from scanmap.solvers.latency import Blink, Latency, Pass, latency_of_blinks, latency_of_sweeps
from scanmap.sweep import SweepParams, Turning, sweep

BLINKS = 24
REST_S = 0.35  # after a switch, beyond the latency searched for
GOLDEN = 0.618033988749895  # multiples of it fill a period evenly
CONTRAST_DN = 12.0  # [grey levels] a pixel belongs to the line if the laser adds this to it
LEAST_LIT = 30  # pixels
ROWS = 240  # of an image are enough
LINE_EVERY_S = 5.0  # so much silence at most
PASS_S = 4.0  # a pass of the sweeps lasts: twice the shift that the latest camera searched for would make
LEAST_SPAN_DEG = 10.0  # of a pass, however slow: corners and furniture must come by
TWIN_WIDTH = 640  # of the twin's pictures here [px]: latency does not depend on their size, the time to draw them does

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Contrast:
    """What the laser adds to a picture."""

    lit_px: int  # pixels that become clearly brighter
    level_dn: float  # by how much, median of these [grey levels]
    mask: NDArray[np.bool_]  # (H, W)
    on: float  # mean grey level of them with the laser on
    off: float


def measure_latency(
    choice: Choice, method: str, speeds_deg_s: tuple[float, ...], progress: Progress, span_deg: float | None = None
) -> list[str]:
    """Open the rig, measure by `sweep` or `blink`, close it; the result in lines.

    Args:
        span_deg: of each pass, about the middle of the configured sweep; None = as `latency_by_sweeps` chooses.

    Raises:
        ConfigError, CalibrationError, CameraError, StageError: as `latency_by_sweeps` and `latency_by_blinks`.
    """
    config = choice.load()
    head = choice.head() or config.head()
    if config.rig == "twin":
        head = _smaller(head)
    opened = open_rig(config, head)
    try:
        progress(rig_words(config, opened.rig))
        if method == "blink":
            found, contrast = latency_by_blinks(opened, progress)
            about = f"laser on and off differ by {contrast.level_dn:.0f} grey levels in {contrast.lit_px} pixels"
        else:
            speeds = speeds_deg_s or _two_speeds(config.sweep.speed_deg_s, config.stage.speed_deg_s)
            found = latency_by_sweeps(opened, config, head, speeds, progress, span_deg)
            about = f"play of the gear: {found.backlash_deg:.3f} deg" if len(set(speeds)) > 1 else ""
    finally:
        opened.close()
    corrected = config.camera.latency_s or 0.0 if opened.rig.is_twin else config.camera.latency
    by_sweep = config.sweep.latency_s if method == "sweep" else 0.0
    latency_s = corrected + by_sweep + found.latency_s
    lines = [
        f"camera latency {1e3 * latency_s:.1f} ms, standard deviation {1e3 * found.sigma_s:.1f} ms, "
        f"from {found.samples} {'rows' if method == 'sweep' else 'blinks'}",
        about,
        f"next: under [camera] in the rig's TOML write latency_s = {latency_s:.4f}, or give --set "
        f"camera.latency_s={latency_s:.4f}",
    ]
    return [line for line in lines if line]


def latency_by_sweeps(
    opened: OpenRig,
    config: Config,
    calibration: Calibration,
    speeds_deg_s: tuple[float, ...],
    progress: Progress,
    span_deg: float | None = None,
) -> Latency:
    """Sweep forward and backward at each speed and see by how much the two differ.

    Args:
        speeds_deg_s: two tell latency and backlash apart.
        progress: gets a line about every sweep.
        span_deg: of each pass, about the middle of the configured sweep and never beyond it; None = 4 s of turning,
            10 deg at least.

    Raises:
        ConfigError: the stage cannot turn steadily.
        CalibrationError: too little is seen in both directions.
        CameraError, StageError: the rig failed.
    """
    if not isinstance(opened.rig.stage, Turning):
        raise ConfigError("latency by sweeps needs a stage of kind grbl: choose --method blink")
    process = Pipeline(calibration, config.laserline, config.triangulation).process
    every = max(1, calibration.intrinsics.height // ROWS)
    passes = []
    for speed in speeds_deg_s:
        start_deg, end_deg = _middle(config.sweep, span_deg or max(LEAST_SPAN_DEG, PASS_S * speed))
        progress(f"sweeping {start_deg:g} to {end_deg:g} deg and back at {speed:g} deg/s")
        plan = config.sweep.model_dump() | {
            "mode": "continuous", "passes": 2, "speed_deg_s": speed, "step_deg": 0.01, "off_frames": False,
            "start_deg": start_deg, "end_deg": end_deg, "exposures_us": (),
        }  # fmt: skip
        bearings, columns = [], []
        spoken = time.monotonic()
        for shot in sweep(opened.rig, SweepParams(**plan), sleep=opened.sleep, clock=opened.clock):
            bearings.append(shot.bearing)
            columns.append(process(shot).line.column_px[::every])
            if time.monotonic() - spoken > LINE_EVERY_S:
                spoken = time.monotonic()
                progress(f"at {math.degrees(shot.bearing):.0f} deg, {len(bearings)} pictures")
        passes.append((math.radians(speed), *_two_passes(np.array(bearings), np.array(columns))))
    return latency_of_sweeps(passes)


def _smaller(head: Calibration) -> Calibration:
    """The twin's head with pictures at most `TWIN_WIDTH` wide."""
    own = head.intrinsics
    return head if own.width <= TWIN_WIDTH else head.scaled_to(TWIN_WIDTH, round(own.height * TWIN_WIDTH / own.width))


def _two_speeds(wanted_deg_s: float, fastest_deg_s: float) -> tuple[float, float]:
    """That of the sweep and thrice it: the farther apart, the better they tell latency from backlash."""
    faster = min(3 * wanted_deg_s, fastest_deg_s)
    return (wanted_deg_s, faster) if faster > 1.5 * wanted_deg_s else (wanted_deg_s, wanted_deg_s / 2)


def _middle(sweep: SweepParams, span_deg: float) -> tuple[float, float]:
    """First and last bearing [deg] of at most `span_deg` about the middle of a sweep, in its direction."""
    whole = sweep.end_deg - sweep.start_deg
    half = math.copysign(min(abs(whole), span_deg) / 2, whole)
    middle = (sweep.start_deg + sweep.end_deg) / 2
    return middle - half, middle + half


def latency_by_blinks(opened: OpenRig, progress: Progress, blinks: int = BLINKS) -> tuple[Latency, Contrast]:
    """Switch the laser and see when the pictures show it; the laser is off afterwards.

    Raises:
        ConfigError: the laser cannot be switched, or the camera sends single pictures only.
        CalibrationError: the pictures do not show it.
        CameraError, StageError: the rig failed.
    """
    rig = opened.rig
    if not rig.stage.laser_switchable:
        raise ConfigError("the laser cannot be switched by software, so it cannot blink: choose --method sweep")
    if not isinstance(rig.camera, Streaming):
        raise ConfigError("this camera sends single pictures only: its latency cannot be measured")
    try:
        contrast = laser_contrast(rig)
        progress(f"blinking the laser {blinks} times")
        period_s = _period(rig.camera)
        seen = []
        spoken = time.monotonic()
        for number in range(2 * blinks):
            if time.monotonic() - spoken > LINE_EVERY_S:
                spoken = time.monotonic()
                progress(f"blink {number // 2} of {blinks}")
            phase_s = period_s * ((number * GOLDEN) % 1.0)
            seen.append(_blink(opened, rig.camera, contrast, phase_s, on=number % 2 == 0))
        return latency_of_blinks(seen), contrast
    finally:
        rig.stage.laser(False)


def laser_contrast(rig: Rig) -> Contrast:
    """How clearly the laser shows in a picture; the laser is off afterwards.

    Raises:
        CameraError: it does not show at all.
    """
    levels = []
    for on in (True, False):
        rig.stage.laser(on)
        levels.append(_brightness(rig.camera.grab()))
    added = levels[0].astype(np.int16) - levels[1]
    mask = added > CONTRAST_DN
    if np.count_nonzero(mask) < LEAST_LIT:
        raise CameraError(
            f"the laser makes no difference in the picture (at most {int(added.max())} grey levels): is it on, does it "
            "shine into the camera's view, is camera.exposure_us high enough?"
        )
    lit = added[mask]
    on_off = float(levels[0][mask].mean()), float(levels[1][mask].mean())
    return Contrast(int(np.count_nonzero(mask)), float(np.median(lit)), mask, *on_off)


def _blink(opened: OpenRig, camera: Streaming, contrast: Contrast, phase_s: float, *, on: bool) -> Blink:
    """Switch once and look until the pictures have long shown it."""
    frames = [camera.newest(), camera.newest()]
    opened.sleep(phase_s)
    before = opened.clock()
    opened.rig.stage.laser(on)
    after = opened.clock()
    # A picture's own time tells when all pictures exposed before the switch have come.
    while frames[-1].time < after + REST_S:
        frames.append(camera.newest())
    spread = contrast.on - contrast.off
    levels = [(_mean_of_lit(frame, contrast.mask) - contrast.off) / spread for frame in frames]
    return Blink((before + after) / 2, np.array([frame.time for frame in frames]), np.array(levels))


def _brightness(frame: Frame) -> NDArray[np.uint8]:
    """(H, W) the brightest channel of each pixel: a red line is bright in red."""
    return _brightest(decode_image(frame.image).image)


def _mean_of_lit(frame: Frame, mask: NDArray[np.bool_]) -> float:
    """Mean brightness of the pixels in the mask alone: they are one in a hundred."""
    return float(_brightest(decode_image(frame.image).image[mask][:, None]).mean())


def _brightest(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if pixels.ndim == 2:
        return pixels
    # By channel: a reduction over so short an axis costs ten times as much.
    return np.maximum(np.maximum(pixels[..., 0], pixels[..., 1]), pixels[..., 2])


def _period(camera: Streaming) -> float:
    times = [camera.newest().time for _ in range(6)]
    return max(1e-3, float(np.median(np.diff(times))))


def _two_passes(bearings: NDArray[np.float64], columns: NDArray[np.float64]) -> tuple[Pass, Pass]:
    """Split where the head turned round."""
    if len(bearings) < 20:
        raise CameraError(f"only {len(bearings)} pictures came while the head turned: turn slower, or farther")
    forward = bearings[-1] < bearings[len(bearings) // 2]
    turn = int(np.argmax(bearings) if forward else np.argmin(bearings)) + 1
    return Pass(bearings[:turn], columns[:turn]), Pass(bearings[turn:], columns[turn:])
