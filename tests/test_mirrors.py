"""Mirrors in scans of box rooms by exact ray casting: images go, rooms behind doors and windows stay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from rooms_by_rays import Box, distances

from scanmap.config import load
from scanmap.geometry import HeadMount
from scanmap.laserline import Reason
from scanmap.scan import Scan, ScanParams
from scanmap.scan.leaning_mirrors import judged
from scanmap.scan.mirrors import find_mirrors, without_mirrors
from scanmap.scan.panorama import Panorama
from scanmap.session.job import finished_scan
from scanmap.triangulation import Profile

EAST = 2.5  # [m] the wall with the mirror, the door or the window
ROOM: Box = ((-2.2, -1.4, -1.0), (EAST, 2.4, 1.6))
FURNITURE: tuple[Box, ...] = (
    ((-2.2, 0.6, -1.0), (-1.7, 1.7, 0.8)),
    ((0.2, 1.9, -1.0), (1.3, 2.4, -0.2)),
    ((0.5, 1.9, 0.3), (1.4, 2.4, 0.34)),
    ((-1.2, 1.3, -1.0), (-0.7, 1.7, -0.5)),
    ((1.2, -1.2, -1.0), (1.9, -0.6, 0.1)),
)
Pane = tuple[tuple[float, float], tuple[float, float]]  # y and z of two corners [m]


class Swept(NamedTuple):
    """A scan, and which of its cells (B, H) show an image."""

    scan: Scan
    image: NDArray[np.bool_]


def swept(
    room: Box = ROOM,
    boxes: Sequence[Box] = FURNITURE,
    mirrors: Sequence[tuple[Pane, float]] = (),
    *,
    step_deg: float = 2.0,
    turn_deg: float = 180.0,
    rows: int = 240,
    seed: int = 1,
    lean_deg: float = 0.0,
) -> Swept:
    """Sweep of a room with mirrors before its east wall: each a pane, and how far its top is before the wall [m]."""
    rng, mount, image = np.random.default_rng(seed), HeadMount(), list[NDArray[np.bool_]]()
    scan = Scan(mount, rows)
    slope = np.tan(np.radians(np.linspace(25.0, -25.0, rows)))
    head = np.stack([np.ones(rows), np.zeros(rows), slope], axis=1) / np.hypot(1.0, slope)[:, None]
    lean = np.radians(lean_deg)
    normal = np.array([-np.cos(lean), 0.0, np.sin(lean)])
    for bearing in np.radians(np.arange(-60.0, turn_deg - 60.0 + 1e-6, step_deg)):
        T = mount.T_world_head(bearing)
        way = head @ T[:3, :3].T
        reach = distances(np.zeros(3), way, room, boxes)
        seen_in = np.zeros(rows, bool)
        for ((y0, z0), (y1, z1)), before in mirrors:
            depth = way @ normal
            with np.errstate(divide="ignore"):
                to_pane = np.where(depth < 0, normal @ [EAST - before, 0.0, z1] / depth, np.inf)
            at = np.where(np.isfinite(to_pane), to_pane, 0.0)[:, None] * way
            hit = (to_pane < reach) & (at[:, 1] > y0) & (at[:, 1] < y1) & (at[:, 2] > z0) & (at[:, 2] < z1)
            onward = distances(at, way - 2.0 * depth[:, None] * normal, room, boxes)
            reach = np.where(hit, to_pane + onward, reach)
            seen_in |= hit
        sigma = 5e-4 * reach**2  # the thesis head's, at 0.04 px
        reach = reach + sigma * rng.standard_normal(rows)
        reason = np.where(reach < 8.0, Reason.OK, Reason.BEYOND_RANGE).astype(np.uint8)
        reach = np.where(reason == Reason.OK, reach, np.nan)
        scan.add(Profile(head * reach[:, None], reach, sigma, 0 * reach + 99.0, 0 * reach, reason), float(bearing))
        image.append(seen_in & (reason == Reason.OK))
    return Swept(scan, np.array(image))


def walled(opening: Pane, thick: float, depth: float, boxes: Sequence[Box] = FURNITURE) -> tuple[Box, list[Box]]:
    """Another room of the same width and height behind an opening of the east wall: `depth` beyond `thick` [m]."""
    (_, y_low, floor), (_, y_high, ceiling) = ROOM
    (y0, z0), (y1, z1) = opening
    ends = EAST + max(thick, 1e-4)
    wall: list[Box] = [
        ((EAST, y_low, floor), (ends, y0, ceiling)), ((EAST, y1, floor), (ends, y_high, ceiling)),
        ((EAST, y0, z1), (ends, y1, ceiling)), ((EAST, y0, floor), (ends, y1, z0)),
    ]  # fmt: skip
    return (ROOM[0], (ends + depth, y_high, ceiling)), [*boxes, *(box for box in wall if box[0][2] < box[1][2])]


def image_of(boxes: Sequence[Box]) -> list[Box]:
    """The boxes reflected at the east wall."""
    return [((2 * EAST - b[0], a[1], a[2]), (2 * EAST - a[0], b[1], b[2])) for a, b in boxes]


HANGING: Pane = ((0.5, -0.5), (1.2, 0.9))
DOOR: Pane = ((0.0, -1.0), (1.0, 1.05))
WINDOW: Pane = ((0.2, -0.2), (1.4, 1.05))


@pytest.mark.parametrize(
    ("pane", "before", "settings"),
    [
        (HANGING, 0.015, {}),
        (HANGING, 0.005, {"step_deg": 6.0, "rows": 900}),
        (HANGING, 0.03, {"step_deg": 0.5}),
        (((-0.6, -0.9), (1.6, 1.1)), 0.02, {}),  # doors of a wardrobe
        (((-0.9, 0.0), (-0.5, 0.6)), 0.01, {"turn_deg": 358.0}),
        (((0.3, -0.4), (1.5, 0.4)), 0.02, {"turn_deg": 358.0, "seed": 3}),
    ],
)
def test_what_is_seen_in_a_mirror_is_given_up_and_nothing_else(pane: Pane, before: float, settings) -> None:
    scan, image = swept(mirrors=[(pane, before)], **settings)
    assert image.sum() > 100
    clean = without_mirrors(scan)
    gone = scan.valid & ~clean.valid
    assert gone[image].mean() > 0.98
    assert not gone[~image].any()
    assert (clean.reason[gone] == Reason.MIRROR).all()


def test_the_mirror_is_found_where_it_hangs() -> None:
    (mirror,) = find_mirrors(swept(mirrors=[(HANGING, 0.02)], turn_deg=358.0).scan)
    np.testing.assert_allclose(mirror.plane[:3], [-1.0, 0.0, 0.0], atol=0.01)
    assert mirror.plane[3] == pytest.approx(EAST - 0.02, abs=0.021)
    assert mirror.agree > 50
    assert mirror.deny < 0.01 * mirror.agree


LEANING: Pane = ((0.9, -0.95), (1.6, 0.7))


@pytest.mark.parametrize(
    ("lean_deg", "settings"), [(7.5, {}), (10.0, {"turn_deg": 300.0}), (8.0, {"step_deg": 3.0, "rows": 600, "seed": 2})]
)
def test_a_mirror_that_leans_is_told_by_what_is_seen_in_it(lean_deg: float, settings) -> None:
    scan, image = swept(mirrors=[(LEANING, 0.02)], lean_deg=lean_deg, **settings)
    [mirror] = find_mirrors(scan)
    lean = np.radians(lean_deg)
    normal = np.array([-np.cos(lean), 0.0, np.sin(lean)])
    assert mirror.plane[:3] @ normal > np.cos(np.radians(0.5))
    assert mirror.plane @ [EAST - 0.02, 1.2, LEANING[1][1], 1.0] == pytest.approx(0.0, abs=0.03)
    assert mirror.cells[image].mean() > 0.9
    assert not mirror.cells[~image].any()


@pytest.mark.parametrize(("pane", "furnished"), [(((-0.9, 0.0), (-0.5, 0.6)), False), (HANGING, True)])
def test_what_agrees_beyond_one_wall_is_told_apart(pane: Pane, furnished: bool) -> None:
    scan, image = swept(boxes=FURNITURE if furnished else (), mirrors=[(pane, 0.01)], turn_deg=358.0)
    fit = judged(Panorama(scan, ScanParams()), image, np.array([-1.0, 0.0, 0.0, EAST - 0.01]), scan.valid & ~image)
    assert fit.hanging == 0
    assert fit.agree >= 20
    assert fit.beyond > 20 if furnished else fit.beyond < 3


def test_the_room_behind_a_door_beside_a_mirror_stays() -> None:
    room, boxes = walled(((-1.0, -1.0), (0.1, 1.05)), 0.1, 2.0)
    scan, image = swept(room, boxes, [(((0.6, -0.5), (1.4, 0.9)), 0.015)])
    gone = scan.valid & ~without_mirrors(scan).valid
    assert gone[image].mean() > 0.98
    assert not gone[~image].any()
    assert (scan.points[..., 0] > EAST + 0.5)[~image].sum() > 500  # which is much of it


@pytest.mark.parametrize("step_deg", [1.0, 2.0, 6.0])
@pytest.mark.parametrize(
    ("opening", "thick", "depth", "beyond"),
    [
        (DOOR, 0.1, 3.0, []),
        (DOOR, 0.1, 4.7, []),  # as deep as this room
        (DOOR, 0.0, 4.7, image_of(FURNITURE)),  # a twin behind a wall of no thickness: the floor runs on
        (DOOR, 0.0, 2.0, []),
        (WINDOW, 0.1, 4.7, image_of(FURNITURE)),  # a twin behind a window: its reveal shows
        (WINDOW, 0.0, 4.7, []),  # a window of no thickness, a room of the same size: nothing of this one's furniture
        (WINDOW, 0.0, 3.3, []),
        (((-1.39, -1.0), (2.39, 1.59)), 0.0, 4.7, []),  # a wall of glass
        (((-1.0, -1.0), (1.9, 1.3)), 0.1, 6.0, []),  # a corridor
    ],
)
def test_rooms_behind_doors_and_windows_stay(opening: Pane, thick: float, depth: float, beyond, step_deg) -> None:
    room, boxes = walled(opening, thick, depth, [*FURNITURE, *beyond])
    scan = swept(room, boxes, step_deg=step_deg, rows=900 if step_deg > 5 else 240).scan
    assert (scan.points[..., 0] > EAST + 0.5).sum() > 200
    assert find_mirrors(scan) == []


def test_an_empty_box_behind_glass_stays() -> None:
    room, boxes = walled(((-1.39, -1.0), (2.39, 1.59)), 0.0, 4.7, [])
    assert find_mirrors(swept(room, boxes, turn_deg=358.0).scan) == []


@pytest.mark.parametrize("seed", range(6))
def test_rooms_without_a_mirror_lose_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    boxes = []
    for _ in range(int(rng.integers(3, 14))):
        size = rng.uniform([0.2, 0.2, 0.3], [1.2, 0.7, 2.0])
        x, y = rng.uniform(-2.1, 1.6), rng.choice([-1.35, rng.uniform(0.7, 1.8), 2.35 - size[1]])
        boxes.append(((x, y, -1.0), (x + size[0], y + size[1], -1.0 + size[2])))
    scan = swept(boxes=boxes, step_deg=float(rng.choice([1.5, 3.0, 6.0])), turn_deg=float(rng.choice([180, 354]))).scan
    assert find_mirrors(scan) == []


def test_the_setting_keeps_them() -> None:
    scan, image = swept(mirrors=[(HANGING, 0.015)])
    assert (finished_scan(scan, load("twin-room", [])).reason[image] == Reason.MIRROR).mean() > 0.98
    kept = finished_scan(scan, load("twin-room", ["scan.mirrors=false"]))
    assert not (kept.reason == Reason.MIRROR).any()


@pytest.mark.parametrize(("bearings", "rows"), [(0, 9), (1, 9), (2, 9), (5, 1), (5, 2), (40, 40)])
def test_scans_too_small_or_without_points_are_left_alone(bearings: int, rows: int) -> None:
    whole = swept(step_deg=4.0, rows=max(rows, 3)).scan.taken(np.arange(bearings))
    assert without_mirrors(whole) is whole
    empty = Scan.empty(HeadMount(), rows, np.radians(np.arange(bearings, dtype=float)))
    assert without_mirrors(empty) is empty
    one = Scan.empty(HeadMount(), rows, np.radians(np.arange(bearings, dtype=float)))
    if bearings:
        one.points[0, 0], one.reason[0, 0] = (1.0, 0.0, 0.0), Reason.OK
    assert without_mirrors(one) is one
