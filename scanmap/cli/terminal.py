"""The terminal: standard output that never ends a scan, one-line errors, signals."""

from __future__ import annotations

import errno
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

from rich.console import Console

# A closed terminal sends SIGHUP, which Windows does not know.
_STOPPING = (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
_LOUD_LIBRARIES = {"OPENCV_LOG_LEVEL": "OFF", "OPENCV_FFMPEG_LOGLEVEL": "-8", "RUST_LOG": "off"}


class SteadyOutput:
    """Standard output which falls silent when its reader has gone or its disk is full: a scan goes on.

    `error` keeps what happened, unless it was only a reader that had seen enough (`scanmap ... | head`).
    """

    def __init__(self) -> None:
        self.silent = False
        self.error: OSError | None = None

    @property
    def encoding(self) -> str:
        """What its reader reads; tables are drawn with signs that it has."""
        return getattr(sys.stdout, "encoding", None) or "utf-8"

    def write(self, text: str) -> int:
        """Write, or do nothing where nobody listens."""
        self._attempt(lambda: sys.stdout.write(printable(text, self.encoding)))
        return len(text)

    def flush(self) -> None:
        """Flush, likewise."""
        if sys.stdout is not None:
            self._attempt(sys.stdout.flush)

    def isatty(self) -> bool:
        """Whether a person reads it."""
        return not self.silent and sys.stdout is not None and sys.stdout.isatty()

    def fileno(self) -> int:
        """Of standard output itself."""
        return sys.stdout.fileno()

    def _attempt(self, action: Callable[[], object]) -> None:
        if self.silent or sys.stdout is None:
            return
        try:
            action()
        except (OSError, ValueError) as error:
            self.silent = True
            if isinstance(error, OSError) and error.errno not in (errno.EPIPE, errno.EBADF):
                self.error = error
            # The interpreter flushes once more when it ends, and would complain.
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


output = SteadyOutput()
console = Console(file=output, highlight=False, emoji=False)  # type: ignore[arg-type]


def printable(text: str, encoding: str | None) -> str:
    """The text, with `\\xff` for bytes of file names that are no text, and for what the terminal has no sign for."""
    try:
        text = text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    except UnicodeEncodeError:
        text = text.encode("utf-8", "backslashreplace").decode("utf-8")
    encoding = encoding or "utf-8"
    return text.encode(encoding, "backslashreplace").decode(encoding)


def say(text: str) -> None:
    """One line to the user, taken as it is; broken at words where a person reads it, never in a pipe."""
    console.print(text, markup=False, soft_wrap=not console.is_terminal)


def say_written(out: Path, kept: Path | None) -> None:
    """That a calibration is written, and where the one is now that stood there."""
    say(f"wrote {out}" + (f"; the old one is {kept}" if kept is not None else ""))


def complain(text: str) -> None:
    """One line on standard error, whatever line breaks the text has."""
    with suppress(OSError, ValueError, AttributeError):
        print(printable(f"scanmap: {' '.join(text.split())}", getattr(sys.stderr, "encoding", None)), file=sys.stderr)


class _ToStderr(logging.Handler):
    """Log lines to standard error as it is now: a progress bar may stand there."""

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError, ValueError, AttributeError):
            print(printable(self.format(record), getattr(sys.stderr, "encoding", None)), file=sys.stderr)


def set_up_logging(debug: bool) -> None:
    """Warnings only, or with `debug` everything of scanmap's own; libraries stay as quiet as they can be."""
    if not debug:
        for name, value in _LOUD_LIBRARIES.items():
            os.environ.setdefault(name, value)
    handler = _ToStderr()
    handler.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s" if debug else "warning: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    logging.getLogger("scanmap").setLevel(logging.DEBUG if debug else logging.WARNING)


class Stop:
    """Whether Ctrl-C or SIGTERM asked for an end; orderly once `orderly` was called, at once before it."""

    def __init__(self) -> None:
        self.asked = False
        self.at_once = False
        self._words = ""

    def orderly(self, words: str) -> Callable[[], bool]:
        """From here on the first signal says `words` and only asks; gives what tells whether it did."""
        self._words = words
        return lambda: self.asked

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Take a signal."""
        if self.asked or not self._words:
            self.at_once = True
            raise KeyboardInterrupt
        self.asked = True
        say(f"{self._words} (once more to stop at once)")


@contextmanager
def stop_on_signal() -> Iterator[Stop]:
    """Take Ctrl-C, SIGTERM and a closed terminal; a second one interrupts at once."""
    stop = Stop()
    before = {number: signal.signal(number, stop) for number in _STOPPING}
    try:
        yield stop
    except BaseException as error:
        if not stop.at_once:
            raise
        # Libraries make other errors of it, when it comes while they are loaded.
        complain("interrupted")
        raise KeyboardInterrupt from error
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
