"""What a scan looks like: the only importer of rerun, and only when something is to be seen."""

from scanmap.view.entities import ViewParams
from scanmap.view.opening import open_view
from scanmap.view.recorder import View
from scanmap.view.viewer import show

__all__ = ["View", "ViewParams", "open_view", "show"]
