"""Accuracy and CPU time of the laser line on frames with known truth, beside the bound and the textbook's methods.

    python benchmarks/laserline.py [--seeds 10] [--only NAME ...] [--no-textbook] [--no-hard]

1600x1200, Gaussian line on a background of 10 grey levels, a curve with slopes up to 0.68 px a row, 8 bit. The bound
is the Cramer-Rao bound of one row, 1.062 sqrt(sigma) s_n / A for a whole line, with rounding to grey levels counted
as noise of 1/12. Times are CPU time of one thread (the fastest of five calls, median over the frames).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import LaserLineParams, Rounding, find_laser_line, rounding_of

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from synthetic_lines import HARD, RED, LineSpec, bound, clean, hard_frame, score

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]


@dataclass(frozen=True)
class Case:
    """A frame, how the line is looked for, and what is asked for."""

    spec: LineSpec
    pool_rows: int = 0
    window: bool = False
    jpeg: tuple[int, str] | None = None  # quality and colour resolution that the frame goes through
    limit_px: float | None = None
    limit_ms: float | None = None

    @property
    def params(self) -> LaserLineParams:
        """The detector's parameters."""
        return LaserLineParams(pool_rows=self.pool_rows)

    @property
    def window_px(self) -> F64 | None:
        """(H, 2) as a calibration would give it, or None."""
        return np.tile([180.0, 900.0], (self.spec.height, 1)) if self.window else None


PLAIN = LineSpec()
CASES = {
    "default": Case(PLAIN, limit_px=0.0232, limit_ms=4.0),
    "default, window": Case(PLAIN, window=True, limit_px=0.0232, limit_ms=2.5),
    "default, BGR": Case(replace(PLAIN, colour=RED), limit_px=0.0232),
    "default, BGR, window": Case(replace(PLAIN, colour=RED), window=True, limit_px=0.0232),
    "pooled": Case(PLAIN, pool_rows=9, limit_px=0.012, limit_ms=5.0),
    "pooled, window": Case(PLAIN, pool_rows=9, window=True, limit_px=0.012, limit_ms=5.0),
    "steps of 60 px": Case(replace(PLAIN, step_px=60.0), limit_px=0.0232),
    "steps of 60 px, pooled": Case(replace(PLAIN, step_px=60.0), pool_rows=9, limit_px=0.012, limit_ms=5.0),
    "sigma 1": Case(replace(PLAIN, sigma=1.0)),
    "sigma 3": Case(replace(PLAIN, sigma=3.0)),
    "sigma 4": Case(replace(PLAIN, sigma=4.0)),
    "peak 40": Case(replace(PLAIN, peak=40.0)),
    "saturated, peak 510": Case(replace(PLAIN, peak=510.0), limit_px=0.018),
    "saturated, peak 510, pooled": Case(replace(PLAIN, peak=510.0), pool_rows=9),
    "speckle 0.3": Case(replace(PLAIN, speckle=0.3), limit_px=0.145),
    "speckle 0.3, pooled": Case(replace(PLAIN, speckle=0.3), pool_rows=9),
    "peak 30, noise 6": Case(replace(PLAIN, peak=30.0, noise=6.0)),
    "peak 230, noise 1": Case(replace(PLAIN, peak=230.0, noise=1.0)),
    "sigma 1, peak 30": Case(replace(PLAIN, sigma=1.0, peak=30.0)),
    "sigma 4, peak 100, noise 6": Case(replace(PLAIN, sigma=4.0, peak=100.0, noise=6.0)),
    "sigma 1, saturated": Case(replace(PLAIN, sigma=1.0, peak=510.0)),
    "sigma 4, saturated, noise 6": Case(replace(PLAIN, sigma=4.0, peak=400.0, noise=6.0)),
}
CASES |= {
    f"JPEG {quality} {sampling}, {name}{', pooled' if rows else ''}": Case(
        replace(PLAIN, colour=colour), pool_rows=rows, jpeg=(quality, sampling)
    )
    for quality, sampling, name, colour in (
        (85, "422", "grey", None),
        (85, "422", "BGR", RED),
        (85, "420", "BGR", RED),
        (95, "422", "BGR", RED),
    )
    for rows in (0, 9)
}
TEXTBOOK_CASES = ("default", "peak 40", "saturated, peak 510", "speckle 0.3", "steps of 60 px")


def brightest(image: U8) -> F64:
    """The thesis: first maximum of the row."""
    return image.argmax(axis=1).astype(np.float64)


def around(image: U8, middle: F64, reach: int) -> NDArray[np.float32]:
    """Samples (H, 2 reach + 1) around integer columns."""
    x = np.clip(middle.astype(np.intp)[:, None] + np.arange(-reach, reach + 1), 0, image.shape[1] - 1)
    return image[np.arange(len(image))[:, None], x].astype(np.float32)


def centre_of_gravity(image: U8) -> F64:
    """Centre of gravity of +-6 px around the maximum, above the row's median."""
    middle = brightest(image)
    y = np.maximum(around(image, middle, 6) - np.median(image[:, ::8], axis=1, keepdims=True), 0.0)
    return middle + y @ np.arange(-6.0, 7.0) / np.maximum(y.sum(axis=1), 1e-6)


def gaussian_derivative(image: U8) -> F64:
    """Zero of the row's derivative after a Gaussian of 2 px, next to the maximum, by linear interpolation."""
    x = np.arange(-8.0, 9.0)
    kernel = (-x * np.exp(-0.5 * (x / 2.0) ** 2)).astype(np.float32)
    middle = brightest(cv2.blur(image, (5, 1)))
    y = around(image, middle, 12)
    slope = np.stack([y[:, k : k + 17] @ kernel for k in range(9)], axis=1)  # at -4 .. 4
    falls = (slope[:, :-1] < 0) & (slope[:, 1:] >= 0)
    falls[:, [0, -1]] |= ~falls.any(axis=1, keepdims=True)
    distance = np.where(falls, np.abs(np.arange(8) - 3.5), 99.0)
    at = distance.argmin(axis=1)
    row = np.arange(len(image))
    before, after = slope[row, at], slope[row, at + 1]
    step = np.where(after > before, -before / np.where(after > before, after - before, 1.0), 0.5)
    return middle - 4.0 + at + np.clip(step, 0.0, 1.0)


def log_parabola(image: U8) -> F64:
    """Vertex of a parabola through the logarithms of +-3 px, weighted by their squares (Caruana 1986, Guo 2011)."""
    middle = brightest(cv2.blur(image, (5, 1)))
    y = np.maximum(around(image, middle, 3) - np.median(image[:, ::8], axis=1, keepdims=True), 1.0).astype(np.float64)
    x = np.arange(-3.0, 4.0)
    w = y * y
    s0, s1, s2, s3, s4 = (w @ x**k for k in range(5))
    t0, t1, t2 = ((w * np.log(y)) @ x**k for k in range(3))
    # Cramer's rule for the two upper coefficients; their common determinant cancels.
    linear = s0 * (t1 * s4 - t2 * s3) - t0 * (s1 * s4 - s2 * s3) + s2 * (s1 * t2 - s2 * t1)
    square = s0 * (s2 * t2 - s3 * t1) - s1 * (s1 * t2 - s2 * t1) + t0 * (s1 * s3 - s2 * s2)
    return middle + np.clip(-0.5 * linear / np.where(square < 0, square, -1e-9), -3.0, 3.0)


TEXTBOOK: dict[str, Callable[[U8], F64]] = {
    "brightest pixel": brightest,
    "centre of gravity +-6": centre_of_gravity,
    "Gaussian-derivative FIR": gaussian_derivative,
    "log-parabola, weighted": log_parabola,
}


def compressed(image: U8, quality: int, sampling: str) -> tuple[U8, Rounding | None]:
    """The frame after JPEG, and what its file says of rounding."""
    factor = {"422": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422, "420": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420}[sampling]
    how = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, factor]
    data = cv2.imencode(".jpg", image, how)[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), np.uint8), rounding_of(data.tobytes())


def cpu_ms(call: Callable[[], object], repeats: int = 5) -> float:
    """CPU time of the fastest call [ms]; the first, which finds cold caches, does not count."""
    call()
    times = []
    for _ in range(repeats):
        start = time.thread_time()
        call()
        times.append(time.thread_time() - start)
    return 1e3 * min(times)


def measure(name: str, case: Case, seeds: int, textbook: bool) -> None:
    """Print one case's line, and the textbook's below it."""
    errors, scaled, times = [], [], []
    others: dict[str, list[F64]] = {other: [] for other in TEXTBOOK}
    others_ms: dict[str, list[float]] = {other: [] for other in TEXTBOOK}
    for seed in range(seeds):
        image, truth = clean(case.spec, np.random.default_rng(seed))
        image, rounding = (image, None) if case.jpeg is None else compressed(image, *case.jpeg)
        look = partial(find_laser_line, image, case.params, window=case.window_px, rounding=rounding)
        line = look()
        times.append(cpu_ms(look))
        errors.append(line.column_px - truth)
        scaled.append(errors[-1] / line.sigma_px)
        for other in TEXTBOOK if textbook else ():
            others[other].append(TEXTBOOK[other](image) - truth)
            others_ms[other].append(cpu_ms(lambda image=image, other=other: TEXTBOOK[other](image), 3))
    least = bound(case.spec)
    asked = ", ".join(f"{value} {unit}" for value, unit in ((case.limit_px, "px"), (case.limit_ms, "ms")) if value)
    print(_row(name, np.concatenate(errors), least, float(np.median(times)), np.concatenate(scaled)) + asked)
    for other in TEXTBOOK if textbook else ():
        print(_row(f"  {other}", np.concatenate(others[other]), least, float(np.median(others_ms[other]))))


def _row(name: str, error: F64, least: float, ms: float, scaled: F64 | None = None) -> str:
    found = np.isfinite(error)
    rms = float(np.sqrt(np.mean(error[found] ** 2)))
    z = f"{np.std(scaled[found]):6.3f}" if scaled is not None else " " * 6
    return (f"{name:30s} {rms:8.4f} {least:8.4f} {rms / least:7.3f} {np.mean(error[found]):8.4f} {found.mean():7.4f} "
            f"{(np.abs(error[found]) > 1.0).sum():6d} {z} {ms:7.2f}  ")  # fmt: skip


def empty_frames(seeds: int) -> None:
    """Print the share of rows in which a line is found where there is none."""
    for noise in (1.0, 3.0, 6.0):
        spec = LineSpec(peak=0.0, noise=noise)
        found = [
            np.isfinite(find_laser_line(clean(spec, np.random.default_rng(seed))[0], LaserLineParams()).column_px)
            for seed in range(seeds)
        ]
        print(f"no line, noise {noise:.0f}: found in {np.mean(found):.5f} of the rows (asked: 0.001)")


def hard_frames(seeds: int) -> None:
    """Print rows found and rows invented in frames with windows, stripes, text, reflections, gaps, halos."""
    print(f"\n{'hard frame':18s} {'BGR':>15s} {'BGR - off':>15s} {'grey':>15s} {'grey - off':>15s}   found/false rows")
    for name in HARD:
        cells = []
        for colour in (True, False):
            for with_off in (False, True):
                results = []
                for seed in range(seeds):
                    frame = hard_frame(name, seed, colour=colour)
                    off = frame.background if with_off else None
                    results.append(score(find_laser_line(frame.image, LaserLineParams(), off).column_px, frame))
                found, false = np.mean(results, axis=0)
                cells.append(f"{'  -   ' if name.startswith('empty') else f'{found:.4f}'}/{false:.4f}".rjust(15))
        print(f"{name:18s} {' '.join(cells)}")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10, help="frames per case")
    parser.add_argument("--only", nargs="*", default=None, help="cases whose name holds one of these")
    parser.add_argument("--no-textbook", action="store_true", help="leave the textbook's methods out")
    parser.add_argument("--no-hard", action="store_true", help="leave the hard frames out")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"{'frame':30s} {'RMS px':>8s} {'bound':>8s} {'ratio':>7s} {'bias':>8s} {'found':>7s} {'> 1 px':>6s} "
          f"{'z std':>6s} {'CPU ms':>7s}  asked")  # fmt: skip
    for name, case in CASES.items():
        if options.only is None or any(part in name for part in options.only):
            measure(name, case, options.seeds, name in TEXTBOOK_CASES and not options.no_textbook)
    if options.only is None:
        empty_frames(max(2, options.seeds // 3))
        if not options.no_hard:
            hard_frames(3)


if __name__ == "__main__":
    main()
