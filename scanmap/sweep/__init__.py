"""Sweep a rig through a room."""

from scanmap.sweep.matching import Shift, shift_between
from scanmap.sweep.planning import CABLE_LIMITS, Plan, SweepParams, between, plan
from scanmap.sweep.proving import Homable, Place, Withdraw
from scanmap.sweep.stepping import Settable, Steps, grab
from scanmap.sweep.sweeping import sweep
from scanmap.sweep.turning import Turning, Turns, missing, passes
from scanmap.sweep.watching import Watch

__all__ = [
    "CABLE_LIMITS",
    "Homable",
    "Place",
    "Plan",
    "Settable",
    "Shift",
    "Steps",
    "SweepParams",
    "Turning",
    "Turns",
    "Watch",
    "Withdraw",
    "between",
    "grab",
    "missing",
    "passes",
    "plan",
    "shift_between",
    "sweep",
]
