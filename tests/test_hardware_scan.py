"""`rig = "hardware"`: a webcam and a board behind a pty, scanned by the same code as the twin."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import baked_scene
from fake_cameras import FakeCapture, FakeDevice

from scanmap import config as configuration
from scanmap import session
from scanmap.errors import CalibrationError, CameraError, ConfigError, StageError
from scanmap.recording import describe, open_source
from scanmap.rig import grbl_opening
from scanmap.session.rigs import open_rig
from scanmap.shot import decode_image
from scanmap.sweep import SweepParams, plan, sweep
from scanmap.twin import Truth, TwinCamera
from scanmap.twin.firmware import Firmware
from scanmap.twin.ports import pty_port

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="a pty needs POSIX"),
    pytest.mark.usefixtures("baked_once"),
]

HARDWARE = (
    "rig=hardware", "calibration.image.width=320", "calibration.image.height=240", "sweep.end_deg=40",
    "sweep.step_deg=10", "sweep.settle_s=0.0", "stage.watchdog=false", "camera.source=0", "camera.latency_s=0.0",
    "camera.exposure_us=1000",
)  # fmt: skip


class Head:
    """A webcam and a board on one head, in the twin's room; the program sees them as hardware."""

    def __init__(self) -> None:
        self.config = configuration.load("twin-room", HARDWARE)
        self.board = Firmware()
        self.scene = baked_scene(self.config.twin, self.config.twin.light)
        self.camera = TwinCamera(self.scene, self.config.head(), self.config.twin, state=self._state)
        self.device = FakeDevice(period_s=0.02, sizes=((320, 240),), picture=lambda _: self.camera.grab().image)

    def _state(self) -> tuple[float, bool]:
        return self.board.bearing, self.board.laser_on


@pytest.fixture
def head(monkeypatch: pytest.MonkeyPatch) -> Head:
    head = Head()
    real = cv2.VideoCapture
    fake = lambda target, *rest: FakeCapture(head.device) if target == 0 else real(target, *rest)  # noqa: E731
    monkeypatch.setattr(cv2, "VideoCapture", fake)
    monkeypatch.setattr(grbl_opening, "BOOT_S", 0.1)
    for name in ("WARM_UP_S", "AUTOMATIC_WARM_UP_S", "FOLLOW_S"):
        monkeypatch.setattr(f"scanmap.rig.camera_stream.{name}", 0.0)
    return head


@pytest.fixture
def choice(head: Head) -> Iterator[session.Choice]:
    with pty_port(head.board) as url:
        yield session.Choice("twin-room", (*HARDWARE, f"stage.port={url}"))


def test_a_scan_of_hardware_is_as_good_as_the_twins_and_says_no_twin(
    head: Head, choice: session.Choice, tmp_path: Path
) -> None:
    outputs = session.Outputs((tmp_path / "room.ply",), record=tmp_path / "room.mcap")
    with session.prepare_scan(choice, outputs, view=False) as job:
        result = job.run(lambda _: None, lambda: False)
        assert job.announcement[0].startswith("rig: grbl on /dev/") and "camera 0" in job.announcement[0]
    assert result.ended == "finished" and not result.faults and result.truth is None
    np.testing.assert_allclose(np.degrees(result.scan.bearings), [0, 10, 20, 30, 40], atol=1e-9)
    truth = Truth(head.scene, job.calibration, head.config.twin.laser)
    report = truth.compare(result.scan.points[result.scan.valid], result.scan.bearings)
    with session.prepare_scan(
        session.Choice("twin-room", (*HARDWARE, "rig=twin")), session.Outputs(), view=False
    ) as job:
        twin = job.run(lambda _: None, lambda: False).truth
    assert twin is not None
    assert report.median_m < 1.3 * twin.median_m and report.completeness > twin.completeness - 0.05
    source = open_source(tmp_path / "room.mcap")
    assert not source.is_twin
    for shot in source.shots():
        assert shot.image.startswith(b"\xff\xd8")
    assert b"digital twin" not in (tmp_path / "room.ply").read_bytes()[:2000]
    assert not head.board.laser_on and not head.board.motor_on
    assert head.device.released == head.device.opened


def test_a_missing_part_is_said_before_anything_turns_and_leaves_nothing(
    head: Head, choice: session.Choice, tmp_path: Path
) -> None:
    outputs = session.Outputs((tmp_path / "room.ply",), record=tmp_path / "room.mcap")
    head.device.unplugged = True
    with pytest.raises(CameraError, match="camera 0 cannot be opened"):
        session.prepare_scan(choice, outputs, view=False)
    head.device.unplugged = False
    with pytest.raises(StageError, match="nothing-here"):
        session.prepare_scan(
            session.Choice("twin-room", (*HARDWARE, "stage.port=/dev/nothing-here")), outputs, view=False
        )
    head.device.sizes, head.device.picture = ((64, 48),), None
    with pytest.raises(CalibrationError, match="image is 64x48, the calibration is for 320x240"):
        session.prepare_scan(choice, outputs, view=False)
    assert not list(tmp_path.iterdir())
    assert head.device.released == head.device.opened
    assert not head.board.laser_on


def test_a_camera_lost_in_mid_scan_keeps_what_was_scanned(head: Head, choice: session.Choice, tmp_path: Path) -> None:
    outputs = session.Outputs((tmp_path / "room.ply",), record=tmp_path / "room.mcap")
    settings = (*choice.settings, "camera.timeout_s=0.2", "sweep.retries=1")

    def lose(progress: session.Progress) -> None:
        head.device.unplugged = progress.bearing_deg >= 10

    with session.prepare_scan(session.Choice("twin-room", settings), outputs, view=False) as job:
        result = job.run(lose, lambda: False)
    assert isinstance(result.error, CameraError) and "no usable frame after 2 tries" in str(result.error)
    assert len(result.scan.bearings) >= 2
    assert (tmp_path / "room.ply").exists()
    assert not head.board.laser_on and not head.board.motor_on


def test_a_camera_that_comes_back_leaves_a_note_in_the_recording(
    head: Head, choice: session.Choice, tmp_path: Path
) -> None:
    outputs = session.Outputs(record=tmp_path / "room.mcap")

    def wobble(progress: session.Progress) -> None:
        if progress.done == 2:
            head.device.unplugged = True
            threading.Timer(0.3, setattr, (head.device, "unplugged", False)).start()

    with session.prepare_scan(choice, outputs, view=False) as job:
        assert job.run(wobble, lambda: False).ended == "finished"
    noted = [fault for fault in describe(tmp_path / "room.mcap").faults if fault.part == "camera"]
    assert noted and "camera 0" in noted[0].message


def test_exposures_that_nobody_can_set_are_refused_before_anything_opens(head: Head) -> None:
    settings = (*HARDWARE, "camera.source=http://phone/video", "sweep.exposures_us=[1000, 2000]")
    config = configuration.load("twin-room", settings)
    with pytest.raises(ConfigError, match=r"exposures_us needs a USB webcam"):
        open_rig(config, config.head())
    assert head.device.opened == 0


def test_replay_only_is_no_rig() -> None:
    config = configuration.load("srv-turntable")
    with pytest.raises(ConfigError, match=r"replay-only.*hardware"):
        open_rig(config, config.head())


def test_a_continuous_sweep_of_hardware_knows_every_bearing(head: Head) -> None:
    """Board and camera in real time, the camera 60 ms late: each picture tells by itself where it was exposed."""
    head.board = Firmware(instant=False)
    head.device.picture = lambda size: np.full(
        (size[1], size[0], 3), round(math.degrees(head.board.bearing) * 5), np.uint8
    )
    head.device.latency_s, head.device.period_s, head.device.sends_jpeg = 0.06, 0.02, False
    changes = ("sweep.mode=continuous", "sweep.end_deg=20", "sweep.speed_deg_s=10", "sweep.step_deg=0.5")
    with pty_port(head.board) as url:
        settings = (*HARDWARE, *changes, f"stage.port={url}", "camera.latency_s=0.06", "stage.acceleration_deg_s2=200")
        config = configuration.load("twin-room", settings)
        opened = open_rig(config, config.head())
        shots = list(sweep(opened.rig, config.sweep, sleep=opened.sleep, clock=opened.clock))
        opened.close()
    bearings = np.degrees([shot.bearing for shot in shots])
    seen = np.array([decode_image(shot.image).image[0, 0, 0] / 5 for shot in shots])
    assert len(shots) > 10 and np.ptp(bearings) > 12
    # Late by 60 ms at 10 deg/s is 0.6 deg; a grey level is 0.2.
    assert abs(np.median(bearings - seen)) < 0.25
    assert not head.board.laser_on


def test_every_pass_has_its_exposure_and_each_row_the_better_picture(tmp_path: Path) -> None:
    """A dark room scanned bright and dim: the bright pass finds what the dim one misses, and both are kept."""
    base = ("calibration.image.width=320", "calibration.image.height=240", "sweep.end_deg=40", "sweep.step_deg=10",
            "twin.laser.white_wall_peak=0.05")  # fmt: skip

    def scanned(*more: str) -> session.Result:
        choice = session.Choice("twin-room", (*base, *more))
        outputs = session.Outputs(record=tmp_path / f"{len(list(tmp_path.iterdir()))}.mcap")
        with session.prepare_scan(choice, outputs, view=False) as job:
            return job.run(lambda _: None, lambda: False)

    dim, both = scanned(), scanned("sweep.exposures_us=[5000, 40000]")
    assert both.shots == 2 * dim.shots and len(both.scan.bearings) == len(dim.scan.bearings)
    assert both.summary.points > 1.05 * dim.summary.points
    assert both.truth is not None and dim.truth is not None
    assert both.truth.median_m < 0.8 * dim.truth.median_m
    levels = [decode_image(shot.image, grey=True).image.mean() for shot in open_source(tmp_path / "1.mcap").shots()]
    assert min(levels[5:]) > 2 * max(levels[:5])
    assert plan(SweepParams(exposures_us=(1.0, 2.0))).words.count("each with 2 exposures") == 1
    with pytest.raises(ConfigError, match="exclude each other"):
        plan(SweepParams(exposures_us=(1.0,), mode="adaptive"))
