"""Frames with a laser line whose columns are known: clean ones for the noise bound, hard ones for real rooms.

Light is added up in grey levels as floats, (H, W, 3) in BGR, and becomes a picture last: scattered, clipped, rounded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import LaserLineParams, find_laser_line

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

RED = (0.06, 0.10, 1.0)  # a red diode laser in blue, green, red of a sensor without a filter
GREEN = (0.12, 1.0, 0.10)


@dataclass(frozen=True)
class LineSpec:
    """A clean frame: one curved line on an even background."""

    height: int = 1200
    width: int = 1600
    sigma: float = 2.0  # [px]
    peak: float = 200.0  # [grey levels]; above 245 the core saturates
    background: float = 10.0  # [grey levels]
    noise: float = 3.0  # [grey levels] additive
    speckle: float = 0.0  # contrast, multiplies the line's light
    step_px: float = 0.0  # depth steps, every `step_rows` rows there and back
    step_rows: int = 100
    colour: tuple[float, float, float] | None = None  # None: a grey frame

    def columns(self) -> F64:
        """Columns (H,) of the line: a sine with slopes up to 0.68 px a row at 1200 rows, and the steps."""
        row = np.arange(self.height)
        reach = 130.0 * self.height / 1200.0
        column: F64 = 0.325 * self.width + reach * np.sin(2.0 * np.pi * row / self.height) + 0.37
        return column + self.step_px * ((row // self.step_rows) % 2)


class LineFrame(NamedTuple):
    """A hard frame and what is true of it."""

    image: U8  # (H, W) or (H, W, 3) BGR, laser on
    background: U8  # same shape, laser off
    truth: F64  # (H,) columns of the line; NaN where there is none
    visible: NDArray[np.bool_]  # (H,) rows in which the picture shows the line
    second: F64  # (H,) columns of a second true segment in the row; NaN elsewhere


class Score(NamedTuple):
    """A detector's columns against a frame's."""

    found: float  # fraction of the rows that carry a line with a column within 1 px of it
    false: float  # fraction of all rows with a column more than 3 px from anything true


def bound(spec: LineSpec) -> float:
    """Cramer-Rao bound of one row's column [px]: position, height, width, background unknown, clipped samples lost.

    For a whole line in even noise it is 1.062 sqrt(sigma) s_n / A; rounding to grey levels is noise of 1/12.
    """
    x = np.arange(-40.0, 41.0)
    variances = []
    for u in np.linspace(0.0, 0.9, 10):
        bell = np.exp(-0.5 * ((x - u) / spec.sigma) ** 2)
        signal = spec.peak * bell
        slope = signal * (x - u) / spec.sigma**2
        variance = spec.noise**2 + 1.0 / 12.0 + (spec.speckle * signal) ** 2
        seen = spec.background + signal < 255.0
        jacobian = np.stack([slope, bell, slope * (x - u) / spec.sigma, np.ones_like(x)])[:, seen]
        variances.append(np.linalg.inv((jacobian / variance[seen]) @ jacobian.T)[0, 0])
    return float(np.sqrt(np.mean(variances)))


def clean(spec: LineSpec, rng: np.random.Generator) -> tuple[U8, F64]:
    """A clean frame (H, W) or (H, W, 3), and its columns (H,)."""
    column = spec.columns()
    line = line_light(column, spec.peak, spec.sigma, spec.width)
    if spec.speckle:
        lit = line > 1e-3
        line[lit] *= 1.0 + spec.speckle * rng.standard_normal(int(lit.sum()), np.float32)
    light = line if spec.colour is None else line[..., None] * np.float32(spec.colour)
    return sensor(light + np.float32(spec.background), spec.noise, rng), column


EACH_ROW = LaserLineParams()


def errors(spec: LineSpec, params: LaserLineParams = EACH_ROW, seeds: Iterable[int] = range(3)) -> tuple[F64, F64]:
    """Errors [px] and errors over sigma_px of all rows of several frames; NaN where no line was found."""
    off, scaled = [], []
    for seed in seeds:
        image, truth = clean(spec, np.random.default_rng(seed))
        line = find_laser_line(image, params)
        off.append(line.column_px - truth)
        scaled.append(off[-1] / line.sigma_px)
    return np.concatenate(off), np.concatenate(scaled)


def line_light(column: F64, peak: float | F64, sigma: float | F64, width: int) -> F32:
    """Light (H, W) of a Gaussian line; rows whose column is NaN are dark."""
    light = np.zeros((len(column), width), np.float32)
    height, breadth = np.broadcast_to(peak, len(column)), np.broadcast_to(sigma, len(column))
    reach = int(np.ceil(6.0 * breadth.max())) + 1
    rows = np.flatnonzero(np.isfinite(column))
    x = np.rint(column[rows]).astype(np.intp)[:, None] + np.arange(-reach, reach + 1)
    z = (x - column[rows, None]) / breadth[rows, None]
    value = height[rows, None] * np.exp(-0.5 * z * z)
    inside = (x >= 0) & (x < width)
    light[np.broadcast_to(rows[:, None], x.shape)[inside], x[inside]] = value[inside]
    return light


def sensor(light: F32, noise: float, rng: np.random.Generator) -> U8:
    """What an 8-bit sensor makes of light in grey levels: noise, clipping at 255, rounding."""
    scattered = light + np.float32(noise) * rng.standard_normal(light.shape, np.float32)
    return np.clip(np.rint(scattered), 0, 255).astype(np.uint8)


def score(column: F64, frame: LineFrame) -> Score:
    """How many of the frame's rows were found, and how many were invented."""
    off = np.fmin(np.abs(column - frame.truth), np.abs(column - frame.second))
    carries = frame.visible & (np.isfinite(frame.truth) | np.isfinite(frame.second))
    with np.errstate(invalid="ignore"):
        found, false = carries & (off <= 1.0), np.isfinite(column) & ~(off <= 3.0)
    return Score(float(found.sum() / max(carries.sum(), 1)), float(false.mean()))


def hard_frame(name: str, seed: int = 0, *, height: int = 600, width: int = 800, colour: bool = True) -> LineFrame:
    """One of `HARD`, rendered; a red laser in BGR, or grey as behind a red filter."""
    rng = np.random.default_rng([seed, len(name), sum(map(ord, name))])
    room = Room(height, width, rng)
    HARD[name](room)
    return room.frame(colour)


class Room:
    """Ambient light, a line and its faults, being put together."""

    def __init__(self, height: int, width: int, rng: np.random.Generator) -> None:
        self.height, self.width, self.rng = height, width, rng
        # A wall lit from one side, with plaster's faint unevenness.
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        shade = 24.0 + 22.0 * x / width + 8.0 * y / height
        plaster = cv2.GaussianBlur(rng.normal(0.0, 18.0, (height, width)).astype(np.float32), (0, 0), 4.0)
        self.ambient: F32 = ((shade + plaster)[..., None] * np.float32([0.85, 0.95, 1.0])).astype(np.float32)
        row = np.arange(height)
        self.column: F64 = 0.4 * width + 0.08 * width * np.sin(5.0 * row / height + 0.4) + 0.21
        self.second: F64 = np.full(height, np.nan)
        self.peak: F64 = np.full(height, 150.0)
        self.sigma = 1.8
        self.laser: tuple[float, float, float] = RED
        self.extra = np.zeros((height, width), np.float32)  # laser light besides the line: reflections
        self.halo = 0.0  # share of the line's light that a dirty lens spreads
        self.off_gain = np.ones(3)  # of the laser-off frame, by channel
        self.white_columns: tuple[int, ...] = ()
        self.hidden = np.zeros(height, bool)

    def box(self, x: float, y: float, w: float, h: float, level: tuple[float, float, float]) -> None:
        """An even rectangle; position and size as fractions of the picture."""
        top, left = int(y * self.height), int(x * self.width)
        bottom, right = int((y + h) * self.height), int((x + w) * self.width)
        self.ambient[max(top, 0) : bottom, max(left, 0) : right] = level

    def hide(self, rows: NDArray[np.bool_]) -> None:
        """Say that the line cannot be seen in these rows, though its light falls there."""
        self.hidden = rows

    def frame(self, colour: bool) -> LineFrame:
        """Expose laser on and laser off."""
        line = line_light(self.column, self.peak, self.sigma, self.width) + self.extra
        line = np.maximum(line, line_light(self.second, self.peak, self.sigma, self.width))
        if self.halo:
            spread = cv2.GaussianBlur(line, (0, 0), 9.0) * np.float32(self.halo)
            line = line + spread
        ambient = cv2.GaussianBlur(self.ambient, (0, 0), 0.7)
        on, off = ambient + line[..., None] * np.float32(self.laser), ambient * np.float32(self.off_gain)
        if not colour:
            # Behind a red filter the sensor sees red and a twentieth of the rest.
            weights = np.float32([0.05, 0.05, 1.0] if self.laser[2] >= self.laser[1] else [0.05, 1.0, 0.05])
            on, off = on @ weights, off @ weights
        image, background = sensor(on, 1.5, self.rng), sensor(off, 1.5, self.rng)
        for x in self.white_columns:
            image[:, x], background[:, x] = 255, 255
        return LineFrame(image, background, self.column, ~self.hidden, self.second)


def _plain(room: Room) -> None:
    pass


def _window_away(room: Room) -> None:
    room.box(0.62, 0.1, 0.3, 0.5, (420.0, 410.0, 400.0))


def _window_left(room: Room) -> None:
    """The thesis's own failure: bright light left of the line."""
    room.box(0.02, 0.2, 0.22, 0.6, (420.0, 410.0, 400.0))


def _window_beside(room: Room) -> None:
    left = (np.nanmax(room.column) + 14.0) / room.width
    room.box(left, 0.15, 0.3, 0.5, (420.0, 410.0, 400.0))


def _window_over(room: Room) -> None:
    room.box(0.3, 0.3, 0.4, 0.25, (420.0, 410.0, 400.0))
    row = np.arange(room.height)
    room.hide((row >= 0.3 * room.height - 4) & (row < 0.55 * room.height + 4))


def _lamp_over(room: Room) -> None:
    centre = (int(room.column[room.height // 2]) + 4, room.height // 2)
    glow = np.zeros((room.height, room.width), np.float32)
    cv2.circle(glow, centre, 28, 900.0, -1)
    glow = cv2.GaussianBlur(glow, (0, 0), 6.0)
    room.ambient += glow[..., None] * np.float32([0.9, 1.0, 1.0])
    at = glow[np.arange(room.height), room.column.astype(np.intp)]
    room.hide(at > 40.0)


def _lamps_small(room: Room) -> None:
    """Spots of a lamp chain: saturated, as narrow as the line."""
    for _ in range(14):
        x, y = room.rng.uniform(0.05, 0.95) * room.width, room.rng.uniform(0.05, 0.95) * room.height
        if abs(x - room.column[int(y)]) < 20:
            continue
        spot = np.zeros(room.ambient.shape[:2], np.float32)
        cv2.circle(spot, (int(x), int(y)), 3, 500.0, -1)
        room.ambient += cv2.GaussianBlur(spot, (0, 0), 1.5)[..., None]


def _stripes(room: Room) -> None:
    """A red-and-white cloth, hung so that its stripes run along the line."""
    x = np.arange(room.width)
    red = ((x // 14) % 2).astype(np.float32)[:, None]
    cloth = red * np.float32([15.0, 18.0, 75.0]) + (1.0 - red) * np.float32([80.0, 82.0, 85.0])
    part = slice(int(0.25 * room.height), int(0.7 * room.height))
    room.ambient[part, int(0.2 * room.width) : int(0.8 * room.width)] = cloth[
        None, int(0.2 * room.width) : int(0.8 * room.width)
    ]


def _curtain(room: Room) -> None:
    """Stripes of red and white a few pixels wide, which lean a little; red light hardly tells the two apart."""
    room.peak[:], room.sigma = 50.0, 1.4
    x = np.arange(room.width)[None, :] + 0.15 * np.arange(room.height)[:, None]
    red = ((x // 9) % 2).astype(np.float32)[..., None]
    cloth = red * np.float32([18.0, 20.0, 75.0]) + (1.0 - red) * np.float32([88.0, 90.0, 92.0])
    part = (slice(int(0.3 * room.height), int(0.75 * room.height)), slice(int(0.1 * room.width), int(0.9 * room.width)))
    room.ambient[part] = cv2.GaussianBlur(cloth, (0, 0), 0.8)[part]


def _red_ribs(room: Room) -> None:
    """Narrow red ribs on a dark wall: the line's colour and width, half its height."""
    for x in np.linspace(0.1, 0.9, 9) * room.width:
        if np.nanmin(np.abs(room.column - x)) < 12:
            continue
        room.ambient[int(0.2 * room.height) : int(0.8 * room.height), int(x) : int(x) + 5] = (20.0, 22.0, 95.0)


def _spines(room: Room) -> None:
    """A shelf of books, spines as red and as high as the line, some columns wide; what is behind swallows the line."""
    top, bottom = int(0.35 * room.height), int(0.6 * room.height)
    room.ambient[top:bottom] = (12.0, 12.0, 14.0)
    for x in np.linspace(0.1, 0.9, 12) * room.width:
        wide = int(room.rng.integers(7, 14))
        if np.nanmin(np.abs(room.column - x - wide / 2)) > 25:
            room.ambient[top:bottom, int(x) : int(x) + wide] = (18.0, 20.0, 150.0)
    room.peak[top:bottom] = 1.0
    row = np.arange(room.height)
    room.hide((row >= top - 2) & (row < bottom + 2))


def _tube(room: Room) -> None:
    """A tube of light, upright, saturated and no wider than a near line."""
    left = int(0.7 * room.width)
    room.ambient[int(0.1 * room.height) : int(0.75 * room.height), left : left + 5] = (900.0, 950.0, 950.0)


def _posters(room: Room) -> None:
    for _ in range(18):
        x, y, w, h = room.rng.uniform([0, 0, 0.04, 0.04], [0.9, 0.9, 0.25, 0.3])
        room.box(x, y, w, h, tuple(room.rng.uniform(8.0, 110.0, 3)))


def _text(room: Room) -> None:
    """White print on a dark board: strokes as narrow as the line, but not its colour."""
    room.box(0.1, 0.1, 0.8, 0.8, (14.0, 14.0, 14.0))
    layer = np.zeros((room.height, room.width), np.uint8)
    for k in range(9):
        cv2.putText(
            layer, "ILL WILL LILI HILL", (int(0.12 * room.width), int((0.18 + 0.08 * k) * room.height)),
            cv2.FONT_HERSHEY_SIMPLEX, 1.6, 255, 3,
        )  # fmt: skip
    room.ambient += 110.0 * layer[..., None].astype(np.float32) / 255.0


def _monitor(room: Room) -> None:
    room.box(0.58, 0.3, 0.25, 0.3, (230.0, 200.0, 170.0))
    room.ambient[
        int(0.3 * room.height) : int(0.6 * room.height), int(0.6 * room.width) : int(0.8 * room.width) : 16
    ] *= 0.2


def _reflection(room: Room) -> None:
    """A glossy door shows the line again, weaker, for a third of the rows."""
    rows = np.arange(room.height)
    copy = np.where((rows > 0.3 * room.height) & (rows < 0.65 * room.height), room.column + 0.13 * room.width, np.nan)
    room.extra += line_light(copy, 70.0, 2.6, room.width)


def _two_segments(room: Room) -> None:
    """At a depth edge that leans, two surfaces carry the line in the same rows."""
    rows = np.arange(room.height)
    near = room.column + 0.1 * room.width
    room.second = np.where((rows > 0.4 * room.height) & (rows < 0.6 * room.height), near, np.nan)
    room.column = np.where(rows < 0.55 * room.height, room.column, np.nan)


def _broken(room: Room) -> None:
    """Black things swallow the line: gaps of 3 to 30 rows."""
    row = 20
    while row < room.height - 40:
        gap = int(room.rng.integers(3, 30))
        room.column[row : row + gap] = np.nan
        row += gap + int(room.rng.integers(25, 70))


def _dark(room: Room) -> None:
    """Dark furniture: the line fades to 18 grey levels in places."""
    row = np.arange(room.height)
    room.peak = 84.0 + 66.0 * np.sign(np.sin(9.0 * row / room.height))


def _halo(room: Room) -> None:
    room.peak, room.halo = np.full(room.height, 480.0), 0.35


def _saturated_white(room: Room) -> None:
    """A strong line: its core saturates every channel to white, only the flanks are red."""
    room.peak, room.laser = np.full(room.height, 900.0), (0.32, 0.36, 1.0)


def _steps(room: Room) -> None:
    row = np.arange(room.height)
    room.column = room.column + 60.0 * ((row // 75) % 2)


def _thin_line(room: Room) -> None:
    room.sigma = 0.9


def _wide_line(room: Room) -> None:
    room.sigma = 5.0


def _green_laser(room: Room) -> None:
    room.laser = GREEN


def _exposure(room: Room) -> None:
    """The camera exposes the laser-off frame longer."""
    _posters(room)
    room.off_gain = np.array([1.3, 1.3, 1.3])


def _white_balance(room: Room) -> None:
    _posters(room)
    room.off_gain = np.array([1.2, 1.0, 0.8])


def _white_columns(room: Room) -> None:
    room.white_columns = (int(0.15 * room.width), int(0.7 * room.width), int(0.7 * room.width) + 1)


def _empty(room: Room) -> None:
    room.column[:] = np.nan


def _empty_posters(room: Room) -> None:
    _posters(room)
    room.column[:] = np.nan


HARD: dict[str, Callable[[Room], None]] = {
    "plain wall": _plain,
    "window away": _window_away,
    "window left": _window_left,
    "window beside": _window_beside,
    "window over": _window_over,
    "lamp over": _lamp_over,
    "small lamps": _lamps_small,
    "stripes": _stripes,
    "curtain": _curtain,
    "red ribs": _red_ribs,
    "red spines": _spines,
    "tube of light": _tube,
    "posters": _posters,
    "white text": _text,
    "monitor": _monitor,
    "reflection": _reflection,
    "two segments": _two_segments,
    "broken": _broken,
    "dark": _dark,
    "halo": _halo,
    "saturated white": _saturated_white,
    "steps": _steps,
    "thin line": _thin_line,
    "wide line": _wide_line,
    "green laser": _green_laser,
    "exposure": _exposure,
    "white balance": _white_balance,
    "white columns": _white_columns,
    "empty": _empty,
    "empty posters": _empty_posters,
}
