"""Image (+ background) to `LaserLine`: one sub-pixel column per row."""

from scanmap.laserline.grey import binary_image, overlay, to_grey
from scanmap.laserline.line import LaserLineParams, find_laser_line, needs_colour
from scanmap.laserline.result import LaserLine, Reason

__all__ = [
    "LaserLine",
    "LaserLineParams",
    "Reason",
    "binary_image",
    "find_laser_line",
    "needs_colour",
    "overlay",
    "to_grey",
]
