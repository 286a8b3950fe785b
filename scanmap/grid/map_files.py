"""Occupancy maps as Nav2 keeps them: an image and a YAML file beside it, written and read."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap import __version__
from scanmap.errors import ConfigError, RecordingError
from scanmap.grid.occupancy import EVIDENCE_MODELS, OccupancyGrid

Array = NDArray[np.float64]

# 205 is 0.19608 occupied: just above free_thresh, so that unknown is never read back as free.
OCCUPIED_PIXEL, UNKNOWN_PIXEL, FREE_PIXEL = 0, 205, 254
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
# Width, height and white of a P5 file, with comments anywhere between.
_PGM_HEADER = re.compile(rb"P5(?:(?:\s|#[^\n]*\n)+(\d+)){3}\s")
_MODES = ("trinary", "scale", "raw")


class NavMap(NamedTuple):
    """A map as nav2_map_server publishes it."""

    values: NDArray[np.int8]  # (rows, cols) -1 unknown, 0 free .. 100 occupied; row 0 = lowest y
    resolution_m: float
    origin: tuple[float, float, float]  # lower-left corner x, y [m] and yaw [rad]
    mode: str
    occupied_thresh: float
    free_thresh: float


def save_map(
    grid: OccupancyGrid,
    path: Path | str,
    image_format: Literal["pgm", "png"] = "pgm",
    mode: Literal["trinary", "scale"] = "trinary",
) -> list[Path]:
    """Write `path` (.yaml) and the image beside it; the files written.

    `scale` keeps degrees of occupancy and marks what was never seen by transparency, so it needs png. Both
    read back with the occupied, free and unknown cells of the grid.

    Raises:
        ConfigError: a name, format or mode that cannot be, or a path that cannot be written.
    """
    path = Path(path)
    if path.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"map {path} must end in .yaml; its image is written beside it")
    if image_format not in ("pgm", "png") or mode not in ("trinary", "scale"):
        raise ConfigError(f"map format {image_format}, mode {mode}: formats are pgm, png, modes trinary, scale")
    if mode == "scale" and image_format != "png":
        raise ConfigError(f"map mode scale marks unknown cells by transparency, which {image_format} lacks; use png")
    image = np.flipud(_trinary_pixels(grid) if mode == "trinary" else _scale_pixels(grid))
    image_path = path.with_suffix(f".{image_format}")
    content = {
        image_path: cv2.imencode(f".{image_format}", image)[1].tobytes(),
        path: _yaml(grid, image_path.name, mode).encode(),
    }
    partial = {target: target.with_name(f".{target.name}.part") for target in content}
    try:
        # Both whole or neither: a YAML beside half an image would still load.
        for target, data in content.items():
            partial[target].write_bytes(data)
        for target in content:
            partial[target].replace(target)
    except OSError as error:
        raise ConfigError(f"map {path} cannot be written: {error.strerror}; choose another --map") from error
    finally:
        for part in partial.values():
            part.unlink(missing_ok=True)
    return [path, image_path]


def load_map(path: Path | str) -> OccupancyGrid:
    """The grid that a map file describes, by Nav2's rules; what `save_map` wrote keeps its cells.

    Raises:
        RecordingError: as `read_nav_map`; or the map is rotated, which this grid cannot be.
    """
    nav = read_nav_map(path)
    if nav.origin[2] != 0.0:
        raise RecordingError(f"map {path}: yaw {nav.origin[2]} in its origin; only maps with yaw 0 become a grid")
    known = nav.values.astype(np.float64) / 100.0
    if nav.mode == "scale":
        known = nav.free_thresh + known * (nav.occupied_thresh - nav.free_thresh)
    model = EVIDENCE_MODELS["octomap"]
    with np.errstate(divide="ignore", invalid="ignore"):
        log_odds = np.clip(np.log(known / (1.0 - known)), model.low, model.high)
    log_odds[nav.values == 0] = model.low
    log_odds[nav.values == 100] = model.high
    log_odds[nav.values < 0] = 0.0
    return OccupancyGrid(log_odds.astype(np.float32), nav.resolution_m, nav.origin[:2])


def read_nav_map(path: Path | str) -> NavMap:
    """Read a map exactly as nav2_map_server does: modes, thresholds, negate, alpha.

    Raises:
        RecordingError: a file is missing or damaged, a key is missing or wrong; each names the file.
    """
    path = Path(path)
    document = _document(path)
    mode = str(document.get("mode", "trinary")).lower()
    if mode not in _MODES:
        raise RecordingError(f"map {path}: mode {mode!r}; valid are {', '.join(_MODES)}")
    occupied, free = (_number(document, key, path) for key in ("occupied_thresh", "free_thresh"))
    if mode == "scale" and free >= occupied:
        raise RecordingError(f"map {path}: free_thresh {free} must be below occupied_thresh {occupied}")
    resolution = _number(document, "resolution", path)
    if not resolution > 0:
        raise RecordingError(f"map {path}: resolution {resolution} must be above 0 m per cell")
    name = document.get("image")
    if not isinstance(name, str) or not name:
        raise RecordingError(f"map {path}: image {name!r} must be a file name")
    shade, opaque = _shade(path.parent / name, mode, path)
    if mode == "raw":
        values = np.where(np.floor(shade * 255.0 + 0.5) <= 100.0, np.floor(shade * 255.0 + 0.5), -1.0)
    else:
        occupancy = shade if _negate(document, path) else 1.0 - shade
        values = _cells(occupancy, occupied, free, opaque if mode == "scale" else None)
    return NavMap(np.flipud(values).astype(np.int8), resolution, _origin(document, path), mode, occupied, free)


def _cells(occupancy: Array, occupied: float, free: float, opaque: NDArray[np.bool_] | None) -> Array:
    """Cell values by the rules of nav2_map_server: scale mode where `opaque` is given, else trinary."""
    if opaque is None:
        between = np.full(occupancy.shape, -1.0)
    else:
        between = np.rint((occupancy - free) / (occupied - free) * 100.0)
    values: Array = np.where(occupancy > occupied, 100.0, np.where(occupancy < free, 0.0, between))
    return values if opaque is None else np.where(opaque, values, -1.0)


def _shade(image_path: Path, mode: str, path: Path) -> tuple[Array, NDArray[np.bool_]]:
    """Brightness 0 .. 1 of every pixel, row 0 on top, and whether it is opaque."""
    try:
        data = np.frombuffer(image_path.read_bytes(), np.uint8)
    except OSError as error:
        raise RecordingError(f"map {path}: its image {image_path} cannot be read: {error.strerror}") from error
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    if image is None:
        raise RecordingError(f"map {path}: its image {image_path} is damaged or no image; PGM and PNG are read")
    header = _PGM_HEADER.match(data[:4096].tobytes())
    # OpenCV brings the white of a P2 file to 255, but leaves that of a P5 file where it was.
    white = float(header.group(1)) if header else 65535.0 if image.dtype == np.uint16 else 255.0
    channels = image.reshape(*image.shape[:2], -1).astype(np.float64) / white
    alpha = channels[..., 3] if channels.shape[2] == 4 else np.ones(image.shape[:2])
    # Averaging alpha in with the colours is what nav2 does in trinary mode, and only there.
    shade = channels.mean(axis=2) if mode == "trinary" else channels[..., :3].mean(axis=2)
    return shade, alpha == 1.0


def _document(path: Path) -> dict[str, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        document = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RecordingError(f"map {path} cannot be read: {error.strerror}") from error
    except (YAMLError, UnicodeDecodeError) as error:
        raise RecordingError(f"map {path} is not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(document, dict):
        raise RecordingError(f"map {path} has no keys; it needs image, resolution, origin, negate and thresholds")
    return document


def _number(document: dict[str, Any], key: str, path: Path) -> float:
    value = document.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise RecordingError(f"map {path}: {key} {'is missing' if value is None else repr(value)}; it must be a number")
    return float(value)


def _origin(document: dict[str, Any], path: Path) -> tuple[float, float, float]:
    value = document.get("origin")
    if not isinstance(value, list) or len(value) != 3:
        raise RecordingError(f"map {path}: origin {value!r} must be [x, y, yaw]")
    x, y, yaw = (_number({"origin": part}, "origin", path) for part in value)
    return x, y, yaw


def _negate(document: dict[str, Any], path: Path) -> bool:
    value = document.get("negate")
    if not isinstance(value, int):
        raise RecordingError(f"map {path}: negate {'is missing' if value is None else repr(value)}; it must be 0 or 1")
    return bool(value)


def _trinary_pixels(grid: OccupancyGrid) -> NDArray[np.uint8]:
    image = np.full(grid.shape, UNKNOWN_PIXEL, dtype=np.uint8)
    image[grid.free] = FREE_PIXEL
    image[grid.occupied] = OCCUPIED_PIXEL
    return image


def _scale_pixels(grid: OccupancyGrid) -> NDArray[np.uint8]:
    """(rows, cols, 4) BGRA; occupancy stretched so that the grid's classes meet the file's thresholds."""
    knots = [0.0, grid.free_below, grid.occupied_above, 1.0]
    occupancy = np.interp(grid.probability(), knots, [0.0, FREE_THRESH, OCCUPIED_THRESH, 1.0])
    pixel = np.rint(255.0 * (1.0 - occupancy))
    # The last pixel values on this side of each threshold: rounding must not change a cell's class.
    lightest_occupied = np.ceil(255.0 * (1.0 - OCCUPIED_THRESH)) - 1.0
    darkest_free = np.floor(255.0 * (1.0 - FREE_THRESH)) + 1.0
    # One more between: nav2 rounds to percent, and 205 would become 0, free.
    pixel = np.clip(pixel, lightest_occupied + 1.0, darkest_free - 2.0, where=grid.unknown, out=pixel)
    pixel[grid.occupied] = np.minimum(pixel[grid.occupied], lightest_occupied)
    pixel[grid.free] = np.maximum(pixel[grid.free], darkest_free)
    alpha = np.where(grid.log_odds == 0.0, 0.0, 255.0)
    return np.stack([pixel, pixel, pixel, alpha], axis=-1).astype(np.uint8)


def _yaml(grid: OccupancyGrid, image: str, mode: str) -> str:
    comments = {"software": f"scanmap {__version__}", **grid.comments}
    lines = [f"# {key}: {' '.join(str(value).split())}" for key, value in comments.items()]
    x, y = (float(v) for v in grid.origin)
    lines += [
        f"image: {image}",
        f"mode: {mode}",
        f"resolution: {float(grid.resolution_m)!r}",
        f"origin: [{x!r}, {y!r}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {OCCUPIED_THRESH}",
        f"free_thresh: {FREE_THRESH}",
    ]
    return "\n".join(lines) + "\n"
