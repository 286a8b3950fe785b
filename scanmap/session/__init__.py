"""Opens what a config names, runs it, writes it, and holds it against the twin's truth; for cli and panel."""

from scanmap.session.description import describe
from scanmap.session.doctor import Finding, examine
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
from scanmap.session.knobs import HELP as KEYS_HELP
from scanmap.session.latency import measure_latency
from scanmap.session.live import open_live
from scanmap.session.live_view import open_live_view, watching_words
from scanmap.session.new_rig import Drive, Head, first_config
from scanmap.session.outputs import Outputs
from scanmap.session.preparing import Choice, prepare_replay, prepare_scan
from scanmap.session.recovering import recover
from scanmap.session.stage_work import home, jog, switch_laser, where
from scanmap.view import show

__all__ = [
    "KEYS_HELP",
    "Choice",
    "Drive",
    "Finding",
    "Head",
    "Job",
    "Outputs",
    "Progress",
    "Result",
    "describe",
    "examine",
    "first_config",
    "home",
    "jog",
    "map_lines",
    "map_of_cloud",
    "map_settings",
    "measure_latency",
    "open_live",
    "open_live_view",
    "prepare_replay",
    "prepare_scan",
    "prepare_view",
    "recover",
    "show",
    "show_as_it_is",
    "shown_as_it_is",
    "switch_laser",
    "watch",
    "watching_words",
    "where",
]
