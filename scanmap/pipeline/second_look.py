"""A second look at the pictures in which something else was taken for the laser line, once the sweep is known.

Two things are known after a sweep that no picture knows of itself: what stands still (`still`), and how bright surfaces
are in the laser's light (`reflectance`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import BLOCK, Reason, ridge_of
from scanmap.pipeline.neighbours import Neighbours, neighbours_of
from scanmap.pipeline.placing import Lines, place_lines
from scanmap.pipeline.reflectance import Usual, reflectance, shape_of
from scanmap.pipeline.running import run
from scanmap.pipeline.step import Pipeline, Step
from scanmap.pipeline.still import SHARE, StillThings
from scanmap.scan import Scan
from scanmap.scan.second_lines import Pictures
from scanmap.shot import Shot
from scanmap.triangulation import locate

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Shots = Callable[[], Iterable[Shot]]

_TURNS = 3  # at first many of the neighbours are as wrong; after that they are asked
_LOOKS = 3  # each may show what was hidden behind the last
_LEAST_ROWS = 8  # of a picture that are worth another look
# Share of points that were another thing's, from which on the line itself is looked for once more, in pictures that
# have so many rows without a point though a place is listed where it should be.
_HARD, _WORTH_ROWS = 0.01, 24
_AROUND_PX = 8  # beside a line that is none, nothing is looked for
_APART = float(np.radians(2.9))  # between pictures that are compared with others
_SUSPECT = 2 / 3  # of the share that is asked of pictures, where they list what is like a line, to read them again
# A line found where others are hidden stands out of its picture this near, by such a part of what its height and width
# are worth, or by so many grey levels where these are not known.
_WITHIN_PX, _SHOWN, _LEAST_SHOWN = 2, 0.25, 2.0
_NEXT = 1.5  # times that, within which what stands beside a picture is asked in others too


class _Known(NamedTuple):
    """What a sweep knows at one moment."""

    still: StillThings
    shown: bool  # whether that comes from all that the pictures show, or what was listed
    neighbours: Neighbours | None  # None at first
    usual: Usual
    choosing: bool = False  # whether only what goes on from the neighbours is wanted

    def share(self, k: int, range_m: F32 | F64) -> F64:
        """As `Neighbours.share` has it; the same for all while they are not known."""
        return np.full(len(range_m), SHARE) if self.neighbours is None else self.neighbours.share(k, range_m)


class SecondLook:
    """Collects what a sweep saw beside the line; afterwards looks again where that was taken for the line."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._lines = Lines([], [], [], [], [])
        self._places: list[F32 | None] = []  # of pictures without laser-off frames: what does not change is gone there
        self._listed_in: list[F32 | None] = []
        self._others: dict[int, list[F32]] = {}  # columns (H,) that showed another thing, by bearing; NaN elsewhere

    def __call__(self, step: Step) -> None:
        """A sink: note one step; they come in the order in which their profiles are added to the scan."""
        self._lines.note(step)
        places = None if step.fault else step.places
        self._places.append(places if step.shot.background is None else None)
        self._listed_in.append(places)

    def settle(self, scan: Scan, shots: Shots | None, without: Collection[int] = frozenset()) -> int:
        """Replace in `scan`, in place, what was not the line; returns how many points were another's or given up.

        Lines of beams that an edge cut are put back where they belong.

        Args:
            scan: holds the profiles of the steps seen, in their order.
            shots: the same shots once more; None where they are gone, and points can only be given up.
            without: bearings of the scan, by their index, that are left alone and say nothing.
        """
        asked = [k for k in range(len(scan)) if k not in without]
        views = _apart(scan.bearings, [k for k in asked if self._places[k] is not None])
        usual = Usual.of(self._lines.reflectance, self._lines.shape)
        known, total = _Known(self._listed(scan, views), False, None, usual), 0
        for _ in range(_TURNS):
            # Most scans of plain rooms need not be read again, nor asked more.
            suspect = shots is None or known.shown or self._suspected(scan, views, known)
            if shots is not None and suspect and not known.shown:
                known = known._replace(still=self._shown(views, shots()), shown=True)
            wrong = self._wrong(scan, asked, views if suspect else [], known)
            total += int(wrong.sum())
            again = wrong.sum(axis=1) >= _LEAST_ROWS
            if known.shown and known.neighbours is None:
                again[views] |= self._open(scan, views)
            self._look_again(scan, wrong, again, known, shots)
            if known.neighbours is not None and not (views and wrong.any()):
                break
            known = known._replace(neighbours=neighbours_of(scan.bearings, scan.range_m, asked))
        if known.shown and total >= _HARD * scan.valid.sum():
            self._choose(scan, views, known._replace(choosing=True), shots)
        place_lines(scan, self._pipeline, self._lines, asked, shots)
        return total

    def _suspected(self, scan: Scan, views: list[int], known: _Known) -> bool:
        """Whether what was taken for the line in one of the views may be among the things that were listed."""
        if ((scan.reason[views] == Reason.RIVALS).sum(axis=1) >= _LEAST_ROWS).any():
            return True
        return any(self._stands(scan, k, known, _SUSPECT).sum() >= _LEAST_ROWS for k in views)

    def _open(self, scan: Scan, views: list[int]) -> Mask:
        """Which of the views leave the line open in many rows: it may be plain once what stands still is masked."""
        reason = scan.reason[views]
        rivals, doubtful = ((reason == why).sum(axis=1) for why in (Reason.RIVALS, Reason.AMBIGUOUS))
        return np.asarray((rivals >= _LEAST_ROWS) | (doubtful >= _WORTH_ROWS))

    def _wrong(self, scan: Scan, asked: list[int], views: list[int], known: _Known) -> Mask:
        """The cells (B, H) that show another thing than the line."""
        wrong = np.zeros((len(scan), scan.rows), bool)
        for k in asked:
            seen = self._lines.reflectance[k], self._lines.shape[k]
            wrong[k] = known.usual.nothing(*seen)
            black = known.usual.hardly(self._lines.reflectance[k]) | known.usual.polish(*seen)
            thrown = known.usual.thrown(self._lines.shape[k], scan.range_m[k])
            if known.neighbours is not None and (black | thrown).any():
                alone, beside_nothing = known.neighbours.alone(k, scan.range_m[k])
                wrong[k] |= (black & alone) | (thrown & beside_nothing)
        for k in views:
            wrong[k] |= self._stands(scan, k, known)
        for k in _beside(scan.bearings, asked, views, [k for k in views if wrong[k].any()]):
            wrong[k] |= self._stands(scan, k, known)
        return wrong & scan.valid

    def pictures(self) -> Pictures | None:
        """What the pictures list as line-like; None where none does."""
        some = [k for k, places in enumerate(self._listed_in) if places is not None]
        if not some:
            return None
        own, lists = self._pipeline.calibration, [np.asarray(self._listed_in[k]) for k in some]
        places = np.full((len(some), len(lists[0]), max(values.shape[1] for values in lists)), np.inf, np.float32)
        for k, values in enumerate(lists):
            places[k, :, : values.shape[1]] = np.where(np.isfinite(values), values, np.inf)
        middles = (2.0 * np.arange(len(lists[0]), dtype=np.float64) + 0.5) * BLOCK - 0.5  # of every other block
        bearings = np.array([self._lines.keys[k][1] for k in some])
        window, project = self._pipeline.window, own.intrinsics.project
        T_axis_head = own.mount.T_axis_head()
        plane = own.laser_plane @ np.linalg.inv(T_axis_head)
        return Pictures(bearings, places, middles, window, T_axis_head @ own.T_head_camera, plane, project)

    def _stands(self, scan: Scan, k: int, known: _Known, part: float = 1.0) -> Mask:
        """Rows (H,) that stand still: of all, or once neighbours are known, of those that these do not bear out."""
        column, share = scan.column_px[k], known.share(k, scan.range_m[k])
        if known.neighbours is not None:
            column = np.where(share < SHARE, column, np.nan)
            if np.isfinite(column).sum() < _LEAST_ROWS:
                return np.zeros(scan.rows, bool)
        return known.still.line(float(scan.bearings[k]), column, ridge_of(*self._lines.shape[k]), part * share)

    def _choose(self, scan: Scan, views: list[int], known: _Known, shots: Shots | None) -> None:
        """Look again where the line is listed on the neighbours' course and something else was taken, or nothing."""
        worth = np.zeros(len(scan), bool)
        worth[views] = [self._choice(scan, k, known)[0].sum() >= _WORTH_ROWS for k in views]
        self._look_again(scan, np.zeros_like(scan.valid), worth, known, shots)

    def _choice(self, scan: Scan, k: int, known: _Known) -> tuple[Mask, list[F32]]:
        """Rows (H,) without a point where the neighbours' course has a listed place, and columns (H,) listed off it."""
        column = np.repeat(np.asarray(self._places[k], np.float64), 2 * BLOCK, axis=0)[: scan.rows]
        row = np.repeat(np.arange(scan.rows, dtype=np.float64), column.shape[1])
        points = locate(column.ravel(), row, self._pipeline.calibration, self._pipeline.triangulation)[0]
        assert known.neighbours is not None
        goes_on, elsewhere = known.neighbours.tell(k, np.sqrt((points**2).sum(axis=1)).reshape(column.shape))
        off = np.where((goes_on == 0) & (elsewhere > 0), column, np.nan).astype(np.float32)
        return ~scan.valid[k] & (goes_on > 0).any(axis=1), list(off.T)

    def _shown(self, views: list[int], shots: Iterable[Shot]) -> StillThings:
        """What the pictures of some bearings show, read once more."""
        still, wanted = StillThings(self._pipeline.calibration), {self._lines.keys[k] for k in views}
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

    def _look_again(self, scan: Scan, wrong: Mask, again: Mask, known: _Known, shots: Shots | None) -> None:
        """Give up the cells `wrong` (B, H), and fill those without a point of the pictures `again` (B,)."""
        if shots is None or not again.any():
            scan.give_up(wrong, Reason.AMBIGUOUS)
            return
        places: dict[tuple[float, float], list[int]] = {}
        for k in map(int, np.flatnonzero(again)):
            places.setdefault(self._lines.keys[k], []).append(k)
            self._others.setdefault(k, []).append(np.where(wrong[k], scan.column_px[k], np.nan))
        scan.give_up(wrong, Reason.AMBIGUOUS)

        def wanted() -> Iterator[Shot]:
            for shot in shots():
                if (shot.time, shot.bearing) in places:
                    yield shot

        def look(shot: Shot) -> Step:
            k = places[shot.time, shot.bearing][0]
            others = self._others[k] + (self._choice(scan, k, known)[1] if known.choosing else [])
            mask = np.any([self._around(column) for column in others], axis=0)
            ridges = self._pipeline.ridges(shot)
            if ridges is not None:
                mask |= known.still.mask(shot.bearing, ridges)
            for looks_left in range(_LOOKS - 1, -1, -1):
                step = self._pipeline.process(shot, mask)
                false = _other(step, k, known, ridges)
                if looks_left == 0 or false.sum() < _LEAST_ROWS:
                    break
                mask |= self._around(np.where(false, step.line.column_px, np.nan))
            step.profile.reason[false] = Reason.AMBIGUOUS
            return step

        def take(step: Step) -> None:
            for k in places[step.shot.time, step.shot.bearing]:
                new = ~scan.valid[k] & (step.profile.reason == Reason.OK)
                scan.amend(k, new, step.profile)
                self._lines.reflectance[k][new] = reflectance(step)[new]
                self._lines.shape[k][:, new] = shape_of(step)[:, new]

        run(wanted(), look, [take])

    def _around(self, column: F32 | F64) -> Mask:
        """(ceil(H / BLOCK), W) that is True around columns (H,)."""
        mask = np.zeros((-(-len(column) // BLOCK), self._pipeline.calibration.intrinsics.width), bool)
        row = np.flatnonzero(np.isfinite(column))
        around = np.rint(column[row]).astype(np.intp)[:, None] + np.arange(-_AROUND_PX, _AROUND_PX + 1)
        mask[row[:, None] // BLOCK, np.clip(around, 0, mask.shape[1] - 1)] = True
        return mask


def _other(step: Step, k: int, known: _Known, ridges: U8 | None) -> Mask:
    """Rows (H,) of a step, of a scan's bearing `k`, that are another thing's than the line."""
    line = step.line
    ridge = ridge_of(line.peak, line.width_px)
    share = known.share(k, step.profile.range_m)
    other = known.still.line(step.shot.bearing, line.column_px, ridge, share)
    if known.choosing:
        other |= share < SHARE
    other |= known.usual.nothing(reflectance(step), shape_of(step))
    return other if ridges is None else other | _hidden(line.column_px, ridge, ridges)


def _hidden(column: F64, ridge: F64, ridges: U8) -> Mask:
    """Rows (H,) of a line that is nothing that stands out in its picture, of these `ridges`: edges of bright panes."""
    row = np.flatnonzero(np.isfinite(column))
    near = np.rint(column[row]).astype(np.intp)[:, None] + np.arange(-_WITHIN_PX, _WITHIN_PX + 1)
    shown = ridges[row[:, None] // BLOCK, np.clip(near, 0, ridges.shape[1] - 1)].max(axis=1)
    hidden = np.zeros(len(column), bool)
    hidden[row] = shown < np.fmax(_SHOWN * ridge[row], _LEAST_SHOWN)
    return hidden


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
