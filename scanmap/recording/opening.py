"""`open_source`: what a path is, and the reader for it."""

from __future__ import annotations

from pathlib import Path

from scanmap.errors import RecordingError
from scanmap.recording.frames import frames_source
from scanmap.recording.layout import RecordingParams
from scanmap.recording.mcap_reader import mcap_source
from scanmap.recording.source import Source
from scanmap.recording.video import VIDEO_SUFFIXES, video_source

KINDS = "an .mcap recording, a ROS 2 bag folder, a folder of frames with scan.csv, or a video with a csv of bearings"


def open_source(path: Path | str, params: RecordingParams | None = None, bearings: Path | str | None = None) -> Source:
    """Open whatever can be replayed.

    Args:
        path: an .mcap recording, a ROS 2 bag folder, a folder of frames with scan.csv, or a video.
        params: where a bag that others recorded keeps things.
        bearings: csv of a video's bearings; left out, it is looked for beside the video.

    Raises:
        RecordingError: not found, not readable, empty, or of no known kind.
        ConfigError: a csv that its writer can correct.
    """
    path = Path(path)
    try:
        return _open(path, params or RecordingParams(), Path(bearings) if bearings is not None else None)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror or error}") from error


def _open(path: Path, params: RecordingParams, bearings: Path | None) -> Source:
    if not path.exists():
        raise RecordingError(f"{path} does not exist; scanmap replays {KINDS}")
    if path.is_dir():
        is_bag = (path / "metadata.yaml").exists() or (not (path / "scan.csv").exists() and any(path.glob("*.mcap")))
        return mcap_source(path, params) if is_bag else frames_source(path)
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return video_source(path, bearings)
    return mcap_source(path, params)
