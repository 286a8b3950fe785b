"""Where everything stands in a recording of the viewer, and `[view]`, what goes into it."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

# A blueprint is found by the application's name: it is the same in every recording and layout file.
APPLICATION = "scanmap"

SHOT = "shot"  # timeline: running number of the shot
SCAN_TIME = "scan_time"  # timeline: [s] since the first shot

WORLD = "world"
POINTS = "world/points"
POINTS_ABOVE = "world/points_above"
MAP = "world/map"
GRID = "world/map/grid"
HEAD = "world/head"
BODY = "world/head/body"
LASER = "world/head/laser"
CAMERA = "world/head/camera"
IMAGE = "world/head/camera/image"
LINE = "world/head/camera/image/line"
RESULT = "world/result"
CLOUD = "world/result/cloud"
CLOUD_ABOVE = "world/result/cloud_above"
RESULT_MAP = "world/result/map"
RESULT_GRID = "world/result/map/grid"

BEARING = "plots/bearing"
ROWS = "plots/rows"
STATES = "state"
SCAN_STATE = "state/scan"
LINE_STATE = "state/line"
LOG = "log"
SETTINGS = "settings"

THESIS = "thesis"
THESIS_ORIGINAL = "thesis/original"
THESIS_GREY = "thesis/grey"
THESIS_BINARY = "thesis/binary"
THESIS_OVERLAY = "thesis/overlay"
THESIS_PICTURES = (THESIS_ORIGINAL, THESIS_GREY, THESIS_BINARY, THESIS_OVERLAY)
THESIS_PPX = "thesis/plots/ppx"
THESIS_P = "thesis/plots/p"
THESIS_DISTANCE = "thesis/plots/distance"

GROUND = (18, 20, 26)  # RGB of the 3D views' background, and of what a map does not know

TABS = ("scan", "thesis", "result")


class ViewParams(BaseModel, frozen=True, extra="forbid"):
    """What the viewer is given of a scan; `[view]` in a rig's TOML."""

    image_every: int = Field(1, ge=0, description="show the picture of every n-th shot; 0 = none [shots]")
    image_width_px: int = Field(
        0, ge=0, le=20000, description="make pictures no wider than this; 0 = as the camera sent them [px]"
    )
    jpeg_quality: int = Field(80, ge=1, le=100, description="quality of pictures that are encoded anew [%]")
    max_points_per_shot: int = Field(600, ge=2, description="thin a shot's points out to this many [points]")
    max_points_result: int = Field(400_000, ge=2, description="thin the finished cloud out to this many [points]")
    point_radius_px: float = Field(1.5, gt=0, le=20, description="radius of a drawn point [px]")
    hide_above_m: float = Field(
        1.2, gt=0, description="points higher above the laser than this are hidden at first: ceilings [m]"
    )
    thesis_tab: bool = Field(True, description="the thesis's view: grey, line image, overlay, both algorithms")
    thesis_width_px: int = Field(800, ge=16, le=20000, description="make its pictures no wider than this [px]")
    thesis_every: int = Field(5, ge=1, description="its pictures for every n-th shot; they are decoded anew [shots]")
    row: int | None = Field(None, ge=0, description="image row whose distance it plots; left out: the middle one [px]")
    overlay_colour: Literal["red", "green", "blue"] = Field("red", description="colour of the line in its overlay")
    live_port: int = Field(9876, ge=1, le=65535, description="where a live view listens, on this machine only")
    live_memory_mb: int = Field(256, ge=16, le=65536, description="what a live view keeps for late viewers [MB]")
