"""The residuals a calibration may state, and from where on nothing may be scanned with it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from scanmap.calibration.head import Calibration
from scanmap.errors import CalibrationError


@dataclass(frozen=True)
class Gate:
    """The largest residual that passes."""

    limit: float  # in the residual's unit; for pixels at a width of 1600 or less
    words: str
    remedy: str  # the next command
    grows_with_width: bool = False  # pixels of a larger image are smaller angles

    def limit_at(self, width: int) -> float:
        """The limit for images of this width [px]."""
        return self.limit * max(1.0, width / 1600.0) if self.grows_with_width else self.limit


# Keys of [residuals]; numbers and reasons are in docs/calibration.md.
GATES = {
    "camera_rms_px": Gate(1.0, "corners of the board against the camera model", "scanmap calibrate camera", True),
    "laser_rms_px": Gate(1.0, "laser line on the board against the laser plane", "scanmap calibrate laser", True),
    "axis_rms_px": Gate(1.5, "corners of the board against the turn about the axis", "scanmap calibrate axis", True),
    "self_rms_px": Gate(1.0, "laser line on flat walls against their planes", "scanmap calibrate self", True),
    "table_worst_percent": Gate(10.0, "measured distances against the pinhole head", "scanmap calibrate table"),
}


def faults_of(calibration: Calibration) -> list[str]:
    """Every stated residual over its gate, in words; a residual that is no number is one too."""
    faults = []
    if "laser plane" in calibration.meta.get("uncalibrated", ()):
        faults.append("its laser plane is not calibrated yet; scanmap calibrate laser")
    for key, gate in GATES.items():
        if key not in calibration.residuals:
            continue
        value, limit = calibration.residuals[key], gate.limit_at(calibration.intrinsics.width)
        number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not number or value > limit:
            shown = f"{value:.3g}" if number else repr(value)
            faults.append(f"{key} = {shown} ({gate.words}) is over its gate of {limit:.3g}; {gate.remedy}")
    return faults


def check_residuals(calibration: Calibration) -> None:
    """Raise CalibrationError where a calibration states a residual over its gate: no scan is made with it."""
    faults = faults_of(calibration)
    if faults:
        raise CalibrationError(f"calibration refused: {'; '.join(faults)} sets it right")
