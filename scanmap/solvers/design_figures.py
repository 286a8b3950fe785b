"""Heads compared in one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from scanmap.calibration import Calibration
from scanmap.solvers.design import curve
from scanmap.solvers.table_figures import figure
from scanmap.triangulation import TriangulationParams


def draw_designs(heads: Sequence[tuple[str, Calibration, TriangulationParams]], sigma_px: float, path: Path) -> None:
    """Range against column, and one point's sigma against range, a curve a head."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    with figure(path, "heads compared (middle row)", size=(8.5, 8.5), rows=2) as (above, below):
        for name, head, limits in heads:
            column, distance, slope = curve(head, limits)
            words = f"{name}: {1e3 * head.baseline_m:.0f} mm, {head.intrinsics.width} px"
            above.plot(column / head.intrinsics.width, distance, label=words)
            below.plot(distance, 1e3 * sigma_px * slope, label=words)
        above.set(xlabel="column / image width", ylabel="range [m]", yscale="log", xlim=(0, 1))
        below.set(xlabel="range [m]", ylabel=f"sigma of a point [mm] at {sigma_px:g} px", xscale="log", yscale="log")
        for axis in (above.yaxis, below.xaxis, below.yaxis):
            # Lengths as one reads them off a ruler, not powers of ten.
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(NullFormatter())
        for axes in (above, below):
            axes.grid(which="both", alpha=0.25)
            axes.legend(fontsize="small")
