"""Beams that an edge cuts: one part of the laser's sheet meets this surface, the rest another one before or behind it.

The sheet has a thickness, a Gaussian of some millimetres. Where an edge that runs along it, of a post, a door frame, a
shelf, cuts it, what is left of it on either surface lies beside its middle plane, by m = phi(t) / f of the beam's
standard deviation, f = Phi(t) being the share of the light that is left. All rows along the edge are off alike, up to
two of these, and each fits a Gaussian as well as ever.

Compared with the next bearings on the same surface three things tell. There is less light, by f. The line is narrower:
of the beam's variance t m + m^2 is gone (a truncated normal; Johnson, Kotz and Balakrishnan 1994, 13.10), from which
follow the beam's own width in the picture and how far the line was moved. And so far its points lie off the plane of
the others. Where all three agree the line is put back. Dark paint has less light but no narrower line; another face of
the same thing may have both, but does not lie that far off, or goes on so on its other side.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import means_along
from scanmap.pipeline.moving import move, per_column
from scanmap.pipeline.step import Pipeline
from scanmap.scan import Scan

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

# Bearings nearer to each other may be cut by the same edge, as a beam is no wider; farther ones are no neighbours.
_AWAY, _FARTHEST = float(np.radians(0.4)), float(np.radians(15.0))
_ROWS, _FEWEST, _LONG = 31, 12, 24  # rows whose median tells light and width; how many must be known; least of a run
_LIGHT, _WIDTH = 0.9, 0.93  # of the next bearing's, above which nothing was cut,
_NARROW = 0.85  # and what most rows of a run are narrower than
_MEANS = (0.95, 0.93)  # of light and width, above which means of a few rows need not be asked
_LEAST_LIGHT = 0.03  # of it, below which what is left is no beam's flank
_SAME, _OTHER = 0.05, 0.12  # of its range, up to which a bearing's surface may be the next one's, and beyond which not
_FLAT_PX = 0.2  # by which half of the points of a plane lie off it, at most
_FITS, _FAR_OFF = 3, 4.0  # of a plane, and how many medians a point is off it that is none of its own
_LEAST, _MOST = 0.6, 1.4  # how far points lie off the plane, in terms of what light and width foretell
# A Gaussian fitted to what is left of a beam is narrower than its variance is: where hardly any blur is added to the
# sheet's own width, these together make it 1.11 of the line's variance (of shares of 0.2 to 0.5); the rest is scatter.
_SHEET = 1.15
_UNKNOWN = 0.3  # of how far a line was moved


class _Beside(NamedTuple):
    """Bearings next to one, by their index in the scan, each beyond what an edge cuts together with the last."""

    near: int
    far: int  # on the same side
    other: int | None  # on the other side


def put_back(
    scan: Scan, pipeline: Pipeline, light: Sequence[F32], width_px: Sequence[F32], asked: Collection[int]
) -> Mask:
    """Put lines of cut beams back in `scan`, in place, with their doubt in sigma; returns which cells (B, H) moved.

    Args:
        light: (H,) of each bearing: height times width of its line times the square of its range; NaN where clipped.
        width_px: (H,) of each bearing: standard deviation of the line's profile.
        asked: bearings of the scan, by their index, that count.
    """
    order = np.array(sorted(asked, key=lambda k: float(scan.bearings[k])), np.intp)
    coarse = [means_along(np.stack([own[k] for k in order])) for own in (light, width_px)] if len(order) else []
    sides = _sides(scan.bearings[order])
    put = np.zeros((len(scan), scan.rows), bool)
    for side, opposite in (sides, sides[::-1]):
        some = np.flatnonzero(side.near >= 0)
        with np.errstate(invalid="ignore"):
            less = [means[some] < most * means[side.near[some]] for means, most in zip(coarse, _MEANS, strict=True)]
        for place in some[(less[0] & less[1]).any(axis=1)].tolist() if some.size else ():
            near, far, other = int(side.near[place]), int(side.far[place]), int(opposite.next[place])
            beside = _Beside(int(order[near]), int(order[far]), int(order[other]) if other >= 0 else None)
            k = int(order[place])
            for rows, foretold in _cut(scan, k, beside.near, light, width_px):
                moved = _off_plane(scan, pipeline, k, rows, beside)
                if _LEAST <= abs(moved) / foretold <= _MOST:
                    put[k, move(scan, pipeline, k, rows, -moved, _UNKNOWN * abs(moved))] = True
    return put


class _Side(NamedTuple):
    """Places of bearings on one side of each of B ascending ones, -1 where there is none."""

    next: Index  # (B,) beyond what one edge cuts
    near: Index  # (B,) the same, where there is another one beyond
    far: Index  # (B,) which is that


def _sides(turns: F64) -> tuple[_Side, _Side]:
    """The side of greater, and of lesser ascending bearings (B,) [rad]."""

    def side(ascending: F64) -> _Side:
        count = len(ascending)
        after = np.searchsorted(ascending, ascending + _AWAY)
        known = np.append(ascending, np.inf)
        after = np.where(known[after] - ascending <= _FARTHEST, after, count)
        beyond = np.append(np.searchsorted(ascending, ascending + _AWAY), count)[after]
        whole = beyond < count
        return _Side(
            *(np.where(here, to, -1) for here, to in ((after < count, after), (whole, after), (whole, beyond)))
        )

    up, down = side(turns), side(-turns[::-1])
    last = len(turns) - 1
    return up, _Side(*(np.where(to >= 0, last - to, -1)[::-1] for to in down))


def _cut(scan: Scan, k: int, near: int, light: Sequence[F32], width_px: Sequence[F32]) -> Iterator[tuple[Index, float]]:
    """Runs of rows (N,) of bearing `k` that look cut, compared with the one beside it, and how far that moves them."""
    with np.errstate(invalid="ignore", divide="ignore"):
        same = np.abs(scan.range_m[near] / scan.range_m[k] - 1.0) < _SAME
        share, narrow = (_running_median(np.where(same, own[k] / own[near], np.nan)) for own in (light, width_px))
        at = np.flatnonzero((share < _LIGHT) & (share > _LEAST_LIGHT) & (narrow < _WIDTH))
    for rows in np.split(at, np.flatnonzero(np.diff(at) > _ROWS // 2) + 1):
        if len(rows) >= _LONG and np.median(narrow[rows]) < _NARROW:
            yield rows, _foretold(share[rows], narrow[rows], width_px[near][rows])


def _running_median(values: F64) -> F64:
    """Medians over _ROWS rows (H,) of what is known; NaN where that is little, and where the row itself is not."""
    known, result = np.isfinite(values), np.full(len(values), np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, _ROWS // 2, constant_values=np.nan), _ROWS)
    count = np.isfinite(windows).sum(axis=1)
    at = np.flatnonzero(known & (count >= _FEWEST))
    # What is not known comes last; `nanmedian` takes four times as long.
    ordered, count = np.sort(windows[at], axis=1), count[at]
    each = np.arange(len(at))
    result[at] = 0.5 * (ordered[each, (count - 1) // 2] + ordered[each, count // 2])
    return result


def _foretold(share: F64, narrow: F64, whole: F32) -> float:
    """How far [px] a line was moved whose beam kept a `share` of its light and became narrower; of rows (N,).

    Infinite where no beam could have become so narrow.
    """
    f = float(np.median(share))
    t = NormalDist().inv_cdf(f)
    m = NormalDist().pdf(t) / f
    beam = (1.0 - float(np.median(narrow)) ** 2) / (t * m + m * m)  # of the line's variance
    return float(np.nanmedian(whole)) * float(np.sqrt(min(beam, 1.0))) * m if beam < _SHEET else float("inf")


def _off_plane(scan: Scan, pipeline: Pipeline, k: int, rows: Index, beside: _Beside) -> float:
    """How many columns the line of rows (N,) is off the plane of the bearings beside it; NaN where these have none."""
    slope = per_column(pipeline, scan.column_px[k, rows].astype(np.float64), rows.astype(np.float64))
    points = np.concatenate([scan.points[one, rows] for one in (beside.near, beside.far)]).astype(np.float64)
    points = points[np.isfinite(points[:, 0])]
    if len(points) < 2 * _FEWEST:
        return float("nan")
    for _ in range(_FITS):  # without what does not belong to it
        middle = points.mean(axis=0)
        normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
        rest = np.abs((points - middle) @ normal)
        points = points[rest <= _FAR_OFF * np.median(rest)]
    off_plane = slope @ scan.mount.T_world_head(float(scan.bearings[k]))[:3, :3].T @ normal

    def off(one: int) -> F64:
        return np.asarray((scan.points[one, rows] - middle) @ normal / off_plane, np.float64)

    moved = float(np.nanmedian(off(k)))
    flat = np.median(rest) < _FLAT_PX * np.nanmedian(np.abs(off_plane))
    if not flat or not _edge(scan, k, rows, beside, moved * _toward(scan, pipeline, k, rows, beside.near), off):
        moved = float("nan")
    return moved


def _edge(scan: Scan, k: int, rows: Index, beside: _Beside, away: float, off: Callable[[int], F64]) -> bool:
    """Whether what lies on the other side lets a line be cut there and move `away` from it [px], rather than bend.

    Either it lies before the surface, or behind; or the plane goes on, behind something thin on either side, which
    more rows must tell.
    """
    if beside.other is None:
        return away > 0
    with np.errstate(invalid="ignore"):
        range_m = scan.range_m[beside.other, rows]
        jumps = np.abs(range_m / scan.range_m[k, rows] - 1.0) > _OTHER
        goes_on = np.abs(off(beside.other)) < 0.5 * abs(away)
    here = ~jumps & np.isfinite(range_m)
    behind = np.count_nonzero(here) >= 3 * _LONG and goes_on[here].mean() > 0.5
    return bool((goes_on | ~here).mean() > 0.5 and (away > 0 or behind))


def _toward(scan: Scan, pipeline: Pipeline, k: int, rows: Index, near: int) -> float:
    """1 where light that moves toward the bearing `near` moves to greater columns, else -1."""
    T = scan.mount.T_world_head(float(scan.bearings[k]))
    point = np.nanmedian(scan.points[k, rows].astype(np.float64), axis=0)
    aside = np.cross([0.0, 0.0, np.sign(scan.bearings[near] - scan.bearings[k])], point - T[:3, 3])
    T_camera_world = np.linalg.inv(T @ pipeline.calibration.T_head_camera)
    places = np.stack([point, point + 1e-3 * aside]) @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    before, after = pipeline.calibration.intrinsics.project(places)[:, 0]
    return float(np.sign(after - before))
