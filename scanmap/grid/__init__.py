"""Occupancy grid of a scan: floor, evidence per bearing, map files that Nav2 loads."""

from scanmap.grid.evidence import GridParams
from scanmap.grid.floor import Floor, find_floor
from scanmap.grid.map_files import NavMap, load_map, read_nav_map, save_map
from scanmap.grid.occupancy import OccupancyGrid

__all__ = [
    "Floor",
    "GridParams",
    "NavMap",
    "OccupancyGrid",
    "find_floor",
    "load_map",
    "read_nav_map",
    "save_map",
]
