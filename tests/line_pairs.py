"""Where the laser line is in the ten pairs of photographs of `laser-range-finder`, marked by eye.

The line lies level in these pictures: per pair, pieces of (column, row) corners between which it can be seen.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

U8 = NDArray[np.uint8]

PIECES: dict[int, tuple[tuple[tuple[int, int], ...], ...]] = {
    1: (((80, 143), (150, 142)), ((166, 147), (191, 146)), ((198, 141), (224, 141), (234, 144), (319, 144))),
    2: (((42, 144), (165, 140)), ((175, 145), (228, 145)), ((232, 141), (319, 144))),
    3: (((0, 111), (17, 112)), ((21, 117), (74, 117)), ((95, 84), (150, 81), (232, 85)), ((236, 116), (319, 116))),
    4: (((0, 111), (17, 112)), ((20, 116), (55, 116)), ((57, 100), (319, 99))),
    5: (
        ((8, 101), (46, 102)), ((52, 98), (80, 101)), ((84, 102), (107, 104)), ((110, 105), (172, 108)),
        ((174, 110), (197, 112)), ((265, 98), (285, 98)), ((288, 117), (319, 116)),
    ),
    6: (
        ((8, 101), (46, 102)), ((53, 98), (81, 101)), ((86, 102), (107, 103)), ((110, 105), (156, 106), (190, 111)),
        ((265, 98), (285, 98)), ((288, 117), (319, 116)),
    ),
    7: (
        ((8, 101), (47, 102)), ((52, 98), (82, 101)), ((85, 102), (130, 105)), ((133, 105), (145, 106)),
        ((172, 108), (180, 109)), ((188, 111), (197, 112)), ((265, 98), (285, 97)), ((300, 116), (319, 116)),
    ),
    8: (
        ((0, 111), (22, 112)), ((24, 116), (88, 116)), ((112, 110), (124, 110)), ((178, 110), (208, 108), (226, 110)),
        ((288, 117), (319, 116)),
    ),
    9: (
        ((0, 111), (22, 112)), ((24, 116), (92, 117)), ((110, 110), (122, 110)), ((178, 110), (206, 108), (226, 110)),
        ((287, 117), (319, 116)),
    ),
    10: (
        ((0, 111), (22, 112)), ((24, 116), (90, 116)), ((102, 110), (106, 110)), ((112, 110), (122, 110)),
        ((180, 110), (190, 110)), ((195, 109), (212, 108)), ((223, 110), (230, 110)), ((300, 116), (319, 116)),
    ),
}  # fmt: skip


def marked(number: int) -> NDArray[np.float64]:
    """Row (320,) of the line in each column of a pair's pictures; NaN where it cannot be seen."""
    row = np.full(320, np.nan)
    for piece in PIECES[number]:
        x, y = np.array(piece, np.float64).T
        columns = np.arange(int(x[0]), int(x[-1]) + 1)
        row[columns] = np.interp(columns, x, y)
    return row


def pair(folder: Path, number: int) -> tuple[U8, U8]:
    """Laser on and off, (320, 240, 3) BGR: transposed, so that the line stands upright."""
    images = (cv2.imread(str(next((folder / f"sample{number}").glob(f"sample{number}-{which}-0*")))) for which in "ba")
    on, off = (np.ascontiguousarray(np.asarray(image, np.uint8).transpose(1, 0, 2)) for image in images)
    return on, off
