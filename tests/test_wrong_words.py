"""What a new user gets wrong on the command line: one line says what, the value, what is valid; exit code 2 or 1."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from scanmap.cli import main

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs a command in a folder of junk; its exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "junk.toml").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "rig.toml").write_text("rig = 'twin'\n[sweep]\nstep_deg = 2.0\n", encoding="utf-8")
    (tmp_path / "room.ply").write_text("ply\n", encoding="utf-8")
    (tmp_path / "cut.mcap").write_bytes(b"")

    def command(*words: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            main(list(words))
        said = capsys.readouterr()
        return int(ended.value.code or 0), said.out, said.err

    return command


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("board --out .", "--out . is a folder"),
        ("board --out folder.png", "--out folder.png is a folder"),
        ("calibrate check cut.mcap --figure .", "--figure . is a folder"),
        ("calibrate self cut.mcap --out .", "--out . is a folder"),
        ("calibrate self cut.mcap --out folder.toml", "--out folder.toml is a folder"),
        ("design --out .", "--out . is a folder"),
        ("design --sigma-px 0", "'--sigma-px': must be greater than or equal to 0.001; try scanmap design --help"),
        ("scan --set sweep=3", "sweep = 3: must be a table. `scanmap config` lists every key"),
        ("stage laser maybe", "'on|off': 'maybe' is not one of 'on', 'off'"),
        ("init --out my.txt", "must end in .toml; try my.toml"),
        ("init --out none/my.toml", "there is no folder"),
        ("view cut.mcap --save room.ply", "--save room.ply: must end in .rrd; try room.rrd"),
        ("map cut.mcap --out room.png", "--out room.png: must end in .yaml; try room.yaml"),
        ("scan --config junk.toml", "configuration junk.toml cannot be read: it is not UTF-8 text"),
        ("scan --set rig=replay-only", "try scanmap replay SOURCE, or set rig"),
        ("scan --config srv-turntable", "try scanmap replay SOURCE --config srv-turntable"),
        ("recover none.mcap", "none.mcap: there is no such file; scanmap recover wants the .mcap file of a scan"),
        ("recover room.ply", "room.ply: not a recording; scanmap recover wants the .mcap file of a scan"),
        ("recover cut.mcap --out cut.mcap", "recording cut.mcap exists and is not overwritten; give another --out"),
        ("recover cut.mcap --out none/whole.mcap", "there is no folder none; create it with mkdir -p none"),
        ("calibrate camera none --board chessboard:8x6:40mm", "none does not exist; SOURCE is a folder of pictures"),
        ("scan --resume none.mcap", "--resume none.mcap: not the recording (.mcap) of a scan: there is no such file"),
        ("scan --resume room.ply", "--resume room.ply: not the recording"),
    ],
)
def test_usage(run: Run, words: str, complaint: str) -> None:
    code, out, err = run(*words.split())
    assert code == 2
    assert complaint in err and err.count("\n") == 1
    assert "None" not in err and not out


def test_a_rigs_toml_is_no_calibration(run: Run) -> None:
    code, _, err = run("scan", "--calibration", "rig.toml")
    assert code == 2 and err.count("\n") == 1
    assert "rig.toml is the configuration of a rig, not a calibration: give it with --config" in err


def test_a_negative_angle_is_no_option(run: Run) -> None:
    code, out, _ = run("stage", "jog", "-5", "--set", "stage.min_deg=-90")
    assert code == 0 and "bearing -5.000 deg" in out
    code, _, err = run("stage", "jog", "--too")
    assert code == 2 and "try scanmap stage jog --help" in err


def test_a_map_of_heights_where_nothing_is_says_so(run: Run) -> None:
    demo = Path(__file__).parents[1] / "recordings" / "demo.mcap"
    code, out, _ = run("map", str(demo), "--out", "m.yaml", "--height-m", "100:200")
    assert code == 0 and "nothing was seen at these heights" in out and "--height-m" in out
    code, out, _ = run("map", str(demo), "--out", "m.yaml")
    assert code == 0 and "nothing was seen" not in out
