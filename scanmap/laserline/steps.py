"""The steps of the fit: a Gaussian line per row by Gauss and Newton, for rows with a whole line and for others."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.noise import dot
from scanmap.laserline.pictures import not_one

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Index = NDArray[np.intp]

_SIGMA_MIN_PX, _SIGMA_MAX_PX = 0.3, 14.0
REACH = 3.2  # [sigma] samples farther from the line say nothing of it
ITERATIONS = 2
_LONG, _THIN_PX = 0.2, 0.95  # [widths] of a step after which another is taken; so thin a line takes another anyway
_MOSTLY = 0.75  # share of the rows that lack samples, from which on all are fitted as they are
ROOT_PI, _ROOT_2PI = float(np.sqrt(np.pi)), float(np.sqrt(2.0 * np.pi))


def fit_whole(y: F32, x: F32, start: Fit, cut: Index) -> Fit:
    """Fits (N,) of rows with a whole line; those `cut` are fitted elsewhere, and as well here if they are few."""
    if len(cut) <= _MOSTLY * y.shape[1]:
        fit = _improve_whole(x, Leftover(y, x, start), start)
        # From so good a start one step is enough, to a part in a hundred of what noise does; but not where it was long.
        long = np.maximum(np.abs(fit.u - start.u), np.abs(fit.s - start.s)) > np.float32(_LONG) * fit.s
        again = not_one((long | (fit.s < _THIN_PX)).nonzero()[0])
        if again.size:
            some = fit.of(again)
            fit.with_rows(again, _improve_whole(x, Leftover(y.take(again, axis=1), x, some), some))
        return fit
    lacking = np.zeros(y.shape[1], bool)
    lacking[cut] = True
    whole = not_one((~lacking).nonzero()[0])
    fit = Fit(*(values.copy() for values in start))
    if whole.size:
        fit.with_rows(whole, fit_whole(y.take(whole, axis=1), x, start.of(whole), cut[:0]))
    return fit


class Fit(NamedTuple):
    """A line per row, arrays (N,)."""

    u: F32
    s: F32
    A: F32
    b: F32
    information: F32  # on u, in units of (A / s)^2 / noise^2

    def of(self, rows: Index) -> Fit:
        """The fits of some rows."""
        return Fit(*(values[rows] for values in self))

    def with_rows(self, rows: Index, others: Fit) -> Fit:
        """These fits, with those of some rows replaced."""
        for values, other in zip(self, others, strict=True):
            values[rows] = other
        return self


class Leftover:
    """What a fit leaves over in y (n, N), and where its samples count."""

    def __init__(self, y: F32, x: F32, fit: Fit) -> None:
        self.z = x - fit.u
        self.z *= np.float32(1.0) / fit.s
        self.bell = np.square(self.z)
        self.bell *= np.float32(-0.5)
        np.exp(self.bell, out=self.bell)
        self.residual = self.bell * -fit.A
        self.residual += y
        self.residual -= fit.b
        reach = np.maximum(np.float32(REACH), np.float32(3.0) / fit.s) + np.float32(0.5) / fit.s
        # Farther away the bell is lower.
        self.weight = (self.bell >= np.exp(np.float32(-0.5) * np.square(reach))).astype(np.float32)


def first_guess(y: F32, x: F32, b: F32, top: F32) -> Fit:
    """First guess: background from the window's ends; place and width from what rises above a quarter of the height.

    Cut off there softly, so that it matters little where the samples lie; a Gaussian's area above it is 1.4335 A s.
    """
    A = np.maximum(top - b, np.float32(1.0))
    above = y - (b + np.float32(0.25) * A)
    np.maximum(above, np.float32(0.0), out=above)
    area = above.sum(axis=0)
    # Not BLAS, whose sums depend on how many rows there are.
    u = _clipped(dot(above, np.broadcast_to(x, above.shape)) / np.maximum(area, np.float32(1.0)), -2.0, 2.0)
    s = _clipped(area / (A * np.float32(1.4335)), 0.7, 0.3 * len(x))
    # The highest sample stands beside the line's middle.
    higher = np.float32(1.0) + np.float32(0.5) * np.square((u - np.rint(u)) / s)
    return Fit(u, s / higher, A * higher, b, np.zeros_like(b))


def _improve_whole(x: F32, look: Leftover, fit: Fit) -> Fit:
    """One step for rows with a whole line: the normal equations are those of the integrals over it.

    Sums over samples of a smooth peak wider than 0.75 px are its integrals to a part in a hundred, and the odd ones
    vanish, so that only the gradient is summed; what the matrix lacks costs convergence, not accuracy (the chord
    method, Kantorovich).
    """
    wr = look.weight * look.residual
    per_s = np.float32(1.0) / fit.s
    level = wr.sum(axis=0) * per_s
    wr *= look.bell
    bell = wr.sum(axis=0) * per_s
    wr *= look.z
    slope, bent = wr.sum(axis=0) * per_s, dot(wr, look.z) * per_s
    count = look.weight.sum(axis=0) * per_s
    # The level eliminated, then height and width; all per sigma.
    k = np.float32(2.0 * np.pi) / count
    share = level * np.float32(_ROOT_2PI) / count
    bell -= share
    bent -= share
    aa, at, tt = np.float32(ROOT_PI) - k, np.float32(0.5 * ROOT_PI) - k, np.float32(0.75 * ROOT_PI) - k
    per_det = np.float32(1.0) / (aa * tt - at * at)
    a, t = (tt * bell - at * bent) * per_det, (aa * bent - at * bell) * per_det
    b = fit.b + (level - np.float32(_ROOT_2PI) * (a + t)) / count
    p = slope * np.float32(2.0 / ROOT_PI)
    A = np.maximum(fit.A + a, np.float32(0.5))
    per_A = np.float32(1.0) / A
    half = len(x) // 2
    u = _clipped(fit.u + _clipped(p * per_A, -1.0, 1.0) * fit.s, -half, half)
    s = _clipped(fit.s * (np.float32(1.0) + _clipped(t * per_A, -0.4, 0.6)), _SIGMA_MIN_PX, _SIGMA_MAX_PX)
    return Fit(u, s, A, b, s * np.float32(0.5 * ROOT_PI))


def fit_part(y: F32, x: F32, usable: F32, fit: Fit, least: F32, limit: F32, steps: int = 2 * ITERATIONS) -> Fit:
    """The fits (M,) of rows that lack samples, or whose sums are not the integrals; see `improve`."""
    # They have farther to go than rows with a whole line.
    for _ in range(steps):
        fit = improve(y, x, usable * near(x, fit, REACH, least), fit, limit)
    return fit


def improve(y: F32, x: F32, weight: F32, fit: Fit, limit: F32) -> Fit:
    """One Gauss-Newton step from the samples at which the fit is below its row's `limit` (M,)."""
    basis = np.empty((5, *y.shape), np.float32)
    level, g, q, d, basis[4] = *basis[:4], y
    z = (x - fit.u) / fit.s
    level[:] = 1.0
    np.exp(np.float32(-0.5) * z * z, out=g)
    np.multiply(g, z, out=d)  # derivative by u, times s / A
    np.multiply(d, z, out=q)  # derivative by s, times s / A
    weight = weight * (g * fit.A < limit - fit.b)
    # Normal equations of (b, A, s, u), upper triangle, and their right side.
    normal = np.zeros((4, 5, y.shape[1]))
    for i, own in enumerate((weight, weight * g, weight * q, weight * d)):
        normal[i, i:] = np.einsum("jn,kjn->kn", own, basis[i:])
    (b, A, t, p), information = solved(normal)
    A = np.maximum(A, 0.5)
    half = len(x) // 2
    u = _clipped(fit.u + _clipped(p / A, -1.0, 1.0) * fit.s, -half, half)
    s = _clipped(fit.s * (1.0 + _clipped(t / A, -0.4, 0.6)), _SIGMA_MIN_PX, _SIGMA_MAX_PX)
    return Fit(*(values.astype(np.float32) for values in (u, s, A, b, information)))


def solved(normal: F64) -> tuple[F64, F64]:
    """Solutions (n, N) of N symmetric systems, by elimination; and 1 / inverse[-1, -1] of each.

    Args:
        normal: (n, n + 1, N) upper triangles and right sides; changed.
    """
    n = len(normal)
    # What ill-conditioned rows need to be solved at all.
    diagonal = np.einsum("iik->ik", normal[:, :n])
    diagonal *= 1.0 + 1e-6
    diagonal += 1e-6
    for i, row in enumerate(normal):
        np.maximum(row[i], 1e-9, out=row[i])
        below = row[i + 1 : n, None].copy()
        row[i + 1 :] /= row[i]
        normal[i + 1 :, i + 1 :] -= below * row[i + 1 :]
    information = normal[-1, -2].copy()
    solution = normal[:, n]
    for i in range(n - 1, 0, -1):
        solution[:i] -= normal[:i, i] * solution[i]
    return solution, information


def near(x: F32, fit: Fit, reach: float, least: float | F32 = 3.0) -> F32:
    """1 for samples that say something of the line, else 0."""
    near: F32 = (np.abs(x - fit.u) <= np.maximum(reach * fit.s, least) + np.float32(0.5)).astype(np.float32)
    return near


def _clipped(values: F32 | F64, low: float, high: float) -> NDArray[np.floating]:
    # What np.clip does before it clips costs more than clipping does.
    clipped: NDArray[np.floating] = np.minimum(np.maximum(values, low), high)
    return clipped


def bell_of(x: F32, fit: Fit) -> F32:
    z = (x - fit.u) / fit.s
    bell: F32 = np.exp(np.float32(-0.5) * z * z)
    return bell
