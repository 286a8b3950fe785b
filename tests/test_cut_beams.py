"""Lines whose beam an edge cut: a drawn wall, the laser's sheet truncated sample by sample, whole pictures through."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from scanmap.calibration import Calibration, CalibrationFile, HeadTable, ImageTable
from scanmap.geometry import transform
from scanmap.laserline import LaserLineParams
from scanmap.pipeline import Pipeline, SecondLook, run
from scanmap.scan import Scan
from scanmap.shot import Shot
from scanmap.triangulation import TriangulationParams, locate

F64 = NDArray[np.float64]

WIDTH, HEIGHT = 640, 160
BEARINGS = np.radians(np.arange(60.0, 121.0, 4.0))
WALL_Y, POST_Y = 2.0, 1.6
CUT = 8  # the bearing whose beam is cut, and its rows
ROWS = slice(30, 120)
BEAM_PX, PSF_PX, HEIGHT_OF_LINE = 1.3, 0.8, 110.0


def head(baseline_m: float = 0.2) -> Calibration:
    return CalibrationFile(
        image=ImageTable(width=WIDTH, height=HEIGHT),
        head=HeadTable(baseline_m=baseline_m, beta_deg=22.0, alpha_deg=30.0),
    ).build()


def wall_columns(calibration: Calibration, bearing: float, wall_y: float = WALL_Y) -> F64:
    """Columns (H,) in which the middle of the laser's sheet on a wall is seen."""
    column, row = np.meshgrid(np.linspace(0.0, WIDTH - 1.0, 900), np.arange(HEIGHT, dtype=np.float64))
    points = locate(column.ravel(), row.ravel(), calibration, TriangulationParams(range_max_m=50.0))[0]
    y = transform(calibration.mount.T_world_head(bearing), points)[:, 1].reshape(column.shape)
    found = np.full(HEIGHT, np.nan)
    for k in range(HEIGHT):
        known = np.isfinite(y[k])
        order = np.argsort(y[k, known])
        found[k] = np.interp(wall_y, y[k, known][order], column[k, known][order], left=np.nan, right=np.nan)
    return found


def cut_beam(share: float, side: float) -> tuple[F64, F64]:
    """Places [px] and weights of a Gaussian sheet of which one `side` is gone, and so much is left."""
    place = np.linspace(-5.0, 5.0, 4001) * BEAM_PX
    weight = np.exp(-0.5 * (place / BEAM_PX) ** 2)
    whole = weight.sum()
    below = np.cumsum(weight) / whole
    weight[(below > share) if side > 0 else (below < 1.0 - share)] = 0.0
    return place, weight / whole


def profile(column: float, beam: tuple[F64, F64]) -> F64:
    """Grey levels (W,) of a line whose sheet's middle is seen at `column`."""
    x = np.arange(WIDTH, dtype=np.float64)
    level = np.zeros(WIDTH)
    width = np.hypot(BEAM_PX, PSF_PX)
    near = np.abs(x - column) < 12
    spread = np.exp(-0.5 * ((x[near, None] - column - beam[0]) / PSF_PX) ** 2)
    level[near] = HEIGHT_OF_LINE * (spread @ beam[1]) * width / PSF_PX
    return level


def as_png(picture: F64) -> bytes:
    return bytes(cv2.imencode(".png", np.clip(np.rint(picture), 0, 255).astype(np.uint8))[1])


def swept(calibration: Calibration, drawn: dict[int, list[F64 | None]], off: bool = False) -> Scan:
    """A sweep of the wall after the second look; `drawn` replaces rows (H,) of some bearings' pictures.

    With `off` there are laser-off frames.
    """
    rng = np.random.default_rng(5)
    whole = cut_beam(1.0, 1.0)
    shots = []
    for k, bearing in enumerate(map(float, BEARINGS)):
        picture = rng.normal(20.0, 2.0, (HEIGHT, WIDTH))
        for row, column in enumerate(wall_columns(calibration, bearing)):
            own = drawn.get(k, [np.empty(0)] * HEIGHT)[row]
            if own is not None and np.isfinite(column):
                picture[row] += own if own.size else profile(column, whole)
        background = as_png(rng.normal(20.0, 2.0, (HEIGHT, WIDTH))) if off else None
        shots.append(Shot(k, bearing, bearing, float(k), as_png(picture), background))
    pipeline = Pipeline(calibration, LaserLineParams(grey="luminance_601"), TriangulationParams())
    scan, second = Scan(calibration.mount, HEIGHT), SecondLook(pipeline)
    run(shots, pipeline.process, [lambda step: scan.add(step.profile, step.shot.bearing), second], workers=1)
    second.settle(scan, lambda: shots)
    return scan


def rows_of(
    calibration: Calibration, beam: tuple[F64, F64], scale: float = 1.0, moved_px: float = 0.0
) -> list[F64 | None]:
    columns = wall_columns(calibration, float(BEARINGS[CUT]))
    inside = range(*ROWS.indices(HEIGHT))
    return [scale * profile(columns[k] + moved_px, beam) if k in inside else np.empty(0) for k in range(HEIGHT)]


def off_wall(scan: Scan) -> F64:
    """How far (n,) [m] the points of the rows in question are off the wall, of those there are."""
    y = scan.points[CUT, ROWS, 1].astype(np.float64)
    assert np.isfinite(y).mean() > 0.9
    return y[np.isfinite(y)] - WALL_Y


def post(side: int) -> dict[int, list[F64 | None]]:
    """The bearing on one side of the cut one: a black post stands before the wall in its rows."""
    inside = range(*ROWS.indices(HEIGHT))
    return {CUT + side: [None if k in inside else np.empty(0) for k in range(HEIGHT)]}


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(
    ("beam_px", "psf_px", "share"),
    [(1.3, 0.8, 0.25), (1.3, 0.8, 0.5), (1.3, 0.8, 0.75), (2.6, 0.6, 0.25), (2.6, 0.6, 0.5)],
)
def test_what_is_left_of_a_cut_beam_is_put_back(
    share: float, side: int, beam_px: float, psf_px: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{__name__}.BEAM_PX", beam_px)
    monkeypatch.setattr(f"{__name__}.PSF_PX", psf_px)
    calibration = head()
    # Greater bearings are to the left in the picture: what the post on that side takes is the beam's left part.
    beam = cut_beam(share, float(-side))
    lost = {**post(side), CUT: rows_of(calibration, beam)}
    place, weight = beam
    moved_px = float(place @ weight / weight.sum())
    columns = wall_columns(calibration, float(BEARINGS[CUT]))[ROWS]
    row = np.arange(HEIGHT, dtype=np.float64)[ROWS]
    seen = locate(columns + moved_px, row, calibration, TriangulationParams())[0]
    before = float(np.median(transform(calibration.mount.T_world_head(float(BEARINGS[CUT])), seen)[:, 1] - WALL_Y))
    assert abs(before) > 0.008
    scan = swept(calibration, lost)
    off = off_wall(scan)
    assert abs(np.median(off)) < 0.2 * abs(before)
    # What stays unknown is in sigma, and not in that of other bearings.
    sigma = np.nanmedian(scan.sigma_m[CUT, ROWS])
    assert 0.15 * abs(before) < sigma < 0.8 * abs(before)
    assert np.nanmedian(scan.sigma_m[CUT + 3 * -side, ROWS]) < 0.5 * sigma


def unmoved(calibration: Calibration, rows: list[F64 | None], moved_px: float) -> None:
    """Assert that rows so drawn stay where they are seen, beside a post."""
    scan = swept(calibration, {**post(1), CUT: rows})
    columns = wall_columns(calibration, float(BEARINGS[CUT]))[ROWS] + moved_px
    known = np.isfinite(scan.column_px[CUT, ROWS])
    assert known.mean() > 0.9
    assert np.abs(scan.column_px[CUT, ROWS] - columns)[known].max() < 0.5
    assert abs(np.nanmedian(scan.column_px[CUT, ROWS] - columns)) < 0.05


def test_dark_paint_moves_nothing() -> None:
    calibration = head()
    unmoved(calibration, rows_of(calibration, cut_beam(1.0, 1.0), 0.4), 0.0)


def test_a_step_in_the_wall_moves_nothing() -> None:
    calibration = head()
    unmoved(calibration, rows_of(calibration, cut_beam(1.0, 1.0), 0.5, 0.8), 0.8)


def test_a_narrower_line_that_is_where_it_should_be_stays() -> None:
    calibration = head()
    place, weight = cut_beam(1.0, 1.0)
    thin = 0.6 * place, weight
    unmoved(calibration, rows_of(calibration, thin, 0.7), 0.0)


@pytest.mark.parametrize("moved_px", [-0.9, 2.0])
def test_another_face_darker_and_narrower_stays(moved_px: float) -> None:
    calibration = head()
    place, weight = cut_beam(1.0, 1.0)
    # What a post on the greater bearings' side leaves of a beam lies to the right of it, by less than that.
    thin = 0.6 * place, weight
    unmoved(calibration, rows_of(calibration, thin, 0.6, moved_px), moved_px)


def test_a_line_narrower_than_any_beam_leaves_stays() -> None:
    calibration = head()
    place, weight = cut_beam(1.0, 1.0)
    unmoved(calibration, rows_of(calibration, (0.1 * place, weight), 0.75, 0.9), 0.9)


def post_alone(beam: tuple[F64, F64], off: bool = False) -> tuple[F64, F64]:
    """How far the points of a post that one bearing alone meets are off it [m], and their sigmas, by its beam."""
    calibration = head()
    columns = wall_columns(calibration, float(BEARINGS[CUT]), POST_Y)
    inside = range(*ROWS.indices(HEIGHT))
    drawn: list[F64 | None] = [profile(columns[k], beam) if k in inside else np.empty(0) for k in range(HEIGHT)]
    scan = swept(calibration, {CUT: drawn}, off)
    found = np.flatnonzero(scan.valid[CUT, ROWS])
    assert len(found) > 0.9 * len(inside)
    return scan.points[CUT, ROWS][found, 1].astype(np.float64) - POST_Y, scan.sigma_m[CUT, ROWS][found].astype(
        np.float64
    )


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize(("share", "most"), [(0.2, 2.3), (0.35, 1.8)])
def test_where_nothing_tells_what_part_of_a_beam_is_left_sigma_says_how_far_it_may_be_off(
    share: float, most: float, side: float
) -> None:
    """Of blur, which no edge takes from a line, nothing is known: the less is left of a beam, the less sigma says."""
    off, sigma = post_alone(cut_beam(share, side))
    assert abs(np.median(off)) > 0.008
    assert 0.5 < np.median(np.abs(off) / sigma) < most


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("share", [0.5, 0.65])
def test_where_enough_of_a_beam_is_left_its_flank_tells(share: float, side: float) -> None:
    off, sigma = post_alone(cut_beam(share, side))
    assert np.median(np.abs(off) / sigma) < 1.8


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("share", [0.35, 0.5, 0.65])
def test_with_a_laser_off_frame_its_lean_tells_what_part_of_a_beam_is_left(share: float, side: float) -> None:
    beam = cut_beam(share, side)
    calibration, row = head(), np.arange(HEIGHT, dtype=np.float64)[ROWS]
    columns = wall_columns(calibration, float(BEARINGS[CUT]), POST_Y)[ROWS] + float(
        np.average(beam[0], weights=beam[1])
    )
    T = calibration.mount.T_world_head(float(BEARINGS[CUT]))
    seen = transform(T, locate(columns, row, calibration, TriangulationParams())[0])
    before = abs(float(np.median(seen[:, 1])) - POST_Y)
    off, sigma = post_alone(beam, off=True)
    assert before > 0.01
    assert abs(np.median(off)) < 0.5 * before
    assert np.sqrt(np.mean(np.square(off / sigma))) < 1.5


def test_what_leans_for_another_reason_stays_with_a_laser_off_frame() -> None:
    """A thin bright line, and the same in a gloss that is brighter on one side."""
    place, weight = cut_beam(1.0, 1.0)
    thin = 0.6 * place, weight
    gloss = 0.3 * np.exp(-0.5 * np.square((place / BEAM_PX - 0.6) / 1.8)) * weight.max()
    glossy = np.concatenate([0.6 * place, place]), np.concatenate([weight, gloss])
    for beam in (thin, glossy):
        without, off = (np.median(post_alone(beam, off)[0]) for off in (False, True))
        assert abs(off - without) < 0.002


def test_a_whole_beam_on_a_post_is_as_sure_as_any() -> None:
    off, sigma = post_alone(cut_beam(1.0, 1.0))
    assert np.sqrt(np.mean(np.square(off / sigma))) < 1.5
    assert np.median(sigma) < 0.004
