"""Where the laser line is in the photographs of `srv-calib`, marked by eye: hand-held boards before a cabinet.

The rig stood still: beside the board the line falls on the same post and floor in every picture.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

# Rows and columns of the line's ends on the board, by picture. Number 123 shows it on the cabinet alone.
BOARDS: dict[int, tuple[int, int, int, int]] = {
    11: (0, 204, 410, 233), 12: (0, 207, 416, 238), 13: (0, 201, 406, 232), 14: (19, 175, 406, 225),
    15: (0, 142, 309, 178), 16: (106, 147, 283, 168), 17: (103, 146, 284, 165), 18: (37, 139, 335, 178),
    19: (84, 151, 385, 187), 20: (87, 151, 379, 184), 21: (95, 153, 387, 186), 22: (99, 150, 387, 184),
    23: (111, 144, 385, 178), 24: (124, 159, 427, 198), 25: (129, 164, 436, 200), 26: (135, 166, 447, 204),
    27: (136, 172, 460, 210), 28: (130, 177, 467, 217), 29: (120, 181, 471, 223), 30: (115, 184, 473, 226),
    31: (117, 184, 474, 226), 32: (112, 181, 464, 222), 33: (111, 179, 461, 220), 34: (111, 179, 460, 220),
    35: (125, 188, 479, 231), 36: (129, 186, 479, 229), 37: (130, 186, 479, 229), 38: (129, 194, 479, 238),
    39: (132, 199, 479, 241), 40: (138, 206, 479, 246), 41: (126, 214, 479, 252), 42: (130, 223, 479, 259),
    43: (135, 231, 479, 266), 44: (48, 224, 479, 265), 45: (0, 218, 420, 258), 46: (0, 215, 401, 254),
    47: (0, 218, 378, 252), 48: (0, 224, 366, 250), 49: (0, 222, 357, 241), 50: (0, 203, 343, 225),
    51: (0, 196, 333, 220), 52: (0, 192, 336, 218), 53: (0, 189, 359, 218), 54: (0, 178, 346, 208),
    55: (0, 170, 336, 200), 56: (0, 164, 318, 193), 57: (0, 162, 312, 191), 58: (0, 155, 297, 184),
    59: (0, 149, 286, 178), 60: (0, 146, 284, 176), 61: (0, 139, 264, 168), 62: (0, 134, 243, 159),
    63: (0, 135, 211, 156), 64: (0, 134, 196, 153), 65: (0, 132, 148, 146), 66: (0, 129, 126, 139),
    67: (0, 125, 107, 133), 68: (0, 119, 85, 125), 69: (0, 119, 69, 124), 70: (0, 119, 83, 125),
    71: (0, 117, 203, 140), 72: (37, 119, 278, 144), 73: (50, 119, 286, 145), 74: (64, 120, 295, 146),
    75: (109, 123, 338, 152), 76: (146, 128, 369, 155), 77: (186, 131, 406, 161), 78: (233, 136, 458, 173),
    79: (242, 139, 473, 180), 80: (296, 148, 479, 178), 81: (307, 150, 479, 180), 82: (335, 152, 479, 177),
    83: (350, 168, 479, 192), 84: (343, 166, 479, 190), 85: (328, 171, 479, 194), 86: (298, 167, 479, 198),
    87: (278, 163, 479, 199), 88: (259, 164, 479, 205), 89: (241, 164, 479, 209), 90: (227, 164, 479, 208),
    91: (223, 164, 479, 206), 92: (217, 162, 479, 206), 93: (210, 159, 479, 205), 94: (181, 158, 479, 212),
    95: (74, 143, 456, 207), 96: (99, 152, 412, 205), 97: (45, 146, 360, 196), 98: (0, 142, 307, 190),
    99: (0, 144, 285, 188), 100: (0, 149, 284, 192), 101: (0, 170, 333, 217), 102: (0, 182, 382, 238),
    103: (17, 187, 433, 243), 104: (40, 193, 457, 247), 105: (49, 210, 479, 266), 106: (66, 223, 479, 276),
    107: (68, 236, 479, 289), 108: (72, 247, 479, 300), 109: (89, 272, 479, 327), 110: (105, 293, 479, 345),
    111: (30, 245, 479, 318), 112: (0, 228, 479, 300), 113: (0, 226, 479, 298), 114: (0, 218, 474, 294),
    115: (0, 230, 437, 290), 116: (0, 156, 319, 188), 117: (0, 155, 340, 192), 118: (0, 152, 334, 190),
    119: (0, 148, 335, 189), 120: (0, 143, 325, 181), 121: (0, 133, 306, 169), 122: (0, 132, 305, 165),
    124: (0, 128, 312, 163), 125: (0, 127, 312, 161), 126: (0, 122, 288, 155), 127: (0, 105, 183, 120),
    128: (0, 102, 133, 113), 129: (0, 104, 131, 113), 130: (0, 107, 155, 119), 131: (18, 111, 304, 140),
}  # fmt: skip
NUMBERS = (*range(11, 132),)
# Corners of the line on the post, down to row 380, and on the floor.
_POST_ROWS = (0, 40, 100, 160, 220, 264, 300, 348, 380, 396, 408, 420, 432, 444, 456, 470, 479)
_POST_COLUMNS = (
    90.1, 94.7, 101.6, 108.3, 115.6, 120.4, 124.2, 130.0, 133.2, 137.3, 138.8, 140.7, 144.6, 148.6, 152.1, 156.2, 158.0,
)  # fmt: skip
_SEEN = 5.0  # [grey levels] that the line rises by, over both sides, where it can be seen
_AWAY_PX, _TOGETHER_ROWS = 5, 15


def picture(folder: Path, number: int) -> U8:
    """(480, 640, 3) BGR."""
    return np.asarray(cv2.imread(str(folder / f"Image{number}.jpg")), np.uint8)


def marked(number: int) -> F64:
    """Columns (2, 480) of the line by rows, on the board and beside it; NaN where no board is."""
    row = np.arange(480.0)
    columns = np.stack([np.full(480, np.nan), np.interp(row, _POST_ROWS, _POST_COLUMNS)])
    if number in BOARDS:
        first, at_first, last, at_last = BOARDS[number]
        on_board = (row >= first) & (row <= last)
        columns[0, on_board] = np.interp(row[on_board], (first, last), (at_first, at_last))
    return columns


def carrying(image: U8, columns: F64) -> NDArray[np.bool_]:
    """Rows (n, H) in which the picture shows a line at columns (n, H): boards hide the post, white ones the line.

    The line must rise over both its sides in the laser's own green, in the mean of the rows around: too little to be
    found by, and enough to be seen by who knows where it is.
    """
    green = cv2.blur(image[..., 1].astype(np.float32), (3, 1))
    row = np.arange(len(image))
    seen = []
    for line in columns:
        x = np.clip(np.rint(np.nan_to_num(line)), _AWAY_PX + 2, image.shape[1] - _AWAY_PX - 3).astype(np.intp)
        near = x[:, None] + np.arange(-1, 2)
        rise = green[row[:, None], near] - np.maximum(
            green[row[:, None], near - _AWAY_PX], green[row[:, None], near + _AWAY_PX]
        )
        mean = cv2.blur(np.median(rise, axis=1)[:, None], (1, _TOGETHER_ROWS))[:, 0]
        seen.append((mean >= _SEEN) & np.isfinite(line))
    return np.array(seen)
