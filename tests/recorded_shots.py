"""Shots and recordings made up for the tests of `scanmap.recording`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scanmap.calibration import Calibration
from scanmap.recording import Recorder, RecordingParams
from scanmap.shot import Shot

START_NS = 1_700_000_000_123_456_789

CALIBRATION = Calibration.loads(
    """
[image]
width = 64
height = 48
[head]
baseline_m = 0.08
beta_deg = 25.7
alpha_deg = 32.3
[axis]
head_offset_m = [0.03, -0.01, 0.0]
tilt_deg = [0.5, -0.25]
"""
)


def made_up_shots(count: int, *, off: bool = False, image_bytes: int = 3000) -> list[Shot]:
    """Shots whose images are random bytes behind a JPEG's magic: a reader must hand them on as they are."""
    rng = np.random.default_rng(count)

    def image() -> bytes:
        return b"\xff\xd8\xff" + rng.bytes(image_bytes)

    return [
        Shot(
            i,
            float(rng.normal()),
            i * np.pi / 180,
            round(i * 1e8 + rng.integers(1000)) / 1e9,
            image(),
            image() if off else None,
        )
        for i in range(count)
    ]


def record(path: Path, shots: list[Shot], **options: Any) -> Path:
    """Write shots as a finished recording."""
    options = {"source": "digital twin", "calibration": CALIBRATION, "start_ns": START_NS} | options
    with Recorder(path, params=RecordingParams(min_free_mb=0), **options) as recorder:
        for shot in shots:
            recorder.write(shot)
    return path
