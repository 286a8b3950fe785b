"""What pictures show where the board that was named is not in them, and the name it has."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.shot import Image
from scanmap.solvers.board import Board
from scanmap.solvers.chessboard import find_part
from scanmap.solvers.detection import Rejected, View
from scanmap.solvers.marks import FAMILIES, marks_in

Array = NDArray[np.float64]

# Markers that must agree before anything is said about a board: any four lie as some board has them.
MARKERS_LEAST, LAYOUT_LEAST = 4, 6
# [share of the distance between markers] how far they may lie from where a layout has them.
LAYOUT_OFF = 0.15
SQUARES_MOST = 24
# So many pictures must have room for a row that none of them shows.
MISSED_LEAST = 4


class Layout(NamedTuple):
    """Squares of a ChArUco board as its marker numbers tell them."""

    columns: int
    rows: int  # at least


def seen_instead(image: Image, board: Board) -> str:
    """What a picture without the board shows in its place, as far as it can be told; empty if nothing."""
    grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    marks = marks_in(grey, FAMILIES[0])
    layout = layout_of(marks) if len(marks) >= LAYOUT_LEAST else None
    if layout is not None and (board.kind != "charuco" or layout != (board.columns, board.rows)):
        return _charuco_words(layout, board)
    if board.kind == "charuco":
        if len(marks_in(np.ascontiguousarray(grey[:, ::-1]), FAMILIES[0])) >= MARKERS_LEAST > len(marks):
            return "the picture is mirrored: turn mirroring off in the camera"
        for family in FAMILIES[1:]:
            if len(marks_in(grey, family)) >= MARKERS_LEAST:
                return f"its markers are of {family[5:]}, and scanmap reads 4X4 ones: print one with scanmap board"
    grid = find_part(grey, thorough=True)
    if grid is None and marks:
        return f"only single markers are in sight ({', '.join(str(n) for n in sorted(marks)[:6])}), no board"
    if grid is None:
        return ""
    across, down = grid.wide().shape
    if board.kind == "charuco":
        return (
            f"a plain chessboard of {across}x{down} inner corners is in sight: use "
            f"--board chessboard:{across}x{down}:{1e3 * board.square_m:g}mm"
        )
    return (
        "" if across <= max(board.corners) and down <= min(board.corners) else _chessboard_words((across, down), board)
    )


def layout_of(marks: dict[int, Array]) -> Layout | None:
    """Columns, and rows as far as markers are seen, of the ChArUco board on which markers with these numbers lie so.

    Markers are counted row by row on the light squares; the first square is dark (OpenCV since 4.6).
    """
    numbers = np.array(sorted(marks))
    centres = np.array([marks[int(number)].mean(axis=0) for number in numbers])
    best, most = None, LAYOUT_LEAST - 1
    for columns in range(3, SQUARES_MOST + 1):
        cells = np.argwhere(np.indices((2 * int(numbers.max()) // columns + 3, columns)).sum(axis=0) % 2 == 1)
        if numbers.max() >= len(cells):
            continue
        flat = cells[numbers][:, ::-1].astype(np.float64)
        H, _ = cv2.findHomography(centres, flat, cv2.RANSAC, LAYOUT_OFF)
        if H is None or np.linalg.matrix_rank(np.c_[flat - flat[0]]) < 2:
            continue
        off = np.linalg.norm(cv2.perspectiveTransform(centres[:, None], H)[:, 0] - flat, axis=1)
        count = int((off < LAYOUT_OFF).sum())
        # Counted in a wrong width a few markers lie right by chance.
        if count > most and count >= 0.8 * len(numbers):
            best, most = Layout(columns, int(flat[:, 1].max()) + 1), count
    return best


def wrong_size(board: Board, views: Sequence[View], rejected: Sequence[Rejected]) -> str:
    """Why the board in the pictures is not the chessboard that was named, and what it is; empty if it may be.

    Parts of a board count for less than a whole one: nobody knows what is cut off. Without any picture of the whole
    board, what is there may be a smaller one.
    """
    whole = sum(view.part is None for view in views)
    larger = Counter(each.other for each in rejected if each.other is not None)
    if sum(larger.values()) > whole:
        return _chessboard_words(_largest(larger), board, larger.total())
    if whole or not views:
        return ""
    parts = Counter((max(view.part), min(view.part)) for view in views if view.part is not None)
    size = _largest(parts)
    if parts[size] >= 3 and 2 * parts[size] >= len(views):
        return _chessboard_words(size, board, parts[size])
    return (
        f"no picture shows all of {board.name}, at most {size[0]}x{size[1]} inner corners: show all of it once, or use "
        f"--board {_named(size, board)} if that is all it has"
    )


def rows_too_many(board: Board, views: Sequence[View], size: tuple[int, int]) -> str:
    """Why a ChArUco board has fewer rows than was named; empty if it may have them.

    Its markers are counted row by row, so a shorter print looks like a board whose last rows never show. That they
    are cut off or covered in every picture is unlikely where their places lie within the pictures (W, H).
    """
    if board.kind != "charuco" or not views:
        return ""
    across, down = board.corners
    last = max(int(view.ids.max()) for view in views) // across
    if last + 1 >= down:
        return ""
    places = board.points[(last + 1) * across : (last + 2) * across, :2][:, None]
    missed = 0
    for view in views:
        H, _ = cv2.findHomography(board.points[view.ids, :2], view.corners)
        next_row = cv2.perspectiveTransform(places, H)[:, 0] if H is not None else np.full((across, 2), np.nan)
        inside = ((next_row > 0) & (next_row < np.array(size) - 1)).all(axis=1)
        missed += bool(inside.all()) and int((view.ids // across == last).sum()) > across // 2
    if missed < MISSED_LEAST:
        return ""
    return (
        f"no picture shows more than {last + 2} rows of squares of {board.name}, and {missed} have room for them: use "
        f"--board {_named((board.columns, last + 2), board)} if that is all it has, else show all of it once"
    )


def _largest(sizes: Counter[tuple[int, int]]) -> tuple[int, int]:
    """The largest size that is no single find, if there is one."""
    often = [size for size, count in sizes.items() if count >= 2] or list(sizes)
    return max(often, key=lambda size: (size[0] * size[1], sizes[size]))


def _named(size: tuple[int, int], board: Board) -> str:
    return replace(board, columns=size[0], rows=size[1]).name


def _chessboard_words(size: tuple[int, int], board: Board, count: int = 1) -> str:
    pictures = f" ({count} pictures)" if count > 1 else ""
    return (
        f"the board in the pictures has {size[0]}x{size[1]} inner corners{pictures}, not "
        f"{board.columns}x{board.rows}: use --board {_named(size, board)}"
    )


def _charuco_words(layout: Layout, board: Board) -> str:
    columns, rows = layout
    marker = board.marker_m or 0.7 * board.square_m
    name = replace(board, kind="charuco", columns=columns, rows=rows, marker_m=marker).name
    if board.kind == "chessboard":
        return (
            f"a ChArUco board is in sight, {columns} squares wide and at least {rows} high: use --board such as {name}"
        )
    return (
        f"the board in the pictures is {columns} squares wide and at least {rows} high, not "
        f"{board.columns}x{board.rows}: use --board {name} (count the squares)"
    )
