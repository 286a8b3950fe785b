"""scanmap: a webcam and a line laser on a turning head become a calibrated room scanner."""

__version__ = "0.1.0"
