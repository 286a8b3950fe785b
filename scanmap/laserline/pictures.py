"""Several pictures at once, one below the other: what is found in each is what it would be alone, bit for bit.

Most of what is asked of a line are short calls on some thousand numbers, whose cost is that of being called. P pictures
of H rows are one of P H rows; what is a picture's own (noise, medians) is an array (P,).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import CameraError

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Index = NDArray[np.intp]
U8 = NDArray[np.uint8]

LEAST_WIDTH = 6  # columns: five for the narrowest matched filter, two groups of three for the noise in its band


@dataclass(frozen=True)
class Rows:
    """N rows of P pictures."""

    picture: Index  # (N,) which of them each row is of, rising
    noise_of: F64  # (P,) of a sample of each picture [grey levels]

    @cached_property
    def noise(self) -> F32:
        """Noise of a sample of each row (N,)."""
        return self.noise_of.astype(np.float32)[self.picture]

    @cached_property
    def parts(self) -> list[slice]:
        """Where the rows of each picture stand."""
        return by_picture(self.picture, len(self.noise_of))

    def of(self, some: Index | slice) -> Rows:
        """Some of the rows."""
        if isinstance(some, slice) and some == slice(None):
            return self
        return Rows(self.picture[some], self.noise_of)


def by_picture(picture: Index, count: int) -> list[slice]:
    """Where in arrays (N,) each of `count` pictures stands, from the rising numbers (N,) of the pictures."""
    if count == 1:
        return [slice(0, len(picture))]
    ends = np.searchsorted(picture, np.arange(count + 1)).tolist()
    return [slice(first, last) for first, last in pairwise(ends)]


def not_one(index: Index) -> Index:
    """The indices (N,), a single one twice: NumPy sums a single column by another rule than two or more."""
    return index.repeat(2) if len(index) == 1 else index


def check_width(image: U8, height: int) -> None:
    """Raise CameraError for pictures (P H, W, ...) of `height` rows too narrow to have a line and two sides."""
    width = image.shape[1]
    if width < LEAST_WIDTH:
        raise CameraError(
            f"a picture of {width}x{height} px is too narrow: line and what lies beside it need {LEAST_WIDTH} columns "
            "or more; set another size in [camera], or give the pictures as the camera took them"
        )
