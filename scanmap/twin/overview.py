"""A picture of the twin's room from outside, looking through the walls that stand in the way."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanmap.twin.scene import Scene

GAMMA = 1.0 / 2.2
CULLED = 6  # surfaces seen from behind that a ray may pass


def overview(
    scene: Scene, *, azimuth_deg: float = 250.0, elevation_deg: float = 48.0, size: tuple[int, int] = (1200, 900)
) -> NDArray[np.uint8]:
    """Picture (H, W, 3) BGR of the room, seen from `azimuth_deg` (world, counter-clockwise from x) and above.

    The brightness is stretched to what is seen; surfaces seen from behind are left out, as in a doll's house.
    """
    low, high = scene.rays.vertices.min(axis=0), scene.rays.vertices.max(axis=0)
    middle, span = 0.5 * (low + high), float(np.linalg.norm(high - low))
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    outward = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    eye = middle + 1.5 * span * outward
    right = np.cross([0.0, 0.0, 1.0], outward)
    right /= np.linalg.norm(right)
    up = np.cross(outward, right)
    width, height = size
    u, v = np.meshgrid((np.arange(width) - 0.5 * width) / width, (0.5 * height - np.arange(height)) / width)
    directions = (0.72 * (u.ravel()[:, None] * right + v.ravel()[:, None] * up) - outward).astype(np.float32)
    starts = np.tile(eye, (len(directions), 1))
    behind = np.arange(len(directions))
    for _ in range(CULLED):
        hits = scene.rays.cast(starts[behind], directions[behind])
        away = np.einsum("ij,ij->i", scene.rays.normals[hits.triangle], directions[behind]) > 0
        away &= hits.triangle >= 0
        behind = behind[away]
        if not len(behind):
            break
        starts[behind] += (hits.distance[away, None] + 1e-3) * directions[behind]
    light = scene.radiance(starts, directions).reshape(height, width, 3)
    shown = np.clip(light / np.percentile(light[light.max(axis=2) > 0], 98.5), 0.0, 1.0) ** GAMMA
    shown[light.max(axis=2) == 0] = 1.0
    return np.ascontiguousarray((255.0 * shown[:, :, ::-1]).astype(np.uint8))
