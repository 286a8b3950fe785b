"""Walls square to each other: what a room tells of a head beside its walls being flat.

An offset that is a little wrong turns the walls of a room against each other long before it bends them. How square a
room is nobody knows beforehand, so its own walls must say: the scatter of their directions about one cross is estimated
with the head, and where they do not agree better than rooms usually do, nothing is concluded from them. Furniture that
stands askew has a cross of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# How far from square rooms are: median [rad] and factor of one standard deviation, before a wall is seen.
USUAL, USUAL_FACTOR = float(np.radians(0.2)), 3.0
# What may be meant to be square, and directions known so well that they tell [rad].
NEARLY = float(np.radians(1.5))
TELLING = float(np.radians(0.5))
FEWEST = 3
# Nothing is known of how the room lies.
ANY_TURN = float(np.radians(30.0))


class Upright(NamedTuple):
    """Upright pieces under the best head so far: which way W of them face."""

    azimuth: Array  # (W,) of their normals [rad]
    slope: Array  # (W, P) its derivative by the P changes of the head
    sigma: Array  # (W,) its noise under a known head [rad]


class Squared(NamedTuple):
    """What squareness changes."""

    change: Array  # (P,) to be added
    covariance: Array  # (P, P) after
    walls: int  # that make the largest cross; 0 if there is none
    scatter: float  # of their directions about it, as far as they tell [rad]


def squared(upright: Upright, covariance: Array) -> Squared:
    """The head brought to where walls are as square to each other as they seem to be meant.

    Args:
        covariance: (P, P) of the head's changes, from the walls' flatness.
    """
    result = Squared(np.zeros(len(covariance)), covariance, 0, float("nan"))
    for azimuth, slope, sigma in _crosses(upright):
        now = azimuth + slope @ result.change
        change, known, scatter = _one_cross(Upright(now, slope, sigma), result.covariance)
        first = result.walls == 0
        result = Squared(
            result.change + change, known, len(now) if first else result.walls, scatter if first else result.scatter
        )
    return result


def _one_cross(upright: Upright, covariance: Array) -> tuple[Array, Array, float]:
    """Change (P,), covariance (P, P) after it, and scatter [rad], by pieces that may be one cross.

    The scatter is unknown and marginalised: a Kalman update for each of a grid, weighted with how usual it is and how
    likely it makes the directions found (a hierarchical model, Gelman 2006).
    """
    azimuth, slope, sigma = upright
    grid = np.linspace(-3.0, 3.0, 31)
    scatters = USUAL * USUAL_FACTOR**grid
    likely, changes, covariances = np.empty(len(grid)), [], []
    for k, scatter in enumerate(scatters):
        S = slope @ covariance @ slope.T + np.diag(sigma**2 + scatter**2) + ANY_TURN**2
        gain = np.linalg.solve(S, slope @ covariance).T
        changes.append(-gain @ azimuth)
        covariances.append(covariance - gain @ slope @ covariance)
        likely[k] = -0.5 * (grid[k] ** 2 + azimuth @ np.linalg.solve(S, azimuth) + np.linalg.slogdet(S)[1])
    share = np.exp(likely - likely.max())
    share /= share.sum()
    change = share @ np.array(changes)
    apart = np.array(changes) - change
    spread = np.einsum("k,kij->ij", share, np.array(covariances)) + (apart * share[:, None]).T @ apart
    return change, 0.5 * (spread + spread.T), float(np.exp(share @ np.log(scatters)))


def _crosses(upright: Upright) -> Iterator[Upright]:
    """Pieces that nearly make a cross, the best known first; their directions modulo 90 deg, about one of them."""
    left = upright.sigma < TELLING
    while left.any():
        azimuth, slope, sigma = (part[left] for part in upright)
        off = _modulo(azimuth[:, None] - azimuth[None, :])
        best = int(np.argmax((np.abs(off) < NEARLY) @ (1.0 / (sigma**2 + USUAL**2))))
        member = np.abs(off[:, best]) < NEARLY
        if np.count_nonzero(member) >= FEWEST:
            yield Upright(off[member, best], slope[member], sigma[member])
        left[np.flatnonzero(left)[member]] = False


def _modulo(angle: Array) -> Array:
    """Into (-45, 45] deg."""
    quarter = 0.5 * np.pi
    folded: Array = angle - quarter * np.round(angle / quarter)
    return folded
