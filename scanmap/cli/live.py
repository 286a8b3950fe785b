"""`scanmap live`: the fixed head's numbers and pictures, now."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scanmap.cli.settings import CalibrationOption, ConfigOption, SetOption

if TYPE_CHECKING:
    from scanmap.session.knobs import Knobs
    from scanmap.session.live import Distance, Reading

LINE_EVERY_S = 1.0  # where nobody watches a terminal
NAMES = {"ratio": "Algorithm 1", "pixel_angle": "Algorithm 2", "plane": "calibrated"}


def live(
    source: Annotated[
        Path | None, typer.Argument(metavar="SOURCE", help="A recording to play as if live, instead of the rig.")
    ] = None,
    row: Annotated[
        int | None, typer.Option("--row", metavar="N", min=0, help="Image row whose distance is shown; the middle one.")
    ] = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: CalibrationOption = None,
    view: Annotated[
        bool, typer.Option("--view/--no-view", help="Serve the pictures on 127.0.0.1, and open the viewer on them.")
    ] = True,
    rrd: Annotated[Path | None, typer.Option("--rrd", metavar="F.rrd", help="Keep the pictures in a file.")] = None,
    frames: Annotated[
        int | None, typer.Option("--frames", metavar="N", min=1, help="End after so many pictures.")
    ] = None,
) -> None:
    """Show the newest picture's line and distance while the head stands still.

    Keys: + - bit index, g other greys, up down (J K: ten) row, c overlay colour, m range model, q or Ctrl-C end.

    Example: scanmap live --config my-rig.toml --row 600
    """
    from contextlib import ExitStack

    from scanmap import session
    from scanmap.cli.keys import pressed_keys
    from scanmap.cli.terminal import output, say, stop_on_signal

    with ExitStack() as opened:
        opened.enter_context(stop_on_signal())
        choice = session.Choice(config, tuple(set_ or ()), calibration)
        panel = session.open_live(choice, source, say)
        opened.callback(panel.close)
        knobs = panel.knobs(row)
        for line in panel.lines:
            say(line)
        port = panel.config.view.live_port if view else None
        show = None
        if view or rrd is not None:
            shown = session.open_live_view(panel, knobs, port=port, rrd=rrd)
            opened.callback(shown.close)
            show = shown.show
        if port is not None:
            say(session.watching_words(port))
        say(f"keys: {session.KEYS_HELP}")
        print_readings = opened.enter_context(_printer())
        keys = opened.enter_context(pressed_keys())
        for number, (reading, turned) in enumerate(panel.readings(knobs, keys, show or (lambda *_: None)), 1):
            print_readings(reading, turned)
            if frames is not None and number >= frames:
                break
            if show is None and output.silent:
                break  # nobody listens any more, nobody looks


def words(reading: Reading, knobs: Knobs) -> list[str]:
    """The panel's numbers, a line each."""
    line = f"column {reading.ppx:.2f}, p {reading.p:.5f}" if math.isfinite(reading.ppx) else "no line"
    grey = f"{knobs.grey} {knobs.bit_index}" if knobs.grey == "bit_index" else knobs.grey
    numbers = [
        f"frame {reading.frame}, {reading.rate_hz:.1f}/s; grey {grey}, overlay {knobs.colour}, points by {knobs.model}",
        f"row {reading.row}: maximum {reading.peak}, {line}",
        *(f"{NAMES[model]}: {_distance(value)}" for model, value in reading.distances.items()),
    ]
    return [*numbers, f"fault: {reading.fault}"] if reading.fault else numbers


def _distance(value: Distance) -> str:
    if value.words:
        return value.words
    return f"{value.depth_m:.4f} m +- {1e3 * value.sigma_m:.1f} mm"


class _Printer:
    """Rewrites the panel in a terminal; elsewhere a line a second."""

    def __init__(self) -> None:
        from scanmap.cli.terminal import console

        self._live = None
        self._last = -math.inf
        if console.is_terminal:
            from rich.live import Live

            self._live = Live(console=console, auto_refresh=False, redirect_stdout=False)

    def __enter__(self) -> _Printer:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def __call__(self, reading: Reading, knobs: Knobs) -> None:
        from rich.text import Text

        from scanmap.cli.terminal import say

        lines = words(reading, knobs)
        if self._live is not None:
            self._live.update(Text("\n".join(lines)), refresh=True)
        elif time.monotonic() - self._last >= LINE_EVERY_S:
            self._last = time.monotonic()
            say("; ".join(lines))


def _printer() -> _Printer:
    return _Printer()
