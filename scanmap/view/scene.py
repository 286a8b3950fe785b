"""The head as the viewer draws it: frames, camera, laser fan, colours. Pure geometry in, arrays out."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.geometry import inverse
from scanmap.scan import Scan
from scanmap.scan.surface import normals
from scanmap.view import entities as at
from scanmap.view.entities import ViewParams
from scanmap.view.pictures import shrink_factor

if TYPE_CHECKING:
    import rerun as rr

    from scanmap.grid import OccupancyGrid

Array = NDArray[np.float64]
Colours = NDArray[np.uint8]

# The viewer counts a pixel's centre as 0.5; its pinhole knows no distortion. To be added to a camera matrix.
HALF_PIXEL: Array = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])

LASER_RED = (255, 45, 45, 255)
FAN_RED = (255, 30, 30, 70)

# Where the light of a finished cloud comes from: no wall of a box stands square to it, none turns away.
_LAMP: Array = np.array([0.48, 0.28, 0.83])

# RGB of a cell by its value: free, occupied, and unknown as index -1. The viewer draws no cell transparent.
_MAP_COLOURS = np.array([(96, 104, 118), (250, 250, 250), at.GROUND], np.uint8)


class Fan(NamedTuple):
    """The laser's sheet of light as triangles around its source, head frame."""

    vertices: Array  # (N, 3) the source first [m]
    triangles: NDArray[np.uint32]  # (N - 2, 3)


def laser_fan(calibration: Calibration, reach_m: float, pieces: int = 24) -> Fan:
    """The part of the laser plane that the camera's rows see, up to `reach_m` from the laser.

    The laser itself is taken to stand where the plane is nearest to the head's origin.
    """
    normal, d = calibration.laser_plane[:3], calibration.laser_plane[3]
    source = -d * normal
    own = calibration.intrinsics
    middle = np.full(3, 0.5 * (own.width - 1))
    rays = (
        own.rays(middle, np.array([0.0, own.height - 1.0, 0.5 * (own.height - 1)]))
        @ calibration.T_head_camera[:3, :3].T
    )
    in_plane = rays - (rays @ normal)[:, None] * normal
    in_plane /= np.linalg.norm(in_plane, axis=1, keepdims=True)
    first, last, forward = in_plane
    across = np.cross(normal, forward)
    ends = [float(np.arctan2(v @ across, v @ forward)) for v in (first, last)]
    angles = np.linspace(ends[0], ends[1], pieces + 1)
    rim = source + reach_m * (np.cos(angles)[:, None] * forward + np.sin(angles)[:, None] * across)
    k = np.arange(1, pieces + 1, dtype=np.uint32)
    return Fan(np.vstack([source, rim]), np.stack([np.zeros_like(k), k, k + 1], axis=1))


def log_scene(recording: rr.RecordingStream, calibration: Calibration, params: ViewParams) -> None:
    """Log what does not move in its frame: axes of the world, body of the head, camera, laser fan."""
    import rerun as rr

    size = calibration.baseline_m or 0.1
    recording.log(at.WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    T = calibration.T_head_camera
    recording.log(at.CAMERA, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=True)
    own = calibration.intrinsics
    factor = shrink_factor(own.width, params.image_width_px)
    K = own.matrix + HALF_PIXEL
    K[:2] /= factor
    recording.log(
        at.IMAGE,
        rr.Pinhole(
            image_from_camera=K,
            resolution=[own.width // factor, own.height // factor],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=float(np.clip(5.0 * size, 0.05, 0.6)),
            color=(130, 170, 220, 255),
        ),
        static=True,
    )
    fan = laser_fan(calibration, float(np.clip(15.0 * size, 0.1, 2.0)))
    mesh = rr.Mesh3D(vertex_positions=fan.vertices, triangle_indices=fan.triangles, albedo_factor=FAN_RED)
    recording.log(at.LASER, mesh, static=True)
    recording.log(f"{at.LASER}/rim", rr.LineStrips3D([fan.vertices[1:]], colors=LASER_RED, radii=-1.0), static=True)
    recording.log(at.BODY, _body(fan.vertices[0], T[:3, 3], size), static=True)


def _body(laser: Array, camera: Array, size: float) -> rr.Boxes3D:
    """A bar with the laser at one end and the camera at the other."""
    import rerun as rr

    half = 0.12 * size
    bar = np.abs(camera - laser) / 2.0 + 0.5 * half
    return rr.Boxes3D(
        centers=[(laser + camera) / 2.0, laser, camera],
        half_sizes=[bar, (1.6 * half, half, half), (1.2 * half, 1.4 * half, 1.4 * half)],
        colors=[(70, 74, 84), (190, 40, 40), (60, 110, 170)],
        fill_mode=rr.components.FillMode.Solid,
    )


def height_colours(z: NDArray[np.floating], low: float, high: float) -> Colours:
    """(N, 3) RGB of heights `z` (N,) between `low` and `high` [m], blue to red."""
    part = np.clip((z - low) / max(high - low, 1e-6), 0.0, 1.0)
    colours: Colours = _RAINBOW[(255.0 * part).astype(np.uint8)]
    return colours


def scan_colours(scan: Scan, limit: int) -> tuple[NDArray[np.float32], Colours]:
    """Points (N, 3) of a scan in the world frame [m] and their RGB (N, 3), thinned out to about `limit`.

    Colours say height; a lamp beside the head shades them, so that surfaces show their shape.
    """
    valid = np.flatnonzero(scan.valid)
    valid = valid[:: max(1, -(-len(valid) // limit))]
    points = scan.points.reshape(-1, 3)[valid]
    if not len(points):
        return points, np.empty((0, 3), np.uint8)
    low, high = np.percentile(points[:, 2], [2.0, 98.0])
    colours = height_colours(points[:, 2], float(low), float(high))
    facing = normals(scan).reshape(-1, 3)[valid] @ _LAMP
    light = np.where(np.isfinite(facing), 0.82 + 0.28 * facing, 0.9)
    return points, (colours * light[:, None].clip(0.5, 1.0)).astype(np.uint8)


def log_grid(recording: rr.RecordingStream, path: str, grid: OccupancyGrid, *, static: bool = False) -> None:
    """Log an occupancy grid as a map lying on the floor."""
    import rerun as rr

    cells = np.flipud(_MAP_COLOURS[np.sign(grid.to_ros())])  # the viewer wants the largest y on top
    height, width = cells.shape[:2]
    # Cells count in the level frame, whose z is the height above the floor.
    T = inverse(grid.floor.T_level_world) if grid.floor is not None else np.eye(4)
    recording.log(path.rpartition("/")[0], rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=static)
    recording.log(
        path,
        rr.GridMap(
            data=np.ascontiguousarray(cells).tobytes(),
            format=rr.components.ImageFormat(width=width, height=height, color_model="RGB", channel_datatype="U8"),
            cell_size=grid.resolution_m,
            translation=[*grid.origin, 0.0],
        ),
        static=static,
    )
    # Seen from above, the head itself would not stand where it stands on the floor.
    recording.log(f"{path}/scanner", rr.Points3D([[0.0, 0.0, 0.0]], colors=LASER_RED, radii=-5.0), static=True)


def _rainbow() -> Colours:
    # Without the darkest ends of the map, which vanish on a dark ground.
    steps = np.linspace(22, 236, 256).astype(np.uint8)[:, None]
    bgr = np.asarray(cv2.applyColorMap(steps, cv2.COLORMAP_TURBO), np.uint8)
    return np.ascontiguousarray(bgr[:, 0, ::-1])


_RAINBOW = _rainbow()
