"""Lines placed with what a whole sweep knows of them, each in the way that fits what has moved it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import means_along
from scanmap.pipeline.clean_flanks import by_clean_flanks
from scanmap.pipeline.cut_beams import put_back
from scanmap.pipeline.narrow_lines import place_narrow_lines
from scanmap.pipeline.reflectance import reflectance, shape_of
from scanmap.pipeline.step import Pipeline, Step
from scanmap.pipeline.unlit_lines import look_without_light
from scanmap.pipeline.widths import Widths
from scanmap.scan import Scan
from scanmap.shot import Shot

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

_MOSTLY = 0.9  # of a block's rows whose lean is told without the room's light


class Lines(NamedTuple):
    """What is known of a sweep's lines, in lists with an item for each bearing."""

    keys: list[tuple[float, float]]  # time and bearing of its shot
    reflectance: list[F32]  # (H,); NaN where it is not known
    shape: list[F32]  # (2, H) height and width
    lean: list[F32 | None]  # as `Look` has it
    has_off: list[bool]  # whether there was a laser-off frame

    def note(self, step: Step) -> None:
        """Add a bearing's."""
        self.keys.append((step.shot.time, step.shot.bearing))
        self.reflectance.append(reflectance(step))
        self.shape.append(shape_of(step))
        self.lean.append(step.lean)
        self.has_off.append(step.shot.background is not None)


def place_lines(
    scan: Scan, pipeline: Pipeline, lines: Lines, asked: list[int], shots: Callable[[], Iterable[Shot]] | None
) -> None:
    """Move points in `scan`, in place, to where their lines are, with what stays open in their sigma.

    Args:
        lines: of all of the scan's bearings.
        asked: bearings, by their index, that say something.
        shots: the shots of the scan once more; None where they are gone.
    """
    widths = [shape[1] for shape in lines.shape]
    put = put_back(scan, pipeline, lines.reflectance, widths, asked)
    # The thesis's ways to find the line stay as they are.
    if not asked or pipeline.laserline.method != "gauss":
        return
    left = np.zeros_like(put)
    left[asked] = [np.isfinite(lines.reflectance[k]) for k in asked]
    usual = Widths.of(scan, pipeline.calibration, lines.shape, left)
    if usual is None:
        return
    left &= ~put
    # What of the beam the lean tells, where the room's own light is taken away.
    pure = [lean if off else None for lean, off in zip(lines.lean, lines.has_off, strict=True)]
    if shots is not None:
        lit = left & scan.valid & ~np.array(lines.has_off)[:, None]
        take = partial(_take, lines, pure)
        new = look_without_light(scan, pipeline, usual, lines.lean, lit, shots, lines.keys, take)
        rest = left & ~new.all
        left &= ~new.by_flank
        left &= ~by_clean_flanks(scan, pipeline, usual, widths, lines.lean, rest, shots, lines.keys)
    place_narrow_lines(scan, pipeline, usual, widths, pure, left & scan.valid)


def _take(lines: Lines, pure: list[F32 | None], k: int, rows: Mask, alone: Mask, step: Step) -> None:
    """Note what was found of the k-th bearing's lines without the room's light, as `look_without_light` tells it."""
    lines.reflectance[k][rows] = reflectance(step)[rows]
    lines.shape[k][:, rows] = shape_of(step)[:, rows]
    if step.lean is not None:
        mostly = means_along(alone.astype(np.float32)) > _MOSTLY
        pure[k] = np.where(mostly, step.lean, np.float32(np.nan))
