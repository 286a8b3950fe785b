"""Scan after scan in fast-forward, as in a day and a night: nothing piles up.

A scan of 180 bearings takes three minutes on a head: a day and a night are 480 of them (`ENDURANCE_SCANS=480`).
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
import threading
from pathlib import Path

import pytest

from scanmap import session

QUICK = (
    "calibration.image.width=320", "calibration.image.height=240", "sweep.step_deg=20", "sweep.end_deg=40",
    "twin.room='box'",
)  # fmt: skip


def widen_table_of_names() -> None:
    """Make room in CPython's table of interned names, which else doubles at some moment: 1.9 MB at once.

    A name that is gone leaves its slot in use; only when all slots are, the table is built anew. Scans intern some
    names and let them go, so that the moment comes after hundreds of them, once.
    """
    names = [sys.intern(f"name {number}") for number in range(300_000)]
    names.clear()


def held() -> tuple[int, int, int]:
    """Memory [kB], threads, file handles of this process; memory without what is free and only not given back."""
    gc.collect()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc
        if trim is not None:
            trim(0)
    # Anonymous memory: pages of libraries come and go with what else the machine does.
    status = Path("/proc/self/status").read_text()
    return (
        int(status.split("RssAnon:")[1].split()[0]),
        threading.active_count(),
        len(list(Path("/proc/self/fd").iterdir())),
    )


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts handles in /proc")
def test_nothing_piles_up_from_scan_to_scan(tmp_path: Path) -> None:
    seen = []
    widen_table_of_names()
    for number in range(int(os.environ.get("ENDURANCE_SCANS", "300"))):
        outputs = session.Outputs((tmp_path / "a.ply",), record=tmp_path / "a.mcap")
        with session.prepare_scan(session.Choice("twin-quick", QUICK), outputs, view=False) as job:
            assert job.run(lambda _: None, lambda: False).ended == "finished"
        (tmp_path / "a.mcap").unlink()
        seen.append(held())
        if number in (19, 49) or number % 100 == 99:
            print(f"after {number + 1} scans: {seen[-1][0]} kB, {seen[-1][1]} threads, {seen[-1][2]} handles")
    settled, last = seen[len(seen) // 3], seen[-1]
    assert last[1:] == settled[1:]
    assert last[0] < settled[0] + 1000
