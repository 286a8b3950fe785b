"""The live panel's pictures in rerun, following the knobs that are turned meanwhile."""

from __future__ import annotations

from pathlib import Path

from scanmap.errors import ConfigError
from scanmap.pipeline import Step
from scanmap.session.knobs import Knobs
from scanmap.session.live import Live
from scanmap.view import View, open_view, show
from scanmap.view.viewer import has_display


class LiveView:
    """Shows every step; opened by `open_live_view`."""

    def __init__(self, live: Live, view: View, knobs: Knobs) -> None:
        self._live, self._view, self._knobs = live, view, knobs

    def show(self, step: Step, knobs: Knobs) -> None:
        """Show a step as the knobs stand."""
        if knobs != self._knobs:
            line = self._live.config.laserline.model_copy(update={"grey": knobs.grey, "bit_index": knobs.bit_index})
            params = self._live.config.view.model_copy(update={"row": knobs.row, "overlay_colour": knobs.colour})
            self._view.look_at(params, line)
            self._knobs = knobs
        self._view.step(step)

    def close(self) -> None:
        """End the view's file and server."""
        self._view.close()


def open_live_view(live: Live, knobs: Knobs, *, port: int | None, rrd: Path | None) -> LiveView:
    """Serve the panel's pictures on a port of this machine, keep them in a file, or both.

    Raises:
        ConfigError: the port is taken, or the file exists or cannot be written.
    """
    if rrd is not None and rrd.exists():
        raise ConfigError(f"{rrd} exists and is not overwritten: choose another --rrd, or move it away")
    params = live.config.view.model_copy(
        update={"row": knobs.row, "overlay_colour": knobs.colour, "thesis_every": 1, "thesis_tab": True}
    )
    view = open_view(
        calibration=live.calibration,
        params=params,
        settings_toml=live.config.dumps(),
        title=live.name,
        is_twin=live.is_twin,
        rrd=rrd,
        live_port=port,
        laserline=live.config.laserline,
        tab="thesis",
    )
    return LiveView(live, view, knobs)


def watching_words(port: int) -> str:
    """Open the viewer on a served panel where there is a display; what was done, or can be."""
    if has_display():
        show(port)
        return "the viewer is open"
    return f"no display here; watch with scanmap view --live {port} where there is one"
