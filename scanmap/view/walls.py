"""Flat pieces of a scan in space, coloured by how far beside its own plane every patch lies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.errors import ConfigError
from scanmap.view import entities as at
from scanmap.view.boards import colours_by_distance

Array = NDArray[np.float64]


class FlatPieces(NamedTuple):
    """What one calibration makes of the pieces; world frame."""

    name: str
    points: Array  # (N, 3) [m]
    off_px: Array  # (N,) columns beside the own plane
    outlines: list[Array]  # (5, 3) closed rectangle of each piece [m]


def write_walls(path: Path, heads: Sequence[FlatPieces]) -> None:
    """Write an .rrd with one view for each calibration, side by side; colours mean the same in all.

    Raises:
        ConfigError: the file cannot be written.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    views = [_view(head, f"/{head.name.split()[0]}") for head in heads]
    recording = rr.RecordingStream(f"{at.APPLICATION}-walls")
    try:
        path.open("wb").close()
        recording.save(path, default_blueprint=rrb.Blueprint(rrb.Horizontal(*views), collapse_panels=True))
    except OSError as error:
        raise ConfigError(f"{path} cannot be written ({error.strerror}); choose another path for --rrd") from error
    # The last is the best one: what is far for it is shown in full colour, so that the others stand out.
    limit = 3.0 * float(np.percentile(np.abs(heads[-1].off_px), 95))
    for head in heads:
        root = head.name.split()[0]
        recording.log(root, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        colours = colours_by_distance(head.off_px, limit)
        points = rr.Points3D(head.points, colors=colours, radii=rr.Radius.ui_points(1.5))
        recording.log(f"{root}/patches", points, static=True)
        strips = rr.LineStrips3D(head.outlines, colors=[130, 130, 130], radii=rr.Radius.ui_points(0.7))
        recording.log(f"{root}/pieces", strips, static=True)
        axis = rr.Arrows3D(origins=[[0, 0, 0]], vectors=[[0, 0, 0.3]], colors=[[255, 255, 255]])
        recording.log(f"{root}/axis", axis, static=True)
    recording.flush()
    recording.disconnect()


def _view(head: FlatPieces, origin: str) -> object:
    import rerun.blueprint as rrb

    middle = np.median(head.points, axis=0)
    away = float(np.percentile(np.linalg.norm(head.points - middle, axis=1), 95))
    eye = middle + away * np.array([-1.1, -1.3, 1.6])
    return rrb.Spatial3DView(
        origin=origin,
        name=head.name,
        background=[*at.GROUND, 255],
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=eye.tolist(), look_target=middle.tolist(), eye_up=(0.0, 0.0, 1.0)
        ),
    )
