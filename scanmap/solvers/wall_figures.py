"""How flat the walls of a scan come out: residuals over the range image, walls from above, pieces in space."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.solvers.check import Check
from scanmap.solvers.flat_segments import Segments, beside, fitted_plane
from scanmap.solvers.sight import Patches, located, sight_of
from scanmap.solvers.table_figures import figure
from scanmap.view.walls import FlatPieces

Array = NDArray[np.float64]

# Deviations are drawn so much larger than walls.
EXAGGERATION = 20.0
SMALLEST_DRAWN = 30  # patches


def draw_check(check: Check, calibration: Calibration, path: Path, title: str) -> None:
    """Residuals of the judged walls, and the walls from above with their deviations drawn larger."""
    with figure(path, title, size=(9.0, 9.5), rows=2) as (above, below):
        _residual_map(above, check.off_px, check.patches)
        _from_above(below, check.segments, check.patches, {"as calibrated": (calibration, "tab:blue")})


def draw_refined(before: Calibration, after: Calibration, segments: Segments, patches: Patches, path: Path) -> None:
    """The flat pieces from above before and after self-calibration, deviations drawn larger."""
    with figure(path, "self-calibration: before and after", size=(9.0, 9.5), rows=2) as (above, below):
        _from_above(above, segments, patches, {"before": (before, "tab:red")})
        _from_above(below, segments, patches, {"after": (after, "tab:blue")})


def in_space(name: str, calibration: Calibration, segments: Segments, patches: Patches) -> FlatPieces:
    """The flat pieces under a calibration, each against its own plane."""
    points, per_column = located(sight_of(patches, calibration.intrinsics), calibration)
    members, off, outlines = [], [], []
    for k in range(len(segments)):
        member = (segments.label == k) & np.isfinite(points[..., 0])
        if np.count_nonzero(member) < SMALLEST_DRAWN:
            continue
        p, slope = points[member], per_column[member]
        plane = fitted_plane(p, slope, segments.planes[k, :3])
        members.append(p)
        off.append(beside(p, slope, plane))
        outlines.append(_rectangle(p, plane[:3]))
    return FlatPieces(name, np.concatenate(members), np.concatenate(off), outlines)


def _rectangle(points: Array, normal: Array) -> Array:
    """Closed rectangle (5, 3) around points on a plane, one of its sides level."""
    centre = points.mean(axis=0)
    side = np.cross(normal, [0.0, 0.0, 1.0]) if abs(normal[2]) < 0.95 else np.array([1.0, 0.0, 0.0])
    side = side - (side @ normal) * normal
    side /= np.linalg.norm(side)
    other = np.cross(normal, side)
    (a, b), (c, d) = (np.percentile((points - centre) @ way, [1.0, 99.0]) for way in (side, other))
    return np.array([centre + x * side + y * other for x, y in ((a, c), (b, c), (b, d), (a, d), (a, c))])


def _residual_map(axes: Any, off_px: Array, patches: Patches) -> None:
    bearings = np.degrees(patches.bearings)
    known = np.abs(off_px[np.isfinite(off_px)])
    limit = max(float(np.percentile(known, 98)), 0.02) if known.size else 1.0
    image = axes.pcolormesh(
        bearings, np.arange(off_px.shape[1]), off_px.T, cmap="coolwarm", vmin=-limit, vmax=limit, shading="nearest",
        rasterized=True,
    )  # fmt: skip
    axes.invert_yaxis()
    axes.set(xlabel="bearing [deg]", ylabel="patch of rows, from the top", title="columns beside the wall's own plane")
    axes.figure.colorbar(image, ax=axes, label="[px]")


def _from_above(axes: Any, segments: Segments, patches: Patches, heads: dict[str, tuple[Calibration, str]]) -> None:
    """Upright pieces from above: their fitted line in grey, every bearing's mean deviation from it exaggerated."""
    for name, (head, colour) in heads.items():
        points = located(sight_of(patches, head.intrinsics), head)[0]
        drawn = False
        for k in range(len(segments)):
            member = (segments.label == k) & np.isfinite(points[..., 0])
            if np.count_nonzero(member) < SMALLEST_DRAWN:
                continue
            p = points[member]
            centre = p.mean(axis=0)
            normal = np.linalg.eigh((p - centre).T @ (p - centre))[1][:, 0]
            if abs(normal[2]) > 0.3:
                continue
            shots = np.flatnonzero(member.any(axis=1))
            mean = np.array([points[i][member[i]].mean(axis=0) for i in shots])
            off = (mean - centre) @ normal
            flat, shown = mean - off[:, None] * normal, mean + (EXAGGERATION - 1.0) * off[:, None] * normal
            axes.plot(flat[:, 0], flat[:, 1], color="0.7", lw=1.0)
            axes.plot(shown[:, 0], shown[:, 1], ".-", color=colour, ms=2, lw=0.8, label=None if drawn else name)
            drawn = True
        if not drawn:
            axes.text(0.5, 0.6, f"{name}: no upright flat piece", transform=axes.transAxes, ha="center")
    axes.plot(0, 0, "k+", label="axis")
    axes.set_aspect("equal", "datalim")
    axes.set(xlabel="x [m]", ylabel="y [m]", title=f"walls from above, deviations drawn {EXAGGERATION:g} times larger")
    axes.grid(alpha=0.3)
    axes.legend(loc="best", fontsize="small")
