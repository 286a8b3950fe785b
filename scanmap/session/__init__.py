"""Opens what a config names, runs it, writes it, and holds it against the twin's truth; for cli and panel."""

from scanmap.session.inspection import describe, make_map, map_settings, prepare_view, watch
from scanmap.session.job import Job, Progress, Result
from scanmap.session.outputs import Outputs
from scanmap.session.preparing import Choice, prepare_replay, prepare_scan
from scanmap.view import show

__all__ = [
    "Choice",
    "Job",
    "Outputs",
    "Progress",
    "Result",
    "describe",
    "make_map",
    "map_settings",
    "prepare_replay",
    "prepare_scan",
    "prepare_view",
    "show",
    "watch",
]
