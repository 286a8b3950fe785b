"""What surfaces do from one bearing to the next, against walls, rods and things that stand still."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from test_second_look import BEARINGS, BRIGHT, HEIGHT, SEEN, TUBE, WALL_Y, WIDTH, drawn, head, tube

from scanmap.calibration import Calibration
from scanmap.laserline import LaserLineParams, ridge_of, ridges
from scanmap.pipeline import Pipeline, SecondLook, run
from scanmap.pipeline.neighbours import Neighbours, neighbours_of
from scanmap.pipeline.second_look import _hidden
from scanmap.pipeline.still import SHARE
from scanmap.scan import Scan
from scanmap.shot import Shot
from scanmap.triangulation import TriangulationParams

F64 = NDArray[np.float64]
PARAMS = LaserLineParams(grey="luminance_601")


def wall(step_deg: float, turns: int = 9) -> tuple[F64, NDArray[np.float32]]:
    """Bearings (B,) and ranges (B, 4) of a wall 2 m away, met within 60 deg of its normal."""
    bearings = np.radians(step_deg * (np.arange(turns) - turns // 2))
    return bearings, np.repeat((2.0 / np.cos(bearings)).astype(np.float32)[:, None], 4, axis=1)


@pytest.mark.parametrize("step_deg", [0.25, 1.0, 6.0, 15.0])
def test_a_wall_goes_on_and_what_lies_before_it_does_not(step_deg: float) -> None:
    bearings, ranges = wall(step_deg)
    ranges[4, 1] = 0.5  # a rod, or no line at all
    ranges[5, 3] = np.nan
    known = neighbours_of(bearings, ranges, range(9))
    at_rod, beside_it = known.share(4, ranges[4]), known.share(3, ranges[3])
    assert at_rod[0] == at_rod[2] == SHARE
    assert at_rod[1] < beside_it[1] < SHARE
    assert beside_it[0] == SHARE
    assert at_rod[3] == SHARE  # not to be there denies nothing


def test_a_full_turn_has_no_ends_and_a_gap_has_two_sides() -> None:
    turn = np.radians(np.arange(0.0, 360.0, 15.0))
    ranges = np.ones((len(turn), 4), np.float32)
    beside = neighbours_of(turn, ranges, range(len(turn))).beside
    assert {k for k, _ in beside[0]} == {1, len(turn) - 1}
    some = [k for k in range(len(turn)) if k not in (2, 3)]
    beside = neighbours_of(turn, ranges, some).beside
    assert [k for k, _ in beside[4]] == [5]
    assert beside[2] == []
    np.testing.assert_allclose([away for k in some for _, away in beside[k]], np.radians(15.0))


def test_a_second_turn_and_a_bracket_are_nobodys_neighbours() -> None:
    one = np.radians(np.arange(0.0, 60.0, 5.0))
    bearings = np.concatenate([one, one, one + 2.0 * np.pi])
    known: Neighbours = neighbours_of(bearings, np.ones((36, 4), np.float32), range(36))
    for k, beside in enumerate(known.beside):
        for other, away in beside:
            assert away == pytest.approx(np.radians(5.0))
            assert abs(other % 12 - k % 12) == 1


def swept(calibration: Calibration, shows: set[int], rod: int | None = None) -> tuple[Scan, SecondLook, list[Shot]]:
    """A wall, a tube that only some of the pictures show, and a rod that the laser meets in one of them."""
    rng = np.random.default_rng(3)
    shots = []
    for k, bearing in enumerate(map(float, BEARINGS)):
        image = drawn(calibration, bearing, [tube(0.6, 1.9)] if k in shows else [], TUBE, rng)
        if k == rod:
            picture = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_GRAYSCALE)
            picture[60:180] = rng.normal(20.0, 2.0, (120, WIDTH)).clip(0, 255)
            picture[60:180] += (BRIGHT * np.exp(-0.5 * ((np.arange(WIDTH) - 420.0) / 1.5) ** 2)).astype(np.uint8)
            image = bytes(cv2.imencode(".png", picture)[1])
        shots.append(Shot(k, bearing, bearing, float(k), image, None))
    pipeline = Pipeline(calibration, PARAMS, TriangulationParams())
    scan, second = Scan(calibration.mount, HEIGHT), SecondLook(pipeline)
    run(shots, pipeline.process, [lambda step: scan.add(step.profile, step.shot.bearing), second], workers=1)
    return scan, second, shots


def off_the_wall(scan: Scan) -> NDArray[np.bool_]:
    """(B, H) points that are not on the wall."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(scan.points[..., 1] - WALL_Y) > 0.1)


def test_a_tube_that_half_the_pictures_show_is_told_by_the_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    shows = {SEEN - 4, SEEN - 2, SEEN, SEEN + 2}
    scan, second, shots = swept(head(), shows)
    alone = scan.taken(np.arange(len(scan)))
    false = int(off_the_wall(scan).sum())
    assert false > 150
    second.settle(scan, lambda: shots)
    assert off_the_wall(scan).sum() < 0.1 * false
    # In most places stands the line now, which the same pictures show: all but close by.
    assert (~off_the_wall(scan) & scan.valid).sum() > (~off_the_wall(alone) & alone.valid).sum() + 0.5 * false
    # The neighbours are what tells.
    monkeypatch.setattr("scanmap.pipeline.neighbours._NEITHER", SHARE)
    monkeypatch.setattr("scanmap.pipeline.neighbours._ONE_SIDE", SHARE)
    scan, second, shots = swept(head(), shows)
    second.settle(scan, lambda: shots)
    assert off_the_wall(scan).sum() > 0.5 * false


@pytest.mark.parametrize("shows", [set(), {SEEN - 4, SEEN - 2, SEEN, SEEN + 2}])
def test_a_rod_that_one_picture_shows_is_kept(shows: set[int]) -> None:
    scan, second, shots = swept(head(), shows, rod=7)
    assert off_the_wall(scan)[7, 64:176].all()
    second.settle(scan, lambda: shots)
    assert off_the_wall(scan)[7, 64:176].all()


def test_the_edge_of_a_bright_pane_is_nothing_that_stands_out() -> None:
    picture = np.full((HEIGHT, WIDTH), 20, np.uint8)
    picture[:, 300:400] = 250
    line = np.rint(20.0 + BRIGHT * np.exp(-0.5 * ((np.arange(WIDTH) - 120.0) / 1.5) ** 2)).astype(np.uint8)
    shown = ridges(np.maximum(picture, line), PARAMS)
    ridge = ridge_of(np.full(HEIGHT, BRIGHT), np.full(HEIGHT, 1.5))
    assert not _hidden(np.full(HEIGHT, 120.0), ridge, shown).any()
    for column in (300.0, 350.0, 399.0):
        assert _hidden(np.full(HEIGHT, column), ridge, shown).all()
        assert _hidden(np.full(HEIGHT, column), np.full(HEIGHT, np.nan), shown).all()
