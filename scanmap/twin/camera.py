"""`TwinCamera`: renders what the calibration's camera would see of the room at the stage's true bearing."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from scanmap.calibration import Calibration
from scanmap.geometry import transform
from scanmap.rig import Frame
from scanmap.twin.laser import LaserFan, LaserParams, LineLight
from scanmap.twin.light import LightParams
from scanmap.twin.motion import DriveParams
from scanmap.twin.optics import Lens
from scanmap.twin.scene import RoomParams, Scene
from scanmap.twin.sensor import STEPS, Coded, Sensor, SensorParams

F32 = NDArray[np.float32]

COARSE = 4  # [px] the room is cast in steps of this, and finely only at its edges
VIEW_DIGITS = 9  # bearings [rad] alike to so many decimals are one view
EDGE_DN = 4.0  # [grey levels] a place is an edge from this difference between itself and its surroundings


class TwinParams(RoomParams, frozen=True, extra="forbid"):
    """The digital twin; `[twin]` and its tables in a rig's TOML."""

    seed: int = Field(1, ge=0, description="of all noise: the same seed gives the same pictures")
    rate_hz: float = Field(30.0, gt=0.0, le=1000.0, description="pictures a second, where the head turns meanwhile")
    latency_s: float = Field(
        0.0, ge=0.0, le=5.0, description="how much later than its exposure a picture is stamped [s]"
    )
    jitter_s: float = Field(0.0, ge=0.0, le=1.0, description="standard deviation of that [s]")
    exposure_us: float = Field(
        5000.0, gt=0.0, le=1e7, description="exposure at which light and laser are as bright as they say [us]"
    )
    light: LightParams = LightParams()
    laser: LaserParams = LaserParams()
    sensor: SensorParams = SensorParams()
    drive: DriveParams = DriveParams()


class _Backdrop(NamedTuple):
    """The room without the laser at one bearing."""

    bearing: float
    coded: Coded  # (H, W, 3)
    amplitude: NDArray[np.uint8]  # (H, W, 3) noise, 16ths of a grey level


class TwinCamera:
    """A `Camera` (see `scanmap.rig`) that looks at a scene.

    Args:
        scene: the room, from `build_scene`.
        calibration: the head as it truly is.
        params: laser and sensor.
        state: gives the stage's true bearing [rad] and whether the laser is on, at the moment it is called.
        rng: of noise and speckle; left out, one from `params.seed`.
        clock: [s] monotonic.

    Noise belongs to the view and to how often it was shot, as `remember` is told: what else was looked at does not
    matter, so that a scan in two parts equals one in a single go.
    """

    def __init__(
        self,
        scene: Scene,
        calibration: Calibration,
        params: TwinParams,
        state: Callable[[], tuple[float, bool]],
        *,
        rng: np.random.Generator | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        own = calibration.intrinsics
        self._scene, self._calibration, self._params = scene, calibration, params
        self._state, self._clock = state, clock
        self._rng = np.random.default_rng(params.seed) if rng is None else rng
        self._frames_seed = int(self._rng.integers(1 << 62))
        self._taken: Counter[float] = Counter()  # taken of each view
        self._looks: Counter[tuple[float, bool]] = Counter()  # at each view since the last shot
        self._sensor = Sensor(params.sensor, own.width, own.height, self._rng)
        self._fan = LaserFan(scene, calibration, params.laser, params.sensor.blur_px)
        self._speckle = _speckle_tile(params.laser.speckle, own.height, self._rng)
        self._coarse_size = (max(2, own.width // COARSE), max(2, own.height // COARSE))
        self._coarse_rays = self._rays(*_grid(own.width, own.height, *self._coarse_size))
        self._fine_rays = self._rays(*_grid(own.width, own.height, own.width, own.height))
        self._backdrop: _Backdrop | None = None
        self._gain = np.float32(1.0)  # of the exposure, against the one that everything is given for

    @property
    def width(self) -> int:
        """Image width [px]."""
        return self._calibration.intrinsics.width

    @property
    def height(self) -> int:
        """Image height [px]."""
        return self._calibration.intrinsics.height

    def grab(self) -> Frame:
        """A picture of the room at the bearing and with the laser as they are now."""
        bearing, laser_on = self._state()
        now = self._clock()
        rng = self._noise_of(bearing, laser_on)
        backdrop = self._backdrop
        if backdrop is None or backdrop.bearing != bearing:
            backdrop = self._backdrop = self._look(bearing)
        if not laser_on:
            return Frame(self._sensor.read_out(backdrop.coded, backdrop.amplitude, rng), now)
        coded, amplitude = backdrop.coded.copy(), backdrop.amplitude.copy()
        for line in (self._fan.trace(bearing), *self._fan.echoes(bearing)):
            self._add_line(coded, amplitude, self._fan.draw(line), rng)
        return Frame(self._sensor.read_out(coded, amplitude, rng), now)

    def remember(self, bearings: Iterable[float]) -> None:
        """A shot was taken at each of these `bearings` [rad]; the next ones there are others."""
        self._taken.update(round(bearing, VIEW_DIGITS) for bearing in bearings)
        self._looks.clear()

    def shot_taken(self, bearing: float) -> None:
        """As `remember`, of the shot just taken, by where the board says it was [rad].

        A head that stands elsewhere has looked at other views; then it is those that were shot.
        """
        views = {view for view, _ in self._looks}
        self.remember([bearing] if not views or round(bearing, VIEW_DIGITS) in views else views)

    def expose(self, exposure_us: float) -> None:
        """Expose so long from the next picture on [us]."""
        self._gain = np.float32(exposure_us / self._params.exposure_us)
        self._backdrop = None

    def close(self) -> None:
        """Free nothing: there is no device."""

    def _noise_of(self, bearing: float, laser_on: bool) -> np.random.Generator:
        """The generator for the picture that is taken now."""
        bearing = round(bearing, VIEW_DIGITS)
        look = self._looks[bearing, laser_on]
        self._looks[bearing, laser_on] += 1
        view = int(np.float64(bearing).view(np.uint64))
        return np.random.default_rng([self._frames_seed, view, laser_on, self._taken[bearing], look])

    def _rays(self, columns: NDArray[np.float64], rows: NDArray[np.float64]) -> F32:
        """Directions (N, 3) in the head frame."""
        R = self._calibration.T_head_camera[:3, :3].astype(np.float32)
        return _turned(Lens(self._calibration).rays(columns, rows), R)

    def _look(self, bearing: float) -> _Backdrop:
        """The room coarsely everywhere, and pixel by pixel where the coarse picture has contrast."""
        T_world_head = self._calibration.mount.T_world_head(bearing)
        origin = transform(T_world_head, self._calibration.T_head_camera[:3, 3])
        R = T_world_head[:3, :3].astype(np.float32)
        through = self._params.sensor.filter_rgb * self._gain
        coarse_shape = (self._coarse_size[1], self._coarse_size[0], 3)
        light = (self._scene.radiance(origin, _turned(self._coarse_rays, R)) * through).reshape(coarse_shape)
        glare = self._params.sensor.glare * _blurred(light, self._params.sensor.glare_px / COARSE)
        rough = self._sensor.code(light + glare)
        size = (self.width, self.height)
        coded = np.asarray(cv2.resize(rough, size, interpolation=cv2.INTER_LINEAR), np.int16)
        edge = cv2.resize(_edges(rough), size, interpolation=cv2.INTER_NEAREST)
        at = np.flatnonzero(edge)
        fine = self._scene.radiance(origin, _turned(np.take(self._fine_rays, at, axis=0), R)) * through
        row, column = np.divmod(at, self.width)
        scale = (coarse_shape[0] / self.height, coarse_shape[1] / self.width)
        fine += glare[(row * scale[0]).astype(np.intp), (column * scale[1]).astype(np.intp)]
        coded.reshape(-1, 3)[at] = self._sensor.code(fine)
        if self._params.sensor.blur_px > 0:
            coded = np.asarray(cv2.GaussianBlur(coded, (3, 3), self._params.sensor.blur_px), np.int16)
        return _Backdrop(bearing, coded, self._sensor.noise_amplitude(coded))

    def _add_line(self, coded: Coded, amplitude: NDArray[np.uint8], line: LineLight, rng: np.random.Generator) -> None:
        """Add the laser's light to a coded picture, with speckle and glare."""
        if not line.light.size:
            return
        light = line.light * (self._params.sensor.filter_rgb * self._gain)
        if self._params.laser.speckle > 0:
            y, x = rng.integers(0, self._speckle.shape[0] - self.height + 1), rng.integers(0, 64)
            columns = (np.arange(light.shape[1]) + x) % self._speckle.shape[1]
            light *= self._speckle[y : y + self.height, columns, None]
        margin = int(3.0 * self._params.sensor.glare_px) if self._params.sensor.glare > 0 else 0
        first = max(0, line.first_column - margin)
        last = min(self.width, line.first_column + light.shape[1] + margin)
        ends = (line.first_column - first, last - line.first_column - light.shape[1])
        light = np.pad(light, ((0, 0), ends, (0, 0)))
        if margin:
            light += self._params.sensor.glare * _blurred_coarsely(light, self._params.sensor.glare_px)
        row, column = np.nonzero(_brightest_channel(light) > 1e-4)
        added = light[row, column]
        column += first
        bright = self._sensor.code(self._sensor.light(coded[row, column]) + added)
        coded[row, column] = bright
        amplitude[row, column] = self._sensor.noise_amplitude(bright)


def _grid(width: int, height: int, columns: int, rows: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixel coordinates (rows * columns,) of the middles of an even grid of cells over the picture."""
    u = (np.arange(columns) + 0.5) * width / columns - 0.5
    v = (np.arange(rows) + 0.5) * height / rows - 0.5
    return np.tile(u, rows), np.repeat(v, columns)


def _edges(rough: Coded) -> NDArray[np.uint8]:
    """1 where (h, w) a coarse picture cannot be interpolated: where its brightness bends."""
    bend = _brightest_channel(cv2.absdiff(rough, cv2.blur(rough, (3, 3))))
    return (bend > EDGE_DN * STEPS).view(np.uint8)


def _brightest_channel(picture: NDArray[Any]) -> NDArray[Any]:
    # Three strided passes: a reduction over so short an axis costs ten times as much.
    brightest: NDArray[Any] = np.maximum(np.maximum(picture[..., 0], picture[..., 1]), picture[..., 2])
    return brightest


def _turned(directions: F32, R: F32) -> F32:
    # einsum, not @: BLAS would wake its threads for nothing and double the CPU time.
    turned: F32 = np.einsum("ij,kj->ik", directions, R)
    return turned


def _blurred(light: F32, sigma: float, sigma_rows: float = 0.0) -> F32:
    """Gaussian blur; `sigma_rows` [px] where it differs along the rows' direction."""
    return np.asarray(cv2.GaussianBlur(light, (0, 0), max(sigma, 0.3), sigmaY=max(sigma_rows, 0.0)), np.float32)


def _blurred_coarsely(light: F32, sigma: float) -> F32:
    """Wide Gaussian blur by way of a smaller picture."""
    height, width = light.shape[:2]
    columns, rows = max(1, width // COARSE), max(1, height // COARSE)
    small = np.asarray(cv2.resize(light, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)
    # Averaging over a cell and interpolating between cells blur too: 1/12 + 1/6 of a cell squared.
    along, down = (max((sigma * part) ** 2 - 0.25, 0.1) ** 0.5 for part in (columns / width, rows / height))
    return np.asarray(cv2.resize(_blurred(small, along, down), (width, height)), np.float32)


def _speckle_tile(contrast: float, height: int, rng: np.random.Generator) -> F32:
    """Factors (height + 256, 512) around 1 with standard deviation `contrast`, grains a pixel or two wide.

    Source: integrated speckle is gamma-distributed (Goodman 1975).
    """
    if contrast == 0:
        return np.ones((height + 256, 512), np.float32)
    grain = _blurred(rng.standard_normal((height + 256, 512), np.float32), 0.6)
    grain /= grain.std()
    # Wilson-Hilferty: a gamma variable of shape 1/contrast^2 from a normal one.
    ninth = np.float32(contrast**2 / 9.0)
    factors: F32 = np.maximum(1.0 - ninth + np.sqrt(ninth) * grain, 0.0) ** 3
    return factors
