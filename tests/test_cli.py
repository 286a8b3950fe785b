"""The command line as users meet it: what it says, how it ends, and that bad input loses nothing."""

import logging
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from conftest import TwinScan

from scanmap import session
from scanmap.cli import main, terminal
from scanmap.config import load, parse
from scanmap.recording import open_source
from scanmap.session.job import Job
from scanmap.view.recorder import is_whole

QUICK = (
    "--config", "twin-quick", "--set", "calibration.image.width=320", "--set", "calibration.image.height=240",
    "--set", "sweep.step_deg=30",
)  # fmt: skip


class Said(NamedTuple):
    """What a command printed, and its exit code."""

    code: int
    out: str
    err: str


Run = Callable[..., Said]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    """Run a command in an empty folder, on a machine without a display."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)

    def command(*words: str | Path) -> Said:
        with pytest.raises(SystemExit) as ended:
            main([str(word) for word in words])
        printed = capsys.readouterr()
        return Said(int(ended.value.code or 0), printed.out, printed.err)

    root = logging.getLogger()
    before = root.handlers[:], root.level, logging.getLogger("scanmap").level
    yield command
    root.handlers[:], level, own = before
    root.setLevel(level)
    logging.getLogger("scanmap").setLevel(own)


def one_line(said: Said, code: int, *words: str) -> None:
    """An error of exactly one line on stderr, with these words, and no traceback anywhere."""
    assert said.code == code, said
    assert said.err.startswith("scanmap: ") and said.err.count("\n") == 1, said.err
    assert "bug" not in said.err and "Traceback" not in said.out
    for word in words:
        assert word in said.err, (word, said.err)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of seven bearings, 320x240."""
    folder = tmp_path_factory.mktemp("small")
    choice = session.Choice("twin-quick", tuple(word for word in QUICK[3::2]))
    outputs = session.Outputs((folder / "room.ply",), record=folder / "room.mcap")
    with session.prepare_scan(choice, outputs, view=False) as job:
        job.run(lambda _: None, lambda: False)
    return folder / "room.mcap"


@pytest.fixture
def frames(small: Path, tmp_path: Path) -> Path:
    """The same scan as a folder of frames, with its calibration."""
    folder = tmp_path / "frames of a room"
    (folder / "frames").mkdir(parents=True)
    source = open_source(small)
    lines = ["frame,bearing_deg,time_s"]
    for shot in source.shots():
        (folder / "frames" / f"{shot.index:06d}.jpg").write_bytes(shot.image)
        lines.append(f"{shot.index},{math.degrees(shot.bearing)!r},{shot.time!r}")
    (folder / "scan.csv").write_text("\n".join(lines) + "\n")
    (folder / "calibration.toml").write_text(source.calibration_toml)
    return folder


# What a new user meets


def test_no_command_shows_the_help(run: Run) -> None:
    said = run()
    assert said.code == 0 and not said.err
    assert all(name in said.out for name in ("scan", "replay", "view", "map", "info", "config"))


@pytest.mark.parametrize("command", ["scan", "replay", "view", "map", "info", "config"])
def test_every_command_has_help_of_80_columns(run: Run, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    said = run(command, "--help")
    assert said.code == 0 and max(map(len, said.out.splitlines())) <= 80
    # The list of commands shows the first sentence whole.
    first = said.out.split("\n\n")[1].strip().replace("\n ", "")
    assert first in run("--help").out


def test_adaptive_sweep_looks_closer_where_the_room_jumps(run: Run, tmp_path: Path) -> None:
    adaptive = (*QUICK, "--set", "sweep.mode=adaptive", "--set", "sweep.fine_deg=5", "--set", "sweep.step_deg=15")
    said = run("scan", *adaptive, "--out", "a.ply")
    assert said.code == 0 and "13 bearings" in said.out and "then every 5 deg where it is needed" in said.out
    shots = list(open_source(tmp_path / "a.mcap").shots())
    assert 13 < len(shots) <= 37 and [shot.index for shot in shots] == list(range(len(shots)))
    assert run("replay", "a.mcap", "--out", "b.ply").code == 0
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_scan_says_twin_first_and_leaves_cloud_map_recording(run: Run, tmp_path: Path) -> None:
    said = run("scan", *QUICK, "--out", "room 2.5.ply")
    assert said.code == 0 and not said.err
    lines = said.out.splitlines()
    assert lines[0].startswith("DIGITAL TWIN") and "made up" in lines[0] and len(lines[0]) <= 80
    names = {"room 2.5.ply", "room 2.5.yaml", "room 2.5.pgm", "room 2.5.mcap"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert {line.removeprefix("wrote ") for line in lines if line.startswith("wrote ")} == names
    assert "error against truth: median" in said.out and "accuracy budget" in said.out
    assert "next: scanmap info 'room 2.5.mcap'" in lines
    # What it proposes works here, where no window can be opened.
    assert "next: scanmap view 'room 2.5.mcap' --save 'room 2.5.rrd'" in lines


def test_scan_again_never_overwrites_a_recording(run: Run, small: Path, tmp_path: Path) -> None:
    shutil.copy(small, tmp_path / "a.mcap")
    assert run("scan", *QUICK, "--set", "sweep.step_deg=90", "--out", "a.ply").code == 0
    assert (tmp_path / "a.mcap").read_bytes() == small.read_bytes() and (tmp_path / "a-2.mcap").exists()
    one_line(run("scan", *QUICK, "--record", "a.mcap"), 2, "a.mcap exists")


def test_scan_without_recording_proposes_what_is_there(run: Run, tmp_path: Path) -> None:
    said = run("scan", *QUICK, "--set", "sweep.step_deg=90", "--no-record", "--out", "r.ply")
    assert said.code == 0 and not list(tmp_path.glob("*.mcap"))
    assert "next: scanmap info r.ply" in said.out and ".mcap" not in said.out


def test_replay_writes_the_same_bytes(run: Run, small: Path, tmp_path: Path) -> None:
    said = run("replay", small, "--out", "again.ply", "--out", "again.xyz", "--out", "again.pcd", "--map", "m.yaml")
    assert said.code == 0 and not said.err
    assert said.out.splitlines()[0].startswith("replaying 7 shots") and "DIGITAL TWIN" in said.out.splitlines()[0]
    assert (tmp_path / "again.ply").read_bytes() == small.with_suffix(".ply").read_bytes()
    assert (tmp_path / "again.xyz").stat().st_size and (tmp_path / "m.pgm").exists()


def test_modes_of_sweeping_all_run_on_the_twin(run: Run) -> None:
    said = run("scan", *QUICK, "--set", "sweep.mode=continuous", "--set", "sweep.end_deg=20", "--set",
               "sweep.step_deg=5", "--set", "sweep.speed_deg_s=20", "--no-record")  # fmt: skip
    assert said.code == 0, said
    assert " points from " in said.out


def test_video_with_csv(run: Run, frames: Path, tmp_path: Path) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 5, (320, 240))
    for path in sorted((frames / "frames").iterdir()):
        writer.write(cv2.imread(str(path)))
    writer.release()
    (tmp_path / "b.csv").write_text("bearing_deg\n" + "\n".join(str(30 * k) for k in range(7)))
    calibration = frames / "calibration.toml"
    said = run("replay", "v.avi", "--bearings", "b.csv", "--calibration", calibration, "--out", "v.ply")
    assert said.code == 0 and "replaying 7 shots" in said.out
    (tmp_path / "cut.mp4").write_bytes((tmp_path / "v.avi").read_bytes()[:300])
    one_line(run("replay", "cut.mp4", "--bearings", "b.csv", "--calibration", calibration), 1, "cannot be opened")
    one_line(run("replay", frames, "--bearings", "b.csv"), 2, "--bearings is for videos")


def test_map_of_recording_and_cloud(run: Run, small: Path, tmp_path: Path) -> None:
    options = ("--resolution-m", "0.02", "--height-m", "0.1:1.5", "--image", "png", "--mode", "scale")
    for source, name in ((small, "a"), (small.with_suffix(".ply"), "b")):
        said = run("map", source, "--out", f"{name}.yaml", *options)
        assert said.code == 0 and not said.err
        assert f"wrote {name}.yaml" in said.out and f"wrote {name}.png" in said.out and "0.02 m" in said.out
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_info_knows_every_kind_scanmap_writes(run: Run, small: Path, tmp_path: Path, twin_scan: TwinScan) -> None:
    kinds = ["r.ply", "r.glb", "r.stl", "r.obj", "r-mesh.ply", "r.pcd", "r.xyz"]
    outs = [word for name in kinds for word in ("--out", name)]
    assert run("replay", twin_scan.recording, *outs, "--map", "m.yaml", "--rrd", "v.rrd").code == 0
    (tmp_path / "rig.toml").write_text(run("config", "--config", "wide").out)
    for name in [*kinds, "m.yaml", "rig.toml", str(small), str(small.parent / "room.ply")]:
        said = run("info", name)
        assert said.code == 0 and name in said.out and not said.err, said
    assert "7 shots" in run("info", small).out and "digital twin" in run("info", small).out
    one_line(run("info", "v.rrd"), 2, "scanmap view v.rrd")
    one_line(run("info", "m.pgm"), 2, ".yaml")
    one_line(run("info", "nothing.ply"), 2, "does not exist")


def test_info_of_text_in_every_disguise(run: Run, tmp_path: Path) -> None:
    for suffix in ("mcap", "ply", "pcd", "xyz", "glb", "stl", "yaml", "toml"):
        for text in ("hello world\n", ""):
            (tmp_path / f"x.{suffix}").write_text(text)
            if not text and suffix == "toml":
                continue  # a configuration of nothing but defaults
            said = run("info", f"x.{suffix}")
            assert said.code in (1, 2), suffix
            one_line(said, said.code, f"x.{suffix}")


def test_config_is_complete_and_can_be_loaded_again(run: Run) -> None:
    text = run("config", "--config", "thesis", "--set", "sweep.step_deg=0.5").out
    assert parse(text, "again") == load("thesis", ["sweep.step_deg=0.5"])
    for key in ("T_head_camera", "intrinsics", "fx", "rpc_deg", "steps_per_deg", "laser_height_m", "residuals"):
        assert key in text, key
    assert not [line for line in text.splitlines() if line.rstrip().endswith("#")]


# No window here


@pytest.mark.parametrize("words", [("scan", *QUICK, "--view"), ("replay", "{small}", "--view")])
def test_view_without_display_leaves_nothing(run: Run, small: Path, tmp_path: Path, words: tuple[str, ...]) -> None:
    one_line(run(*(word.format(small=small) for word in words)), 2, "no display", "--rrd")
    assert not list(tmp_path.iterdir())


def test_viewing_without_display_says_so_before_any_work(run: Run, small: Path, tmp_path: Path) -> None:
    said = run("view", small)
    one_line(said, 2, "no display", "--save")
    assert not said.out
    one_line(run("view", "--live", "9"), 2, "no display")
    one_line(run("view"), 2, "SOURCE")
    one_line(run("view", small, "--live", "9"), 2, "--live")
    (tmp_path / "x.rrd").write_bytes(b"RRF2")
    one_line(run("view", "x.rrd"), 2, "rerun x.rrd")
    one_line(run("view", "no.rrd"), 2, "no.rrd is not a file")


def test_view_saves_and_says_what(run: Run, small: Path, tmp_path: Path) -> None:
    said = run("view", small, "--save", "v.rrd")
    assert said.code == 0 and said.out.strip().endswith("wrote v.rrd")
    assert (tmp_path / "v.rrd").stat().st_size > 10_000


def test_taken_port_leaves_nothing(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import socket

    monkeypatch.setenv("DISPLAY", ":99")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        said = run("scan", *QUICK, "--set", f"view.live_port={port}", "--view", "--out", "p.ply", "--rrd", "p.rrd")
    one_line(said, 2, f"port {port}", "--set view.live_port=")
    assert not list(tmp_path.iterdir())


# Words that cannot be


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("nonsense",), ("nonsense", "scan, replay, view, map, info, config")),
        (("scan", "--nope"), ("--nope", "scanmap scan --help")),
        (("info",), ("FILE", "scanmap info --help")),
        (("view", "--live", "0"), ("--live", "1")),
        (("map", "a.mcap"), ("--out",)),
        (("map", "a.mcap", "--out", "m.yaml", "--image", "gif"), ("gif", "pgm", "png")),
        (("map", "a.mcap", "--out", "m.yaml"), ("a.mcap does not exist",)),
        (("replay", "nowhere"), ("nowhere does not exist",)),
        (("scan", *QUICK, "--record", "c.mcap", "--no-record"), ("--record", "--no-record")),
        (("scan", *QUICK, "--out", "."), ("folder",)),
        (("scan", *QUICK, "--out", ".."), ("folder",)),
        (("scan", *QUICK, "--out", "nofolder/x.ply"), ("nofolder", "mkdir -p")),
        (("scan", *QUICK, "--out", "x.docx"), (".docx", ".ply")),
        (("scan", *QUICK, "--out", "x"), (".ply",)),
        (("scan", *QUICK, "--out", "b.ply", "--out", "./b.ply"), ("b.ply", "two outputs")),
        (("scan", *QUICK, "--out", "b.ply", "--map", "b.pgm"), ("b.yaml",)),
        (("scan", *QUICK, "--record", "b.bag"), ("b.mcap",)),
        (("scan", *QUICK, "--rrd", "b.mcap"), ("b.rrd",)),
        (("scan", *QUICK, "--calibration", "no.toml"), ("no.toml", "no such file")),
        (("scan", "--config", "nosuch"), ("nosuch", "twin-room")),
        (("scan", "--config", "srv-turntable"), ("scanmap replay SOURCE",)),
        (("scan", *QUICK, "--set", "sweep.step_deg=-1"), ("sweep.step_deg = -1", "greater than 0")),
        (("scan", *QUICK, "--set", "sweep.step_deg=1e-9"), ("1e-09", "bearings")),
        (("scan", *QUICK, "--set", "sweep.passes=1000000000"), ("passes",)),
        (("scan", *QUICK, "--set", "sweep.end_deg=350"), ("350", "180")),
        (("scan", *QUICK, "--set", "sweep.step_deg"), ("key=value",)),
        (("scan", *QUICK, "--set", "twin.room=no.ply"), ("no.ply", "furnished")),
        (("scan", *QUICK, "--set", "grid.height_low_m=nan"), ("grid.height_low_m = nan", "finite")),
    ],
)
def test_wrong_words_are_one_line_and_leave_nothing(
    run: Run, tmp_path: Path, words: tuple[str, ...], expected: tuple[str, ...]
) -> None:
    one_line(run(*words), 2, *expected)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--mode", "scale"), "png"),
        (("--height-m", "a:b"), "LOW:HIGH"),
        (("--height-m", "1.5:0.1"), "below"),
        (("--height-m", "nan:1"), "finite"),
        (("--resolution-m", "-1"), "resolution_m = -1"),
    ],
)
def test_wrong_map_options(run: Run, small: Path, tmp_path: Path, options: tuple[str, ...], expected: str) -> None:
    one_line(run("map", small, "--out", "m.yaml", *options), 2, expected)
    assert not list(tmp_path.iterdir())


def test_every_fault_of_a_configuration_at_once_by_the_users_own_keys(run: Run, tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(
        'rigg = 1\n[sweep]\npasses = "backward"\nstep_deg = nan\n[twin.light]\namb = 3\nambient = "x"\n'
        "[calibration.image]\nwidth = -1\nheight = 5\n[calibration.head]\nbaseline_m = 0.1\nbeta_deg = 500\n"
        "[calibration.heat]\n"
    )
    said = run("config", "--config", "rig.toml")
    one_line(said, 2, "rigg is no key", "sweep.step_deg = nan", "twin.light.amb is no key here; valid: ambient, window",
             "twin.light.ambient = 'x'", "calibration.image.width = -1", "calibration.head.beta_deg = 500",
             "calibration.heat is no key here; valid: image", "sweep.passes = 'backward': ")  # fmt: skip
    assert "literal[" not in said.err and "passes.int" not in said.err and "CalibrationFile" not in said.err


# Damaged sources


def damage_image(folder: Path) -> None:
    (folder / "frames/000002.jpg").write_bytes(b"\0" * 500)
    (folder / "frames/000003.jpg").write_bytes(b"")
    path = folder / "frames/000004.jpg"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    (folder / "frames/000005.jpg").unlink()


def test_damaged_and_missing_images_cost_only_themselves(run: Run, frames: Path) -> None:
    damage_image(frames)
    said = run("replay", frames, "--out", "o.ply", "--map", "o.yaml")
    assert said.code == 0 and not said.err
    faults = [line for line in said.out.splitlines() if line.startswith("fault: ")]
    assert len(faults) == 4
    for words in ("500 bytes", "0 bytes", "image is cut", "000005.jpg is missing"):
        assert any(words in fault for fault in faults), words
    assert "points from 6 bearings" in said.out


def test_one_image_of_another_size_costs_itself_but_all_of_them_are_refused(run: Run, frames: Path) -> None:
    cv2.imwrite(str(frames / "frames/000000.jpg"), np.zeros((100, 120, 3), np.uint8))
    said = run("replay", frames, "--out", "o.ply")
    assert said.code == 0 and "120x100" in said.out
    text = (frames / "calibration.toml").read_text().replace("width = 320", "width = 640")
    (frames / "other.toml").write_text(text)
    said = run("replay", frames, "--calibration", frames / "other.toml", "--out", "p.ply", "--rrd", "p.rrd")
    one_line(said, 1, "120x100", "640x240", "--calibration")
    assert not list(Path().glob("p.*"))


@pytest.mark.parametrize("content", [np.zeros((240, 320, 3), np.uint8), None], ids=["black", "damaged"])
def test_no_line_at_all_overwrites_nothing(run: Run, frames: Path, tmp_path: Path, content: Any) -> None:
    for path in (frames / "frames").iterdir():
        path.write_bytes(b"nope") if content is None else cv2.imwrite(str(path), content)
    (tmp_path / "o.ply").write_text("yesterday's")
    said = run("replay", frames, "--out", "o.ply", "--map", "m.yaml")
    one_line(said, 1, "laser" if content is not None else "no image of 7")
    assert (tmp_path / "o.ply").read_text() == "yesterday's" and not (tmp_path / "m.yaml").exists()
    one_line(run("map", frames, "--out", "m.yaml"), 1, "no cloud or map")


def test_replay_that_broke_off_overwrites_nothing(
    run: Run, small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = ("replay", small, "--out", "o.ply", "--map", "m.yaml", "--rrd", "v.rrd")
    for name in ("o.ply", "unfinished-1-o.ply", "m.pgm", "v.rrd"):
        (tmp_path / name).write_text("yesterday's")
    monkeypatch.setattr(terminal.Stop, "orderly", lambda stop, words: lambda: True)
    said = run(*asked)
    assert said.code == 130 and "wrote unfinished-2-o.ply" in said.out and "next: scanmap info unf" in said.out, said
    for name in ("m.yaml", "m.pgm", "v.rrd"):
        assert f"wrote unfinished-1-{name}" in said.out
    assert is_whole(tmp_path / "unfinished-1-v.rrd")
    for name in ("o.ply", "unfinished-1-o.ply", "m.pgm", "v.rrd"):
        assert (tmp_path / name).read_text() == "yesterday's"
    assert run("info", "unfinished-1-m.yaml").code == 0
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    said = run(*asked)
    assert said.code == 0 and (tmp_path / "o.ply").read_bytes() == small.with_suffix(".ply").read_bytes()
    assert "wrote v.rrd" in said.out and is_whole(tmp_path / "v.rrd")
    assert not (tmp_path / "unfinished-2-v.rrd").exists()


def test_a_replay_without_a_shot_leaves_an_older_view(run: Run, frames: Path, tmp_path: Path) -> None:
    (tmp_path / "v.rrd").write_text("yesterday's")
    for picture in (frames / "frames").iterdir():
        picture.unlink()
    one_line(run("replay", frames, "--out", "o.ply", "--rrd", "v.rrd"), 1, "none of the 7 images")
    assert (tmp_path / "v.rrd").read_text() == "yesterday's" and not list(tmp_path.glob("unfinished*"))


def test_pictures_too_narrow_for_a_line_are_refused_in_one_line(run: Run, frames: Path) -> None:
    for picture in (frames / "frames").iterdir():
        cv2.imwrite(str(picture), cv2.imread(str(picture))[:, 100:102])
    edit("calibration.toml", "width = 320", "width = 2")(frames)
    edit("calibration.toml", "cx = 159.5", "cx = 0.5")(frames)  # else nothing is in range there
    one_line(run("replay", frames, "--out", "o.ply"), 1, "a picture of 2x240 px is too narrow", "6 columns or more")


def edit(name: str, old: str, new: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text((folder / name).read_text().replace(old, new)) and None  # type: ignore[func-returns-value]


@pytest.mark.parametrize(
    ("damage", "code", "words"),
    [
        (lambda folder: (folder / "scan.csv").unlink(), 1, ("scan.csv", "frame,bearing_deg,time_s")),
        (edit("scan.csv", "bearing_deg", "angle"), 2, ("lacks the column bearing_deg",)),
        (edit("scan.csv", "\n1,", "\n1,nan,"), 2, ("line 3", "nan")),
        (lambda folder: (folder / "scan.csv").write_text("frame,bearing_deg\n"), 2, ("no line",)),
        (lambda folder: (folder / "calibration.toml").unlink(), 1, ("--calibration",)),
        (edit("calibration.toml", "width", "widht"), 1, ("widht",)),
        (lambda folder: (folder / "rig.toml").write_text("foo = 1"), 2, ("foo is no key", "--config")),
        (lambda folder: shutil.rmtree(folder / "frames"), 1, ("none of the 7 images",)),
    ],
)
def test_faulty_folders(
    run: Run, frames: Path, tmp_path: Path, damage: Callable[[Path], Any], code: int, words: tuple[str, ...]
) -> None:
    damage(frames)
    one_line(run("replay", frames, "--out", "o.ply", "--map", "o.yaml", "--rrd", "o.rrd"), code, *words)
    assert [path.name for path in tmp_path.iterdir()] == [frames.name]


def test_empty_folder(run: Run, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    one_line(run("replay", "empty"), 1, "empty", "scan.csv")


def test_cut_recording_is_read_up_to_the_cut(run: Run, small: Path, tmp_path: Path) -> None:
    data = small.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 6 // 10])
    said = run("replay", "cut.mcap", "--out", "o.ply")
    shots = int(said.out.split()[1])
    assert said.code == 0 and 2 <= shots <= 5
    assert f"{shots} shots before the cut were read" in said.out and f"from {shots} bearings" in said.out
    assert "cut at byte" in run("info", "cut.mcap").out


def test_recordings_that_are_none(run: Run, small: Path, tmp_path: Path) -> None:
    for data, words in ((b"", "empty"), (b"hello world", "no MCAP file"), (small.read_bytes()[:500], "first shot")):
        (tmp_path / "x.mcap").write_bytes(data)
        one_line(run("replay", "x.mcap", "--out", "o.ply", "--rrd", "o.rrd"), 1, words)
        assert [path.name for path in tmp_path.iterdir()] == ["x.mcap"]


def test_flipped_bytes_cost_their_shots(run: Run, small: Path, tmp_path: Path) -> None:
    data = bytearray(small.read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "flip.mcap").write_bytes(data)
    said = run("replay", "flip.mcap", "--out", "o.ply")
    assert said.code == 0 and "CRC" in said.out and "6 of 7 recorded shots" in said.out


# Trouble on the way


def test_an_error_nobody_foresaw_keeps_what_was_scanned(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = Job._recorded

    def breaking(self: Job) -> Iterator[Any]:
        for k, shot in enumerate(original(self)):
            if k == 4:
                raise ZeroDivisionError("of all things")
            yield shot

    monkeypatch.setattr(Job, "_recorded", breaking)
    said = run("scan", *QUICK, "--out", "a.ply")
    assert said.code == 1 and "ZeroDivisionError: of all things" in said.err and "--debug" in said.err
    assert said.err.count("\n") == 1 and "points from 4 bearings" in said.out
    assert (tmp_path / "a.ply").exists() and (tmp_path / "a.yaml").exists()
    assert "ended: error: ZeroDivisionError: of all things" in run("info", "a.mcap").out
    with pytest.raises(ZeroDivisionError):
        main(["scan", *QUICK, "--no-record", "--debug"])


def test_an_output_that_fails_costs_no_other(run: Run, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from scanmap.session import outputs

    real = outputs.write

    def full(scan: Any, path: Path, *more: Any) -> None:
        if path.suffix == ".pcd":
            raise OSError(28, "No space left on device")
        real(scan, path, *more)

    monkeypatch.setattr(outputs, "write", full)
    said = run("replay", small, "--out", "a.pcd", "--out", "a.ply")
    assert said.code == 1 and "NOT written a.pcd: No space left on device" in said.out and "wrote a.ply" in said.out


def test_full_disk_leaves_no_half_map(run: Run, small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Path.write_bytes

    def full(path: Path, data: bytes) -> int:
        if path.name.endswith(".yaml.part"):
            real(path, data[:10])
            raise OSError(28, "No space left on device")
        return real(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    one_line(run("map", small.with_suffix(".ply"), "--out", "m.yaml"), 2, "No space left")
    assert not list(tmp_path.iterdir())


def test_disk_with_too_little_room_leaves_nothing(run: Run, tmp_path: Path) -> None:
    one_line(run("scan", *QUICK, "--out", "a.ply", "--set", "recording.min_free_mb=1e12"), 1, "free", "--no-record")
    assert not list(tmp_path.iterdir())


def test_reader_that_has_gone_ends_no_scan(run: Run, small: Path, tmp_path: Path, monkeypatch: Any) -> None:
    class Gone:
        def write(self, text: str) -> int:
            raise BrokenPipeError(32, "Broken pipe")

        def flush(self) -> None:
            raise BrokenPipeError(32, "Broken pipe")

        def isatty(self) -> bool:
            return False

        def fileno(self) -> int:
            raise ValueError("none")

    monkeypatch.setattr(terminal.output, "silent", False)
    monkeypatch.setattr(sys, "stdout", Gone())
    assert run("replay", small, "--out", "o.ply").code == 0
    assert (tmp_path / "o.ply").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_output_that_cannot_be_printed_is_said() -> None:
    script = "from scanmap.cli import main; main(['config'])"
    with Path("/dev/full").open("w") as full:
        result = subprocess.run(
            [sys.executable, "-c", script], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert result.returncode == 1 and result.stderr.count("\n") == 1 and "No space left" in result.stderr


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-c", "from scanmap.cli import main; main()", *words]
    return subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_in_mid_scan_keeps_everything(run: Run, tmp_path: Path, number: signal.Signals) -> None:
    fine = [word.replace("step_deg=30", "step_deg=0.1") for word in QUICK]
    process = start(tmp_path, "scan", *fine, "--out", "a.ply", "--rrd", "a.rrd")
    recording = tmp_path / "a.mcap"
    until = time.monotonic() + 60
    while time.monotonic() < until and not (recording.exists() and recording.stat().st_size > 100_000):
        time.sleep(0.05)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and not err
    assert "stopping: the head parks" in out and "interrupted after " in out
    assert "next: scanmap scan --resume a.mcap --out a.ply" in out
    assert {"a.ply", "a.yaml", "a.pgm", "a.rrd", "a.mcap"} == {path.name for path in tmp_path.iterdir()}
    about = run("info", recording).out
    assert "ended: interrupted" in about and about.endswith(f"next: scanmap scan --resume {recording}\n")
    assert run("replay", recording, "--out", "again.ply").code == 0
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()


def test_interrupt_while_opening_leaves_nothing(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from scanmap.session import preparing

    def impatient(*_: Any) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(1)

    monkeypatch.setattr(preparing, "_recorder", impatient)
    said = run("scan", *QUICK, "--out", "a.ply", "--rrd", "a.rrd")
    one_line(said, 130, "interrupted")
    assert not list(tmp_path.iterdir())


def test_debug_is_only_scanmaps_own(run: Run, small: Path) -> None:
    run("info", small, "--debug")
    assert logging.getLogger("scanmap").getEffectiveLevel() == logging.DEBUG
    assert logging.getLogger("trimesh").getEffectiveLevel() == logging.WARNING
    from scanmap.errors import ConfigError

    with pytest.raises(ConfigError):
        main(["info", "nothing", "--debug"])


def test_live_progress_is_a_line_now_and_then_where_no_bar_can_be(capsys: Any, monkeypatch: Any) -> None:
    from scanmap.cli import report

    clock = iter([0.0, 1.0, 11.0, 12.0])
    monkeypatch.setattr(report.time, "monotonic", lambda: next(clock))
    with report.progress_bar("scanning", 100) as move:
        for done in (1, 10, 11):
            move(session.Progress(done, 100, 9.0, 200, 240))
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["scanning 10/100, 99 s left, bearing 9.00 deg, 200/240 rows"]


def test_bar_on_a_terminal_moves_and_ends(small: Path, tmp_path: Path) -> None:
    pty = pytest.importorskip("pty")
    leader, follower = pty.openpty()
    command = [sys.executable, "-c", "from scanmap.cli import main; main()", "replay", str(small), "--out", "a.ply"]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "80", "LINES": "24"}
    process = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=follower, stderr=subprocess.PIPE)
    os.close(follower)
    watch = threading.Timer(60, process.kill)
    watch.start()
    shown = b""
    try:
        while piece := os.read(leader, 65536):
            shown += piece
    except OSError:  # Linux's way of saying that the other end is closed
        pass
    _, err = process.communicate(timeout=60)
    watch.cancel()
    os.close(leader)
    assert process.returncode == 0 and not err
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown.decode())
    assert "7/7 0:00:00 left, bearing 180.00 deg" in text and "wrote a.ply" in text
    assert max(len(line) for line in re.split(r"[\r\n]+", text)) <= 80


@pytest.mark.skipif(os.name != "posix", reason="names of files are bytes on POSIX only")
def test_a_name_that_is_no_text_is_readable_in_messages_and_refused_for_outputs(run: Run, twin_scan: TwinScan) -> None:
    name = os.fsdecode(b"r\xffoom")
    said = run("scan", *QUICK, "--out", f"{name}.ply")
    assert said.code == 2 and "r\\xffoom.ply: maps and recordings name files in UTF-8" in said.err
    assert not list(Path().iterdir())
    shutil.copy(twin_scan.recording, f"{name}.mcap")
    said = run("info", f"{name}.mcap")
    assert said.code == 0 and "recording r\\xffoom.mcap: " in said.out
    assert "r\\xffoom.mcap is complete" in run("scan", "--resume", f"{name}.mcap").err


def test_what_a_terminal_has_no_sign_for_is_written_as_an_escape() -> None:
    assert terminal.printable("wall \u2013 \udcff \ud800", "ascii") == r"wall \u2013 \udcff \ud800"
    assert terminal.printable("caf\u00e9 \udcff", "utf-8") == "caf\u00e9 \\xff"
