"""Whatever a wire, a file or a user brings: one of scanmap's own errors or a result, never a crash, never a hang.

`make fuzz` runs 100,000 inputs; an ordinary test run a few. Inputs are damaged copies of good ones, and pure noise.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from fuzz_targets import SHOTS, TARGETS, Damage, damaged
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from recorded_shots import CALIBRATION

from scanmap import config as configuration
from scanmap.calibration import Calibration
from scanmap.recording import open_source
from scanmap.recording.bearings import read_bearings

EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "60"))

fuzz = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)

damages: st.SearchStrategy[Damage] = st.lists(
    st.tuples(st.floats(0, 1), st.sampled_from((0, 1, 1, 2, 8, 100)), st.binary(max_size=9)), min_size=1, max_size=4
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.parametrize("name", TARGETS)
@fuzz
@given(damage=damages)
def test_damage(name: str, folder: Path, damage: Damage) -> None:
    TARGETS[name].read(damaged(TARGETS[name].good, damage), folder)


@pytest.mark.parametrize("name", TARGETS)
@fuzz
@given(noise=st.binary(max_size=300))
def test_noise(name: str, folder: Path, noise: bytes) -> None:
    TARGETS[name].read(noise, folder)


def test_what_is_damaged_was_good(folder: Path) -> None:
    """Else the damage would be done to something that is refused anyway."""
    (folder / "good.csv").write_bytes(TARGETS["scan.csv"].good)
    (folder / "good.mcap").write_bytes(TARGETS["MCAP"].good)
    assert len(read_bearings(folder / "good.csv")) == 4
    assert list(open_source(folder / "good.mcap").shots()) == SHOTS
    assert Calibration.loads(TARGETS["calibration TOML"].good.decode(), source="good").dumps() == CALIBRATION.dumps()
    assert configuration.parse(TARGETS["rig TOML"].good.decode(), "good") == configuration.load("twin-room")
