"""Opens what a config names, runs it, writes it, and holds it against the twin's truth; for cli and panel."""

from scanmap.session.description import describe
from scanmap.session.inspection import (
    map_lines,
    map_of_cloud,
    map_settings,
    prepare_view,
    show_as_it_is,
    shown_as_it_is,
    watch,
)
from scanmap.session.job import Job, Progress, Result
from scanmap.session.latency import measure_latency
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
    "map_lines",
    "map_of_cloud",
    "map_settings",
    "measure_latency",
    "prepare_replay",
    "prepare_scan",
    "prepare_view",
    "show",
    "show_as_it_is",
    "shown_as_it_is",
    "watch",
]
