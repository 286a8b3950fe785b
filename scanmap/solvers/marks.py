"""Printed markers on a turntable, followed around: how its axis leans, and how far aside of the head it passes.

A block's flat faces hardly tell one of the directions in which an axis may lean, but every point of the turntable runs
on a circle about it. Where each corner of a marker lies on the turntable follows from all pictures that show it, for
any axis; the best axis leaves least of the corners (variable projection, Golub and Pereyra 1973). Neither the markers'
size nor their places need to be known, so scale is not told.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.errors import CameraError
from scanmap.geometry import inverse
from scanmap.shot import Image, Shot, decode_image
from scanmap.solvers.freedom import Freedom

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# All that OpenCV knows of one grid of squares is in its largest dictionary.
FAMILIES = (
    "DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_36h11",
)  # fmt: skip
# A family is looked for in so many pictures, this far apart.
LOOKS, LOOK_EVERY = 8, 7
# A marker must be seen so often to be followed, over such an angle [rad], and lie this near where it is expected [px].
OFTEN, ARC, NEAR_PX = 12, np.radians(60.0), 15.0
OUTLIERS = 4.0  # robust deviations
TOLD = ("aside", "tilt_x", "tilt_y")
# No deviation is smaller: two sets of pictures of one turntable agree to this, whatever each states [m, rad, rad].
LEAST = np.array([1e-4, np.radians(0.05), np.radians(0.05)])


class Marks(NamedTuple):
    """N corners of markers as they were seen."""

    corner: Index  # (N,) which; 4 a marker, in order
    bearing: Array  # (N,) [rad]
    pixel: Array  # (N, 2) column, row

    def where(self, keep: NDArray[np.bool_]) -> Marks:
        """Some of them."""
        return Marks(self.corner[keep], self.bearing[keep], self.pixel[keep])


class Followed(NamedTuple):
    """What markers say of a turntable's axis, as changes of a head."""

    change: Array  # (3,) of `TOLD` [m, rad, rad]
    sigma: Array  # (3,) one standard deviation each
    markers: int
    rms_px: float


def marks_in(grey: Image, family: str, *, fine: bool = False) -> dict[int, Array]:
    """Corners (4, 2) of the markers in a picture by their numbers; `fine` places them within a pixel."""
    how = cv2.aruco.DetectorParameters()
    if fine:
        how.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family))
    found: Any = cv2.aruco.ArucoDetector(dictionary, how).detectMarkers(grey)
    corners, numbers = found[0], found[1]
    if numbers is None:
        return {}
    often = Counter(int(n) for n in numbers.ravel())
    return {
        int(n): np.asarray(c, np.float64).reshape(4, 2)
        for n, c in zip(numbers.ravel(), corners, strict=True)
        if often[int(n)] == 1
    }


class MarkSeeker:
    """Looks for markers in the pictures of a scan, one after the other; gives up early where there are none."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, dict[int, Array]]] = []
        self._family = ""
        self._met: dict[str, Counter[int]] = {family: Counter() for family in FAMILIES}
        self._pictures = 0

    def look(self, shot: Shot) -> None:
        """Look at one picture; one that cannot be decoded shows nothing."""
        number, self._pictures = self._pictures, self._pictures + 1
        if not self._family and (number % LOOK_EVERY or number >= LOOKS * LOOK_EVERY):
            return
        try:
            grey = decode_image(shot.image, grey=True).image
        except CameraError:
            return
        if not self._family:
            self._recognise(grey)
        if self._family:
            self._seen.append((shot.bearing, marks_in(grey, self._family, fine=True)))

    def _recognise(self, grey: Image) -> None:
        """A family is known by one marker that is met again."""
        for family, met in self._met.items():
            met.update(marks_in(grey, family).keys())
            if met and max(met.values()) >= 2:
                self._family = family
                return

    def marks(self) -> Marks | None:
        """All corners of the markers that were seen often; None if there are none."""
        often = Counter(number for _, marks in self._seen for number in marks)
        numbers = sorted(number for number, count in often.items() if count >= OFTEN)
        if not numbers:
            return None
        rows = [
            (4 * numbers.index(number) + k, bearing, *corner)
            for bearing, marks in self._seen
            for number, corners in marks.items()
            if number in numbers
            for k, corner in enumerate(corners)
        ]
        corner, bearing, column, row = np.array(rows, np.float64).T
        return Marks(corner.astype(np.intp), bearing, np.stack([column, row], axis=1))


def follow(marks: Marks, calibration: Calibration, free: Freedom) -> Followed | None:
    """The axis about which the markers run on circles; None where none can be followed.

    Args:
        free: what may move in the head; of it `TOLD` is told.
    """
    from scipy.optimize import least_squares

    rays = calibration.intrinsics.rays(*marks.pixel.T)
    marks = _turning(marks.where(np.isfinite(rays[:, 0])), calibration)
    if not len(marks.corner):
        return None
    at = [free.names.index(name) for name in TOLD]

    def left(told: Array) -> Array:
        change = np.zeros(len(free.names))
        change[at] = told
        return _left(marks, free.changed(calibration, change))

    found = least_squares(lambda told: left(told).ravel(), np.zeros(3), x_scale=free.ruler[at], loss="cauchy")
    off = np.hypot(*left(found.x).T)
    marks = marks.where(off <= OUTLIERS * 1.4826 * np.median(off))
    marks = marks.where(np.bincount(marks.corner)[marks.corner] >= OFTEN)
    if len(np.unique(marks.corner)) <= len(TOLD):
        return None
    found = least_squares(lambda told: left(told).ravel(), found.x, x_scale=free.ruler[at])
    off = left(found.x)
    # What the detector does to one corner it does in many pictures: each corner is one voice (Huber's sandwich).
    numbers, voice = np.unique(marks.corner, return_inverse=True)
    if np.linalg.matrix_rank(found.jac) < len(TOLD):
        return None
    jac = found.jac.reshape(-1, 2, 3)
    sums = np.zeros((len(numbers), 3))
    np.add.at(sums, voice, np.einsum("nki,nk->ni", jac, off))
    bread = np.linalg.inv(found.jac.T @ found.jac)
    spread = bread @ (sums.T @ sums) @ bread * len(numbers) / (len(numbers) - 3)
    alone = bread * float(np.mean(off**2))
    sigma = np.sqrt(np.maximum(np.maximum(np.diag(spread), np.diag(alone)), LEAST**2))
    return Followed(found.x, sigma, len(np.unique(marks.corner // 4)), float(np.sqrt(np.mean((off**2).sum(axis=1)))))


def _turning(marks: Marks, calibration: Calibration) -> Marks:
    """Those of markers that are seen over an arc and turn about the axis as it is known: not those on the wall."""
    number = marks.corner // 4
    marks = marks.where(
        np.isin(number, [each for each in np.unique(number) if _arc(marks.bearing[number == each]) > ARC])
    )
    if not len(marks.corner):
        return marks
    off, number = np.hypot(*_left(marks, calibration).T), marks.corner // 4
    near = [each for each in np.unique(number) if float(np.median(off[number == each])) < NEAR_PX]
    return marks.where(np.isin(number, near))


def _arc(bearing: Array) -> float:
    """The smallest part of a turn that holds all bearings (n,) [rad]."""
    seen = np.sort(np.mod(bearing, 2.0 * np.pi))
    return 2.0 * np.pi - float(np.diff(seen, append=seen[0] + 2.0 * np.pi).max())


def _left(marks: Marks, head: Calibration) -> Array:
    """Pixels (N, 2) that are left of the corners under a head, each corner where it fits all its pictures best."""
    T = inverse(head.mount.T_axis_head() @ head.T_head_camera)
    c, s, zero = np.cos(marks.bearing), np.sin(marks.bearing), np.zeros_like(marks.bearing)
    back = np.stack([c, s, zero, -s, c, zero, zero, zero, zero + 1.0], axis=1).reshape(-1, 3, 3)
    M, t = T[:3, :3] @ back, T[:3, 3]
    xy = head.intrinsics.rays(*marks.pixel.T)[:, :2]
    numbers, own = np.unique(marks.corner, return_inverse=True)
    # A point on the ray (x, y, 1) has X - x Z = 0 and Y - y Z = 0; divided by Z that is what the picture shows.
    rows = M[:, :2] - xy[:, :, None] * M[:, 2:]
    rest = xy * t[2] - t[:2]
    depth = np.ones(len(xy))
    for _ in range(2):
        weight = depth[:, None] ** -2
        # What is left of a corner may always stand in one direction, which no inverse survives.
        square, right = np.tile(1e-12 * np.eye(3), (len(numbers), 1, 1)), np.zeros((len(numbers), 3))
        np.add.at(square, own, np.einsum("nki,nkj->nij", rows * weight[..., None], rows))
        np.add.at(right, own, np.einsum("nki,nk->ni", rows * weight[..., None], rest))
        place = np.linalg.solve(square, right[..., None])[..., 0]
        seen = np.einsum("nij,nj->ni", M, place[own]) + t
        depth = seen[:, 2]
    scale = np.array([head.intrinsics.fx, head.intrinsics.fy])
    off: Array = (seen[:, :2] / depth[:, None] - xy) * scale
    return off
