"""Shot to Step: the one loop, and its decode workers. Grid, guard and view come in as sinks."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import chain
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.errors import CameraError
from scanmap.laserline import LaserLine, LaserLineParams, Reason, find_laser_line, needs_colour
from scanmap.shot import Decoded, Shot, decode_image
from scanmap.triangulation import Profile, TriangulationParams, column_window, triangulate

CHECKED_IMAGES = 3  # so many of another size than the calibration's, and nothing is processed


class Step(NamedTuple):
    """One shot, and what was made of it."""

    shot: Shot
    line: LaserLine  # (H,)
    profile: Profile  # (H,) head frame
    fault: str = ""  # what was wrong with the image; empty when nothing was


Sink = Callable[[Step], None]


class Pipeline:
    """What turns one shot into points; the same object serves every worker, for it changes nothing."""

    def __init__(
        self, calibration: Calibration, laserline: LaserLineParams, triangulation: TriangulationParams
    ) -> None:
        self.calibration = calibration
        self.laserline = laserline
        self.triangulation = triangulation
        self.window: NDArray[np.float64] = column_window(calibration, triangulation)
        self.colour = needs_colour(laserline)  # whether the line is found in colour or a grey decode will do

    def process(self, shot: Shot) -> Step:
        """Decode, find the line, triangulate. A bad image gives a Step without points and its fault."""
        try:
            image = self._decode(shot.image)
            background = self._decode(shot.background) if shot.background is not None else None
        except CameraError as error:
            return self._blind(shot, str(error))
        line = find_laser_line(image.image, self.laserline, background.image if background else None, self.window)
        fault = ""
        rows = min(image.rows_valid, background.rows_valid if background else image.rows_valid)
        if rows < len(line.reason):
            line = _without_rows(line, rows)
            fault = f"image is cut: {rows} of {len(line.reason)} rows are whole"
        return Step(shot, line, triangulate(line, self.calibration, self.triangulation), fault)

    def _decode(self, data: bytes) -> Decoded:
        decoded = decode_image(data, grey=not self.colour)
        height, width = decoded.image.shape[:2]
        own = self.calibration.intrinsics
        if (width, height) != (own.width, own.height):
            raise CameraError(f"image is {width}x{height}, the calibration is for {own.width}x{own.height}")
        return decoded

    def _blind(self, shot: Shot, fault: str) -> Step:
        rows = self.calibration.intrinsics.height
        nan = np.full(rows, np.nan)
        line = LaserLine(nan, nan, nan, nan, np.full(rows, Reason.DAMAGED, np.uint8))
        return Step(shot, line, triangulate(line, self.calibration, self.triangulation), fault)


def checked(shots: Iterable[Shot], calibration: Calibration) -> Iterator[Shot]:
    """The same shots, after the first readable images were held against the calibration.

    One that fits is enough: a single odd image costs its own shot, not the scan.

    Raises:
        CalibrationError: the images have another size than the calibration; before anything is processed.
    """
    source = iter(shots)
    seen: list[Shot] = []
    odd: list[tuple[int, int]] = []
    for shot in source:
        seen.append(shot)
        try:
            height, width = decode_image(shot.image, grey=True).image.shape[:2]
        except CameraError:
            continue
        if (width, height) == (calibration.intrinsics.width, calibration.intrinsics.height):
            return chain(seen, source)
        odd.append((width, height))
        if len(odd) == CHECKED_IMAGES:
            break
    if odd:
        calibration.check_image(*odd[0])
    return chain(seen, source)


def run(
    shots: Iterable[Shot],
    process: Callable[[Shot], Step],
    sinks: Iterable[Sink],
    stop: Callable[[], bool] = lambda: False,
    workers: int = 0,
) -> int:
    """Process shots in parallel, hand the steps to every sink in the order of the shots; returns their number.

    Args:
        shots: the source; consumed in the caller's thread, a few shots ahead of the sinks, never more, so
            that memory does not grow with the number of frames.
        process: `Pipeline.process`.
        sinks: each called with every Step, in the caller's thread.
        stop: asked before each shot; True ends the loop after what was begun.
        workers: decode threads; 0 takes one per processor core.

    When the source raises, the steps already begun reach the sinks first.
    """
    workers = workers or os.cpu_count() or 1
    sinks = tuple(sinks)
    pending: deque[Future[Step]] = deque()
    done = 0

    def deliver() -> None:
        nonlocal done
        step = pending.popleft().result()
        for sink in sinks:
            sink(step)
        done += 1

    with _single_threaded_opencv(), ThreadPoolExecutor(workers, thread_name_prefix="decode") as pool:
        try:
            for shot in shots:
                pending.append(pool.submit(process, shot))
                while len(pending) > 2 * workers or (pending and pending[0].done()):
                    deliver()
                if stop():
                    break
        finally:
            while pending:
                deliver()
    return done


@contextmanager
def _single_threaded_opencv() -> Iterator[None]:
    """The workers are the parallelism; OpenCV's own threads would only get in their way."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _without_rows(line: LaserLine, first: int) -> LaserLine:
    """The line with every row from `first` on given up as damaged."""
    damaged = np.arange(len(line.reason)) >= first
    column, peak, width, sigma = (np.where(damaged, np.nan, values) for values in line[:4])
    return LaserLine(column, peak, width, sigma, np.where(damaged, Reason.DAMAGED, line.reason).astype(np.uint8))
