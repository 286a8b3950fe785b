"""Where the line runs: one column per block of rows, by a quick look where that settles it, else with all rivals."""

from __future__ import annotations

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
from scanmap.laserline.leads import find_leads, of_one_colour, settled
from scanmap.laserline.path import choose_path
from scanmap.laserline.sight import Sight, second_rows

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Index = NDArray[np.intp]


def search(sight: Sight, window: F64, min_snr: float) -> F32:
    """The line's column (B,) in each block of rows, NaN where there is none.

    Args:
        window: (H, 2) first and last column of each row, NaN where a row can have no line.
        min_snr: least signal to noise of a place that can be the line.
    """
    if not is_large(sight.lit):
        other = None if sight.image is None else blocks_of(sight.image, NEIGHBOUR[sight.channel])
        found = find_candidates(sight.lit, window, sight.noise, min_snr, other)
        return choose_path(found, _scores(sight, found), min_snr)
    leads = find_leads(sight.rows, block_window(window))
    good = settled(leads, sight.noise, min_snr)
    if sight.image is not None:
        good = of_one_colour(second_rows(sight.image), leads, sight.channel, good)
    found = Candidates(leads.column[:, None], np.where(good, leads.height / unit_of(sight.noise, True), 0.0)[:, None])
    rest = np.flatnonzero(~good)
    if not rest.size:
        return choose_path(found, found.snr, min_snr)
    found = _with_blocks(found, rest, _all_candidates(sight, rest, window, min_snr))
    return choose_path(found, _scores(sight, found), min_snr)


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


def _scores(sight: Sight, found: Candidates) -> F32:
    if sight.image is None:
        return found.snr
    return found.snr * colour_doubt(sight.image, sight.channel, found, sight.noise)
