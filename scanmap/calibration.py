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
from pydantic import BaseModel, Field, FiniteFloat, ValidationError, field_validator, model_validator

from scanmap.errors import CalibrationError
from scanmap.geometry import HeadMount, is_rotation, rigid, rotation_z

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
        """Directions (..., 3) with z = 1 in the camera frame of pixels `column`, `row` (...,); NaN passes.

        NaN too where no ray comes out at the pixel: a polynomial that folds over inside the image.
        """
        if not self.distorted:
            x = (column - self.cx) / self.fx
            y = (row - self.cy) / self.fy
            return np.stack([x, y, np.ones_like(x)], axis=-1)
        shape = np.shape(column)
        known = np.isfinite(column).ravel()
        xy = np.full((known.size, 2), np.nan)
        if known.any():
            pixels = np.stack([column.ravel()[known], row.ravel()[known]], axis=-1)
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
            found = cv2.undistortPoints(
                pixels[:, None], self.matrix, np.array(self.distortion), None, None, None, criteria
            )[:, 0]
            back = self.project(np.concatenate([found, np.ones((len(found), 1))], axis=1))
            found[~(np.abs(back - pixels).max(axis=1) < 1e-3)] = np.nan
            xy[known] = found
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
        angle = self.pixel_angle
        if angle is not None:
            # Column u of the old image is (u + 0.5) sx - 0.5 of the new one.
            half = 0.5 * angle.rpc_deg * (1.0 / sx - 1.0)
            angle = replace(angle, rpc_deg=angle.rpc_deg / sx, ro_deg=angle.ro_deg + half)
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
            # Strictly, so that text is never taken for a number; a TOML array is a tuple here.
            return CalibrationFile.model_validate(_with_tuples(tomllib.loads(text)), strict=True).build()
        except tomllib.TOMLDecodeError as error:
            raise CalibrationError(f"{source} is not valid TOML: {error}") from error
        except ValidationError as error:
            raise CalibrationError(f"{source}: {'; '.join(_faults(error))}") from error

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
        return tomli_w.dumps(_plain(document))

    def save(self, path: Path | str) -> None:
        """Write the calibration as TOML."""
        try:
            Path(path).write_text(self.dumps(), encoding="utf-8")
        except OSError as error:
            raise CalibrationError(f"calibration {path} cannot be written: {error}") from error


def _with_tuples(document: dict[str, Any]) -> dict[str, Any]:
    """The tables with fixed keys with their arrays as tuples; what the solvers wrote stays as it is."""

    def tupled(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: tupled(below) for key, below in value.items()}
        return tuple(tupled(below) for below in value) if isinstance(value, list) else value

    free = ("residuals", "covariance", "meta")
    return {name: value if name in free else tupled(value) for name, value in document.items()}


def _plain(value: Any) -> Any:
    """Arrays and numpy's numbers, which the solvers compute with, as what TOML knows."""
    if isinstance(value, dict):
        return {str(key): _plain(below) for key, below in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(below) for below in value]
    return _plain(value.tolist()) if isinstance(value, np.ndarray | np.generic) else value


def _faults(error: ValidationError) -> list[str]:
    """Every fault in words: path, the bad value, what is allowed."""
    faults = []
    for detail in error.errors():
        where = ".".join(str(part) for part in detail["loc"]) or "file"
        message = detail["msg"].removeprefix("Value error, ")
        if detail["type"] == "extra_forbidden":
            table: Any = CalibrationFile
            for part in detail["loc"][:-1]:
                table = _TABLES[str(part)]
            message = f"no key of a calibration; valid: {', '.join(table.model_fields)}"
        elif isinstance(detail["input"], int | float | str):
            where = f"{where} = {detail['input']!r}"
        faults.append(f"{where}: {message}")
    return faults


class ImageTable(BaseModel, frozen=True, extra="forbid"):
    """`[image]`: the size the calibration holds for."""

    width: int = Field(gt=0, le=20000, description="image width [px]")
    height: int = Field(gt=0, le=20000, description="image height [px]")


class IntrinsicsTable(BaseModel, frozen=True, extra="forbid"):
    """`[intrinsics]`: pinhole and distortion, OpenCV's convention."""

    fx: FiniteFloat = Field(gt=0, description="focal length in columns [px]")
    fy: FiniteFloat = Field(gt=0, description="focal length in rows [px]")
    cx: FiniteFloat = Field(description="principal point, column [px]")
    cy: FiniteFloat = Field(description="principal point, row [px]")
    distortion: tuple[FiniteFloat, ...] = Field((0.0,) * 5, max_length=5, description="k1 k2 p1 p2 k3")


class HeadTable(BaseModel, frozen=True, extra="forbid"):
    """`[head]`: where the camera and the laser plane are; either the full form or the short one."""

    T_head_camera: tuple[tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat], ...] | None = Field(
        None, min_length=4, max_length=4, description="camera frame to head frame, 4x4"
    )
    laser_plane: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat] = Field(
        (0.0, 1.0, 0.0, 0.0), description="n.x + d = 0 in the head frame [m]"
    )
    baseline_m: FiniteFloat | None = Field(None, gt=0, description="short form: camera left of the laser by [m]")
    beta_deg: FiniteFloat | None = Field(None, gt=-80, lt=80, description="short form: inward yaw [deg]")
    alpha_deg: FiniteFloat | None = Field(None, gt=1, lt=85, description="short form: half horizontal view [deg]")

    @field_validator("T_head_camera")
    @classmethod
    def _rigid(cls, value: tuple[tuple[float, ...], ...] | None) -> tuple[tuple[float, ...], ...] | None:
        if value is not None:
            T = np.array(value)
            if not is_rotation(T[:3, :3]) or not np.allclose(T[3], [0, 0, 0, 1]):
                raise ValueError("is not a rigid transform (a rotation, a shift, last row 0 0 0 1)")
        return value

    @field_validator("laser_plane")
    @classmethod
    def _has_normal(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if np.linalg.norm(value[:3]) < 1e-9:
            raise ValueError("has no normal: its first three numbers are zero")
        return value

    @model_validator(mode="after")
    def _one_form(self) -> HeadTable:
        short = {"baseline_m": self.baseline_m, "beta_deg": self.beta_deg}
        missing = [name for name, value in short.items() if value is None]
        if self.T_head_camera is None and missing:
            raise ValueError(f"needs T_head_camera, or baseline_m and beta_deg; {' and '.join(missing)} missing")
        if self.T_head_camera is not None and len(missing) < len(short):
            raise ValueError("has both T_head_camera and the short form (baseline_m, beta_deg); keep one")
        return self


class AxisTable(BaseModel, frozen=True, extra="forbid"):
    """`[axis]`: how the head sits on the axis."""

    head_offset_m: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = Field(
        (0.0, 0.0, 0.0), description="head origin from the axis [m]"
    )
    tilt_deg: tuple[FiniteFloat, FiniteFloat] = Field(
        (0.0, 0.0), description="axis against head z, about x and y [deg]"
    )


class RatioTable(BaseModel, frozen=True, extra="forbid"):
    """`[ratio]`: Algorithm 1 of the thesis."""

    alpha_deg: float = Field(gt=0, lt=85, description="half horizontal view [deg]")
    beta_deg: float = Field(gt=-80, lt=80, description="inward yaw [deg]")
    baseline_m: FiniteFloat = Field(gt=0, description="camera to laser [m]")
    width: int | None = Field(None, gt=0, description="image width l [px]; the [image] width if left out")


class PixelAngleTable(BaseModel, frozen=True, extra="forbid"):
    """`[pixel_angle]`: Algorithm 2 of the thesis."""

    rpc_deg: FiniteFloat = Field(gt=0, description="angle per column [deg/px]")
    ro_deg: FiniteFloat = Field(description="angle at column 0 [deg]")
    baseline_m: FiniteFloat = Field(gt=0, description="camera to laser [m]")


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
        if self.intrinsics is None and self.head.alpha_deg is None:
            raise ValueError("needs [intrinsics], or alpha_deg in [head]")
        if self.intrinsics is not None and self.head.alpha_deg is not None:
            raise ValueError("has both [intrinsics] and head.alpha_deg; keep one")
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


# The tables by the names they have in the file.
_TABLES: dict[str, type[BaseModel]] = {
    "image": ImageTable, "intrinsics": IntrinsicsTable, "head": HeadTable, "axis": AxisTable, "ratio": RatioTable,
    "pixel_angle": PixelAngleTable,
}  # fmt: skip
