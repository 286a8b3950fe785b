"""Shot to Step: the one loop, and its decode workers. Grid, guard and view come in as sinks."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from scanmap.laserline import LaserLine
from scanmap.shot import Shot
from scanmap.triangulation import Profile


class Step(NamedTuple):
    """One shot, and what was made of it."""

    shot: Shot
    line: LaserLine  # (H,)
    profile: Profile  # (H,) head frame
    fault: str = ""  # what was wrong with the image; empty when nothing was


Sink = Callable[[Step], None]
