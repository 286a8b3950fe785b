"""What surfaces look like: materials, and textures painted once and looked up at hit points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Colour = tuple[float, float, float]  # R, G, B; linear reflectance or radiance


@dataclass(frozen=True)
class Texture:
    """A raster laid on the world by a plane projection; it repeats outside its own area."""

    raster: F32  # (h, w, 3) RGB, multiplies the material's albedo
    origin: tuple[float, float, float]  # [m] where raster (0, 0) lies
    across: tuple[float, float, float]  # one raster width, as direction / length [1/m]
    down: tuple[float, float, float]  # one raster height, as direction / length [1/m]

    def at(self, points: NDArray[np.floating]) -> F32:
        """RGB factors (N, 3) at world points (N, 3)."""
        h, w = self.raster.shape[:2]
        axes = np.stack([np.asarray(self.across) * w, np.asarray(self.down) * h], axis=1)
        cell = np.einsum("ij,jk->ki", points, axes.astype(points.dtype))
        cell -= (np.asarray(self.origin) @ axes).astype(points.dtype)[:, None]
        column, row = np.floor(cell).astype(np.int32)
        sampled: F32 = self.raster.reshape(-1, 3)[(row % h) * w + column % w]
        return sampled

    def moved(self, T: F64) -> Texture:
        """The texture on a world moved by the rigid transform `T` (4, 4)."""
        R = T[:3, :3]
        return replace(
            self,
            origin=_tuple(R @ np.asarray(self.origin) + T[:3, 3]),
            across=_tuple(R @ np.asarray(self.across)),
            down=_tuple(R @ np.asarray(self.down)),
        )


@dataclass(frozen=True)
class Material:
    """How a surface returns light."""

    albedo: Colour  # diffuse reflectance
    gloss: float = 0.0  # fraction mirrored; the rest is diffuse
    emission: Colour = (0.0, 0.0, 0.0)  # own radiance [fraction of saturation]
    texture: Texture | None = None

    def moved(self, T: F64) -> Material:
        """The material on a world moved by the rigid transform `T` (4, 4)."""
        return replace(self, texture=self.texture.moved(T)) if self.texture else self


def boards(rng: np.random.Generator, origin: tuple[float, float, float], length_m: float, width_m: float) -> Texture:
    """Floorboards along x: eight boards that differ in tone, with grain and dark joints."""
    rows, columns, count = 384, 512, 8
    tone = rng.normal(1.0, 0.09, count).repeat(rows // count)[:, None]
    raster = tone * _grain(rng, rows, columns, (2.0, 40.0), 0.08)
    for edge in range(3):
        raster[edge :: rows // count] *= 0.7
    for k in range(count):
        joint = int(rng.integers(columns))
        raster[k * rows // count : (k + 1) * rows // count, joint : joint + 3] *= 0.6
    return Texture(_grey(raster), origin, (1 / length_m, 0.0, 0.0), (0.0, 1 / width_m, 0.0))


def wood(rng: np.random.Generator, size_m: float, along: tuple[float, float, float]) -> Texture:
    """Wood grain along a direction; projected obliquely, so that it shows on every face."""
    raster = _grain(rng, 256, 256, (1.5, 30.0), 0.12)
    axis = np.asarray(along) / np.linalg.norm(along)
    across = np.cross(axis, [0.55, 0.45, 0.70])
    return Texture(_grey(raster), (0.0, 0.0, 0.0), _tuple(axis / size_m), _tuple(across / size_m))


def plaster(rng: np.random.Generator, size_m: float = 1.3) -> Texture:
    """Rough paint: two scales of faint blotches."""
    raster = _grain(rng, 256, 256, (3.0, 3.0), 0.012) * _grain(rng, 256, 256, (24.0, 24.0), 0.02)
    return Texture(_grey(raster), (0.0, 0.0, 0.0), (0.8 / size_m, 0.75 / size_m, 0.0), (0.1 / size_m, 0.0, 1 / size_m))


def stripes(count: int, duty: float, dark: float, origin: F64, down: F64) -> Texture:
    """Bars across `down` (one length [1/m] covers all), a fraction `duty` bright, the rest `dark`."""
    phase = np.mod(np.arange(32 * count) / 32.0, 1.0)
    raster = np.where(phase < duty, 1.0, dark)[:, None].repeat(2, axis=1)
    return Texture(_grey(raster), _tuple(origin), (0.0, 0.0, 0.0), _tuple(down))


def slats(count: int, origin: F64, down: F64) -> Texture:
    """A blind: slats across `down`, each from bright to shaded."""
    tilt = np.mod(np.arange(32 * count) / 32.0, 1.0)
    raster = (1.0 - 0.35 * tilt**3)[:, None].repeat(2, axis=1)
    return Texture(_grey(raster), _tuple(origin), (0.0, 0.0, 0.0), _tuple(down))


def painting(rng: np.random.Generator, origin: F64, across: F64, down: F64) -> Texture:
    """An abstract picture: hills of saturated colours under a pale sky, with a sun and a white mount."""
    h, w = 240, 320
    image = np.empty((h, w, 3), np.float32)
    image[:] = np.linspace([0.30, 0.52, 0.75], [0.92, 0.80, 0.55], h)[:, None]
    cv2.circle(image, (int(0.7 * w), int(0.32 * h)), 26, (0.95, 0.55, 0.10), -1, cv2.LINE_AA)
    columns = np.arange(w)
    for k, colour in enumerate([(0.20, 0.30, 0.55), (0.10, 0.42, 0.30), (0.55, 0.10, 0.12), (0.05, 0.06, 0.08)]):
        a, b, c = rng.uniform(0.6, 1.4, 3)
        ridge = h * (0.45 + 0.13 * k) + 16 * np.sin(columns / w * 6.0 * a + 5 * b) + 8 * np.sin(columns / w * 17 * c)
        image[np.arange(h)[:, None] > ridge[None]] = colour
    mount = np.ones((h, w), bool)
    mount[18:-18, 18:-18] = False
    image[mount] = 0.85
    return Texture(image, _tuple(origin), _tuple(across), _tuple(down))


def _grain(rng: np.random.Generator, rows: int, columns: int, sigma: tuple[float, float], depth: float) -> F64:
    """Smoothed noise around 1 with standard deviation `depth`, tiling without a seam."""
    frequency_v = np.fft.fftfreq(rows)[:, None]
    frequency_u = np.fft.rfftfreq(columns)[None]
    weight = np.exp(-2.0 * np.pi**2 * ((sigma[0] * frequency_v) ** 2 + (sigma[1] * frequency_u) ** 2))
    smooth = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((rows, columns))) * weight, s=(rows, columns))
    grain: F64 = 1.0 + depth * smooth / smooth.std()
    return grain


def _grey(raster: F64) -> F32:
    return np.repeat(np.clip(raster, 0.02, None)[..., None], 3, axis=2).astype(np.float32)


def _tuple(v: F64) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])
