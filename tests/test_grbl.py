"""The GRBL driver against boards: one contract for `twin://` and for a pty with pyserial's own `Serial`."""

from __future__ import annotations

import gc
import itertools
import math
import os
import random
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanmap.errors import StageError
from scanmap.rig import Frame, Rig, Stage, grbl_opening
from scanmap.rig import grbl_protocol as protocol
from scanmap.rig.grbl import GrblStage
from scanmap.rig.grbl_opening import open_grbl
from scanmap.rig.serial_port import SerialPort
from scanmap.rig.stage import StageParams, open_stage
from scanmap.sweep import SweepParams, sweep
from scanmap.twin.board import DialectName
from scanmap.twin.firmware import Firmware
from scanmap.twin.motion import Drivetrain
from scanmap.twin.ports import plug, pty_port, tcp_port

PORTS: dict[str, Callable[[Firmware], AbstractContextManager[str]]] = {"twin": plug}
if os.name == "posix":
    PORTS |= {"pty": pty_port, "socket": tcp_port}


def handles() -> int:
    return len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0  # noqa: PTH112, PTH208


def eventually(condition: Callable[[], bool]) -> bool:
    """A pty hands bytes on when its thread gets round to it."""
    deadline = time.monotonic() + 2.0
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.005)
    return condition()


@pytest.fixture(params=["grbl", "grblHAL", "FluidNC"])
def board(request: pytest.FixtureRequest) -> Firmware:
    return Firmware(dialect=request.param, resets_on_open=request.param == "grbl")


@pytest.fixture(params=sorted(PORTS))
def url(request: pytest.FixtureRequest, board: Firmware, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setattr(grbl_opening, "BOOT_S", 0.1)  # a pty never restarts its board
    monkeypatch.setattr(grbl_opening, "GREETING_S", 0.1)
    before = handles(), threading.active_count()
    with PORTS[request.param](board) as url:
        yield url
    gc.collect()
    assert (handles(), threading.active_count()) == before


@pytest.fixture
def stage(url: str) -> Iterator[GrblStage]:
    stage = open_grbl(StageParams(port=url, steps_per_deg=80.0, timeout_s=1.0, watchdog=False))
    yield stage
    stage.close()


def test_the_firmware_is_recognised(stage: GrblStage, board: Firmware) -> None:
    assert stage.dialect.value == board.dialect
    assert board.dialect in stage.name


def test_reports_the_place_where_the_head_really_is(stage: Stage, board: Firmware) -> None:
    for deg in (0.0, 0.01, 33.333, 180.0, 7.77, 0.0):
        reported = stage.move_to(math.radians(deg))
        assert reported == pytest.approx(board.bearing, abs=1e-12)
        assert stage.where() == reported
        assert abs(math.degrees(reported) - deg) <= 0.5 / 80 + 1e-9


def test_laser_follows(stage: Stage, board: Firmware) -> None:
    assert not board.laser_on
    stage.laser(True)
    assert board.laser_on
    stage.move_to(0.1)
    assert board.laser_on
    stage.laser(False)
    assert not board.laser_on


def test_limits_hold(stage: Stage, board: Firmware) -> None:
    with pytest.raises(StageError, match="outside 0 to 180"):
        stage.move_to(math.radians(181))
    assert board.bearing == 0.0


def test_after_close_the_laser_is_off_and_the_motor_free(stage: Stage, board: Firmware) -> None:
    if board.dialect == "FluidNC":
        board.memory.settings[1] = 255  # stepping/idle_ms of its file, which docs/wiring.md asks for
    stage.move_to(1.0)
    stage.laser(True)
    assert board.motor_on
    stage.close()
    stage.close()
    assert eventually(lambda: not board.laser_on and not board.motor_on)
    with pytest.raises(StageError, match="gone"):
        stage.where()


def test_a_pulled_plug_is_noticed_at_once(stage: Stage, board: Firmware) -> None:
    stage.move_to(1.0)
    board.faults.unplugged = True
    with pytest.raises(StageError, match=r"is gone .*plug the board in again"):
        for _ in range(3):  # a dying line may swallow the first bytes
            stage.move_to(1.5)
    stage.close()


def test_a_second_start_finds_a_board_that_a_killed_one_left_shining(url: str, board: Firmware) -> None:
    first = open_grbl(StageParams(port=url, timeout_s=1.0, watchdog=False))
    first.move_to(1.0)
    first.laser(True)
    first._link.close()  # kill -9: no goodbye
    with_laser = open_grbl(StageParams(port=url, timeout_s=1.0, watchdog=False))
    assert not board.laser_on
    with_laser.close()
    if board.dialect == "grbl":
        assert board.memory.settings[1] == 25  # not the 255 of the killed run


def test_startup_lines_that_light_the_laser_are_undone(url: str, board: Firmware) -> None:
    board.memory.startup[0] = "M3S1000"
    board.power_cycle()
    assert eventually(lambda: board.laser_on)
    stage = open_grbl(StageParams(port=url, timeout_s=1.0, watchdog=False))
    assert not board.laser_on
    stage.start_turn(1.0, 0.3)
    stage.laser(False)  # a reset in mid-way, for M5 would wait
    assert not board.laser_on
    stage.laser(True)
    stage.close()
    assert eventually(lambda: not board.laser_on and not board.motor_on) or board.dialect == "FluidNC"
    assert not board.laser_on
    assert grbl_opening.identify(url, StageParams(timeout_s=1.0)).startswith(board.dialect)
    assert eventually(lambda: not board.laser_on)


def test_an_owner_may_say_what_is_left_of_the_motors_hold(url: str, board: Firmware) -> None:
    if board.dialect == "FluidNC":
        pytest.skip("FluidNC has no numbered settings")
    board.memory.settings[1] = 255.0  # left behind by a computer that lost power
    for idle_ms, left in ((None, 25.0), (80.0, 80.0), (255.0, 255.0), (None, 25.0)):
        open_grbl(StageParams(port=url, timeout_s=1.0, watchdog=False, idle_ms=idle_ms)).close()
        assert board.memory.settings[1] == left


def test_work_coordinates_whose_offset_no_report_tells(url: str, board: Firmware) -> None:
    board.memory.settings[10] = 0
    board.memory.offsets["G54"][0] = 7.0
    stage = open_grbl(StageParams(port=url, timeout_s=1.0, watchdog=False))
    for deg in (10.0, 55.0):
        assert stage.move_to(math.radians(deg)) == pytest.approx(board.bearing, abs=1e-9)
        assert math.degrees(board.bearing) == pytest.approx(deg, abs=1 / 80)
    stage.close()


def test_a_grblhal_that_takes_printable_commands_for_text_in_dollar_lines() -> None:
    board = Firmware(dialect="grblHAL", switch_deg=-3.0, resets_on_open=False, instant=False)
    board.memory.settings.update({22: 3, 23: 1, 39: 0, 25: 3600.0, 24: 3600.0, 26: 5.0})
    board.power_cycle()
    with plug(board) as url:  # asked for its status all the while it homes
        stage = open_grbl(StageParams(port=url, timeout_s=0.2, homing="switch", home_deg=-2.0, min_deg=-2.0))
        stage.move_to(math.radians(1.0))
        assert math.degrees(board.bearing) == pytest.approx(1.0, abs=1 / 80)
        stage.close()
    assert not board.laser_on


@pytest.mark.parametrize("dialect", ["grbl", "grblHAL", "FluidNC"])
def test_a_limit_switch_in_mid_way_leaves_the_board_as_it_was_found(dialect: DialectName) -> None:
    board = Firmware(dialect=dialect, instant=False)
    board.memory.settings[1] = 40.0
    with plug(board) as url:
        stage = open_grbl(StageParams(port=url, timeout_s=0.5))
        stage.laser(True)
        stage.start_turn(3.0, 0.3)
        board.trip_limit()
        with pytest.raises(StageError, match="ALARM:1, a limit switch"):
            stage.move_to(0.1)
        stage.close()
        assert eventually(lambda: board.state == "Alarm" and not board.laser_on)
        assert board.memory.settings[1] == 40.0


@pytest.mark.parametrize("dialect", ["grbl", "grblHAL"])
def test_the_boards_own_soft_limits_end_in_words_and_without_light(dialect: DialectName) -> None:
    board = Firmware(dialect=dialect)
    board.memory.settings.update({1: 40.0, 22: 1, 20: 1})
    board.power_cycle()
    with plug(board) as url:  # by hand, so that all of machine space lies on the other side of zero
        stage = open_grbl(StageParams(port=url, timeout_s=0.5))
        stage.laser(True)
        with pytest.raises(StageError, match=r"ALARM:2, the target lies outside .*\$20=0"):
            stage.move_to(0.5)
        stage.close()
    assert not board.laser_on and board.memory.settings[1] == 40.0


@pytest.mark.parametrize("dialect", ["grbl", "grblHAL", "FluidNC"])
def test_a_head_homed_at_its_far_end_counts_from_there(dialect: DialectName) -> None:
    board = Firmware(dialect=dialect, switch_deg=190.0, drivetrain=Drivetrain(bearing_deg=30.0))
    board.memory.settings.update({22: 1, 23: 0, 20: 1})  # machine space from -199 to -1
    board.power_cycle()
    with plug(board) as url:
        params = StageParams(port=url, homing="switch", home_deg=189.0, max_deg=189.0, timeout_s=0.5)
        stage = open_grbl(params)
        assert board.planner.position()[0] == -1.0
        for deg in (180.0, 0.0, 90.0):
            assert stage.move_to(math.radians(deg)) == pytest.approx(board.bearing, abs=1e-9)
            assert math.degrees(board.bearing) == pytest.approx(deg, abs=1 / 80)
        stage.close()


def test_fluidnc_is_never_told_a_numbered_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    board, sent = Firmware(dialect="FluidNC", switch_deg=-3.0), bytearray()
    board.memory.settings.update({22: 1, 23: 1})
    write = board.write
    monkeypatch.setattr(board, "write", lambda data: (sent.extend(data), write(data))[1])
    with plug(board) as url:
        params = StageParams(port=url, homing="switch", steps_per_deg=80.0, acceleration_deg_s2=100.0, idle_ms=30.0)
        stage = open_grbl(params)
        stage.laser(True)
        stage.move_to(1.0)
        stage.home()
        stage.close()
        assert stage.last_words == ["M5", "$MD"]
    assert b"$HX" in sent and not re.search(rb"\$\d+=", bytes(sent))


def test_settings_are_written_once(url: str, board: Firmware) -> None:
    params = StageParams(port=url, steps_per_deg=80.0, acceleration_deg_s2=200.0, timeout_s=1.0, watchdog=False)
    if board.dialect == "FluidNC":
        pytest.skip("FluidNC has no numbered settings")
    open_grbl(params).close()
    writes = board.memory.writes
    open_grbl(params).close()
    assert board.memory.writes == writes + 2  # the motor's hold, on and off
    assert board.memory.settings[120] == 200.0


def test_an_interrupted_move_stops_without_losing_its_place(
    stage: GrblStage, board: Firmware, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage.move_to(0.5)
    read_line = SerialPort.read_line
    calls = iter(range(100))

    def interrupted(self: SerialPort, timeout_s: float) -> str | None:
        if next(calls) == 1:
            raise KeyboardInterrupt
        return read_line(self, timeout_s)

    board.instant = False
    board._epoch = time.monotonic() - board._now
    monkeypatch.setattr(SerialPort, "read_line", interrupted)
    with pytest.raises(KeyboardInterrupt):
        stage.move_to(3.0)
    assert eventually(lambda: board.state == "Run")
    stage.laser(False)
    assert board.bearing < 2.0
    assert stage.where() == pytest.approx(board.bearing, abs=1e-9)
    assert stage.move_to(0.6) == pytest.approx(board.bearing, abs=1e-9)


@pytest.fixture
def uno() -> Iterator[tuple[Firmware, str]]:
    board = Firmware()
    with plug(board, "uno") as url:
        yield board, url


Uno = tuple[Firmware, str]


def test_backlash_is_taken_up(uno: Uno) -> None:
    board, url = uno
    board.drivetrain.backlash_deg = 0.8
    with Rig(NoCamera(), open_grbl(StageParams(port=url, backlash_deg=1.0)), "twin") as rig:
        offsets = [rig.stage.move_to(math.radians(deg)) - board.bearing for deg in (0, 90, 45, 45, 44, 120, 0)]
    assert offsets == pytest.approx([math.radians(0.4)] * 7, abs=1e-9)  # always the same side


class NoCamera:
    """A camera whose pictures show nothing, but never twice the same: one that repeats itself is frozen."""

    width = height = 1

    def __init__(self) -> None:
        self.numbers = itertools.count()

    def grab(self) -> Frame:
        return Frame(str(next(self.numbers)).encode(), 0.0)

    def close(self) -> None: ...


@pytest.mark.parametrize("homing", ["switch", "index"])
def test_homing_gives_the_same_bearing_wherever_the_head_stood(homing: str) -> None:
    for start in (5.0, 100.0):
        board = Firmware(switch_deg=-3.0, index_deg=-2.0, drivetrain=Drivetrain(bearing_deg=start))
        board.memory.settings.update({22: 1, 23: 1} if homing == "switch" else {})
        board.power_cycle()
        home = -2.0  # the switch is at -3, the board backs off by $27 = 1
        with plug(board) as url:
            params = StageParams(port=url, homing=homing, home_deg=home, min_deg=-2, timeout_s=0.5)
            stage = open_grbl(params)
            stage.move_to(math.pi / 2)
            assert math.degrees(board.bearing) == pytest.approx(90.0, abs=1 / 80)
            stage.close()


@pytest.mark.parametrize("dialect", ["grbl", "grblHAL", "FluidNC"])
def test_homing_without_a_switch_is_said_in_every_dialect(dialect: DialectName) -> None:
    board = Firmware(dialect=dialect, switch_deg=None)
    board.memory.settings.update({22: 1, 23: 1})
    board.power_cycle()
    with plug(board) as url, pytest.raises(StageError, match="ALARM:9, the limit switch was not found"):
        open_grbl(StageParams(port=url, homing="switch", timeout_s=0.5))


def test_by_hand_home_is_where_the_head_stands(uno: Uno) -> None:
    board, url = uno
    stage = open_grbl(StageParams(port=url, home_deg=90.0))
    assert math.degrees(stage.where()) == 90.0
    stage.move_to(math.radians(120))
    assert stage.home() == math.radians(90)
    stage.close()
    assert math.degrees(board.bearing) == pytest.approx(30.0)


@pytest.mark.parametrize("fault", ["lose_ok", "lose_status", "lose_lines", "garbage", "latency"])
def test_small_faults_at_random_moments_are_repaired(uno: Uno, fault: str) -> None:
    board, url = uno
    chance = random.Random(4)
    stage = open_grbl(StageParams(port=url, timeout_s=0.5))
    for deg in range(0, 40, 2):
        if fault == "garbage":
            board.faults.garbage = chance.randbytes(20)
        elif fault == "latency":
            board.faults.latency_s = chance.uniform(0, 0.02)
        elif chance.random() < 0.3:
            setattr(board.faults, fault, 1)
        assert stage.move_to(math.radians(deg)) == pytest.approx(board.bearing, abs=1e-9)
        assert math.degrees(board.bearing) == pytest.approx(deg, abs=1 / 80)
    stage.close()
    assert not board.laser_on


def pull_the_plug(board: Firmware) -> None:
    board.faults.unplugged = True


def hang(board: Firmware) -> None:
    board.faults.mute = True


@pytest.mark.parametrize(
    ("fault", "words", "laser_off"),
    [
        (Firmware.power_cycle, "restarted by itself.*position is lost", True),
        (Firmware.trip_limit, "ALARM:1, a limit switch", True),
        (pull_the_plug, "is gone", False),
        (hang, "has not answered for 0.2 s", False),
    ],
)
def test_grave_faults_in_a_sweep_are_noticed_said_and_leave_no_laser(
    uno: Uno, fault: Callable[[Firmware], None], words: str, laser_off: bool
) -> None:
    board, url = uno
    stage = open_stage(StageParams(port=url, timeout_s=0.2))
    with Rig(NoCamera(), stage, "twin", is_twin=True) as rig:
        shots = sweep(rig, SweepParams(step_deg=5), sleep=board.wait)
        seen = [next(shots) for _ in range(4)]
        assert board.laser_on
        fault(board)
        with pytest.raises(StageError, match=words):
            next(shots)
        assert len(seen) == 4
    assert board.laser_on is not laser_off


def test_after_an_unasked_restart_nothing_moves_until_homed(uno: Uno) -> None:
    board, url = uno
    stage = open_grbl(StageParams(port=url, timeout_s=0.3))
    stage.move_to(1.0)
    board.power_cycle()
    for _ in range(2):
        with pytest.raises(StageError, match="position is lost"):
            stage.move_to(1.5)
    assert board.bearing == pytest.approx(1.0, abs=1e-3)
    stage.home()
    stage.move_to(0.5)
    assert board.bearing == pytest.approx(1.5, abs=1e-3)
    stage.close()


@pytest.mark.parametrize("dialect", ["grbl", "grblHAL", "FluidNC"])
@pytest.mark.parametrize("moment", ["at rest", "in mid-way"])
def test_a_restart_is_noticed_although_its_banner_got_lost(dialect: DialectName, moment: str) -> None:
    board = Firmware(dialect=dialect, instant=moment == "at rest")
    with plug(board) as url:
        stage = open_grbl(StageParams(port=url, timeout_s=0.3, speed_deg_s=60.0))
        stage.move_to(0.2)
        if moment == "in mid-way":
            stage.start_turn(1.0, 0.5)
        board.power_cycle()
        board.read(1 << 16)
        place = board.bearing
        with pytest.raises(StageError, match="restarted by itself"):
            stage.move_to(1.0)
        if moment == "at rest":
            assert board.bearing == place
        stage.close()
    assert not board.laser_on


def test_a_restart_while_homing_ends_in_bounded_time(monkeypatch: pytest.MonkeyPatch) -> None:
    board = Firmware(switch_deg=-3.0, instant=False, drivetrain=Drivetrain(bearing_deg=90.0))
    board.memory.settings.update({22: 1, 23: 1})
    board.power_cycle()
    write = board.write

    def brown_out_in_homing(data: bytes) -> None:
        write(data)
        if data == b"$H\n":
            board.power_cycle()

    monkeypatch.setattr(board, "write", brown_out_in_homing)
    with plug(board) as url, pytest.raises(StageError, match="restarted by itself"):
        open_grbl(StageParams(port=url, homing="switch", timeout_s=0.2))


def test_auto_names_what_it_tried(monkeypatch: pytest.MonkeyPatch, uno: Uno) -> None:
    board, url = uno
    monkeypatch.setattr(grbl_opening, "serial_devices", lambda: [])
    with pytest.raises(StageError, match="no serial port on this machine"):
        open_grbl(StageParams())
    monkeypatch.setattr(grbl_opening, "serial_devices", lambda: ["/dev/nothing", "loop://", url])
    stage = open_grbl(StageParams(timeout_s=0.05))
    assert stage.name == f"grbl on {url}"
    stage.close()
    with pytest.raises(StageError, match=r"/dev/nothing.*cannot be opened"):
        open_grbl(StageParams(port="/dev/nothing"))
    with pytest.raises(StageError, match=r"refused; is the board on, and on this network") as refused:
        open_grbl(StageParams(port="socket://127.0.0.1:1"))
    assert str(refused.value).count("socket://") == 1 and "cable" not in str(refused.value)
    assert not board.laser_on


def test_an_old_grbl_is_refused(uno: Uno, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("scanmap.twin.board").twin.board.BANNERS, "grbl", "Grbl 0.9j ['$' for help]")
    with pytest.raises(StageError, match=r"grbl 0\.9j: flash grbl 1\.1"):
        open_grbl(StageParams(port=uno[1], timeout_s=0.2))


@settings(max_examples=500)
@given(st.text(max_size=80) | st.from_regex(r"<\w+(:\d)?\|[MW]Pos:[-.\d,]*(\|WCO:[-.\d,]*)?>?", fullmatch=True))
def test_no_line_crashes_the_parsers(line: str) -> None:
    status = protocol.parse_status(line)
    if status:
        assert all(map(math.isfinite, status.position))
    protocol.parse_banner(line)
    protocol.parse_setting(line)
    protocol.parse_probe(line)
    code = protocol.parse_code(line)
    if code:
        assert protocol.explain(*code)


@given(x=st.floats(-1e4, 1e4), state=st.sampled_from(["Idle", "Run", "Hold:0", "Hold:1", "Alarm", "Door:2"]))
def test_status_reports_are_read_back(x: float, state: str) -> None:
    status = protocol.parse_status(f"<{state}|MPos:{x:.3f},0.000,1.000|Bf:15,128|FS:0,0|WCO:1.000,2.000,3.000|Pn:X>")
    assert status is not None
    assert status.position[0] == pytest.approx(x, abs=5.0001e-4)  # three decimals, rounded
    assert f"{status.state}:{status.substate}" in (state, f"{state}:0")
    assert status.work_offset == (1.0, 2.0, 3.0)


@settings(max_examples=60, deadline=None)
@given(noise=st.binary(max_size=200))
def test_noise_on_the_line_before_the_banner_does_no_harm(noise: bytes) -> None:
    board = Firmware(resets_on_open=False)
    with plug(board, "noisy") as url:
        board.faults.garbage = noise
        stage = open_grbl(StageParams(port=url, timeout_s=0.3))
        assert stage.move_to(0.5) == pytest.approx(board.bearing)
        stage.close()


KILLED = """
import os, signal, sys
from scanmap.rig import grbl_opening as grbl
from scanmap.rig.stage import StageParams
grbl.BOOT_S = 0.2
stage = grbl.open_grbl(StageParams(port=sys.argv[1]))
stage.laser(True)
stage.start_turn(3.0, 0.1)
print("shining", flush=True)
sys.stdin.readline()
stage.close() if sys.argv[2] == "close" else os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(os.name != "posix", reason="needs a pty")
@pytest.mark.parametrize("end", ["close", "kill"])
def test_after_kill_9_the_watchdog_puts_the_laser_out(end: str) -> None:
    board = Firmware(instant=False, resets_on_open=False)
    with pty_port(board) as url:
        command = [sys.executable, "-c", KILLED, url, end]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as program:
            assert program.stdin is not None
            assert program.stdout is not None
            assert program.stdout.readline() == b"shining\n"
            assert board.laser_on
            assert board.state == "Run"
            program.stdin.write(b"\n")
        assert program.returncode == (0 if end == "close" else -9)
        deadline = time.monotonic() + 10.0
        while board.laser_on and time.monotonic() < deadline:
            time.sleep(0.02)
        assert not board.laser_on
        assert board.state == "Idle"  # braked first: the position is kept


def test_many_scans_leave_nothing_behind() -> None:
    """Fast-forward endurance: no handle, thread or queued byte is left after a scan."""
    board = Firmware()
    with plug(board) as url:
        left = set()
        for _ in range(20):
            with Rig(NoCamera(), open_grbl(StageParams(port=url)), "twin", is_twin=True) as rig:
                assert len(list(sweep(rig, SweepParams(step_deg=20), sleep=board.wait))) == 10
            left.add((handles(), threading.active_count(), board.waiting(), board.memory.writes % 2))
    assert len(left) == 1
