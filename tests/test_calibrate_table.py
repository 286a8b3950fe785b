"""`calibrate table`: the thesis's numbers, real numbers of another head, analytic heads, and bad tables."""

from pathlib import Path

import numpy as np
import pytest

from scanmap.calibration import Calibration
from scanmap.cli import main
from scanmap.errors import ConfigError
from scanmap.solvers.pairs import Pairs, read_pairs
from scanmap.solvers.table import calibration_of, columns_rightward, depths_of, fit_table
from scanmap.triangulation import TriangulationParams, locate

# Rows of the line (whole pixels, 240 high) and distances [m] that laser-range-finder's calibrate.yml pairs.
RANGE_FINDER = "row,distance_mm\n99,350\n101,400\n81,180\n108,650\n108,650\n116,2450\n"


def thesis(data: Path) -> Pairs:
    return read_pairs(data / "thesis_table.csv")


def errors(pairs: Pairs, *, chosen: list[int] | None = None, width: int = 1600, baseline: float = 0.08) -> dict:
    rows = np.arange(len(pairs.column)) if chosen is None else np.array(chosen)
    fit = fit_table(pairs, width, baseline, rows)
    return {name: depth / pairs.distance_m - 1.0 for name, depth in depths_of(fit, pairs).items()}


def test_the_thesis_table_gives_its_known_constants(data: Path) -> None:
    pairs = thesis(data)
    fit = fit_table(pairs, 1600, 0.08, np.arange(7))
    assert (fit.ratio.alpha_deg, fit.ratio.beta_deg) == pytest.approx((42.1, 28.9), abs=0.05)
    assert fit.angle.rpc_deg == pytest.approx(0.0426, abs=5e-5) and fit.angle.ro_deg == pytest.approx(-7.690, abs=5e-4)
    assert fit.free is not None
    free = (fit.free.alpha_deg, fit.free.beta_deg, fit.free.baseline_m)
    assert free == pytest.approx((33.55, 29.60, 0.0920), rel=1e-3)
    assert fit.best is fit.free and fit.best.infinity() == pytest.approx(114.7, abs=0.05)
    near = fit_table(pairs, 1600, 0.08, np.arange(3)).ratio
    assert (near.alpha_deg, near.beta_deg) == pytest.approx((32.34, 25.63), abs=0.005)


def test_the_pinhole_head_fits_the_thesis_table(data: Path) -> None:
    found = errors(thesis(data))
    assert np.abs(found["pinhole with x fitted"]).max() < 0.015
    assert np.abs(found["pinhole fitted"]).max() < 0.034
    assert found["ratio recomputed"][4:] == pytest.approx([0.149, 0.258, 0.516], abs=0.002)


def test_real_distances_of_another_head(tmp_path: Path) -> None:
    """Whole rows only, near returns on the left, and a far pixel worth a third of the distance."""
    path = tmp_path / "pairs.csv"
    path.write_text(RANGE_FINDER)
    pairs = read_pairs(path)
    assert pairs.distance_m.max() == 2.45
    found = errors(pairs, width=240, baseline=0.0225)
    assert np.abs(found["pixel_angle by distance"]).max() < 0.025
    assert np.abs(found["pinhole fitted"]).max() < 0.025
    assert "pinhole with x fitted" not in found
    held_out = errors(pairs, chosen=[2, 1, 5], width=240, baseline=0.0225)
    for name in ("pinhole fitted", "pixel_angle by distance"):
        assert np.abs(held_out[name][[0, 3, 4]]).max() < 0.02


def test_a_pair_noted_twice_counts_once() -> None:
    nan = np.full(5, np.nan)
    column, distance = np.array([530.0, 698.0, 848.0, 1072.0, 1264.0]), np.array([0.3, 0.2, 0.15, 0.101, 0.078])
    once = fit_table(Pairs(column, distance, nan, nan), 1600, 0.08, np.arange(5))
    again = [0, 1, 1, 1, 2, 3, 4]
    twice = fit_table(Pairs(column[again], distance[again], nan[again], nan[again]), 1600, 0.08, np.arange(7))
    assert twice.pinhole == once.pinhole
    assert twice.angle == once.angle


YML = """# rows of a horizontal line
readings: [99, 101, -1, 81, 108, 116]
distances:
    0: 350
    1: 400
    3: 180
    4: 650
    5: 2450
h: 22.5
image_width: 320
image_height: 240
"""


def test_the_range_finders_own_file_brings_its_head(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = tmp_path / "calibrate.yml", tmp_path / "head.toml"
    path.write_text(YML)
    code, said, _ = run(capsys, str(path), "--out", str(out))
    assert code == 0
    assert "columns 81 to 116 of 240, 0.18 to 2.45 m, baseline 22.5 mm" in said
    assert "best: Algorithm 2 by distance" in said
    head = Calibration.load(out)
    # The line lies along the rows there; scanmap's image stands on its side.
    assert (head.intrinsics.width, head.intrinsics.height) == (240, 320)
    assert abs(head.baseline_m) == pytest.approx(0.0225)
    code, said, _ = run(capsys, str(path), "--baseline-mm", "25")
    assert "baseline 25 mm" in said
    for old, new, words in (
        ("    1: 400", "    2: 400", "no reading at column 2"), ("h: 22.5\n", "", "lacks h"),
        ("h: 22.5", "h: far", "could not convert"), ("    1: 400", "    1: -4", "above 0"), (YML, "a: [", "no YAML"),
    ):  # fmt: skip
        path.write_text(YML.replace(old, new))
        code, _, complaint = run(capsys, str(path))
        assert code == 2 and words in complaint and complaint.count("\n") == 1


def test_the_real_file_within_two_and_a_half_per_cent(data: Path) -> None:
    pairs = read_pairs(data / "real" / "laser-range-finder" / "data" / "calibrate.yml")
    assert pairs.head is not None
    assert (pairs.head.width, pairs.head.height, pairs.head.baseline_m) == (240, 320, 0.0225)
    found = errors(pairs, width=240, baseline=0.0225)
    assert np.abs(found["pinhole fitted"]).max() < 0.025
    three = [int(np.flatnonzero(pairs.distance_m == d)[0]) for d in (0.18, 0.4, 2.45)]
    others = [k for k in range(6) if k not in three]
    held_out = errors(pairs, chosen=three, width=240, baseline=0.0225)
    assert np.abs(held_out["pinhole fitted"][others]).max() < 0.02


def test_figures_are_not_drawn_where_nothing_can_be_written(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table, figures = str(data / "thesis_table.csv"), tmp_path / "figures"
    for words in (["--out", "/proc/c.toml", "--figures", str(figures)], ["--figures", "/proc/none/figures"]):
        code, said, complaint = run(capsys, table, *words)
        assert code == 2 and "cannot be written" in complaint and not said
        assert not figures.exists()


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_head_is_found_from_its_own_distances_and_written(mirrored: bool) -> None:
    """Depths by plain trigonometry; the written calibration gives them back through the plane model."""
    width, alpha, beta, baseline = 1280, np.radians(30.0), np.radians(22.0), 0.11
    u = np.array([330.0, 400.0, 520.0, 700.0, 900.0, 1150.0])
    focal = width / (2 * np.tan(alpha))
    depth = baseline / np.tan(beta + np.arctan((u - (width - 1) / 2) / focal))
    nan = np.full(len(u), np.nan)
    pairs = Pairs(columns_rightward(u, width, mirrored), depth, nan, nan)
    fit = fit_table(pairs, width, baseline, np.arange(len(u)))
    assert fit.mirrored == mirrored
    assert (fit.best.alpha_deg, fit.best.beta_deg, fit.best.baseline_m) == pytest.approx((30.0, 22.0, 0.11), rel=1e-6)
    head = Calibration.loads(calibration_of(fit, 960).dumps())
    assert np.linalg.det(head.T_head_camera[:3, :3]) == pytest.approx(1.0)
    points, _, _ = locate(pairs.column, np.full(len(u), 479.5), head, TriangulationParams())
    assert points[:, 0] == pytest.approx(depth, rel=1e-6) and np.abs(points[:, 1:]).max() < 1e-9
    assert (head.ratio is None) == mirrored


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", "table", *words])
    return int(ended.value.code or 0), *capsys.readouterr()


def test_the_command_prints_tables_and_errata_draws_and_writes(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "calibration.toml"
    code, said, _ = run(
        capsys, str(data / "thesis_table.csv"), "--experiment", str(data / "thesis_experiment.csv"), "--out", str(out)
    )
    assert code == 0
    for words in ("alpha 42.15, beta 28.90", "alpha 32.34, beta 25.63", "0.0426 ppx -7.690", "0.1149", "0.0943",
                  "0.0728", "does not follow from the full table", "below limit", "erratum"):  # fmt: skip
        assert words in said
    drawn = sorted(path.name for path in tmp_path.glob("*.png"))
    assert len(drawn) == 6 and all((tmp_path / name).stat().st_size > 10_000 for name in drawn)
    head = Calibration.load(out)
    assert head.ratio is not None and head.pixel_angle is not None
    assert head.pixel_angle.ro_deg == pytest.approx(-7.690, abs=5e-4)
    # On top of another calibration only the two models are new, and the old file stays beside.
    code, said, _ = run(capsys, str(data / "thesis_table.csv"), "--calibration", str(out), "--out", str(out))
    assert code == 0 and "calibration.toml.1" in said
    assert Calibration.load(out).T_head_camera == pytest.approx(head.T_head_camera)


BAD = {
    "": "is empty",
    "ppx,actual_m\n": "no measurement",
    "ppx,far\n1,2\n": "no column of distances in the header ppx, far; valid: actual, distance",
    "ppx,actual_m\n530,0.3\n600,x\n": "line 3: 'x' is no number",
    "ppx,actual_m\n530,0.3\n600,-1\n": "line 3: distance -1; it must be above 0",
    "ppx,actual_m\n530,0.3,7,8\n": "4 cells under 2 headers",
    "actual_m\n0.3\n0.2\n0.1\n": "every row needs a column",
    "ppx,actual_m\n100,0.3\nnan,0.2\n130,0.1\n": "row 2 has no column of the image",
    "ppx,actual_m\n530,0.3\n600,0.25\n": "too few; measure at 3 distances",
    "ppx,actual_m\n530,0.3\n600,0.25\n2000,0.2\n": "column 2000 is outside an image 1600 px wide; give --width",
    "ppx,actual_m\n530,0.3\n600,0.1\n698,0.2\n848,0.4\n": "do not follow the columns",
}


@pytest.mark.parametrize("text", BAD)
def test_bad_tables_are_one_clear_line_and_nothing_is_written(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "table.csv", tmp_path / "calibration.toml"
    path.write_text(text)
    out.write_text("the old one")
    code, _, complaint = run(capsys, str(path), "--out", str(out))
    assert code in (1, 2) and BAD[text] in complaint and complaint.count("\n") == 1
    assert out.read_text() == "the old one"


def test_a_wrong_row_is_named_and_keeps_the_calibration_from_being_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "table.csv", tmp_path / "calibration.toml"
    path.write_text(
        "ppx;actual_m # noted by hand\n530;0,300\n600;0,250\n698;0,200\n848;0,210\n1072;0,100\n1264;0,075\n"
    )
    code, _, complaint = run(capsys, str(path), "--out", str(out))
    assert code == 1 and "worst at row 4 (ppx 848, 0.21 m)" in complaint
    assert not out.exists()


def test_a_table_that_is_not_there_and_rows_it_does_not_have(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        read_pairs(tmp_path / "none.csv")
    path = tmp_path / "table.csv"
    path.write_text(RANGE_FINDER)
    for rows in ("0:3", "1,9", "a"):
        code, _, complaint = run(capsys, str(path), "--rows", rows, "--width", "240", "--baseline-mm", "22.5")
        assert code == 2 and "valid: 1 to 6" in complaint
