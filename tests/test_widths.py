"""How wide the line is: drawn from what optics says of a sheet, a lens, slanted walls and a tone curve."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from scanmap.calibration import CalibrationFile, HeadTable, ImageTable
from scanmap.laserline import LaserLine, Reason
from scanmap.pipeline.widths import Widths
from scanmap.scan import Scan
from scanmap.triangulation import TriangulationParams, triangulate

F64 = NDArray[np.float64]

WIDTH, HEIGHT = 640, 48
ROW = np.arange(HEIGHT, dtype=np.float64)
HEAD = CalibrationFile(
    image=ImageTable(width=WIDTH, height=HEIGHT), head=HeadTable(baseline_m=0.2, beta_deg=22.0, alpha_deg=30.0)
).build()
LENS_PX, SHEET_M, DIVERGENCE, BY_HEIGHT = 0.8, 0.003, 0.0015, 0.05
BEARINGS = np.radians(np.arange(40.0, 140.1, 2.0))
# Corners of a room seen from above [m].
ROOM = np.array([(-3.0, -0.5), (-3.0, 1.6), (-0.6, 1.6), (-0.9, 3.0), (1.9, 2.4), (2.6, -0.5)])


def seen(bearing: float) -> tuple[F64, F64, F64]:
    """Column, range [m] and width [px] of the line (H,) on the walls: by rays that meet them beside the sheet."""
    column, row = np.meshgrid(np.arange(0.0, WIDTH, 0.25), ROW)
    T = HEAD.mount.T_world_head(bearing) @ HEAD.T_head_camera
    rays, camera = HEAD.intrinsics.rays(column.ravel(), row.ravel()) @ T[:3, :3].T, T[:3, 3]
    nearest = np.full(len(rays), np.inf)
    for a, b in zip(ROOM, np.roll(ROOM, -1, axis=0), strict=True):
        along = b - a
        det = rays[:, 0] * along[1] - rays[:, 1] * along[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            far = ((a[0] - camera[0]) * along[1] - (a[1] - camera[1]) * along[0]) / det
            at = camera[:2] + far[:, None] * rays[:, :2]
            share = (at - a) @ along / (along @ along)
        nearest = np.where((far > 0) & (share >= 0) & (share <= 1), np.minimum(nearest, far), nearest)
    points = camera + nearest[:, None] * rays
    own = (points - HEAD.mount.T_world_head(bearing)[:3, 3]) @ HEAD.mount.T_world_head(bearing)[:3, :3]
    beside = (own @ HEAD.laser_plane[:3] + HEAD.laser_plane[3]).reshape(column.shape)
    range_m = np.linalg.norm(own, axis=1).reshape(column.shape)
    found, far_m, width = (np.full(HEIGHT, np.nan) for _ in range(3))
    for k in range(HEIGHT):
        crossing = np.flatnonzero(np.diff(np.sign(beside[k])) != 0)
        if len(crossing) == 1 and 2 < crossing[0] < beside.shape[1] - 3:
            i = int(crossing[0])
            slope = (beside[k, i + 1] - beside[k, i]) / 0.25
            found[k], far_m[k] = column[k, i] - beside[k, i] / slope, range_m[k, i]
            width[k] = np.hypot(LENS_PX, np.hypot(SHEET_M, DIVERGENCE * far_m[k]) / slope)
    return found, far_m, width


def swept(spoilt: float = 0.0) -> tuple[Scan, list[NDArray[np.float32]], F64]:
    """A sweep of the room, heights and widths of its lines, and what these are but for noise; some are `spoilt`."""
    rng, scan, shapes, true = np.random.default_rng(4), Scan(HEAD.mount, HEIGHT), [], []
    for bearing in map(float, BEARINGS):
        column, _, width = seen(bearing)
        height = np.full(HEIGHT, rng.uniform(50.0, 190.0))
        own = width * (height / 100.0) ** BY_HEIGHT
        measured = own * rng.normal(1.0, 0.02, HEIGHT) * np.where(rng.uniform() < spoilt, 0.7, 1.0)
        reason = np.where(np.isfinite(column), Reason.OK, Reason.WEAK).astype(np.uint8)
        height = np.where(np.isfinite(column), height, np.nan)
        line = LaserLine(column, height, measured, np.full(HEIGHT, 0.03), reason)
        scan.add(triangulate(line, HEAD, TriangulationParams()), bearing)
        shapes.append(np.array([height, measured], np.float32))
        true.append(own)
    return scan, shapes, np.stack(true)


@pytest.mark.parametrize(("spoilt", "most"), [(0.0, 0.006), (0.15, 0.015)])
def test_usual_widths_are_those_of_the_sheet_the_lens_and_the_slant(spoilt: float, most: float) -> None:
    scan, shapes, true = swept(spoilt)
    usual = Widths.of(scan, HEAD, shapes, scan.valid)
    assert usual is not None
    seen_all = [usual.of_bearing(k) for k in range(len(scan))]
    off = np.log(np.stack([own.width_px for own in seen_all]) / true)
    known = np.stack([own.slant_known for own in seen_all]) & scan.valid
    assert known.sum() > 0.8 * scan.valid.sum()
    assert np.percentile(np.abs(off[known]), 95) < most
    # Medians by column alone know neither the slant nor the height.
    order = np.argsort(scan.column_px[known])
    groups = np.array_split(np.log(true)[known][order], 16)
    assert np.std(np.concatenate([own - np.median(own) for own in groups])) > 0.02


def test_means_are_asked_of_what_is_usual_there() -> None:
    scan, shapes, _ = swept()
    shapes[20][1] *= 0.8
    usual = Widths.of(scan, HEAD, shapes, scan.valid)
    assert usual is not None
    ratio, known = usual.ratios()
    assert np.nanmedian(ratio[20]) == pytest.approx(np.log(0.8), abs=0.02)
    others = known & (np.arange(len(scan)) != 20)[:, None]
    assert np.nanpercentile(np.abs(ratio[others]), 90) < 0.03


def test_few_lines_tell_nothing() -> None:
    scan, shapes, _ = swept()
    few = np.zeros_like(scan.valid)
    few[:3] = scan.valid[:3]
    assert Widths.of(scan, HEAD, shapes, few) is None


def test_an_empty_sweep_tells_nothing() -> None:
    scan = Scan(HEAD.mount, HEIGHT)
    assert Widths.of(scan, HEAD, [], scan.valid) is None
