"""Intrinsics from boards: against a known camera, with bad views among good ones, and on real photographs."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from boards_by_projection import Head, picture_of, random_pose, seen, view_of

from scanmap.calibration.uncertainty import INTRINSICS, parameters_of
from scanmap.errors import CalibrationError
from scanmap.geometry import rigid
from scanmap.session.calibrating import BoardJob, solve_camera
from scanmap.solvers.board import parse_board
from scanmap.solvers.coverage import coverage_of, is_new, progress_of
from scanmap.solvers.detection import View, find_board
from scanmap.solvers.intrinsics import calibrate_camera
from scanmap.solvers.pictures import Picture, collect

BOARD = parse_board("chessboard:9x6:30mm")
HEAD = Head()
SIZE = (HEAD.width, HEAD.height)
TRUTH = parameters_of(HEAD.truth(), INTRINSICS)


def views(seed: int, count: int = 20, sigma_px: float = 0.05) -> list[View]:
    rng = np.random.default_rng(seed)
    poses = [random_pose(HEAD, BOARD, rng, near=0.3, far=0.7) for _ in range(count)]
    return [view_of(HEAD, BOARD, T, rng, sigma_px) for T in poses]


@pytest.mark.parametrize("seed", range(4))
def test_a_known_camera_comes_back_within_what_is_stated(seed: int) -> None:
    fit = calibrate_camera(views(seed), BOARD, SIZE)
    off = parameters_of(HEAD.truth(), INTRINSICS) * 0 + [
        fit.intrinsics.fx, fit.intrinsics.fy, fit.intrinsics.cx, fit.intrinsics.cy, *fit.intrinsics.distortion,
    ] - TRUTH  # fmt: skip
    assert abs(off[0] / TRUTH[0]) < 1e-3
    assert abs(off[1] / TRUTH[1]) < 1e-3
    sigma = [fit.uncertainty.sigma(name) for name in INTRINSICS]
    assert (np.abs(off) < 3.5 * np.array(sigma)).all()
    assert fit.rms_px == pytest.approx(0.05 * np.sqrt(2), rel=0.1)


def test_stated_sigma_is_the_spread_over_seeds() -> None:
    found, stated = [], []
    for seed in range(12):
        fit = calibrate_camera(views(100 + seed), BOARD, SIZE)
        found.append([fit.intrinsics.fx, fit.intrinsics.cx, fit.intrinsics.cy])
        stated.append([fit.uncertainty.sigma(name) for name in ("fx", "cx", "cy")])
    spread = np.sqrt(((np.array(found) - TRUTH[[0, 2, 3]]) ** 2).mean(axis=0))
    ratio = spread / np.sqrt((np.array(stated) ** 2).mean(axis=0))
    # The spread of 12 draws is itself known to 20 %.
    assert ((ratio > 0.5) & (ratio < 1.7)).all()


def test_one_wrong_view_is_found_and_named() -> None:
    good = views(7)
    rng = np.random.default_rng(8)
    bent = good[5].corners + rng.normal(0, 3.0, good[5].corners.shape)
    bad = good[5]._replace(name="the wrong one", corners=bent)
    fit = calibrate_camera([*good[:5], bad, *good[6:]], BOARD, SIZE)
    assert [each.name for each in fit.rejected] == ["the wrong one"]
    assert abs(fit.intrinsics.fx / TRUTH[0] - 1.0) < 1e-3


def test_too_few_views_say_how_many_are_needed() -> None:
    with pytest.raises(CalibrationError, match=r"5 usable views; at least 8"):
        calibrate_camera(views(1, 5), BOARD, SIZE)


def test_parallel_boards_are_refused_by_name() -> None:
    rng = np.random.default_rng(3)
    flat = []
    for _ in range(15):
        shift = [rng.uniform(-0.15, 0.0), rng.uniform(-0.1, 0.0), rng.uniform(0.5, 0.6)]
        flat.append(view_of(HEAD, BOARD, rigid(np.eye(3), shift), rng, 0.05))
    with pytest.raises(CalibrationError, match="parallel"):
        calibrate_camera(flat, BOARD, SIZE)


def test_views_of_different_boards_are_refused() -> None:
    rng = np.random.default_rng(5)
    wrong = [v._replace(corners=v.corners + rng.normal(0, 6.0, v.corners.shape)) for v in views(4)]
    with pytest.raises(CalibrationError, match=r"over the gate|contradict"):
        calibrate_camera(wrong, BOARD, SIZE)


def test_guidance_asks_for_what_is_missing() -> None:
    rng = np.random.default_rng(6)
    left = [view_of(HEAD, BOARD, rigid(np.eye(3), [-0.35, rng.uniform(-0.2, 0.0), 0.6]), rng, 0.05) for _ in range(12)]
    asked = progress_of(left, BOARD, SIZE).wishes
    assert "8 more views" in asked[0]
    assert any("tilt" in each for each in asked)
    assert any("right" in each for each in asked)
    assert progress_of(views(9, 30), BOARD, SIZE).wishes == []


def test_coverage_counts_corners_where_they_are() -> None:
    T = rigid(np.eye(3), [-0.1, -0.1, 0.5])
    view = view_of(HEAD, BOARD, T, np.random.default_rng(0), 0.0)
    counts = coverage_of([view], SIZE).counts
    assert counts.sum() == len(BOARD.points)
    u, v = seen(HEAD, BOARD.points[:1] + T[:3, 3])[0]
    assert counts[int(v // (1200 / 6)), int(u // (1600 / 8))] > 0


def test_the_same_view_again_is_not_new() -> None:
    one, other = views(10, 2)
    again = one._replace(corners=one.corners + 1.0)
    assert not is_new(again, [other, one], HEAD.width)
    assert is_new(other, [one], HEAD.width)


def test_pictures_of_another_size_and_without_board_are_rejected_with_reasons() -> None:
    small = Head().small()
    board = parse_board("chessboard:8x6:30mm")
    rng = np.random.default_rng(11)
    picture = picture_of(small, board, random_pose(small, board, rng), rng, samples=2)
    empty, large = np.full_like(picture, 90), np.zeros((600, 800, 3), np.uint8)
    found = collect([Picture("good", picture), Picture("empty", empty), Picture("large", large)], board)
    assert [view.name for view in found.views] == ["good"]
    assert [(each.name, each.reason) for each in found.rejected] == [
        ("empty", "no board found"), ("large", "is 800x600, the first 640x480; leave out what another camera took"),
    ]  # fmt: skip


def test_a_board_that_is_not_there_at_all_says_what_is() -> None:
    small = Head().small()
    rng = np.random.default_rng(12)
    board = parse_board("chessboard:8x6:30mm")
    picture = picture_of(small, board, random_pose(small, board, rng), rng, samples=2)
    found = collect([Picture("one", picture)], parse_board("chessboard:9x7:30mm"))
    with pytest.raises(CalibrationError, match="chessboard:8x6:30mm"):
        found.require()


@pytest.mark.slow
def test_rendered_pictures_give_the_camera_back() -> None:
    head = Head().small()
    rng = np.random.default_rng(21)
    found = []
    while len(found) < 20:
        picture = picture_of(head, BOARD, random_pose(head, BOARD, rng, near=0.3, far=0.6), rng)
        view = find_board(picture, BOARD, str(len(found)))
        if isinstance(view, View):
            found.append(view)
    fit = calibrate_camera(found, BOARD, (head.width, head.height))
    truth = parameters_of(head.truth(), INTRINSICS)
    assert abs(fit.intrinsics.fx / truth[0] - 1) < max(1e-3, 3 * fit.uncertainty.sigma("fx") / truth[0])
    assert fit.rms_px < 0.15


@pytest.mark.slow
def test_stated_covariance_is_the_spread_over_fifty_seeds() -> None:
    found, stated = [], []
    for seed in range(50):
        fit = calibrate_camera(views(1000 + seed), BOARD, SIZE)
        own = fit.intrinsics
        found.append([own.fx, own.fy, own.cx, own.cy, *own.distortion])
        stated.append(fit.uncertainty.matrix)
    off = np.array(found) - TRUTH
    ratio = np.sqrt((off**2).mean(axis=0) / np.mean([np.diag(m) for m in stated], axis=0))
    # A spread of 50 draws is known to 10 %.
    assert ((ratio > 0.7) & (ratio < 1.35)).all()
    # Mahalanobis distance of nine parameters.
    distance = np.mean([e @ np.linalg.solve(m, e) for e, m in zip(off, stated, strict=True)])
    assert 6.5 < distance < 12.5


def test_real_photographs(data: Path) -> None:
    from scanmap import config as configuration

    folder = data / "real" / "srv-calib" / "camera"
    board = parse_board("chessboard:8x6:40mm")
    solved = solve_camera(BoardJob(str(folder), board, configuration.load(None)), None)
    own = solved.calibration.intrinsics
    assert len(solved.fit.views) == 27
    assert solved.fit.rms_px <= 0.16
    # The independent refit, within three stated sigmas of ours.
    for name, value, here in (
        ("fx", 621.1, own.fx),
        ("fy", 619.4, own.fy),
        ("cx", 323.0, own.cx),
        ("cy", 239.4, own.cy),
    ):
        assert abs(here - value) < 3 * solved.fit.uncertainty.sigma(name)
    assert (own.width, own.height) == (640, 480)
    assert cv2.imread(str(folder / "Image100.jpg")).shape == (480, 640, 3)
