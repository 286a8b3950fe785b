"""Scans of rooms made of boxes, by ray-plane intersection: truth that shares no code with what is tested."""

import numpy as np

from scanmap.geometry import HeadMount
from scanmap.laserline import Reason
from scanmap.scan import Scan
from scanmap.triangulation import Profile

BASELINE, BETA, ALPHA = 0.08, np.radians(25.7), np.radians(32.3)
ROOM = ((-2.0, -1.5, -0.5), (2.5, 1.8, 1.9))  # corners of the room [m], the head stands at the origin


def box_scan(
    bearings_deg,
    rows=300,
    room=ROOM,
    boxes=(),
    sigma_px=0.0,
    seed=0,
    mount=HeadMount(),  # noqa: B008
    range_max=8.0,
):
    """Scan of a room and of axis-aligned boxes in it, with the thesis's head and column noise `sigma_px`.

    A row of the camera meets the laser plane y = 0 in a line x = d, z = -k (d cos beta + b sin beta); where that line
    leaves the room or enters a box is the point, and d gives the column.
    """
    rng = np.random.default_rng(seed)
    width = rows * 4 / 3
    focal = width / (2 * np.tan(ALPHA))
    k = (np.arange(rows) - (rows - 1) / 2) / focal

    def at(depth):
        return np.stack([depth, 0 * depth, -k * (depth * np.cos(BETA) + BASELINE * np.sin(BETA))], axis=-1)

    def column(depth):
        return (width - 1) / 2 + focal * np.tan(np.arctan2(BASELINE, depth) - BETA)

    def depth_of(u):
        return BASELINE / np.tan(BETA + np.arctan((u - (width - 1) / 2) / focal))

    scan = Scan(mount, rows, {"source": "analytic"})
    for bearing in np.radians(bearings_deg):
        T = mount.T_world_head(bearing)
        start, end = (at(np.full(rows, d)) @ T[:3, :3].T + T[:3, 3] for d in (0.0, 1.0))
        depth = _box(start, end - start, room)[1]
        for box in boxes:
            enter, leave = _box(start, end - start, box)
            hit = (enter < leave) & (enter > 0)
            depth = np.where(hit, np.minimum(depth, enter), depth)
        u = column(depth) + sigma_px * rng.standard_normal(rows)
        depth = depth_of(u)
        points = at(depth)
        slope = np.linalg.norm(at(depth_of(u + 0.5)) - at(depth_of(u - 0.5)), axis=-1)
        range_m = np.linalg.norm(points, axis=-1)
        far = ~((range_m <= range_max) & (depth > 0))
        values = [points, range_m, slope * max(sigma_px, 1e-3), np.full(rows, 120.0), u]
        for value in values:
            value[far] = np.nan
        scan.add(Profile(*values, np.where(far, Reason.BEYOND_RANGE, Reason.OK).astype(np.uint8)), bearing)
    return scan


def _box(start, direction, box):
    """Where rays enter and leave an axis-aligned box, as multiples of `direction` (slab method)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (np.array(box)[:, None, :] - start) / direction
    return np.nanmax(t.min(axis=0), axis=-1), np.nanmin(t.max(axis=0), axis=-1)
