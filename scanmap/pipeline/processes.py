"""Worker processes: every core with an interpreter of its own.

Decoding a JPEG leaves the interpreter's lock, but finding the line is many short NumPy calls that hold it: two threads
did the work of one and a half.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType
from typing import IO, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import Laser, LaserLine
from scanmap.pipeline.handover import Shared
from scanmap.pipeline.running import run_groups
from scanmap.pipeline.starting import keep_memory, start
from scanmap.pipeline.step import Pipeline, Sink, Step
from scanmap.shot import Shot
from scanmap.triangulation import Profile

log = logging.getLogger(__name__)

# Below so many shots a worker costs more to start (half a second, where it is no copy) than it brings.
WORTH_SHOTS = 100
# Shots sent in one message, and looked at together: waking this process for each interrupted a worker ten times a
# frame, and the line in twelve pictures at once costs three fifths of what it costs one by one. Of more pictures, what
# one step leaves for the next is no longer in the processor's cache.
TOGETHER = 12
# Messages on their way to one worker: it finds the next images waiting when it is done with some.
IN_FLIGHT = 2
# Reading shots and handing them to so many cores leaves this process time to work on some: it need not be started,
# nor be sent anything. More cores than these keep it busy.
_HELPS_CORES = 4


class Answer(NamedTuple):
    """What a worker sends back: a Step without its Shot, or what it raised."""

    line: LaserLine | None = None
    profile: Profile | None = None
    fault: str = ""
    places: NDArray[np.float32] | None = None
    lean: NDArray[np.float32] | None = None
    error: Exception | None = None


def worth_processes(shots: int | None) -> bool:
    """Whether worker processes shorten the work; None where the number of shots is not known."""
    return (os.cpu_count() or 1) > 1 and (shots is None or shots >= WORTH_SHOTS)


class Processes:
    """Worker processes for one pipeline; a context manager that ends them.

    `run` and `process` give what `run` with `Pipeline.process` gives, bit for bit; `process` may be called from
    `threads` threads at once. A worker that is killed is missed only in speed: its shots are processed here.
    """

    def __init__(self, pipeline: Pipeline, count: int = 0) -> None:
        """Start `count` workers, or for 0 as many as keep every core busy with this process, which helps on few cores.

        They are ready when their first shot comes.
        """
        self.pipeline = pipeline
        cores = os.cpu_count() or 1
        helps = not count and 1 < cores <= _HELPS_CORES
        self._workers = _started(pipeline, count or cores - helps)
        helps = helps or not self._workers
        self.threads = IN_FLIGHT * len(self._workers) + helps
        self._free: queue.SimpleQueue[_Worker | None] = queue.SimpleQueue()  # None: this process itself
        self._gone: set[_Worker | None] = set()
        if helps:
            keep_memory()
            self._free.put(None)
        for _ in range(IN_FLIGHT):
            for worker in self._workers:
                self._free.put(worker)

    def __enter__(self) -> Processes:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for worker in self._workers:
            worker.close()

    @property
    def pids(self) -> list[int]:
        """The workers' process numbers."""
        return [worker.pid for worker in self._workers]

    def run(self, shots: Iterable[Shot], sinks: Iterable[Sink], stop: Callable[[], bool] = lambda: False) -> int:
        """As `pipeline.run`, on all workers."""
        return run_groups(shots, self._processed, sinks, stop, self.threads, TOGETHER)

    def process(self, shot: Shot) -> Step:
        """`Pipeline.process`, done by whichever worker is free."""
        return next(self._processed([shot]))

    def _processed(self, shots: list[Shot]) -> Iterator[Step]:
        """The steps of shots that whichever worker is free has processed; or what it raised, in the place of one."""
        worker = self._free.get()
        try:
            answers = worker.ask(shots, self.pipeline.laser) if worker else _answers(self.pipeline, shots)
        except (OSError, EOFError, pickle.UnpicklingError, ValueError) as gone:
            if worker not in self._gone:
                self._gone.add(worker)
                log.warning("a worker process ended (%s); its shots are processed here", gone or "its pipe closed")
            return iter([self.pipeline.process(shot) for shot in shots])
        finally:
            self._free.put(worker)
        return _steps(shots, answers)


def _started(pipeline: Pipeline, count: int) -> list[_Worker]:
    """Workers, as many of them as the system has room for."""
    workers: list[_Worker] = []
    try:
        while len(workers) < count:
            workers.append(_Worker(pipeline))
    except OSError as error:
        log.warning("%d of %d worker processes were started: %s", len(workers), count, error.strerror or error)
    return workers


def _steps(shots: list[Shot], answers: list[Answer]) -> Iterator[Step]:
    for shot, answer in zip(shots, answers, strict=True):
        if answer.line is None or answer.profile is None:
            raise answer.error or RuntimeError("a worker process answered nothing")
        yield Step(shot, answer.line, answer.profile, answer.fault, answer.places, answer.lean)


class _Worker:
    """One worker process, its two pipes and the memory shared with it."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._started = start(pipeline, serve, IN_FLIGHT)
        self._to, self._back, self._shared = self._started.to, self._started.back, self._started.shared
        self._asked = 0
        self._sending = threading.Lock()
        self._last_read = threading.Event()
        self._last_read.set()
        self.pid = self._started.pid

    def ask(self, shots: list[Shot], laser: Laser | None) -> list[Answer]:
        """Send shots and what is known of the laser; the answers, which come in the order of messages, whoever asks."""
        with self._sending:
            before, read = self._last_read, threading.Event()
            self._last_read = read
            # No more are on their way than there are slots, and the oldest is answered first.
            slot = self._asked % IN_FLIGHT
            self._asked += 1
            try:
                self._shared.dump((slot, laser, [_sent(shot) for shot in shots]), self._to, slot)
            except BaseException:
                read.set()
                raise
        try:
            before.wait()
            return cast(list[Answer], self._shared.load(self._back))
        finally:
            read.set()

    def close(self) -> None:
        """End the worker: it stops when nothing more can come."""
        with contextlib.suppress(OSError):  # it is gone already
            self._to.close()
        self.exit_code = self._started.end()
        self._back.close()


def serve(pipeline: Pipeline, shared: Shared, messages: IO[bytes], answers: IO[bytes]) -> None:
    """The worker's own loop: messages of shots until the pipe closes."""
    while True:
        try:
            slot, pipeline.laser, shots = shared.load(messages)
        except EOFError:
            return
        shared.dump(_answers(pipeline, [Shot(*fields) for fields in shots]), answers, slot)


def _sent(shot: Shot) -> tuple[object, ...]:
    """The fields of a shot, its pictures such that they go through shared memory."""
    pictures = (None if data is None else pickle.PickleBuffer(data) for data in (shot.image, shot.background))
    return shot.index, shot.bearing, shot.bearing_commanded, shot.time, *pictures


def _answers(pipeline: Pipeline, shots: list[Shot]) -> list[Answer]:
    try:
        return [Answer(*step[1:]) for step in pipeline.process_all(shots)]
    except Exception as error:
        if len(shots) == 1:
            return [Answer(error=error)]
        return [answer for shot in shots for answer in _answers(pipeline, [shot])]
