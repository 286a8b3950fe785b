"""What can go wrong, by the part of the scanner that a user would look at.

A message says what, the bad value, the valid ones, and the next command to try. Numerical failure is not
an error: it is data (NaN with a reason).
"""


class ScanmapError(Exception):
    """Base of every error scanmap raises on purpose; shown as one line, exit code 1."""


class ConfigError(ScanmapError):
    """A configuration, option or file name the user can correct; exit code 2."""


class CameraError(ScanmapError):
    """A camera is missing, refused a setting, or delivered an unusable image."""


class StageError(ScanmapError):
    """The stage is missing, did not answer, or did not arrive."""


class CalibrationError(ScanmapError):
    """A calibration is damaged, does not fit the images, or could not be solved."""


class CalibrationFileError(CalibrationError, ConfigError):
    """A calibration file that was named is missing, damaged or something else; exit code 2."""


class RecordingError(ScanmapError):
    """A recording or data file cannot be read or written."""


class RegistrationError(ScanmapError):
    """Two stations could not be brought into one frame."""


def in_words(message: str) -> str:
    """What pydantic says is wrong with a value, in the words of this program."""
    for theirs, ours in (("Value error, ", ""), ("Input should", "must"), ("an object", "a table")):
        message = message.replace(theirs, ours)
    return "is missing" if message == "Field required" else message
