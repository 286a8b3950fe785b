"""How wide the line is, by the column it is seen at: all bearings of a sweep together tell it.

Its width depends on its range, and so on its column: the laser's sheet spreads, lenses blur.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Of lines by their columns, whose medians tell the usual width; lines of one, at least; lines in all that are enough.
_GROUPS, _LEAST, _ENOUGH = 16, 400, 40_000


class Widths(NamedTuple):
    """How wide lines usually are at a column."""

    column: F64  # (G,) rising [px]
    width_px: F64  # (G,)

    @classmethod
    def of(cls, column: F32, width_px: Sequence[F32], asked: Mask) -> Widths | None:
        """From lines at columns (B, H) and their widths, (H,) each, where `asked` (B, H); None of too few."""
        every = max(1, int(asked.sum()) // _ENOUGH)
        width = np.stack([own[::every] for own in width_px]) if len(width_px) else np.empty((0, 1), np.float32)
        at = column[:, ::every]
        known = asked[:, ::every] & np.isfinite(at) & np.isfinite(width)
        at, width = at[known], width[known]
        if len(at) < _LEAST:
            return None
        groups = np.array_split(np.argsort(at, kind="stable"), min(_GROUPS, len(at) // _LEAST))
        return cls(*(np.array([np.median(values[some]) for some in groups], np.float64) for values in (at, width)))

    def width(self, column: F32 | F64) -> F64:
        """Usual widths at columns (...); NaN where there is none."""
        return np.where(np.isfinite(column), np.interp(column, self.column, self.width_px), np.nan)
