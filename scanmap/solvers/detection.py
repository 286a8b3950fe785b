"""Find a board in a picture: sub-pixel corners, or why there are none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.shot import Image
from scanmap.solvers.board import Board
from scanmap.solvers.chessboard import Grid, find_part, find_whole

Array = NDArray[np.float64]
Index = NDArray[np.intp]
# Which of the board's points, where they are (N, 2) [px], a marker's side over a square's, and the part that is seen.
_Found = tuple[Index, Array, float, tuple[int, int] | None]

# A view counts from this share of the board's corners, and from this many.
LEAST_SHARE, LEAST_CORNERS = 0.25, 8
# [px] a corner may move when it is refined; one that moves further was none.
MOVED_MOST_PX = 2.0
# [10 to 90 % of an edge, as a share of a square] beyond it corners are no longer found evenly.
BLUR_MOST = 0.3
# Of the board's median contrast: a corner with less lies in glare, in a shadow or under a finger.
CONTRAST_LEAST = 0.25
# [share of a square] how far corners may lie from where a flat board has them (distortion bends it a little).
BENT_MOST = 0.35


class View(NamedTuple):
    """A board found in a picture."""

    name: str
    ids: Index  # (N,) which of `Board.points`
    corners: Array  # (N, 2) column, row [px]
    blur_px: float  # 10 to 90 % of an edge
    dropped: int  # corners given up for glare, shadow or a bad fit
    bearing: float = float("nan")  # [rad] where the source knows it
    marker_ratio: float = float("nan")  # measured side of a marker over side of a square; ChArUco
    part: tuple[int, int] | None = None  # columns, rows of the part of a chessboard that is seen; its place is unknown

    def board_seen(self, board: Board) -> Board:
        """The board as far as this view shows it: a part of a chessboard counts from its own first corner."""
        return board if self.part is None else replace(board, columns=self.part[0], rows=self.part[1])


class Rejected(NamedTuple):
    """A picture without a usable board."""

    name: str
    reason: str
    other: tuple[int, int] | None = None  # columns, rows of the chessboard that is there instead


def find_board(image: Image, board: Board, name: str = "", bearing: float = float("nan")) -> View | Rejected:
    """Find the board in a grey (H, W) or BGR (H, W, 3) picture, laser on or off."""
    grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    found = _charuco(grey, board) if board.kind == "charuco" else _chessboard(grey, board)
    if isinstance(found, Rejected):
        return found._replace(name=name)
    ids, corners, ratio, part = found
    spacing = _spacing(board, ids, corners)
    if spacing < 5.0:
        return Rejected(name, f"squares of {spacing:.1f} px are too small to measure; come closer")
    # The gradients of a marker beside a corner are not the corner's.
    clear = 0.5 * (1.0 - board.marker_m / board.square_m) if board.kind == "charuco" else 1.0
    refined, moved = _refined(grey, corners, min(0.3, clear) * spacing)
    contrast, blur = _edges(grey, refined, spacing, _across_edges(board, ids, corners))
    keep = (moved < MOVED_MOST_PX) & (contrast > CONTRAST_LEAST * np.median(contrast))
    keep &= (refined >= 2).all(axis=1) & (refined < np.array(grey.shape[::-1]) - 3).all(axis=1)
    if blur > max(4.0, BLUR_MOST * spacing):
        return Rejected(name, f"blurred: an edge is {blur:.1f} px wide; hold still, focus, more light")
    least = max(LEAST_CORNERS, int(LEAST_SHARE * len(board.points)))
    if keep.sum() < min(least, len(board.points)):
        why = "the rest are cut off, covered or in glare" if len(keep) < len(board.points) else "glare or shadow"
        return Rejected(name, f"only {int(keep.sum())} of {len(board.points)} corners are clear: {why}")
    if _on_one_line(board, ids[keep]):
        return Rejected(name, "the corners in sight lie on one line")
    fault = _not_flat(board, ids[keep], refined[keep], spacing)
    if fault:
        return Rejected(name, fault)
    return View(name, ids[keep], refined[keep], blur, int((~keep).sum()), bearing, ratio, part)


def _chessboard(grey: Image, board: Board) -> _Found | Rejected:
    """A whole chessboard, or a part of it; where in the board that part lies nobody can tell."""
    across, down = board.corners
    grid = find_whole(grey, across, down)
    if grid is None:
        piece = find_part(grey)
        if piece is not None and _has_markers(grey, piece):
            return Rejected("", "a ChArUco board is in sight")
        size = piece.wide().shape if piece is not None else (0, 0)
        if size[0] > max(across, down) or size[1] > min(across, down):
            return Rejected("", f"a chessboard of {size[0]}x{size[1]} inner corners is in sight", size)
        grid = find_whole(grey, across, down, thorough=True) or piece
    if grid is None:
        return Rejected("", "no board found")
    both = (grid, Grid(np.ascontiguousarray(grid.corners.transpose(1, 0, 2))))
    fitting = [each for each in both if each.shape[0] <= across and each.shape[1] <= down]
    grid = _right_handed(fitting[0])
    rows, columns = np.nonzero(grid.seen)
    part = grid.shape if grid.shape != (across, down) else None
    return rows * across + columns, grid.corners[rows, columns], np.nan, part


def _has_markers(grey: Image, grid: Grid) -> bool:
    """Whether markers of a ChArUco board lie between the corners."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    quads = cv2.aruco.ArucoDetector(dictionary, cv2.aruco.DetectorParameters()).detectMarkers(grey)[0]
    hull = cv2.convexHull(grid.corners[grid.seen].astype(np.float32))
    middles = [np.asarray(quad, np.float64).reshape(4, 2).mean(axis=0) for quad in quads]
    return sum(cv2.pointPolygonTest(hull, (float(u), float(v)), False) > 0 for u, v in middles) >= 2


def _right_handed(grid: Grid) -> Grid:
    """Numbered so that x, y and the look at the board make a right-handed frame; a chessboard allows it."""
    rows, columns = np.nonzero(grid.seen)
    along = np.linalg.lstsq(np.c_[columns, rows, np.ones(len(rows))], grid.corners[rows, columns], rcond=None)[0]
    return grid if np.linalg.det(along[:2]) > 0 else Grid(grid.corners[:, ::-1])


def _charuco(grey: Image, board: Board) -> _Found | Rejected:
    pattern = board.charuco()
    corners, ids, squares, marks = cv2.aruco.CharucoDetector(pattern).detectBoard(grey)
    count = board.columns * board.rows // 2
    strange = [] if marks is None else [int(i) for i in marks.ravel() if i >= count]
    if len(strange) >= 2:
        return Rejected("", f"marker {max(strange)} is in sight, and {board.name} has 0 to {count - 1}")
    if ids is None or corners is None or len(ids) < 4:
        seen = 0 if marks is None else len(marks)
        return Rejected("", "no board found" if not seen else f"only {seen} markers of the board could be read")
    which = np.asarray(ids).ravel().astype(np.intp)
    where = np.asarray(corners, np.float64).reshape(-1, 2)
    return which, where, _marker_ratio(board, which, where, squares), None


def _marker_ratio(board: Board, ids: Index, corners: Array, markers: Any) -> float:
    """Side of the markers over side of a square, measured by the homography of the corners."""
    H, _ = cv2.findHomography(corners, board.points[ids, :2])
    if H is None:
        return float("nan")
    flat = cv2.perspectiveTransform(np.concatenate([np.asarray(m).reshape(1, 4, 2) for m in markers], axis=1), H)
    quads = flat.reshape(-1, 4, 2)
    sides = np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=-1)
    return float(np.median(sides) / board.square_m)


def _spacing(board: Board, ids: Index, corners: Array) -> float:
    """Smallest distance between neighbouring corners [px]."""
    across, down = board.corners
    grid = np.full((down, across, 2), np.nan)
    grid.reshape(-1, 2)[ids] = corners
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    known = np.concatenate(steps)
    known = known[np.isfinite(known)]
    return float(known.min()) if known.size else 0.0


def _refined(grey: Image, corners: Array, reach: float) -> tuple[Array, Array]:
    """Corners (N, 2) to sub-pixel, where the gradients around stand across the way there; and how far they went.

    Source: Foerstner and Guelch 1987, OpenCV's cornerSubPix.
    """
    half = int(np.clip(reach, 2, 12))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    found = cv2.cornerSubPix(grey, corners.astype(np.float32)[:, None].copy(), (half, half), (-1, -1), criteria)
    refined = np.asarray(found, np.float64).reshape(-1, 2)
    return refined, np.linalg.norm(refined - corners, axis=1)


def _across_edges(board: Board, ids: Index, corners: Array) -> Array:
    """Unit vectors (2, 2) in the picture across the edges along the columns and along the rows."""
    flat = board.points[ids, :2]
    along = np.linalg.lstsq(np.c_[flat, np.ones(len(flat))], corners, rcond=None)[0][:2]
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    unit: Array = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    return unit


def _edges(grey: Image, corners: Array, spacing: float, across: Array) -> tuple[Array, float]:
    """Contrast (N,) around each corner [grey levels], and the median width of an edge, 10 to 90 % [px].

    Of the two directions of edges, `across` (2, 2), the more blurred one: a hand shakes one way.
    """
    half = int(np.clip(0.4 * spacing, 3, 25))
    height, width = grey.shape
    contrast, widths = np.zeros(len(corners)), []
    for k, (u, v) in enumerate(np.rint(corners).astype(int)):
        patch = grey[max(0, v - half) : min(height, v + half + 1), max(0, u - half) : min(width, u + half + 1)]
        if min(patch.shape) < 5:
            continue
        low, high = np.percentile(patch, [8, 92])
        contrast[k] = high - low
        smooth = cv2.GaussianBlur(patch.astype(np.float32), (0, 0), 0.7)
        gradient = np.stack([cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)], axis=-1) / 8
        slope = np.percentile(np.abs(gradient.reshape(-1, 2) @ across.T), 97, axis=0).min()
        widths.append(0.8 * contrast[k] / max(float(slope), 1e-3))
    return contrast, float(np.median(widths)) if widths else np.inf


def _on_one_line(board: Board, ids: Index) -> bool:
    spread = np.linalg.svd(board.points[ids, :2] - board.points[ids, :2].mean(axis=0), compute_uv=False)
    return bool(spread[1] < board.square_m)


def _not_flat(board: Board, ids: Index, corners: Array, spacing: float) -> str:
    """Whether the corners lie where no view of a flat board has them; the fault in words, or empty."""
    flat = board.points[ids, :2].astype(np.float64)
    H, _ = cv2.findHomography(flat, corners)
    if H is None:
        return "the corners are no view of a flat board"
    off = np.linalg.norm(cv2.perspectiveTransform(flat[:, None], H)[:, 0] - corners, axis=1)
    if np.median(off) > BENT_MOST * spacing:
        return f"the corners are no view of {board.name}: is that the board, and is it flat?"
    if np.linalg.det(H) * H[2, 2] < 0:
        return "the picture is mirrored: turn mirroring off in the camera"
    return ""
