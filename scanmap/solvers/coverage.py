"""Which parts of the picture and which tilts the views so far cover, and what to show next: live guidance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Intrinsics
from scanmap.solvers.board import Board
from scanmap.solvers.board_pose import board_pose, rough_camera
from scanmap.solvers.detection import View

Array = NDArray[np.float64]

VIEWS_LEAST, VIEWS_GOOD = 8, 20
CELLS = (8, 6)  # of the picture, across and down
COVERED_GOOD = 0.8  # [share of the cells]
TILT_GOOD_DEG = 35.0
LINES_GOOD = 15  # boards with the laser line on them
DEPTHS_GOOD = 1.5  # farthest over nearest of these
# [share of the image width] views whose corners differ by less on average are one view.
NEW_SHARE = 0.005


class Progress(NamedTuple):
    """How far live views have come."""

    covered: float  # share of the picture where corners were seen
    tilt_deg: float  # spread of the boards' directions
    depths_m: tuple[float, float]  # nearest and farthest board
    wishes: list[str]  # what to show next, most needed first; empty when there is enough


class Coverage(NamedTuple):
    """Corners per cell of the picture."""

    counts: NDArray[np.intp]  # (rows, columns)

    @property
    def share(self) -> float:
        """Share of the cells that hold corners."""
        return float((self.counts > 0).mean())


def coverage_of(views: Sequence[View], size: tuple[int, int]) -> Coverage:
    """`Coverage` of pictures of `size` = width, height [px]."""
    corners = np.concatenate([view.corners for view in views]) if views else np.zeros((0, 2))
    edges = [np.linspace(-0.5, extent - 0.5, cells + 1) for extent, cells in zip(size, CELLS, strict=True)]
    counts, _, _ = np.histogram2d(corners[:, 1], corners[:, 0], bins=(edges[1], edges[0]))
    return Coverage(counts.astype(np.intp))


def apart(view: View, other: View | None) -> float:
    """Mean distance [px] of the corners that both views have; infinite where they have too few in common."""
    if other is None:
        return np.inf
    both, here, there = np.intersect1d(view.ids, other.ids, return_indices=True)
    if len(both) < 0.8 * len(view.ids):
        return np.inf
    off = float(np.linalg.norm(view.corners[here] - other.corners[there], axis=1).mean())
    if np.isnan(view.marker_ratio) and len(view.ids) == len(other.ids):
        # A chessboard may have been numbered the other way round this time.
        off = min(off, float(np.linalg.norm(view.corners - other.corners[::-1], axis=1).mean()))
    return off


def is_new(view: View, before: Sequence[View], width: int) -> bool:
    """Whether a view shows something that none before it showed."""
    return all(apart(view, old) >= NEW_SHARE * width for old in before)


def tilt_spread_deg(poses: Array) -> float:
    """Largest angle [deg] between the normals of boards with the poses (V, 4, 4)."""
    normals = np.asarray(poses)[:, :3, 2]
    return float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0)))) if len(normals) else 0.0


def hints(views: Sequence[View], poses: Array, size: tuple[int, int]) -> list[str]:
    """What to show next, most needed first; empty when there is enough."""
    wanted = []
    if views and all(view.part is not None for view in views):
        wanted.append("show the whole board once")
    if len(views) < VIEWS_GOOD:
        missing = VIEWS_GOOD - len(views)
        wanted.append("1 more view" if missing == 1 else f"{missing} more views")
    if tilt_spread_deg(poses) < TILT_GOOD_DEG:
        wanted.append("tilt the board more, 20 to 40 deg up, down, left and right")
    if coverage_of(views, size).share < COVERED_GOOD:
        wanted.append(f"hold the board into the {_emptiest(coverage_of(views, size))} of the picture")
    return wanted


def progress_of(
    views: Sequence[View], board: Board, size: tuple[int, int], camera: Intrinsics | None = None
) -> Progress:
    """How far live views have come, and what to show next.

    Args:
        camera: of the views, when they are for the laser; None before there is a camera: tilts are then judged with
            an ordinary webcam's focal length.
    """
    poses = [board_pose(view, board, camera or rough_camera(size)).T_camera_board for view in views]
    known = np.array([pose for pose in poses if np.isfinite(pose).all()]).reshape(-1, 4, 4)
    wishes = hints(views, known, size) if camera is None else _laser_hints(views, known)
    depths = known[:, 2, 3]
    return Progress(
        coverage_of(views, size).share, tilt_spread_deg(known),
        (float(depths.min()), float(depths.max())) if len(depths) else (np.nan, np.nan), wishes,
    )  # fmt: skip


def _laser_hints(views: Sequence[View], poses: Array) -> list[str]:
    wanted = []
    if len(views) < LINES_GOOD:
        wanted.append(f"{LINES_GOOD - len(views)} more views")
    depths = poses[:, 2, 3]
    if len(depths) and depths.max() < DEPTHS_GOOD * depths.min():
        wanted.append("hold the board nearer and farther")
    if tilt_spread_deg(poses) < TILT_GOOD_DEG:
        wanted.append("turn the board both ways, 20 to 40 deg")
    return wanted


def _emptiest(coverage: Coverage) -> str:
    names = [["upper left", "upper middle", "upper right"], ["left", "middle", "right"],
             ["lower left", "lower middle", "lower right"]]  # fmt: skip
    rows, columns = (np.array_split(np.arange(n), 3) for n in coverage.counts.shape)
    empty = [[float((coverage.counts[np.ix_(r, c)] == 0).mean()) for c in columns] for r in rows]
    at = np.unravel_index(np.argmax(empty), (3, 3))
    return names[at[0]][at[1]]
