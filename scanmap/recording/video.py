"""A scan as a video and a csv of bearings."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from scanmap.errors import ConfigError, RecordingError
from scanmap.recording.bearings import Row, frame_number, read_bearings
from scanmap.recording.source import Report, Source, text_beside
from scanmap.shot import Image, Shot, encode_png, image_format

VIDEO_SUFFIXES = (".avi", ".mp4", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg", ".mjpeg", ".mjpg")


def video_source(path: Path, bearings: Path | None = None) -> Source:
    """Open a video; the JPEGs of a motion JPEG stay as they are, all other frames become lossless PNG.

    The csv has the columns `frame,bearing_deg[,time_s]` with frame numbers from 0 (frames it does not name are
    passed over), or only bearings, one a frame. Times default to those of the video.

    Args:
        path: the video.
        bearings: the csv; left out, it is `<video>.csv`, `scan.csv` or `bearings.csv` beside the video.

    Raises:
        RecordingError: no csv found, or a file cannot be read.
        ConfigError: the csv is faulty.
    """
    table = bearings or _beside(path)
    rows = _by_frame(table, read_bearings(table, frame_optional=True))
    _opened(path).release()
    return Source(
        path=path,
        kind="video",
        read=lambda report: _read(path, table, rows, report),
        calibration_toml=text_beside(path.parent / "calibration.toml"),
        count=len(rows),
    )


def _beside(path: Path) -> Path:
    candidates = [path.with_suffix(".csv"), path.parent / "scan.csv", path.parent / "bearings.csv"]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise RecordingError(
        f"video {path} has no csv of bearings: put {candidates[0].name} with the columns frame,bearing_deg beside it"
    )


def _by_frame(table: Path, rows: list[Row]) -> dict[int, Row]:
    by_frame: dict[int, Row] = {}
    for row in rows:
        number = frame_number(row.frame)
        if number is None:
            raise ConfigError(
                f"{table}: line {row.line}: frame {row.frame!r} is no frame number of a video (0, 1, ...)"
            )
        if number in by_frame:
            raise ConfigError(f"{table}: line {row.line}: frame {row.frame} is there twice")
        by_frame[number] = row
    return by_frame


def open_video(path: Path) -> cv2.VideoCapture:
    """A video whose frames come as the sensor read them: a phone's mark that they are turned is not heeded.

    Raises:
        RecordingError: it cannot be opened.
    """
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise RecordingError(f"video {path} cannot be opened: no video, damaged, or a codec that OpenCV lacks")
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def _opened(path: Path) -> cv2.VideoCapture:
    """The video; one that is a row of JPEGs hands out those as they are, any other its decoded frames."""
    capture = open_video(path)
    if int(capture.get(cv2.CAP_PROP_FOURCC)) != cv2.VideoWriter.fourcc(*"MJPG"):
        return capture
    packets = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    if not packets.isOpened():
        return capture
    capture.release()
    return packets


def _read(path: Path, table: Path, rows: dict[int, Row], report: Report) -> Iterator[Shot]:
    capture = _opened(path)
    rate = capture.get(cv2.CAP_PROP_FPS) or 1.0
    last, number, index = max(rows), 0, 0
    try:
        while number <= last and capture.grab():
            row = rows.get(number)
            if row is not None:
                ok, pixels = capture.retrieve()
                if ok:
                    time = number / rate if math.isnan(row.time) else row.time
                    yield Shot(index, row.bearing, row.bearing, time, _encoded(np.asarray(pixels, np.uint8)))
                else:
                    report(f"{path}: frame {number} cannot be decoded and is left out")
                index += 1
            number += 1
    finally:
        capture.release()
    beyond = sum(1 for frame in rows if frame >= number)
    if beyond == len(rows):
        raise RecordingError(f"none of the {len(rows)} frames that {table} names is in {path}, which has {number}")
    if beyond:
        report(f"{path} has {number} frames; {beyond} frames that {table.name} names are not in it")


def _encoded(frame: Image) -> bytes:
    """A JPEG packet (1, N) as it is, a decoded frame as PNG."""
    packet = bytes(frame) if frame.shape[0] == 1 else b""
    return packet if image_format(packet) == "jpeg" else encode_png(frame)
