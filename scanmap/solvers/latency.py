"""How much later than its exposure a picture is stamped: from sweeps in both directions, or from a blinking laser."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import CalibrationError

Array = NDArray[np.float64]

SEARCH_S = 1.0  # no camera is later than that
STEPS_ROUND = 41  # of the search, each round ten times finer
ROUNDS = 3
BLOCKS = 8  # bearings are left out in so many blocks in turn, to see how sure the result is
LEAST_PAIRS = 200  # of rows seen in both directions
BESIDE = 1  # pictures
TUKEY = 4.685  # 95 % efficient for Gaussian noise (Huber, Ronchetti 2009)


class Latency(NamedTuple):
    """What was measured."""

    latency_s: float  # beyond the latency already taken off the stamps
    sigma_s: float
    samples: int
    backlash_deg: float = 0.0  # play of the gear that sweeps at two speeds tell apart from latency


class Pass(NamedTuple):
    """A sweep in one direction, as the image saw it."""

    bearings: Array  # (B,) [rad], in order or in reverse
    columns: Array  # (B, H) of the laser line [px]; NaN = none


class Blink(NamedTuple):
    """The laser was switched once."""

    switched: float  # [s] when, on the clock of the pictures
    times: Array  # (N,) of pictures around it [s]
    levels: Array  # (N,) how much of the laser's light they show, 0 to 1


def shift_between(forward: Pass, backward: Pass, most_rad: float) -> tuple[float, float, int]:
    """By how much the two passes are turned against each other: forward(b) = backward(b - shift).

    A latency makes every bearing of the forward pass too large and of the backward pass too small by
    speed times latency, so the shift is twice that; play of the gear adds to it at any speed.

    Args:
        most_rad: the largest shift looked for [rad].

    Returns:
        The shift [rad], its standard deviation, and how many rows were compared.

    Raises:
        CalibrationError: too little was seen in both directions.
    """
    back = _in_order(backward)
    front = _in_order(forward)
    shift = _best_shift(front, back, most_rad)
    blocks = np.array_split(np.arange(len(front.bearings)), BLOCKS)
    left_out = np.array([_refined(_without(front, block), back, shift)[0] for block in blocks])
    shift, pairs = _refined(front, back, shift)
    sigma = math.sqrt((BLOCKS - 1) / BLOCKS * float(((left_out - left_out.mean()) ** 2).sum()))
    return shift, sigma, pairs


def latency_of_sweeps(passes: Sequence[tuple[float, Pass, Pass]]) -> Latency:
    """Latency from sweeps forward and backward, at one speed or more.

    Args:
        passes: speed [rad/s], forward and backward pass.

    Raises:
        CalibrationError: too little was seen in both directions.

    With shift = 2 speed latency + backlash, two speeds tell both; with one the backlash is taken for zero.
    """
    speeds = np.array([speed for speed, _, _ in passes])
    found = [shift_between(front, back, 2 * speed * SEARCH_S) for speed, front, back in passes]
    shifts = np.array([shift for shift, _, _ in found])
    sigmas = np.maximum([sigma for _, sigma, _ in found], 1e-7)
    pairs = sum(count for _, _, count in found)
    if len(set(speeds.tolist())) < 2:
        weights = 1 / sigmas**2
        latency = float((weights * shifts / (2 * speeds)).sum() / weights.sum())
        return Latency(latency, float(math.sqrt(1 / (weights * 4 * speeds**2).sum())), pairs)
    design = np.column_stack([2 * speeds, np.ones(len(speeds))]) / sigmas[:, None]
    covariance = np.linalg.inv(design.T @ design)
    latency, backlash = covariance @ design.T @ (shifts / sigmas)
    return Latency(float(latency), float(math.sqrt(covariance[0, 0])), pairs, math.degrees(float(backlash)))


def latency_of_blinks(blinks: Sequence[Blink]) -> Latency:
    """Latency from moments at which the laser was switched, and the pictures that saw it.

    All blinks together are one step: at which time after the switching do pictures change from the level before to
    the level after? Switched at even phases of the camera's period, the pictures lie densely around it.

    Raises:
        CalibrationError: the pictures do not show the laser being switched.
    """
    seen = [blink for blink in blinks if abs(_level_at(blink, -1) - _level_at(blink, 0)) > 0.5]
    if len(seen) < max(4, len(blinks) // 2):
        raise CalibrationError(
            f"only {len(seen)} of {len(blinks)} blinks of the laser are seen in the pictures: point the head at a "
            "near, dull wall, and see that camera.exposure_us is fixed"
        )
    left_out = np.array([_step([b for k, b in enumerate(seen) if k % BLOCKS != block]) for block in range(BLOCKS)])
    sigma = math.sqrt((BLOCKS - 1) / BLOCKS * float(((left_out - left_out.mean()) ** 2).sum()))
    # Never surer than the pictures lie apart.
    apart = float(np.median(np.concatenate([np.diff(np.sort(blink.times)) for blink in seen])))
    return Latency(_step(seen), max(sigma, apart / (math.sqrt(12) * len(seen))), len(seen))


def _level_at(blink: Blink, which: int) -> float:
    return float(blink.levels[np.argsort(blink.times)[which]])


def _step(blinks: Sequence[Blink]) -> float:
    """Seconds after the switching at which a step fits the levels best, in the sense of least absolute differences."""
    since = np.concatenate([blink.times - blink.switched for blink in blinks])
    # Switched off is switched on upside down.
    levels = np.concatenate([b.levels if _level_at(b, -1) > 0.5 else 1.0 - b.levels for b in blinks])
    order = np.argsort(since)
    since, levels = since[order], np.clip(levels[order], 0.0, 1.0)
    cost = np.concatenate([[0.0], np.cumsum(levels)]) + np.concatenate([np.cumsum(1.0 - levels[::-1])[::-1], [0.0]])
    best = np.flatnonzero(cost[1:-1] <= cost[1:-1].min() + 1e-9) + 1
    return float(np.mean(since[best - 1] + since[best]) / 2)


def _in_order(one: Pass) -> Pass:
    order = np.argsort(one.bearings, kind="stable")
    bearings, first = np.unique(one.bearings[order], return_index=True)
    return Pass(bearings, one.columns[order][first])


def _without(one: Pass, block: NDArray[np.intp]) -> Pass:
    return Pass(np.delete(one.bearings, block), np.delete(one.columns, block, axis=0))


def _best_shift(front: Pass, back: Pass, most: float) -> float:
    """By trying, finer each round, from the middle of what still fits."""
    middle, reach = 0.0, most
    # At least as fine at first as pictures lie apart: a wrong valley would never be left again.
    steps = max(STEPS_ROUND, 2 * math.ceil(2 * most / max(float(np.median(np.diff(back.bearings))), 1e-6)) + 1)
    for _ in range(ROUNDS):
        trials = np.linspace(middle - reach, middle + reach, steps)
        costs = [_cost(front, back, shift) for shift in trials]
        if not np.isfinite(costs).any():
            raise CalibrationError(
                "the laser line is seen in too few rows in both directions: point the middle of the sweep at "
                "furniture, or sweep more of the room (--span-deg)"
            )
        middle = float(trials[int(np.nanargmin(costs))])
        reach, steps = 2 * reach / (steps - 1) * 2, STEPS_ROUND
    return middle


def _cost(front: Pass, back: Pass, shift: float) -> float:
    """Mean absolute difference in pixels, capped: what one direction sees and the other does not shall not rule."""
    difference, _ = _difference(front, back, shift)
    difference = np.abs(difference[np.isfinite(difference)])
    return float(np.minimum(difference, 20.0).mean()) if difference.size > LEAST_PAIRS else math.inf


def _refined(front: Pass, back: Pass, shift: float) -> tuple[float, int]:
    """Gauss-Newton from a shift that is nearly right; the shift and the rows it rests on."""
    pairs = 0
    for _ in range(8):
        difference, slope = _difference(front, back, shift)
        known = np.isfinite(difference) & np.isfinite(slope)
        r, g = difference[known], slope[known]
        pairs = int(known.sum())
        if pairs <= LEAST_PAIRS:
            raise CalibrationError(
                "the laser line is seen in too few rows in both directions: sweep more of the room (--span-deg)"
            )
        scale = max(1.4826 * float(np.median(np.abs(r))), 0.02)
        weight = np.clip(1.0 - (r / (TUKEY * scale)) ** 2, 0.0, None) ** 2
        # Rows along which nothing changes say nothing, depth edges would say too much.
        g = np.clip(g, -3 * np.median(np.abs(g)) - 1.0, 3 * np.median(np.abs(g)) + 1.0)
        bottom = float((weight * g * g).sum())
        if bottom <= 0:
            raise CalibrationError(
                "nothing in view changes with the bearing: sweep past corners and furniture (--span-deg)"
            )
        shift -= float((weight * g * r).sum()) / bottom
    return shift, pairs


def _difference(front: Pass, back: Pass, shift: float) -> tuple[Array, Array]:
    """Columns of the forward pass minus those of the backward one at the shifted bearing; and its slope in `shift`.

    The slope is taken from pictures beside the two that are interpolated: from the same two its noise would be
    that of the difference, and pull the shift toward one of them.
    """
    at = front.bearings - shift
    last = len(back.bearings) - 1
    k = np.clip(np.searchsorted(back.bearings, at) - 1, 0, last - 1)
    share = ((at - back.bearings[k]) / (back.bearings[k + 1] - back.bearings[k]))[:, None]
    difference = front.columns - (back.columns[k] * (1.0 - share) + back.columns[k + 1] * share)
    difference[(at < back.bearings[0]) | (at > back.bearings[-1])] = np.nan
    before, behind = k - BESIDE, k + 1 + BESIDE
    known = (before >= 0) & (behind <= last)
    before, behind = np.clip(before, 0, last), np.clip(behind, 0, last)
    width = np.where(known, back.bearings[behind] - back.bearings[before], np.nan)
    return difference, (back.columns[behind] - back.columns[before]) / width[:, None]
