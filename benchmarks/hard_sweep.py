"""Sweep a room made to deceive, without laser-off frames, with and without the second look; and draw one of its frames.

Run: python benchmarks/hard_sweep.py [--step DEG]

The twin renders it: a window, a tube of light, a striped curtain, white print on black, books, a black sofa, a pole.
Printed are the share of points more than 10 cm off any surface, and how many points are within 1 cm of one. The
picture, docs/img/hard-sweep.jpg, shows the first reading on the left and the second on the right: cyan the line, orange
what was taken for it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration, CalibrationFile, HeadTable, ImageTable
from scanmap.laserline import LaserLineParams
from scanmap.pipeline import Pipeline, SecondLook, run
from scanmap.scan import Scan
from scanmap.shot import Shot, decode_image
from scanmap.triangulation import TriangulationParams
from scanmap.twin import LightParams, TwinCamera, TwinParams
from scanmap.twin.mesh import box, cylinder, merged, quad
from scanmap.twin.room import Room, Thing, assembled, cuboid_walls, placed
from scanmap.twin.scene import Scene
from scanmap.twin.texture import Material, Texture

U8 = NDArray[np.uint8]
ROOT = Path(__file__).parents[1]
SIZE = (5.0, 3.6, 2.6)
HEADS = (
    ("thesis head, colour", (1600, 1200), HeadTable(baseline_m=0.08, beta_deg=25.7, alpha_deg=32.3), False),
    ("thesis head, red filter", (1600, 1200), HeadTable(baseline_m=0.08, beta_deg=25.7, alpha_deg=32.3), True),
    ("0.2 m head, colour", (800, 600), HeadTable(baseline_m=0.2, beta_deg=20.0, alpha_deg=32.3), False),
    ("0.12 m head, red filter", (640, 480), HeadTable(baseline_m=0.12, beta_deg=15.0, alpha_deg=28.0), True),
)
PICTURE = (1, 132.0)  # head, and bearing [deg] of the nearest frame


def room() -> Room:
    """The room, its corner at the origin."""
    length, width, height = SIZE
    walls, outline = cuboid_walls(*SIZE)
    paint, rng = Material((0.78, 0.76, 0.72)), np.random.default_rng(5)
    things = [
        (Thing("floor", Material((0.35, 0.24, 0.15))), quad([0, 0, 0], [length, 0, 0], [0, width, 0])),
        (Thing("ceiling", paint), quad([0, 0, height], [0, width, 0], [length, 0, 0])),
        (Thing("south", paint), quad([0, 0, 0], [0, 0, height], [length, 0, 0])),
        (Thing("north", paint), quad([0, width, 0], [length, 0, 0], [0, 0, height])),
        (Thing("west", paint), quad([0, 0, 0], [0, width, 0], [0, 0, height])),
        (Thing("east", paint), quad([length, 0, 0], [0, 0, height], [0, width, 0])),
        (Thing("window", _shining(2.5), False), quad([1.0, width - 0.01, 0.9], [1.1, 0, 0], [0, 0, 1.2])),
        (Thing("tube", _shining(3.0), False), quad([2.32, width - 0.01, 0.6], [0.015, 0, 0], [0, 0, 1.6])),
        (Thing("sofa", Material((0.018, 0.018, 0.02))), box([1.5, 2.9, 0.35], [1.5, 0.8, 0.7])),
        (Thing("pole", Material((0.3, 0.3, 0.32))), cylinder([2.1, 1.9, 0], 0.012, 1.8)),
        (Thing("box", Material((0.45, 0.33, 0.2))), box([1.4, 1.2, 0.4], [0.4, 0.35, 0.8], 25)),
    ]
    stripes = np.full((2, 512, 3), (0.85, 0.84, 0.82), np.float32)
    stripes[:, (np.arange(512) // 8) % 2 == 0] = (0.62, 0.05, 0.05)
    cloth = Texture(stripes, (2.5, 0, 0), (1 / 2.2, 0, 0), (0, 0, 1.0))
    things.append(
        (Thing("curtain", Material((1, 1, 1), texture=cloth)), box([2.85, width - 0.05, 1.25], [0.6, 0.06, 2.1]))
    )
    print_ = np.zeros((300, 400), np.uint8)
    for y, size, text in ((90, 2.9, "ILLILLI"), (190, 2.9, "HTIHLIT"), (285, 2.9, "iIlIilIl")):
        cv2.putText(print_, text, (5, y), 0, size, (255,), 7)
    ink = np.repeat((0.03 + 0.82 * print_ / 255.0)[..., None], 3, axis=2).astype(np.float32)
    page = Texture(ink, (length, 2.0, 2.1), (0, -1 / 1.1, 0), (0, 0, -1 / 0.8))
    poster = quad([length - 0.012, 0.9, 1.3], [0, 0, 0.8], [0, 1.1, 0])
    things.append((Thing("poster", Material((1, 1, 1), texture=page)), poster))
    x, spines = 3.3, [(0.6, 0.06, 0.05), (0.1, 0.15, 0.4), (0.8, 0.75, 0.65), (0.05, 0.05, 0.05)]
    while x < 4.3:
        wide = float(rng.uniform(0.015, 0.045))
        book = box([x + wide / 2, width - 0.15, 1.3], [0.96 * wide, 0.2, 0.24])
        things.append((Thing("book", Material(spines[int(rng.integers(4))])), book))
        x += wide
    things.append(
        (Thing("shelf", Material((0.5, 0.36, 0.22))), merged([box([3.8, width - 0.15, 1.16], [1.1, 0.28, 0.025])]))
    )
    return assembled("made to deceive", things, [(2.4, 1.8, 2.56)], walls, outline)


def _shining(light: float) -> Material:
    return Material((0.05, 0.05, 0.05), emission=(0.95 * light, light, light))


def sweep(
    scene: Scene, size: tuple[int, int], table: HeadTable, red_filter: bool, step: float
) -> tuple[Calibration, list[Shot]]:
    """The head, and its shots of half a turn."""
    head = CalibrationFile(image=ImageTable(width=size[0], height=size[1]), head=table).build()
    params = TwinParams()
    params = params.model_copy(update={"sensor": params.sensor.model_copy(update={"red_filter": red_filter})})
    state = [0.0]
    camera = TwinCamera(scene, head, params, lambda: (state[0], True))
    shots = []
    for k, bearing in enumerate(np.radians(np.arange(0.0, 180.1, step))):
        state[0] = float(bearing)
        shots.append(Shot(k, float(bearing), float(bearing), float(k), bytes(camera.grab().image), None))
    return head, shots


def main() -> None:
    """Sweep with every head, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--step", type=float, default=6.0, help="[deg]")
    options = parser.parse_args()
    scene = Scene(placed(room(), (2.5, 0.9), 1.0, 0.0), LightParams(ambient=0.05))
    for index, (name, size, table, red_filter) in enumerate(HEADS):
        head, shots = sweep(scene, size, table, red_filter, options.step)
        pipeline = Pipeline(head, LaserLineParams(pool_rows=9), TriangulationParams())
        scan, second = Scan(head.mount, size[1]), SecondLook(pipeline)

        def add(step, scan=scan):
            scan.add(step.profile, step.shot.bearing)

        run(shots, pipeline.process, [add, second])
        first = scan.taken(np.arange(len(scan)))
        second.settle(scan, lambda shots=shots: shots)
        for label, result in (("one look", first), ("second look", scan)):
            error = scene.rays.distance(result.points[result.valid].astype(np.float64))
            print(f"{name}, {label}: {len(error)} points, > 10 cm {(error > 0.1).mean():.4f}, "
                  f"within 1 cm {int((error < 0.01).sum())}")  # fmt: skip
        if index == PICTURE[0]:
            k = int(np.abs(np.degrees(scan.bearings) - PICTURE[1]).argmin())
            draw(np.asarray(decode_image(shots[k].image).image, np.uint8), first.column_px[k], scan.column_px[k])


def draw(image: U8, first: NDArray[np.float32], second: NDArray[np.float32]) -> None:
    """Both readings of one picture, side by side."""
    panels = []
    for column in (first, second):
        panel = image.copy()
        for row, (u, other) in enumerate(zip(column, second, strict=True)):
            if np.isfinite(u):
                colour = (255, 255, 0) if abs(u - other) < 1.0 else (0, 140, 255)
                cv2.line(panel, (int(u) - 3, row), (int(u) + 3, row), colour, 1)
        panels.append(cv2.resize(panel, (640, 480), interpolation=cv2.INTER_AREA))
    path = ROOT / "docs" / "img" / "hard-sweep.jpg"
    cv2.imwrite(str(path), np.hstack(panels), [cv2.IMWRITE_JPEG_QUALITY, 85])
    print(path)


if __name__ == "__main__":
    main()
