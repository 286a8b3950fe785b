"""`scanmap board`: boards to print, true to scale, with rulers that tell whether the printer kept to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import ConfigError
from scanmap.solvers.board import Board

MM_PER_INCH = 25.4
# [mm] paper, portrait.
PAPERS = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
# What most printers leave white.
PRINTER_MARGIN_MM = 6.0
RULER_MM = 100.0
RULER_SPACE_MM = 16.0
PNG_DPI = 300

Rectangle = tuple[float, float, float, float]  # left, bottom, width, height [mm]


def draw_sheet(board: Board, path: Path, paper: str = "a4") -> None:
    """Write a board as PDF (vector) or PNG (300 dpi), with rulers of 100 mm along two edges.

    Args:
        board: what to draw; centred on the paper, lying if it does not fit standing.
        path: .pdf or .png.
        paper: one of PAPERS.

    Raises:
        ConfigError: another suffix, a paper that is too small, or the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if path.is_dir():
        raise ConfigError(f"--out {path} is a folder; give the name of a .pdf or .png in it")
    if path.suffix.lower() not in (".pdf", ".png"):
        raise ConfigError(f"--out {path}: a board is written as .pdf or .png; try {path.with_suffix('.pdf')}")
    width, height = _paper_for(board, paper)
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, width), ylim=(0.0, height))
    axes.axis("off")
    left, bottom = _corner(board, (width, height))
    _fill(axes, [(left + x, bottom + y, w, h) for x, y, w, h in black_parts(board)])
    _draw_rulers(axes, board, (left, bottom))
    # Metadata that changes would make two prints of one board differ.
    metadata: dict[str, Any] = {"Title": board.name}
    if path.suffix.lower() == ".pdf":
        metadata.update(CreationDate=None, Producer=None)
    try:
        figure.savefig(path, dpi=PNG_DPI, metadata=metadata)
    except OSError as error:
        raise ConfigError(f"--out {path} cannot be written: {error.strerror}") from error


def black_parts(board: Board) -> list[Rectangle]:
    """Black rectangles of a board [mm], from its lower left corner; markers bit by bit."""
    across, down = board.squares
    side = 1e3 * board.square_m
    # The first square of a chessboard is black, that of a ChArUco board in OpenCV's numbering too.
    black = [
        (x * side, (down - 1 - y) * side, side, side) for y in range(down) for x in range(across) if (x + y) % 2 == 0
    ]
    if board.kind == "charuco":
        pattern = board.charuco()
        marker = 1e3 * board.marker_m
        for corners, number in zip(pattern.getObjPoints(), np.asarray(pattern.getIds()).ravel(), strict=True):
            at_x, at_y = 1e3 * float(np.min(corners[:, 0])), 1e3 * float(np.min(corners[:, 1]))
            bits = _bits(pattern.getDictionary(), int(number))
            bit = marker / len(bits)
            black += [
                (at_x + k * bit, down * side - at_y - (j + 1) * bit, bit, bit)
                for j, row in enumerate(bits)
                for k, white in enumerate(row)
                if not white
            ]
    return black


def _bits(dictionary: Any, number: int) -> NDArray[np.bool_]:
    """Bits of a marker with its black border, True white."""
    size = int(dictionary.markerSize) + 2
    return np.asarray(dictionary.generateImageMarker(number, size, borderBits=1)) > 127


def _paper_for(board: Board, paper: str) -> tuple[float, float]:
    if paper not in PAPERS:
        raise ConfigError(f"--paper {paper}: no size I know; choose {', '.join(PAPERS)}")
    across, down = (1e3 * board.square_m * n for n in board.squares)
    need = across + 2 * PRINTER_MARGIN_MM + RULER_SPACE_MM, down + 2 * PRINTER_MARGIN_MM + RULER_SPACE_MM
    for width, height in (PAPERS[paper], PAPERS[paper][::-1]):
        if need[0] <= width and need[1] <= height:
            return width, height
    fits = next((name for name, size in PAPERS.items() if max(need) <= max(size) and min(need) <= min(size)), "")
    advice = f"--paper {fits}" if fits else "smaller squares"
    raise ConfigError(
        f"{board.name} needs {need[0]:.0f} x {need[1]:.0f} mm with its rulers, which does not fit on {paper}; "
        f"try {advice}"
    )


def _corner(board: Board, paper: tuple[float, float]) -> tuple[float, float]:
    """Lower left corner of the board on the paper [mm]: centred in what the rulers leave."""
    across, down = (1e3 * board.square_m * n for n in board.squares)
    return (paper[0] - across + RULER_SPACE_MM) / 2, (paper[1] - down + RULER_SPACE_MM) / 2


def _fill(axes: Any, rectangles: list[Rectangle]) -> None:
    from matplotlib.collections import PolyCollection

    corners = [[(x, y), (x + w, y), (x + w, y + h), (x, y + h)] for x, y, w, h in rectangles]
    # Without antialiasing no hairline shows between two bits.
    axes.add_collection(PolyCollection(corners, facecolors="black", edgecolors="none", antialiaseds=False))


def _draw_rulers(axes: Any, board: Board, corner: tuple[float, float]) -> None:
    """A ruler along x and one along y: a printer may stretch one direction only."""
    left, bottom = corner
    length = RULER_MM if 1e3 * board.square_m * min(board.squares) >= RULER_MM else 50.0
    for along_x in (True, False):
        for mm in range(int(length) + 1):
            tick = 5.0 if mm % 10 == 0 else 3.5 if mm % 5 == 0 else 2.0
            near = -4.0
            x, y = (left + mm, bottom + near) if along_x else (left + near, bottom + mm)
            dx, dy = (0.0, -tick) if along_x else (-tick, 0.0)
            axes.plot([x, x + dx], [y, y + dy], color="black", lw=0.3, solid_capstyle="butt")
            if mm % 20 == 0:
                axes.text(x + 1.3 * dx, y + 1.3 * dy, str(mm), fontsize=5, ha="center" if along_x else "right",
                          va="top" if along_x else "center")  # fmt: skip
    words = f"{board.name}: print at 100 %, measure both rulers ({length:.0f} mm) and a row of squares"
    axes.text(left + length + 6.0, bottom - 6.0, words, fontsize=5, va="top", wrap=True)
