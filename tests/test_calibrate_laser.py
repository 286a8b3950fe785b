"""The laser plane from boards: against a known head, with bad boards among good ones, and on real photographs."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from boards_by_projection import Head, line_of, picture_of, random_pose, seen, view_of

from scanmap import config as configuration
from scanmap.calibration import Calibration, check_residuals, moved, uncertainty_of
from scanmap.calibration.uncertainty import INTRINSICS, PLANE, Uncertainty, parameters_of
from scanmap.errors import CalibrationError
from scanmap.geometry import rigid
from scanmap.laserline import LaserLineParams
from scanmap.session.calibrating import BoardJob, check_laser, solve_camera, solve_laser, write_calibration
from scanmap.solvers.board import parse_board
from scanmap.solvers.board_line import BoardLine, find_board_line, points_on_board
from scanmap.solvers.detection import Rejected, find_board
from scanmap.solvers.intrinsics import calibrate_camera
from scanmap.solvers.laser_plane import fit_laser_plane, head_frame_of, plane_in_camera, residual_of, with_laser_plane
from scanmap.solvers.pictures import Picture, read_pictures

BOARD = parse_board("chessboard:9x6:30mm")
HEAD = Head()
TRUTH = HEAD.truth()


def lines(seed: int, count: int = 20, near: float = 0.3, far: float = 1.0, board=BOARD) -> list[BoardLine]:
    rng = np.random.default_rng(seed)
    found: list[BoardLine] = []
    while len(found) < count:
        line = line_of(HEAD, board, random_pose(HEAD, board, rng, near=near, far=far), rng, 0.05, 0.1)
        if line is not None:
            found.append(line)
    return found


def ranges(calibration: Calibration, distances: tuple[float, ...]) -> list[float]:
    """Ranges that a calibration gives for columns where the true head sees its laser at these distances."""
    from scanmap.triangulation import TriangulationParams, locate

    points = np.array([[d, 0.0, 0.0] for d in distances])
    along = TRUTH.laser_plane[:3]
    points -= (points @ along + TRUTH.laser_plane[3])[:, None] * along
    T = np.linalg.inv(TRUTH.T_head_camera)
    points_cam = points @ T[:3, :3].T + T[:3, 3]
    pixels = seen(HEAD, points_cam)
    found = locate(pixels[:, 0], pixels[:, 1], calibration, TriangulationParams())[0]
    # From the camera, which every head frame knows.
    away = np.linalg.norm(found - calibration.T_head_camera[:3, 3], axis=1)
    return [float(r) for r in away / np.linalg.norm(points_cam, axis=1)]


@pytest.mark.parametrize("seed", range(3))
def test_a_known_plane_comes_back_and_so_do_ranges(seed: int) -> None:
    fit = fit_laser_plane(lines(seed), BOARD, TRUTH.intrinsics)
    made = with_laser_plane(replace(TRUTH, covariance={}), fit, keep_head=True)
    assert abs(made.laser_plane[3] - TRUTH.laser_plane[3]) < 5e-5
    turn = np.degrees(np.arccos(np.clip(made.laser_plane[:3] @ TRUTH.laser_plane[:3], -1, 1)))
    known = uncertainty_of(made)
    assert known is not None
    assert turn < 3.5 * np.degrees(np.hypot(known.sigma("plane_nx"), known.sigma("plane_nz")))
    at_1, at_3 = ranges(made, (1.0, 3.0))
    assert abs(at_1 - 1.0) < 1e-3
    assert abs(at_3 - 1.0) < 2e-3
    assert fit.rms_px == pytest.approx(0.1, rel=0.2)


def test_a_focal_length_that_is_wrong_is_in_the_stated_slope() -> None:
    some = lines(5)
    fit = fit_laser_plane(some, BOARD, TRUTH.intrinsics)
    for name, by in (("fx", 3.0), ("cx", 2.0)):
        other = moved(TRUTH, [name], np.array([by])).intrinsics
        change = fit_laser_plane(some, BOARD, other).plane - fit.plane
        predicted = by * fit.slope[:, INTRINSICS.index(name)]
        np.testing.assert_allclose(change, predicted, atol=0.1 * np.abs(change).max() + 1e-7)


def test_the_camera_uncertainty_enters_the_plane_with_its_correlation() -> None:
    fit = fit_laser_plane(lines(6), BOARD, TRUTH.intrinsics)
    alone = with_laser_plane(replace(TRUTH, covariance={}), fit, keep_head=True)
    unsure = Uncertainty(INTRINSICS, np.diag([4.0, 4.0, 1.0, 1.0, 1e-6, 1e-6, 1e-9, 1e-9, 1e-6]))
    both = with_laser_plane(replace(TRUTH, covariance=unsure.table()), fit, keep_head=True)
    a, b = uncertainty_of(alone), uncertainty_of(both)
    assert a is not None
    assert b is not None
    assert a.names == PLANE
    assert b.names == (*INTRINSICS, *PLANE)
    assert b.sigma("plane_nx") > 2 * a.sigma("plane_nx")
    at = [b.names.index("cx"), b.names.index("plane_nx")]
    correlation = b.matrix[at[0], at[1]] / (b.sigma("cx") * b.sigma("plane_nx"))
    assert abs(correlation) > 0.5


@pytest.mark.parametrize("keep_head", [True, False])
def test_ranges_through_the_whole_chain_are_as_good_as_stated(keep_head: bool) -> None:
    rng = np.random.default_rng(11)
    views = [view_of(HEAD, BOARD, random_pose(HEAD, BOARD, rng, near=0.3, far=0.7), rng, 0.05) for _ in range(20)]
    camera = calibrate_camera(views, BOARD, (HEAD.width, HEAD.height))
    base = replace(TRUTH, intrinsics=camera.intrinsics, covariance=camera.uncertainty.table())
    some = lines(12)
    # A normal may come out either way round; what is stated must not depend on it.
    for sign in (1.0, -1.0):
        fit = fit_laser_plane(some, BOARD, camera.intrinsics)
        fit = fit._replace(plane=sign * fit.plane, slope=sign * fit.slope)
        made = with_laser_plane(base, fit, keep_head=keep_head)
        known = uncertainty_of(made)
        assert known is not None
        slope = np.zeros((2, len(known.names)))
        for k, name in enumerate(known.names):
            step = np.array([0.05 * known.sigma(name) + 1e-12])
            ahead, behind = (ranges(moved(made, [name], by), (1.0, 3.0)) for by in (step, -step))
            slope[:, k] = (np.array(ahead) - np.array(behind)) / (2 * step)
        stated = np.sqrt(np.diag(slope @ known.matrix @ slope.T))
        # Camera and plane err together; taken as independent they would state ten times as much.
        assert (stated < [3e-4, 6e-4]).all()
        off = np.array(ranges(made, (1.0, 3.0))) - 1.0
        assert (np.abs(off) < np.minimum(4.0 * stated + 1e-4, [1e-3, 2e-3])).all()


def test_the_head_frame_of_the_thesis_is_the_thesis() -> None:
    beta, baseline = np.radians(25.7), 0.08
    normal_cam = np.array([-np.cos(beta), 0.0, -np.sin(beta)])  # head y in the camera's axes
    T = head_frame_of(np.append(normal_cam, baseline))
    expected = [[-np.sin(beta), 0, np.cos(beta), 0], [-np.cos(beta), 0, -np.sin(beta), baseline], [0, -1, 0, 0]]
    np.testing.assert_allclose(T[:3], expected, atol=1e-12)
    np.testing.assert_allclose(head_frame_of(-np.append(normal_cam, baseline)), T, atol=1e-12)


def test_without_a_head_the_frame_is_drawn_from_plane_and_camera() -> None:
    fit = fit_laser_plane(lines(8), BOARD, TRUTH.intrinsics)
    blank = replace(TRUTH, T_head_camera=np.eye(4), laser_plane=np.array([0.0, 1.0, 0.0, 0.0]), covariance={})
    made = with_laser_plane(blank, fit, keep_head=False)
    np.testing.assert_array_equal(made.laser_plane, [0.0, 1.0, 0.0, 0.0])
    assert made.T_head_camera[1, 3] == pytest.approx(HEAD.baseline * np.cos(HEAD.roll), abs=5e-5)
    assert made.T_head_camera[0, 3] == made.T_head_camera[2, 3] == 0.0
    assert np.degrees(made.beta) == pytest.approx(np.degrees(TRUTH.beta), abs=0.05)
    plane = plane_in_camera(made)
    np.testing.assert_allclose(plane * np.sign(plane @ plane_in_camera(TRUTH)), plane_in_camera(TRUTH), atol=1e-3)


def test_one_wrong_board_is_found_and_named() -> None:
    some = lines(9)
    wrong = some[4]._replace(columns=some[4].columns + 12.0)
    wrong = wrong._replace(view=wrong.view._replace(name="the wrong one"))
    fit = fit_laser_plane([*some[:4], wrong, *some[5:]], BOARD, TRUTH.intrinsics)
    assert [each.name for each in fit.rejected] == ["the wrong one"]
    off = fit.plane * np.sign(fit.plane @ plane_in_camera(TRUTH)) - plane_in_camera(TRUTH)
    assert np.abs(off).max() < 1e-3


def test_a_check_forgives_one_wrong_board_and_no_wrong_plane() -> None:
    some = lines(9)
    some[4] = some[4]._replace(columns=some[4].columns + 12.0)
    plane = plane_in_camera(TRUTH)
    assert residual_of(plane, some, BOARD, TRUTH.intrinsics)[1] < 0.3
    assert residual_of(plane + np.array([0.0, 0.0, 0.0, 2e-3]), some, BOARD, TRUTH.intrinsics)[1] > 1.0


def test_too_few_boards_and_boards_at_one_distance_are_refused() -> None:
    with pytest.raises(CalibrationError, match="usable on 3 boards; at least 5"):
        fit_laser_plane(lines(1, 3), BOARD, TRUTH.intrinsics)
    rng = np.random.default_rng(2)
    flat = []
    while len(flat) < 8:
        T = rigid(np.eye(3), [rng.uniform(-0.25, -0.1), rng.uniform(-0.12, 0.0), 0.6])
        line = line_of(HEAD, BOARD, T, rng, 0.05, 0.1)
        if line is not None:
            flat.append(line)
    with pytest.raises(CalibrationError, match="one distance"):
        fit_laser_plane(flat, BOARD, TRUTH.intrinsics)


def test_another_laser_on_every_board_is_refused() -> None:
    rng = np.random.default_rng(3)
    moving = [line._replace(columns=line.columns + rng.uniform(-60, 60)) for line in lines(4)]
    with pytest.raises(CalibrationError, match=r"no common plane|miss the laser plane"):
        fit_laser_plane(moving, BOARD, TRUTH.intrinsics)


@pytest.fixture(scope="module")
def picture():
    """A rendered board with the laser's line on it, its pose, and the head."""
    head = Head().small()
    board = parse_board("chessboard:8x6:30mm")
    truth = head.truth()
    plane = plane_in_camera(truth)
    # A board whose middle lies on the laser plane.
    at = np.array([0.0, 0.0, 0.5])
    at[0] = -(plane[2] * at[2] + plane[3]) / plane[0]
    from scanmap.geometry import rotation_x, rotation_y

    R = rotation_x(0.2) @ rotation_y(0.3)
    T = rigid(R, at - R @ board.points.mean(axis=0))
    return head, board, T, picture_of(head, board, T, np.random.default_rng(1), laser=True)


def test_the_line_in_a_picture_is_found_on_the_board_alone(picture) -> None:
    head, board, _, image = picture
    truth = head.truth()
    view = find_board(image, board, "one")
    assert not isinstance(view, Rejected)
    line = find_board_line(image, None, view, board, truth.intrinsics, LaserLineParams(), 0.02)
    assert isinstance(line, BoardLine)
    assert len(line.rows) > 100
    points, _ = points_on_board(line, board, truth.intrinsics)
    off = points @ plane_in_camera(truth)[:3] + plane_in_camera(truth)[3]
    # 0.1 px at half a metre and f 506 px.
    assert np.sqrt((off**2).mean()) < 1.5e-4


def test_what_the_file_rounds_is_in_the_lines_sigma(picture, tmp_path) -> None:
    head, board, _, image = picture
    (tmp_path / "one.jpg").write_bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 75])[1].tobytes())
    (read,) = read_pictures(tmp_path)
    assert isinstance(read, Picture)
    view = find_board(read.image, board, "one")
    assert not isinstance(view, Rejected)
    told, untold = (
        find_board_line(read.image, None, view, board, head.truth().intrinsics, LaserLineParams(), 0.02, rounding)
        for rounding in (read.rounding, None)
    )
    assert isinstance(told, BoardLine) and isinstance(untold, BoardLine)
    assert np.median(told.sigma_px) > 1.05 * np.median(untold.sigma_px)
    plane = plane_in_camera(head.truth())
    points = (points_on_board(one, board, head.truth().intrinsics)[0] for one in (told, untold))
    off, off_untold = (np.sqrt(((p @ plane[:3] + plane[3]) ** 2).mean()) for p in points)
    assert off < off_untold  # 0.22 and 0.23 mm: it also says which mixture of the channels is best


def test_a_dark_laser_is_said_to_be_dark(picture) -> None:
    head, board, T, _ = picture
    image = picture_of(head, board, T, np.random.default_rng(1), laser=False)
    view = find_board(image, board, "dark")
    assert not isinstance(view, Rejected)
    found = find_board_line(image, None, view, board, head.truth().intrinsics, LaserLineParams(), 0.02)
    assert isinstance(found, Rejected)
    assert "laser" in found.reason


def test_a_calibration_over_its_gate_is_no_calibration_to_scan_with() -> None:
    check_residuals(replace(TRUTH, residuals={"laser_rms_px": 0.4}))
    with pytest.raises(CalibrationError, match=r"laser_rms_px = 2.5 .* over its gate of 1"):
        check_residuals(replace(TRUTH, residuals={"laser_rms_px": 2.5}))
    with pytest.raises(CalibrationError, match="calibrate laser"):
        check_residuals(replace(TRUTH, meta={"uncalibrated": ["laser plane", "axis"]}))


def test_nothing_is_overwritten_with_something_worse(tmp_path: Path) -> None:
    out = tmp_path / "calibration.toml"
    good, bad = (replace(TRUTH, residuals={"laser_rms_px": value}) for value in (0.2, 0.9))
    assert write_calibration(good, out, "laser_rms_px") is None
    before = out.read_bytes()
    with pytest.raises(CalibrationError, match="stays as it is"):
        write_calibration(bad, out, "laser_rms_px")
    assert out.read_bytes() == before
    assert write_calibration(good, out, "laser_rms_px") == tmp_path / "calibration.toml.1"
    with pytest.raises(CalibrationError, match="over its gate"):
        write_calibration(replace(good, residuals={"laser_rms_px": 7.0}), tmp_path / "new.toml", "laser_rms_px")
    assert not (tmp_path / "new.toml").exists()


@pytest.mark.slow
def test_stated_covariance_is_the_spread_over_fifty_seeds() -> None:
    off, stated = [], []
    truth = parameters_of(TRUTH, PLANE)
    for seed in range(50):
        fit = fit_laser_plane(lines(2000 + seed), BOARD, TRUTH.intrinsics)
        made = with_laser_plane(replace(TRUTH, covariance={}), fit, keep_head=True)
        off.append(parameters_of(made, PLANE) - truth)
        known = uncertainty_of(made)
        assert known is not None
        stated.append(np.diag(known.matrix))
    spread, said = np.sqrt((np.array(off) ** 2).mean(axis=0)), np.sqrt(np.mean(stated, axis=0))
    # ny is 1 to second order and says nothing; a sandwich of 20 boards is itself known to 15 %.
    ratio = (spread / said)[[0, 2, 3]]
    assert ((ratio > 0.65) & (ratio < 1.45)).all()


@pytest.mark.slow
def test_real_photographs(data: Path) -> None:
    folder = data / "real" / "srv-calib"
    config = configuration.load(None)
    board = parse_board("chessboard:8x6:40mm")
    camera = solve_camera(BoardJob(str(folder / "camera"), board, config), None).calibration
    job = BoardJob(str(folder / "laser"), board, config)
    solved = solve_laser(job, camera, None)
    fit = solved.fit
    reference = json.loads((folder / "refit_calibration.json").read_text())
    n, d = np.array(reference["n"]), reference["d"]
    side = np.sign(fit.plane[:3] @ n)
    assert np.degrees(np.arccos(side * fit.plane[:3] @ n)) < 0.15
    assert abs(side * fit.plane[3] - d) < 0.7e-3
    assert fit.rms_m <= 0.55e-3
    assert len(fit.lines) >= 105
    assert check_laser(job, solved.calibration, None)[1] < 1.0


@pytest.mark.slow
def test_the_wrong_plane_of_the_real_set_is_refused(data: Path) -> None:
    import warnings

    folder = data / "real" / "srv-calib"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the file was written by an old Python
        wrong = np.load(folder / "LaserPlane4.npy")
    reference = json.loads((folder / "refit_calibration.json").read_text())
    own = replace(TRUTH.intrinsics, width=640, height=480)
    (fx, _, cx), (_, fy, cy), _ = reference["K"]
    own = replace(own, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(reference["dist"]))
    bad = Calibration(own, np.eye(4), wrong / np.linalg.norm(wrong[:3]))
    job = BoardJob(str(folder / "laser"), parse_board("chessboard:8x6:40mm"), configuration.load(None))
    with pytest.raises(CalibrationError, match=r"calibration refused: .* off its laser plane, the gate is 1.00 px"):
        check_laser(job, bad, None)
