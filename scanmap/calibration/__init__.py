"""`Calibration`: the one file that describes a head, and its TOML. No solver lives here."""

from scanmap.calibration.camera import Intrinsics
from scanmap.calibration.file import CalibrationFile, HeadTable, ImageTable
from scanmap.calibration.gates import GATES, check_residuals
from scanmap.calibration.head import Calibration, PixelAngleModel, RatioModel
from scanmap.calibration.uncertainty import Uncertainty, moved, parameters_of, uncertainty_of

__all__ = [
    "GATES",
    "Calibration",
    "CalibrationFile",
    "HeadTable",
    "ImageTable",
    "Intrinsics",
    "PixelAngleModel",
    "RatioModel",
    "Uncertainty",
    "check_residuals",
    "moved",
    "parameters_of",
    "uncertainty_of",
]
