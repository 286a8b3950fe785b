"""What a written calibration says of where it came from, and what is said when one takes another's place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scanmap.calibration import Calibration
from scanmap.calibration.keeping import parts_lost, recorded_command
from scanmap.cli import main
from scanmap.solvers.board import parse_board
from scanmap.solvers.pictures import Picture, collect

HEAD = "[image]\nwidth = 640\nheight = 480\n[head]\nbaseline_m = 0.08\nbeta_deg = 25.7\nalpha_deg = 32.3\n"


@pytest.mark.parametrize(
    ("words", "kept"),
    [
        (
            ["calibrate", "camera", "/home/me/pictures", "--out", "there/c.toml"],
            "calibrate camera pictures --out c.toml",
        ),
        (["--out=/home/me/c.toml", "--set", "twin.room=/home/me/room.ply"], "--out=c.toml --set twin.room=room.ply"),
        (["/dev/video0", "--board", "chessboard:8x6:40mm"], "video0 --board chessboard:8x6:40mm"),
        (["http://me:secret@192.168.1.20:8080/video?x=/y"], "http://192.168.1.20:8080"),
        (["camera", "--set", "sweep.step_deg=0.5", "3", "."], "camera --set sweep.step_deg=0.5 3 ."),
    ],
)
def test_the_command_is_kept_without_folders_and_logins(words: list[str], kept: str) -> None:
    assert recorded_command(words) == f"scanmap {kept}"


def test_a_matrix_stands_in_rows_and_comes_back_to_the_last_bit() -> None:
    names, matrix = ["fx", "fy"], np.array([[1.8341518684043259, -3.5e-16], [-3.5e-16, 2.0]]).tolist()
    text = "[1.0,\n    2.0,\n]"  # words are no numbers
    made = replace(
        Calibration.loads(HEAD), covariance={"parameters": names, "matrix": matrix}, meta={"note": text}
    )  # fmt: skip
    written = made.dumps()
    assert "    [1.8341518684043259, -3.5e-16],\n" in written
    again = Calibration.loads(written)
    assert again.covariance["matrix"] == matrix
    assert again.meta["note"] == text
    np.testing.assert_array_equal(again.T_head_camera, made.T_head_camera)


def test_a_head_that_is_lost_is_named(tmp_path: Path) -> None:
    whole = Calibration.loads(HEAD)
    bare = replace(whole, meta={"uncalibrated": ["laser plane", "axis"]})
    out = tmp_path / "c.toml"
    assert parts_lost(bare, out) == []
    whole.save(out)
    assert parts_lost(bare, out) == ["laser plane", "axis"]
    assert parts_lost(whole, out) == []
    bare.save(out)
    assert parts_lost(bare, out) == []
    out.write_text("damaged")
    assert parts_lost(bare, out) == []


@pytest.mark.parametrize("group", ["calibrate", "stage"])
def test_a_group_alone_says_its_commands_in_a_line(group: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([group])
    said = capsys.readouterr().err
    assert end.value.code == 2
    assert said.startswith(f"scanmap: scanmap {group} does nothing by itself; commands: ")
    assert len(said) < 200


def test_a_missing_calibration_is_said_without_numbers_of_the_system(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["calibrate", "scale", str(tmp_path / "no.toml"), "--size", "320x240", "--out", str(tmp_path / "o.toml")])
    said = capsys.readouterr().err
    assert end.value.code == 2
    assert "no.toml cannot be read: No such file or directory\n" in said


def test_a_speed_of_nothing_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["calibrate", "latency", "--speed-deg-s", "0"])
    assert end.value.code == 2
    assert "--speed-deg-s" in capsys.readouterr().err


def test_a_giant_picture_is_not_searched_for_minutes() -> None:
    giant = np.broadcast_to(np.uint8(0), (20000, 20000))
    found = collect([Picture("giant", giant)], parse_board("chessboard:8x6:40mm"))
    assert "20000x20000 is larger than any" in found.rejected[0].reason
