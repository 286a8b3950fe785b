"""Lines of which one side is another's are placed by the other side, once the sweep tells how wide a line is.

How wide the line is depends on its range, and so on its column: the laser's sheet spreads, lenses blur. All bearings
together tell it. Where a stretch of the line is narrower or wider than that, and leans, its picture is read again, and
the flank that is still a line's tells where it is (`laserline.by_clean_flanks`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import BOTH, MEAN_ROWS, ODD, ROWS, UNUSUAL, Moved, means_along
from scanmap.pipeline.moving import move
from scanmap.pipeline.running import run
from scanmap.pipeline.step import Pipeline
from scanmap.pipeline.widths import Widths
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
    for k in _doubtful(usual, scan.column_px, width_px, lean):
        rows = _odd(usual, scan.column_px[k], np.where(asked[k], width_px[k], np.nan))
        if rows.any():
            odd[k] = rows
            places.setdefault(keys[k], []).append(k)

    def wanted() -> Iterator[Shot]:
        for shot in shots():
            if (shot.time, shot.bearing) in places:
                yield shot

    def look(shot: Shot) -> tuple[Shot, Moved | None]:
        k = places[shot.time, shot.bearing][0]
        column = scan.column_px[k].astype(np.float64)
        return shot, pipeline.by_clean_flanks(shot, column, usual.width(column), odd[k])

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


def _doubtful(usual: Widths, column: F32, width_px: Sequence[F32], lean: Sequence[F32 | None]) -> list[int]:
    """Bearings in which some rows are wider or narrower, and lean, of columns (B, H) and widths, (H,) each."""
    width = means_along(np.stack(width_px))
    rows = np.minimum(np.arange(width.shape[1]) * MEAN_ROWS + MEAN_ROWS // 2, column.shape[1] - 1)
    unknown = np.full(width.shape[1], np.nan, np.float32)
    with np.errstate(invalid="ignore"):
        unusual = np.abs(np.log(width / usual.width(column[:, rows])))
        odd = _ODD_OF_LEAN * np.abs(np.stack([unknown if own is None else own for own in lean]))
        doubtful = (unusual > _SOME * UNUSUAL) & (odd > _SOME * ODD) & (unusual * odd > _SOME * BOTH)
    return np.flatnonzero(doubtful.any(axis=1)).tolist()


def _odd(usual: Widths, column: F32, width: F32) -> Mask:
    """Rows (H,) in and around stretches that are wider or narrower."""
    with np.errstate(invalid="ignore"):
        ratio = np.log(width / usual.width(column))
    known = np.isfinite(ratio)
    mean = cv2.blur(np.where(known, ratio, 0.0)[None], (ROWS, 1), borderType=cv2.BORDER_CONSTANT)
    odd = (np.abs(mean) > UNUSUAL).astype(np.uint8)
    return np.asarray(cv2.dilate(odd, np.ones((1, 2 * _AROUND + 1), np.uint8))[0], bool) & known
