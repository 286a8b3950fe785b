"""The room's light from other bearings' pictures: a tiled wall, drawn as a lens and a camera's curve show it."""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from functools import lru_cache

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanmap.calibration import CalibrationFile, HeadTable, ImageTable
from scanmap.geometry import inverse, transform
from scanmap.laserline import LaserLineParams, slide_between
from scanmap.pipeline import Pipeline, SecondLook, run, unlit_lines
from scanmap.pipeline.room_light import unlit
from scanmap.scan import Scan
from scanmap.shot import Shot
from scanmap.triangulation import TriangulationParams

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

WIDTH, HEIGHT, FINER = 640, 192, 4
HEAD = CalibrationFile(
    image=ImageTable(width=WIDTH, height=HEIGHT), head=HeadTable(baseline_m=0.2, beta_deg=22.0, alpha_deg=30.0)
).build()
BEARINGS = np.radians(np.arange(64.0, 117.0, 7.5))
WALL_Y, ON_JOINT = 2.0, 3  # [m]; the bearing whose line falls on a joint
BEAM_M, LENS_PX, ROOM, PEAK, NOISE = 0.005, 0.9, 0.06, 0.35, 1.0
TILE_M, JOINT_M, ALBEDO = 0.31, 0.005, 0.3


@lru_cache
def middle(bearing: float) -> tuple[float, F64]:
    """Where the sheet's middle meets the wall, x [m], and the columns (H,) it is seen in."""
    plane = HEAD.laser_plane @ inverse(HEAD.mount.T_world_head(bearing))
    x = -(plane[1] * WALL_Y + plane[3]) / plane[0]
    T = HEAD.mount.T_world_head(bearing) @ HEAD.T_head_camera
    z = np.linspace(-3.0, 3.0, 2000)
    seen = HEAD.intrinsics.project(
        transform(inverse(T), np.stack([np.full_like(z, x), np.full_like(z, WALL_Y), z], axis=1))
    )
    order = np.argsort(seen[:, 1])
    return float(x), np.interp(np.arange(HEIGHT), seen[order, 1], seen[order, 0])


def picture(bearing: float, joint_m: float | None, lit: bool, seed: int) -> bytes:
    """A file of a wall whose joints lie so far beside the sheet's middle at one bearing; None: without any."""
    rng = np.random.default_rng(seed)
    column = (np.arange(WIDTH * FINER) + 0.5) / FINER - 0.5
    u, v = np.meshgrid(column, np.arange(HEIGHT, dtype=np.float64))
    T = HEAD.mount.T_world_head(bearing) @ HEAD.T_head_camera
    rays = HEAD.intrinsics.rays(u, v) @ T[:3, :3].T
    points = T[:3, 3] + ((WALL_Y - T[1, 3]) / rays[..., 1])[..., None] * rays
    albedo = np.ones(u.shape)
    if joint_m is not None:
        beside = points[..., 0] - middle(float(BEARINGS[ON_JOINT]))[0] - joint_m
        course = np.floor(points[..., 2] / TILE_M)
        albedo = 1.0 - 0.3 * ((np.round(beside / TILE_M) + course) % 2)
        albedo[np.abs((beside + 0.5 * TILE_M) % TILE_M - 0.5 * TILE_M) < 0.5 * JOINT_M] = ALBEDO
        albedo[np.abs(points[..., 2] / TILE_M - course) < JOINT_M / TILE_M] = ALBEDO
    own = transform(inverse(HEAD.mount.T_world_head(bearing)), points)
    away = own @ HEAD.laser_plane[:3] + HEAD.laser_plane[3]
    light = (ROOM + lit * PEAK * np.exp(-0.5 * np.square(away / BEAM_M))) * albedo
    seen = cv2.GaussianBlur(light, (0, 0), LENS_PX * FINER, sigmaY=1e-3).reshape(HEIGHT, WIDTH, FINER).mean(axis=2)
    levels = 255.0 * np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)
    levels += rng.normal(0.0, NOISE, levels.shape)
    return bytes(
        cv2.imencode(".jpg", np.clip(np.rint(levels), 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
    )


@lru_cache
def shots(joint_m: float | None, off_deg: float = 0.0) -> list[Shot]:
    """A sweep's shots, whose bearings are wrong by so much (standard deviation)."""
    wrong = np.radians(np.random.default_rng(3).normal(0.0, off_deg, len(BEARINGS)))
    told = BEARINGS + wrong - wrong[ON_JOINT]
    return [
        Shot(k, float(told[k]), float(told[k]), float(k), picture(float(bearing), joint_m, True, k))
        for k, bearing in enumerate(BEARINGS)
    ]


def swept(some: list[Shot], settled: bool = True) -> Scan:
    pipeline = Pipeline(HEAD, LaserLineParams(grey="luminance_601", pool_rows=9), TriangulationParams())
    scan, second = Scan(HEAD.mount, HEIGHT), SecondLook(pipeline)
    run(some, pipeline.process, [lambda step: scan.add(step.profile, step.shot.bearing), second], workers=1)
    if settled:
        second.settle(scan, lambda: some)
    return scan


def off_middle(scan: Scan, k: int = ON_JOINT) -> F64:
    """How far the line is found off the sheet's middle [px], in rows that have one."""
    off = scan.column_px[k] - middle(float(BEARINGS[k]))[1]
    assert np.isfinite(off).mean() > 0.9
    return off[np.isfinite(off)]


def grey(data: bytes) -> U8:
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE), np.uint8)


@pytest.mark.parametrize("off_deg", [0.0, 0.1])
@pytest.mark.parametrize("joint_m", [-0.006, -0.005, -0.0035, 0.0035, 0.005, 0.006])
def test_a_line_on_a_joint_is_where_the_middle_of_the_sheet_is(joint_m: float, off_deg: float) -> None:
    """Bearings that are wrong by 0.1 deg lie a pixel beside each other's pictures, and more."""
    some = shots(joint_m, off_deg)
    before, scan = off_middle(swept(some, settled=False)), swept(some)
    after, sigma = off_middle(scan), scan.sigma_m[ON_JOINT] / np.nanmedian(scan.range_m[ON_JOINT])
    assert abs(np.median(before)) > 0.15
    assert abs(np.median(after)) < 0.4 * abs(np.median(before))
    per_px = 1.0 / HEAD.intrinsics.fx * np.nanmedian(scan.range_m[ON_JOINT]) / 0.2
    assert abs(np.median(after)) * per_px < 2.0 * np.nanmedian(sigma)
    for k in set(range(len(BEARINGS))) - {ON_JOINT}:
        assert abs(np.median(off_middle(scan, k))) < 0.05


def test_the_picture_without_the_laser_is_the_room() -> None:
    some = shots(0.0035)
    scan = swept(some, settled=False)
    others = [(k, grey(some[k].image)) for k in (ON_JOINT - 1, ON_JOINT + 1)]
    dark = unlit(scan, HEAD, ON_JOINT, grey(some[ON_JOINT].image), others, 0)
    true = grey(picture(float(BEARINGS[ON_JOINT]), 0.0035, False, 99)).astype(float)
    near = np.abs(np.arange(WIDTH) - middle(float(BEARINGS[ON_JOINT]))[1][:, None]) < 20
    assert dark.told.mean() > 0.9
    apart = (dark.picture - true)[near & dark.told[:, None]]
    assert np.std(apart) < 1.6 * NOISE * np.sqrt(2.0)
    assert abs(np.mean(apart)) < 0.3


def test_of_a_thing_that_stood_beside_the_line_only_later_nothing_is_taken() -> None:
    some = shots(0.0035)
    scan = swept(some, settled=False)
    later = grey(some[ON_JOINT + 1].image).copy()
    later[:96] //= 2
    dark = unlit(scan, HEAD, ON_JOINT, grey(some[ON_JOINT].image), [(ON_JOINT + 1, later)], 0)
    assert not dark.told[:80].any()


def test_a_plain_wall_is_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unlit_lines, "unlit", None)
    scan = swept(shots(None))
    assert abs(np.median(off_middle(scan))) < 0.03


def test_a_bearing_that_was_withdrawn_says_nothing_of_others() -> None:
    bearings, speaks = np.radians(np.arange(0.0, 30.0, 2.0)), np.ones(15, bool)
    assert unlit_lines._others(bearings, speaks, 7, 554.0) == [3, 11]
    speaks[11] = False
    assert unlit_lines._others(bearings, speaks, 7, 554.0) == [3, 12]
    assert unlit_lines._others(bearings, speaks, 0, 554.0) == [4]
    assert unlit_lines._others(np.radians([0.0, 20.0, 40.0]), np.ones(3, bool), 1, 554.0) == []


class Usual:
    """Widths of 2000 bearings, as far from what is usual as it is told."""

    def __init__(self, ratio: float) -> None:
        self.ratio = ratio

    def ratios(self) -> tuple[F64, NDArray[np.bool_]]:
        return np.full((2000, 20), self.ratio), np.ones((2000, 20), bool)


def test_of_a_long_scan_only_the_lines_that_lean_most_are_asked() -> None:
    lean, speaks = [np.full(20, 0.03 + 1e-4 * k, np.float32) for k in range(2000)], np.ones(2000, bool)
    assert unlit_lines._doubtful(Usual(0.0), lean, speaks) == list(range(1900, 2000))
    lean[1950] = np.full(20, 0.01, np.float32)
    assert 1950 not in unlit_lines._doubtful(Usual(0.0), lean, speaks)
    straight = [np.zeros(20, np.float32)] * 2000
    assert unlit_lines._doubtful(Usual(0.05), straight, speaks) == []
    assert len(unlit_lines._doubtful(Usual(-0.1), straight, speaks)) == 100
    speaks[:1990] = False
    assert unlit_lines._doubtful(Usual(-0.1), straight, speaks) == list(range(1990, 2000))


class Watched(Shot):
    """A shot that tells when it is gone."""

    __slots__ = ("__weakref__",)


def test_shots_are_held_only_as_long_as_they_are_used() -> None:
    alive: weakref.WeakSet[Watched] = weakref.WeakSet()
    most = 0

    def taken() -> Iterator[Shot]:
        nonlocal most
        for k in range(200):
            shot = Watched(k, 0.01 * k, 0.01 * k, float(k), b"")
            alive.add(shot)
            most = max(most, len(alive))
            yield shot
            del shot

    others = {k: [k - 3, k + 3] for k in range(10, 190, 2)}
    keys = [(float(k), 0.01 * k) for k in range(200)]
    done = 0
    for job in unlit_lines._jobs(others, taken(), keys):
        assert [job.shot.index, *(shot.index for _, shot in job.others)] == [job.k, job.k - 3, job.k + 3]
        done += 1
        del job
    assert done == len(others)
    assert most < 12


@given(true=st.floats(-4.5, 4.5), gain=st.floats(0.8, 1.25), seed=st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_how_far_strips_are_moved_is_told_as_well_as_it_says(true: float, gain: float, seed: int) -> None:
    rng, x = np.random.default_rng(seed), np.arange(321.0)
    at, wide = np.array([50.0, 110.0, 230.0]) + rng.uniform(-10, 10, 3), rng.uniform(1.5, 4.0, 3)

    def room(x: F64) -> F64:
        return np.asarray(60.0 + sum(14.0 * np.tanh((x - a) / b) for a, b in zip(at, wide, strict=True)))

    noise = rng.normal(0.0, 1.5, (2, 120, len(x)))
    on, off = (room(x - true) + noise[0]).astype(np.float32), (gain * room(x) + noise[1]).astype(np.float32)
    on[:, 150:170] = np.nan
    right, sigma = slide_between(on, off, 7)
    assert sigma < 0.1
    assert abs(right - true) < 5.0 * sigma + 0.03


def test_of_noise_alone_no_shift_is_told() -> None:
    noise = 60.0 + np.random.default_rng(1).normal(0.0, 2.0, (2, 200, 321)).astype(np.float32)
    assert slide_between(noise[0], noise[1], 7) == (0.0, np.inf)
