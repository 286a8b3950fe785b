"""Boards: their names, their sheets, and how surely they are found or refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from boards_by_projection import Head, picture_of, random_pose, seen

from scanmap.errors import ConfigError
from scanmap.geometry import rigid, rotation_x, rotation_y
from scanmap.solvers.board import parse_board
from scanmap.solvers.board_sheet import draw_sheet
from scanmap.solvers.detection import Rejected, View, find_board, seen_instead

CHESS = parse_board("chessboard:8x6:30mm")
CHARUCO = parse_board("charuco:7x5:30mm:22mm")
HEAD = Head().small()
TILTED = rigid(rotation_x(0.3) @ rotation_y(-0.35), [0.0, 0.0, 0.0])


def in_front(board, at=(0.0, 0.0, 0.45)):
    middle = TILTED[:3, :3] @ board.points.mean(axis=0)
    return rigid(TILTED[:3, :3], np.array(at) - middle)


@pytest.fixture(scope="module")
def chess() -> np.ndarray:
    return picture_of(HEAD, CHESS, in_front(CHESS), np.random.default_rng(1))


@pytest.fixture(scope="module")
def charuco() -> np.ndarray:
    return picture_of(HEAD, CHARUCO, in_front(CHARUCO), np.random.default_rng(2))


def test_names_say_what_is_meant() -> None:
    assert (CHESS.corners, CHESS.squares, CHESS.square_m) == ((8, 6), (9, 7), 0.03)
    assert (CHARUCO.corners, CHARUCO.squares, CHARUCO.marker_m) == ((6, 4), (7, 5), 0.022)
    assert parse_board("chessboard:8x6:4cm") == parse_board("chessboard:8x6:40mm")
    assert parse_board(CHARUCO.name) == CHARUCO
    np.testing.assert_allclose(CHARUCO.points, CHARUCO.charuco().getChessboardCorners(), atol=1e-7)


@pytest.mark.parametrize(
    "name",
    ["chessboard:8x6", "chessboard:8x6:40", "chessboard:8x6:40mm:20mm", "charuco:7x5:30mm", "charuco:7x5:30mm:29mm",
     "chessboard:2x2:40mm", "chessboard:8x6:0mm", "chessboard:8x6:1.2.3mm", "grid:8x6:40mm", "charuco:99x99:9mm:6mm"],
)  # fmt: skip
def test_a_name_that_is_none_is_refused_with_the_form(name: str) -> None:
    with pytest.raises(ConfigError, match=r"chessboard:8x6:40mm"):
        parse_board(name)


@pytest.mark.parametrize("board", [CHESS, CHARUCO], ids=["chessboard", "charuco"])
def test_corners_of_a_picture_are_where_the_board_was(board, chess, charuco) -> None:
    view = find_board(chess if board is CHESS else charuco, board)
    assert isinstance(view, View)
    T = in_front(board)
    truth = seen(HEAD, board.points @ T[:3, :3].T + T[:3, 3])
    off = view.corners - truth[view.ids]
    if board is CHESS and np.abs(off).max() > 5:  # it looks the same upside down
        off = view.corners - truth[::-1][view.ids]
    assert len(view.ids) == len(board.points)
    # Squares of 25 px, noise of 1.5 grey levels; between markers only 3 px around a corner are its own.
    assert np.sqrt((off**2).sum(axis=1).mean()) < (0.08 if board is CHESS else 0.13)
    assert np.abs(off.mean(axis=0)).max() < 0.05  # pixel centres at integers


def test_markers_tell_their_side_against_the_squares(charuco) -> None:
    view = find_board(charuco, CHARUCO)
    assert isinstance(view, View)
    assert view.marker_ratio == pytest.approx(22 / 30, rel=0.06)


def test_part_of_a_charuco_board_is_enough(charuco) -> None:
    T = in_front(CHARUCO)
    cut = charuco.copy()
    truth = seen(HEAD, CHARUCO.points @ T[:3, :3].T + T[:3, 3])
    cut[:, : int(truth[:, 0].mean())] = 40
    view = find_board(cut, CHARUCO)
    assert isinstance(view, View)
    assert 8 <= len(view.ids) < 0.6 * len(CHARUCO.points)
    assert np.abs(view.corners - truth[view.ids]).max() < 0.3


def test_glare_costs_the_corners_it_lies_on_and_no_other(charuco) -> None:
    T = in_front(CHARUCO)
    truth = seen(HEAD, CHARUCO.points @ T[:3, :3].T + T[:3, 3])
    spot = np.zeros(charuco.shape[:2], np.float32)
    u, v = truth[7]
    cv2.circle(spot, (round(float(u)), round(float(v))), 22, 1.0, -1)
    glare = np.clip(charuco + 400.0 * cv2.GaussianBlur(spot, (0, 0), 4)[..., None], 0, 255).astype(np.uint8)
    view = find_board(glare, CHARUCO)
    assert isinstance(view, View)
    assert 7 not in view.ids
    assert len(view.ids) >= 14
    assert np.abs(view.corners - truth[view.ids]).max() < 0.3


def test_uneven_light_moves_nothing() -> None:
    T = in_front(CHESS)
    dim = picture_of(HEAD, CHESS, T, np.random.default_rng(3), light=0.2)
    view = find_board(dim, CHESS)
    assert isinstance(view, View)
    truth = seen(HEAD, CHESS.points @ T[:3, :3].T + T[:3, 3])
    off = min(np.abs(view.corners - truth).max(), np.abs(view.corners - truth[::-1]).max())
    assert off < 0.25


def test_a_blurred_picture_is_refused_and_says_so(charuco) -> None:
    for sigma in (9, 14):
        found = find_board(cv2.GaussianBlur(charuco, (0, 0), sigma), CHARUCO)
        assert isinstance(found, Rejected)
    smeared = cv2.blur(picture_of(HEAD, CHESS, in_front(CHESS), np.random.default_rng(1)), (17, 1))
    found = find_board(smeared, CHESS)
    assert isinstance(found, Rejected)
    assert "blurred" in found.reason or "no board" in found.reason


def test_nothing_is_found_in_noise_or_on_an_empty_wall() -> None:
    rng = np.random.default_rng(4)
    for image in (rng.integers(0, 255, (480, 640), np.uint8), np.full((480, 640, 3), 90, np.uint8)):
        for board in (CHESS, CHARUCO):
            assert isinstance(find_board(image, board), Rejected)


def test_a_mirrored_picture_is_told_from_a_missing_board(charuco) -> None:
    mirrored = np.ascontiguousarray(charuco[:, ::-1])
    assert isinstance(find_board(mirrored, CHARUCO), Rejected)
    assert "mirrored" in seen_instead(mirrored, CHARUCO)


@pytest.mark.parametrize("said", ["chessboard:7x5:30mm", "chessboard:9x6:30mm", "chessboard:6x5:30mm"])
def test_a_board_of_another_size_is_refused_by_its_own_size(chess, said: str) -> None:
    found = find_board(chess, parse_board(said))
    assert isinstance(found, Rejected)
    assert "8x6" in found.reason + seen_instead(chess, parse_board(said))


def test_another_charuco_board_is_refused(charuco) -> None:
    found = find_board(charuco, parse_board("charuco:5x4:30mm:22mm"))
    assert isinstance(found, Rejected)
    found = find_board(charuco, parse_board("charuco:5x7:30mm:22mm"))
    assert isinstance(found, Rejected)


@pytest.mark.parametrize("name", ["charuco:7x5:30mm:22mm", "chessboard:8x6:24mm"])
def test_the_printed_sheet_is_found_at_its_true_scale(tmp_path: Path, name: str) -> None:
    board = parse_board(name)
    draw_sheet(board, tmp_path / "board.png")
    image = cv2.imread(str(tmp_path / "board.png"))
    view = find_board(image, board)
    assert isinstance(view, View)
    assert len(view.ids) == len(board.points)
    mm = view.corners * 25.4 / 300
    flat = 1e3 * board.points[view.ids, :2]
    fit = np.linalg.lstsq(np.c_[flat, np.ones(len(flat))], mm, rcond=None)[0]
    np.testing.assert_allclose(fit[:2], np.eye(2), atol=2e-3)


def test_the_pdf_is_as_large_as_its_paper_and_says_what_it_is(tmp_path: Path) -> None:
    draw_sheet(CHARUCO, tmp_path / "board.pdf", "a4")
    text = (tmp_path / "board.pdf").read_bytes()
    assert text.startswith(b"%PDF")
    box = text[text.index(b"/MediaBox") :].split(b"]")[0].split(b"[")[1].split()
    assert float(box[2]) / 72 * 25.4 == pytest.approx(297.0, abs=0.05)
    assert float(box[3]) / 72 * 25.4 == pytest.approx(210.0, abs=0.05)


def test_a_board_larger_than_the_paper_names_the_paper_that_fits(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--paper a3"):
        draw_sheet(parse_board("charuco:7x5:40mm:29mm"), tmp_path / "board.pdf", "a4")
    with pytest.raises(ConfigError, match=r"\.pdf"):
        draw_sheet(CHARUCO, tmp_path / "board.svg")
    assert not list(tmp_path.iterdir())


def test_random_poses_are_in_the_picture() -> None:
    """The renderer's own: a pose that it hands out shows the whole board."""
    T = random_pose(HEAD, CHESS, np.random.default_rng(5))
    pixels = seen(HEAD, CHESS.points @ T[:3, :3].T + T[:3, 3])
    assert (pixels > 0).all()
    assert (pixels < [HEAD.width, HEAD.height]).all()
