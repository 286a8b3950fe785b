"""Lines of which one side is another's are placed by the other side, once the sweep tells how wide a line is.

Where a stretch of the line is narrower or wider than lines are there (`widths`), and leans, its picture is read again,
and the flank that is still a line's tells where it is (`laserline.by_clean_flanks`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import ROWS, Moved, Usual, least_of
from scanmap.pipeline.moving import move
from scanmap.pipeline.running import run
from scanmap.pipeline.step import Pipeline
from scanmap.pipeline.widths import Seen, Widths
from scanmap.scan import Scan
from scanmap.shot import Shot

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

_AROUND = ROWS // 2  # rows beside a stretch that are read with it
_SOME = 0.7  # of what counts in ROWS rows, from which on in means of fewer they are asked
_ODD_OF_LEAN = 0.45  # rms of (z^2 - 1.5) z exp(-z^2 / 2), in which the lean is told, at the places asked


def by_clean_flanks(
    scan: Scan,
    pipeline: Pipeline,
    usual: Widths,
    width_px: Sequence[F32],
    lean: Sequence[F32 | None],
    asked: Mask,
    shots: Callable[[], Iterable[Shot]],
    keys: Sequence[tuple[float, float]],
) -> Mask:
    """Move points in `scan`, in place, whose line has one clean flank, with the doubt in sigma; returns which (B, H).

    Args:
        usual: how wide the scan's lines are.
        width_px: (H,) of each bearing: standard deviation of the line's profile.
        lean: of each bearing, how much the profile leans, as `Look` has it.
        asked: (B, H) cells whose width counts.
        shots: the shots of the scan once more.
        keys: time and bearing of each bearing's shot.
    """
    put = np.zeros((len(scan), scan.rows), bool)
    odd: dict[int, Mask] = {}
    places: dict[tuple[float, float], list[int]] = {}
    seen: dict[int, Seen] = {}  # as they are before anything moves
    for k in _doubtful(usual, lean):
        own = usual.of_bearing(k)
        rows = _odd(np.where(asked[k], width_px[k], np.nan) / own.width_px, own.slant_known)
        if rows.any():
            odd[k], seen[k] = rows, own
            places.setdefault(keys[k], []).append(k)

    def wanted() -> Iterator[Shot]:
        for shot in shots():
            if (shot.time, shot.bearing) in places:
                yield shot

    def look(shot: Shot) -> tuple[Shot, Moved | None]:
        k = places[shot.time, shot.bearing][0]
        column, own = scan.column_px[k].astype(np.float64), seen[k]
        return shot, pipeline.by_clean_flanks(shot, column, Usual(own.width_px, own.slant_known), odd[k])

    def take(told: tuple[Shot, Moved | None]) -> None:
        shot, moved = told
        if moved is None:
            return
        for k in places[shot.time, shot.bearing]:
            rows = np.flatnonzero((moved.by != 0.0) & scan.valid[k])
            put[k, move(scan, pipeline, k, rows, moved.by[rows], moved.doubt[rows])] = True

    if places:
        run(wanted(), look, [take])
    return put


def _doubtful(usual: Widths, lean: Sequence[F32 | None]) -> list[int]:
    """Bearings in which some rows are wider or narrower, and lean."""
    ratio, slant_known = usual.ratios()
    unknown = np.full(ratio.shape[1], np.nan, np.float32)
    with np.errstate(invalid="ignore"):
        unusual, odd = np.abs(ratio), _ODD_OF_LEAN * np.abs(np.stack([unknown if own is None else own for own in lean]))
        least, least_odd, both = (_SOME * values for values in least_of(slant_known & (ratio < 0)))
        doubtful = (unusual > least) & (odd > least_odd) & (unusual * odd > both)
    return np.flatnonzero(doubtful.any(axis=1)).tolist()


def _odd(ratio: F64, slant_known: Mask) -> Mask:
    """Rows (H,) in and around stretches that are wider or narrower, of widths over the usual ones."""
    with np.errstate(invalid="ignore"):
        off = np.log(ratio)
    known = np.isfinite(off)
    mean = cv2.blur(np.where(known, off, 0.0)[None], (ROWS, 1), borderType=cv2.BORDER_CONSTANT)[0]
    odd = (np.abs(mean) > least_of(slant_known & (mean < 0))[0]).astype(np.uint8)
    return np.asarray(cv2.dilate(odd[None], np.ones((1, 2 * _AROUND + 1), np.uint8))[0], bool) & known
