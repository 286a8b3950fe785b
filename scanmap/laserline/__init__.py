"""Image (+ background) to `LaserLine`: one sub-pixel column per row."""

from scanmap.laserline.candidates import BLOCK
from scanmap.laserline.flanks import ROWS, Moved, Usual, by_clean_flanks, least_of
from scanmap.laserline.grey import binary_image, overlay, to_grey
from scanmap.laserline.line import find_laser_line, laser_of, look, look_at_all
from scanmap.laserline.offmatch import slide_between
from scanmap.laserline.params import LaserLineParams, needs_colour
from scanmap.laserline.result import MEAN_ROWS, LaserLine, Look, Reason, means_along
from scanmap.laserline.ridges import ridge_of, ridges
from scanmap.laserline.rounding import Rounding, rounding_of
from scanmap.laserline.sight import Laser

__all__ = [
    "BLOCK",
    "MEAN_ROWS",
    "ROWS",
    "Laser",
    "LaserLine",
    "LaserLineParams",
    "Look",
    "Moved",
    "Reason",
    "Rounding",
    "Usual",
    "binary_image",
    "by_clean_flanks",
    "find_laser_line",
    "laser_of",
    "least_of",
    "look",
    "look_at_all",
    "means_along",
    "needs_colour",
    "overlay",
    "ridge_of",
    "ridges",
    "rounding_of",
    "slide_between",
    "to_grey",
]
