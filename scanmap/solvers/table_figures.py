"""The thesis's figures of a table of measurements, as PNG."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import CalibrationError
from scanmap.solvers.pairs import Pairs
from scanmap.solvers.table import PinholeModel, TableFit, columns_rightward
from scanmap.triangulation import pixel_angle_depth, pixel_ratio, ratio_depth

Array = NDArray[np.float64]

RATIO, ANGLE, PINHOLE, MEASURED = "tab:blue", "tab:orange", "tab:green", "black"


@contextmanager
def figure(path: Path, title: str, *, size: tuple[float, float] = (8.0, 5.0), rows: int = 1) -> Iterator[Any]:
    """Axes of a figure that is written to `path` on leaving; its parent folder is there.

    Raises:
        CalibrationError: the PNG cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawing = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(drawing)
    axes = drawing.subplots(rows, 1)
    drawing.suptitle(title)
    yield axes
    try:
        drawing.savefig(path, dpi=110)
    except OSError as error:
        raise CalibrationError(f"figure {path} cannot be written: {error.strerror or error}") from error


def draw_table(pairs: Pairs, fit: TableFit, folder: Path, stem: str) -> list[Path]:
    """Draw distance against ppx, against p and against theta, the angle with its line, measured against actual.

    Args:
        folder: where the PNGs go; it exists.
        stem: how their names begin.
    """
    u = columns_rightward(pairs.column, fit.width, fit.mirrored)
    shown = f"ppx [px]{', counted from the other side' if fit.mirrored else ''}"
    p, theta = pixel_ratio(u, fit.width), np.degrees(np.arctan(fit.angle.baseline_m / pairs.distance_m))
    wide = np.linspace(u.min() - 0.03 * np.ptp(u), u.max() + 0.03 * np.ptp(u), 400)
    paths = {name: folder / f"{stem}-{name}.png" for name in (
        "distance-ppx", "distance-p", "distance-theta", "angle-ppx", "measured-actual")}  # fmt: skip
    for name, at, line, label in (
        ("distance-ppx", u, wide, shown),
        ("distance-p", p, pixel_ratio(wide, fit.width), "p = (l - ppx) / l"),
        ("distance-theta", theta, fit.angle.rpc_deg * wide + fit.angle.ro_deg, "theta [deg]"),
    ):
        with figure(paths[name], f"distance against {label.split(' ')[0]}") as axes:
            _curves(axes, line, wide, fit)
            axes.plot(at, pairs.distance_m, "o", color=MEASURED, label="measured", zorder=5)
            axes.set(xlabel=label, ylabel="distance d [m]", ylim=(0.0, 1.15 * pairs.distance_m.max()))
            axes.legend()
            axes.grid(alpha=0.3)
    with figure(paths["angle-ppx"], "angle theta = atan(x / d) against ppx") as axes:
        axes.plot(u, theta, "o", color=MEASURED, label="measured")
        axes.plot(wide, fit.angle.rpc_deg * wide + fit.angle.ro_deg, color=ANGLE, label=_angle_words(fit))
        axes.plot(wide, _pinhole_angle(fit, wide), "--", color=PINHOLE, label="pinhole head")
        axes.set(xlabel=shown, ylabel="theta [deg]")
        axes.legend()
        axes.grid(alpha=0.3)
    draw_measured_against_actual(pairs, _fitted(fit, u), paths["measured-actual"])
    return list(paths.values())


def draw_measured_against_actual(pairs: Pairs, fitted: dict[str, tuple[str, Array]], path: Path) -> None:
    """Distances by the models and as published against the ruler's, and their errors below."""
    series = dict(fitted)
    for name, colour, published in (
        ("Algorithm 1, published", RATIO, pairs.published_ratio_m),
        ("Algorithm 2, published", ANGLE, pairs.published_angle_m),
    ):
        if np.isfinite(published).any():
            series[name] = (colour, published)
    with figure(path, "measured against actual distance", size=(8.0, 7.0), rows=2) as (above, below):
        limit = 1.08 * float(pairs.distance_m.max())
        above.plot([0, limit], [0, limit], color="0.6", lw=1, label="exact")
        for name, (colour, depth) in series.items():
            marker = "x" if "published" in name else "o"
            above.plot(pairs.distance_m, depth, marker, color=colour, label=name, fillstyle="none")
            below.plot(pairs.distance_m, 100.0 * (depth / pairs.distance_m - 1.0), f"{marker}-", color=colour,
                       label=name, fillstyle="none", lw=0.8)  # fmt: skip
        below.axhline(0.0, color="0.6", lw=1)
        above.set(ylabel="measured [m]", xlim=(0, limit), ylim=(0, limit))
        below.set(xlabel="actual distance [m]", ylabel="error [%]", xlim=(0, limit))
        above.legend(fontsize="small")
        for axes in (above, below):
            axes.grid(alpha=0.3)


def _fitted(fit: TableFit, u: Array) -> dict[str, tuple[str, Array]]:
    return {
        "Algorithm 1, fitted": (RATIO, ratio_depth(u, fit.ratio)),
        "Algorithm 2, fitted": (ANGLE, pixel_angle_depth(u, fit.angle)),
        _pinhole_words(fit.best): (PINHOLE, fit.best.depth(u)),
    }


def _curves(axes: Any, at: Array, u: Array, fit: TableFit) -> None:
    for name, (colour, depth) in _fitted(fit, u).items():
        axes.plot(at, np.where(depth > 0, depth, np.nan), color=colour, label=name)


def _pinhole_words(model: PinholeModel) -> str:
    return f"pinhole {model.alpha_deg:.2f} / {model.beta_deg:.2f} deg, x {1e3 * model.baseline_m:.1f} mm"


def _angle_words(fit: TableFit) -> str:
    return f"line {fit.angle.rpc_deg:.4f} ppx {fit.angle.ro_deg:+.3f}"


def _pinhole_angle(fit: TableFit, u: Array) -> Array:
    angle: Array = np.degrees(np.arctan(fit.angle.baseline_m / fit.best.depth(u)))
    return angle
