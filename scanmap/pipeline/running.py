"""The one loop, and its decode workers."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import chain
from typing import Protocol, TypeVar

import cv2

from scanmap.errors import CameraError
from scanmap.pipeline.step import Pipeline, Sink
from scanmap.shot import Shot, decode_image

_AHEAD = 3  # groups of shots that are read before the first is begun, where more than one make a group
S = TypeVar("S")  # a shot, or what else a thread is handed
T = TypeVar("T")  # what is made of it
CHECKED_IMAGES = 3  # so many of another size than the calibration's, and nothing is processed


class Runner(Protocol):
    """`run`, on whatever it runs."""

    def __call__(self, shots: Iterable[Shot], *, sinks: Iterable[Sink], stop: Callable[[], bool]) -> int: ...


def checked(shots: Iterable[Shot], pipeline: Pipeline) -> Iterator[Shot]:
    """The same shots, after the first readable images were held against the calibration and told of the laser.

    One that fits is enough: a single odd image costs its own shot, not the scan. So is one that shows the laser.

    Raises:
        CalibrationError: the images have another size than the calibration; before anything is processed.
    """
    source, calibration = iter(shots), pipeline.calibration
    seen: list[Shot] = []
    odd: list[tuple[int, int]] = []
    fitting = 0
    for shot in source:
        seen.append(shot)
        try:
            height, width = decode_image(shot.image, grey=True).image.shape[:2]
        except CameraError:
            continue
        fits = (width, height) == (calibration.intrinsics.width, calibration.intrinsics.height)
        odd, fitting = [*odd, *[(width, height)] * (not fits)], fitting + fits
        if (fits and pipeline.ask_laser(shot)) or CHECKED_IMAGES in (len(odd), fitting):
            break
    if odd and not fitting:
        calibration.check_image(*odd[0])
    return chain(seen, source)


def run(
    shots: Iterable[S],
    process: Callable[[S], T],
    sinks: Iterable[Callable[[T], None]],
    stop: Callable[[], bool] = lambda: False,
    workers: int = 0,
) -> int:
    """Process shots in parallel, hand the steps to every sink in the order of the shots; returns their number.

    Args:
        shots: the source; consumed in the caller's thread, a few shots ahead of the sinks, never more, so
            that memory does not grow with the number of frames.
        process: `Pipeline.process`; where there are many shots, `Processes.run` is the same on every core.
        sinks: each called with every Step, or what else is made of a shot, in the caller's thread.
        stop: asked before each shot; True ends the loop after what was begun.
        workers: threads that call `process`; 0 takes one per processor core.

    When the source raises, the steps already begun reach the sinks first.
    """
    return run_groups(shots, lambda group: [process(shot) for shot in group], sinks, stop, workers, 1)


def run_groups(
    shots: Iterable[S],
    process: Callable[[list[S]], Iterable[T]],
    sinks: Iterable[Callable[[T], None]],
    stop: Callable[[], bool],
    workers: int,
    together: int,
) -> int:
    """`run` with `together` shots handed to a thread at once; what `process` gives is iterated in the caller's.

    The last groups are ever smaller, so that no core waits long for what another has begun.
    """
    workers = workers or os.cpu_count() or 1
    sinks = tuple(sinks)
    pending: deque[Future[Iterable[T]]] = deque()
    ahead: deque[S] = deque()
    most_ahead = _AHEAD * together if together > 1 else 1
    done = 0

    def begin(count: int) -> None:
        pending.append(pool.submit(process, [ahead.popleft() for _ in range(count)]))

    def deliver() -> None:
        nonlocal done
        for step in pending.popleft().result():
            for sink in sinks:
                sink(step)
            done += 1

    with single_threaded_opencv(), ThreadPoolExecutor(workers, thread_name_prefix="decode") as pool:
        try:
            for shot in shots:
                ahead.append(shot)
                if len(ahead) == most_ahead:
                    begin(together)
                while len(pending) > 2 * workers or (pending and pending[0].done()):
                    deliver()
                if stop():
                    break
        finally:
            while ahead:
                begin(-(-len(ahead) // _AHEAD))
            while pending:
                deliver()
    return done


@contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """The workers are the parallelism; OpenCV's own threads would only get in their way."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
