"""A calibration on disk is never lost to a new one."""

from pathlib import Path

import pytest

from scanmap.calibration import Calibration
from scanmap.calibration.keeping import refuse_path, save_beside
from scanmap.config import load
from scanmap.errors import CalibrationError, ConfigError


def head() -> Calibration:
    return load("thesis").head()


def test_the_old_one_is_kept_beside_under_the_next_free_number(tmp_path: Path) -> None:
    path = tmp_path / "calibration.toml"
    assert save_beside(head(), path) is None
    for number in (1, 2):
        before = path.read_bytes()
        kept = save_beside(load("wide").head() if number == 1 else head(), path)
        assert kept == tmp_path / f"calibration.toml.{number}" and kept.read_bytes() == before
    assert Calibration.load(path).baseline_m == pytest.approx(0.08)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [
        "calibration.toml", "calibration.toml.1", "calibration.toml.2",
    ]  # fmt: skip


def test_what_cannot_be_written_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "calibration.toml"
    save_beside(head(), path)
    before = path.read_bytes()

    def full(self: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(CalibrationError, match="No space left"):
        save_beside(load("wide").head(), path)
    assert path.read_bytes() == before
    assert not list(tmp_path.glob(".calibration*"))


@pytest.mark.parametrize(
    ("name", "words"), [("c.txt", "end in .toml"), ("no/c.toml", "no folder"), ("d.toml", "folder")]
)
def test_paths_that_cannot_be_are_refused_before_work(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "d.toml").mkdir()
    with pytest.raises(ConfigError, match=words):
        refuse_path(tmp_path / name)
