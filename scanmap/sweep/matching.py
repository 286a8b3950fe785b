"""How far two pictures of one head are turned against each other: what the room says of the bearing.

The pictures are compared without the laser line, which turns with the head and says nothing.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.errors import CameraError

WIDTH = 400  # [px] pictures are made at most this wide
LINE_PX = 12  # to either side of a row's brightest pixel, of the reduced picture
BLUR_PX, BROAD_PX = 1.0, 8.0  # noise is finer than what is compared; a laser line narrower than its surroundings
SURE = 6.0  # standard deviations; the highest of 10^5 values of pure noise reaches 5
ALIKE = 0.45  # true pairs of the twin's rooms have 0.55 and more, chance likenesses 0.32 at most
ALIKE_BLUR_PX = 2.0
BETTER = 0.1  # by so much a shift must explain the pictures better than none
SAME_PX, SAME_SIGMA = (
    0.5,
    5.0,
)  # [px of the small pictures], [standard deviations]: two of one place are no farther apart
SMOOTH_PX = 3.0  # noise is finer than what two places differ in
KEPT = 6  # pictures kept small, for each is held against several

F32 = NDArray[np.float32]


class Shift(NamedTuple):
    """How far a picture has moved to the right against another."""

    columns_px: float  # of the picture as it came
    scale: float  # pixels of that picture in one of those compared
    error_px: float  # standard deviation of columns_px, of noise alone
    certainty: float  # height of the correlation's peak above its surroundings [standard deviations]
    likeness: float  # correlation coefficient of what the two pictures have in common then
    likeness_unmoved: float  # the same, had they not moved

    @property
    def is_sure(self) -> bool:
        """Whether the pictures show enough of the same to tell."""
        return self.certainty >= SURE and self.likeness >= ALIKE

    @property
    def slack_px(self) -> float:
        """How far two pictures of one place may seem to be apart."""
        return SAME_PX * self.scale + SAME_SIGMA * self.error_px

    @property
    def is_small(self) -> bool:
        """Whether the pictures can be of one place."""
        return abs(self.columns_px) <= self.slack_px

    @property
    def is_proved(self) -> bool:
        """Whether the pictures cannot be of one place: moved, they are clearly more alike."""
        return not self.is_small and self.likeness - self.likeness_unmoved > BETTER


def shift_between(before: bytes, after: bytes) -> Shift:
    """Shift of encoded picture `after` against `before`, by phase correlation (Kuglin and Hines 1975).

    Raises:
        CameraError: a picture cannot be decoded, or the two have different sizes.
    """
    (first, scale), (second, _) = _structure(before), _structure(after)
    if first.shape != second.shape:
        raise CameraError(f"pictures of {first.shape} and {second.shape} pixels cannot be compared")
    a, b = np.fft.rfft2(first), np.fft.rfft2(second)
    cross = b * np.conj(a)
    size = np.abs(cross)
    # Whitened, but frequencies that hold nothing but noise are not blown up to the others' size.
    surface = np.fft.irfft2(cross / (size + size.mean()), first.shape)
    row, column = np.unravel_index(int(surface.argmax()), surface.shape)
    spread = float(surface.std())
    certainty = float((surface[row, column] - surface.mean()) / spread) if spread > 0 else 0.0
    around = [float(surface[row, (column + k) % surface.shape[1]]) for k in (-1, 0, 1)]
    bend = around[0] - 2.0 * around[1] + around[2]
    place = column + (0.5 * (around[0] - around[2]) / bend if bend < 0 else 0.0)
    wrapped = (place + surface.shape[1] / 2) % surface.shape[1] - surface.shape[1] / 2
    # Noise of this spread moves the top of a parabola by its slope over the parabola's bend.
    error = spread / (math.sqrt(2.0) * -bend) if bend < 0 else math.inf
    likeness, unmoved = (_likeness(first, second, columns) for columns in (round(wrapped), 0))
    return Shift(float(wrapped) * scale, scale, error * scale, certainty, likeness, unmoved)


def _likeness(first: F32, second: F32, columns: int) -> float:
    """Correlation coefficient (-1 to 1) of two structures, the second moved back by whole columns."""
    if columns < 0:
        first, second, columns = second, first, -columns
    width = first.shape[1] - columns
    a, b = (cv2.GaussianBlur(part, (0, 0), ALIKE_BLUR_PX) for part in (first[:, :width], second[:, columns:]))
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / size if size > 0 else 0.0


def difference(before: bytes, after: bytes) -> float:
    """By how much two encoded pictures differ, laser line and all [grey levels, rms]; their noise makes a little.

    Even where a plain or dark room gives nothing to match, two places differ in their shading or in the line.

    Raises:
        CameraError: a picture cannot be decoded, or the two have different sizes.
    """
    first, second = (_small(image)[0] for image in (before, after))
    if first.shape != second.shape:
        raise CameraError(f"pictures of {first.shape} and {second.shape} pixels cannot be compared")
    return _unevenness(first - second)


def line_difference(before: bytes, after: bytes) -> float:
    """By how much two encoded pictures differ in what is sharp: the line, not the light of a room [grey levels, rms].

    Raises:
        CameraError: a picture cannot be decoded, or the two have different sizes.
    """
    first, second = (_small(image)[0] for image in (before, after))
    if first.shape != second.shape:
        raise CameraError(f"pictures of {first.shape} and {second.shape} pixels cannot be compared")
    return _unevenness(_sharp(first) - _sharp(second))


def contrast(image: bytes) -> float:
    """By how much the parts of an encoded picture differ, as `difference` counts [grey levels, rms].

    Raises:
        CameraError: it cannot be decoded.
    """
    return _unevenness(_small(image)[0])


def _unevenness(apart: F32) -> float:
    # Lamps that flicker make some rows darker, all along.
    along = apart - apart.mean(axis=1, keepdims=True)
    return float(cv2.GaussianBlur(along, (0, 0), SMOOTH_PX).std())


def scale_of(width: int) -> float:
    """How many pixels of a picture make one of those that are compared."""
    return max(1.0, width / WIDTH)


@lru_cache(maxsize=KEPT)
def _structure(image: bytes) -> tuple[F32, float]:
    """Edges and textures (h, w) of a picture, small and without the laser line; and how many pixels make one."""
    small, scale = _small(image)
    seen = 1.0 - _line(small).astype(np.float32)
    blurred, weight = (cv2.GaussianBlur(v, (0, 0), BLUR_PX) for v in (small * seen, seen))
    smooth = blurred / np.maximum(weight, 1e-3)
    # Only what changes along the rows tells of a turn: a floor's edge looks the same from every bearing.
    structure = cv2.Sobel(smooth, cv2.CV_32F, 1, 0) * cv2.erode(seen, np.ones((3, 5), np.uint8))
    window = cv2.createHanningWindow(small.shape[::-1], cv2.CV_32F)
    return np.asarray(structure * window, np.float32), scale


def _line(small: F32) -> NDArray[np.bool_]:
    """(h, w) where the brightest thing of each row is: the laser line, or a lamp, which is no loss."""
    columns = np.arange(small.shape[1])
    near: NDArray[np.bool_] = np.abs(columns - _sharp(small).argmax(axis=1)[:, None]) <= LINE_PX
    return near


def _sharp(small: F32) -> F32:
    return np.asarray(small - cv2.GaussianBlur(small, (0, 0), BROAD_PX), np.float32)


@lru_cache(maxsize=KEPT)
def _small(image: bytes) -> tuple[F32, float]:
    """A picture in grey, at most WIDTH wide, and how many of its pixels make one of these."""
    data = np.frombuffer(image, np.uint8)
    try:
        grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        grey = None
    if grey is None:
        raise CameraError(f"picture of {len(image)} bytes cannot be decoded")
    scale = scale_of(grey.shape[1])
    size = (round(grey.shape[1] / scale), round(grey.shape[0] / scale))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.float32), scale
