"""`scan --resume`: the parts of a scan equal one in a single go, or it says why it will not go on."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from scanmap import config as configuration
from scanmap import session
from scanmap.errors import ConfigError, ScanmapError, StageError
from scanmap.recording import RecordingParams, describe, open_source
from scanmap.session import preparing
from scanmap.session.rigs import OpenRig, open_rig
from scanmap.sweep import plan

pytestmark = pytest.mark.usefixtures("baked_once")

QUICK = ("calibration.image.width=320", "calibration.image.height=240", "sweep.step_deg=20")
SWITCH = ("stage.homing='switch'", "twin.drive.switch_deg=-3.0", "stage.home_deg=-2")


def scan(folder: Path, *settings: str, shots: int = 1000) -> Path:
    """Scan the twin, interrupted after about so many shots; its recording."""
    outputs = session.Outputs((folder / "a.ply",), record=folder / "a.mcap")
    with session.prepare_scan(session.Choice("twin-quick", (*QUICK, *settings)), outputs, view=False) as job:
        job.run(lambda _: None, lambda: job.done + 1 >= shots)
    return folder / "a.mcap"


def resume(recording: Path, *settings: str) -> session.Job:
    outputs = session.Outputs((recording.with_name("b.ply"),))
    job = session.prepare_scan(session.Choice(settings=settings), outputs, view=False, resume=recording)
    with job:
        assert job.run(lambda _: None, lambda: False).ended == "finished"
    return job


def replayed(recording: Path, name: str) -> bytes:
    outputs = session.Outputs((recording.with_name(name),))
    with session.prepare_replay(recording, session.Choice(), outputs) as job:
        job.run(lambda _: None, lambda: False)
    return recording.with_name(name).read_bytes()


@pytest.mark.parametrize(
    "settings",
    [
        (),
        SWITCH,
        ("sweep.passes='forward-backward'", "sweep.off_frames=true"),
        ("sweep.mode='adaptive'", "sweep.fine_deg=5", "sweep.step_deg=15"),
    ],
    ids=["hand", "switch", "passes", "adaptive"],
)
def test_two_parts_equal_one_scan_bit_for_bit(tmp_path: Path, settings: tuple[str, ...]) -> None:
    (tmp_path / "whole").mkdir()
    whole = scan(tmp_path / "whole", *settings)
    first = scan(tmp_path, *settings, shots=4)
    before = first.read_bytes()
    there = len(list(open_source(first).shots()))
    job = resume(first)
    assert first.read_bytes() == before
    assert any("homed" in line or "was recognised" in line for line in job.announcement)
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "whole" / "a.ply").read_bytes()
    assert replayed(first, "c.ply") == (tmp_path / "b.ply").read_bytes()
    part = tmp_path / "a.part2.mcap"
    assert [shot.index for shot in open_source(part).shots()] == list(range(there, job.done))
    times = [shot.time for shot in open_source(first).shots()]
    assert times == sorted(times)
    info = describe(first)
    assert info.shots == job.done and info.end_reason == "finished"
    assert [shots for _, shots in info.parts] == [there, job.done - there]
    assert 0 < info.duration_s < describe(whole).duration_s + 10  # the time between the parts does not count


def test_what_to_do_next_is_said_of_the_whole_scan_not_of_its_last_part(tmp_path: Path) -> None:
    first, said = tmp_path / "a.mcap", []
    for begun, shots in ((None, 3), (first, 5), (first, 1000)):
        outputs = session.Outputs((tmp_path / "a.ply",), record=None if begun else first)
        choice = session.Choice(None if begun else "twin-quick", () if begun else QUICK)
        with session.prepare_scan(choice, outputs, view=False, resume=begun) as job:
            said.append(job.run(lambda _: None, lambda job=job, shots=shots: job.done + 1 >= shots).next_commands)
    assert (tmp_path / "a.part3.mcap").exists()
    assert said[0] == said[1] and said[0][1:] == said[2]
    assert said[0][0] == f"scanmap scan --resume {first} --out {tmp_path / 'a.ply'}"
    assert all(str(first) in command and "part" not in command for command in said[2])


def test_shots_lost_to_damage_are_taken_again(tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    scan(tmp_path / "whole")
    first = scan(tmp_path, shots=6)
    data = bytearray(first.read_bytes())
    data[data.index(list(open_source(first).shots())[2].image) + 500] ^= 1
    first.write_bytes(data)
    resume(first)
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "whole" / "a.ply").read_bytes()
    assert next(iter(open_source(tmp_path / "a.part2.mcap").shots())).index == 2


def test_three_parts_and_a_part_without_a_shot(tmp_path: Path) -> None:
    first = scan(tmp_path, shots=3)
    with session.prepare_scan(session.Choice(), session.Outputs(), view=False, resume=first) as job:
        job.run(lambda _: None, lambda: job.done >= 6)
    (tmp_path / "a.part3.mcap").write_bytes(first.read_bytes()[:700])
    job = resume(first)
    assert job.outputs.record == tmp_path / "a.part4.mcap"
    source = open_source(first)
    assert [shot.index for shot in source.shots()] == list(range(10))
    assert len(source.parts) == 3 and any("part3" in fault for fault in source.faults)


def test_a_part_of_another_scan_is_left_out(tmp_path: Path) -> None:
    first = scan(tmp_path, shots=3)
    (tmp_path / "other").mkdir()
    scan(tmp_path / "other", shots=3).rename(tmp_path / "a.part2.mcap")
    source = open_source(first)
    assert len(list(source.shots())) == source.count
    assert any("another scan" in fault for fault in source.faults)


def turned(deg: float, monkeypatch: pytest.MonkeyPatch) -> list[OpenRig]:
    """Let the twin's head stand elsewhere when its board is switched on again; gives the rig when it is opened."""
    opened: list[OpenRig] = []

    def open_turned(config: configuration.Config, *rest: Any) -> OpenRig:
        drive = config.twin.drive.model_copy(update={"head_deg": deg})
        twin = config.twin.model_copy(update={"drive": drive})
        opened.append(open_rig(config.model_copy(update={"twin": twin}), *rest))
        return opened[-1]

    monkeypatch.setattr(preparing, "open_rig", open_turned)
    return opened


@pytest.mark.parametrize("deg", [0.35, 23.0, -1.5])
def test_a_head_left_elsewhere_is_found_by_the_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, deg: float
) -> None:
    """After a power cut the board believes the head at home, wherever it stands."""
    first = scan(tmp_path, "sweep.step_deg=4", "sweep.end_deg=48", shots=8)
    opened = turned(deg, monkeypatch)
    with session.prepare_scan(session.Choice(), session.Outputs(), view=False, resume=first) as job:
        assert job.run(lambda _: None, lambda: False).ended == "finished"
        assert opened[0].twin is not None
        board = opened[0].twin.firmware
        off = math.degrees(opened[0].rig.stage.where()) - board.drivetrain.bearing_deg
        assert abs(off) < 0.15  # where the head is said to stand, and where it stands


def test_a_head_that_nothing_recognises_goes_nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = scan(tmp_path, "sweep.step_deg=4", shots=12)
    turned(150.0, monkeypatch)
    with pytest.raises(StageError, match=r"is not found in .*turn it by hand to 0 deg.*switch or index mark"):
        resume(first)
    assert not (tmp_path / "a.part2.mcap").exists()


def test_a_room_too_dark_to_be_recognised_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = scan(tmp_path, "twin.room='box'", "twin.light.ambient=0.0", shots=5)
    turned(50.0, monkeypatch)
    with pytest.raises(StageError, match=r"too dark or plain to be recognised"):
        resume(first)


REFUSED: list[tuple[Callable[[Path], Path], tuple[str, ...], str]] = [
    (scan, (), "is complete, 10 shots: scanmap replay"),
    (lambda folder: scan(folder, "sweep.mode='adaptive'", "sweep.step_deg=90", "sweep.fine_deg=45"), (), "is complete"),
    (lambda folder: scan(folder, shots=3), ("sweep.step_deg=5",), "goes on with the settings it began with"),
    (lambda folder: folder / "nothing.mcap", (), "not the recording"),
    (lambda folder: scan(folder, shots=3).rename(folder / "a.part2.mcap"), (), "the file that the scan began in"),
]


@pytest.mark.parametrize(("make", "settings", "words"), REFUSED)
def test_what_cannot_be_gone_on_with_is_refused_and_leaves_nothing(
    tmp_path: Path, make: Callable[[Path], Path], settings: tuple[str, ...], words: str
) -> None:
    recording = make(tmp_path)
    there = sorted(tmp_path.iterdir())
    with pytest.raises(ConfigError, match=words):
        resume(recording, *settings)
    assert sorted(tmp_path.iterdir()) == there


def test_a_scan_whose_file_alone_lost_its_end_is_recovered_not_gone_on_with(tmp_path: Path) -> None:
    path = scan(tmp_path)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ConfigError, match=r"complete but for its end, .* 10 shots: scanmap recover .*a\.mcap, or"):
        resume(path)
    assert session.describe(path)[-1] == f"next: scanmap recover {path}"
    assert session.recover(path)[0].endswith("10 shots, whole; " + f"{path} is as it was")
    assert not any(line.startswith("next") for line in session.describe(tmp_path / "a.whole.mcap"))


CONTINUOUS = ("sweep.mode='continuous'", "sweep.step_deg=2", "sweep.end_deg=30", "sweep.passes=2")


def test_a_continuous_sweep_goes_on_where_it_was_left(tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    whole = scan(tmp_path / "whole", *CONTINUOUS)
    first = scan(tmp_path, *CONTINUOUS, shots=20)
    there = [shot.index for shot in open_source(first).shots()]
    job = resume(first)
    assert any("was recognised" in line for line in job.announcement)
    source = open_source(first)
    ours, theirs = ({shot.index: shot.bearing for shot in of.shots()} for of in (source, open_source(whole)))
    assert len(there) < len(ours) == describe(first).shots
    slots = len(plan(job.config.sweep, job.config.stage.limits).bearings) // 2
    # Whether a picture falls into the slots where the head speeds up and slows down, chance decides.
    assert {index % slots for index in ours.keys() ^ theirs.keys()} <= {0, slots - 1}
    assert len(ours.keys() & theirs.keys()) >= 2 * slots - 4
    for index in ours.keys() & theirs.keys():
        assert abs(ours[index] - theirs[index]) < math.radians(0.2 + 0.02)  # a picture later, a little off
    with pytest.raises(ConfigError, match="is complete"):
        resume(first)


def test_shots_of_a_head_that_lost_its_place_are_taken_back_and_taken_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps that are lost a few at a time show only when the head is back where it began."""
    (tmp_path / "whole").mkdir()
    settings = ("sweep.step_deg=3", "sweep.end_deg=30")
    scan(tmp_path / "whole", *settings)

    def open_slipping(*words: Any) -> OpenRig:
        opened = open_rig(*words)
        assert opened.twin is not None
        drive = opened.twin.firmware.drivetrain
        follow = drive.follow

        def slipping(steps: int) -> None:
            forward = steps - drive._counted
            follow(steps)
            if forward > 0:
                drive.slip(round(0.15 * forward))

        drive.follow = slipping  # type: ignore[method-assign]
        return opened

    monkeypatch.setattr(preparing, "open_rig", open_slipping)
    outputs = session.Outputs((tmp_path / "a.ply",), record=tmp_path / "a.mcap")
    with session.prepare_scan(session.Choice("twin-quick", (*QUICK, *settings)), outputs, view=False) as job:
        result = job.run(lambda _: None, lambda: False)
    assert "10 shots cannot be trusted and are left out" in str(result.error) and len(result.scan) == 1
    monkeypatch.undo()
    first = tmp_path / "a.mcap"
    assert describe(first).shots == 11
    assert any("10 shots withdrawn" in line and line.endswith("1 to 10") for line in describe(first).lines)
    source = open_source(first)
    assert [shot.index for shot in source.shots()] == [0] and source.count == 1
    assert any("10 shots that the sweep took back are left out" in fault for fault in source.faults)
    all_of_them = open_source(first, RecordingParams(withdrawn="keep"))
    assert len(list(all_of_them.shots())) == 11
    resume(first)
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "whole" / "a.ply").read_bytes()
    assert replayed(first, "c.ply") == (tmp_path / "b.ply").read_bytes()
    lines = session.recover(first)
    assert lines[0].startswith(f"wrote {tmp_path / 'a.whole.mcap'}: 11 shots")
    assert replayed(tmp_path / "a.whole.mcap", "d.ply") == (tmp_path / "b.ply").read_bytes()


def test_a_scan_without_a_laser_is_gone_on_with_by_its_pictures_of_the_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "whole").mkdir()
    scan(tmp_path / "whole", "sweep.off_frames=true")

    def open_dead(*words: Any) -> OpenRig:
        opened = open_rig(*words)
        assert opened.twin is not None
        opened.twin.firmware.laser_dead = True
        return opened

    monkeypatch.setattr(preparing, "open_rig", open_dead)
    first = scan(tmp_path, "sweep.off_frames=true")
    monkeypatch.undo()
    assert list(open_source(first).shots()) == []
    job = resume(first)
    assert any("was recognised" in line for line in job.announcement)
    whole = open_source(tmp_path / "whole" / "a.mcap")
    assert [shot.bearing for shot in open_source(first).shots()] == [shot.bearing for shot in whole.shots()]


def test_a_bag_of_others_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from recorded_shots import made_up_shots, record

    with pytest.raises(ScanmapError, match="only scanmap's own"):
        resume(record(tmp_path / "a.mcap", made_up_shots(3)))


def test_recover_joins_parts_and_saves_what_a_cut_left(tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    scan(tmp_path / "whole")
    first = scan(tmp_path, shots=6)
    first.write_bytes(first.read_bytes()[: -len(first.read_bytes()) // 3])
    resume(first)
    before = first.read_bytes()
    lines = session.recover(first)
    joined = tmp_path / "a.whole.mcap"
    assert first.read_bytes() == before and lines[0].startswith(f"wrote {joined}: 10 shots")
    assert any("is cut at byte" in line for line in lines) and "ended: finished" in lines
    source = open_source(joined)
    assert list(source.shots()) == list(open_source(first).shots()) and not source.faults
    assert replayed(joined, "d.ply") == (tmp_path / "whole" / "a.ply").read_bytes()
    with pytest.raises(ScanmapError, match="exists and is not overwritten"):
        session.recover(first)
    with pytest.raises(ConfigError, match="whole, there is nothing to recover"):
        session.recover(joined, tmp_path / "e.mcap")
    assert not (tmp_path / "e.mcap").exists()
    with pytest.raises(ConfigError, match=r"must end in \.mcap"):
        session.recover(first, tmp_path / "x.part2.mcap")
