"""A second look at the pictures in which something else was taken for the laser line, once the sweep is known.

Two things are known after a sweep that no picture knows of itself: what stands still (`still`), and how bright surfaces
are in the laser's light. Light and width of a line, times the square of its range, are what the surface reflects: 400
times less than the usual surface of this scan is less than black paint seen at a grazing angle.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import BLOCK, Reason
from scanmap.pipeline.running import run
from scanmap.pipeline.step import Pipeline, Step
from scanmap.pipeline.still import FIRST, ROWS, StillThings
from scanmap.scan import Scan
from scanmap.shot import Shot

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

_LOOKS = 3  # each may show what was hidden behind the last
_LEAST_ROWS = 8  # of a picture that are worth another look
# Rows of places asked together; the share of those with a point, and the number, that must agree.
_NEAR, _MOSTLY, _AGREE = 5, 0.6, 4
# A point this close to the axis may be any of nearly all columns of the picture, and seldom is there such a thing.
_CLOSE_M, _AGREE_CLOSE = 0.5, 2
_DIM, _UNCLIPPED = 0.0025, 200.0  # of the usual reflectance; grey levels up to which a height says how bright a line is
_ALIKE_PX = 4.0  # how far the line may run from the row that was asked, of ROWS
_AROUND_PX = 8  # beside a line that is none, nothing is looked for


class SecondLook:
    """Collects what a sweep saw beside the line; afterwards looks again where that was taken for the line."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._still = StillThings(pipeline.calibration, pipeline.window)
        self._keys: list[tuple[float, float]] = []
        self._reflectance: list[F32] = []
        self._places: list[F32 | None] = []

    def __call__(self, step: Step) -> None:
        """A sink: note one step; they come in the order in which their profiles are added to the scan."""
        self._keys.append((step.shot.time, step.shot.bearing))
        self._reflectance.append(_reflectance(step))
        self._places.append(None if step.fault else step.places)

    def settle(
        self, scan: Scan, shots: Callable[[], Iterable[Shot]] | None, without: Collection[int] = frozenset()
    ) -> int:
        """Replace in `scan`, in place, what was not the line; returns how many points were another's or given up.

        Args:
            scan: holds the profiles of the steps seen, in their order.
            shots: the same shots once more; None where they are gone, and points can only be given up.
            without: bearings of the scan, by their index, that are left alone and say nothing.
        """
        doubted, usual = 0, self._usual()
        asked = np.array([k for k in range(len(scan)) if k not in without], np.intp)
        for k in asked:
            if (places := self._places[k]) is not None:
                self._still.add(float(scan.bearings[k]), places)
        for looks_left in range(_LOOKS if shots is not None else 0, -1, -1):
            wrong = self._wrong(scan, asked, usual)
            asked = np.flatnonzero(wrong.sum(axis=1) >= _LEAST_ROWS)
            if not asked.size:
                break
            wrong[np.setdiff1d(np.arange(len(scan)), asked)] = False
            doubted += int(wrong.sum())
            masks = {int(k): self._mask(scan, int(k), wrong[k]) for k in asked} if looks_left else {}
            scan.give_up(wrong, Reason.AMBIGUOUS)
            if looks_left and shots is not None:
                self._look_again(scan, wrong, masks, shots())
        return doubted

    def _usual(self) -> float:
        known = np.concatenate(
            [values[np.isfinite(values)][::4] for values in self._reflectance] or [np.empty(0, np.float32)]
        )
        return float(np.median(known)) if known.size else 0.0

    def _wrong(self, scan: Scan, asked: NDArray[np.intp], usual: float) -> Mask:
        """Cells (B, H) of the bearings `asked` that are not the line."""
        wrong = np.zeros((len(scan), scan.rows), bool)
        valid = scan.valid
        for k in asked:
            with np.errstate(invalid="ignore"):
                wrong[k] = valid[k] & (self._reflectance[k] < _DIM * usual)
        if not self._still.count():
            return wrong
        column = scan.column_px[asked, FIRST::ROWS]
        i, j = np.nonzero(valid[asked, FIRST::ROWS])
        row = j * ROWS + FIRST
        distance = np.hypot(*np.moveaxis(scan.points[asked[i], row, :2], -1, 0)).astype(np.float64)
        stands, known, close = (np.zeros(column.shape, np.float32) for _ in range(3))
        known[i, j], close[i, j] = 1.0, distance < _CLOSE_M
        stands[i, j] = self._still.stands(scan.bearings[asked[i]], row, column[i, j].astype(np.float64), distance)
        together = np.ones(_NEAR)
        for k, values, have, nearby in zip(asked, stands, known, close, strict=True):
            if values.any():
                near, all_near = (np.convolve(v, together, "same") for v in (values, have))
                still = (near >= _MOSTLY * all_near) & (near >= np.where(nearby > 0, _AGREE_CLOSE, _AGREE))
                wrong[k] |= _over_rows(still, scan.column_px[k]) & valid[k]
        return wrong

    def _mask(self, scan: Scan, k: int, wrong: Mask) -> Mask:
        """Where a picture's line is not to be looked for: what stands still, and what was taken for it."""
        mask = self._still.mask(float(scan.bearings[k]), BLOCK)
        row = np.flatnonzero(wrong)
        column = np.rint(scan.column_px[k, row]).astype(np.intp)[:, None] + np.arange(-_AROUND_PX, _AROUND_PX + 1)
        mask[row[:, None] // BLOCK, np.clip(column, 0, mask.shape[1] - 1)] = True
        return mask

    def _look_again(self, scan: Scan, wrong: Mask, masks: dict[int, Mask], shots: Iterable[Shot]) -> None:
        places: dict[tuple[float, float], list[int]] = {}
        for k in masks:
            places.setdefault(self._keys[k], []).append(k)

        def wanted() -> Iterator[Shot]:
            for shot in shots:
                if (shot.time, shot.bearing) in places:
                    yield shot

        def again(shot: Shot) -> Step:
            return self._pipeline.process(shot, masks[places[shot.time, shot.bearing][0]])

        def take(step: Step) -> None:
            for k in places[step.shot.time, step.shot.bearing]:
                scan.amend(k, wrong[k], step.profile)
                self._reflectance[k] = np.where(wrong[k], _reflectance(step), self._reflectance[k])
            if step.places is not None:
                self._still.add(step.shot.bearing, step.places)

        run(wanted(), again, [take])


def _reflectance(step: Step) -> F32:
    """Light of the line (H,) times the square of its range, NaN where it is clipped or there is none."""
    with np.errstate(invalid="ignore"):
        light = np.where(step.line.peak < _UNCLIPPED, step.line.peak * step.line.width_px, np.nan)
        return (light * step.profile.range_m**2).astype(np.float32)


def _over_rows(asked: Mask, column: F32) -> Mask:
    """Verdicts on one row in ROWS, over the rows (H,) around it that have the same line."""
    index = np.minimum(np.arange(len(column)) // ROWS, len(asked) - 1)
    with np.errstate(invalid="ignore"):
        same = np.abs(column - column[FIRST::ROWS][index]) < _ALIKE_PX
    verdict: Mask = asked[index] & (same | np.isnan(column[FIRST::ROWS][index]))
    return verdict
