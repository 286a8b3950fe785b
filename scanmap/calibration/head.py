"""`Calibration`: what describes a head, and the constants of the thesis's two models for it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration.camera import Intrinsics
from scanmap.errors import CalibrationError, CalibrationFileError
from scanmap.geometry import HeadMount

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RatioModel:
    """Algorithm 1 of the thesis, the pixel ratio: d = x / ((tan a + tan b) - 2 p tan a)."""

    alpha_deg: float  # half the horizontal field of view
    beta_deg: float  # inward yaw of the camera
    baseline_m: float
    width: int  # [px] image width l


@dataclass(frozen=True)
class PixelAngleModel:
    """Algorithm 2 of the thesis, the pixel angle: theta = rpc ppx + ro, d = x / tan(theta)."""

    rpc_deg: float  # [deg per px]; the thesis gives degrees though it says radians
    ro_deg: float  # [deg]
    baseline_m: float


@dataclass(frozen=True)
class Calibration:
    """A head: camera, laser plane, axis, and what the thesis's two models were fitted to."""

    intrinsics: Intrinsics
    T_head_camera: Array  # (4, 4)
    laser_plane: Array  # (4,) n.x + d = 0 in the head frame, |n| = 1, metres
    mount: HeadMount = field(default_factory=HeadMount)
    ratio: RatioModel | None = None
    pixel_angle: PixelAngleModel | None = None
    residuals: dict[str, Any] = field(default_factory=dict)
    covariance: dict[str, Any] = field(default_factory=dict)
    meta: dict[str, Any] = field(default_factory=dict)

    @property
    def baseline_m(self) -> float:
        """Distance of the camera's centre from the laser plane [m]."""
        return abs(float(self.laser_plane[:3] @ self.T_head_camera[:3, 3] + self.laser_plane[3]))

    @property
    def alpha(self) -> float:
        """Half the horizontal field of view [rad], alpha of the thesis; distortion left aside."""
        return float(np.arctan(0.5 * self.intrinsics.width / self.intrinsics.fx))

    @property
    def beta(self) -> float:
        """Inward yaw of the camera against the laser plane [rad], beta of the thesis."""
        side = np.sign(self.laser_plane[:3] @ self.T_head_camera[:3, 3] + self.laser_plane[3]) or 1.0
        return float(np.arcsin(np.clip(-side * self.laser_plane[:3] @ self.T_head_camera[:3, 2], -1, 1)))

    def scaled_to(self, width: int, height: int) -> Calibration:
        """The same head at another resolution of the same field of view (pixel centres at integers)."""
        old = self.intrinsics
        sx, sy = width / old.width, height / old.height
        intrinsics = replace(
            old, width=width, height=height, fx=old.fx * sx, fy=old.fy * sy,
            cx=(old.cx + 0.5) * sx - 0.5, cy=(old.cy + 0.5) * sy - 0.5,
        )  # fmt: skip
        ratio = replace(self.ratio, width=width) if self.ratio else None
        angle = self.pixel_angle
        if angle is not None:
            # Column u of the old image is (u + 0.5) sx - 0.5 of the new one.
            half = 0.5 * angle.rpc_deg * (1.0 / sx - 1.0)
            angle = replace(angle, rpc_deg=angle.rpc_deg / sx, ro_deg=angle.ro_deg + half)
        return replace(self, intrinsics=intrinsics, ratio=ratio, pixel_angle=angle)

    def rescaled(self, width: int, height: int) -> Calibration:
        """`scaled_to` for a file: refuses another aspect, and carries what is stated in pixels along.

        Raises:
            CalibrationError: another aspect cannot show the same field of view.
        """
        own = self.intrinsics
        if not self._same_aspect(width, height):
            raise CalibrationError(
                f"{width}x{height} has another aspect than the calibration's {own.width}x{own.height}: it cannot show "
                "the same field of view; calibrate the camera at that size"
            )
        scaled = self.scaled_to(width, height)
        by = {"fx": width / own.width, "cx": width / own.width, "fy": height / own.height, "cy": height / own.height}
        covariance = dict(self.covariance)
        if covariance:
            factor = np.array([by.get(name, 1.0) for name in covariance["parameters"]])
            covariance["matrix"] = (np.array(covariance["matrix"]) * np.outer(factor, factor)).tolist()
        residuals = {
            name: value * width / own.width if name.endswith("_px") else value for name, value in self.residuals.items()
        }
        meta = {**self.meta, "scaled_from": f"{own.width}x{own.height}"}
        return replace(scaled, covariance=covariance, residuals=residuals, meta=meta)

    def check_image(self, width: int, height: int) -> None:
        """Raise CalibrationError unless images of this size belong to this calibration."""
        own = self.intrinsics
        if (width, height) == (own.width, own.height):
            return
        if self._same_aspect(width, height):
            last = f", or make it: scanmap calibrate scale F.toml --size {width}x{height} --out G.toml"
        elif (height, width) == (own.width, own.height):
            last = "; these stand on their side, so turn them by 90 deg (a mark in the file that says so is not heeded)"
        else:
            last = ""
        raise CalibrationError(
            f"image is {width}x{height}, the calibration is for {own.width}x{own.height}; set the camera to "
            f"{own.width}x{own.height}, or give the calibration of these images with --calibration{last}"
        )

    def _same_aspect(self, width: int, height: int) -> bool:
        own = self.intrinsics
        return abs(width * own.height - height * own.width) <= 0.5 * max(own.width, own.height)

    @classmethod
    def load(cls, path: Path | str) -> Calibration:
        """Read a calibration.toml.

        Raises:
            CalibrationFileError: missing, not TOML, or a field is missing or wrong; every fault is named.
        """
        try:
            text = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            why = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
            raise CalibrationFileError(f"calibration {path} cannot be read: {why}") from error
        try:
            return cls.loads(text, source=str(path))
        except CalibrationError as error:
            raise CalibrationFileError(str(error)) from error

    @classmethod
    def loads(cls, text: str, source: str = "calibration") -> Calibration:
        """Parse the TOML text of a calibration; `source` names it in errors."""
        from scanmap.calibration.file import parse

        return parse(text, source)

    def dumps(self) -> str:
        """The calibration as TOML text; `loads` gives it back bit for bit."""
        from scanmap.calibration.file import dumps

        return dumps(self)

    def save(self, path: Path | str) -> None:
        """Write the calibration as TOML."""
        try:
            Path(path).write_text(self.dumps(), encoding="utf-8")
        except OSError as error:
            raise CalibrationError(f"calibration {path} cannot be written: {error}") from error
