"""`scanmap board` and `calibrate camera|laser|axis|scale` as a user types them."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from boards_by_projection import Head, axis_pictures, laser_pose, picture_of, random_pose

from scanmap.calibration import Calibration, uncertainty_of
from scanmap.solvers.board import parse_board

BOARD = "chessboard:8x6:30mm"
Run = Callable[..., tuple[int, str, str]]


def one_line(text: str) -> bool:
    return text.count("\n") == 1 and text.startswith("scanmap: ") and "Traceback" not in text


def test_board_writes_a_sheet_and_says_what_comes_next(run: Run) -> None:
    code, out, _ = run("board", "--out", "board.pdf")
    assert code == 0
    assert Path("board.pdf").stat().st_size > 1000
    assert "scanmap calibrate camera SOURCE --board charuco:7x5:30mm:22mm" in out


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["board", "--out", "board.svg"], 2, "board.pdf"),
        (["board", "--out", "b.pdf", "--board", "chessboard:8x6"], 2, "chessboard:8x6:40mm"),
        (["board", "--out", "b.pdf", "--paper", "b9"], 2, "a4, a3, letter"),
        (["calibrate", "camera", "nowhere", "--board", BOARD], 2, "does not exist"),
        (["calibrate", "camera", ".", "--board", BOARD], 1, "no pictures"),
        (["calibrate", "camera", ".", "--board", "checkers"], 2, "not the name of a board"),
        (["calibrate", "camera", ".", "--board", BOARD, "--out", "c.txt"], 2, "c.toml"),
        (["calibrate", "laser", ".", "--board", BOARD], 2, "scanmap calibrate camera"),
        (["calibrate", "laser", ".", "--board", BOARD, "--out", "my head.toml"], 2, "--out 'my head.toml' comes first"),
        (["calibrate", "axis", ".", "--board", BOARD], 2, "scanmap calibrate laser"),
    ],
)
def test_mistakes_are_one_line_that_names_the_way_out(run: Run, words: list[str], code: int, said: str) -> None:
    ended, _, err = run(*words)
    assert ended == code
    assert said in err
    assert one_line(err)
    assert not list(Path().glob("*.toml"))


def test_pictures_without_a_board_leave_the_old_calibration_alone(run: Run) -> None:
    Path("pictures").mkdir()
    for k in range(3):
        cv2.imwrite(f"pictures/{k}.png", np.full((240, 320, 3), 90, np.uint8))
    Head().small().truth().save("calibration.toml")
    before = Path("calibration.toml").read_bytes()
    code, _, err = run("calibrate", "camera", "pictures", "--board", BOARD)
    assert code == 1
    assert "is in none of 3 pictures" in err
    assert one_line(err)
    assert Path("calibration.toml").read_bytes() == before


def test_scale_makes_a_calibration_for_a_binned_picture(run: Run) -> None:
    Head().truth().save("calibration.toml")
    code, out, _ = run("calibrate", "scale", "calibration.toml", "--size", "800x600", "--out", "half.toml")
    assert code == 0
    half, whole = Calibration.load("half.toml").intrinsics, Calibration.load("calibration.toml").intrinsics
    assert (half.width, half.height, half.fx) == (800, 600, whole.fx / 2)
    # Pixel centres at integers: the middle of the first two pixels is the middle of the first one now.
    assert half.cx == pytest.approx((whole.cx - 0.5) / 2)
    assert "same field of view" in out
    code, _, err = run("calibrate", "scale", "calibration.toml", "--size", "800x450", "--out", "cropped.toml")
    assert code == 1
    assert "another aspect" in err
    for size in ("big", "800", "4x3", "16x99999999999"):
        code, _, err = run("calibrate", "scale", "calibration.toml", "--size", size, "--out", "x.toml")
        assert code == 2 and f"--size {size}: not WIDTHxHEIGHT" in err


def test_a_scan_refuses_a_calibration_without_a_laser_plane(run: Run) -> None:
    from dataclasses import replace

    replace(Head().truth(), meta={"uncalibrated": ["laser plane"]}).save("camera.toml")
    code, _, err = run("scan", "--calibration", "camera.toml", "--out", "room.ply")
    assert code == 1
    assert "scanmap calibrate laser" in err
    assert one_line(err)
    assert not Path("room.ply").exists()


@pytest.mark.slow
def test_a_wrong_picture_among_good_ones_is_named_and_another_length_is_doubted(run: Run) -> None:
    head, board, rng = Head().small(), parse_board(BOARD), np.random.default_rng(3)
    Path("camera").mkdir()
    for k in range(12):
        cv2.imwrite(f"camera/{k:02d}.png", picture_of(head, board, random_pose(head, board, rng), rng, samples=2))
    # A sheet that is not flat.
    u, v = np.meshgrid(np.arange(640, dtype=np.float32), np.arange(480, dtype=np.float32))
    picture = picture_of(head, board, random_pose(head, board, rng, near=0.4, far=0.6), rng, samples=2)
    cv2.imwrite("camera/bent.png", cv2.remap(picture, u + 3 * np.sin(v / 40), v, cv2.INTER_LINEAR))
    code, out, err = run("calibrate", "camera", "camera", "--board", BOARD)
    assert code == 0, err
    assert "left out: bent.png: contradicts the others" in out
    code, out, err = run("calibrate", "laser", "camera", "--board", "chessboard:8x6:40mm")
    assert code == 1
    assert "made with chessboard:8x6:30mm, this is chessboard:8x6:40mm" in out
    assert "the laser line is visible on none of" in err and one_line(err)


@pytest.mark.slow
def test_three_commands_make_a_calibrated_head(run: Run) -> None:
    head = Head().small()
    truth, board = head.truth(), parse_board(BOARD)
    rng = np.random.default_rng(1)
    for name in ("camera", "laser", "axis/frames"):
        Path(name).mkdir(parents=True)
    for k in range(20):
        T = random_pose(head, board, rng, near=0.3, far=0.7)
        cv2.imwrite(f"camera/{k:02d}.png", picture_of(head, board, T, rng, samples=3))
    for k in range(12):
        picture = picture_of(head, board, laser_pose(head, board, rng), rng, laser=True, samples=3)
        cv2.imwrite(f"laser/{k:02d}.png", picture)
    rows = ["frame,bearing_deg"]
    for k, (bearing, picture) in enumerate(axis_pictures(head, board, np.radians(np.arange(-14, 15, 3.5)), rng)):
        cv2.imwrite(f"axis/frames/{k:06d}.png", picture)
        rows.append(f"{k},{np.degrees(bearing)}")
    Path("axis/scan.csv").write_text("\n".join(rows) + "\n")

    code, out, err = run("calibrate", "camera", "camera", "--board", BOARD, "--figures", "check", "--rrd", "c.rrd")
    assert code == 0, err
    assert "next: scanmap calibrate laser" in out
    code, out, err = run("calibrate", "laser", "laser", "--board", BOARD, "--figures", "check", "--rrd", "l.rrd")
    assert code == 0, err
    code, out, err = run("calibrate", "axis", "axis", "--board", BOARD, "--figures", "check", "--rrd", "a.rrd")
    assert code == 0, err
    made = Calibration.load("calibration.toml")
    assert made.baseline_m == pytest.approx(truth.baseline_m, rel=0.01)
    assert np.degrees(made.beta) == pytest.approx(np.degrees(truth.beta), abs=0.2)
    assert {"camera_rms_px", "laser_rms_px", "axis_rms_px"} <= set(made.residuals)
    assert uncertainty_of(made) is not None
    assert "uncalibrated" not in made.meta
    assert Path("calibration.toml.2").exists()
    names = {path.name for path in Path("check").iterdir()}
    assert names == {f"{part}{kind}.png" for part in ("camera", "laser", "axis") for kind in ("", "-boards")}
    code, out, err = run("calibrate", "laser", "laser", "--board", BOARD, "--check")
    assert code == 0, err
    assert "passed" in out
