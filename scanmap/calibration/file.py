"""The form of calibration.toml: its tables, their limits, every fault named at once."""

from __future__ import annotations

import re
import tomllib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, FiniteFloat, ValidationError, field_validator, model_validator

from scanmap.calibration.camera import Intrinsics
from scanmap.calibration.head import Calibration, PixelAngleModel, RatioModel
from scanmap.errors import CalibrationError, in_words
from scanmap.geometry import HeadMount, is_rotation, rigid, rotation_z

Array = NDArray[np.float64]

# Camera axes (x right, y down, z forward) seen in the head frame of a camera that looks along head x.
R_HEAD_CAMERA_FORWARD: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
RIG_KEYS = frozenset({"rig", "sweep", "camera", "stage", "twin"})  # what tells a rig's TOML


def parse(text: str, source: str) -> Calibration:
    """`Calibration.loads`."""
    try:
        document = tomllib.loads(text)
        if "image" not in document and RIG_KEYS & document.keys():
            raise CalibrationError(
                f"{source} is the configuration of a rig, not a calibration: give it with --config, and leave "
                "--calibration out to take the one in it"
            )
        # Strictly, so that text is never taken for a number; a TOML array is a tuple here.
        return CalibrationFile.model_validate(_with_tuples(document), strict=True).build()
    except tomllib.TOMLDecodeError as error:
        raise CalibrationError(f"{source} is not valid TOML: {error}") from error
    except ValidationError as error:
        raise CalibrationError(f"{source}: {'; '.join(_faults(error))}") from error


def dumps(calibration: Calibration) -> str:
    """`Calibration.dumps`."""
    import tomli_w

    own = calibration.intrinsics
    document: dict[str, Any] = {
        "image": {"width": own.width, "height": own.height},
        "intrinsics": {
            "fx": own.fx, "fy": own.fy, "cx": own.cx, "cy": own.cy, "distortion": list(own.distortion),
        },
        "head": {
            "T_head_camera": calibration.T_head_camera.tolist(),
            "laser_plane": calibration.laser_plane.tolist(),
        },
        "axis": {
            "head_offset_m": list(calibration.mount.offset_m),
            "tilt_deg": list(calibration.mount.tilt_deg),
        },
    }  # fmt: skip
    if calibration.ratio:
        document["ratio"] = {
            "alpha_deg": calibration.ratio.alpha_deg, "beta_deg": calibration.ratio.beta_deg,
            "baseline_m": calibration.ratio.baseline_m, "width": calibration.ratio.width,
        }  # fmt: skip
    if calibration.pixel_angle:
        document["pixel_angle"] = {
            "rpc_deg": calibration.pixel_angle.rpc_deg, "ro_deg": calibration.pixel_angle.ro_deg,
            "baseline_m": calibration.pixel_angle.baseline_m,
        }  # fmt: skip
    for name in ("residuals", "covariance", "meta"):
        if getattr(calibration, name):
            document[name] = getattr(calibration, name)
    return _NUMBERS.sub(_on_one_line, tomli_w.dumps(_plain(document)))


# An array of numbers that the writer broke into a line each: nobody reads a matrix that way.
_NUMBERS = re.compile(r"\[\n((?: +[-+0-9.e]+,\n)+) *\]")


def _on_one_line(array: re.Match[str]) -> str:
    return f"[{', '.join(array[1].replace(',', ' ').split())}]"


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
        message = in_words(detail["msg"])
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
