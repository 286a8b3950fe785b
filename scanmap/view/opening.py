"""Open a view: the recording, where it goes, and all that stays the same during a scan."""

from __future__ import annotations

import platform
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scanmap.calibration import Calibration
from scanmap.errors import ConfigError
from scanmap.laserline import LaserLineParams
from scanmap.view import entities as at
from scanmap.view.blueprint import layout
from scanmap.view.entities import ViewParams
from scanmap.view.recorder import View
from scanmap.view.scene import log_scene
from scanmap.view.thesis_view import ThesisView, chosen_row
from scanmap.view.viewer import LOOPBACK, check_port

if TYPE_CHECKING:
    import rerun as rr

# Colour-blind safe: blue is well, orange needs a look, vermilion is bad.
SCAN_STATES = {"scanning": 0x56B4E9FF, "finished": 0x009E73FF, "stopped": 0xE69F00FF}
LINE_STATES = {"line found": 0x009E73FF, "few rows": 0xE69F00FF, "no line": 0xD55E00FF, "damaged image": 0xCC79A7FF}


def open_view(
    *,
    calibration: Calibration,
    params: ViewParams,
    settings_toml: str,
    title: str,
    is_twin: bool,
    rrd: Path | None,
    live_port: int | None,
    laserline: LaserLineParams | None = None,
    tab: str = "scan",
) -> View:
    """Open a view of one scan.

    Args:
        calibration: of the head that scans.
        params: what is shown.
        settings_toml: the effective configuration, shown as a document.
        title: name of the recording, for example the rig's.
        is_twin: marks everything as coming from the digital twin.
        rrd: file to write, or None.
        live_port: port on this machine to serve a live view on, or None.
        laserline: grey conversion for the thesis's pictures; its defaults if left out.
        tab: the one in front, of `entities.TABS`.

    Raises:
        ConfigError: the file cannot be written, the port is taken, or `params.row` is not in the image. From
            here on nothing the view does stops a scan.
    """
    import rerun as rr

    if rrd is None and live_port is None:
        raise ConfigError("a view needs somewhere to go: give --rrd F.rrd, or --view")
    chosen_row(calibration.intrinsics.height, params)
    sinks = _sinks(params, rrd, live_port)
    recording = rr.RecordingStream(at.APPLICATION)
    recording.set_sinks(
        *sinks, default_blueprint=layout(rows=calibration.intrinsics.height, thesis=params.thesis_tab, tab=tab)
    )
    recording.send_recording_name(title)
    recording.send_property("scan", rr.AnyValues(source=source_words(is_twin)))
    recording.set_time(at.SHOT, sequence=0)
    recording.set_time(at.SCAN_TIME, duration=0.0)
    log_scene(recording, calibration, params)
    _log_plots(recording, calibration.intrinsics.height)
    document = settings_document(title, settings_toml, is_twin)
    recording.log(at.SETTINGS, rr.TextDocument(document, media_type=rr.MediaType.MARKDOWN), static=True)
    thesis = ThesisView(recording, calibration, laserline or LaserLineParams(), params) if params.thesis_tab else None
    view = View(recording, calibration, params, thesis, rrd)
    view.log("INFO", f"source: {source_words(is_twin)}")
    return view


def source_words(is_twin: bool) -> str:
    """Where a scan comes from, plainly: nobody should steer a robot by a made-up room."""
    return "digital twin" if is_twin else "real rig or recording"


def settings_document(title: str, settings_toml: str, is_twin: bool) -> str:
    """Markdown: where the scan comes from, versions, the effective configuration."""
    versions = {"scanmap": version("scanmap"), "rerun": version("rerun-sdk"), "Python": platform.python_version()}
    table = "\n".join(f"| {name} | {number} |" for name, number in versions.items())
    return (
        f"# {title}\n\n**source: {source_words(is_twin)}**\n\n| program | version |\n|---|---|\n{table}\n\n"
        f"## Settings\n\n```toml\n{settings_toml.strip()}\n```\n"
    )


def _sinks(params: ViewParams, rrd: Path | None, live_port: int | None) -> list[rr.FileSink | rr.GrpcServerSink]:
    import rerun as rr

    if live_port is not None:
        check_port(live_port)
    sinks: list[rr.FileSink | rr.GrpcServerSink] = []
    if rrd is not None:
        try:
            with rrd.open("wb"):
                pass
        except OSError as error:
            raise ConfigError(f"{rrd} cannot be written ({error.strerror}); choose another path for --rrd") from error
        sinks.append(rr.FileSink(str(rrd)))
    if live_port is not None:
        # A server that viewers connect to, never a connection to a viewer: a frozen one would stall the scan.
        sinks.append(rr.GrpcServerSink(LOOPBACK, live_port, server_memory_limit=f"{params.live_memory_mb}MB"))
    return sinks


def _log_plots(recording: rr.RecordingStream, rows: int) -> None:
    import rerun as rr

    names, colours = ["commanded [deg]", "reported [deg]"], [(120, 120, 130), (255, 190, 80)]
    recording.log(at.BEARING, rr.SeriesLines(names=names, colors=colours, widths=[3.0, 1.5]), static=True)
    line = rr.SeriesLines(names=f"rows with a point, of {rows}", colors=(110, 230, 120))
    recording.log(at.ROWS, line, static=True)
    for path, states in ((at.SCAN_STATE, SCAN_STATES), (at.LINE_STATE, LINE_STATES)):
        colour = np.array(list(states.values()), np.uint32)
        recording.log(path, rr.StateConfiguration(values=list(states), colors=colour), static=True)
