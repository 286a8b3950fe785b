"""What is too dark to be a surface, and what a mirror makes of a wall: as bright as that, but near and black."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from scanmap.calibration import CalibrationFile, HeadTable, ImageTable
from scanmap.laserline import LaserLineParams, Reason
from scanmap.pipeline import Pipeline, SecondLook, run
from scanmap.scan import Scan
from scanmap.shot import Shot
from scanmap.triangulation import TriangulationParams, locate

F64 = NDArray[np.float64]

WIDTH, HEIGHT = 640, 160
WALL_M, NEAR_M = 2.0, 0.35
WALL_PEAK, WIDTH_PX = 60.0, 2.0
MIRROR, SHOT = slice(40, 110), 5  # rows in which nothing comes back from the wall, and the bearing that sees more
HEAD = CalibrationFile(
    image=ImageTable(width=WIDTH, height=HEIGHT), head=HeadTable(baseline_m=0.2, beta_deg=22.0, alpha_deg=30.0)
).build()


def columns(range_m: float) -> F64:
    """Columns (H,) in which the line is seen at a range."""
    column, row = np.meshgrid(np.linspace(0.0, WIDTH - 1.0, 900), np.arange(HEIGHT, dtype=np.float64))
    points = locate(column.ravel(), row.ravel(), HEAD, TriangulationParams(range_max_m=50.0))[0]
    ranges = np.linalg.norm(points, axis=1).reshape(column.shape)
    order = np.argsort(np.where(np.isfinite(ranges), ranges, np.inf), axis=1)
    return np.array([np.interp(range_m, ranges[k, order[k]], column[k, order[k]]) for k in range(HEIGHT)])


def swept(
    seen_at: tuple[int, ...], peak: float, near_m: float = NEAR_M, wall_peak: float = WALL_PEAK, others: float = 0.0
) -> Scan:
    """A sweep of a wall with a mirror after the second look; some bearings see a line of a height near the head.

    In the mirror's rows the other bearings see a line of the height `others` on the wall.
    """
    x, far, near, shots = np.arange(WIDTH), columns(WALL_M), columns(near_m), []
    for k, bearing in enumerate(np.radians(np.arange(70.0, 121.0, 5.0))):
        picture = np.random.default_rng(k).normal(20.0, 2.0, (HEIGHT, WIDTH))
        mirror = range(*MIRROR.indices(HEIGHT))
        for row in range(HEIGHT):
            here = (near, peak) if k in seen_at else (far, others)
            own, high = here if row in mirror else (far, wall_peak)
            picture[row] += high * np.exp(-0.5 * ((x - own[row]) / WIDTH_PX) ** 2)
        image = bytes(cv2.imencode(".png", np.clip(np.rint(picture), 0, 255).astype(np.uint8))[1])
        shots.append(Shot(k, float(bearing), float(bearing), float(k), image, None))
    pipeline = Pipeline(HEAD, LaserLineParams(grey="luminance_601"), TriangulationParams())
    scan, second = Scan(HEAD.mount, HEIGHT), SecondLook(pipeline)
    run(shots, pipeline.process, [lambda step: scan.add(step.profile, step.shot.bearing), second], workers=1)
    assert np.nanmedian(scan.range_m[SHOT, MIRROR]) == pytest.approx(near_m, rel=0.02)
    second.settle(scan, lambda: shots)
    return scan


# What a surface there of the wall's kind would throw back, in terms of the wall's light.
NEARER = (WALL_M / NEAR_M) ** 2


def test_light_of_a_wall_that_seems_near_and_black_is_given_up_where_no_neighbour_goes_on() -> None:
    scan = swept((SHOT,), 0.8 * WALL_PEAK)
    assert 0.8 / NEARER < 0.03
    assert not scan.valid[:, MIRROR].any()
    assert (scan.reason[SHOT, MIRROR] == Reason.AMBIGUOUS).mean() > 0.9
    assert scan.valid[:, : MIRROR.start].all()


def test_it_stays_where_the_next_bearing_goes_on() -> None:
    scan = swept((SHOT, SHOT + 1), 0.8 * WALL_PEAK)
    assert scan.valid[SHOT : SHOT + 2, MIRROR].mean() > 0.95


@pytest.mark.parametrize("reflects", [0.05, 0.15])
def test_dark_things_near_the_scanner_stay(reflects: float) -> None:
    scan = swept((SHOT,), reflects * NEARER * WALL_PEAK)
    assert scan.valid[SHOT, MIRROR].mean() > 0.95


def test_black_things_that_are_seen_dimly_stay() -> None:
    # Seen at a grazing angle, or of black gloss: their light is a tenth of the wall's.
    scan = swept((SHOT,), 0.025 * WALL_M**2 * 160.0, near_m=1.0, wall_peak=160.0)
    assert scan.valid[SHOT, MIRROR].mean() > 0.95


@pytest.mark.parametrize(
    ("seen_at", "near_m", "kept"), [((SHOT,), 0.7, 0), ((SHOT, SHOT + 1), 0.7, 1), ((SHOT,), 1.2, 1)]
)
def test_what_polish_shows_of_a_line_is_given_up_among_bearings_that_see_the_wall(
    seen_at: tuple[int, ...], near_m: float, kept: int
) -> None:
    """A tenth of the wall's light, at ranges where that is 0.012 and 0.036 of what the wall reflects."""
    scan = swept(seen_at, 0.1 * 190.0, near_m, wall_peak=190.0, others=190.0)
    assert scan.valid[SHOT, MIRROR].mean() == pytest.approx(kept, abs=0.05)


@pytest.mark.parametrize(("light", "kept"), [(0.12, 0), (0.5, 1)])
def test_what_is_blacker_than_any_surface_and_shows_is_given_up_though_two_bearings_agree(
    light: float, kept: int
) -> None:
    scan = swept((SHOT, SHOT + 1), light * 190.0, wall_peak=190.0, others=190.0)
    assert light / NEARER < 0.004 or kept
    assert scan.valid[SHOT : SHOT + 2, MIRROR].mean() == pytest.approx(kept, abs=0.05)
