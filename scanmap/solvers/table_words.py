"""What a fit to a table of measurements says, in words, and when it is worth nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import CalibrationError
from scanmap.solvers.pairs import Pairs
from scanmap.solvers.table import (
    PUBLISHED_ANGLE,
    PUBLISHED_RATIO,
    TableFit,
    columns_rightward,
    depths_of,
    fit_angle,
    fit_ratio,
)

Array = NDArray[np.float64]

# A fit worse than this on a row it was fitted to is no calibration; half of it is a wrong row or a wrong width.
WORST_PERCENT = 10.0

# What the thesis prints and does not follow from its formulas.
ERRATA = (
    "Algorithm 1's published 0.105, 0.079 and 'below limit' at ppx 1072, 1264 and 1582 do not follow from its formula "
    "with 32.3 / 25.7 deg, which gives 0.1149, 0.0943 and 0.0728; d >= d_min holds at every column, so no row is below",
    "Algorithm 2's published 0.047 at ppx 1582 is 0.0446 by its formula; and theta >= 60 deg there, so the model is "
    "below its own limit (column 1563, d 0.0462; the text says 0.047)",
    "rpc = 0.0439, ro = -8.7683 are said to be the straight line through these points; that is 0.0426 and -7.690. "
    "The table follows from 0.044 and -8.768",
    "the angles of Algorithm 2 are degrees, not radians; its equation 6 writes tan(theta) where theta is meant",
    "equations 14 and 15 print 1.114 and 1.266 for 1.1134 and 1.2643",
    "d_min = 0.071 m of Algorithm 1 follows from 32.3 / 25.7 deg, not from 32 / 25 (0.0733)",
    "'the two differ by no more than 0.007 m' is 0.028 m recomputed; 'error below 1 % from 0.15 m' is 2.6 % in its "
    "own table",
    "alpha is called the horizontal opening angle; the formulas use it as half of it",
)


def fit_lines(pairs: Pairs, fit: TableFit, chosen: NDArray[np.intp]) -> list[str]:
    """The constants found, and what can be said of them."""
    which = "all rows" if len(chosen) == len(pairs.column) else "rows " + ", ".join(str(k + 1) for k in chosen)
    lines = [
        f"Algorithm 1 on {which}: alpha {fit.ratio.alpha_deg:.2f}, beta {fit.ratio.beta_deg:.2f} deg"
        + _on_first_three(pairs, fit, chosen),
        f"Algorithm 2 on {which}: theta = {fit.angle.rpc_deg:.4f} ppx {fit.angle.ro_deg:+.3f} deg (straight line); "
        f"by distance {fit.angle_by_distance.rpc_deg:.4f} and {fit.angle_by_distance.ro_deg:.3f}",
        f"pinhole head, x = {1e3 * fit.pinhole.baseline_m:.1f} mm held: alpha {fit.pinhole.alpha_deg:.2f}, "
        f"beta {fit.pinhole.beta_deg:.2f} deg",
    ]
    if fit.free is not None:
        lines.append(
            f"pinhole head, x fitted: alpha {fit.free.alpha_deg:.2f}, beta {fit.free.beta_deg:.2f} deg, "
            f"x {1e3 * fit.free.baseline_m:.1f} mm"
        )
    else:
        lines.append("pinhole head, x fitted: these rows cannot tell the baseline; it is held as measured")
    chose = "x fitted" if fit.best is fit.free else "x held"
    lines.append(
        f"taken: {chose}, which predicts a row that is left out better; worst row "
        f"{worst_percent(pairs, fit, chosen):.1f} %, infinity at column {fit.best.infinity():.1f}"
    )
    by_model = worst_by_model(pairs, fit, chosen)
    best = min(by_model, key=lambda name: by_model[name])
    worst = ", ".join(f"{name} {percent:.1f} %" for name, percent in by_model.items())
    lines.append(f"worst row by model: {worst}; best: {best}")
    if fit.infinity_slack > 10.0:
        lines.append(
            f"at the farthest row one pixel is {fit.infinity_slack:.0f} % of the distance: whole columns are too "
            "coarse there; note sub-pixel columns"
        )
    return lines + (_published_lines(pairs, fit) if pairs.published else [])


def worst_percent(pairs: Pairs, fit: TableFit, chosen: NDArray[np.intp]) -> float:
    """Largest relative error of the pinhole head on the rows it was fitted to [%]."""
    u = columns_rightward(pairs.column, fit.width, fit.mirrored)[chosen]
    return float(100.0 * np.abs(fit.best.depth(u) / pairs.distance_m[chosen] - 1.0).max())


def worst_by_model(pairs: Pairs, fit: TableFit, chosen: NDArray[np.intp]) -> dict[str, float]:
    """Largest relative error of each fitted model on the rows it was fitted to [%]."""
    names = {"ratio fitted": "Algorithm 1", "pixel_angle fitted": "Algorithm 2 (line)",
             "pixel_angle by distance": "Algorithm 2 by distance", "pinhole fitted": "pinhole",
             "pinhole with x fitted": "pinhole with x fitted"}  # fmt: skip
    depths = depths_of(fit, pairs)
    off = {
        words: 100.0 * np.abs(depths[name][chosen] / pairs.distance_m[chosen] - 1.0)
        for name, words in names.items()
        if name in depths
    }
    return {words: float(each.max()) for words, each in off.items() if np.isfinite(each).all()}


def check_worth(pairs: Pairs, fit: TableFit, chosen: NDArray[np.intp]) -> None:
    """Raise CalibrationError where the fit is too bad to scan with, naming its worst row."""
    worst = worst_percent(pairs, fit, chosen)
    if worst <= WORST_PERCENT:
        return
    u = columns_rightward(pairs.column, fit.width, fit.mirrored)[chosen]
    k = int(chosen[np.abs(fit.best.depth(u) / pairs.distance_m[chosen] - 1.0).argmax()])
    raise CalibrationError(
        f"nothing is written: the head fits no better than {worst:.1f} % (limit {WORST_PERCENT:g} %), worst at row "
        f"{k + 1} (ppx {pairs.column[k]:g}, {pairs.distance_m[k]:g} m); is that row wrong, or --width {fit.width}?"
    )


def _on_first_three(pairs: Pairs, fit: TableFit, chosen: NDArray[np.intp]) -> str:
    if not pairs.published or len(chosen) <= 3:
        return ""
    u = columns_rightward(pairs.column, fit.width, fit.mirrored)
    model = fit_ratio(u[:3], pairs.distance_m[:3], fit.width, fit.ratio.baseline_m)
    return f"; on rows 1 to 3: alpha {model.alpha_deg:.2f}, beta {model.beta_deg:.2f} deg"


def _published_lines(pairs: Pairs, fit: TableFit) -> list[str]:
    """Whether the published constants follow from the whole table."""
    u = columns_rightward(pairs.column, fit.width, fit.mirrored)
    ratio = fit_ratio(u, pairs.distance_m, fit.width, fit.ratio.baseline_m)
    angle = fit_angle(u, pairs.distance_m, fit.angle.baseline_m)
    near = replace(PUBLISHED_RATIO, width=fit.width)
    lines = []
    if max(abs(ratio.alpha_deg - near.alpha_deg), abs(ratio.beta_deg - near.beta_deg)) > 0.5:
        lines.append(
            f"the published pair {near.alpha_deg:g} / {near.beta_deg:g} deg does not follow from the full table "
            f"({ratio.alpha_deg:.1f} / {ratio.beta_deg:.1f}); it nearly follows from rows 1 to 3"
        )
    if abs(angle.rpc_deg - PUBLISHED_ANGLE.rpc_deg) > 5e-4:
        lines.append(
            f"the published pair {PUBLISHED_ANGLE.rpc_deg:g}, {PUBLISHED_ANGLE.ro_deg:g} does not follow from the full "
            f"table ({angle.rpc_deg:.4f}, {angle.ro_deg:.3f}), nor from any part of it"
        )
    return lines
