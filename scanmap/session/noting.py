"""What a rig's drivers warn of while a scan runs, kept in its recording: a camera that came back, a line sent again."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from scanmap.errors import ScanmapError

DRIVERS = "scanmap.rig"  # the logger above those of cameras and stages

Note = Callable[[str, str], None]  # told of a fault, one line, and whose it is: `camera` or `stage`


@contextmanager
def noting(note: Note) -> Iterator[None]:
    """Hand every warning of the drivers on while this is open; drivers' threads may warn as well."""
    handler = _Handler(note)
    drivers = logging.getLogger(DRIVERS)
    drivers.addHandler(handler)
    try:
        yield
    finally:
        drivers.removeHandler(handler)


class _Handler(logging.Handler):
    def __init__(self, note: Note) -> None:
        super().__init__(logging.WARNING)
        self._note = note
        self._last = ""

    def emit(self, record: logging.LogRecord) -> None:
        words = record.getMessage()
        if words != self._last:  # what repeats in a loop is said once
            self._last = words
            with suppress(ScanmapError):  # a disk that is full is told of by the next shot
                self._note(words, "camera" if ".camera" in record.name else "stage")
