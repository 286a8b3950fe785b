"""The twin's board held to grbl 1.1's documented interface, line by line: what it answers, in which form and order.

Source: gnea/grbl, doc/markdown/interface.md, commands.md, jogging.md, doc/csv.
"""

from __future__ import annotations

import re

import pytest
from test_firmware import listen, say

from scanmap.twin.firmware import Firmware

BANNER = "Grbl 1.1h ['$' for help]"
LOCK = "[MSG:'$H'|'$X' to unlock]"


@pytest.fixture
def board() -> Firmware:
    board = Firmware()
    listen(board)
    return board


def test_settings_come_in_order_and_in_the_documented_form(board: Firmware) -> None:
    *lines, last = say(board, "$$")
    assert last == "ok"
    found = [re.fullmatch(r"\$(\d+)=(\d+)(\.\d{3})?", line) for line in lines]
    assert all(found)
    numbers = [int(match[1]) for match in found if match]
    assert numbers == [*range(7), *range(10, 14), *range(20, 28), 30, 31, 32,
                       100, 101, 102, 110, 111, 112, 120, 121, 122, 130, 131, 132]  # fmt: skip
    with_decimals = {int(match[1]) for match in found if match and match[3]}
    assert with_decimals == {11, 12, 24, 25, 27, *(number for number in numbers if number >= 100)}


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        ("$", ["[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]", "ok"]),
        ("$I", ["[VER:1.1h.20190825:]", "[OPT:V,15,128]", "ok"]),
        ("$N", ["$N0=", "$N1=", "ok"]),
        ("$G", ["[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]", "ok"]),
        ("$X", ["ok"]),
        ("$C", ["[MSG:Enabled]", "ok"]),
        ("$SLP", ["ok", "[MSG:Sleeping]"]),
        ("M30", ["[MSG:Pgm End]", "ok"]),
        ("$RST=$", ["[MSG:Restoring defaults]", "ok", BANNER]),
        ("$RST=x", ["error:3"]),
        ("$J", ["error:3"]),
        ("$HX", ["error:3"]),  # single axes are a compile option
    ],
)
def test_what_is_asked_is_answered_as_documented(board: Firmware, command: str, answer: list[str]) -> None:
    assert say(board, command) == answer


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("N10000000", 27),
        ("G10 L2 X0", 28),
        ("G10 P1 X0", 28),
        ("G10 L2 P7 X0", 29),
        ("G10 L3 P1 X0", 20),
        ("G38.2 X0 F100", 33),
        ("T256", 38),
        ("F-1", 4),
        ("G59.1", 23),
    ],
)
def test_errors_that_a_driver_should_never_meet_have_their_numbers_too(board: Firmware, line: str, error: int) -> None:
    assert say(board, line) == [f"error:{error}"]
    assert say(board, "") == ["ok"]


def test_what_the_owner_notes_stands_in_the_build_info_until_everything_is_restored(board: Firmware) -> None:
    for line in ("$I=head 7", "$N0=G54", "$100=90", "G10 L2 P2 X3"):
        assert say(board, line) == ["ok"]
    assert say(board, "$I")[0] == "[VER:1.1h.20190825:HEAD7]"
    say(board, "$RST=#")
    assert "[G55:0.000,0.000,0.000]" in say(board, "$#") and "$100=90.000" in say(board, "$$")
    say(board, "$RST=*")
    assert say(board, "$I")[0] == "[VER:1.1h.20190825:]" and say(board, "$N")[0] == "$N0="
    assert "$100=80.000" in say(board, "$$")


def test_sleep_ends_with_a_reset_alone_and_in_an_alarm(board: Firmware) -> None:
    say(board, "$SLP")
    assert say(board, b"?")[0].startswith("<Sleep|") and say(board, "$X") == []
    assert say(board, b"\x18") == [BANNER, LOCK]
    assert say(board, b"?")[0].startswith("<Alarm|")


def test_check_mode_moves_nothing_and_ends_with_a_reset(board: Firmware) -> None:
    say(board, "$C")
    assert say(board, "G1 X90 F600") == ["ok"] and say(board, "G7") == ["error:20"]
    assert say(board, b"?")[0].startswith("<Check|MPos:0.000")
    assert say(board, "$C") == ["[MSG:Disabled]", "ok", BANNER]


def test_program_pause_waits_for_cycle_start(board: Firmware) -> None:
    board.write(b"M0\n")
    assert listen(board) == []
    assert say(board, b"?")[0].startswith("<Hold:0|")
    assert say(board, b"~") == ["ok"]


def test_overrides_turn_moves_that_begin_up_and_down_and_a_reset_undoes_them(board: Firmware) -> None:
    for _ in range(2):
        say(board, b"?")
    say(board, b"\x91\x91\x93\x96\x9b")  # feed +10, +10, +1, rapid 50, spindle -10
    assert "|Ov:121,50,90" in say(board, b"?")[0]
    say(board, b"\x92" * 30)
    assert "|Ov:10,50,90" in say(board, b"?")[0]  # no less
    say(board, b"\x90\x91\x91\x91\x91\x91\x91\x91\x91\x91\x91\x91")
    assert "|Ov:200,50,90" in say(board, b"?")[0]  # no more
    board.write(b"G1 X90 F600\n")
    board.wait(2.0)
    assert "|FS:1200,0" in say(board, b"?")[-1]
    listen(board)
    say(board, b"\x18")
    assert "|FS:0,0" in say(board, b"?")[0] and "|Ov:100,100,100" in say(board, b"?")[0]


def test_an_open_door_brakes_stops_the_spindle_and_waits(board: Firmware) -> None:
    say(board, "M3 S1000")
    board.write(b"G1 X90 F600\n")
    board.wait(2.0)
    board.write(b"\x84?")
    said = board.read(200).decode()
    assert "[MSG:Check Door]" in said and "<Door:2|" in said and board.laser_on
    board.wait(1.0)
    assert say(board, b"?")[-1].startswith("<Door:0|") and not board.laser_on
    stood = board.bearing
    board.write(b"G4 P0\n")
    board.wait(5.0)
    assert listen(board) == [] and board.bearing == stood  # lines wait
    board.write(b"~?")
    assert "<Door:3|" in board.read(200).decode() and board.laser_on
    board.wait(3.9)
    assert board.bearing == stood  # a spindle is given four seconds
    board.wait(0.3)
    assert board.bearing > stood
    assert listen(board)[-1] == "ok"


def test_a_door_while_jogging_forgets_the_jog_and_while_homing_is_alarm_7() -> None:
    board = Firmware(switch_deg=-90.0)
    listen(board)
    board.write(b"$J=X90 F600\n")
    board.wait(1.0)
    board.write(b"\x84")
    board.wait(1.0)
    board.write(b"~")
    board.wait(1.0)
    board.read(1000)
    assert say(board, b"?")[0].startswith("<Idle|")
    for line in ("$22=1", "$23=1"):
        say(board, line)
    board.write(b"$H\n")
    board.wait(0.5)
    assert "ALARM:7" in say(board, b"\x84")
