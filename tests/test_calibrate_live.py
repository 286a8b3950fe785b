"""`calibrate camera|laser|axis` with a camera that runs: a phone's stream, and a webcam on a head behind a pty."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from boards_by_projection import Head, axis_poses, laser_pose, picture_of, random_pose
from fake_cameras import FakeCapture, FakeDevice, as_jpeg, phone

from scanmap.calibration import Calibration
from scanmap.cli.collecting import Collecting
from scanmap.rig import grbl_opening
from scanmap.solvers.board import parse_board
from scanmap.solvers.detection import Rejected, View
from scanmap.solvers.pictures import Picture, Views, collect
from scanmap.twin.firmware import Firmware
from scanmap.twin.ports import pty_port
from scanmap.view.viewer import free_port

NAME = "chessboard:8x6:30mm"
BOARD = parse_board(NAME)
HEAD = Head().small()
SIZE = (HEAD.width, HEAD.height)
HELD = 4  # somebody holds the board for so many pictures that were looked at
AXIS_DEG = 12.0


class Room:
    """What the camera sees: a board in somebody's hands, or standing while the head turns."""

    def __init__(self, sign: float = 1.0) -> None:
        self.board = Firmware()
        self.rng = np.random.default_rng(1)
        self.sign = sign
        self.poses: list[np.ndarray] = []
        self.standing = False
        self.looked_at = 0
        self.seen: dict[tuple[object, bool], np.ndarray] = {}
        self.noise = self.rng.normal(0, 1.0, (*SIZE[::-1], 3))

    def jpeg(self, size: tuple[int, int] = SIZE) -> bytes:
        """The picture of this moment; its noise never the same."""
        key, T = self._now()
        lit = self.board.laser_on
        if (key, lit) not in self.seen:
            self.seen[key, lit] = picture_of(HEAD, BOARD, T, self.rng, laser=lit, samples=2, noise=0.5)
        noise = np.roll(self.noise, tuple(self.rng.integers(0, 200, 2)), axis=(0, 1))
        return as_jpeg(np.clip(self.seen[key, lit] + noise, 0, 255).astype(np.uint8), 95)

    def _now(self) -> tuple[object, np.ndarray]:
        if not self.standing:
            number = self.looked_at // HELD % len(self.poses)
            return number, self.poses[number]
        bearing = round(self.sign * self.board.bearing, 4)
        return bearing, axis_poses(HEAD, BOARD, np.array([bearing]), away=0.7)[0][1]


@pytest.fixture
def room(monkeypatch: pytest.MonkeyPatch) -> Room:
    room = Room()
    tell = Collecting.__call__

    def told(self: Collecting, views: Views, last: View | Rejected) -> bool:
        room.looked_at += 1
        return tell(self, views, last)

    monkeypatch.setattr(Collecting, "__call__", told)
    return room


@pytest.fixture
def hardware(room: Room, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Words for --set: a webcam in the room on a head with a board on a pty."""
    device = FakeDevice(period_s=0.03, sizes=(SIZE,), picture=room.jpeg)
    real = cv2.VideoCapture
    fake = lambda target, *rest: FakeCapture(device) if target == 0 else real(target, *rest)  # noqa: E731
    monkeypatch.setattr(cv2, "VideoCapture", fake)
    monkeypatch.setattr(grbl_opening, "BOOT_S", 0.1)
    for name in ("WARM_UP_S", "AUTOMATIC_WARM_UP_S", "FOLLOW_S"):
        monkeypatch.setattr(f"scanmap.rig.camera_stream.{name}", 0.0)
    with pty_port(room.board) as url:
        settings = (
            "rig=hardware", "camera.source=0", "camera.latency_s=0.0", f"stage.port={url}", "stage.watchdog=false",
            f"sweep.start_deg={-AXIS_DEG}", f"sweep.end_deg={AXIS_DEG}", "sweep.step_deg=3", "sweep.settle_s=0.0",
            "camera.exposure_us=1000", "stage.min_deg=-90", f"view.live_port={free_port()}",
        )  # fmt: skip
        yield [word for setting in settings for word in ("--set", setting)]
    assert not room.board.laser_on and not room.board.motor_on


def hold(room: Room, kind: Callable[..., np.ndarray], count: int, **more: float) -> None:
    room.standing = False
    room.seen.clear()
    room.poses = [kind(HEAD, BOARD, room.rng, **more) for _ in range(count)]


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="a pty needs POSIX")
def test_three_live_commands_make_a_calibrated_head(room: Room, run, hardware: list[str]) -> None:
    truth = HEAD.truth()
    hold(room, random_pose, 26, near=0.3, far=0.7)
    with phone(room.jpeg, period_s=0.03) as served:
        code, out, err = run("calibrate", "camera", f"{served.url}/video", "--board", NAME, "--view", *hardware[-2:])
    assert code == 0, out + err
    assert "still for a moment" in out and "of the picture covered, tilted within" in out
    assert "next: " in out and "views, " in out
    hold(room, laser_pose, 18)
    code, out, err = run("calibrate", "laser", "camera", "--board", NAME, "--no-view", *hardware)
    assert code == 0, out + err
    assert "boards at 0." in out
    room.standing = True
    code, out, err = run("calibrate", "axis", "camera", "--board", NAME, "--no-view", *hardware)
    assert code == 0, out + err
    assert "bearing 12.0 deg, 24.0 deg so far" in out
    made = Calibration.load("calibration.toml")
    assert made.baseline_m == pytest.approx(truth.baseline_m, rel=0.015)
    assert made.intrinsics.fx == pytest.approx(truth.intrinsics.fx, rel=0.01)
    assert made.mount.offset_m[:2] == pytest.approx(truth.mount.offset_m[:2], abs=2e-3)
    # The motor the other way round.
    room.sign = -1.0
    before = Path("calibration.toml").read_bytes()
    code, out, err = run("calibrate", "axis", "camera", "--board", NAME, "--no-view", *hardware)
    assert code == 1
    assert "the motor turns the wrong way" in err and err.count("\n") == 1
    assert Path("calibration.toml").read_bytes() == before


@pytest.mark.skipif(os.name != "posix", reason="a pty needs POSIX")
def test_a_head_that_does_not_turn_is_asked_for(run, hardware: list[str]) -> None:
    HEAD.truth().save("calibration.toml")
    for words in (["0"], ["camera", "--set", "rig=twin"]):
        code, _, err = run("calibrate", "axis", words[0], "--board", NAME, *hardware, *words[1:])
        assert code == 2
        assert "a head that turns" in err and err.count("\n") == 1


def test_a_board_in_the_hand_counts_once_it_rests(room: Room) -> None:
    hold(room, random_pose, 2)
    still, other = (picture_of(HEAD, BOARD, T, room.rng, samples=2) for T in room.poses)
    shaken = np.roll(still, 6, axis=1)
    order = [still, shaken, still, still, still, other, other]
    told: list[View | Rejected] = []
    pictures = [Picture(str(k), image) for k, image in enumerate(order)]
    views = collect(pictures, BOARD, distinct=True, held=True, report=lambda _, last: bool(told.append(last)) or True)
    assert [view.name for view in views.views] == ["3", "6"]
    assert [each.reason for each in told if isinstance(each, Rejected)] == [
        "hold the board still", "hold the board still", "hold the board still", "shows the same as an earlier view",
        "hold the board still",
    ]  # fmt: skip
