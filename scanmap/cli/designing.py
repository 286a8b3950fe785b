"""`scanmap design`: what a head would measure, before anybody buys or prints it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scanmap.cli.settings import CalibrationOption, SetOption, size_of

if TYPE_CHECKING:
    from scanmap.calibration import Calibration
    from scanmap.config import Config
    from scanmap.solvers.design import Design


def design(
    config: Annotated[
        list[str] | None,
        typer.Option("--config", metavar="FILE|PRESET", help="A rig's TOML or preset; several are compared."),
    ] = None,
    set_: SetOption = None,
    calibration: CalibrationOption = None,
    baseline_mm: Annotated[
        float | None, typer.Option("--baseline-mm", metavar="MM", min=1.0, max=5000.0, help="Camera to laser [mm].")
    ] = None,
    beta_deg: Annotated[
        float | None,
        typer.Option("--beta-deg", metavar="DEG", min=-79.0, max=79.0, help="Camera turned in toward the laser [deg]."),
    ] = None,
    alpha_deg: Annotated[
        float | None,
        typer.Option(
            "--alpha-deg", metavar="DEG", min=2.0, max=84.0, help="Half the horizontal view of the lens [deg]."
        ),
    ] = None,
    image: Annotated[str | None, typer.Option("--image", metavar="WxH", help="Resolution, such as 1920x1080.")] = None,
    sigma_px: Annotated[
        float, typer.Option("--sigma-px", metavar="PX", min=0.001, max=20.0, help="How well a column is found [px].")
    ] = 0.1,
    wall: Annotated[
        str, typer.Option("--wall", metavar="WxH@D", help="Wall whose points are counted: width, height, distance [m].")
    ] = "4x2.5@2",
    out: Annotated[Path | None, typer.Option("--out", metavar="F.png", help="Draw the curves as PNG.")] = None,
) -> None:
    """Nearest range, range step and sigma against range, field of view, points on a wall.

    For a head that is not built yet, or several: repeat --config. The lens, baseline and tilt can be given directly.

    Examples: scanmap design --config thesis --config wide --out heads.png

    scanmap design --baseline-mm 120 --beta-deg 20 --alpha-deg 32.3 --image 1920x1080
    """
    import numpy as np

    from scanmap.calibration.keeping import refuse_file
    from scanmap.cli.terminal import say
    from scanmap.solvers.design import RANGES_M, evaluate
    from scanmap.solvers.design_figures import draw_designs

    refuse_file("--out", out, ".png")
    size = None if image is None else size_of("--image", image)
    short = {"baseline_m": None if baseline_mm is None else baseline_mm / 1e3, "beta_deg": beta_deg,
             "alpha_deg": alpha_deg}  # fmt: skip
    heads = [_head(name, set_, calibration, short, size) for name in config or ["twin-room"]]
    if not config and heads[0][0].endswith("*"):
        heads = [("as given", *heads[0][1:])]
    ranges_m = np.array(RANGES_M) if len(heads) > 1 else None  # one column of ranges for all
    designs = [evaluate(name, head, own.triangulation, sigma_px, ranges_m) for name, head, own in heads]
    _print_heads(designs, [own for _, _, own in heads], _wall(wall))
    _print_ranges(designs, sigma_px)
    for one in designs:
        say(f"{one.name}: {one.model_error}")
    if out is not None:
        draw_designs([(name, head, own.triangulation) for name, head, own in heads], sigma_px, out)
        say(f"wrote {out}")


def _head(
    name: str, set_: list[str] | None, calibration: str | None, short: dict[str, float | None],
    size: tuple[int, int] | None,
) -> tuple[str, Calibration, Config]:  # fmt: skip
    """Name, head and configuration; what was given directly makes a head of the short form on top."""
    from scanmap.calibration import Calibration, CalibrationFile
    from scanmap.config import load
    from scanmap.errors import CalibrationError, ConfigError

    own = load(name, set_ or ())
    head = Calibration.load(calibration) if calibration is not None else own.head()
    given = {key: value for key, value in short.items() if value is not None}
    shown = Path(name).stem
    if given or size is not None:
        import numpy as np

        width, height = size or (head.intrinsics.width, head.intrinsics.height)
        document = {
            "image": {"width": width, "height": height},
            "head": {
                "baseline_m": head.baseline_m, "beta_deg": float(np.degrees(head.beta)),
                "alpha_deg": float(np.degrees(head.alpha)), **given,
            },
        }  # fmt: skip
        try:
            head = CalibrationFile.model_validate(document).build()
        except (CalibrationError, ValueError) as error:
            raise ConfigError(f"no head can be made of {given}: {error}") from error
        shown += "*"
    return shown, head, own


def _wall(text: str) -> tuple[float, float, float]:
    from scanmap.errors import ConfigError

    size, _, distance = text.lower().partition("@")
    width, _, height = size.partition("x")
    try:
        numbers = float(width), float(height), float(distance)
    except ValueError:
        numbers = (0.0, 0.0, 0.0)
    if not all(0.0 < number < 1000.0 for number in numbers):
        raise ConfigError(f"--wall {text}: not WIDTHxHEIGHT@DISTANCE in metres; try --wall 4x2.5@2")
    return numbers


def _print_heads(designs: list[Design], configs: list[Config], wall: tuple[float, float, float]) -> None:
    from rich.table import Table

    from scanmap.cli.terminal import console
    from scanmap.solvers.design import points_on_wall

    width, height, distance = wall
    table = Table(padding=(0, 0), pad_edge=False)
    table.add_column("")
    for one in designs:
        table.add_column(one.name, justify="right")
    rows = {
        "image px": [f"{d.size[0]}x{d.size[1]}" for d in designs],
        "baseline mm": [f"{1e3 * d.baseline_m:.1f}" for d in designs],
        "beta, alpha deg": [f"{d.beta_deg:.2f}, {d.alpha_deg:.2f}" for d in designs],
        "nearest range m": [f"{d.nearest_m:.3f}" for d in designs],
        "farthest range m": [f"{d.farthest_m:.2f}" for d in designs],
        "column at infinity": [f"{d.column_infinity:.1f}" for d in designs],
        "columns used": [f"{d.columns_used:.0f}" for d in designs],
        "view up, down deg (2 m)": [f"{d.view_up_deg:.1f}, {d.view_down_deg:.1f}" for d in designs],
        f"points on {width:g}x{height:g} m at {distance:g} m": [
            str(points_on_wall(d, distance, width, height, c.sweep.step_deg))
            for d, c in zip(designs, configs, strict=True)
        ],
    }
    for name, cells in rows.items():
        table.add_row(name, *cells)
    console.print(table)


def _print_ranges(designs: list[Design], sigma_px: float) -> None:
    import numpy as np
    from rich.table import Table

    from scanmap.cli.terminal import console

    table = Table(
        title=f"range step of one column, and sigma at {sigma_px:g} px (mm)", title_justify="left", padding=(0, 0),
        pad_edge=False,
    )  # fmt: skip
    table.add_column("range m", justify="right")
    for one in designs:
        for what in ("column", "step", "sigma"):
            table.add_column(f"{one.name}\n{what}" if what == "column" else what, justify="right")
    for k, distance in enumerate(designs[0].ranges_m):
        cells = [f"{distance:.3g}"]
        for one in designs:
            seen = bool(np.isfinite(one.column[k]))
            numbers = (f"{one.column[k]:.1f}", f"{1e3 * one.step_m[k]:.2f}", f"{1e3 * one.sigma_m[k]:.2f}")
            cells += numbers if seen else ("-", "-", "-")
        table.add_row(*cells)
    console.print(table)
