"""What each rule of the laser line is worth: every one switched off in turn, and what changes.

Run: python benchmarks/ablation.py [--only NAME ...] [--seeds 3] [--step DEG]

Four sets of pictures are drawn: the hard frames of tests/synthetic_lines.py with other seeds than the tests', in colour
and grey, raw and through JPEG, without and with laser-off frames; the room made to deceive of benchmarks/hard_sweep.py,
with four heads, one look; lines on even ground, in all colours, heights, widths and noises, and along edges of paint.
Printed are the figures with every rule, and what is added to those without each (a dot: nothing); its lines of code,
and the CPU time of an ordinary frame that it takes (1600x1200, twelve at once, colour and grey).
"""

from __future__ import annotations

import argparse
import inspect
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from pkgutil import resolve_name
from unittest import mock

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from hard_sweep import HEADS, room, sweep
from pipeline import frames
from synthetic_lines import GREEN, HARD, RED, LineSpec, clean, hard_frame, score
from test_laserline_edges import frames as edge_frames

from scanmap.config import load
from scanmap.geometry import transform
from scanmap.laserline import LaserLineParams, find_laser_line, look_at_all, rounding_of
from scanmap.laserline.edges import no_edges
from scanmap.pipeline import Pipeline
from scanmap.shot import Shot, decode_image
from scanmap.triangulation import TriangulationParams, column_window, triangulate
from scanmap.twin import LightParams
from scanmap.twin.room import placed
from scanmap.twin.scene import Scene

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]
ALONE, POOLED = LaserLineParams(), LaserLineParams(pool_rows=9)
SEED = 500  # the first of the frames drawn; the tests' are below


def no_rows(column: F64, *_: object, **__: object) -> NDArray[np.bool_]:
    """None of them."""
    return np.zeros(len(column), bool)


NO_INDEX = np.empty(0, np.intp)
# Whose lines are counted, where it is looked up (both in scanmap.laserline), and what stands in for it.
# fmt: off
RULES: dict[str, tuple[str, str, object]] = {
    "a quick look": ("leads", "search.settled", lambda leads, *_: np.zeros(leads.height.shape, bool)),
    "less another channel": ("candidates._less_elsewhere", "candidates._less_elsewhere", lambda r, *_: r),
    "candidates' lead in colour": ("candidates._leads", "candidates._leads", lambda own, *_: np.zeros_like(own)),
    "candidates' colour": ("colour.colour_doubt", "search.colour_doubt", lambda _, c, found, *__: found.snr**0),
    "24 candidates": ("search._with_blocks", "search._FULL", 99),
    "jumps of the path": ("path._best_path", "path.JUMP", 0.0),
    "edges under the line": ("edges.across_edges", "line.across_edges", lambda p, *_: no_edges(len(p[0]))),
    "the same, off frame": ("edges.doubt_of_edges", "line.doubt_of_edges", lambda p, *_: no_edges(len(p[0]))),
    "print taken off": ("beside_print", "line.apart_from_print", lambda *_: None),
    "saturated, by brightness": ("brightness", "line.by_brightness", lambda found, *_: found),
    "dim rows borrow": ("dim", "peaks.dim_rows", lambda *_: None),
    "dim rows between": ("runs.continuing", "runs.continuing", lambda *_: NO_INDEX),
    "bright cores": ("cores.take_cores", "line.take_cores", lambda *_: None),
    "bars": ("bars", "line.take_bars", lambda *_: None),
    "blobs": ("runs.blobs", "runs.blobs", no_rows),
    "another colour": ("colour.strangers", "line.strangers", lambda found, *_: (no_rows(found[0]),) * 2),
    "white beside cores": ("colour._white_beside", "colour._white_beside", lambda _, row, *__: no_rows(row)),
    "flat tops": ("flat", "line.flat_tops", no_rows),
    "frayed ends": ("runs.frayed", "runs.frayed", no_rows),
    "going on": ("onward", "line.goes_on", lambda *_: (NO_INDEX, NO_INDEX)),
    "rivals": ("rivals", "line.contested", no_rows),
    "short runs": ("runs.crumbs", "runs.crumbs", no_rows),
    "off frame: edges": ("offframe", "line.told_from_edges", lambda found, weak, *_: (found, weak)),
    "off frame: whole runs": ("offframe.borne_out", "offframe.borne_out", no_rows),
    "off frame: moved": ("offmatch.shift_between", "line.in_place", lambda _, background: background),
    "off frame: exposure": ("offmatch.exposure_between", "difference.exposure_between", lambda *_: (1.0, None)),
    "off frame: its noise": ("difference._even", "difference._even", lambda own, _: own.astype(np.float32)),
}
# fmt: on


def through_jpeg(image: U8) -> tuple[U8, bytes]:
    """A picture as a camera would hand it on, and its file."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), np.uint8), data.tobytes()


class Sets:
    """All that is drawn, once."""

    def __init__(self, seeds: int, step: float) -> None:
        kinds = [(name, seed) for name in HARD for seed in range(SEED, SEED + seeds)]
        self.hard = [(name, hard_frame(name, seed, colour=own)) for own in (True, False) for name, seed in kinds]
        self.scene = Scene(placed(room(), (2.5, 0.9), 1.0, 0.0), LightParams(ambient=0.05))
        self.sweeps = [sweep(self.scene, *head[1:], step) for head in HEADS]
        self.lines = list(_lines(seeds))
        self.ordinary = []
        for red in (False, True):
            config = load("twin-room", ['laserline.grey="luminance_601"'] if red else [])
            files, pipeline = frames(red), Pipeline(config.head(), config.laserline, config.triangulation)
            pipeline.ask_laser(Shot(0, 0.0, 0.0, 0.0, files[0]))
            images = np.stack([decode_image(file, grey=red).image for file in files])
            self.ordinary.append((pipeline, images, [rounding_of(file) for file in files]))

    def figures(self) -> dict[str, float]:
        """What the detector makes of them."""
        told = {}
        for label, with_off in (("hard", False), ("hard, off", True)):
            found, false = [], []
            for k, (name, frame) in enumerate(self.hard):
                on, off = (through_jpeg(p)[0] if k % 2 else p for p in (frame.image, frame.background))
                one = score(find_laser_line(on, ALONE, off if with_off else None).column_px, frame)
                found += [] if "empty" in name else [one.found]
                false.append(one.false)
            told |= {f"{label}: found": float(np.mean(found)), f"{label}: false": float(np.mean(false))}
        error, limits = [], TriangulationParams()
        for head, shots in self.sweeps:
            window = column_window(head, limits)
            for shot in shots:
                line = find_laser_line(decode_image(shot.image).image, POOLED, None, window, rounding_of(shot.image))
                points = triangulate(line, head, limits).points
                seen = transform(head.mount.T_world_head(shot.bearing), points[np.isfinite(points).all(axis=1)])
                error.append(self.scene.rays.distance(seen))
        off = np.concatenate(error)
        told |= {"room: within 1 cm": float(np.sum(off < 0.01)), "room: > 10 cm": float(np.mean(off > 0.1))}
        z, typical = [], []
        for image, dark, column, data in self.lines:
            line = find_laser_line(image, POOLED, dark, None, rounding_of(data) if data else None)
            z.append((line.column_px - column) / line.sigma_px)
            typical.append(np.log(np.nanmedian(np.abs(line.column_px - column)) + 1e-3))
        scaled = np.abs(np.concatenate(z))
        told |= {"line: px": float(np.exp(np.mean(typical))), "line: > 5 sigma": float(np.mean(scaled > 5.0))}
        return told

    def cpu_ms(self) -> F64:
        """CPU time of an ordinary frame, in colour and in grey."""
        spent = []
        for pipeline, images, roundings in self.ordinary:
            start = time.thread_time()
            for k in range(0, len(images), 12):
                some = slice(k, k + 12)
                look_at_all(images[some], pipeline.laserline, pipeline.window, pipeline.laser, roundings[some])
            spent.append((time.thread_time() - start) / len(images) * 1e3)
        return np.array(spent)


def _lines(seeds: int) -> Iterator[tuple[U8, U8 | None, F64, bytes | None]]:
    """Pictures, laser-off frames, columns, and the pictures' files."""
    rng = np.random.default_rng(SEED)
    for k in range(24 * seeds):
        peak, noise = np.exp(rng.uniform(np.log([30.0, 1.0]), np.log([600.0, 6.0])))
        own = (None, RED, GREEN)[k % 3]
        spec = LineSpec(480, 640, rng.uniform(1.0, 4.0), peak, noise=noise, step_px=30.0 * (k % 2), colour=own)
        image, column = clean(spec, rng)
        picture, data = through_jpeg(image)
        yield (image, None, column, None) if k % 4 == 0 else (picture, None, column, data)
    for k in range(12 * seeds):
        on, off, column = edge_frames((1.3, 2.0)[k % 2], rng.uniform(-6.0, 6.0), seed=SEED + k)
        yield on, (None, off)[k // 2 % 2], column, None


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", help="rules whose names contain one of these")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--step", type=float, default=12.0, help="of the sweeps [deg]")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    sets = Sets(options.seeds, options.step)
    usual, whole = sets.figures(), np.min([sets.cpu_ms() for _ in range(5)], axis=0)
    print("| rule | lines | ms colour | ms grey | " + " | ".join(usual) + " |\n" + "|---" * (4 + len(usual)) + "|")
    print("| all | | {:.2f} | {:.2f} | ".format(*whole) + " | ".join(f"{v:.5g}" for v in usual.values()) + " |")
    for name, (source, at, instead) in RULES.items():
        if options.only and not any(own in name for own in options.only):
            continue
        left_out, times = mock.patch(f"scanmap.laserline.{at}", instead), []
        for _ in range(10):
            whole = sets.cpu_ms()
            with left_out:
                times.append((whole, sets.cpu_ms()))
        with left_out:
            told = sets.figures()
        ms = np.subtract(*np.min(times, axis=0))
        lines = len(inspect.getsourcelines(resolve_name(f"scanmap.laserline.{source}"))[0])
        more = (told[key] - usual[key] for key in told)
        cells = [f"{value:+.2g}" if abs(value) > 5e-5 else "." for value in more]
        print(f"| {name} | {lines} | {ms[0]:.2f} | {ms[1]:.2f} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
