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

    filter_outliers: bool = Field(True, description="remove points that no neighbour in the range image supports")
    merge_deg: float = Field(0.02, ge=0, description="bearings closer than this are one column [deg]")


class Scan:
    """Range image of one station: B bearings x H image rows.

    Filled by `add`, one profile a shot, in the order they come; `merged` sorts by bearing. Arrays are views
    of the filled part: points in the world frame [m], NaN where a cell has no point.
    """

    def __init__(self, mount: HeadMount, rows: int, comments: Mapping[str, Any] | None = None) -> None:
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
        T = [self.mount.T_world_head(float(b)) for b in self.bearings]
        return np.array([t[:3, 3] for t in T]).reshape(-1, 3)

    def without(self, mask: NDArray[np.bool_], reason: Reason) -> Scan:
        """A copy in which the cells of `mask` (B, H) have no point any more, for `reason`."""
        copy = self.taken(np.arange(self._count))
        lost = mask & copy.valid
        copy._fields["reason"][lost] = reason
        for name in ("points", "range_m", "sigma_m", "intensity", "column_px"):
            copy._fields[name][lost] = np.nan
        return copy

    def taken(self, order: NDArray[np.intp]) -> Scan:
        """A copy with the bearings of index `order` (N,), in that order."""
        copy = Scan(self.mount, self.rows, self.comments)
        copy._count = len(order)
        copy._bearings = self._bearings[order]
        copy._fields = {name: values[order] for name, values in self._fields.items()}
        return copy

    def merged(self, tolerance_deg: float = 0.02) -> Scan:
        """Sorted by bearing, with bearings closer than the tolerance made one column.

        Passes forward and backward, and repeated bearings, measure the same cell: where they agree within
        their errors (4 sigma, at least 2 mm) the points are averaged with weights 1 / sigma^2, where they do
        not the one with the smaller sigma stays.
        """
        scan = self.taken(np.argsort(self.bearings, kind="stable"))
        if len(scan) < 2:
            return scan
        first = np.flatnonzero(np.diff(scan.bearings, prepend=-np.inf) > np.radians(tolerance_deg))
        if len(first) == len(scan):
            return scan
        merged = scan.taken(first)
        for k, (start, stop) in enumerate(zip(first, np.append(first[1:], len(scan)), strict=True)):
            if stop - start > 1:
                merged._set_average(k, scan, slice(start, stop))
        return merged

    def _set_average(self, k: int, source: Scan, group: slice) -> None:
        """Write the average of the columns `group` of `source` into column k."""
        valid = source.valid[group]
        sigma = np.where(valid, source.sigma_m[group], np.inf).astype(np.float64)
        best = sigma.argmin(axis=0)
        rows = np.arange(self.rows)
        points = source.points[group].astype(np.float64)
        apart = np.linalg.norm(points - points[best, rows], axis=-1)
        agree = valid & (apart <= np.maximum(4.0 * np.hypot(sigma, sigma[best, rows]), 2e-3))
        weight = np.where(agree, 1.0 / np.maximum(sigma, 1e-9) ** 2, 0.0)
        total = weight.sum(axis=0)
        some = total > 0
        averaged = {"points": points, "range_m": source.range_m[group], "intensity": source.intensity[group]}
        for name, values in (averaged | {"column_px": source.column_px[group]}).items():
            w, t = (weight[..., None], total[:, None]) if values.ndim == 3 else (weight, total)
            self._fields[name][k, some] = (np.where(w > 0, values, 0.0) * w).sum(axis=0)[some] / t[some]
        self._fields["sigma_m"][k, some] = 1.0 / np.sqrt(total[some])
        self._fields["reason"][k] = source.reason[group][best, rows]
        self._bearings[k] = source.bearings[group].mean()

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
