"""Accuracy and CPU time of the laser line on synthetic frames with known truth, beside the bound.

    python benchmarks/laserline.py [--seeds 10] [--only NAME ...]

1600x1200, Gaussian line on a background of 10 grey levels, a curve with slopes up to 0.68 px a row, 8 bit.
The bound is the Cramer-Rao bound of one row, with rounding to whole grey levels counted as noise.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import LaserLineParams, find_laser_line

HEIGHT, WIDTH = 1200, 1600


@dataclass(frozen=True)
class Frame:
    """What a frame shows."""

    sigma: float = 2.0  # [px]
    peak: float = 200.0  # [grey levels]
    noise: float = 3.0  # [grey levels]
    speckle: float = 0.0  # contrast
    steps: float = 0.0  # [px] of the depth steps every 100 rows
    pool: int = 0
    window: bool = False
    colour: bool = False
    limit_px: float | None = None  # what is asked for
    limit_ms: float | None = None


FRAMES = {
    "default": Frame(limit_px=0.0232, limit_ms=4.0),
    "default, window 180..900": Frame(window=True, limit_px=0.0232, limit_ms=2.5),
    "default, red of BGR": Frame(colour=True, limit_px=0.0232),
    "pooled": Frame(pool=9, limit_px=0.012, limit_ms=5.0),
    "pooled, steps of 60 px": Frame(pool=9, steps=60.0, limit_px=0.012, limit_ms=5.0),
    "steps of 60 px": Frame(steps=60.0),
    "sigma 1": Frame(sigma=1.0),
    "sigma 3": Frame(sigma=3.0),
    "sigma 4": Frame(sigma=4.0),
    "peak 40": Frame(peak=40.0),
    "peak 30, noise 6": Frame(peak=30.0, noise=6.0),
    "peak 250, noise 1": Frame(peak=230.0, noise=1.0),
    "sigma 1, peak 30": Frame(sigma=1.0, peak=30.0),
    "sigma 4, noise 6": Frame(sigma=4.0, noise=6.0, peak=100.0),
    "saturated, peak 510": Frame(peak=510.0, limit_px=0.018),
    "saturated, sigma 1, peak 510": Frame(sigma=1.0, peak=510.0),
    "saturated, sigma 4, peak 400": Frame(sigma=4.0, peak=400.0, noise=6.0),
    "speckle 0.3": Frame(speckle=0.3, limit_px=0.145),
    "speckle 0.3, pooled": Frame(speckle=0.3, pool=9),
}


def truth(frame: Frame) -> NDArray[np.float64]:
    """Columns (H,) of the line."""
    row = np.arange(HEIGHT)
    column = 520.0 + 130.0 * np.sin(2.0 * np.pi * row / HEIGHT) + 0.37
    return column + frame.steps * ((row // 100) % 2)


def render(frame: Frame, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The frame, (H, W) or (H, W, 3) with a sixth of the line's red in green and blue."""
    x = np.arange(WIDTH)
    line = frame.peak * np.exp(-0.5 * ((x - truth(frame)[:, None]) / frame.sigma) ** 2)
    if frame.speckle:
        line *= 1.0 + frame.speckle * rng.standard_normal(line.shape)
    share = np.array([0.15, 0.15, 1.0]) if frame.colour else np.array([1.0])
    image = 10.0 + line[..., None] * share
    image += frame.noise * rng.standard_normal(image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8).squeeze()


def bound(frame: Frame) -> float:
    """Cramer-Rao bound of one row's column [px], position, height, width and background unknown."""
    x = np.arange(-40.0, 41.0)
    values = []
    for u in np.linspace(0.0, 0.9, 10):
        bell = np.exp(-0.5 * ((x - u) / frame.sigma) ** 2)
        signal = frame.peak * bell
        slope = signal * (x - u) / frame.sigma**2
        variance = frame.noise**2 + 1.0 / 12.0 + (frame.speckle * signal) ** 2
        usable = 10.0 + signal < 255.0
        jacobian = np.stack([slope, bell, slope * (x - u) / frame.sigma, np.ones_like(x)])[:, usable]
        values.append(np.linalg.inv((jacobian / variance[usable]) @ jacobian.T)[0, 0])
    return float(np.sqrt(np.mean(values)))


def measure(frame: Frame, seeds: int) -> dict[str, float]:
    """Errors over all rows of all seeds, and the CPU time of one call."""
    params = LaserLineParams(pool_rows=frame.pool)
    window = np.tile([180.0, 900.0], (HEIGHT, 1)) if frame.window else None
    errors, scaled, times = [], [], []
    for seed in range(seeds):
        image = render(frame, np.random.default_rng(seed))
        find_laser_line(image, params, window=window)
        fastest = np.inf
        for _ in range(5):
            start = time.thread_time()
            line = find_laser_line(image, params, window=window)
            fastest = min(fastest, time.thread_time() - start)
        times.append(fastest)
        error = line.column_px - truth(frame)
        errors.append(error)
        scaled.append(error / line.sigma_px)
    all_errors, all_scaled = np.concatenate(errors), np.concatenate(scaled)
    found = np.isfinite(all_errors)
    return {
        "rms": float(np.sqrt(np.mean(all_errors[found] ** 2))),
        "bias": float(np.mean(all_errors[found])),
        "found": float(found.mean()),
        "off": float((np.abs(all_errors[found]) > 1.0).sum()),
        "z": float(np.std(all_scaled[found])),
        "ms": 1e3 * float(np.median(times)),
    }


def false_lines(noise: float, seeds: int) -> float:
    """Share of rows in which a line is found where there is none."""
    found = 0
    for seed in range(seeds):
        image = render(Frame(peak=0.0, noise=noise), np.random.default_rng(seed))
        found += int(np.isfinite(find_laser_line(image, LaserLineParams()).column_px).sum())
    return found / (seeds * HEIGHT)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--only", nargs="*", default=None, help="part of a name")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"{'frame':32s} {'RMS px':>8s} {'bound':>8s} {'ratio':>6s} {'bias':>8s} {'found':>7s} {'>1px':>5s} "
          f"{'z std':>6s} {'CPU ms':>7s}  limit")  # fmt: skip
    for name, frame in FRAMES.items():
        if options.only and not any(part in name for part in options.only):
            continue
        m, least = measure(frame, options.seeds), bound(frame)
        limits = ", ".join(
            f"{value} {unit}" for value, unit in ((frame.limit_px, "px"), (frame.limit_ms, "ms")) if value
        )
        print(f"{name:32s} {m['rms']:8.4f} {least:8.4f} {m['rms'] / least:6.3f} {m['bias']:8.4f} {m['found']:7.4f} "
              f"{m['off']:5.0f} {m['z']:6.3f} {m['ms']:7.2f}  {limits}")  # fmt: skip
    for noise in (1.0, 3.0, 6.0):
        print(f"no line, noise {noise:.0f}: found in {false_lines(noise, max(2, options.seeds // 3)):.5f} of rows")


if __name__ == "__main__":
    main()
