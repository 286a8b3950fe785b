"""Render a recording to a PNG without a display, by the viewer itself."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scanmap.errors import ConfigError
from scanmap.view import entities as at
from scanmap.view.viewer import free_port, live_address, start_viewer

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

TRIES = 60


def render(
    rrd: Path, png: Path, *, tab: str = "scan", width: int = 1600, height: int = 1000, shot: int | None = None
) -> None:
    """Write what the viewer shows of a recording as a PNG.

    Needs a Vulkan driver; without a graphics card Mesa's lavapipe (`mesa-vulkan-drivers`) serves.

    Args:
        rrd: recording of a `View`.
        png: file to write.
        tab: which one, of `entities.TABS`.
        width, height: of the picture [px].
        shot: at which shot; None for the last.

    Raises:
        ConfigError: no such file or tab, or the viewer cannot draw here.
    """
    from rerun.experimental import ViewerClient

    if not rrd.is_file():
        raise ConfigError(f"{rrd} is not a file; make one with `scanmap view SOURCE --save F.rrd`")
    if tab not in at.TABS:
        raise ConfigError(f"the layout has no tab {tab!r}; choose one of {', '.join(at.TABS)}")
    port = free_port()
    size = f"{width}x{height}"
    viewer = start_viewer([str(rrd), "--headless", "--port", str(port), "--window-size", size])
    try:
        client = ViewerClient.connect(live_address(port))
        _await_recording(client)
        _bring_to_front(client, tab)
        if shot is not None:
            client.set_time(at.SHOT, sequence=shot, play_state="paused")
        time.sleep(2.0)  # views read their data in the background and do not say when they are done
        client.take_screenshot(max_size=None)
        time.sleep(1.0)
        png.write_bytes(client.take_screenshot(max_size=None))
    finally:
        viewer.terminate()
        viewer.wait(10.0)


def _await_recording(client: ViewerClient) -> None:
    for _ in range(TRIES):
        state = client.get_state()
        if state.views and not state.loading:
            return
        time.sleep(0.25)
    raise ConfigError("the viewer did not load the recording in time; is it an .rrd of scanmap?")


def _bring_to_front(client: ViewerClient, tab: str) -> None:
    """Turn to a tab, and hide the window's bars that a picture has no use for."""
    blueprint: dict[str, Any] = client.get_blueprint("recording").blueprint
    names = {path: part.get("ContainerBlueprint", {}).get("display_name") for path, part in blueprint.items()}
    wanted = [path for path, name in names.items() if name == tab.capitalize()]
    for part in blueprint.values():
        container = part.get("ContainerBlueprint", {})
        if wanted and wanted[0] in container.get("contents", ()):
            container["active_tab"] = wanted[0]
    blueprint["/top_panel"] = {"PanelBlueprint": {"state": "Hidden"}}
    client.set_blueprint(blueprint, of="recording")
