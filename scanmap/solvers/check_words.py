"""A check in words."""

from __future__ import annotations

import numpy as np

from scanmap.solvers.check import Check


def verdict_lines(check: Check) -> list[tuple[bool, str]]:
    """Whether each question was passed, and the sentence to say about it."""
    lines = [_flatness(check)]
    if check.corners:
        lines.append(_corners(check))
    if check.passes is not None:
        lines.append(_passes(check))
    if check.refined is not None:
        lines.append(_contradictions(check))
    return lines


def conclusion(check: Check) -> str:
    """The last word."""
    if check.passed:
        return "PASS: nothing in this scan contradicts the calibration"
    if check.refined is None and check.passes_agree:
        return (
            "FAIL: walls are not flat, but this scan cannot tell whether the calibration bends them or two surfaces "
            "were taken for one; scan again in steps of 1 deg, at the camera's full resolution"
        )
    return "FAIL: this scan contradicts the calibration"


def notes(check: Check) -> list[str]:
    """What was not asked, and why."""
    said = []
    if check.passes is None:
        said.append("repeatability: not measured, no bearing was seen twice; scan with --set sweep.passes=2")
    if not check.corners:
        said.append("corners: no two large upright walls nearly square to each other")
    elif not check.params.square:
        said.append("corners: shown, not judged")
    if check.refined is None:
        said.append(f"walls are judged as they were found, for self-calibration cannot help: {check.unrefined}")
    if check.known is None:
        said.append("the calibration states no covariance: it is held to the line's noise alone, as if it were exact")
    return said


def _flatness(check: Check) -> tuple[bool, str]:
    worst = max(check.walls, key=lambda wall: wall.strain)
    bent = sum(wall.strain > 1.0 for wall in check.walls)
    words = (
        f"walls: {len(check.walls)} judged, half of what is seen of them within {check.strain:.2f} of what was "
        "promised; "
        f"the worst, {worst.length_m:.2f} m long at {worst.range_m:.2f} m, is bowed by {1e3 * abs(worst.bow_m):.2f} mm "
        f"(limit {1e3 * worst.bow_limit_m:.2f}), rms {1e3 * worst.rms_m:.2f} mm (limit {1e3 * worst.rms_limit_m:.2f})"
    )
    if not check.flat:
        words += f"; {bent} of {len(check.walls)} are bent more than the calibration allows"
    return check.flat, words


def _corners(check: Check) -> tuple[bool, str]:
    angles = ", ".join(f"{corner.angle_deg:.2f}" for corner in check.corners[:6])
    off = float(np.median([abs(corner.angle_deg - 90.0) for corner in check.corners]))
    words = f"corners: {angles} deg; median {off:.2f} deg from square (limit {check.params.corner_deg:g} and noise)"
    if not check.corners_hold:
        words += "; if the room is not square, give --not-square"
    return check.corners_hold, words


def _passes(check: Check) -> tuple[bool, str]:
    passes = check.passes
    assert passes is not None
    lag = "" if np.isnan(passes.lag_deg) else f"; back and forth differ by {passes.lag_deg:+.4f} deg of bearing"
    return check.passes_agree, (
        f"passes: {passes.bearings} bearings seen again, columns repeat to {passes.rms_px:.3f} px "
        f"(promised {passes.promised_px:.3f}){lag}"
    )


def _contradictions(check: Check) -> tuple[bool, str]:
    refined = check.refined
    assert refined is not None
    words = (
        f"self-calibration: flat pieces deviate by {refined.rms_before_px:.3f} px, and by "
        f"{refined.rms_after_px:.3f} px under the head that fits them best"
    )
    found = [
        f"{e.name} by {1e3 * e.change:+.2f} mm" if e.name.startswith(("offset", "distance"))
        else f"{e.name} by {np.degrees(e.change):+.3f} deg"
        for e in check.contradictions
    ]  # fmt: skip
    if found:
        words += f"; it would change {', '.join(found)}, far beyond what was promised"
    return not found, words
