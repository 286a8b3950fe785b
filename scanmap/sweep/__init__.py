"""Sweep a rig through a room."""

from scanmap.sweep.matching import Shift, shift_between
from scanmap.sweep.planning import CABLE_LIMITS, Plan, SweepParams, between, plan
from scanmap.sweep.stepping import Homable, Settable, Steps
from scanmap.sweep.sweeping import sweep
from scanmap.sweep.watching import Watch

__all__ = [
    "CABLE_LIMITS",
    "Homable",
    "Plan",
    "Settable",
    "Shift",
    "Steps",
    "SweepParams",
    "Watch",
    "between",
    "plan",
    "shift_between",
    "sweep",
]
