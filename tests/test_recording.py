"""Laws of a recording: what goes in comes out bit for bit, for us and for everybody else's readers."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recorded_shots import CALIBRATION, START_NS, made_up_shots, record

from scanmap.calibration import Calibration
from scanmap.errors import CalibrationError, RecordingError
from scanmap.recording import Recorder, RecordingParams, describe, messages, open_source, whole_ns
from scanmap.recording.definitions import DEFINITIONS
from scanmap.shot import Shot

finite = st.floats(allow_nan=False, allow_infinity=False)
seconds = st.floats(0, 1e6)
images = st.binary(max_size=300)
any_shot = st.builds(
    Shot,
    index=st.integers(0, 2**32 - 1),
    bearing=finite,
    bearing_commanded=finite,
    time=seconds,
    image=images,
    background=st.none() | images,
)


@settings(max_examples=60, deadline=None)
@given(shots=st.lists(any_shot, min_size=1, max_size=6))
def test_replay_is_what_write_gave_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, shots: list[Shot]
) -> None:
    path = tmp_path_factory.mktemp("law") / "scan.mcap"
    with Recorder(path, calibration=CALIBRATION, source="rig", params=RecordingParams(min_free_mb=0)) as recorder:
        live = [recorder.write(shot) for shot in shots]
    source = open_source(path)
    assert list(source.shots()) == live
    assert source.faults == []
    assert source.count == len(shots)
    for given_, kept in zip(shots, live, strict=True):
        assert (given_.image, given_.background) == (kept.image, kept.background)
        assert (given_.bearing, given_.bearing_commanded) == (kept.bearing, kept.bearing_commanded)
        assert kept.time == whole_ns(given_.time)


@given(seconds)
def test_a_time_in_whole_nanoseconds_stays_as_it_is(time: float) -> None:
    kept = whole_ns(time)
    assert abs(kept - time) <= 0.5e-9 + np.spacing(time)
    assert whole_ns(kept) == kept


def test_times_at_which_nothing_moves_on_keep_shots_apart(tmp_path: Path) -> None:
    shots = [Shot(i, float(i), float(i), 0.0, bytes([i]), bytes([100 + i])) for i in range(5)]
    assert list(open_source(record(tmp_path / "a.mcap", shots)).shots()) == shots


def test_what_came_along_is_there_again(tmp_path: Path) -> None:
    path = tmp_path / "scan.mcap"
    plan = {"step_deg": 1.0, "passes": ["forward", "back"]}
    with Recorder(
        path, calibration=CALIBRATION, source="digital twin", rig_toml="[sweep]\nstep_deg = 1.0\n", plan=plan,
        metadata={"firmware": "Grbl 1.1h"},
    ) as recorder:  # fmt: skip
        for shot in made_up_shots(7):
            recorder.write(shot)
        recorder.fault("no picture within 2 s; asked again", part="camera", seconds=0.25, details={"tries": "2"})
    source = open_source(path)
    assert source.is_twin
    assert source.end_reason == "finished"
    assert source.rig_toml == "[sweep]\nstep_deg = 1.0\n"
    assert source.calibration_toml == CALIBRATION.dumps()
    assert source.calibration().dumps() == CALIBRATION.dumps()
    assert source.metadata["firmware"] == "Grbl 1.1h"
    info = describe(path)
    assert (info.kind, info.source, info.shots, info.end_reason, info.cut_at) == (
        "recording", "digital twin", 7, "finished", None,
    )  # fmt: skip
    assert info.plan == plan
    assert info.versions["scanmap_version"]
    assert info.has_calibration
    assert info.has_rig
    assert 0.6 <= info.duration_s < 0.61
    assert info.size_bytes == path.stat().st_size
    assert [(fault.part, fault.level, fault.message) for fault in info.faults] == [
        ("camera", 1, "no picture within 2 s; asked again")
    ]
    assert info.topics["/camera/image/compressed"] == ("sensor_msgs/msg/CompressedImage", 7)
    assert info.topics["/joint_states"] == ("sensor_msgs/msg/JointState", 7)


@pytest.mark.parametrize(
    ("error", "reason"),
    [(KeyboardInterrupt(), "interrupted"), (SystemExit(143), "interrupted"), (ValueError("stage"), "error: stage")],
)
def test_why_it_ended_is_noted_and_everything_before_is_there(
    tmp_path: Path, error: BaseException, reason: str
) -> None:
    shots = made_up_shots(3)
    with pytest.raises(type(error)), Recorder(tmp_path / "a.mcap", calibration=CALIBRATION, source="rig") as recorder:
        for shot in shots:
            recorder.write(shot)
        raise error
    source = open_source(tmp_path / "a.mcap")
    assert source.end_reason == reason
    assert list(source.shots()) == shots


def test_every_shot_is_readable_before_the_recording_ends(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    shots = made_up_shots(4, off=True)
    recorder = Recorder(path, calibration=CALIBRATION, source="rig")
    for done, shot in enumerate(shots, 1):
        recorder.write(shot)
        assert list(open_source(path).shots()) == shots[:done]
    recorder.close("interrupted")
    recorder.close()
    assert open_source(path).end_reason == "interrupted"
    with pytest.raises(RecordingError, match="closed"):
        recorder.write(shots[0])


def test_a_recording_is_never_replaced_by_accident(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", made_up_shots(2))
    before = path.read_bytes()
    with pytest.raises(RecordingError, match=r"exists already.*--record"):
        Recorder(path, calibration=CALIBRATION, source="rig")
    assert path.read_bytes() == before
    record(path, made_up_shots(1), overwrite=True)
    assert describe(path).shots == 1


def test_where_nothing_can_be_written_it_says_so(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file"):
        Recorder(tmp_path / "missing" / "a.mcap", calibration=CALIBRATION, source="rig")


def test_others_readers_read_every_message(tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    shots = made_up_shots(5, off=True)
    path = record(tmp_path / "a.mcap", shots)
    seen: dict[str, list[object]] = {}
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            seen.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    stamps = [START_NS + round(shot.time * 1e9) for shot in shots]
    for topic, images in (("/camera/image/compressed", [s.image for s in shots]),
                          ("/camera/off/compressed", [s.background for s in shots])):  # fmt: skip
        assert [m.data.tobytes() for m in seen[topic]] == images
        assert [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in seen[topic]] == stamps
        assert {m.format for m in seen[topic]} == {"jpeg"}
    joints = seen["/joint_states"]
    assert all(m.name == ["head", "head_commanded"] for m in joints)
    assert [tuple(m.position) for m in joints] == [(s.bearing, s.bearing_commanded) for s in shots]
    info = seen["/camera/camera_info"][0]
    assert (info.width, info.height) == (64, 48)
    assert np.array_equal(info.k.reshape(3, 3), CALIBRATION.intrinsics.matrix)
    # Pictures are as the lens made them; P is what a rectified one would have: the same camera, no second eye.
    assert np.array_equal(info.p.reshape(3, 4), np.hstack([CALIBRATION.intrinsics.matrix, np.zeros((3, 1))]))
    assert np.array_equal(info.r.reshape(3, 3), np.eye(3))
    assert (info.distortion_model, info.d.tolist()) == ("plumb_bob", list(CALIBRATION.intrinsics.distortion))


def test_the_mcap_library_finds_every_crc_right_and_all_that_came_along(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    shots = made_up_shots(7, off=True)
    path = record(tmp_path / "a.mcap", shots, rig_toml="[sweep]\nstep_deg = 1.0\n", plan={"shots": "7"})
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        counts = {c.topic: summary.statistics.channel_message_counts.get(k, 0) for k, c in summary.channels.items()}
        kept = {a.name: a.data.decode() for a in reader.iter_attachments()}
        metadata = {record.name for record in reader.iter_metadata()}
        messages = list(reader.iter_messages())
    assert counts["/camera/image/compressed"] == counts["/camera/off/compressed"] == counts["/joint_states"] == 7
    assert len(messages) == summary.statistics.message_count == sum(counts.values())
    assert len({message.log_time for _, channel, message in messages if channel.topic == "/joint_states"}) == 7
    assert kept["rig.toml"] == "[sweep]\nstep_deg = 1.0\n"
    assert Calibration.loads(kept["calibration.toml"]).dumps() == CALIBRATION.dumps()
    assert metadata and summary.statistics.metadata_count >= len(metadata)


def test_static_transforms_place_the_camera_where_the_calibration_does(tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader
    from scipy.spatial.transform import Rotation

    path = record(tmp_path / "a.mcap", made_up_shots(1))
    with AnyReader([path]) as reader:
        (message,) = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages() if c.topic == "/tf_static"]
    T = {}
    for link in message.transforms:
        q, t = link.transform.rotation, link.transform.translation
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        matrix[:3, 3] = t.x, t.y, t.z
        T[link.header.frame_id, link.child_frame_id] = matrix
    assert np.allclose(T["head", "camera"], CALIBRATION.T_head_camera, atol=1e-12)
    assert np.allclose(T["head_axis", "head"], CALIBRATION.mount.T_axis_head(), atol=1e-12)
    assert np.allclose(T["world", "head_base"], np.eye(4))


def test_the_rerun_viewer_takes_the_file_as_it_is(tmp_path: Path) -> None:
    rerun = shutil.which("rerun", path=str(Path(sys.executable).parent))
    if rerun is None:
        pytest.skip("no rerun binary beside this Python")
    path = record(tmp_path / "a.mcap", made_up_shots(6, off=True))
    check = subprocess.run([rerun, "mcap", "check", path], capture_output=True, text=True, check=False)
    assert check.returncode == 0, check.stderr
    healthy = [line for line in check.stdout.splitlines() if line.startswith("ok")]
    assert len(healthy) == 5, check.stdout


def test_a_full_disk_stops_the_scan_and_keeps_what_was_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    shots = made_up_shots(9)
    recorder = Recorder(path, calibration=CALIBRATION, source="rig")
    for shot in shots[:5]:
        recorder.write(shot)
    room = 1000  # of the 3 kB of the next shot

    class FullDisk:
        def __init__(self, raw: object) -> None:
            self.raw = raw

        def write(self, data: memoryview) -> int:
            nonlocal room
            if room == 0:
                raise OSError(28, "No space left on device")
            part, room = data[:room], 0
            return self.raw.write(part)

        def __getattr__(self, name: str) -> object:
            return getattr(self.raw, name)

    monkeypatch.setattr(recorder._file, "_raw", FullDisk(recorder._file._raw))
    with pytest.raises(RecordingError, match="stopped after 5 shots: No space left"):
        recorder.write(shots[5])
    recorder.close("error: disk full")
    source = open_source(path)
    assert list(source.shots()) == shots[:5]
    assert source.end_reason == "cut"
    assert describe(path).cut_at == path.stat().st_size  # no half chunk is left behind


def test_times_between_nanoseconds_come_back_as_write_said(tmp_path: Path) -> None:
    shot = Shot(0, 0.0, 0.0, 0.1234567894321, b"on")
    with Recorder(tmp_path / "a.mcap", calibration=CALIBRATION, source="rig") as recorder:
        kept = recorder.write(shot)
    assert kept.time == 0.123456789
    assert list(open_source(tmp_path / "a.mcap").shots()) == [kept]


def test_free_disk_is_checked_before_and_during(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = 10**9

    def disk_usage(_: Path) -> object:
        return shutil._ntuple_diskusage(10**10, 0, free)

    monkeypatch.setattr(shutil, "disk_usage", disk_usage)
    shots = made_up_shots(4)
    with pytest.raises(RecordingError, match="2 shots are recorded"), Recorder(
        tmp_path / "a.mcap", calibration=CALIBRATION, source="rig"
    ) as recorder:  # fmt: skip
        recorder.write(shots[0])
        free = 199_000_000
        recorder.write(shots[1])
    assert list(open_source(tmp_path / "a.mcap").shots()) == shots[:2]
    assert open_source(tmp_path / "a.mcap").end_reason.startswith("error: disk")
    with pytest.raises(RecordingError, match="199 MB free"):
        Recorder(tmp_path / "b.mcap", calibration=CALIBRATION, source="rig")
    assert not (tmp_path / "b.mcap").exists()
    free = 10**9
    with Recorder(tmp_path / "c.mcap", calibration=CALIBRATION, source="rig", expected_shots=10**6) as recorder:
        with pytest.raises(RecordingError, match="still to come"):
            recorder.write(shots[0])
        recorder.close()


def test_reading_does_not_pile_up_in_memory(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", made_up_shots(200, image_bytes=100_000))
    source = open_source(path)
    tracemalloc.start()
    assert sum(1 for _ in source.shots()) == 200
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2e6  # of the 20 MB in the file


def test_a_recording_without_a_calibration_says_how_to_give_one(tmp_path: Path) -> None:
    source = open_source(record(tmp_path / "a.mcap", made_up_shots(1)))
    source.calibration_toml = ""
    assert not source.has_calibration
    with pytest.raises(CalibrationError, match="--calibration"):
        source.calibration()


def test_a_description_in_words(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", made_up_shots(4, off=True), plan={"step_deg": 1.0})
    lines = describe(path).lines
    assert lines[0].startswith(f"recording {path}: 4 shots, 0.3 s, 0.0 MB")
    assert "source: digital twin; its room is made up" in lines
    assert "ended: finished" in lines
    assert "carries: calibration" in lines
    assert "plan step_deg: 1.0" in lines
    assert "topic /camera/off/compressed: 4 sensor_msgs/msg/CompressedImage" in lines
    path.write_bytes(path.read_bytes()[:-100])
    assert any(line.startswith("ended: cut at byte") for line in describe(path).lines)


def test_plans_of_others_are_shown_as_they_are(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", made_up_shots(1), metadata={"note": "ü"}, plan={"bearings": [0, 1]})
    assert json.dumps(describe(path).plan) == '{"bearings": [0, 1]}'
    assert describe(path).versions["note"] == "ü"


@pytest.mark.parametrize("release", ["ROS2_HUMBLE", "ROS2_KILTED", "LATEST"])
def test_messages_are_those_of_ros(release: str) -> None:
    from rosbags.typesys import Stores, get_typestore

    theirs = get_typestore(Stores[release])
    for name in DEFINITIONS:
        assert messages.definition(name).decode() == theirs.generate_msgdef(name, ros_version=2)[0]
