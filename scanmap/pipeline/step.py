"""One shot, and what was made of it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.errors import CameraError
from scanmap.laserline import (
    Laser,
    LaserLine,
    LaserLineParams,
    Moved,
    Reason,
    Rounding,
    Usual,
    by_clean_flanks,
    laser_of,
    look,
    look_at_all,
    needs_colour,
    ridges,
    rounding_of,
)
from scanmap.shot import Decoded, Image, Shot, decode_image, is_grey
from scanmap.triangulation import Profile, TriangulationParams, column_window, triangulate, triangulate_all

F64 = NDArray[np.float64]


class Step(NamedTuple):
    """One shot, and what was made of it."""

    shot: Shot
    line: LaserLine  # (H,)
    profile: Profile  # (H,) head frame
    fault: str = ""  # what was wrong with the image; empty when nothing was
    places: NDArray[np.float32] | None = None  # all that looks like a line, as `Look` has it
    lean: NDArray[np.float32] | None = None  # of the line, as that has it


Sink = Callable[[Step], None]

# Conversions that give a picture of one plane back as it is.
_CHANNELS = ("auto", "red", "green", "blue")


class Pipeline:
    """What turns shots into points; the same object serves every worker, for they change nothing in it.

    The laser is a matter of the scan: `checked` asks the first pictures for it before any is processed.
    """

    def __init__(
        self,
        calibration: Calibration,
        laserline: LaserLineParams,
        triangulation: TriangulationParams,
        slack_px: float = 0.0,
    ) -> None:
        """Make ready; with `slack_px` more columns to either side than range_min and range_max allow.

        A calibration that is to be judged or refined must not hide from view what speaks against it.
        """
        self.calibration = calibration
        self.laserline = laserline
        self.triangulation = triangulation
        self.window: NDArray[np.float64] = column_window(calibration, triangulation)
        self.window += np.array([-slack_px, slack_px])
        self.colour = needs_colour(laserline)  # whether the line is found in colour or a grey decode will do
        self.laser: Laser | None = None  # where a picture has told it beyond doubt

    def process(self, shot: Shot, still: NDArray[np.bool_] | None = None) -> Step:
        """Decode, find the line, triangulate. A bad image gives a Step without points and its fault.

        Args:
            still: where things of the room are known to be, as `laserline.look` takes it.
        """
        try:
            image = self._decode(shot.image, self._grey(shot.image))
        except CameraError as error:
            return self._blind(shot, str(error))
        dark, lacks = self._background(shot)
        found = look(image.image, self.laserline, dark, self.window, still, self.laser, rounding_of(shot.image))
        line, cut = _cut(found.line, image.rows_valid)
        fault = "; ".join(each for each in (cut, lacks) if each)
        return Step(
            shot, line, triangulate(line, self.calibration, self.triangulation), fault, found.places, found.lean
        )

    def process_all(self, shots: Sequence[Shot]) -> list[Step]:
        """What `process` gives for each of the shots, bit for bit, sooner."""
        own = self.calibration.intrinsics
        planes = {self._grey(shot.image) for shot in shots}
        if len(shots) == 1 or len(planes) > 1 or any(shot.background is not None for shot in shots):
            return [self.process(shot) for shot in shots]
        stack = _memory((len(shots), own.height, own.width, 3)[: 3 if planes == {True} else 4])
        rows: list[int] = []  # that are whole, of the pictures that can be read
        roundings: list[Rounding | None] = []
        faults: dict[int, str] = {}
        for k, shot in enumerate(shots):
            own_place = stack[len(rows)]
            try:
                image, whole = self._decode(shot.image, planes == {True}, own_place)
            except CameraError as error:
                faults[k] = str(error)
                continue
            if image is not own_place:
                own_place[:] = image
            rows.append(whole)
            roundings.append(rounding_of(shot.image))
        seen_by = self.laserline, self.window, self.laser, roundings
        looks = look_at_all(stack[: len(rows)], *seen_by) if rows else []
        cuts = [_cut(found.line, whole) for found, whole in zip(looks, rows, strict=True)]
        profiles = triangulate_all([line for line, _ in cuts], self.calibration, self.triangulation) if rows else []
        seen = zip(cuts, profiles, looks, strict=True)
        steps = []
        for k, shot in enumerate(shots):
            if k in faults:
                steps.append(self._blind(shot, faults[k]))
            else:
                (line, fault), profile, found = next(seen)
                steps.append(Step(shot, line, profile, fault, found.places, found.lean))
        return steps

    def ask_laser(self, shot: Shot) -> bool:
        """Let a picture tell of the laser; whether it leaves no doubt, or none is needed."""
        if self.laserline.grey != "auto" or self._grey(shot.image):
            return True
        with suppress(CameraError):
            self.laser = laser_of(self._decode(shot.image, False).image, self.laserline, self._background(shot)[0])
        return self.laser is not None

    def ridges(self, shot: Shot) -> NDArray[np.uint8] | None:
        """What of a shot's image looks like a line, as `laserline.ridges` has it; None where it cannot be read."""
        try:
            image = self._decode(shot.image, self._grey(shot.image)).image
        except CameraError:
            return None
        return ridges(image, self.laserline, self.laser)

    def by_clean_flanks(self, shot: Shot, line: F64, usual: Usual, asked: NDArray[np.bool_]) -> Moved | None:
        """What `laserline.by_clean_flanks` says of a shot's line, arrays (H,); None where it cannot be read."""
        try:
            image = self._decode(shot.image, self._grey(shot.image)).image
        except CameraError:
            return None
        return self._clean_flanks(shot, image, self._background(shot)[0], line, usual, asked)

    def picture(self, shot: Shot) -> Image | None:
        """A shot's picture as the line is found in it; None where it cannot be read whole."""
        try:
            image, whole = self._decode(shot.image, self._grey(shot.image))
        except CameraError:
            return None
        return image if whole == len(image) else None

    def channel_of(self, image: Image) -> int:
        """The channel of a picture in which the line shows; green, where that is open."""
        if image.ndim == 2 or self.laser is None or self.laser.channel < 0:
            return 1
        return self.laser.channel

    def look_without(self, shot: Shot, image: Image, dark: Image) -> Step:
        """What `process` gives with a laser-off frame that matches the shot's picture."""
        seen = self.laserline, dark, self.window, None, self.laser, rounding_of(shot.image), True
        found = look(image, *seen)
        profile = triangulate(found.line, self.calibration, self.triangulation)
        return Step(shot, found.line, profile, "", found.places, found.lean)

    def clean_flanks_without(self, shot: Shot, image: Image, dark: Image, line: F64, usual: Usual) -> Moved:
        """What `by_clean_flanks` gives with a laser-off frame that matches the shot's picture."""
        return self._clean_flanks(shot, image, dark, line, usual, np.isfinite(line), matched=True)

    def _clean_flanks(
        self,
        shot: Shot,
        image: Image,
        dark: Image | None,
        line: F64,
        usual: Usual,
        asked: NDArray[np.bool_],
        matched: bool = False,
    ) -> Moved:
        own = self.laser if self.laserline.grey == "auto" else None
        return by_clean_flanks(image, self.laserline, line, usual, asked, dark, own, rounding_of(shot.image), matched)

    def _grey(self, data: bytes) -> bool:
        """Whether a picture's brightness is all that is asked for, or all there is of its channels."""
        return not self.colour or (self.laserline.grey in _CHANNELS and is_grey(data))

    def _decode(self, data: bytes, grey: bool, into: Image | None = None) -> Decoded:
        decoded = decode_image(data, grey=grey, into=into)
        height, width = decoded.image.shape[:2]
        own = self.calibration.intrinsics
        if (width, height) != (own.width, own.height):
            raise CameraError(f"image is {width}x{height}, the calibration is for {own.width}x{own.height}")
        return decoded

    def _background(self, shot: Shot) -> tuple[Image | None, str]:
        """The laser-off picture, and why there is none: a damaged one is left out, for the line is seen without it."""
        if shot.background is None:
            return None, ""
        try:
            image, whole = self._decode(shot.background, self._grey(shot.image))
        except CameraError as error:
            return None, f"laser-off picture left out: {error}"
        if whole < len(image):
            return None, f"laser-off picture left out: it is cut, {whole} of {len(image)} rows are whole"
        return image, ""

    def _blind(self, shot: Shot, fault: str) -> Step:
        rows = self.calibration.intrinsics.height
        nan = np.full(rows, np.nan)
        line = LaserLine(nan, nan, nan, nan, np.full(rows, Reason.DAMAGED, np.uint8))
        return Step(shot, line, triangulate(line, self.calibration, self.triangulation), fault)


_own = threading.local()


def _memory(shape: tuple[int, ...]) -> Image:
    """This thread's memory for pictures, the same every time: new memory costs as much as a quarter of decoding."""
    size = int(np.prod(shape))
    if getattr(_own, "bytes", None) is None or _own.bytes.size < size:
        _own.bytes = np.empty(size, np.uint8)
    return np.asarray(_own.bytes[:size].reshape(shape))


def _cut(line: LaserLine, whole: int) -> tuple[LaserLine, str]:
    """The line with the rows of a damaged picture given up of which only the first are `whole`, and what to say."""
    rows = len(line.reason)
    if whole >= rows:
        return line, ""
    damaged = np.arange(rows) >= whole
    column, peak, width, sigma = (np.where(damaged, np.nan, values) for values in line[:4])
    cut = LaserLine(column, peak, width, sigma, np.where(damaged, Reason.DAMAGED, line.reason).astype(np.uint8))
    return cut, f"image is cut: {whole} of {rows} rows are whole"
