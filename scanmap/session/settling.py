"""The second look after a session: where the pictures are read from again."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

from scanmap.pipeline import SecondLook
from scanmap.recording import Recorder, open_source
from scanmap.scan import Scan
from scanmap.shot import Shot

Shots = Callable[[], Iterable[Shot]]


def settle(
    second_look: SecondLook, scan: Scan, sources: Sequence[Shots | None], withdrawn: Collection[int]
) -> list[str]:
    """Look again, in `scan`, where something else was taken for the line; returns what went wrong, one line each.

    Args:
        sources: together the pictures of the scan; without any, points can only be given up.
        withdrawn: bearings of the scan, by their index, that nothing is made of.

    Nothing that goes wrong here costs the scan.
    """
    known = [source for source in sources if source is not None]

    def again() -> Iterator[Shot]:
        for source in known:
            yield from source()

    try:
        second_look.settle(scan, again if known else None, withdrawn)
    except Exception as error:
        return [f"the second look at the pictures ended early: {type(error).__name__}: {error}"]
    return []


def read_again(recorder: Recorder | None) -> Shots | None:
    """The shots of a recording that was just written; None without one."""
    if recorder is None or not recorder.shots:
        return None
    return open_source(recorder.path).shots
