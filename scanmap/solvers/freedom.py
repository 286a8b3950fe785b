"""What may move in a head: named small changes of laser plane and mount, and which of them flatness can see.

Flat walls stay flat when the whole scan is scaled, turned about the axis or lifted along it. So of the seven ways in
which laser plane and axis can stand to the camera, flatness sees six; the seventh, scale, must be held by a length
that is known: the baseline, or the axis's distance from the head, at the height of what is scanned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.calibration.uncertainty import uncertainty_of
from scanmap.geometry import HeadMount, inverse, rigid, rotation_z

Array = NDArray[np.float64]
Scale = Literal["baseline", "axis"]

STEP = 1e-5  # of a numerical derivative [rad] or [m]

# Changes: the plane turned by yaw and roll about the camera's centre [rad] and moved away from it [m]; the head's
# offset from the axis [m], along x and y or aside, which keeps its length; the axis's tilt [rad].
NAMES = ("yaw", "roll", "distance", "offset_x", "offset_y", "aside", "tilt_x", "tilt_y")
FREE: dict[Scale, tuple[str, ...]] = {
    "baseline": ("yaw", "roll", "offset_x", "offset_y", "tilt_x", "tilt_y"),
    "axis": ("yaw", "roll", "distance", "aside", "tilt_x", "tilt_y"),
}
# How well a head is known before, by ruler and printed parts (one standard deviation); what a scan cannot see stays.
RULER: dict[Scale, dict[str, float]] = {
    "baseline": {
        "yaw": np.radians(1.0), "roll": np.radians(0.3), "offset_x": 0.03, "offset_y": 0.015,
        "tilt_x": np.radians(0.3), "tilt_y": np.radians(0.3),
    },
    # A turntable is no printed part of the head: how it leans is told from pictures, to half a degree.
    "axis": {
        "yaw": np.radians(1.0), "roll": np.radians(1.0), "distance": 0.01, "aside": 0.005,
        "tilt_x": np.radians(0.5), "tilt_y": np.radians(0.5),
    },
}  # fmt: skip


def longer_length(calibration: Calibration) -> Scale:
    """Which of a head's two lengths holds the scale: the longer, for the same ruler measures it better."""
    return "axis" if np.hypot(*calibration.mount.offset_m[:2]) > calibration.baseline_m else "baseline"


def tangents(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors (3,) across a plane's normal: yaw turns it along the first, roll along the second."""
    up = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) < 0.95 else np.array([1.0, 0.0, 0.0])
    first = np.cross(normal, up)
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


class Freedom(NamedTuple):
    """What may move in one head, and how far."""

    names: tuple[str, ...]  # P of `NAMES`
    ruler: Array  # (P,) one standard deviation of each before
    pivot_m: float | None  # height of the axis' point about which it tilts; the head's origin if None
    centre: Array  # (P,) where each is expected
    sigma: Array  # (P,) one standard deviation about there; the ruler's where nothing else tells

    @classmethod
    def of(cls, calibration: Calibration, scale: Scale, height_m: float) -> Freedom:
        """All that flatness can see beside `scale`, which holds at the height of what is scanned.

        A turntable's axis may be known better than by ruler: `calibrate axis` says how well.
        """
        ruler = dict(RULER[scale])
        known = uncertainty_of(calibration)
        if scale == "axis" and known is not None:
            for name, said in (("aside", "offset_y"), ("tilt_x", "tilt_x"), ("tilt_y", "tilt_y")):
                ruler[name] = min(ruler[name], known.sigma(said) or ruler[name])
        names = FREE[scale]
        by_ruler = np.array([ruler[name] for name in names])
        return cls(names, by_ruler, height_m if scale == "axis" else None, np.zeros(len(names)), by_ruler)

    def told(self, names: Sequence[str], change: Array, sigma: Array) -> Freedom:
        """The same where something else tells some of the changes, with deviations."""
        at = [self.names.index(name) for name in names]
        centre, own = self.centre.copy(), self.sigma.copy()
        centre[at], own[at] = change, np.minimum(own[at], sigma)
        return self._replace(centre=centre, sigma=own)

    def changed(self, calibration: Calibration, change: Array) -> Calibration:
        """The head with a change (P,) in it."""
        return changed(calibration, self.names, change, self.pivot_m)

    def slope(self, calibration: Calibration) -> Array:
        """Derivative (8, P) of laser plane, offset x and y [m], tilt x and y [rad] by the changes."""

        def numbers(change: Array) -> Array:
            head = self.changed(calibration, change)
            return np.concatenate([head.laser_plane, head.mount.offset_m[:2], np.radians(head.mount.tilt_deg)])

        steps = STEP * np.eye(len(self.names))
        return np.stack([(numbers(step) - numbers(-step)) / (2.0 * STEP) for step in steps], axis=1)


def changed(calibration: Calibration, names: Sequence[str], values: Array, pivot_m: float | None = None) -> Calibration:
    """The head with some of `NAMES` changed; its camera stays where it is, laser plane and mount move.

    Args:
        pivot_m: height in the world of that point of the axis about which it tilts; the head's origin if left out.
    """
    change = dict.fromkeys(NAMES, 0.0) | dict(zip(names, map(float, values), strict=True))
    normal, centre = calibration.laser_plane[:3], calibration.T_head_camera[:3, 3]
    away = normal @ centre + calibration.laser_plane[3] + change["distance"]
    first, second = tangents(normal)
    turned = normal + change["yaw"] * first + change["roll"] * second
    turned /= np.linalg.norm(turned)
    mount = _moved(calibration.mount, change, pivot_m)
    return replace(calibration, laser_plane=np.append(turned, away - turned @ centre), mount=mount)


def _moved(mount: HeadMount, change: dict[str, float], pivot_m: float | None) -> HeadMount:
    """The mount with offset and tilt changed."""
    offset = np.array(mount.offset_m)
    tilt_x, tilt_y = (
        mount.tilt_deg[k] + float(np.degrees(change[name])) for k, name in enumerate(("tilt_x", "tilt_y"))
    )
    if pivot_m is not None:
        arm = offset - [0.0, 0.0, pivot_m]
        before, after = (m.T_axis_head()[:3, :3] for m in (mount, HeadMount(mount.offset_m, (tilt_x, tilt_y))))
        offset = offset + after @ before.T @ arm - arm
    offset[:2] += change["offset_x"], change["offset_y"]
    if change["aside"]:
        offset[:2] += change["aside"] * np.array([-offset[1], offset[0]]) / np.hypot(*offset[:2])
    return HeadMount((float(offset[0]), float(offset[1]), float(offset[2])), (tilt_x, tilt_y))


def redrawn(calibration: Calibration, laser_plane: Array) -> Calibration:
    """The same head with its frame drawn so that its laser plane is `laser_plane`: the camera turns instead.

    The plane must be as far from the camera as its own. World heights and directions that nothing can observe (along
    the axis and about it) stay as they are.
    """
    centre = calibration.T_head_camera[:3, 3]
    T_new_old = _turn_about(centre, calibration.laser_plane[:3], laser_plane[:3])
    T_axis_new = calibration.mount.T_axis_head() @ inverse(T_new_old)
    R = T_axis_new[:3, :3]
    tilt_x, tilt_y = np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(np.clip(R[2, 0], -1.0, 1.0))
    # What is left is a turn about the axis: bearing zero, which no scan knows.
    x, y, _ = rotation_z(-float(np.arctan2(R[1, 0], R[0, 0]))) @ T_axis_new[:3, 3]
    mount = HeadMount(
        (float(x), float(y), calibration.mount.offset_m[2]), (float(np.degrees(tilt_x)), float(np.degrees(tilt_y)))
    )
    return replace(
        calibration, T_head_camera=T_new_old @ calibration.T_head_camera, laser_plane=laser_plane.copy(), mount=mount
    )


def _turn_about(centre: Array, source: Array, target: Array) -> Array:
    """(4, 4) smallest turn about a point that brings one unit vector onto another (Rodrigues)."""
    axis, cosine = np.cross(source, target), float(source @ target)
    K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    R = np.eye(3) + K + K @ K / (1.0 + cosine)
    return rigid(R, centre - R @ centre)
