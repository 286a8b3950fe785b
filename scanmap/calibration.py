"""`Calibration`: the one file that describes a head, and its TOML. No solver lives here."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError, model_validator

from scanmap.errors import CalibrationError
from scanmap.geometry import HeadMount, inverse, is_rotation, rigid, rotation_z

Array = NDArray[np.float64]

# Camera axes (x right, y down, z forward) seen in the head frame of a camera that looks along head x.
R_HEAD_CAMERA_FORWARD: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole with Brown-Conrady distortion, OpenCV's convention, pixels; pixel centres at integers."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)  # k1 k2 p1 p2 k3

    @cached_property
    def matrix(self) -> Array:
        """(3, 3) camera matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def distorted(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return any(self.distortion)

    def rays(self, column: Array, row: Array) -> Array:
        """Directions (..., 3) with z = 1 in the camera frame of pixels `column`, `row` (...,); NaN passes."""
        if not self.distorted:
            x = (column - self.cx) / self.fx
            y = (row - self.cy) / self.fy
            return np.stack([x, y, np.ones_like(x)], axis=-1)
        shape = np.shape(column)
        known = np.isfinite(column).ravel()
        xy = np.full((known.size, 2), np.nan)
        if known.any():
            pixels = np.stack([column.ravel()[known], row.ravel()[known]], axis=-1)
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-9)
            xy[known] = cv2.undistortPoints(
                pixels[:, None], self.matrix, np.array(self.distortion), None, None, None, criteria
            )[:, 0]
        return np.concatenate([xy, np.ones((known.size, 1))], axis=1).reshape(*shape, 3)

    def project(self, points_cam: Array) -> Array:
        """Pixels (..., 2) column, row of points (..., 3) [m] in the camera frame; NaN behind the camera."""
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.where(points_cam[..., 2] > 0, points_cam[..., 2], np.nan)
            x, y = points_cam[..., 0] / z, points_cam[..., 1] / z
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.stack([self.fx * xd + self.cx, self.fy * yd + self.cy], axis=-1)


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
        angle = replace(self.pixel_angle, rpc_deg=self.pixel_angle.rpc_deg / sx) if self.pixel_angle else None
        return replace(self, intrinsics=intrinsics, ratio=ratio, pixel_angle=angle)

    def check_image(self, width: int, height: int) -> None:
        """Raise CalibrationError unless images of this size belong to this calibration."""
        own = self.intrinsics
        if (width, height) != (own.width, own.height):
            raise CalibrationError(
                f"image is {width}x{height}, the calibration is for {own.width}x{own.height}; "
                f"set the camera to {own.width}x{own.height} or give the calibration of these images "
                "with --calibration"
            )

    @classmethod
    def load(cls, path: Path | str) -> Calibration:
        """Read a calibration.toml.

        Raises:
            CalibrationError: missing, not TOML, or a field is missing or wrong; every fault is named.
        """
        try:
            text = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise CalibrationError(f"calibration {path} cannot be read: {error}") from error
        return cls.loads(text, source=str(path))

    @classmethod
    def loads(cls, text: str, source: str = "calibration") -> Calibration:
        """Parse the TOML text of a calibration; `source` names it in errors."""
        try:
            return CalibrationFile.model_validate(tomllib.loads(text)).build()
        except tomllib.TOMLDecodeError as error:
            raise CalibrationError(f"{source} is not valid TOML: {error}") from error
        except ValidationError as error:
            faults = "; ".join(
                f"{'.'.join(str(p) for p in fault['loc']) or 'file'}: {fault['msg']}" for fault in error.errors()
            )
            raise CalibrationError(f"{source}: {faults}") from error

    def dumps(self) -> str:
        """The calibration as TOML text; `loads` gives it back bit for bit."""
        import tomli_w

        own = self.intrinsics
        document: dict[str, Any] = {
            "image": {"width": own.width, "height": own.height},
            "intrinsics": {
                "fx": own.fx, "fy": own.fy, "cx": own.cx, "cy": own.cy, "distortion": list(own.distortion),
            },
            "head": {
                "T_head_camera": self.T_head_camera.tolist(),
                "laser_plane": self.laser_plane.tolist(),
            },
            "axis": {
                "head_offset_m": list(self.mount.offset_m),
                "tilt_deg": list(self.mount.tilt_deg),
            },
        }  # fmt: skip
        if self.ratio:
            document["ratio"] = {
                "alpha_deg": self.ratio.alpha_deg, "beta_deg": self.ratio.beta_deg,
                "baseline_m": self.ratio.baseline_m, "width": self.ratio.width,
            }  # fmt: skip
        if self.pixel_angle:
            document["pixel_angle"] = {
                "rpc_deg": self.pixel_angle.rpc_deg, "ro_deg": self.pixel_angle.ro_deg,
                "baseline_m": self.pixel_angle.baseline_m,
            }  # fmt: skip
        for name in ("residuals", "covariance", "meta"):
            if getattr(self, name):
                document[name] = getattr(self, name)
        return tomli_w.dumps(document)

    def save(self, path: Path | str) -> None:
        """Write the calibration as TOML."""
        try:
            Path(path).write_text(self.dumps(), encoding="utf-8")
        except OSError as error:
            raise CalibrationError(f"calibration {path} cannot be written: {error}") from error


class ImageTable(BaseModel, frozen=True, extra="forbid"):
    """`[image]`: the size the calibration holds for."""

    width: int = Field(gt=0, le=20000, description="image width [px]")
    height: int = Field(gt=0, le=20000, description="image height [px]")


class IntrinsicsTable(BaseModel, frozen=True, extra="forbid"):
    """`[intrinsics]`: pinhole and distortion, OpenCV's convention."""

    fx: float = Field(gt=0, description="focal length in columns [px]")
    fy: float = Field(gt=0, description="focal length in rows [px]")
    cx: float = Field(description="principal point, column [px]")
    cy: float = Field(description="principal point, row [px]")
    distortion: tuple[float, ...] = Field((0.0,) * 5, max_length=5, description="k1 k2 p1 p2 k3")


class HeadTable(BaseModel, frozen=True, extra="forbid"):
    """`[head]`: where the camera and the laser plane are; either the full form or the short one."""

    T_head_camera: tuple[tuple[float, float, float, float], ...] | None = Field(
        None, min_length=4, max_length=4, description="camera frame to head frame, 4x4"
    )
    laser_plane: tuple[float, float, float, float] = Field(
        (0.0, 1.0, 0.0, 0.0), description="n.x + d = 0 in the head frame [m]"
    )
    baseline_m: float | None = Field(None, gt=0, description="short form: camera left of the laser by [m]")
    beta_deg: float | None = Field(None, gt=-80, lt=80, description="short form: inward yaw [deg]")
    alpha_deg: float | None = Field(None, gt=1, lt=85, description="short form: half horizontal view [deg]")


class AxisTable(BaseModel, frozen=True, extra="forbid"):
    """`[axis]`: how the head sits on the axis."""

    head_offset_m: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="head origin from the axis [m]")
    tilt_deg: tuple[float, float] = Field((0.0, 0.0), description="axis against head z, about x and y [deg]")


class RatioTable(BaseModel, frozen=True, extra="forbid"):
    """`[ratio]`: Algorithm 1 of the thesis."""

    alpha_deg: float = Field(gt=0, lt=85, description="half horizontal view [deg]")
    beta_deg: float = Field(gt=-80, lt=80, description="inward yaw [deg]")
    baseline_m: float = Field(gt=0, description="camera to laser [m]")
    width: int | None = Field(None, gt=0, description="image width l [px]; the [image] width if left out")


class PixelAngleTable(BaseModel, frozen=True, extra="forbid"):
    """`[pixel_angle]`: Algorithm 2 of the thesis."""

    rpc_deg: float = Field(description="angle per column [deg/px]")
    ro_deg: float = Field(description="angle at column 0 [deg]")
    baseline_m: float = Field(gt=0, description="camera to laser [m]")


class CalibrationFile(BaseModel, frozen=True, extra="forbid"):
    """The form of calibration.toml; `build` gives the `Calibration`.

    With the short form (`baseline_m`, `beta_deg`, `alpha_deg` in `[head]`) the camera stands left of the
    laser at (0, baseline, 0), yawed inward by beta, and `[intrinsics]` may be left out.
    """

    image: ImageTable
    intrinsics: IntrinsicsTable | None = None
    head: HeadTable
    axis: AxisTable = AxisTable()
    ratio: RatioTable | None = None
    pixel_angle: PixelAngleTable | None = None
    residuals: dict[str, Any] = Field(default_factory=dict)
    covariance: dict[str, Any] = Field(default_factory=dict)
    meta: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _complete(self) -> CalibrationFile:
        head = self.head
        if head.T_head_camera is None and (head.baseline_m is None or head.beta_deg is None):
            raise ValueError("[head] needs T_head_camera, or baseline_m and beta_deg")
        if head.T_head_camera is not None and (head.baseline_m is not None or head.beta_deg is not None):
            raise ValueError("[head] has both T_head_camera and the short form; keep one")
        if self.intrinsics is None and head.alpha_deg is None:
            raise ValueError("needs [intrinsics], or alpha_deg in [head]")
        if self.intrinsics is not None and head.alpha_deg is not None:
            raise ValueError("has both [intrinsics] and alpha_deg; keep one")
        if head.T_head_camera is not None:
            T = np.array(head.T_head_camera)
            if not is_rotation(T[:3, :3]) or not np.allclose(T[3], [0, 0, 0, 1]):
                raise ValueError("head.T_head_camera is not a rigid transform (rotation, last row 0 0 0 1)")
        if np.linalg.norm(head.laser_plane[:3]) < 1e-9:
            raise ValueError("head.laser_plane has no normal: its first three numbers are zero")
        numbers = np.concatenate([np.ravel(head.T_head_camera or [0.0]), head.laser_plane, self.axis.head_offset_m])
        if not np.isfinite(numbers).all():
            raise ValueError("[head] or [axis] holds a number that is not finite")
        return self

    def build(self) -> Calibration:
        """The `Calibration` this file describes."""
        plane = np.array(self.head.laser_plane)
        norm = np.linalg.norm(plane[:3])
        return Calibration(
            intrinsics=self._intrinsics(),
            T_head_camera=self._T_head_camera(),
            # A plane that is normalised already stays as it is: dumps and loads agree to the last bit.
            laser_plane=plane if abs(norm - 1.0) < 1e-12 else plane / norm,
            mount=HeadMount(self.axis.head_offset_m, self.axis.tilt_deg),
            ratio=self._ratio(),
            pixel_angle=PixelAngleModel(**self.pixel_angle.model_dump()) if self.pixel_angle else None,
            residuals=self.residuals,
            covariance=self.covariance,
            meta=self.meta,
        )

    def _intrinsics(self) -> Intrinsics:
        width, height = self.image.width, self.image.height
        if self.intrinsics is None:
            f = width / (2.0 * np.tan(np.radians(self.head.alpha_deg or 0.0)))
            return Intrinsics(width, height, float(f), float(f), (width - 1) / 2, (height - 1) / 2)
        own = self.intrinsics
        k = (*own.distortion, *(0.0,) * 5)[:5]
        return Intrinsics(width, height, own.fx, own.fy, own.cx, own.cy, (k[0], k[1], k[2], k[3], k[4]))

    def _T_head_camera(self) -> Array:
        if self.head.T_head_camera is not None:
            return np.array(self.head.T_head_camera)
        beta, baseline = self.head.beta_deg or 0.0, self.head.baseline_m or 0.0
        return rigid(rotation_z(-np.radians(beta)) @ R_HEAD_CAMERA_FORWARD, [0.0, baseline, 0.0])

    def _ratio(self) -> RatioModel | None:
        if self.ratio is None:
            return None
        width = self.ratio.width or self.image.width
        return RatioModel(self.ratio.alpha_deg, self.ratio.beta_deg, self.ratio.baseline_m, width)


def T_camera_head(calibration: Calibration) -> Array:
    """(4, 4) head frame to camera frame."""
    return inverse(calibration.T_head_camera)
