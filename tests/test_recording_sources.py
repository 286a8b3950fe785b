"""Folders of frames, videos with a csv, and bags that other robots recorded."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from recorded_shots import CALIBRATION, START_NS, made_up_shots, record

from scanmap.errors import ConfigError, RecordingError, ScanmapError
from scanmap.recording import RecordingParams, describe, open_source
from scanmap.rig.camera import CameraParams
from scanmap.rig.camera_files import open_files
from scanmap.shot import Shot, decode_image, encode_png, image_format
from scanmap.solvers.pictures import Picture, read_pictures

DATA = Path(__file__).parents[2] / "shared" / "data"


def write_folder(folder: Path, csv: str, names: list[str], off: tuple[str, ...] = ()) -> Path:
    (folder / "frames").mkdir(parents=True)
    for name in names:
        (folder / "frames" / name).write_bytes(b"on " + name.encode())
    for name in off:
        (folder / "off").mkdir(exist_ok=True)
        (folder / "off" / name).write_bytes(b"off " + name.encode())
    (folder / "scan.csv").write_text(csv)
    return folder


def test_a_folder_of_frames_by_name_and_by_number(tmp_path: Path) -> None:
    csv = "frame,bearing_deg,time_s\nstep_num1.jpg,-0.0,0.0\nstep_num2.jpg,-1.125,1.0\n\n7,90,2.5\n8,180,3.5\n"
    csv += "9,185,4.5\n010,190,5.5\n"
    names = ["step_num1.jpg", "step_num2.jpg", "000007.jpg", "000008.png", "9.JPG", "010.jpeg"]
    folder = write_folder(tmp_path / "scan", csv, names, off=("step_num2.jpg", "000007.jpg"))
    CALIBRATION.save(folder / "calibration.toml")
    source = open_source(folder)
    shots = list(source.shots())
    assert [s.image for s in shots] == [f"on {name}".encode() for name in names]
    assert [s.background for s in shots[:4]] == [None, b"off step_num2.jpg", b"off 000007.jpg", None]
    assert np.allclose([s.bearing for s in shots], np.radians([0, -1.125, 90, 180, 185, 190]), rtol=0, atol=1e-15)
    assert [s.bearing_commanded for s in shots] == [s.bearing for s in shots]
    assert [s.time for s in shots] == [0.0, 1.0, 2.5, 3.5, 4.5, 5.5]
    assert [s.index for s in shots] == [0, 1, 2, 3, 4, 5]
    assert source.count == 6
    assert len(source.faults) == 4  # four pictures with the laser off are not there
    assert source.calibration().dumps() == CALIBRATION.dumps()
    assert (describe(folder).kind, describe(folder).shots, describe(folder).has_calibration) == ("frames", 6, True)


SPREADSHEETS = {
    "semicolon and decimal comma": "frame;bearing_deg;time_s\r\na,1.jpg;22,5;0,25\r\n",
    "tab": "frame\tbearing_deg\ttime_s\na,1.jpg\t22.5\t0,25\n",
    "quotes": 'time_s,note,bearing_deg,frame\n0.25,"x;y;z",22.5,"a,1.jpg"\n',
    "with the folder": 'frame,bearing_deg,time_s\n"frames/a,1.jpg",22.5,0.25\n',
}


@pytest.mark.parametrize("kind", SPREADSHEETS)
def test_a_csv_may_be_written_as_spreadsheets_write_it(tmp_path: Path, kind: str) -> None:
    folder = write_folder(tmp_path / "scan", SPREADSHEETS[kind], ["a,1.jpg"], off=("a,1.jpg",))
    (shot,) = open_source(folder).shots()
    assert (shot.bearing, shot.time) == (np.radians(22.5), 0.25)
    assert (shot.image, shot.background) == (b"on a,1.jpg", b"off a,1.jpg")


def test_scans_side_by_side_in_a_folder_are_not_taken_for_one(tmp_path: Path) -> None:
    record(tmp_path / "hall.mcap", made_up_shots(3))
    record(tmp_path / "room.mcap", made_up_shots(4), start_ns=START_NS + 1)
    for reader in (open_source, describe):
        with pytest.raises(RecordingError, match=r"2 scans: .*hall\.mcap, .*room\.mcap; name one"):
            reader(tmp_path)
    record(tmp_path / "room.part2.mcap", made_up_shots(2), start_ns=START_NS + 1)
    (tmp_path / "hall.mcap").unlink()
    assert (open_source(tmp_path).count, describe(tmp_path).shots) == (6, 6)


def test_a_missing_image_costs_its_own_shot(tmp_path: Path) -> None:
    csv = "frame,bearing_deg,time_s\na.jpg,0,0\nb.jpg,1,1\nc.jpg,2,2\n"
    source = open_source(write_folder(tmp_path / "scan", csv, ["a.jpg", "c.jpg"]))
    assert [s.index for s in source.shots()] == [0, 2]
    (fault,) = source.faults
    assert "line 3" in fault
    assert "b.jpg is missing" in fault


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_an_unreadable_image_costs_its_own_shot(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "scan", "frame,bearing_deg\na.jpg,0\nb.jpg,1\n", ["a.jpg", "b.jpg"])
    (folder / "frames" / "a.jpg").chmod(0)
    source = open_source(folder)
    assert [s.index for s in source.shots()] == [1]
    assert "cannot be read" in source.faults[0]


@pytest.mark.parametrize(
    ("csv", "message"),
    [
        ("", "is empty; it needs the header frame,bearing_deg,time_s"),
        ("frame,bearing_deg,time_s\n", "no line with a frame"),
        ("frame,angle,time_s\na.jpg,0,0\n", r"lacks the column bearing_deg: it has frame, angle, time_s"),
        ("name,angle\na.jpg,0\n", r"lacks the column frame and bearing_deg: it has name, angle; it needs frame,bear"),
        ("frame,bearing_deg,time_s\na.jpg,0,0\nb.jpg,ten,1\n", "line 3: bearing_deg is 'ten', not a finite number"),
        ("frame,bearing_deg,time_s\na.jpg,nan,0\n", "line 2: bearing_deg is 'nan'"),
        ("frame,bearing_deg,time_s\na.jpg,-inf,0\n", "line 2: bearing_deg is '-inf'"),
        ("frame,bearing_deg,time_s\na.jpg\n", "line 2: bearing_deg is ''.*line 2: time_s is ''"),
        ("frame,bearing_deg,time_s\na.jpg,1,soon\n", "line 2: time_s is 'soon'"),
        ("frame,bearing_deg,time_s\n,1,1\n", "line 2: frame is empty"),
        ("frame,bearing_deg,bearing_deg\na.jpg,1,2\n", "column bearing_deg twice"),
        ("frame,bearing_deg,time_s\n../../secret,1,1\n", "is no name of a file in the folder"),
        ("frame,bearing_deg,time_s\n" + "a.jpg,x,1\n" * 9, "and 4 more"),
    ],
)
def test_a_faulty_csv_is_told_in_one_line_with_line_and_value(tmp_path: Path, csv: str, message: str) -> None:
    folder = write_folder(tmp_path / "scan", csv, ["a.jpg"])
    with pytest.raises(ConfigError, match=message) as caught:
        open_source(folder)
    assert "\n" not in str(caught.value)


def test_a_csv_that_is_no_text_is_told(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "scan", "", ["a.jpg"])
    (folder / "scan.csv").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(ConfigError, match="is no csv: it is not text in UTF-8; save it"):
        open_source(folder)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary() | st.text().map(lambda text: b"frame,bearing_deg\n" + text.encode("utf-8", "replace")))
@example(b"frame,bearing_deg\n" + b"9" * 5000 + b",1\n")
@example(b"frame,bearing_deg\n" + b"n" * 5000 + b",1\n")
@example(b"frame,bearing_deg\na\0b,1\n")
@example(b'frame,bearing_deg\n"a,1\n')
@example(b"frame,bearing_deg\n,1,2,3,4,5\n")
def test_no_csv_breaks_the_reader(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "scan.csv").write_bytes(content)
    with pytest.raises(ScanmapError) as caught:
        list(open_source(tmp_path).shots())
    assert "\n" not in str(caught.value)


def test_a_disk_that_fails_on_the_way_is_told(tmp_path: Path) -> None:
    source = open_source(record(tmp_path / "a.mcap", made_up_shots(3)))
    working = source.read

    def failing(report: Callable[[str], None]) -> Iterator[Shot]:
        yield next(working(report))
        raise OSError(5, "Input/output error")

    source.read = failing
    shots = source.shots()
    assert next(shots) == made_up_shots(3)[0]
    with pytest.raises(RecordingError, match="cannot be read any further: Input/output error"):
        next(shots)


def test_a_csv_from_a_spreadsheet_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "scan", "", ["a.jpg"])
    (folder / "scan.csv").write_bytes("\ufeffFrame, Bearing_deg\r\na.jpg, 90\r\n".encode())
    (shot,) = open_source(folder).shots()
    assert (shot.bearing, shot.time) == (np.pi / 2, 0.0)


def test_a_folder_without_a_scan_says_what_a_scan_needs(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is empty; a scan needs"):
        open_source(tmp_path)
    (tmp_path / "holiday.jpg").write_bytes(b"")
    with pytest.raises(RecordingError, match=r"has no scan.csv, only holiday\.jpg"):
        open_source(tmp_path)


def test_a_csv_that_names_nothing_there_is_an_error(tmp_path: Path) -> None:
    source = open_source(write_folder(tmp_path / "scan", "frame,bearing_deg\na.jpg,0\nb.jpg,1\n", ["z.jpg"]))
    with pytest.raises(RecordingError, match="none of the 2 images"):
        list(source.shots())


@pytest.mark.parametrize(
    ("name", "count", "last_deg"), [("real/srv-scan", 320, -358.875), ("rendered/room-offset", 31, 180)]
)
def test_real_folders(name: str, count: int, last_deg: float) -> None:
    folder = DATA / name
    if not folder.exists():
        pytest.skip(f"data set {name} is not here")
    source = open_source(folder)
    shots = list(source.shots())
    assert len(shots) == source.count == count
    assert source.faults == []
    assert np.isclose(shots[-1].bearing, np.radians(last_deg))
    assert shots[1].image == (folder / "frames" / ("step_num2.jpg" if count == 320 else "000001.jpg")).read_bytes()


@pytest.fixture(params=[("MJPG", "avi", "jpeg"), ("mp4v", "mp4", "png")], ids=["mjpg", "mp4"])
def video(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Ten grey frames of brightness 20 k."""
    codec, suffix, _ = request.param
    path = tmp_path / f"sweep.{suffix}"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 5.0, (64, 48))
    if not writer.isOpened():
        pytest.skip(f"this OpenCV writes no {codec} video")
    for k in range(10):
        writer.write(np.full((48, 64, 3), 20 * k, np.uint8))
    writer.release()
    return path


def frame_of(image: bytes) -> int:
    """Which of the ten frames it is; lossy codecs shift the brightness by less than 5 of the 20 between two."""
    number = float(decode_image(image).image.mean()) / 20
    assert abs(number - round(number)) < 0.25
    return round(number)


def test_a_video_with_frame_numbers(video: Path, request: pytest.FixtureRequest) -> None:
    video.with_suffix(".csv").write_text("frame,bearing_deg\n2,10\n5,20\n9,30\n")
    source = open_source(video)
    shots = list(source.shots())
    assert [frame_of(s.image) for s in shots] == [2, 5, 9]
    assert np.allclose([s.bearing for s in shots], np.radians([10, 20, 30]))
    assert np.allclose([s.time for s in shots], [0.4, 1.0, 1.8])
    assert (source.kind, source.count, source.faults) == ("video", 3, [])
    # a motion JPEG is what the camera sent: nothing is decoded and encoded again
    assert {image_format(s.image) for s in shots} == {request.node.callspec.params["video"][2]}
    if video.suffix == ".avi":
        assert all(s.image in video.read_bytes() for s in shots)
    assert list(source.shots()) == shots


@pytest.mark.parametrize("header", ["", "bearing_deg\n"])
def test_a_video_with_one_bearing_a_frame(video: Path, tmp_path: Path, header: str) -> None:
    csv = tmp_path / "angles.txt"
    csv.write_text(header + "\n".join(str(k) for k in range(10)))
    shots = list(open_source(video, bearings=csv).shots())
    assert [frame_of(s.image) for s in shots] == list(range(10))
    assert np.allclose([s.bearing for s in shots], np.radians(np.arange(10)))


def test_a_mark_that_a_video_was_taken_upside_down_turns_no_frame(tmp_path: Path) -> None:
    """Phones write it; the pictures of the calibration were not turned by theirs, and must fit these."""
    path = tmp_path / "v.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 5, (64, 48))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no mp4v video")
    frame = np.zeros((48, 64, 3), np.uint8)
    frame[:24, :32] = 250
    for _ in range(3):
        writer.write(frame)
    writer.release()
    data = path.read_bytes()
    upright = struct.pack(">9I", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    at = data.index(upright, data.index(b"tkhd"))
    turned = struct.pack(">9I", 0xFFFF0000, 0, 0, 0, 0xFFFF0000, 0, 64 << 16, 48 << 16, 1 << 30)
    path.write_bytes(data[:at] + turned + data[at + len(turned) :])
    path.with_suffix(".csv").write_text("frame,bearing_deg\n1,10\n")
    assert cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_ORIENTATION_META) == 180
    (shot,) = open_source(path).shots()
    with closing(open_files(CameraParams(source=str(path)))) as camera:
        live = camera.newest().image
    first = next(picture for picture in read_pictures(path) if isinstance(picture, Picture))
    for image in (decode_image(shot.image).image, decode_image(live).image, first.image):
        assert image[10, 10].min() > 200 and image[-10, -10].max() < 50


def test_a_video_that_is_shorter_than_its_csv(video: Path) -> None:
    video.with_suffix(".csv").write_text("frame,bearing_deg\n8,1\n9,2\n10,3\n11,4\n")
    source = open_source(video)
    assert len(list(source.shots())) == 2
    assert "10 frames; 2 frames" in source.faults[0]
    video.with_suffix(".csv").write_text("frame,bearing_deg\n10,3\n11,4\n")
    with pytest.raises(RecordingError, match="none of the 2 frames"):
        list(open_source(video).shots())


def test_faults_of_videos(video: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no csv of bearings: put sweep\.csv"):
        open_source(video)
    video.with_suffix(".csv").write_text("frame,bearing_deg\na.jpg,1\n")
    with pytest.raises(ConfigError, match=r"line 2: frame 'a\.jpg' is no frame number"):
        open_source(video)
    video.with_suffix(".csv").write_text("frame,bearing_deg\n1,1\n1,2\n")
    with pytest.raises(ConfigError, match="line 3: frame 1 is there twice"):
        open_source(video)
    broken = tmp_path / "broken.avi"
    broken.write_bytes(b"no video")
    (tmp_path / "broken.csv").write_text("bearing_deg\n1\n")
    with pytest.raises(RecordingError, match="cannot be opened"):
        open_source(broken)


Bag = Callable[..., Path]


@pytest.fixture
def others_bag(tmp_path: Path) -> Bag:
    """A bag as another robot records it: written by another library, joints at 50 Hz, images between, no metadata."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
    from rosbags.rosbag2 import Writer as BagWriter
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    T = store.types

    def stamp(ns: int) -> Any:
        time = T["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        return T["std_msgs/msg/Header"](stamp=time, frame_id="x")

    def build(
        *, rate: float = np.pi / 8, joint: str = "head", image_topic: str = "/camera/image/compressed",
        joint_topic: str = "/joint_states", shots: int = 20, gap: tuple[float, float] = (9, 9), wrap: bool = False,
        off_after: bool = False, compressed: bool = False,
    ) -> Path:  # fmt: skip
        events: list[tuple[float, str, int]] = [(0.02 * k, "joint", k) for k in range(50 * shots // 5 + 20)]
        events = [e for e in events if not gap[0] <= e[0] < gap[1]]
        events += [(0.1071 + 0.2 * k, "image", k) for k in range(shots)]
        if off_after:
            events += [(0.1071 + 0.2 * k + 0.15, "off", k) for k in range(shots)]
        image_type, joint_type = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/JointState"
        folder = tmp_path / f"bag{len(list(tmp_path.iterdir()))}"
        bag = BagWriter(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        if compressed:
            bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with bag as writer:
            images = writer.add_connection(image_topic, image_type, typestore=store)
            off = writer.add_connection("/camera/off/compressed", image_type, typestore=store)
            joints = writer.add_connection(joint_topic, joint_type, typestore=store)
            for when, kind, k in sorted(events):
                ns = START_NS + round(when * 1e9)
                if kind == "joint":
                    bearing = when * rate
                    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi if wrap else bearing
                    message = T[joint_type](
                        header=stamp(ns), name=["wheel", joint], position=np.array([7.0, bearing]),
                        velocity=np.empty(0), effort=np.empty(0),
                    )  # fmt: skip
                    writer.write(joints, ns, store.serialize_cdr(message, joint_type))
                    continue
                shot_ns = START_NS + round((0.1071 + 0.2 * k) * 1e9)
                data = np.frombuffer(f"{kind} {k}".encode(), np.uint8)
                message = T[image_type](header=stamp(shot_ns), format="jpeg", data=data)
                # stamped at exposure, in the bag a little later, as with every real camera
                writer.write(
                    images if kind == "image" else off, ns + 5_000_000, store.serialize_cdr(message, image_type)
                )
        return folder

    return build


@pytest.mark.parametrize("as_file", [False, True])
def test_a_bag_of_others_replays_with_bearings_between_their_samples(others_bag: Bag, as_file: bool) -> None:
    bag = others_bag()
    source = open_source(next(bag.glob("*.mcap")) if as_file else bag)
    shots = list(source.shots())
    assert source.faults == []
    assert [s.image for s in shots] == [f"image {k}".encode() for k in range(20)]
    times = 0.1071 + 0.2 * np.arange(20)
    assert np.allclose([s.bearing for s in shots], times * np.pi / 8, rtol=0, atol=1e-6)
    assert np.allclose([s.time for s in shots], START_NS / 1e9 + times, rtol=0, atol=1e-6)
    assert [s.index for s in shots] == list(range(20))
    assert not source.has_calibration
    assert not source.is_twin
    assert source.metadata == {}
    assert describe(bag).shots == 20


def test_bearings_are_interpolated_the_short_way_round(others_bag: Bag) -> None:
    rate = np.pi / 1.11  # the joint jumps from pi to -pi between the samples on both sides of an image
    shots = list(open_source(others_bag(rate=rate, wrap=True)).shots())
    error = np.array([s.bearing for s in shots]) - (0.1071 + 0.2 * np.arange(20)) * rate
    assert np.allclose(np.exp(1j * error), 1, atol=1e-6)


def test_laser_off_images_of_others_may_come_after_the_laser_on_ones(others_bag: Bag) -> None:
    source = open_source(others_bag(off_after=True))
    assert [s.background for s in source.shots()] == [f"off {k}".encode() for k in range(20)]
    assert source.faults == []


def test_images_in_a_gap_of_the_bearings_are_left_out(others_bag: Bag) -> None:
    source = open_source(others_bag(gap=(1.0, 3.0)))
    kept = [int(s.image.split()[1]) for s in source.shots()]
    times = 0.1071 + 0.2 * np.arange(20)
    assert kept == np.flatnonzero((times < 0.98) | (times > 3.0)).tolist()
    assert "no bearing of joint 'head'" in source.faults[0]
    assert source.faults[-1] == f"{20 - len(kept)} images in all were left out for want of a bearing"


def test_other_topics_and_joints_can_be_named(others_bag: Bag) -> None:
    bag = others_bag(image_topic="/usb_cam/image_raw/compressed", joint_topic="/pan/joint_states", joint="pan")
    with pytest.raises(
        RecordingError, match=r"has no .*/camera/image/compr.*; it has .*/usb_cam/image_raw/comp.*--set"
    ):
        open_source(bag)
    named = RecordingParams(image_topic="/usb_cam/image_raw/compressed")
    with pytest.raises(RecordingError, match=r"/joint_states; it has .*/pan/joint_states.*recording\.joint_topic"):
        open_source(bag, named)
    named = named.model_copy(update={"joint_topic": "/pan/joint_states"})
    with pytest.raises(RecordingError, match=r"no joint 'head'.*it has pan, wheel.*recording\.joint="):
        list(open_source(bag, named).shots())
    assert len(list(open_source(bag, named.model_copy(update={"joint": "pan"})).shots())) == 20
    assert "/usb_cam/image_raw/compressed" in describe(next(bag.glob("*.mcap"))).topics


def test_compressed_bags_are_read(others_bag: Bag) -> None:
    assert len(list(open_source(others_bag(compressed=True)).shots())) == 20


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.ZSTD, "enable_crcs": False},
        {"compression": CompressionType.NONE, "chunk_size": 5000},
        {"use_chunking": False},
        {"index_types": IndexType.NONE, "use_statistics": False, "repeat_channels": False, "repeat_schemas": False},
    ],
    ids=str,
)
def test_every_way_to_lay_out_an_mcap_file_is_read(tmp_path: Path, options: dict[str, Any]) -> None:
    shots = made_up_shots(9, off=True)
    path = tmp_path / "rewritten.mcap"
    with record(tmp_path / "ours.mcap", shots).open("rb") as ours, path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start("ros2")
        channels: dict[str, int] = {}
        for schema, channel, message in make_reader(ours).iter_messages():
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.log_time)
        writer.finish()
    got = list(open_source(path).shots())
    assert [s.image for s in got] == [s.image for s in shots]
    assert [s.background for s in got] == [s.background for s in shots]
    assert [(s.bearing, s.bearing_commanded) for s in got] == [(s.bearing, s.bearing_commanded) for s in shots]
    info = describe(path)
    assert (info.shots, info.topics["/joint_states"].messages, info.cut_at) == (9, 9, None)


def test_a_bag_without_mcap_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    (tmp_path / "bag_0.db3").write_bytes(b"SQLite")
    with pytest.raises(RecordingError, match=r"only bag_0\.db3, metadata\.yaml.*ros2 bag convert"):
        open_source(tmp_path)


def test_parts_of_a_bag_are_read_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    shots = made_up_shots(12)
    for part in range(12):
        record(tmp_path / f"scan_{part}.mcap", shots[part : part + 1])
    assert list(open_source(tmp_path).shots()) == shots


def test_png_frames_pass_as_they_are(tmp_path: Path) -> None:
    png = encode_png(np.arange(48 * 64, dtype=np.uint8).reshape(48, 64))
    folder = write_folder(tmp_path / "scan", "frame,bearing_deg\n0,0\n", [])
    (folder / "frames" / "000000.png").write_bytes(png)
    (shot,) = open_source(folder).shots()
    assert shot.image == png
