"""Walls square to each other as knowledge about a head: rooms that are square help, rooms that are not do no harm."""

import numpy as np
import pytest
from room_lines import head, off_by

from scanmap.calibration import Calibration
from scanmap.geometry import HeadMount, rotation_z
from scanmap.solvers.self_calibration import Refined, refine
from scanmap.solvers.sight import Lines
from scanmap.solvers.squareness import Upright, squared

MOUNT = HeadMount((0.02, -0.012, 0.0), (0.0, 0.0))
# Walls as direction of the outward normal [deg] and distance [m]; cupboards as centre, half sizes [m] and turn [deg].
SQUARE = ((0.0, 2.2), (90.0, 1.9), (180.0, 2.4), (-90.0, 0.9))
CUPBOARDS = ((1.9, 0.9, 0.3, 0.4, 0.0), (-0.6, 1.7, 0.5, 0.2, 0.0), (-2.1, 0.6, 0.3, 0.4, 0.0))
SKEW_DEG = (0.0, 0.35, -0.45, 0.3)
SKEWED = tuple((*cupboard[:4], turn) for cupboard, turn in zip(CUPBOARDS, (-0.4, 0.5, 0.3), strict=True))


def room_seen(walls, cupboards, seed: int, shared_px: float, bearings=None) -> Lines:
    """Lines of half a turn in a room with cupboards up to its ceiling, by rays met with planes.

    All rows of a shot are off by the same `shared_px`, beside some noise of their own.
    """
    rng, exact, rows = np.random.default_rng(seed), head(300, MOUNT), 300
    own, beta = exact.intrinsics, exact.beta
    bearings = np.arange(0.0, 181.0, 3.0) if bearings is None else bearings
    k = (np.arange(rows) - own.cy) / own.fy
    column = np.empty((len(bearings), rows))
    planes = [(np.array([np.cos(np.radians(a)), np.sin(np.radians(a)), 0.0]), d) for a, d in walls]
    planes += [(np.array([0.0, 0.0, -1.0]), 0.7), (np.array([0.0, 0.0, 1.0]), 1.1)]
    for i, bearing in enumerate(np.radians(bearings)):
        T = MOUNT.T_world_head(bearing)

        def at(depth, T=T):
            z = -k * (depth * np.cos(beta) + 0.08 * np.sin(beta))
            return np.stack([depth + 0 * k, 0 * k, z], axis=1) @ T[:3, :3].T + T[:3, 3]

        start, way = at(0.0), at(1.0) - at(0.0)
        with np.errstate(divide="ignore"):
            met = np.array([(d - start @ n) / (way @ n) for n, d in planes])
        depth = np.where(met > 0, met, np.inf).min(axis=0)
        for x, y, *half, turn in cupboards:
            R = rotation_z(-np.radians(turn))
            with np.errstate(divide="ignore"):
                faces = np.array([
                    [(sign * half[j] - ((start - [x, y, 0.0]) @ R.T)[:, j]) / (way @ R.T)[:, j] for sign in (-1, 1)]
                    for j in (0, 1)
                ])  # fmt: skip
            enter, leave = faces.min(axis=1).max(axis=0), faces.max(axis=1).min(axis=0)
            depth = np.where((enter < leave) & (enter > 0), np.minimum(depth, enter), depth)
        column[i] = own.cx + own.fx * np.tan(np.arctan2(0.08, depth) - beta)
    column += shared_px * rng.standard_normal((len(bearings), 1)) + 0.002 * rng.standard_normal(column.shape)
    return Lines(column, np.full(column.shape, 0.003), np.radians(bearings))


def missed(refined: Refined, exact: Calibration) -> np.ndarray:
    """Error of the head's offset (2,) [m]."""
    return (np.array(refined.after.mount.offset_m) - exact.mount.offset_m)[:2]


@pytest.mark.slow
def test_a_square_room_tells_the_offset_that_flat_walls_leave_open() -> None:
    exact, flat_only, squared_too = head(300, MOUNT), [], []
    for seed in range(4):
        lines = room_seen(SQUARE, CUPBOARDS, seed, 0.004, np.arange(0.0, 181.0, 1.5))
        refined = refine(lines, off_by(exact, 0.5, (0.008, -0.006)))
        assert refined.square.walls >= 5 and np.degrees(refined.square.scatter) < 0.15
        squared_too.append(missed(refined, exact))
        flat_only.append(missed(refined, exact) - refined.square.change[2:4])
        sigma = [refined.estimate(name).sigma for name in ("offset_x", "offset_y")]
        assert (np.abs(squared_too[-1]) < 3 * np.array(sigma)).all()
    assert np.sqrt(np.mean(np.square(squared_too))) < 0.8 * np.sqrt(np.mean(np.square(flat_only)))


def test_a_room_that_is_not_square_does_no_harm() -> None:
    exact = head(300, MOUNT)
    skew = [(a + by, d) for (a, d), by in zip(SQUARE, SKEW_DEG, strict=True)]
    refined = refine(room_seen(skew, SKEWED, 1, shared_px=0.004), off_by(exact, 0.5, (0.008, -0.006)))
    assert 0.15 < np.degrees(refined.square.scatter) < 0.8
    sigma = [refined.estimate(name).sigma for name in ("offset_x", "offset_y")]
    assert (np.abs(missed(refined, exact)) < 3 * np.array(sigma)).all()


@pytest.mark.parametrize("scatter_deg", [0.0, 0.02, 0.3, 1.0])
def test_stated_sigma_is_the_spread_whatever_the_room(scatter_deg: float) -> None:
    """A head with one unknown that turns walls by 0.02 deg a unit; many rooms of five walls."""
    rng, off = np.random.default_rng(5), []
    slope = np.radians(0.02) * np.array([[1.0], [-1.0], [0.5], [-0.3], [0.0]])
    sigma = np.radians([0.01, 0.02, 0.01, 0.03, 0.01])
    for _ in range(200):
        truth = rng.normal(0.0, 3.0)
        azimuth = rng.uniform(-1.0, 1.0) + 0.5 * np.pi * rng.integers(0, 4, 5) - slope[:, 0] * truth
        azimuth += sigma * rng.standard_normal(5) + np.radians(scatter_deg) * rng.standard_normal(5)
        found = squared(Upright(azimuth, slope, sigma), np.array([[9.0]]))
        off.append((found.change[0] - truth) / np.sqrt(found.covariance[0, 0]))
    assert np.sqrt(np.mean(np.square(off))) < 1.3


def test_walls_of_two_crosses_are_not_taken_for_one() -> None:
    askew = np.radians([0.0, 90.0, 180.0, 7.0, 97.0, 187.0])
    slope, sigma = np.zeros((6, 1)), np.full(6, np.radians(0.01))
    found = squared(Upright(askew, slope, sigma), np.eye(1))
    assert found.walls == 3 and np.degrees(found.scatter) < 0.1
    alone = squared(Upright(askew[[0, 3]], slope[:2], sigma[:2]), np.eye(1))
    assert alone.walls == 0 and alone.change == pytest.approx([0.0])


def test_bearings_seen_twice_are_as_good_as_more_of_them() -> None:
    """Forward and back, each picture with an error of its own: the same pieces, a smaller error left."""
    there = np.arange(0.0, 181.0, 3.0)
    once, twice = (
        refine(room_seen(SQUARE, CUPBOARDS, 1, 0.006, bearings), head(300, MOUNT))
        for bearings in (there, np.append(there, there[::-1]))
    )
    assert len(twice.segments) <= len(once.segments) + 1 and twice.patches.column_px.shape[0] == len(there)
    assert twice.rms_after_px < 0.85 * once.rms_after_px
