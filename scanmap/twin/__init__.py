"""The digital twin: a room, a camera that sees it, and the truth about it."""

from scanmap.twin.camera import TwinCamera, TwinParams
from scanmap.twin.delay import DelayedCamera
from scanmap.twin.laser import LaserParams
from scanmap.twin.light import LightParams
from scanmap.twin.scene import RoomParams, Scene, build_scene
from scanmap.twin.sensor import SensorParams
from scanmap.twin.truth import LitPoints, Truth, TruthReport

__all__ = [
    "DelayedCamera",
    "LaserParams",
    "LightParams",
    "LitPoints",
    "RoomParams",
    "Scene",
    "SensorParams",
    "Truth",
    "TruthReport",
    "TwinCamera",
    "TwinParams",
    "build_scene",
]
