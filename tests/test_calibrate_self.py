"""Self-calibration: analytic rooms, a rendered room and photographs; what it refuses, and what it never overwrites."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from room_lines import head, off_by, room_lines, turntable_lines
from test_end_to_end import block_faces, block_size, head_of_rig_json, replayed

from scanmap import session
from scanmap.calibration import Calibration
from scanmap.calibration.uncertainty import uncertainty_of
from scanmap.cli import main
from scanmap.config import load
from scanmap.errors import CalibrationError
from scanmap.geometry import HeadMount, fit_plane, rotation_z
from scanmap.session.judging import measure_lines
from scanmap.solvers.flat_segments import beside
from scanmap.solvers.freedom import changed, redrawn
from scanmap.solvers.self_calibration import Refined, refine
from scanmap.solvers.sight import Lines, located, patches_of, sight_of


def test_columns_beside_a_plane_are_the_same_of_a_room_and_of_its_model() -> None:
    """All lengths a hundredth: the picture is the same. A floor in metres rewarded heads that shrink what they see."""
    rng = np.random.default_rng(5)
    points, per_column = rng.normal(0.0, 2.0, (2, 50, 3))
    normal = np.array([0.36, -0.48, 0.8])
    room = beside(points, 0.01 * per_column, np.append(normal, 1.5))
    model = beside(0.01 * points, 1e-4 * per_column, np.append(normal, 0.015))
    assert model == pytest.approx(room, rel=1e-9)
    along = 0.01 * per_column @ normal
    steep = np.abs(along) > 0.05 * 0.01 * np.linalg.norm(per_column, axis=1)
    assert steep.sum() > 40 and room[steep] == pytest.approx(((points @ normal + 1.5) / along)[steep])


def errors(refined: Refined, exact: Calibration) -> tuple[float, np.ndarray, np.ndarray]:
    """Of beta [deg], offset [mm] and tilt [deg]."""
    found, true = refined.after.mount, exact.mount
    beta = float(np.degrees(refined.after.beta - exact.beta))
    offset = 1e3 * (np.array(found.offset_m) - true.offset_m)
    return beta, offset, np.array(found.tilt_deg) - true.tilt_deg


@pytest.mark.parametrize(("beta", "offset"), [(0.5, (0.008, -0.006)), (-0.5, (-0.006, 0.008))])
def test_bent_walls_give_offset_and_beta_back(beta: float, offset: tuple[float, float]) -> None:
    """0.008 px at 400 columns is 0.03 px at 1600: what the line is found to."""
    refined = refine(room_lines(0.008, seed=3, step_deg=4.0), off_by(head(), beta, offset))
    assert refined.gained and refined.scale == "baseline" and refined.rms_before_px > 10 * refined.rms_after_px
    beta_off, offset_off, tilt_off = errors(refined, head())
    assert abs(beta_off) < 0.05 and np.linalg.norm(offset_off) < 1.0 and np.abs(tilt_off).max() < 0.05
    after = refined.after
    assert after.baseline_m == pytest.approx(0.08, rel=1e-9)
    assert after.laser_plane == pytest.approx(head().laser_plane, abs=1e-12)
    assert all(e.observed for e in refined.estimates)


@pytest.mark.slow
def test_stated_sigma_is_the_spread() -> None:
    """Offsets and beta over some seeds, in units of the deviation that each run states."""
    ratios = []
    for seed in range(6):
        refined = refine(room_lines(0.03, seed), head())
        beta, offset, _ = errors(refined, head())
        off = {"yaw": np.radians(beta), "offset_x": offset[0] / 1e3, "offset_y": offset[1] / 1e3}
        ratios += [off[name] / refined.estimate(name).sigma for name in off]
        known = uncertainty_of(refined.after)
        assert known is not None and known.sigma("offset_x") == pytest.approx(refined.estimate("offset_x").sigma)
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.8


@pytest.mark.parametrize("lean_deg", [(0.0, 0.0), (-0.4, 0.3)])
def test_on_a_turntable_the_axis_holds_the_scale(lean_deg: tuple[float, float]) -> None:
    """The axis's distance is kept; where the axis leans is refined, with the plane."""
    true = head(480, HeadMount((-0.42, 0.0, 0.0)))
    wrong = changed(true, ("yaw", "roll", "distance", "tilt_x", "tilt_y"), np.array([
        np.radians(0.5), np.radians(0.2), -0.002, *np.radians(lean_deg)]))  # fmt: skip
    refined = refine(turntable_lines(0.02, true.mount), wrong)
    assert refined.scale == "axis" and refined.gained
    assert np.hypot(*refined.after.mount.offset_m[:2]) == pytest.approx(0.42, abs=5e-4)
    angle = np.degrees(np.arccos(min(1.0, refined.after.laser_plane[:3] @ true.laser_plane[:3])))
    assert angle < 0.01 and refined.after.baseline_m == pytest.approx(0.08, abs=1.5e-4)
    assert np.abs(refined.after.mount.tilt_deg).max() < 0.02
    known = uncertainty_of(refined.after)
    assert known is not None
    for name, found in zip(("tilt_x", "tilt_y"), refined.after.mount.tilt_deg, strict=True):
        assert abs(np.radians(found)) < 3.0 * known.sigma(name) == pytest.approx(3.0 * refined.estimate(name).sigma)


def test_a_head_as_good_as_the_scan_can_tell_is_said_to_be() -> None:
    refined = refine(room_lines(0.008, seed=3, step_deg=4.0), head())
    assert (
        not refined.gained and refine(room_lines(0.008, seed=3, step_deg=4.0), off_by(head(), 0.1, (0.0, 0.0))).gained
    )


def test_redrawing_a_head_changes_nothing_but_bearing_zero() -> None:
    tilted = changed(head(), ("yaw", "roll", "offset_x", "tilt_x"), np.array([0.01, -0.004, 0.003, 0.002]))
    drawn = redrawn(tilted, head().laser_plane)
    patches = patches_of(room_lines(0.0, seed=0, step_deg=30.0))
    sight = sight_of(patches, head().intrinsics)
    a, b = (located(sight, one)[0] for one in (tilted, drawn))
    known = np.isfinite(a[..., 0])
    a, b = a[known], b[known]
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum())
    moved = a @ rotation_z(turn).T
    assert np.ptp(moved - b, axis=0) == pytest.approx([0, 0, 0], abs=1e-9)
    assert np.abs((moved - b)[:, :2]).max() < 1e-9 and abs(turn) > 0.005


def one_wall(lines: Lines) -> Lines:
    """Only what lies within 20 deg of bearing 90: one wall, seen nearly square."""
    near = np.abs(np.degrees(lines.bearings) - 90.0) < 20.0
    return Lines(*(part[near] for part in lines))


def too_few(lines: Lines) -> Lines:
    return Lines(*(part[:5] for part in lines))


def hardly_any(lines: Lines) -> Lines:
    """A line in one row of eight only."""
    column = lines.column_px.copy()
    column[:, np.arange(column.shape[1]) % 8 > 0] = np.nan
    return lines._replace(column_px=column)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (too_few, "needs a sweep; this recording has 5 shots"),
        (one_wall, "cannot tell|flat pieces found"),
        (hardly_any, "only 0 flat pieces found"),
    ],
)
def test_what_a_scan_cannot_tell_is_refused(spoil, words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        refine(spoil(room_lines(0.05, seed=1, step_deg=4.0)), head())


def test_a_head_that_is_not_this_one_is_refused() -> None:
    with pytest.raises(CalibrationError, match="nothing is written"):
        refine(room_lines(0.008, seed=1), off_by(head(), 4.5, (0.0, 0.0)))


@pytest.mark.parametrize(
    ("missing", "words"), [("laser plane", "no laser plane to refine"), ("axis", "has no axis yet: write the head's")]
)
def test_what_was_never_calibrated_is_named(missing: str, words: str) -> None:
    wrong = replace(off_by(head(), 4.5, (0.0, 0.0)), meta={"uncalibrated": [missing]})
    with pytest.raises(CalibrationError, match=words):
        refine(room_lines(0.008, seed=1), wrong)


def test_half_a_turn_of_a_bare_box_ends_with_an_answer() -> None:
    """Pieces of a few patches at the ends of the walls have no plane, and must not count as one."""
    lines = room_lines(0.008, seed=4, mount=HeadMount(), bearings=np.arange(0.0, 181.0, 3.0))
    refined = refine(lines, off_by(head(mount=HeadMount()), 0.5, (0.008, -0.006)))
    assert abs(np.degrees(refined.after.beta) - 25.7) < 0.05


def test_rendered_room_without_its_offset(data: Path) -> None:
    source = data / "rendered" / "room-offset"
    exact = head_of_rig_json(source / "rig.json")
    choice = session.Choice(settings=())
    with session.prepare_replay(source, with_head(choice, replace(exact, mount=HeadMount())), session.Outputs()) as job:
        measured = measure_lines(job, lambda _: None, lambda: False)
    beta, offset, _ = errors(refine(measured.lines, measured.calibration), exact)
    assert np.linalg.norm(offset[:2]) < 3.0 and abs(beta) < 0.05


def with_head(choice: session.Choice, calibration: Calibration) -> session.Choice:
    class Given(session.Choice):
        def head(self) -> Calibration:
            return calibration

    return Given(choice.config, choice.settings)


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", *words])
    return int(ended.value.code or 0), *capsys.readouterr()


def published_head(folder: Path) -> Calibration:
    """The head of srv-scan as its refit_calibration.json has it, with the plane that its boards told."""
    refit = json.loads((folder / "refit_calibration.json").read_text())
    preset = load("srv-turntable").head()
    R = preset.T_head_camera[:3, :3]  # its z is the published axis
    assert R[2] == pytest.approx(refit["turntable_axis_cam"], abs=1e-9)
    offset = -R @ np.array(refit["turntable_centre_cam_m"])
    plane = np.append(R @ np.array(refit["n"]), refit["d"])
    return replace(preset, laser_plane=plane, mount=HeadMount((offset[0], offset[1], offset[2])))


def block_of(source: Path, head_file: Path) -> tuple[list[np.ndarray], list[float]]:
    """Points of the four faces of srv-scan's block, and its size [m]."""
    result = replayed(source, session.Outputs(), session.Choice("srv-turntable", calibration=str(head_file)))
    cloud = result.scan.points[result.scan.valid].astype(np.float64)
    side = cloud[(cloud[:, 2] > 0.006) & (cloud[:, 2] < 0.034) & (np.hypot(*cloud[:, :2].T) < 0.075)]
    return block_faces(side), block_size(side)


@pytest.mark.slow
def test_photographed_block_comes_right_from_the_boards_plane(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The rig had moved since its board pictures: with the board's plane the block is 107 x 70 mm, its faces bowed."""
    folder, board, out = data / "real" / "srv-scan", tmp_path / "board.toml", tmp_path / "calibration.toml"
    published_head(folder).save(board)
    assert block_of(folder, board)[1] == pytest.approx([0.070, 0.107], abs=0.001)
    source = str(folder)
    code, said, _ = run(capsys, "check", source, "--config", "srv-turntable", "--calibration", str(board))
    assert code == 1 and "FAIL  walls" in said and "FAIL  self-calibration" in said
    code, said, _ = run(
        capsys, "self", source, "--config", "srv-turntable", "--calibration", str(board), "--out", str(out)
    )
    assert code == 0 and "scale is held by the axis" in said
    faces, size = block_of(folder, out)
    assert size == pytest.approx([0.055, 0.092], abs=0.001)
    for face in faces:
        assert fit_plane(without_strays(face)).rms_m < 0.0005
    # The axis as its markers had told it on the empty table too, in the published head's frame [deg].
    assert "4 printed markers, followed around" in said
    lean = Calibration.load(out).mount.tilt_deg
    assert lean == pytest.approx((-0.42, 0.53), abs=0.1)
    code, said, _ = run(capsys, "check", source, "--config", "srv-turntable", "--calibration", str(out))
    assert code == 0 and "PASS" in said
    # Once more there is nothing to gain, and nothing is written.
    before = out.read_bytes()
    code, said, _ = run(
        capsys, "self", source, "--config", "srv-turntable", "--calibration", str(out), "--out", str(out)
    )
    assert code == 0 and "nothing to gain" in said and out.read_bytes() == before


def without_strays(face: np.ndarray) -> np.ndarray:
    fit = fit_plane(face)
    off = np.abs(face @ fit.normal + fit.d)
    return face[off < 4 * 1.4826 * np.median(off)]


def test_the_command_writes_beside_the_old_one_and_says_what_it_saw(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, picture, space = tmp_path / "calibration.toml", tmp_path / "walls.png", tmp_path / "walls.rrd"
    recording, wrong = twin_recording(tmp_path)
    replace(wrong, meta={"uncalibrated": ["axis"]}).save(out)
    code, said, complaint = run(
        capsys, "self", str(recording), "--calibration", str(out), "--out", str(out), "--figure", str(picture),
        "--rrd", str(space),
    )  # fmt: skip
    assert code == 0, complaint
    assert "DIGITAL TWIN" in said and "not observable" in said and "calibration.toml.1" in said
    assert Calibration.load(tmp_path / "calibration.toml.1").beta == pytest.approx(wrong.beta)
    after = Calibration.load(out)
    assert np.degrees(after.beta) == pytest.approx(25.7, abs=0.05)
    assert after.residuals["self_rms_px"] < 0.2 and after.meta["source"] == "digital twin"
    known = uncertainty_of(after)
    assert known is not None
    for name, true, found in zip(("offset_x", "offset_y"), (0.0, 0.0), after.mount.offset_m, strict=False):
        assert abs(found - true) < 4 * known.sigma(name)
    assert "uncalibrated" not in after.meta and "square to each other" in said
    assert picture.stat().st_size > 20_000 and space.stat().st_size > 20_000
    # A good head is left as it is, and what cannot be read costs nothing either.
    before = out.read_bytes()
    for words, complaint in (
        ((str(tmp_path / "none.mcap"), "--out", str(out)), "does not exist"),
        ((str(recording), "--out", str(tmp_path)), "is a folder"),
        ((str(recording), "--out", str(tmp_path / "head.ply")), "must end in .toml"),
        ((str(recording), "--calibration", str(out), "--out", str(out), "--figure", "walls.jpg"), "must end in .png"),
        (
            (str(recording), "--out", str(out), "--figure", "/proc/walls.png"),
            "--figure /proc/walls.png cannot be written",
        ),
    ):
        code, _, said = run(capsys, "self", *words)
        assert code == 2 and complaint in said
    assert out.read_bytes() == before


def twin_recording(folder: Path) -> tuple[Path, Calibration]:
    """A small full turn of the twin's box-shaped room, and its head with beta and offset wrong."""
    path = folder / "box.mcap"
    settings = (
        "calibration.image.width=640", "calibration.image.height=480", "twin.room=box", "stage.max_deg=360",
        "sweep.end_deg=354", "sweep.step_deg=6.0",
    )  # fmt: skip
    with session.prepare_scan(session.Choice(None, settings), session.Outputs(record=path), view=False) as job:
        job.run(lambda _: None, lambda: False)
        return path, off_by(job.calibration, 0.5, (0.008, -0.006))
