"""`calibrate check`: true heads pass, wrong ones fail, in analytic rooms where both are known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from room_lines import head, off_by, room_lines, turntable_lines
from test_calibrate_self import run, twin_recording

from scanmap.calibration import Calibration
from scanmap.calibration.uncertainty import Uncertainty
from scanmap.errors import CalibrationError
from scanmap.geometry import HeadMount, inverse, transform
from scanmap.solvers.check import check
from scanmap.solvers.check_words import conclusion, notes, verdict_lines
from scanmap.solvers.flat_segments import Segments
from scanmap.solvers.passes import compare_passes
from scanmap.solvers.sight import Lines, Patches
from scanmap.solvers.walls import CheckParams, walls_under

NOISE_PX = 0.01


def test_a_true_head_passes_and_its_corners_are_square() -> None:
    judged = check(room_lines(NOISE_PX, seed=2), head())
    assert judged.passed and judged.strain < 1.0
    assert len(judged.corners) >= 4
    assert np.abs([corner.angle_deg - 90.0 for corner in judged.corners]).max() < 0.2
    assert any("not measured" in note for note in notes(judged))


@pytest.mark.parametrize(("beta", "offset"), [(0.2, (0.0, 0.0)), (0.0, (0.0, 0.02))])
def test_a_wrong_head_fails_and_is_told_by_how_much(beta: float, offset: tuple[float, float]) -> None:
    judged = check(room_lines(NOISE_PX, seed=2), off_by(head(), beta, offset))
    assert not judged.passed and judged.contradictions
    said = " ".join(line for passed, line in verdict_lines(judged) if not passed)
    assert ("yaw by +0.2" if beta else "offset_y by -2") in said.replace("+0.19", "+0.2").replace("-19.", "-20.")


def test_a_line_that_stands_still_says_the_same_at_every_bearing() -> None:
    """A level plate turns under a line that does not move: all its shots weigh as much as one."""
    true = head(480, HeadMount((-0.42, 0.0, 0.0)))
    judged = check(turntable_lines(0.02, true.mount), true)
    plate = max(judged.walls, key=lambda wall: wall.bearings)
    assert plate.bearings == 90 and plate.places < 30
    assert min(wall.places for wall in judged.walls if wall is not plate) > 150


@pytest.mark.slow
def test_what_a_calibration_admits_is_not_held_against_it() -> None:
    """The same small error: too much for a head that claims to be exact, within what an uncertain one states."""
    wrong = off_by(head(), 0.05, (0.0, 0.0))
    sigma = np.radians(0.05)
    admitted = Uncertainty(("plane_nx", "plane_d"), np.diag([sigma**2, 0.0])).table()
    lines = room_lines(NOISE_PX, seed=2)
    claims, admits = check(lines, wrong), check(lines, replace(wrong, covariance=admitted))
    assert not claims.passed
    assert admits.flat and not admits.contradictions
    assert claims.strain > 2.0 * admits.strain


def test_passes_that_repeat_and_passes_that_lag() -> None:
    """Forward and back: the same columns, and columns of bearings 0.2 deg apart under the same name."""
    there = np.arange(0.0, 180.0, 4.0)
    forward = room_lines(NOISE_PX, seed=1, bearings=there)
    for lag in (0.0, 0.2):
        back = room_lines(NOISE_PX, seed=2, bearings=there[::-1] + lag)
        both = Lines(
            np.concatenate([forward.column_px, back.column_px]), np.concatenate([forward.sigma_px, back.sigma_px]),
            np.radians(np.concatenate([there, there[::-1]])),
        )  # fmt: skip
        found = compare_passes(both, 0.03)
        assert found is not None and found.bearings == len(there)
        assert found.lag_deg == pytest.approx(lag, abs=0.02)
        if lag == 0.0:
            assert found.rms_px == pytest.approx(NOISE_PX, rel=0.1)
    assert compare_passes(forward, 0.03) is None


@pytest.mark.slow
def test_rooms_that_are_not_square_are_said_and_can_be_excused() -> None:
    lines = room_lines(NOISE_PX, seed=2)
    # Bearings that run 3 % too far open every corner by 2.7 deg, and bend the walls.
    opened = lines._replace(bearings=lines.bearings * 0.97)
    judged = check(opened, head())
    assert not judged.corners_hold
    assert check(opened, head(), CheckParams(square=False)).corners_hold


def test_where_nobody_can_tell_walls_from_calibration_it_is_not_called_wrong() -> None:
    """A true head, bearings 20 deg apart: a wall and what stands before it are taken for one bent wall."""
    judged = check(room_lines(NOISE_PX, seed=2, bearings=np.arange(0.0, 181.0, 20.0)), head())
    assert judged.refined is None and not judged.passed
    assert "cannot tell whether the calibration" in conclusion(judged) and "contradicts" not in conclusion(judged)
    assert any(judged.unrefined and judged.unrefined in line for line in notes(judged))


def test_nothing_flat_is_nothing_to_judge_by() -> None:
    lines = room_lines(NOISE_PX, seed=2)
    column = lines.column_px.copy()
    column[:, np.arange(column.shape[1]) % 8 > 0] = np.nan
    with pytest.raises(CalibrationError, match="too little in this recording is flat"):
        check(lines._replace(column_px=column), head())


@pytest.mark.slow
def test_the_command_fails_and_passes_by_its_exit_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording, wrong = twin_recording(tmp_path)
    path, picture = tmp_path / "wrong.toml", tmp_path / "walls.png"
    # A residual over its gate keeps a scan from being made, not a calibration from being judged.
    replace(wrong, residuals={"self_rms_px": 7.0}).save(path)
    code, said, _ = run(
        capsys, "check", str(recording), "--calibration", str(path), "--figure", str(picture), "--wall-mm-per-m", "1"
    )
    assert code == 1 and "FAIL: this scan contradicts" in said and picture.stat().st_size > 20_000
    code, said, complaint = run(capsys, "check", str(recording))
    assert code == 0 and "PASS: nothing in this scan contradicts" in said, complaint
    assert Calibration.load(path).residuals == {"self_rms_px": 7.0}


@pytest.mark.parametrize("arc_m", [0.012, -0.008])
def test_a_walls_bow_is_its_arc_and_positive_where_its_ends_come_nearer(arc_m: float) -> None:
    """A wall 2 m away, from 1.2 m to the left to 1.2 m to the right, its ends nearer by the arc."""
    exact = replace(head(), mount=HeadMount())
    along, z = np.linspace(-1.2, 1.2, 41)[:, None], np.linspace(-0.4, 0.4, 9)
    x = np.broadcast_to(2.0 - arc_m * (along / 1.2) ** 2, (41, 9))
    in_head = np.stack([np.hypot(x, along), np.zeros_like(x), np.broadcast_to(z, x.shape)], axis=-1)
    pixel = exact.intrinsics.project(transform(inverse(exact.T_head_camera), in_head.reshape(-1, 3)))
    column, row = pixel.T.reshape(2, *x.shape)
    # A shot has one bearing: that of its middle, whose rows are alike.
    patches = Patches(column, row, np.full(x.shape, 0.01), np.arctan2(along, x)[:, 4])
    flat = Segments(np.zeros(x.shape, np.intp), np.array([[-1.0, 0.0, 0.0, 2.0]]), 0.01)
    (wall,), _ = walls_under(exact, patches, flat, [0], (0.01, CheckParams()))
    assert wall.bow_m == pytest.approx(arc_m, rel=0.05)
