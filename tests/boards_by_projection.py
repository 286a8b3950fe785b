"""Boards as a known head would see them: corners, lines and pictures by a projection of the tests' own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration, Intrinsics
from scanmap.geometry import HeadMount, inverse, rigid, rotation_x, rotation_y, rotation_z
from scanmap.solvers.board import Board
from scanmap.solvers.board_line import BoardLine
from scanmap.solvers.detection import View

Array = NDArray[np.float64]
K_TRUE = (-0.12, 0.06, 0.0008, -0.0005, -0.01)


@dataclass(frozen=True)
class Head:
    """A head with everything a little off the ideal."""

    width: int = 1600
    height: int = 1200
    f: tuple[float, float] = (1265.0, 1262.0)
    c: tuple[float, float] = (805.0, 593.0)
    k: tuple[float, ...] = K_TRUE
    baseline: float = 0.08
    beta: float = float(np.radians(25.7))
    roll: float = float(np.radians(0.4))  # of the laser plane about x
    offset: tuple[float, float, float] = (0.03, -0.004, 0.0)
    tilt: tuple[float, float] = (0.5, -0.3)  # [deg]

    def truth(self) -> Calibration:
        forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
        T = rigid(rotation_z(-self.beta) @ forward, [0.0, self.baseline, 0.0])
        normal = rotation_x(self.roll) @ np.array([0.0, 1.0, 0.0])
        k = (*self.k, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
        own = Intrinsics(self.width, self.height, *self.f, *self.c, (k[0], k[1], k[2], k[3], k[4]))
        return Calibration(own, T, np.append(normal, 0.0), HeadMount(self.offset, self.tilt))

    def small(self) -> Head:
        return replace(
            self, width=640, height=480, f=(self.f[0] * 0.4, self.f[1] * 0.4),
            c=((self.c[0] + 0.5) * 0.4 - 0.5, (self.c[1] + 0.5) * 0.4 - 0.5),
        )  # fmt: skip


def bent(xy: Array, k: tuple[float, ...]) -> Array:
    """Brown-Conrady, written from the formula: x (1 + k1 r2 + ...) + tangential terms."""
    x, y = xy[..., 0], xy[..., 1]
    r2 = x**2 + y**2
    radial = 1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3
    dx = 2 * k[2] * x * y + k[3] * (r2 + 2 * x**2)
    dy = k[2] * (r2 + 2 * y**2) + 2 * k[3] * x * y
    return np.stack([x * radial + dx, y * radial + dy], axis=-1)


def unbent(xy: Array, k: tuple[float, ...]) -> Array:
    found = xy.copy()
    for _ in range(10):
        found = found + xy - bent(found, k)
    return found


def seen(head: Head, points_cam: Array) -> Array:
    return bent(points_cam[..., :2] / points_cam[..., 2:], head.k) * head.f + head.c


def looks(head: Head, pixels: Array) -> Array:
    xy = unbent((pixels - np.array(head.c)) / np.array(head.f), head.k)
    return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)


def random_pose(head: Head, board: Board, rng: np.random.Generator, *, near: float = 0.4, far: float = 1.0) -> Array:
    """T_camera_board of a board held somewhere into the picture, tilted by up to 40 deg."""
    middle = board.points.mean(axis=0)
    while True:
        tilt = rng.uniform(-np.radians(40), np.radians(40), 2)
        R = rotation_x(tilt[0]) @ rotation_y(tilt[1]) @ rotation_z(rng.uniform(-0.4, 0.4))
        depth = rng.uniform(near, far)
        at = looks(head, rng.uniform([0, 0], [head.width, head.height])) * depth
        T = rigid(R, at - R @ middle)
        pixels = seen(head, board.points @ R.T + T[:3, 3])
        if ((pixels > 8) & (pixels < np.array([head.width, head.height]) - 9)).all():
            return T


def view_of(head: Head, board: Board, T: Array, rng: np.random.Generator, sigma_px: float, **more: float) -> View:
    pixels = seen(head, board.points @ T[:3, :3].T + T[:3, 3])
    pixels = pixels + rng.normal(0, sigma_px, pixels.shape) if sigma_px else pixels
    return View(f"view {rng.integers(1 << 30)}", np.arange(len(pixels)), pixels, 1.5, 0, **more)


def line_of(
    head: Head, board: Board, T: Array, rng: np.random.Generator, sigma_px: float, line_px: float
) -> BoardLine | None:
    """The laser line on the squares of a board: where each row's ray meets both planes; None if it misses them."""
    truth = head.truth()
    plane = truth.T_head_camera.T @ truth.laser_plane
    across = np.cross(plane[:3], T[:3, 2])
    across /= np.linalg.norm(across)
    A = np.stack([plane[:3], T[:3, 2], across])
    on_both = np.linalg.solve(A, [-plane[3], T[:3, 2] @ T[:3, 3], across @ T[:3, 3]])
    along = on_both + np.linspace(-1.5, 1.5, 12001)[:, None] * across
    local = (along - T[:3, 3]) @ T[:3, :3]
    low, high = board.outline()[0, :2], board.outline()[2, :2]
    inside = ((local[:, :2] > low) & (local[:, :2] < high)).all(axis=1) & (along[:, 2] > 0.1)
    if inside.sum() < 2:
        return None
    pixels = seen(head, along[inside])
    pixels = pixels[np.argsort(pixels[:, 1])]
    rows = np.arange(np.ceil(max(0, pixels[0, 1])), np.floor(min(head.height - 1, pixels[-1, 1])) + 1)
    if len(rows) < 60:
        return None
    columns = np.interp(rows, pixels[:, 1], pixels[:, 0]) + rng.normal(0, line_px, len(rows))
    if columns.min() < 0 or columns.max() > head.width - 1:
        return None
    return BoardLine(view_of(head, board, T, rng, sigma_px), columns, rows, np.full(len(rows), max(line_px, 0.01)))


def axis_views(
    head: Head, board: Board, bearings: Array, rng: np.random.Generator, sigma_px: float, *, sign: float = 1.0,
    away: float = 0.5,
) -> list[View]:  # fmt: skip
    """One board standing in the room, seen from every bearing (rad) in which all of it is in the picture."""
    views = []
    for bearing, T in axis_poses(head, board, bearings, sign=sign, away=away):
        views.append(view_of(head, board, T, rng, sigma_px, bearing=bearing))
    return views


def axis_poses(
    head: Head, board: Board, bearings: Array, *, sign: float = 1.0, away: float = 0.5
) -> list[tuple[float, Array]]:
    """Bearing and T_camera_board of one board standing in the room, where all of it is in the picture."""
    truth = head.truth()
    mount = truth.mount
    middle = truth.T_head_camera @ np.append(looks(head, np.array(head.c)) * away, 1.0)
    camera_world = mount.T_world_head(0.0) @ truth.T_head_camera
    R = camera_world[:3, :3] @ rotation_x(0.2) @ rotation_y(-0.3)
    at = (mount.T_world_head(0.0) @ middle)[:3]
    T_world_board = rigid(R, at - R @ board.points.mean(axis=0))
    found = []
    for bearing in bearings:
        T = inverse(truth.T_head_camera) @ inverse(mount.T_world_head(sign * float(bearing))) @ T_world_board
        pixels = seen(head, board.points @ T[:3, :3].T + T[:3, 3])
        if (pixels > 8).all() and (pixels < np.array([head.width, head.height]) - 9).all() and T[2, 3] > 0:
            found.append((float(bearing), T))
    return found


def axis_pictures(
    head: Head, board: Board, bearings: Array, rng: np.random.Generator
) -> list[tuple[float, NDArray[np.uint8]]]:
    """Bearing and picture of one board standing in the room."""
    return [
        (bearing, picture_of(head, board, T, rng, samples=3))
        for bearing, T in axis_poses(head, board, bearings, away=0.7)
    ]


def laser_pose(head: Head, board: Board, rng: np.random.Generator) -> Array:
    """T_camera_board of a board held so that the laser crosses its squares."""
    while True:
        T = random_pose(head, board, rng, near=0.35, far=0.9)
        line = line_of(head, board, T, rng, 0.0, 0.0)
        if line is not None and len(line.rows) > 100:
            return T


def picture_of(
    head: Head,
    board: Board,
    T: Array,
    rng: np.random.Generator,
    *,
    laser: bool = False,
    noise: float = 1.5,
    light: float = 1.0,
    blur_px: float = 0.6,
    samples: int = 4,
) -> NDArray[np.uint8]:
    """(H, W, 3) BGR picture of the board before a dim wall, antialiased by `samples` x `samples` rays a pixel.

    `light` falls off across the picture: 1 for even light.
    """
    import cv2

    step = (np.arange(samples) + 0.5) / samples - 0.5
    total = np.zeros((head.height, head.width))
    texture = board_texture(board)
    rays, per_column, per_row = pixel_rays(head)
    for dv in step:
        for du in step:
            total += texture(_on_board(rays + du * per_column + dv * per_row, T))
    total /= samples**2
    shade = np.linspace(light, 1.0, head.width)[None, :]
    image = 25.0 + 190.0 * total * shade
    bgr = np.repeat(image[..., None], 3, axis=-1)
    if laser:
        bgr[..., 2] += _laser(head, T) * (60.0 + 140.0 * total)
    bgr = cv2.GaussianBlur(bgr, (0, 0), blur_px)
    bgr += rng.normal(0, noise, bgr.shape)
    return np.clip(np.rint(bgr), 0, 255).astype(np.uint8)


def board_texture(board: Board):
    """Function of board coordinates (..., 2) [m]: 1 white, 0 black, 0.2 beyond the sheet."""
    first = board.outline()[0, :2]
    across, down = board.squares
    marks = None
    if board.kind == "charuco":
        marks = board.charuco().generateImage((across * 60, down * 60), marginSize=0).astype(np.float64) / 255.0

    def brightness(at: Array) -> Array:
        square = (at - first) / board.square_m
        cell = np.floor(square).astype(int)
        inside = (cell >= 0).all(axis=-1) & (cell[..., 0] < across) & (cell[..., 1] < down)
        if marks is None:
            colour = (cell.sum(axis=-1) % 2 == 1).astype(np.float64)
        else:
            pixel = np.clip((square * 60).astype(int), 0, [across * 60 - 1, down * 60 - 1])
            colour = marks[pixel[..., 1], pixel[..., 0]]
        sheet = (square > -0.8).all(axis=-1) & (square[..., 0] < across + 0.8) & (square[..., 1] < down + 0.8)
        return np.where(inside, colour, np.where(sheet, 1.0, 0.2))

    return brightness


def _on_board(rays: Array, T: Array) -> Array:
    t = (T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2])
    return ((rays * t[..., None] - T[:3, 3]) @ T[:3, :3])[..., :2]


def _laser(head: Head, T: Array) -> Array:
    """Brightness (H, W) of a line 1.2 px wide on the board's plane."""
    truth = head.truth()
    plane = truth.T_head_camera.T @ truth.laser_plane
    rays, per_column, _ = pixel_rays(head)

    def off(looking: Array) -> Array:
        t = (T[:3, 2] @ T[:3, 3]) / (looking @ T[:3, 2])
        return (looking * t[..., None]) @ plane[:3] + plane[3]

    rate = off(rays + 0.5 * per_column) - off(rays - 0.5 * per_column)
    return np.exp(-0.5 * (off(rays) / rate / 1.2) ** 2)


@cache
def pixel_rays(head: Head) -> tuple[Array, Array, Array]:
    """Rays (H, W, 3) of all pixel centres, and their change by column and by row: straight within a pixel."""
    v, u = np.mgrid[0 : head.height, 0 : head.width].astype(np.float64)
    at = np.stack([u, v], axis=-1)
    near = [looks(head, at + np.array(by)) for by in ((0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))]
    return near[0], near[1] - near[2], near[3] - near[4]
