"""Sweep a rig through a room."""

from scanmap.sweep.planning import CABLE_LIMITS, Plan, SweepParams, between, plan
from scanmap.sweep.sweeping import sweep

__all__ = ["CABLE_LIMITS", "Plan", "SweepParams", "between", "plan", "sweep"]
