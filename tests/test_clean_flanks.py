"""Lines of which one side is dimmed, cut off or added to: light drawn finely, blurred, sampled, and seen with noise."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from scanmap.calibration import Calibration, CalibrationFile, HeadTable, ImageTable
from scanmap.geometry import transform
from scanmap.laserline import LaserLineParams, Usual, by_clean_flanks, find_laser_line
from scanmap.pipeline import Pipeline, SecondLook, run
from scanmap.scan import Scan
from scanmap.shot import Shot
from scanmap.triangulation import TriangulationParams, locate

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

WIDTH, HEIGHT = 640, 160
BEAM_PX, BLUR_PX, PEAK, LEVEL = 1.9, 0.7, 110.0, 30.0
USUAL = float(np.hypot(BEAM_PX, BLUR_PX))
FINE = np.arange(-14.0, 14.0, 0.05)  # [px] from the middle of the beam
PARAMS = LaserLineParams(grey="luminance_601", pool_rows=9)
ALL = np.ones(HEIGHT, bool)
UNSURE, SURE = (Usual(np.full(HEIGHT, USUAL), np.full(HEIGHT, known)) for known in (False, True))


def light(kind: str, side: int = 1) -> F64:
    """What a surface throws back of a beam at FINE, its usual height being 1, without blur."""
    x = side * FINE
    beam = np.exp(-0.5 * (x / BEAM_PX) ** 2)
    if kind == "joint":  # of tiles, dark, beside the line's middle
        return np.where((x > 0.3) & (x < 3.2), 0.4, 1.0) * beam
    if kind == "stripe":  # paler, over half of the line, and darker in the room's light, too: it hardly leans
        stripe = (x > 0.0) & (x < 5.0)
        return np.where(stripe, 0.64 * beam - 0.36 * LEVEL / PEAK, beam)
    if kind == "edge":  # beyond which there is nothing near
        return np.where(x < 0.7, beam, 0.0)
    if kind == "gloss":  # that shows the line once more
        return beam + 0.45 * np.exp(-0.5 * ((x - 4.6) / BEAM_PX) ** 2)
    width = {"whole": 1.0, "narrow": 0.72, "wide": 1.3}[kind]
    return np.exp(-0.5 * (x / BEAM_PX / width) ** 2)


def sampled(thrown_back: F64, column: float) -> F64:
    """Grey levels (W,) above what is there without the laser."""
    x = np.arange(WIDTH, dtype=np.float64)
    near = np.abs(x - column) < 20.0
    spread = np.exp(-0.5 * ((x[near, None] - column - FINE) / BLUR_PX) ** 2)
    level = np.zeros(WIDTH)
    level[near] = PEAK * (spread @ thrown_back) * (FINE[1] - FINE[0]) / (np.sqrt(2.0 * np.pi) * BLUR_PX)
    return level


def drawn(thrown_back: F64, columns: F64, seed: int = 3, noise: float = 2.0) -> U8:
    picture = np.random.default_rng(seed).normal(LEVEL, noise, (HEIGHT, WIDTH))
    for row, column in enumerate(columns):
        picture[row] += sampled(thrown_back, column)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


COLUMNS = 250.3 + 0.11 * np.arange(HEIGHT)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("kind", ["joint", "edge", "gloss"])
def test_the_clean_flank_says_where_the_line_is(kind: str, side: int) -> None:
    image = drawn(light(kind, side), COLUMNS)
    line = find_laser_line(image, PARAMS)
    moved = by_clean_flanks(image, PARAMS, line.column_px, UNSURE, ALL)
    before, after = line.column_px - COLUMNS, line.column_px + moved.by - COLUMNS
    assert abs(np.median(before)) > 0.4
    assert np.median(np.abs(after)) < 0.4 * np.median(np.abs(before))
    told = moved.by != 0.0
    assert told.mean() > 0.8
    # Its doubt covers what is left, and is less than what is gone.
    assert np.sqrt(np.mean(np.square(after[told] / np.hypot(moved.doubt, line.sigma_px)[told]))) < 1.2
    assert np.all(moved.doubt < 0.5 * np.abs(moved.by) + 1e-9)


def test_rows_that_are_not_sure_go_with_those_around_them() -> None:
    """The joint is paler in the middle of the picture, where its line is hardly narrower than usual."""
    pale, image = np.abs(np.arange(HEIGHT) - HEIGHT // 2) < 15, drawn(light("joint"), COLUMNS)
    middling = 0.5 * (light("joint") + light("whole"))
    image[pale] = drawn(middling, COLUMNS)[pale]
    line = find_laser_line(image, PARAMS).column_px
    alone = by_clean_flanks(image[pale], PARAMS, line[pale], Usual(*(own[pale] for own in UNSURE)), ALL[pale])
    moved = by_clean_flanks(image, PARAMS, line, UNSURE, ALL)
    assert not alone.by.any()
    assert (moved.by[pale] != 0.0).mean() > 0.9
    assert np.median(np.abs(line + moved.by - COLUMNS)[pale]) < 0.5 * np.median(np.abs(line - COLUMNS)[pale])


@pytest.mark.parametrize("side", [-1, 1])
def test_a_line_that_hardly_leans_moves_where_its_usual_width_is_sure(side: int) -> None:
    image = drawn(light("stripe", side), COLUMNS, noise=1.0)
    line = find_laser_line(image, PARAMS)
    before = np.median(np.abs(line.column_px - COLUMNS))
    assert before > 0.3
    unsure, sure = (by_clean_flanks(image, PARAMS, line.column_px, usual, ALL) for usual in (UNSURE, SURE))
    assert np.median(np.abs(line.column_px + unsure.by - COLUMNS)) > 0.8 * before
    assert np.median(np.abs(line.column_px + sure.by - COLUMNS)) < 0.4 * before


@pytest.mark.parametrize("kind", ["whole", "narrow", "wide"])
@pytest.mark.parametrize("quality", [None, 85])
@pytest.mark.parametrize("usual", [UNSURE, SURE])
def test_lines_alike_on_both_sides_stay(kind: str, quality: int | None, usual: Usual) -> None:
    for seed in range(5):
        image = drawn(light(kind), COLUMNS, seed)
        if quality is not None:
            data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
            image = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
        line = find_laser_line(image, PARAMS)
        moved = by_clean_flanks(image, PARAMS, line.column_px, usual, ALL)
        assert not moved.by.any()


def test_noise_that_hides_which_flank_is_clean_moves_nothing() -> None:
    image = drawn(0.35 * light("joint"), COLUMNS, noise=6.0)
    line = find_laser_line(image, PARAMS)
    assert np.isfinite(line.column_px).mean() > 0.5
    moved = by_clean_flanks(image, PARAMS, line.column_px, UNSURE, ALL)
    assert (moved.by != 0.0).mean() < 0.1


def test_a_laser_off_frame_is_taken_away_first() -> None:
    room = 60.0 * (np.arange(WIDTH) > 258)[None, :].repeat(HEIGHT, axis=0)
    off = np.clip(np.random.default_rng(8).normal(LEVEL + room, 2.0), 0, 255).astype(np.uint8)
    columns = np.full(HEIGHT, 250.3)
    image = np.clip(drawn(light("joint", -1), columns) + room, 0, 255).astype(np.uint8)
    line = find_laser_line(image, PARAMS, off)
    moved = by_clean_flanks(image, PARAMS, line.column_px, UNSURE, ALL, background=off)
    error = np.abs(line.column_px - columns), np.abs(line.column_px + moved.by - columns)
    assert np.median(error[0]) > 0.4
    assert np.median(error[1]) < 0.4 * np.median(error[0])


def head() -> Calibration:
    return CalibrationFile(
        image=ImageTable(width=WIDTH, height=HEIGHT), head=HeadTable(baseline_m=0.2, beta_deg=22.0, alpha_deg=30.0)
    ).build()


def wall_columns(calibration: Calibration, bearing: float, wall_y: float) -> F64:
    """Columns (H,) in which the laser's plane is seen on a wall at so much y [m]."""
    column, row = np.meshgrid(np.linspace(0.0, WIDTH - 1.0, 900), np.arange(HEIGHT, dtype=np.float64))
    points = locate(column.ravel(), row.ravel(), calibration, TriangulationParams(range_max_m=50.0))[0]
    y = transform(calibration.mount.T_world_head(bearing), points)[:, 1].reshape(column.shape)
    order = np.argsort(np.where(np.isfinite(y), y, np.inf), axis=1)
    return np.array([np.interp(wall_y, y[k, order[k]], column[k, order[k]]) for k in range(HEIGHT)])


# Each bearing sees a panel that stands before or behind the next ones', so that no plane tells anything [m].
PANELS_Y = 1.7 + 0.13 * (3 * np.arange(11) % 5)
JOINT = 5


def swept(joint: int = JOINT, lost: int = -1, params: LaserLineParams = PARAMS) -> Scan:
    """A sweep of the panels after the second look; a joint runs along the line of one, a picture is lost before it."""
    calibration, shots = head(), []
    for k, bearing in enumerate(np.radians(np.arange(70.0, 111.0, 4.0))):
        picture = drawn(
            light("joint" if k == joint else "whole"), wall_columns(calibration, float(bearing), PANELS_Y[k]), k
        )
        image = bytes(cv2.imencode(".png", picture)[1])
        shots.append(Shot(k, float(bearing), float(bearing), float(k), image, None))
    pipeline = Pipeline(calibration, params, TriangulationParams())
    scan, second = Scan(calibration.mount, HEIGHT), SecondLook(pipeline)
    run(shots, pipeline.process, [lambda step: scan.add(step.profile, step.shot.bearing), second], workers=1)
    if lost >= 0:
        shots[lost] = replace(shots[lost], image=b"")
    second.settle(scan, lambda: shots)
    return scan


def off_panel(scan: Scan) -> float:
    """How far the points of the bearing with the joint are off its panel, in the median [m]."""
    assert scan.valid[JOINT].mean() > 0.9
    return float(np.nanmedian(np.abs(scan.points[JOINT, :, 1].astype(np.float64) - PANELS_Y[JOINT])))


def test_a_sweep_tells_the_usual_width_and_moves_the_points() -> None:
    scan, plain, lost = swept(), swept(-1), swept(lost=JOINT)
    others = [k for k in range(len(scan)) if k != JOINT]
    assert np.array_equal(scan.column_px[others], plain.column_px[others], equal_nan=True)
    # A picture that cannot be read again leaves its points where they were, which their sigma allows for.
    assert off_panel(lost) > 0.008
    assert 0.3 * off_panel(lost) < np.nanmedian(lost.sigma_m[JOINT]) < 2.0 * off_panel(lost)
    assert off_panel(scan) < 0.3 * off_panel(lost)
    assert np.nanmedian(scan.sigma_m[JOINT]) > 2.0 * np.nanmedian(plain.sigma_m[JOINT])
    assert np.nanmedian(scan.sigma_m[JOINT]) < 0.5 * np.nanmedian(lost.sigma_m[JOINT])
    # Range, place and column of a moved point belong together.
    known = scan.valid[JOINT]
    rows = np.flatnonzero(known).astype(np.float64)
    own = locate(scan.column_px[JOINT, known].astype(np.float64), rows, head(), TriangulationParams())[0]
    T = scan.mount.T_world_head(float(scan.bearings[JOINT]))
    assert np.allclose(scan.points[JOINT, known], transform(T, own), atol=1e-5)
    assert np.allclose(scan.range_m[JOINT, known], np.linalg.norm(own, axis=1), atol=1e-5)


def test_the_centre_of_gravity_stays_the_thesis_s() -> None:
    params = PARAMS.model_copy(update={"method": "cog", "pool_rows": 1})
    scan, again = swept(params=params), swept(lost=JOINT, params=params)
    assert np.array_equal(scan.column_px, again.column_px, equal_nan=True)
