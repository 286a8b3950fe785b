"""Keys as they are pressed, without Enter; nothing where standard input is no terminal."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

ARROWS = {"\x1b[A": "up", "\x1b[B": "down", "\x1bOA": "up", "\x1bOB": "down"}


@contextmanager
def pressed_keys() -> Iterator[Callable[[], str]]:
    """Gives a function that returns the next key, empty if none was pressed; the terminal is as before afterwards."""
    if sys.stdin is None or not sys.stdin.isatty():
        yield lambda: ""
        return
    if sys.platform == "win32":
        yield _next_on_windows
        return
    import termios
    import tty

    handle = sys.stdin.fileno()
    before = termios.tcgetattr(handle)
    tty.setcbreak(handle)  # Ctrl-C stays a signal
    try:
        yield lambda: next_key(handle)
    finally:
        termios.tcsetattr(handle, termios.TCSADRAIN, before)


def next_key(handle: int) -> str:
    """One key from a terminal's file handle: a character, `up` or `down`; empty if none waits."""
    text = _waiting(handle)
    if text == "\x1b":
        text += _waiting(handle) + _waiting(handle)
    return ARROWS.get(text, text)


def _waiting(handle: int) -> str:
    import select

    if not select.select([handle], [], [], 0.0)[0]:
        return ""
    return os.read(handle, 1).decode("latin-1")


def _next_on_windows() -> str:
    import msvcrt

    if not msvcrt.kbhit():  # type: ignore[attr-defined,unused-ignore]
        return ""
    key = str(msvcrt.getwch())  # type: ignore[attr-defined,unused-ignore]
    if key in ("\x00", "\xe0"):
        return {"H": "up", "P": "down"}.get(str(msvcrt.getwch()), "")  # type: ignore[attr-defined,unused-ignore]
    return key
