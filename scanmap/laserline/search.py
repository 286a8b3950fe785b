"""Where the line runs: one column per block of rows, by a quick look where that settles it, else with all rivals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.candidates import (
    BLOCK,
    COUNT,
    Candidates,
    block_window,
    find_candidates,
    is_large,
    unit_of,
)
from scanmap.laserline.colour import blocks_of, colour_doubt
from scanmap.laserline.grey import NEIGHBOUR, extract
from scanmap.laserline.leads import STEEP_PX, find_leads, settled, shares_of
from scanmap.laserline.path import choose_path, stand_out
from scanmap.laserline.sight import Sight, quick_rows

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_GOES_ON = 0.5  # least height of a line between two places, over the lesser of theirs


class Course(NamedTuple):
    """Where the line runs through B blocks of rows, arrays (B,)."""

    column: F32  # [px] NaN where there is none
    pure: Mask  # of the laser's colour beyond doubt
    places: F32  # (ceil(B / 2), n) [px] all that looks like a line in every other block, NaN where nothing more does


def search(sight: Sight, window: F64, min_snr: float, still: Mask | None = None) -> Course:
    """The line's column in each block of rows.

    Args:
        window: (H, 2) first and last column of each row, NaN where a row can have no line.
        min_snr: least signal to noise of a place that can be the line.
        still: (B, W) where things of the room are known to be; nothing there is taken for the line.
    """
    if still is not None or not is_large(sight.lit):
        large = is_large(sight.lit)
        other = None if sight.image is None else blocks_of(sight.image, NEIGHBOUR[sight.channel])
        found = find_candidates(sight.lit, window, sight.noise, min_snr, other, large, still)
        path = choose_path(found, _scores(sight, found, np.full(len(found.snr), np.nan, np.float32)), min_snr)
        return Course(path, np.zeros(len(path), bool), _places(found, min_snr))
    found, shares, beside = _settled(sight, window, min_snr)
    good = found.snr[:, 0] > 0
    rest = (~good).nonzero()[0]
    if not rest.size:
        return Course(choose_path(found, found.snr, min_snr), good, np.hstack([_places(found, min_snr), beside]))
    found = _with_blocks(found, rest, _all_candidates(sight, rest, window, min_snr))
    path = choose_path(found, _scores(sight, found, shares), min_snr)
    return Course(path, good, np.hstack([_places(found, min_snr), beside]))


def _places(found: Candidates, min_snr: float) -> F32:
    """The candidates' columns in every other block, NaN where they are none."""
    return np.where(found.snr[::2] >= min_snr, found.column[::2], np.float32(np.nan))


def _settled(sight: Sight, window: F64, min_snr: float) -> tuple[Candidates, F32, F32]:
    """The only candidate (B, 1) of each block that a quick look settles, and its share in other channels (B,).

    And the column (ceil(B / 2), 1) of what comes next to it in every other block, NaN where nothing does.

    A row of every other block is looked at; in the blocks between, the line must go on as high.
    """
    limits = block_window(window)
    leads = find_leads(sight.rows, (limits[0][::2], limits[1][::2]))
    good = settled(leads, sight.noise, min_snr)
    known = np.zeros(len(good), np.float32)
    if sight.image is not None:
        known = shares_of(quick_rows(sight.image), leads, sight.channel, good)
        good = ~np.isnan(known)
    column, height, shares = (np.zeros(len(limits[0]), np.float32) for _ in range(3))
    column[::2], height[::2], shares[::2] = leads.column, np.where(good, leads.height, np.float32(0.0)), known
    between = len(column[1::2])
    after = np.minimum(np.arange(1, between + 1), len(good) - 1)
    near = np.abs(leads.column[:between] - leads.column[after]) < STEEP_PX
    both = (good[:between] & good[after] & near).nonzero()[0]
    middle = 0.5 * (leads.column[both] + leads.column[after[both]])
    at, response = stand_out(sight.lit, np.minimum((2 * both + 1) * BLOCK + 1, len(sight.lit) - 1), middle, sight.noise)
    least = np.minimum(leads.height[both], leads.height[after[both]])
    odd = 2 * both + 1
    column[odd], shares[odd] = at, 0.5 * (known[both] + known[after[both]])
    height[odd] = np.where(response > _GOES_ON * least, response, np.float32(0.0))
    shares[height == 0] = np.nan
    unit = np.float32(unit_of(sight.noise, True))
    beside = np.where(leads.rival >= min_snr * unit, leads.beside, np.float32(np.nan))
    return Candidates(column[:, None], (height / unit)[:, None]), shares, beside[:, None]


def _all_candidates(sight: Sight, blocks: Index, window: F64, min_snr: float) -> Candidates:
    """All candidates of some blocks of a large picture."""
    rows = np.minimum((blocks[:, None] * BLOCK + np.arange(BLOCK)).ravel(), len(sight.lit) - 1)
    if sight.image is None:
        return find_candidates(sight.lit[rows], window[rows], sight.noise, min_snr, large=True)
    image = sight.image[rows]
    other = blocks_of(image, NEIGHBOUR[sight.channel])
    return find_candidates(extract(image, sight.channel), window[rows], sight.noise, min_snr, other, large=True)


def _with_blocks(found: Candidates, blocks: Index, more: Candidates) -> Candidates:
    """Candidates of one place per block, those of some `blocks` replaced by all their places."""
    column, snr = (np.zeros((len(found.snr), COUNT), np.float32) for _ in range(2))
    for whole, first, others in zip((column, snr), found, more, strict=True):
        whole[:, :1] = first
        whole[blocks, : others.shape[1]] = others
    return Candidates(column, snr)


def _scores(sight: Sight, found: Candidates, shares: F32) -> F32:
    """The candidates' worth (B, n): their signal to noise, less where the colour is in doubt."""
    if sight.image is None:
        return found.snr
    return found.snr * colour_doubt(sight.image, sight.channel, found, sight.noise, shares)
