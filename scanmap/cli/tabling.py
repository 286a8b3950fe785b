"""`scanmap calibrate table`: the thesis's way, a few measured distances."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scanmap.cli.settings import CalibrationOption

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from scanmap.solvers.pairs import Pairs
    from scanmap.solvers.table import TableFit


def table(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE.csv",
            help="Header ppx,actual_m (or column, row; distance_mm, ...), a line each; or calibrate.yml.",
        ),
    ],
    width: Annotated[
        int | None,
        typer.Option(
            "--width", metavar="PX", min=8, max=20000, help="Image along the axis the line moves on [px]; 1600."
        ),
    ] = None,
    height: Annotated[
        int | None, typer.Option("--height", metavar="PX", min=8, max=20000, help="Image across that axis [px]; 1200.")
    ] = None,
    baseline_mm: Annotated[
        float | None,
        typer.Option("--baseline-mm", metavar="MM", min=1.0, max=5000.0, help="Camera to laser, by ruler [mm]; 80."),
    ] = None,
    rows: Annotated[
        str | None, typer.Option("--rows", metavar="1:3|1,2,6", help="Fit these rows only; the others are predicted.")
    ] = None,
    experiment: Annotated[
        Path | None, typer.Option("--experiment", metavar="E.csv", help="A second table actual_m,alg1_m,alg2_m.")
    ] = None,
    figures: Annotated[
        Path | None,
        typer.Option("--figures", metavar="DIR", help="Draw the figures as PNG there; beside --out if given."),
    ] = None,
    calibration: CalibrationOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="F.toml", help="Write the calibration; an old one is kept beside.")
    ] = None,
) -> None:
    """Fit Algorithm 1, Algorithm 2 and the pinhole head to measured distances.

    Prints published, recomputed and fitted values side by side, with their errors. With --calibration only [ratio] and
    [pixel_angle] of that file are replaced.

    Example: scanmap calibrate table thesis_table.csv --figures figures --out calibration.toml
    """
    import numpy as np

    from scanmap.calibration import Calibration
    from scanmap.calibration.keeping import refuse_folder, refuse_path
    from scanmap.cli.terminal import say
    from scanmap.solvers import table as solver
    from scanmap.solvers.pairs import NotedHead, check_fit, read_pairs

    if out is not None:
        refuse_path(out)
    refuse_folder("--figures", figures)
    base = Calibration.load(calibration) if calibration is not None else None
    pairs = read_pairs(file)
    noted = pairs.head or NotedHead(1600, 1200, 0.08)
    if base is not None:
        noted = NotedHead(base.intrinsics.width, base.intrinsics.height, base.baseline_m)
        width = height = baseline_mm = None
    width, height = width or noted.width, height or noted.height
    baseline_mm = baseline_mm or 1e3 * noted.baseline_m
    other = read_pairs(experiment) if experiment is not None else None
    if not pairs.has_columns and pairs.published and out is None and rows is None:
        _print_experiment(pairs)
        _draw_experiment(pairs, figures, file.stem)
        return
    chosen = np.arange(len(pairs.column)) if rows is None else _rows(rows, len(pairs.column))
    check_fit(pairs, file, width, chosen)
    fit = solver.fit_table(pairs, width, baseline_mm / 1e3, chosen)
    say(
        f"{file}: {len(pairs.column)} rows, columns {pairs.column.min():g} to {pairs.column.max():g} of {width}, "
        f"{pairs.distance_m.min():g} to {pairs.distance_m.max():g} m, baseline {baseline_mm:g} mm"
    )
    _print_fit(pairs, fit, chosen)
    if other is not None:
        _print_experiment(other)
    _draw(pairs, other, fit, figures if figures is not None else (out.parent if out is not None else None), file.stem)
    if out is not None:
        _write(fit, height, base, out, pairs, chosen)


def _rows(text: str, count: int) -> NDArray[np.intp]:
    """Indices of `1:3` or `1,2,6`, counted from 1."""
    import numpy as np

    from scanmap.errors import ConfigError

    try:
        if ":" in text:
            first, last = (int(part) for part in text.split(":"))
            numbers = list(range(first, last + 1))
        else:
            numbers = [int(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or min(numbers) < 1 or max(numbers) > count:
        raise ConfigError(f"--rows {text}: not rows of this table; valid: 1 to {count}, as 1:3 or 1,2,6")
    return np.array(sorted(set(numbers)), np.intp) - 1


def _print_fit(pairs: Pairs, fit: TableFit, chosen: NDArray[np.intp]) -> None:
    from scanmap.cli.terminal import say
    from scanmap.solvers.table import depths_of
    from scanmap.solvers.table_words import ERRATA, fit_lines

    depths = depths_of(fit, pairs)
    if fit.mirrored:
        say("near returns are on the left: columns are counted from the other side in all that follows")
    _print_models("Table 1: Algorithm 1, pixel ratio", pairs, chosen, {
        "published": pairs.published_ratio_m, "32.3 / 25.7": depths.get("ratio recomputed"),
        "fitted": depths["ratio fitted"]})  # fmt: skip
    _print_models("Table 2: Algorithm 2, pixel angle", pairs, chosen, {
        "published": pairs.published_angle_m, "0.044, -8.768": depths.get("pixel_angle recomputed"),
        "line": depths["pixel_angle fitted"], "by distance": depths["pixel_angle by distance"]})  # fmt: skip
    _print_models("Table 3: pinhole head", pairs, chosen, {
        "x held": depths["pinhole fitted"], "x fitted": depths.get("pinhole with x fitted")})  # fmt: skip
    for line in fit_lines(pairs, fit, chosen):
        say(line)
    for line in ERRATA if pairs.published else ():
        say(f"erratum: {line}")


def _print_models(
    title: str, pairs: Pairs, chosen: NDArray[np.intp], depths: dict[str, NDArray[np.float64] | None]
) -> None:
    """One table: a row a measurement, each model's distance and its error in per cent."""
    import numpy as np
    from rich.table import Table

    from scanmap.cli.terminal import console

    shown = {name: depth for name, depth in depths.items() if depth is not None and np.isfinite(depth).any()}
    drawn = Table(title=title, title_justify="left", padding=(0, 0), pad_edge=False)
    for header in ("ppx", "actual m", *(part for name in shown for part in (name, "%"))):
        drawn.add_column(header, justify="right")
    for k, (u, actual) in enumerate(zip(pairs.column, pairs.distance_m, strict=True)):
        cells = [f"{u:g}" + ("" if k in chosen else " *"), f"{actual:.3f}"]
        for depth in shown.values():
            known = bool(np.isfinite(depth[k]))
            cells += [f"{depth[k]:.4f}", f"{100.0 * (depth[k] / actual - 1.0):+.1f}"] if known else ["-", "-"]
        drawn.add_row(*cells)
    console.print(drawn)


def _print_experiment(pairs: Pairs) -> None:
    """Distances somebody measured with both algorithms, and their errors."""
    import numpy as np
    from rich.table import Table

    from scanmap.cli.terminal import console

    drawn = Table(title="Experiment: measured against actual", title_justify="left", padding=(0, 0), pad_edge=False)
    for name in ("actual m", "Alg 1 m", "%", "Alg 2 m", "%"):
        drawn.add_column(name, justify="right")
    for actual, *both in zip(pairs.distance_m, pairs.published_ratio_m, pairs.published_angle_m, strict=True):
        cells = [f"{actual:.3f}"]
        for value in both:
            known = bool(np.isfinite(value))
            cells += [f"{value:.3f}", f"{100.0 * (value / actual - 1.0):+.1f}"] if known else ["below limit", "-"]
        drawn.add_row(*cells)
    console.print(drawn)


def _draw(pairs: Pairs, other: Pairs | None, fit: TableFit, folder: Path | None, stem: str) -> None:
    from scanmap.cli.terminal import say
    from scanmap.solvers.table_figures import draw_table

    if folder is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    for path in draw_table(pairs, fit, folder, stem):
        say(f"wrote {path}")
    if other is not None:
        _draw_experiment(other, folder, f"{stem}-experiment")


def _draw_experiment(pairs: Pairs, folder: Path | None, stem: str) -> None:
    from scanmap.cli.terminal import say
    from scanmap.solvers.table_figures import draw_measured_against_actual

    if folder is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{stem}-measured-actual.png"
    draw_measured_against_actual(pairs, {}, path)
    say(f"wrote {path}")


def _write(fit: TableFit, height: int, base: object, out: Path, pairs: Pairs, chosen: NDArray[np.intp]) -> None:
    """The calibration, with what it was fitted to; refused where it fits nothing."""
    from dataclasses import replace
    from datetime import date

    from scanmap.calibration import Calibration
    from scanmap.calibration.keeping import save_beside
    from scanmap.cli.terminal import say, say_written
    from scanmap.solvers.table import calibration_of
    from scanmap.solvers.table_words import check_worth, worst_percent

    check_worth(pairs, fit, chosen)
    head = calibration_of(fit, height, base if isinstance(base, Calibration) else None)
    residuals = {**head.residuals, "table_worst_percent": worst_percent(pairs, fit, chosen)}
    meta = {**head.meta, "table_rows": len(chosen), "table_date": date.today().isoformat(),
            "table_command": "calibrate table"}  # fmt: skip
    kept = save_beside(replace(head, residuals=residuals, meta=meta), out)
    say_written(out, kept)
    if fit.mirrored:
        say("no [ratio] and [pixel_angle] in it: the thesis's models want near returns on the right")
    say(f"next: scanmap scan --calibration {shlex.quote(str(out))} --out room.ply")
