"""The pictures of the check: lines over the board, residual maps, coverage, as PNG."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Intrinsics
from scanmap.errors import CalibrationError
from scanmap.shot import Image
from scanmap.solvers.axis import AxisFit
from scanmap.solvers.board import Board
from scanmap.solvers.board_line import BoardLine, points_on_board
from scanmap.solvers.board_pose import board_pose, project
from scanmap.solvers.coverage import CELLS, coverage_of
from scanmap.solvers.detection import View
from scanmap.solvers.intrinsics import CameraFit
from scanmap.solvers.laser_plane import LaserFit

Array = NDArray[np.float64]
GREEN, RED, YELLOW = (60, 200, 60), (40, 40, 235), (0, 200, 255)  # BGR
RESIDUAL_LENGTH = 0.05  # [share of the image width] the 95th percentile residual is drawn this long


def draw_camera(fit: CameraFit, size: tuple[int, int], path: Path) -> None:
    """Corners with their residuals, coverage of the picture, and rms of each view."""
    corners = np.concatenate([view.corners for view in fit.views])
    residuals = np.concatenate(fit.residuals)
    typical = float(np.percentile(np.linalg.norm(residuals, axis=1), 95)) or 1.0
    with _figure(path, f"camera: {len(fit.views)} views, rms {fit.rms_px:.3f} px", (13, 9), (2, 2)) as axes:
        ax = axes[0, 0]
        scale = typical / (RESIDUAL_LENGTH * size[0])
        ax.quiver(*corners.T, *residuals.T, angles="xy", scale_units="xy", scale=scale, width=0.0015, color="tab:red")
        _as_image(ax, size, f"residuals, {1.0 / scale:.0f} times enlarged: no direction should prevail anywhere")
        _draw_coverage(axes[0, 1], fit, size)
        ax = axes[1, 0]
        rms = [float(np.sqrt((r**2).sum(axis=1).mean())) for r in fit.residuals]
        ax.bar(range(len(rms)), rms, color="tab:blue")
        ax.set(xlabel="view", ylabel="rms [px]", title="each view")
        ax = axes[1, 1]
        ax.plot(*residuals.T, ".", ms=2, alpha=0.5)
        ax.set(xlabel="column residual [px]", ylabel="row residual [px]", aspect="equal", title="all corners")
        ax.grid(alpha=0.3)


def draw_laser(fit: LaserFit, size: tuple[int, int], path: Path) -> None:
    """Distance of the line from the plane over the image, against depth, and per board."""
    off = 1e3 * np.concatenate(fit.off_m)
    columns = np.concatenate([line.columns for line in fit.lines])
    rows = np.concatenate([line.rows for line in fit.lines])
    depth = np.concatenate([points[:, 2] for points in fit.points])
    bound = float(np.percentile(np.abs(off), 98)) or 1.0
    title = f"laser plane: {len(fit.lines)} boards, rms {1e3 * fit.rms_m:.2f} mm ({fit.rms_px:.2f} px)"
    with _figure(path, title, (13, 9), (2, 2)) as axes:
        dots = axes[0, 0].scatter(columns, rows, c=off, s=2, cmap="coolwarm", vmin=-bound, vmax=bound)
        _as_image(axes[0, 0], size, "distance from the plane over the image [mm]")
        axes[0, 0].figure.colorbar(dots, ax=axes[0, 0])
        axes[0, 1].scatter(depth, off, c=rows, s=2, cmap="viridis")
        axes[0, 1].set(xlabel="depth [m]", ylabel="off the plane [mm]", title="against depth (colour: row)")
        per_board = [1e3 * float(np.sqrt((each**2).mean())) for each in fit.off_m]
        axes[1, 0].bar(range(len(per_board)), per_board, color="tab:blue")
        axes[1, 0].set(xlabel="board", ylabel="rms [mm]", title="each board")
        axes[1, 1].hist(np.clip(off, -2 * bound, 2 * bound), bins=80, color="tab:blue")
        axes[1, 1].set(xlabel="off the plane [mm]", title="all points")
        axes[0, 1].grid(alpha=0.3)


def draw_axis(fit: AxisFit, path: Path) -> None:
    """Residuals of the corners against the bearing."""
    bearing = np.degrees([view.bearing for view in fit.views])
    with _figure(path, f"axis: {len(fit.views)} views, rms {fit.rms_px:.3f} px", (9, 7), (2, 1)) as axes:
        for ax, k, name in zip(axes, (0, 1), ("column", "row"), strict=True):
            for at, residual in zip(bearing, fit.residuals, strict=True):
                ax.plot(np.full(len(residual), at), residual[:, k], ".", ms=2, color="tab:blue")
            ax.plot(bearing, [r[:, k].mean() for r in fit.residuals], "o", color="tab:red", label="mean of the view")
            ax.set(xlabel="bearing [deg]", ylabel=f"{name} residual [px]")
            ax.grid(alpha=0.3)
            ax.legend()


def draw_boards(
    pictures: Sequence[tuple[str, Image]], board: Board, views: Sequence[View], intrinsics: Intrinsics, path: Path,
    lines: Sequence[BoardLine] = (), plane: Array | None = None,
) -> None:  # fmt: skip
    """A few pictures with what was found in them: the board's squares drawn by its pose, the line, the fitted plane."""
    found = {view.name: view for view in views}
    of_line = {line.view.name: line for line in lines}
    drawn = [
        _over(image, found[name], board, intrinsics, of_line.get(name), plane)
        for name, image in pictures
        if name in found
    ]
    if not drawn:
        return
    while len(drawn) % 2:
        drawn.append(np.zeros_like(drawn[0]))
    rows = [np.hstack(drawn[k : k + 2]) for k in range(0, len(drawn), 2)]
    if not cv2.imwrite(str(path), np.vstack(rows)):
        raise CalibrationError(f"{path} cannot be written")


def _over(
    image: Image, view: View, board: Board, own: Intrinsics, line: BoardLine | None, plane: Array | None
) -> Image:
    """One picture, 800 px wide, with its board drawn over."""
    scale = 800.0 / image.shape[1]
    colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    canvas = np.asarray(cv2.resize(colour, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)

    def pixels(at: Array) -> NDArray[np.int32]:
        # In 1/16 of a pixel; pixel centres at integers.
        return np.asarray(np.rint(16.0 * ((np.nan_to_num(at, nan=-99.0) + 0.5) * scale - 0.5)), np.int32)

    pose = board_pose(view, board, own)
    shown = view.board_seen(board)
    across, down = shown.corners
    grid = project(shown.points, pose.T_camera_board, own).reshape(down, across, 2)
    strips = [pixels(strip) for strip in (*grid, *grid.transpose(1, 0, 2))]
    cv2.polylines(canvas, strips, False, GREEN, 1, cv2.LINE_AA, 4)
    for corner in pixels(view.corners):
        cv2.circle(canvas, (int(corner[0]), int(corner[1])), 48, YELLOW, 1, cv2.LINE_AA, 4)
    if line is not None:
        if plane is not None:
            crossing = _fitted(plane, pose.T_camera_board, points_on_board(line, board, own)[0], own)
            cv2.polylines(canvas, [pixels(crossing)], False, GREEN, 1, cv2.LINE_AA, 4)
        for at in pixels(np.stack([line.columns, line.rows], axis=-1)[::6]):
            cv2.circle(canvas, (int(at[0]), int(at[1])), 16, RED, -1, cv2.LINE_AA, 4)
    cv2.putText(canvas, view.name, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(canvas, view.name, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return canvas


def _fitted(plane: Array, T_camera_board: Array, points: Array, own: Intrinsics) -> Array:
    """Pixels (N, 2) of where the fitted laser plane crosses the board, along the points (M, 3) of the line on it."""
    R, t = T_camera_board[:3, :3], T_camera_board[:3, 3]
    along = np.cross(plane[:3], R[:, 2])
    along /= np.linalg.norm(along)
    start = np.linalg.solve(np.stack([plane[:3], R[:, 2], along]), [-plane[3], R[:, 2] @ t, 0.0])
    reach = points @ along
    return own.project(start + np.linspace(reach.min(), reach.max(), 101)[:, None] * along)


def _draw_coverage(ax: Any, fit: CameraFit, size: tuple[int, int]) -> None:
    counts = coverage_of(fit.views, size).counts
    shown = ax.imshow(
        counts, extent=(-0.5, size[0] - 0.5, size[1] - 0.5, -0.5), cmap="Greens", vmin=0, vmax=max(8, counts.max())
    )
    for view in fit.views:
        ax.plot(*view.corners.T, ".", ms=1.5, color="tab:blue", alpha=0.5)
    ax.figure.colorbar(shown, ax=ax)
    _as_image(ax, size, f"corners in {100 * fit.covered:.0f} % of {CELLS[0]}x{CELLS[1]} cells")


def _as_image(ax: Any, size: tuple[int, int], title: str) -> None:
    ax.set(xlim=(-0.5, size[0] - 0.5), ylim=(size[1] - 0.5, -0.5), aspect="equal", title=title)
    ax.set(xlabel="column [px]", ylabel="row [px]")


@contextmanager
def _figure(path: Path, title: str, inches: tuple[float, float], grid: tuple[int, int]) -> Iterator[Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawing = Figure(figsize=inches, layout="constrained")
    FigureCanvasAgg(drawing)
    drawing.suptitle(title)
    yield drawing.subplots(*grid)
    try:
        drawing.savefig(path, dpi=100)
    except OSError as error:
        raise CalibrationError(f"{path} cannot be written: {error.strerror}") from error
