"""The watch over a sweep: what pictures say of the head and the laser, and how a sweep takes it."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from scanmap import config as configuration
from scanmap.errors import CameraError, StageError
from scanmap.session.rigs import TwinDevices, open_twin
from scanmap.session.watching import watch_of
from scanmap.shot import Shot, encode_png
from scanmap.sweep import Withdraw, shift_between, sweep

pytestmark = pytest.mark.usefixtures("baked_once")

SMALL = ("calibration.image.width=320", "calibration.image.height=240", "sweep.step_deg=3", "sweep.end_deg=36")
CONTINUOUS = ("sweep.mode='continuous'", "sweep.step_deg=2")
SWITCH = ("stage.homing='switch'", "twin.drive.switch_deg=-3.0", "stage.home_deg=-2")


def texture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return cv2.GaussianBlur(rng.normal(100.0, 60.0, (240, 640)).astype(np.float32), (0, 0), 3.0)


def picture(scene: np.ndarray, columns: float, noise: int = 0) -> bytes:
    """320 columns of a scene moved to the right, with a line that stays, and noise of its own."""
    view = cv2.warpAffine(scene, np.array([[1.0, 0.0, columns - 160.0], [0.0, 1.0, 0.0]]), (320, 240))
    view = view + np.random.default_rng(noise).normal(0.0, 1.5, view.shape)
    view[:, 60:63] = 250
    return encode_png(np.clip(view, 0, 255).astype(np.uint8))


@pytest.mark.parametrize("columns", [0.0, 0.3, 2.5, -7.25, 40.0])
def test_a_shift_is_measured_to_a_tenth_of_a_pixel_whatever_the_laser_line_does(columns: float) -> None:
    shift = shift_between(picture(texture(1), 0.0, 1), picture(texture(1), columns, 2))
    assert shift.is_sure and shift.columns_px == pytest.approx(columns, abs=0.15)
    assert shift.is_small == (abs(columns) <= 0.3)


def test_what_has_nothing_in_common_or_shows_nothing_is_never_sure() -> None:
    for k in range(8):
        assert not shift_between(picture(texture(k), 0.0, 1), picture(texture(k + 50), 0.0, 2)).is_sure
        plain = np.full((240, 640), 40.0, np.float32)
        assert not shift_between(picture(plain, 0.0, k), picture(plain, 0.0, k + 100)).is_sure
    with pytest.raises(CameraError):
        shift_between(b"", picture(texture(1), 0.0))


Fault = Callable[[TwinDevices], None]


def run(
    *settings: str,
    fault: Fault | None = None,
    after: int = 5,
    withdraw: Withdraw = lambda indices, why: None,
) -> tuple[list[Shot], list[str], str, float]:
    """Sweep the twin, with a fault after a few shots; shots, notes, how it ended, the largest error of a bearing."""
    config = configuration.load("twin-quick", (*SMALL, *settings))
    opened = open_twin(config, config.head())
    assert opened.twin is not None
    shots: list[Shot] = []
    notes: list[str] = []
    wrong = 0.0
    try:
        watch = watch_of(config, config.head())
        for shot in sweep(
            opened.rig,
            config.sweep,
            sleep=opened.sleep,
            clock=opened.clock,
            watch=watch,
            note=notes.append,
            withdraw=withdraw,
        ):
            shots.append(shot)
            off = math.degrees(shot.bearing) - opened.twin.firmware.drivetrain.bearing_deg
            wrong = max(wrong, abs(off) if not notes else 0.0)
            if len(shots) == after and fault is not None:
                fault(opened.twin)
        return shots, notes, "done", wrong
    except StageError as error:
        return shots, notes, str(error), wrong
    finally:
        opened.close()
        assert not opened.twin.firmware.laser_on


def slip(twin: TwinDevices) -> None:
    twin.firmware.drivetrain.slip(80)


def stall(twin: TwinDevices) -> None:
    twin.firmware.drivetrain.stalled = True


def laser_out(twin: TwinDevices) -> None:
    twin.firmware.laser_dead = True


def brown_out(twin: TwinDevices) -> None:
    twin.firmware.power_cycle()


def limit(twin: TwinDevices) -> None:
    twin.firmware.trip_limit()


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (slip, r"steps were lost .* shifted by .* head off by about -(0\.[89]|1\.[01])\d* deg"),
        (stall, "motor stalled: the picture does not change, however far"),
        (laser_out, "laser has gone out: no line at 12.00 deg, where there was one"),
        (brown_out, "restarted by itself, so its position is lost"),
        (limit, "ALARM:1"),
    ],
)
def test_a_fault_is_noticed_at_the_next_shot(fault: Fault, words: str) -> None:
    shots, _, ended, wrong = run(fault=fault)
    assert len(shots) == 5 and wrong < 0.01
    assert re.search(words, ended), ended


@pytest.mark.parametrize("fault", [slip, brown_out, limit])
def test_a_head_with_a_switch_finds_its_place_and_goes_on(fault: Fault, caplog: pytest.LogCaptureFixture) -> None:
    whole, *_ = run(*SWITCH)
    with caplog.at_level(logging.WARNING):
        shots, notes, ended, _ = run(*SWITCH, fault=fault)
    assert ended == "done" and len(notes) == 1 and "homed again" in notes[0]
    assert "homing again (1 more times at most)" in caplog.text
    assert [shot.bearing for shot in shots] == [shot.bearing for shot in whole]
    for shot, clean in zip(shots, whole, strict=True):
        assert shift_between(clean.image, shot.image).is_small


def test_a_stalled_motor_is_not_homed_for_ever() -> None:
    shots, notes, ended, _ = run(*SWITCH, fault=stall)
    assert len(shots) == 5 and len(notes) == 2 and "motor stalled" in ended


@pytest.mark.parametrize("room", [(), ("twin.room='box'",), ("twin.light.ambient=0.0",)], ids=str)
def test_a_motor_that_stalls_where_the_room_is_plain_or_dark_is_noticed_at_once(room: tuple[str, ...]) -> None:
    """No picture can be matched there, but two of one place differ by nothing but noise."""
    settings = ("sweep.end_deg=80", "sweep.step_deg=8", "sweep.off_frames=true")
    shots, _, ended, _ = run(*settings, *room, fault=stall, after=9)
    assert len(shots) == 9 and "motor stalled: the picture does not change, however far" in ended


DARK = ("twin.light.ambient=0.0", "sweep.end_deg=80", "sweep.step_deg=8")


def test_steps_lost_in_the_dark_are_told_at_the_end_by_the_line() -> None:
    def half_a_step(twin: TwinDevices) -> None:
        twin.firmware.drivetrain.slip(320)

    shots, _, ended, _ = run(*DARK, fault=half_a_step, after=5)
    assert len(shots) == 11 and "the laser line at 8.00 and 24.00 deg is not where it was; 10 shots cannot" in ended


def test_a_stalled_head_that_sees_no_line_is_no_dead_laser_and_in_the_dark_a_dead_laser_no_stalled_head() -> None:
    def both(twin: TwinDevices) -> None:
        stall(twin)
        laser_out(twin)

    assert "motor stalled: the picture does not change, however far" in run(fault=both)[2]
    assert "laser has gone out: no line at" in run(*DARK, fault=laser_out)[2]


def test_a_shot_on_whose_way_the_motor_stalled_is_taken_back() -> None:
    """Four tenths of a degree short: too little to be doubted, until the next picture is the same."""

    def fault(twin: TwinDevices) -> None:
        turned = twin.firmware.drivetrain.bearing_deg
        follow = twin.firmware.drivetrain.follow

        def blocked(steps: int) -> None:
            follow(steps)
            if twin.firmware.drivetrain.bearing_deg > turned + 1.6:
                twin.firmware.drivetrain.stalled = True

        twin.firmware.drivetrain.follow = blocked  # type: ignore[method-assign]

    lost: list[int] = []
    shots, _, ended, _ = run(*CONTINUOUS, fault=fault, withdraw=lambda indices, _: lost.extend(indices))
    assert "motor stalled: the picture does not change, however far" in ended
    assert len(shots) == 6 and lost == [5]


def test_steps_lost_too_few_at_a_time_are_noticed_at_the_end() -> None:
    def creep(twin: TwinDevices) -> None:
        follow = twin.firmware.drivetrain.follow

        def slipping(steps: int) -> None:
            forward = steps - twin.firmware.drivetrain._counted
            follow(steps)
            if forward > 0:
                twin.firmware.drivetrain.slip(round(0.15 * forward))

        twin.firmware.drivetrain.follow = slipping  # type: ignore[method-assign]

    shots, _, ended, _ = run(fault=creep, after=1)
    assert len(shots) == 13 and "has lost its place in the course of the scan" in ended


@pytest.mark.parametrize(
    "settings", [(), ("twin.room='box'",), ("twin.light.ambient=0.0",), ("sweep.off_frames=true",)], ids=str
)
def test_a_sweep_without_a_fault_raises_none(settings: tuple[str, ...]) -> None:
    shots, notes, ended, _ = run(*settings, "sweep.end_deg=180", "sweep.step_deg=6")
    assert (len(shots), notes, ended) == (31, [], "done")


def test_a_loose_contact_of_the_laser_costs_no_shot() -> None:
    def flicker(twin: TwinDevices) -> None:
        twin.firmware.laser_dead = True
        grab = twin.camera.grab

        def one_dark() -> object:
            frame = grab()
            twin.firmware.laser_dead = False
            return frame

        twin.camera.grab = one_dark  # type: ignore[method-assign, assignment]

    shots, _, ended, _ = run(fault=flicker)
    whole, *_ = run()
    assert ended == "done"
    config = configuration.load("twin-quick", SMALL)
    lit = watch_of(config, config.head())._lit
    assert lit is not None
    for shot, clean in zip(shots, whole, strict=True):
        assert lit(shot.image, None) == pytest.approx(lit(clean.image, None), abs=0.2)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (slip, r"steps were lost .* head off by about -(0\.[789]|1\.[012])\d* deg"),
        (stall, "steps were lost or the motor stalled"),
        (laser_out, "laser has gone out: no line at 8"),
        (brown_out, "restarted by itself"),
    ],
)
def test_a_continuous_sweep_is_watched_as_well(fault: Fault, words: str) -> None:
    shots, _, ended, wrong = run(*CONTINUOUS, fault=fault)
    assert [shot.index for shot in shots] == [0, 1, 2, 3, 4] and wrong < 0.01
    assert re.search(words, ended), ended


def test_a_continuous_sweep_homes_again_and_misses_no_slot() -> None:
    shots, notes, ended, _ = run(*CONTINUOUS, *SWITCH, "twin.latency_s=0.08", "twin.jitter_s=0.002", fault=slip)
    assert ended == "done" and len(notes) == 1 and "homed again" in notes[0]
    assert sorted({shot.index for shot in shots}) == list(range(18))


def test_a_continuous_sweep_without_a_fault_raises_none_however_late_its_pictures_come() -> None:
    shots, notes, ended, _ = run(*CONTINUOUS, "sweep.passes=2", "twin.latency_s=0.08", "twin.jitter_s=0.002")
    assert (notes, ended) == ([], "done")
    assert len(shots) == len({shot.index for shot in shots}) > 34
