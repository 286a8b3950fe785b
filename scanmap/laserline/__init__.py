"""Image (+ background) to `LaserLine`: one sub-pixel column per row."""

from scanmap.laserline.line import LaserLine, LaserLineParams, Reason, find_laser_line

__all__ = ["LaserLine", "LaserLineParams", "Reason", "find_laser_line"]
