"""Dim rows borrow the line's width, and in part its height, from their neighbours, where their own say little."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from scanmap.laserline.pictures import Rows

F32 = NDArray[np.float32]
Index = NDArray[np.intp]

_NEARBY = 31  # rows
_DIM = 0.06  # of sigma_px / width_px, from which on a row's own width is doubtful
_PLACE_PX = 4.0  # from the middle of the window a line is looked for, in steps of half a pixel
_REACH = 3.2  # [sigma] samples farther from the line say nothing of it
_ITERATIONS = 3
_TEXTURE = 2.0  # [variance of a sample] rows that scatter more are not only dim
_ROOT_PI = float(np.sqrt(np.pi))


class DimRows(NamedTuple):
    """Lines of `rows` (M,) of a fit, arrays (M,)."""

    rows: Index
    u: F32
    s: F32
    A: F32
    b: F32
    height: F32  # A, drawn towards what it is nearby by how little the row knows of it


def dim_rows(y: F32, x: F32, cut: Index, s: F32, A: F32, rows: Rows) -> DimRows | None:
    """The rows of (N,) fits in which noise hides how wide the line is, fitted again; None where there are none.

    Args:
        y: (n, N) samples around each row's peak.
        x: (n, 1) their places.
        cut: (M,) rows that lack samples, which are left as they are.
        s: (N,) widths of the rows' own fits [px].
        A: (N,) their heights [grey levels].
        rows: which pictures they are of.

    Width and height are alike in neighbouring rows of one surface, and what a row says of its place depends on neither.
    With the width given, the place is where the matched filter answers most (the maximum of the likelihood), not the
    next bump of noise; and neither sigma nor the decision which rows to believe follows the row's own noise.
    """
    limit = (rows.noise_of * (np.sqrt(2.0 / _ROOT_PI) / _DIM)).astype(np.float32)
    light = A * np.sqrt(s)
    if np.count_nonzero(light < limit.max()) < _NEARBY:
        return None
    lacking = np.zeros(len(s), bool)
    lacking[cut] = True
    found = []
    for part, least, noise in zip(rows.parts, limit, rows.noise_of, strict=True):
        if np.count_nonzero(light[part] < least) >= _NEARBY:
            lines = _dim_rows(y[:, part], x, lacking[part], s[part], A[part], least, float(noise))
            found.append(lines._replace(rows=lines.rows + part.start))
    return DimRows(*(np.concatenate(values) for values in zip(*found, strict=True))) if found else None


def _dim_rows(y: F32, x: F32, lacking: NDArray[np.bool_], s: F32, A: F32, limit: np.float32, noise: float) -> DimRows:
    """The same of one picture."""
    # Told from the neighbours too: choosing rows by their own noise would bias them.
    width, height = _middle(s), _middle(A)
    dim = height * np.sqrt(width) < limit
    rows = np.flatnonzero(dim & ~lacking)
    if len(rows) < _NEARBY:
        return DimRows(rows[:0], *(A[:0] for _ in range(5)))
    y, near = y.take(rows, axis=1), width[rows]
    u, A_own, b = _placed(y, x, near, float(np.median(near)))
    residual = y - b - A_own * _bell(x, u, near)
    plain = np.square(residual).mean(axis=0) < _TEXTURE * noise**2
    spread = np.float32(1.3 * noise**2 / _ROOT_PI) / near
    shrunk = height[rows] + _kept(A_own, spread) * (A_own - height[rows])
    return DimRows(*(values[plain] for values in (rows, u, near, A_own, b, np.maximum(shrunk, np.float32(0.5)))))


def _placed(y: F32, x: F32, s: F32, usual: float) -> tuple[F32, F32, F32]:
    """Places, heights and backgrounds (M,) of lines of given widths (M,)."""
    places = np.arange(-_PLACE_PX, _PLACE_PX + 0.1, 0.5, dtype=np.float32)[:, None]
    kernel = np.exp(-0.5 * np.square((x[:, 0] - places) / np.float32(usual)))
    kernel -= kernel.mean(axis=1, keepdims=True)
    kernel /= np.sqrt(np.square(kernel).sum(axis=1, keepdims=True))
    u = places[(kernel @ y).argmax(axis=0), 0]
    for _ in range(_ITERATIONS):
        z = (x - u) / s
        g = np.exp(np.float32(-0.5) * z * z)
        w = (np.abs(z) <= np.float32(_REACH) + np.float32(0.5) / s).astype(np.float32)
        g *= w
        d = g * z
        count, g1, g2 = w.sum(axis=0), g.sum(axis=0), np.square(g).sum(axis=0)
        level, bell = (w * y).sum(axis=0), (g * y).sum(axis=0)
        power = np.maximum(g2 - g1 * g1 / count, np.float32(1e-3))
        A = np.maximum((bell - g1 * level / count) / power, np.float32(0.5))
        b = (level - A * g1) / count
        step = (d * (y - b - A * g)).sum(axis=0) / np.maximum(np.square(d).sum(axis=0), np.float32(1e-3)) / A
        u = u + np.minimum(np.maximum(step, np.float32(-0.7)), np.float32(0.7)) * s
    return u, A, b


def _kept(values: F32, variance: F32) -> F32:
    """Share (M,) of a row's difference from its neighbours that is not the row's noise, from how they scatter."""
    rows = (_NEARBY, 1)
    mean, square = (cv2.blur(v[None], rows, borderType=cv2.BORDER_REPLICATE)[0] for v in (values, values * values))
    kept: F32 = np.maximum(1.0 - variance / np.maximum(square - mean * mean, variance), 0.0).astype(np.float32)
    return kept


def _middle(values: F32) -> F32:
    """Medians (N,) of the rows nearby."""
    half = _NEARBY // 2
    around = sliding_window_view(np.pad(values, half, mode="reflect"), _NEARBY).copy()
    around.partition(half, axis=1)
    return np.ascontiguousarray(around[:, half])


def _bell(x: F32, u: F32, s: F32) -> F32:
    bell: F32 = np.exp(np.float32(-0.5) * np.square((x - u) / s))
    return bell
