"""How well a line's columns are known in the end: by themselves, by the scatter along the line, and by the file."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.edges import Edges, no_edges
from scanmap.laserline.pooling import (
    APART_ROWS,
    moved,
    pool,
    segments,
    unexplained,
    unexplained_by_height,
    unforeseen,
)
from scanmap.laserline.result import LaserLine
from scanmap.laserline.rounding import hidden_px, shared_px
from scanmap.laserline.sight import Sight

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# By what factor the scatter along a line must exceed the sigmas to be believed, and may fall below them once they are
# known to be wrong; what is beyond the last is the surface's own.
_MORE, _LESS, _MOST = 1.08, 0.5, 4.0

# Height [grey levels] that no whole line has; a cut one, whose flanks alone tell, is moved by rounding so much more, at
# least: 1.5 to 2 on random frames (`benchmarks/error_bars.py`).
_SATURATES, _CUT = 256.0, 1.5


class Doubts(NamedTuple):
    """What N rows' own samples do not say of their columns, and is no matter of whether they are the line's."""

    edges: Edges  # (N,) of the room's brightness
    plain: NDArray[np.bool_]  # (N,) whether nothing else but noise is known to move the line
    lean: F32  # (N,) of their profiles, as `Peaks` has it

    @property
    def each(self) -> tuple[NDArray[np.generic], ...]:
        """All of them, arrays (N,)."""
        return *self.edges, self.plain, self.lean

    def of(self, some: slice) -> Doubts:
        """Of some of the rows."""
        return Doubts(Edges(self.edges.shift[some], self.edges.doubt[some]), self.plain[some], self.lean[some])


def no_doubts(rows: int) -> Doubts:
    """Of so many rows, nothing yet."""
    return Doubts(no_edges(rows), np.zeros(rows, bool), np.zeros(rows, np.float32))


def with_error_bars(line: LaserLine, sight: Sight, rows: int, doubts: Doubts) -> LaserLine:
    """The lines with sigmas that the scatter along them bears out, and pooled over so many rows (3 or more).

    What all rows share of what the files round is added where the scatter does not show it.
    """
    column, peak, width, sigma = (values.reshape(-1, sight.height) for values in line[:4])
    plain = doubts.plain.reshape(-1, sight.height)
    steps = unforeseen(column)
    parts = segments(column, sigma, steps)
    more = unexplained_by_height(column, sigma, parts[0], APART_ROWS, peak)
    lag = np.where(np.isfinite(more).any(axis=1), APART_ROWS[0], 0)
    # Sigmas are too large where nothing but the tone curve is wrong; of a file that is not known it may be more.
    known = np.array([rounding is not None for rounding in sight.roundings])[:, None]
    more = np.where((more > _MORE) | (known & plain & (more < 1.0 / _MORE)), np.clip(more, _LESS, _MOST), 1.0)
    corrected = (more != 1.0).any(axis=1)
    if corrected.any():
        sigma *= more
        parts = segments(column, sigma, steps)
    if rows >= 3:
        column, sigma = pool(column, sigma, rows, parts)
        # Errors that are alike in neighbouring rows do not average out as others do.
        again = unexplained(column, sigma, parts[0], (rows + 1,))
        differ = (corrected & np.isfinite(again)) | (again > _MORE)
        sigma *= np.where(differ, np.minimum(np.maximum(again, _LESS), _MOST), 1.0)[:, None]
        lag = np.where(np.isfinite(again), rows + 1, 0)
    variance = np.square(sigma).ravel() + np.square(doubts.edges.doubt)
    if known.any():
        variance += np.square(_hidden(sight, width, peak, moved(column, parts, lag))).ravel()
    return line._replace(column_px=column.ravel(), sigma_px=np.sqrt(variance))


def _hidden(sight: Sight, width: F64, peak: F64, leans: F64) -> F32:
    """What rounding does to lines of some widths and heights (P, H) that the scatter along them does not show [px]."""
    hidden = np.zeros(width.shape, np.float32)
    alike = list(zip(sight.roundings, sight.mixtures, np.round(sight.noise, 1).tolist(), strict=True))
    different = set(alike)
    for one in different:
        rounding, mixture, noise = one
        if rounding is not None:
            some = slice(None) if len(different) == 1 else [k for k, other in enumerate(alike) if other == one]
            shared = shared_px(rounding, mixture, noise, width[some], peak[some])
            hidden[some] = hidden_px(rounding, shared, leans[some])
    return np.where(peak > _SATURATES, np.float32(_CUT) * hidden, hidden)
