"""Cuts and flipped bytes: everything before is read, nothing is ever read wrong."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recorded_shots import made_up_shots, record

from scanmap.errors import CalibrationError, ConfigError, RecordingError
from scanmap.recording import describe, open_source, recover
from scanmap.recording.mcap_records import CHUNK, MESSAGE_INDEX, Record, open_mcap, walk
from scanmap.recording.shot_file import ShotFile
from scanmap.shot import Shot


def chunk_ends(path: Path) -> list[int]:
    """Bytes at which the chunks end; the first holds no shot."""
    with open_mcap(path) as file:
        return [r.offset + r.length for r in walk(file) if isinstance(r, Record) and r.opcode == CHUNK]


def read(path: Path) -> tuple[list[Shot], list[str]]:
    """Shots and faults of a damaged file; nothing at all where it says that there is nothing."""
    try:
        source = open_source(path)
        return list(source.shots()), source.faults
    except RecordingError as error:
        return [], [str(error)]


@pytest.mark.parametrize("seed", range(20))
def test_every_shot_before_a_cut_is_read(tmp_path: Path, seed: int) -> None:
    shots = made_up_shots(8, off=True)
    whole = record(tmp_path / "whole.mcap", shots)
    data, ends = whole.read_bytes(), chunk_ends(whole)
    cut = int(np.random.default_rng(seed).integers(0, len(data) - 40))
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[:cut])
    before = sum(end <= cut for end in ends[1:])
    got, faults = read(path)
    assert got == shots[:before]
    assert len(faults) == 1
    if before:
        assert f"{before} shots before the cut" in faults[0]
        assert "is cut at byte" in faults[0]
        info = describe(path)
        assert info.shots == before
        assert info.cut_at is not None
        assert open_source(path).end_reason == "cut"
        assert open_source(path).count == before
        open_source(path).calibration()


@pytest.mark.parametrize("seed", range(60))
def test_a_flipped_byte_never_gives_a_wrong_image(tmp_path: Path, seed: int) -> None:
    shots = made_up_shots(6, off=True, image_bytes=400)
    path = record(tmp_path / "a.mcap", shots)
    data = bytearray(path.read_bytes())
    rng = np.random.default_rng(seed)
    at = int(rng.integers(8, len(data)))
    hit = sum(end <= at for end in chunk_ends(path)[1:])  # shots wholly before the damage
    data[at] ^= int(rng.integers(1, 256))
    path.write_bytes(data)
    got, faults = read(path)
    for shot in got:
        assert shot.image in [s.image for s in shots]
        original = next(s for s in shots if s.image == shot.image)
        assert (shot.bearing, shot.background) == (original.bearing, original.background)
        # without its metadata a file counts from its epoch, as those of others do
        assert shot.time == original.time or "metadata" in faults[0] or shot.time > 1e9
    assert len(got) >= len(shots) - 1
    assert [s.image for s in shots[:hit]] == [s.image for s in got[:hit]]
    if len(got) < len(shots):
        assert faults


def test_what_is_said_of_a_recording_survives_any_flipped_byte_of_its_indexes(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", made_up_shots(4))
    data, true = path.read_bytes(), describe(path)
    with open_mcap(path) as file:
        indexes = [r for r in walk(file) if isinstance(r, Record) and r.opcode == MESSAGE_INDEX]
    places = [at for index in indexes for at in range(index.offset, index.offset + index.length)]
    for at in places[::7]:
        path.write_bytes(data[:at] + bytes([data[at] ^ 0x41]) + data[at + 1 :])
        said = describe(path)
        assert (said.shots, said.duration_s, said.topics) == (true.shots, true.duration_s, true.topics), at


def test_damage_costs_its_own_shot_and_is_reported(tmp_path: Path) -> None:
    shots = made_up_shots(6)
    path = record(tmp_path / "a.mcap", shots)
    data = bytearray(path.read_bytes())
    data[data.index(shots[2].image) + 1000] ^= 1
    path.write_bytes(data)
    told: list[str] = []
    source = open_source(path)
    assert [shot.index for shot in source.shots(on_fault=told.append)] == [0, 1, 3, 4, 5]
    assert told == source.faults
    assert "CRC" in told[0]
    assert told[1] == "5 of 6 recorded shots could be read"
    assert list(source.shots()) == [s for s in shots if s.index != 2]
    assert len(source.faults) == 2


@pytest.mark.parametrize("length", [0, 1, 5000, 1 << 20, 1 << 62])
def test_a_wrong_length_is_stepped_over_by_the_index(tmp_path: Path, length: int) -> None:
    shots = made_up_shots(6)
    path = record(tmp_path / "a.mcap", shots)
    with open_mcap(path) as file:
        third = [r for r in walk(file) if isinstance(r, Record) and r.opcode == CHUNK][3]
    data = bytearray(path.read_bytes())
    data[third.offset - 8 : third.offset] = length.to_bytes(8, "little")
    path.write_bytes(data)
    got, faults = read(path)
    assert got == [s for s in shots if s.index != 2]
    assert "damaged" in faults[0]


def test_a_damaged_calibration_is_not_used(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", made_up_shots(2))
    data = bytearray(path.read_bytes())
    at = data.index(b"head_offset_m")
    data[at + 17] ^= 1
    path.write_bytes(data)
    source = open_source(path)
    assert not source.has_calibration
    assert "CRC" in source.faults[0]
    with pytest.raises(CalibrationError):
        source.calibration()
    assert len(list(source.shots())) == 2
    assert "CRC" in source.faults[0]


def test_damaged_metadata_is_not_believed(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", made_up_shots(3))
    path.write_bytes(path.read_bytes().replace(b"digital twin", b"digital tw1n", 1))
    source = open_source(path)
    assert source.metadata == {}
    assert "metadata 'scanmap': its CRC does not match" in source.faults[0]
    assert [s.image for s in source.shots()] == [s.image for s in made_up_shots(3)]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"solid cube", "is no MCAP file: it begins with b'solid cu'"),
        (b"\x89MCAP0\r\n", "before its first shot"),
    ],
)
def test_what_is_no_recording_is_told_in_one_line(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=message) as caught:
        open_source(path)
    assert "\n" not in str(caught.value)


def test_what_does_not_exist_names_what_can_be_replayed(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"does not exist.*\.mcap.*scan\.csv.*video"):
        open_source(tmp_path / "nothing.mcap")


@pytest.mark.parametrize("seed", range(8))
def test_recovery_makes_a_whole_file_of_what_is_whole(tmp_path: Path, seed: int) -> None:
    from rosbags.highlevel import AnyReader

    shots = made_up_shots(8, off=True)
    whole = record(tmp_path / "whole.mcap", shots, rig_toml="description = 'mine'")
    ends = chunk_ends(whole)
    rng = np.random.default_rng(seed)
    data = bytearray(whole.read_bytes())
    lost = int(rng.integers(0, 7))
    if seed % 2:
        data[data.index(shots[lost].image) + 100] ^= 255
        kept = [shot for shot in shots if shot.index != lost]
    else:
        del data[int(rng.integers(ends[lost + 1], ends[lost + 2])) :]
        kept = shots[: lost + 1]
    path, out = tmp_path / "broken.mcap", tmp_path / "saved.mcap"
    path.write_bytes(data)
    info = recover(path, out)
    assert path.read_bytes() == data
    assert (info.shots, info.cut_at, info.end_reason) == (len(kept), None, "finished" if seed % 2 else "cut")
    source = open_source(out)
    assert list(source.shots()) == kept
    assert source.rig_toml == "description = 'mine'"
    assert source.calibration().dumps() == open_source(whole).calibration().dumps()
    assert source.metadata == open_source(whole).metadata
    with AnyReader([out]) as reader:
        assert sum(1 for _ in reader.messages()) == 4 * len(kept) + 1
    with pytest.raises(RecordingError, match="exists already"):
        recover(path, out)


def test_a_recording_that_grows_is_read_as_far_every_time(tmp_path: Path) -> None:
    shots = made_up_shots(8)
    whole = record(tmp_path / "whole.mcap", shots).read_bytes()
    path = tmp_path / "growing.mcap"
    path.write_bytes(whole[: len(whole) // 2])
    source = open_source(path)
    first, faults = list(source.shots()), list(source.faults)
    path.write_bytes(whole)
    assert (list(source.shots()), source.faults) == (first, faults)
    assert 2 <= len(first) < 8 and "is cut at byte" in faults[0]
    assert list(open_source(path).shots()) == shots


def test_recovery_finds_the_topics_at_the_end_of_the_file(tmp_path: Path) -> None:
    shots = made_up_shots(3)
    path = record(tmp_path / "a.mcap", shots)
    data = bytearray(path.read_bytes())
    data[data.index(b"sensor_msgs/msg/CompressedImage")] ^= 1
    path.write_bytes(data)
    assert recover(path, tmp_path / "saved.mcap").shots == 3
    assert list(open_source(tmp_path / "saved.mcap").shots()) == shots


def test_recovery_leaves_whole_and_empty_files_alone(tmp_path: Path) -> None:
    whole = record(tmp_path / "whole.mcap", made_up_shots(2))
    with pytest.raises(ConfigError, match="is whole, there is nothing to recover"):
        recover(whole, tmp_path / "saved.mcap")
    (tmp_path / "begun.mcap").write_bytes(whole.read_bytes()[:600])
    with pytest.raises(RecordingError, match="no whole message"):
        recover(tmp_path / "begun.mcap", tmp_path / "saved.mcap")
    assert not (tmp_path / "saved.mcap").exists()


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_recovery_that_is_broken_off_leaves_no_half_of_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    path = record(tmp_path / "a.mcap", made_up_shots(5))
    path.write_bytes(path.read_bytes()[:-3000])

    def broken_off(*_: object) -> None:
        raise error

    monkeypatch.setattr(ShotFile, "sync", broken_off)
    with pytest.raises((KeyboardInterrupt, RecordingError)):
        recover(path, tmp_path / "saved.mcap")
    assert [each.name for each in tmp_path.iterdir()] == ["a.mcap"]


def test_a_killed_program_loses_no_shot_it_has_written(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    program = (
        "import sys; sys.path.insert(0, sys.argv[2])\n"
        "from recorded_shots import CALIBRATION, made_up_shots\n"
        "from scanmap.recording import Recorder\n"
        "recorder = Recorder(sys.argv[1], calibration=CALIBRATION, source='rig')\n"
        "for shot in made_up_shots(10000, image_bytes=100):\n"
        "    recorder.write(shot)\n"
        "    print(shot.index, flush=True)\n"
    )
    arguments = [sys.executable, "-c", program, str(path), str(Path(__file__).parent)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for _ in range(50):
            process.stdout.readline()
        process.send_signal(signal.SIGKILL)
        written = [50 + k for k, _ in enumerate(process.stdout, 1)][-1:] or [50]
    got, faults = read(path)
    assert written[0] <= len(got) <= written[0] + 1
    assert got == made_up_shots(10000, image_bytes=100)[: len(got)]
    assert "is cut" in faults[0]
