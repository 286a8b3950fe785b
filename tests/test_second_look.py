"""What stands still while the head turns is not the laser line: geometry, and whole sweeps of drawn pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from scanmap.calibration import Calibration, CalibrationFile, HeadTable, ImageTable
from scanmap.calibration.file import AxisTable
from scanmap.geometry import inverse, transform
from scanmap.laserline import LaserLineParams, Reason, ridge_of
from scanmap.pipeline import Pipeline, SecondLook, run
from scanmap.pipeline.still import StillThings
from scanmap.scan import Scan
from scanmap.shot import Shot
from scanmap.triangulation import TriangulationParams

F64 = NDArray[np.float64]

WIDTH, HEIGHT = 640, 240
STEP = np.radians(6.0)
BEARINGS = np.arange(0, 24) * STEP
WALL_Y = 2.0  # the only wall, y = 2 in the world, right across the sweep
SEEN = 15  # of the bearings, one from which the tube at (0.6, 1.9) is seen well
BRIGHT, TUBE = 90.0, 190.0  # [grey levels] of the line and of the tube


def head(offset: tuple[float, float, float] = (0.03, 0.01, 0.0)) -> Calibration:
    return CalibrationFile(
        image=ImageTable(width=WIDTH, height=HEIGHT),
        head=HeadTable(baseline_m=0.2, beta_deg=22.0, alpha_deg=30.0),
        axis=AxisTable(head_offset_m=offset, tilt_deg=(0.3, -0.2)),
    ).build()


def seen(calibration: Calibration, bearing: float, points: F64) -> F64:
    """Pixels (N, 2) of world points, NaN outside the picture."""
    T = calibration.mount.T_world_head(bearing) @ calibration.T_head_camera
    pixel = calibration.intrinsics.project(transform(inverse(T), points))
    inside = ((pixel > 1) & (pixel < [WIDTH - 2, HEIGHT - 2])).all(axis=1)
    pixel[~inside] = np.nan
    return pixel


def line_on_wall(calibration: Calibration, bearing: float) -> F64:
    """Columns (H,) of the laser line on the wall."""
    T = calibration.mount.T_world_head(bearing)
    angle = np.radians(np.linspace(-40.0, 40.0, 4000))
    way = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1) @ T[:3, :3].T
    reach = (WALL_Y - T[1, 3]) / way[:, 1]
    met = way[:, 1] > 0.2
    pixel = seen(calibration, bearing, (T[:3, 3] + reach[:, None] * way)[met])
    known = pixel[np.isfinite(pixel[:, 0])]
    if len(known) < 2:
        return np.full(HEIGHT, np.nan)
    order = np.argsort(known[:, 1])
    return np.interp(np.arange(HEIGHT), known[order, 1], known[order, 0], left=np.nan, right=np.nan)


def tube(x: float, y: float, low: float = -0.4, high: float = 0.4) -> F64:
    return np.stack([np.full(600, x), np.full(600, y), np.linspace(low, high, 600)], axis=1)


def columns_of(calibration: Calibration, bearing: float, thing: F64) -> F64:
    """Columns (H,) of a thing, NaN where it is not seen."""
    pixel = seen(calibration, bearing, thing)
    pixel = pixel[np.isfinite(pixel[:, 0])]
    order = np.argsort(pixel[:, 1])
    if len(pixel) < 2:
        return np.full(HEIGHT, np.nan)
    return np.interp(np.arange(HEIGHT), pixel[order, 1], pixel[order, 0], left=np.nan, right=np.nan)


def collected(calibration: Calibration, things: list[F64], bearings: F64 = BEARINGS) -> StillThings:
    """What pictures of the wall's line and of things as bright as it show."""
    still, rng = StillThings(calibration), np.random.default_rng(3)
    pipeline = Pipeline(calibration, LaserLineParams(grey="luminance_601"), TriangulationParams())
    for bearing in bearings:
        image = drawn(calibration, float(bearing), things, BRIGHT, rng)
        ridges = pipeline.ridges(Shot(0, float(bearing), float(bearing), 0.0, image, None))
        assert ridges is not None
        still.add(float(bearing), ridges)
    return still


def asked(still: StillThings, bearing: float, column: F64, height: float = BRIGHT) -> NDArray[np.bool_]:
    """What `still` says of columns (H,) taken for the laser line."""
    return still.line(bearing, column, ridge_of(np.full(HEIGHT, height), np.full(HEIGHT, 1.5)))


def test_a_tube_stands_and_the_line_does_not() -> None:
    calibration, lamp = head(), tube(0.6, 1.9)
    still = collected(calibration, [lamp])
    tubes = lines = rows = 0
    for bearing in map(float, BEARINGS):
        line, thing = line_on_wall(calibration, bearing), columns_of(calibration, bearing, lamp)
        apart = np.isfinite(line) & ~(np.abs(line - thing) < 20.0)
        rows += int(apart.sum())
        lines += int(asked(still, bearing, np.where(apart, line, np.nan)).sum())
        shown = np.isfinite(thing) & ~(np.abs(line - thing) < 20.0)
        if shown.sum() > 40:
            tubes += 1
            assert asked(still, bearing, np.where(shown, thing, np.nan))[shown].mean() > 0.9
    assert tubes >= 5
    assert lines < 0.005 * rows


def test_a_short_piece_of_a_tube_stands_too() -> None:
    calibration, lamp = head(), tube(0.6, 1.9)
    still, bearing = collected(calibration, [lamp]), float(BEARINGS[SEEN])
    thing = columns_of(calibration, bearing, lamp)
    row = np.flatnonzero(np.isfinite(thing))
    short = np.full(HEIGHT, np.nan)
    short[row[60:70]] = thing[row[60:70]]
    assert asked(still, bearing, short)[row[60:70]].mean() > 0.7
    assert not asked(still, bearing, short + 25.0).any()


def test_where_the_laser_meets_the_thing_itself_it_is_kept() -> None:
    calibration, lamp = head(), tube(0.6, 1.9)
    still = collected(calibration, [lamp])
    bearing = float(BEARINGS[SEEN]) + 0.01
    thing = columns_of(calibration, bearing, lamp)
    known = np.isfinite(thing)
    assert known.sum() > 40
    # As high as in every other picture it is the thing; three times as high the laser has met it.
    assert asked(still, bearing, thing, 0.9 * BRIGHT)[known].mean() > 0.9
    assert not still.line(bearing, thing, 3.0 * ridge_of(np.full(HEIGHT, BRIGHT), np.full(HEIGHT, 1.5))).any()


def test_a_thing_seen_in_two_other_pictures_proves_nothing() -> None:
    calibration, lamp = head(), tube(0.6, 1.9)
    some = BEARINGS[SEEN - 1 : SEEN + 2]
    thing = columns_of(calibration, float(some[1]), lamp)
    assert np.isfinite(thing).sum() > 40
    assert not asked(collected(calibration, [lamp], some), float(some[1]), thing).any()
    assert asked(collected(calibration, [lamp], BEARINGS[SEEN - 2 : SEEN + 3]), float(some[1]), thing).any()


def test_a_second_turn_is_no_other_view() -> None:
    calibration, lamp = head(), tube(0.6, 1.9)
    bearing = float(BEARINGS[SEEN])
    thing = columns_of(calibration, bearing, lamp)
    assert np.isfinite(thing).sum() > 40
    still = collected(calibration, [lamp], bearing + 2.0 * np.pi * np.arange(1, 5))
    assert not asked(still, bearing, thing).any()


def test_the_mask_covers_the_thing_at_every_bearing_and_little_else() -> None:
    calibration, lamp = head(), tube(0.6, 1.9)
    still, rng = collected(calibration, [lamp]), np.random.default_rng(4)
    pipeline = Pipeline(calibration, LaserLineParams(grey="luminance_601"), TriangulationParams())
    for bearing in map(float, BEARINGS[4:12]):
        image = drawn(calibration, bearing, [lamp], BRIGHT, rng)
        ridges = pipeline.ridges(Shot(0, bearing, bearing, 0.0, image, None))
        assert ridges is not None
        mask = still.mask(bearing, ridges)
        assert mask.shape == (HEIGHT // 4, WIDTH)
        thing = columns_of(calibration, bearing, lamp)
        row = np.flatnonzero(np.isfinite(thing))
        if len(row):
            assert mask[row // 4, np.rint(thing[row]).astype(int)].mean() > 0.9
        assert mask.mean() < 0.12


def drawn(calibration: Calibration, bearing: float, things: list[F64], level: float, rng: np.random.Generator) -> bytes:
    """A grey picture of the wall's line and of things as bright as `level`."""
    x = np.arange(WIDTH)
    picture = rng.normal(20.0, 2.0, (HEIGHT, WIDTH))
    line = line_on_wall(calibration, bearing)
    for row in np.flatnonzero(np.isfinite(line)):
        picture[row] += BRIGHT * np.exp(-0.5 * ((x - line[row]) / 1.5) ** 2)
    for thing in things:
        pixel = seen(calibration, bearing, thing)
        pixel = pixel[np.isfinite(pixel[:, 0])]
        order = np.argsort(pixel[:, 1])
        if len(pixel) > 1:
            rows = np.arange(int(np.ceil(pixel[:, 1].min())), int(pixel[:, 1].max()) + 1)
            for row, column in zip(rows, np.interp(rows, pixel[order, 1], pixel[order, 0]), strict=True):
                picture[row] += level * np.exp(-0.5 * ((x - column) / 1.5) ** 2)
    return bytes(cv2.imencode(".png", np.clip(np.rint(picture), 0, 255).astype(np.uint8))[1])


def swept(
    calibration: Calibration, things: list[F64], level: float = TUBE, order: list[int] | None = None
) -> tuple[Scan, SecondLook, list[Shot]]:
    rng = np.random.default_rng(3)
    shots = [
        Shot(k, float(b), float(b), float(k), drawn(calibration, float(b), things, level, rng), None)
        for k, b in enumerate(BEARINGS)
    ]
    shots = [shots[k] for k in order] if order else shots
    pipeline = Pipeline(calibration, LaserLineParams(grey="luminance_601"), TriangulationParams())
    scan, second = Scan(calibration.mount, HEIGHT), SecondLook(pipeline)
    run(shots, pipeline.process, [lambda step: scan.add(step.profile, step.shot.bearing), second], workers=1)
    return scan, second, shots


def off_the_wall(scan: Scan) -> NDArray[np.int64]:
    """Points that are not on the wall, (B,)."""
    with np.errstate(invalid="ignore"):
        off: NDArray[np.int64] = (np.abs(scan.points[..., 1] - WALL_Y) > 0.1).sum(axis=1)
    return off


def test_tubes_brighter_than_the_line_cost_few_points() -> None:
    calibration = head()
    clean = int(swept(calibration, [])[0].valid.sum())
    scan, second, shots = swept(calibration, [tube(0.6, 1.9), tube(0.1, 1.8)])
    assert off_the_wall(scan).sum() > 0.3 * clean  # one picture cannot tell
    assert second.settle(scan, lambda: shots) > 0.3 * clean
    # Where the laser is about to meet the thing itself the two are hard to tell apart; and a tube has ends.
    assert np.sort(off_the_wall(scan))[-2] <= 20
    assert off_the_wall(scan).sum() < 0.05 * clean
    assert scan.valid.sum() > 0.93 * clean


def test_rows_that_one_picture_left_open_are_told_by_the_others() -> None:
    """Above and below a short tube the line is seen: that one of the two is not the line, a picture knows by itself."""
    scan, second, shots = swept(head(), [tube(0.6, 1.9, -0.15, 0.15), tube(0.1, 1.8, -0.15, 0.15)])
    left_open = scan.reason == Reason.RIVALS
    assert left_open.sum() > 300
    assert off_the_wall(scan).sum() < 0.02 * scan.valid.sum()
    second.settle(scan, lambda: shots)
    assert scan.valid[left_open].mean() > 0.9
    assert off_the_wall(scan).sum() < 0.01 * scan.valid.sum()


def test_without_the_pictures_points_are_given_up() -> None:
    scan, second, _ = swept(head(), [tube(0.6, 1.9), tube(0.1, 1.8)])
    before, false = int(scan.valid.sum()), int(off_the_wall(scan).sum())
    given_up = second.settle(scan, None)
    assert off_the_wall(scan).sum() < 0.1 * false
    assert int(scan.valid.sum()) == before - given_up
    assert (scan.reason == Reason.AMBIGUOUS).sum() >= given_up


def test_a_sweep_without_such_things_stays_as_it_is() -> None:
    scan, second, shots = swept(head(), [])
    before = scan.taken(np.arange(len(scan)))
    assert second.settle(scan, lambda: shots) == 0
    np.testing.assert_array_equal(scan.points, before.points)
    np.testing.assert_array_equal(scan.reason, before.reason)


def test_the_order_of_the_shots_does_not_matter() -> None:
    things = [tube(0.6, 1.9), tube(0.1, 1.8)]
    order = [int(k) for k in np.random.default_rng(1).permutation(len(BEARINGS))]
    (one, first, shots), (other, second, mixed) = swept(head(), things), swept(head(), things, order=order)
    first.settle(one, lambda: shots)
    second.settle(other, lambda: mixed)
    np.testing.assert_array_equal(one.merged().points, other.merged().points)


def odd_pictures(height: float, width: float, count: int) -> tuple[Scan, SecondLook, list[Shot]]:
    """A sweep with pictures side by side in which there is another thing than the line, where 0.2 m would be."""
    calibration, k, rows = head((0.0, 0.0, 0.0)), 8, slice(60, 180)
    scan, second, shots = swept(calibration, [])
    pipeline = Pipeline(calibration, LaserLineParams(grey="luminance_601"), TriangulationParams())
    rng = np.random.default_rng(5)
    for i in range(count):
        picture = rng.normal(20.0, 2.0, (HEIGHT, WIDTH))
        picture[rows] += height * np.exp(-0.5 * ((np.arange(WIDTH) - 560.0) / width) ** 2)
        image = bytes(cv2.imencode(".png", np.clip(np.rint(picture), 0, 255).astype(np.uint8))[1])
        shots.append(Shot(99 + i, float(BEARINGS[k] + (0.5 + 0.2 * i) * STEP), 0.0, 99.0 + i, image, None))
        step = pipeline.process(shots[-1])
        assert np.isfinite(step.profile.range_m[rows]).mean() > 0.9
        assert np.nanmax(step.profile.range_m) < 0.4
        scan.add(step.profile, shots[-1].bearing)
        second(step)
    return scan, second, shots


@pytest.mark.parametrize("lit", [False, True])
def test_what_returns_less_light_than_any_surface_is_not_the_line(lit: bool) -> None:
    """A dim thing in one picture only, where the line is lost, at a column that means 0.3 m."""
    scan, second, shots = odd_pictures(180.0 if lit else 25.0, 4.0 if lit else 1.2, 1)
    second.settle(scan, lambda: shots)
    assert scan.valid[-1].any() == lit


@pytest.mark.parametrize("side_by_side", [1, 2])
def test_what_returns_little_light_is_the_line_where_a_neighbour_goes_on(side_by_side: int) -> None:
    """0.005 of what is usual: a black thing, or nothing."""
    scan, second, shots = odd_pictures(60.0, 1.5, side_by_side)
    second.settle(scan, lambda: shots)
    kept = (scan.range_m[len(BEARINGS) :] < 0.4).sum(axis=1)
    assert (kept > 100).all() if side_by_side == 2 else not kept.any()
