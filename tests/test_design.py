"""`scanmap design` against plain trigonometry."""

import io
import sys
from pathlib import Path

import numpy as np
import pytest

from scanmap.calibration import CalibrationFile
from scanmap.cli import main
from scanmap.errors import CalibrationError
from scanmap.solvers.design import evaluate, points_on_wall
from scanmap.triangulation import TriangulationParams

LIMITS = TriangulationParams(range_min_m=0.02, range_max_m=8.0)


def head(baseline_m: float = 0.08, beta_deg: float = 25.7, alpha_deg: float = 32.3, width: int = 1600):
    document = {
        "image": {"width": width, "height": 3 * width // 4},
        "head": {"baseline_m": baseline_m, "beta_deg": beta_deg, "alpha_deg": alpha_deg},
    }
    return CalibrationFile.model_validate(document).build()


@pytest.mark.parametrize(("baseline", "beta", "alpha", "width"), [(0.08, 25.7, 32.3, 1600), (0.2, 12.0, 25.0, 1280)])
def test_numbers_are_those_of_the_triangle(baseline: float, beta: float, alpha: float, width: int) -> None:
    found = evaluate("head", head(baseline, beta, alpha, width), LIMITS, sigma_px=0.1)
    a, b = np.radians([alpha, beta])
    focal = width / (2 * np.tan(a))
    middle = (width - 1) / 2
    assert found.column_infinity == pytest.approx(middle - focal * np.tan(b), abs=0.01)
    last = baseline / np.tan(b + np.arctan((width - 1 - middle) / focal))
    # The middle row is half a pixel beside the horizontal, so range is a little more than depth.
    assert found.nearest_m == pytest.approx(max(last, 0.02), rel=2e-3)
    seen = np.isfinite(found.column)
    assert seen[found.ranges_m > 0.3].all()
    angle = np.arctan2(baseline, found.ranges_m[seen])
    assert found.column[seen] == pytest.approx(middle + focal * np.tan(angle - b), abs=0.05)
    # d = x / tan(angle), angle = b + atan((u - c) / f).
    step = baseline / np.sin(angle) ** 2 * np.cos(angle - b) ** 2 / focal
    assert found.step_m[seen] == pytest.approx(step, rel=2e-3)
    assert found.sigma_m[seen] == pytest.approx(0.1 * step, rel=2e-3)


def test_tables_are_drawn_with_signs_that_the_reader_has(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pipe on Windows is cp1252: lines of escapes stood there instead of a table."""
    stdout = io.TextIOWrapper(io.BytesIO(), encoding="cp1252")
    monkeypatch.setattr(sys, "stdout", stdout)
    with pytest.raises(SystemExit) as ended:
        main(["design", "--config", "wide"])
    assert ended.value.code == 0
    said = stdout.buffer.getvalue().decode("cp1252")  # type: ignore[attr-defined]
    assert "|nearest range m         |       0.200|" in said and "\\u" not in said


def test_a_longer_baseline_measures_finer_and_sees_less_near() -> None:
    short, long = (evaluate("head", head(x), LIMITS, 0.1) for x in (0.08, 0.16))
    assert long.sigma_m[6] == pytest.approx(0.5 * short.sigma_m[6], rel=0.02)
    assert long.nearest_m == pytest.approx(2.0 * short.nearest_m, rel=0.01)


def test_view_and_points_on_a_wall() -> None:
    found = evaluate("head", head(), LIMITS, 0.1)
    # The camera's lower border, seen from the laser: z = -(v - cv) / f (d cos beta + x sin beta).
    b = np.radians(25.7)
    height = (599.5 / 1265.4749) * (1.9 * np.cos(b) + 0.08 * np.sin(b))
    assert found.view_down_deg == pytest.approx(np.degrees(np.arctan2(height, 1.9)), abs=0.3)
    assert found.view_up_deg == pytest.approx(found.view_down_deg, abs=0.1)
    assert points_on_wall(found, 2.0, 4.0, 1.0, 1.0) == pytest.approx(90 * 28.1 * 1200 / 47.0, rel=0.03)
    assert points_on_wall(found, 2.0, 4.0, 1.0, 0.5) == pytest.approx(
        2 * points_on_wall(found, 2.0, 4.0, 1.0, 1.0), abs=1
    )


def test_a_camera_that_never_sees_the_laser_is_said_so() -> None:
    with pytest.raises(CalibrationError, match=r"never sees the laser between 0\.02 and 8 m; turn it in"):
        evaluate("head", head(beta_deg=-70.0), LIMITS, 0.1)


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main(["design", *words])
    return int(ended.value.code or 0), *capsys.readouterr()


def test_heads_are_compared_in_one_table_and_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "heads.png"
    code, said, _ = run(capsys, "--config", "thesis", "--config", "wide", "--out", str(picture))
    assert code == 0 and picture.stat().st_size > 20_000
    for words in ("column at infinity", "190.5", "271.0", "558.8", "nearest range m", "points on 4x2.5 m at 2 m"):
        assert words in said


def test_a_head_can_be_given_without_any_file(capsys: pytest.CaptureFixture[str]) -> None:
    code, said, _ = run(capsys, "--baseline-mm", "120", "--beta-deg", "20", "--image", "1920x1080")
    assert code == 0 and "1920x1080" in said and "120.0" in said
    for words, complaint in (
        (("--image", "3"), "try --image 1920x1080"),
        (("--wall", "4"), "try --wall 4x2.5@2"),
        (("--config", "none"), "presets"),
        (("--out", "heads.txt"), "must end in .png; try heads.png"),
    ):
        code, _, said = run(capsys, *words)
        assert code == 2 and complaint in said and said.count("\n") == 1


def test_a_head_for_things_in_the_hand_is_not_compared_where_it_sees_nothing() -> None:
    near = evaluate("head", head(baseline_m=0.05, beta_deg=60.0, alpha_deg=10.0), LIMITS, 0.1)
    assert near.farthest_m < 0.3
    assert near.model_error == "nothing in view from 0.3 to 3 m to compare the thesis's models by"
