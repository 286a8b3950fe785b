"""How well a calibration is known: a covariance matrix over named parameters, `[covariance]` of its file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration.head import Calibration
from scanmap.errors import CalibrationError

Array = NDArray[np.float64]

# Every parameter a solver may give a variance for, by its name in the file.
INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")  # [px], the coefficients without unit
PLANE = ("plane_nx", "plane_ny", "plane_nz", "plane_d")  # of laser_plane in the head frame, d in [m]
MOUNT = ("offset_x", "offset_y", "offset_z", "tilt_x", "tilt_y")  # head_offset_m [m], tilt [rad]
NAMES = (*INTRINSICS, *PLANE, *MOUNT)


@dataclass(frozen=True)
class Uncertainty:
    """Covariance of a calibration's parameters; those it does not name count as exact.

    `T_head_camera` is never uncertain: it says where the head's frame is drawn. How the camera truly stands to the
    laser is in the plane, how it stands to the axis in the mount.
    """

    names: tuple[str, ...]  # N of NAMES
    matrix: Array  # (N, N) products of the parameters' units

    def __post_init__(self) -> None:
        fault = _fault(self.names, self.matrix)
        if fault:
            raise CalibrationError(f"[covariance]: {fault}")

    def sigma(self, name: str) -> float:
        """Standard deviation of one parameter in its unit; 0 where it is not named."""
        if name not in self.names:
            return 0.0
        at = self.names.index(name)
        return float(np.sqrt(self.matrix[at, at]))

    def joined(self, names: Sequence[str], own: Array, slope: Array) -> Uncertainty:
        """With parameters that were solved on top of these.

        Args:
            names: M new parameters; any of them that is here already is replaced.
            own: (M, M) covariance they have from their own measurements.
            slope: (M, N) derivative of the new by each of the parameters here.

        Source: first-order propagation, cov(new) = own + S C S', cov(new, old) = S C.
        """
        keep = [k for k, name in enumerate(self.names) if name not in names]
        old = self.matrix
        cross = slope @ old
        corner = own + cross @ slope.T
        matrix = np.block([[old[np.ix_(keep, keep)], cross[:, keep].T], [cross[:, keep], corner]])
        return Uncertainty((*(self.names[k] for k in keep), *names), 0.5 * (matrix + matrix.T))

    def without(self, names: Sequence[str]) -> Uncertainty:
        """Only the parameters that are not among `names`."""
        keep = [k for k, name in enumerate(self.names) if name not in names]
        return Uncertainty(tuple(self.names[k] for k in keep), self.matrix[np.ix_(keep, keep)])

    def table(self) -> dict[str, Any]:
        """As `[covariance]` of a calibration.toml."""
        return {"parameters": list(self.names), "matrix": self.matrix.tolist()}


def uncertainty_of(calibration: Calibration) -> Uncertainty | None:
    """What a calibration says about its own uncertainty; None where it says nothing.

    Raises:
        CalibrationError: `[covariance]` is not of the form of `Uncertainty.table`.
    """
    table = calibration.covariance
    if not table:
        return None
    if set(table) != {"parameters", "matrix"}:
        raise CalibrationError(f"[covariance] has the keys {', '.join(table)}; it needs parameters and matrix")
    try:
        names = tuple(str(name) for name in table["parameters"])
        matrix = np.array(table["matrix"], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"[covariance]: matrix is no matrix of numbers: {error}") from error
    return Uncertainty(names, matrix)


def parameters_of(calibration: Calibration, names: Sequence[str] = NAMES) -> Array:
    """Values (N,) of named parameters, in the units of their covariance."""
    own, mount = calibration.intrinsics, calibration.mount
    values = np.array([
        own.fx, own.fy, own.cx, own.cy, *own.distortion, *calibration.laser_plane, *mount.offset_m,
        *np.radians(mount.tilt_deg),
    ])  # fmt: skip
    return values[[NAMES.index(name) for name in names]]


def moved(calibration: Calibration, names: Sequence[str], by: Array) -> Calibration:
    """The calibration with named parameters changed by `by` (N,); the plane's normal stays a unit vector.

    What a numerical derivative or a random draw from the covariance needs.
    """
    values = dict(zip(NAMES, parameters_of(calibration), strict=True))
    for name, change in zip(names, by, strict=True):
        values[name] += float(change)
    v = {name: float(value) for name, value in values.items()}
    intrinsics = replace(
        calibration.intrinsics, fx=v["fx"], fy=v["fy"], cx=v["cx"], cy=v["cy"],
        distortion=(v["k1"], v["k2"], v["p1"], v["p2"], v["k3"]),
    )  # fmt: skip
    plane = np.array([v[name] for name in PLANE])
    tilt_deg = np.degrees([v["tilt_x"], v["tilt_y"]])
    mount = calibration.mount._replace(
        offset_m=(v["offset_x"], v["offset_y"], v["offset_z"]), tilt_deg=(float(tilt_deg[0]), float(tilt_deg[1]))
    )
    return replace(calibration, intrinsics=intrinsics, laser_plane=plane / np.linalg.norm(plane[:3]), mount=mount)


def _fault(names: tuple[str, ...], matrix: Array) -> str:
    """What is wrong with a covariance, in words; empty if nothing."""
    unknown = [name for name in names if name not in NAMES]
    if unknown:
        return f"{', '.join(unknown)}: no parameter; valid: {', '.join(NAMES)}"
    if len(set(names)) != len(names):
        return "a parameter is named twice"
    if matrix.shape != (len(names), len(names)):
        return f"matrix has the shape {matrix.shape} for {len(names)} parameters"
    if not np.isfinite(matrix).all():
        return "matrix holds values that are not finite"
    scale = np.sqrt(np.clip(np.diag(matrix), 0.0, None))
    scale[scale == 0.0] = 1.0
    correlation = matrix / np.outer(scale, scale)
    if not np.allclose(correlation, correlation.T, atol=1e-6):
        return "matrix is not symmetric"
    # The plane's normal has one number too many, so zero eigenvalues belong here; negative ones do not.
    if len(names) and np.linalg.eigvalsh(0.5 * (correlation + correlation.T)).min() < -1e-6:
        return "matrix is no covariance: it has a negative eigenvalue"
    return ""
