"""What a self-calibration found, in words and numbers a person can check with a ruler."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scanmap.calibration import Calibration
from scanmap.solvers.marks import Followed
from scanmap.solvers.self_calibration import Estimate, Refined
from scanmap.solvers.walls import CheckParams, Wall, walls_under

SHOWN_WALLS = 6

# What no scan of flat things tells, whatever was scanned.
UNOBSERVABLE = (
    "bearing zero (the head's own yaw about the axis)",
    "the height along the axis",
    "the camera's pitch apart from the axis's tilt about y",
    "the intrinsics, which are kept",
)
_MEANING = {
    "yaw": "laser plane against the camera, yaw (beta)",
    "roll": "laser plane against the camera, roll",
    "distance": "camera to laser plane (baseline)",
    "offset_x": "head offset from the axis, x",
    "offset_y": "head offset from the axis, y",
    "aside": "axis, aside of where it was",
    "tilt_x": "axis tilt about x",
    "tilt_y": "axis tilt about y",
}


class Line(NamedTuple):
    """One parameter: what it is, before, after, one standard deviation, and whether the scan saw it."""

    what: str
    before: str
    after: str
    sigma: str
    seen: str


def parameter_lines(refined: Refined) -> list[Line]:
    """Every parameter that was free."""
    lines = []
    for estimate in refined.estimates:
        unit, factor, digits = ("mm", 1e3, 2) if _is_length(estimate) else ("deg", float(np.degrees(1.0)), 3)
        before, after = (_value(head, estimate, head is refined.after) for head in (refined.before, refined.after))
        lines.append(Line(
            _MEANING[estimate.name], f"{factor * before:.{digits}f}", f"{factor * after:.{digits}f} {unit}",
            f"{factor * estimate.sigma:.{digits}f}", "yes" if estimate.observed else "hardly; near where it was",
        ))  # fmt: skip
    return lines


def scale_words(refined: Refined) -> str:
    """Which length holds the scale, and how to hold the other."""
    if refined.scale == "baseline":
        return (
            f"scale is held by the baseline, {1e3 * refined.before.baseline_m:.2f} mm: flat walls stay flat at any "
            "scale; measure it well, or give --scale axis"
        )
    distance = 1e3 * float(np.hypot(*refined.before.mount.offset_m[:2]))
    return (
        f"scale is held by the axis, {distance:.2f} mm from the head: flat faces stay flat at any scale; or give "
        "--scale baseline"
    )


def marks_words(followed: Followed) -> str:
    """What markers on the turntable said of its axis."""
    aside, tilt_x, tilt_y = 1e3 * followed.change[0], *np.degrees(followed.change[1:])
    return (
        f"{followed.markers} printed markers, followed around: against the calibration the axis leans by {tilt_x:+.2f} "
        f"and {tilt_y:+.2f} deg about x and y and passes {aside:+.2f} mm aside ({followed.rms_px:.2f} px rms)"
    )


def before_and_after(refined: Refined) -> list[tuple[Wall, Wall]]:
    """The largest flat pieces under both calibrations."""
    sizes = np.bincount(refined.segments.label[refined.segments.label >= 0], minlength=len(refined.segments))
    chosen = [int(k) for k in np.argsort(-sizes)[:SHOWN_WALLS]]
    allowed = (refined.rms_after_px, CheckParams())
    both = [
        walls_under(head, refined.patches, refined.segments, chosen, allowed)[0]
        for head in (refined.before, refined.after)
    ]
    return list(zip(*both, strict=True))


def _is_length(estimate: Estimate) -> bool:
    return estimate.name in ("offset_x", "offset_y", "aside", "distance")


def _value(head: Calibration, estimate: Estimate, changed: bool) -> float:
    """The parameter's value [m] or [rad] as the calibration's own words have it; a roll counts from where it was."""
    mount = head.mount
    return {
        "yaw": head.beta, "distance": head.baseline_m, "roll": estimate.change * changed,
        "aside": estimate.change * changed,
        "offset_x": mount.offset_m[0], "offset_y": mount.offset_m[1],
        "tilt_x": float(np.radians(mount.tilt_deg[0])), "tilt_y": float(np.radians(mount.tilt_deg[1])),
    }[estimate.name]  # fmt: skip
