"""What the line is looked for in: the plane as the camera saw it, what of it the laser lit, and the noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline.candidates import BLOCK, is_large, noise_of, noises_of
from scanmap.laserline.channel import SATURATED, judged_channel
from scanmap.laserline.colour import without_colour
from scanmap.laserline.difference import without_background
from scanmap.laserline.grey import CHANNEL, NEIGHBOUR, Grey, extract, to_grey
from scanmap.laserline.pictures import check_width
from scanmap.laserline.rounding import Mixture, Rounding, best_mixture

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]

# Of a channel, of its neighbour and of their difference [grey levels], at the frequencies of a line.
Noises = tuple[float, float, float]

ONE_FOR_ALL = -1  # the channel of a colour picture without colour

# Noise of the difference of two channels over that of one, from which on they are independent; below, in grey levels,
# no difference is measured.
_INDEPENDENT, _NONE = 1.2, 0.3
# Share of a channel (blue, green, red) in what it and its neighbour have of brightness (BT.601's weights).
BRIGHTNESS = (0.16, 0.66, 0.34)
_NOISE_ROWS = 150  # of a laser-off frame that says little in places, that tell noise
_BAND_PX = 3  # columns in a group that is compared with the next
# How far the mixture goes from there to the laser's own channel where the file does not say what was rounded, at the
# least, and for each grey level of noise: more averages noise, less the errors that all rows of an upright line share.
_COLOUR, _COLOUR_PER_NOISE = 0.1, 0.3


class Laser(NamedTuple):
    """What a picture tells of the laser in all pictures of a scan."""

    channel: int  # it shows in
    noise: Noises  # that its line is seen in


class Conversion(NamedTuple):
    """How a colour picture becomes one plane; see `to_grey` and `without_background`."""

    grey: Grey
    bit_index: int
    off_threshold: float


class Sight(NamedTuple):
    """P pictures of one view, one below the other, seen in the laser's light."""

    height: int  # H, rows of a picture
    on: U8  # (P H, W) the pictures' plane; a view where one of their channels will do
    off: U8 | None  # (H, W) the laser-off frame's, of a single picture
    even: U8 | None  # (H, W) that without its noise, at the laser-on one's exposure
    plane: U8  # (P H, W) the brighter of both
    lit: U8  # (P H, W) what the laser added, lifted by PEDESTAL, with a laser-off frame; else the plane
    rows: U8  # (P ceil(B / 2), W) of lit: one row of every other block, contiguous
    image: U8 | None  # (P H, W, 3) where colour tells the laser from other things
    image_rows: U8 | None  # (P ceil(B / 2), W, 3) of image
    channel: int  # of the image; -1 without one
    noise: F64  # (P,) of a sample of lit [grey levels]
    mixtures: Sequence[Mixture]  # (P,) of the image's channels that the line is placed in
    roundings: Sequence[Rounding | None]  # (P,) of the files that the pictures were
    gain: float = 1.0  # that the laser-off frame's exposure is matched by
    # (H, W) what the laser added in the neighbouring channel, where that knows more of the place
    beside: U8 | None = None
    on_beside: U8 | None = None  # (H, W) that channel as the camera saw it

    @property
    def large(self) -> bool:
        """Whether most of a picture need never be looked at."""
        return is_large(self.lit[: self.height])

    def pictures(self) -> Iterator[Sight]:
        """Each picture by itself."""
        return map(self.picture, range(len(self.noise)))

    def picture(self, k: int) -> Sight:
        """The k-th picture by itself."""
        own, one = slice(k * self.height, (k + 1) * self.height), slice(k, k + 1)
        on, plane, lit, image = (None if v is None else v[own] for v in (self.on, self.plane, self.lit, self.image))
        assert on is not None and plane is not None and lit is not None
        return self._replace(
            on=on,
            plane=plane,
            lit=lit,
            image=image,
            noise=self.noise[one],
            mixtures=self.mixtures[one],
            roundings=self.roundings[one],
        )


def sight_of(
    image: U8,
    background: U8 | None,
    how: Conversion,
    height: int,
    channel: int | None,
    roundings: Sequence[Rounding | None],
    noises: Noises | None = None,
    matched: bool = False,
) -> Sight:
    """Look at pictures.

    Args:
        image: grey (P H, W) or BGR (P H, W, 3), pictures of `height` rows one below the other.
        background: the laser-off frame of the same view, moved onto a single picture; or None.
        how: colour becomes one plane.
        channel: as `channel_of` has it.
        roundings: (P,) of the files that the pictures were.
        noises: in that channel, where another picture has told them.
        matched: whether the laser-off frame has the pictures' exposure.

    Raises:
        CameraError: the pictures are too narrow for a line.
    """
    check_width(image, height)
    if channel == ONE_FOR_ALL:
        channel, image, background = None, image[..., 1], None if background is None else background[..., 1]
    large = is_large(image[:height])
    if channel is not None and background is None:
        seen = quick_rows(image, height)
        rows = np.asarray(cv2.extractChannel(seen, channel), np.uint8)
        # Most of a large picture is never looked at.
        plane = image[..., channel] if large else extract(image, channel)
        noise = _noises(plane, rows, height)
        each = zip(range(0, len(image), height), noise, roundings, strict=True)
        mixtures = [_mixture(image[k : k + height], channel, own, rounding, noises) for k, own, rounding in each]
        return Sight(height, plane, None, None, plane, plane, rows, image, seen, channel, noise, mixtures, roundings)
    on = plane = lit = to_grey(image, how.grey, how.bit_index, channel)
    off, even, beside, on_beside, gain = None, None, None, None, 1.0
    if background is not None:
        dark = to_grey(background, how.grey, how.bit_index, channel)
        lit, off, even, gain = without_background(on, dark, how.off_threshold, matched)
        plane = np.asarray(cv2.max(on, off), np.uint8)
    rows = np.ascontiguousarray(quick_rows(lit, height))
    noise = _noises(lit, rows, height) if off is None else _noise_where_known(lit, off, rows)
    mixtures = [Mixture(-1 if channel is None else channel)] * len(noise)
    if background is not None and channel is not None:
        mixture = _mixture(image, channel, float(noise[0]), roundings[0], noises)
        if mixture.channel >= 0:
            on_beside, off_beside = (extract(picture, NEIGHBOUR[channel]) for picture in (image, background))
            beside, mixtures = without_background(on_beside, off_beside, matched=matched).lit, [mixture]
    told = noise, mixtures, roundings, gain, beside, on_beside
    return Sight(height, on, off, even, plane, lit, rows, None, None, -1, *told)


def channel_of(image: U8, background: U8 | None, grey: Grey) -> int | None:
    """The channel of a picture (H, W) or (H, W, 3) that the line is looked for in.

    None for a grey picture or a conversion that mixes the channels, ONE_FOR_ALL where the three are one.
    """
    if image.ndim == 2:
        return None
    channel, clear = judged_channel(image, background) if grey == "auto" else (CHANNEL.get(grey), False)
    # A monochrome camera's picture in three equal channels.
    return ONE_FOR_ALL if channel is not None and not clear and without_colour(image) else channel


def quick_rows(image: U8, height: int) -> U8:
    """The second row of every other block of rows (P ceil(B / 2), ...) of pictures of `height` rows; a view if it can.

    A picture's last row stands for one that it lacks.
    """
    if height % (2 * BLOCK) == 0:
        return image[1 :: 2 * BLOCK]
    row = np.minimum(np.arange(1, height + 2 * BLOCK - 1, 2 * BLOCK), height - 1)[: -(-height // (2 * BLOCK))]
    return image[(np.arange(0, len(image), height)[:, None] + row).ravel()]


def _noises(plane: U8, rows: U8, height: int) -> F64:
    """Noise (P,) of a sample of pictures of `height` rows."""
    # What is in the cache already, where it is enough.
    some = rows if is_large(plane[:height]) else plane
    return noises_of(some.reshape(len(plane) // height, -1, plane.shape[1]))


def _noise_where_known(lit: U8, off: U8, rows: U8) -> F64:
    """Noise (1,) of a sample of a difference, where the laser-off frame tells."""
    some = slice(1, None, max(1, len(off) // _NOISE_ROWS))
    known = off[some] < SATURATED
    if known.all():
        return _noises(lit, rows, len(lit))
    steps = cv2.absdiff(lit[some, 1:], lit[some, :-1])[known[:, 1:] & known[:, :-1]]
    return np.array([noise_of(np.asarray(steps, np.uint8))])


def _noise_of(plane: U8) -> float:
    return float(noises_of(plane[None])[0])


def _mixture(image: U8, channel: int, noise: float, rounding: Rounding | None, noises: Noises | None) -> Mixture:
    """What of a picture's channels the line is placed in.

    Cameras and JPEG store colour at half the columns and coarser steps: a channel is brightness, which is sharp, and
    colour, which is smeared. Two channels together hold more of the one and less of the other. Where the file does not
    tell what was rounded, the noise does: independent noises differ by more than each, by the root of two; what is
    stored at fewer columns and coarser steps differs by less the coarser it is.
    """
    if rounding is not None and rounding.colour is not None:
        return best_mixture(rounding, channel, noises or noises_in_band(image, channel))
    rows = np.ascontiguousarray(image[:: max(1, len(image) // 8), ::2])
    own, other = (np.asarray(cv2.extractChannel(rows, c), np.uint8) for c in (channel, NEIGHBOUR[channel]))
    difference = _noise_of(np.asarray(cv2.addWeighted(own, 1.0, other, -1.0, 128.0), np.uint8))
    fine = difference / (_INDEPENDENT * _noise_of(other)) if difference > _NONE else 0.0
    if fine >= 1.0:
        return Mixture(-1)
    colour = fine + (1.0 - fine) * min(_COLOUR + _COLOUR_PER_NOISE * noise, 1.0)
    return Mixture(channel, BRIGHTNESS[channel] + colour * (1.0 - BRIGHTNESS[channel]))


def noises_in_band(image: U8, channel: int) -> Noises:
    """Noise of a channel, its neighbour and their difference, at the frequencies of a line, as a sample's would be.

    Compression takes the noise between one column and the next, which moves no line, and leaves more of that between
    groups of columns, which does.
    """
    check_width(image, len(image))
    rows = np.ascontiguousarray(image[:: max(1, len(image) // 8)])
    means = cv2.resize(rows, (max(rows.shape[1] // _BAND_PX, 1), len(rows)), interpolation=cv2.INTER_AREA)
    own, other = (np.asarray(cv2.extractChannel(means, c), np.uint8) for c in (channel, NEIGHBOUR[channel]))
    difference = np.asarray(cv2.addWeighted(own, 1.0, other, -1.0, 128.0), np.uint8)
    first, second, both = (round(float(np.sqrt(_BAND_PX)) * _noise_of(plane), 1) for plane in (own, other, difference))
    return first, second, both
