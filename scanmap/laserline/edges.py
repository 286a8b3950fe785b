"""Lines across an edge of the room's own brightness: where they would be, were both sides alike."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.channel import SATURATED
from scanmap.laserline.joints import Lit, off_joints
from scanmap.laserline.path import strips
from scanmap.laserline.peaks import Peaks, fit_gaussian
from scanmap.laserline.pictures import Rows, not_one
from scanmap.laserline.rounding import is_compressed
from scanmap.laserline.samples import Samples, ends
from scanmap.laserline.sight import Sight

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Index = NDArray[np.intp]

_UNEVEN = 2.5  # [noise] that a laser-off picture, smoothed, must differ by under a line
_ROWS = 7  # over which the two sides of a line are compared
_SURE = 4.5  # [sigma] of their difference, from which on it is there
_APART = 16  # rows in which a JPEG's blocks do the same
_RINGING = 0.05  # of a line's height, that compression leaves beside it
# An edge as high as the line's background, half on either side of it, moves a line by 1.7 widths (rms over places).
_MOVES, _WORTH = 1.7, 1.5
_PLACES_PX = np.arange(-6.0, 6.1, 1.0, dtype=np.float32)  # of the edge, from the middle of the window
_STEPS, _LONG = 4, 0.15  # at most, and [widths] what is long
_REST = 0.15  # of what an edge may do to a line, is left where its explanations agree
_FARTHEST = 1.0  # [widths] that an edge is believed to move a line by
_TRUE, _PAINT = 2, 3  # places of the light as it is, and over what was there, among the kinds that `_added` gives
_SHADOW = 0.1  # by which the former must explain lines better, as the logarithm of what a Gaussian leaves of them
_JOINT_DOUBT_PX, _JOINT_REST = 0.05, 0.3  # where a line lies on a dark joint: at least, and of what it is moved by
_CURVE_ROWS, _CURVE_DOUBT_PX = 9, 0.12  # over which a camera's curve does the same, and half of which is believed
_CLEAR = 0.7  # like _SHADOW, from which on the half of less is believed
_BESIDE = 0.1  # of a line's height, that the levels on its sides differ by where another line's light lies on one
_SKIRT, _GLOSS = (2.5, 3.5), 0.04  # [widths] where, and [heights] how much skirts on both sides are a gloss's
_BLUR_PX = 0.8  # of an edge, by optics and pixels
_RATIO = 4.0  # of the two sides, at most
_LEAST = 1.0  # [grey levels] of a side


class Sides(NamedTuple):
    """Levels beside N lines, of some rows each, arrays (N,) [grey levels]."""

    left: F32
    right: F32
    differ: NDArray[np.bool_]  # by more than noise explains


class Edges(NamedTuple):
    """What edges of the room's own brightness do to N lines, arrays (N,) [px]."""

    shift: F32  # that takes it back
    doubt: F32  # standard deviation of what is left; of all rows of an upright line alike


def no_edges(rows: int) -> Edges:
    """Nothing of `rows` lines."""
    return Edges(np.zeros(rows, np.float32), np.zeros(rows, np.float32))


def sides_of(y: F32, rows: Rows) -> Sides:
    """Levels at the two ends of windows (n, N)."""
    level = np.float32(np.sqrt(2.0 / (max(2, len(y) // 6) * _ROWS)))
    both, scatter = np.stack(ends(y)), rows.noise_of.astype(np.float32) * level
    for k, part in enumerate(rows.parts):
        if part.stop > part.start:
            both[:, part] = cv2.blur(both[:, part], (_ROWS, 1), borderType=cv2.BORDER_REPLICATE)
        if part.stop - part.start > 2 * _APART:
            # Compression leaves noise that means do not take out: what they still scatter by, some rows apart.
            step = both[1, part] - both[0, part]
            apart = np.abs(step[_APART:] - step[:-_APART])
            apart.partition(len(apart) // 2)
            scatter[k] = max(scatter[k], apart[len(apart) // 2] / np.float32(0.954))
    return Sides(both[0], both[1], np.abs(both[1] - both[0]) > (np.float32(_SURE) * scatter)[rows.picture])


def lean_alone(y: F32, peaks: Peaks, sides: Sides) -> F32:
    """How much lines (N,) lean of themselves; zero where other light makes them lean.

    That is another line's beside them, which makes the levels on their two sides differ, or a gloss, which is seen as
    skirts on both sides: of a line that lacks light, at least one side is steep.

    Args:
        y: (n, N) windows from which the room's own light was taken away.
        peaks: fitted to them.
        sides: of them.
    """
    x = np.arange(len(y), dtype=np.float32)[:, None] - len(y) // 2
    z = (x - peaks.offset_px) / peaks.width_px
    skirts = []
    for level, there in ((sides.left, -z), (sides.right, z)):
        skirt = (there > np.float32(_SKIRT[0])) & (there < np.float32(_SKIRT[1]))
        mean = (y * skirt).sum(axis=0) / np.maximum(skirt.sum(axis=0), 1)
        rises = np.where(skirt.any(axis=0), mean - level, np.float32(0.0))
        skirts.append(cv2.blur(rises.astype(np.float32)[None], (_ROWS, 1), borderType=cv2.BORDER_REPLICATE)[0])
    other = np.minimum(*skirts) > np.float32(_GLOSS) * peaks.height
    other |= np.abs(sides.right - sides.left) > np.float32(_BESIDE) * peaks.height
    return np.where(other, np.float32(0.0), peaks.lean)


def across_edges(
    peaks: Peaks, good: NDArray[np.bool_], sides: Sides, around: Samples, half: int, some: Index | slice
) -> Edges:
    """What steps of the room's brightness under the lines do to them.

    An edge of paint is in the line's light as in the room's: both are multiplied by the same step. A shadow's edge is
    in the room's only. How high the step is is seen beside the line; where it is, and of which kind, is what explains
    the row best.
    """
    edges = no_edges(len(good))
    contrast = np.abs(sides.right - sides.left) / np.maximum(sides.right + sides.left, np.float32(2.0 * _LEAST))
    moved = np.float32(_MOVES) * contrast * peaks.width_px
    differ = sides.differ & (np.abs(sides.right - sides.left) > _RINGING * peaks.height)
    at = np.flatnonzero(
        good & differ & (moved > _WORTH * peaks.sigma_px) & ~peaks.clipped & (np.abs(peaks.offset_px) < 2.0)
    )
    if not at.size:
        return edges
    y, usable = around.of(half, at if isinstance(some, slice) else some[at])
    whole = not_one(np.flatnonzero(usable.all(axis=0)))
    y, at = y.take(whole, axis=1), at[whole]
    noise = around.rows.of(some).noise[at]
    left, right = (np.maximum(side[at], np.float32(_LEAST)) for side in (sides.left, sides.right))
    right = np.minimum(np.maximum(right, left / np.float32(_RATIO)), left * np.float32(_RATIO))
    shift, spread = _explained(_evened(y, left, right), peaks.offset_px[at], peaks.width_px[at], noise)
    # Where explanations are far from each other, what is known beforehand counts as well.
    share = np.square(moved[at]) / (np.square(moved[at]) + np.square(spread))
    edges.shift[at] = share * shift
    edges.doubt[at] = np.hypot(np.sqrt(share) * spread, np.float32(_REST) * moved[at])
    return edges


def doubt_of_edges(peaks: Peaks, good: NDArray[np.bool_], sight: Sight, at: tuple[Index, Index], usable: F32) -> Edges:
    """How much is open of the places of lines (N,) that lie on what the laser-off picture shows uneven.

    Args:
        at: rows and columns (N,) of the middles of the windows.
        usable: (n, N) 1, or 0 for samples that say little.

    Paint dims both lights alike: what the laser added, over what was there without it, is the same on dark paint and on
    light. Where only the room's light differs (a shadow, a lamp), what a camera codes of the same laser is less on the
    bright side; its light is the same. Which it is, and by what curve light is coded, is not known: how far the line's
    places by all of these are from each other counts as doubt. Of pictures that a camera compressed the curve is: there
    the line is moved to where its light is.
    """
    edges = no_edges(len(good))
    assert sight.off is not None and sight.even is not None
    half = len(usable) // 2
    rows, columns = (values[good] for values in at)
    if not rows.size:
        return edges
    room = _strips(sight.even, rows, columns, half)
    low, high = room.min(axis=0), room.max(axis=0)
    contrast = (high - low) / np.maximum(high + low, np.float32(2.0 * _LEAST))
    uneven = high - low > np.float32(_UNEVEN * sight.noise[0])
    uneven &= _MOVES * contrast * peaks.width_px[good] > _WORTH * peaks.sigma_px[good]
    some = np.flatnonzero(uneven)
    if not some.size:
        return edges
    lit, dark = _strips(sight.on, rows[some], columns[some], half), room.take(some, axis=1)
    even = _added(lit, dark)
    which = np.flatnonzero(good)[some]
    tells = usable.take(which, axis=1) * (np.maximum(lit, dark) < SATURATED - 3)
    many = np.ascontiguousarray(np.broadcast_to(tells[:, None], even.shape)).reshape(len(even), -1)
    alone = Rows(np.zeros(many.shape[1], np.intp), sight.noise)
    found = fit_gaussian(even.reshape(len(even), -1), many, alone, peaks.contrast)
    u = found.offset_px.reshape(even.shape[1:]) - peaks.offset_px[which]
    edges.doubt[which] = np.minimum(np.maximum(u, -_MOVES), _MOVES).std(axis=0)
    if is_compressed(sight.roundings[0]):
        misfit = (found.noise / np.maximum(found.height, np.float32(1.0))).reshape(u.shape)
        shadow = np.log(misfit[_PAINT] / misfit[_TRUE])
        edges.shift[which] = _by_curve(u[_TRUE], shadow, rows[some], len(sight.even))
        above, below = (np.clip(rows[some] + k, 0, len(sight.off) - 1) for k in (-1, 1))
        seen = sum(_strips(sight.off, row, columns[some], half) for row in (above, rows[some], below))
        before = _light(np.asarray(seen, np.float32) * np.float32(sight.gain / 3.0))
        lines = Lit(even[:, _TRUE], before, tells, rows[some], peaks.offset_px[which], peaks.width_px[which])
        joint, shift = off_joints(lines, len(sight.even), sight.noise, peaks.contrast)
        at_joint, shift = which[joint], shift[joint]
        edges.shift[at_joint] = shift
        edges.doubt[at_joint] = np.hypot(np.float32(_JOINT_DOUBT_PX), np.float32(_JOINT_REST) * shift)
    return edges


def _by_curve(moved: F32, shadow: F32, row: Index, height: int) -> F32:
    """What is to be believed of how far lines in `row` (M,) are `moved` (M,) [px] to where their light is.

    Cameras that compress code light by a curve. One row's noise is as large as what that does to most lines; what all
    rows around have in common is not, and counts the more the larger it is, and the clearer it is that the edges are a
    `shadow`'s (M,). Where they are paint's as well nothing is moved.
    """
    total, count, kind = np.zeros((3, height), np.float32)
    total[row], count[row], kind[row] = np.minimum(np.maximum(moved, -_FARTHEST), _FARTHEST), 1.0, shadow
    sums, rows, kinds = (
        np.asarray(cv2.blur(v[None], (_CURVE_ROWS, 1), borderType=cv2.BORDER_CONSTANT)[0], np.float32)[row]
        for v in (total, count, kind)
    )
    kinds /= rows
    common = sums / rows * (kinds > np.float32(_SHADOW))
    doubt = np.float32(_CURVE_DOUBT_PX * _CLEAR) / np.maximum(kinds, np.float32(_CLEAR))
    believed: F32 = common * (np.square(common) / (np.square(common) + np.square(doubt)))
    return believed


def _added(lit: F32, dark: F32) -> F32:
    """What a laser added to windows (n, M): as coded or as light, as it is or over what was there: (n, 4, M)."""
    high = dark.max(axis=0)
    paint = np.maximum(dark, np.maximum(high / np.float32(_RATIO), np.float32(_LEAST)))
    light, before = _light(lit), _light(dark)
    usual = (_light(lit + np.float32(1.0)) - light).mean(axis=0)
    albedo = np.maximum(before, before.max(axis=0) / np.float32(_RATIO * _RATIO))
    coded, true = lit - dark, (light - before) / usual
    kinds = [coded, coded * (paint.mean(axis=0) / paint), true, true * (albedo.mean(axis=0) / albedo)]
    return np.ascontiguousarray(np.stack(kinds, axis=1), np.float32)


def _strips(plane: U8, row: Index, column: Index, half: int) -> F32:
    """Samples (2 half + 1, N) around integer columns (N,) of rows (N,)."""
    return strips(plane, row, column, half).astype(np.float32)


def _light(coded: F32) -> F32:
    """Light [of saturation] behind grey levels, by the curve that cameras code it with (IEC 61966-2-1)."""
    v = np.maximum(coded, 0.0) * np.float32(1.0 / 255.0)
    light: F32 = np.where(v <= 0.04045, v * (1.0 / 12.92), ((v + 0.055) * (1.0 / 1.055)) ** 2.4).astype(np.float32)
    return light


def _evened(y: F32, left: F32, right: F32) -> F32:
    """Windows (n, M) as they would be without edges of known height at several places (n, K, M)."""
    x = (np.arange(len(y), dtype=np.float32) - len(y) // 2)[:, None]
    middle = np.float32(0.5) * (left + right)
    # An edge, or an even ramp from one end to the other.
    step = np.concatenate([_step(x, _PLACES_PX), 0.5 + x / np.float32(len(y) - 2)], axis=1)[:, :, None]
    level = (left + (right - left) * step).astype(np.float32)
    paint, shadow = level / middle, level - middle
    return np.concatenate([y[:, None] / paint, y[:, None] - shadow, y[:, None]], axis=1)


def _explained(even: F32, u: F32, width: F32, noise: F32) -> tuple[F32, F32]:
    """How far lines (M,) lie from `u`, by several explanations of their windows, and how far those are from each other.

    Args:
        even: (n, K, M) the windows without what each explanation says is not the line.
        u: (M,) where the lines are without any [px from the middle].
        width: (M,) how wide they are, as sigma [px].
        noise: (M,) standard deviation of a sample [grey levels].

    Steps of Gauss and Newton from a common place, weighted by their likelihoods; where they are long, again from there.
    """
    start, limit = u, np.float32(_FARTHEST) * width
    shift, spread = np.zeros_like(u), np.zeros_like(u)
    far = np.arange(len(u))
    for _ in range(_STEPS):
        step, spread[far], wider = _step_from(even.take(far, axis=2), start[far] + shift[far], width[far], noise[far])
        shift[far] = np.minimum(np.maximum(shift[far] + step, -limit[far]), limit[far])
        long = np.abs(step) > _LONG * width[far]
        width = width.copy()
        width[far] = np.maximum(width[far] * wider, np.float32(0.5))
        far = not_one(far[long])
        if not far.size:
            break
    return shift, spread


def _step_from(even: F32, u: F32, width: F32, noise: F32) -> tuple[F32, F32, F32]:
    """One step (M,) from `u`, the spread of the explanations' places, and the factor by which lines are wider."""
    n = len(even)
    z = ((np.arange(n, dtype=np.float32) - n // 2)[:, None] - u) / width
    bell = np.exp(np.float32(-0.5) * np.square(z))
    profiles = [np.ones_like(bell), bell, bell * np.square(z), bell * z]
    parts = _orthogonal(profiles)
    level, high, wide, moved = (np.einsum("nm,nkm->km", part, even) for part in parts)
    chi2 = np.einsum("nkm,nkm->km", even, even) - level**2 - high**2 - wide**2 - moved**2
    chi2 *= np.float32(1.0) / np.square(noise)
    # Lengths of what each profile has of its own turn shares into height, width and place.
    _, per_height, per_width, per_shift = (
        np.einsum("nm,nm->m", part, profile) for part, profile in zip(parts, profiles, strict=True)
    )
    wider = wide / per_width
    height = high / per_height - wider * np.einsum("nm,nm->m", parts[1], profiles[2]) / per_height
    height = np.maximum(height, np.float32(0.2) * high / per_height + np.float32(0.1))
    shift = np.minimum(np.maximum(moved / per_shift / height, np.float32(-0.5)), np.float32(0.5)) * width
    wider = np.minimum(np.maximum(np.float32(1.0) + wider / height, np.float32(0.7)), np.float32(1.4))
    # What no explanation covers is not noise: it makes all of them more alike.
    least = chi2.min(axis=0)
    scatter = np.maximum(least / np.float32(max(n - 6, 1)), np.float32(1.0))
    share = np.exp(np.float32(-0.5) * (chi2 - least) / scatter)
    share /= share.sum(axis=0)
    place = (share * shift).sum(axis=0)
    return place, np.sqrt((share * np.square(shift - place)).sum(axis=0)), (share * wider).sum(axis=0)


def _orthogonal(parts: list[F32]) -> list[F32]:
    """Each of the profiles (n, M) without what those before it have of it, of length 1 (Gram and Schmidt)."""
    done: list[F32] = []
    for part in parts:
        own = part.copy()
        for other in done:
            own -= other * np.einsum("nm,nm->m", other, own)
        own *= np.float32(1.0) / np.sqrt(np.einsum("nm,nm->m", own, own))
        done.append(own)
    return done


def _step(x: F32, places: F32) -> F32:
    """A blurred step (n, K), by the logistic that is nearest to a Gaussian's integral."""
    step: F32 = (1.0 / (1.0 + np.exp((places - x) * np.float32(1.7 / _BLUR_PX)))).astype(np.float32)
    return step
