"""Shots that a sweep took back: which they are, of all parts of a recording."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from scanmap.recording import layout, mcap_records, messages
from scanmap.recording.layout import RecordingParams
from scanmap.recording.mcap_records import DamagedError
from scanmap.recording.messages import Fault, MalformedMessageError
from scanmap.recording.outline import Outline
from scanmap.recording.source import Report
from scanmap.shot import Shot, Withdrawal


class Withdrawn(NamedTuple):
    """A note that takes back the shots of an index that stand before it."""

    part: int  # number of the file, from 0
    offset: int  # byte of its record
    indices: frozenset[int]
    why: Withdrawal


class Withdrawals:
    """Leaves out the recorded shots that were taken back afterwards."""

    def __init__(self, notes: list[Withdrawn], params: RecordingParams) -> None:
        self._notes = _obeyed(notes, params)
        self._left_out: set[int] = set()
        self._kept: set[int] = set()

    def keeps(self, shot: Shot, part: int, offset: int) -> bool:
        """Whether the shot that stands in file number `part`, at byte `offset`, still counts."""
        gone = any((note.part, note.offset) > (part, offset) and shot.index in note.indices for note in self._notes)
        (self._left_out if gone else self._kept).add(shot.index)
        return not gone

    def account(self, path: Path, report: Report) -> None:
        """Say what was left out and did not come again."""
        missing = self._left_out - self._kept
        if not missing:
            return
        reasons = " or ".join(sorted({layout.WITHDRAWN_WORDS[note.why] for note in self._notes}))
        report(
            f"{len(missing)} shots that the sweep took back are left out ({reasons}): {ranges(missing)}; "
            f"scanmap scan --resume {path} takes them again"
        )


def withdrawals(outlines: list[Outline]) -> list[Withdrawn]:
    """What the diagnostics of a recording of ours say was taken back."""
    notes = []
    for part, found in enumerate(outlines):
        for offset, fault in noted_faults(found):
            why = fault.details.get(layout.WITHDRAWN_WHY_DETAIL, "")
            if why in {reason.value for reason in Withdrawal}:
                notes.append(Withdrawn(part, offset, withdrawn_indices(fault), Withdrawal(why)))
    return notes


def withdrawn_indices(fault: Fault) -> frozenset[int]:
    """Indices of the shots that a note takes back."""
    numbers = fault.details.get(layout.WITHDRAWN_DETAIL, "").split()
    return frozenset(int(number) for number in numbers if number.isdecimal())


def left_out(notes: list[Withdrawn], params: RecordingParams) -> int:
    """How many shots the notes take back."""
    return sum(len(note.indices) for note in _obeyed(notes, params))


def _obeyed(notes: list[Withdrawn], params: RecordingParams) -> list[Withdrawn]:
    kept = {"leave-out": (), "keep-unlit": (Withdrawal.LINE,), "keep": tuple(Withdrawal)}[params.withdrawn]
    return [note for note in notes if note.why not in kept]


def noted_faults(part: Outline) -> list[tuple[int, Fault]]:
    """Warnings and errors on the diagnostics topics of a file, with the bytes where they stand."""
    found: list[tuple[int, Fault]] = []
    with mcap_records.open_mcap(part.path) as file:
        for chunk in part.diagnostics:
            try:
                for opcode, view in mcap_records.chunk_records(mcap_records.body(file, chunk)):
                    if opcode != mcap_records.MESSAGE:
                        continue
                    message = mcap_records.message(view)
                    channel = part.directory.channels.get(message.channel_id)
                    if channel is not None and channel.message_type == layout.DIAGNOSTIC_ARRAY:
                        found += [(chunk.offset, fault) for fault in messages.read_faults(message.data)]
            except (DamagedError, MalformedMessageError):
                continue  # the reading of the shots says so
    return [(offset, fault) for offset, fault in found if fault.level > 0]


def ranges(indices: Collection[int]) -> str:
    """`2 to 5, 9`."""
    runs: list[list[int]] = []
    for index in sorted(indices):
        if runs and index == runs[-1][-1] + 1:
            runs[-1].append(index)
        else:
            runs.append([index])
    return ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 1 else str(run[0]) for run in runs)
