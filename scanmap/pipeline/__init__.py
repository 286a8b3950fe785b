"""Shot to Step: the one loop, and its decode workers. Grid, guard and view come in as sinks."""

from scanmap.pipeline.processes import TOGETHER, Processes, worth_processes
from scanmap.pipeline.running import Runner, checked, run
from scanmap.pipeline.second_look import SecondLook
from scanmap.pipeline.step import Pipeline, Sink, Step

__all__ = [
    "TOGETHER",
    "Pipeline",
    "Processes",
    "Runner",
    "SecondLook",
    "Sink",
    "Step",
    "checked",
    "run",
    "worth_processes",
]
