"""The laser's fan in the room, and its line on the sensor by continuous geometry.

Rays of the fan are traced to the surface and tested for sight of the camera. Neighbouring hits on one
surface are joined to pieces of the line; where a piece crosses an image row (or column, where it lies flat)
its profile is laid down there, as wide and as bright as the sheet of light makes it.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from scanmap.calibration import Calibration
from scanmap.geometry import Array, inverse, transform
from scanmap.raycast import Hits
from scanmap.twin.optics import Lens
from scanmap.twin.panes import Pane, panes_of
from scanmap.twin.scene import Scene

RAYS_PER_ROW = 4
COLOURS = {"red": (1.0, 0.06, 0.015), "green": (0.10, 1.0, 0.12)}
GLOSS_EXPONENT = 150.0
# The reference of `white_wall_peak`: a wall of this reflectance, seen and lit straight on at this range.
WALL_ALBEDO, WALL_RANGE_M = 0.8, 2.0


class LaserParams(BaseModel, frozen=True, extra="forbid"):
    """The twin's line laser; `[twin.laser]`."""

    colour: Literal["red", "green"] = Field("red", description="colour of the line")
    white_wall_peak: float = Field(
        0.9, ge=0, le=100, description="line height on a white wall at 2 m [fraction of saturation]; nearer saturates"
    )
    fan_deg: float = Field(80.0, gt=1, lt=175, description="opening angle of the fan [deg]")
    waist_m: float = Field(0.0005, gt=0, le=0.05, description="half thickness of the sheet at the head, sigma [m]")
    divergence_rad: float = Field(0.001, ge=0, le=0.1, description="its growth with range, sigma [rad]")
    speckle: float = Field(0.08, ge=0, le=1, description="speckle contrast of the line in one pixel")

    def thickness(self, range_m: Array) -> Array:
        """Sheet thickness, standard deviation [m], at ranges [m] from the head."""
        return np.hypot(self.waist_m, self.divergence_rad * range_m)


class LitLine(NamedTuple):
    """Hits of the fan, in its order. Arrays of length N; `seen` says which the camera sees."""

    points: Array  # (N, 3) head frame [m]
    pixel: Array  # (N, 2) column, row; NaN outside the picture's neighbourhood
    across: Array  # (N, 2) [px] the sheet's standard deviation as it lies on the surface, seen in the picture
    peak: Array  # (N, 3) RGB light at the middle of the line, before blur [fraction of saturation]
    normal: Array  # (N, 3) of the surface, head frame
    thing: NDArray[np.int64]  # (N,) index of the room's thing
    seen: NDArray[np.bool_]


class _Beam(NamedTuple):
    """Light of the fan on its way. Arrays of length N, in the order of its rays; head frame [m]."""

    points: Array  # (N, 3) what it meets
    direction: Array  # (N, 3) unit, toward there
    way: Array  # (N,) from the laser
    hits: Hits
    normal: Array  # (3,) of the sheet
    share: float  # of the laser's light
    ray: NDArray[np.intp]  # (N,) number of the ray


class LineLight(NamedTuple):
    """The line on the sensor: linear light in the columns `first_column` and after."""

    first_column: int
    light: NDArray[np.float32]  # (H, w, 3) RGB [fraction of saturation]


class LaserFan:
    """The fan of a calibration's laser plane, from the head's origin projected onto that plane."""

    def __init__(self, scene: Scene, calibration: Calibration, params: LaserParams, blur_px: float) -> None:
        own = calibration.intrinsics
        self._scene, self._params, self._mount = scene, params, calibration.mount
        self._width, self._height = own.width, own.height
        self._blur_px = blur_px
        self._lens = Lens(calibration)
        self._camera = calibration.T_head_camera[:3, 3]
        self._normal = calibration.laser_plane[:3]
        self.source = -calibration.laser_plane[3] * self._normal
        optical_axis = calibration.T_head_camera[:3, 2]
        forward = optical_axis - (optical_axis @ self._normal) * self._normal
        forward /= np.linalg.norm(forward)
        self._panes = panes_of(scene)
        # What a pane mirrors is drawn ray by ray.
        self._lobes = scene.gloss[scene.room.thing_of].astype(np.float64)
        for pane in self._panes:
            self._lobes[pane.faces] = 0.0
        reach = np.tan(np.radians(0.5 * params.fan_deg))
        count = int(np.clip(RAYS_PER_ROW * 2.0 * reach * own.fy, 500, 40_000))
        # Even in the tangent: evenly many rays per image row, whatever the depth.
        tangent = np.linspace(-reach, reach, count)
        directions = forward + tangent[:, None] * np.cross(self._normal, forward)
        self._directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        wall = float(params.thickness(np.array(WALL_RANGE_M)))
        spread = own.fx * wall / WALL_RANGE_M
        self._gain = (
            params.white_wall_peak
            / WALL_ALBEDO
            * WALL_RANGE_M
            * wall
            * np.hypot(spread, np.hypot(blur_px, 12**-0.5))
            / spread
        )

    def trace(self, bearing: float) -> LitLine:
        """Where the laser's light falls with the head at `bearing` [rad], and what of it the camera sees."""
        T_world_head = self._mount.T_world_head(bearing)
        return self._lit(T_world_head, self._beam(T_world_head), None)

    def echoes(self, bearing: float) -> list[LitLine]:
        """The line once more by every flat glossy thing: where that throws the fan, and what is seen in it.

        Of each path one reflection before the surface and one after it.
        """
        if not self._panes:
            return []
        T_world_head = self._mount.T_world_head(bearing)
        T_head_world = inverse(T_world_head)
        panes = [pane.moved(T_head_world) for pane in self._panes]
        straight = self._beam(T_world_head)
        found = [self._lit(T_world_head, straight, pane) for pane in panes]
        for pane in panes:
            beam = self._turned(T_world_head, straight, pane)
            found += [self._lit(T_world_head, beam, via) for via in (None, *panes) if len(beam.points)]
        return [line for line in found if line.seen.any()]

    def _beam(self, T_world_head: Array) -> _Beam:
        """The fan as it leaves the laser, up to what it meets first."""
        hits = self._scene.rays.cast(
            transform(T_world_head, self.source), self._directions @ T_world_head[:3, :3].T, exact=True
        )
        met = np.flatnonzero(hits.triangle >= 0)
        hits = Hits(hits.distance[met], hits.triangle[met], hits.uv[met])
        way, direction = hits.distance.astype(np.float64), self._directions[met]
        return _Beam(self.source + way[:, None] * direction, direction, way, hits, self._normal, 1.0, met)

    def _turned(self, T_world_head: Array, beam: _Beam, pane: Pane) -> _Beam:
        """The part of a beam that a pane throws on, up to what it meets then."""
        on = np.flatnonzero(pane.faces[beam.hits.triangle])
        direction, normal = pane.turned(beam.direction[on]), pane.turned(beam.normal)
        start = beam.points[on] + 1e-4 * direction
        hits = self._scene.rays.cast(transform(T_world_head, start), direction @ T_world_head[:3, :3].T, exact=True)
        met = np.flatnonzero(hits.triangle >= 0)
        hits = Hits(hits.distance[met], hits.triangle[met], hits.uv[met])
        onward, direction = hits.distance.astype(np.float64), direction[met]
        points = start[met] + onward[:, None] * direction
        way = beam.way[on][met] + onward
        return _Beam(points, direction, way, hits, normal, beam.share * pane.reflectance, beam.ray[on][met])

    def _lit(self, T_world_head: Array, beam: _Beam, via: Pane | None) -> LitLine:
        """What the camera sees of a beam's light, straight or `via` a mirror."""
        points, hits = beam.points, beam.hits
        world = transform(T_world_head, points)
        normal = self._scene.rays.normals[hits.triangle] @ T_world_head[:3, :3]
        cosine = np.einsum("ij,ij->i", normal, beam.direction)
        eye = self._camera if via is None else via.image(self._camera)

        def pixels(places: Array) -> Array:
            return self._lens.project(places if via is None else via.image(places))

        pixel = pixels(points)
        near = (np.abs(pixel / [self._width, self._height] - 0.5) < 0.55).all(axis=1) & (np.abs(cosine) > 1e-3)
        pixel[~near] = np.nan
        seen = near.copy()
        seen[near] = np.einsum("ij,ij->i", eye - points[near], normal[near]) * -cosine[near] > 0
        if via is None:
            seen[seen] = ~self._scene.rays.occluded(transform(T_world_head, self._camera), world[seen])
        else:
            seen[seen] = via.shows(self._scene, T_world_head, self._camera, points[seen])
        # Where a ray is missing in between, the line is cut.
        seen[:-1] &= (np.diff(beam.ray) == 1) | (beam.share == 1.0)
        sigma = self._params.thickness(beam.way)
        # A ray beside the fan's middle meets the surface displaced along the surface, not along the plane's normal.
        along = normal @ beam.normal / np.where(cosine == 0, 1, cosine)
        step = 0.5 * sigma[:, None] * (beam.normal - beam.direction * along[:, None])
        across = pixels(points + step) - pixels(points - step)
        light = self._gain * np.abs(cosine) / (beam.way * sigma) * beam.share
        light *= 1.0 if via is None else via.reflectance
        reflected = self._scene.albedo(hits, world) + self._gloss(hits, points, normal, beam.direction, eye)
        colour = np.array(COLOURS[self._params.colour])
        thing = self._scene.room.thing_of[hits.triangle]
        return LitLine(points, pixel, across, light[:, None] * reflected * colour, normal, thing, seen)

    def _gloss(self, hits: Hits, points: Array, normal: Array, direction: Array, eye: Array) -> Array:
        """Reflectance (N, 1) of the glossy lobe toward the eye (Blinn 1977)."""
        gloss = self._lobes[hits.triangle]
        half = eye - points
        half = half / np.linalg.norm(half, axis=1, keepdims=True) - direction
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
        lobe = np.abs(np.einsum("ij,ij->i", half, normal)) ** GLOSS_EXPONENT
        reflectance: Array = (gloss * (GLOSS_EXPONENT + 8.0) / 8.0 * lobe)[:, None]
        return reflectance

    def draw(self, line: LitLine) -> LineLight:
        """The line's light on the sensor, without glare and noise."""
        joined = self._joined(line)
        starts = np.flatnonzero(joined)
        if not len(starts):
            return LineLight(0, np.zeros((self._height, 0, 3), np.float32))
        step = line.pixel[starts + 1] - line.pixel[starts]
        # Where a piece ends the surface goes on, on average, for half the way to the ray that missed it.
        ends = np.stack([np.where(joined[starts - 1], 0.0, -0.5), np.where(joined[starts + 1], 1.0, 1.5)], axis=1)
        upright = np.abs(step[:, 1]) >= np.abs(step[:, 0])
        by_row = self._splats(line, starts[upright], ends[upright], along=1)
        by_column = self._splats(line, starts[~upright], ends[~upright], along=0)
        row = np.concatenate([by_row[0], by_column[1]])
        column = np.concatenate([by_row[1], by_column[0]])
        light = np.concatenate([by_row[2], by_column[2]])
        inside = (row >= 0) & (row < self._height) & (column >= 0) & (column < self._width)
        row, column, light = row[inside], column[inside], light[inside]
        if not len(row):
            return LineLight(0, np.zeros((self._height, 0, 3), np.float32))
        first, width = int(column.min()), int(column.max() - column.min()) + 1
        index, size = row * width + column - first, self._height * width
        planes = [np.bincount(index, light[:, k], size) for k in range(3)]
        return LineLight(first, np.stack(planes, axis=-1).reshape(self._height, width, 3).astype(np.float32))

    def _joined(self, line: LitLine) -> NDArray[np.bool_]:
        """Which hits are joined with their successor: both seen, same thing, one surface without a jump in depth."""
        gap = line.points[1:] - line.points[:-1]
        off = np.minimum(
            np.abs(np.einsum("ij,ij->i", gap, line.normal[:-1])), np.abs(np.einsum("ij,ij->i", gap, line.normal[1:]))
        )
        same = line.seen[:-1] & line.seen[1:] & (line.thing[:-1] == line.thing[1:])
        return np.append(same & (off < 2e-3), False)

    def _splats(
        self, line: LitLine, starts: NDArray[np.intp], ends: Array, along: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """Pixels and light of segments from hits `starts` to the next, cut at every half row (along 1) or column (0).

        A segment covers the parts `ends` (S, 2) of the way: 0 to 1, or somewhat more at the end of a piece.
        Returns the pixel along (K,), the pixel across (K,) and the light (K, 3).
        """
        from scipy.special import ndtr

        parts = 2
        side = 1 - along
        a, step = line.pixel[starts], line.pixel[starts + 1] - line.pixel[starts]
        extent = a[:, along, None] + ends * step[:, along, None]
        low, high = np.ceil((np.sort(extent, axis=1).T + 0.5) * parts - 0.5).astype(np.int64)
        count = high - low
        k = np.repeat(np.arange(len(starts)), count)
        cut = low[k] + np.arange(len(k)) - np.repeat(np.cumsum(count) - count, count)
        a, step = a[k], step[k]
        part = ((cut + 0.5) / parts - 0.5 - a[:, along]) / step[:, along]
        i = starts[k]
        centre = a[:, side] + part * step[:, side]
        slope = step[:, side] / step[:, along]
        across = line.across[i] + part[:, None] * (line.across[i + 1] - line.across[i])
        sheet = np.abs(across[:, side] - slope * across[:, along])
        # Blur works across the line; a slanted line also spreads over the height of its part of the row.
        sigma = np.sqrt(sheet**2 + self._blur_px**2 * (1.0 + slope**2) + slope**2 / (12.0 * parts**2) + 1e-6)
        peak = line.peak[i] + part[:, None] * (line.peak[i + 1] - line.peak[i])
        peak *= (sheet * np.sqrt(2.0 * np.pi) / parts)[:, None]
        reach = int(np.clip(np.ceil(4.5 * sigma.max(initial=1.0)), 3, 80))
        pixel = np.rint(centre).astype(np.int64)[:, None] + np.arange(-reach, reach + 1)
        edges = np.concatenate([pixel - 0.5, pixel[:, -1:] + 0.5], axis=1)
        share = np.diff(ndtr(((edges - centre[:, None]) / sigma[:, None]).astype(np.float32)), axis=1)
        k_kept, p_kept = np.nonzero(share > 1e-6)
        return cut[k_kept] // parts, pixel[k_kept, p_kept], share[k_kept, p_kept, None] * peak[k_kept]
