"""`Board`: a flat printed pattern of known size, and the name it has on the command line."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import ConfigError

Array = NDArray[np.float64]

FORMS = (
    "chessboard:8x6:40mm (inner corners, side of a square) or "
    "charuco:7x5:30mm:22mm (squares, side of a square, side of a marker)"
)
_NAME = re.compile(r"(chessboard|charuco):(\d+)x(\d+):([\d.]+)(mm|cm|m)(?::([\d.]+)(mm|cm|m))?")
_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
# Markers of 4x4 bits are the largest at a given board, so they are read from farthest away.
_DICTIONARIES = (50, 100, 250, 1000)


@dataclass(frozen=True)
class Board:
    """A chessboard or a ChArUco board.

    Its frame: x along the columns, y along the rows, z away from who looks at it; the origin is the first inner
    corner of a chessboard, and the outer corner of the first square of a ChArUco board.
    """

    kind: Literal["chessboard", "charuco"]
    columns: int  # inner corners of a chessboard, squares of a ChArUco board
    rows: int
    square_m: float
    marker_m: float = 0.0

    @property
    def name(self) -> str:
        """As `--board` takes it."""
        marker = f":{1e3 * self.marker_m:g}mm" if self.kind == "charuco" else ""
        return f"{self.kind}:{self.columns}x{self.rows}:{1e3 * self.square_m:g}mm{marker}"

    @property
    def corners(self) -> tuple[int, int]:
        """Inner corners along columns and rows."""
        less = 1 if self.kind == "charuco" else 0
        return self.columns - less, self.rows - less

    @property
    def squares(self) -> tuple[int, int]:
        """Squares along columns and rows."""
        across, down = self.corners
        return across + 1, down + 1

    @cached_property
    def points(self) -> Array:
        """(N, 3) inner corners in the board's frame [m], row by row."""
        across, down = self.corners
        first = self.square_m if self.kind == "charuco" else 0.0
        x, y = np.meshgrid(first + self.square_m * np.arange(across), first + self.square_m * np.arange(down))
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)

    def outline(self, margin_m: float = 0.0) -> Array:
        """(4, 3) outer corners of the squares, moved out by `margin_m` [m], clockwise as seen."""
        first = 0.0 if self.kind == "charuco" else -self.square_m
        across, down = self.squares
        low = first - margin_m
        right, bottom = first + across * self.square_m + margin_m, first + down * self.square_m + margin_m
        return np.array([[low, low, 0.0], [right, low, 0.0], [right, bottom, 0.0], [low, bottom, 0.0]])

    def charuco(self) -> Any:
        """OpenCV's board of the same kind; its markers are the first of the 4x4 dictionary that has enough."""
        import cv2

        needed = self.columns * self.rows // 2
        size = next(size for size in _DICTIONARIES if size >= needed)
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_4X4_{size}"))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, dictionary)


def parse_board(name: str) -> Board:
    """The board of a name such as `chessboard:8x6:40mm`.

    Raises:
        ConfigError: not of that form, or no board that could be printed and found.
    """
    match = _NAME.fullmatch(name.strip().lower())
    if match is None:
        raise ConfigError(f"--board {name}: not the name of a board; write {FORMS}")
    kind, columns, rows, square, unit, marker, marker_unit = match.groups()
    try:
        sides = float(square) * _METRES[unit], float(marker) * _METRES[marker_unit] if marker else 0.0
    except ValueError as error:
        raise ConfigError(f"--board {name}: {error}; write {FORMS}") from error
    board = Board("charuco" if kind == "charuco" else "chessboard", int(columns), int(rows), *sides)
    fault = _fault(board, has_marker=marker is not None)
    if fault:
        raise ConfigError(f"--board {name}: {fault}; write {FORMS}")
    return board


def _fault(board: Board, *, has_marker: bool) -> str:
    if not (min(board.corners) >= 3 and max(board.corners) <= 40):
        return f"{board.corners[0]}x{board.corners[1]} inner corners; 3 to 40 each way can be found"
    if not 1e-3 <= board.square_m <= 1.0:
        return f"a square of {1e3 * board.square_m:g} mm; 1 mm to 1 m makes sense"
    if board.kind == "chessboard":
        return "a chessboard has no markers" if has_marker else ""
    if not 0.3 * board.square_m <= board.marker_m <= 0.9 * board.square_m:
        return (
            f"markers of {1e3 * board.marker_m:g} mm in squares of {1e3 * board.square_m:g} mm; 30 to 90 % can be read"
        )
    return ""
