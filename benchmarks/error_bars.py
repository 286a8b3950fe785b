"""Whether sigma_px says how far a line's columns are off in pictures that went through JPEG.

    python benchmarks/error_bars.py [--frames 1000]

Frames of 320 rows drawn at random: quality 75 to 95, 4:4:4, 4:2:2 or 4:2:0, red or green laser, height 30 to 1000 grey
levels (from about 240 they saturate), sigma 1 to 4 px, noise 1 to 6, half of them through a tone curve; a third of the
lines upright, a third leaning by 0.002 to 0.03 columns a row, a third slanted by 0.08 to 0.3. z is the root mean square
of error over sigma_px, each row by itself and pooled over nine; beside it z where the file's own rounding is kept from
the detector.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import LaserLineParams, find_laser_line, rounding_of

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from synthetic_lines import GREEN, RED
from test_laserline_rounding import SAMPLING, drawn, encoded, opened

F64 = NDArray[np.float64]
Frame = dict[str, float | str]

ROWS = 320
LEAN = {"upright": (0.0, 0.0), "leaning": (0.002, 0.03), "slanted": (0.08, 0.3)}
BANDS = {
    "quality": (75, 80, 85, 90, 96),
    "height": (30, 50, 85, 140, 240, 500, 1000),
    "sigma": (1, 1.5, 2, 3, 4),
    "noise": (1, 1.8, 3.3, 6),
}


def measured(rng: np.random.Generator) -> Frame:
    """A frame, what it is, and mean squares of error over sigma_px."""
    how = str(rng.choice(list(LEAN)))
    lean = rng.choice([-1.0, 1.0]) * rng.uniform(*LEAN[how])
    frame: Frame = {
        "quality": float(rng.integers(75, 96)), "height": float(np.exp(rng.uniform(*np.log([30, 1000])))),
        "sigma": rng.uniform(1, 4), "noise": float(np.exp(rng.uniform(0, np.log(6)))),
        "sampling": str(rng.choice(list(SAMPLING))), "line": how,
    }  # fmt: skip
    column = rng.uniform(128.0, 160.0) + lean * (np.arange(ROWS) - ROWS / 2)
    shape = float(frame["height"]), float(frame["sigma"]), float(frame["noise"])
    pixels = drawn(rng, column, *shape, (RED, GREEN)[rng.integers(2)], bool(rng.integers(2)))
    data = encoded(pixels, int(frame["quality"]), str(frame["sampling"]))
    image, rounding = opened(data), rounding_of(data)
    for name, rows, told in (("alone", 0, rounding), ("pooled", 9, rounding), ("blind", 0, None), ("both", 9, None)):
        line = find_laser_line(image, LaserLineParams(pool_rows=rows), rounding=told)
        off = line.column_px - column
        # Rows that were not found at all are another matter.
        known = np.abs(off) <= 1.0 + 6.0 * line.sigma_px
        off, sigma = (off[known], line.sigma_px[known]) if known.any() else (np.full(1, np.nan), np.ones(1))
        frame[name] = float(np.mean(np.square(off / sigma)))
        frame[f"{name} px"] = float(np.mean(np.square(off)))
    return frame


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=1000)
    cv2.setNumThreads(1)
    frames = [measured(np.random.default_rng(k)) for k in range(parser.parse_args().frames)]
    print(f"{'line':8s} {'frames':20s} {'n':>5s} | alone  z     px | pooled z     px | untold: alone z, pooled z")
    for line in LEAN:
        row(line, "all", frames, lambda frame: True)
        for name in SAMPLING:
            row(line, f"4:{name[1]}:{name[2]}", frames, lambda frame, name=name: frame["sampling"] == name)
        for what, limits in BANDS.items():
            for low, high in pairwise(limits):
                label = f"{what} {low:g} to {high:g}"
                row(line, label, frames, lambda f, what=what, low=low, high=high: low <= float(f[what]) < high)


def row(line: str, label: str, frames: list[Frame], chosen: Callable[[Frame], bool]) -> None:
    """Print one line of the table."""
    some = [frame for frame in frames if frame["line"] == line and chosen(frame)]
    z = {
        name: float(np.sqrt(np.nanmean([float(frame[name]) for frame in some])))
        for name in ("alone", "alone px", "pooled", "pooled px", "blind", "both")
    }
    print(f"{line:8s} {label:20s} {len(some):5d} | {z['alone']:6.2f} {z['alone px']:8.4f} | {z['pooled']:6.2f} "
          f"{z['pooled px']:8.4f} | {z['blind']:6.2f} {z['both']:6.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
