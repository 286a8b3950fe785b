"""The rotation axis from a board that stands still: against a known head, and what must be refused."""

from dataclasses import replace

import numpy as np
import pytest
from boards_by_projection import Head, axis_views, random_pose, view_of

from scanmap.calibration import moved, uncertainty_of
from scanmap.calibration.uncertainty import INTRINSICS, MOUNT, Uncertainty, parameters_of
from scanmap.errors import CalibrationError
from scanmap.geometry import HeadMount
from scanmap.solvers.axis import SOLVED, calibrate_axis, with_axis
from scanmap.solvers.board import parse_board
from scanmap.solvers.intrinsics import calibrate_camera

BOARD = parse_board("chessboard:9x6:30mm")
CHARUCO = parse_board("charuco:9x6:30mm:22mm")
HEAD = Head()
TRUTH = HEAD.truth()
BLANK = replace(TRUTH, mount=HeadMount())
BEARINGS = np.radians(np.arange(-30.0, 31.0, 3.0))


def views(seed: int, **more):
    return axis_views(HEAD, more.pop("board", BOARD), BEARINGS, np.random.default_rng(seed), 0.05, away=0.45, **more)


@pytest.mark.parametrize("board", [BOARD, CHARUCO], ids=["chessboard", "charuco"])
def test_a_known_axis_comes_back_within_what_is_stated(board) -> None:
    fit = calibrate_axis(views(1, board=board), board, BLANK)
    made = with_axis(replace(BLANK, covariance={}), fit)
    off = parameters_of(made, SOLVED) - parameters_of(TRUTH, SOLVED)
    assert np.abs(off[:2]).max() < 1e-4
    assert np.degrees(np.abs(off[2:])).max() < 0.02
    known = uncertainty_of(made)
    assert known is not None
    assert (np.abs(off) < 4.0 * np.array([known.sigma(name) for name in SOLVED])).all()
    assert fit.turn == pytest.approx(1.0, abs=1e-3)
    assert made.mount.offset_m[2] == BLANK.mount.offset_m[2]


def test_corners_numbered_upside_down_are_turned_round() -> None:
    rng = np.random.default_rng(2)
    mixed = []
    for view in views(2):
        flip = rng.random() < 0.5
        mixed.append(view._replace(corners=view.corners[::-1].copy()) if flip else view)
    fit = calibrate_axis(mixed, BOARD, BLANK)
    off = parameters_of(replace(BLANK, mount=fit.mount), MOUNT) - parameters_of(TRUTH, MOUNT)
    assert np.abs(off[:2]).max() < 2e-4


def test_a_motor_that_turns_the_other_way_is_named() -> None:
    with pytest.raises(CalibrationError, match="wrong way"):
        calibrate_axis(views(3, sign=-1.0), BOARD, BLANK)


def test_wrong_steps_per_degree_are_named_with_the_factor() -> None:
    wrong = [view._replace(bearing=view.bearing / 1.25) for view in views(4)]
    with pytest.raises(CalibrationError, match=r"turns 1\.25\d? deg for every degree"):
        calibrate_axis(wrong, BOARD, BLANK)


def test_one_moved_board_is_found_and_named() -> None:
    some = views(5)
    some[3] = some[3]._replace(name="moved", corners=some[3].corners + np.array([15.0, -8.0]))
    fit = calibrate_axis(some, BOARD, BLANK)
    assert [each.name for each in fit.rejected] == ["moved"]
    off = parameters_of(replace(BLANK, mount=fit.mount), MOUNT) - parameters_of(TRUTH, MOUNT)
    assert np.abs(off[:2]).max() < 2e-4


def test_too_small_a_turn_and_pictures_without_bearings_are_refused() -> None:
    some = views(6)
    with pytest.raises(CalibrationError, match=r"over 12.0 deg of bearing; at least 15"):
        calibrate_axis(some[:5], BOARD, BLANK)
    with pytest.raises(CalibrationError, match="usable in 3 pictures"):
        calibrate_axis(some[:3], BOARD, BLANK)
    with pytest.raises(CalibrationError, match="without bearings"):
        calibrate_axis([view._replace(bearing=float("nan")) for view in some], BOARD, BLANK)


def test_a_focal_length_that_is_wrong_is_in_the_stated_slope() -> None:
    some = views(7)
    fit = calibrate_axis(some, BOARD, BLANK)
    here = parameters_of(replace(BLANK, mount=fit.mount), SOLVED)
    for name, by in (("fx", 2.0), ("cy", 2.0)):
        other = calibrate_axis(some, BOARD, moved(BLANK, [name], np.array([by])))
        change = parameters_of(replace(BLANK, mount=other.mount), SOLVED) - here
        predicted = by * fit.slope[:, INTRINSICS.index(name)]
        np.testing.assert_allclose(change, predicted, atol=0.15 * np.abs(change).max() + 1e-6)


def test_the_camera_uncertainty_enters_the_axis() -> None:
    fit = calibrate_axis(views(8), BOARD, BLANK)
    unsure = Uncertainty(INTRINSICS, np.diag([4.0, 4.0, 1.0, 1.0, 1e-6, 1e-6, 1e-9, 1e-9, 1e-6]))
    alone = uncertainty_of(with_axis(replace(BLANK, covariance={}), fit))
    both = uncertainty_of(with_axis(replace(BLANK, covariance=unsure.table()), fit))
    assert alone is not None
    assert both is not None
    assert both.sigma("offset_x") > 2.0 * alone.sigma("offset_x")


def held(sigma_px: float):
    """A camera known to so much, in every way that counts as much as that."""
    own = np.array([sigma_px, sigma_px, sigma_px, sigma_px, 1e-3, 1e-3, 1e-4, 1e-4, 1e-3])
    return Uncertainty(INTRINSICS, np.diag(own**2)).table()


def test_the_bearings_tell_part_of_a_focal_length_that_is_off() -> None:
    off = []
    for seed in range(6):
        some = axis_views(HEAD, BOARD, BEARINGS, np.random.default_rng(60 + seed), 0.05, away=0.3)
        wrong = moved(BLANK, ["fx", "fy"], np.array([1.0, 1.0]))
        both = [calibrate_axis(some, BOARD, replace(wrong, covariance=cov)) for cov in (held(1.0), {})]
        assert all(fit.agrees for fit in both)
        off.append([parameters_of(replace(BLANK, mount=f.mount), SOLVED) - parameters_of(TRUTH, SOLVED) for f in both])
    joint, fixed = np.sqrt((np.array(off)[:, :, :2] ** 2).mean(axis=(0, 2)))
    assert joint < 0.75 * fixed


def test_a_joint_result_moves_with_the_camera_as_stated() -> None:
    some = views(7)
    known = replace(BLANK, covariance=held(0.3))
    fit = calibrate_axis(some, BOARD, known)
    here = parameters_of(replace(BLANK, mount=fit.mount), SOLVED)
    for name, by in (("fx", 0.5), ("cy", 0.5)):
        other = calibrate_axis(some, BOARD, moved(known, [name], np.array([by])))
        change = parameters_of(replace(BLANK, mount=other.mount), SOLVED) - here
        predicted = by * fit.slope[:, INTRINSICS.index(name)]
        np.testing.assert_allclose(change, predicted, atol=0.15 * np.abs(change).max() + 1e-6)


def test_a_camera_that_the_turn_contradicts_is_not_bent_to_fit() -> None:
    wrong = moved(replace(BLANK, covariance=held(0.01)), ["fx", "fy"], np.array([12.0, 12.0]))
    some = views(9)
    fit = calibrate_axis(some, BOARD, wrong)
    assert not fit.agrees
    alone = calibrate_axis(some, BOARD, replace(wrong, covariance={}))
    assert fit.mount == alone.mount


@pytest.mark.slow
def test_the_chain_is_within_a_tenth_of_a_millimetre_over_fifty_seeds() -> None:
    """Camera from 20 views, axis with the board at 0.3 m, corners with 0.05 px of noise throughout."""
    truth = parameters_of(TRUTH, SOLVED)
    off, stated = [], []
    for seed in range(50):
        rng = np.random.default_rng(seed)
        poses = [random_pose(HEAD, BOARD, rng, near=0.3, far=0.7) for _ in range(20)]
        camera = calibrate_camera([view_of(HEAD, BOARD, T, rng, 0.05) for T in poses], BOARD, (1600, 1200))
        known = replace(BLANK, intrinsics=camera.intrinsics, covariance=camera.uncertainty.table())
        some = axis_views(HEAD, BOARD, np.radians(np.arange(-30.0, 31.0, 1.5)), rng, 0.05, away=0.3)
        made = with_axis(known, calibrate_axis(some, BOARD, known))
        off.append(parameters_of(made, SOLVED) - truth)
        sure = uncertainty_of(made)
        assert sure is not None
        stated.append([sure.sigma(name) for name in SOLVED])
    errors = np.array(off)
    assert (np.abs(errors[:, :2]) < 1e-4).mean() >= 0.98
    assert np.degrees(np.abs(errors[:, 2:])).max() < 0.02
    ratio = np.sqrt((errors**2).mean(axis=0) / np.square(stated).mean(axis=0))
    assert ((ratio > 0.7) & (ratio < 1.35)).all()


@pytest.mark.slow
def test_stated_covariance_is_the_spread_over_fifty_seeds() -> None:
    truth = parameters_of(TRUTH, SOLVED)
    off, stated = [], []
    for seed in range(50):
        fit = calibrate_axis(views(3000 + seed), BOARD, BLANK)
        off.append(parameters_of(replace(BLANK, mount=fit.mount), SOLVED) - truth)
        stated.append(np.diag(fit.own))
    ratio = np.sqrt((np.array(off) ** 2).mean(axis=0) / np.mean(stated, axis=0))
    assert ((ratio > 0.7) & (ratio < 1.35)).all()
