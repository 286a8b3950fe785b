"""Lines on dark joints that a laser-off picture shows: where the middle of the laser's sheet is.

A surface's albedo a multiplies the sheet's light before the lens blurs both. Of a sheet of variance S on it at u, seen
through a lens that blurs by the variance L, a picture shows (the product of two Gaussians is one)

    G(x - u; T) (a * G(S L / T))(u + (x - u) S / T),    T = S + L,

and of the room's light a * G(L): sharpened by L - S L / T = L^2 / T, and read nearer to u by S / T, it is what the line
has to be divided by. Divided as it is, lines are moved a third too far.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.peaks import Peaks, fit_gaussian
from scanmap.laserline.pictures import Rows

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_SHEET = 0.7  # S / T: of 20 joints in drawn rooms 0.5 to 1 puts the line best
_ROWS = 25  # that tell together what a joint is and what it does
_SHARPENED = 5  # rows, for which noise is taken out of what is sharpened
_STEPS = 3
_WITHIN = 2.5  # [widths] of the line, within which its joint is
# Of the light beside it, what a joint lacks, at least and at most: a darker gap is a shadow, or holds nothing; and of
# that, what its two sides differ by.
_DIP, _BLACK, _STEP = 0.25, 0.8, 0.25
_LEAST_PX = 1.3  # width of a line that has enough samples
_DARKEST = 1.0 / 16.0  # of the brightest beside it
_END = 3  # samples at either end of a window that are beside the joint
# [widths] of a line, in which what its Gaussian leaves is asked; and how many times as much a joint leaves, from which
# on it is a shadow, dark in the room's light only: shadows 4 to 7, joints 0.5 to 1.5, seldom 2.5.
_LOOKED_AT, _WORSE = 3.0, 2.5
_FARTHEST = 1.0  # [px] that a line is moved


class Lit(NamedTuple):
    """Windows (n, M) of lines in light."""

    added: F32  # by the laser
    room: F32  # without it, in any unit
    usable: F32  # 1, or 0 for samples that say little
    row: Index  # (M,) of the picture
    place: F32  # (M,) of the line, from the middle of the window [px]
    width: F32  # (M,) of it, as sigma [px]


def off_joints(lit: Lit, height: int, noise: F64, contrast: F64) -> tuple[Mask, F32]:
    """Which lines (M,) lie on a dark joint, and how far (M,) each is from where the sheet's middle is [px].

    Args:
        lit: rows of one picture of `height` rows.
        noise: (1,) of a sample [grey levels].
        contrast: (1,) of its speckle.
    """
    half = len(lit.room) // 2
    x = np.arange(-half, half + 1, dtype=np.float32)[:, None]
    near = np.abs(x - lit.place) < np.float32(_WITHIN) * lit.width
    left, right = lit.room[:_END].mean(axis=0), lit.room[-_END:].mean(axis=0)
    lowest = np.where(near, lit.room, np.float32(np.inf)).min(axis=0)
    left, right, lowest = _means(np.stack([left, right, lowest]), lit.row, height)
    low, high = np.minimum(left, right), np.maximum(left, right)
    lacks = low - lowest
    joint = (lacks > np.float32(_DIP) * high) & (lacks < np.float32(_BLACK) * high)
    joint &= (high - low < np.float32(_STEP) * lacks) & (lit.width > _LEAST_PX) & lit.usable.all(axis=0)
    moved = np.zeros_like(lit.place)
    some = np.flatnonzero(joint)
    if some.size < _ROWS:
        return np.zeros_like(joint), moved
    added, usable, room = (np.ascontiguousarray(values[:, some]) for values in (lit.added, lit.usable, lit.room))
    start, width = lit.place[some], lit.width[some]
    room = np.asarray(cv2.blur(room, (_SHARPENED, 1), borderType=cv2.BORDER_REPLICATE), np.float32)
    bent = np.zeros_like(room)
    bent[1:-1] = room[2:] + room[:-2] - np.float32(2.0) * room[1:-1]
    sharp = room - np.float32(0.5 * (1.0 - _SHEET) ** 2) * np.square(width) * bent
    sharp = np.maximum(sharp, np.float32(_DARKEST) * room.max(axis=0))
    place, alone = start, Rows(np.zeros(some.size, np.intp), noise)
    for _ in range(_STEPS):
        albedo = _at(sharp, place + np.float32(_SHEET) * (x - place))
        bell = np.exp(np.float32(-0.5) * np.square((x - place) / width))
        usual = (albedo * bell).sum(axis=0) / bell.sum(axis=0)
        found = fit_gaussian(added * (usual / albedo), usable, alone, contrast)
        place = np.clip(found.offset_px, start - _FARTHEST, start + _FARTHEST).astype(np.float32)
    shadow = fit_gaussian(added, usable, alone, contrast)
    left_by_joint, left_by_shadow = _left(added * (usual / albedo), found, x), _left(added, shadow, x)
    joint[some] = left_by_joint < np.float32(_WORSE) * left_by_shadow
    moved[some] = place - start
    return joint, _means(moved[None], lit.row, height, joint)[0]


def _left(y: F32, found: Peaks, x: F32) -> F32:
    """What Gaussians leave of windows (n, M), rms in heights of the line (M,), in means along the line."""
    z = (x - found.offset_px) / found.width_px
    rest = y / found.height - np.exp(np.float32(-0.5) * np.square(z))
    near = (np.abs(z) < np.float32(_LOOKED_AT)).astype(np.float32)
    rest -= (rest * near).sum(axis=0) / near.sum(axis=0)
    rest = np.asarray(cv2.blur(rest * near, (_ROWS, 1), borderType=cv2.BORDER_REFLECT), np.float32)
    left: F32 = np.sqrt(np.square(rest).sum(axis=0) / near.sum(axis=0))
    return left


def _means(values: F32, row: Index, height: int, some: Mask | None = None) -> F32:
    """Means (k, M) of values (k, M) of lines in `row` (M,), of `some` of them, over the rows around each."""
    counted = np.ones(len(row), np.float32) if some is None else some.astype(np.float32)
    spread = np.zeros((len(values) + 1, height), np.float32)
    spread[:-1, row], spread[-1, row] = values * counted, counted
    summed = np.asarray(cv2.blur(spread, (_ROWS, 1), borderType=cv2.BORDER_CONSTANT), np.float32)[:, row]
    means: F32 = summed[:-1] / np.maximum(summed[-1], np.float32(1e-6))
    return means


def _at(values: F32, place: F32) -> F32:
    """Values (n, M) of windows between their samples, at places (n, M) from the middle [px]."""
    half = len(values) // 2
    along = np.clip(place + np.float32(half), 0.0, 2.0 * half - 1e-3)
    first = along.astype(np.intp)
    share = (along - first).astype(np.float32)
    low, high = (np.take_along_axis(values, first + k, axis=0) for k in (0, 1))
    between: F32 = low + share * (high - low)
    return between
