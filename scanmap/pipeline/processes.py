"""Worker processes: every core with an interpreter of its own.

Decoding a JPEG leaves the interpreter's lock, but finding the line is many short NumPy calls that hold it: two threads
did the work of one and a half. The workers are started as programs of their own rather than by `multiprocessing`,
which would run the user's script once more in each of them, or copy a process in which rerun's threads hold locks.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import logging
import os
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType
from typing import IO, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import Laser, LaserLine
from scanmap.pipeline.running import run_groups
from scanmap.pipeline.step import Pipeline, Sink, Step
from scanmap.shot import Shot
from scanmap.triangulation import Profile

log = logging.getLogger(__name__)

# Below so many shots a worker costs more to start (half a second) than it brings.
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
# What a pipe should hold, where the system lets it: with its usual 64 kB either side waits for the other several times
# a frame.
_PIPE_BYTES = 1 << 20
PATIENCE_S = 5.0
# glibc gives large arrays back to the system as they are freed, and asking for them anew costs a fifth of a frame's
# time in page faults, asking for little at a time another 3 %; elsewhere these names mean nothing. Names in the
# environment of a worker, numbers (malloc.h) for this process.
_KEEP_MEMORY = {
    ("MALLOC_MMAP_THRESHOLD_", -3): 1 << 30,
    ("MALLOC_TRIM_THRESHOLD_", -1): 1 << 30,
    ("MALLOC_TOP_PAD_", -2): 1 << 26,
}

# The workers are the parallelism; threads that BLAS starts as it is imported cost a fifth of a worker's start.
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
# The worker imports scanmap from where this process did.
# Importing makes no garbage.
_START = (
    "import gc; gc.disable(); import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "from scanmap.pipeline.processes import serve; serve(sys.stdin.buffer, sys.stdout.buffer)"
)


class Answer(NamedTuple):
    """What a worker sends back: a Step without its Shot, or what it raised."""

    line: LaserLine | None = None
    profile: Profile | None = None
    fault: str = ""
    places: NDArray[np.float32] | None = None
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
        self._workers = [_Worker(pipeline) for _ in range(count or cores - helps)]
        self.threads = IN_FLIGHT * len(self._workers) + helps
        self._free: queue.SimpleQueue[_Worker | None] = queue.SimpleQueue()  # None: this process itself
        if helps:
            _keep_memory()
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
            log.warning("a worker process ended (%s); its shots are processed here", gone or "its pipe closed")
            return iter([self.pipeline.process(shot) for shot in shots])
        finally:
            self._free.put(worker)
        return _steps(shots, answers)


def _steps(shots: list[Shot], answers: list[Answer]) -> Iterator[Step]:
    for shot, answer in zip(shots, answers, strict=True):
        if answer.line is None or answer.profile is None:
            raise answer.error or RuntimeError("a worker process answered nothing")
        yield Step(shot, answer.line, answer.profile, answer.fault, answer.places)


class _Worker:
    """One worker process and its two pipes."""

    def __init__(self, pipeline: Pipeline) -> None:
        # A session of its own: Ctrl-C is for this process, which ends its workers when it is done.
        self._process = subprocess.Popen(
            [sys.executable, "-c", _START],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            env=os.environ | _ONE_THREAD | {name: str(size) for (name, _), size in _KEEP_MEMORY.items()},
        )
        self._to = cast(IO[bytes], self._process.stdin)
        self._back = cast(IO[bytes], self._process.stdout)
        for pipe in (self._to, self._back):
            _widen(pipe)
        self._sending = threading.Lock()
        self._last_read = threading.Event()
        self._last_read.set()
        self.pid = self._process.pid
        for first in (sys.path, pipeline):
            pickle.dump(first, self._to, protocol=5)
        self._to.flush()

    def ask(self, shots: list[Shot], laser: Laser | None) -> list[Answer]:
        """Send shots and what is known of the laser; the answers, which come in the order of messages, whoever asks."""
        with self._sending:
            before, read = self._last_read, threading.Event()
            self._last_read = read
            try:
                pickle.dump((laser, shots), self._to, protocol=5)
                self._to.flush()
            except BaseException:
                read.set()
                raise
        try:
            before.wait()
            return cast(list[Answer], pickle.load(self._back))
        finally:
            read.set()

    def close(self) -> None:
        """End the worker: it stops when nothing more can come."""
        with contextlib.suppress(OSError):  # it is gone already
            self._to.close()
        try:
            self._process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._back.close()


def _keep_memory() -> None:
    """What the workers' environment says, for this process."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # another C library
        for (_, number), size in _KEEP_MEMORY.items():
            ctypes.CDLL(None).mallopt(number, size)


def _widen(pipe: IO[bytes]) -> None:
    """Let a pipe hold more, where the system can and will."""
    with contextlib.suppress(ImportError, AttributeError, OSError):
        import fcntl

        fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)


def serve(messages: IO[bytes], answers: IO[bytes]) -> None:
    """The worker's own loop: a Pipeline first, then messages of shots until the pipe closes."""
    import cv2

    cv2.setNumThreads(1)  # the workers are the parallelism
    pipeline = cast(Pipeline, pickle.load(messages))
    gc.freeze()  # what was imported is never garbage
    gc.enable()
    while True:
        try:
            pipeline.laser, shots = cast(tuple[Laser | None, list[Shot]], pickle.load(messages))
        except EOFError:
            return
        pickle.dump(_answers(pipeline, shots), answers, protocol=5)
        answers.flush()


def _answers(pipeline: Pipeline, shots: list[Shot]) -> list[Answer]:
    try:
        return [Answer(*step[1:]) for step in pipeline.process_all(shots)]
    except Exception as error:
        if len(shots) == 1:
            return [Answer(error=error)]
        return [answer for shot in shots for answer in _answers(pipeline, [shot])]
