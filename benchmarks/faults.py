"""Every fault at random moments of a scan: noticed when, what was lost, is the laser off, does a resumed scan equal?

    python benchmarks/faults.py [--moments 20] [--homing hand|switch] [--mode step|continuous] [FAULT ...]

Small pictures, few bearings, a board in fast-forward; seeded. Writes the table of docs/reliability.md.
"""

from __future__ import annotations

import argparse
import errno
import functools
import logging
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scanmap import session
from scanmap.errors import CameraError, ScanmapError
from scanmap.recording import describe, open_source
from scanmap.rig import Frame
from scanmap.scan.formats import read_ply
from scanmap.session import preparing, rigs
from scanmap.session.rigs import OpenRig, TwinDevices, open_rig
from scanmap.shot import Shot
from scanmap.twin import TruthReport

SETTINGS = (
    "calibration.image.width=320", "calibration.image.height=240", "sweep.step_deg=8", "sweep.end_deg=80",
    "sweep.off_frames=true", "stage.timeout_s=0.3", "recording.min_free_mb=0",
)  # fmt: skip
MODES = {"step": (), "continuous": ("sweep.mode='continuous'", "sweep.step_deg=2", "sweep.off_frames=false")}
ELSEWHERE_RAD = math.radians(0.5)  # a head whose place was told by pictures is nearer
EXPOSED: dict[bytes, tuple[float, bool]] = {}  # of every picture that a twin took: true bearing [rad], laser on
HOMING = {"hand": (), "switch": ("stage.homing='switch'", "twin.drive.switch_deg=-3.0", "stage.home_deg=-2")}


@dataclass
class Scene:
    """What a fault can lay hands on."""

    twin: TwinDevices
    job: session.Job


Fault = Callable[[Scene], None]
Settings = tuple[str, ...]


def _no_camera(scene: Scene, times: int = 1 << 30) -> None:
    grab, left = scene.twin.camera.grab, [times]

    def broken() -> Any:
        left[0] -= 1
        if left[0] < 0:
            return grab()
        raise CameraError("the camera is gone")

    scene.twin.camera.grab = broken  # type: ignore[method-assign]


def _frozen(scene: Scene) -> None:
    frame = scene.twin.camera.grab()
    scene.twin.camera.grab = lambda: frame  # type: ignore[method-assign]


class _Disk:
    """Stands before a recording's file: slow, or full after some bytes."""

    def __init__(self, file: Any, room: float, delay_s: float) -> None:
        self._file, self._room, self._delay_s = file, room, delay_s

    def write(self, data: Any) -> int:
        time.sleep(self._delay_s)
        if len(data) > self._room:
            self._file.write(data[: int(self._room)])
            raise OSError(errno.ENOSPC, "No space left on device")
        self._room -= len(data)
        return int(self._file.write(data))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def _disk(scene: Scene, room: float, delay_s: float = 0.0) -> None:
    assert scene.job.recorder is not None
    file = scene.job.recorder._file
    file._raw = _Disk(file._raw, room, delay_s)


def _set(name: str, value: object) -> Fault:
    return lambda scene: setattr(scene.twin.firmware.faults, name, value)


FAULTS: dict[str, Fault] = {
    "camera unplugged": _no_camera,
    "two bad frames": lambda scene: _no_camera(scene, 2),
    "camera frozen": _frozen,
    "stage unplugged": _set("unplugged", True),
    "board hangs": _set("mute", True),
    "brown-out": lambda scene: scene.twin.firmware.power_cycle(),
    "limit switch": lambda scene: scene.twin.firmware.trip_limit(),
    "4 deg of steps lost": lambda scene: scene.twin.firmware.drivetrain.slip(320),
    "motor stalled": lambda scene: setattr(scene.twin.firmware.drivetrain, "stalled", True),
    "laser dead": lambda scene: setattr(scene.twin.firmware, "laser_dead", True),
    "lost ok": _set("lose_ok", 1),
    "lost line": _set("lose_lines", 1),
    "lost status": _set("lose_status", 2),
    "garbage": _set("garbage", bytes(range(256))),
    "slow disk": lambda scene: _disk(scene, math.inf, 0.02),
    "full disk": lambda scene: _disk(scene, 3000.0),
}


def _witness(opened: OpenRig) -> None:
    """Keep what every picture truly shows."""
    assert opened.twin is not None
    camera = opened.twin.camera
    grab = camera.grab

    def witnessed() -> Frame:
        state = camera._state()
        frame = grab()
        EXPOSED[frame.image] = state
        return frame

    camera.grab = witnessed  # type: ignore[method-assign]


@dataclass
class Tally:
    """What became of the scans that one fault was put into."""

    runs: int = 0
    overcome: int = 0  # scans that finished in spite of it
    after: list[int] = field(default_factory=list)  # shots recorded between fault and end
    lost: int = 0  # shots recorded and not readable
    wrong: int = 0  # shots recorded, also after resuming, that show another place, or no line
    shining: int = 0  # scans after which the laser shines
    equal: int = 0  # of the scans, finished or resumed, that equal an undisturbed one
    words: set[str] = field(default_factory=set)

    def row(self, name: str) -> str:
        stopped = self.runs - self.overcome
        after = f"{max(self.after)}" if self.after else "-"
        return (
            f"| {name} | {self.overcome} / {stopped} | {after} | {self.lost} | {self.wrong} | "
            f"{self.runs - self.shining} / {self.runs} | {self.equal} / {self.runs} |"
        )


def scan(
    folder: Path, settings: Settings, resume: Path | None = None, fault: Fault | None = None, moment: int = -1
) -> Any:
    """One scan: result or None, error, writes to the board, shots recorded at the fault, whether the laser shines."""
    writes, at_fault = [0], [-1]
    opened: list[OpenRig] = []

    def sabotaged(*words: Any) -> OpenRig:
        opened.append(open_rig(*words))
        _witness(opened[-1])
        return opened[-1]

    preparing.open_rig = sabotaged  # type: ignore[assignment]
    record = None if resume is not None else folder / "a.mcap"
    outputs = session.Outputs((folder / ("b.ply" if resume else "a.ply"),), record=record)
    choice = session.Choice() if resume is not None else session.Choice("twin-quick", settings)
    result, error = None, None
    try:
        with session.prepare_scan(choice, outputs, view=False, resume=resume) as job:
            twin = opened[0].twin
            assert twin is not None
            board, plain = twin.firmware, twin.firmware.write

            def write(data: bytes) -> None:
                writes[0] += 1
                if writes[0] == moment and fault is not None and job.recorder is not None:
                    at_fault[0] = job.recorder.shots
                    fault(Scene(twin, job))
                plain(data)

            board.write = write  # type: ignore[method-assign]
            result = job.run(lambda _: None, lambda: False)
            error = result.error
    except (ScanmapError, OSError) as raised:
        error = raised
    return result, error, writes[0], at_fault[0], bool(opened) and opened[0].twin.firmware.laser_on  # type: ignore[union-attr]


def is_elsewhere(shot: Shot) -> bool:
    """Whether a recorded picture shows another place than it should, or no line: by what the twin knows of it."""
    bearing, lit = EXPOSED[shot.image]
    return not lit or abs(bearing - shot.bearing) > ELSEWHERE_RAD


def is_same(cloud: Path, clean: Path, truth: TruthReport | None, clean_truth: TruthReport) -> bool:
    """Whether a scan has every bearing and, but for the noise of pictures taken again, the points of another.

    A continuous sweep never meets the same bearings twice: it must be as complete, and as true to the room.
    """
    if not cloud.exists() or truth is None:
        return False
    one, other = read_ply(cloud), read_ply(clean)
    if not np.array_equal(one.bearings, other.bearings):
        all_there = bool((np.abs(one.bearings[:, None] - other.bearings).min(axis=0) < math.radians(1.0)).all())
        return (
            all_there
            and truth.completeness > 0.98 * clean_truth.completeness
            and truth.within_1cm > 0.98 * clean_truth.within_1cm
            and truth.beyond_10cm < clean_truth.beyond_10cm + 0.01
        )
    apart = np.abs(one.range_m - other.range_m) / np.hypot(one.sigma_m, other.sigma_m)
    both = one.valid & other.valid
    return bool(both.sum() > 0.97 * other.valid.sum() and (apart[both] < 6.0).mean() > 0.97)


@dataclass(frozen=True)
class Clean:
    """An undisturbed scan."""

    folder: Path
    settings: Settings
    writes: int  # words to the board
    truth: TruthReport


def campaign(name: str, moments: int, clean: Clean, rng: np.random.Generator) -> Tally:
    """One fault at so many moments."""
    whole = {shot.index: shot for shot in open_source(clean.folder / "a.mcap").shots()}
    tally = Tally()
    for moment in rng.integers(1, clean.writes + 1, moments):
        with tempfile.TemporaryDirectory() as text:
            folder = Path(text)
            result, error, _, at_fault, shining = scan(folder, clean.settings, fault=FAULTS[name], moment=int(moment))
            if at_fault < 0:
                continue
            tally.runs += 1
            tally.shining += shining
            recording, cloud = folder / "a.mcap", folder / "a.ply"
            recorded = describe(recording).shots if recording.exists() else 0
            shots = list(open_source(recording).shots()) if recorded else []
            if error is None:
                tally.overcome += 1
            else:
                tally.words.add(str(error))
                tally.after.append(recorded - at_fault)
            tally.lost += max(0, (result.shots if result is not None else at_fault) - recorded)
            if not recorded:
                recording.unlink(missing_ok=True)
                result, error, *_ = scan(folder, clean.settings)
            elif error is not None and {shot.index for shot in shots} < whole.keys():
                cloud = folder / "b.ply"
                result, error, *_ = scan(folder, clean.settings, resume=recording)
            if recording.exists():  # with the part that was added
                tally.wrong += sum(map(is_elsewhere, open_source(recording).shots()))
            EXPOSED.clear()
            same = is_same(cloud, clean.folder / "a.ply", result.truth if result else None, clean.truth)
            tally.equal += same
            if not same:
                tally.words.add(f"UNEQUAL: moment {moment}: {error}")
    return tally


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("faults", nargs="*", metavar="FAULT", help=", ".join(FAULTS))
    parser.add_argument("--moments", type=int, default=20)
    parser.add_argument("--homing", choices=list(HOMING), default="hand")
    parser.add_argument("--mode", choices=list(MODES), default="step")
    parser.add_argument("--words", action="store_true", help="print every message")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    rigs.build_scene = functools.lru_cache(rigs.build_scene)  # the light of the room is computed once
    print("| fault | overcome / stopped | noticed after (shots) | lost | wrong | laser off | equal |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as text:
        settings = (*SETTINGS, *MODES[options.mode], *HOMING[options.homing])
        result, error, writes, *_ = scan(Path(text), settings)
        assert error is None, error
        clean = Clean(Path(text), settings, writes, result.truth)
        for name in options.faults or FAULTS:
            rng = np.random.default_rng(sum(map(ord, name)))
            tally = campaign(name, options.moments, clean, rng)
            print(tally.row(name), flush=True)
            for words in sorted(tally.words) if options.words else ():
                print("    ", words)


if __name__ == "__main__":
    main()
