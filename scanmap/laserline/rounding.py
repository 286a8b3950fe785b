"""What a JPEG's rounding does to all rows of an upright line alike, foretold from the file's own tables.

The rows of an upright line lie alike in the file's blocks of eight columns. Whatever is rounded away of one row is
rounded away of all: no pooling takes it out, and no scatter along the line shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.grey import NEIGHBOUR

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

LIGHT = 0.12  # share of the laser's light that a neighbouring channel sees

_TABLES, _FRAMES, _SCAN = 0xDB, (0xC0, 0xC1, 0xC2), 0xDA  # marker segments (ITU-T T.81, table B.1)
_FIRST_ROW = (0, 1, 5, 6, 14, 15, 27, 28)  # where a table's first row stands in it
# Channels (blue, green, red) from brightness, Cb and Cr, and the latter from the former (JFIF 1.02; BT.601).
_FROM_COLOUR = ((1.772, 0.0), (-0.344, -0.714), (0.0, 1.402))
_TO_COLOUR = np.array([[0.114, 0.587, 0.299], [0.5, -0.331, -0.169], [-0.081, -0.419, 0.5]])
_REACH = 3.2  # [widths] samples farther from the line say nothing of it
_PHASES = 4  # places a column at which a line is tried
_STEPS = 4  # widths and heights an octave that the error is tabulated at
_FIRST = (-4, 8)  # steps from 1 to the first of them
_WIDTHS = 2.0 ** (np.arange(_FIRST[0], 13) / _STEPS)  # [px] 0.5 to 8
_HEIGHTS = 2.0 ** (np.arange(_FIRST[1], 33) / _STEPS)  # [grey levels] 4 to 256


# Of the laser's channel in a mixture, that are weighed up; the last is best where nothing but independent noise counts.
_SHARES = (0.34, 0.42, 0.5, 0.58, 0.66, 0.75, 0.82, 0.89)
# How far a line moves until what is rounded of it is another error [px]: measured, 0.06 to 0.2, the less the higher the
# line; and the frequency of what is rounded to nothing [rad/px], the lower ones being too strong, the others too weak.
_ALIKE_PX, _WAVE = 0.1, 1.2
_USUAL = (6, 18)  # place among widths and heights that they are weighed up for: 1.4 px, 91 grey levels
_POOLED = 6.0  # variances of noise that pooling makes one of; it leaves what is rounded as it is


class Rounding(NamedTuple):
    """The steps that a JPEG rounds to, of what is even down a block; column frequencies 0 to 7."""

    brightness: tuple[float, ...]  # (8,) [grey levels of the transform, whose even part is 8 times a sample]
    colour: tuple[tuple[float, ...], tuple[float, ...]] | None  # (8,) each of Cb and Cr; None in a grey file
    columns: int = 1  # that share a sample of colour
    rows: int = 1


_NOTHING = Rounding((1e-6,) * 8, None)  # but to whole grey levels


class Mixture(NamedTuple):
    """The channels of a picture that the line is placed in."""

    channel: int  # the laser's (blue, green, red); -1: brightness alone
    share: float = 1.0  # of it; the rest is its neighbour's


def is_compressed(rounding: Rounding | None) -> bool:
    """Whether a picture is known to have been a JPEG."""
    return rounding is not None and rounding is not _NOTHING


def rounding_of(data: bytes) -> Rounding | None:
    """The rounding of an encoded picture; None of a JPEG whose header cannot be read."""
    at, tables = 2, b""
    if data[:2] != b"\xff\xd8":
        return _NOTHING
    while at + 4 < len(data) and data[at] == 0xFF:
        kind, size = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if kind == _SCAN or size < 2:
            break
        if kind == _TABLES:
            tables += data[at + 4 : at + 2 + size]
        if kind in _FRAMES:
            return _rounding(tables, data[at + 9 : at + 2 + size])
        at += 2 + size
    return None


@lru_cache(8)
def _rounding(tables: bytes, parts: bytes) -> Rounding | None:
    """The rounding by a file's quantisation tables, and its frame header from the count of components on."""
    steps, at = {}, 0
    while at < len(tables):
        wide = tables[at] >> 4  # 0: steps of one byte, 1: of two
        end = at + 1 + 64 * (1 + wide)
        if wide > 1 or end > len(tables):
            return None
        values = np.frombuffer(tables[at + 1 : end], ">u2" if wide else "u1")
        steps[tables[at] & 15] = tuple(max(float(values[k]), 1.0) for k in _FIRST_ROW)
        at = end
    each = [(parts[k + 1] >> 4, parts[k + 1] & 15, parts[k + 2]) for k in range(1, len(parts) - 2, 3)]
    if len(each) not in (1, 3) or any(table not in steps or not across or not down for across, down, table in each):
        return None
    if len(each) == 1:
        return Rounding(steps[each[0][2]], None)
    (across, down, own), (across_colour, down_colour, blue), (_, _, red) = each
    columns, rows = across // across_colour, down // down_colour
    return Rounding(steps[own], (steps[blue], steps[red]), columns, rows) if {columns, rows} <= {1, 2, 4} else None


@lru_cache(256)
def best_mixture(rounding: Rounding, channel: int, noise: tuple[float, float, float]) -> Mixture:
    """The mixture of a channel and its neighbour that places a line best.

    Args:
        rounding: of the file.
        channel: the laser's.
        noise: of the channel, of its neighbour and of their difference [grey levels].
    """
    own, other, difference = (value**2 for value in noise)
    both = 0.5 * (own + other - difference)
    best, least = Mixture(channel), np.inf
    for share in _SHARES:
        tried, rest = Mixture(channel, share), 1.0 - share
        variance = share**2 * own + rest**2 * other + 2.0 * share * rest * both
        variance *= _responses(1).samples[_USUAL[0]] / ((share + rest * LIGHT) * _HEIGHTS[_USUAL[1]]) ** 2
        total = variance / _POOLED + float(np.square(_table(rounding, tried, 0.0)[:, *_USUAL]).sum())
        if total < least:
            best, least = tried, total
    return best


def shared_px(
    rounding: Rounding, mixture: Mixture, noise: float, width: NDArray[np.floating], height: NDArray[np.floating]
) -> F32:
    """Standard deviations (2, N) [px] of the errors that the rows of an upright line share; anything where it is NaN.

    Args:
        rounding: of the file.
        mixture: what the line is placed in.
        noise: of a sample [grey levels]; noise that is larger than the steps takes their error out of the mean.
        width: (N,) of the line [px].
        height: (N,) [grey levels].

    Returns:
        of what is rounded, which is another error a tenth of a column farther on, and of what is rounded to nothing.
    """
    table = _table(rounding, mixture, round(noise, 1))
    across, down = (
        np.minimum(np.maximum(np.rint(_STEPS * np.log2(np.fmax(v, 0.1, dtype=np.float32)) - first), 0), n - 1)
        for v, first, n in ((width, _FIRST[0], len(_WIDTHS)), (height, _FIRST[1], len(_HEIGHTS)))
    )
    shared: F32 = table.reshape(2, -1).take((across * len(_HEIGHTS) + down).astype(np.intp), axis=1)
    return shared


def hidden_px(rounding: Rounding, shared: F32, moved: NDArray[np.floating]) -> F32:
    """What of `shared_px` (2, H) fourth differences along the line are blind to (H,) [px].

    Args:
        rounding: of the file.
        shared: (2, H) as `shared_px` has it.
        moved: (H,) columns that the line moves on by from one of their rows to the next [px].

    On an upright line they see nothing of it. Of errors correlated by r from one row to the next they lack the share
    1.6 r - 0.8 r^4 + ...; of a wave, all but (2 sin(phase / 2))^8 / 70.
    """
    moved = moved.astype(np.float32)
    r = np.exp(np.square(moved) * (-0.5 / _ALIKE_PX**2))
    r4 = np.square(np.square(r))
    r8 = np.square(r4)
    quick = 1.6 * r - 0.8 * r4 + r8 * (8.0 / 35.0 * r - r8 / 35.0)
    phase = np.minimum(np.abs(moved) * (_WAVE / rounding.columns), np.pi)
    seen = np.square(np.square(np.square(2.0 * np.sin(0.5 * phase)))) * (1.0 / 70.0)
    hidden: F32 = np.sqrt(np.square(shared[0]) * quick + np.square(shared[1]) * np.maximum(1.0 - seen, 0.0))
    return hidden


@lru_cache(256)
def _table(rounding: Rounding, mixture: Mixture, noise: float) -> F32:
    """`shared_px` by width and height."""
    (brightness, blue, red), heights = _parts(mixture)
    # Colour's noise is a mean over its sample's pixels; a third of what is left of three channels'.
    quiet = 1.0 / np.sqrt(rounding.columns * rounding.rows)
    parts = [(brightness, heights[0], rounding.brightness, 1, 1.0 if rounding.colour is None else 0.67)]
    for part, own, steps in zip((blue, red), heights[1:], rounding.colour or (), strict=False):
        parts.append((part, own, steps, rounding.columns, 0.66 * quiet))
    whole = _left_by_noise(np.ones(1), noise)[0]  # of samples, which are whole grey levels
    weights = (mixture.share**2 + (1.0 - mixture.share) ** 2) * brightness**2 if mixture.channel >= 0 else 0.0
    quick = weights * whole * _responses(1).samples[:, None] / np.square(_HEIGHTS)
    slow = np.zeros_like(quick)
    for part, own, steps, columns, share in parts:
        line, step = _responses(columns), np.array(steps)
        rounded = line.waves[:, None] * _left_by_noise(step, share * noise) / np.square(_HEIGHTS)[:, None]
        # What is rounded to nothing errs by all there was, and by nearly the same a column farther on.
        error = part**2 * np.minimum(rounded, (line.lost * own**2)[:, None])
        nothing = abs(own) * line.held[:, None] * _HEIGHTS[:, None] < step
        slow += (error * nothing).sum(axis=2)
        quick += (error * ~nothing).sum(axis=2)
        quick += part**2 * (line.samples[:, None] * whole / np.square(_HEIGHTS) + (line.smeared * own**2)[:, None])
    return np.asarray(np.sqrt([quick, slow]), np.float32)


def _parts(mixture: Mixture) -> tuple[Sequence[float], Sequence[float]]:
    """What a mixture, as high as the laser's own channel, holds of brightness, Cb and Cr; its line's in them."""
    if mixture.channel < 0:
        return (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)
    neighbour, rest = NEIGHBOUR[mixture.channel], 1.0 - mixture.share
    per = 1.0 / (mixture.share + rest * LIGHT)
    mixed = zip(_FROM_COLOUR[mixture.channel], _FROM_COLOUR[neighbour], strict=True)
    light = np.zeros(3)
    light[mixture.channel], light[neighbour] = 1.0, LIGHT
    return (per, *(per * (mixture.share * own + rest * other) for own, other in mixed)), tuple(_TO_COLOUR @ light)


def _left_by_noise(step: F64, noise: float) -> F64:
    """Variance (n,) of the mean error of values rounded to a step each, after noise.

    The rounding error's Fourier series, each term damped by the noise's characteristic function (Widrow 1956).
    """
    n = np.arange(1, 6)[:, None]
    damped = np.exp(-np.square(2.0 * np.pi * n * noise / step))
    left: F64 = (np.square(step / (np.pi * n)) * 0.5 * damped).sum(axis=0)
    return left


class _Responses(NamedTuple):
    """What moves lines of _WIDTHS and height 1, mean squares over all places in a block [px^2]."""

    waves: F64  # (W, 8) by each frequency, an error of 1 in it
    lost: F64  # (W, 8) where the line has none of it left
    samples: F64  # (W,) an error of 1 in every sample
    smeared: F64  # (W,) what is stored at fewer columns
    held: F64  # (W, 8) how much of each frequency the line has at most, on average


@lru_cache(4)
def _responses(columns: int) -> _Responses:
    """The responses of a plane that is stored at one sample for so many `columns`."""
    count, block = 128, 8 * columns
    x = np.arange(count)
    stored = (np.arange(count // columns) + 0.5) * columns - 0.5
    spread = np.stack([np.interp(x, stored, one) for one in np.eye(len(stored))], axis=1)  # (count, stored)
    k = np.arange(8)[:, None]
    waves = np.where(k == 0, np.sqrt(0.125), 0.5 * np.cos(np.pi * k * (2 * k.T + 1) / 16.0))
    place = count // 2 + np.arange(0, block, 1.0 / _PHASES)[:, None]
    s = _WIDTHS[:, None, None]
    z = (x - place) / s
    line = np.exp(-0.5 * z * z)  # (W, P, count)
    near = np.abs(z) <= np.maximum(_REACH, 3.0 / s)
    told = near * line * z / s  # what each sample says of the place: derivative by it, free of the level
    told -= near * (told.sum(axis=2) / near.sum(axis=2))[..., None]
    told /= np.square(told).sum(axis=2)[..., None]
    seen = told @ spread
    means = line.reshape(*line.shape[:2], -1, columns).mean(axis=3)
    by_wave, held = (v.reshape(*v.shape[:2], -1, 8) @ waves.T for v in (seen, means))
    return _Responses(
        np.square(by_wave).sum(axis=2).mean(axis=1) / 8.0,
        np.square((by_wave * held).sum(axis=2)).mean(axis=1),
        np.square(seen).sum(axis=2).mean(axis=1),
        np.square((told * (means @ spread.T - line)).sum(axis=2)).mean(axis=1),
        4.0 * np.sqrt(np.square(held).sum(axis=2).mean(axis=1)),
    )
