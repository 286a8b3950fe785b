"""Pictures to calibrate from: a folder, a video, a recording, or whatever a camera delivers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.errors import CalibrationError, CameraError, ConfigError, RecordingError
from scanmap.laserline import Rounding, rounding_of
from scanmap.recording import open_source
from scanmap.recording.frames import SUFFIXES
from scanmap.recording.video import VIDEO_SUFFIXES, open_video
from scanmap.shot import Image, Shot, decode_image
from scanmap.solvers.board import Board
from scanmap.solvers.coverage import apart, is_new
from scanmap.solvers.detection import Rejected, View, find_board
from scanmap.solvers.other_boards import rows_too_many, seen_instead, wrong_size

Array = NDArray[np.float64]

# Of a video without bearings this many pictures are taken, evenly.
VIDEO_PICTURES = 120
PIXELS_MOST = 100_000_000  # looking for a board in more takes minutes
# [share] by which markers may measure larger or smaller against their squares than they should.
RATIO_MOST = 0.08
# With fewer views than this share of the rejected ones, what the others show is the board.
OTHER_SHARE = 0.25
# [share of the width] a board in somebody's hands may move between two pictures and count as held still.
REST_SHARE = 0.002


class Picture(NamedTuple):
    """One picture, decoded."""

    name: str
    image: Image  # (H, W, 3) BGR
    background: Image | None = None  # the same with the laser off
    bearing: float = float("nan")  # [rad]
    rounding: Rounding | None = None  # of the file that the image was


@dataclass
class Views:
    """What became of the pictures so far."""

    board: Board
    size: tuple[int, int] = (0, 0)  # width, height of the pictures [px]
    views: list[View] = field(default_factory=list)
    rejected: list[Rejected] = field(default_factory=list)
    instead: str = ""  # what the first pictures without the board show in its place
    picture: Picture | None = None  # the newest
    line: Array | None = None  # (N, 2) column, row of the laser line in it [px]
    before: View | None = None  # the board in the picture before it, if it was found there

    def require(self) -> None:
        """Raise CalibrationError where no picture shows the board at all; says what they show."""
        if self.instead and self.views and len(self.views) < OTHER_SHARE * len(self.rejected):
            raise CalibrationError(
                f"{self.board.name} is in {len(self.views)} of {len(self.views) + len(self.rejected)} pictures only: "
                f"{self.instead}"
            )
        fault = wrong_size(self.board, self.views, self.rejected) or rows_too_many(self.board, self.views, self.size)
        if fault:
            raise CalibrationError(fault)
        if self.views:
            self._require_ratio()
            return
        if not self.rejected:
            raise CalibrationError("there is no picture to calibrate from")
        why = self.instead or f"{self.rejected[0].reason}; is --board what you printed?"
        raise CalibrationError(f"{self.board.name} is in none of {len(self.rejected)} pictures: {why}")

    def _require_ratio(self) -> None:
        """Raise CalibrationError where the markers are not as large against the squares as the board's name says."""
        ratios = np.array([view.marker_ratio for view in self.views])
        if self.board.kind != "charuco" or not np.isfinite(ratios).any():
            return
        seen, said = float(np.nanmedian(ratios)), self.board.marker_m / self.board.square_m
        if abs(seen / said - 1.0) > RATIO_MOST:
            raise CalibrationError(
                f"the markers measure {seen:.3f} of a square, --board {self.board.name} says {said:.3f}: one of "
                "its two "
                f"lengths is wrong; measure both on the print"
            )


def read_pictures(path: Path) -> Iterator[Picture | Rejected]:
    """The pictures of a folder, a video or a recording, in order; bearings where it has them.

    Raises:
        ConfigError: there is no such folder or file.
        RecordingError: there is nothing to read in it.
    """
    if not path.exists():
        raise ConfigError(
            f"{path} does not exist; SOURCE is a folder of pictures, a video, a recording (.mcap), or `camera`"
        )
    if path.is_dir() and not (path / "scan.csv").exists() and not any(path.glob("*.mcap")):
        return _of_folder(path)
    csvs = (path.with_suffix(".csv"), path.parent / "scan.csv", path.parent / "bearings.csv")
    if path.suffix.lower() in VIDEO_SUFFIXES and not any(csv.is_file() for csv in csvs):
        return _of_video(path)
    if path.suffix.lower() in SUFFIXES:
        raise RecordingError(f"{path} is one picture; give the folder that holds all of them")
    return pictures_of(open_source(path).shots())


def pictures_of(shots: Iterable[Shot]) -> Iterator[Picture | Rejected]:
    """The pictures of shots; one that is damaged is rejected."""
    for shot in shots:
        name = f"shot {shot.index} at {np.degrees(shot.bearing):.2f} deg"
        try:
            image = _whole(shot.image)
            background = _whole(shot.background) if shot.background is not None else None
        except CameraError as error:
            yield Rejected(name, str(error))
            continue
        if background is not None and background.shape != image.shape:
            background = None
        yield Picture(name, image, background, shot.bearing, rounding_of(shot.image))


def _whole(data: bytes) -> Image:
    decoded = decode_image(data)
    if decoded.rows_valid < len(decoded.image):
        raise CameraError(f"the picture is cut off after {decoded.rows_valid} of {len(decoded.image)} rows")
    return decoded.image


def collect(
    pictures: Iterable[Picture | Rejected],
    board: Board,
    *,
    use: Callable[[Picture, View], Rejected | None] = lambda picture, view: None,
    distinct: bool = False,
    held: bool = False,
    report: Callable[[Views, View | Rejected], bool] = lambda views, last: True,
) -> Views:
    """Find the board in every picture.

    Args:
        use: what else a picture is good for; gives a `Rejected` where it is good for nothing.
        distinct: leave out what shows no more than an earlier view did.
        held: somebody holds the board before a running camera: a view counts once the board has come to rest.
        report: told of every picture; False ends it.
    """
    views = Views(board)
    for picture in pictures:
        views.picture = None if isinstance(picture, Rejected) else picture
        last = picture if isinstance(picture, Rejected) else _judged(picture, views, use, distinct, held)
        if isinstance(last, View):
            views.views.append(last)
        else:
            views.rejected.append(last)
        if not report(views, last):
            break
    return views


def _judged(
    picture: Picture, views: Views, use: Callable[[Picture, View], Rejected | None], distinct: bool, held: bool
) -> View | Rejected:
    height, width = picture.image.shape[:2]
    if height * width > PIXELS_MOST:
        return Rejected(picture.name, f"{width}x{height} is larger than any camera's picture; at most 100 megapixels")
    if views.size == (0, 0):
        views.size = (width, height)
    if views.size != (width, height):
        return Rejected(
            picture.name,
            f"is {width}x{height}, the first {views.size[0]}x{views.size[1]}; leave out what another camera took",
        )
    seen = picture.image if picture.background is None else picture.background
    found = find_board(seen, views.board, picture.name, picture.bearing)
    if isinstance(found, Rejected):
        views.before = None
        if not views.instead and len(views.rejected) < 5:
            views.instead = seen_instead(seen, views.board)
        return found
    moved_px = apart(found, views.before) if held else 0.0
    views.before = found
    if moved_px > REST_SHARE * width:
        return Rejected(picture.name, "hold the board still")
    if distinct and not is_new(found, views.views, width):
        return Rejected(picture.name, "shows the same as an earlier view")
    return use(picture, found) or found


def _of_folder(path: Path) -> Iterator[Picture | Rejected]:
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
    if not files:
        raise RecordingError(f"folder {path} holds no pictures ({', '.join(SUFFIXES)})")
    return _decoded(files)


def _decoded(files: list[Path]) -> Iterator[Picture | Rejected]:
    for file in files:
        try:
            data = file.read_bytes()
            yield Picture(file.name, _whole(data), rounding=rounding_of(data))
        except (CameraError, OSError) as error:
            yield Rejected(file.name, str(error))


def _of_video(path: Path) -> Iterator[Picture]:
    capture = open_video(path)
    count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    every = max(1, count // VIDEO_PICTURES)
    number = 0
    try:
        while capture.grab():
            if number % every == 0:
                ok, pixels = capture.retrieve()
                if ok:
                    yield Picture(f"frame {number}", np.asarray(pixels, np.uint8))
            number += 1
    finally:
        capture.release()
