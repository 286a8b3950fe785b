"""Pictures of hard frames with the found line drawn in: docs/img/hard-frames.jpg and docs/img/pairs.jpg.

Run: python benchmarks/hard_frames.py [--pairs FOLDER]

Each panel shows a picture twice, as the camera gave it and with the found line in cyan; rows without a point carry an
orange tick at the panel's edge. The twin's frames come from its furnished room with the window shining, the others from
tests/synthetic_lines.py; the pairs are photographs of laser-range-finder (MIT), turned so that the line stands upright.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from line_pairs import pair  # noqa: E402
from synthetic_lines import hard_frame  # noqa: E402

from scanmap.calibration import Calibration, CalibrationFile, HeadTable, ImageTable  # noqa: E402
from scanmap.laserline import LaserLineParams, find_laser_line  # noqa: E402
from scanmap.shot import decode_image  # noqa: E402
from scanmap.triangulation import TriangulationParams, column_window  # noqa: E402
from scanmap.twin import LightParams, TwinCamera, TwinParams, build_scene  # noqa: E402

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]
LINE, MISSING = (255, 255, 0), (0, 140, 255)
PANEL = 330  # [px] square

# Name, and whether in colour.
SYNTHETIC = (
    ("stripes", True, "red and white stripes, no off frame"),
    ("red spines", True, "red spines as high as the line, no off frame"),
    ("white text", True, "white text, no off frame"),
    ("tube of light", True, "a tube of light, no off frame"),
    ("white text", False, "white text in grey, no off frame"),
    ("tube of light", False, "a tube of light in grey, no off frame"),
    ("reflection", True, "a second reflection, no off frame"),
    ("saturated white", True, "a core saturated white, no off frame"),
    ("steps", True, "depth edges, no off frame"),
    ("broken", True, "black things swallow the line"),
)
# Bearing [deg], picture rows and columns, and what is to be seen.
TWIN = (
    (100.0, (150, 750), "window and armchair of black cloth"),
    (58.0, (300, 900), "glossy black screen, table, wall behind"),
)


class Panel(NamedTuple):
    """One picture and its line."""

    image: U8  # (h, w, 3) BGR
    column: F64  # (h,) NaN where none
    text: str


def synthetic() -> Iterator[Panel]:
    """The hard frames of the tests, cut to the surroundings of their line."""
    for name, colour, text in SYNTHETIC:
        frame = hard_frame(name, colour=colour)
        line = find_laser_line(frame.image, LaserLineParams())
        image = frame.image if colour else cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR)
        yield _around(np.asarray(image, np.uint8), line.column_px, frame.truth, text, slice(60, 540), 480)


def twin() -> Iterator[Panel]:
    """Frames of the furnished room by day, without off frames."""
    table = HeadTable(baseline_m=0.08, beta_deg=25.7, alpha_deg=32.3)
    head: Calibration = CalibrationFile(image=ImageTable(width=1600, height=1200), head=table).build()
    light = LightParams(window=True)
    params = TwinParams(light=light)
    state = [0.0]
    camera = TwinCamera(build_scene(params, light), head, params, lambda: (state[0], True))
    window = column_window(head, TriangulationParams())
    for bearing, (top, bottom), text in TWIN:
        state[0] = float(np.radians(bearing))
        image = np.asarray(decode_image(camera.grab().image).image, np.uint8)
        line = find_laser_line(image, LaserLineParams(pool_rows=9), None, window)
        yield _around(image, line.column_px, line.column_px, text, slice(top, bottom), bottom - top)


def pairs(folder: Path) -> Iterator[Panel]:
    """Photographs with their off frames."""
    for number, text in ((1, "exposure changed"), (7, "shoe, box, brush"), (8, "lamp"), (10, "lamp, bright")):
        on, off = pair(folder, number)
        line = find_laser_line(on, LaserLineParams(), off)
        yield Panel(on[:, 40:200], line.column_px - 40, f"pair {number}: {text}, with an off frame")


def _around(image: U8, column: F64, truth: F64, text: str, rows: slice, width: int) -> Panel:
    left = int(np.clip(np.nanmedian(truth[rows]) - width / 2, 0, image.shape[1] - width))
    return Panel(image[rows, left : left + width], column[rows] - left, text)


def drawn(panel: Panel) -> U8:
    """The picture and the picture with its line side by side, under the text."""
    height, width = panel.image.shape[:2]
    scale = PANEL / height
    size = (round(width * scale), PANEL)
    plain = cv2.resize(panel.image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)
    marked = plain.copy()
    for y in range(PANEL):
        column = panel.column[min(int(y / scale), height - 1)]
        if np.isfinite(column):
            x = round((column + 0.5) * scale)
            cv2.line(marked, (x - 1, y), (x, y), LINE, 1)
        else:
            marked[y, :6] = MISSING
    both = np.hstack([plain, np.full((PANEL, 4, 3), 255, np.uint8), marked])
    head = np.full((24, both.shape[1], 3), 255, np.uint8)
    cv2.putText(head, panel.text, (2, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return np.asarray(cv2.copyMakeBorder(np.vstack([head, both]), 4, 4, 6, 6, cv2.BORDER_CONSTANT, value=(255,) * 3))


def sheet(panels: list[Panel], across: int, path: Path) -> None:
    """All panels in rows of `across` as one picture."""
    tiles = [drawn(panel) for panel in panels]
    width = max(tile.shape[1] for tile in tiles)
    tiles = [cv2.copyMakeBorder(t, 0, 0, 0, width - t.shape[1], cv2.BORDER_CONSTANT, value=(255,) * 3) for t in tiles]
    blank = np.full_like(tiles[0], 255)
    tiles += [blank] * (-len(tiles) % across)
    rows = [np.hstack(tiles[k : k + across]) for k in range(0, len(tiles), across)]
    cv2.imwrite(str(path), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])
    print(path)


def main() -> None:
    """Draw both sheets; the pairs only where their folder is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = ROOT.parent / "shared" / "data" / "real" / "laser-range-finder" / "images"
    parser.add_argument("--pairs", type=Path, default=default, help="images of laser-range-finder")
    options = parser.parse_args()
    folder = ROOT / "docs" / "img"
    sheet([*twin(), *synthetic()], 2, folder / "hard-frames.jpg")
    if options.pairs.is_dir():
        sheet(list(pairs(options.pairs)), 4, folder / "pairs.jpg")


if __name__ == "__main__":
    main()
