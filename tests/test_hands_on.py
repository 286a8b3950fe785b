"""`doctor`, `stage`, `init`, `live`: with nothing attached, on the twin, and on a webcam and board that are fakes."""

# ruff: noqa: F401, F811 (fixtures of other test files)
from __future__ import annotations

import errno
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import serial
from fake_cameras import as_jpeg, noisy, phone
from test_cli import Run, one_line, run
from test_hardware_scan import HARDWARE, Head, head

from scanmap import config as configuration
from scanmap import session
from scanmap.cli.keys import next_key
from scanmap.cli.live import words
from scanmap.laserline import Reason
from scanmap.rig import camera as camera_module
from scanmap.rig.camera_probe import probe_modes
from scanmap.session import doctor as doctor_module
from scanmap.session.knobs import Knobs
from scanmap.twin.firmware import Firmware
from scanmap.twin.ports import plug, pty_port

pytestmark = pytest.mark.usefixtures("baked_once")

SMALL = ("--set", "calibration.image.width=320", "--set", "calibration.image.height=240")


@pytest.fixture
def nothing_attached(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("scanmap.session.doctor", "scanmap.session.new_rig"):
        monkeypatch.setattr(f"{module}.camera_devices", list)
        monkeypatch.setattr(f"{module}.serial_devices", list)
    monkeypatch.setattr(camera_module, "camera_devices", list)


@pytest.fixture
def attached(head: Head, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A webcam and a board; the board's port."""
    with pty_port(head.board) as url:
        for module in ("scanmap.session.doctor", "scanmap.session.new_rig"):
            monkeypatch.setattr(f"{module}.camera_devices", lambda: [(0, "Fake Cam")])
            monkeypatch.setattr(f"{module}.serial_devices", lambda: [url])
        yield url


# doctor


def test_doctor_with_nothing_attached_examines_the_twin(run: Run, nothing_attached: None) -> None:
    said = run("doctor", *SMALL)
    assert said.code == 0 and not said.err
    lines = said.out.splitlines()
    assert any(line.startswith("note  camera: none on this machine: plug a webcam in") for line in lines)
    assert any(line.startswith("note  board: no serial port") for line in lines)
    assert any(line.startswith("ok    rig: DIGITAL TWIN") for line in lines)
    for part in ("picture", "laser", "latency", "line", "speed", "disk"):
        assert any(line.startswith(f"ok    {part}: ") for line in lines), part
    assert lines[-1] == "ready to scan"


def test_doctor_of_a_rig_that_is_not_there_is_a_fault(run: Run, nothing_attached: None) -> None:
    said = run("doctor", "--set", "rig=hardware", *SMALL)
    assert said.code == 1 and not said.err
    assert "FAULT camera: none" in said.out and "FAULT board: no serial port" in said.out
    assert "FAULT rig: no camera found" in said.out and said.out.splitlines()[-1] == "3 faults"


@pytest.mark.skipif(os.name != "posix", reason="a pty needs POSIX")
def test_doctor_of_a_whole_rig(run: Run, head: Head, attached: str) -> None:
    rng = np.random.default_rng(2)

    def line(size: tuple[int, int]) -> np.ndarray:
        """Cheaper than the room: a wall two metres away."""
        picture = noisy(rng, 40, size)
        picture[:, 49:52, 2] += np.uint8(120 * head.board.laser_on)
        return picture

    head.device.picture, head.device.period_s = line, 0.05
    settings = [word for key in HARDWARE if "latency" not in key for word in ("--set", key)]
    said = run("doctor", *settings, "--set", f"stage.port={attached}")
    assert "ok    camera: 0 (Fake Cam): 320x240 at" in said.out
    assert f"ok    board: {attached}: grbl 1.1h" in said.out
    assert "ok    laser: on and off differ by" in said.out
    assert "note  latency: " in said.out and "set camera.latency_s = " in said.out
    assert said.code == 0 and "ready to scan" in said.out
    assert not head.board.laser_on and not head.board.motor_on


def test_a_full_disk_and_a_weak_laser_are_faults(monkeypatch: pytest.MonkeyPatch, nothing_attached: None) -> None:
    monkeypatch.setattr(doctor_module.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 1_000_000})())
    choice = session.Choice("twin-room", (*SMALL[1::2], "twin.laser.white_wall_peak=0.001"))
    states = {finding.part: finding for finding in session.examine(choice, Path())}
    disk = states["disk"]
    assert disk.state == "fault" and disk.words.startswith("1 MB free, a scan of ") and "free some" in disk.words
    assert "and 200 MB are to stay free (recording.min_free_mb)" in disk.words
    assert states["rig"].state == "fault" and "makes no difference" in states["rig"].words


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EACCES, r"you may not use it: join its group `dialout` \(`sudo usermod -aG dialout"),
        (errno.EBUSY, r"another program holds it .*: close that one"),
        (errno.ENOENT, r"it is not there; ports of this machine: none; plug the board in"),
    ],
)
def test_a_port_that_cannot_be_opened_says_why_and_what_to_do(
    run: Run, nothing_attached: None, monkeypatch: pytest.MonkeyPatch, number: int, words: str
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise serial.SerialException(number, f"could not open port: {os.strerror(number)}")

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    said = run("doctor", "--set", "rig=hardware", "--set", "stage.port=/dev/ttyUSB7")
    line = next(line for line in said.out.splitlines() if "board" in line)
    assert said.code == 1 and line.startswith("FAULT") and re.search(f"/dev/ttyUSB7: cannot be opened: {words}", line)


def still_pictures(head: Head) -> Callable[[], float]:
    """Two sizes of pictures that cost nothing; returns the clock by which they come, 25 a second on any machine."""
    pictures = [0]

    def send(size: tuple[int, int]) -> np.ndarray:
        pictures[0] += 1
        return np.zeros((size[1], size[0], 3), np.uint8)

    head.device.sizes, head.device.picture, head.device.period_s = ((640, 480), (1280, 720)), send, 0.0
    return lambda: pictures[0] * 0.04


def test_modes_are_tried_one_by_one(head: Head) -> None:
    modes = probe_modes(0, still_pictures(head))
    assert [mode.words for mode in modes] == ["640x480 at 25/s JPEG", "1280x720 at 25/s JPEG"]


# stage


def test_stage_on_the_twin(run: Run) -> None:
    assert "bearing 30.000 deg" in run("stage", "jog", "30").out
    assert "bearing 12.500 deg" in run("stage", "jog", "--to", "12.5").out
    said = run("stage", "where")
    assert said.code == 0 and "DIGITAL TWIN" in said.out and "bearing 0.000 deg" in said.out
    assert "home, by hand" in run("stage", "home").out
    one_line(run("stage", "jog"), 2, "stage jog 10", "--to")
    one_line(run("stage", "jog", "--", "-5"), 2, "outside 0 to 180")
    one_line(run("stage", "laser", "blue"), 2, "blue", "on", "off")
    one_line(run("stage", "where", "--config", "srv-turntable"), 2, "has no stage")
    one_line(run("stage", "laser", "on", "--config", "thesis"), 2, "always-on", "own switch")


def test_home_by_switch_really_homes() -> None:
    config = configuration.load("twin-room", ["stage.homing=switch", "twin.drive.switch_deg=-3", "stage.home_deg=-2"])
    said: list[str] = []
    session.home(config, said.append)
    assert "home, by its switch: bearing -2.000 deg" in said


def test_asking_where_and_the_laser_move_nothing_even_where_opening_would_home() -> None:
    board = Firmware(switch_deg=-3.0)
    board.memory.settings.update({22: 1, 23: 1})
    board.drivetrain.bearing_deg = 30.0
    with plug(board) as url:
        config = configuration.load(
            "twin-room", ["rig=hardware", f"stage.port={url}", "stage.homing=switch", "stage.home_deg=-2"]
        )
        session.where(config, lambda _: None)
        session.switch_laser(config, lambda _: None, on=True, seconds=0.1)
        assert math.degrees(board.bearing) == pytest.approx(30.0)
        session.home(config, lambda _: None)
        assert math.degrees(board.bearing) < 0.0


@pytest.mark.skipif(os.name != "posix", reason="a pty needs POSIX")
def test_the_laser_is_on_only_while_the_command_runs(head: Head, attached: str) -> None:
    config = configuration.load("twin-room", [*HARDWARE, f"stage.port={attached}"])
    seen: list[bool] = []

    def sleep(seconds: float) -> None:
        time.sleep(seconds)
        seen.append(head.board.laser_on)

    said: list[str] = []
    session.switch_laser(config, said.append, on=True, seconds=0.3, sleep=sleep)
    assert seen and all(seen)
    assert not head.board.laser_on and said[-1] == "laser off"

    def interrupted(_: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        session.switch_laser(config, said.append, on=True, seconds=30, sleep=interrupted)
    assert not head.board.laser_on


LIT = """
import sys
import cv2
from fake_cameras import FakeCapture, FakeDevice
from scanmap.cli import main
from scanmap.rig import grbl_opening as grbl
device = FakeDevice(sizes=((320, 240),))
cv2.VideoCapture = lambda *_: FakeCapture(device)
grbl.BOOT_S = 0.1
settings = ["rig=hardware", "camera.source=0", "calibration.image.width=320", "calibration.image.height=240"]
words = [word for setting in (*settings, f"stage.port={sys.argv[1]}") for word in ("--set", setting)]
main([*sys.argv[2].split(), *words])
"""


@pytest.mark.skipif(os.name != "posix", reason="a pty needs POSIX")
@pytest.mark.parametrize(
    ("command", "end"),
    [
        ("stage laser on --seconds 60", signal.SIGTERM),
        ("live --no-view", signal.SIGINT),
        pytest.param("stage laser on --seconds 60", signal.SIGINT, marks=pytest.mark.slow),
        pytest.param("live --no-view", signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param("doctor", signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param("calibrate latency --method blink", signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param("calibrate latency", signal.SIGINT, marks=pytest.mark.slow),
    ],
)
def test_a_signal_switches_the_laser_off_and_frees_the_motor(command: str, end: signal.Signals) -> None:
    board = Firmware(instant="calibrate latency" not in command)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with pty_port(board) as url:
        process = subprocess.Popen(
            [sys.executable, "-c", LIT, url, command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
        )
        try:
            deadline = time.monotonic() + 60
            while not board.laser_on and process.poll() is None and time.monotonic() < deadline:
                time.sleep(0.02)
            assert board.laser_on, process.communicate(timeout=30)
            process.send_signal(end)
            _, errors = process.communicate(timeout=30)
        finally:
            process.kill()
        assert process.returncode == 130, errors
        assert not board.laser_on and not board.motor_on


@pytest.mark.skipif(os.name != "posix", reason="a pty needs POSIX")
def test_ctrl_c_stops_a_jog_where_it_is_with_its_place_kept() -> None:
    board = Firmware(instant=False)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    sent = bytearray()
    with pty_port(board) as url:
        write = board.write
        board.write = lambda data: (sent.extend(data), write(data))[1]  # type: ignore[method-assign]
        command = [sys.executable, "-c", LIT, url, "stage jog 90"]
        with subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment) as process:
            deadline = time.monotonic() + 60
            while board.bearing < 0.1 and process.poll() is None and time.monotonic() < deadline:
                time.sleep(0.02)
            assert board.state == "Jog"
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=30)
        assert process.returncode == 130
        assert b"$J=G53 G21 X90" in sent and sent.count(b"\x85") == 1 and b"!" not in sent
        deadline = time.monotonic() + 5
        while board.motor_on and time.monotonic() < deadline:
            time.sleep(0.02)
        assert 0.1 < board.bearing < 1.5 and board.state == "Idle" and not board.motor_on
        assert board.planner.position()[0] == pytest.approx(math.degrees(board.bearing))


@pytest.mark.parametrize("words", [("500",), ("--", "-200"), ("nan",), ("--to", "181"), ("--", "-5")])
def test_a_jog_out_of_the_limits_is_a_usage_error(run: Run, words: tuple[str, ...]) -> None:
    said = run("stage", "jog", *words)
    assert said.code == 2 and "stage.max_deg" in said.err and len(said.err.splitlines()) == 1


# init


def test_a_first_configuration_loads_and_is_never_overwritten(
    run: Run,
    nothing_attached: None,
    tmp_path: Path,
) -> None:
    said = run("init", "--out", "my-rig.toml", "--gear", "3", "--microsteps", "8")
    assert said.code == 0 and "no camera found" in said.out and "no GRBL board found" in said.out
    assert "next: scanmap doctor --config my-rig.toml" in said.out
    config = configuration.load(str(tmp_path / "my-rig.toml"))
    assert config.rig == "hardware" and config.stage.steps_per_deg == pytest.approx(200 * 8 * 3 / 360)
    assert config.camera.source == "auto" and config.stage.port == "auto" and config.sweep.off_frames
    assert config.head().intrinsics.width == config.camera.width
    before = (tmp_path / "my-rig.toml").read_bytes()
    one_line(run("init", "--out", "my-rig.toml"), 2, "my-rig.toml exists and is not overwritten")
    assert (tmp_path / "my-rig.toml").read_bytes() == before
    one_line(run("init", "--out", "my-rig.yaml"), 2, "my-rig.toml")
    one_line(run("init", "--out", "x.toml", "--gear", "-1"), 2, "--gear")
    one_line(run("init", "--out", "nowhere/x.toml"), 2, "nowhere")
    for options in (("--gear", "nan"), ("--gear", "inf"), ("--gear", "0"), ("--baseline-m", "nan")):
        said = run("init", "--out", "x.toml", *options)
        assert said.code == 2 and not said.out  # said before anything is probed
    assert [path.name for path in tmp_path.iterdir()] == ["my-rig.toml"]


@pytest.mark.skipif(os.name != "posix", reason="a pty needs POSIX")
def test_a_first_configuration_names_what_was_found(
    run: Run, head: Head, attached: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = still_pictures(head)
    monkeypatch.setattr("scanmap.session.new_rig.probe_modes", lambda index: probe_modes(index, clock))
    said = run("init", "--out", "my-rig.toml", "--laser", "always-on")
    assert "camera 0 (Fake Cam): 1280x720" in said.out and f"board on {attached}: grbl 1.1h" in said.out
    config = configuration.load(str(tmp_path / "my-rig.toml"))
    assert (config.camera.source, config.camera.width, config.stage.port) == (0, 1280, attached)
    assert config.stage.laser == "always-on" and not config.sweep.off_frames


def test_a_first_configuration_asks_a_phone_for_its_size(run: Run, nothing_attached: None, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    with phone(lambda: as_jpeg(noisy(rng, size=(320, 240)))) as served:
        said = run("init", "--out", "a.toml", "--camera", served.url + "/video")
    assert said.code == 0 and "pictures of 320x240" in said.out
    config = configuration.load(str(tmp_path / "a.toml"))
    assert config.head().intrinsics.width == 320 and config.camera.source == served.url + "/video"
    said = run("init", "--out", "b.toml", "--camera", "7")
    assert said.code == 0 and "camera 7 cannot be opened" in said.out
    assert configuration.load(str(tmp_path / "b.toml")).camera.source == 7


# live

KNOBS = Knobs("auto", 16, 100, "red", "plane")


def test_keys_change_what_the_thesis_could_change() -> None:
    def after(keys: str, knobs: Knobs = KNOBS) -> Knobs:
        for key in keys:
            knobs = knobs.pressed(key, 240)
        return knobs

    assert after("+").bit_index == 17 and after("+").grey == "bit_index"
    assert after("-" * 30).bit_index == 0 and after("+" * 30).bit_index == 24
    assert after("jjkJ").row == 111 and after("k" * 200).row == 0 and after("J" * 99).row == 239
    assert KNOBS.pressed("up", 240).row == 99 and KNOBS.pressed("down", 240).row == 101
    assert [after("c" * n).colour for n in range(4)] == ["red", "green", "blue", "red"]
    assert [after("m" * n).model for n in range(4)] == ["plane", "ratio", "pixel_angle", "plane"]
    assert after("g").grey == "bit_index" and after("gG").grey == "auto" and after("G").grey == "ycbcr_cb"
    assert after("xyz\t\n") == KNOBS and after("q").ended


@pytest.mark.skipif(os.name != "posix", reason="reads a pipe as a terminal")
def test_keys_of_a_terminal() -> None:
    out, into = os.pipe()
    os.write(into, b"g\x1b[A\x1b[Bq")
    assert [next_key(out) for _ in range(5)] == ["g", "up", "down", "q", ""]
    os.close(out)
    os.close(into)


def test_live_on_the_twin_says_the_distances_and_obeys_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    choice = session.Choice("thesis", (*SMALL[1::2], "twin.sensor.noise=false"))
    panel = session.open_live(choice, None, lambda _: None)
    keys = iter(["", "m", "", "+", "", "c", "", "q", ""])
    shown: list[Knobs] = []
    seen = []
    for reading, knobs in panel.readings(panel.knobs(60), lambda: next(keys), lambda _, turned: shown.append(turned)):
        seen.append(reading)
        text = words(reading, knobs)
        assert text[1].startswith(f"row 60: maximum {reading.peak}, column")
    panel.close()
    assert panel.lines[0].startswith("DIGITAL TWIN")
    assert [knobs.model for knobs in shown] == ["plane", "ratio", "ratio", "ratio"]
    assert shown[2].grey == "bit_index" and shown[2].bit_index == 17 and shown[3].colour == "green"
    first = seen[0]
    depth = first.distances["plane"]
    # The wall is 2 m away.
    assert depth.depth_m == pytest.approx(2.0, abs=0.02) and 0 < depth.sigma_m < 0.02
    assert set(first.distances) == {"plane", "ratio", "pixel_angle"}
    assert first.p == pytest.approx((320 - first.ppx) / 320)
    assert [reading.frame for reading in seen] == [1, 2, 3, 4]


def test_live_says_below_range_and_no_return(monkeypatch: pytest.MonkeyPatch) -> None:
    panel = session.open_live(session.Choice("twin-room", (*SMALL[1::2], "triangulation.range_min_m=2.5")), None, print)
    reading, _ = next(iter(panel.readings(panel.knobs(None), lambda: "", lambda *_: None)))
    panel.close()
    assert reading.distances["plane"].words == "below range" and math.isnan(reading.distances["plane"].depth_m)
    dark = session.open_live(
        session.Choice("twin-room", (*SMALL[1::2], "twin.laser.white_wall_peak=0.0001")), None, print
    )
    reading, knobs = next(iter(dark.readings(dark.knobs(None), lambda: "", lambda *_: None)))
    dark.close()
    assert {value.words for value in reading.distances.values()} == {f"no return ({Reason.WEAK.words})"}
    assert "no line" in words(reading, knobs)[1]


def test_live_of_a_recording_and_of_a_camera(
    run: Run,
    head: Head,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = ("calibration.image.width=320", "calibration.image.height=240", "sweep.end_deg=4")
    with session.prepare_scan(
        session.Choice(None, settings), session.Outputs(record=tmp_path / "a.mcap"), view=False
    ) as job:
        job.run(lambda _: None, lambda: False)
    said = run("live", "a.mcap", "--no-view", "--rrd", "a.rrd", "--row", "120")
    assert said.code == 0 and "played as if live" in said.out and "row 120: maximum" in said.out
    assert (tmp_path / "a.rrd").stat().st_size > 10_000
    one_line(run("live", "a.mcap", "--no-view", "--rrd", "a.rrd"), 2, "a.rrd exists")
    one_line(run("live", "--no-view", *SMALL, "--row", "240"), 2, "--row 240", "0 to 239")
    with plug(head.board) as url:
        words_ = [word for key in (*HARDWARE, f"stage.port={url}") for word in ("--set", key)]
        said = run("live", *words_, "--no-view", "--frames", "3")
    assert said.code == 0 and "laser ON until this ends" in said.out and "calibrated: " in said.out
    assert not head.board.laser_on


def test_pictures_of_a_dead_camera_are_said_and_end_it(head: Head, run: Run) -> None:
    words_ = [word for key in (*HARDWARE, "stage.laser=always-on", "camera.timeout_s=0.1") for word in ("--set", key)]
    number = iter(range(1000))
    real = head.camera.grab

    def lose() -> bytes:
        head.device.unplugged = next(number) > 3
        return real().image

    head.device.picture = lambda _: lose()
    said = run("live", *words_, "--no-view")
    assert said.code == 1 and "fault: camera 0" in said.out
