"""Sweep rooms with mirrors, and rooms with doors and windows, along every path of the light; then without the images.

Run: python benchmarks/mirrors.py [--step DEG] [--turn DEG] [--rooms N] [--plot DIR]

No pictures are rendered: rays of the laser's fan are traced to the room, straight and by each mirror, and from there
to the camera, straight and by the mirror; in every image row the brightest line wins, and what reflects less than any
surface is left out, as the second look does. All lines in the window are listed, as pictures list them. Printed are the
shares of points more than 10 cm off any surface by the path they came on, what is left of them, and what was lost of
true points. --plot draws every room from above: grey what stays, red what was given up.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration, CalibrationFile, HeadTable, ImageTable
from scanmap.geometry import inverse, transform
from scanmap.laserline import LaserLine, Reason
from scanmap.raycast import RayScene
from scanmap.scan import Scan
from scanmap.scan.mirrors import without_mirrors
from scanmap.scan.second_lines import Pictures
from scanmap.triangulation import TriangulationParams, column_window, triangulate
from scanmap.twin.mesh import Mesh, box, cylinder, merged, quad, wall_with_hole
from scanmap.twin.room import Room, Thing, assembled, placed
from scanmap.twin.texture import Material

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

PATHS = ("straight", "camera by mirror", "laser by mirror", "both by mirror")
REFLECTANCE, ALBEDO = 0.88, 0.7
FAN_RAYS, FAN = 6000, np.tan(np.radians(40.0))
PEAK, FAINT = 0.9 * 2.0**2 / ALBEDO, 0.025  # light of a wall at 2 m, and the least that is found [of saturation]
COLUMN_PX = 0.04  # noise of a column at half of saturation
DIM, DIVERGENCE_PX, NEAR_PX = 0.0025, 1.6, 0.6  # of the second look; width of the line far away, and what nearness adds
HEIGHT_M = 2.6
MOST = 6  # lines of one path in one row


class Pane(NamedTuple):
    """A mirror: a corner and two sides."""

    corner: F64
    a: F64
    b: F64

    @property
    def normal(self) -> F64:
        n = np.cross(self.a, self.b)
        return np.asarray(n / np.linalg.norm(n))

    def reflected(self, points: F64) -> F64:
        return points - 2.0 * ((points - self.corner) @ self.normal)[..., None] * self.normal

    def holds(self, points: F64) -> Mask:
        """Whether points (N, 3) of its plane lie on it."""
        s, t = ((points - self.corner) @ side / (side @ side) for side in (self.a, self.b))
        return (s > 0) & (s < 1) & (t > 0) & (t < 1)


class Drawn(NamedTuple):
    """A room, its rays and its mirrors in the scanner's frame."""

    room: Room
    rays: RayScene
    panes: list[Pane]
    words: str


def drawn(seed: int, *, mirrors: bool) -> Drawn:
    """A furnished room drawn at random, with mirrors on its walls or with a door or window to another room."""
    rng = np.random.default_rng(seed)
    length, width = rng.uniform(3.2, 6.5), rng.uniform(2.8, 5.0)
    at = np.array([rng.uniform(0.25, 0.75) * length, rng.uniform(0.2, 0.5) * width, rng.uniform(0.6, 1.3)])
    parts = _shell(0.0, length, width)[:-1] + _furniture(rng, 0.0, length, width, at)
    panes, words = list[Pane](), "none"
    if mirrors:
        for _ in range(int(rng.integers(1, 3))):
            wide, low = rng.uniform(0.4, 1.6), rng.uniform(0.03, 0.9)
            side, proud = rng.choice(["north", "east", "west"]), rng.uniform(0.005, 0.04)
            start = rng.uniform(0.05, (length if side == "north" else width) - wide - 0.05)
            high = min(low + rng.uniform(0.6, 1.9), 2.5)
            corner, along = {
                "north": ([start, width - proud, low], [wide, 0, 0]),
                "east": ([length - proud, start, low], [0, wide, 0]),
                "west": ([proud, start, low], [0, wide, 0]),
            }[side]
            panes.append(Pane(np.array(corner), np.array(along, float), np.array([0, 0, high - low])))
        words = ", ".join(f"{np.linalg.norm(pane.a):.1f} x {pane.b[2]:.1f} m" for pane in panes)
        parts.append(quad([length, 0, 0], [0, width, 0], [0, 0, HEIGHT_M]))
    else:
        thick, sill = rng.choice([0.0, 0.1, 0.2]), rng.choice([0.0, 0.0, 0.8])
        y = rng.uniform(0.2, width - 1.4)
        hole = (y, y + rng.uniform(0.7, 1.2), sill, 2.05)
        depth = rng.choice([length, rng.uniform(1.2, 6.0)])  # half of them as deep as this room
        parts.append(wall_with_hole([length, 0, 0], [0, width, 0], [0, 0, HEIGHT_M], hole))
        parts += _reveal(hole, length, thick) if thick else []
        parts += _shell(length + thick, depth, width) + _furniture(rng, length + thick, depth, width, at)
        words = f"{'window' if sill else 'door'}, wall {thick:.1f} m, {depth:.1f} m behind it, {length:.1f} m here"
    things = [(Thing("room", Material((ALBEDO,) * 3)), merged(parts))]
    things += [
        (Thing("mirror", Material((0.01,) * 3, gloss=REFLECTANCE), measurable=False), quad(p.corner, p.a, p.b))
        for p in panes
    ]
    lamp = (0.5 * length, 0.5 * width, HEIGHT_M - 0.05)
    room = placed(assembled("drawn", things, [lamp]), (at[0], at[1]), float(at[2]), 0.0)
    rays = RayScene(room.vertices, room.triangles)
    return Drawn(room, rays, [p._replace(corner=p.corner - at) for p in panes], words)


def _shell(x: float, length: float, width: float) -> list[Mesh]:
    return [
        quad([x, 0, 0], [length, 0, 0], [0, width, 0]), quad([x, 0, HEIGHT_M], [0, width, 0], [length, 0, 0]),
        quad([x, 0, 0], [0, 0, HEIGHT_M], [length, 0, 0]), quad([x, width, 0], [length, 0, 0], [0, 0, HEIGHT_M]),
        *([] if x else [quad([x, 0, 0], [0, width, 0], [0, 0, HEIGHT_M])]),
        quad([x + length, 0, 0], [0, width, 0], [0, 0, HEIGHT_M]),
    ]  # fmt: skip


def _reveal(hole: tuple[float, float, float, float], x: float, thick: float) -> list[Mesh]:
    y0, y1, z0, z1 = hole
    through, up, along = [thick, 0, 0], [0, 0, z1 - z0], [0, y1 - y0, 0]
    return [
        quad([x, y0, z0], through, up), quad([x, y1, z0], up, through), quad([x, y0, z1], through, along),
        quad([x, y0, z0], along, through),
    ]  # fmt: skip


def _furniture(rng: np.random.Generator, x: float, length: float, width: float, at: F64) -> list[Mesh]:
    parts = [cylinder([x + 0.25 * length, 0.7 * width, 0], 0.12, HEIGHT_M - 1e-3)]
    for _ in range(int(rng.integers(2, 13))):
        size = rng.uniform([0.2, 0.2, 0.3], [1.2, 0.7, 1.9])
        place = np.array([rng.uniform(x + 0.3, x + length - 0.3), rng.choice([0.25, rng.uniform(0.2, width), width])])
        if np.hypot(*(place - at[:2])) > 1.0:
            place[1] = np.clip(place[1], 0.4, width - 0.4)
            parts.append(box([*place, size[2] / 2], size, float(rng.choice([0, 0, rng.uniform(-40, 40)]))))
    return parts


def sweep(
    room: Drawn, head: Calibration, bearings: F64, rng: np.random.Generator
) -> tuple[Scan, NDArray[np.int8], Pictures]:
    """A scan of the room, the path (B, H) that each point came on, -1 without one, and all lines in its pictures."""
    limits = TriangulationParams()
    window, height = column_window(head, limits), head.intrinsics.height
    scan, paths = Scan(head.mount, height), list[NDArray[np.int8]]()
    places = np.full((len(bearings), height // 8, 4 * MOST), np.inf, np.float32)
    tangent = np.linspace(-FAN, FAN, FAN_RAYS)
    fan = np.stack([np.ones(FAN_RAYS), np.zeros(FAN_RAYS), tangent], axis=1) / np.hypot(1.0, tangent)[:, None]
    for view, bearing in enumerate(bearings):
        T = head.mount.T_world_head(float(bearing))
        column, light, path = np.full(height, np.nan), np.zeros(height), np.full(height, -1, np.int8)
        for number, image, bright in _lines(room, T[:3, 3], transform(T, head.T_head_camera[:3, 3]), fan @ T[:3, :3].T):
            pixel = head.intrinsics.project(transform(inverse(T @ head.T_head_camera), image))
            pixel = np.where(np.isfinite(pixel), pixel, -9.0)
            row = np.clip(np.rint(pixel[:, 1]).astype(np.intp), 0, height - 1)
            inside = (
                (np.abs(pixel[:, 1] - row) <= 0.5) & (pixel[:, 0] > window[row, 0]) & (pixel[:, 0] < window[row, 1])
            )
            for k in np.flatnonzero(inside & (bright > FAINT)):
                if row[k] % 8 == 2:
                    listed = places[view, row[k] // 8, MOST * number : MOST * (number + 1)]
                    listed[np.isinf(listed).argmax()] = pixel[k, 0]
                if bright[k] > light[row[k]]:
                    column[row[k]], light[row[k]], path[row[k]] = pixel[k, 0], bright[k], number
        sigma = COLUMN_PX * np.clip(0.5 / np.maximum(light, 1e-9), 0.7, 6.0)
        column += sigma * rng.standard_normal(height)
        reason = np.where(np.isnan(column), Reason.WEAK, Reason.OK).astype(np.uint8)
        line = LaserLine(column, 255.0 * np.minimum(light, 1.0), np.full(height, 2.0), sigma, reason)
        profile = triangulate(line, head, limits)
        scan.add(profile, float(bearing))
        paths.append(np.where(profile.reason == Reason.OK, path, -1).astype(np.int8))
    with np.errstate(invalid="ignore"):
        reflected = scan.intensity * scan.range_m**2 * (DIVERGENCE_PX + NEAR_PX / scan.range_m)
        scan.give_up((scan.intensity < 200.0) & (reflected < DIM * np.nanmedian(reflected)), Reason.AMBIGUOUS)
    middles = 8.0 * np.arange(height // 8) + 1.5
    T, project = head.mount.T_axis_head(), head.intrinsics.project
    plane = head.laser_plane @ inverse(T)
    pictures = Pictures(bearings, places, middles, window, T @ head.T_head_camera, plane, project)
    return scan, np.where(scan.valid, np.array(paths), -1).astype(np.int8), pictures


def _lines(room: Drawn, laser: F64, camera: F64, fan: F64) -> list[tuple[int, F64, F64]]:
    """Path, where the camera sees the laser's light (N, 3), and how bright (N,), for every path."""
    hits = room.rays.cast(laser, fan, exact=True)
    met = np.flatnonzero(hits.triangle >= 0)
    points, normal = laser + hits.distance[met, None] * fan[met], room.rays.normals[hits.triangle[met]]
    mirrored = np.zeros(len(met), bool)
    found = []
    for pane in room.panes:
        mirrored |= (np.abs((points - pane.corner) @ pane.normal) < 2e-3) & pane.holds(points)
    lit = [(False, points[~mirrored], normal[~mirrored], laser, hits.distance[met][~mirrored])]
    for pane in room.panes:
        on = (np.abs((points - pane.corner) @ pane.normal) < 2e-3) & pane.holds(points)
        if on.any():
            way = pane.reflected(points[on] + fan[met][on]) - points[on]
            again = room.rays.cast(points[on] + 1e-3 * way, way)
            some = np.flatnonzero(again.triangle >= 0)
            reach = again.distance[some].astype(float) + 1e-3
            spot = points[on][some] + reach[:, None] * way[some]
            source = pane.reflected(laser)
            lit.append(
                (True, spot, room.rays.normals[again.triangle[some]], source, hits.distance[met][on][some] + reach)
            )
    for turned, spot, facing, source, reach in lit:
        cosine = np.einsum("ij,ij->i", facing, spot - source) / reach
        bright = PEAK * ALBEDO * np.abs(cosine) / reach**2 * (REFLECTANCE if turned else 1.0)
        for via in (None, *room.panes):
            eye = camera if via is None else via.reflected(camera)
            clear = np.einsum("ij,ij->i", facing, spot - eye) * cosine > 0
            if via is None:
                clear &= ~room.rays.occluded(camera, spot)
            else:
                depth = (spot - eye) @ via.normal
                cross = eye + ((via.corner - eye) @ via.normal / np.where(depth == 0, 1.0, depth))[:, None] * (
                    spot - eye
                )
                side = np.sign((camera - via.corner) @ via.normal) * via.normal
                clear &= via.holds(cross) & ((spot - via.corner) @ side > 1e-3)
                cross = cross + 2e-3 * side
                clear &= ~room.rays.occluded(camera, cross) & ~room.rays.occluded(cross, spot)
            number = 2 * turned + (via is not None)
            image = spot if via is None else via.reflected(spot)
            found.append((number, image[clear], bright[clear] * (REFLECTANCE if via is not None else 1.0)))
    return found


def draw(path: Path, scan: Scan, gone: Mask) -> None:
    """The room from above."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 7))
    axes = figure.add_subplot()
    for mask, colour in ((scan.valid & ~gone, "0.4"), (gone, "tab:red")):
        axes.plot(*scan.points[mask][::3, :2].T, ".", markersize=1.5, color=colour)
    axes.plot(0, 0, "k^")
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    figure.savefig(path, dpi=80)


def main() -> None:
    """Sweep every room, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--step", type=float, default=6.0, help="[deg]")
    parser.add_argument("--turn", type=float, default=180.0, help="[deg]")
    parser.add_argument("--rooms", type=int, default=20, help="of each kind")
    parser.add_argument("--plot", type=Path, help="draw every room into this folder")
    options = parser.parse_args()
    head = CalibrationFile(
        image=ImageTable(width=1600, height=1200), head=HeadTable(baseline_m=0.08, beta_deg=25.7, alpha_deg=32.3)
    ).build()
    bearings = np.radians(np.arange(0.0, min(options.turn, 359.9) + 1e-6, options.step))
    for mirrors in (True, False):
        total, false, left, lost = 0, np.zeros(4, int), np.zeros(4, int), 0
        for seed in range(options.rooms):
            room = drawn(seed, mirrors=mirrors)
            scan, path, pictures = sweep(room, head, bearings, np.random.default_rng(seed))
            gone = scan.valid & ~without_mirrors(scan, None, pictures).valid
            off = np.zeros(scan.valid.shape, bool)
            off[scan.valid] = room.rays.distance(scan.points[scan.valid]) > 0.1
            counts = [np.bincount(path[mask], minlength=4) for mask in (off & (path >= 0), off & ~gone & (path >= 0))]
            total, false, left = total + int(scan.valid.sum()), false + counts[0], left + counts[1]
            lost += int((gone & (path == 0)).sum())
            print(
                f"  {seed}: {room.words}: {counts[0][3]} images, {counts[1][3]} left, {(gone & (path == 0)).sum()} lost"
            )
            if options.plot:
                draw(options.plot / f"{'mirror' if mirrors else 'opening'}-{seed}.png", scan, gone)
        shares = [
            f"{name} {n / total:.5f} (left {m / total:.5f})" for name, n, m in zip(PATHS, false, left, strict=True)
        ]
        kind = "mirrors" if mirrors else "openings"
        print(f"{options.rooms} rooms with {kind}, {total} points, > 10 cm off: {', '.join(shares)}")
        print(f"  true points lost: {lost / total:.5f}")


if __name__ == "__main__":
    main()
