"""Cameras: one contract for all of them, and what each does when something is wrong."""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_cameras import FakeCapture, FakeDevice, as_jpeg, noisy, phone

from scanmap.errors import CameraError, ConfigError
from scanmap.rig import Camera, Streaming
from scanmap.rig import camera as camera_module
from scanmap.rig.camera import CameraParams, open_camera
from scanmap.rig.camera_capture import CapturedPictures
from scanmap.rig.camera_checks import fingerprint, size_of, without_padding
from scanmap.rig.camera_stream import BLACK_SHOTS, StreamCamera
from scanmap.shot import decode_image, encode_png, image_format


@pytest.fixture(autouse=True)
def warm(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test waits for a lamp."""
    for name in ("WARM_UP_S", "AUTOMATIC_WARM_UP_S", "FOLLOW_S"):
        monkeypatch.setattr(f"scanmap.rig.camera_stream.{name}", 0.0)


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> FakeDevice:
    device = FakeDevice()
    real = cv2.VideoCapture

    def capture(target: object, *rest: object) -> object:
        is_device = isinstance(target, int) or str(target).startswith(("/dev/", "rtsp://"))
        return FakeCapture(device) if is_device else real(target, *rest)

    monkeypatch.setattr(cv2, "VideoCapture", capture)
    monkeypatch.setattr(camera_module, "camera_devices", lambda: [(0, "Fake Cam")])
    return device


@contextlib.contextmanager
def opened(params: CameraParams, size: tuple[int, int] | None = None) -> Iterator[StreamCamera]:
    camera = open_camera(params, size)
    try:
        yield camera  # type: ignore[misc]
    finally:
        camera.close()


@pytest.fixture
def frames() -> Callable[[], bytes]:
    rng = np.random.default_rng(5)
    return lambda: as_jpeg(noisy(rng))


# One contract


@pytest.fixture(params=["twin", "v4l2", "yuyv", "http", "snapshot", "folder", "video",
                        pytest.param("real", marks=pytest.mark.hardware)])  # fmt: skip
def camera(
    request: pytest.FixtureRequest, tmp_path: Path, frames: Callable[[], bytes], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Camera]:
    kind = request.param
    with contextlib.ExitStack() as stack:
        if kind == "twin":
            from scanmap.config import load
            from scanmap.session.rigs import open_twin

            config = load("twin-quick", ["calibration.image.width=64", "calibration.image.height=48"])
            rig = open_twin(config, config.head())
            stack.callback(rig.close)
            yield rig.rig.camera
            return
        if kind == "real":
            from scanmap.config import load

            named = os.environ.get("SCANMAP_RIG")
            yield stack.enter_context(opened(load(named).camera if named else CameraParams()))
            return
        if kind in ("v4l2", "yuyv"):
            request.getfixturevalue("device").sends_jpeg = kind == "v4l2"
            source: int | str = 0
        elif kind in ("http", "snapshot"):
            served = stack.enter_context(phone(frames))
            source = served.url + ("/video" if kind == "http" else "/shot.jpg")
        elif kind == "folder":
            for number in range(20):
                (tmp_path / f"{number:06d}.jpg").write_bytes(frames())
            source = str(tmp_path)
        else:
            writer = cv2.VideoWriter(str(tmp_path / "v.avi"), MJPG, 30, (64, 48))
            rng = np.random.default_rng(1)
            for _ in range(20):
                writer.write(noisy(rng))
            writer.release()
            source = str(tmp_path / "v.avi")
        params = CameraParams(source=source, latency_s=0.0, rate_hz=100.0 if kind == "snapshot" else None)
        yield stack.enter_context(opened(params))


MJPG = cv2.VideoWriter.fourcc(*"MJPG")


def test_every_camera_gives_whole_pictures_of_its_size_in_the_order_of_time(camera: Camera) -> None:
    before = -np.inf
    seen = set()
    for _ in range(4):
        frame = camera.grab()
        assert image_format(frame.image) in ("jpeg", "png")
        assert decode_image(frame.image).image.shape[:2] == (camera.height, camera.width)
        assert frame.time >= before
        before = frame.time
        seen.add(frame.image)
    assert len(seen) == 4
    assert isinstance(camera, Streaming)
    newest = camera.newest()
    assert size_of(newest.image) == (camera.width, camera.height)
    camera.close()
    camera.close()


# Time


def test_a_picture_was_exposed_after_it_was_asked_for_however_late_it_comes(device: FakeDevice) -> None:
    """The picture carries the moment of its exposure; pictures under way when it is asked for are passed over."""
    device.latency_s, device.transfer_s = 0.04, 0.02
    exposed: list[float] = []
    rng = np.random.default_rng(2)

    def expose(size: tuple[int, int]) -> np.ndarray:
        exposed.append(time.monotonic())
        picture = noisy(rng, size=size)
        picture[:8, :8] = len(exposed) % 200 + 20  # which one it is
        return picture

    device.picture = expose
    with opened(CameraParams(source=0, latency_s=0.04, exposure_us=5000)) as camera:
        for _ in range(6):
            asked = time.monotonic()
            frame = camera.grab()
            mark = int(np.median(decode_image(frame.image, grey=True).image[1:7, 1:7]))
            which = min(range(len(exposed)), key=lambda n: abs((n + 1) % 200 + 20 - mark))
            assert exposed[which] > asked
            assert frame.time == pytest.approx(exposed[which], abs=0.02)


def test_without_a_drivers_stamp_the_arrival_counts(device: FakeDevice) -> None:
    device.stamps = False
    with opened(CameraParams(source=0, latency_s=0.0)) as camera:
        before = time.monotonic()
        assert before < camera.grab().time < time.monotonic()


def test_newest_never_gives_a_picture_twice_and_never_an_old_one(device: FakeDevice) -> None:
    with opened(CameraParams(source=0, latency_s=0.0)) as camera:
        camera.newest()
        time.sleep(0.1)  # ten pictures come and go
        asked = time.monotonic()
        first, second = camera.newest(), camera.newest()
        assert asked - first.time < 0.05
        assert second.time > first.time and second.image != first.image


# What it sent


def test_the_cameras_own_bytes_are_kept(device: FakeDevice) -> None:
    sent: set[bytes] = set()
    rng = np.random.default_rng(2)

    def send(size: tuple[int, int]) -> bytes:
        sent.add(data := as_jpeg(noisy(rng, size=size)))
        return data

    device.picture, device.padding = send, 1000
    with opened(CameraParams(source="auto", width=128, height=96)) as camera:
        frame = camera.grab()
    assert frame.image in sent
    assert (camera.width, camera.height) == (128, 96)


def test_a_camera_without_jpeg_is_kept_without_loss(device: FakeDevice, caplog: pytest.LogCaptureFixture) -> None:
    device.sends_jpeg = False
    sent: list[np.ndarray] = []
    rng = np.random.default_rng(2)

    def send(size: tuple[int, int]) -> np.ndarray:
        sent.append(noisy(rng, size=size))
        return sent[-1]

    device.picture = send
    with opened(CameraParams(source=0)) as camera:
        frame = camera.grab()
    picture = decode_image(frame.image).image
    assert image_format(frame.image) == "png"
    assert any(np.array_equal(picture, other) for other in sent)
    assert "no JPEG" in caplog.text


def test_http_bytes_are_kept_with_and_without_a_length(frames: Callable[[], bytes]) -> None:
    sent: set[bytes] = set()

    def send() -> bytes:
        sent.add(data := frames())
        return data

    for with_length, boundary in itertools.product((True, False), ("--frame", "--my boundary--")):
        with (
            phone(send, with_length=with_length, boundary=boundary) as served,
            opened(CameraParams(source=served.url + "/video", latency_s=0.0)) as camera,
        ):
            assert camera.grab().image in sent


def test_a_thumbnail_inside_a_picture_is_not_its_end(frames: Callable[[], bytes]) -> None:
    thumbnail = as_jpeg(np.zeros((16, 16, 3), np.uint8))

    def send() -> bytes:
        data = frames()
        return data[:2] + b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail + data[2:]

    with (
        phone(send, with_length=False) as served,
        opened(CameraParams(source=served.url + "/video", latency_s=0.0)) as camera,
    ):
        assert (camera.width, camera.height) == (64, 48)
        assert decode_image(camera.grab().image).rows_valid == 48


# Settings


def test_everything_is_asked_for_and_what_is_refused_is_said(
    device: FakeDevice, caplog: pytest.LogCaptureFixture
) -> None:
    params = CameraParams(source=0, width=100, height=90, rate_hz=15, exposure_us=4000, gain=20, focus=3,
                          white_balance_k=4600)  # fmt: skip
    with opened(params):
        pass
    assert device.controls[cv2.CAP_PROP_AUTO_EXPOSURE] == 1
    assert device.controls[cv2.CAP_PROP_EXPOSURE] == 40  # V4L2 counts in 100 us
    assert device.controls[cv2.CAP_PROP_AUTOFOCUS] == 0 and device.controls[cv2.CAP_PROP_FOCUS] == 3
    assert device.controls[cv2.CAP_PROP_AUTO_WB] == 0 and device.controls[cv2.CAP_PROP_WB_TEMPERATURE] == 4600
    assert device.controls[cv2.CAP_PROP_GAIN] == 20 and device.controls[cv2.CAP_PROP_FPS] == 15
    assert "asked for 100x90, it sends 128x96" in caplog.text
    assert "refused" not in caplog.text
    device.obeys = False
    device.controls.clear()
    caplog.clear()
    with opened(params) as camera:
        camera.grab()
    for words in ("rate_hz = 15 was refused, it says 7", "exposure_us = 4000 was refused", "gain = 20 was refused",
                  "white_balance_k = 4600", "focus = 3 was", "automatic exposure could not"):  # fmt: skip
        assert words in caplog.text


def test_automatic_exposure_is_said(device: FakeDevice, caplog: pytest.LogCaptureFixture) -> None:
    with opened(CameraParams(source=0)):
        pass
    assert device.controls[cv2.CAP_PROP_AUTO_EXPOSURE] == 3
    assert "exposure is automatic" in caplog.text


def test_the_calibrations_size_is_asked_for(device: FakeDevice) -> None:
    with opened(CameraParams(source=0), (128, 96)) as camera:
        assert (camera.width, camera.height) == (128, 96)


def test_the_exposure_can_be_changed_while_it_runs(
    device: FakeDevice, monkeypatch: pytest.MonkeyPatch, frames: Callable[[], bytes]
) -> None:
    monkeypatch.setattr("scanmap.rig.camera_stream.FOLLOW_S", 0.1)
    with opened(CameraParams(source=0, latency_s=0.0, exposure_us=4000)) as camera:
        camera.grab()
        asked = time.monotonic()
        camera.expose(20000)
        assert camera.grab().time > asked + 0.1
        assert device.controls[cv2.CAP_PROP_EXPOSURE] == 200
    with (
        phone(frames) as served,
        opened(CameraParams(source=served.url + "/video", latency_s=0.0)) as camera,
        pytest.raises(CameraError, match="cannot be set from here"),
    ):
        camera.expose(1000)


def test_pictures_of_a_camera_that_has_just_started_are_not_shot(
    device: FakeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("scanmap.rig.camera_stream.AUTOMATIC_WARM_UP_S", 0.3)
    with opened(CameraParams(source=0, latency_s=0.0)) as camera:
        started = time.monotonic()
        assert camera.grab().time > started + 0.25


# Faults


def faulty(device: FakeDevice, bad: Callable[[bytes], bytes | np.ndarray], when: Callable[[], bool]) -> None:
    """Every picture is damaged by `bad` while `when` says so."""
    rng = np.random.default_rng(9)

    def send(size: tuple[int, int]) -> bytes | np.ndarray:
        data = as_jpeg(noisy(rng, size=size))
        return bad(data) if when() else data

    device.picture = send


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (lambda data: data[: len(data) // 2], "cut short"),
        (lambda data: data[:400] + bytes(600) + data[1000:], "damaged|cannot be decoded|cut short|no JPEG"),
        (lambda _: as_jpeg(np.full((24, 32, 3), 90, np.uint8)), "32x24 instead of 64x48"),
        (lambda _: b"\xff\xd8\xff" + b"no picture" * 9, "no JPEG or PNG"),
    ],
)
def test_a_bad_picture_is_an_error_and_the_next_one_is_fine(
    device: FakeDevice, bad: Callable[[bytes], bytes], words: str
) -> None:
    broken = threading.Event()
    faulty(device, bad, broken.is_set)
    with opened(CameraParams(source=0, latency_s=0.0, timeout_s=1.0)) as camera:
        camera.grab()
        broken.set()
        with pytest.raises(CameraError, match=words):
            camera.grab()
        broken.clear()
        camera.grab()


def test_a_frozen_camera_is_noticed_even_if_its_time_stamps_differ(frames: Callable[[], bytes]) -> None:
    """The comment segment is another one each time; the picture is not."""
    picture, number = frames(), itertools.count()

    def send() -> bytes:
        comment = f"{next(number):08d}".encode()
        return picture[:2] + b"\xff\xfe" + (len(comment) + 2).to_bytes(2, "big") + comment + picture[2:]

    with (
        phone(send) as served,
        opened(CameraParams(source=served.url + "/video", latency_s=0, timeout_s=0.3)) as camera,
    ):
        camera.grab()
        asked = time.monotonic()
        with pytest.raises(CameraError, match="frozen"):
            camera.grab()
        assert time.monotonic() - asked < 5.0


def test_a_server_that_repeats_pictures_is_waited_for(frames: Callable[[], bytes]) -> None:
    """Phones send the last picture again until there is a new one."""
    number, now = itertools.count(), [frames()]

    def send() -> bytes:
        if next(number) % 5 == 4:
            now[0] = frames()
        return now[0]

    with phone(send) as served, opened(CameraParams(source=served.url + "/video", latency_s=0)) as camera:
        seen = [camera.grab().image for _ in range(5)]
    assert len(set(seen)) == 5


def test_one_black_picture_is_passed_over_and_a_camera_gone_black_is_an_error(device: FakeDevice) -> None:
    number = itertools.count()
    black = as_jpeg(np.zeros((48, 64, 3), np.uint8))
    faulty(device, lambda _: black, lambda: next(number) % 3 == 0)
    with opened(CameraParams(source=0, latency_s=0.0)) as camera:
        for _ in range(4):
            assert decode_image(camera.grab().image).image.max() > 3
        faulty(device, lambda _: black, lambda: True)
        for _ in range(BLACK_SHOTS - 1):
            camera.grab()  # dark corners exist
        with pytest.raises(CameraError, match="black pictures for 10 shots: take its lens cap off"):
            camera.grab()


def test_old_pictures_are_not_taken_for_new_ones(device: FakeDevice) -> None:
    with opened(CameraParams(source=0, latency_s=3.0, timeout_s=0.1)) as camera:
        camera._params = camera._params.model_copy(update={"latency_s": 30.0, "timeout_s": -29.8})
        with pytest.raises(CameraError, match=r"only old pictures.*latency"):
            camera.grab()


def test_an_unplugged_camera_is_noticed_in_time_and_comes_back(device: FakeDevice) -> None:
    with opened(CameraParams(source=0, latency_s=0.0, timeout_s=0.3)) as camera:
        camera.grab()
        device.unplugged = True
        asked = time.monotonic()
        with pytest.raises(CameraError, match=r"stopped sending|cannot be opened"):
            camera.grab()
        assert time.monotonic() - asked < 3.0
        device.unplugged = False
        deadline = time.monotonic() + 5.0
        while time.monotonic() < deadline:
            with contextlib.suppress(CameraError):
                camera.grab()
                break
        assert device.opened >= 2
        camera.grab()
    assert device.released >= device.opened


def test_a_camera_plugged_in_anew_is_found_by_its_own_name(
    device: FakeDevice, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may come back as another number; the link named after it leads there."""
    (tmp_path / "usb-Cam_123-video-index0").symlink_to("/dev/video3")
    (tmp_path / "usb-Other-video-index0").symlink_to("/dev/video0")
    monkeypatch.setattr("scanmap.rig.camera_capture.BY_ID", tmp_path)
    asked: list[object] = []
    fake = cv2.VideoCapture
    monkeypatch.setattr(cv2, "VideoCapture", lambda target, *rest: asked.append(target) or fake(3, *rest))
    source = CapturedPictures(CameraParams(source=3, exposure_us=1000))
    source.open()
    source.close()
    source.open()
    source.close()
    assert asked == [3, str(tmp_path / "usb-Cam_123-video-index0")]


def test_a_phone_that_hangs_up_is_asked_again(frames: Callable[[], bytes], caplog: pytest.LogCaptureFixture) -> None:
    with phone(frames, hang_up_after=4) as served:
        with opened(CameraParams(source=served.url + "/video", latency_s=0, timeout_s=2.0)) as camera:
            for _ in range(6):
                camera.grab()
        assert served.requests >= 2
    assert "was lost" in caplog.text


def test_nobody_there(device: FakeDevice, monkeypatch: pytest.MonkeyPatch) -> None:
    device.unplugged = True
    with pytest.raises(CameraError, match=r"camera 3 cannot be opened; cameras of this machine: 0 \(Fake Cam\)"):
        open_camera(CameraParams(source=3))
    with pytest.raises(CameraError, match=r"no camera found \(0 \(Fake Cam\): .*doctor"):
        open_camera(CameraParams())
    monkeypatch.setattr(camera_module, "camera_devices", list)
    with pytest.raises(CameraError, match=r"no camera found \(none on this machine\)"):
        open_camera(CameraParams())
    with pytest.raises(CameraError, match=r"http://127\.0\.0\.1:1/video does not answer"):
        open_camera(CameraParams(source="http://127.0.0.1:1/video"))
    with pytest.raises(CameraError, match="is no index, no URL and no file"):
        open_camera(CameraParams(source="nothing.avi"))
    with pytest.raises(ConfigError, match=r"ftp:// is no way to a camera"):
        open_camera(CameraParams(source="ftp://phone"))
    with pytest.raises(CameraError, match=r"rtsp://phone does not answer"):
        open_camera(CameraParams(source="rtsp://phone"))


def test_an_empty_folder_and_the_end_of_one(tmp_path: Path, frames: Callable[[], bytes]) -> None:
    with pytest.raises(CameraError, match=r"no pictures \(\.jpg, \.jpeg, \.png\) in it; name their folder"):
        open_camera(CameraParams(source=str(tmp_path)))
    (tmp_path / "a.jpg").write_bytes(frames())
    with opened(CameraParams(source=str(tmp_path))) as camera:
        camera.grab()
        with pytest.raises(CameraError, match="at its end"):
            camera.grab()


def test_a_phones_refusals_in_words(frames: Callable[[], bytes]) -> None:
    with phone(frames, status=401) as served, pytest.raises(CameraError, match=r"answered 401 .*user:password@host"):
        open_camera(CameraParams(source=served.url + "/video"))
    with phone(frames, content_type="text/html") as served, pytest.raises(CameraError, match="sends text/html"):
        open_camera(CameraParams(source=served.url + "/"))


def test_user_and_password_go_with_the_request_and_never_into_a_message(frames: Callable[[], bytes]) -> None:
    with phone(frames) as served:
        url = served.url.replace("http://", "http://me:s%40cret@") + "/video"
        with opened(CameraParams(source=url)) as camera:
            assert "cret" not in camera.name
        assert served.seen_authorization == "Basic bWU6c0BjcmV0"


def test_closing_ends_the_thread_and_frees_the_device(device: FakeDevice) -> None:
    before = threading.active_count()
    with opened(CameraParams(source=0)) as camera:
        assert threading.active_count() == before + 1
    assert threading.active_count() == before
    assert device.released == device.opened == 1
    with pytest.raises(CameraError, match="closed"):
        camera.newest()


def test_threads_of_a_camera_that_never_sends_do_not_stay(device: FakeDevice, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scanmap.rig.camera_stream.OPENING_S", 0.1)
    faulty(device, lambda _: b"garbage", lambda: True)
    before = threading.active_count()
    with pytest.raises(CameraError, match="no JPEG"):
        open_camera(CameraParams(source=0, timeout_s=0.1))
    assert threading.active_count() == before


# Bytes


def test_headers_are_read_as_they_are() -> None:
    for width, height in ((17, 33), (1600, 1200)):
        pixels = np.zeros((height, width, 3), np.uint8)
        assert size_of(as_jpeg(pixels)) == size_of(encode_png(pixels)) == (width, height)
    data = as_jpeg(noisy(np.random.default_rng(1)))
    assert without_padding(data + bytes(77)) == data
    assert without_padding(data[:-2] + bytes(77)) == data[:-2] + bytes(77)  # cut: nothing to be believed
    assert fingerprint(data) != fingerprint(as_jpeg(noisy(np.random.default_rng(2))))
    for junk in (b"", b"\xff", b"\xff\xd8\xff\xc0", data[:5], b"\xff\xd8" + b"\xff" * 99):
        with pytest.raises(CameraError):
            size_of(junk)


def test_passwords_and_warnings_stay_out_of_each_other(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    with pytest.raises(CameraError) as raised:
        open_camera(CameraParams(source="http://me:secret@127.0.0.1:1/"))
    assert "secret" not in str(raised.value) + caplog.text
