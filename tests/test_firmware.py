"""The twin's board against grbl 1.1's documented behaviour (gnea/grbl, doc/markdown), byte by byte."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanmap.twin.firmware import Firmware
from scanmap.twin.motion import Drivetrain, Move


def say(board: Firmware, text: str | bytes) -> list[str]:
    """Send, let all that follows happen, and return the lines that came."""
    board.write(text if isinstance(text, bytes) else text.encode() + b"\n")
    return listen(board)


def listen(board: Firmware) -> list[str]:
    heard = board.read(1 << 16)
    while (event := board.next_event()) != math.inf:
        board.wait(event)
        heard += board.read(1 << 16)
    return [line for line in heard.decode().split("\r\n") if line]


@pytest.fixture
def board() -> Firmware:
    board = Firmware()
    listen(board)
    return board


def test_banner_on_power_up_and_after_reset() -> None:
    board = Firmware()
    assert listen(board) == ["Grbl 1.1h ['$' for help]"]
    assert say(board, b"\x18") == ["Grbl 1.1h ['$' for help]"]


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("", 0),
        ("g1 x10 f600", 0),
        ("G0X1(comment)Y2;rest", 0),
        ("10", 1),
        ("GX", 2),
        ("$nonsense", 2),  # a setting whose number is missing
        ("$Hello", 3),
        ("$100", 3),
        ("$100=", 2),
        ("$100=80x", 3),
        ("$200=1", 3),
        ("$100=-1", 4),
        ("$H", 5),
        ("$0=2", 6),
        ("$20=1", 10),
        ("G1 X" + "1" * 80, 11),
        ("$J=X10", 22),
        ("$J=G0X10F100", 16),
        ("G7", 20),
        ("M7", 20),  # not built in
        ("G1.5 X1 F10", 23),
        ("M3.5", 23),
        ("A10", 20),
        ("G0 G1 X1", 21),
        ("G1 X1", 22),
        ("G10 L2 P1 X0 G1", 24),
        ("X1 X2", 25),
        ("G92", 26),
        ("G4", 28),
        ("G80 G53 X1", 30),
        ("G80 X1", 31),
        ("G1 X1 F10 P3", 36),
    ],
)
def test_every_line_gets_one_answer_with_grbls_number(board: Firmware, line: str, error: int) -> None:
    assert say(board, line)[-1:] == [f"error:{error}" if error else "ok"]


def test_status_report_has_grbls_form_and_its_rare_fields(board: Firmware) -> None:
    say(board, "G10 L2 P1 X5")
    reports = [say(board, b"?")[0] for _ in range(22)]
    assert reports[0] == "<Idle|MPos:0.000,0.000,0.000|FS:0,0|WCO:5.000,0.000,0.000>"
    assert reports[1] == "<Idle|MPos:0.000,0.000,0.000|FS:0,0|Ov:100,100,100>"
    assert set(reports[2:10]) == {"<Idle|MPos:0.000,0.000,0.000|FS:0,0>"}
    assert "WCO" in reports[10]
    say(board, "$10=2")
    assert say(board, b"?")[0].startswith("<Idle|WPos:-5.000,0.000,0.000|Bf:15,128|FS:0,0")


def test_inches_have_four_decimals_everywhere(board: Firmware) -> None:
    board.index_deg = -25.4
    for line in ("$13=1", "G10 L2 P1 X2.54"):
        say(board, line)
    assert say(board, "G38.2 X-90 F600") == ["[PRB:-1.0000,0.0000,0.0000:1]", "ok"]
    assert say(board, b"?") == [
        "<Idle|MPos:-1.0054,0.0000,0.0000|FS:0.0,0|Pn:P|WCO:0.1000,0.0000,0.0000>"
    ]  # it braked behind the mark
    parameters = say(board, "$#")
    assert [line[1:4] for line in parameters[:-1]] == [
        *(f"G{n}" for n in (54, 55, 56, 57, 58, 59, 28, 30, 92)),
        "TLO",
        "PRB",
    ]
    assert "[G54:0.1000,0.0000,0.0000]" in parameters


def test_what_an_alarm_and_the_check_mode_lock(board: Firmware) -> None:
    say(board, "$C")
    assert [say(board, line)[-1] for line in ("$100=90", "$H", "$I", "$X")] == ["error:8"] * 3 + ["ok"]
    say(board, "$C")
    board.raise_alarm(5)
    listen(board)
    assert [say(board, line)[-1] for line in ("M5", "$C", "$N0=G21", "$1=255")] == [
        "error:9",
        "error:8",
        "error:8",
        "ok",
    ]


def test_only_a_change_of_m3_or_s_reaches_the_laser(board: Firmware) -> None:
    assert say(board, "M3 S500") == ["ok"]
    assert board.laser_on
    say(board, "$30=2000")
    assert not board.laser_on
    say(board, "M3 S500")
    assert not board.laser_on
    say(board, "S600")
    assert board.laser_on
    board.write(b"M5\nG1 X90 F600\nM5\n")
    assert board.read(100) == b"ok\r\n" * 3  # the second M5 has nothing to wait for


def test_program_end_keeps_units_speed_and_feed(board: Firmware) -> None:
    say(board, "G20 G91 G55 F10 M3 S5")
    assert say(board, "M2") == ["[MSG:Pgm End]", "ok"]
    assert say(board, "$G")[0] == "[GC:G1 G54 G17 G20 G90 G94 M5 M9 T0 F254 S5]"
    assert not board.laser_on


def test_a_dead_stop_lets_the_motor_go_even_where_it_should_hold(board: Firmware) -> None:
    say(board, "$1=255")
    board.write(b"G1 X90 F600\n")
    board.wait(1.0)
    board.trip_limit()
    assert not board.motor_on


def test_grblhal_refuses_gcode_after_an_error_until_it_hears_an_empty_line() -> None:
    board = Firmware(dialect="grblHAL")
    listen(board)
    assert say(board, "G7") == ["error:20"]
    assert say(board, "M5") == ["error:20"]
    assert say(board, "") == say(board, "M5") == ["ok"]


def test_grblhal_that_must_home_first_is_not_unlocked_by_hand() -> None:
    board = Firmware(dialect="grblHAL", switch_deg=20.0)
    board.memory.settings[22] = 5
    board.power_cycle()
    assert listen(board)[1:] == ["ALARM:11", "[MSG:Homing cycle required]"]
    assert say(board, "$X") == ["error:46"]
    assert say(board, "$HX") == ["error:5"]  # $22 has no bit for one axis
    assert say(board, "$22=7") == say(board, "$HX") == ["ok"]
    assert board.state == "Idle"


def test_ok_means_planned_and_a_dwell_proves_arrival(board: Firmware) -> None:
    board.write(b"G1 X90 F600\n")
    assert board.read(100) == b"ok\r\n"
    board.wait(3.0)
    board.write(b"?")
    report = board.read(100).decode()
    assert report.startswith("<Run|MPos:")
    assert 20 < math.degrees(board.bearing) < 35
    board.write(b"G4 P0.01\n")
    assert board.read(100) == b""
    board.wait(20.0)
    assert board.read(100) == b"ok\r\n"
    assert board.bearing == math.pi / 2


def test_a_move_takes_the_time_of_its_trapezoid(board: Firmware) -> None:
    started = board.now
    say(board, "G1 X90 F600")
    say(board, "G4 P0")
    assert board.now - started == pytest.approx(90 / 10 + 10 / 360, abs=1e-9)


def test_rapids_and_feeds_obey_the_axis_limits(board: Firmware) -> None:
    say(board, "$110=300")
    started = board.now
    say(board, "G1 X10 F9000")
    say(board, "G4 P0")
    assert board.now - started == pytest.approx(10 / 5 + 5 / 360, abs=1e-9)


def test_hold_brakes_resume_goes_on_and_reset_in_hold_keeps_the_position(board: Firmware) -> None:
    board.write(b"G1 X90 F1200\n")
    board.wait(1.0)
    board.write(b"!?")
    assert b"<Hold:1|" in board.read(200)
    board.wait(1.0)
    board.write(b"?")
    assert b"<Hold:0|" in board.read(200)
    held = board.bearing
    board.wait(10.0)
    assert board.bearing == held
    assert say(board, b"~")[-1:] == []
    assert board.bearing == math.pi / 2
    board.write(b"G1 X0\n")
    board.wait(1.0)
    board.write(b"!")
    board.wait(1.0)
    held = board.bearing
    lines = say(board, b"\x18")
    assert not any("ALARM" in line for line in lines)
    report = say(board, b"?")[-1]
    assert report.startswith(f"<Idle|MPos:{math.degrees(held):.3f}")


def test_reset_in_motion_is_alarm_3_and_locks_until_unlocked(board: Firmware) -> None:
    board.write(b"M3 S500\nG1 X90 F600\n")
    board.wait(1.0)
    board.read(100)
    assert board.laser_on
    lines = say(board, b"\x18")
    assert lines == ["ALARM:3", "Grbl 1.1h ['$' for help]", "[MSG:'$H'|'$X' to unlock]"]
    assert not board.laser_on
    assert say(board, "G0 X0") == ["error:9"]
    assert say(board, "$X") == ["[MSG:Caution: Unlocked]", "ok"]
    assert say(board, "G0 X0") == ["ok"]


def test_jog_is_cancelled_by_0x85_with_its_position_kept(board: Firmware) -> None:
    board.write(b"$J=G91X90F600\n")
    board.wait(1.0)
    board.write(b"?")
    assert b"<Jog|" in board.read(200)
    board.write(b"\x85")
    listen(board)
    assert board.state == "Idle"
    assert 5 < math.degrees(board.bearing) < 15
    assert say(board, "G0 X0") == ["ok"]


def test_hard_limit_halts_even_status_until_reset(board: Firmware) -> None:
    board.write(b"M3 S1000\nG1 X90 F600\n")
    board.wait(1.0)
    board.read(100)
    board.trip_limit()
    assert listen(board) == ["ALARM:1", "[MSG:Reset to continue]"]
    assert not board.laser_on
    assert say(board, b"?") == []
    assert say(board, "$X") == []
    assert say(board, b"\x18")[-1] == "[MSG:'$H'|'$X' to unlock]"


def test_soft_limits_of_the_board(board: Firmware) -> None:
    for line in ("$22=1", "$20=1"):
        assert say(board, line) == ["ok"]
    assert say(board, "$J=X10F100") == ["error:15"]
    assert say(board, "G0 X10") == ["ALARM:2", "[MSG:Reset to continue]"]
    assert say(board, b"\x18")[-1] == "[MSG:'$H'|'$X' to unlock]"


@pytest.mark.parametrize(("direction", "switch", "place"), [(1, -20.0, -199.0), (0, 100.0, -1.0)])
def test_homing_finds_the_switch_and_names_the_place(direction: int, switch: float, place: float) -> None:
    board = Firmware(switch_deg=switch)
    for line in ("$22=1", f"$23={direction}"):
        say(board, line)
    board.write(b"$H\n?")
    assert board.read(1000) == b""  # silent until it is done
    assert listen(board) == [f"<Home|MPos:{place:.3f},0.000,0.000|FS:0,0|WCO:0.000,0.000,0.000>", "ok"]
    assert math.degrees(board.bearing) == pytest.approx(switch - math.copysign(1.0, switch), abs=0.02)
    assert f"MPos:{place:.3f}," in say(board, b"?")[0]


def test_homing_without_a_switch_is_alarm_9() -> None:
    board = Firmware()
    say(board, "$22=1")
    assert "ALARM:9" in say(board, "$H")
    assert board.alarm


def test_index_probe_reports_its_place_or_alarm_5(board: Firmware) -> None:
    board.index_deg = -30.0
    assert say(board, "G38.2 X-90 F600") == ["[PRB:-30.000,0.000,0.000:1]", "ok"]
    assert "ALARM:4" in say(board, "G38.2 X-90 F600")
    for line in ("$X", "G0 X-40"):
        say(board, line)
    assert "ALARM:5" in say(board, "G38.2 X-90 F600")


def test_settings_survive_power_loss_and_positions_do_not(board: Firmware) -> None:
    say(board, "$100=160")
    say(board, "G0 X10")
    assert math.degrees(board.bearing) == pytest.approx(20.0)
    board.power_cycle()
    listen(board)
    assert "$100=160.000" in say(board, "$$")
    assert "MPos:0.000" in say(board, b"?")[0]
    assert math.degrees(board.bearing) == pytest.approx(20.0)


def test_receive_buffer_holds_128_bytes_and_drops_the_rest(board: Firmware) -> None:
    board.write(b"G4 P100\n")
    board.write(b"G4P0\n" * 30)
    board.wait(200.0)
    assert board.read(1000).count(b"ok") == 1 + 128 // 5


def test_laser_follows_m3_m5_and_sync(board: Firmware) -> None:
    board.write(b"G1 X10 F600\nM3 S800\n")
    assert not board.laser_on
    board.wait(2.0)
    assert board.laser_on
    assert say(board, "M5")[-1] == "ok"
    assert not board.laser_on
    say(board, "M3")
    assert board.laser_on
    say(board, "S0")
    assert not board.laser_on


def test_motor_lets_go_when_idle_unless_told_to_hold(board: Firmware) -> None:
    say(board, "G0 X10")
    assert not board.motor_on
    say(board, "$1=255")
    say(board, "G0 X20")
    assert board.motor_on


def test_inches_and_relative_and_offsets(board: Firmware) -> None:
    for line in ("G20", "G91", "G0 X1", "G0 X1", "G21", "G90", "G92 X0", "G0 X5"):
        assert say(board, line) == ["ok"]
    assert math.degrees(board.bearing) == pytest.approx(55.8, abs=1 / 160)
    say(board, "G53 G0 X7")
    assert math.degrees(board.bearing) == pytest.approx(7.0)


def test_startup_lines_run_after_a_reset(board: Firmware) -> None:
    assert say(board, "$N0=G20") == ["ok"]
    assert say(board, b"\x18") == ["Grbl 1.1h ['$' for help]", ">G20:ok"]
    assert "G20" in say(board, "$G")[0]


def test_sleep_needs_a_reset(board: Firmware) -> None:
    say(board, "$1=255")
    assert say(board, "$SLP") == ["ok", "[MSG:Sleeping]"]
    assert not board.motor_on
    assert say(board, b"?")[0].startswith("<Sleep")
    assert say(board, "G0X1") == []
    assert say(board, b"\x18")[-1] == "[MSG:'$H'|'$X' to unlock]"


def test_backlash_stall_and_lost_steps_are_seen_by_the_truth_only() -> None:
    board = Firmware(drivetrain=Drivetrain(backlash_deg=0.5))
    for line in ("G0 X10", "G0 X9.8", "G0 X9"):
        say(board, line)
    assert math.degrees(board.bearing) == pytest.approx(9.25)
    board.drivetrain.slip(80)
    board.drivetrain.stalled = True
    before = board.bearing
    say(board, "G0 X50")
    assert board.bearing == before
    assert "MPos:50.000" in say(board, b"?")[0]


def test_real_time_board_moves_with_the_wall_clock() -> None:
    board = Firmware(instant=False)
    board.write(b"G1 X0.5 F600\n")
    first = board.bearing
    board.wait(0.12)
    assert first < math.radians(0.5) == board.bearing


@given(length=st.floats(0.01, 360), speed=st.floats(0.1, 100), acceleration=st.floats(1, 5000), at=st.floats(0, 1))
def test_a_move_is_smooth_and_a_hold_brakes_within_it(
    length: float, speed: float, acceleration: float, at: float
) -> None:
    move = Move(np.zeros(3), np.array([length, 0.0, 0.0]), speed, acceleration, 5.0)
    assert move.travelled(5.0) == 0.0
    assert move.travelled(move.end_time) == pytest.approx(length)
    times = np.linspace(5.0, move.end_time, 200)
    way = np.array([move.travelled(t) for t in times])
    assert (np.diff(way) >= -1e-9 * length).all()
    assert np.diff(way).max() <= speed * np.diff(times).max() * (1 + 1e-6) + 1e-9
    middle = 5.0 + at * move.duration
    brake = move.braked(middle)
    assert brake.position(middle)[0] == pytest.approx(move.position(middle)[0])
    assert brake.position(brake.end_time)[0] <= length * (1 + 1e-9)
    assert brake.position(brake.end_time)[0] == pytest.approx(brake.end[0], rel=1e-6, abs=1e-9)


CODES = ["G1", "G10", "G38.2", "G4", "G53", "G92", "L2", "L20", "P1", "P7", "X9", "X", "F600", "M0", "M3", "S9"]
COMMANDS = ["$H", "$J=", "$I=", "$N0=", "$RST=*", "$22=1", "$C", "?", "~", "!", "\x84", "\x85", "\x91", "\n", "\n"]
LIKE_LINES = st.lists(st.sampled_from(CODES + COMMANDS), max_size=30).map(
    lambda words: "".join(words).encode("latin-1")
)


@settings(max_examples=200, deadline=None)
@given(data=st.lists(st.binary(max_size=60) | LIKE_LINES, max_size=8))
def test_no_bytes_crash_the_board_and_a_reset_always_helps(data: list[bytes]) -> None:
    board = Firmware()
    for chunk in data:
        board.write(chunk)
        board.wait(0.01)
    board.write(b"\x18")
    board.wait(1e6)
    assert re.search(rb"Grbl 1\.1h", board.read(1 << 20))
    assert not board.laser_on
