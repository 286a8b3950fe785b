"""Image (+ background) to `LaserLine`: one sub-pixel column per row."""

from scanmap.laserline.candidates import BLOCK
from scanmap.laserline.grey import binary_image, overlay, to_grey
from scanmap.laserline.line import clear_channel, find_laser_line, look, look_at_all
from scanmap.laserline.params import LaserLineParams, needs_colour
from scanmap.laserline.result import LaserLine, Look, Reason
from scanmap.laserline.ridges import ridge_of, ridges
from scanmap.laserline.rounding import Rounding, rounding_of

__all__ = [
    "BLOCK",
    "LaserLine",
    "LaserLineParams",
    "Look",
    "Reason",
    "Rounding",
    "binary_image",
    "clear_channel",
    "find_laser_line",
    "look",
    "look_at_all",
    "needs_colour",
    "overlay",
    "ridge_of",
    "ridges",
    "rounding_of",
    "to_grey",
]
