"""The layout of the viewer: tabs for the scan, the thesis's own view, and the result."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.view import entities as at

if TYPE_CHECKING:
    import rerun.blueprint as rrb

Array = NDArray[np.float64]


class Eye(NamedTuple):
    """From where a 3D view looks, world frame [m]."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)


# A room's size and the default sweep of 0 to 180 deg, until the points say otherwise.
DEFAULT_EYE = Eye((0.0, -2.6, 4.4), (0.0, 1.7, -0.6))


_GROWING = (at.POINTS, at.POINTS_ABOVE)


def eye_over(low: Array, high: Array, bearing: float) -> Eye:
    """An eye behind and above the head that sees everything between two corners.

    Args:
        low, high: (3,) corners of a box around the points, world frame [m].
        bearing: [rad] the middle of the sweep; the eye stands on the other side of the head.
    """
    centre = 0.5 * (low + high)
    size = float(np.linalg.norm(high - low))
    forward = np.array([np.cos(bearing), np.sin(bearing), 0.0])
    position = centre + size * (-0.6 * forward + np.array([0.0, 0.0, 0.67]))
    target = centre - 0.04 * size * forward
    return Eye(_triple(position), _triple(target))


def layout(*, rows: int, thesis: bool, eye: Eye = DEFAULT_EYE, tab: str = "scan") -> rrb.Blueprint:
    """The blueprint of a recording.

    Args:
        rows: image rows, the most points a shot can have.
        thesis: whether the recording has the thesis's view.
        eye: of the 3D views.
        tab: the one in front, of `entities.TABS`.
    """
    import rerun.blueprint as rrb

    tabs: dict[str, Any] = {"scan": _scan_tab(eye, rows)}
    if thesis:
        tabs["thesis"] = _thesis_tab()
    tabs["result"] = _result_tab(eye)
    front = list(tabs).index(tab) if tab in tabs else 0
    return rrb.Blueprint(
        rrb.Tabs(*tabs.values(), active_tab=front),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        # Following: a live view keeps up with the scan, a file opens with the whole scan in sight.
        rrb.TimePanel(timeline=at.SHOT, state="collapsed", play_state="following"),
        auto_views=False,
        auto_layout=False,
    )


def _scan_tab(eye: Eye, rows: int) -> rrb.Horizontal:
    import rerun.blueprint as rrb

    left = rrb.Vertical(
        _world_view(
            "Cloud, head and map", eye, [f"+ /{at.WORLD}/**", f"- /{at.RESULT}/**"], _GROWING, (at.POINTS_ABOVE,)
        ),
        rrb.Horizontal(
            rrb.TextLogView(
                origin=at.LOG, name="Log", columns=rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
            ),
            rrb.StateTimelineView(origin=at.STATES, name="State"),
        ),
        row_shares=[4, 1],
    )
    right = rrb.Vertical(
        rrb.Spatial2DView(origin=at.IMAGE, name="Camera and laser line"),
        rrb.Tabs(
            rrb.Vertical(
                rrb.TimeSeriesView(origin=at.BEARING, name="Bearing [deg]", plot_legend=rrb.Corner2D.LeftTop),
                rrb.TimeSeriesView(
                    origin=at.ROWS,
                    name=f"Rows with a point, of {rows}",
                    axis_y=rrb.ScalarAxis(range=(0.0, 1.05 * rows)),
                    plot_legend=rrb.PlotLegend(visible=False),
                ),
                name="Plots",
            ),
            rrb.TextDocumentView(origin=at.SETTINGS, name="Settings"),
        ),
        row_shares=[1, 1],
    )
    return rrb.Horizontal(left, right, column_shares=[7, 4], name="Scan")


def _thesis_tab() -> rrb.Vertical:
    import rerun.blueprint as rrb

    pictures = (
        (at.THESIS_ORIGINAL, "Original"),
        (at.THESIS_GREY, "Grey"),
        (at.THESIS_BINARY, "Line image"),
        (at.THESIS_OVERLAY, "Overlay"),
    )
    hidden = rrb.PlotLegend(visible=False)
    return rrb.Vertical(
        rrb.Horizontal(*(rrb.Spatial2DView(origin=path, name=name) for path, name in pictures)),
        rrb.Horizontal(
            rrb.TimeSeriesView(origin=at.THESIS_PPX, name="ppx: column of the line [px]", plot_legend=hidden),
            rrb.TimeSeriesView(origin=at.THESIS_P, name="p: pixel ratio (l - ppx) / l", plot_legend=hidden),
            rrb.TimeSeriesView(origin=at.THESIS_DISTANCE, name="d: distance [m]", plot_legend=rrb.Corner2D.LeftTop),
        ),
        row_shares=[5, 6],
        name="Thesis",
    )


def _result_tab(eye: Eye) -> rrb.Horizontal:
    import rerun.blueprint as rrb

    height = 1.2 * float(np.linalg.norm(np.subtract(eye.position, eye.target)))
    x, y, z = eye.target
    above = Eye((x, y, z + height), eye.target, (0.0, 1.0, 0.0))
    head = f"+ /{at.BODY}"
    return rrb.Horizontal(
        _world_view("Finished cloud", eye, [f"+ /{at.RESULT}/**", head], (), (at.CLOUD_ABOVE,)),
        _world_view("Map from above", above, [f"+ /{at.RESULT_MAP}/**"], (), ()),
        column_shares=[7, 4],
        name="Result",
    )


def _world_view(
    name: str, eye: Eye, contents: list[str], growing: tuple[str, ...], hidden: tuple[str, ...]
) -> rrb.Spatial3DView:
    import rerun.blueprint as rrb

    # Only the points pile up; pictures, head and map are shown as they are at the time cursor.
    overrides: dict[str, Any] = {path: [_all_until_now()] for path in growing}
    for path in hidden:
        overrides[path] = [*overrides.get(path, []), rrb.EntityBehavior(visible=False)]
    return rrb.Spatial3DView(
        origin=f"/{at.WORLD}",
        contents=contents,
        name=name,
        background=[*at.GROUND, 255],
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=eye.position, look_target=eye.target, eye_up=eye.up
        ),
        overrides=overrides,
    )


def _all_until_now() -> rrb.VisibleTimeRanges:
    """Everything from the beginning to the time cursor: a cloud that grows."""
    import rerun.blueprint as rrb

    start, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    return rrb.VisibleTimeRanges([rrb.VisibleTimeRange(name, start=start, end=end) for name in (at.SHOT, at.SCAN_TIME)])


def _triple(vector: Array) -> tuple[float, float, float]:
    x, y, z = (round(float(v), 4) for v in vector)
    return x, y, z
