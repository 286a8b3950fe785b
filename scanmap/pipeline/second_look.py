"""A second look at the pictures in which something else was taken for the laser line, once the sweep is known.

Two things are known after a sweep that no picture knows of itself: what stands still (`still`), and how bright surfaces
are in the laser's light. Light and width of a line, times the square of its range, are what the surface reflects: 400
times less than the usual surface of this scan is less than black paint seen at a grazing angle.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import BLOCK, Reason, ridge_of
from scanmap.pipeline.running import run
from scanmap.pipeline.step import Pipeline, Step
from scanmap.pipeline.still import SHARE, StillThings
from scanmap.scan import Scan
from scanmap.shot import Shot

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Shots = Callable[[], Iterable[Shot]]

_LOOKS = 3  # each may show what was hidden behind the last
_LEAST_ROWS = 8  # of a picture that are worth another look
_DIM, _UNCLIPPED = 0.0025, 200.0  # of the usual reflectance; grey levels up to which a height says how bright a line is
_AROUND_PX = 8  # beside a line that is none, nothing is looked for
_APART = float(np.radians(2.9))  # between pictures that are compared with others
_SUSPECT = 0.4  # share of the pictures that must list a place as line-like, for some of all to be read again
_NEXT = 1.5  # times that, within which what stands beside a picture is asked in others too


class SecondLook:
    """Collects what a sweep saw beside the line; afterwards looks again where that was taken for the line."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._keys: list[tuple[float, float]] = []
        self._reflectance: list[F32] = []
        self._ridge: list[F32] = []
        self._places: list[F32 | None] = []

    def __call__(self, step: Step) -> None:
        """A sink: note one step; they come in the order in which their profiles are added to the scan."""
        self._keys.append((step.shot.time, step.shot.bearing))
        self._reflectance.append(_reflectance(step))
        self._ridge.append(ridge_of(step.line.peak, step.line.width_px).astype(np.float32))
        self._places.append(None if step.fault else step.places)

    def settle(self, scan: Scan, shots: Shots | None, without: Collection[int] = frozenset()) -> int:
        """Replace in `scan`, in place, what was not the line; returns how many points were another's or given up.

        Args:
            scan: holds the profiles of the steps seen, in their order.
            shots: the same shots once more; None where they are gone, and points can only be given up.
            without: bearings of the scan, by their index, that are left alone and say nothing.
        """
        asked = [k for k in range(len(scan)) if k not in without]
        usual = self._usual()
        views = _apart(scan.bearings, [k for k in asked if self._places[k] is not None])
        still = self._listed(scan, views)
        # Most scans of plain rooms need not be read again.
        if shots is not None and any(self._stands(scan, k, still, _SUSPECT).sum() >= _LEAST_ROWS for k in views):
            still = self._shown(scan, views, shots())
        wrong = np.zeros((len(scan), scan.rows), bool)
        for k in asked:
            with np.errstate(invalid="ignore"):
                wrong[k] = self._reflectance[k] < _DIM * usual
        for k in views:
            wrong[k] |= self._stands(scan, k, still)
        for k in _beside(scan.bearings, asked, views, [k for k in views if wrong[k].any()]):
            wrong[k] |= self._stands(scan, k, still)
        wrong &= scan.valid
        again = wrong.sum(axis=1) >= _LEAST_ROWS
        if shots is None or not again.any():
            scan.give_up(wrong, Reason.AMBIGUOUS)
        else:
            self._look_again(scan, wrong, again, still, usual, shots())
        return int(wrong.sum())

    def _stands(self, scan: Scan, k: int, still: StillThings, share: float = SHARE) -> Mask:
        return still.line(float(scan.bearings[k]), scan.column_px[k], self._ridge[k], share)

    def _usual(self) -> float:
        known = np.concatenate(
            [values[np.isfinite(values)][::4] for values in self._reflectance] or [np.empty(0, np.float32)]
        )
        return float(np.median(known)) if known.size else 0.0

    def _shown(self, scan: Scan, views: list[int], shots: Iterable[Shot]) -> StillThings:
        """What the pictures of some bearings show, read once more."""
        still, wanted = StillThings(self._pipeline.calibration), {self._keys[k] for k in views}
        with ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="decode") as pool:
            some = (shot for shot in shots if (shot.time, shot.bearing) in wanted)
            for bearing, ridges in pool.map(lambda shot: (shot.bearing, self._pipeline.ridges(shot)), some):
                if ridges is not None:
                    still.add(bearing, ridges)
        return still

    def _listed(self, scan: Scan, views: list[int]) -> StillThings:
        """What was listed as line-like in the pictures of some bearings: less, but known without them."""
        still, own = StillThings(self._pipeline.calibration), self._pipeline.calibration.intrinsics
        for k in views:
            places = np.asarray(self._places[k])
            i, j = np.nonzero(np.isfinite(places))
            ridges = np.zeros((len(places), own.width), np.uint8)
            ridges[i, np.clip(np.rint(places[i, j]), 0, own.width - 1).astype(np.intp)] = 255
            # One row in two blocks was listed.
            still.add(float(scan.bearings[k]), np.repeat(ridges, 2, axis=0))
        return still

    def _look_again(
        self, scan: Scan, wrong: Mask, again: Mask, still: StillThings, usual: float, shots: Iterable[Shot]
    ) -> None:
        """Give up the cells `wrong` (B, H), and fill those without a point of the pictures `again` (B,)."""
        places: dict[tuple[float, float], list[int]] = {}
        masks = {}
        for k in map(int, np.flatnonzero(again)):
            places.setdefault(self._keys[k], []).append(k)
            masks[k] = self._around(scan.column_px[k], wrong[k])
        scan.give_up(wrong, Reason.AMBIGUOUS)

        def wanted() -> Iterator[Shot]:
            for shot in shots:
                if (shot.time, shot.bearing) in places:
                    yield shot

        def look(shot: Shot) -> Step:
            mask = masks[places[shot.time, shot.bearing][0]]
            ridges = self._pipeline.ridges(shot)
            if ridges is not None:
                mask |= still.mask(shot.bearing, ridges)
            for looks_left in range(_LOOKS - 1, -1, -1):
                step = self._pipeline.process(shot, mask)
                with np.errstate(invalid="ignore"):
                    false = _reflectance(step) < _DIM * usual
                false |= still.line(shot.bearing, step.line.column_px, ridge_of(step.line.peak, step.line.width_px))
                if looks_left == 0 or false.sum() < _LEAST_ROWS:
                    break
                mask |= self._around(step.line.column_px, false)
            step.profile.reason[false] = Reason.AMBIGUOUS
            return step

        def take(step: Step) -> None:
            for k in places[step.shot.time, step.shot.bearing]:
                scan.amend(k, ~scan.valid[k] & (step.profile.reason == Reason.OK), step.profile)

        run(wanted(), look, [take])

    def _around(self, column: F32 | F64, rows: Mask) -> Mask:
        """(ceil(H / BLOCK), W) that is True around the line's columns (H,) in some rows (H,)."""
        mask = np.zeros((-(-len(rows) // BLOCK), self._pipeline.calibration.intrinsics.width), bool)
        row = np.flatnonzero(rows)
        around = np.rint(column[row]).astype(np.intp)[:, None] + np.arange(-_AROUND_PX, _AROUND_PX + 1)
        mask[row[:, None] // BLOCK, np.clip(around, 0, mask.shape[1] - 1)] = True
        return mask


def _reflectance(step: Step) -> F32:
    """Light of the line (H,) times the square of its range, NaN where it is clipped or there is none."""
    with np.errstate(invalid="ignore"):
        light = np.where(step.line.peak < _UNCLIPPED, step.line.peak * step.line.width_px, np.nan)
        return (light * step.profile.range_m**2).astype(np.float32)


def _apart(bearings: F64, some: list[int]) -> list[int]:
    """Those of some bearings [rad], by their index, that see something new: no second turn, nor closely beside."""
    turn = 2.0 * np.pi
    chosen: list[int] = []
    for k in sorted(some, key=lambda k: (bearings[k] % turn, bearings[k])):
        if not chosen or bearings[k] % turn - bearings[chosen[-1]] % turn >= _APART:
            chosen.append(k)
    return chosen


def _beside(bearings: F64, asked: list[int], views: list[int], some: list[int]) -> list[int]:
    """Those of the bearings [rad] `asked` that lie next to `some` of the views, by their index, and are no views."""
    turn = (bearings[:, None] - bearings[some] + np.pi) % (2.0 * np.pi) - np.pi
    near = np.any(np.abs(turn) <= _NEXT * _APART, axis=1)
    near[views] = False
    return [k for k in asked if near[k]]
