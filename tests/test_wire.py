"""The GRBL driver byte by byte: scripted (sent, reply) pairs for three firmwares; nothing may remain."""

from __future__ import annotations

import math
import time

import pytest

from scanmap.errors import ConfigError, StageError
from scanmap.rig.grbl import GrblStage
from scanmap.rig.grbl_link import GrblLink
from scanmap.rig.grbl_protocol import (
    Dialect,
    Status,
    dialect_of_build_info,
    parse_banner,
    parse_status,
    real_time_of_build_info,
)
from scanmap.rig.grbl_wait import Wait
from scanmap.rig.manual import ManualStage
from scanmap.rig.serial_port import SerialPort
from scanmap.rig.stage import StageParams
from scanmap.rig.template import TemplateStage

Script = list[tuple[bytes, bytes]]


class ScriptedPort:
    """Stands for a pyserial port: what is sent must be the next of the script, whose reply then arrives."""

    def __init__(self, script: Script) -> None:
        self.script = list(script)
        self.incoming = bytearray()
        self.closed = False
        self.deaf_to_status = False

    @property
    def in_waiting(self) -> int:
        return len(self.incoming)

    def write(self, data: bytes) -> int:
        if self.deaf_to_status and data == b"?":
            return 1
        assert self.script, f"{data!r} was sent, the script is at its end"
        expected, reply = self.script.pop(0)
        assert data == expected
        self.incoming += reply
        return len(data)

    def read(self, size: int) -> bytes:
        chunk = bytes(self.incoming[:size])
        del self.incoming[:size]
        return chunk

    def close(self) -> None:
        self.closed = True


def at(x: float, state: str = "Idle") -> bytes:
    return f"<{state}|MPos:{x:.3f},0.000,0.000|FS:0,0>\r\n".encode()


OK = b"ok\r\n"
PREAMBLE = (b"G21 G90 G94 G1 F1200.0\n", OK)
SETTINGS_OF_SCANS = b"$1=255\r\n$10=1\r\n$13=0\r\n$32=0\r\n$100=80.000\r\n$110=1200.000\r\n$120=10.000\r\nok\r\n"
OPEN_GRBL: Script = [
    (b"?", at(0)),
    (b"$$\n", b"$1=25\r\n$10=1\r\n$13=0\r\n$32=1\r\n$100=250.000\r\n$110=500.000\r\n$120=10.000\r\nok\r\n"),
    (b"$100=80\n", OK),
    (b"$1=255\n", OK),
    (b"$110=1200\n", OK),
    (b"$32=0\n", OK),
    (b"$$\n", SETTINGS_OF_SCANS),
    PREAMBLE,
    (b"M5\n", OK),
]
CLOSE_GRBL: Script = [(b"M5\n", OK), (b"$1=25\n", OK), (b"\x18", b"\r\nGrbl 1.1h ['$' for help]\r\n")]
OPEN_HAL: Script = [
    (b"?", b"<Alarm|MPos:0.000,0.000,0.000|Bf:35,1023|FS:0,0|Pn:X>\r\n"),
    (b"$X\n", b"[MSG:Caution: Unlocked]\r\nok\r\n"),
    (b"?", at(0)),
    (b"$$\n", b"$1=255\r\n$32=0\r\n$100=80.000\r\n$110=6000.000\r\n$120=100.000\r\n$481=0\r\n$650=text\r\nok\r\n"),
    PREAMBLE,
    (b"M5\n", OK),
]
OPEN_FLUIDNC: Script = [
    (b"?", at(0)),
    (b"$13\n", b"$13=0\r\nok\r\n"),
    (b"$/axes/x/steps_per_mm\n", b"$/axes/x/steps_per_mm=80.000\r\nok\r\n"),
    (b"$/stepping/idle_ms\n", b"$/stepping/idle_ms=255\r\nok\r\n"),
    PREAMBLE,
    (b"M5\n", OK),
]
CLOSE_FLUIDNC: Script = [
    (b"M5\n", OK),
    (b"\x18", b"\r\nGrbl 3.7 [FluidNC v3.7.8 (wifi) '$' for help]\r\n"),
    (b"$MD\n", b"[MSG:INFO: Disabling all motors]\r\nok\r\n"),
]


def move(x: float, reported: float | None = None) -> Script:
    return [
        (f"G53 G1 X{x:.4f}\n".encode(), OK),
        (b"G4 P0.01\n", OK),
        (b"?", at(x if reported is None else reported)),
    ]


def play(script: Script, dialect: Dialect = Dialect.GRBL, **params: object) -> tuple[GrblStage, ScriptedPort]:
    port = ScriptedPort(script)
    settings = StageParams.model_validate({"steps_per_deg": 80.0, "timeout_s": 0.2, **params})
    return GrblStage(GrblLink(SerialPort(port, "script"), settings.timeout_s), dialect, settings), port


def finish(port: ScriptedPort) -> None:
    assert port.script == []
    assert port.incoming == b""


@pytest.mark.parametrize(
    ("dialect", "opening", "closing"),
    [
        (Dialect.GRBL, OPEN_GRBL, CLOSE_GRBL),
        (Dialect.GRBLHAL, OPEN_HAL, CLOSE_GRBL),
        (Dialect.FLUIDNC, OPEN_FLUIDNC, CLOSE_FLUIDNC),
    ],
)
def test_open_move_laser_close(dialect: Dialect, opening: Script, closing: Script) -> None:
    middle = [*move(90.0, 89.988), (b"M3 S1000\n", OK), (b"M5\n", OK)]
    stage, port = play([*opening, *middle, *closing], dialect)
    assert stage.move_to(math.pi / 2) == math.radians(89.9875)  # the whole step that 89.988 stands for
    stage.laser(True)
    stage.laser(False)
    stage.close()
    stage.close()
    assert port.closed
    finish(port)


def test_always_on_laser_is_never_switched_nor_its_mode_touched() -> None:
    opening = [pair for pair in OPEN_GRBL if pair[0] not in (b"M5\n", b"$32=0\n")]
    stage, port = play([*opening, *CLOSE_GRBL[1:]], laser="always-on")
    assert not stage.laser_switchable
    stage.laser(True)
    stage.laser(False)
    stage.close()
    finish(port)


def test_backlash_is_taken_up_from_below() -> None:
    up = [(b"?", at(0)), *move(-0.5), *move(0), (b"?", at(0)), *move(10)]
    further = [(b"?", at(10)), *move(20)]
    down = [(b"?", at(20)), *move(14.5), *move(15)]
    stage, port = play([*OPEN_GRBL, *up, *further, *down], backlash_deg=0.5)
    for deg in (0, 10, 20, 15):
        stage.move_to(math.radians(deg))
    finish(port)


def test_direction_and_home_bearing_turn_the_axis_round() -> None:
    stage, port = play([*OPEN_GRBL, *move(-80.0)], direction=-1, home_deg=10.0)
    assert stage.move_to(math.pi / 2) == pytest.approx(math.pi / 2)
    finish(port)


def test_work_coordinates_and_inches_are_undone() -> None:
    opening = [*OPEN_GRBL]
    opening[0] = (b"?", b"<Idle|WPos:0.000,0.000,0.000|FS:0,0>\r\n")
    opening = [(sent, reply.replace(b"$13=0", b"$13=1")) for sent, reply in opening]
    report = b"<Idle|WPos:1.000,0.000,0.000|FS:0,0>\r\n"
    offset = b"<Idle|WPos:1.000,0.000,0.000|FS:0,0|WCO:2.000,0.000,0.000>\r\n"
    opening.insert(1, (b"?", offset))
    stage, port = play([*opening, (b"?", report)])
    assert stage.where() == pytest.approx(math.radians(76.2))
    finish(port)


def test_lost_ok_is_noticed_by_an_idle_board_and_the_line_sent_again() -> None:
    line = b"G53 G1 X10.0000\n"
    stage, port = play([*OPEN_GRBL, (line, b""), (b"?", at(10)), (b"?", at(10)), *move(10)])
    assert stage.move_to(math.radians(10)) == pytest.approx(math.radians(10))
    finish(port)


def test_a_hold_nobody_asked_for_is_released_once_then_said() -> None:
    line = b"G53 G1 X10.0000\n"
    held = at(4, "Hold:0")
    stage, port = play([*OPEN_GRBL, (line, b""), (b"?", held), (b"~", OK), *move(10)[1:]])
    assert stage.move_to(math.radians(10)) == pytest.approx(math.radians(10))
    finish(port)
    stage, port = play([*OPEN_GRBL, (line, b""), (b"?", held), (b"~", b""), (b"?", held)])
    with pytest.raises(StageError, match="is on hold: release its hold button"):
        stage.move_to(math.radians(10))
    finish(port)


def test_a_running_board_that_stands_still_is_stuck(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scanmap.rig.grbl_wait.STILL_S", 0.01)
    line = b"G53 G1 X10.0000\n"
    stage, port = play([*OPEN_GRBL, (line, OK), (b"G4 P0.01\n", b""), (b"?", at(4, "Run")), (b"?", at(4, "Run"))])
    with pytest.raises(StageError, match="runs but stands at 4: check the motor"):
        stage.move_to(math.radians(10))
    finish(port)


def test_lost_status_is_asked_for_again() -> None:
    stage, port = play([*OPEN_GRBL, (b"?", b""), (b"?", b"<Idle|MPos:garb\r\n" + at(3))], timeout_s=1.0)
    assert stage.where() == pytest.approx(math.radians(3))
    finish(port)


def test_a_line_damaged_on_its_way_is_sent_again_and_a_wrong_place_is_noticed() -> None:
    damaged = [(b"G53 G1 X10.0000\n", b"error:2\r\n"), *move(10, reported=1.0), *move(10)]
    stage, port = play([*OPEN_GRBL, *damaged])
    assert stage.move_to(math.radians(10)) == pytest.approx(math.radians(10))
    finish(port)


@pytest.mark.parametrize("there", [4, 9.975], ids=["far off", "two steps off"])
def test_a_head_that_never_arrives_is_an_error_with_both_places(there: float) -> None:
    stage, port = play([*OPEN_GRBL, *move(10, reported=there), *move(10, reported=there)])
    with pytest.raises(StageError, match=f"asked for 10 deg and stands at {there:g}"):
        stage.move_to(math.radians(10))
    finish(port)


def test_a_head_one_step_off_has_arrived() -> None:
    stage, port = play([*OPEN_GRBL, *move(10, reported=9.988)])  # a step is 1 / 80 deg
    assert stage.move_to(math.radians(10)) == pytest.approx(math.radians(9.9875))
    finish(port)


@pytest.mark.parametrize(
    ("reply", "words"),
    [
        (b"ALARM:1\r\n[MSG:Reset to continue]\r\n", "ALARM:1, a limit switch was hit .*stage home"),
        (b"\r\nGrbl 1.1h ['$' for help]\r\n", "restarted by itself.*power supply"),
        (b"error:9\r\n", "error:9, the board is locked"),
        (b"\x00\xff\xfe<<<>|ok?\r\n", "has not answered for 0.2 s"),
    ],
)
def test_what_goes_wrong_is_said_in_words(reply: bytes, words: str) -> None:
    line = b"G53 G1 X10.0000\n"
    again: Script = [(line, reply)] if reply.startswith(b"error") else []
    stage, port = play([*OPEN_GRBL, (line, reply), *again])
    port.deaf_to_status = True
    with pytest.raises(StageError, match=words):
        stage.move_to(math.radians(10))
    finish(port)


def test_outside_the_limits_nothing_is_sent() -> None:
    stage, port = play(OPEN_GRBL)
    for deg in (-0.1, 180.1, math.nan, math.inf):
        with pytest.raises(StageError, match=r"outside 0 to 180.*stage\.max_deg"):
            stage.move_to(math.radians(deg))
    finish(port)


def test_homing_by_switch_at_opening() -> None:
    settled = [(b"$H\n", OK), (b"?", at(-1.0)), PREAMBLE, (b"?", at(-1.0)), (b"?", at(-1.0)), (b"M5\n", OK)]
    stage, port = play([*OPEN_GRBL[:-2], *settled, *move(88.0)], homing="switch", home_deg=1.0)
    assert stage.move_to(math.pi / 2) == pytest.approx(math.pi / 2)
    finish(port)


def test_fluidnc_with_other_steps_in_its_file_is_refused() -> None:
    with pytest.raises(StageError, match=r"steps_per_mm is 80 .*steps_per_deg is 44.*make them equal"):
        play(OPEN_FLUIDNC[:3], Dialect.FLUIDNC, steps_per_deg=44.0)


LOCKED = b"<Alarm|MPos:0.000,0.000,0.000|FS:0,0|WCO:0.000,0.000,0.000>\r\n"
UNLOCK = b"\r\nGrbl 1.1h ['$' for help]\r\n[MSG:'$H'|'$X' to unlock]\r\n"
SETTINGS_22 = b"$1=255\r\n$22=%d\r\n$32=0\r\n$100=80.000\r\n$110=6000.000\r\n$120=10.000\r\nok\r\n"


def test_settings_are_read_and_written_while_the_board_waits_in_alarm_for_its_homing() -> None:
    script: Script = [
        (b"?", LOCKED),
        (b"$$\n", LOCKED + OPEN_GRBL[1][1]),  # a report overtakes the answer
        *((sent, LOCKED + reply) for sent, reply in OPEN_GRBL[2:-2]),
        (b"\x18", UNLOCK),
        (b"?", LOCKED),
        (b"$H\n", OK),
        (b"?", at(-1.0)),
        PREAMBLE,
        (b"?", at(-1.0)),
        (b"?", at(-1.0)),
        (b"M5\n", OK),
    ]
    _, port = play(script, homing="switch")
    finish(port)


def test_homing_without_a_switch_is_an_error_although_grbl_says_ok() -> None:
    failed = b"ALARM:9\r\nok\r\n" + UNLOCK
    script = [(b"?", LOCKED), (b"$$\n", SETTINGS_22 % 1), (b"$H\n", failed), (b"?", LOCKED)]
    with pytest.raises(StageError, match="ALARM:9, the limit switch was not found"):
        play(script, homing="switch")


@pytest.mark.parametrize(
    ("dialect", "flags", "sent"),
    [(Dialect.GRBL, 1, b"$H\n"), (Dialect.GRBLHAL, 1, b"$H\n"), (Dialect.GRBLHAL, 3, b"$HX\n")],
)
def test_one_axis_homes_alone_only_where_the_board_allows_it(dialect: Dialect, flags: int, sent: bytes) -> None:
    home = [(sent, OK), (b"?", at(-1.0)), PREAMBLE, (b"?", at(-1.0)), (b"?", at(-1.0)), (b"M5\n", OK)]
    _, port = play([(b"?", at(0)), (b"$$\n", SETTINGS_22 % flags), *home], dialect, homing="switch")
    finish(port)


def test_grblhal_that_demands_homing_says_so() -> None:
    alarm = b"<Alarm:11|MPos:0.000,0.000,0.000|Bf:100,1023|FS:0,0>\r\n"
    with pytest.raises(StageError, match=r"error:46, the board must be homed first"):
        play(
            [(b"?", alarm), (b"$X\n", b"error:46\r\n"), (b"\n", OK), (b"$X\n", b"error:46\r\n"), (b"\n", OK)],
            Dialect.GRBLHAL,
        )


def test_grblhal_is_told_that_its_error_was_heard_or_it_would_refuse_everything_after_it() -> None:
    damaged = [(b"G53 G1 X10.0000\n", b"error:2\r\n"), (b"\n", OK), *move(10)]
    stage, port = play([*OPEN_HAL, *damaged], Dialect.GRBLHAL)
    assert stage.move_to(math.radians(10)) == pytest.approx(math.radians(10))
    finish(port)


def test_fluidnc_with_verbose_errors_says_words_instead_of_numbers() -> None:
    old = [(sent, reply) for sent, reply in OPEN_FLUIDNC]
    old[2:3] = [(old[2][0], b"error:Invalid $ statement\r\n")] * 2  # asked again, refused again: not known
    line = b"G53 G1 X10.0000\n"
    refused = [(line, b"error:Gcode invalid target\r\n")] * 2
    stage, port = play([*old, *refused], Dialect.FLUIDNC)
    with pytest.raises(StageError, match=r"refused .*error:Gcode invalid target"):
        stage.move_to(math.radians(10))
    finish(port)


def test_fluidnc_that_reports_inches() -> None:
    opening = [*OPEN_FLUIDNC]
    opening[1] = (b"$13\n", b"$13=1\r\nok\r\n")
    reported = b"<Idle|MPos:0.3937,0.0000,0.0000|FS:0,0>\r\n"
    stage, port = play([*opening, *move(10)[:2], (b"?", reported)], Dialect.FLUIDNC)
    assert stage.move_to(math.radians(10)) == pytest.approx(math.radians(10))
    finish(port)


@pytest.mark.parametrize(("held", "reported"), [(4.444444, 180.0), (4.444, 180.018)])
def test_steps_with_many_decimals_are_written_whole_and_counted_right(held: float, reported: float) -> None:
    """1600 steps for a turn; grbl prints 4.444 whichever it holds, and 800 steps are half a turn."""
    assert 800 / held == pytest.approx(reported, abs=5e-4)
    new = [(sent.replace(b"=80\n", b"=4.444444\n"), reply.replace(b"80.000", b"4.444")) for sent, reply in OPEN_GRBL]
    old = [(b"?", at(0)), (b"$$\n", (SETTINGS_22 % 0).replace(b"80.000", b"4.444")), PREAMBLE, (b"M5\n", OK)]
    for opening in (new, old):
        stage, port = play([*opening, *move(180.0, reported)], steps_per_deg=1600 / 360)
        assert stage.move_to(math.pi) == pytest.approx(math.pi, abs=1e-12)
        finish(port)


def test_a_board_whose_steps_nobody_says_is_taken_at_its_word_where_they_are_rounded() -> None:
    opening = [(b"?", at(0)), (b"$$\n", (SETTINGS_22 % 0).replace(b"80.000", b"8.889")), PREAMBLE, (b"M5\n", OK)]
    stage, port = play([*opening, *move(180.0)], steps_per_deg=None)
    assert stage.move_to(math.pi) == math.pi  # 1600 steps of 8.889 would be 179.998
    finish(port)


def test_the_index_mark_is_where_the_probe_says_also_in_inches() -> None:
    inches = OPEN_GRBL[1][1].replace(b"$13=0", b"$13=1")
    place = b"<Idle|MPos:-1.0000,0.0000,0.0000|FS:0,0>\r\n"
    script = [
        *OPEN_GRBL[:1],
        (b"$$\n", inches),
        *((sent, reply.replace(b"$13=0", b"$13=1")) for sent, reply in OPEN_GRBL[2:-2]),
        (b"$X\n", OK),
        (b"?", place),
        PREAMBLE,
        (b"G91 G38.2 X-180.000 F300.0\n", b"[PRB:-1.0000,0.0000,0.0000:1]\r\nok\r\n"),
        (b"G90\n", OK),
        (b"?", place),
        (b"M5\n", OK),
    ]
    stage, port = play(
        [*script, (b"G1 F1200.0\n", OK), *move(-15.4, 0)[:2], (b"?", b"<Idle|MPos:-0.6063,0.0000,0.0000|FS:0,0>\r\n")],
        homing="index",
    )
    assert stage.move_to(math.radians(10)) == pytest.approx(math.radians(10))
    finish(port)


def test_reports_that_a_board_sends_by_itself_do_not_prove_that_an_answer_is_lost() -> None:
    stage, port = play([*OPEN_GRBL, (b"G53 G1 X10.0000\n", at(0) * 5 + OK), *move(10)[1:]])
    assert stage.move_to(math.radians(10)) == pytest.approx(math.radians(10))
    finish(port)


def test_a_laser_that_an_alarm_keeps_from_m5_is_switched_off_by_a_reset() -> None:
    locked = [(b"M5\n", b"error:9\r\n")] * 2
    reset = [(b"!", b""), (b"?", LOCKED), (b"\x18", UNLOCK), (b"?", LOCKED)]
    stage, port = play([*OPEN_GRBL, *locked, *reset])
    stage.laser(False)
    finish(port)
    with pytest.raises(StageError, match="is in alarm"):
        stage.move_to(0.1)


@pytest.mark.parametrize(
    ("lines", "dialect"),
    [
        ("Grbl 1.1h ['$' for help]|[VER:1.1h.20190830:]|[OPT:V,15,128]", Dialect.GRBL),
        ("GrblHAL 1.1f ['$' or '$HELP' for help]|[VER:1.1f.20240812:]|[OPT:VNMSL,100,1024,3,0]", Dialect.GRBLHAL),
        ("Grbl 1.1f ['$' for help]|[NEWOPT:ENUMS,RT+,HOME,TC,SED]|[FIRMWARE:grblHAL]", Dialect.GRBLHAL),
        ("Grbl 3.7 [FluidNC v3.7.8 (noradio) '$' for help]|[VER:3.7 FluidNC v3.7.8:]|[OPT:PHS]", Dialect.FLUIDNC),
    ],
)
def test_banners_and_build_infos(lines: str, dialect: Dialect) -> None:
    first, *info = lines.split("|")
    banner = parse_banner(first)
    assert banner
    assert dialect_of_build_info(info, banner.dialect) is dialect


@pytest.mark.parametrize(
    ("report", "state", "substate", "x"),
    [
        ("<Idle|WPos:1.000,0.000,0.000|Bf:15,128|FS:0,0|Pn:XYZ>", "Idle", 0, 1.0),
        ("<Run:2|MPos:2.000|Bf:99,1023|Ln:7|FS:600,0|A:SFM|WCS:G54|H:1,1|FW:grblHAL>", "Run", 2, 2.0),
        ("<Hold:1|MPos:3.000,0.000,0.000|F:500|Ov:100,100,100>", "Hold", 1, 3.0),
        ("<Door:3|MPos:4.000,0.000,0.000|FS:0,0|Pn:D>", "Door", 3, 4.0),
        ("<Alarm:11|MPos:5.000,0.000,0.000|FS:0,0>", "Alarm", 11, 5.0),
        ("<Tool|MPos:6.000,0.000,0.000|FS:0,0>", "Tool", 0, 6.0),
        ("<Sleep|MPos:7.000,0.000,0.000|FS:0,0>", "Sleep", 0, 7.0),
    ],
)
def test_status_reports_of_the_dialects(report: str, state: str, substate: int, x: float) -> None:
    status = parse_status(report)
    assert status
    assert (status.state, status.substate, status.position[0]) == (state, substate, x)


def test_build_info_beats_a_disguised_banner() -> None:
    assert dialect_of_build_info(["[VER:1.1f:]", "[FIRMWARE:grblHAL]"], Dialect.GRBL) is Dialect.GRBLHAL
    assert dialect_of_build_info(["[VER:1.1h.20190825:]"], Dialect.GRBL) is Dialect.GRBL


def test_a_board_slow_to_start_is_not_taken_for_one_that_restarts() -> None:
    banner = b"Grbl 1.1h ['$' for help]\r\n"
    port = ScriptedPort([(b"\x18", b""), (b"\x18", banner + banner), (b"?", at(0)), (b"$I\n", OK)])
    link = GrblLink(SerialPort(port, "script"), 0.1)
    assert link.reset().dialect is Dialect.GRBL
    assert link.command("$I") == []
    finish(port)


def test_a_stale_ok_is_not_taken_for_the_next_answer_even_from_a_port_that_tells_one_byte_at_a_time() -> None:
    class OneByte(ScriptedPort):
        @property
        def in_waiting(self) -> int:
            return min(1, len(self.incoming))

    port = OneByte([(b"M5\n", OK + OK), (b"$I\n", b"[VER:1.1h:]\r\nok\r\n")])
    link = GrblLink(SerialPort(port, "script"), 0.1)
    assert link.command("M5") == []
    assert link.command("$I") == ["[VER:1.1h:]"]
    finish(port)


def test_a_setting_that_a_damaged_line_stored_wrongly_is_written_again_then_refused() -> None:
    lost = (b"$$\n", SETTINGS_OF_SCANS.replace(b"$110=1200", b"$110=10"))  # two characters got lost
    again = [(b"$110=1200\n", OK), OPEN_GRBL[6]]
    _, port = play([*OPEN_GRBL[:6], lost, *again, *OPEN_GRBL[7:]])
    finish(port)
    with pytest.raises(StageError, match=r"keeps \$110=10 although it was told 1200"):
        play([*OPEN_GRBL[:6], lost, again[0], lost])


def test_a_weak_laser_and_a_step_rate_beyond_an_arduino_are_said(caplog: pytest.LogCaptureFixture) -> None:
    told = SETTINGS_OF_SCANS.replace(b"$32=0", b"$30=20000\r\n$32=0").replace(b"$110=1200", b"$110=30000")
    quick = [(b"?", at(0)), (b"$$\n", told), (b"G21 G90 G94 G1 F24000.0\n", OK), (b"M5\n", OK)]
    play(quick, speed_deg_s=400.0)
    assert "gives the laser 5 % of its power: $30 is 20000; set stage.laser_s" in caplog.text
    assert "is to make 32000 steps a second, an Arduino makes 30000" in caplog.text
    caplog.clear()
    play([quick[0], quick[1], PREAMBLE, quick[3]], laser_s=1000.0)
    assert not caplog.text


def test_nothing_is_sent_while_a_board_writes_its_memory() -> None:
    """An AVR hears nothing meanwhile: not even `?`, which is asked every 12 ms otherwise."""

    class Writing(ScriptedPort):
        told = 0.0

        def write(self, data: bytes) -> int:
            assert time.monotonic() - self.told > 0.09
            self.told = time.monotonic() if data.startswith(b"$1=") else 0.0
            return super().write(data)

    port = Writing([(b"$1=255\n", b""), (b"?", at(0)), (b"?", at(0)), (b"$1=255\n", OK)])
    assert GrblLink(SerialPort(port, "script"), 0.05).command("$1=255") == []
    finish(port)


def test_a_startup_line_that_lights_the_laser_is_undone_after_every_reset_and_said(
    caplog: pytest.LogCaptureFixture,
) -> None:
    banner = CLOSE_GRBL[-1][1]
    lit = banner + b">G21:ok\r\n>M3S1000:ok\r\n"
    off = (b"M5\n", OK)
    opening = [(OPEN_GRBL[0][0], b">M3S1000:ok\r\n" + at(0)), *OPEN_GRBL[1:]]
    reset = [(b"!", b""), (b"?", at(0)), (b"\x18", lit), (b"?", at(0)), PREAMBLE, off]
    stage, port = play([*opening, *reset, *CLOSE_GRBL[:-1], (b"\x18", lit), off])
    assert "switched its laser on by a startup line" in caplog.text
    stage._link.stop()
    stage.close()
    finish(port)


def test_a_startup_line_that_lights_no_laser_changes_nothing() -> None:
    opening = [(OPEN_GRBL[0][0], b">G21M5:ok\r\n>M30:ok\r\n>M3:error:9\r\n" + at(0)), *OPEN_GRBL[1:]]
    stage, port = play([*opening, *CLOSE_GRBL])
    stage.close()
    finish(port)


def test_a_jog_goes_to_a_place_and_is_cancelled_by_an_interruption(monkeypatch: pytest.MonkeyPatch) -> None:
    line = b"$J=G53 G21 X10.0000 F1200.0\n"
    stage, port = play([*OPEN_GRBL, (line, OK), (b"?", at(4, "Jog")), (b"?", at(10)), (b"?", at(10))])
    assert stage.jog(math.radians(10)) == pytest.approx(math.radians(10))
    finish(port)
    cancelled = [(b"\x85", b""), (b"?", at(4, "Jog")), (b"?", at(4.5)), (b"?", at(4.5))]
    stage, port = play([*OPEN_GRBL, (line, OK), (b"?", at(4, "Jog")), *cancelled, *CLOSE_GRBL])
    read_line = SerialPort.read_line

    def interrupted(self: SerialPort, timeout_s: float) -> str | None:
        if timeout_s == 0.051 and len(port.script) == len(cancelled) + len(CLOSE_GRBL):
            raise KeyboardInterrupt
        return read_line(self, timeout_s)

    monkeypatch.setattr("scanmap.rig.grbl_link.BRAKE_POLL_S", 0.051)
    monkeypatch.setattr(SerialPort, "read_line", interrupted)
    with pytest.raises(KeyboardInterrupt):
        stage.jog(math.radians(10))
    assert stage.where() == pytest.approx(math.radians(4.5))
    stage.close()
    finish(port)


def test_a_board_without_jogs_is_told_g1_and_one_that_refuses_this_jog_is_not() -> None:
    line = b"$J=G53 G21 X10.0000 F1200.0\n"
    stage, port = play([*OPEN_GRBL, *[(line, b"error:3\r\n")] * 2, *move(10)])
    assert stage.jog(math.radians(10)) == pytest.approx(math.radians(10))
    finish(port)
    stage, port = play([*OPEN_GRBL, *[(line, b"error:15\r\n")] * 2])
    with pytest.raises(StageError, match=r"error:15, the jog would leave the travel set by \$130"):
        stage.jog(math.radians(10))
    finish(port)


def test_a_grblhal_without_legacy_commands_is_asked_by_bytes_that_no_line_contains() -> None:
    assert real_time_of_build_info(["[NEWOPT:ENUMS,RT-,HOME]"]) == (b"\x80", b"\x82", b"\x81")
    assert real_time_of_build_info(["[NEWOPT:ENUMS,RT+]"]) == real_time_of_build_info([]) == (b"?", b"!", b"~")
    port = ScriptedPort(
        [(b"\x80", at(3)), (b"\x82", b""), (b"\x80", at(3)), (b"\x18", CLOSE_GRBL[-1][1]), (b"\x80", at(3))]
    )
    link = GrblLink(SerialPort(port, "script"), 0.2)
    link.real_time = real_time_of_build_info(["[NEWOPT:RT-]"])
    assert link.status().position[0] == 3
    link.stop()
    finish(port)


def test_a_work_offset_that_no_report_tells_is_asked_for() -> None:
    report = (b"?", b"<Idle|WPos:1.000,0.000,0.000|FS:0,0>\r\n")
    modes = (b"$G\n", b"[GC:G0 G55 G17 G21 G90 G94 M5 M9 T0 F0 S0]\r\nok\r\n")
    offsets = (
        b"$#\n",
        b"[G54:9.000,0.000,0.000]\r\n[G55:4.000,0.000,0.000]\r\n[G92:0.500,0.000,0.000]\r\n[TLO:0.000]\r\nok\r\n",
    )
    script = [*OPEN_HAL, *[report] * 13, modes, offsets, *move(10)[:2], (b"?", report[1].replace(b"1.000", b"5.500"))]
    stage, port = play(script, Dialect.GRBLHAL)
    assert stage.where() == pytest.approx(math.radians(5.5))
    assert stage.move_to(math.radians(10)) == pytest.approx(math.radians(10))
    finish(port)


def test_an_open_door_is_said_in_bounded_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scanmap.rig.grbl_wait.STILL_S", 0.01)
    line = b"G53 G1 X10.0000\n"
    ajar = at(4, "Door:1")
    stage, port = play([*OPEN_GRBL, (line, b"[MSG:Check Door]\r\n"), (b"?", ajar), (b"?", ajar)])
    with pytest.raises(StageError, match="is on door: release its hold button or close its door"):
        stage.move_to(math.radians(10))
    finish(port)


def test_a_board_that_goes_on_after_its_door_was_closed_is_given_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr("scanmap.rig.grbl_wait.time.monotonic", lambda: clock[0])
    wait = Wait("head", 2.0, 0.25)
    for after_s, state, substate in (
        (2.9, "Door", 1),
        (0.1, "Door", 0),
        (0.1, "Door", 3),
        (4.0, "Door", 3),
        (0.1, "Run", 0),
    ):
        clock[0] += after_s
        status = Status(state, substate, (4.0, 0.0, 0.0), False, None)
        assert not wait.is_over(status)
        wait.resume_due(status)
    clock[0] += 3.1
    with pytest.raises(StageError, match="runs but stands at 4"):
        wait.is_over(status)


def test_a_restart_whose_banner_got_lost_is_told_by_the_feed_rate_that_is_gone() -> None:
    stage, port = play([*OPEN_GRBL, (b"G53 G1 X10.0000\n", b"error:22\r\n")])
    for _ in range(2):
        with pytest.raises(StageError, match="restarted by itself, so its position is lost"):
            stage.move_to(math.radians(10))
    finish(port)


def test_a_slow_turn_leaves_no_slow_moves_behind() -> None:
    slow = [(b"G53 G1 X90.0000 F360.0\n", OK), (b"G53 G1 X90.0000\n", OK), (b"G1 F1200.0\n", OK)]
    stage, port = play([*OPEN_GRBL, *slow, *move(90), *move(0)])
    stage.start_turn(math.radians(90), math.radians(6))
    for deg in (90, 0):
        assert stage.move_to(math.radians(deg)) == pytest.approx(math.radians(deg))
    finish(port)


def test_a_turn_that_was_stopped_is_not_taken_up_again() -> None:
    turn = (b"G53 G1 X90.0000 F360.0\n", OK)
    stopped = [(b"!", b""), (b"?", at(40, "Hold:0")), (b"\x18", CLOSE_GRBL[-1][1]), (b"?", at(40)), PREAMBLE]
    stage, port = play([*OPEN_GRBL, turn, *stopped, (b"G1 F1200.0\n", OK), *move(10)])
    stage.start_turn(math.radians(90), math.radians(6))
    stage.laser(False)
    assert stage.move_to(math.radians(10)) == pytest.approx(math.radians(10))
    finish(port)


def test_a_banner_that_noise_has_damaged_still_means_a_restart() -> None:
    stage, port = play([*OPEN_GRBL, (b"G53 G1 X10.0000\n", b"r\x00bl 1.1h ['$' for help]\r\n")])
    with pytest.raises(StageError, match="restarted by itself"):
        stage.move_to(math.radians(10))
    finish(port)


def test_template_speaks_the_users_own_language() -> None:
    script = [
        (b"S90.0 1500\n", b"hm\r\ndone 1\r\n"),
        (b"L1\n", b"done\r\n"),
        (b"L0\n", b"done\r\n"),
        (b"FREE\n", b"done\r\n"),
    ]
    params = StageParams(
        kind="template",
        command_move="S{deg:.1f} {us:.0f}",
        command_laser_on="L1",
        command_laser_off="L0",
        command_release="FREE",
        answer="done",
        speed_deg_s=720,
        timeout_s=0.2,
    )
    port = ScriptedPort(script)
    stage = TemplateStage(SerialPort(port, "servo"), params)
    assert stage.move_to(math.pi / 2) == stage.where() == math.pi / 2
    stage.laser(True)
    stage.close()
    assert port.closed
    finish(port)


def test_template_faults() -> None:
    with pytest.raises(ConfigError, match=r"command_move = 'S\{angle\}'.*\{deg\}"):
        TemplateStage(SerialPort(ScriptedPort([]), "servo"), StageParams(kind="template", command_move="S{angle}"))
    params = StageParams(kind="template", command_move="S{deg:g}", speed_deg_s=720, timeout_s=0.05)
    stage = TemplateStage(SerialPort(ScriptedPort([(b"S9\n", b"what\r\n")]), "servo"), params)
    with pytest.raises(StageError, match=r"did not answer 'ok' to 'S9' \(last heard: 'what'\)"):
        stage.move_to(math.radians(9))


def test_manual_asks_again_until_it_understands() -> None:
    asked: list[str] = []
    answers = iter(["", "abc", "400", "12.5"])

    def ask(question: str) -> str:
        asked.append(question)
        return next(answers)

    stage = ManualStage(StageParams(kind="manual"), ask)
    assert stage.move_to(math.radians(10)) == math.radians(10)
    assert stage.move_to(math.radians(12)) == stage.where() == math.radians(12.5)
    assert len(asked) == 4
    assert not stage.laser_switchable
    with pytest.raises(StageError, match="outside"):
        stage.move_to(4.0)


def test_manual_without_a_terminal_says_so() -> None:
    def ask(_: str) -> str:
        raise EOFError

    with pytest.raises(StageError, match="needs a terminal"):
        ManualStage(StageParams(kind="manual"), ask).move_to(1.0)
