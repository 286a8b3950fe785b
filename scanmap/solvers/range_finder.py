"""The calibrate.yml of laser-range-finder: rows of a horizontal line, and distances measured at some columns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scanmap.errors import ConfigError
from scanmap.solvers.pairs import NotedHead, Pairs

# readings: row of the line in every image column, negative where there is none; distances: column to distance [mm];
# h: camera to laser [mm]; and the size of the image.
KEYS = ("readings", "distances", "h", "image_width", "image_height")
EXAMPLE = "readings: [98, ...], distances: {14: 350, ...} [mm], h: 22.5 [mm], image_width, image_height"


def read_range_finder(path: Path) -> Pairs:
    """Pairs of row and distance of a calibrate.yml, and the head it was measured with.

    Raises:
        ConfigError: not readable, a key is missing, or a distance stands at a column without a reading.
    """
    document = _document(path)
    missing = [key for key in KEYS if key not in document]
    if missing:
        raise ConfigError(f"{path} lacks {', '.join(missing)}; it must hold {EXAMPLE}")
    try:
        readings = np.array(document["readings"], dtype=np.float64)
        columns = [int(column) for column in document["distances"]]
        distances = np.array([float(value) for value in document["distances"].values()])
        head = NotedHead(int(document["image_height"]), int(document["image_width"]), 1e-3 * float(document["h"]))
    except (TypeError, ValueError, AttributeError) as error:
        raise ConfigError(f"{path}: {error}; it must hold {EXAMPLE}") from error
    if readings.ndim != 1 or not columns:
        raise ConfigError(f"{path} holds no readings or no distances; it must hold {EXAMPLE}")
    for column, distance in zip(columns, distances, strict=True):
        if not (0 <= column < len(readings) and readings[column] >= 0):
            raise ConfigError(f"{path}: no reading at column {column} of {len(readings)}, where {distance:g} mm stands")
        if not 0 < distance < np.inf:
            raise ConfigError(f"{path}: distance {distance:g} at column {column}; it must be above 0")
    if not (min(head.width, head.height) >= 8 and 0 < head.baseline_m < 5.0):
        raise ConfigError(f"{path}: image {head.height}x{head.width} px, h {1e3 * head.baseline_m:g} mm: no such head")
    empty = np.full(len(columns), np.nan)
    return Pairs(readings[columns], 1e-3 * distances, empty, empty, head)


def _document(path: Path) -> dict[str, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        document = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"table {path} cannot be read: {error.strerror}; give a csv such as ppx,actual_m") from error
    except (YAMLError, UnicodeDecodeError) as error:
        why = str(error).splitlines()[0]
        raise ConfigError(f"table {path} is no YAML: {why}; give a csv such as ppx,actual_m") from error
    if not isinstance(document, dict):
        raise ConfigError(f"{path} is no calibrate.yml; it must hold {EXAMPLE}")
    return document
