"""What grbl says in which order, and what it does not hear: facts of its sources that a driver can trip over."""

from __future__ import annotations

import math

import pytest
from test_firmware import listen, say

from scanmap.twin.board import DialectName, decimal
from scanmap.twin.firmware import Firmware

BANNER = "Grbl 1.1h ['$' for help]"
LOCKED = [BANNER, "[MSG:'$H'|'$X' to unlock]"]


@pytest.fixture
def board() -> Firmware:
    board = Firmware()
    listen(board)
    return board


def test_a_line_that_a_reset_breaks_off_is_answered_before_the_banner(board: Firmware) -> None:
    board.write(b"G1 X90 F600\nG4 P0.01\n")
    assert board.read(100) == b"ok\r\n"
    board.wait(1.0)
    started = board.now
    assert say(board, b"\x18") == ["ALARM:3", "ok", *LOCKED]
    assert board.now - started == pytest.approx(0.5)  # it waits for its own words to get out


def test_grblhal_leaves_that_line_unanswered() -> None:
    board = Firmware(dialect="grblHAL")
    listen(board)
    board.write(b"G1 X90 F600\nG4 P0.01\n")
    board.wait(1.0)
    board.read(1000)
    assert say(board, b"\x18")[:2] == ["ALARM:3", "GrblHAL 1.1f ['$' or '$HELP' for help]"]


def test_homing_that_fails_says_alarm_then_ok_then_restarts() -> None:
    board = Firmware()
    say(board, "$22=1")
    assert say(board, "$H") == ["ALARM:9", "ok", *LOCKED]
    board.write(b"$H\n")
    board.wait(0.1)
    assert say(board, b"\x18") == ["ALARM:6", "ok", *LOCKED]


def test_a_reset_within_half_a_second_of_a_limit_switch_is_lost(board: Firmware) -> None:
    board.write(b"G1 X90 F600\nG4 P1\n")
    board.wait(1.0)
    board.read(100)
    board.trip_limit()
    board.write(b"\x18")
    assert listen(board) == ["ALARM:1", "[MSG:Reset to continue]"]
    assert say(board, b"?") == []
    assert say(board, b"\x18") == ["ok", *LOCKED]


def test_grblhal_halted_by_an_alarm_answers_status_and_refuses_the_rest() -> None:
    board = Firmware(dialect="grblHAL")
    listen(board)
    board.trip_limit()
    assert listen(board) == ["ALARM:1", "[MSG:Reset to continue]"]
    assert say(board, b"?")[0].startswith("<Alarm|")
    assert [say(board, line) for line in ("M5", "$X", "")] == [["error:9"], ["error:79"], ["ok"]]
    assert say(board, b"\x18")[-1] == "[MSG:'$H'|'$X' to unlock]"


@pytest.mark.parametrize(("dialect", "stays"), [("grbl", False), ("grblHAL", False), ("FluidNC", True)])
def test_only_fluidnc_leaves_the_laser_on_in_an_alarm(dialect: DialectName, stays: bool) -> None:
    board = Firmware(dialect=dialect)
    say(board, "M3 S1000")
    board.trip_limit()
    listen(board)
    assert board.laser_on is stays
    say(board, b"\x18")
    assert not board.laser_on


def test_soft_limit_brakes_alarms_and_answers_after_the_reset(board: Firmware) -> None:
    for line in ("$22=1", "$20=1", "G1 X-90 F600"):
        say(board, line)
    assert say(board, "G1 X-300") == ["ALARM:2", "[MSG:Reset to continue]"]
    assert say(board, b"\x18") == ["ok", *LOCKED]
    assert "MPos:-90.000," in say(board, b"?")[0]


def test_while_the_memory_is_written_all_but_two_bytes_are_lost(board: Firmware) -> None:
    board.write(b"$1=255\nG7X9\n")
    assert listen(board) == ["ok"]
    assert say(board, "") == ["error:20"]  # `G7` got through, and no more of it


def test_a_dwell_is_rounded_up_to_twentieths_of_a_second(board: Firmware) -> None:
    started = board.now
    board.write(b"G4 P0.01\n")
    board.write(b"??")
    assert board.read(100) == b""
    lines = listen(board)
    assert lines[-1] == "ok" or lines[0] == "ok"
    assert sum(line.startswith("<Idle") for line in lines) == 1  # however often it was asked
    assert board.now - started == pytest.approx(0.05)


def test_work_offset_and_overrides_are_told_at_once_after_a_change(board: Firmware) -> None:
    for _ in range(3):
        say(board, b"?")
    say(board, "G92 X1")
    assert "|WCO:-1.000" in say(board, b"?")[0]
    assert "|Ov:" not in say(board, b"?")[0]
    say(board, "M3 S100")
    assert "|FS:0,100|Ov:100,100,100|A:S>" in say(board, b"?")[0]
    board.write(b"G1 X90 F600\n")
    say(board, "M4")
    assert "|A:C>" in say(board, b"?")[0]


def test_offset_and_overrides_come_every_30_and_20_reports_of_a_moving_board(board: Firmware) -> None:
    board.write(b"G1 X360 F600\n")
    board.wait(0.1)
    board.read(100)
    reports = []
    for _ in range(61):
        board.write(b"?")
        reports.append(board.read(200).decode())
    assert [index for index, report in enumerate(reports) if "WCO" in report] == [0, 30, 60]
    assert [index for index, report in enumerate(reports) if "Ov" in report] == [1, 21, 41]


def test_a_hold_goes_on_only_once_it_stands(board: Firmware) -> None:
    board.write(b"G1 X90 F1200\n")
    board.wait(1.0)
    board.write(b"!~")
    board.wait(5.0)
    assert board.state == "Hold"
    board.write(b"~")
    listen(board)
    assert board.bearing == math.pi / 2


def test_lines_wait_until_a_cancelled_jog_stands(board: Firmware) -> None:
    board.write(b"$J=G91X90F1200\n")
    board.wait(1.0)
    board.write(b"\x85G4 P0\n")
    assert board.read(100) == b"ok\r\n"  # the jog's own
    assert listen(board) == ["ok"]
    place = math.degrees(board.bearing)
    assert say(board, "G91 G1 X1 F600") == ["ok"]  # from where it stands, not from where it was to go
    assert math.degrees(board.bearing) == pytest.approx(place + 1, abs=1 / 80)


def test_relative_moves_below_a_step_add_up(board: Firmware) -> None:
    for _ in range(10):
        assert say(board, "G91 G1 X0.005 F600") == ["ok"]
    assert math.degrees(board.bearing) == pytest.approx(0.05)


def test_a_move_lights_what_a_setting_has_switched_off(board: Firmware) -> None:
    say(board, "M3 S500")
    say(board, "$31=1")
    assert not board.laser_on
    say(board, "G1 X1 F600")
    assert board.laser_on
    say(board, "M5")
    say(board, "G1 X2")
    assert not board.laser_on


def test_in_laser_mode_only_g1_gives_light(board: Firmware) -> None:
    for line in ("$32=1", "M3 S500"):
        say(board, line)
    assert not board.laser_on  # the standing mode is G0
    say(board, "G1 F600")
    assert board.laser_on
    board.write(b"G0 X20\n")
    board.wait(0.1)
    assert not board.laser_on
    listen(board)
    board.write(b"M4\nG1 X90\n")
    board.wait(0.1)
    assert board.laser_on
    listen(board)
    assert not board.laser_on


@pytest.mark.parametrize(
    ("settings", "speed", "share"),
    [
        ((1000, 0), 1000, 1.0),
        ((1000, 0), 500, 128 / 255),
        ((1000, 100), 50, 1 / 255),
        ((1000, 100), 0, 0.0),
        ((0, 0), 0, 1.0),  # $30=0: on or off only, and M3 is on
    ],
)
def test_s_is_scaled_between_31_and_30(board: Firmware, settings: tuple[int, int], speed: int, share: float) -> None:
    for number, value in zip((30, 31), settings, strict=True):
        say(board, f"${number}={value}")
    say(board, f"M3 S{speed}")
    assert board.loop.executor.spindle.share == pytest.approx(share)


def test_a_startup_line_is_tried_before_it_is_kept(board: Firmware) -> None:
    assert say(board, "$N1=G7") == ["error:20"]
    assert say(board, "$N1=M3S100") == ["ok"]
    assert board.laser_on
    assert say(board, b"\x18") == [BANNER, ">M3S100:ok"]
    assert board.laser_on


def test_without_legacy_commands_grblhal_takes_a_question_mark_in_a_dollar_line_for_text() -> None:
    board = Firmware(dialect="grblHAL")
    listen(board)
    board.memory.settings[39] = 0
    assert "[NEWOPT:ENUMS,RT-,HOME]" in say(board, "$I")
    assert say(board, b"$G?\n") == ["error:3"]
    assert say(board, b"?")[0].startswith("<Idle") and say(board, b"\x80")[0].startswith("<Idle")
    board.write(b"$G\x80")
    assert board.read(200).startswith(b"<Idle")


def test_what_grblhal_reports_is_a_mask() -> None:
    board = Firmware(dialect="grblHAL")
    listen(board)
    say(board, "$10=0")
    assert [say(board, b"?") for _ in range(3)] == [["<Idle|WPos:0.000,0.000,0.000>"]] * 3


def test_settings_are_as_wide_as_the_board_keeps_them(board: Firmware) -> None:
    for line in ("$1=256", "$30=999.6"):
        assert say(board, line) == ["ok"]
    assert {"$1=0", "$30=1000"} <= set(say(board, "$$"))


@pytest.mark.parametrize(
    ("value", "places", "text"), [(0.0375, 3, "0.038"), (-0.0125, 3, "-0.013"), (89.9999, 3, "90.000"), (12.5, 0, "13")]
)
def test_numbers_are_rounded_as_the_board_rounds_them(value: float, places: int, text: str) -> None:
    assert decimal(value, places) == text
