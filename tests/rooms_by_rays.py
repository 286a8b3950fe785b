"""Scans of box rooms by exact ray casting, for tests of what is built on a Scan."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from scanmap.geometry import HeadMount
from scanmap.laserline import Reason
from scanmap.scan import Scan
from scanmap.triangulation import Profile

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


def distances(origin: np.ndarray, rays: np.ndarray, room: Box, boxes: Sequence[Box]) -> np.ndarray:
    """Distance along unit `rays` (N, 3) to the walls of the room, seen from inside, or to a box before them."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        walls = [(np.array(corner) - origin) / rays for corner in room]
        t = np.maximum(*walls).min(axis=1)
        for low, high in boxes:
            faces = [(np.array(corner) - origin) / rays for corner in (low, high)]
            near, far = np.minimum(*faces).max(axis=1), np.maximum(*faces).min(axis=1)
            t = np.where((near < far) & (near > 0), np.minimum(t, near), t)
    return t


def scan_room(
    bearings_deg: np.ndarray,
    room: Box,
    boxes: Sequence[Box] = (),
    *,
    rows: int = 300,
    mount: HeadMount | None = None,
    laser_height: float = 1.0,
    half_view_deg: float = 25.0,
    R_room_world: np.ndarray | None = None,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
    lost: Callable[[float, np.ndarray], np.ndarray] | None = None,
    range_max: float = 12.0,
) -> Scan:
    """A scan of a room whose floor is z = 0 and whose scanner stands at (0, 0, laser_height).

    R_room_world leans the scanner; `lost(bearing_deg, rows)` marks rows without a return; range noise has
    sigma `noise * range^2`.
    """
    mount = mount or HeadMount()
    R = np.eye(3) if R_room_world is None else R_room_world
    scan = Scan(mount, rows, {"source": "digital twin"})
    slope = np.tan(np.radians(np.linspace(half_view_deg, -half_view_deg, rows)))
    head = np.stack([np.ones(rows), np.zeros(rows), slope], axis=1)
    head /= np.linalg.norm(head, axis=1)[:, None]
    for bearing in np.atleast_1d(bearings_deg):
        T = mount.T_world_head(np.radians(bearing))
        t = distances(R @ T[:3, 3] + [0.0, 0.0, laser_height], head @ (R @ T[:3, :3]).T, room, boxes)
        if rng is not None:
            t = t + noise * t**2 * rng.standard_normal(rows)
        reason = np.where(t <= range_max, Reason.OK, Reason.BEYOND_RANGE).astype(np.uint8)
        if lost is not None:
            reason[lost(float(bearing), np.arange(rows))] = Reason.WEAK
        t = np.where(reason == Reason.OK, t, np.nan)
        scan.add(
            Profile(head * t[:, None], t, np.maximum(noise, 1e-5) * t**2, t * 0 + 100.0, t * 0, reason),
            np.radians(bearing),
        )
    return scan
