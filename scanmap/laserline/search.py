"""Where the line runs: one column per block of rows, by a quick look where that settles it, else with all rivals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.candidates import (
    BLOCK,
    COUNT,
    MANY,
    Candidates,
    block_window,
    find_candidates,
    unit_of,
)
from scanmap.laserline.colour import blocks_of, colour_doubt
from scanmap.laserline.grey import NEIGHBOUR, extract
from scanmap.laserline.leads import STEEP_PX, find_leads, settled, shares_of
from scanmap.laserline.path import choose_path, stand_out
from scanmap.laserline.sight import Sight

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_FULL, _HIGH = 4, 0.5  # candidates of a block, so high beside its highest, from which on there may be more
_OTHER = 0.5  # of its signal to noise, that a candidate is worth at most if it is of another colour or untold
_GOES_ON = 0.5  # least height of a line between two places, over the lesser of theirs


class Course(NamedTuple):
    """Where the line runs through B blocks of rows of P pictures."""

    column: F32  # (P, B) [px] NaN where there is none
    pure: Mask  # (P, B) of the laser's colour beyond doubt
    # (ceil(B / 2), n) [px] for each picture: all that looks like a line in every other block, NaN where nothing does
    places: Sequence[F32]


class _Quick(NamedTuple):
    """What a quick look settles of B blocks of P pictures."""

    candidates: Candidates  # (P, B, 1) the only one of each block; snr 0 where it is not settled
    shares: F32  # (P, B) of the candidates' height in other channels, NaN where that is not settled
    beside: F32  # (P, ceil(B / 2)) [px] what comes next to it in every other block, NaN where nothing does


def search(sight: Sight, window: F64, min_snr: float, still: Mask | None = None) -> Course:
    """The line's column in each block of rows.

    Args:
        window: (H, 2) first and last column of each row, NaN where a row can have no line.
        min_snr: least signal to noise of a place that can be the line.
        still: (B, W) where things of the room are known to be; nothing there is taken for the line.
    """
    if still is not None or not sight.large:
        searched = [_searched(picture, window, min_snr, still) for picture in sight.pictures()]
        column = np.stack([path for path, _ in searched])
        return Course(column, np.zeros(column.shape, bool), [places for _, places in searched])
    quick = _settled(sight, window, min_snr)
    good = quick.candidates.snr[..., 0] > 0
    column, places = np.empty(good.shape, np.float32), list[F32]()
    for k, settled_blocks in enumerate(good):
        found = Candidates(quick.candidates.column[k], quick.candidates.snr[k])
        rest, score = (~settled_blocks).nonzero()[0], found.snr
        if rest.size:
            picture = sight.picture(k)
            found = _with_blocks(found, rest, _all_candidates(picture, rest, window, min_snr))
            found, score = _scored(picture, found, quick.shares[k], window, min_snr)
        column[k] = choose_path(found, score, min_snr)
        places.append(np.concatenate((_places(found, min_snr), quick.beside[k, :, None]), axis=1))
    return Course(column, good, places)


def _searched(sight: Sight, window: F64, min_snr: float, still: Mask | None) -> tuple[F32, F32]:
    """The line's column (B,) in one picture, and all places like it, of all candidates of all blocks."""
    other = None if sight.image is None else blocks_of(sight.image, NEIGHBOUR[sight.channel])
    found = find_candidates(sight.lit, window, float(sight.noise[0]), min_snr, other, sight.large, still)
    found, score = _scored(sight, found, np.full(len(found.snr), np.nan, np.float32), window, min_snr, still)
    return choose_path(found, score, min_snr), _places(found, min_snr)


def _places(found: Candidates, min_snr: float) -> F32:
    """The candidates' columns in every other block, NaN where they are none."""
    return np.where(found.snr[::2] >= min_snr, found.column[::2], np.float32(np.nan))


def _settled(sight: Sight, window: F64, min_snr: float) -> _Quick:
    """What one row of every other block settles; in the blocks between, the line must go on as high."""
    first, last = block_window(window)
    shape = (len(sight.noise), len(first))
    leads = find_leads(sight.rows.reshape(shape[0], -1, sight.rows.shape[1]), (first[::2], last[::2]))
    good = settled(leads, sight.noise, min_snr)
    known = np.zeros(good.shape, np.float32)
    if sight.image_rows is not None:
        known = shares_of(sight.image_rows, leads, sight.channel, good)
        good = ~np.isnan(known)
    column, height, shares = (np.zeros(shape, np.float32) for _ in range(3))
    column[:, ::2], height[:, ::2], shares[:, ::2] = leads.column, np.where(good, leads.height, np.float32(0.0)), known
    between = shape[1] // 2
    after = np.minimum(np.arange(1, between + 1), good.shape[1] - 1)
    near = np.abs(leads.column[:, :between] - leads.column[:, after]) < STEEP_PX
    picture, both = (good[:, :between] & good[:, after] & near).nonzero()
    here, there = (picture, both), (picture, after[both])
    middle = 0.5 * (leads.column[here] + leads.column[there])
    row = np.minimum((2 * both + 1) * BLOCK + 1, sight.height - 1) + picture * sight.height
    at, response = stand_out(sight.lit, row, middle, sight.noise)
    least = np.minimum(leads.height[here], leads.height[there])
    odd = (picture, 2 * both + 1)
    column[odd], shares[odd] = at, 0.5 * (known[here] + known[there])
    height[odd] = np.where(response > _GOES_ON * least, response, np.float32(0.0))
    shares[height == 0] = np.nan
    unit = np.array([[unit_of(noise, True)] for noise in sight.noise.tolist()], np.float32)
    beside = np.where(leads.rival >= min_snr * unit, leads.beside, np.float32(np.nan))
    return _Quick(Candidates(column[..., None], (height / unit)[..., None]), shares, beside)


def _all_candidates(
    sight: Sight, blocks: Index, window: F64, min_snr: float, still: Mask | None = None, count: int = COUNT
) -> Candidates:
    """All candidates of some blocks (n,) of one picture."""
    still = None if still is None else still[blocks]
    rows = np.minimum((blocks[:, None] * BLOCK + np.arange(BLOCK)).ravel(), len(sight.lit) - 1)
    if sight.image is None:
        return find_candidates(
            sight.lit[rows], window[rows], float(sight.noise[0]), min_snr, None, sight.large, still, count
        )
    image = sight.image[rows]
    other = blocks_of(image, NEIGHBOUR[sight.channel])
    own = extract(image, sight.channel)
    return find_candidates(own, window[rows], float(sight.noise[0]), min_snr, other, sight.large, still, count)


def _with_blocks(found: Candidates, blocks: Index, more: Candidates) -> Candidates:
    """Candidates, those of some `blocks` replaced by more."""
    width = max(first.shape[1] for first in (found.snr, more.snr))
    column, snr = (np.zeros((len(found.snr), width), np.float32) for _ in range(2))
    for whole, first, others in zip((column, snr), found, more, strict=True):
        whole[:, : first.shape[1]] = first
        whole[blocks] = 0.0
        whole[blocks, : others.shape[1]] = others
    return Candidates(column, snr)


def _scored(
    sight: Sight, found: Candidates, shares: F32, window: F64, min_snr: float, still: Mask | None = None
) -> tuple[Candidates, F32]:
    """Candidates and their worth (B, n): their signal to noise, less where the colour is in doubt.

    Where all that were listed of a block are of another colour, as the gaps of a blind, it is asked for more.
    """
    if sight.image is None:
        return found, found.snr
    noise = float(sight.noise[0])
    score = found.snr * colour_doubt(sight.image, sight.channel, found, noise, shares)
    listed = found.snr >= min_snr
    high = listed & (found.snr > _HIGH * found.snr[:, :1])
    full = (np.count_nonzero(high, axis=1) >= _FULL) & ~(listed & (score > _OTHER * found.snr)).any(axis=1)
    blocks = full.nonzero()[0]
    if blocks.size:
        found = _with_blocks(found, blocks, _all_candidates(sight, blocks, window, min_snr, still, MANY))
        score = found.snr * colour_doubt(sight.image, sight.channel, found, noise, shares)
    return found, score
