"""What a file holds, in lines: recordings, clouds, meshes, maps, calibrations, rigs."""

from __future__ import annotations

import shlex
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanmap import config as configuration
from scanmap import recording
from scanmap.calibration import Calibration
from scanmap.errors import ConfigError, RecordingError
from scanmap.grid import load_map
from scanmap.scan.formats import read_ply, read_points
from scanmap.session.inspection import grid_lines
from scanmap.session.summary import summarise
from scanmap.sweep import plan

KINDS = (
    "a recording (.mcap), a folder of frames, a video, a cloud (.ply .pcd .xyz), a mesh (.glb .stl .obj), "
    "a map (.yaml), a calibration or rig (.toml)"
)


def describe(path: Path) -> list[str]:
    """What a file holds, as lines.

    Raises:
        ConfigError: no such file, or of a kind scanmap does not know.
        RecordingError, CalibrationError: it is damaged.
    """
    if not path.exists():
        raise ConfigError(f"{path} does not exist; scanmap info wants {KINDS}")
    if path.suffix.lower() == ".rrd":
        raise ConfigError(
            f"{path} is a view, made to be looked at: scanmap view {shlex.quote(str(path))}; info wants its recording"
        )
    if path.suffix.lower() in (".pgm", ".png", ".jpg", ".jpeg"):
        raise ConfigError(f"{path} is an image; of a map name the .yaml beside it. scanmap info wants {KINDS}")
    reader = _READERS.get(path.suffix.lower()) if path.is_file() else None
    return reader(path) if reader is not None else _describe_recording(path)


def _describe_recording(path: Path) -> list[str]:
    info = recording.describe(path)
    unfinished = info.cut_at is not None or info.end_reason != "finished"
    if not (unfinished and info.has_rig and path.suffix == ".mcap"):
        return info.lines
    name = shlex.quote(str(recording.first_part(path)))
    # Where its sweep ended in good order the file alone lacks its end, and no shot is left to be taken.
    return [*info.lines, f"next: scanmap {'recover' if info.end_reason == 'finished' else 'scan --resume'} {name}"]


def _describe_ply(path: Path) -> list[str]:
    try:
        scan = read_ply(path)
    except RecordingError:
        points = read_points(path)
        return [
            f"PLY {path}: {len(points)} points, no scan of scanmap's: a mesh, or of another program",
            _extent(points),
        ]
    summary = summarise(scan)
    if not summary.points:
        return [f"cloud {path}: empty"]
    first, last = np.degrees(scan.bearings[[0, -1]])
    return [
        f"cloud {path}: {summary.points} points",
        f"bearings: {summary.bearings} from {first:.3f} to {last:.3f} deg, {summary.rows} image rows",
        f"range: {summary.range_min_m:.3f} to {summary.range_max_m:.3f} m, median {summary.range_median_m:.3f} m",
        *(f"{key}: {value}" for key, value in scan.comments.items()),
    ]


def _describe_map(path: Path) -> list[str]:
    return [f"map {path}", *grid_lines(load_map(path))]


def _describe_toml(path: Path) -> list[str]:
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from error
    if "image" in document or "head" in document:
        return _describe_calibration(path)
    config = configuration.load(str(path))
    head = "inline" if not isinstance(config.calibration, str | None) else config.calibration or "none of its own"
    return [
        f"rig {path}: {config.description or 'without a description'}",
        f"rig = {config.rig}; calibration: {head}",
        f"sweep: {plan(config.sweep).words}",
        f"all of it: scanmap config --config {shlex.quote(str(path))}",
    ]


def _describe_calibration(path: Path) -> list[str]:
    head = Calibration.load(path)
    own = head.intrinsics
    return [
        f"calibration {path}: {own.width}x{own.height} px, fx {own.fx:.2f}, fy {own.fy:.2f}, "
        f"cx {own.cx:.2f}, cy {own.cy:.2f}",
        f"baseline {1e3 * head.baseline_m:.2f} mm, beta {np.degrees(head.beta):.3f} deg, "
        f"half view {np.degrees(head.alpha):.2f} deg",
        f"head offset {tuple(head.mount.offset_m)} m, axis tilt {tuple(head.mount.tilt_deg)} deg",
        *(f"{key}: {value}" for table in (head.residuals, head.meta) for key, value in table.items()),
    ]


def _describe_mesh(path: Path) -> list[str]:
    import trimesh

    try:
        mesh = trimesh.load_mesh(path)
        points = np.asarray(mesh.vertices, np.float64).reshape(-1, 3)
        count = len(mesh.faces)
    except Exception as error:  # trimesh raises whatever its parsers run into
        raise RecordingError(f"mesh {path} cannot be read: {type(error).__name__}: {error}") from error
    if not len(points):
        raise RecordingError(f"mesh {path} holds no corner: it is empty or no mesh")
    return [f"mesh {path}: {len(points)} corners, {count} triangles", _extent(points)]


def _describe_pcd(path: Path) -> list[str]:
    header: dict[str, str] = {}
    comments: list[str] = []
    with path.open("rb") as file:
        for line in file:
            text = line.decode("latin-1").strip()
            if text.startswith("#"):
                comments.append(text.lstrip("# "))
                continue
            key, _, value = text.partition(" ")
            header[key] = value
            if key == "DATA" or len(header) > 20:
                break
    if "POINTS" not in header or "FIELDS" not in header:
        raise RecordingError(f"{path} is not a PCD file: its header lacks POINTS or FIELDS")
    # Every bearing by itself is for programs.
    about = [comment for comment in comments if ": " in comment and not comment.startswith("bearings_rad")]
    return [f"cloud {path}: {header['POINTS']} points, fields {header['FIELDS']}, {header.get('DATA')}", *about]


def _describe_xyz(path: Path) -> list[str]:
    try:
        points = np.array([line.split()[:3] for line in path.read_text(encoding="ascii").splitlines()], np.float64)
    except ValueError as error:
        raise RecordingError(f"cloud {path} is not x y z as text: {error}") from error
    if points.ndim != 2 or points.shape[1] != 3:
        raise RecordingError(f"cloud {path} is not x y z as text: it has no line of three numbers")
    return [f"cloud {path}: {len(points)} points", _extent(points)]


def _extent(points: NDArray[np.float64]) -> str:
    known = points[np.isfinite(points).all(axis=1)]
    if not len(known):
        return "extent: none"
    parts = zip("xyz", known.min(axis=0), known.max(axis=0), strict=True)
    return "extent: " + ", ".join(f"{axis} {low:.3f} to {high:.3f}" for axis, low, high in parts) + " m"


_READERS: dict[str, Callable[[Path], list[str]]] = {
    ".ply": _describe_ply,
    ".pcd": _describe_pcd,
    ".xyz": _describe_xyz,
    ".glb": _describe_mesh,
    ".stl": _describe_mesh,
    ".obj": _describe_mesh,
    ".yaml": _describe_map,
    ".yml": _describe_map,
    ".toml": _describe_toml,
}
