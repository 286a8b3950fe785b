"""Recordings: one scan as one MCAP file, and everything else that can be replayed as `Shot`s."""

from scanmap.recording.info import RecordingInfo, TopicInfo, describe
from scanmap.recording.layout import RecordingParams
from scanmap.recording.mcap_writer import Recorder, whole_ns
from scanmap.recording.opening import open_source
from scanmap.recording.parts import first_part, is_later_part, next_part, part_path
from scanmap.recording.recovery import recover
from scanmap.recording.source import Source

__all__ = [
    "Recorder",
    "RecordingInfo",
    "RecordingParams",
    "Source",
    "TopicInfo",
    "describe",
    "first_part",
    "is_later_part",
    "next_part",
    "open_source",
    "part_path",
    "recover",
    "whole_ns",
]
