"""How a worker process comes to be: a copy of this one where that is safe, else a program of its own.

A copy is there at once, where a program first imports for a third of a second what this process has imported. But it
has none of the other threads, and what one of those held (rerun's, a camera's) is held for ever: a copy is taken only
of a process of one thread, as `scanmap replay` is where nobody watches. A program of its own is not started by
`multiprocessing`, which would run the user's script once more in it.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import IO, NamedTuple, cast

import cv2

from scanmap.pipeline.handover import Shared, shared_file
from scanmap.pipeline.running import single_threaded_opencv
from scanmap.pipeline.step import Pipeline

Serve = Callable[[Pipeline, Shared, IO[bytes], IO[bytes]], None]

# What a pipe should hold, where the system lets it and there is no shared memory: with its usual 64 kB either side
# waits for the other several times a frame.
_PIPE_BYTES = 1 << 20
PATIENCE_S = 5.0
# glibc gives large arrays back to the system as they are freed, and asking for them anew costs a fifth of a frame's
# time in page faults, asking for little at a time another 3 %; elsewhere these names mean nothing. Names in the
# environment of a program, numbers (malloc.h) for a process that runs.
_KEEP_MEMORY = {
    ("MALLOC_MMAP_THRESHOLD_", -3): 1 << 30,
    ("MALLOC_TRIM_THRESHOLD_", -1): 1 << 30,
    ("MALLOC_TOP_PAD_", -2): 1 << 26,
}
# The workers are the parallelism; threads that BLAS starts as it is imported cost a fifth of a program's start.
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
# It imports scanmap from where this process did; importing makes no garbage.
_PROGRAM = (
    "import gc; gc.disable(); import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "from scanmap.pipeline.starting import begin; begin()"
)
_TASKS = Path("/proc/self/task")  # one entry per thread, on Linux


class Started(NamedTuple):
    """A worker process, the memory shared with it, and its two pipes."""

    pid: int
    shared: Shared
    to: IO[bytes]
    back: IO[bytes]
    end: Callable[[], int | None]  # waits for it, kills it after PATIENCE_S; its exit code


def start(pipeline: Pipeline, serve: Serve, slots: int) -> Started:
    """A process that calls `serve` with a pipeline of its own, to which `slots` messages may be on their way."""
    file = shared_file(slots)
    try:
        started = _copied(pipeline, serve, file) or _program(pipeline, serve, file)
    finally:
        if file is not None:
            os.close(file)  # what is mapped stays
    for pipe in (started.to, started.back):
        _widen(pipe)
    return started


def keep_memory() -> None:
    """Let this process keep what it has freed."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # another C library
        for (_, number), size in _KEEP_MEMORY.items():
            ctypes.CDLL(None).mallopt(number, size)


def _copied(pipeline: Pipeline, serve: Serve, file: int | None) -> Started | None:
    """A copy of this process; None where other threads may hold what the copy would wait for."""
    with single_threaded_opencv():  # which ends OpenCV's own threads
        if not _is_alone():
            return None
        (read_shots, to), (back, write_answers) = os.pipe(), os.pipe()
        shared = Shared(file)
        copy = multiprocessing.get_context("fork").Process(
            target=_serve_copy, args=(pipeline, serve, shared, read_shots, write_answers), daemon=True
        )
        copy.start()
    os.close(read_shots)
    os.close(write_answers)

    def end() -> int | None:
        copy.join(PATIENCE_S)
        copy.kill()
        copy.join()
        return copy.exitcode

    return Started(cast(int, copy.pid), shared, os.fdopen(to, "wb"), os.fdopen(back, "rb"), end)


def _is_alone() -> bool:
    """Whether this process is known to have one thread, and may have children."""
    return _TASKS.is_dir() and len(list(_TASKS.iterdir())) == 1 and not multiprocessing.current_process().daemon


def _serve_copy(pipeline: Pipeline, serve: Serve, shared: Shared, read_shots: int, write_answers: int) -> None:
    """What a copy does instead of going on: nothing of what it was copied with is its own, nor closed by it twice."""
    gc.freeze()
    os.setsid()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    for file in [int(entry.name) for entry in Path("/proc/self/fd").iterdir()]:
        if file > 2 and file not in (read_shots, write_answers):
            with contextlib.suppress(OSError):  # that of the list itself
                os.close(file)
    cv2.setNumThreads(1)
    keep_memory()
    serve(pipeline, shared, os.fdopen(read_shots, "rb"), os.fdopen(write_answers, "wb"))


def _program(pipeline: Pipeline, serve: Serve, file: int | None) -> Started:
    # A session of its own: Ctrl-C is for this process, which ends its workers when it is done.
    process = subprocess.Popen(
        [sys.executable, "-c", _PROGRAM],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
        pass_fds=() if file is None else (file,),
        env=os.environ | _ONE_THREAD | {name: str(size) for (name, _), size in _KEEP_MEMORY.items()},
    )
    to, back = cast(IO[bytes], process.stdin), cast(IO[bytes], process.stdout)
    for first in (sys.path, serve, pipeline, file):
        pickle.dump(first, to, protocol=5)
    to.flush()

    def end() -> int | None:
        try:
            return process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()

    return Started(process.pid, Shared(file), to, back, end)


def begin() -> None:
    """What the program does: it is told by its pipe what to serve, and with which pipeline."""
    cv2.setNumThreads(1)  # the workers are the parallelism
    messages = sys.stdin.buffer
    serve, pipeline, file = (pickle.load(messages) for _ in range(3))
    shared = Shared(file)
    gc.freeze()  # what was imported is never garbage
    gc.enable()
    serve(pipeline, shared, messages, sys.stdout.buffer)


def _widen(pipe: IO[bytes]) -> None:
    """Let a pipe hold more, where the system can and will."""
    with contextlib.suppress(ImportError, AttributeError, OSError):
        import fcntl

        fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
