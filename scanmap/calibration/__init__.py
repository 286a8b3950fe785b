"""`Calibration`: the one file that describes a head, and its TOML. No solver lives here."""

from scanmap.calibration.camera import Intrinsics
from scanmap.calibration.file import CalibrationFile, HeadTable, ImageTable
from scanmap.calibration.head import Calibration, PixelAngleModel, RatioModel

__all__ = [
    "Calibration",
    "CalibrationFile",
    "HeadTable",
    "ImageTable",
    "Intrinsics",
    "PixelAngleModel",
    "RatioModel",
]
