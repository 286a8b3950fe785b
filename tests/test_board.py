"""Boards: their names, their sheets, and how surely they are found or refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from boards_by_projection import Head, picture_of, random_pose, seen

from scanmap.errors import CalibrationError, ConfigError
from scanmap.geometry import rigid, rotation_x, rotation_y
from scanmap.solvers import chessboard
from scanmap.solvers.board import parse_board
from scanmap.solvers.board_sheet import draw_sheet
from scanmap.solvers.chessboard import Grid, find_part
from scanmap.solvers.detection import Rejected, View, find_board
from scanmap.solvers.other_boards import seen_instead
from scanmap.solvers.pictures import Picture, collect

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


@pytest.mark.parametrize("said", ["7x5", "9x6", "6x5", "9x7", "12x8", "8x7"])
def test_a_board_of_another_size_is_named(chess, said: str) -> None:
    board = parse_board(f"chessboard:{said}:30mm")
    found = collect([Picture(str(k), chess) for k in range(4)], board)
    with pytest.raises(CalibrationError, match=r"use --board chessboard:8x6:30mm") as refused:
        found.require()
    assert f"has 8x6 inner corners (4 pictures), not {said}" in str(refused.value)


@pytest.mark.parametrize("sought", ["5x6", "8x3", "4x6"])
def test_part_of_a_chessboard_is_a_part(chess, sought: str) -> None:
    """Covered on one side, numbered from its own first corner, where it truly is."""
    T = in_front(CHESS)
    truth = seen(HEAD, CHESS.points @ T[:3, :3].T + T[:3, 3]).reshape(6, 8, 2)
    across, down = (int(k) for k in sought.split("x"))
    kept = truth[:down, 8 - across :]
    # A sheet of paper lies over the rest, from half a square beyond these corners on.
    if across < 8:
        hidden = truth[[0, -1], 7 - across : 9 - across].mean(axis=1)
    else:
        hidden = truth[down - 1 : down + 1, [0, -1]].mean(axis=0)
    (x0, y0), along = hidden[0], hidden[1] - hidden[0]
    v, u = np.mgrid[0 : chess.shape[0], 0 : chess.shape[1]]
    cut = chess.copy()
    cut[(u - x0) * along[1] - (v - y0) * along[0] < 0] = 120
    view = find_board(cut, CHESS)
    assert isinstance(view, View)
    assert view.part in ((across, down), (down, across))
    assert len(view.ids) >= across * down - 2
    apart = np.linalg.norm(view.corners[:, None] - kept.reshape(-1, 2), axis=-1)
    assert apart.min(axis=1).max() < 0.3
    # Its own first corner is the board's (0, 0): a homography from its ids maps onto the corners.
    H, _ = cv2.findHomography(CHESS.points[view.ids, :2], view.corners)
    fitted = cv2.perspectiveTransform(CHESS.points[view.ids, None, :2], H)[:, 0]
    assert np.abs(fitted - view.corners).max() < 1.0
    assert np.linalg.det(H) * H[2, 2] > 0


@pytest.mark.parametrize(
    ("rows", "shift", "recovers"),
    [((0, 1, 2), 0, True), ((0, 2, 3), 0, True), ((0, 3, 5), 0, False), ((0, 2, 4), 1, False), ((0, 2, 4), 0, False)],
    ids=["sound", "one row left out", "two and one", "two rows on, a column beside", "every other row"],
)
def test_a_piece_of_a_board_with_rows_left_out_is_not_grown(
    chess, monkeypatch: pytest.MonkeyPatch, rows: tuple[int, ...], shift: int, recovers: bool
) -> None:
    """What OpenCV gave of boards cut by the picture's border; grown on, it missed the true corners by 16 px."""
    T = in_front(CHESS)
    truth = seen(HEAD, CHESS.points @ T[:3, :3].T + T[:3, 3]).reshape(6, 8, 2)
    piece = Grid(np.array([truth[row, k * shift : 6 + k * shift] for k, row in enumerate(rows)]))
    monkeypatch.setattr(chessboard, "_looked_for", lambda *_: piece)
    grid = find_part(cv2.cvtColor(chess, cv2.COLOR_BGR2GRAY))
    if not recovers:
        assert grid is None
        return
    assert grid is not None and grid.shape in ((8, 6), (6, 8)) and grid.seen.all()
    np.testing.assert_allclose(grid.corners, truth, atol=0.3)


def test_photographed_boards_cut_by_the_border_are_found_where_they_are(data: Path) -> None:
    board = parse_board("chessboard:8x6:40mm")
    for number in (45, 46, 47, 48, 49, 109, 111):
        picture = cv2.imread(str(data / "real" / "srv-calib" / "laser" / f"Image{number}.jpg"))
        view = find_board(picture, board)
        assert isinstance(view, View), number
        H, _ = cv2.findHomography(board.points[view.ids, :2], view.corners)
        fitted = cv2.perspectiveTransform(board.points[view.ids, None, :2], H)[:, 0]
        assert np.abs(fitted - view.corners).max() < 2.0, number


def test_a_hand_on_a_chessboard_costs_the_corners_under_it(chess) -> None:
    T = in_front(CHESS)
    truth = seen(HEAD, CHESS.points @ T[:3, :3].T + T[:3, 3])
    covered = chess.copy()
    cv2.circle(covered, tuple(np.rint(truth[19]).astype(int).tolist()), 30, (120, 140, 190), -1)
    view = find_board(covered, CHESS)
    assert isinstance(view, View)
    assert view.part is None
    assert 36 <= len(view.ids) <= 47
    assert np.linalg.norm(view.corners[:, None] - truth, axis=-1).min(axis=1).max() < 0.3


def test_a_charuco_board_is_not_taken_for_a_chessboard(charuco) -> None:
    found = collect([Picture("one", charuco)], CHESS)
    with pytest.raises(CalibrationError, match="use --board such as charuco:7x5:30mm"):
        found.require()


def test_views_that_show_only_parts_ask_for_the_whole(chess) -> None:
    cut = np.ascontiguousarray(chess[:, 290:])
    found = collect([Picture("one", cut)], CHESS)
    assert found.views
    with pytest.raises(CalibrationError, match="show all of it once"):
        found.require()


def test_markers_are_not_called_a_chessboard() -> None:
    """A sheet of separate markers: right angles and four-fold corners, but no chessboard."""
    sheet = np.full((480, 640), 235, np.uint8)
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_ARUCO_ORIGINAL)
    for k in range(12):
        row, column = divmod(k, 4)
        sheet[40 + 140 * row : 140 + 140 * row, 60 + 140 * column : 160 + 140 * column] = cv2.aruco.generateImageMarker(
            family, 7 * k + 3, 100
        )
    sheet = cv2.GaussianBlur(sheet, (0, 0), 0.8)
    for board in (CHESS, CHARUCO):
        assert isinstance(find_board(sheet, board), Rejected)
        assert "chessboard of" not in seen_instead(sheet, board)
        assert "inner corners" not in seen_instead(sheet, board)


@pytest.mark.parametrize("name", ["charuco:7x5:30mm:22mm", "charuco:6x8:30mm:22mm", "charuco:9x6:30mm:20mm"])
def test_another_charuco_board_is_named_by_its_own_markers(name: str) -> None:
    board = parse_board(name)
    picture = picture_of(HEAD, board, in_front(board, (0.0, 0.0, 0.5)), np.random.default_rng(5))
    for said in ("charuco:5x4:30mm:22mm", "charuco:8x7:30mm:22mm", "charuco:5x7:30mm:22mm"):
        found = collect([Picture("one", picture)], parse_board(said))
        with pytest.raises(CalibrationError) as refused:
            found.require()
        squares = f"{board.columns}x{board.rows}"
        assert f"use --board charuco:{squares}:30mm:22mm" in str(refused.value)


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


def test_a_charuco_board_with_fewer_rows_than_named_is_refused() -> None:
    """Its markers are numbered as those of the longer one: only rows that never show tell."""
    board, longer = parse_board("charuco:7x5:30mm:22mm"), parse_board("charuco:7x6:30mm:22mm")
    rng = np.random.default_rng(5)
    shown = [
        Picture(str(k), picture_of(HEAD, board, in_front(board, (tilt, -tilt, 0.5)), rng))
        for k, tilt in enumerate((-0.2, -0.1, 0.0, 0.1, 0.2))
    ]
    collect(shown, board).require()
    with pytest.raises(CalibrationError, match="use --board charuco:7x5:30mm:22mm if that is all it has"):
        collect(shown, longer).require()
    # One or two pictures without its last row may be a hand's doing.
    collect(shown[:2], longer).require()
