"""`Scan`: the organised range image, bearing x row. Neighbours are array neighbours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from scanmap.geometry import HeadMount, transform
from scanmap.laserline import Reason
from scanmap.triangulation import Profile

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]


class ScanParams(BaseModel, frozen=True, extra="forbid"):
    """What happens to the range image before it is written; `[scan]` in a rig's TOML."""

    second_look: bool = Field(
        True,
        description="after the sweep, look again where something else was taken for the line, or for one side of it",
    )
    mirrors: bool = Field(True, description="remove points seen in mirrors on walls, where the scan itself proves them")
    filter_outliers: bool = Field(True, description="remove points that no neighbour in the range image supports")
    max_sigma_share: float = Field(
        0.05, gt=0, le=1, description="outliers, too: points whose sigma is more than this share of their range"
    )
    merge_deg: float = Field(0.02, ge=0, description="bearings closer than this are one column [deg]")
    support_px: float = Field(
        0.25, ge=0, le=20, description="neighbours this close in the image are one surface, beside their noise [px]"
    )
    support_sigma: float = Field(4.0, ge=0, le=50, description="noise allowed between neighbours [standard deviations]")
    max_incidence_deg: float = Field(
        87.0, ge=45, lt=90, description="a surface seen more steeply than this is a depth edge [deg]"
    )
    normal_window_deg: float = Field(1.5, gt=0, le=30, description="patch a normal is fitted to [deg of view]")


class Scan:
    """Range image of one station: B bearings x H image rows.

    Filled by `add`, one profile a shot, in the order they come; `merged` sorts by bearing. Arrays are views
    of the filled part: points in the world frame [m], NaN where a cell has no point.
    """

    def __init__(
        self, mount: HeadMount, rows: int, comments: Mapping[str, Any] | None = None, capacity: int = 0
    ) -> None:
        """An empty scan, with room for `capacity` bearings; for more it grows."""
        self.mount = mount
        self.rows = rows
        # What files say about this scan: `source: digital twin`, software version, rig.
        self.comments: dict[str, Any] = dict(comments or {})
        self._count = 0
        self._bearings = np.empty(0)
        self._fields: dict[str, NDArray[Any]] = {
            "points": np.empty((0, rows, 3), np.float32),
            "range_m": np.empty((0, rows), np.float32),
            "sigma_m": np.empty((0, rows), np.float32),
            "intensity": np.empty((0, rows), np.float32),
            "column_px": np.empty((0, rows), np.float32),
            "reason": np.empty((0, rows), np.uint8),
        }
        if capacity:
            self._grow(capacity)

    @classmethod
    def empty(cls, mount: HeadMount, rows: int, bearings: F64, comments: Mapping[str, Any] | None = None) -> Scan:
        """A scan of B `bearings` [rad] without a point: every cell NaN and `Reason.NOT_SCANNED`, to be filled."""
        scan = cls(mount, rows, comments, len(bearings))
        scan._count = len(bearings)
        scan._bearings[:] = bearings
        for name, values in scan._fields.items():
            values[:] = Reason.NOT_SCANNED if name == "reason" else np.nan
        return scan

    def add(self, profile: Profile, bearing: float) -> None:
        """Append one profile (H,) seen at `bearing` [rad]; its points go to the world frame."""
        if len(profile.range_m) != self.rows:
            raise ValueError(f"profile has {len(profile.range_m)} rows, the scan {self.rows}")
        k = self._count
        if k == len(self._bearings):
            self._grow(max(64, 2 * k))
        self._bearings[k] = bearing
        self._fields["points"][k] = transform(self.mount.T_world_head(bearing), profile.points)
        for name in ("range_m", "sigma_m", "intensity", "column_px", "reason"):
            self._fields[name][k] = getattr(profile, name)
        self._count += 1

    def amend(self, k: int, rows: NDArray[np.bool_], profile: Profile) -> None:
        """Replace the cells `rows` (H,) of the k-th bearing by those of another profile seen there."""
        self._fields["points"][k, rows] = transform(self.mount.T_world_head(self.bearings[k]), profile.points[rows])
        for name in ("range_m", "sigma_m", "intensity", "column_px", "reason"):
            self._fields[name][k, rows] = getattr(profile, name)[rows]

    def give_up(self, mask: NDArray[np.bool_], reason: Reason) -> None:
        """Take the points of the cells `mask` (B, H) away, in place, for `reason`."""
        lost = mask & self.valid
        self.reason[lost] = reason
        for name in ("points", "range_m", "sigma_m", "intensity", "column_px"):
            self._view(name)[lost] = np.nan

    def __len__(self) -> int:
        """Number of bearings B."""
        return self._count

    @property
    def bearings(self) -> F64:
        """(B,) [rad] as reported by the stage."""
        return self._bearings[: self._count]

    @property
    def points(self) -> F32:
        """(B, H, 3) world frame [m]."""
        return self._view("points")

    @property
    def range_m(self) -> F32:
        """(B, H) distance from the head's origin [m]."""
        return self._view("range_m")

    @property
    def sigma_m(self) -> F32:
        """(B, H) standard deviation along the camera's ray [m]."""
        return self._view("sigma_m")

    @property
    def intensity(self) -> F32:
        """(B, H) line height above the background [grey levels]."""
        return self._view("intensity")

    @property
    def column_px(self) -> F32:
        """(B, H) image column of the laser line [px]."""
        return self._view("column_px")

    @property
    def reason(self) -> NDArray[np.uint8]:
        """(B, H) Reason: OK, or why the cell has no point."""
        return self._fields["reason"][: self._count]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(B, H) cells that have a point."""
        mask: NDArray[np.bool_] = self.reason == Reason.OK
        return mask

    @property
    def origins(self) -> F64:
        """(B, 3) the head's origin, where the laser stands, in the world frame [m]."""
        x, y, z = self.mount.offset_m
        c, s = np.cos(self.bearings), np.sin(self.bearings)
        return np.stack([c * x - s * y, s * x + c * y, np.full(len(c), z)], axis=-1)

    @classmethod
    def from_arrays(
        cls,
        mount: HeadMount,
        bearings: F64,
        fields: Mapping[str, NDArray[Any]],
        comments: Mapping[str, Any] | None = None,
    ) -> Scan:
        """A scan of whole arrays.

        Args:
            mount: how the head sits on the axis.
            bearings: (B,) [rad].
            fields: `points` (B, H, 3) world frame [m]; `range_m`, `sigma_m`, `intensity`, `column_px` and `reason`
                (B, H), as the properties of the same names describe them.
            comments: what files say about this scan.
        """
        scan = cls(mount, fields["reason"].shape[1], comments)
        scan._count = len(bearings)
        scan._bearings = np.asarray(bearings, np.float64)
        scan._fields = {name: np.asarray(fields[name], own.dtype) for name, own in scan._fields.items()}
        return scan

    def without(self, mask: NDArray[np.bool_], reason: Reason) -> Scan:
        """A copy in which the cells of `mask` (B, H) have no point any more, for `reason`."""
        copy = self.taken(np.arange(self._count))
        copy.give_up(mask, reason)
        return copy

    def taken(self, order: NDArray[np.intp]) -> Scan:
        """A copy with the bearings of index `order` (N,), in that order."""
        fields = {name: values[order] for name, values in self._fields.items()}
        return Scan.from_arrays(self.mount, self._bearings[order], fields, self.comments)

    def merged(self, tolerance_deg: float = 0.02) -> Scan:
        """Sorted by bearing, with bearings closer than the tolerance made one column.

        Passes forward and backward, repeated bearings and a second turn measure the same cell: points that agree
        within their errors (4 sigma, at least 2 mm) are averaged with weights 1 / sigma^2. Where they do not all agree,
        what most say stays; of what equally many say, that with the smaller error in columns of the picture.
        """
        bearings, groups = bearing_columns(self.bearings, float(np.radians(tolerance_deg)))
        fields = self.taken(np.array([group[0] for group in groups], np.intp))._fields
        means = np.array([bearings[group].mean() for group in groups])
        for k, group in enumerate(groups):
            if len(group) > 1:
                for name, values in self._average(group).items():
                    fields[name][k] = values
        return Scan.from_arrays(self.mount, means, fields, self.comments)

    def _average(self, group: NDArray[np.intp]) -> dict[str, NDArray[Any]]:
        """The fields of one column (H, ...) that the columns `group` of this scan measured together."""
        reason = self.reason[group]
        sigma = np.where(reason == Reason.OK, self.sigma_m[group], np.inf).astype(np.float64)
        rows = np.arange(self.rows)
        points = self.points[group].astype(np.float64)

        def agreeing(k: Any) -> NDArray[np.bool_]:
            apart = np.linalg.norm(points - points[k, rows], axis=-1)
            close = apart <= np.maximum(4.0 * np.hypot(sigma, sigma[k, rows]), 2e-3)
            return np.asarray(close & np.isfinite(sigma))

        votes = np.stack([agreeing(k).sum(axis=0) for k in range(len(group))])
        # In columns of the picture: in metres whatever is near is exact, and a false point often is near.
        error = np.where(np.isfinite(sigma), sigma / np.square(self.range_m[group].astype(np.float64)), np.inf)
        best = np.where(votes == votes.max(axis=0), error, np.inf).argmin(axis=0)
        agree = agreeing(best)
        weight = np.where(agree, 1.0 / np.maximum(sigma, 1e-9) ** 2, 0.0)
        total = weight.sum(axis=0)
        with np.errstate(invalid="ignore"):
            share = weight / total  # NaN in rows that no column measured, and so is their mean
        column: dict[str, NDArray[Any]] = {"reason": reason[best, rows]}
        column["points"] = _weighted_mean(points, share[..., None])
        for name in ("range_m", "intensity", "column_px"):
            column[name] = _weighted_mean(self._fields[name][group], share)
        column["sigma_m"] = 1.0 / np.sqrt(np.where(total > 0, total, np.nan))
        return column

    def _view(self, name: str) -> F32:
        values: F32 = self._fields[name][: self._count]
        return values

    def _grow(self, capacity: int) -> None:
        def grown(values: NDArray[Any]) -> NDArray[Any]:
            larger = np.empty((capacity, *values.shape[1:]), values.dtype)
            larger[: self._count] = values[: self._count]
            return larger

        self._bearings = grown(self._bearings)
        self._fields = {name: grown(values) for name, values in self._fields.items()}


def bearing_columns(bearings: F64, tolerance: float) -> tuple[F64, list[NDArray[np.intp]]]:
    """Which bearings are one column of the range image.

    Args:
        bearings: (N,) [rad], in any order, over any number of turns.
        tolerance: [rad].

    Returns:
        The bearings brought into one turn, (N,), and the indices of each column's members, columns ascending.

    No member is farther than the tolerance from the first of its column, so a fine sweep cannot chain into a single
    one; columns whose means come that close are joined, so that a second grouping changes nothing.
    """
    bearings = np.array(bearings, np.float64)
    groups = [np.array([k]) for k in np.argsort(bearings, kind="stable")]
    while groups:
        means = np.array([bearings[group].mean() for group in groups])
        turns = np.floor((means - means.min() + tolerance) / (2.0 * np.pi))
        for group, turn in zip(groups, turns, strict=True):
            bearings[group] -= 2.0 * np.pi * turn
        means = means - 2.0 * np.pi * turns
        joined: list[list[NDArray[np.intp]]] = []
        start = -np.inf
        for k in np.argsort(means, kind="stable"):
            if means[k] - start > tolerance:
                joined.append([])
                start = means[k]
            joined[-1].append(groups[k])
        settled = len(joined) == len(groups) and not turns.any()
        groups = [np.concatenate(parts) for parts in joined]
        if settled:
            break
    return bearings, groups


def _weighted_mean(values: NDArray[Any], share: F64) -> F64:
    mean: F64 = np.where(share == 0, 0.0, values * share).sum(axis=0)
    return mean
