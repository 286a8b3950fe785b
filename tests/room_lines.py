"""Laser lines of analytic rooms and turntables, for the solvers that work on lines alone."""

from dataclasses import replace

import numpy as np
from analytic_scan import box_scan

from scanmap.calibration import Calibration, CalibrationFile
from scanmap.geometry import HeadMount, rotation_z
from scanmap.solvers.sight import Lines

MOUNT = HeadMount((0.02, -0.012, 0.0), (0.4, -0.3))
CABINET = ((0.8, -0.5, -0.5), (1.2, -0.1, 0.3))


def head(rows: int = 300, mount: HeadMount = MOUNT) -> Calibration:
    """The thesis's head, as `box_scan` has it, at `rows` rows."""
    document = {
        "image": {"width": rows * 4 // 3, "height": rows},
        "head": {"baseline_m": 0.08, "beta_deg": 25.7, "alpha_deg": 32.3},
    }
    return replace(CalibrationFile.model_validate(document).build(), mount=mount)


def off_by(exact: Calibration, beta_deg: float, offset_m: tuple[float, float]) -> Calibration:
    """The head with its camera turned in by more, and its offset from the axis wrong."""
    T = exact.T_head_camera.copy()
    T[:3, :3] = rotation_z(-np.radians(beta_deg)) @ T[:3, :3]
    (x, y, z), tilt = exact.mount
    return replace(exact, T_head_camera=T, mount=HeadMount((x + offset_m[0], y + offset_m[1], z), tilt))


def room_lines(sigma_px: float, seed: int, mount: HeadMount = MOUNT, step_deg: float = 6.0, bearings=None) -> Lines:
    """Lines of a full turn in a box-shaped room with a cabinet; column noise `sigma_px`."""
    turn = np.arange(0.0, 360.0, step_deg) if bearings is None else bearings
    scan = box_scan(turn, rows=300, boxes=[CABINET], sigma_px=sigma_px, mount=mount, seed=seed)
    column = scan.column_px.astype(float)
    return Lines(column, np.where(np.isfinite(column), max(sigma_px, 1e-3), np.nan), scan.bearings)


def turntable_lines(sigma_px: float, mount: HeadMount) -> Lines:
    """Lines of a block, 92 x 54 mm, on a square plate, turned in front of a fixed head."""
    block, plate = ((-0.046, -0.027, -0.1), (0.046, 0.027, 0.03)), ((-0.1, -0.1, -0.2), (0.1, 0.1, -0.1))
    far_room = ((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0))
    scan = box_scan(
        -np.arange(0.0, 360.0, 4.0), rows=480, room=far_room, boxes=[block, plate], sigma_px=sigma_px, mount=mount,
        range_max=0.6,
    )  # fmt: skip
    column = scan.column_px.astype(float)
    return Lines(column, np.where(np.isfinite(column), sigma_px, np.nan), scan.bearings)
