"""The loop: order, memory, faults, and what comes through when the source breaks."""

import errno
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest

from scanmap.calibration import Calibration, CalibrationFile
from scanmap.errors import CalibrationError, StageError
from scanmap.laserline import LaserLineParams, Reason
from scanmap.pipeline import Pipeline, Processes, Step, checked, run, step, worth_processes
from scanmap.shot import Decoded, Image, Shot, decode_image, encode_png
from scanmap.triangulation import TriangulationParams

W, H = 320, 240


@pytest.fixture(scope="module")
def head() -> Calibration:
    document = {
        "image": {"width": W, "height": H},
        "head": {"baseline_m": 0.08, "beta_deg": 25.7, "alpha_deg": 32.3},
    }
    return CalibrationFile.model_validate(document).build()


@pytest.fixture(scope="module")
def pipeline(head: Calibration) -> Pipeline:
    return Pipeline(head, LaserLineParams(), TriangulationParams())


def picture(column: float, *, jpeg: bool = False, noise: int = 2) -> bytes:
    rng = np.random.default_rng(int(column * 10))
    line = 180.0 * np.exp(-0.5 * ((np.arange(W) - column) / 1.6) ** 2)
    grey = np.clip(rng.normal(10.0 + line, noise, (H, W)), 0, 255).astype(np.uint8)
    image = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    if jpeg:
        return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 92])[1])
    return encode_png(image)


def shots(count: int, **kwargs: bool) -> list[Shot]:
    return [Shot(k, 0.01 * k, 0.01 * k, 0.1 * k, picture(100.0 + k % 30, **kwargs)) for k in range(count)]


def test_steps_come_in_the_order_of_the_shots(pipeline: Pipeline) -> None:
    def slow_when_even(shot: Shot) -> Step:
        time.sleep(0.02 * (shot.index % 2 == 0))
        return pipeline.process(shot)

    seen: list[int] = []
    assert run(shots(12), slow_when_even, [lambda step: seen.append(step.shot.index)], workers=4) == 12
    assert seen == list(range(12))


def test_depth_of_the_line_is_the_analytic_one(pipeline: Pipeline, head: Calibration) -> None:
    column = 117.0
    step = pipeline.process(Shot(0, 0.0, 0.0, 0.0, picture(column, noise=0)))
    f = W / (2 * np.tan(np.radians(32.3)))
    depth = 0.08 / np.tan(np.radians(25.7) + np.arctan((column - (W - 1) / 2) / f))
    assert step.profile.points[H // 2, 0] == pytest.approx(depth, rel=2e-3)
    assert (step.line.reason == Reason.OK).mean() > 0.99


def test_workers_do_not_change_a_bit(pipeline: Pipeline) -> None:
    results = []
    for workers in (1, 3):
        steps: list[Step] = []
        run(shots(8, jpeg=True), pipeline.process, [steps.append], workers=workers)
        results.append([step.profile.points.tobytes() for step in steps])
    assert results[0] == results[1]


def test_source_is_never_read_far_ahead(pipeline: Pipeline) -> None:
    taken = 0
    behind = 0
    done = 0

    def source() -> Iterator[Shot]:
        nonlocal taken
        for shot in shots(40):
            taken += 1
            yield shot

    def sink(_: Step) -> None:
        nonlocal behind, done
        done += 1
        behind = max(behind, taken - done)

    run(source(), pipeline.process, [sink], workers=2)
    assert behind <= 6


def test_shots_before_a_broken_source_reach_the_sinks(pipeline: Pipeline) -> None:
    def breaking() -> Iterator[Shot]:
        yield from shots(5)
        raise StageError("the stage is gone")

    steps: list[Step] = []
    with pytest.raises(StageError, match="gone"):
        run(breaking(), pipeline.process, [steps.append], workers=2)
    assert [step.shot.index for step in steps] == list(range(5))


def test_stop_ends_after_what_was_begun(pipeline: Pipeline) -> None:
    steps: list[Step] = []
    assert run(shots(50), pipeline.process, [steps.append], stop=lambda: len(steps) >= 3, workers=2) < 15


def test_no_worker_outlives_the_run(pipeline: Pipeline) -> None:
    run(shots(4), pipeline.process, [], workers=3)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("decode")]


def test_damaged_image_is_a_fault_not_an_end(pipeline: Pipeline) -> None:
    step = pipeline.process(Shot(3, 0.0, 0.0, 0.0, b"\xff\xd8\xff nothing"))
    assert "decoded" in step.fault
    assert (step.profile.reason == Reason.DAMAGED).all() and np.isnan(step.profile.range_m).all()


def test_cut_jpeg_keeps_the_rows_above_the_cut(pipeline: Pipeline) -> None:
    whole = picture(120.0, jpeg=True)
    step = pipeline.process(Shot(0, 0.0, 0.0, 0.0, whole[: len(whole) * 6 // 10]))
    found = step.line.reason == Reason.OK
    assert "cut" in step.fault
    assert found[: H // 4].mean() > 0.95 and not found[-H // 8 :].any()
    assert np.abs(step.line.column_px[found] - 120.0).max() < 0.5


@pytest.mark.parametrize("damage", ["no picture", "cut", "of another size"])
def test_a_damaged_laser_off_picture_costs_no_row(pipeline: Pipeline, damage: str) -> None:
    whole = picture(120.0, jpeg=True)
    off = bytes(cv2.imencode(".jpg", np.full((H, W, 3), 10, np.uint8))[1])
    small = bytes(cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8))[1])
    spoilt = {"no picture": b"nothing", "cut": whole[: len(whole) * 6 // 10], "of another size": small}[damage]
    step, alone = (pipeline.process(Shot(0, 0.0, 0.0, 0.0, whole, background)) for background in (spoilt, None))
    assert step.fault.startswith("laser-off picture left out: ")
    assert np.array_equal(step.line.column_px, alone.line.column_px, equal_nan=True)
    assert pipeline.process(Shot(0, 0.0, 0.0, 0.0, whole, off)).fault == ""


def test_image_of_another_size_is_refused_before_anything_is_processed(pipeline: Pipeline) -> None:
    other = Shot(0, 0.0, 0.0, 0.0, encode_png(np.zeros((48, 64), np.uint8)))
    with pytest.raises(CalibrationError, match=r"64x48.*320x240"):
        checked([other], pipeline)


def test_check_looks_past_a_damaged_first_image(pipeline: Pipeline) -> None:
    bad = Shot(0, 0.0, 0.0, 0.0, b"nothing")
    assert [shot.index for shot in checked([bad, *shots(3)[1:]], pipeline)] == [0, 1, 2]


def test_image_of_another_size_in_the_middle_costs_only_itself(pipeline: Pipeline) -> None:
    step = pipeline.process(Shot(7, 0.0, 0.0, 0.0, encode_png(np.zeros((48, 64), np.uint8))))
    assert "64x48" in step.fault and not np.isfinite(step.profile.range_m).any()


@pytest.fixture(scope="module")
def processes(pipeline: Pipeline) -> Iterator[Processes]:
    with Processes(pipeline, count=2) as workers:
        yield workers


@pytest.fixture
def helped(pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch) -> Iterator[Processes]:
    """One worker process, and this one, as on two cores."""
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    with Processes(pipeline) as workers:
        assert (len(workers.pids), workers.threads) == (1, 3)
        yield workers


def test_worker_processes_do_not_change_a_bit(pipeline: Pipeline, processes: Processes, helped: Processes) -> None:
    results = []
    source = [*shots(9, jpeg=True), Shot(9, 0.0, 0.0, 0.0, b"\xff\xd8\xff nothing")]
    for runner in (
        partial(run, process=pipeline.process, workers=1),
        partial(run, process=processes.process, workers=processes.threads),
        processes.run,
        helped.run,
    ):
        steps: list[Step] = []
        assert runner(source, sinks=[steps.append], stop=lambda: False) == len(source)
        assert [step.shot for step in steps] == source
        results.append([(*(a.tobytes() for a in (*step.line, *step.profile)), step.fault) for step in steps])
    assert results[0] == results[1] == results[2] == results[3]
    assert "decoded" in results[1][-1][-1]


def coloured(column: float, light: tuple[float, float, float]) -> bytes:
    rng = np.random.default_rng(int(column))
    line = 180.0 * np.exp(-0.5 * ((np.arange(W) - column) / 1.6) ** 2)
    image = np.clip(rng.normal(10.0 + line[:, None] * np.array(light), 2.0, (H, W, 3)), 0, 255).astype(np.uint8)
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1])


def test_shots_together_give_what_each_gives_alone(head: Calibration) -> None:
    """With the laser's channel told by the first picture; one that shows another laser is asked for its own."""
    red, green = (0.05, 0.1, 1.0), (0.1, 1.0, 0.05)
    pictures = [coloured(100.0, red), b"nothing", coloured(104.0, red)[:9000], picture(120.0), coloured(110.0, green)]
    source = [Shot(k, 0.01 * k, 0.01 * k, 0.1 * k, image) for k, image in enumerate(pictures)]
    pipeline, unasked = (Pipeline(head, LaserLineParams(), TriangulationParams()) for _ in range(2))
    assert list(checked(source, pipeline)) == source
    assert pipeline.laser is not None and pipeline.laser.channel == 2
    for ask in (pipeline, unasked):
        for together, shot in zip(ask.process_all(source), source, strict=True):
            alone = ask.process(shot)
            assert (together.shot, together.fault) == (alone.shot, alone.fault)
            for own, same in zip((*alone.line, *alone.profile), (*together.line, *together.profile), strict=True):
                np.testing.assert_array_equal(own, same)
    steps = pipeline.process_all(source)
    assert ["cut" in step.fault for step in steps] == [False, False, True, False, False]
    for k, column in ((0, 100.0), (3, 120.0), (4, 110.0)):
        assert np.nanmedian(steps[k].line.column_px) == pytest.approx(column, abs=0.2)
        assert np.isfinite(steps[k].line.column_px).mean() > 0.98


def test_a_monochrome_cameras_pictures_are_decoded_to_their_one_plane(
    head: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []

    def decode(data: bytes, *, grey: bool, into: Image | None = None) -> Decoded:
        asked.append(grey)
        return decode_image(data, grey=grey, into=into)

    monkeypatch.setattr(step, "decode_image", decode)
    of_colour = [shot.image for shot in shots(3, jpeg=True)]
    grey = [bytes(cv2.imencode(".jpg", decode_image(data, grey=True).image)[1]) for data in of_colour]
    source = [Shot(k, 0.0, 0.0, 0.1 * k, image) for k, image in enumerate([*grey, *of_colour])]
    auto, plane, sum_of_all = (
        Pipeline(head, LaserLineParams(grey=how), TriangulationParams()) for how in ("auto", "luminance_601", "mean")
    )
    for pipeline, some, decoded in (
        (auto, source[:3], [True] * 3),
        (auto, source[3:], [False] * 3),
        (auto, source, [True] * 3 + [False] * 3),  # one by one
        (plane, source, [True] * 6),
        (sum_of_all, source[:3], [False] * 3),
    ):
        asked.clear()
        together = pipeline.process_all(some)
        assert asked == decoded
        for one, shot in zip(together, some, strict=True):
            np.testing.assert_array_equal(one.line, pipeline.process(shot).line)
            assert (one.line.reason == Reason.OK).mean() > 0.99
    for one, other in zip(auto.process_all(source[:3]), plane.process_all(source[:3]), strict=True):
        np.testing.assert_array_equal(one.line, other.line)
    assert auto.ask_laser(source[0]) and auto.laser is None


def test_a_picture_that_leaves_doubt_tells_no_channel(head: Calibration) -> None:
    pipeline = Pipeline(head, LaserLineParams(), TriangulationParams())
    assert len(list(checked(shots(5), pipeline))) == 5
    assert pipeline.laser is None


def test_what_a_worker_process_raises_is_raised_here(head: Calibration) -> None:
    broken = Pipeline(head, LaserLineParams(), TriangulationParams())
    broken.window = np.zeros((3, 2))  # not one of this image's rows
    with pytest.raises(Exception) as here:
        broken.process(shots(1)[0])
    with Processes(broken, count=1) as workers, pytest.raises(type(here.value)) as there:
        workers.process(shots(1)[0])
    assert str(there.value) == str(here.value)


def test_steps_before_what_a_worker_process_raises_reach_the_sinks(
    pipeline: Pipeline, processes: Processes, helped: Processes
) -> None:
    broken = Shot(4, 0.0, 0.0, 0.0, cast(bytes, None))
    with pytest.raises(Exception) as here:
        pipeline.process(broken)
    for workers in (processes, helped):
        steps: list[Step] = []
        with pytest.raises(type(here.value)):
            workers.run([*shots(4), broken, *shots(3)], [steps.append])
        assert [step.shot.index for step in steps][:4] == list(range(4))


def test_source_that_fails_and_stop_end_the_worker_processes_run_too(processes: Processes) -> None:
    def breaking() -> Iterator[Shot]:
        yield from shots(5)
        raise StageError("the stage is gone")

    steps: list[Step] = []
    with pytest.raises(StageError, match="gone"):
        processes.run(breaking(), [steps.append])
    assert [step.shot.index for step in steps] == list(range(5))
    assert processes.run(shots(60), [], stop=lambda: True) == 1
    # What was read ahead of the sinks is still finished.
    assert processes.run(shots(300), [steps.append], stop=lambda: len(steps) >= 8) < 200


def test_killed_worker_process_costs_no_shot_and_is_told_once(
    pipeline: Pipeline, caplog: pytest.LogCaptureFixture
) -> None:
    steps: list[Step] = []
    with Processes(pipeline, count=2) as workers:

        def sink(step: Step) -> None:
            steps.append(step)
            if len(steps) == 3:
                os.kill(workers.pids[0], signal.SIGKILL)

        workers.run(shots(60), [sink])
    assert len([line for line in caplog.messages if "ended" in line]) == 1
    assert [step.shot.index for step in steps] == list(range(60))
    assert all((step.line.reason == Reason.OK).mean() > 0.99 for step in steps)


def test_system_without_room_for_a_worker_process_costs_no_shot(
    pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr("scanmap.pipeline.processes.start", full)
    steps: list[Step] = []
    with Processes(pipeline, count=2) as workers:
        workers.run(shots(5), [steps.append])
    assert [step.shot.index for step in steps] == list(range(5))
    assert caplog.messages == ["0 of 2 worker processes were started: Resource temporarily unavailable"]


_BITS = """
import os, pickle, signal, sys, threading
from scanmap.pipeline import Processes
from scanmap.pipeline.starting import _is_alone

pipeline, shots = pickle.load(sys.stdin.buffer)
expected, got = [pipeline.process(shot) for shot in shots], []
assert _is_alone()
with Processes(pipeline, count=2) as workers:
    for pid in workers.pids:
        with open(f"/proc/{pid}/cmdline") as own, open("/proc/self/cmdline") as ours:
            assert own.read() == ours.read(), "not a copy"
    workers.run(shots, [got.append])
assert [worker.exit_code for worker in workers._workers] == [0, 0], "one waits for a pipe that another holds"
with Processes(pipeline, count=2) as workers:
    workers.run(shots, [lambda step: os.kill(workers.pids[0], signal.SIGKILL)])
assert [worker.exit_code for worker in workers._workers] == [-signal.SIGKILL, 0]
for one, other in zip(expected, got, strict=True):
    assert [a.tobytes() for a in (*one.line, *one.profile)] == [a.tobytes() for a in (*other.line, *other.profile)]
waiting = threading.Event()
threading.Thread(target=waiting.wait).start()
with Processes(pipeline, count=1) as workers:
    with open(f"/proc/{workers.pids[0]}/cmdline") as own, open("/proc/self/cmdline") as ours:
        assert own.read() != ours.read(), "a copy of a process with threads"
    workers.process(shots[0])
waiting.set()
"""


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="threads are counted on Linux only")
def test_a_process_without_threads_is_copied_and_copies_do_not_change_a_bit(pipeline: Pipeline) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _BITS],
        input=pickle.dumps((pipeline, shots(30, jpeg=True))),
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr.decode()


def test_no_worker_process_outlives_its_block(pipeline: Pipeline) -> None:
    with pytest.raises(StageError), Processes(pipeline, count=2) as workers:
        raise StageError("gone")
    assert [worker.exit_code for worker in workers._workers] == [0, 0]


def test_worker_processes_only_where_there_is_enough_for_them() -> None:
    assert not worth_processes(5)
    assert worth_processes(1800) == worth_processes(None) == ((os.cpu_count() or 1) > 1)
