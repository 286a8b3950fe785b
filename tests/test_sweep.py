"""Sweeps: plans, the order of frames, limits, retries, and the laser off however it ends."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanmap.errors import CameraError, ConfigError, StageError
from scanmap.rig import Frame, Rig
from scanmap.rig.manual import ManualStage
from scanmap.rig.stage import StageParams, open_stage
from scanmap.sweep import SweepParams, between, missing, passes, plan, sweep
from scanmap.twin.firmware import Firmware
from scanmap.twin.ports import plug


class FakeCamera:
    """Writes the true bearing and the laser into its pictures; can fail at will."""

    width, height = 8, 6

    def __init__(self, firmware: Firmware) -> None:
        self.firmware = firmware
        self.fail_at: set[int] = set()
        self.grabs = 0
        self.closed = False
        self.latency_s = 0.0
        self.jitter = np.random.default_rng(1)

    def grab(self) -> Frame:
        self.grabs += 1
        if self.grabs in self.fail_at:
            raise CameraError("truncated frame")
        self.firmware.wait(0.033)
        laser = "on" if self.firmware.laser_on else "off"
        image = f"{math.degrees(self.firmware.bearing):.4f} {laser}".encode()
        if self.latency_s:
            self.firmware.wait(self.latency_s + self.jitter.normal(0.0, 0.002))
        return Frame(image, self.firmware.now)

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def firmware() -> Firmware:
    return Firmware()


@pytest.fixture
def rig(firmware: Firmware) -> Iterator[Rig]:
    with plug(firmware) as url:
        stage = open_stage(StageParams(port=url, timeout_s=0.3))
        with Rig(FakeCamera(firmware), stage, "digital twin", is_twin=True) as rig:
            yield rig


def picture(image: bytes | None) -> tuple[float, str]:
    assert image is not None
    bearing, laser = image.split()
    return float(bearing), laser.decode()


def test_default_plan_is_181_bearings_a_degree_apart() -> None:
    planned = plan(SweepParams())
    np.testing.assert_allclose(np.degrees(planned.bearings), np.arange(181), atol=1e-12)
    assert planned.time_s > 181 * 0.15


@given(start=st.floats(0, 180), end=st.floats(0, 180), step=st.floats(0.05, 200), passes=st.integers(1, 4))
def test_a_plan_stays_between_its_ends_in_equal_steps(start: float, end: float, step: float, passes: int) -> None:
    planned = plan(SweepParams(start_deg=start, end_deg=end, step_deg=step, passes=passes))
    bearings = np.degrees(planned.bearings).reshape(passes, -1)
    assert bearings[0, 0] == pytest.approx(start, abs=1e-9)
    assert bearings.min() >= min(start, end) - 1e-6
    assert bearings.max() <= max(start, end) + 1e-6
    np.testing.assert_allclose(np.abs(np.diff(bearings)), step, atol=1e-9)
    assert abs(end - bearings[0, -1]) < step + 1e-6
    for odd in bearings[1::2]:
        np.testing.assert_array_equal(odd, bearings[0, ::-1])


@pytest.mark.parametrize("change", [{"end_deg": 181.0}, {"start_deg": -1.0}, {"end_deg": 360.0}])
def test_more_than_the_cable_allows_is_refused_before_anything_moves(
    rig: Rig, firmware: Firmware, change: dict[str, float]
) -> None:
    with pytest.raises(ConfigError, match=r"outside 0 to 180 deg.*stage\.max_deg"):
        sweep(rig, SweepParams(**change))
    assert firmware.bearing == 0.0


def test_limits_raised_on_purpose_are_obeyed(firmware: Firmware) -> None:
    with plug(firmware) as url:
        stage = open_stage(StageParams(port=url, max_deg=360.0))
        with Rig(FakeCamera(firmware), stage, "digital twin", is_twin=True) as rig:
            shots = list(sweep(rig, SweepParams(end_deg=350, step_deg=50), sleep=firmware.wait))
    assert shots[-1].bearing == pytest.approx(math.radians(350))


def test_each_shot_carries_what_the_stage_reported_and_the_laser_was_right(rig: Rig, firmware: Firmware) -> None:
    params = SweepParams(step_deg=7.003, off_frames=True, passes="forward-backward")
    shots = list(sweep(rig, params, sleep=firmware.wait))
    assert [shot.index for shot in shots] == list(range(52))
    times = [shot.time for shot in shots]
    assert times[0] == 0.0
    assert times == sorted(times)
    for shot in shots:
        where, laser = picture(shot.image)
        assert laser == "on"
        assert picture(shot.background) == (where, "off")
        assert math.degrees(shot.bearing) == pytest.approx(where, abs=1e-4)
        assert abs(math.degrees(shot.bearing - shot.bearing_commanded)) <= 1 / 80
    assert any(shot.bearing != shot.bearing_commanded for shot in shots)
    assert not firmware.laser_on
    assert firmware.bearing == 0.0


def test_without_off_frames_there_is_no_background(rig: Rig, firmware: Firmware) -> None:
    assert all(shot.background is None for shot in sweep(rig, SweepParams(step_deg=30), sleep=firmware.wait))


def test_a_failed_frame_is_taken_again(rig: Rig, firmware: Firmware) -> None:
    rig.camera.fail_at = {2, 3, 7}  # type: ignore[attr-defined]
    shots = list(sweep(rig, SweepParams(step_deg=30), sleep=firmware.wait))
    assert len(shots) == 7


def test_a_camera_that_stays_broken_ends_the_sweep_with_the_laser_off(rig: Rig, firmware: Firmware) -> None:
    rig.camera.fail_at = set(range(4, 100))  # type: ignore[attr-defined]
    shots = sweep(rig, SweepParams(step_deg=30, retries=2), sleep=firmware.wait)
    assert [next(shots).index for _ in range(3)] == [0, 1, 2]
    with pytest.raises(CameraError, match=r"no usable frame after 3 tries: truncated frame.*sweep\.retries"):
        next(shots)
    assert not firmware.laser_on
    assert firmware.bearing == 0.0


def test_stop_ends_in_order(rig: Rig, firmware: Firmware) -> None:
    shots = sweep(rig, SweepParams(step_deg=10), stop=lambda: firmware.bearing > 1.0, sleep=firmware.wait)
    assert len(list(shots)) == 7
    assert not firmware.laser_on
    assert firmware.bearing == 0.0


@pytest.mark.parametrize("ending", ["close", "throw"])
def test_left_in_the_middle_the_laser_is_off_and_the_head_parked(rig: Rig, firmware: Firmware, ending: str) -> None:
    shots = sweep(rig, SweepParams(step_deg=10), sleep=firmware.wait)
    next(shots)
    next(shots)
    assert firmware.laser_on
    if ending == "close":
        shots.close()  # type: ignore[attr-defined]
    else:
        with pytest.raises(KeyboardInterrupt):
            shots.throw(KeyboardInterrupt)  # type: ignore[attr-defined]
    assert not firmware.laser_on
    assert firmware.bearing == 0.0


def test_an_unplugged_stage_is_one_clear_error_and_every_shot_before_it_counts(rig: Rig, firmware: Firmware) -> None:
    shots = sweep(rig, SweepParams(step_deg=10), sleep=firmware.wait)
    seen = [next(shots) for _ in range(5)]
    firmware.faults.unplugged = True
    with pytest.raises(StageError, match=r"twin://head is gone .*plug the board in"):
        next(shots)
    assert len(seen) == 5


def test_continuous_sweep_knows_the_bearing_of_every_exposure_in_both_directions(rig: Rig, firmware: Firmware) -> None:
    rig.camera.latency_s = 0.08  # type: ignore[attr-defined]
    params = SweepParams(
        mode="continuous", speed_deg_s=6, latency_s=0.08, step_deg=0.5, end_deg=60, passes="forward-backward"
    )
    shots = list(sweep(rig, params, sleep=firmware.wait, clock=lambda: firmware.now))
    errors = np.array([math.degrees(shot.bearing) - picture(shot.image)[0] for shot in shots])
    assert len(shots) > 80
    assert {picture(shot.image)[1] for shot in shots} == {"on"}
    assert np.abs(errors).max() < 6 * 0.008 + 1 / 80  # four sigma of the jitter, one step
    assert abs(errors.mean()) < 0.004
    indices = [shot.index for shot in shots]
    assert indices == sorted(set(indices)) and max(indices) < 2 * 121  # a slot has one shot at most
    for shot in shots:
        slot = shot.index if shot.index < 121 else shot.index - 121
        way = math.degrees(shot.bearing) if shot.index < 121 else 60 - math.degrees(shot.bearing)
        assert 0.5 * slot - 1e-6 <= way < 0.5 * (slot + 1) + 1e-6
    assert not firmware.laser_on
    assert firmware.bearing == 0.0


def test_latency_left_out_shows_as_opposite_shifts_of_the_two_passes(rig: Rig, firmware: Firmware) -> None:
    rig.camera.latency_s = 0.08  # type: ignore[attr-defined]
    params = SweepParams(mode="continuous", step_deg=0.5, end_deg=60, passes=2)
    shots = list(sweep(rig, params, sleep=firmware.wait, clock=lambda: firmware.now))
    errors = np.array([math.degrees(shot.bearing) - picture(shot.image)[0] for shot in shots])
    bearings = [shot.bearing for shot in shots]
    half = int(np.argmax(np.diff(bearings) < 0))
    assert errors[5 : half - 5].mean() == pytest.approx(6 * 0.08, abs=0.02)
    assert errors[half + 5 : -5].mean() == pytest.approx(-6 * 0.08, abs=0.02)


def test_continuous_sweep_left_in_the_middle_stops_at_once(rig: Rig, firmware: Firmware) -> None:
    shots = sweep(rig, SweepParams(mode="continuous", park=False), sleep=firmware.wait, clock=lambda: firmware.now)
    for _ in range(20):
        next(shots)
    here = math.degrees(firmware.bearing)
    shots.close()  # type: ignore[attr-defined]
    assert not firmware.laser_on
    assert firmware.state == "Idle"
    assert here <= math.degrees(firmware.bearing) < here + 0.5
    assert rig.stage.where() == pytest.approx(firmware.bearing)


def test_continuous_faster_than_the_stage_is_refused(rig: Rig) -> None:
    with pytest.raises(StageError, match=r"exceeds stage\.speed_deg_s = 20"):
        next(sweep(rig, SweepParams(mode="continuous", speed_deg_s=30)))


def test_continuous_needs_a_motor() -> None:
    stage = ManualStage(StageParams(kind="manual"), input)
    rig = Rig(FakeCamera(Firmware()), stage, "hand")
    with pytest.raises(ConfigError, match="needs a stage of kind grbl"):
        sweep(rig, SweepParams(mode="continuous"))


def test_adaptive_sweep_visits_what_the_picture_asks_for(rig: Rig, firmware: Firmware) -> None:
    coarse = plan(SweepParams(step_deg=10)).bearings
    asked: list[int] = []

    def refine(shots: int) -> np.ndarray:
        gaps = np.zeros(18, bool)
        gaps[[3, 4]] = True
        asked.append(shots)
        return [between(coarse, gaps, 2.5), np.radians([36.0, 34.0]), np.empty(0)][len(asked) - 1]

    params = SweepParams(step_deg=10, mode="adaptive")
    shots = list(sweep(rig, params, sleep=firmware.wait, refine=refine))
    fine = [math.degrees(shot.bearing) for shot in shots[19:]]
    assert fine == pytest.approx([47.5, 45, 42.5, 37.5, 35, 32.5, 34, 36], abs=1 / 80)  # down, then up again
    assert [shot.index for shot in shots] == list(range(27))
    assert asked == [19, 25, 27]


def test_the_last_slot_of_a_turn_may_be_empty_only_where_the_sweep_has_ended() -> None:
    planned = plan(SweepParams(mode="continuous", step_deg=2, end_deg=80))
    (turn,) = passes(planned)
    assert missing(planned, turn, range(turn.slots - 1)) == [(turn.slots - 1, turn.slots - 1)]
    assert missing(planned, turn, range(turn.slots - 1), ends=False) == []
    assert missing(planned, turn, {*range(10), *range(14, turn.slots)}, ends=False) == [(10, 13)]


@given(n=st.integers(2, 40), fine=st.floats(0.05, 5), mask=st.integers(0, 2**39 - 1))
def test_gaps_are_filled_evenly_and_only_where_asked(n: int, fine: float, mask: int) -> None:
    coarse = np.radians(np.linspace(0, 90, n))
    gaps = np.array([bool(mask >> k & 1) for k in range(n - 1)])
    joined = np.sort(np.concatenate([coarse, between(coarse, gaps, fine)]))
    steps = np.degrees(np.diff(joined))
    assert (steps > 1e-9).all()
    left = np.searchsorted(coarse, joined[:-1] + 1e-9) - 1
    assert (steps[gaps[left]] <= fine + 1e-9).all()
    np.testing.assert_allclose(steps[~gaps[left]], 90 / (n - 1))


def test_a_sweep_can_begin_where_another_ended(rig: Rig, firmware: Firmware) -> None:
    shots = list(sweep(rig, SweepParams(step_deg=10), sleep=firmware.wait, done=range(15)))
    assert [shot.index for shot in shots] == [15, 16, 17, 18]
    assert shots[0].bearing_commanded == pytest.approx(math.radians(150))


def test_a_plan_says_what_it_is() -> None:
    planned = plan(SweepParams(off_frames=True))
    assert planned.words.startswith("181 bearings from 0 to 180 deg every 1 deg, forward, laser on and off; about 1:12")
    assert planned.as_metadata()["shots"] == "181"
    assert plan(SweepParams(start_deg=20, end_deg=20)).words.startswith("1 bearing at 20 deg; about")
    assert plan(SweepParams(end_deg=0, passes=3)).words.startswith("3 shots at 0 deg;")
    assert "deg, 1 pass; about" in plan(SweepParams(passes=1)).words
    assert "then every 0.25 deg where it is needed; at least" in plan(SweepParams(mode="adaptive")).words
    assert set(map(type, planned.as_metadata().values())) == {str}
    with pytest.raises(ConfigError, match=r"sweep\.passes = 0"):
        plan(SweepParams(passes=0))


def brown_out(board: Firmware) -> None:
    board.power_cycle()


def limit_switch(board: Firmware) -> None:
    board.trip_limit()


def unplug(board: Firmware) -> None:
    board.faults.unplugged = True


def hang(board: Firmware) -> None:
    board.faults.mute = True


def lose_ok(board: Firmware) -> None:
    board.faults.lose_ok = 1


def lose_line(board: Firmware) -> None:
    board.faults.lose_lines = 1


def lose_status(board: Firmware) -> None:
    board.faults.lose_status = 2


def noise(board: Firmware) -> None:
    board.faults.garbage = bytes(range(256))


class TroubledBoard(Firmware):
    """Something happens to it at the n-th piece of data it gets."""

    writes = 0
    trouble_at = -1

    def trouble(self) -> None:
        """Replaced by the test."""

    def write(self, data: bytes) -> None:
        self.writes += 1
        if self.writes == self.trouble_at:
            self.trouble()
        super().write(data)


def run(board: TroubledBoard, first: int = 0) -> tuple[list[tuple[int, float, str]], str]:
    """Sweep as far as it goes; what was seen, and how it ended."""
    seen: list[tuple[int, float, str]] = []
    params = SweepParams(step_deg=15, off_frames=True)
    try:
        with plug(board) as url:
            stage = open_stage(StageParams(port=url, timeout_s=0.1, homing="switch", home_deg=-2.0, min_deg=-2))
            with Rig(FakeCamera(board), stage, "digital twin", is_twin=True) as rig:
                for shot in sweep(rig, params, sleep=board.wait, done=range(first)):
                    where, laser = picture(shot.image)
                    assert picture(shot.background) == (where, "off")
                    assert math.degrees(shot.bearing) == pytest.approx(where, abs=1e-4)
                    seen.append((shot.index, round(where, 3), laser))
    except StageError as error:
        return seen, str(error)
    return seen, "done"


def homed_board() -> TroubledBoard:
    board = TroubledBoard(switch_deg=-3.0)
    board.memory.settings.update({22: 1, 23: 1})
    return board


@pytest.mark.slow
@pytest.mark.parametrize(
    ("trouble", "words"),
    [
        (brown_out, "restarted by itself|not answered"),
        (limit_switch, "ALARM:1|alarm|not answered"),
        (unplug, "gone"),
        (hang, "not answered"),
        (lose_ok, "done"),
        (lose_line, "done"),
        (lose_status, "done"),
        (noise, "done"),
    ],
)
def test_trouble_at_twenty_moments_loses_no_shot_before_it_and_the_resumed_scan_is_equal(
    trouble: Callable[[TroubledBoard], None], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("scanmap.rig.grbl.HOMING_S", 0.3)
    clean = homed_board()
    whole, ended = run(clean)
    assert (len(whole), ended) == (13, "done")
    chance = np.random.default_rng(7)
    for moment in chance.integers(1, clean.writes + 1, 20):
        board = homed_board()
        board.trouble_at = int(moment)
        board.trouble = lambda board=board: trouble(board)  # type: ignore[method-assign, misc]
        seen, ended = run(board)
        assert seen == whole[: len(seen)]
        assert len(seen) == 13 or re.search(words, ended), (moment, ended)
        board.faults.unplugged = board.faults.mute = False
        board.power_cycle()
        assert not board.laser_on
        rest, ended = run(board, first=len(seen))
        assert ended == "done"
        assert seen + rest == whole
